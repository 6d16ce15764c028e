"""Measure the run: curves while it trains, and the quality of the decoded file at the end."""

from dataclasses import field
from typing import Any

import torch
from lightning.pytorch import Trainer
from torch import Tensor

from nsvq_lightning.data.scene import View
from nsvq_lightning.io.atomic import optional
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import Json
from nsvq_lightning.io.formats import save
from nsvq_lightning.io.nsvq.file import paper_header, read_nsvq
from nsvq_lightning.quality.loss import apply_mask, ssim
from nsvq_lightning.quality.metrics import build_lpips, color_corrected, eight_bit, psnr
from nsvq_lightning.report import numbers, page, pictures
from nsvq_lightning.top_level import log
from nsvq_lightning.training.distributed import sum_over_processes
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import is_fast_dev_run, run_folder
from nsvq_lightning.training.run_scene import scene_of

from .base import WritingCallback, picture_file
from .settings import Whole


def notify_monitors(trainer: Trainer, module: SplatModule) -> None:
    """Let callbacks with a ``monitor``, as early stopping has, act now; those of ``train/…`` once that has been logged.

    They wait for the end of an epoch or a validation, depending on their settings and the trainer's, and act in one of
    these hooks. Here the sampler is endless and no validation runs, so neither ever comes. Where validation is asked
    for, it calls those of ``val/…`` itself.
    """
    validates = trainer.enable_validation and trainer.val_check_interval != 1  # that of an epoch never comes
    for watcher in trainer.callbacks:  # type: ignore[attr-defined]  # Lightning does not type it
        monitor = getattr(watcher, "monitor", None)
        if not isinstance(monitor, str) or (monitor.startswith("val/") and validates):
            continue
        if monitor in trainer.callback_metrics or not monitor.startswith("train/"):
            watcher.on_train_epoch_end(trainer, module)
            watcher.on_validation_end(trainer, module)


