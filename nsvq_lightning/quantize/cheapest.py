"""The cheapest code of a row where codes cost bits, too: entropy-constrained vector quantization.

Chou, Lookabaugh and Gray (1989) choose the code with the least D + λ·R: D is what the error does, R the bits that the
code takes. With D = h·‖x − c‖² for a row that matters h, the same code has the least ‖x − c‖² + (λ/h)·R.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import kernel, thread_count
from nsvq_lightning.compute.lanes import (
    broadcast,
    fma,
    get,
    lane_min,
    load,
    lowest_bit,
    mask_bits,
    put,
    select,
)
from nsvq_lightning.quantize.nearest import check_rows, distance_parts, least

__all__ = ["cheapest", "cheapest_reference", "code_rates"]

_UNSEEN = 0.3
"""Uses that a code counts beyond those it has: one that is not used costs bits, too, but finitely many."""


def code_rates(codes: Tensor, count: int) -> Tensor:
    """Bits ``[count]`` float32 that each code takes, −log2 of how often it is among ``codes [N]`` int64."""
    uses = torch.bincount(codes, minlength=count).double() + _UNSEEN
    return (uses.sum().log2() - uses.log2()).float()


def cheapest(x: Tensor, codebook: Tensor, rates: Tensor, prices: Tensor) -> Tensor:
    """Codes ``[N]`` int64 with the least ‖x − c‖² + price · rate; of equally cheap ones the lowest.

    Args:
        x: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``.
        rates: Bits of each code ``[K]``, finite.
        prices: What a bit costs each row ``[N]``, in squared distances; finite, not negative. At 0, the nearest code.

    Raises:
        ValueError: The shapes do not fit together, or there is no code.
        TypeError: The dtypes of ``x`` and ``codebook`` differ or are not floating point.
    """
    check_rows(x, codebook)
    if rates.shape != codebook.shape[:1] or prices.shape != x.shape[:1]:
        raise ValueError(
            f"rates [K] and prices [N] must belong to {len(codebook)} codes and {len(x)} rows, got "
            f"{list(rates.shape)} and {list(prices.shape)}"
        )
    x, codebook = x.detach(), codebook.detach()
    if kernels_for(x) != "cpu":
        return cheapest_reference(x, codebook, rates, prices)
    table = _blocks(codebook.numpy(), rates.float().numpy())
    result = np.empty(len(x), np.int64)
    thread_count()
    dim = x.shape[1]
    _search_kernel(dim)(x.contiguous().numpy().ravel(), prices.float().contiguous().numpy(), table, result)
    return torch.from_numpy(result)


@torch.no_grad()
def cheapest_reference(x: Tensor, codebook: Tensor, rates: Tensor, prices: Tensor) -> Tensor:
    """:func:`cheapest` by the definition, on any device and in any floating-point type."""
    costs = (distances.square() + prices[part, None] * rates for part, distances in distance_parts(x, codebook))
    return torch.cat([least(part) for part in costs])


def _blocks(codebook: NDArray[np.float32], rates: NDArray[np.float32]) -> NDArray[np.float32]:
    """Blocks of 16 codes, ``[⌈K/16⌉, D + 1, 16]`` flat: their values, infinite in lanes without a code, and rates."""
    count, dim = codebook.shape
    padded = np.zeros((-(-count // 16) * 16, dim + 1), np.float32)
    padded[count:, :dim] = np.inf
    padded[:count, :dim], padded[:count, dim] = codebook, rates
    return np.ascontiguousarray(padded.reshape(-1, 16, dim + 1).transpose(0, 2, 1)).ravel()


@cache
def _search_kernel(dim: int) -> Any:
    """The search for one dimension, a compile-time constant."""

    def search(x, prices, table, result):  # type: ignore[no-untyped-def]
        blocks = table.shape[0] // (16 * (dim + 1))
        for i in prange(result.shape[0]):
            price = broadcast(get(prices, i))
            best, block_of = broadcast(np.float32(np.inf)), broadcast(np.float32(0.0))
            for block in range(blocks):
                at = block * 16 * (dim + 1)
                total = broadcast(np.float32(0.0))
                for j in range(dim):
                    difference = load(table, at + 16 * j) - broadcast(get(x, i * dim + j))
                    total = fma(difference, difference, total)
                total = fma(price, load(table, at + 16 * dim), total)
                cheaper = total < best
                best = select(cheaper, total, best)
                block_of = select(cheaper, broadcast(np.float32(block)), block_of)
            smallest = broadcast(lane_min(best))
            first = lane_min(select(best <= smallest, block_of, broadcast(np.float32(np.inf))))
            lane = lowest_bit(mask_bits((best <= smallest) & (block_of <= broadcast(first))))
            put(result, i, np.int64(first) * 16 + lane)

    return kernel(search)
