"""The Lightning module: splats, codebooks, state, one optimiser; what happens at certain steps is left to callbacks."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any, Literal, Self, cast

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.model_helpers import _restricted_classmethod
from torch import Tensor, nn
from torchmetrics import Metric

from nsvq_lightning.compression.stored import compress
from nsvq_lightning.compute.devices import LateNumber, upload
from nsvq_lightning.compute.environment import threads_spin
from nsvq_lightning.data.scene import ONE_PLACE, Scene, View
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import load
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quality.loss import kept, photometric_loss
from nsvq_lightning.quality.metrics import eight_bit, image_metrics, psnr
from nsvq_lightning.quantize.attributes import attribute_rows, build_quantizers, decoded, noisy_rows
from nsvq_lightning.quantize.base import Quantizer
from nsvq_lightning.quantize.nsvq import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render, render, visible
from nsvq_lightning.skips import is_on
from nsvq_lightning.splats.splats import RawSplats, Splats, SplatTensors, sh_degree_of
from nsvq_lightning.training.edit import finite_splats
from nsvq_lightning.training.optim import (
    LearningRates,
    apply_rates,
    build_adam,
    group_lr,
    param_groups,
    position_lr,
)
from nsvq_lightning.training.resume import (
    QUANTIZER_SETTINGS,
    SCENE,
    PlainCheckpointIO,
    branch_checkpoint,
    can_branch,
    changed_schedule,
    check_continuation,
    check_scene,
    check_settings,
    continued_schedule,
    plain,
    scene_record,
)
from nsvq_lightning.training.scene_access import needed_scene, scene_of
from nsvq_lightning.training.schedule import Phase, Schedule, log_interval
from nsvq_lightning.training.state import RunState, Stopwatch
from nsvq_lightning.version import __version__

__all__ = ["SplatModule"]

log = logging.getLogger(__name__)


class SplatModule(LightningModule):
    """Trains 3D Gaussian splats and the codebooks that store them (NSVQ-GS).

    The module renders what its phase trains and computes the loss; phases, density control, codebooks and reports are
    callbacks (:mod:`nsvq_lightning.callbacks`), which see it as a :class:`~nsvq_lightning.training.host.SplatHost`.

    What a phase renders:

    * warm-up, prune: the raw splats,
    * quantize: the splats that are in view unquantized, each attribute replaced by its noise-substituted quantization
      (paper, section 3.2); outside training their nearest codes,
    * fine-tune: the codebook rows of the frozen codes; the raw quantized attributes get no gradient.

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
        splats: Splats to start from, for use from Python.

    Raises:
        ValueError: A codebook is for an unknown attribute or has no code, or an argument is out of range.
        TypeError: What ``quantizer`` makes does not implement :class:`nsvq_lightning.quantize.base.Quantizer`.
    """

    def __init__(
        self,
        sh_degree: int = 3,
        quantizer: Callable[[int, int], nn.Module] = NSVQ,
        codebooks: str | dict[str, int] | None = "16k",
        background: Literal["auto", "black", "white", "random"] = "auto",
        dssim_weight: float = 0.2,
        rates: LearningRates = LearningRates(),  # noqa: B008  frozen
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
        """Class and number of codes by attribute, as requested; k-means and checkpoints may give fewer codes."""
        self.background: str = background
        self.dssim_weight = dssim_weight
        # A checkpoint stores these two as plain dictionaries.
        self.rates = LearningRates(**rates) if isinstance(rates, Mapping) else rates
        self.storage = Storage.from_dict(storage) if isinstance(storage, Mapping) else storage
        self.backend = backend
        self.antialiased = antialiased
        self.seed = seed
        self.init_from = init_from
        self.save_hyperparameters(ignore=["splats"])
        self.state = RunState()
        self.active_sh_degree = 0 if splats is None else splats.sh_degree
        self.stopwatch = Stopwatch(self.state)
        self.schedule = Schedule()
        self.opacity_weight = 0.0
        self.wants_screen_gradients = False
        self.pixel_map: Tensor | None = None
        self.appearance: Callable[[Tensor, View], Tensor] | None = None
        self.splat_budget: int | None = None
        self.evaluation_splats: SplatTensors | None = None
        self.history: list[dict[str, Any]] = []
        self.view_metrics = image_metrics()
        self._step_rates = self.rates
        self._rate_factors: dict[str, float] = {}
        self._updates = True
        self._late_loss: tuple[str, LateNumber] | None = None
        self._micro_batch = 0

    @_restricted_classmethod
    def load_from_checkpoint(cls, checkpoint_path: Any, *args: Any, **settings: Any) -> Self:
        """Lightning's, which would also import what the checkpoint names; here only the user names what to import.

        Args:
            checkpoint_path: File or address.
            *args: Lightning's arguments.
            **settings: Those by name, and arguments of this class that replace the checkpoint's.

        Raises:
            FormatError: The checkpoint is damaged, or its settings name something that has not been imported.
        """
        stored = (
            PlainCheckpointIO().load_checkpoint(os.fspath(checkpoint_path)).get(cls.CHECKPOINT_HYPER_PARAMS_KEY, {})
        )
        check_settings(checkpoint_path, {name: value for name, value in stored.items() if name not in settings})
        return super().load_from_checkpoint(checkpoint_path, *args, **settings)

    def __setattr__(self, name: str, value: Any) -> None:
        # Lightning writes it before and after each of some thirty hooks of a step; nn.Module would look for a
        # parameter.
        if name == "_current_fx_name":
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

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
        """Whether a trainer is fitting the module now, not evaluating it."""
        return self._trainer is not None and self._trainer.state.fn == "fit"

    @property
    def _scene(self) -> Scene | None:
        """The scene of the trainer's data module; None without one."""
        return None if self._trainer is None else scene_of(self._trainer)

    def rows(self, attribute: str) -> Tensor:
        """Rows ``[N, D]`` of a quantized attribute, detached."""
        return attribute_rows(self.splats.raw(), attribute)

    @torch.no_grad()
    def hard_splats(self, phase: Phase) -> RawSplats:
        """The splats as a file written in ``phase`` would hold them, detached: hard codes from ``QUANTIZE`` on."""
        raw = RawSplats(*(tensor.detach() for tensor in self.splats.raw()))
        return decoded(raw, self.quantizers) if phase >= Phase.QUANTIZE else raw

    def scale_rate(self, group: str, factor: float) -> None:
        """Multiply the learning rate of a parameter group in the iteration that starts."""
        self._rate_factors[group] = factor * self._rate_factors.get(group, 1.0)

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
        return replace(scene, config=self._settings(quantizers))  # PostHoc fits its codebooks while the scene is stored

    def forward(self, camera: Camera, observe: Tensor | None = None) -> Render:
        """Render what the current phase trains or, outside training, what a file would hold.

        Args:
            camera: Where to look from.
            observe: Strength of each pixel ``[H, W]``, see :func:`nsvq_lightning.render`.
        """
        background = self._random_background() if self.training and self.background == "random" else self._background()
        return self._render(self._phase_splats(camera), camera, background, observe)

    def _render(
        self, splats: SplatTensors, camera: Camera, background: Tensor | None, observe: Tensor | None = None
    ) -> Render:
        degree = min(self.active_sh_degree, sh_degree_of(splats.shN))
        return render(
            splats,
            camera,
            sh_degree=degree,
            background=background,
            observe=observe,
            antialiased=self.antialiased,
            backend=self.backend,
        )

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
        return upload(torch.rand(3, generator=self._generator("background")), self.device)

    def _generator(self, *salts: str) -> torch.Generator:
        """Generator of one view of this step; quantizers draw a seed from it, so it lives on the CPU.

        It depends on the view's number in the step, not on the process: 2 processes with a view each draw what one
        process with 2 micro-batches draws. Number 0 keeps the draws of older runs.
        """
        processes = 1 if self._trainer is None else self._trainer.world_size
        return generator(self.seed, self.global_step, 0, *salts, self._micro_batch * processes + self.global_rank)

    def _settings(self, quantizers: Mapping[str, Quantizer]) -> dict[str, Any]:
        """What the file stores about the run: nothing that differs between two runs with the same seed."""
        sizes = {name: int(q.codebook.shape[0]) for name, q in quantizers.items()}
        quantizer = {name: type(q).__name__ for name, q in quantizers.items()}
        return {
            "version": __version__,
            "codebooks": sizes,
            "quantizers": quantizer,
            "phase_ends": list(self.schedule.ends),
            "rates": asdict(self.rates),
            "background": self.background,
            **({"antialiased": True} if self.antialiased else {}),
            "dssim_weight": self.dssim_weight,
            "extent": self.extent,
            "seed": self.seed,
        }

    def setup(self, stage: str) -> None:
        """Fill empty splats from ``init_from`` or the scene's points, and set the extent of the scene.

        Raises:
            ValueError: There is nothing to start from, or the trainer has another precision than ``32-true``.
        """
        if self.trainer.precision != "32-true":
            raise ValueError(
                f"splats train in float32, trainer.precision is {self.trainer.precision}: kernels compute in float32 "
                "whatever it says, and a scaled loss would grow splats needlessly; leave it at 32-true"
            )
        # An interrupted evaluation may have left its splats.
        self.evaluation_splats = None
        scene = scene_of(self.trainer)
        if scene is not None:
            self._take_background(scene)
        if stage != "fit":
            return
        if scene is not None and self.extent == 0.0:
            self.state.extent = scene.extent
        if len(self.splats) == 0:
            self.splats = self._first_splats().to(self.device)
        if self.extent <= 0.0 and scene is not None:
            raise ValueError(f"the {len(scene.train)} train photos of {scene.root} {ONE_PLACE}")
        if self.extent <= 0.0:
            raise ValueError("the extent of the scene is unknown; fit with a data module that has a scene")

    def _take_background(self, scene: Scene) -> None:
        """Render over what the photos have behind their objects.

        Raises:
            ValueError: It was asked for another background.
        """
        if self.background == "auto":
            self.background = "white" if scene.white else "black"
        if scene.white and self.background != "white":
            raise ValueError(
                f"the photos of {scene.root} are transparent around their objects and are shown on white, "
                f"model.background is {self.background}: leave it at auto"
            )

    def _first_splats(self) -> Splats:
        if self.init_from is not None:
            loaded = load(self.init_from)
            if loaded.sh_degree != self.splats.sh_degree:
                raise ValueError(
                    f"{self.init_from} has SH degree {loaded.sh_degree}, the module has {self.splats.sh_degree}; "
                    f"set sh_degree={loaded.sh_degree}"
                )
            self.active_sh_degree = loaded.sh_degree
            return finite_splats(loaded, self.init_from)
        scene = needed_scene(self.trainer, "no splats to start from", "set init_from")
        return Splats.from_points(scene.points, scene.colors, self.splats.sh_degree)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One Adam optimiser with one named group for each attribute and codebook."""
        return build_adam(param_groups(self.splats, self.codebooks, self.rates, self.extent))  # type: ignore[arg-type]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add history, schedule, quantizers and scene; plain data only, so that ``weights_only=True`` can read it."""
        checkpoint["history"] = self.history
        checkpoint[QUANTIZER_SETTINGS] = self.quantizer_settings
        checkpoint["schedule"] = asdict(self.schedule)
        if self._scene is not None:
            checkpoint[SCENE] = scene_record(self._scene)
        stored = checkpoint.get(self.CHECKPOINT_HYPER_PARAMS_KEY)
        if stored is not None:
            # Without the photos nobody knows what "auto" was.
            checkpoint[self.CHECKPOINT_HYPER_PARAMS_KEY] = plain(stored) | {"background": self.background}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore history and schedule; a fit keeps its own schedule, and may continue with other codebooks.

        Raises:
            ValueError: A fit cannot continue from the checkpoint, or it is of another scene than the trainer's, which
                ``allow_other_scene`` of :class:`nsvq_lightning.training.trainer.SplatTrainer` lets pass.
        """
        scene, anyway = self._scene, getattr(self._trainer, "allow_other_scene", False)
        if scene is not None and SCENE in checkpoint and not anyway:
            check_scene(checkpoint, scene)
        self.history = list(checkpoint.get("history", []))
        if not self.is_fitting:
            if "schedule" in checkpoint:
                self.schedule = Schedule(**checkpoint["schedule"])
            return
        if "schedule" in checkpoint:
            self.schedule = continued_schedule(checkpoint, self.schedule)
            if (change := changed_schedule(checkpoint, self.schedule)) is not None:
                log.warning(change)
        if can_branch(checkpoint, self.codebooks):
            branch_checkpoint(checkpoint, self.codebooks, self.configure_optimizers())
        check_continuation(checkpoint, self.state_dict(), self.quantizer_settings)

    def on_fit_start(self) -> None:
        """Warn about what the user should know of this device."""
        if self.device.type == "cuda":
            log.warning(
                "training on %s with kernels that are tested under Triton's interpreter, but have never run on a GPU: "
                "--trainer.accelerator=cpu trains without them, and docs/backends.md says more",
                torch.cuda.get_device_name(self.device),
            )
        elif threads_spin() and torch.get_num_threads() > 1 and hasattr(os, "getloadavg") and os.getloadavg()[0] > 1.0:
            log.warning(
                "other processes also need the cores, and idle threads occupy them: a run may take twice as long; "
                "import nsvq_lightning before torch, or set OMP_WAIT_POLICY=passive"
            )

    def on_train_start(self) -> None:
        """Set the learning rates of this run, not those of a checkpoint; start measuring the training time."""
        views = self.trainer.world_size * self.trainer.accumulate_grad_batches
        apply_rates(self.trainer.optimizers[0], self.rates, self.extent, views)
        self._step_rates = self.rates.of_step(views)
        self.stopwatch.start()

    def on_train_batch_start(self, batch: View, batch_idx: int) -> None:
        """Set the learning rates of this iteration."""
        self._micro_batch = batch_idx % self.trainer.accumulate_grad_batches
        if self._micro_batch == 0:
            self._updates = True
        position = position_lr(self.global_step + 1, self.extent, self._step_rates, self.schedule.position_decay_end)
        for group in self.trainer.optimizers[0].param_groups:
            name = group["name"]
            rate = position if name == "means" else group_lr(name, self._step_rates, self.extent)
            group["lr"] = rate * self._rate_factors.pop(name, 1.0)

    def training_step(self, batch: View, batch_idx: int) -> dict[str, Any] | None:
        """Loss of one view: (1 - w)·L1 + w·(1 - SSIM) + λ·Σ opacity (paper, section 3.3).

        Returns:
            ``loss``, the attached ``render``, the ``edits`` count of its splats, and ``late_loss``, the loss as a
            number that can be read without waiting for the backward pass. If the loss is not finite, the step will
            update nothing. A CPU knows at once: then None or, with several processes, which run the backward pass
            together, only the loss. A GPU is asked after the backward pass has been launched, so that it never waits.
        """
        edits = self.splats.edits
        rendered = self(batch.camera, self.pixel_map)
        if self.wants_screen_gradients:
            rendered.means2d.retain_grad()
        image = rendered.image if self.appearance is None else self.appearance(rendered.image, batch)
        loss = photometric_loss(image, batch.image, self.dssim_weight, batch.mask)
        if self.opacity_weight:
            loss = loss + self.opacity_weight * self.splats.opacities.sigmoid().sum()
        if (self.global_step + 1) % log_interval(self.trainer) == 0 or not is_on("metrics"):
            self._log_step(loss, image, batch)
        late_loss = LateNumber(loss)
        if not late_loss.is_here:
            self._late_loss = batch.name, late_loss
        elif not self._has_finite_loss(batch.name, late_loss):
            return {"loss": loss} if self.trainer.world_size > 1 else None
        return {"loss": loss, "render": rendered, "edits": edits, "late_loss": late_loss}

    def _has_finite_loss(self, view: str, loss: LateNumber) -> bool:
        """Whether the loss of a view is finite; otherwise say so, and let the step update nothing."""
        if math.isfinite(loss.read()):
            return True
        log.warning("step %d: the loss of %s is %s, no update", self.global_step + 1, view, loss.read())
        self._updates = False
        return False

    def on_after_backward(self) -> None:
        """Look at a loss whose number was still on its way when the backward pass was launched."""
        if self._late_loss is not None:
            self._has_finite_loss(*self._late_loss)
            self._late_loss = None

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Drop the gradients of a step that must not update; with several processes the strategy has done so."""
        if not self._updates:
            optimizer.zero_grad()

    def _log_step(self, loss: Tensor, image: Tensor, view: View) -> None:
        quality = psnr(eight_bit(image.detach()), eight_bit(view.image), view.mask).float()
        values: dict[str, Metric | Tensor | int | float] = {
            "train/loss": loss.detach(),
            "train/psnr": quality,
            "train/splats": float(len(self.splats)),
        }
        self.log_dict(values, batch_size=1)

    def on_train_batch_end(self, outputs: Any, batch: View, batch_idx: int) -> None:
        """Add the time of this step."""
        self.stopwatch.lap()

    def on_train_end(self) -> None:
        """Stop measuring the training time."""
        self.stopwatch.stop()

    def _evaluation_start(self) -> None:
        if len(self.splats) == 0:
            raise ValueError("there are no splats to render: pass the checkpoint of a run (--ckpt_path)")
        if self.evaluation_splats is None:
            self.evaluation_splats = self.hard_splats(self.phase)

    def _evaluation_end(self) -> None:
        self.evaluation_splats = None

    on_validation_start = on_test_start = on_predict_start = _evaluation_start
    on_validation_end = on_test_end = on_predict_end = _evaluation_end

    def _evaluation_step(self, view: View, prefix: str) -> dict[str, Any]:
        image = kept(self._evaluation_image(view.camera), view.mask)
        scores = self.view_metrics(image, view.image, view.mask)
        self.log_dict({f"{prefix}/{name}": metric for name, metric in self.view_metrics.items()}, batch_size=1)
        return {"image": image, **scores}

    def _evaluation_image(self, camera: Camera) -> Tensor:
        if self.evaluation_splats is None:
            raise RuntimeError("evaluation steps run only inside Trainer.validate, test or predict")
        return eight_bit(self.render_splats(self.evaluation_splats, camera).image)

    def validation_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Score one view: ``image [H, W, 3]`` (8-bit values in [0, 1]), ``psnr``, ``ssim``."""
        return self._evaluation_step(batch, "val")

    def test_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Score one view: ``image [H, W, 3]`` (8-bit values in [0, 1]), ``psnr``, ``ssim``."""
        return self._evaluation_step(batch, "test")

    def predict_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Render one view: ``name`` and ``image [H, W, 3]`` (8-bit values in [0, 1])."""
        return {"name": batch.name, "image": self._evaluation_image(batch.camera)}
