"""Whole runs with the options that go beyond the paper, one by one and together."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from checkpoints import CheckpointAt
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import Recipe, RunFactory
from torch import Tensor

from nsvq_lightning.callbacks import (
    CanonicalCovariance,
    CodebookInit,
    CodebookReplacement,
    ContributionPruning,
    PhaseSchedule,
    RunCheckpoint,
)
from nsvq_lightning.commands.main import main
from nsvq_lightning.compression.covariance_error import covariances
from nsvq_lightning.compression.importance import scale_floor
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Phase

LAST_BEFORE_CODEBOOKS = 27
"""Of the recipe's 60 iterations."""


def options(**replaced: Callback) -> dict[str, Callback]:
    return {
        "canonical": CanonicalCovariance("full", floor=0.8),
        "contribution": ContributionPruning(share=0.02),
        "codebook_init": CodebookInit(weights="contribution"),
        "codebook_replacement": CodebookReplacement(jitter=0.5, reset_moments=True, end=40_000),
        **replaced,
    }


def scene_bytes(trainer: Trainer) -> bytes:
    return (run_folder(trainer) / "scene.nsvq").read_bytes()


@pytest.fixture(scope="module")
def all_options(run: RunFactory, recipe: Recipe) -> Trainer:
    trainer, _ = run(recipe(**options(), checkpoint=CheckpointAt(25, LAST_BEFORE_CODEBOOKS, 40)).values())
    return trainer


def test_few_splats_get_few_codes(run: RunFactory, recipe: Recipe) -> None:
    """Oracle: K·D is at most so many values a splat, K at least 1, and what was asked for where that is less."""
    for share in (0.0005, 0.004):
        _, module = run(recipe(codebook_init=CodebookInit(values_per_splat=share)).values())
        splats, asked = len(module.splats), {"scales": 24, "quats": 24, "sh0": 16, "shN": 16}
        for name, quantizer in module.quantizers.items():
            most = max(1, int(share * splats / quantizer.codebook.shape[1]))
            assert len(quantizer.codebook) == min(most, asked[name])
            assert int(quantizer.codes.max()) < len(quantizer.codebook)
        assert len(module.quantizers["shN"].codebook) < asked["shN"]


@pytest.mark.parametrize("share", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_number_of_values_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match="values_per_splat must be a finite number above 0"):
        CodebookInit(values_per_splat=share)


def test_the_order_of_callbacks_matters_only_where_it_is_said_to(
    all_options: Trainer, run: RunFactory, recipe: Recipe
) -> None:
    names = list(recipe(**options()))
    for order in (names[::-1], random.Random(1).sample(names, len(names))):
        later, earlier = order.index("codebook_replacement"), order.index("canonical")
        if later < earlier:
            order[later], order[earlier] = order[earlier], order[later]
        callbacks = recipe(**options())
        assert scene_bytes(run([callbacks[name] for name in order])[0]) == scene_bytes(all_options)


@pytest.mark.parametrize("interrupted_at", [25, LAST_BEFORE_CODEBOOKS, 40])
def test_a_resumed_run_is_the_run_not_interrupted(
    all_options: Trainer, run: RunFactory, recipe: Recipe, interrupted_at: int
) -> None:
    path = run_folder(all_options) / "checkpoints" / f"step-{interrupted_at}.ckpt"
    resumed, _ = run(recipe(**options(), checkpoint=RunCheckpoint(every=0)).values(), ckpt_path=path)
    assert scene_bytes(resumed) == scene_bytes(all_options)


def test_neutral_options_are_the_reference_run(run: RunFactory, recipe: Recipe) -> None:
    neutral = {"canonical": CanonicalCovariance(), "contribution": ContributionPruning()}
    assert scene_bytes(run(recipe(**neutral).values())[0]) == scene_bytes(run(recipe().values())[0])


class Look(Callback):
    """Keeps scales and quaternions around the start of the quantize phase."""

    def __init__(self) -> None:
        self.before: tuple[Tensor, Tensor] | None = None
        self.after: tuple[Tensor, Tensor] | None = None

    def on_before_zero_grad(self, trainer: Trainer, pl_module: LightningModule, optimizer: Any) -> None:
        assert isinstance(pl_module, SplatModule)
        if trainer.global_step == LAST_BEFORE_CODEBOOKS:
            self.after = pl_module.splats.scales.detach().clone(), pl_module.splats.quats.detach().clone()

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any) -> None:
        assert isinstance(pl_module, SplatModule)
        if trainer.global_step == LAST_BEFORE_CODEBOOKS:
            self.before = pl_module.splats.scales.detach().clone(), pl_module.splats.quats.detach().clone()


