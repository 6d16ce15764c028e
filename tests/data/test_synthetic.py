from __future__ import annotations

import filecmp
from pathlib import Path

import numpy as np
import pytest
import torch

from nsvq_lightning.data import synthetic
from nsvq_lightning.data.colmap import import_pycolmap
from nsvq_lightning.data.raytrace import Lamp, Room
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.data.surfaces import Quad, Sphere
from nsvq_lightning.data.synthetic import write_synthetic_scene

GREY = np.full((2, 2, 3), 0.5, np.float32)


def _vector(*xyz: float) -> np.ndarray:
    return np.array(xyz, np.float32)


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


def test_pictures_are_neither_dark_nor_burnt_nor_flat(demo_scene: Path) -> None:
    scene = load_scene(demo_scene)
    pixels = torch.stack([scene.view(i).image for i in range(len(scene))]).float()
    assert 60 < pixels.mean() < 170
    assert (pixels >= 255).all(-1).float().mean() < 0.05
    assert pixels.std() > 35


def test_same_arguments_same_bytes(demo_scene: Path, tmp_path: Path) -> None:
    again = write_synthetic_scene(tmp_path / "again", views=9, width=96, height=72, points=500)
    files = sorted(path.relative_to(demo_scene) for path in demo_scene.rglob("*") if path.is_file())
    assert len(files) >= 12
    _, different, failed = filecmp.cmpfiles(demo_scene, again, [str(file) for file in files], shallow=False)
    assert different == failed == []


def test_nothing_is_left_of_an_interrupted_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(synthetic, "demo_room", lambda: None)
    monkeypatch.setattr(synthetic, "render_view", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_synthetic_scene(tmp_path / "scene", views=2, width=8, height=8, points=1)
    assert list(tmp_path.iterdir()) == []


def test_no_folder_is_overwritten(demo_scene: Path) -> None:
    with pytest.raises(FileExistsError, match="remove it or give another folder"):
        write_synthetic_scene(demo_scene)
    with pytest.raises(ValueError, match="views >= 2"):
        write_synthetic_scene(demo_scene.parent / "other", views=1)


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
