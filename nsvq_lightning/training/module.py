"""The Lightning module: one step of training; what happens at certain steps is left to callbacks."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any, Literal, Self

import numpy as np
import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.callbacks import ModelPruning, StochasticWeightAveraging, WeightAveraging
from lightning.pytorch.utilities.model_helpers import _restricted_classmethod
from torch import Generator, Tensor, nn

from nsvq_lightning.compute.devices import AsyncScalar, check_can_train, to_device
from nsvq_lightning.compute.jit import check_threads
from nsvq_lightning.data.scene import View
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import Json
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quality.loss import apply_mask, photometric_loss, ssim
from nsvq_lightning.quality.metrics import eight_bit, psnr
from nsvq_lightning.quantize.attributes import build_quantizers, decoded, noisy_rows
from nsvq_lightning.quantize.codebook import Quantizer
from nsvq_lightning.quantize.straight_through import TrainedStraightThrough
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.rasterize import Render, visible
from nsvq_lightning.rendering.sampling import trained_by
from nsvq_lightning.splats.splats import Splats, SplatTensors, detached
from nsvq_lightning.top_level import log
from nsvq_lightning.training import distributed, optim, resume, run_scene
from nsvq_lightning.training.schedule import Phase, Schedule
from nsvq_lightning.training.self_check import check_device
from nsvq_lightning.training.splat_scene import SplatScene
from nsvq_lightning.training.stopwatch import Stopwatch

# A term of the loss ``[]``, from the rendering of a train view and the view, whose photo is uint8.
LossTerm = Callable[[Render, View], Tensor]

# What may be behind the splats.
BACKGROUNDS = "auto", "black", "white", "random"


class SplatModule(LightningModule):
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
        psnr_loss: Train for PSNR instead of L1 from the prune phase on, when splats no longer grow.
        rates: Learning rates.
        backend: Rasterizer, see :func:`nsvq_lightning.render`.
        antialiased: Render with anti-aliasing.
        seed: Seed of every draw of the run except the order of the views.
        storage: Level of the compressed file, and how exactly it stores the scene.
        init_from: Scene file of any format to start from, without its non-finite splats.
        splats: Splats to start from, for use from Python, which are copied. A fit takes them into the :attr:`frame` of
            its scene.

    Attributes:
        splats: The splats, in :attr:`frame`; rows are edited only through :mod:`nsvq_lightning.training.row_ops`.
        quantizer_settings: Class and number of codes of each quantizer by attribute, as requested; k-means may give
            fewer codes.
        frame: Coordinates of the splats; the module is given cameras, and makes files, in those of the files.
        cameras: Of training ``[C, 4]``, as files keep them (:func:`nsvq_lightning.rendering.sampling.trained_by`).
        extent: Of the cameras, in units of the frame; 0 while unknown.
        schedule: Phases and milestones of the run.
        phase: Phase of the current iteration.
        active_sh_degree: SH degree that is rendered; higher coefficients are ignored.
        history: Evaluations so far, one plain dictionary each; checkpoints carry it.
        stopwatch: Time spent training.
        loss_terms: Terms of the loss by name; callbacks add some, or wrap the first.
        pixel_weights: Strength ``[H, W]`` of the pixels of the next view, whose rendering then has ``absgrad``, or
            None.
        splat_budget: How many splats the scene is to have in the end; None for as many as density control makes.
        first_points: How many points of SfM and of flow the first splats are made from; None for those of SfM, as in
            3DGS.
        rate_strength: How strongly codes are chosen by their bits, which a budget in bytes counts on; 0 for the nearest
            ones.
        values_per_splat: Most numbers of a codebook for each splat, which it counts on, too.
        stretches: How many splats a run has in which shares of it, from its schedule and how many it has at start and
            end.
        evaluation_splats: What validation, test and prediction render instead of the module's own splats, in
            :attr:`frame`.
        updates: Whether this iteration is to change anything: False once a loss of this process is not finite.

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
        psnr_loss: bool = True,
        rates: optim.LearningRates = optim.LearningRates(),  # noqa: B008  frozen
        backend: str = "auto",
        antialiased: bool = False,
        seed: int = 0,
        storage: Storage = Storage(),  # noqa: B008  frozen
        init_from: str | None = None,
        splats: SplatTensors | None = None,
    ) -> None:
        super().__init__()
        if background not in BACKGROUNDS:
            raise ValueError(f"background must be auto, black, white or random, got {background!r}")
        if not 0.0 <= dssim_weight <= 1.0:
            raise ValueError(f"dssim_weight must be between 0 and 1, got {dssim_weight}")
        self.splats = Splats(sh_degree) if splats is None else Splats.from_tensors(*map(Tensor.float, detached(splats)))
        sh_degree = self.splats.sh_degree  # what a checkpoint says of splats that were given
        self.codebooks = nn.ModuleDict(build_quantizers(quantizer, codebooks, self.splats))
        self.quantizer_settings = {
            name: {"quantizer": type(made).__name__, "codes": len(made.codebook)}
            for name, made in self.quantizers.items()
        }
        self.background: str = background
        self.dssim_weight = dssim_weight
        self.psnr_loss = psnr_loss
        # A checkpoint stores these two as plain dictionaries.
        self.rates = optim.LearningRates(**rates) if isinstance(rates, Mapping) else rates
        self.storage = Storage.of(storage)
        self.backend = backend
        self.antialiased = antialiased
        self.seed = seed = int(seed)
        self.init_from = init_from
        self.save_hyperparameters(ignore=["splats"])
        self.frame = Frame()
        self.cameras = np.zeros((0, 4))
        self.extent = 0.0
        self.schedule = Schedule()
        self.phase = Phase.WARMUP
        self.active_sh_degree = 0 if splats is None else self.splats.sh_degree
        self.history: list[Json] = []
        self.stopwatch = Stopwatch()
        self.loss_terms: dict[str, LossTerm] = {"photometric": partial(_photometric_term, self)}
        self.pixel_weights: Tensor | None = None
        self.splat_budget: int | None = None
        self.first_points: int | None = None
        self.rate_strength = 0.0
        self.values_per_splat = math.inf
        self.stretches: Callable[[Schedule, int, int], list[tuple[float, int]]] | None = None
        self.evaluation_splats: SplatTensors | None = None
        self.updates = True
        self._rate_factors: dict[str, float] = {}
        self._late_losses: list[tuple[str, AsyncScalar]] = []
        self._view_of_step = 0

    @property
    def quantizers(self) -> Mapping[str, Quantizer]:
        """Quantizer by attribute; empty for a run without quantization."""
        return dict(self.codebooks.items())  # type: ignore[arg-type]

    @property
    def scene(self) -> SplatScene:
        """What is trained, as it is now: renders any splats, and gives the rows that codebooks are placed on."""
        how = self.active_sh_degree, self.background, self.antialiased, self.backend
        return SplatScene(self.splats, self.quantizers, self.frame, *how, self.cameras)

    def compressed(self) -> CompressedScene:
        """The scene as it is stored, in the coordinates of its files (:meth:`SplatScene.compressed`).

        Raises:
            ValueError: There are no splats.
        """
        # Nothing that differs between two runs with the same seed.
        settings = {
            "phase_ends": list(self.schedule.ends),
            "rates": asdict(self.rates),
            "dssim_weight": self.dssim_weight,
            "extent": self.extent * self.frame.unit,
            "seed": self.seed,
        }
        return self.scene.compressed(self.phase, settings)

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

        def draws(*salts: str) -> Generator:
            # It lives on the CPU: quantizers draw a seed from it. The 0 is a salt of before, which bits depend on.
            return generator(self.seed, self.global_step, 0, *salts, self._view_of_step)

        splats, quantizers = self.splats.raw(), self.quantizers
        if self.phase is Phase.QUANTIZE and self.training and quantizers:
            rows = visible(splats, self.frame.camera(camera), backend=self.backend)
            splats = noisy_rows(splats, rows, quantizers, lambda name: draws("noise", name))
        elif self.phase >= Phase.QUANTIZE:
            splats = decoded(splats, quantizers)
        options = {"pixel_weights": pixel_weights}
        if self.background == "random" and self.training:
            options["background"] = to_device(torch.rand(3, generator=draws("background")), self.device)
        return self.scene.render(splats, camera, **options)

    def setup(self, stage: str) -> None:
        """Refuse a trainer that cannot train splats; take background and, for a fit, cameras, frame and extent.

        Splats that were given move into the frame, in place.

        Raises:
            ValueError: The trainer has another precision than ``32-true``, a device without kernels or, for a fit, no
                scene or a strategy that loses replaced parameters.
        """
        check_can_train(self.trainer.strategy.root_device, self.backend)
        if self.trainer.precision != "32-true" or self.dtype != torch.float32:
            raise ValueError(
                "splats train in float32, and kernels compute in it whatever trainer.precision says; a scaled loss "
                "would grow splats needlessly: leave it at 32-true, and the module as it is made"
            )
        for callback in self.trainer.callbacks:  # type: ignore[attr-defined]  # Lightning does not type it
            if isinstance(callback, StochasticWeightAveraging | WeightAveraging | ModelPruning):
                name, does = type(callback).__name__, "masks" if isinstance(callback, ModelPruning) else "averages"
                raise ValueError(f"{name} {does} parameters, but splats come and go: leave it out")
        self.evaluation_splats = self.pixel_weights = None  # an interrupted evaluation or fit may have left some
        scene = run_scene.scene_of(self.trainer)
        if scene is not None:
            self.background = run_scene.background_of(scene, self.background)
        if stage != "fit":
            return
        if scene is not None:
            self.cameras = trained_by(scene.train_cameras)
            if self.frame == Frame():
                self.frame = scene.frame
                # Splats that were given came with the coordinates of the files.
                for tensor, moved in zip(detached(self.splats), self.frame.splats(self.splats), strict=True):
                    tensor.copy_(moved)
        distributed.check_strategy(self.trainer.strategy)
        check_threads()
        if not self.extent:
            self.extent = run_scene.extent_of(self.trainer)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One Adam optimiser with a named group for each attribute and codebook; first splats, if there are none."""
        own = self.init_from is None and (len(self.splats) == 0 or self.trainer.ckpt_path is not None)
        if len(self.splats) == 0:
            degree = self.splats.sh_degree
            if self.init_from is None:
                make = partial(run_scene.first_splats, self.trainer, degree, self.first_points, self.seed)
                self.active_sh_degree = 0
            else:
                make = partial(run_scene.splats_of_file, self.init_from, self.scene)
                self.active_sh_degree = degree
            self.splats = distributed.on_first_process(self.trainer, make).to(self.device)
        run_scene.warn_of_others(self.trainer, self.splats, own)
        optimizer = optim.build_adam(optim.param_groups(self.splats, self.codebooks, self.rates, self.extent))  # type: ignore[arg-type]
        if self.rates.by_distance:
            run_scene.move_by_distance(self.trainer, optimizer, self.splats, self.extent)
        return optimizer

    def on_train_start(self) -> None:
        """Set Adam's numbers of this run, not those of a checkpoint; start measuring the training time."""
        check_device(self.device)
        self.train()  # quantizers, whatever was rendered before
        self.splats.edits += 1  # they are the caller's no more
        views = self.trainer.world_size * self.trainer.accumulate_grad_batches
        optim.check_groups(self.trainer.optimizers, self.quantizers)
        self._step_factor = optim.adapt_to_views(self.trainer.optimizers[0], self.rates, views)
        self.stopwatch.start()

    def on_train_batch_start(self, batch: View, batch_idx: int) -> None:
        """Set the learning rates of this iteration."""
        micro_batch = batch_idx % self.trainer.accumulate_grad_batches
        if micro_batch == 0:
            self.updates = True
        # 2 processes with a view each draw what one process with 2 micro-batches draws.
        self._view_of_step = micro_batch * self.trainer.world_size + self.global_rank
        end = self.schedule.iteration(self.schedule.position_decay)
        for group in self.trainer.optimizers[0].param_groups:
            rate = optim.group_lr(group["name"], self.rates, self.extent)
            if group["name"] == "means":
                rate = optim.position_lr(self.global_step + 1, self.extent, self.rates, end)
            group["lr"] = self._step_factor * rate * self._rate_factors.pop(group["name"], 1.0)

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
            values = {"train/loss": loss.detach(), "train/psnr": quality, "train/splats": len(self.splats)}
            self.log_dict(values, batch_size=1)  # type: ignore[arg-type]  # a number among tensors
        late_loss = AsyncScalar(loss)
        if not late_loss.is_here:
            self._late_losses.append((batch.name, late_loss))
        elif not _is_finite(late_loss, batch.name, self.global_step):
            self.updates = False
            self.zero_grad()
            return {"loss": loss} if self.trainer.world_size > 1 else None
        return {"loss": loss, "render": rendered, "edits": edits, "late_loss": late_loss}

    def on_after_backward(self) -> None:
        """Look at a loss that was still on its way; of a step that must not update, drop the gradients."""
        for view, loss in self._late_losses:
            self.updates &= _is_finite(loss, view, self.global_step)
        self._late_losses.clear()
        if not self.updates:
            self.zero_grad()

    def on_train_end(self) -> None:
        """Stop measuring the training time; what is rendered from here on is what a file would hold."""
        self.stopwatch.stop()
        self.eval()

    def _start_evaluation(self) -> None:
        if len(self.splats) == 0:
            raise ValueError("there are no splats to render: pass the checkpoint of a run (--ckpt_path)")
        if self.evaluation_splats is None:
            self.evaluation_splats = self.scene.hard_splats(self.phase)

    def _end_evaluation(self) -> None:
        self.evaluation_splats = None

    on_validation_start = on_test_start = on_predict_start = _start_evaluation
    on_validation_end = on_test_end = on_predict_end = _end_evaluation

    def predict_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Render one view: ``name`` and ``image [H, W, 3]`` (8-bit values in [0, 1])."""
        if self.evaluation_splats is None:
            raise RuntimeError("evaluation steps run only inside Trainer.validate, test or predict")
        return {"name": batch.name, "image": eight_bit(self.scene.render(self.evaluation_splats, batch.camera).image)}

    def test_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Score one view: ``image [H, W, 3]`` (8-bit values in [0, 1]), ``psnr``, ``ssim``."""
        image = apply_mask(self.predict_step(batch, batch_idx)["image"], batch.mask)
        photo = eight_bit(batch.image)
        scores = {"psnr": psnr(image, photo, batch.mask).float(), "ssim": ssim(image, photo, batch.mask)}
        named = {f"{'test' if self.trainer.testing else 'val'}/{name}": score for name, score in scores.items()}
        # Lightning averages the number of views over the processes, rounded down: a multiple of theirs is exact.
        self.log_dict(named, batch_size=self.trainer.world_size, sync_dist=True)
        return {"image": image, **scores}

    validation_step = test_step

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
        stored = resume.PlainCheckpointIO().load_checkpoint(checkpoint_path).get(cls.CHECKPOINT_HYPER_PARAMS_KEY, {})
        resume.check_settings(checkpoint_path, {k: v for k, v in stored.items() if k not in settings})
        return super().load_from_checkpoint(checkpoint_path, *args, **settings)

    def get_extra_state(self) -> Tensor:
        """Phase, SH degree, extent, seconds of training; unit, middle and origin of the frame; background and cameras.

        Float64 ``[12 + 4 · C]``.
        """
        self.stopwatch.lap()
        values = self.phase, self.active_sh_degree, self.extent, self.stopwatch.seconds
        frame = self.frame.unit, *self.frame.middle, *self.frame.origin
        seen = BACKGROUNDS.index(self.background), *self.cameras.ravel()
        return torch.tensor([*values, *frame, *seen], dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Go on from these; background and cameras of the trainer's scene stay."""
        phase, degree, self.extent, self.stopwatch.seconds, unit, *places = state.tolist()
        self.phase = Phase(int(phase))
        self.splats.edits += 1
        self.active_sh_degree = int(degree)
        if self.background == "auto":
            self.background = BACKGROUNDS[int(places[6])]
        if len(self.cameras) == 0:
            self.cameras = np.reshape(places[7:], (-1, 4))
        frame = Frame(unit, tuple(places[:3]), tuple(places[3:6]))
        scene = run_scene.scene_of(self._trainer)  # whose photos may be others, around another middle
        self.frame = frame if scene is None else frame.relative_to(scene.frame.origin)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add history, schedule, quantizers and scene; plain data only, so that ``weights_only=True`` can read it."""
        checkpoint["history"] = self.history
        checkpoint["schedule"] = asdict(self.schedule)
        checkpoint[resume.QUANTIZER_SETTINGS] = self.quantizer_settings
        if (scene := run_scene.scene_of(self._trainer)) is not None:
            checkpoint[resume.SCENE] = resume.scene_record(scene)
        if (stored := checkpoint.get(self.CHECKPOINT_HYPER_PARAMS_KEY)) is not None:
            # Without the photos nobody knows what "auto" was.
            checkpoint[self.CHECKPOINT_HYPER_PARAMS_KEY] = resume.plain(stored) | {"background": self.background}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore history and schedule; a fit keeps its own schedule.

        Raises:
            ValueError: The checkpoint is of other codebooks or another SH degree; a fit cannot continue from it; or it
                is of another scene than the trainer's, which ``allow_other_scene`` of
                :class:`nsvq_lightning.training.trainer.SplatTrainer` lets pass.
        """
        scene = run_scene.scene_of(self._trainer)
        if scene is not None and resume.SCENE in checkpoint and not getattr(self._trainer, "allow_other_scene", False):
            resume.check_scene(checkpoint, scene)
        self.history = list(checkpoint["history"])
        settings = {"background": self.background, "antialiased": self.antialiased}
        if self._trainer is None or self._trainer.state.fn != "fit":
            self.cameras = np.reshape(checkpoint.get("cameras", []), (-1, 4))  # of older ones; now in the extra state
            self.schedule = Schedule(**checkpoint["schedule"])
        else:
            self.schedule = resume.continued_schedule(checkpoint, self.schedule)
            settings = {**self.hparams, **settings}
        if changed := resume.changes(checkpoint, self.schedule, settings):
            log.warning(f"the checkpoint is of a run with other settings: pass {changed} to continue it as it was")
        resume.check_continuation(checkpoint, self.state_dict(), self.quantizer_settings)


def _photometric_term(module: SplatModule, rendered: Render, view: View) -> Tensor:
    """(1 - w)·L1 + w·(1 - SSIM) of picture and photo (Kerbl et al. 2023, eq. 7); later for PSNR."""
    late = module.psnr_loss and module.phase > Phase.WARMUP
    return photometric_loss(rendered.image, view.image, module.dssim_weight, view.mask, psnr=late)


def _is_finite(loss: AsyncScalar, view: str, step: int) -> bool:
    """Whether the loss of a view is finite; otherwise say so."""
    value = loss.read()
    if not math.isfinite(value):
        log.warning(f"step {step + 1}: the loss of {view} is {value}, no update")
    return math.isfinite(value)
