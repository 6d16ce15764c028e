from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from nsvq_lightning.data.blocks import Block, cut, points_in_front, shown, write_blocks
from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.scene import Scene, load_scene
from nsvq_lightning.rendering.camera import Camera


@pytest.fixture(scope="module")
def scene(demo_scene: Path) -> Scene:
    return load_scene(demo_scene)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_cores_have_each_point_once_and_photos_show_as_much_of_each(scene: Scene, count: int) -> None:
    blocks, points = cut(scene, count), scene.points.double().numpy()
    anywhere = np.random.default_rng(0).normal(0, 1000, (500, 3))
    for places in (points, anywhere):
        assert (np.sum([block.contains(places) for block in blocks], axis=0) == 1).all()
    for block in blocks:
        core, around = block.contains(points), block.contains(points, around=True)
        assert (core <= around).all()
        assert count == 1 or core.sum() < around.sum()
    weights = np.zeros(len(points))
    for index in scene.train:
        rows, cells = points_in_front(points, scene.cameras[index])
        weights[rows] += 1 / np.bincount(cells)[cells]
    shares = [weights[block.contains(points)].sum() / weights.sum() for block in blocks]
    assert min(shares) > 0.7 / count


def test_what_a_nearer_surface_hides_is_not_shown() -> None:
    K = torch.tensor([[200.0, 0, 100], [0, 200, 75], [0, 0, 1]])
    camera = Camera(K, torch.eye(4), 200, 150)
    across, down = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-0.8, 0.8, 80))
    wall = np.stack([2 * across, 2 * down, np.full_like(across, 4)], -1).reshape(-1, 3)
    box = np.stack([0.5 * across, 0.5 * down, np.full_like(across, 2)], -1).reshape(-1, 3)
    points = np.concatenate([wall, box, wall * [1, 1, -1]])
    is_wall = np.arange(len(points)) < len(wall)
    front = points_in_front(points, camera)
    assert front[0].max() < len(wall) + len(box)
    mask = shown(front, is_wall, camera)
    assert mask[0, 0]
    assert mask[-1, -1]
    assert not mask[75, 100]
    assert shown(front, ~is_wall, camera)[75, 100]
    assert not shown(front, np.zeros(len(points), bool), camera).any()


def test_a_part_is_a_scene_with_the_same_cameras_and_split(scene: Scene, tmp_path: Path) -> None:
    blocks, folders = cut(scene, 2), [tmp_path / "1", tmp_path / "2"]
    for folder in folders:
        folder.mkdir()
    counts = write_blocks(scene, blocks, folders)
    for block, folder, (train, test) in zip(blocks, folders, counts, strict=True):
        assert Block.read(folder) == block
        part = load_scene(folder)
        assert (len(part.train), len(part.test)) == (train, test)
        inside = block.contains(scene.points.double().numpy(), around=True)
        torch.testing.assert_close(part.points, scene.points[torch.from_numpy(inside)])
        torch.testing.assert_close(part.colors, scene.colors[torch.from_numpy(inside)], atol=0.5 / 255, rtol=0)
        for number in (part.test[0], part.train[-1]):
            view = part.view(number)
            whole = scene.view(int(Path(view.name).stem))
            assert (whole.index in scene.test) == (number in part.test)
            # The cameras differ by the corner of the crop alone, and the pixels are those of the photo there.
            torch.testing.assert_close(view.camera.viewmat, whole.camera.viewmat, atol=1e-5, rtol=0)
            left, top = (whole.camera.K - view.camera.K)[:2, 2].round().int().tolist()
            height, width = view.image.shape[:2]
            crop = whole.image[top : top + height, left : left + width]
            assert view.mask is not None
            assert view.mask.any(1)[[0, -1]].all()
            assert view.mask.any(0)[[0, -1]].all()
            assert torch.equal(view.image[view.mask], crop[view.mask])


def test_too_many_parts_are_refused(scene: Scene) -> None:
    with pytest.raises(SceneError, match=r"too few points .* for 400 parts: ask for fewer"):
        cut(scene, 400)
    with pytest.raises(SceneError, match=r"is no part of a scene .*nsvq split"):
        Block.read(Path("nowhere"))
