"""Error substitution on a GPU: gather, residual, noise and result of a row in one pass, gradients in another.

Sums of rows by code have one fixed order: rows are sorted by code, and some programs add up one code's.
The noise of a row is that of the CPU kernel in :mod:`nsvq_lightning.quantize.substitution`: the integers are equal, and
the arithmetic after them is the same sequence of roundings, polynomials included.
"""

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary
from triton.language import constexpr

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.compute.rows import sorted_by_key
from nsvq_lightning.quantize import substitution
from nsvq_lightning.quantize.cuda.search import load_if, places

SPLIT = constexpr(0x3F3504F3)  # bits of 1/√2: a mantissa lies in [1/√2, √2)
TWO_LOG2_E = constexpr(2 / math.log(2))
ARTANH = constexpr((1 / 11, 1 / 9, 1 / 7, 1 / 5, 1 / 3, 1.0))
TINY = constexpr(torch.finfo(torch.float32).tiny)

ROWS = constexpr(16)  # rows of a code that are added up side by side
# Most programs that share the rows of one code, so that one of very many is no long tail; a power of two.
PARTS = constexpr(8)
PART = constexpr(256)  # fewest rows of a part, but for the last one


@triton.jit
def log2(x):
    """Binary logarithm of positive normal numbers as on the CPU: 2 artanh((m - 1)/(m + 1)) and the exponent."""
    bits = x.to(tl.int32, bitcast=True)
    exponent = (bits - SPLIT) >> 23
    mantissa = (bits - (exponent << 23)).to(tl.float32, bitcast=True)
    s = tl.div_rn(mantissa - 1, mantissa + 1)
    squared = s * s
    series = tl.zeros_like(s) + ARTANH[0]
    for power in tl.static_range(1, 6):
        series = tl.fma(series, squared, ARTANH[power])
    return tl.fma(s * TWO_LOG2_E, series, exponent.to(tl.float32))


GOLDEN, FIRST, SECOND = (constexpr(value) for value in substitution.MULTIPLIERS)
COS, SIN = constexpr(substitution.COS), constexpr(substitution.SIN)
UNIT = constexpr(2.0**-24)
MINUS_TWO_LN2 = constexpr(-2 * math.log(2))


@triton.jit
def random_bits(seed, counter):
    """64 random bits of each counter (int64)."""
    key = tl.cast(seed, tl.uint64)
    second_key = (key ^ (key >> 31)) * SECOND
    bits = (counter.to(tl.uint64) + key) * GOLDEN
    bits = (bits ^ (bits >> 30)) * FIRST
    bits = (bits ^ (bits >> 27) ^ second_key) * SECOND
    return bits ^ (bits >> 31)


