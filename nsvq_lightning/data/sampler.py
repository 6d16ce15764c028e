"""The order in which the train views are drawn."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.utils.data import Sampler

from nsvq_lightning.random import generator

__all__ = ["ViewSampler"]


class ViewSampler(Sampler[int]):
    """Endless sequence of views: all in random order without replacement, then all again in a new order.

    Epoch ``e`` of the sequence is a permutation drawn from ``generator(seed, e, "views")``. Draw ``d`` of rank ``r`` of
    ``R`` ranks takes position ``d·R + r``, so the ranks share one sequence, and a run resumed at draw ``d`` continues
    exactly where it stopped.

    Args:
        n_views: Number of views, at least 1.
        seed: Seed of the run.
        rank: This process.
        world_size: Number of processes.
        start: Draw at which iteration starts.

    Raises:
        ValueError: A number is out of range.
    """

    def __init__(self, n_views: int, seed: int = 0, rank: int = 0, world_size: int = 1, start: int = 0) -> None:
        if n_views < 1:
            raise ValueError(f"n_views must be at least 1, got {n_views}")
        if not 0 <= rank < world_size:
            raise ValueError(f"rank must be in [0, world_size), got rank {rank} of {world_size}")
        if start < 0:
            raise ValueError(f"start must be at least 0, got {start}")
        self.n_views, self.seed, self.rank, self.world_size, self.start = n_views, seed, rank, world_size, start
        self._epoch = -1
        self._order = torch.empty(0, dtype=torch.int64)

    def view_at(self, draw: int) -> int:
        """View of draw ``draw`` on this rank, in ``[0, n_views)``."""
        epoch, position = divmod(draw * self.world_size + self.rank, self.n_views)
        return int(self._permutation(epoch)[position])

    def __iter__(self) -> Iterator[int]:
        draw = self.start
        while True:
            yield self.view_at(draw)
            draw += 1

    def _permutation(self, epoch: int) -> Tensor:
        if epoch != self._epoch:
            self._order = torch.randperm(self.n_views, generator=generator(self.seed, epoch, "views"))
            self._epoch = epoch
        return self._order
