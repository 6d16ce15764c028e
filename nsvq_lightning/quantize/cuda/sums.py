"""Sums of rows by code on a GPU, in one fixed order: rows are sorted by code, and some programs add up one code's."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.memory import check_tensor

ROWS = 16
"""Rows of a code that are added up side by side."""
WIDTH = 64
"""Largest number of columns per program."""


PARTS = 8
"""Most programs that share the rows of one code, so that a code of very many is no long tail; a power of two."""
PART = 256
"""Fewest rows of a part, but for the last one."""


@triton.jit
def part_size(begin, end, PARTS: tl.constexpr, PART: tl.constexpr):
    """Rows in a part of a code's rows ``begin`` to ``end``."""
    return tl.maximum(tl.cdiv(end - begin, PARTS), PART)


@triton.jit
def part_kernel(
    values, order, offsets, partial, dim, PARTS: tl.constexpr, PART: tl.constexpr, ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
):  # fmt: skip
    """Sum a part of a code's rows ``order[offsets[code]:offsets[code + 1]]`` in the dtype of ``partial``."""
    program = tl.program_id(0).to(tl.int64)
    code, part = program // PARTS, (program % PARTS).to(tl.int32)
    column = tl.program_id(1) * WIDTH + tl.arange(0, WIDTH)[None, :]
    begin, end = tl.load(offsets + code), tl.load(offsets + code + 1)
    size = part_size(begin, end, PARTS, PART)
    first = begin + part * size
    last = tl.minimum(first + size, end)
    if first < last:
        total = tl.zeros([ROWS, WIDTH], partial.dtype.element_ty)
        for start in range(first, last, ROWS):
            place = start + tl.arange(0, ROWS)[:, None]
            row = tl.load(order + place, mask=place < last, other=0)
            value = tl.load(values + row * dim + column, mask=(place < last) & (column < dim), other=0.0)
            total += value.to(partial.dtype.element_ty)
        lane = tl.program_id(1) * WIDTH + tl.arange(0, WIDTH)
        tl.store(partial + program * dim + lane, tl.sum(total, 0), mask=lane < dim)


@triton.jit
def sum_kernel(
    partial, offsets, sums, dim, PARTS: tl.constexpr, PART: tl.constexpr, WIDTH: tl.constexpr
):  # fmt: skip
    """Sum the parts of a code; 0 for a code without rows."""
    code = tl.program_id(0).to(tl.int64)
    column = tl.program_id(1) * WIDTH + tl.arange(0, WIDTH)
    begin, end = tl.load(offsets + code), tl.load(offsets + code + 1)
    part = tl.arange(0, PARTS)[:, None]
    there = (part * part_size(begin, end, PARTS, PART) < end - begin) & (column < dim)[None, :]
    total = tl.load(partial + (code * PARTS + part) * dim + column[None, :], mask=there, other=0.0)
    tl.store(sums + code * dim + column, tl.sum(total, 0), mask=column < dim)


def sorted_by_code(codes: Tensor, num_codes: int) -> tuple[Tensor, Tensor]:
    """Rows ``[N]`` int64, stably sorted by code, and where each code begins ``[K + 1]`` int32."""
    # 16-bit keys take a quarter of the sorting passes of 64-bit ones.
    key = torch.int16 if num_codes < 2**15 else torch.int32
    keys, order = codes.to(key).sort(stable=True)
    starts = torch.searchsorted(keys, torch.arange(num_codes + 1, dtype=key, device=codes.device), out_int32=True)
    return order, starts


_sorted = WeakTensorKeyDictionary()
"""Rows by code of codes that still exist, after the version of these codes and how many there may be."""


def _remembered(codes: Tensor, num_codes: int) -> tuple[Tensor, Tensor]:
    """:func:`sorted_by_code`, once for codes that stay the same, as frozen ones do."""
    version, count, *found = _sorted.get(codes, (-1, -1))
    if (version, count) != (codes._version, num_codes):
        found = list(sorted_by_code(codes, num_codes))
        _sorted[codes] = codes._version, num_codes, found[0], found[1]
    return found[0], found[1]


def sum_rows(values: Tensor, codes: Tensor, num_codes: int, dtype: torch.dtype) -> Tensor:
    """Sums ``[K, D]`` of the rows of each code, 0 for a code without rows; nothing is read back from the device.

    Args:
        values: Contiguous rows ``[N, D]`` on a CUDA device.
        codes: Codes ``[N]`` int64 in [0, K).
        num_codes: K.
        dtype: Dtype of the sums and of their accumulation.

    Raises:
        ValueError: The values are not ``[N, D]`` or not contiguous, or there is not one code per row.
        TypeError: A dtype is wrong.
    """
    check_tensor("values", values, (len(values), values.shape[-1]), values.device, values.dtype)
    check_tensor("codes", codes, (len(values),), values.device, torch.int64)
    order, offsets = _remembered(codes, num_codes)
    dim = values.shape[1]
    width = min(WIDTH, triton.next_power_of_2(dim))
    columns = triton.cdiv(dim, width)
    partial = torch.empty(num_codes * PARTS, dim, dtype=dtype, device=values.device)
    sums = torch.empty(num_codes, dim, dtype=dtype, device=values.device)
    with torch.cuda.device_of(values):
        part_kernel[(num_codes * PARTS, columns)](
            values, order, offsets, partial, dim, PARTS=PARTS, PART=PART, ROWS=ROWS, WIDTH=width, num_warps=1, **COMPILE
        )
        sum_kernel[(num_codes, columns)](
            partial, offsets, sums, dim, PARTS=PARTS, PART=PART, WIDTH=width, num_warps=1, **COMPILE
        )
    return sums
