"""A callback for runs started from the command line: what each process trains, step by step."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer


class ReplicaWitness(Callback):
    """Writes one line a step into ``folder/<rank>.txt``: iteration, phase, splats, SHA-256 of all parameters."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.lines: list[str] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if batch_idx % trainer.accumulate_grad_batches == 0:
            self._note(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._note(trainer, pl_module)
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / f"{trainer.global_rank}.txt").write_text("\n".join(self.lines))

    def _note(self, trainer: Trainer, module: LightningModule) -> None:
        digest = hashlib.sha256()
        for name, parameter in sorted(module.named_parameters()):
            digest.update(name.encode() + parameter.detach().numpy().tobytes())
        phase: Any = module.phase
        self.lines.append(f"{trainer.global_step} {phase.name} {len(module.splats)} {digest.hexdigest()}")
