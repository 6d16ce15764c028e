"""Replicas of one scene on several processes: make them equal at the start, and check that they stay equal."""

from __future__ import annotations

from typing import cast

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.strategies import Strategy
from torch import Tensor, nn

from nsvq_lightning.training.optim import raw_optimizer

__all__ = ["check_replicas", "checksum", "follow_first", "from_first_process", "sum_over_processes"]


def follow_first(strategy: Strategy, module: nn.Module) -> None:
    """Copy the first process's parameters and buffers to the module on every process; row counts may differ before."""
    module.load_state_dict(strategy.broadcast(module.state_dict()))


@torch.no_grad()
def checksum(tensor: Tensor) -> Tensor:
    """Checksum of a tensor's bits and their positions, scalar int64: Σ (i + 1)·(bits of element i) modulo 2⁶⁴.

    Args:
        tensor: Float32, any shape.
    """
    bits = tensor.detach().contiguous().view(-1).view(torch.int32).long()
    return (bits * torch.arange(1, bits.shape[0] + 1, device=bits.device)).sum()


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
    parameters: dict[str, Tensor] = {group["name"]: group["params"][0] for group in raw_optimizer(trainer).param_groups}
    own = torch.stack([checksum(parameter) for parameter in parameters.values()])
    differ = sum_over_processes(trainer, (own != from_first_process(trainer, own)).long())
    different = [name for name, processes in zip(parameters, differ.tolist(), strict=True) if processes]
    if different:
        raise RuntimeError(
            f"iteration {trainer.global_step}, after {event}: the replicas of {trainer.world_size} processes differ in "
            f"{', '.join(different)}. A decision used data of one process alone, or the machines compute "
            "differently: pass it through nsvq_lightning.training.replicas.sum_over_processes or from_first_process, "
            "and train on machines of one kind"
        )


def from_first_process(trainer: Trainer, tensor: Tensor) -> Tensor:
    """The first process's value of a tensor, on every process; its shape may differ before."""
    return tensor if trainer.world_size == 1 else trainer.strategy.broadcast(tensor).to(tensor.device)


def sum_over_processes(trainer: Trainer, tensor: Tensor) -> Tensor:
    """Sum of a tensor over all processes, in place; the tensor unchanged if there is one process."""
    if trainer.world_size == 1:
        return tensor
    reduced = trainer.strategy.reduce(tensor, reduce_op="sum")
    return cast(Tensor, reduced)
