"""Exact nearest code on a GPU: a running minimum over all codes, whose distances never leave the registers.

Distances are sums of squared differences in float32, one fused multiply-add per element in column order. The CPU
decides by the same sums, so both always choose the same code. Differences need no centring and lose nothing to
cancellation, as dot products would (and TF32 would give most rows a wrong code); they cost twice the arithmetic.

Codes are stored column by column and padded to whole tiles, so that no load of the inner loop has a mask. A program is
one warp, in which a thread compares 8 rows with 4 codes: 12 loads for 32 differences. The programs of a multiprocessor
pass over the codes side by side and find them in its L1 cache.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.memory import check_tensor

ROWS = 8
"""Rows per program."""
CODES = 128
"""Codes that a program compares its rows with at a time."""


@triton.jit
def compare(
    x, at, codebook, num_codes, code_stride, DIM: tl.constexpr, ROWS: tl.constexpr, CODES: tl.constexpr,
    WITH_SECOND: tl.constexpr,
):  # fmt: skip
    """Compare rows with all codes ``[DIM, code_stride]``, which are infinite beyond ``num_codes``.

    Each column stands for every ``CODES``-th code. Returns their smallest distance to each row ``[ROWS, CODES]``, the
    code it belongs to and, with ``WITH_SECOND``, the next larger one (or the same, of equal ones). ``at`` is where the
    rows begin in ``x``.
    """
    code = tl.arange(0, CODES)
    smallest = tl.full([ROWS, CODES], float("inf"), tl.float32)
    second = smallest
    chosen = tl.zeros([ROWS, CODES], tl.int32) + code[None, :]
    for first in range(0, num_codes, CODES):
        distance = tl.zeros([ROWS, CODES], tl.float32)
        for j in range(DIM):
            value = tl.load(x + at + j)
            centre = tl.load(codebook + tl.cast(code_stride, tl.int64) * j + first + code)
            difference = centre[None, :] - value[:, None]
            distance = tl.fma(difference, difference, distance)
        # Of equally near codes the first is kept, and a NaN is never nearer.
        nearer = distance < smallest
        if WITH_SECOND:
            second = tl.where(nearer, smallest, tl.where(distance < second, distance, second))
        smallest = tl.where(nearer, distance, smallest)
        chosen = tl.where(nearer, (first + code)[None, :], chosen)
    return smallest, chosen, second


@triton.jit
def least_of(smallest, chosen, num_codes):
    """The smallest distance of each row, and the lowest code that has it."""
    least = tl.min(smallest, 1)
    return least, tl.min(tl.where(smallest == least[:, None], chosen, num_codes), 1)


@triton.jit(do_not_specialize=["count"])
def nearest_kernel(
    x, codebook, result, count, num_codes, code_stride, DIM: tl.constexpr, ROWS: tl.constexpr, CODES: tl.constexpr,
):  # fmt: skip
    """Nearest code of each row ``[count, DIM]``."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    at = tl.minimum(row, tl.cast(count, tl.int64) - 1) * DIM
    smallest, chosen, _ = compare(x, at, codebook, num_codes, code_stride, DIM, ROWS, CODES, False)
    _, nearest = least_of(smallest, chosen, num_codes)
    tl.store(result + row, nearest.to(tl.int64), mask=row < count)


def nearest_codes(x: Tensor, codebook: Tensor) -> Tensor:
    """Nearest codes ``[N]`` int64; of equally near ones the lowest, and 0 for a row with a NaN.

    Args:
        x: float32 rows ``[N, D]`` on a CUDA device.
        codebook: Codes ``[K, D]`` there.

    Raises:
        ValueError: Rows and codes do not fit together, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    check_tensor("x", x, (len(x), codebook.shape[-1]), x.device)
    check_tensor("codebook", codebook, (len(codebook), x.shape[1]), x.device)
    result = torch.empty(len(x), dtype=torch.int64, device=x.device)
    if len(x):
        codes = by_column(codebook)
        with torch.cuda.device_of(x):
            nearest_kernel[(triton.cdiv(len(x), ROWS),)](
                x, codes, result, len(x), len(codebook), codes.shape[1], DIM=x.shape[1], ROWS=ROWS, CODES=CODES,
                num_warps=1, **COMPILE,
            )  # fmt: skip
    return result


def by_column(codebook: Tensor) -> Tensor:
    """Codes ``[K, D]`` transposed to ``[D, M]``, K rounded up to whole tiles; infinite where there is no code."""
    count, dim = codebook.shape
    columns = codebook.new_full((dim, triton.cdiv(count, CODES) * CODES), torch.inf)
    columns[:, :count] = codebook.t()
    return columns
