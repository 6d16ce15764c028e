"""Act at most once per iteration."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import LightningModule, Trainer

from .hosted import HostedCallback

__all__ = ["LatchedCallback", "StepLatch"]


class StepLatch:
    """Remembers the last iteration acted on.

    With gradient accumulation ``on_train_batch_start`` and ``on_train_batch_end`` are called several times at one
    ``global_step``; code that must run once per iteration asks the latch first. Its state belongs in ``state_dict``: a
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


class LatchedCallback(HostedCallback):
    """Callback that acts at most once per iteration of a fit, also when the fit is resumed."""

    def __init__(self) -> None:
        super().__init__()
        self._latch = StepLatch()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit of the same callback; a checkpoint's state is loaded after this."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._latch = StepLatch()

    def state_dict(self) -> dict[str, Any]:
        """The last iteration acted on."""
        return {"last": self._latch.last}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do not repeat what was done before the checkpoint."""
        self._latch.last = state_dict["last"]
