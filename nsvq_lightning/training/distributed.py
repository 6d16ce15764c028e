"""Training on several devices: one view each, equal replicas, and what they exchange."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy, Strategy, StrategyRegistry
from torch import Tensor, nn
from torch.distributed import all_reduce

from nsvq_lightning.compute.devices import to_device
from nsvq_lightning.top_level import log
from nsvq_lightning.version import check_replaced

T = TypeVar("T")


def check_strategy(strategy: Strategy) -> None:
    """Refuse a strategy that would lose the parameters that callbacks replace.

    Raises:
        ValueError: The strategy wraps the module, as in ``DistributedDataParallel``.
    """
    if not isinstance(strategy, SingleDeviceStrategy | ViewParallelStrategy):
        raise ValueError(
            "A wrapper such as DistributedDataParallel binds gradient hooks to the parameters it finds at the start: "
            "after the first clone it crashes or silently stops averaging. Write nsvq_lightning.SplatTrainer(…), which "
            'chooses by itself, or Trainer(devices=1, …), or Trainer(strategy="view_parallel", …), in a notebook '
            '"view_parallel_notebook"; for nsvq fit --trainer.devices=1 or --trainer.strategy=view_parallel'
        )


def follow_first(strategy: Strategy, module: nn.Module) -> None:
    """Copy the first process's parameters and buffers to the module on every process; row counts may differ before."""
    # What is pickled on a GPU would come back on the first process's.
    module.load_state_dict(strategy.broadcast({name: tensor.cpu() for name, tensor in module.state_dict().items()}))


@torch.no_grad()
def checksum(tensor: Tensor) -> Tensor:
    """Checksum of a tensor's bits and their positions, scalar int64: Σ (i + 1)·(bits of element i) modulo 2⁶⁴.

    Args:
        tensor: Float32, any shape.
    """
    bits = tensor.ravel().view(torch.int32).long()
    return (bits * torch.arange(1, len(bits) + 1, device=bits.device)).sum()


def check_replicas(trainer: Trainer, event: str) -> None:
    """Check that all processes hold the same trained parameters, to the bit.

    This is a collective: every process must call it at the same point.

    Args:
        trainer: The trainer, whose optimiser names the parameters.
        event: What has just happened, for the message.

    Raises:
        RuntimeError: A parameter differs; all processes raise it.
    """
    if trainer.world_size == 1:
        return
    parameters: dict[str, Tensor] = {group["name"]: group["params"][0] for group in trainer.optimizers[0].param_groups}
    own = torch.stack([checksum(parameter) for parameter in parameters.values()])
    differ = sum_over_processes(trainer, (own != from_first_process(trainer, own)).long())
    if different := [name for name, processes in zip(parameters, differ.tolist(), strict=True) if processes]:
        raise RuntimeError(
            f"iteration {trainer.global_step}, after {event}: the replicas of {trainer.world_size} processes differ in "
            f"{', '.join(different)}. A decision used data of one process alone, or the machines compute "
            "differently: pass it through sum_over_processes or from_first_process of "
            "nsvq_lightning.training.distributed, and train on machines of one kind"
        )


def on_first_process(trainer: Trainer, make: Callable[[], T]) -> T:
    """What the first process makes, on every process: what enters a decision and comes from a library or a file.

    Another version of it, or another processor, may make something else of the same input. This is a collective.

    Args:
        trainer: The trainer.
        make: Called on the first process alone; what it raises is raised on all.
    """
    if trainer.world_size == 1:
        return make()
    made: T | Exception | None = None
    if trainer.is_global_zero:
        try:
            made = make()
        except Exception as error:  # the others would wait for it
            made = error
    made = trainer.strategy.broadcast(made)
    if isinstance(made, Exception):
        raise made
    return made  # type: ignore[return-value]


def from_first_process(trainer: Trainer, tensor: Tensor) -> Tensor:
    """The first process's value of a tensor, on every process; its shape may differ before."""
    return tensor if trainer.world_size == 1 else trainer.strategy.broadcast(tensor.cpu()).to(tensor.device)


def sum_over_processes(trainer: Trainer, tensor: Tensor) -> Tensor:
    """Sum of a tensor over all processes, in place; the tensor unchanged if there is one process."""
    if trainer.world_size > 1:
        all_reduce(tensor)  # not the strategy's reduction, which has a barrier
    return tensor


# Without them, replicas would start apart, or gradients never be averaged.
check_replaced("lightning", DDPStrategy, "block_backward_sync", "configure_ddp", "post_backward")


class ViewParallelStrategy(DDPStrategy):
    """Averages gradients over all processes, even if parameters were replaced: ``strategy="view_parallel"``.

    ``DistributedDataParallel`` keeps the parameters it finds at the start, but cloning and pruning replace them. Here
    nothing is wrapped: every process starts from the first one's parameters and buffers, and after each backward pass
    the gradients of the module's current parameters are summed and divided by the number of processes. So all replicas
    take the same update and stay equal to the bit, as long as all data that enters a decision has passed a collective;
    :func:`nsvq_lightning.training.distributed.check_replicas` compares them.

    With gradient accumulation there is one reduction per step. A parameter that has no gradient on any process stays
    without one; a step in which any process has a non-finite loss updates nothing.

    Arguments are those of ``DDPStrategy`` that do not concern the wrapper, such as ``process_group_backend``.

    Attributes:
        _failed: How many of this process's views of the step have a loss that is not finite, on its device.
    """

    _accumulates = False
    _failed: Tensor | None = None

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
        if self.world_size == 1:
            return
        failed = (~torch.isfinite(closure_loss.detach())).float()
        self._failed = failed if self._failed is None else self._failed + failed
        if self._accumulates:
            return
        assert self.lightning_module is not None
        parameters = [parameter for parameter in self.lightning_module.parameters() if parameter.requires_grad]
        votes = torch.tensor([float(parameter.grad is not None) for parameter in parameters])
        tally = torch.cat([self._failed.clamp(max=1).view(1), to_device(votes, self.root_device)])
        self._failed = None
        all_reduce(tally)
        failed, *wanted = tally.tolist()  # waits for the backward pass: what is reduced next depends on it
        if failed and self.is_global_zero:
            log.warning(f"the loss of {int(failed)} of {self.world_size} processes is not finite, no update")
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


# How its processes start, by its name: as commands of their own or, from a notebook, as copies of this process.
for _end, _start in {"": "popen", "_spawn": "spawn", "_fork": "fork", "_notebook": "fork"}.items():
    _about = f"A replica on each device, one view each per step; processes start by {_start}"
    StrategyRegistry.register(f"view_parallel{_end}", ViewParallelStrategy, _about, override=True, start_method=_start)
