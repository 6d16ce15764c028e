from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nsvq_lightning.commands.doctor import folder as folder_checks
from nsvq_lightning.commands.doctor.finding import Finding, good
from nsvq_lightning.commands.doctor.folder import check_folder
from nsvq_lightning.commands.doctor.model_checks import check_overlap, corner_shift, shared_points
from nsvq_lightning.commands.doctor.photo_checks import read_photos
from nsvq_lightning.data.colmap import import_pycolmap, read_model
from nsvq_lightning.data.scene import load_scene

SceneFactory = Callable[..., Path]


@pytest.fixture
def scene(demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the demo scene that may be damaged; the slow estimate is tested by itself."""
    monkeypatch.setattr(folder_checks, "check_budget", lambda scene: [good("run time", "not measured")])
    return Path(shutil.copytree(demo_scene, tmp_path / "scene"))


def _by_subject(root: Path) -> dict[str, Finding]:
    return {finding.subject: finding for finding in check_folder(root)}


def test_a_sound_scene_has_no_problem(scene: Path) -> None:
    findings = _by_subject(scene)
    assert not [finding for finding in findings.values() if finding.verdict == "problem"]
    assert findings["cameras"].values["sizes"] == [(96, 72)]
    assert findings["tracks"].values["seen_by_three"] == 1  # the demo scene makes no other points
    assert findings["split"].values == {"train": 7, "test": 2}
    assert findings["split"].verdict == "note"  # few photos
    assert findings["photos"].verdict == findings["exposure"].verdict == "good"


def test_the_estimate_of_a_run_is_measured(demo_scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from nsvq_lightning.commands.doctor import budget

    scene = load_scene(demo_scene)
    grown = budget.grown(scene, 2000)
    assert len(grown) == 2000
    memory, time = budget.check_budget(scene)
    assert 1e9 < memory.values["bytes"] < 2e9
    assert min(time.values["step_seconds"], time.values["paper_step_seconds"]) > 0
    # With a second for each splat, instead of what a busy machine takes:
    monkeypatch.setattr(budget, "_seconds", lambda splats, scene, view: len(splats))
    _, time = budget.check_budget(scene)
    assert 100 < time.values["step_seconds"] < time.values["paper_step_seconds"]
    monkeypatch.setattr(budget, "available_memory", lambda: 10**9)
    assert "max_width" in next(iter(budget.check_budget(scene))).text


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("damage", "subject", "words"),
    [
        (lambda root: shutil.rmtree(root), "model", "does not exist"),
        (lambda root: shutil.rmtree(root / "sparse"), "model", "no COLMAP model"),
        (lambda root: _cut(root / "sparse/0/points3D.bin"), "model", "truncated"),
        (lambda root: shutil.rmtree(root / "images"), "scene", "copy the photos"),
        (lambda root: (root / "images/view_003.png").unlink(), "scene", "view_003.png"),
        (lambda root: (root / "images/view_003.png").write_text("no image"), "scene", "view_003.png"),
        (lambda root: _cut(root / "images/view_003.png"), "photos", "1 of 9 cannot be used"),
    ],
)
def test_damage_is_a_problem_and_no_exception(
    scene: Path, damage: Callable[[Path], None], subject: str, words: str
) -> None:
    damage(scene)
    finding = _by_subject(scene)[subject]
    assert finding.verdict == "problem"
    assert words in finding.text


def test_files_outside_the_model_and_of_another_shape_are_named(scene: Path) -> None:
    picture = cv2.imread(str(scene / "images/view_000.png"))
    assert cv2.imwrite(str(scene / "images/new.png"), picture)
    assert cv2.imwrite(str(scene / "images/view_001.png"), picture[:, :50])
    findings = _by_subject(scene)
    assert findings["registered"].values["files"] == ["new.png"]
    assert findings["sizes"].values == {"of another aspect ratio": 1}
    assert findings["sizes"].verdict == "problem"


def test_exposure_is_measured_in_stops_where_points_were_seen(scene: Path) -> None:
    def stops() -> list[float]:
        found = [photo.exposure for photo in read_photos(load_scene(scene), read_model(scene, observations=True))]
        return [value if value is not None else float("nan") for value in found]

    before, path = stops(), scene / "images/view_004.png"
    assert max(map(abs, before)) < 0.3
    assert cv2.imwrite(str(path), np.round(cv2.imread(str(path)) * 0.5).astype(np.uint8))
    after = stops()
    # half the grey level is 2.2 stops under a gamma of 2.2
    assert after[4] - before[4] == pytest.approx(-2.2, abs=0.1)
    assert after[:4] + after[5:] == before[:4] + before[5:]


def test_points_that_a_scene_leaves_out_shift_no_exposure(scene: Path) -> None:
    """A point at a camera's centre is in the model and not in the scene."""
    model = read_model(scene, observations=True)
    before = [photo.exposure for photo in read_photos(load_scene(scene), model)]
    view = model.images[3].viewmat
    model.points[0] = -view[:3, :3].T @ view[:3, 3]
    loaded = load_scene(scene)
    shorter = replace(loaded, points=loaded.points[1:], colors=loaded.colors[1:])
    after = [photo.exposure for photo in read_photos(shorter, model)]
    assert after == pytest.approx(before, abs=0.02)


def test_a_larger_model_beside_the_first_is_a_problem(scene: Path) -> None:
    shutil.copytree(scene / "sparse/0", scene / "sparse/1")
    images = scene / "sparse/0/images.bin"
    assert "model" not in _by_subject(scene)
    reconstruction = import_pycolmap().Reconstruction(str(scene / "sparse/1"))
    reconstruction.deregister_frame(next(iter(reconstruction.frames)))
    reconstruction.write_binary(str(images.parent))
    finding = _by_subject(scene)["model"]
    assert (finding.verdict, finding.text.partition(":")[0]) == ("problem", "sparse/0 has 8 images, sparse/1 has 9")


def test_shared_points_are_those_of_both_views() -> None:
    rng = np.random.default_rng(0)
    saw = rng.random((40, 5)) < 0.4
    saw[:, 4] = False  # a view without points
    sets = [set(np.flatnonzero(column)) for column in saw.T]
    counts = shared_points(np.argwhere(saw), 5)
    for i, j in itertools.product(range(5), repeat=2):
        assert counts[i, j] == len(sets[i] & sets[j])


def test_a_view_that_shares_nothing_is_named(scene: Path) -> None:
    model = read_model(scene, observations=True)
    assert model.observations is not None
    assert [finding.verdict for finding in check_overlap(model)] == ["good"]
    lonely = model.observations[model.observations[:, 1] != 2]
    model.__dict__["observations"] = lonely
    (finding,) = check_overlap(model)
    assert finding.verdict == "note"
    assert finding.values["groups"] == 2
    assert "view_002.png" in finding.text


def test_corners_move_as_the_polynomial_says() -> None:
    camera = import_pycolmap().Camera(model="SIMPLE_RADIAL", width=40, height=30, params=[50.0, 20.0, 15.0, 0.1])
    radius = np.hypot(20, 15) / 50
    assert corner_shift(camera) == pytest.approx(50 * 0.1 * radius**3)
