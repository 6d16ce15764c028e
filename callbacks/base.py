"""What callbacks share: the check of the module, the folder of the run, acting once per step, the search for NaN."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.training.edit import drop_non_finite
from nsvq_lightning.training.host import SplatHost, check_optimizer, splat_host
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.run_folder import hold, is_trial, let_go, run_folder, take

__all__ = [
    "FiniteSearch",
    "HostedCallback",
    "OncePerStep",
    "StepCallback",
    "WritingCallback",
    "keep_finite_splats",
]


class HostedCallback(Callback):
    """Base of the callbacks that train: works with any :class:`nsvq_lightning.training.host.SplatHost`.

    The module is checked before anything starts, its optimiser as soon as there is one. A subclass that overrides these
    hooks calls them here first.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Check the module.

        Raises:
            TypeError: It lacks something that :class:`~nsvq_lightning.training.host.SplatHost` names.
        """
        splat_host(pl_module)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check the optimiser.

        Raises:
            ValueError: It lacks the parameter groups of a host, or there are several.
        """
        check_optimizer(trainer, pl_module)


class WritingCallback(HostedCallback):
    """Callback that writes files: it takes the folder of the run when the run starts, not when the first file is due.

    A subclass that overrides these hooks calls them here first.
    """

    stages: ClassVar[tuple[str, ...]] = ("fit",)
    """Stages in which it writes: ``fit``, ``test`` or both."""
    folder: str | Path | None = None
    """Where it writes instead of the folder of the run, if set."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Check the module, and for a test take the folder.

        Raises:
            FileExistsError: It holds another run.
        """
        super().setup(trainer, pl_module, stage)
        if stage != "fit":
            self._take_folder(trainer, stage)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the folder, now that the trainer knows which checkpoint it continues from.

        Raises:
            FileExistsError: It holds another run.
        """
        self._take_folder(trainer, "fit")

    def _take_folder(self, trainer: Trainer, stage: str) -> None:
        if stage not in self.stages:
            return
        if self.folder is None:
            folder = run_folder(trainer)
            if trainer.is_global_zero and not is_trial(trainer):
                hold(folder)  # again, if an earlier stage of the run has ended
        elif trainer.is_global_zero and not is_trial(trainer):
            take(Path(self.folder), trainer.ckpt_path)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Let go of the folder: nothing is written after this."""
        if stage in self.stages:
            let_go(run_folder(trainer) if self.folder is None else Path(self.folder))


class OncePerStep:
    """Remembers the last iteration acted on.

    With gradient accumulation ``on_train_batch_start`` and ``on_train_batch_end`` are called several times at one
    ``global_step``; code that must run once per iteration asks this first. Its state belongs in ``state_dict``: a
    run resumed right after the step must not act again.
    """

    def __init__(self) -> None:
        # No iteration: they are 1-based, and `global_step` is 0 before the first step.
        self.last = -1

    def first_time(self, iteration: int) -> bool:
        """True at the first call with this iteration."""
        if iteration == self.last:
            return False
        self.last = iteration
        return True


class StepCallback(HostedCallback):
    """Callback that acts at most once per iteration of a fit, also when the fit is resumed."""

    def __init__(self) -> None:
        super().__init__()
        self._once = OncePerStep()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit of the same callback; a checkpoint's state is loaded after this."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._once = OncePerStep()

    def state_dict(self) -> dict[str, Any]:
        """The last iteration acted on."""
        return {"last": self._once.last}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do not repeat what was done before the checkpoint."""
        self._once.last = state_dict["last"]


class FiniteSearch:
    """Decides when to search for NaN and infinite values: at intervals, and after a step without an update.

    After a step with a non-finite loss no parameter has a gradient, on any process
    (:class:`nsvq_lightning.SplatModule`, :class:`nsvq_lightning.training.distributed.ViewParallelStrategy`). So all
    processes decide alike without communication.

    Args:
        every: Iterations between two searches.
        name: Name of the argument, for the error.

    Raises:
        ValueError: ``every`` is below 1.
    """

    def __init__(self, every: int, name: str = "every") -> None:
        if every < 1:
            raise ValueError(f"{name} must be at least 1, got {every}")
        self.every = every

    def is_due(self, trainer: Trainer) -> bool:
        """Whether to search now, at the end of an iteration: before callbacks exchange the parameters."""
        return trainer.global_step % self.every == 0 or not _was_updated(trainer)


def _was_updated(trainer: Trainer) -> bool:
    groups = raw_optimizer(trainer).param_groups
    return any(parameter.grad is not None for group in groups for parameter in group["params"])


def keep_finite_splats(trainer: Trainer, host: SplatHost) -> None:
    """Drop non-finite splats, with their frozen codes (:func:`nsvq_lightning.training.edit.drop_non_finite`).

    The replicas of several processes are equal, so all drop the same splats without communication. Dropping splats
    loses gradients: call it between an update and the next backward pass.

    Raises:
        FloatingPointError: No finite splat is left.
    """
    kept = drop_non_finite(host.splats, raw_optimizer(trainer), trainer.global_step)
    if len(host.splats) == len(kept):
        return
    for quantizer in host.quantizers.values():
        if len(quantizer.codes) > 0:
            quantizer.freeze(quantizer.codes[kept])
