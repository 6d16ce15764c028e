"""The demo scene of the package, and what tests make their scenes with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from demo_room import Lens, demo_poses, demo_room, render_view, surface_points
from skimage.metrics import peak_signal_noise_ratio

from nsvq_lightning.data.colmap import import_pycolmap, read_model
from nsvq_lightning.data.datamodule import DEMO, DemoDataModule
from nsvq_lightning.data.scene import load_scene


def test_the_package_contains_what_its_maker_makes() -> None:
    room, lens, poses = demo_room(), Lens(320, 240), demo_poses(40)
    points = surface_points(room, lens, poses, 4000, seed=0)
    model = read_model(DEMO)
    np.testing.assert_allclose([image.viewmat for image in model.images], poses, rtol=0, atol=1e-12)
    np.testing.assert_allclose(model.points, points.xyz, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(model.colors, points.rgb)
    assert model.cameras[1].params.tolist() == pytest.approx(lens.params)
    scene = DemoDataModule().scene
    for view in (0, 21):  # the error is that of WebP
        assert peak_signal_noise_ratio(render_view(room, poses[view], 320, 240), scene.view(view).image.numpy()) > 36
    assert sum(path.stat().st_size for path in DEMO.rglob("*")) < 1_200_000


def test_it_is_a_colmap_scene(demo_scene: Path) -> None:
    reconstruction = import_pycolmap().Reconstruction(str(demo_scene / "sparse" / "0"))
    assert (reconstruction.num_reg_images(), reconstruction.num_points3D()) == (9, 500)
    assert reconstruction.compute_mean_track_length() >= 3
    assert 0 < reconstruction.compute_mean_reprojection_error() < 0.3  # pixels: the points carry a little noise
    camera = reconstruction.cameras[1]
    assert camera.model_name == "PINHOLE"
    assert camera.principal_point_x != camera.width / 2
    assert camera.principal_point_y != camera.height / 2
    scene = load_scene(demo_scene)
    assert (len(scene), len(scene.test), len(scene.points)) == (9, 2, 500)


def test_pictures_show_the_points_in_their_colours(demo_scene: Path) -> None:
    # the tracks say where each view sees each point; matt surfaces look alike from everywhere
    scene = load_scene(demo_scene)
    reconstruction = import_pycolmap().Reconstruction(str(demo_scene / "sparse" / "0"))
    differences = []
    for i, name in enumerate(scene.names):
        seen = [p for p in reconstruction.find_image_with_name(name).points2D if p.has_point3D()]
        x, y = np.array([p.xy for p in seen]).astype(int).T
        rows = torch.tensor([p.point3D_id - 1 for p in seen])
        differences.append((scene.view(i).image[y, x].float() / 255 - scene.colors[rows]).abs().mean(1))
    assert torch.cat(differences).median() < 0.05
