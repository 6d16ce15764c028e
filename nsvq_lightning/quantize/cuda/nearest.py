"""Exact nearest code on a GPU: a running minimum over all codes, whose distances never leave the registers.

Distances are sums of squared differences in float32, one fused multiply-add a number in the order of the columns: what
decides on the CPU too, so both choose the same code to the bit. Differences need no centring and lose nothing to
cancellation, which dot products would (and TF32 would give most rows a wrong code); they cost twice the arithmetic.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.rendering.cuda.records import COMPILE

__all__ = ["nearest_codes"]

ROWS = 32
"""Rows a program searches."""
CODES = 128
"""Codes it compares them with at a time."""


@triton.jit
def nearest_kernel(
    x, codebook, result, count, num_codes, DIM: tl.constexpr, ROWS: tl.constexpr, CODES: tl.constexpr
):  # fmt: skip
    """Nearest of the codes, whose numbers lie column by column (``[DIM, num_codes]``), of each row."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    inside = row < count
    lane = tl.arange(0, CODES)
    smallest = tl.full([ROWS, CODES], float("inf"), tl.float32)
    chosen = tl.zeros([ROWS, CODES], tl.int32) + lane[None, :]
    for first in range(0, num_codes, CODES):
        code = first + lane
        distance = tl.zeros([ROWS, CODES], tl.float32)
        for j in range(DIM):
            value = tl.load(x + row * DIM + j, mask=inside, other=0.0)
            column = codebook + tl.cast(num_codes, tl.int64) * j
            difference = tl.load(column + code, mask=code < num_codes, other=float("inf"))[None, :] - value[:, None]
            distance = tl.fma(difference, difference, distance)
        # Of equal ones the first stays, and what is not a number is no nearer.
        nearer = distance < smallest
        smallest = tl.where(nearer, distance, smallest)
        chosen = tl.where(nearer, code[None, :], chosen)
    least = tl.min(smallest, 1)
    candidates = tl.where(smallest == least[:, None], chosen, num_codes)
    tl.store(result + row, tl.min(candidates, 1).to(tl.int64), mask=inside)


def nearest_codes(x: Tensor, codebook: Tensor) -> Tensor:
    """Nearest codes ``[N]`` int64; of equally near ones the lowest, and 0 for a row that is not a number.

    Args:
        x: Contiguous float32 rows ``[N, D]`` on a CUDA device.
        codebook: Codes ``[K, D]`` there.
    """
    result = torch.empty(len(x), dtype=torch.int64, device=x.device)
    if len(x):
        with torch.cuda.device_of(x):
            nearest_kernel[(triton.cdiv(len(x), ROWS),)](
                x, codebook.t().contiguous(), result, len(x), len(codebook), DIM=x.shape[1], ROWS=ROWS, CODES=CODES,
                **COMPILE,
            )  # fmt: skip
    return result
