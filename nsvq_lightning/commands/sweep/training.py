"""One training in a folder of its own: started, continued after an interruption, or found finished."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.sweep.settings import Settings, digest
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.version import __version__

__all__ = ["Runner", "Training", "TrainingError", "run_subprocess"]

Runner = Callable[[Sequence[str], Path], int]
"""Runs ``nsvq ARGUMENTS``, writes what it says into a log file, and returns its exit status."""

PATIENCE = 20.0
"""Seconds a training has to stop by itself when the sweep is interrupted."""


class TrainingError(RuntimeError):
    """A training has failed; the message says why in one line."""


@dataclass(frozen=True)
class Training:
    """A run of ``nsvq fit`` in a folder that is named after a digest of its settings: no other run writes there.

    Attributes:
        folder: Where; holds ``log.txt`` and what ``nsvq fit`` leaves, and ``finished.json`` once it is done.
        settings: All settings of ``nsvq fit``.
    """

    folder: Path
    settings: Settings

    @classmethod
    def under(cls, parent: Path, title: str, settings: Settings) -> Training:
        """The training of these settings in ``parent``; the title is for people, and that of the first stays."""
        name = digest(settings)
        return cls(next(parent.glob(f"*-{name}"), parent / f"{title}-{name}"), settings)

    @property
    def checkpoint(self) -> Path:
        """The last checkpoint."""
        return self.folder / "checkpoints" / "last.ckpt"

    @property
    def record(self) -> dict[str, Any] | None:
        """What was noted at the end; None while the training is not finished."""
        try:
            record: dict[str, Any] = json.loads(self._record_path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        return record

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of ``metrics.json``."""
        metrics: dict[str, Any] = json.loads((self.folder / "metrics.json").read_text(encoding="utf-8"))
        return metrics

    def run(self, runner: Runner, start: Path | None = None) -> None:
        """Train, from the own checkpoint if there is one, else from ``start``, else from the beginning.

        Args:
            runner: Runs ``nsvq``.
            start: Checkpoint to branch from.

        Raises:
            TrainingError: The training has failed, or has left no metrics.
        """
        if not self.checkpoint.is_file():
            shutil.rmtree(self.folder, ignore_errors=True)  # what a training that failed early has left
        self.folder.mkdir(parents=True, exist_ok=True)
        config, log = self.folder / "config.yaml", self.folder / "log.txt"
        write_text(config, json.dumps(self.settings, indent=2) + "\n")  # JSON is YAML
        arguments = ["fit", "--config", str(config), f"--trainer.run_folder={self.folder}"]
        start = self.checkpoint if self.checkpoint.is_file() else start
        if start is not None:
            arguments.append(f"--ckpt_path={start}")
        status = runner(arguments, log)
        if status != 0:
            raise TrainingError(f"{_reason(status, log)} (see {log})")
        if not (self.folder / "metrics.json").is_file():
            raise TrainingError(f"the run has left no metrics.json: callbacks.report must stay (see {log})")

    def finish(self, **notes: Any) -> None:
        """Note that the training is done, with JSON values that are to be remembered."""
        write_text(self._record_path, json.dumps({"version": __version__, **notes}, indent=2) + "\n")

    def drop_checkpoints(self) -> None:
        """Remove the checkpoints, which are larger than everything else."""
        shutil.rmtree(self.folder / "checkpoints", ignore_errors=True)

    @property
    def _record_path(self) -> Path:
        return self.folder / "finished.json"


def run_subprocess(arguments: Sequence[str], log: Path) -> int:
    """Run ``nsvq`` as a process of its own: what goes wrong in it, or is not given back, ends with it."""
    with open(log, "wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "nsvq_lightning", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"},
        )
        try:
            return process.wait()
        finally:
            _stop(process)


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End a process that still runs: the sweep itself was interrupted."""
    if process.poll() is not None:
        return
    process.terminate()
    try:
        process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        pass
    finally:
        process.kill()
        process.wait()


def _reason(status: int, log: Path) -> str:
    """Why a process has failed, from the last lines of what it said."""
    if status < 0:
        return f"killed by signal {-status}{', perhaps for want of memory' * (status == -9)}"
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or [f"exit status {status}"])[-1].removeprefix("error: ")
