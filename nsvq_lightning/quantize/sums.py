"""Sums of rows by code: the gradient of a codebook, and the means of k-means. Reproducible to the bit on any device."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import kernel, thread_count
from nsvq_lightning.compute.memory import INT64, flat_checked, outside

__all__ = ["count_hits", "lookup", "sum_by_code"]


@kernel
def _sum_rows(values, codes, sums, parts):  # type: ignore[no-untyped-def]
    """Each part owns a range of codes and scans all rows, so the order of the threads cannot change a sum."""
    for part in prange(parts):
        first, last = part * sums.shape[0] // parts, (part + 1) * sums.shape[0] // parts
        for i in range(codes.shape[0]):
            code = codes[i]
            if first <= code < last:
                for j in range(values.shape[1]):
                    sums[code, j] += values[i, j]


def sum_by_code(values: Tensor, codes: Tensor, num_codes: int, dtype: torch.dtype | None = None) -> Tensor:
    """Sum the rows of each code, in the order of the rows.

    Args:
        values: Rows ``[N, D]``.
        codes: Codes ``[N]`` int64; a row whose code is not in [0, K) is ignored.
        num_codes: K.
        dtype: Dtype of the sums, that of ``values`` by default.

    Returns:
        Sums ``[K, D]``; 0 for a code without rows.

    Raises:
        ValueError: The values are not ``[N, D]``, or there is not one code per row.
        TypeError: The codes are not int64.
    """
    if values.dim() != 2 or codes.shape != values.shape[:1]:
        raise ValueError(
            f"values must have shape [N, D] and codes [N], got {list(values.shape)} and {list(codes.shape)}"
        )
    values, dtype = values.detach(), dtype or values.dtype
    if kernels_for(values) == "cuda":
        from nsvq_lightning.quantize.cuda.sums import sum_rows

        return sum_rows(values.contiguous(), codes, num_codes, dtype)
    if values.device.type == "cpu" and values.dtype in (torch.float32, torch.float64):
        sums = torch.zeros(num_codes, values.shape[1], dtype=dtype)
        numbers = flat_checked("codes", codes.contiguous(), (len(values),), INT64)
        _sum_rows(values.contiguous().numpy(), numbers, sums.numpy(), thread_count())
        return sums
    return _sum_segments(values.to(dtype), codes, num_codes)


def _sum_segments(values: Tensor, codes: Tensor, num_codes: int) -> Tensor:
    """Sort the rows by code, then sum segments: no atomics, whose order varies from run to run."""
    order = torch.argsort(codes, stable=True)
    lengths = torch.bincount(codes, minlength=num_codes)
    return torch.segment_reduce(values[order], "sum", lengths=lengths, axis=0, unsafe=True, initial=0)


@partial(kernel, parallel=False)
def _count_hits(codes, usage):  # type: ignore[no-untyped-def]
    """Count the codes that were hit, unless some are out of range; returns how many are."""
    hit, missing = np.zeros(usage.shape[0], np.uint8), 0
    for i in range(codes.shape[0]):
        if 0 <= codes[i] < usage.shape[0]:
            hit[codes[i]] = 1
        else:
            missing += 1
    for code in range(usage.shape[0] if missing == 0 else 0):
        usage[code] += hit[code]
    return missing


def count_hits(codes: Tensor, usage: Tensor) -> None:
    """Add 1 to ``usage [K]`` (int64, in place) for every code that is among ``codes [N]``, however often.

    Raises:
        ValueError: ``codes`` is not ``[N]``, ``usage`` is not contiguous, or a code is out of range.
        TypeError: A dtype is wrong.
    """
    if usage.device.type == "cpu":
        numbers = flat_checked("codes", codes.contiguous(), (codes.numel(),), INT64)
        if _count_hits(numbers, flat_checked("usage", usage, (usage.numel(),), INT64)):
            raise outside("codes", numbers, len(usage))
    else:
        hit = torch.zeros_like(usage)
        hit[codes] = 1
        usage += hit


def lookup(codebook: Tensor, codes: Tensor) -> Tensor:
    """Rows ``[N, D]`` of ``codebook [K, D]`` for the codes, with a gradient that is summed in a fixed order."""
    result: Tensor = _Lookup.apply(codebook, codes)  # type: ignore[no-untyped-call]
    return result


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, codebook: Tensor, codes: Tensor) -> Tensor:
        ctx.save_for_backward(codes)
        ctx.num_codes = codebook.shape[0]
        return codebook.index_select(0, codes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (codes,) = ctx.saved_tensors
        return sum_by_code(grad, codes, ctx.num_codes), None
