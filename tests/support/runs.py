"""Types of the fixtures that train (``training/conftest.py``)."""

from __future__ import annotations

from collections.abc import Callable

from lightning.pytorch import Callback, Trainer

from nsvq_lightning.training.module import SplatModule

__all__ = ["Recipe", "RunFactory"]

Recipe = Callable[..., dict[str, Callback]]
"""``recipe(**replaced)``: the callbacks of a full run by name."""
RunFactory = Callable[..., tuple[Trainer, SplatModule]]
"""``run(callbacks, ckpt_path=…, module={…}, scene=…, **trainer)`` fits."""
