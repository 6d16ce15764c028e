"""Which runs a sweep is made of, and what makes two of them different."""

from __future__ import annotations

import json
import shutil
from itertools import product
from pathlib import Path

import pytest

from nsvq_lightning.commands.arguments import find_config
from nsvq_lightning.commands.sweep import plan as module
from nsvq_lightning.commands.sweep.plan import Run, Settings, plan, resolve

SCENE = ["--data.root=scene", "--trainer.max_steps=60"]


@pytest.fixture
def scenes(tmp_path: Path) -> tuple[Path, Path]:
    for name in ("fox", "horns"):
        (tmp_path / name).mkdir()
    return tmp_path / "fox", tmp_path / "horns"


def names(runs: list[Run]) -> list[tuple[str | int, ...]]:
    return [tuple(list(run.names.values())[:5]) for run in runs]


def test_everything_is_combined_with_everything(scenes: tuple[Path, Path]) -> None:
    runs = plan(scenes, codebooks=("1k", "4k"), seeds=(0, 3), options=("--trainer.max_steps=60",))
    expected = product(("fox", "horns"), ("default",), ("TrainedStraightThrough",), (0, 3), ("1k", "4k"))
    assert names(runs) == [(scene, *names, size, seed) for scene, *names, seed, size in expected]
    last = runs[-1].settings
    assert last["data"]["init_args"]["root"] == str(scenes[1])
    assert (last["model"]["seed"], last["data"]["init_args"]["seed"]) == (3, 3)
    assert (last["model"]["codebooks"], last["trainer"]["max_steps"]) == ("4k", 60)
    assert runs[-1].title == "horns-default-TrainedStraightThrough-4k-seed3"


def test_without_codebooks_there_is_one_run(scenes: tuple[Path, Path]) -> None:
    runs = plan(scenes[:1], ("paper", "plain"), ("NSVQ",), ("1k", "2k", "4k"))
    quantized = [("fox", "paper", "NSVQ", size, 0) for size in ("1k", "2k", "4k")]
    assert names(runs) == [*quantized, ("fox", "plain", "", "", 0)]


def test_runs_with_the_same_settings_are_one(scenes: tuple[Path, Path], tmp_path: Path) -> None:
    other = shutil.copy(find_config("paper"), tmp_path / "other.yaml")
    runs = plan(scenes[:1], ("paper", str(other)), codebooks=("1k", "4k"))
    assert [run.title for run in runs] == ["fox-paper-NSVQ-1k-seed0", "fox-paper-NSVQ-4k-seed0"]


def test_a_configuration_may_bring_everything(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(f"model: {{codebooks: {{scales: 8}}, seed: 5}}\ndata: {{init_args: {{root: {tmp_path}}}}}\n")
    (run,) = plan(configs=(str(own),), options=("--trainer.max_steps", "9"))
    assert names([run]) == [(tmp_path.name, "own", "TrainedStraightThrough", "scales=8", 5)]
    assert run.names["steps"] == 9


def test_the_short_options_of_fit_hold_for_every_run(scenes: tuple[Path, Path]) -> None:
    (run,) = plan(scenes[:1], options=("--splats", "3000"))
    budget = run.settings["callbacks"]["budget"]["init_args"]
    assert budget == {"quality": 0.9, "splats": 3000, "bytes": None, "start": 0.8}
    with pytest.raises(ValueError, match="--splats and --bytes both say"):
        plan(scenes[:1], options=("--splats=3000", "--bytes=100000"))


def test_what_cannot_be_is_said_at_once(scenes: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="choose one of 16k"):
        plan(scenes, codebooks=("3k",))
    with pytest.raises(ValueError, match="is no folder"):
        plan([tmp_path / "missing"])
    (tmp_path / "b" / "fox").mkdir(parents=True)
    with pytest.raises(ValueError, match="two runs are called fox-default-TrainedStraightThrough-"):
        plan([scenes[0], tmp_path / "b" / "fox"])
    with pytest.raises(SystemExit):
        plan(scenes, options=("--model.no_such=1",))
    with pytest.raises(ValueError, match=r"ckpt_path=a\.ckpt"):
        plan(scenes, options=("--ckpt_path=a.ckpt",))


@pytest.fixture(scope="module")
def standard() -> Settings:
    """The defaults of ``nsvq fit``; read-only."""
    return resolve(SCENE)


def test_settings_as_a_file_are_the_same_settings(tmp_path: Path) -> None:
    # 1e-07 is a string to plain YAML.
    settings = resolve([*SCENE, "--config=paper", "--model.rates.codebook_factor=1e-07", "--model.quantizer=NSVQ"])
    assert settings["model"]["rates"]["codebook_factor"] == 1e-7
    path = tmp_path / "config.yaml"
    path.write_text(json.dumps(settings))
    assert resolve(["--config", str(path)]) == settings


def test_where_the_output_goes_is_no_difference(standard: Settings) -> None:
    assert resolve([*SCENE, "--trainer.default_root_dir=here", "--callbacks.progress.refresh_rate=1"]) == standard


def test_a_digest_tells_settings_and_versions_apart(standard: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Run({}, standard).digest
    assert Run({}, json.loads(json.dumps(standard))).digest == first
    assert Run({}, standard | {"model": standard["model"] | {"seed": 1}}).digest != first
    monkeypatch.setattr(module, "__version__", "0.0.1")
    assert Run({}, standard).digest != first