@triton.jit
def normal(seed, vector, lane):
    """Standard normal values: lanes ``lane`` (0 to 15) of the vectors ``vector`` (int64) of a seed."""
    bits = random_bits(seed, (vector // 2) * 16 + lane)
    radius = ((bits >> 40).to(tl.int32) + 1).to(tl.float32) * UNIT
    turn = (bits & 0xFFFFFF).to(tl.int32).to(tl.float32) * UNIT - 0.5
    length = tl.sqrt_rn(log2(radius) * MINUS_TWO_LN2)
    t = turn * turn
    even = vector % 2 == 0
    value = tl.where(even, COS[0], SIN[0])
    for power in tl.static_range(1, 6):
        value = tl.fma(value, t, tl.where(even, COS[power], SIN[power]))
    return length * tl.where(even, value, turn * value)


@triton.jit
def chosen_rows(x, rows, codebook, codes, count, height, num_codes, DIM: constexpr, ROWS: constexpr, WIDTH: constexpr):
    """Place among the chosen rows, columns, row numbers, masks (inside the tile, and valid), rows, and their codes.

    A row outside the table, or whose code is outside the codebook, is NaN; raising an error would need a sync.
    """
    i = places(ROWS)[:, None]
    column = tl.arange(0, WIDTH)[None, :]
    inside = (i < count) & (column < DIM)
    row = load_if(rows + i, i < count)
    code = load_if(codes + i, i < count)
    there = inside & (row >= 0) & (row < height) & (code >= 0) & (code < num_codes)
    value = tl.load(x + row * DIM + column, mask=there, other=float("nan"))
    centre = tl.load(codebook + code * DIM + column, mask=there, other=float("nan"))
    return i, column, row, inside, there, value, centre


@triton.jit
def inverses(squared):
    """1/s, and 0 where s is 0 (or its inverse too large): a zero vector has no direction."""
    return tl.where(squared > TINY, 1 / squared, 0.0)


@triton.jit(do_not_specialize=["seed", "count", "height"])
def substitute_kernel(
    seed, aim, spread, x, rows, codebook, codes, out, count, height, num_codes, DIM: constexpr, ROWS: constexpr,
    WIDTH: constexpr,
):  # fmt: skip
    """``x + ‖x − c‖·d/‖d‖`` with ``d = aim·(c − x) + spread·v``, for some rows."""
    i, column, _, inside, _, value, centre = chosen_rows(
        x, rows, codebook, codes, count, height, num_codes, DIM, ROWS, WIDTH
    )
    # The order of the CPU's vectors of 16: one short row per lane, long rows along the vectors.
    if DIM < 16:
        noise = normal(seed, i // 16 * DIM + column, (i % 16).to(tl.int32))
    else:
        noise = normal(seed, i * ((DIM + 15) // 16) + column // 16, column % 16)
    residual = tl.where(inside, centre - value, 0.0)
    direction = tl.where(inside, residual * aim + noise * spread, 0.0)
    error, squared = tl.sum(residual * residual, 1)[:, None], tl.sum(direction * direction, 1)[:, None]
    length = tl.sqrt_rn(error * inverses(squared))
    tl.store(out + i * DIM + column, value + direction * length, mask=inside)


@triton.jit(do_not_specialize=["count", "height"])
def radial_kernel(
    grad, x, rows, codebook, codes, out, grad_x, radials, count, height, num_codes, DIM: constexpr,
    ROWS: constexpr, WIDTH: constexpr,
):  # fmt: skip
    """Write the gradient of the rows to the table of all rows, and minus its radial term to ``radials``."""
    i, column, row, inside, there, value, centre = chosen_rows(
        x, rows, codebook, codes, count, height, num_codes, DIM, ROWS, WIDTH
    )
    slope = load_if(grad + i * DIM + column, inside)
    moved = tl.where(inside, load_if(out + i * DIM + column, inside) - value, 0.0)
    residual = tl.where(inside, value - centre, 0.0)
    scale = tl.sum(slope * moved, 1)[:, None] * inverses(tl.sum(residual * residual, 1)[:, None])
    radial = residual * scale
    tl.store(grad_x + row * DIM + column, slope + radial, mask=there)
    tl.store(radials + i * DIM + column, -radial, mask=inside)


def _launch(kernel: Any, x: Tensor, rows: Tensor, codebook: Tensor, *arguments: Any) -> None:
    """Run a kernel on the chosen rows of a table; after its arguments it gets how many rows and codes there are."""
    dim = x.shape[1]
    width = triton.next_power_of_2(dim)
    height = max(1, 1024 // width)  # 1024 elements per program
    if len(rows):
        with torch.cuda.device_of(x):
            kernel[(triton.cdiv(len(rows), height),)](
                *arguments, len(rows), len(x), len(codebook), DIM=dim, ROWS=height, WIDTH=width, **COMPILE
            )


def substitute(
    seed: int, x: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor, *, aim: float, spread: float
) -> Tensor:
    """``x + ‖x − c‖·d/‖d‖`` with ``d = aim·(c − x) + spread·v``, v ~ N(0, I), for some rows of a table, ``[V, D]``.

    Args:
        seed: 63 random bits; v is a function of them and of the position in ``rows``.
        x: Contiguous float32 table ``[N, D]`` on a CUDA device, as are all tensors here.
        rows: Which rows of it, ``[V]`` int64.
        codebook: Codes ``[K, D]``.
        codes: Code of each chosen row, ``[V]`` int64.
        aim: Weight of the residual c − x in the direction d.
        spread: Weight of the noise in d.

    Raises:
        ValueError: The tensors do not fit together, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    substitution.check_inputs(x, rows, codebook, codes)
    out = x.new_empty(len(rows), x.shape[1])
    mix = seed, float(aim), float(spread)
    _launch(substitute_kernel, x, rows, codebook, *mix, x, rows, codebook, codes, out)
    return out


def substitute_backward(
    grad: Tensor, x: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor, out: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of ``x [N, D]`` and ``codebook [K, D]`` from that of the result, ``grad [V, D]``.

    ``out [V, D]`` is the result of :func:`substitute`; the ``rows [V]`` must be distinct here.

    Raises:
        ValueError: As for :func:`substitute`.
        TypeError: A dtype is wrong.
    """
    substitution.check_inputs(x, rows, codebook, codes, grad, out)
    grad_x, radials = torch.zeros_like(x), torch.empty_like(out)
    _launch(radial_kernel, x, rows, codebook, grad, x, rows, codebook, codes, out, grad_x, radials)
    return grad_x, sum_rows(radials, codes, len(codebook), x.dtype)


@triton.jit
def part_size(begin, end):
    """Rows in a part of a code's rows ``begin`` to ``end``."""
    return tl.maximum(tl.cdiv(end - begin, PARTS), PART)


@triton.jit
def part_kernel(values, order, offsets, partial, dim, WIDTH: constexpr):
    """Sum a part of a code's rows ``order[offsets[code]:offsets[code + 1]]`` in the dtype of ``partial``."""
    program = tl.program_id(0).to(tl.int64)
    code, part = program // PARTS, (program % PARTS).to(tl.int32)
    column = tl.program_id(1) * WIDTH + tl.arange(0, WIDTH)
    begin, end = tl.load(offsets + code), tl.load(offsets + code + 1)
    size = part_size(begin, end)
    first = begin + part * size
    last = tl.minimum(first + size, end)
    if first < last:
        total = tl.zeros([ROWS, WIDTH], partial.dtype.element_ty)
        for start in range(first, last, ROWS):
            place = start + tl.arange(0, ROWS)[:, None]
            row = load_if(order + place, place < last)
            value = load_if(values + row * dim + column, (place < last) & (column < dim))
            total += value.to(partial.dtype.element_ty)
        tl.store(partial + program * dim + column, tl.sum(total, 0), mask=column < dim)


@triton.jit
def sum_kernel(partial, offsets, sums, dim, WIDTH: constexpr):
    """Sum the parts of a code; 0 for a code without rows."""
    code = tl.program_id(0).to(tl.int64)
    column = tl.program_id(1) * WIDTH + tl.arange(0, WIDTH)
    begin, end = tl.load(offsets + code), tl.load(offsets + code + 1)
    part = tl.arange(0, PARTS)[:, None]
    there = (part * part_size(begin, end) < end - begin) & (column < dim)[None, :]
    total = load_if(partial + (code * PARTS + part) * dim + column[None, :], there)
    tl.store(sums + code * dim + column, tl.sum(total, 0), mask=column < dim)


# Rows by code of codes that still exist, with the version of these codes and how many there may be.
_sorted = WeakTensorKeyDictionary()


def _remembered(codes: Tensor, num_codes: int) -> tuple[Tensor, Tensor]:
    """:func:`sorted_by_key`, once for codes that stay the same, as frozen ones do."""
    state = codes._version, num_codes
    known, found = _sorted.get(codes, (None, None))
    if known != state:
        found = sorted_by_key(codes, num_codes)
        _sorted[codes] = state, found
    return found  # type: ignore[no-any-return]


def sum_rows(values: Tensor, codes: Tensor, num_codes: int, dtype: torch.dtype) -> Tensor:
    """Sums ``[K, D]`` of the rows of each code, 0 for a code without rows; nothing is read back from the device.

    Args:
        values: Rows ``[N, D]`` on a CUDA device.
        codes: Codes ``[N]`` int64 in [0, K).
        num_codes: K.
        dtype: Dtype of the sums and of their accumulation.

    Raises:
        ValueError: The values are not ``[N, D]``, or there is not one code per row there.
        TypeError: They are not int64.
    """
    check_fit("codes [N] int64", codes, N=len(values))
    order, offsets = _remembered(codes, num_codes)
    values = values.contiguous()
    dim = values.shape[1]
    width = min(64, triton.next_power_of_2(dim))
    columns = triton.cdiv(dim, width)
    partial = values.new_empty(num_codes * PARTS.value, dim, dtype=dtype)
    sums = values.new_empty(num_codes, dim, dtype=dtype)
    with torch.cuda.device_of(values):
        part_kernel[(num_codes * PARTS.value, columns)](
            values, order, offsets, partial, dim, WIDTH=width, num_warps=1, **COMPILE
        )
        sum_kernel[(num_codes, columns)](partial, offsets, sums, dim, WIDTH=width, num_warps=1, **COMPILE)
    return sums
