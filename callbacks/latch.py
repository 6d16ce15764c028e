"""Act at most once an iteration."""

from __future__ import annotations

__all__ = ["StepLatch"]


class StepLatch:
    """Remembers the last iteration something was done at.

    With gradient accumulation ``on_train_batch_start`` and ``on_train_batch_end`` are called several times at one
    ``global_step``; what must happen once an iteration asks the latch first. Its state belongs into ``state_dict``: a
    run resumed right after the step must not act again.
    """

    def __init__(self) -> None:
        # No iteration: they are 1-based, and 0 is what `global_step` says before the first step.
        self.last = -1

    def first_time(self, iteration: int) -> bool:
        """True at the first call with this iteration."""
        if iteration == self.last:
            return False
        self.last = iteration
        return True
