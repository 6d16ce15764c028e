"""Work with any module that hosts splats, and say at once what one lacks."""

from __future__ import annotations

from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.host import check_optimizer, splat_host

__all__ = ["HostedCallback"]


class HostedCallback(Callback):
    """Callback of any module that follows :class:`nsvq_lightning.host.SplatHost`; every callback here is one.

    What the module must have is checked before anything starts, what its optimiser must have as soon as there is one.
    A subclass that has these hooks itself calls them here first.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Check the module.

        Raises:
            TypeError: It lacks something that :class:`~nsvq_lightning.host.SplatHost` names.
        """
        splat_host(pl_module)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check the optimiser.

        Raises:
            ValueError: There is not one with the parameter groups of a host.
        """
        check_optimizer(trainer, pl_module)
