"""Settings as data: what makes two runs different, and what they share."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nsvq_lightning.sweep import settings as module
from nsvq_lightning.sweep.settings import Settings, digest, resolve, trunk_of

SCENE = ["--data.root=scene", "--trainer.max_steps=60"]


@pytest.fixture(scope="module")
def common() -> Settings:
    """Trunk of the run that the others are compared with."""
    trunk = trunk_of(resolve(SCENE))
    assert trunk is not None
    return trunk


def test_settings_as_a_file_are_the_same_settings(tmp_path: Path) -> None:
    # 1e-07 is a string to plain YAML.
    settings = resolve([*SCENE, "--config=nsvq_4k", "--model.rates.codebook_factor=1e-07", "--model.quantizer=NSVQ"])
    path = tmp_path / "config.yaml"
    path.write_text(json.dumps(settings))
    assert resolve(["--config", str(path)]) == settings


def test_where_the_output_goes_is_no_difference() -> None:
    assert resolve([*SCENE, "--trainer.default_root_dir=here"]) == resolve([*SCENE, "--callbacks.progress=null"])


def test_a_digest_tells_settings_and_versions_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    first, again, other = resolve(SCENE), resolve(SCENE), resolve([*SCENE, "--model.seed=1"])
    assert digest(first) == digest(again) != digest(other)
    old = digest(first)
    monkeypatch.setattr(module, "__version__", "0.0.1")
    assert digest(first) != old


@pytest.mark.parametrize(
    "option",
    [
        "--model.codebooks=1k",
        "--model.codebooks=null",
        "--model.quantizer.init_args.kmeans_steps=3",
        "--callbacks.codebook_init=null",
        "--callbacks.codebook_replacement.late_every=700",
        "--callbacks.freeze=null",
        "--callbacks.export=null",
        "--callbacks.checkpoint.every=7",
    ],
)
def test_a_trunk_does_not_depend_on_what_starts_after_it(option: str, common: Settings) -> None:
    assert trunk_of(resolve([*SCENE, option])) == common


@pytest.mark.parametrize(
    "option",
    [
        "--data.root=other",
        "--data.seed=1",
        "--data.factor=2",
        "--model.seed=1",
        "--model.sh_degree=2",
        "--model.rates.codebook_factor=0.5",
        "--model.init_from=scene.ply",
        "--skips.adam_rows=true",
        "--trainer.max_steps=61",
        "--trainer.accumulate_grad_batches=2",
        "--callbacks.phases.quantize_end=40000",
        "--callbacks.density.max_splats=1000",
        "--callbacks.opacity=null",
        "--callbacks.report.every=5",
    ],
)
def test_a_trunk_depends_on_everything_else(option: str, common: Settings) -> None:
    assert trunk_of(resolve([*SCENE, option])) != common


@pytest.mark.parametrize(
    "options",
    [
        ["--config=plain"],  # ends with the prune phase
        ["--callbacks.phases.warmup_end=0", "--callbacks.phases.prune_end=0"],
        ["--callbacks.phases=null"],
        ["--callbacks.freeze=lightning.pytorch.callbacks.ModelSummary"],
        ["--trainer.callbacks=lightning.pytorch.callbacks.ModelSummary"],
        ["--trainer.min_steps=50"],
        ["--trainer.max_steps=20", "--callbacks.phases.total=60"],  # stops before pruning does
    ],
)
def test_a_run_that_may_not_be_cut_has_no_trunk(options: list[str]) -> None:
    assert trunk_of(resolve([*SCENE, *options])) is None


def test_a_trunk_keeps_the_schedule_of_the_whole_run(common: Settings) -> None:
    assert common["trainer"]["max_steps"] == 27  # 20 000 of 45 000
    assert common["callbacks"]["phases"]["init_args"]["total"] == 60


def test_a_checkpoint_of_the_users_is_refused() -> None:
    with pytest.raises(ValueError, match=r"ckpt_path=a\.ckpt"):
        resolve([*SCENE, "--ckpt_path=a.ckpt"])
