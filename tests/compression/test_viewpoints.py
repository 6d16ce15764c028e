"""Views of a scene without photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from nsvq_lightning.compression.viewpoints import likely_cameras, views_of
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.splats.splats import RawSplats


def painting(behind: bool = True) -> RawSplats:
    """A wall of small splats of many colours in the plane z = 0, with a large grey one behind it."""
    rng = np.random.default_rng(0)
    across, down = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    means = np.stack([across.ravel(), down.ravel(), np.zeros(1600)], axis=1)
    scales, sh0 = np.full((1600, 3), np.log(0.02)), 2 * rng.standard_normal((1600, 1, 3))
    if behind:
        means = np.concatenate([means, [[0.0, 0.0, 0.2]]])
        scales = np.concatenate([scales, [[np.log(2.0), np.log(2.0), np.log(0.02)]]])
        sh0 = np.concatenate([sh0, np.zeros((1, 1, 3))])
    tensors = (means, np.tile([1.0, 0, 0, 0], (len(means), 1)), scales, np.full(len(means), 6.0), sh0)
    means, quats, scales, opacities, sh0 = (torch.from_numpy(array.astype(np.float32)) for array in tensors)
    return RawSplats(means, quats, scales, opacities, sh0, torch.zeros(len(means), 0, 3))


def eye(camera: Camera) -> np.ndarray:
    view = camera.viewmat.double().numpy()
    return -view[:3, :3].T @ view[:3, 3]


def test_cameras_stand_where_the_detail_is_seen() -> None:
    """Oracle: the side of the wall that nothing covers."""
    cameras = likely_cameras(painting(), 12, 64, 48)
    assert len(cameras) == 12
    assert {(camera.width, camera.height) for camera in cameras} == {(64, 48)}
    free = likely_cameras(painting(behind=False), 12, 64, 48)
    in_front = [np.mean([eye(camera)[2] < 0 for camera in views]) for views in (cameras, free)]
    # At a slant, splats behind one another may be drawn in another order.
    assert in_front[0] >= 0.65
    assert 0.25 <= in_front[1] <= 0.6


def test_the_same_scene_has_the_same_views_and_the_best_come_first() -> None:
    few, many = (likely_cameras(painting(), 5, 64, 48, seed=seed) for seed in (1, 1))
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(few, many, strict=True))
    other = likely_cameras(painting(), 5, 64, 48, seed=2)
    assert not torch.equal(few[0].viewmat, other[0].viewmat)


def test_a_single_splat_and_one_above_another_have_views() -> None:
    splats = painting(behind=False)
    for rows in (slice(0, 1), slice(0, 41, 40)):
        cameras = likely_cameras(RawSplats(*(tensor[rows] for tensor in splats)), 3, 32, 24)
        assert all(camera.viewmat.isfinite().all() for camera in cameras)


def test_photos_give_their_own_views(demo_scene: Path) -> None:
    scene = load_scene(demo_scene)
    found = views_of(painting(), demo_scene, 3)
    assert 0 < len(found) <= 3
    assert all(
        any(
            camera is scene_camera or torch.equal(camera.viewmat, scene_camera.viewmat)
            for scene_camera in (scene.cameras[i] for i in scene.train)
        )
        for camera in found
    )
    assert len(views_of(painting(), None, 2)) == 2
