"""Parts of compressed scenes hold the same splats, and differences are found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from compressed_scenes import scene as coded
from numpy.typing import NDArray
from viewer_scenes import plain_scene

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import load, read_scene, save
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.io.placing import cropped


def test_a_crop_keeps_codebooks_and_what_is_inside() -> None:
    scene = coded(300, origin=(10.0, 0.0, 0.0))
    world = scene.means + np.array(scene.origin)
    low, high = np.array([9.5, -1.0, -0.5]), np.array([10.5, 1.0, np.inf])
    part = cropped(scene, low, high)
    inside = ((world >= low) & (world <= high)).all(1)
    assert 0 < len(part) == inside.sum() < 300
    small = part.in_use()
    for name in scene.codes:
        expected = scene.codebooks[name][scene.codes[name][inside]]
        np.testing.assert_array_equal(small.codebooks[name][small.codes[name]], expected)
        assert len(small.codebooks[name]) == len(np.unique(part.codes[name]))


def test_joined_scenes_have_the_cameras_of_all() -> None:
    parts = [
        replace(coded(20, origin=(shift, 0.0, 0.0)), cameras=np.array([[0.0, 1.0, 2.0, 500.0], [9.0, 0, 0, 600.0]]))
        for shift in (3.0, 5.0)
    ]
    joined = CompressedScene.joined(parts)
    assert joined.origin == (3, 0, 0)
    assert joined.cameras.tolist() == [[0, 1, 2, 500], [9, 0, 0, 600], [2, 1, 2, 500], [11, 0, 0, 600]]
    moved = joined.relative_to((1.0, -1.0, 0.0))
    assert moved.cameras[1].tolist() == [11, 1, 0, 600]
    assert parts[0].sampling() is not None
    assert replace(parts[0], config={"antialiased": True}).sampling() is None
    assert coded(20).sampling() is None


def test_cameras_of_some_scenes_are_not_those_of_all(caplog: pytest.LogCaptureFixture) -> None:
    far = plain_scene(5, 1)
    near = replace(far, cameras=np.array([[0.0, 1.0, 2.0, 500.0]]))
    assert len(CompressedScene.joined([far, far]).cameras) == 0
    assert not caplog.text
    assert len(CompressedScene.joined([near, far]).cameras) == 0
    assert "of some scenes the cameras of their training are known, of some not" in caplog.text


def test_places_on_a_map_are_told_where_only_some_scenes_have_one(caplog: pytest.LogCaptureFixture) -> None:
    near = plain_scene(5, 1)
    far = replace(near, origin=(4e5, 5e6, 0.0))
    CompressedScene.joined([far, far])
    assert not [record for record in caplog.records if "on a map" in record.message]
    CompressedScene.joined([far, near])
    assert "only some scenes say where 0 is on a map" in caplog.text


def test_activations_instead_of_logits_are_told(caplog: pytest.LogCaptureFixture) -> None:
    rows = plain_scene(20, 1).tensors()._asdict()
    CompressedScene.from_splats(rows)
    assert not caplog.text
    for outlier, told in ((1.0, False), (10.0, True)):  # a scene in millimetres, and one of lengths
        scales = rows["scales"] - rows["scales"].min() + 5
        scales[0] *= outlier
        CompressedScene.from_splats(rows | {"scales": scales})
        assert ("all scales above 0, or" in caplog.text) == told
    caplog.clear()
    CompressedScene.from_splats(rows | {"opacities": rows["opacities"].sigmoid()})
    assert "all opacities are in [0, 1]: logits are expected" in caplog.text


def test_a_file_of_activations_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = plain_scene(20, 1)
    scene.opacities[:] = 1 / (1 + np.exp(-scene.opacities))
    save(scene, tmp_path / "x.ply")
    caplog.clear()
    load(tmp_path / "x.ply")
    assert "all opacities are in [0, 1]: logits are expected" in caplog.text


def test_the_coarse_steps_of_one_scene_are_not_those_of_another() -> None:
    coarse, fine = (replace(plain_scene(5, 1), config={"precision": {"position": step}}) for step in (0.1, 0.01))
    assert CompressedScene.joined([coarse, coarse]).config == coarse.config
    for others in ([coarse, fine], [coarse, plain_scene(5, 1)], [plain_scene(5, 1), coarse]):
        assert Storage.told(CompressedScene.joined(others).config) == Storage()


@pytest.mark.parametrize("cameras", [np.ones((65, 4)), np.ones((2, 3)), np.zeros((1, 4)), np.full((1, 4), np.inf)])
def test_cameras_that_no_reader_takes_are_refused(cameras: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match="cameras must be at most 64 finite positions"):
        replace(coded(20), cameras=cameras)


def test_parts_are_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = coded(50)
    turned = scene.changed({name: lambda rows: 2.0 * rows[:, ::-1] for name in ("shN", "sh0")})
    monkeypatch.setattr("nsvq_lightning.splats.attributes.ROWS", 7)
    parts = [*scene.parts()]
    assert [len(part) for part in parts] == [7] * 7 + [1]
    np.testing.assert_array_equal(np.concatenate([part.rows("shN") for part in parts]), scene.rows("shN"))
    again = scene.changed({name: lambda rows: 2.0 * rows[:, ::-1] for name in ("shN", "sh0")})
    for name in ("shN", "sh0"):
        np.testing.assert_array_equal(again.rows(name), turned.rows(name))
    assert scene.in_order(np.arange(50)) is scene


def test_opacities_of_0_and_1_and_no_length_are_numbers(tmp_path: Path) -> None:
    """Of tensors in memory, as of files."""
    rows = {name: tensor.clone() for name, tensor in plain_scene(20, 1).tensors()._asdict().items()}
    rows["opacities"][:2] = torch.tensor([torch.inf, -torch.inf])
    rows["scales"][3, 2] = -torch.inf
    scene = CompressedScene.from_splats(rows)
    assert scene.opacities[:2].tolist() == [20, -20]
    assert scene.raw["scales"][3, 2] == -20
    save(scene, tmp_path / "x.nsvq")
    assert len(read_scene(tmp_path / "x.nsvq")) == 20


@pytest.mark.parametrize("width", [0, 45])
def test_flat_harmonics_are_refused_as_their_order_is_unknown(width: int, tmp_path: Path) -> None:
    """gsplat and INRIA flatten [N, 3, C]; read as [N, C, 3], the colours were others, without a word."""
    tensors = {**flat_splats(), "shN": torch.zeros(5, width)}
    with pytest.raises(ValueError, match=rf"shN must have shape \[N, .*, 3\], got \[5, {width}\]"):
        save(tensors, tmp_path / "scene.ply")


def flat_splats() -> dict[str, torch.Tensor]:
    """Five splats of degree 0."""
    shapes = {"means": (5, 3), "quats": (5, 4), "scales": (5, 3), "opacities": (5,), "sh0": (5, 1, 3)}
    return {name: torch.randn(shape) for name, shape in shapes.items()}
