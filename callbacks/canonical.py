"""Bring scales and rotations into a canonical form before codebooks are placed on them."""

from __future__ import annotations

import logging
import math
from typing import Any, Literal, get_args

import torch
from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.compression.covariance_error import form_errors
from nsvq_lightning.compression.pixel_size import scale_floor
from nsvq_lightning.random import derive_seed
from nsvq_lightning.splats.forms import Form, canonical
from nsvq_lightning.training.edit import change_coordinates, raise_scales, trainable_rows
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.train_views import train_cameras

from .latch import LatchedCallback

__all__ = ["CanonicalCovariance"]

log = logging.getLogger(__name__)

Mode = Literal["none", "sign", "full", "auto"]


class CanonicalCovariance(LatchedCallback):
    """After the last iteration before the quantize phase, gives like covariances like scales and rotations.

    ``mode`` gives each one of its 48 equivalent pairs of scale and rotation (:mod:`nsvq_lightning.splats.forms`), so
    that k-means groups them; renderings do not change. The form is not enforced afterwards: rows move continuously and
    keep their codes, while a row that jumped to another equivalent pair would lose its code.

    ``floor`` raises scales too small to be visible to one value, then and throughout the quantize phase, so that no
    codes are spent on distinguishing them (:func:`nsvq_lightning.compression.pixel_size.scale_floor`).

    With 4k codes on 187 k splats, right after k-means for scales and rotations, test PSNR was 30.47 dB with ``none``,
    30.61 dB with ``sign`` and 31.17 dB with ``full``, against 31.64 dB unquantized; ``auto`` chose the last.

    Args:
        mode: ``none`` leaves everything as it is, as in the paper; ``sign`` gives quaternions length 1 and w ≥ 0;
            ``full`` also sorts the axes and takes the smallest rotation; ``auto`` takes the form with the smallest
            covariance error after k-means on a sample of the scene's splats.
        floor: Smallest scale, in pixels of the train views where those see splats close; 0 is none, as in the paper.

    Raises:
        ValueError: An unknown mode, or a negative floor.

    Example:
        >>> from nsvq_lightning.callbacks import CanonicalCovariance, standard
        >>> canonical = CanonicalCovariance(mode="auto", floor=0.25)  # --callbacks.canonical.mode=auto
        >>> [callback.floor for callback in standard(canonical=canonical) if isinstance(callback, CanonicalCovariance)]
        [0.25]
    """

    def __init__(self, mode: Mode = "none", floor: float = 0.0) -> None:
        super().__init__()
        if mode not in get_args(Mode):
            raise ValueError(f"mode must be one of {', '.join(get_args(Mode))}, got {mode!r}")
        if not 0.0 <= floor < math.inf:
            raise ValueError(f"floor is a number of pixels and must be at least 0, got {floor}")
        self.mode = mode
        self.floor = floor
        self._log_floor: float | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit of the same callback."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._log_floor = None

    def state_dict(self) -> dict[str, Any]:
        """The last iteration acted on, and the floor in use."""
        return super().state_dict() | {"log_floor": self._log_floor}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue with the floor that was in use."""
        super().load_state_dict(state_dict)
        self._log_floor = state_dict.get("log_floor")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Act before the first iteration of a run that starts in the quantize phase."""
        super().on_train_start(trainer, pl_module)
        self._act_if_due(trainer, as_host(pl_module))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Act after the last iteration before the quantize phase, so before any callback handles its first one.

        After each iteration of the phase, keep scales from falling below the floor: Adam moves parameters with tiny
        gradients as far as all others.
        """
        host = as_host(pl_module)
        self._act_if_due(trainer, host)
        if self._log_floor is not None and host.schedule.phase_at(trainer.global_step) is Phase.QUANTIZE:
            raise_scales(host.splats, self._log_floor)

    def _act_if_due(self, trainer: Trainer, host: SplatHost) -> None:
        iteration, first = trainer.global_step, host.schedule.first_of(Phase.QUANTIZE)
        quantized = {"scales", "quats"} & set(host.quantizers)
        acts = self.mode != "none" or self.floor > 0
        if not acts or not quantized or first is None or iteration != first - 1:
            return
        if self._latch.first_time(iteration):
            if self.floor and "scales" in quantized:
                self._raise(trainer, host)
            form = self._chosen(trainer, host) if self.mode == "auto" else self.mode
            if form != "none":
                self._apply(trainer, host, form)

    def _chosen(self, trainer: Trainer, host: SplatHost) -> Form:
        """The form with the smallest error over the finite splats; in a tie, the one that changes least."""
        finite, _ = trainable_rows(host.splats)
        scales, quats = host.splats.scales.detach()[finite], host.splats.quats.detach()[finite]
        codes = {name: len(q.codebook) for name, q in host.quantizers.items() if name in ("scales", "quats")}
        errors = form_errors(scales, quats, codes, derive_seed(host.seed, trainer.global_step, "canonical"))
        log.info("covariance error by form: %s", ", ".join(f"{form} {error:.3g}" for form, error in errors.items()))
        form: Form = trainer.strategy.broadcast(min(errors, key=errors.__getitem__))
        return form

    def _raise(self, trainer: Trainer, host: SplatHost) -> None:
        self._log_floor = scale_floor(host.splats.means.detach(), train_cameras(trainer), self.floor)
        if self._log_floor is None:
            log.warning("iteration %d: no train view sees a splat; no scale is raised", trainer.global_step)
            return
        share = float((host.splats.scales < self._log_floor).float().mean())
        raise_scales(host.splats, self._log_floor)
        log.info(
            "iteration %d: raised %.1f %% of all scales to %g pixels, %.3g scene units",
            trainer.global_step,
            100 * share,
            self.floor,
            math.exp(self._log_floor),
        )

    @torch.no_grad()
    def _apply(self, trainer: Trainer, host: SplatHost, form: Form) -> None:
        optimizer, splats = raw_optimizer(trainer), host.splats
        new = canonical(splats.scales.detach(), splats.quats.detach(), form)
        change_coordinates(splats, optimizer, "scales", new.scales, new.scale_maps)
        change_coordinates(splats, optimizer, "quats", new.quats, new.quat_maps)
        log.info("iteration %d: canonical covariances, form %s", trainer.global_step, form)
