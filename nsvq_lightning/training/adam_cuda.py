"""One step of Adam over a table of rows, in a single pass over memory.

The step is memory-bound, so what helps is touching less memory: only the leading columns, or only the rows that have a
gradient. Rounding matches the CPU kernel, operation by operation.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.launch import COMPILE
from nsvq_lightning.compute.memory import check_tensor

__all__ = ["adam_update"]

BLOCK = 1024
"""Elements per program."""


@triton.jit
def update(weights, gradients, firsts, seconds, at, chosen, step, gain, decay, fresh, root, eps):
    """Adam on the chosen elements."""
    weight = tl.load(weights + at, mask=chosen, other=0.0)
    gradient = tl.load(gradients + at, mask=chosen, other=0.0)
    first = tl.load(firsts + at, mask=chosen, other=0.0)
    second = tl.load(seconds + at, mask=chosen, other=0.0)
    mean = tl.fma(gradient - first, gain, first)
    square = tl.fma(second, decay, gradient * gradient * fresh)
    moved = weight - tl.div_rn(mean * step, tl.fma(tl.sqrt_rn(square), root, eps))
    tl.store(weights + at, moved, mask=chosen)
    tl.store(firsts + at, mean, mask=chosen)
    tl.store(seconds + at, square, mask=chosen)


@triton.jit
def update_columns_kernel(
    weights, gradients, firsts, seconds, count, stride, step, gain, decay, fresh, root, eps, COLUMNS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Update the leading ``COLUMNS`` (0: all) of each row of ``stride`` elements, ``count`` elements in all."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    chosen = at < count
    if COLUMNS > 0:
        at = at // COLUMNS * stride + at % COLUMNS
    update(weights, gradients, firsts, seconds, at, chosen, step, gain, decay, fresh, root, eps)


@triton.jit
def update_rows_kernel(
    weights, gradients, firsts, seconds, count, stride, step, gain, decay, fresh, root, eps, ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
):  # fmt: skip
    """Update those of ``count`` rows that have a gradient; NaN counts as one."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)[:, None]
    column = tl.arange(0, WIDTH)[None, :]
    inside = (row < count) & (column < stride)
    at = row * stride + column
    gradient = tl.load(gradients + at, mask=inside, other=0.0)
    has_gradient = tl.max((gradient != 0).to(tl.int32), 1)[:, None] > 0
    update(weights, gradients, firsts, seconds, at, inside & has_gradient, step, gain, decay, fresh, root, eps)


def adam_update(
    weights: Tensor,
    gradients: Tensor,
    first: Tensor,
    second: Tensor,
    *,
    step: int,
    lr: float,
    betas: tuple[float, float],
    eps: float,
    columns: int | None = None,
    rows_with_gradient: bool = False,
) -> Callable[[], None]:
    """Prepare an in-place Adam step on contiguous float32 tensors ``[N, ...]`` on a GPU; call the result to run it.

    Args:
        weights: The parameter.
        gradients: Its gradient.
        first: First moment, the mean of the gradients.
        second: Second moment, the mean of their squares.
        step: 1-based number of the step, for bias correction.
        lr: Learning rate.
        betas: Decay rates of the two moments.
        eps: Added to the root of the second moment.
        columns: Update only this many leading columns of each row; the caller guarantees that gradient and moments of
            the others are 0, so that Adam would not change them.
        rows_with_gradient: Leave rows whose gradient is 0 unchanged, moments included.

    Raises:
        ValueError: The tensors differ in shape or device, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    given = {"weights": weights, "gradients": gradients, "first": first, "second": second}
    for name, tensor in given.items():
        check_tensor(name, tensor, weights.shape, weights.device)
    tables = [tensor.detach() for tensor in given.values()]
    factors = _factors(step, lr, betas, eps)
    rows, stride = weights.shape[0], math.prod(weights.shape[1:])

    def launch() -> None:
        if rows * stride == 0 or columns == 0:
            return
        with torch.cuda.device_of(weights):
            if rows_with_gradient:
                width = triton.next_power_of_2(stride)
                height = max(1, BLOCK // width)
                update_rows_kernel[(triton.cdiv(rows, height),)](
                    *tables, rows, stride, *factors, ROWS=height, WIDTH=width, **COMPILE
                )
            else:
                leading = columns if columns is not None and columns < stride else 0
                count = rows * (leading or stride)
                update_columns_kernel[(triton.cdiv(count, BLOCK),)](
                    *tables, count, stride, *factors, COLUMNS=leading, BLOCK=BLOCK, **COMPILE
                )

    return launch


def _factors(step: int, lr: float, betas: tuple[float, float], eps: float) -> tuple[float, ...]:
    """Step size, gradient's share in the first moment, decay and share in the second, 1 / root of its bias, eps."""
    first, second = (1 - beta**step for beta in betas)
    return lr / first, 1 - betas[0], betas[1], 1 - betas[1], 1 / math.sqrt(second), eps
