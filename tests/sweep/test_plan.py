"""Which runs a sweep is made of, what makes two of them different, and what they share."""

from __future__ import annotations

import json
from copy import deepcopy
from itertools import product
from pathlib import Path

import pytest

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
    expected = product(("fox", "horns"), ("default",), ("NSVQ",), (0, 3), ("1k", "4k"))
    assert names(runs) == [(scene, *names, size, seed) for scene, *names, seed, size in expected]
    last = runs[-1].settings
    assert last["data"]["init_args"]["root"] == str(scenes[1])
    assert (last["model"]["seed"], last["data"]["init_args"]["seed"]) == (3, 3)
    assert (last["model"]["codebooks"], last["trainer"]["max_steps"]) == ("4k", 60)
    assert runs[-1].title == "horns-default-NSVQ-4k-seed3"


def test_without_codebooks_there_is_one_run(scenes: tuple[Path, Path]) -> None:
    runs = plan(scenes[:1], ("nsvq_4k", "plain"), ("NSVQ",), ("1k", "2k", "4k"))
    quantized = [("fox", "nsvq_4k", "NSVQ", size, 0) for size in ("1k", "2k", "4k")]
    assert names(runs) == [*quantized, ("fox", "plain", "", "", 0)]


def test_runs_with_the_same_settings_are_one(scenes: tuple[Path, Path]) -> None:
    runs = plan(scenes[:1], ("nsvq_1k", "nsvq_4k"), codebooks=("1k", "4k"))
    assert [run.title for run in runs] == ["fox-nsvq_1k-NSVQ-1k-seed0", "fox-nsvq_1k-NSVQ-4k-seed0"]