class MetricReport(WritingCallback):
    """Writes the results of a run to its folder.

    During training: test PSNR and SSIM, number of splats and training seconds at the end of each phase and every
    ``every`` iterations, in ``curve.csv`` and ``report.html``, a page that can be left open in a browser and shows one
    view as it becomes better. An evaluation renders what a file written at that moment would decode to. It does not
    count as training time.

    Evaluations take the place of Lightning's validation: ``report/psnr``, ``report/ssim`` and ``report/splats`` go to
    the loggers and to ``trainer.callback_metrics``, and ``EarlyStopping(monitor="report/psnr", mode="max")`` or a
    ``ModelCheckpoint`` that monitors one of them is called right away.

    In ``test``: writes ``scene.nsvq``, reads it back, and lets the module render the **decoded file**; then writes
    ``metrics.json``, ``views.csv``, a picture (photo, render, error) of each view in ``renders/``, and ``report.html``,
    which holds all of it and needs no other file. TensorBoard and Weights & Biases loggers show the pictures, too.

    Example:
        >>> from nsvq_lightning import SplatModule
        >>> from nsvq_lightning.callbacks import MetricReport
        >>> report = MetricReport(every=20_000, pictures=False)  # --callbacks.report.every=20000
        >>> module = SplatModule(codebooks="4k")
        >>> [iteration for iteration in range(1, 45_001) if report.is_due(module, iteration)]
        [15000, 20000, 40000, 43000, 45000]
    """

    stages = ("fit", "test")

    every: Whole | None = None
    """Iterations of this run between two evaluations; None is a twentieth of the run, 0 means only the ends of phases.
    """
    lpips: bool = True
    """Measure LPIPS in ``test`` if torchvision and its weights are installed."""
    pictures: bool = True
    """Write a picture of each test view."""

    _scene: CompressedScene | None = field(default=None, init=False)

    # During training

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether the scene is evaluated after this iteration."""
        every = module.schedule.part(20) if self.every is None else self.every
        # By default between the round numbers: opacities are reset at those, and evaluating right then is misleading.
        offset = every // 2 if self.every is None else 0
        return iteration > 0 and (iteration in module.schedule.ends or bool(every and iteration % every == offset))

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, *args: Any) -> None:
        """Evaluate the last iteration, now that all callbacks have finished with it, also if interrupted."""
        super().on_train_batch_start(trainer, module, *args)
        if self.is_due(module, trainer.global_step):
            self._evaluate_once(trainer, module)

    def _evaluate_once(self, trainer: Trainer, module: SplatModule) -> None:
        """Evaluate an iteration that was not evaluated yet, and notify the callbacks that monitor it."""
        iteration = trainer.global_step
        done = module.history[-1]["iteration"] if module.history else 0
        if iteration <= done or is_fast_dev_run(trainer) or not getattr(scene_of(trainer), "test", ()):
            return
        loader = trainer.datamodule.val_dataloader()  # type: ignore[attr-defined]  # Lightning does not type it
        views = map(trainer.strategy.batch_to_device, loader)  # as training and validation have them
        with module.stopwatch.paused(module.device):
            trainer.validating = True  # for hooks that change photos in training alone
            self._evaluate(trainer, module, iteration, views)
            trainer.training = True
            notify_monitors(trainer, module)

    # The end of the run: before Lightning's own work at the end of its only epoch; where no epoch has ended; and of one
    # that was stopped after its last iteration, and trains no further when it is continued.
    on_train_epoch_end = on_train_end = on_fit_end = _evaluate_once

    @torch.no_grad()
    def _evaluate(self, trainer: Trainer, module: SplatModule, iteration: int, views: Any) -> None:
        phase = module.schedule.phase_at(iteration)
        splats, folder = module.scene.hard_splats(phase), run_folder(trainer)

        def show(image: Tensor, photo: Tensor) -> None:
            if self.pictures and trainer.is_global_zero:
                with optional(folder / "preview.png") as path:
                    pictures.write_png(path, torch.cat([eight_bit(photo), image], dim=1))

        mean_psnr, mean_ssim = numbers.evaluate(
            module.scene.render, splats, views, show, lambda sums: sum_over_processes(trainer, sums)
        )
        entry: Json = {
            "iteration": iteration,
            "phase": phase.name.lower(),
            "splats": len(module.splats),
            "psnr": mean_psnr,
            "ssim": mean_ssim,
            "seconds": module.stopwatch.seconds,
        }
        module.history.append(entry)
        if trainer.is_global_zero:
            with optional(folder / "curve.csv") as path:
                numbers.write_csv(path, module.history)
            with optional(folder / page.NAME):
                page.write_page(folder, module.history, module.schedule)
        values = {f"report/{name}": float(entry[name]) for name in ("psnr", "ssim", "splats")}
        trainer.callback_metrics.update({name: torch.tensor(value) for name, value in values.items()})
        for logger in trainer.loggers:
            logger.log_metrics(values, iteration)

    # In test

    def on_test_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Write the file, read it back, and let the module test the decoded scene; a trial tests the one in memory."""
        self._scene, self._scores = None, list[Json]()
        if is_fast_dev_run(trainer):
            return
        path = run_folder(trainer) / "scene.nsvq"
        if trainer.is_global_zero:
            scene = module.compressed()
            save(scene, path, module.storage)
            self._paper = paper_header(scene)
        trainer.strategy.barrier("scene.nsvq")
        self._scene = read_nsvq(path)
        # Detached tensors, not the module: a submodule would enter checkpoints.
        module.evaluation_splats = module.frame.splats(self._scene.decode().to(module.device))
        self._sampling = module.frame.sampling(self._scene.sampling())
        self._lpips, self._lpips_reason = build_lpips() if self.lpips else (None, "switched off")
        if self._lpips is not None:
            self._lpips.to(module.device)

    def on_test_batch_end(self, trainer: Trainer, module: SplatModule, outputs: Any, batch: View, *args: Any) -> None:
        """Keep the scores of one view and write its picture."""
        splats = module.evaluation_splats
        if self._scene is None or splats is None:
            return
        image, photo = outputs["image"], eight_bit(batch.image)
        lpips = None
        if self._lpips is not None:
            lpips = float(self._lpips(image.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None]))
        corrected = apply_mask(eight_bit(color_corrected(image, photo, batch.mask)), batch.mask)
        score = {"name": batch.name, "psnr": float(outputs["psnr"]), "ssim": float(outputs["ssim"]), "lpips": lpips}
        for name, times in numbers.SMALLER.items():
            small = batch.smaller(min(times, *photo.shape[:2]))
            shown = module.scene.render(splats, small.camera, sampling=self._sampling).image
            score[name] = float(psnr(eight_bit(shown), eight_bit(small.image), small.mask))
        score["cc_psnr"] = float(psnr(corrected, photo, batch.mask))
        score["cc_ssim"] = float(ssim(corrected, photo, batch.mask))
        self._scores.append(score)
        if self.pictures:
            with optional(picture_file(trainer, run_folder(trainer) / "renders", batch.name)) as path:
                pictures.write_png(path, pictures.comparison(image, photo))

    def on_test_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Write the figures."""
        if self._scene is None:
            return
        scores = self._scores
        if trainer.world_size > 1:
            gathered: list[list[Json]] = [[] for _ in range(trainer.world_size)]
            torch.distributed.all_gather_object(gathered, scores)
            scores = [score for part in gathered for score in part]
        scores = sorted(scores, key=lambda score: score["name"])
        if trainer.is_global_zero and scores:
            folder = run_folder(trainer)
            file, reason = folder / "scene.nsvq", self._lpips_reason
            metrics = numbers.summarize(file, self._scene, scores, reason, module, self._paper)
            with optional(folder / "metrics.json") as path:
                numbers.write_metrics(path, metrics)
            with optional(folder / "views.csv") as path:
                numbers.write_csv(path, scores)
            paths = [picture_file(trainer, folder / "renders", score["name"]) for score in scores]
            views = [score | {"picture": path.name} for score, path in zip(scores, paths, strict=True)]
            with optional(folder / page.NAME):
                path = page.write_page(folder, module.history, module.schedule, metrics, views)
                log.info(f"report: {path}")
            if self.pictures:
                pictures.log_pictures(trainer.loggers, [path for path in paths if path.exists()], trainer.global_step)
        self._scene, self._lpips = None, None
