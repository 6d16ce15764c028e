"""Compressing a scene that is trained already: tuning, presets, and ``nsvq compress``."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ring import cameras_around
from splat_scenes import ball

from nsvq_lightning.commands.main import main
from nsvq_lightning.compression.presets import (
    PLAINS,
    PRESETS,
    Compressor,
    finest_within,
    finetune_codebooks,
    smallest_within,
)
from nsvq_lightning.compression.viewpoints import picture_error, pictures
from nsvq_lightning.io import CompressedScene, read_header, read_nsvq, write_ply
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.io.nsvq.precision import Precision, Storage
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import detached

ORIGINAL = detached(ball(600).decode())
VIEWS = cameras_around(ball(600).means, 12, 80, 60)


@pytest.fixture(scope="module")
def quantized() -> CompressedScene:
    """The scene with 32 codes each, its splats in the order of the original."""
    sizes = {"quats": 32, "scales": 32, "sh0": 32, "shN": 32}
    return Compressor(ball(600), VIEWS[:4], Storage())._quantized(sizes)


def error(scene: CompressedScene) -> float:
    """In views that tuning does not use."""
    others = cameras_around(ball(600).means, 7, 96, 64)
    return picture_error(scene.decode(), others, pictures(ORIGINAL, others))


def test_pictures_come_nearer_in_other_views_too(quantized: CompressedScene) -> None:
    found = finetune_codebooks(quantized, ORIGINAL, VIEWS, 60, 0)
    assert error(found) < 0.92 * error(quantized)
    for name, codes in quantized.codes.items():
        np.testing.assert_array_equal(found.codes[name], codes)
    assert found.codebooks["sh0"].shape == quantized.codebooks["sh0"].shape


def test_no_steps_change_nothing_and_the_same_steps_give_the_same_bits(quantized: CompressedScene) -> None:
    assert finetune_codebooks(quantized, ORIGINAL, VIEWS, 0, 0) is quantized
    first, second, other = (finetune_codebooks(quantized, ORIGINAL, VIEWS, 3, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.codebooks["quats"], second.codebooks["quats"])
    np.testing.assert_array_equal(first.means, second.means)
    assert not np.array_equal(first.means, other.means)


def test_the_compressor_tunes_what_has_codebooks() -> None:
    preset = PRESETS[-1]
    plain, steps = (Compressor(ball(600), VIEWS, Storage(), tuning=count).at(preset) for count in (0, 40))
    assert steps.error < 0.95 * plain.error


@pytest.fixture(scope="module")
def compressor() -> Compressor:
    scene = ball()
    return Compressor(scene, cameras_around(scene.means, 2, 96, 64), Storage())


def test_a_candidate_is_what_its_bytes_hold(compressor: Compressor, tmp_path: Path) -> None:
    """Oracle: the file, read and rendered here."""
    candidate = compressor.at(PRESETS[-3])
    (tmp_path / "x.nsvq").write_bytes(candidate.data)
    decoded, original = load(tmp_path / "x.nsvq"), ball().decode()
    squares = []
    for camera in cameras_around(ball().means, 2, 96, 64):
        with torch.no_grad():
            pair = [render(splats, camera).image.clamp(0, 1).double() for splats in (decoded, original)]
        squares.append(float((pair[0] - pair[1]).square().mean()))
    assert candidate.error == pytest.approx(math.sqrt(np.mean(squares)), rel=1e-6)
    assert compressor.at(PRESETS[-3]) is candidate


def test_the_presets_go_from_exact_to_small() -> None:
    scene = ball(4000)
    compressor = Compressor(scene, cameras_around(scene.means, 2, 96, 64), Storage())
    found = [compressor.at(preset) for preset in PRESETS]
    sizes, errors = [len(c.data) for c in found], [c.error for c in found]
    assert sizes == sorted(sizes, reverse=True)
    assert errors == sorted(errors)


def test_the_smallest_file_within_an_error_and_the_best_within_bytes(compressor: Compressor) -> None:
    """Oracle: all settings. Those without codebooks are smaller here than the first presets, and worse."""
    every = [compressor.at(preset) for preset in (*PLAINS, *PRESETS)]
    for aim in every:
        found = smallest_within(compressor, aim.error)
        assert len(found.data) == min(len(c.data) for c in every if c.error <= aim.error)
        found = finest_within(compressor, len(aim.data))
        assert found.error == min(c.error for c in every if len(c.data) <= len(aim.data))
    assert finest_within(compressor, 10**9).error == min(c.error for c in every)
    assert smallest_within(compressor, 10.0).preset is PRESETS[-1]


@pytest.mark.parametrize("scale", [1.0, 0.01, 100.0])
def test_an_error_does_not_depend_on_the_unit_of_the_scene(scale: float) -> None:
    scene, errors = ball(300), []
    for factor in (1.0, scale):
        means, scales = scene.means * np.float32(factor), scene.raw["scales"] + np.float32(math.log(factor))
        scaled = replace(scene, means=means, raw={**scene.raw, "scales": scales})
        errors.append(Compressor(scaled, cameras_around(means, 2, 96, 64), Storage()).at(PRESETS[-1]).error)
    assert errors[0] > 0.01
    assert errors[1] == pytest.approx(errors[0], rel=0.2)


def test_what_cannot_be_reached_says_what_can(compressor: Compressor) -> None:
    with pytest.raises(ValueError, match=r"the smallest file of this scene has \d+ bytes, more than 50"):
        finest_within(compressor, 50)
    with pytest.raises(ValueError, match="no setting has an error of at most 1e-09: the most exact one has"):
        smallest_within(compressor, 1e-9)


def test_scenes_that_cannot_be_seen_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot compress 5 splats seen by 0 cameras"):
        Compressor(ball(5), [], Storage())
    scene = ball(5)
    elsewhere = cameras_around(scene.means + np.float32(1e4), 2, 96, 64)
    with pytest.raises(ValueError, match="all 2 pictures of the scene are black"):
        Compressor(scene, elsewhere, Storage())


def test_the_command_compresses_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nsvq_lightning.commands.compress.VIEWS", 4)
    source, output = tmp_path / "scene.ply", tmp_path / "new" / "scene.nsvq"
    scene = ball(700)
    scene.raw["sh0"][3] = np.nan
    write_ply(source, scene)
    assert main(["compress", str(source), str(output), "--codebooks", "0.5k", "--tune=2"]) == 0
    assert f"699 splats in {output.stat().st_size:,} bytes" in capsys.readouterr().out
    stored = read_nsvq(output)
    assert isinstance(stored, CompressedScene)
    assert {name: len(book) for name, book in stored.codebooks.items()}.keys() == {"quats", "scales", "sh0", "shN"}
    first = output.read_bytes()
    assert main(["compress", str(source), str(output), "--codebooks", "0.5k", "--tune=2"]) == 0
    assert output.read_bytes() == first
    assert main(["compress", str(output), str(tmp_path / "again.nsvq"), "--codebooks=none", "--level=paper"]) == 0
    assert read_header(tmp_path / "again.nsvq").level == "paper"


@pytest.mark.parametrize(("name", "message"), [("missing.ply", "missing.ply"), ("empty.ply", "no finite splat")])
def test_bad_files_are_one_line_and_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, message: str
) -> None:
    write_ply(tmp_path / "empty.ply", ball(0))
    assert main(["compress", str(tmp_path / name), str(tmp_path / "x.nsvq")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("nsvq compress: ")
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.ply", "b.ply"], "is a .nsvq file"),
        (["a.ply", "b.nsvq", "--max-steps", "5"], "--data.root"),
        (["a.ply", "b.nsvq", "--max-error", "0"], "must be above 0"),
        (["a.ply", "b.nsvq", "--tune=-1"], "--tune: must be at least 0, got -1"),
        (["a.ply", "b.nsvq", "--data.root=x", "--max-steps=-1"], "--max-steps: must be at least 0, got -1"),
        (["a.ply", "b.nsvq", "--data.root=x", "--max-steps=5", "--codebooks=none"], "there are none"),
        (["a.ply", "b.nsvq", "--max-error", "1", "--target-bytes", "5"], "not allowed with"),
    ],
)
def test_wrong_options_end_with_status_2(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["compress", *arguments])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("steps", [0, 4])
def test_photos_train_the_codebooks_and_the_origin_stays(
    steps: int, tmp_path: Path, demo_scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, output, origin = tmp_path / "scene.nsvq", tmp_path / "out.nsvq", (500_000.0, 4.5e6, 30.0)
    save(replace(ball(400, degree=0), origin=origin), source)
    options = ["--codebooks=0.5k", f"--data.root={demo_scene}", "--tune=2", f"--max-steps={steps}"]
    assert main(["compress", str(source), str(output), *options]) == 0
    stored = read_nsvq(output)
    assert (len(stored), stored.sh_degree, stored.origin) == (400, 0, origin)
    assert stored.config.get("phase_ends", [])[:2] == [0, 0][:steps]
    assert ("PSNR" in capsys.readouterr().out) == (steps > 0)


@pytest.mark.parametrize("aim", ["--target-bytes", pytest.param("--max-error", marks=pytest.mark.slow)])
def test_photos_keep_to_the_aim(
    aim: str,
    tmp_path: Path,
    demo_scene: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # One preset: a looser aim must not bring larger codebooks.
    monkeypatch.setattr("nsvq_lightning.compression.presets.PLAINS", ())
    monkeypatch.setattr(
        "nsvq_lightning.compression.presets.PRESETS", tuple(preset for preset in PRESETS if preset.name == "0.5k")
    )
    source, output = tmp_path / "scene.ply", tmp_path / "out.nsvq"
    write_ply(source, ball(400, degree=0))

    def compress(*options: str) -> tuple[str, float]:
        """How the summary says that the file was made, and what the aim is about: its bytes or its error."""
        caplog.clear()
        assert main(["compress", str(source), str(output), f"--data.root={demo_scene}", "--tune=2", *options]) == 0
        size, made = capsys.readouterr().out.splitlines()[-2:]
        assert f"splats in {output.stat().st_size:,} bytes" in size
        settings, _, error = made.strip().partition(", error ")
        return settings, output.stat().st_size if aim == "--target-bytes" else float(error.split()[0])

    # An aim that the scene just meets, its trained file not: a run stores its settings, and these photos of another
    # scene lead away from this one.
    _, found = compress("--codebooks", "0.5k", "--max-steps=0")
    aimed = found if aim == "--target-bytes" else found * 1.001
    settings, reached = compress(aim, str(aimed), "--max-steps=4")
    assert settings.endswith(", without training")
    assert reached <= aimed
    (message,) = [message for message in caplog.messages if message.startswith("the trained file")]
    assert f"more than {aim}={aimed:g}: {output} is the untrained one" in message
    (trained,) = tmp_path.glob("out_training/version_0/scene.nsvq")
    assert str(trained) in message

    enough = trained.stat().st_size + 1000 if aim == "--target-bytes" else 10
    settings, reached = compress(aim, str(enough), "--max-steps=4")
    assert settings.endswith(", trained with photos")
    assert reached <= enough
    assert output.read_bytes() == next(tmp_path.glob("out_training/version_1/scene.nsvq")).read_bytes()
    assert "the trained file" not in caplog.text


def test_precision_of_a_preset_follows_that_of_the_user() -> None:
    scene = ball(200)
    storage = Storage(precision=Precision(position=0.2, opacity=0.1))
    found = Compressor(scene, cameras_around(scene.means, 1, 40, 30), storage).at(PRESETS[-1])
    assert found.storage.precision.position == pytest.approx(0.8)
    assert found.storage.precision.opacity == 0.25
