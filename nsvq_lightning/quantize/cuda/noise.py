"""The counter-based normal noise of :mod:`nsvq_lightning.quantize.noise` inside a kernel: the same values.

The integers are the same, and the arithmetic after them is the same sequence of roundings, polynomials included.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.launch import COMPILE
from nsvq_lightning.quantize import noise

__all__ = ["normal", "normal_vectors"]

GOLDEN, FIRST, SECOND = (tl.constexpr(value) for value in noise.MULTIPLIERS)
C0, C1, C2, C3, C4, C5 = (tl.constexpr(value) for value in noise.COS)
S0, S1, S2, S3, S4, S5 = (tl.constexpr(value) for value in noise.SIN)
UNIT = tl.constexpr(2.0**-24)
MINUS_TWO_LN2 = tl.constexpr(-2 * math.log(2))
SPLIT = tl.constexpr(0x3F3504F3)
"""Bits of 1/√2: a mantissa lies in [1/√2, √2)."""
TWO_LOG2_E = tl.constexpr(2 / math.log(2))
L0, L1, L2, L3, L4 = (tl.constexpr(1 / odd) for odd in (11, 9, 7, 5, 3))

BLOCK = 1024


@triton.jit
def log2(x):
    """Binary logarithm of positive normal numbers as on the CPU: 2 artanh((m - 1)/(m + 1)) and the exponent."""
    bits = x.to(tl.int32, bitcast=True)
    exponent = (bits - SPLIT) >> 23
    mantissa = (bits - (exponent << 23)).to(tl.float32, bitcast=True)
    s = tl.div_rn(mantissa - 1, mantissa + 1)
    squared = s * s
    series = tl.fma(tl.zeros_like(s) + L0, squared, L1)
    series = tl.fma(tl.fma(series, squared, L2), squared, L3)
    series = tl.fma(tl.fma(series, squared, L4), squared, 1.0)
    return tl.fma(s * TWO_LOG2_E, series, exponent.to(tl.float32))


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
    value = tl.fma(tl.where(even, C0, S0), t, tl.where(even, C1, S1))
    value = tl.fma(tl.fma(value, t, tl.where(even, C2, S2)), t, tl.where(even, C3, S3))
    value = tl.fma(tl.fma(value, t, tl.where(even, C4, S4)), t, tl.where(even, C5, S5))
    return length * tl.where(even, value, turn * value)


@triton.jit(do_not_specialize=["seed", "count"])
def normal_kernel(seed, out, count, BLOCK: tl.constexpr):
    """The first ``count`` values of a seed."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    tl.store(out + at, normal(seed, at // 16, (at % 16).to(tl.int32)), mask=at < count)


def normal_vectors(seed: int, vectors: int, device: torch.device) -> Tensor:
    """The first ``vectors`` vectors of 16 standard normal values of a seed, ``[vectors · 16]``."""
    out = torch.empty(vectors * 16, device=device)
    if vectors:
        with torch.cuda.device_of(out):
            normal_kernel[(triton.cdiv(vectors * 16, BLOCK),)](seed, out, vectors * 16, BLOCK=BLOCK, **COMPILE)
    return out
