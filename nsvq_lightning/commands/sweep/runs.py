"""Train the runs of a sweep, what they share only once, and keep the tables up to date."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.sweep.plan import Run
from nsvq_lightning.commands.sweep.rate_distortion import draw_sweep
from nsvq_lightning.commands.sweep.results import RunResult, as_markdown
from nsvq_lightning.commands.sweep.settings import trunk_of
from nsvq_lightning.commands.sweep.training import Runner, Training, TrainingError, run_subprocess
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.report.figures import write_csv
from nsvq_lightning.training.schedule import Phase

__all__ = ["Sweep"]

TRUNK_PHASES = tuple(phase.name.lower() for phase in Phase if phase <= Phase.PRUNE)
"""Names of the phases before anything is quantized."""

log = logging.getLogger(__name__)


class Sweep:
    """A folder of runs: ``results.csv``, ``results.md``, ``results.png``, and a folder for each run and trunk.

    A trunk is what several runs share: the training up to the end of the prune phase. It is trained once, and its
    checkpoint stays, so that more sizes or quantizers can branch from it later.

    Args:
        folder: Where.
        runner: Runs ``nsvq fit``.
        keep_checkpoints: Keep those of finished runs, too.
    """

    def __init__(self, folder: Path, runner: Runner = run_subprocess, keep_checkpoints: bool = False) -> None:
        self.folder = folder
        self.keep_checkpoints = keep_checkpoints
        self._runner = runner
        self._failed: dict[Path, str] = {}

    def training(self, run: Run) -> Training:
        """The training of a run."""
        return Training.under(self.folder / "runs", run.title, run.settings)

    def trunk(self, run: Run) -> Training | None:
        """The training that a run branches from; None where it starts from the beginning."""
        settings = trunk_of(run.settings)
        title = f"{run.scene}-seed{run.seed}"
        return None if settings is None else Training.under(self.folder / "trunks", title, settings)

    def train(self, runs: Sequence[Run]) -> list[RunResult]:
        """Train what is not finished yet; a run that fails does not keep the others from theirs.

        The tables are written anew after each run, so they are complete whenever this is interrupted.

        Returns:
            A row for each run, in their order.
        """
        trainings = [self.training(run) for run in runs]
        rows = {t.folder: _row(run, t) for run, t in zip(runs, trainings, strict=True) if t.record is not None}
        if rows:
            self._write(list(rows.values()))
        for number, (run, training) in enumerate(zip(runs, trainings, strict=True), start=1):
            counted = f"[{number}/{len(runs)}] {run.title}"
            if training.folder in rows:
                log.info("%s: finished before", counted)
                continue
            log.info("%s: see %s", counted, training.folder / "log.txt")
            rows[training.folder] = self._train_one(run, training)
            log.info("%s: %s", counted, _said(rows[training.folder]))
            self._write([rows[t.folder] for t in trainings if t.folder in rows])
        return [rows[training.folder] for training in trainings]

    def _train_one(self, run: Run, training: Training) -> RunResult:
        try:
            trunk = self.trunk(run)
            # A run that was interrupted after its trunk goes on from its own checkpoint.
            if trunk is not None and not training.checkpoint.is_file():
                self._train_trunk(trunk)
            training.run(self._runner, trunk.checkpoint if trunk is not None else None)
            training.finish(trunk=trunk.folder.name if trunk is not None else None)
        except (TrainingError, OSError) as error:
            return RunResult(**_names(run), folder=training.folder, error=str(error))
        if not self.keep_checkpoints:
            training.drop_checkpoints()
        return _row(run, training)

    def _train_trunk(self, trunk: Training) -> None:
        if trunk.record is not None and trunk.checkpoint.is_file():
            return
        if trunk.folder in self._failed:
            raise TrainingError(self._failed[trunk.folder])
        log.info("  trunk: see %s", trunk.folder / "log.txt")
        try:
            trunk.run(self._runner)
        except TrainingError as error:
            self._failed[trunk.folder] = f"trunk: {error}"
            raise TrainingError(self._failed[trunk.folder]) from error
        trunk.finish()

    def _write(self, rows: Sequence[RunResult]) -> None:
        write_csv(self.folder / "results.csv", [row.as_csv() for row in rows])
        write_text(self.folder / "results.md", as_markdown(rows))
        if any(row.psnr is not None for row in rows):
            draw_sweep(self.folder / "results.png", rows)


def _names(run: Run) -> dict[str, Any]:
    names = ("scene", "config", "quantizer", "codebooks", "seed", "steps")
    return {name: getattr(run, name) for name in names}


def _row(run: Run, training: Training) -> RunResult:
    """The row of a finished run."""
    metrics, record = training.metrics, training.record or {}
    before = metrics["before_quantization"]
    return RunResult(
        **_names(run),
        psnr=metrics["psnr"],
        ssim=metrics["ssim"],
        bytes=metrics["file_bytes"],
        splats=metrics["num_splats"],
        bytes_paper=metrics["paper_level"]["file_bytes"],
        psnr_paper=metrics["phases"][-1]["psnr"],
        seconds=metrics["train_seconds"],
        trunk_seconds=_trunk_seconds(metrics) if record["trunk"] is not None else 0.0,
        psnr_before=before["psnr"] if before is not None else None,
        version=record["version"],
        folder=training.folder,
    )


def _trunk_seconds(metrics: Mapping[str, Any]) -> float:
    """Seconds at the last evaluation of the trunk, which is at its end."""
    seconds: float = max(entry["seconds"] for entry in metrics["phases"] if entry["phase"] in TRUNK_PHASES)
    return seconds


def _said(row: RunResult) -> str:
    if row.error:
        return f"failed: {row.error}"
    psnr = "infinite" if row.psnr is None else f"{row.psnr:.2f} dB"
    return f"PSNR {psnr}, {row.bytes} bytes, {row.seconds:.0f} s of training, {row.trunk_seconds:.0f} s of it shared"
