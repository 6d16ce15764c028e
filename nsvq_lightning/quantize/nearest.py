"""Exact nearest code: the search on which every training step of the quantize phase rests.

TF32 and bfloat16 products give half to nine tenths of the rows a wrong code, so nothing here ever runs under autocast
or with a reduced matmul precision.

Where codes cost bits, too, the cheapest one is searched (entropy-constrained vector quantization, Chou, Lookabaugh and
Gray 1989): that with the least D + λ·R, D what the error does and R the bits that the code takes. With D = h·‖x − c‖²
for a row that matters h, it has the least ‖x − c‖² + (λ/h)·R.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import parallel, parts_of
from nsvq_lightning.compute.memory import Array
from nsvq_lightning.compute.rows import share
from nsvq_lightning.compute.simd import broadcast, fma, get, load, minimum, put, where
from nsvq_lightning.quantize.box_search import MAX_DIM, box_search, code_distances, place_of_least
from nsvq_lightning.quantize.scores import score_search


def check_rows(x: Tensor, codebook: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and codes, detached and contiguous; those that do not fit together are refused.

    Raises:
        ValueError: ``x`` is not ``[N, D]``, ``codebook`` not ``[K, D]`` with at least one code.
        TypeError: They differ in dtype or are not floating point.
    """
    if x.dim() != 2 or codebook.dim() != 2 or x.shape[1] != codebook.shape[1] or x.shape[1] == 0:
        raise ValueError(f"x [N, D] and codebook [K, D] must share D, got {list(x.shape)} and {list(codebook.shape)}")
    if len(codebook) == 0:
        raise ValueError(f"the codebook has no code, shape {list(codebook.shape)}; fit it first")
    if x.dtype != codebook.dtype or not x.dtype.is_floating_point:
        raise TypeError(f"x and codebook must have one floating-point dtype, got {x.dtype} and {codebook.dtype}")
    return x.detach().contiguous(), codebook.detach().contiguous()


def nearest_reference(x: Tensor, codebook: Tensor) -> Tensor:
    """Nearest codes by the definition: all distances, as sums of squared differences, in chunks.

    Any device, any floating-point dtype; in float64 the oracle of the fast searches.

    Args:
        x: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``.

    Returns:
        Codes ``[N]`` int64; of equally near codes the lowest.
    """
    x, codebook = check_rows(x, codebook)
    return torch.cat([least(distances) for _, distances in distance_parts(x, codebook)])


def distance_parts(x: Tensor, codebook: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Rows of ``x [N, D]``, part by part, and their exact distances ``[rows, K]`` to the codes ``[K, D]``, detached."""
    # As many distances at once as fit the caches of a CPU, or are enough to keep a GPU busy.
    rows = max(1, (1 << 22 if x.device.type == "cpu" else 1 << 26) // len(codebook))
    for start in range(0, max(1, len(x)), rows):
        part = slice(start, start + rows)
        with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
            distances = torch.cdist(x[part], codebook, compute_mode="donot_use_mm_for_euclid_dist")
        yield part, distances


def least(costs: Tensor) -> Tensor:
    """Column ``[N]`` int64 of the least of the costs ``[N, K]`` of each row; NaN counts as the largest, as infinity."""
    # argmin would treat NaN as the smallest
    return costs.nan_to_num(nan=torch.inf, posinf=torch.inf).argmin(1)


def nearest(x: Tensor, codebook: Tensor) -> Tensor:
    """Nearest codes in exact float32: a code differs from the float64 one only where distances tie up to rounding.

    Args:
        x: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``, same dtype and device.

    Returns:
        Codes ``[N]`` int64; of equally near codes the lowest. A row with a NaN gets code 0.

    Raises:
        ValueError: The shapes do not fit together, or there is no code.
        TypeError: The dtypes differ or are not floating point.
    """
    x, codebook = check_rows(x, codebook)
    kernels = kernels_for(x)
    if kernels == "cpu":
        rows, codes = x.numpy(), codebook.numpy()
        return torch.from_numpy(box_search(rows, codes) if x.shape[1] <= MAX_DIM else score_search(rows, codes)[0])
    if kernels == "cuda":
        from nsvq_lightning.quantize.cuda.search import nearest_codes

        return nearest_codes(x, codebook)
    return nearest_reference(x, codebook)


def code_rates(codes: Tensor, count: int) -> Tensor:
    """Bits ``[count]`` float32 that each code takes, −log2 of how often it is among ``codes [N]`` int64."""
    # A code that is not used costs bits, too, but finitely many.
    uses = torch.bincount(codes, minlength=count).double() + 0.3
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
    x, codebook = check_rows(x, codebook)
    if rates.shape != codebook.shape[:1] or prices.shape != x.shape[:1]:
        raise ValueError(
            f"rates [K] and prices [N] must belong to {len(codebook)} codes and {len(x)} rows, got "
            f"{list(rates.shape)} and {list(prices.shape)}"
        )
    if kernels_for(x) != "cpu":
        return cheapest_reference(x, codebook, rates, prices)
    table = _blocks(codebook.numpy(), rates.float().numpy())
    result = np.empty(len(x), np.int64)
    queries, dearness = x.numpy().ravel(), prices.float().contiguous().numpy()
    _search_kernel(x.shape[1])(parts_of(len(x), 64), queries, dearness, table, result)
    return torch.from_numpy(result)


@torch.no_grad()
def cheapest_reference(x: Tensor, codebook: Tensor, rates: Tensor, prices: Tensor) -> Tensor:
    """:func:`cheapest` by the definition, on any device and in any floating-point type."""
    costs = (distances.square() + prices[part, None] * rates for part, distances in distance_parts(x, codebook))
    return torch.cat([least(part) for part in costs])


def _blocks(codebook: Array, rates: Array) -> Array:
    """Blocks of 16 codes, ``[⌈K/16⌉, D + 1, 16]`` flat: their values, and rates; infinite in lanes without a code."""
    table = np.c_[codebook, rates]
    padded = np.pad(table, ((0, -len(table) % 16), (0, 0)), constant_values=np.inf)
    return padded.reshape(-1, 16, table.shape[1]).mT.ravel()


@cache
def _search_kernel(dim: int) -> Any:
    """The search for one dimension, a compile-time constant."""

    def search(part, parts, x, prices, table, result):
        blocks = table.shape[0] // (16 * (dim + 1))
        for i in range(*share(result.shape[0], part, parts)):
            price = get(prices, i)
            best, block_of = broadcast(np.inf), broadcast(0)
            for block in range(blocks):
                at = block * 16 * (dim + 1)
                distances = code_distances(dim, table, at, x, i * dim)
                total = fma(price, load(table, at + 16 * dim), distances)
                block_of = where(total < best, block, block_of)
                best = minimum(total, best)
            put(result, i, place_of_least(best, block_of))

    return parallel(search)