@pytest.mark.parametrize("mode", ["sign", "full", "auto"])
def test_rows_are_canonical_when_codebooks_are_placed(mode: Any, run: RunFactory, recipe: Recipe) -> None:
    look = Look()  # first in the list, so that it sees them before and after
    run([look, *recipe(canonical=CanonicalCovariance(mode)).values()], max_steps=60)
    assert look.before is not None
    assert look.after is not None
    after, before = (covariances(*pair).double() for pair in (look.after, look.before))
    assert ((after - before).norm(dim=(1, 2)) / before.norm(dim=(1, 2))).max() < 1e-5
    scales, quats = look.after
    if mode != "auto":
        torch.testing.assert_close(quats.norm(dim=1), torch.ones(len(quats)))
        assert (quats[:, 0] >= 0).all()
    if mode == "full":
        assert (scales.diff(dim=1) <= 0).all()


def test_a_run_that_starts_with_codebooks_starts_canonical(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    phases = PhaseSchedule(warmup_end=0, prune_end=0)
    with caplog.at_level("INFO"):
        run(recipe(phases=phases, canonical=CanonicalCovariance("full")).values(), max_steps=4)
    assert caplog.text.count("iteration 0: canonical covariances, form full") == 1


class Scales(Callback):
    """Log-scales and centres as codes are searched in each iteration."""

    def __init__(self) -> None:
        self.scales: dict[int, Tensor] = {}
        self.means: dict[int, Tensor] = {}

    def on_before_zero_grad(self, trainer: Trainer, pl_module: LightningModule, optimizer: Any) -> None:
        assert isinstance(pl_module, SplatModule)
        iteration = trainer.global_step + 1
        self.scales[iteration] = pl_module.splats.scales.detach().clone()
        self.means[iteration] = pl_module.splats.means.detach().clone()


def test_scales_too_small_to_show_are_one_value_throughout_the_quantize_phase(
    run: RunFactory, recipe: Recipe, demo_scene: Path
) -> None:
    look = Scales()
    _, module = run([look, *recipe(canonical=CanonicalCovariance(floor=0.8)).values()])
    scene = ColmapDataModule(str(demo_scene), factor=2).scene
    first, last = LAST_BEFORE_CODEBOOKS + 1, module.schedule.ends[Phase.QUANTIZE]
    floor = scale_floor(look.means[first], [scene.cameras[index] for index in scene.train], 0.8)
    for iteration in range(first, last + 1):
        scales = look.scales[iteration]
        assert scales.min() == torch.tensor(floor)
        assert (scales == scales.min()).float().mean() > 0.05
    assert (look.scales[LAST_BEFORE_CODEBOOKS] < floor).float().mean() > 0.05


def test_contribution_pruning_removes_splats_before_the_codebooks(run: RunFactory, recipe: Recipe) -> None:
    _, reference = run(recipe().values())
    _, pruned = run(recipe(contribution=ContributionPruning(share=0.05)).values())
    assert 0.2 * len(reference.splats) < len(pruned.splats) < 0.95 * len(reference.splats)


def test_contribution_pruning_in_the_quantize_phase_is_refused(run: RunFactory, recipe: Recipe) -> None:
    with pytest.raises(ValueError, match="must leave an iteration before the quantize phase"):
        run(recipe(contribution=ContributionPruning(share=0.05, at=20_000)).values())


class Recording(NSVQ):
    """Keeps the weights it was fitted with."""

    weight: Tensor | None = None

    def fit(self, x: Tensor, weight: Tensor | None = None, generator: torch.Generator | None = None) -> None:
        self.weight = weight
        super().fit(x, weight, generator)


def test_kmeans_gets_contributions_as_weights(run: RunFactory, recipe: Recipe) -> None:
    for weights in ("none", "contribution"):
        callbacks = recipe(codebook_init=CodebookInit(weights=weights)).values()  # type: ignore[arg-type]
        _, module = run(callbacks, module={"quantizer": Recording})
        found = {name: quantizer.weight for name, quantizer in module.quantizers.items()}  # type: ignore[attr-defined]
        weighted = {name for name, weight in found.items() if weight is not None}
        assert weighted == (set() if weights == "none" else {"quats", "sh0", "shN"})
    assert found["quats"].shape == (len(module.splats),)
    assert found["quats"].min() > 0
    assert found["quats"].max() > 2 * found["quats"].mean()


class Moments(Callback):
    """Looks at Adam's moments of scale codes after each step."""

    def __init__(self) -> None:
        self.zero_rows: list[int] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any) -> None:
        assert isinstance(pl_module, SplatModule)
        optimizer = trainer.optimizers[0]
        group = next(group for group in optimizer.param_groups if group["name"] == "codebook_scales")
        state = optimizer.state.get(group["params"][0])
        if state:
            self.zero_rows.append(int((~state["exp_avg_sq"].any(1)).sum()))


