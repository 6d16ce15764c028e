"""Settings as data: what makes two runs different, and what they share."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from nsvq_lightning.commands.sweep import settings as module
from nsvq_lightning.commands.sweep.settings import Settings, digest, resolve, trunk_of

SCENE = ["--data.root=scene", "--trainer.max_steps=60"]


@pytest.fixture(scope="module")
def standard() -> Settings:
    """The defaults of ``nsvq fit``; read-only."""
    return resolve(SCENE)


def changed(settings: Settings, path: str, value: Any) -> Settings:
    """A copy with another value at ``path``, which must be there: a misspelt one would change nothing."""
    copy = deepcopy(settings)
    *parents, name = path.split(".")
    place = copy
    for parent in parents:
        place = place[parent]
    assert place[name] != value
    place[name] = value
    return copy


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
    first = digest(standard)
    assert digest(json.loads(json.dumps(standard))) == first
    assert digest(changed(standard, "model.seed", 1)) != first
    monkeypatch.setattr(module, "__version__", "0.0.1")
    assert digest(standard) != first


REPLACEMENT = "callbacks.codebook_replacement"


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("model.codebooks", "1k"),
        ("model.codebooks", None),
        ("model.quantizer.init_args.kmeans_steps", 3),
        ("model.quantizer.class_path", "mine.Mine"),
        ("callbacks.phases.init_args.quantize_end", 40_000),
        ("callbacks.phases.init_args.quantize_end", 45_000),
        ("callbacks.phases.init_args.min_finetune", 2),
        ("callbacks.canonical.init_args.mode", "full"),
        ("callbacks.codebook_init", None),
        ("callbacks.codebook_refit.init_args.steps", 1),
        (f"{REPLACEMENT}.init_args.late_every", 700),
        ("callbacks.codebook_finite", None),
        ("callbacks.freeze", None),
        ("callbacks.export", None),
        ("callbacks.checkpoint.init_args.every", 7),
    ],
)
def test_a_trunk_does_not_depend_on_what_starts_after_it(standard: Settings, path: str, value: Any) -> None:
    assert trunk_of(changed(standard, path, value)) == trunk_of(standard) is not None


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("data.init_args.root", "other"),
        ("data.init_args.seed", 1),
        ("data.init_args.factor", 2),
        ("model.seed", 1),
        ("model.sh_degree", 2),
        ("model.rates.codebook_factor", 0.5),
        ("model.init_from", "scene.ply"),
        ("skips.blocks", False),
        ("trainer.max_steps", 61),
        ("trainer.accumulate_grad_batches", 2),
        ("trainer.precision", "64-true"),
        ("callbacks.phases.init_args.prune_end", 19_000),
        ("callbacks.density.init_args.max_splats", 1000),
        ("callbacks.opacity", None),
        ("callbacks.report.init_args.every", 5),
    ],
)
def test_a_trunk_depends_on_everything_else(standard: Settings, path: str, value: Any) -> None:
    assert trunk_of(changed(standard, path, value)) != trunk_of(standard)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("callbacks.phases.init_args.prune_end", 43_000),  # nothing is quantized
        ("callbacks.phases.init_args.total", 60_000),  # the run ends before the prune phase does
        ("callbacks.phases.init_args.iterations_per_photo", 100),  # the photos are not looked at
        ("callbacks.phases", None),
        ("callbacks.freeze.class_path", "mine.Freeze"),
        ("trainer.callbacks", [{"class_path": "mine.Callback"}]),
        ("trainer.min_steps", 50),
    ],
)
def test_a_run_that_may_not_be_cut_has_no_trunk(standard: Settings, path: str, value: Any) -> None:
    reference = changed(standard, "callbacks.phases.init_args.reference_total", 43_000)
    assert trunk_of(reference) is not None
    assert trunk_of(changed(reference, path, value)) is None


def test_plain_splatting_is_nothing_but_a_trunk() -> None:
    assert trunk_of(resolve([*SCENE, "--config=plain"])) is None


def test_a_trunk_keeps_the_schedule_of_the_whole_run(standard: Settings) -> None:
    trunk = trunk_of(standard)
    assert trunk is not None
    assert trunk["trainer"]["max_steps"] == 27  # 20 000 of 45 000
    assert trunk["callbacks"]["phases"]["init_args"]["total"] == 60


def test_a_checkpoint_of_the_users_is_refused() -> None:
    with pytest.raises(ValueError, match=r"ckpt_path=a\.ckpt"):
        resolve([*SCENE, "--ckpt_path=a.ckpt"])
