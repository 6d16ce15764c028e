"""What a run takes from its photos: extent, background, and first splats that do not hide what is behind them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from runs import fit
from splat_scenes import random_splats

from nsvq_lightning.callbacks import PhaseSchedule
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.points import projected
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import save
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.frame import EXTENT, Frame
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training import run_scene
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates
from nsvq_lightning.training.run_scene import (
    background_of,
    camera_distances,
    extent_of,
    first_splats,
    needed_scene,
    scene_of,
)


def trainer_of(data: ColmapDataModule | None) -> Any:
    return SimpleNamespace(datamodule=data)


def test_who_needs_a_scene_says_what_for_and_what_to_do_without(make_scene: Callable[..., Path]) -> None:
    data = ColmapDataModule(str(make_scene()))
    assert scene_of(trainer_of(data)) is data.scene
    assert scene_of(None) is scene_of(trainer_of(None)) is None
    assert scene_of(trainer_of(SimpleNamespace(scene="bicycle"))) is None  # type: ignore[arg-type]  # of one's own
    assert needed_scene(trainer_of(data), "a test needs photos", "skip it") is data.scene
    with pytest.raises(ValueError, match="a test needs photos: fit with a data module that has a scene, or skip it"):
        needed_scene(trainer_of(None), "a test needs photos", "skip it")


def test_cameras_of_any_unit_have_the_extent_of_a_frame(make_scene: Callable[..., Path]) -> None:
    assert extent_of(trainer_of(ColmapDataModule(str(make_scene())))) == EXTENT


@pytest.mark.parametrize(
    ("white", "asked", "found"),
    [(False, "auto", "black"), (True, "auto", "white"), (True, "white", "white"), (False, "random", "random")],
)
def test_the_background_is_that_of_the_photos(white: bool, asked: str, found: str) -> None:
    scene: Any = SimpleNamespace(white=white, root="lego")
    assert background_of(scene, asked) == found


def test_transparent_photos_are_not_trained_on_black() -> None:
    scene: Any = SimpleNamespace(white=True, root="lego")
    for asked in ("black", "random"):
        with pytest.raises(ValueError, match=f"lego are white .* model.background is {asked}: leave it at auto"):
            background_of(scene, asked)


@pytest.mark.parametrize(
    ("grey", "white", "found", "first"),
    [(False, False, 99, "abbb"), (True, False, 99, "bbbb"), (True, True, 99, "abbb"), (True, False, 20, "bbaa")],
)
def test_points_without_colours_only_fill_up_what_photos_show(
    monkeypatch: pytest.MonkeyPatch, grey: bool, white: bool, found: int, first: str
) -> None:
    """Of 40 points, tens that are given (a) or from the flow between photos (b)."""
    given = torch.zeros(30 if grey and not white else 10, 3)
    monkeypatch.setattr(run_scene, "dense_points", lambda _, count, __: (torch.ones(min(count, found), 3),) * 2)
    scene: Any = SimpleNamespace(points=given, colors=given, grey=grey, white=white)
    for each in run_scene._with_dense_points(scene, 40, 0):
        assert "".join("ab"[int(x)] for x in each[::10, 0]) == first
        assert len(each) == 40


@pytest.mark.parametrize(
    ("grey", "found", "told"), [(True, 19, True), (True, 20, False), (False, 1, False), (False, 0, True)]
)
def test_photos_that_cameras_do_not_fit_are_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, grey: bool, found: int, told: bool
) -> None:
    """Of wrong axes or focal lengths, the flow between photos follows little."""
    monkeypatch.setattr(run_scene, "dense_points", lambda *_: (torch.ones(found, 3),) * 2)
    scene: Any = SimpleNamespace(points=torch.zeros(5, 3), colors=torch.zeros(5, 3), grey=grey, white=False)
    run_scene._with_dense_points(scene, 40, 0)
    assert ("are the cameras right (focal lengths in pixels" in caplog.text) == told


@pytest.mark.parametrize(("known", "kept"), [(40, 40), (80, 80), (81, 41), (4000, 80)])
def test_of_a_dense_cloud_some_points_are_taken(known: int, kept: int) -> None:
    points = torch.arange(3.0 * known).view(known, 3)
    scene: Any = SimpleNamespace(points=points, colors=points / points.max(), grey=False, white=False)
    found, colors = run_scene._with_dense_points(scene, 10, 0)
    assert len(found) == len(colors) == kept
    assert torch.equal(found / points.max(), colors)
    for grey in (False, True):
        alone = SimpleNamespace(**vars(scene) | {"grey": grey})
        assert torch.equal(run_scene._with_dense_points(cast(Any, alone), 0, 0)[0], points)  # those of SfM alone
    steps = found[:, 0].diff()
    assert (steps == steps[0]).all()  # evenly spread


@pytest.mark.parametrize("times", [1, 4])
@pytest.mark.parametrize("part", [False, True])
def test_points_of_a_part_of_the_scene_get_others_beside_them(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch, part: bool, times: int
) -> None:
    """Many points in one place are no points of the others; one point many times is one."""
    data = ColmapDataModule(str(demo_scene))
    scene, shown = data.scene, torch.rand(1000, 3)
    monkeypatch.setattr(run_scene, "dense_points", lambda _, count, __: (shown[:count],) * 2)
    monkeypatch.setattr(run_scene, "far_points", lambda *_: (torch.empty(0, 3), torch.empty(0, 3)))
    points = scene.points
    if part:
        points = points[points[:, 0] < points[:, 0].median()]
        points = torch.cat([points, points + 1e-3, points - 1e-3])
    data.scene = replace(scene, points=points.repeat(times, 1), colors=torch.rand(len(points) * times, 3))
    assert (data.scene.covered() < run_scene.MIN_COVERED) == part
    trainer: Any = SimpleNamespace(datamodule=data)
    count = len(points) - 9
    first = first_splats(trainer, 0, count, 0).means.detach()
    assert len(first) == len(points) + part * (count // 2)
    assert torch.equal(first[len(points) :], shown[: part * (count // 2)])


@pytest.mark.parametrize("kept", [0.0, 0.3, 1.0])
def test_points_that_are_always_masked_become_no_splats(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: float
) -> None:
    """Oracle: points whose row is above the border of the masks in some train photo; of masks without them all stay."""
    shutil.copytree(demo_scene, tmp_path / "scene")
    data = ColmapDataModule(str(tmp_path / "scene"))
    scene, shown = data.scene, np.zeros(len(data.scene.points), bool)
    (tmp_path / "scene" / "masks").mkdir()
    for index, (name, camera) in enumerate(zip(scene.names, scene.cameras, strict=True)):
        mask = np.zeros((camera.height, camera.width), np.uint8)
        border = max(1, round(kept * camera.height))
        mask[:border] = 255
        cv2.imwrite(str(tmp_path / "scene" / "masks" / f"{name}.png"), mask)
        column, row, _ = projected(scene.points.double().numpy(), camera)
        shown |= (index in scene.train) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < border)
    nothing = torch.empty(0, 3), torch.empty(0, 3)
    monkeypatch.setattr(run_scene, "dense_points", lambda *_: nothing)
    monkeypatch.setattr(run_scene, "far_points", lambda *_: nothing)
    trainer: Any = SimpleNamespace(datamodule=ColmapDataModule(str(tmp_path / "scene")))
    assert len(first_splats(trainer, 0, 10**6, 0)) == (shown.sum() or len(shown))
    assert len(first_splats(trainer, 0, None, 0)) == len(shown)  # as in 3DGS


@pytest.mark.parametrize(("points", "fills"), [(20, True), (run_scene.FEW_POINTS + 9, False)])
def test_few_points_only_fill_up_what_photos_show(
    make_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, points: int, fills: bool
) -> None:
    shown = torch.rand(100, 3)
    monkeypatch.setattr(run_scene, "dense_points", lambda *_: (shown, shown))
    monkeypatch.setattr(run_scene, "far_points", lambda *_: (torch.empty(0, 3), torch.empty(0, 3)))
    data = ColmapDataModule(str(make_scene(points=points)))
    known = len(data.scene.points)  # some are at a camera's centre
    trainer: Any = SimpleNamespace(datamodule=data)
    first = first_splats(trainer, 0, known + 100, 0).means.detach()
    assert len(first) == known + 100
    assert torch.equal(first[:100] if fills else first[-100:], shown)


def test_a_lone_point_before_the_cameras_does_not_hide_the_scene(make_scene: Callable[..., Path]) -> None:
    data = ColmapDataModule(str(make_scene()))
    scene = replace(data.scene, frame=Frame())
    centres = torch.stack([scene.cameras[index].position for index in scene.train])
    lone = centres[0] + torch.tensor([0.0, 0.0, 0.5])
    points = torch.cat([lone[None], 1e3 + 0.01 * torch.arange(9.0).view(3, 3)])
    data.scene = replace(scene, points=points, colors=torch.zeros(4, 3))
    trainer: Any = SimpleNamespace(datamodule=data)
    free = first_splats(trainer, 0, None, 0)
    capped = first_splats(trainer, 0, 4, 0)
    nearest = torch.cdist(capped.means, centres).min(1).values
    pixels = capped.scales.exp()[:, 0] / nearest * scene.cameras[0].intrinsics[0]
    assert float(pixels[0]) == pytest.approx(50.0, rel=1e-4)
    assert torch.equal(capped.scales[1:], free.scales[1:])
    assert capped.opacities.sigmoid().tolist() == pytest.approx([0.3] * 4)


def test_lone_points_near_the_cameras_are_left_out(demo_scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those in the way, as of wrong matches; those far away, or near others, stay."""
    monkeypatch.setattr(run_scene, "dense_points", lambda *_: (torch.empty(0, 3), torch.empty(0, 3)))
    data = ColmapDataModule(str(demo_scene), factor=4)
    trainer: Any = SimpleNamespace(datamodule=data)
    scene = data.scene
    points = scene.points.repeat(4, 1)
    points += 0.01 * torch.randn(points.shape, generator=generator(0))
    colors = scene.colors.repeat(4, 1)
    data.scene = replace(scene, points=points, colors=colors)
    before = first_splats(trainer, 0, 9000, 0)
    lone = torch.stack([camera.position + 0.3 * camera.viewmat[2, :3] for camera in scene.train_cameras[:3]]).float()
    near = lone[0] + 0.001 * torch.rand(5, 3, generator=generator(1))  # together they are none
    data.scene = replace(
        scene, points=torch.cat([points, lone[1:], near]), colors=torch.cat([colors, torch.ones(7, 3)])
    )
    after = first_splats(trainer, 0, 9000, 0)
    assert len(after) == len(before) + 5