def test_moments_of_replaced_codes_are_reset(run: RunFactory, recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    # Codes out of use for a window of 5 views are rare here: call every third one unused.
    monkeypatch.setattr(
        "nsvq_lightning.quantize.codebook.inactive_codes", lambda usage, *_: torch.arange(len(usage)) % 3 == 0
    )
    zero_rows = {}
    for reset in (False, True):
        moments = Moments()  # last in the list
        run([*recipe(codebook_replacement=CodebookReplacement(jitter=0.5, reset_moments=reset)).values(), moments])
        zero_rows[reset] = moments.zero_rows
    assert max(zero_rows[False][1:]) == 0
    assert max(zero_rows[True]) == 8


def test_bad_options_are_refused() -> None:
    with pytest.raises(ValueError, match="mode must be one of none, sign, full, auto"):
        CanonicalCovariance("sorted")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="floor is a number of pixels and must be at least 0"):
        CanonicalCovariance(floor=-1.0)
    with pytest.raises(ValueError, match="share must be at least 0 and below 1"):
        ContributionPruning(share=1.0)
    with pytest.raises(ValueError, match="at must be at least 1"):
        ContributionPruning(at=0)
    with pytest.raises(ValueError, match="weights must be"):
        CodebookInit("area")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="weighted must be among scales, quats, sh0, shN, got means"):
        CodebookInit(weighted=["means"])
    with pytest.raises(ValueError, match="jitter must be None or above 0"):
        CodebookReplacement(jitter=0.0)


def test_options_are_reached_from_the_command_line(capsys: pytest.CaptureFixture[str], demo_scene: Path) -> None:
    with pytest.raises(SystemExit):
        main(
            [
                *(
                    "fit",
                    f"--data.root={demo_scene}",
                    "--callbacks.canonical.mode=sign",
                    "--callbacks.canonical.floor=0.3",
                ),
                *("--callbacks.contribution.share=0.25", "--callbacks.codebook_init.weights=contribution"),
                *("--callbacks.codebook_init.weighted=[quats, sh0]", "--model.quantizer=NSVQ"),
                "--model.quantizer.start=spread",
                *("--callbacks.codebook_replacement.jitter=0.25", "--callbacks.codebook_replacement.end=40000"),
                *("--callbacks.phases.quantize_end=30000", "--callbacks.phases.reference_total=32000"),
                "--print_config",
            ]
        )
    config = yaml.safe_load(capsys.readouterr().out)
    found = {name: one["init_args"] for name, one in config["callbacks"].items() if "init_args" in one}
    assert config["model"]["quantizer"]["init_args"]["start"] == "spread"
    assert found["canonical"] == {"mode": "sign", "floor": 0.3}
    assert found["contribution"] == {"share": 0.25, "at": 18_500}
    assert found["codebook_init"] == {"weights": "contribution", "weighted": ["quats", "sh0"], "values_per_splat": None}
    assert found["codebook_replacement"]["jitter"] == 0.25
    assert found["codebook_replacement"]["end"] == 40_000
    assert (found["phases"]["quantize_end"], found["phases"]["reference_total"]) == (30_000, 32_000)


@pytest.mark.parametrize("name", ["fast", "best", "small"])
def test_the_shipped_configs_run(
    name: str, demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [f"--data.root={demo_scene}", "--data.factor=2", f"--trainer.default_root_dir={tmp_path}"]
    quiet = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]
    assert main(["fit", f"--config={name}", *arguments, *quiet, "--trainer.max_steps=30", "--model.sh_degree=1"]) == 0
    assert "rendered from the decoded file" in capsys.readouterr().out
    config = yaml.safe_load(next(tmp_path.rglob("config.yaml")).read_text())
    assert config["model"]["quantizer"]["init_args"]["start"] == "spread"
    assert config["callbacks"]["canonical"]["init_args"]["mode"] == "auto"
