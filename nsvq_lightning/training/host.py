"""What a callback may use of the module it is attached to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol, cast

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.protocols import missing_members
from nsvq_lightning.quantize.base import Quantizer
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import ATTRIBUTES, RawSplats, Splats, SplatTensors
from nsvq_lightning.training.optim import codebook_group
from nsvq_lightning.training.schedule import Phase, Schedule
from nsvq_lightning.training.state import Stopwatch

if TYPE_CHECKING:
    from nsvq_lightning.data.scene import View
    from nsvq_lightning.io.compressed import CompressedScene
    from nsvq_lightning.io.nsvq.precision import Storage

__all__ = [
    "SplatHost",
    "as_host",
    "check_optimizer",
    "splat_host",
]


class SplatHost(Protocol):
    """A module that trains splats; :class:`nsvq_lightning.SplatModule` is one.

    Callbacks interact only through this state, and decide by ``schedule`` and the trainer's step, so that each works
    without the others.

    Besides the members below a host has

    * one optimiser, with one single-parameter group for each attribute of the splats, whose ``name`` is that of
      the attribute, and for each codebook, named ``codebook_<attribute>``:
      :func:`nsvq_lightning.training.optim.param_groups` makes them;
    * a ``training_step`` that returns a dictionary with ``loss`` and, for density control, the ``render`` of the
      splats, whose ``means2d`` retains its gradient while ``wants_screen_gradients`` is set and which is made with
      ``observe=pixel_map``, and ``edits``, the ``splats.edits`` when they were rendered; None if the step must not
      update anything;
    * for reports, test and validation steps that return a dictionary with ``image``, ``psnr`` and ``ssim`` of a view.

    Callbacks check members and groups before the first iteration (:func:`splat_host`, :func:`check_optimizer`).
    """

    splats: Splats
    """The splats; rows are edited only through :mod:`nsvq_lightning.training.edit`."""
    schedule: Schedule
    """Phases and milestones of the run."""
    phase: Phase
    """Phase of the current iteration, backed by a buffer."""
    active_sh_degree: int
    """SH degree that is rendered, backed by a buffer."""
    opacity_weight: float
    """λ of the loss term λ · Σ opacity."""
    wants_screen_gradients: bool
    """Whether the training step retains the gradient of the projected centres."""
    pixel_map: Tensor | None
    """Strength ``[H, W]`` of the pixels of the next view, whose rendering then has ``observed``; None for neither."""
    appearance: Callable[[Tensor, View], Tensor] | None
    """Makes of the rendered picture ``[H, W, 3]`` of a train view what its photo shows, before the loss; or None."""
    splat_budget: int | None
    """How many splats the scene is to have in the end; None for as many as density control makes."""
    evaluation_splats: SplatTensors | None
    """What test and predict steps render instead of the module's own splats."""
    history: list[dict[str, Any]]
    """Evaluations so far, one plain dictionary each; checkpoints carry it."""
    stopwatch: Stopwatch
    """Measures the time spent training."""
    seed: int
    """Seed of every draw."""
    background: str
    """``black``, ``white`` or ``random``."""
    storage: Storage
    """How the scene is stored."""

    @property
    def quantizers(self) -> Mapping[str, Quantizer]:
        """Quantizers by attribute; empty for a run without quantization."""

    @property
    def extent(self) -> float:
        """Extent of the scene, scene units."""

    @property
    def train_seconds(self) -> float:
        """Seconds spent training so far."""

    @property
    def device(self) -> torch.device:
        """Where the splats are."""

    def rows(self, attribute: str) -> Tensor:
        """Rows ``[N, D]`` of a quantized attribute, detached."""

    def hard_splats(self, phase: Phase) -> RawSplats:
        """The splats as a file written in ``phase`` would hold them, detached."""

    def scale_rate(self, group: str, factor: float) -> None:
        """Multiply the learning rate of a parameter group in the iteration that starts.

        To be called in ``on_train_batch_start``, for every view of the iteration; factors of several callbacks
        multiply.
        """

    def render_splats(self, splats: SplatTensors, camera: Camera) -> Render:
        """Render any splats with the module's settings."""

    def compressed(self) -> CompressedScene:
        """The scene as it is stored."""


def splat_host(module: LightningModule) -> SplatHost:
    """The module as a host.

    Raises:
        TypeError: It lacks a member of :class:`SplatHost`, or holds another host, which a callback would never set.
    """
    inner = [
        type(each).__name__ for each in getattr(module, "_modules", {}).values() if not missing_members(each, SplatHost)
    ]
    if inner:
        raise TypeError(
            f"{type(module).__name__} cannot host the splat callbacks: it holds a {inner[0]} and passes on to it, but "
            f"what callbacks set stays outside; derive {type(module).__name__} from {inner[0]} instead"
        )
    missing = missing_members(module, SplatHost)
    if missing:
        raise TypeError(
            f"{type(module).__name__} cannot host the splat callbacks, it lacks: {', '.join(missing)}; "
            "derive it from nsvq_lightning.SplatModule or offer the members of nsvq_lightning.training.host.SplatHost"
        )
    return as_host(module)


def check_optimizer(trainer: Trainer, module: LightningModule) -> None:
    """Check that the optimiser has the parameter groups that callbacks edit by name.

    Raises:
        ValueError: It lacks some, or there are several optimisers.
    """
    groups = {group.get("name"): len(group["params"]) for each in trainer.optimizers for group in each.param_groups}
    needed = (*ATTRIBUTES, *(codebook_group(name) for name in as_host(module).quantizers))
    missing = [name for name in needed if groups.get(name) != 1]
    if missing or len(trainer.optimizers) != 1:
        raise ValueError(
            f"{type(module).__name__} cannot host the splat callbacks: they need one optimiser with a parameter group "
            f"of one parameter for each attribute and codebook, named after it; there are {len(trainer.optimizers)} "
            f"optimisers, without groups for: {', '.join(missing) or 'none'}. Build the groups with "
            "nsvq_lightning.training.optim.param_groups"
        )


def as_host(module: LightningModule) -> SplatHost:
    """The module as a host, unchecked; for the hooks of every step."""
    return cast(SplatHost, module)