def test_one_large_photo_does_not_make_the_first_splats_of_others_small(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_scene, "dense_points", lambda *_: (torch.empty(0, 3), torch.empty(0, 3)))
    monkeypatch.setattr(run_scene, "far_points", lambda *_: (torch.empty(0, 3), torch.empty(0, 3)))
    data = ColmapDataModule(str(demo_scene), factor=4)
    trainer: Any = SimpleNamespace(datamodule=data)
    usual = first_splats(trainer, 0, 10_000, 0).scales
    cameras = list(data.scene.cameras)
    one = cameras[data.scene.train[0]]
    sharp = one.K * torch.tensor([[8.0], [8.0], [1.0]])
    cameras[data.scene.train[0]] = Camera(sharp, one.viewmat, 8 * one.width, 8 * one.height, one.near)
    data.scene = replace(data.scene, cameras=tuple(cameras))
    assert torch.equal(first_splats(trainer, 0, 10_000, 0).scales, usual)


def test_positions_move_in_proportion_to_their_distance(demo_scene: Path) -> None:
    data = ColmapDataModule(str(demo_scene), factor=4)
    start = Splats.from_tensors(*random_splats(300, sh_degree=1))
    start.means.data *= torch.linspace(0.2, 3.0, 300)[:, None]
    steps, nearest = {}, torch.ones(0)
    for by_distance in (True, False):
        module = SplatModule(codebooks=None, splats=start, rates=LearningRates(by_distance=by_distance))
        fit(module, data, [PhaseSchedule()], 1)
        before = module.frame.splats(start).means
        centres = torch.tensor([camera.packed_view[12:] for camera in data.scene.standard.train_cameras])
        nearest = torch.cdist(before.double(), centres.double()).min(1).values.float()
        steps[by_distance] = module.splats.means.detach() - before
    assert (steps[False] != 0).any(1).sum() > 100
    assert nearest.max() > 4 * nearest.min()
    torch.testing.assert_close(steps[True], steps[False] * nearest[:, None] / 5, atol=2e-6, rtol=1e-3)
    camera = data.scene.train_cameras[0]
    at = torch.tensor(camera.packed_view[12:]).float()
    places = torch.stack([at, at + torch.tensor([0.0, 3.0, 4.0]), torch.full((3,), torch.nan)])
    distances = camera_distances([camera], places)  # of a splat that is not finite, too, until it is dropped
    assert distances[:2].tolist() == pytest.approx([NEAR, 5.0], rel=1e-5)
    assert distances.isfinite().all()


