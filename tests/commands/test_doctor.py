from __future__ import annotations

import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from transforms_scenes import write_blender

from nsvq_lightning.callbacks import forecast
from nsvq_lightning.commands import doctor
from nsvq_lightning.commands.doctor import Finding, attempt, check_folder
from nsvq_lightning.commands.main import main
from nsvq_lightning.compute import environment, jit
from nsvq_lightning.data.colmap import import_pycolmap, read_model
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.rendering.rasterize import Render, render
from nsvq_lightning.training import self_check

GOOD = Finding("good", "run time", "not measured")


@pytest.fixture
def scene(demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the demo scene that may be damaged; the slow estimate is tested by itself."""
    monkeypatch.setattr(doctor, "check_budget", lambda scene: iter([GOOD]))
    return Path(shutil.copytree(demo_scene, tmp_path / "scene"))


def _by_subject(root: Path) -> dict[str, Finding]:
    return {finding.subject: finding for finding in check_folder(root)}


def test_every_finding_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    *lines, empty, last = capsys.readouterr().out.splitlines()
    findings = {found[2]: found for found in map(re.compile(r"(good|note) +(\S+) +(.*)").fullmatch, lines) if found}
    assert (len(findings), empty) == (len(lines), "")
    assert last.startswith("no problems, ")
    assert findings.keys() == {"machine", "versions", "opencv", "threads", "memory", "disk", "self-test"}
    text = findings["self-test"][3]
    assert text.startswith("cpu: relative errors against float64: image ")
    errors = [float(part.split()[-1]) for part in text.partition("image")[2].split(",")]
    assert (findings["self-test"][1], len(errors)) == ("good", 11)
    assert 0 < max(errors) < 1e-4


def test_a_bad_folder_gives_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith(f"problem  model        no COLMAP model in {tmp_path}")]
    assert lines[-1].startswith("1 problem,")


def test_without_opencv_the_other_checks_are_still_made() -> None:
    code = "import sys; sys.modules['cv2'] = None\nfrom nsvq_lightning.commands.main import main\n"
    code += "sys.exit(main(['doctor']))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (run.returncode, "problem  opencv" in run.stdout, "threads" in run.stdout) == (1, True, True)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ZeroDivisionError("of\nsomething"), "the check itself failed: ZeroDivisionError: of something"),
        (ValueError("a.jpg is cut: copy it again"), "a.jpg is cut: copy it again"),
    ],
)
def test_a_check_that_breaks_is_a_problem_and_keeps_what_it_said_before(error: Exception, said: str) -> None:
    def check() -> Iterator[Finding]:
        yield Finding("good", "disk", "enough")
        raise error

    first, second = attempt("disk", check())
    assert str(first) == "good     disk         enough"
    assert (second.verdict, second.text) == ("problem", said)


def test_threads_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    for used, verdict in ((2, "note"), (4, "good"), (8, "note")):
        monkeypatch.setattr(environment, "usable_cores", lambda: 4)
        monkeypatch.setattr(jit, "thread_count", lambda used=used: used)
        assert next(doctor.check_threads()).verdict == verdict
    monkeypatch.setattr(jit, "thread_count", lambda: 2)
    monkeypatch.setattr(platform, "system", lambda: "Darwin")
    monkeypatch.setattr(platform, "machine", lambda: "arm64")
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert next(doctor.check_threads()).verdict == "good"  # a Mac's slow cores are not missed
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert next(doctor.check_threads()).verdict == "note"


def test_one_opencv_of_any_name_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    packages = ["opencv-python"]
    monkeypatch.setattr(doctor, "packages_distributions", lambda: {"cv2": packages})
    finding = next(doctor.check_packages())
    assert (finding.verdict, "(opencv-python)" in finding.text) == ("good", True)
    packages.append("opencv-contrib-python-headless")
    finding = next(doctor.check_packages())
    assert (finding.verdict, "uninstall" in finding.text) == ("note", True)
    # None of them, and the folder that is left where one of two was uninstalled.
    for gone in (None, ModuleType("cv2")):
        monkeypatch.setitem(sys.modules, "cv2", gone)
        finding = next(doctor.check_packages())
        assert (finding.verdict, "pip install opencv" in finding.text) == ("problem", True)
        assert "--force-reinstall" in finding.text  # to pip, it is there


def test_little_memory_and_disk_are_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "available_memory", lambda: 10**9)
    monkeypatch.setattr(doctor, "MIN_DISK", 1 << 70)
    assert [finding.verdict for finding in doctor.check_room(tmp_path)] == ["note", "note"]
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    assert [finding.verdict for finding in doctor.check_room(tmp_path)] == ["note", "problem"]


@pytest.mark.parametrize(("limit", "left"), [("8000000000", 7_000_000_000), ("max", 20_000_000_000)])
def test_page_cache_of_a_control_group_is_free(monkeypatch: pytest.MonkeyPatch, limit: str, left: int) -> None:
    told = {
        "/proc/meminfo": f"MemTotal: 30000000 kB\nMemAvailable:   {20_000_000_000 // 1024} kB\n",
        "/sys/fs/cgroup/memory.max": f"{limit}\n",
        "/sys/fs/cgroup/memory.current": "7900000000\n",
        "/sys/fs/cgroup/memory.stat": "anon 1000000000\ninactive_file 6900000000\n",
    }
    monkeypatch.setattr(doctor.Path, "read_text", lambda path, encoding: told[str(path)])
    monkeypatch.setattr(doctor.Path, "read_bytes", lambda path: told[str(path)].encode())
    assert doctor.available_memory() == pytest.approx(left, abs=1024)


@pytest.mark.parametrize("factor", [1.01, float("nan")])
def test_wrong_kernels_fail(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    def wrong(splats, camera, *, backend):  # type: ignore[no-untyped-def]
        result = render(splats, camera, backend=backend)
        return Render(result.image * factor, *result[1:]) if backend == "cpu" else result

    monkeypatch.setattr(self_check, "render", wrong)
    finding = next(doctor.check_backends())
    assert finding.verdict == "problem"
    assert "image" in finding.text
    assert "opacities" in finding.text


def test_a_sound_scene_has_no_problem(scene: Path) -> None:
    findings = _by_subject(scene)
    assert not [finding for finding in findings.values() if finding.verdict == "problem"]
    assert "96x72, for 9 registered photos" in findings["cameras"].text
    assert str(findings["split"]).startswith("note     split        7 train and 2 test photos")
    assert findings["photos"].verdict == "good"
    assert findings["run time"] is GOOD


def test_the_estimate_of_a_run_is_measured(demo_scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(demo_scene)
    assert len(forecast.grown(scene, 2000)) == 2000
    (time,) = doctor.check_budget(scene)
    assert re.match(r"about \d+ min for fast.yaml", time.text)
    # With a millisecond for each splat, instead of what a busy machine takes:
    monkeypatch.setattr(forecast, "step_seconds", lambda scene, count, device: count / 1000)
    (time,) = doctor.check_budget(scene)
    found = re.search(r"about (\d+) min", time.text)
    assert found is not None
    assert int(found[1]) > 60


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
        (lambda root: (root / "images/view_003.png").write_text("no image"), "photos", "view_003.png"),
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
    assert findings["registered"].text.startswith("1 of 10 files")
    assert (findings["sizes"].verdict, "1 of 9 files" in findings["sizes"].text) == ("problem", True)


def test_maps_of_a_synthetic_scene_are_no_photos(
    scene: Path, demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_blender(demo_scene, tmp_path / "lego")
    shutil.copy(scene / "images/view_000.png", root / "test" / "r_0_depth.png")
    monkeypatch.chdir(tmp_path)
    assert "registered" not in _by_subject(Path("lego"))


def test_masks_that_exclude_most_are_noted(scene: Path) -> None:
    (scene / "masks").mkdir()
    for index, white in enumerate((4, 2)):
        mask = np.zeros((72, 96), np.uint8)
        mask[:, :white] = 255
        assert cv2.imwrite(str(scene / f"masks/view_00{index}.png"), mask)
    finding = _by_subject(scene)["masks"]
    assert finding.verdict == "note"
    assert finding.text.startswith("2 of 9 photos have pixels that do not count, 97 % of them: most in view_001.png")


def test_pixels_that_stand_still_are_noted(scene: Path) -> None:
    """As bars of films and the background of a turntable."""
    for path in (scene / "images").iterdir():
        photo = cv2.imread(str(path))
        photo[:12] = 0
        assert cv2.imwrite(str(path), photo)
    finding = _by_subject(scene)["still"]
    assert finding.verdict == "note"
    assert finding.text.startswith("17 % of the pixels are the same in most photos")


def test_a_larger_model_beside_the_first_is_a_problem(scene: Path) -> None:
    shutil.copytree(scene / "sparse/0", scene / "sparse/1")
    images = scene / "sparse/0/images.bin"
    assert "model" not in _by_subject(scene)
    reconstruction = import_pycolmap().Reconstruction(str(scene / "sparse/1"))
    reconstruction.deregister_frame(next(iter(reconstruction.frames)))
    reconstruction.write_binary(str(images.parent))
    finding = _by_subject(scene)["model"]
    assert (finding.verdict, finding.text.partition(":")[0]) == ("problem", "sparse/0 has 8 images, sparse/1 has 9")


def test_points_without_colours_are_told(scene: Path) -> None:
    assert "without colours" not in _by_subject(scene)["points"].text
    reconstruction = import_pycolmap().Reconstruction(str(scene / "sparse/0"))
    for point in reconstruction.points3D.values():
        point.color = np.zeros(3, np.uint8)
    reconstruction.write_binary(str(scene / "sparse/0"))
    assert "without colours, 0 % far outliers" in _by_subject(scene)["points"].text


def test_points_in_other_coordinates_are_a_problem(scene: Path) -> None:
    points, colors = (values.numpy() for values in (load_scene(scene).points, load_scene(scene).colors))
    (scene / "sparse/0/points3D.bin").unlink()
    for turn, verdict in ([1, 1, 1], "note"), ([1, -1, -1], "problem"):
        rows = (f"{x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(points * turn, colors, strict=True))
        names = [f"property float {name}" for name in ("x", "y", "z", "red", "green", "blue")]
        head = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *names, "end_header"]
        (scene / "points3D.ply").write_text("\n".join([*head, *rows, ""]))
        finding = _by_subject(scene)["points"]
        assert finding.verdict == verdict
        assert ("they are not where the photos show their colours" in finding.text) == (verdict == "problem")
    # A photo that cannot be read hides nothing else.
    (scene / "images/view_001.png").write_bytes(b"")
    found = _by_subject(scene)
    assert "1 of 9 cannot be used" in found["photos"].text
    assert "scene" not in found
    assert "run time" in found


def test_poses_that_contradict_what_was_seen_are_a_problem(scene: Path) -> None:
    """Camera to world instead of world to camera, the commonest mistake in models that people write themselves."""
    pycolmap = import_pycolmap()
    reconstruction = pycolmap.Reconstruction(str(scene / "sparse/0"))
    for image in reconstruction.images.values():
        image.frame.set_cam_from_world(image.camera_id, image.cam_from_world().inverse())
    assert "poses" not in _by_subject(scene)
    reconstruction.write_binary(str(scene / "sparse/0"))
    finding = _by_subject(scene)["poses"]
    assert finding.verdict == "problem"
    assert "not in the pictures that they were found in: are poses camera to world" in finding.text


def test_views_that_share_too_little_are_named(scene: Path) -> None:
    model = read_model(scene, observations=True)
    assert model.observations is not None
    assert [finding.verdict for finding in doctor.check_overlap(model)] == ["good"]
    lonely = replace(model, observations=model.observations[model.observations[:, 1] != 2])
    (finding,) = doctor.check_overlap(lonely)
    assert (finding.verdict, "with the rest for view_002.png" in finding.text) == ("note", True)
    saw = np.random.default_rng(0).random((len(model.points), len(model.images))) < 0.4
    saw[:, 4] = False  # a view without points
    (finding,) = doctor.check_overlap(replace(model, observations=np.argwhere(saw)))
    sets = [set(np.flatnonzero(column)) for column in saw.T]
    best = [max(len(a & b) / max(len(a), 1) for b in sets if b is not a) for a in sets]
    assert f"shares {100 * np.median(best):.0f} % of its points with its best partner, at least 0 %" in finding.text
