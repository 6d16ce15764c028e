"""A run that leaves a shared trunk is the run that was trained from its start."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer
from runs import Recipe, RunFactory, Whole, paper_phases
from torch import nn

from nsvq_lightning.callbacks import RunCheckpoint
from nsvq_lightning.quantize import NSVQ, StraightThrough
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.resume import (
    branch_optimizer_state,
    can_branch,
    changed_schedule,
    check_continuation,
)
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Phase, Schedule

INTERVALS = {"min_density_interval": 4, "min_reset_interval": 11, "min_replacement_interval": 5, "min_finetune": 1}
PRUNE_END = Schedule(total=60, **INTERVALS).ends[Phase.PRUNE]


def checkpoint_of(trainer: Trainer) -> Path:
    return run_folder(trainer) / "checkpoints" / "last.ckpt"


def check(checkpoint: dict[str, Any], module: SplatModule) -> None:
    check_continuation(checkpoint, module.state_dict(), module.quantizer_settings)


def outcome(trainer: Trainer, module: SplatModule) -> tuple[bytes, list[dict[str, Any]]]:
    """The file, and every evaluation without its time."""
    scene = (run_folder(trainer) / "scene.nsvq").read_bytes()
    return scene, [{name: value for name, value in entry.items() if name != "seconds"} for entry in module.history]


@pytest.fixture(scope="module")
def trunk(run: RunFactory, recipe: Recipe) -> Path:
    """Checkpoint of a run without codebooks, and without the callbacks that drive them, at the end of pruning."""
    parts = recipe(phases=paper_phases(total=60, **INTERVALS), checkpoint=RunCheckpoint())
    for name in ("codebook_init", "codebook_replacement", "freeze", "export"):
        del parts[name]
    trainer, module = run(parts.values(), module={"codebooks": None}, max_steps=PRUNE_END)
    assert trainer.global_step == PRUNE_END
    assert len(module.splats) > 500  # density control has worked: the moments were edited, too
    return checkpoint_of(trainer)


@pytest.mark.parametrize(
    "codebooks",
    [{"scales": 24, "quats": 24, "sh0": 16, "shN": 16}, {"scales": 5, "shN": 8}],
    ids=["all four", "two of four"],
)
def test_a_branch_ends_in_the_bytes_of_the_run_trained_from_its_start(
    run: RunFactory, recipe: Recipe, trunk: Path, codebooks: dict[str, int], paper: Whole
) -> None:
    whole = paper.trainer, paper.module
    if len(codebooks) < 4:
        whole = run(recipe().values(), module={"codebooks": codebooks})
    branched = run(recipe().values(), ckpt_path=trunk, module={"codebooks": codebooks})
    assert outcome(*branched) == outcome(*whole)
    trunk_seconds = float(torch.load(trunk, weights_only=True)["state_dict"]["_extra_state"][3])
    assert branched[1].stopwatch.seconds > trunk_seconds > 0


def test_once_quantized_the_rules_of_that_phase_count() -> None:
    module = SplatModule(sh_degree=1)
    module.schedule = Schedule(min_finetune=200)
    for phase in Phase:
        module.phase = phase
        stored: dict[str, Any] = {"state_dict": module.state_dict()}
        module.on_save_checkpoint(stored)
        told = changed_schedule(stored, Schedule())
        assert (told is None) is (phase < Phase.QUANTIZE)
        assert changed_schedule(stored, module.schedule) is None
    assert told is not None
    assert "--callbacks.phases.min_finetune=200" in told
    module.phase, module.schedule = Phase.PRUNE, Schedule(min_finetune=200, min_reset_interval=11)
    stored = {"state_dict": module.state_dict()}
    module.on_save_checkpoint(stored)
    assert changed_schedule(stored, Schedule(min_reset_interval=12)) == (
        "the checkpoint is of a run with min_reset_interval = 11, this one continues with min_reset_interval = 12; "
        "pass --callbacks.phases.min_reset_interval=11 to continue that run as it was"
    )


def test_codebooks_may_change_until_they_are_placed() -> None:
    module = SplatModule(sh_degree=1, codebooks={"scales": 12})
    for phase in Phase:
        module.phase = phase
        stored = {"state_dict": module.state_dict()}
        for others in ({"scales": 7}, {"scales": 12, "quats": 12}, None):
            fits = can_branch(stored, SplatModule(sh_degree=1, codebooks=others).codebooks)
            assert fits is (phase < Phase.QUANTIZE)
        # Codebooks of the same sizes are the run's own: they are loaded, not exchanged.
        assert not can_branch(stored, module.codebooks)


def test_moments_follow_their_parameters_when_groups_move() -> None:
    def adam(*names: str) -> torch.optim.Adam:
        groups = [{"params": [nn.Parameter(torch.full((2,), 1.0))], "lr": 0.1, "name": name} for name in names]
        return torch.optim.Adam(groups)

    trained = adam("codebook_scales", "means", "sh0", "codebook_sh0")
    for step, group in enumerate(trained.param_groups):
        group["params"][0].grad = torch.full((2,), float(step + 1))
    trained.step()
    target = adam("means", "sh0", "codebook_scales")
    target.load_state_dict(branch_optimizer_state(trained.state_dict(), target.state_dict()))
    states = {group["name"]: target.state[group["params"][0]] for group in target.param_groups}
    # Adam's first moment after one step is 0.1 times the gradient, which was the place in the old order.
    assert float(states["means"]["exp_avg"][0]) == pytest.approx(0.2)
    assert float(states["sh0"]["exp_avg"][0]) == pytest.approx(0.3)
    assert states["codebook_scales"] == {}  # another codebook: no moments


def quantizing(**settings: Any) -> SplatModule:
    module = SplatModule(**{"sh_degree": 0, "quantizer": NSVQ, "codebooks": {"scales": 12, "sh0": 8}, **settings})
    module.phase = Phase.QUANTIZE
    return module


def saved(module: SplatModule) -> dict[str, Any]:
    """What a checkpoint holds of a module."""
    checkpoint: dict[str, Any] = {"state_dict": module.state_dict(), "optimizer_states": [{}]}
    module.on_save_checkpoint(checkpoint)
    return checkpoint


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"codebooks": {"scales": 24, "sh0": 8}}, "this run would with NSVQ (scales: 24, sh0: 8)"),
        ({"codebooks": {"scales": 12}}, "this run would with NSVQ (scales: 12)"),
        ({"codebooks": None}, "this run would with no codebooks"),
        ({"quantizer": StraightThrough}, "this run would with StraightThrough (scales: 12, sh0: 8)"),
    ],
)
def test_a_quantized_run_cannot_go_on_with_other_quantizers(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as refusal:
        check(saved(quantizing()), quantizing(**settings))
    assert "has quantized with NSVQ (scales: 12, sh0: 8)" in str(refusal.value)
    assert "pass the --model.quantizer and --model.codebooks that it was trained with" in str(refusal.value)
    with pytest.raises(ValueError, match=r"has quantized with no codebooks, and this run would with NSVQ"):
        check(saved(quantizing(codebooks=None)), quantizing())


def test_the_same_quantizers_go_on_whatever_they_are_called() -> None:
    module = quantizing()
    scales = module.codebooks["scales"]
    assert isinstance(scales, NSVQ)
    scales.fit(torch.arange(9.0).reshape(3, 3))  # fewer rows than codes
    assert scales.num_codes == 3
    for same in (quantizing(), quantizing(quantizer=partial(NSVQ, kmeans_steps=3))):
        check(saved(module), same)
    paper = quantizing(codebooks="0.5k")  # without SH coefficients there are three codebooks
    check(saved(paper), quantizing(codebooks={"scales": 512, "quats": 512, "sh0": 128, "shN": 7}))
