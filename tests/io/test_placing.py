"""Turned and moved scenes look as before from where the cameras have gone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from compressed_scenes import on_basis
from compressed_scenes import scene as coded
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nsvq_lightning.compression.viewpoints import look_at
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.placing import UP_AXES, moved, rotated, turn_up
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.poses import up_of, view_from
from nsvq_lightning.rendering.rasterize import render
from tests.support.splat_scenes import ball


def picture(scene: CompressedScene, camera: Camera) -> torch.Tensor:
    splats = scene.decode().double().raw()
    world = splats._replace(means=splats.means + torch.tensor(scene.origin))
    with torch.no_grad():
        return render(world, camera, backend="reference").image


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("kind", ["codebooks", "plain", "basis"])
def test_a_turned_scene_is_the_same_scene(degree: int, kind: str) -> None:
    plain = replace(ball(200, degree), origin=(0.5, -1.0, 2.0))
    sizes = {"scales": 9, "quats": 7, "sh0": 8} | ({"shN": 6} if degree else {})
    scene = coded(200, sizes, degree, origin=(0.5, -1.0, 2.0)) if kind == "codebooks" else plain
    if kind == "basis" and degree:
        scene = on_basis(plain)
    rotation = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    scene = replace(scene, cameras=np.array([[1.5, 0.0, -3.0, 700.0], [0.1, 0.2, 0.3, 50.0]]))
    turned = rotated(scene, rotation)
    world = scene.cameras[:, :3] + scene.origin
    np.testing.assert_allclose(turned.cameras[:, :3] + turned.origin, world @ rotation.T)
    np.testing.assert_array_equal(turned.cameras[:, 3], scene.cameras[:, 3])
    assert [len(rows) for rows in turned.codebooks.values()] == [len(rows) for rows in scene.codebooks.values()]
    if scene.bases:
        expanded = replace(scene, raw={name: scene.rows(name) for name in scene.raw}, bases={})
        np.testing.assert_allclose(turned.values("shN"), rotated(expanded, rotation).values("shN"), rtol=0, atol=1e-6)
        np.testing.assert_array_equal(turned.raw["shN"], scene.raw["shN"])
    middle = np.array(scene.origin)
    before = look_at(middle, middle + np.array([1.0, 2.0, -6.0]), 60, 40, 0.9)
    back = np.eye(4)
    back[:3, :3] = rotation.T
    after = Camera(before.K, torch.from_numpy(before.viewmat.double().numpy() @ back), 60, 40)
    expected = picture(scene, before)
    assert expected.std() > 0.01
    torch.testing.assert_close(picture(turned, after), expected, rtol=0, atol=2e-5)


def test_splats_without_a_rotation_turn_with_the_others() -> None:
    """The renderer takes 0 0 0 0 for the identity; its product with a rotation is 0 0 0 0 again."""
    rotation = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    found = []
    for w in (0.0, 1.0):
        scene = ball(20, 1)
        scene.raw["quats"][:] = [w, 0, 0, 0]
        found.append(rotated(scene, rotation).values("quats"))
    np.testing.assert_array_equal(*found)


def test_a_scene_keeps_its_detail_on_a_map() -> None:
    scene = ball(200)
    shift = np.array([4.1e6, 6.3e5, 4.8e6])
    there = moved(scene, np.c_[np.eye(3), shift])
    np.testing.assert_array_equal(there.means, scene.means)
    assert there.origin == tuple(shift)
    near = moved(scene, np.c_[np.eye(3), [4.0, 0.0, -2.0]])
    assert near.origin == moved(scene, np.c_[np.eye(3), [300.0, 0.0, 0.0]]).origin == scene.origin
    np.testing.assert_allclose(near.means, scene.means + np.array([4.0, 0.0, -2.0]), atol=1e-6)


def cameras_with_up(up: NDArray[np.float64], roll: float = 0.0) -> list[Camera]:
    """Level cameras around a vertical axis, looking a little down, every fifth in portrait format."""
    lift = np.linalg.inv(turn_up(up, "minus-y"))
    made = []
    for number, angle in enumerate(np.linspace(0, 5, 20)):
        camera = look_at(np.zeros(3), np.array([4 * np.cos(angle), -1.5, 4 * np.sin(angle)]), 40, 30, 0.9)
        view = camera.viewmat.double().numpy()
        view[:3, :3] = view[:3, :3] @ lift.T
        quarter = Rotation.from_rotvec([0, 0, np.pi / 2 * (number % 5 == 0) + roll]).as_matrix()
        view[:3] = quarter @ view[:3]
        made.append(Camera(camera.K, torch.from_numpy(view), 40, 30))
    return made


@pytest.mark.parametrize("axis", UP_AXES)
@pytest.mark.parametrize("up", [[0.0, -1, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8], [1e-9, 1, 0]])
def test_up_becomes_the_axis(axis: str, up: list[float]) -> None:
    direction = np.array(up) / np.linalg.norm(up)
    rotation = turn_up(direction, axis)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    expected = {"y": [0, 1, 0], "minus-y": [0, -1, 0], "z": [0, 0, 1], "minus-z": [0, 0, -1]}[axis]
    np.testing.assert_allclose(rotation @ direction, expected, atol=1e-6)
    if not up[0]:
        np.testing.assert_allclose(rotation[0], [1, 0, 0], atol=1e-9)  # x stays, as from right, up, back


@pytest.mark.parametrize("up", [[0.0, -1, 0], [0, 0, 1], [0.36, -0.48, 0.8]])
def test_up_is_where_most_cameras_hold_it(up: list[float]) -> None:
    np.testing.assert_allclose(up_of(cameras_with_up(np.array(up))), up, atol=0.02)


@pytest.mark.parametrize("up", [[0.0, -1, 0], [0.36, -0.48, 0.8]])
def test_a_drone_that_turns_above_the_ground_looks_down(up: list[float]) -> None:
    lift = np.linalg.inv(turn_up(np.array(up), "minus-y"))
    unsteady, views = Rotation.from_rotvec(0.03 * np.random.default_rng(0).normal(size=(28, 3))), []
    for number in range(28):  # strips to and fro
        turn = Rotation.from_euler("xy", [-np.pi / 2, np.pi * (number // 4 % 2)]) * unsteady[number]
        views.append(view_from(lift @ turn.as_matrix(), lift @ np.array([number % 4, -30.0, number // 4])))
    cameras = [Camera(torch.eye(3), view, 40, 30) for view in views]
    np.testing.assert_allclose(up_of(cameras), up, atol=0.03)


def test_a_scene_that_comes_near_has_no_origin_any_more() -> None:
    """Files of other formats have none, so it would be displaced there."""
    near = ball(50)
    there = np.hstack([np.eye(3), [[4e6], [5e5], [-2e6]]])
    far = moved(near, there)
    assert far.origin == (4e6, 5e5, -2e6)
    back = moved(far, np.hstack([np.eye(3), -there[:, 3:] + 1]))
    assert back.origin == (0, 0, 0)
    np.testing.assert_allclose(back.means, near.means + 1, atol=1e-5)
    turned = moved(far, np.hstack([[[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.zeros((3, 1))]))
    assert turned.origin == (-5e5, 4e6, -2e6)


def test_nothing_is_moved_of_an_empty_scene() -> None:
    empty = ball(2).take(np.zeros(0, np.int64))
    assert len(moved(empty, np.c_[np.eye(3), np.ones(3)])) == 0