def test_photos_from_one_place_are_named(make_scene: Callable[..., Path]) -> None:
    module, data = SplatModule(), ColmapDataModule(str(make_scene()))
    data.scene = replace(data.scene, extent=0.0)
    trainer = Trainer(max_steps=1, logger=False, enable_checkpointing=False, enable_progress_bar=False)
    with pytest.raises(ValueError, match=r"the 9 photos of .* are taken from one place.* move while"):
        trainer.fit(module, data)


def test_a_run_can_start_from_a_file(demo_scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    start = Splats.from_tensors(*random_splats(30, sh_degree=1))
    save(start, tmp_path / "start.ply")
    module = SplatModule(
        sh_degree=1,
        codebooks=None,
        init_from=str(tmp_path / "start.ply"),
        rates=LearningRates(means=1e-9, means_final=1e-9),
    )
    data = ColmapDataModule(str(demo_scene), factor=4)
    fit(module, data, [PhaseSchedule()], 1)
    means = torch.from_numpy(module.compressed().means)
    torch.testing.assert_close(means, start.means.detach(), atol=1e-5, rtol=0)
    assert module.active_sh_degree == 1
    caplog.clear()
    fit(SplatModule(sh_degree=1, codebooks=None, splats=start), data, [PhaseSchedule()], 1)
    assert "do not fit" not in caplog.text
    data.scene.points.mul_(30)
    fit(SplatModule(sh_degree=1, codebooks=None), data, [PhaseSchedule()], 1)
    assert "do not fit" not in caplog.text  # the scene's own, which some photos may show little of
    start.means.data.mul_(30)
    fit(SplatModule(sh_degree=1, codebooks=None, splats=start), data, [PhaseSchedule()], 1)
    assert f"do not fit the photos of {demo_scene}: its" in caplog.text
    assert "they are of another scene, or in other coordinates" in caplog.text
    wrong = SplatModule(sh_degree=2, codebooks=None, init_from=str(tmp_path / "start.ply"))
    with pytest.raises(ValueError, match="set sh_degree=1"):
        fit(wrong, data, [PhaseSchedule()], 1)


def test_a_start_that_was_trained_to_look_otherwise_is_told(
    demo_scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, data = tmp_path / "start.ply", ColmapDataModule(str(demo_scene), factor=4)
    save(CompressedScene.from_splats(random_splats(30, sh_degree=1), antialiased=True), path)
    for antialiased in (True, False):
        settings = {"sh_degree": 1, "codebooks": None, "antialiased": antialiased}
        fit(SplatModule(**settings, init_from=str(path)), data, [PhaseSchedule()], 1)
        told = f"{path} was trained with antialiased=True, this run has False: it looks different at first"
        assert (told in caplog.text) is not antialiased


def test_a_fourth_of_many_photos_is_asked_what_shows(demo_scene: Path) -> None:
    scene = ColmapDataModule(str(demo_scene), factor=4).scene
    data = SimpleNamespace(scene=replace(scene, train=4 * scene.train))
    trainer: Any = SimpleNamespace(datamodule=data, global_rank=0, world_size=1, global_step=0)
    trained: Any = SimpleNamespace(render=render)
    splats = random_splats(20)
    for most in (2, 14):
        found = list(run_scene.train_sensitivities(trainer, trained, 0, splats, most))
        assert len(found) == max(most, len(scene.train)) > 2


def test_a_file_without_an_origin_is_where_it_fits(tmp_path: Path) -> None:
    start = Splats.from_tensors(*random_splats(30, sh_degree=1))
    frame = Frame(origin=(4000.0, 0.0, -500.0))
    here = SimpleNamespace(frame=frame, splats=start, antialiased=False, background="black")
    world = replace(CompressedScene.from_splats(start), origin=frame.origin)
    save(world, tmp_path / "own.ply")  # which says no origin
    save(world, tmp_path / "own.nsvq")
    save(world.relative_to((0, 0, 0)), tmp_path / "absolute.ply")
    for name in ("own.ply", "own.nsvq", "absolute.ply"):
        found = run_scene.splats_of_file(str(tmp_path / name), cast(Any, here))
        torch.testing.assert_close(found.means.mean(0), start.means.mean(0), atol=1e-2, rtol=0)
