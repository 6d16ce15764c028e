"""An option beyond the recipe: exposures of photos."""

from dataclasses import field
from typing import Any

import torch
from lightning.pytorch import Trainer

from nsvq_lightning.data.scene import View, exposures
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.top_level import log
from nsvq_lightning.training import distributed, run_scene
from nsvq_lightning.training.module import LossTerm, SplatModule

from .base import SplatCallback, has_gradients
from .settings import Positive


class ExposureCompensation(SplatCallback):
    """Gives each train photo an affine map of colours, which is applied to its rendered picture before the loss.

    Cameras that choose exposure and white balance by themselves make photos that contradict each other; splats then
    learn colours that depend on the direction, or haze before the lens. Here colour c becomes (I + A)·c + b with a
    3 × 3 matrix A and a vector b for each photo, trained beside the splats by an Adam of its own. Their mean over the
    train photos is kept at zero, so that the scene keeps the photos' usual colours.

    Test views are rendered as they are: nobody knows their exposure. Their ``cc_psnr`` and ``cc_ssim`` in
    ``metrics.json`` are measured after a colour correction to the photo
    (:func:`nsvq_lightning.quality.metrics.color_corrected`).
    """

    rate: Positive = 0.001
    """Learning rate at the start."""
    final: Positive = 0.1
    """Its factor at the end; it falls exponentially."""

    _adam: torch.optim.Adam | None = field(default=None, init=False)
    _loaded: dict[str, Any] | None = field(default=None, init=False)
    _plain: LossTerm | None = field(default=None, init=False)

    def on_train_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Start from the brightness of SfM's points in each photo, or from what a checkpoint has.

        Raises:
            ValueError: The trainer has no data module with a scene, or the checkpoint is of another number of photos.
        """
        need = "exposures are those of the train photos"
        scene = run_scene.needed_scene(trainer, need, "leave out ExposureCompensation")
        self._row = {view: row for row, view in enumerate(scene.train)}
        if not self._loaded:
            found = exposures(scene)
            start = torch.nn.functional.pad(torch.diag_embed(found / found.mean(0) - 1), (0, 1))
        else:
            start = self._loaded["changes"].clone()
            if len(start) != len(scene.train):
                raise ValueError(
                    f"the checkpoint has exposures of {len(start)} train photos, {scene.root} has {len(scene.train)}: "
                    "continue with the photos of the run"
                )
        self._changes = start.to(module.device).requires_grad_()
        self._adam = torch.optim.Adam([self._changes], lr=self.rate)
        if self._loaded:
            self._adam.load_state_dict(self._loaded["adam"])
            self._loaded = None
        self._plain = plain = module.loss_terms["photometric"]
        module.loss_terms["photometric"] = lambda rendered, view: plain(self._exposed(rendered, view), view)

    def _exposed(self, rendered: Render, view: View) -> Render:
        """The rendered picture with the exposure of a train photo."""
        change = self._changes[self._row[view.index]] - self._changes.mean(0)
        matrix = torch.eye(3, device=change.device) + change[:, :3]
        return rendered._replace(image=torch.nn.functional.linear(rendered.image, matrix, change[:, 3]))

    def on_before_optimizer_step(self, trainer: Trainer, module: SplatModule, optimizer: Any) -> None:
        """Take a step with the gradients averaged over all processes, unless the iteration is to change nothing."""
        if self._adam is None:
            return
        if module.updates and has_gradients(trainer):
            share = module.schedule.share(module.schedule.reference(trainer.global_step + 1))
            self._adam.param_groups[0]["lr"] = self.rate * self.final ** min(1.0, share)
            gradient = torch.zeros_like(self._changes) if self._changes.grad is None else self._changes.grad
            self._changes.grad = distributed.sum_over_processes(trainer, gradient).div_(trainer.world_size)
            self._adam.step()
        self._adam.zero_grad()

    def on_train_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Say how much the photos differ."""
        self.on_exception(trainer, module)
        gains = 1 + self._changes.detach()[:, :, :3].diagonal(dim1=1, dim2=2).mean(1)
        gains = gains.clamp_min(1e-3)  # of a black photo
        stops = gains.log2() - gains.log2().mean()
        log.info(f"exposures of the train photos: {stops.min():+.2f} to {stops.max():+.2f} stops")

    def on_exception(self, trainer: Trainer, module: SplatModule, *_: Any) -> None:
        """Leave the module as it was."""
        if self._plain:
            module.loss_terms["photometric"] = self._plain
            self._plain = None

    def state_dict(self) -> dict[str, Any]:
        """Exposures and the state of their Adam."""
        return {"changes": self._changes.detach(), "adam": self._adam.state_dict()} if self._adam else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there."""
        self._loaded = state_dict or None
