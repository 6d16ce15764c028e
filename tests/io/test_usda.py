from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from compressed_scenes import arrays_of
from viewer_scenes import plain_scene, sigmoid

from nsvq_lightning.io import FormatError, read_scene, save

Usd = pytest.importorskip("pxr.Usd")  # usd-core has no build for some systems


@pytest.mark.parametrize("degree", range(4))
def test_openusd_reads_what_was_meant(tmp_path: Path, degree: int) -> None:
    scene = plain_scene(5000, degree)
    save(scene, tmp_path / "x.usda")
    stage = Usd.Stage.Open(str(tmp_path / "x.usda"))
    prim, plain = stage.GetDefaultPrim(), arrays_of(scene)
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    known = Usd.SchemaRegistry().FindConcretePrimDefinition(prim.GetTypeName()).GetPropertyNames()
    found = {attribute.GetName(): attribute.Get() for attribute in prim.GetAuthoredAttributes()}
    assert set(found) <= set(known)
    np.testing.assert_array_equal(np.array(found["positions"]), plain.means * np.float32([-1, -1, 1]))
    np.testing.assert_allclose(np.array(found["scales"]), np.exp(plain.scales), rtol=1e-6)
    np.testing.assert_allclose(np.array(found["opacities"]), sigmoid(plain.opacities), atol=1e-7)
    assert found["radiance:sphericalHarmonicsDegree"] == degree
    name = "radiance:sphericalHarmonicsCoefficients"
    assert prim.GetAttribute(name).GetMetadata("elementSize") == (degree + 1) ** 2
    colors = np.array(found[name]).reshape(5000, -1, 3)
    np.testing.assert_array_equal(colors[:, :1], plain.sh0)
    assert len(found["orientations"]) == 5000
    assert [q.GetReal() ** 2 + q.GetImaginary().GetLength() ** 2 for q in found["orientations"][:5]] == pytest.approx(
        [1] * 5, abs=1e-5
    )


def test_another_text_is_refused(tmp_path: Path) -> None:
    save(plain_scene(4, 1), tmp_path / "x.usda")
    text = (tmp_path / "x.usda").read_text()
    for wrong in (text.replace("Splat ", "Mesh "), text.replace("positions", "double xformOp"), text[: len(text) // 2]):
        (tmp_path / "y.usda").write_text(wrong)
        with pytest.raises(FormatError, match=r"y\.usda: (not a \.usda file with one|truncated or damaged)"):
            read_scene(tmp_path / "y.usda")
