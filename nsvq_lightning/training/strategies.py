"""Training on several devices: each has a replica of the scene and renders one view per step."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.distributed
from lightning.pytorch.strategies import DDPStrategy, StrategyRegistry
from torch import Tensor
from torch.distributed import all_reduce

from nsvq_lightning.training.replicas import follow_first

__all__ = ["ViewParallelStrategy"]

log = logging.getLogger(__name__)


class ViewParallelStrategy(DDPStrategy):
    """Averages gradients over all processes, even if parameters were replaced: ``strategy="view_parallel"``.

    ``DistributedDataParallel`` keeps the parameters it finds at the start, but cloning and pruning replace them. Here
    nothing is wrapped: every process starts from the first one's parameters and buffers, and after each backward pass
    the gradients of the module's current parameters are summed and divided by the number of processes. So all replicas
    take the same update and stay equal to the bit, as long as all data that enters a decision has passed a collective
    (:mod:`nsvq_lightning.training.host`); :func:`nsvq_lightning.training.replicas.check_replicas` compares them.

    With gradient accumulation there is one reduction per step. A parameter that has no gradient on any process stays
    without one; a step in which any process has a non-finite loss updates nothing.

    Arguments are those of ``DDPStrategy`` that do not concern the wrapper, such as ``process_group_backend``.
    """

    follows_replaced_parameters = True
    """What :class:`~nsvq_lightning.callbacks.DensityControl` requires of a strategy for several processes."""

    _accumulates = False
    _finite = True

    def configure_ddp(self) -> None:
        """Copy the first process's parameters and buffers."""
        assert self.lightning_module is not None
        follow_first(self, self.lightning_module)

    @contextmanager
    def block_backward_sync(self) -> Iterator[None]:
        """Keep gradients local for now: more will be added to them."""
        self._accumulates = True
        try:
            yield
        finally:
            self._accumulates = False

    def post_backward(self, closure_loss: Tensor) -> None:
        """Average the gradients over all processes."""
        self._finite = self._finite and bool(torch.isfinite(closure_loss))
        if self._accumulates or self.world_size == 1:
            return
        assert self.lightning_module is not None
        parameters = [parameter for parameter in self.lightning_module.parameters() if parameter.requires_grad]
        votes = [float(not self._finite), *(float(parameter.grad is not None) for parameter in parameters)]
        tally = torch.tensor(votes, device=self.root_device)
        self._finite = True
        all_reduce(tally)
        failed, *wanted = tally.tolist()
        if failed and self.is_global_zero:
            log.warning("the loss of %d of %d processes is not finite, no update", int(failed), self.world_size)
        for parameter, count in zip(parameters, wanted, strict=True):
            if failed or not count:
                parameter.grad = None
            else:
                gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
                parameter.grad = gradient.contiguous()
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        for work in [all_reduce(gradient, async_op=True) for gradient in gradients]:
            work.wait()
        for gradient in gradients:
            gradient.div_(self.world_size)  # not every backend has an average


StrategyRegistry.register(
    "view_parallel", ViewParallelStrategy, description="A replica on each device, one view each per step", override=True
)
