from __future__ import annotations

import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from compressed_scenes import arrays_of
from viewer_scenes import plain_scene, sigmoid

from nsvq_lightning.io import CompressedScene, FormatError, read_scene, save

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
        with pytest.raises(FormatError, match=r"y\.usda: (0 prims of the kind|no attribute positions|truncated: )"):
            read_scene(tmp_path / "y.usda")


def test_a_stray_quote_takes_no_memory_for_each_character_behind_it(tmp_path: Path) -> None:
    save(plain_scene(3000, 1), tmp_path / "x.usda")
    text = (tmp_path / "x.usda").read_text()
    (tmp_path / "y.usda").write_text(text.replace("positions", 'posi"tions'))
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match=r"y\.usda: "):
            read_scene(tmp_path / "y.usda")
        assert tracemalloc.get_traced_memory()[1] < 20 * len(text)
    finally:
        tracemalloc.stop()


def _changed(path: Path, change: Callable[[str], str]) -> CompressedScene:
    """What is read of a file of 5 splats whose text was changed."""
    save(plain_scene(5, 1), path)
    path.write_text(change(path.read_text()))
    return read_scene(path)


NAMES = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")


def _squeezed(text: str) -> str:
    return re.sub(r" *([=,]) *", r"\1", text)


def _half(text: str) -> str:
    for name in NAMES:
        text = text.replace(f" {name} =", f" {name}h =")
    return text.replace("point3f[]", "point3h[]").replace("float", "half").replace("quatf", "quath")


def _sampled(text: str) -> str:
    return re.sub(r"(positions|scales) = (\[[^\]]*\])", r"\1.timeSamples = { 0.5: \2, 1: [(9, 9, 9)], }", text)


def _beside_others(text: str) -> str:
    """Numbers of other prims, and words that only look like some."""
    other = """def PointInstancer "a" {
        point3f[] positions = [(70, 0, 0)]
        float3[] scales = [(7, 7, 7)]
    }
    # float[] opacities = [0.5]
    """
    text = text.replace("(\n", '(\n    doc = "metersPerUnit = 100, # \\"upAxis = 1"\n    # upAxis = "Z"\n', 1)
    return (
        text.replace("def ", f"{other}def ", 1)
        + 'over "b" {\n float[] opacities = [0.25]\n}\n'
        + other.replace('"a"', '"c"')
    )


@pytest.mark.parametrize("change", [_squeezed, _half, _sampled, _beside_others])
def test_the_same_splats_in_other_words(
    tmp_path: Path, change: Callable[[str], str], caplog: pytest.LogCaptureFixture
) -> None:
    plain, changed = (arrays_of(_changed(tmp_path / "x.usda", each)) for each in (str, change))
    assert Usd.Stage.Open(str(tmp_path / "x.usda"))  # OpenUSD reads it, too
    for name, values in vars(plain).items():
        np.testing.assert_array_equal(getattr(changed, name), values, err_msg=name)
    assert ("changes with time" in caplog.text) == (change is _sampled)


def test_linear_light_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    _changed(
        tmp_path / "x.usda", lambda text: text.replace("(", '(\n    customData = { string c = "lin_rec709_scene" }', 1)
    )
    assert "linear light" in caplog.text


def test_lengths_that_are_logarithms_are_known_by_their_sign(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    plain = _changed(tmp_path / "x.usda", str)
    logs = plain.values("scales")
    assert (logs < 0).any()
    text = ", ".join(f"({', '.join(map(str, row))})" for row in logs.tolist())
    found = _changed(tmp_path / "y.usda", lambda old: re.sub(r"scales = \[[^\]]*\]", f"scales = [{text}]", old))
    np.testing.assert_allclose(found.values("scales"), logs, atol=1e-6)
    assert "taken as logarithms" in caplog.text


def test_axes_and_unit_of_the_stage(tmp_path: Path) -> None:
    """Oracle: by hand. With z up, y points away; ours points down, and away is z."""
    plain = _changed(tmp_path / "x.usda", str)
    x, y, z = (plain.means * [-1, -1, 1]).T  # as the file has them
    turned = _changed(tmp_path / "x.usda", lambda text: text.replace('upAxis = "Y"', 'upAxis="Z"'))
    np.testing.assert_allclose(turned.means, np.stack([-x, -z, -y], 1), atol=1e-6)
    small = _changed(tmp_path / "x.usda", lambda text: text.replace("metersPerUnit = 1", "metersPerUnit = 0.01"))
    np.testing.assert_allclose(small.means, plain.means / 100, rtol=1e-6)
    np.testing.assert_allclose(small.values("scales"), plain.values("scales") - np.log(100), atol=1e-5)


def test_a_word_among_numbers_is_damage(tmp_path: Path) -> None:
    save(plain_scene(3, 0), tmp_path / "x.usda")
    text = (tmp_path / "x.usda").read_text()
    start = text.index("float[] opacities = [") + len("float[] opacities = [")
    (tmp_path / "x.usda").write_text(f"{text[:start]}0.5, many, {text[start:]}")
    with pytest.raises(FormatError, match="damaged: opacities"):
        read_scene(tmp_path / "x.usda")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"PXR-USDC\0\0", "binary OpenUSD .*; write it as text: usdcat"),
        (b"PK\x03\x04", "binary OpenUSD .*; write it as text: usdcat"),
        (b"ply\n", "not a .usda file: it does not start with '#usda'; export it anew"),
        (b"#usda 1.0\ndef Mesh {}", "0 prims of the kind ParticleField3DGaussianSplat, not one"),
        (b'#usda 1.0\ndef ParticleField3DGaussianSplat "a" { double3 xformOp:scale = (1, 1, 1) }', "transforms"),
    ],
)
def test_what_is_not_read_is_said_in_clear_words(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "x.usda").write_bytes(content)
    with pytest.raises(FormatError, match=message):
        read_scene(tmp_path / "x.usda")
