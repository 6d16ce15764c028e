"""Exact nearest code on a GPU: a running minimum over all codes, whose distances never leave the registers.

Distances are sums of squared differences in float32, one fused multiply-add per element in column order. The CPU
decides by the same sums, so both always choose the same code. Differences need no centring and lose nothing to
cancellation, as dot products would (and TF32 would give most rows a wrong code); they cost twice the arithmetic.

Rows and codes are stored column by column and padded to whole tiles, so that no load of the inner loop has a mask. A
program is one warp, in which a thread compares 8 rows with 4 codes: 12 loads for 32 differences. The programs of a
multiprocessor pass over the codes side by side and find them in its L1 cache.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.launch import COMPILE
from nsvq_lightning.compute.memory import check_tensor

__all__ = ["nearest_codes"]

ROWS = 8
"""Rows per program."""
CODES = 128
"""Codes that a program compares its rows with at a time."""


@triton.jit(do_not_specialize=["count", "x_stride"])
def nearest_kernel(
    x, codebook, result, count, num_codes, x_stride, code_stride, DIM: tl.constexpr, ROWS: tl.constexpr,
    CODES: tl.constexpr,
):  # fmt: skip
    """Nearest of the codes ``[DIM, code_stride]``, infinite beyond ``num_codes``, to the rows ``[DIM, x_stride]``."""
    begin = tl.program_id(0).to(tl.int64) * ROWS
    row, code = tl.arange(0, ROWS), tl.arange(0, CODES)
    smallest = tl.full([ROWS, CODES], float("inf"), tl.float32)
    chosen = tl.zeros([ROWS, CODES], tl.int32) + code[None, :]
    for first in range(0, num_codes, CODES):
        distance = tl.zeros([ROWS, CODES], tl.float32)
        for j in range(DIM):
            value = tl.load(x + tl.cast(x_stride, tl.int64) * j + begin + row)
            centre = tl.load(codebook + tl.cast(code_stride, tl.int64) * j + first + code)
            difference = centre[None, :] - value[:, None]
            distance = tl.fma(difference, difference, distance)
        # Of equally near codes the first is kept, and a NaN is never nearer.
        nearer = distance < smallest
        smallest = tl.where(nearer, distance, smallest)
        chosen = tl.where(nearer, (first + code)[None, :], chosen)
    least = tl.min(smallest, 1)
    candidates = tl.where(smallest == least[:, None], chosen, num_codes)
    tl.store(result + begin + row, tl.min(candidates, 1).to(tl.int64), mask=begin + row < count)


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
        rows, codes = _by_column(x, ROWS), _by_column(codebook, CODES)
        with torch.cuda.device_of(x):
            nearest_kernel[(triton.cdiv(len(x), ROWS),)](
                rows, codes, result, len(x), len(codebook), rows.shape[1], codes.shape[1], DIM=x.shape[1],
                ROWS=ROWS, CODES=CODES, num_warps=1, **COMPILE,
            )  # fmt: skip
    return result


def _by_column(table: Tensor, multiple: int) -> Tensor:
    """A table ``[N, D]`` transposed to ``[D, M]``, N rounded up to a multiple; infinite where there is no row."""
    count, dim = table.shape
    columns = table.new_full((dim, triton.cdiv(count, multiple) * multiple), torch.inf)
    columns[:, :count] = table.t()
    return columns
