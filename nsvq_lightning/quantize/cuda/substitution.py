"""Error substitution on a GPU: gather, residual, noise and result of a row in one pass, gradients in another.

As on the CPU, the backward pass takes the direction from the result, not from a second draw: with x̃ - x = ‖r‖ d̂ the
radial term (g·d̂) r/‖r‖ is (g·(x̃ - x)) r/‖r‖². The noise of a row is that of the CPU kernel.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.launch import COMPILE
from nsvq_lightning.compute.memory import check_tensor
from nsvq_lightning.quantize.cuda.noise import normal
from nsvq_lightning.quantize.cuda.sums import sum_rows

__all__ = ["substitute", "substitute_backward"]

BLOCK = 1024
"""Elements per program."""
TINY = tl.constexpr(torch.finfo(torch.float32).tiny)


@triton.jit
def chosen_rows(
    x, rows, codebook, codes, count, height, num_codes, DIM: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr
):
    """Place among the chosen rows, columns, row numbers, masks (inside the tile, and valid), rows, and their codes.

    A row outside the table, or whose code is outside the codebook, is NaN; raising an error would need a sync.
    """
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)[:, None]
    column = tl.arange(0, WIDTH)[None, :]
    inside = (i < count) & (column < DIM)
    row = tl.load(rows + i, mask=i < count, other=0)
    code = tl.load(codes + i, mask=i < count, other=0)
    there = inside & (row >= 0) & (row < height) & (code >= 0) & (code < num_codes)
    value = tl.load(x + row * DIM + column, mask=there, other=float("nan"))
    centre = tl.load(codebook + code * DIM + column, mask=there, other=float("nan"))
    return i, column, row, inside, there, value, centre


@triton.jit
def inverses(squared):
    """1/s, and 0 where s is 0 (or its inverse too large): a zero vector has no direction."""
    return tl.where(squared > TINY, 1 / tl.where(squared > TINY, squared, 1.0), 0.0)


@triton.jit(do_not_specialize=["seed", "count", "height"])
def substitute_kernel(
    seed, aim, spread, x, rows, codebook, codes, out, count, height, num_codes, DIM: tl.constexpr, ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
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
    grad, x, rows, codebook, codes, out, grad_x, radials, count, height, num_codes, DIM: tl.constexpr,
    ROWS: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Write the gradient of the rows to the table of all rows, and minus its radial term to ``radials``."""
    i, column, row, inside, there, value, centre = chosen_rows(
        x, rows, codebook, codes, count, height, num_codes, DIM, ROWS, WIDTH
    )
    slope = tl.load(grad + i * DIM + column, mask=inside, other=0.0)
    moved = tl.where(inside, tl.load(out + i * DIM + column, mask=inside, other=0.0) - value, 0.0)
    residual = tl.where(inside, value - centre, 0.0)
    scale = tl.sum(slope * moved, 1)[:, None] * inverses(tl.sum(residual * residual, 1)[:, None])
    radial = residual * scale
    tl.store(grad_x + row * DIM + column, slope + radial, mask=there)
    tl.store(radials + i * DIM + column, -radial, mask=inside)


def _tile(dim: int) -> dict[str, int]:
    width = triton.next_power_of_2(dim)
    return {"DIM": dim, "WIDTH": width, "ROWS": max(1, BLOCK // width)}


def _check(x: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor) -> None:
    check_tensor("x", x, (len(x), codebook.shape[-1]), x.device)
    check_tensor("rows", rows, (rows.numel(),), x.device, torch.int64)
    check_tensor("codebook", codebook, (len(codebook), x.shape[1]), x.device)
    check_tensor("codes", codes, (len(rows),), x.device, torch.int64)


def substitute(
    seed: int, x: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor, *, aim: float = 0.0, spread: float = 1.0
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
    _check(x, rows, codebook, codes)
    out = x.new_empty(len(rows), x.shape[1])
    tile = _tile(x.shape[1])
    if len(rows):
        with torch.cuda.device_of(x):
            substitute_kernel[(triton.cdiv(len(rows), tile["ROWS"]),)](
                seed, float(aim), float(spread), x, rows, codebook, codes, out, len(rows), len(x), len(codebook),
                **tile, **COMPILE,
            )  # fmt: skip
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
    _check(x, rows, codebook, codes)
    for name, table in (("grad", grad), ("out", out)):
        check_tensor(name, table, (len(rows), x.shape[1]), x.device)
    grad_x, radials = torch.zeros_like(x), torch.empty_like(out)
    tile = _tile(x.shape[1])
    if len(rows):
        with torch.cuda.device_of(x):
            radial_kernel[(triton.cdiv(len(rows), tile["ROWS"]),)](
                grad, x, rows, codebook, codes, out, grad_x, radials, len(rows), len(x), len(codebook), **tile,
                **COMPILE,
            )  # fmt: skip
    return grad_x, sum_rows(radials, codes, len(codebook), x.dtype)