def test_a_configuration_may_bring_everything(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(f"model: {{codebooks: {{scales: 8}}, seed: 5}}\ndata: {{init_args: {{root: {tmp_path}}}}}\n")
    (run,) = plan(configs=(str(own),), options=("--trainer.max_steps", "9"))
    assert names([run]) == [(tmp_path.name, "own", "NSVQ", "scales=8", 5)]
    assert run.names["steps"] == 9


def test_the_short_options_of_fit_hold_for_every_run(scenes: tuple[Path, Path]) -> None:
    (run,) = plan(scenes[:1], options=("--splats", "3000"))
    assert run.settings["callbacks"]["budget"]["init_args"] == {"quality": None, "splats": 3000, "bytes": None}
    with pytest.raises(ValueError, match="--splats and --bytes both say"):
        plan(scenes[:1], options=("--splats=3000", "--bytes=100000"))


def test_what_cannot_be_is_said_at_once(scenes: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"choose one of 0\.5k"):
        plan(scenes, codebooks=("3k",))
    with pytest.raises(ValueError, match="is no folder"):
        plan([tmp_path / "missing"])
    (tmp_path / "b" / "fox").mkdir(parents=True)
    with pytest.raises(ValueError, match="two runs are called fox-default-NSVQ-"):
        plan([scenes[0], tmp_path / "b" / "fox"])
    with pytest.raises(SystemExit):
        plan(scenes, options=("--model.no_such=1",))
    with pytest.raises(ValueError, match=r"ckpt_path=a\.ckpt"):
        plan(scenes, options=("--ckpt_path=a.ckpt",))


@pytest.fixture(scope="module")
def standard() -> Settings:
    """The defaults of ``nsvq fit``; read-only."""
    return resolve(SCENE)


def changed(settings: Settings, case: str) -> Settings:
    """A copy with ``path=JSON``; the path must be there: a misspelt one would change nothing."""
    path, _, value = case.partition("=")
    *parents, name = path.split(".")
    place = copy = deepcopy(settings)
    for parent in parents:
        place = place[parent]
    assert place[name] != json.loads(value)
    place[name] = json.loads(value)
    return copy


def trunk_of(settings: Settings) -> Settings | None:
    trunk = Run({}, settings).trunk
    return None if trunk is None else trunk.settings


def test_settings_as_a_file_are_the_same_settings(tmp_path: Path) -> None:
    # 1e-07 is a string to plain YAML.
    settings = resolve([*SCENE, "--config=nsvq_4k", "--model.rates.codebook_factor=1e-07", "--model.quantizer=NSVQ"])
    assert settings["model"]["rates"]["codebook_factor"] == 1e-7
    path = tmp_path / "config.yaml"
    path.write_text(json.dumps(settings))
    assert resolve(["--config", str(path)]) == settings


def test_where_the_output_goes_is_no_difference(standard: Settings) -> None:
    assert resolve([*SCENE, "--trainer.default_root_dir=here", "--callbacks.progress.refresh_rate=1"]) == standard


def test_a_digest_tells_settings_and_versions_apart(standard: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Run({}, standard).digest
    assert Run({}, json.loads(json.dumps(standard))).digest == first
    assert Run({}, changed(standard, "model.seed=1")).digest != first
    monkeypatch.setattr(module, "__version__", "0.0.1")
    assert Run({}, standard).digest != first


AFTER = """
model.codebooks="1k" model.codebooks=null model.quantizer.init_args.kmeans_steps=3 model.quantizer.class_path="my.Mine"
callbacks.phases.init_args.quantize_end=40000 callbacks.phases.init_args.quantize_end=45000
callbacks.phases.init_args.min_finetune=2 callbacks.canonical.init_args.mode="full" callbacks.codebook_init=null
callbacks.codebook_refit.init_args.steps=1 callbacks.codebook_replacement.init_args.late_every=700
callbacks.codebook_finite=null callbacks.freeze=null callbacks.export=null callbacks.checkpoint.init_args.every=7
"""
ELSE = """
data.init_args.root="other" data.init_args.seed=1 data.init_args.factor=2 model.seed=1 model.sh_degree=2
model.rates.codebook_factor=0.5 model.init_from="scene.ply" skips.blocks=false trainer.max_steps=61
trainer.accumulate_grad_batches=2 trainer.precision="64-true" callbacks.phases.init_args.prune_end=19000
callbacks.density.init_args.max_splats=1000 callbacks.opacity=null callbacks.report.init_args.every=5
"""
# Nothing is quantized, the run ends before the prune phase does, the photos are not looked at, ...
UNCUT = """
callbacks.phases.init_args.prune_end=43000 callbacks.phases.init_args.total=60000
callbacks.phases.init_args.iterations_per_photo=100 callbacks.phases=null callbacks.freeze.class_path="my.Freeze"
trainer.callbacks=[{"class_path":"my.Callback"}] trainer.min_steps=50 trainer.max_epochs=3
"""


@pytest.mark.parametrize("case", AFTER.split())
def test_a_trunk_does_not_depend_on_what_starts_after_it(standard: Settings, case: str) -> None:
    assert trunk_of(changed(standard, case)) == trunk_of(standard) is not None


@pytest.mark.parametrize("case", ELSE.split())
def test_a_trunk_depends_on_everything_else(standard: Settings, case: str) -> None:
    assert trunk_of(changed(standard, case)) != trunk_of(standard)


@pytest.mark.parametrize("case", UNCUT.split())
def test_a_run_that_may_not_be_cut_has_no_trunk(standard: Settings, case: str) -> None:
    reference = changed(standard, "callbacks.phases.init_args.reference_total=43000")
    assert trunk_of(reference) is not None
    assert trunk_of(changed(reference, case)) is None


def test_a_trunk_keeps_the_schedule_of_the_whole_run(standard: Settings) -> None:
    trunk = trunk_of(standard)
    assert trunk is not None
    assert trunk["trainer"]["max_steps"] == 27  # 20 000 of 45 000
    assert trunk["callbacks"]["phases"]["init_args"]["total"] == 60
    assert trunk_of(resolve([*SCENE, "--config=plain"])) is None  # nothing but a trunk
