"""Which runs a sweep is made of."""

from __future__ import annotations

from pathlib import Path

import pytest

from nsvq_lightning.commands.sweep.plan import Request, Run, plan


@pytest.fixture
def scenes(tmp_path: Path) -> tuple[Path, Path]:
    folders = tmp_path / "fox", tmp_path / "horns"
    for folder in folders:
        folder.mkdir()
    return folders


def names(runs: list[Run]) -> list[tuple[str, str, str, str, int]]:
    return [(run.scene, run.config, run.quantizer, run.codebooks, run.seed) for run in runs]


def test_everything_is_combined_with_everything(scenes: tuple[Path, Path]) -> None:
    runs = plan(Request(scenes, codebooks=("1k", "4k"), seeds=(0, 3), max_steps=60))
    expected = [
        (scene, "default", "NSVQ", size, seed) for scene in ("fox", "horns") for seed in (0, 3) for size in ("1k", "4k")
    ]
    assert names(runs) == expected
    last = runs[-1].settings
    assert last["data"]["init_args"]["root"] == str(scenes[1])
    assert (last["model"]["seed"], last["data"]["init_args"]["seed"]) == (3, 3)
    assert (last["model"]["codebooks"], last["trainer"]["max_steps"]) == ("4k", 60)
    assert runs[-1].title == "horns-default-NSVQ-4k-seed3"


def test_without_codebooks_there_is_one_run(scenes: tuple[Path, Path]) -> None:
    runs = plan(Request(scenes[:1], ("nsvq_4k", "plain"), ("NSVQ",), ("1k", "2k", "4k")))
    assert [(run.config, run.quantizer, run.codebooks) for run in runs] == [
        *(("nsvq_4k", "NSVQ", size) for size in ("1k", "2k", "4k")),
        ("plain", "", ""),
    ]


def test_runs_with_the_same_settings_are_one(scenes: tuple[Path, Path]) -> None:
    runs = plan(Request(scenes[:1], ("nsvq_1k", "nsvq_4k"), codebooks=("1k", "4k")))
    assert [(run.config, run.codebooks) for run in runs] == [("nsvq_1k", "1k"), ("nsvq_1k", "4k")]


def test_a_configuration_may_bring_everything(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(f"model: {{codebooks: {{scales: 8}}, seed: 5}}\ndata: {{init_args: {{root: {tmp_path}}}}}\n")
    (run,) = plan(Request(configs=(str(own),), options=("--trainer.max_steps", "9")))
    assert names([run]) == [(tmp_path.name, "own", "NSVQ", "scales=8", 5)]
    assert run.steps == 9


def test_the_short_options_of_fit_hold_for_every_run(scenes: tuple[Path, Path]) -> None:
    (run,) = plan(Request(scenes[:1], options=("--splats", "3000")))
    assert run.settings["callbacks"]["budget"]["init_args"] == {"quality": None, "splats": 3000, "bytes": None}
    with pytest.raises(ValueError, match="--splats and --bytes both say"):
        plan(Request(scenes[:1], options=("--splats=3000", "--bytes=100000")))


def test_what_cannot_be_is_said_at_once(scenes: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"choose one of 0\.5k"):
        plan(Request(scenes, codebooks=("3k",)))
    with pytest.raises(ValueError, match="is no folder"):
        plan(Request((tmp_path / "missing",)))
    (tmp_path / "b" / "fox").mkdir(parents=True)
    with pytest.raises(ValueError, match="two scenes are called fox"):
        plan(Request((scenes[0], tmp_path / "b" / "fox")))
    with pytest.raises(SystemExit):
        plan(Request(scenes, options=("--model.no_such=1",)))
