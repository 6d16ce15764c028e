"""The demo scene of the package, and what tests make their scenes with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from demo_room import Lens, demo_poses, demo_room, render_view, surface_points
from raytrace import Lamp, Quad, Room, Sphere
from skimage.metrics import peak_signal_noise_ratio

from nsvq_lightning.data.colmap import import_pycolmap, read_model
from nsvq_lightning.data.datamodule import DEMO, DemoDataModule
from nsvq_lightning.data.scene import load_scene

GREY = np.full((2, 2, 3), 0.5, np.float32)


def _vector(*xyz: float) -> np.ndarray:
    return np.array(xyz, np.float32)


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


def test_pictures_are_neither_dark_nor_burnt_nor_flat() -> None:
    scene = DemoDataModule().scene
    pixels = torch.stack([scene.view(i).image for i in range(len(scene))]).float()
    assert 60 < pixels.mean() < 170
    assert (pixels >= 255).all(-1).float().mean() < 0.05
    assert pixels.std() > 35


def test_surfaces_know_their_coordinates() -> None:
    rng = np.random.default_rng(0)
    quad = Quad(_vector(1, 2, 3), _vector(2, 0, 0), _vector(0, 0, -3), GREY)
    sphere = Sphere(_vector(0, -1, 2), 0.7, GREY)
    uv = rng.uniform(0.05, 0.95, (50, 2)).astype(np.float32)
    for surface in (quad, sphere):
        points = surface.points(uv)
        np.testing.assert_allclose(surface.coordinates(points), uv, atol=1e-5)
        normals = surface.normals(points)
        np.testing.assert_allclose(surface.intersect(points + normals, -normals), 1, atol=1e-4)
    assert quad.normals(points)[0].tolist() == [0, -1, 0]  # right is x, down is -z: it faces up, to -y


def test_sphere_is_hit_where_the_quadratic_says() -> None:
    sphere = Sphere(_vector(0, 0, 5), 2.0, GREY)
    rays = np.array([[0, 0, 1], [0, 0.5, 1], [0, 0, -1]], np.float32)
    t = sphere.intersect(_vector(0, 0, 0), rays)
    # |t (0, 1/2, 1) - (0, 0, 5)|² = 4  =>  5/4 t² - 10 t + 21 = 0 has no real root
    assert t.tolist() == [3.0, np.inf, np.inf]
    assert sphere.intersect(_vector(0, 0, 5), rays[:1]).tolist() == [2.0]


def test_lamp_light_follows_the_inverse_square_law_and_casts_shadows() -> None:
    floor = Quad(_vector(-5, 0, 5), _vector(10, 0, 0), _vector(0, 0, -10), np.ones((2, 2, 3), np.float32))
    lamp = Lamp(_vector(0, -2, 0), side=0.01, power=4.0, ambient=0.0)
    centre = np.array([[0.5, 0.5], [0.9, 0.5]], np.float32)
    bare = Room([floor], lamp).diffuse(0, centre)[:, 0]
    # straight below: power / 2²; four metres aside: cosines at the lamp and at the floor, power · (2²/20) / 20
    np.testing.assert_allclose(bare, [1.0, 4 * (4 / 20) / 20], rtol=0.01)
    shaded = Room([floor, Sphere(_vector(0, -1, 0), 0.3, GREY)], lamp).diffuse(0, centre)[:, 0]
    assert shaded[0] == 0
    assert shaded[1] == pytest.approx(bare[1])
