"""The Lightning module: one step of training; what happens at certain steps is left to callbacks."""

import logging
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor, nn

from nsvq_lightning.compute.devices import AsyncScalar, check_can_train, to_device
from nsvq_lightning.compute.jit import check_threads
from nsvq_lightning.data.scene import View
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quality.metrics import eight_bit, psnr
from nsvq_lightning.quantize.attributes import build_quantizers, decoded, noisy_rows
from nsvq_lightning.quantize.straight_through import TrainedStraightThrough
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.rasterize import Render, visible
from nsvq_lightning.splats.splats import RawSplats, Splats, detached
from nsvq_lightning.training import distributed, optim, resume, scene_module
from nsvq_lightning.training.scene_module import Stopwatch
from nsvq_lightning.training.schedule import Phase, Schedule

log = logging.getLogger(__name__)

# A term of the loss ``[]``, from the rendering of a train view and the view.
LossTerm = Callable[[Render, View], Tensor]


class SplatModule(resume.ResumedModule):
    """Trains 3D Gaussian splats and the codebooks that store them (NSVQ-GS).

    A step renders one view and computes the sum of :attr:`loss_terms`. What it renders depends on the phase:

    * warm-up, prune: the raw splats,
    * quantize: the splats that are in view unquantized, each attribute replaced by its noise-substituted quantization
      (paper, section 3.2); outside training their nearest codes,
    * fine-tune: the codebook rows of the frozen codes; the raw quantized attributes get no gradient.

    Phases, density control, codebooks and reports are callbacks (:mod:`nsvq_lightning.callbacks`).

    Args:
        sh_degree: Highest degree of the spherical harmonics, 0 to 3.
        quantizer: Makes the quantizer of an attribute from (number of codes, dimension).
        codebooks: The paper's name for their sizes ("0.5k" to "16k"), codes by attribute (scales, quats, sh0, shN;
            others stay unquantized), or None.
        background: Colour behind the splats; ``auto``: white for NeRF-synthetic scenes, black for others; ``random``
            draws a new one each step and tests on black.
        dssim_weight: Share of 1 - SSIM in the loss; the rest is L1.
        rates: Learning rates.
        backend: Rasterizer, see :func:`nsvq_lightning.render`.
        antialiased: Render with anti-aliasing.
        seed: Seed of every draw of the run except the order of the views.
        storage: Level of the compressed file, and how exactly it stores the scene.
        init_from: Scene file of any format to start from, without its non-finite splats.
        splats: Splats to start from, for use from Python. A fit takes them into the :attr:`frame` of its scene.

    Raises:
        ValueError: A codebook is for an unknown attribute or has no code, or an argument is out of range.
        TypeError: What ``quantizer`` makes does not implement :class:`nsvq_lightning.quantize.codebook.Quantizer`.
    """

    def __init__(
        self,
        sh_degree: int = 3,
        quantizer: Callable[[int, int], nn.Module] = TrainedStraightThrough,
        codebooks: str | dict[str, int] | None = "4k",
        background: Literal["auto", "black", "white", "random"] = "auto",
        dssim_weight: float = 0.2,
        rates: optim.LearningRates = optim.LearningRates(),  # noqa: B008  frozen
        backend: str = "auto",
        antialiased: bool = False,
        seed: int = 0,
        storage: Storage = Storage(),  # noqa: B008  frozen
        init_from: str | None = None,
        splats: Splats | None = None,
    ) -> None:
        super().__init__()
        if background not in ("auto", "black", "white", "random"):
            raise ValueError(f"background must be auto, black, white or random, got {background!r}")
        if not 0.0 <= dssim_weight <= 1.0:
            raise ValueError(f"dssim_weight must be between 0 and 1, got {dssim_weight}")
        self.splats = splats if splats is not None else Splats(sh_degree)
        self.codebooks = nn.ModuleDict(build_quantizers(quantizer, codebooks, self.splats))
        self.quantizer_settings = {
            name: {"quantizer": type(q).__name__, "codes": q.codebook.shape[0]} for name, q in self.quantizers.items()
        }
        self.background: str = background
        self.dssim_weight = dssim_weight
        # A checkpoint stores these two as plain dictionaries.
        self.rates = optim.LearningRates(**rates) if isinstance(rates, Mapping) else rates
        self.storage = Storage.from_dict(storage) if isinstance(storage, Mapping) else storage
        self.backend = backend
        self.antialiased = antialiased
        self.seed = seed
        self.init_from = init_from
        self.save_hyperparameters(ignore=["splats"])
        self.phase = Phase.WARMUP
        self.active_sh_degree = 0 if splats is None else splats.sh_degree
        self.extent = 0.0
        self.frame = Frame()
        self.stopwatch = Stopwatch()
        self.schedule = Schedule()
        self.loss_terms: dict[str, LossTerm] = {"photometric": self._photometric_term}
        """Terms of the loss by name; callbacks add some, or wrap the first."""
        self.pixel_weights: Tensor | None = None
        """Strength ``[H, W]`` of the pixels of the next view, whose rendering then has ``absgrad``, or None."""
        self.splat_budget: int | None = None
        """How many splats the scene is to have in the end; None for as many as density control makes."""
        self.rate_strength = 0.0
        """How strongly codes are chosen by their bits, which a budget in bytes counts on; 0 for the nearest ones."""
        self.stretches: Callable[[Schedule, int, int], list[tuple[float, int]]] | None = None
        """How many splats a run has in which shares of it, from its schedule and how many it has at start and end."""
        self.evaluation_splats = None
        self.history: list[dict[str, Any]] = []
        self._step_factor = 1.0
        self._rate_factors: dict[str, float] = {}
        self.updates = True
        """Whether this iteration is to change anything: False once a loss of this process is not finite."""
        self._late_loss: tuple[str, AsyncScalar] | None = None
        self._micro_batch = 0

    def scale_rate(self, group: str, factor: float) -> None:
        """Multiply the learning rate of a parameter group in the iteration that starts.

        To be called in ``on_train_batch_start``, for every view of the iteration; factors of several callbacks
        multiply.
        """
        self._rate_factors[group] = factor * self._rate_factors.get(group, 1.0)

    def forward(self, camera: Camera, pixel_weights: Tensor | None = None) -> Render:
        """Render what the current phase trains or, outside training, what a file would hold.

        Args:
            camera: Where to look from, in the coordinates of the files.
            pixel_weights: Strength of each pixel ``[H, W]``, see :func:`nsvq_lightning.render`.
        """
        options: dict[str, Any] = {"pixel_weights": pixel_weights}
        if self.training and self.background == "random":
            options["background"] = to_device(torch.rand(3, generator=self._generator("background")), self.device)
        return self.render_splats(self._phase_splats(camera), camera, **options)

    def _phase_splats(self, camera: Camera) -> RawSplats:
        raw, camera = self.splats.raw(), self.frame.camera(camera)
        if self.phase < Phase.QUANTIZE or not self.codebooks:
            return raw
        if self.phase is Phase.QUANTIZE and self.training:
            rows = visible(raw, camera, backend=self.backend)
            return noisy_rows(raw, rows, self.quantizers, lambda name: self._generator("noise", name))
        return decoded(raw, self.quantizers)

    def _generator(self, *salts: str) -> torch.Generator:
        """Generator of one view of this step; quantizers draw a seed from it, so it lives on the CPU.

        It depends on the view's number in the step, not on the process: 2 processes with a view each draw what one
        process with 2 micro-batches draws.
        """
        processes = 1 if self._trainer is None else self._trainer.world_size
        return generator(self.seed, self.global_step, 0, *salts, self._micro_batch * processes + self.global_rank)

    def setup(self, stage: str) -> None:
        """Set the background and the extent of the scene.

        Raises:
            ValueError: The trainer has another precision than ``32-true``, a device without kernels or, for a fit, no
                scene or a strategy that loses replaced parameters.
        """
        check_can_train(self.trainer.strategy.root_device, self.backend)
        if self.trainer.precision != "32-true":
            raise ValueError(
                f"splats train in float32, trainer.precision is {self.trainer.precision}: kernels compute in float32 "
                "whatever it says, and a scaled loss would grow splats needlessly; leave it at 32-true"
            )
        self.evaluation_splats = None  # an interrupted evaluation may have left some
        scene = scene_module.scene_of(self.trainer)
        if scene is not None:
            self.background = scene_module.background_of(scene, self.background)
        if stage == "fit":
            if scene is not None and self.frame == Frame():
                self._enter(scene.frame)
            distributed.check_strategy(self.trainer.strategy)
            check_threads()
            extent = partial(scene_module.extent_of, self.trainer)
            self.extent = self.extent or distributed.on_first_process(self.trainer, extent)

    def _enter(self, frame: Frame) -> None:
        """Take splats that came with the coordinates of the files into the frame that they will be trained in."""
        self.frame = frame
        for tensor, moved in zip(detached(self.splats), frame.splats(self.splats), strict=True):
            tensor.copy_(moved)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One Adam optimiser with a named group for each attribute and codebook; first splats, if there are none."""
        if len(self.splats) == 0:
            splats = distributed.on_first_process(self.trainer, partial(scene_module.first_splats, self))
            self.splats = splats.to(self.device)
            self.active_sh_degree = 0 if self.init_from is None else self.splats.sh_degree
        return optim.build_adam(optim.param_groups(self.splats, self.codebooks, self.rates, self.extent))  # type: ignore[arg-type]

    def on_train_start(self) -> None:
        """Set Adam's numbers of this run, not those of a checkpoint; start measuring the training time."""
        scene_module.check_device(self.device)
        views = self.trainer.world_size * self.trainer.accumulate_grad_batches
        optim.check_groups(self.trainer.optimizers, self.quantizers)
        self._step_factor = optim.adapt_to_views(self.trainer.optimizers[0], self.rates, views)
        self.stopwatch.start()

    def on_train_batch_start(self, batch: View, batch_idx: int) -> None:
        """Set the learning rates of this iteration."""
        self._micro_batch = batch_idx % self.trainer.accumulate_grad_batches
        if self._micro_batch == 0:
            self.updates = True
        end = self.schedule.iteration(self.schedule.position_decay)
        for group in self.trainer.optimizers[0].param_groups:
            rate = optim.group_lr(group["name"], self.rates, self.extent)
            if group["name"] == "means":
                rate = optim.position_lr(self.global_step + 1, self.extent, self.rates, end)
            group["lr"] = self._step_factor * rate * self._rate_factors.pop(group["name"], 1.0)

    def _photometric_term(self, rendered: Render, view: View) -> Tensor:
        """(1 - w)·L1 + w·(1 - SSIM) of picture and photo (paper, section 3.3)."""
        return photometric_loss(rendered.image, view.image, self.dssim_weight, view.mask)

    def training_step(self, batch: View, batch_idx: int) -> dict[str, Any] | None:
        """The sum of the loss terms of one view.

        Returns:
            ``loss``, the attached ``render``, whose ``means2d`` retains its gradient, the ``edits`` count of its
            splats, and ``late_loss``, the loss as a number that can be read without waiting for the backward pass. If
            the loss is not finite, the step will update nothing. A CPU knows at once: then None or, with several
            processes, which run the backward pass together, only the loss. A GPU is asked after the backward pass has
            been launched, so that it never waits.
        """
        edits = self.splats.edits
        rendered = self(batch.camera, self.pixel_weights)
        if rendered.means2d.requires_grad:
            rendered.means2d.retain_grad()
        first, *others = (term(rendered, batch) for term in self.loss_terms.values())
        loss = sum(others, start=first)
        if (self.global_step + 1) % max(1, self.trainer.log_every_n_steps) == 0:  # type: ignore[attr-defined]
            quality = psnr(eight_bit(rendered.image.detach()), eight_bit(batch.image), batch.mask).float()
            values = {"train/loss": loss.detach(), "train/psnr": quality, "train/splats": float(len(self.splats))}
            self.log_dict(values, batch_size=1)  # type: ignore[arg-type]  # a number among tensors
        late_loss = AsyncScalar(loss)
        if not late_loss.is_here:
            self._late_loss = batch.name, late_loss
        elif not self._has_finite_loss(batch.name, late_loss):
            return {"loss": loss} if self.trainer.world_size > 1 else None
        return {"loss": loss, "render": rendered, "edits": edits, "late_loss": late_loss}

    def _has_finite_loss(self, view: str, loss: AsyncScalar) -> bool:
        """Whether the loss of a view is finite; otherwise say so, and let the step update nothing."""
        if math.isfinite(loss.read()):
            return True
        log.warning("step %d: the loss of %s is %s, no update", self.global_step + 1, view, loss.read())
        self.updates = False
        return False

    def on_after_backward(self) -> None:
        """Look at a loss that was still on its way when the backward pass was launched."""
        if self._late_loss is not None:
            self._has_finite_loss(*self._late_loss)
            self._late_loss = None

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Drop the gradients of a step that must not update; with several processes the strategy has done so."""
        if not self.updates:
            optimizer.zero_grad()

    def on_train_end(self) -> None:
        """Stop measuring the training time."""
        self.stopwatch.stop()
