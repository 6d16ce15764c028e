"""The scene that is trained: splats, codebooks and state; what each phase renders, and what is stored."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from nsvq_lightning import __version__
from nsvq_lightning.compression.stored import compress
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quantize.base import Quantizer
from nsvq_lightning.quantize.scene import attribute_rows, build_quantizers, decoded, noisy_rows
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render, render, visible
from nsvq_lightning.skips import is_on
from nsvq_lightning.splats.splats import RawSplats, Splats, SplatTensors, sh_degree_of
from nsvq_lightning.training.branch import QUANTIZER_SETTINGS, changed_schedule
from nsvq_lightning.training.hyperparameters import plain
from nsvq_lightning.training.optim import LearningRates
from nsvq_lightning.training.schedule import Phase, Schedule
from nsvq_lightning.training.state import RunState, Stopwatch

__all__ = ["SplatModel"]

log = logging.getLogger(__name__)


class SplatModel(LightningModule):
    """Base of :class:`nsvq_lightning.SplatModule`: the part that callbacks see as a ``SplatHost``.

    What a phase renders:

    * warm-up, prune: the raw splats,
    * quantize: the splats that are in view unquantized, each attribute replaced by its noise-substituted quantization
      (paper, section 3.2); outside training their nearest codes,
    * fine-tune: codebook rows by frozen codes; the raw quantized attributes get no gradient.

    Args:
        splats: The splats; empty ones are filled when a fit starts.
        quantizer: Makes the quantizer of an attribute from (number of codes, dimension).
        codebooks: The paper's name of the codebook sizes, or number of codes by attribute, or None.
        background: ``black``, ``white`` or ``random``.
        dssim_weight: Share of 1 - SSIM in the loss.
        rates: Learning rates.
        backend: Rasterizer.
        seed: Seed of every draw.
        storage: How the scene is stored.

    Raises:
        ValueError: An argument is out of range.
        TypeError: What ``quantizer`` makes is no quantizer.
    """

    def __init__(
        self,
        splats: Splats,
        quantizer: Callable[[int, int], nn.Module],
        codebooks: str | Mapping[str, int] | None,
        background: str,
        dssim_weight: float,
        rates: LearningRates,
        backend: str,
        seed: int,
        storage: Storage,
    ) -> None:
        super().__init__()
        if background not in ("black", "white", "random"):
            raise ValueError(f"background must be black, white or random, got {background!r}")
        if not 0.0 <= dssim_weight <= 1.0:
            raise ValueError(f"dssim_weight must be between 0 and 1, got {dssim_weight}")
        self.background = background
        self.dssim_weight = dssim_weight
        self.rates = rates
        self.backend = backend
        self.seed = seed
        self.storage = storage
        self.splats = splats
        self.codebooks = nn.ModuleDict(build_quantizers(quantizer, codebooks, splats))
        self.quantizer_settings = {
            name: {"quantizer": type(q).__name__, "codes": q.codebook.shape[0]} for name, q in self.quantizers.items()
        }
        """Class and number of codes by attribute, as asked for; k-means and checkpoints may bring fewer codes."""
        self.state = RunState()
        self.stopwatch = Stopwatch(self.state)
        self.schedule = Schedule()
        self.opacity_weight = 0.0
        self.wants_screen_gradients = False
        self.evaluation_splats: SplatTensors | None = None
        self.history: list[dict[str, Any]] = []
        self._micro_batch = 0

    @property
    def quantizers(self) -> Mapping[str, Quantizer]:
        """Quantizer by attribute."""
        return cast("Mapping[str, Quantizer]", dict(self.codebooks.items()))

    @property
    def phase(self) -> Phase:
        """Phase of the current iteration."""
        return self.state.phase

    @phase.setter
    def phase(self, value: Phase) -> None:
        self.state.phase = value

    @property
    def active_sh_degree(self) -> int:
        """SH degree that is rendered."""
        return self.state.sh_degree

    @active_sh_degree.setter
    def active_sh_degree(self, value: int) -> None:
        self.state.sh_degree = value

    @property
    def extent(self) -> float:
        """Extent of the scene, scene units."""
        return self.state.extent

    @property
    def train_seconds(self) -> float:
        """Seconds spent training so far, evaluations left out."""
        return self.state.train_seconds

    @property
    def is_fitting(self) -> bool:
        """Whether a trainer fits the module now, not evaluates it."""
        return self._trainer is not None and self._trainer.state.fn == "fit"

    def rows(self, attribute: str) -> Tensor:
        """Rows ``[N, D]`` of a quantized attribute, detached."""
        return attribute_rows(self.splats.raw(), attribute)

    @torch.no_grad()
    def hard_splats(self, phase: Phase) -> RawSplats:
        """The splats as a file written in ``phase`` would hold them, detached: nearest codes from ``QUANTIZE`` on."""
        raw = RawSplats(*(tensor.detach() for tensor in self.splats.raw()))
        return decoded(raw, self.quantizers) if phase >= Phase.QUANTIZE else raw

    def render_splats(self, splats: SplatTensors, camera: Camera) -> Render:
        """Render any splats at the active SH degree, over the module's background (``random``: black)."""
        return self._render(splats, camera, self._background())

    def compressed(self) -> CompressedScene:
        """The scene as it is stored: frozen or nearest codes, codebooks, positions, opacities and the settings.

        Before the quantize phase there are no codebooks yet, and everything is stored as it is.

        Raises:
            ValueError: There are no splats.
        """
        if len(self.splats) == 0:
            raise ValueError("there are no splats to store or to measure: pass the checkpoint of a run (--ckpt_path)")
        quantizers = self.quantizers if self.phase >= Phase.QUANTIZE else {}
        if self.quantizers and not quantizers:
            log.warning("the %s phase has no codebooks yet: the scene is stored unquantized", self.phase.name.lower())
        scene = compress(self.splats.raw(), quantizers)
        return replace(scene, config=self._settings(quantizers))  # PostHoc places its codebooks while they are stored

    def forward(self, camera: Camera) -> Render:
        """Render what the current phase trains, or outside training what a file would hold."""
        background = self._random_background() if self.training and self.background == "random" else self._background()
        return self._render(self._phase_splats(camera), camera, background)

    def _render(self, splats: SplatTensors, camera: Camera, background: Tensor | None) -> Render:
        degree = min(self.active_sh_degree, sh_degree_of(splats.shN))
        return render(splats, camera, sh_degree=degree, background=background, backend=self.backend)

    def _phase_splats(self, camera: Camera) -> RawSplats:
        raw = self.splats.raw()
        if self.phase < Phase.QUANTIZE or not self.codebooks:
            return raw
        if self.phase is Phase.QUANTIZE and self.training:
            return noisy_rows(
                raw, self._visible_rows(raw, camera), self.quantizers, lambda name: self._generator("noise", name)
            )
        return decoded(raw, self.quantizers)

    @torch.no_grad()
    def _visible_rows(self, raw: RawSplats, camera: Camera) -> Tensor:
        """Rows of the splats that can change the image, ascending."""
        if is_on("first_render"):
            return visible(raw, camera, backend=self.backend)
        return self._render(raw, camera, None).radii.nonzero()[:, 0]

    def _background(self) -> Tensor | None:
        return torch.ones(3, device=self.device) if self.background == "white" else None

    def _random_background(self) -> Tensor:
        return torch.rand(3, generator=self._generator("background")).to(self.device)

    def _generator(self, *salts: str) -> torch.Generator:
        """Generator of one view of this step; quantizers draw a seed from it, so it lives on the CPU.

        The view's number in the step decides, not who renders it: 2 processes with a view each draw what one process
        with 2 micro-batches draws. The 0 keeps the draws of runs from before that.
        """
        processes = 1 if self._trainer is None else self._trainer.world_size
        return generator(self.seed, self.global_step, 0, *salts, self._micro_batch * processes + self.global_rank)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add history, schedule and quantizers; plain data only, so that ``weights_only=True`` can read it."""
        checkpoint["history"] = self.history
        checkpoint[QUANTIZER_SETTINGS] = self.quantizer_settings
        checkpoint["schedule"] = asdict(self.schedule)
        stored = checkpoint.get(self.CHECKPOINT_HYPER_PARAMS_KEY)
        if stored is not None:
            checkpoint[self.CHECKPOINT_HYPER_PARAMS_KEY] = plain(stored)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take over history, and outside a fit (which has its own) the schedule."""
        self.history = list(checkpoint.get("history", []))
        if "schedule" not in checkpoint:
            return
        if not self.is_fitting:
            self.schedule = Schedule(**checkpoint["schedule"])
        elif (change := changed_schedule(checkpoint, self.schedule)) is not None:
            log.warning(change)

    def _settings(self, quantizers: Mapping[str, Quantizer]) -> dict[str, Any]:
        """What is stored in the file about the run: nothing that differs between two runs of one seed."""
        sizes = {name: int(q.codebook.shape[0]) for name, q in quantizers.items()}
        quantizer = {name: type(q).__name__ for name, q in quantizers.items()}
        return {
            "version": __version__,
            "codebooks": sizes,
            "quantizers": quantizer,
            "phase_ends": list(self.schedule.ends),
            "rates": asdict(self.rates),
            "background": self.background,
            "dssim_weight": self.dssim_weight,
            "extent": self.extent,
            "seed": self.seed,
        }
