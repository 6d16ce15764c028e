"""Counter-based normal noise: vector m of a seed is a function of (seed, m), whichever thread computes it, and when.

Two rounds of 64-bit mixing (the finalizer of splitmix64, with the seed entering twice) give two uniform values, which
the Box-Muller transform turns into two normal ones. There are no branches and no tables, so all of it is vectorized.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray

from nsvq_lightning.compute.jit import inline, kernel, thread_count
from nsvq_lightning.compute.lanes import broadcast, fma, load, log2, store, vsqrt

__all__ = ["COS", "MULTIPLIERS", "SIN", "draw_seed", "fill_normal", "normal_vectors"]

MULTIPLIERS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_GOLDEN, _FIRST, _SECOND = (np.uint64(value) for value in MULTIPLIERS)
_S27, _S30, _S31, _S40, _LOW24 = np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(40), np.uint64(0xFFFFFF)
_UNIT = np.float32(2.0**-24)
_MINUS_TWO_LN2 = np.float32(-2 * np.log(2))
# cos 2πt and (sin 2πt)/t as polynomials of t² on |t| ≤ 1/2 (Chebyshev fits), highest power first; errors 1e-6.
COS = (-21.071106, 58.790493, -85.271622, 64.928658, -19.738981, 0.99999923)
SIN = (-12.471244, 41.342884, -76.614471, 81.599945, -41.341591, 6.283185)
_C0, _C1, _C2, _C3, _C4, _C5 = (np.float32(value) for value in COS)
_S0, _S1, _S2, _S3, _S4, _S5 = (np.float32(value) for value in SIN)


def draw_seed(generator: torch.Generator) -> int:
    """A 63-bit seed from a torch generator."""
    device = generator.device
    return int(torch.randint(0, 2**63 - 1, (), dtype=torch.int64, device=device, generator=generator))


@inline
def _uniforms(seed, pair, radius, angle):  # type: ignore[no-untyped-def]
    """Sixteen pairs starting at ``pair``: radius in (0, 1], angle in [-1/2, 1/2) turns, 24 random bits each."""
    key = np.uint64(seed)
    second_key = (key ^ (key >> _S31)) * _SECOND
    for lane in range(16):
        bits = (np.uint64(pair + lane) + key) * _GOLDEN
        bits = (bits ^ (bits >> _S30)) * _FIRST
        bits = (bits ^ (bits >> _S27) ^ second_key) * _SECOND
        bits = bits ^ (bits >> _S31)
        radius[lane] = np.float32(np.int32(bits >> _S40) + np.int32(1)) * _UNIT
        angle[lane] = np.float32(np.int32(bits & _LOW24)) * _UNIT - np.float32(0.5)


@inline
def _cosine(t):  # type: ignore[no-untyped-def]
    value = fma(broadcast(_C0), t, broadcast(_C1))
    value = fma(fma(value, t, broadcast(_C2)), t, broadcast(_C3))
    return fma(fma(value, t, broadcast(_C4)), t, broadcast(_C5))


@inline
def _sine(t):  # type: ignore[no-untyped-def]
    value = fma(broadcast(_S0), t, broadcast(_S1))
    value = fma(fma(value, t, broadcast(_S2)), t, broadcast(_S3))
    return fma(fma(value, t, broadcast(_S4)), t, broadcast(_S5))


@inline
def fill_normal(seed, first, count, out, radius, angle):  # type: ignore[no-untyped-def]
    """Write vectors ``first`` to ``first + count`` (both even) of a seed to ``out [count · 16]``.

    ``radius`` and ``angle`` are scratch, ``[16]`` each.
    """
    for pair in range(count // 2):
        _uniforms(seed, (first // 2 + pair) * 16, radius, angle)
        length = vsqrt(log2(load(radius, 0)) * broadcast(_MINUS_TWO_LN2))
        turn = load(angle, 0)
        store(out, pair * 32, length * _cosine(turn * turn))
        store(out, pair * 32 + 16, length * (turn * _sine(turn * turn)))


@kernel
def _normal_kernel(seed, out):  # type: ignore[no-untyped-def]
    vectors = out.size // 16
    for block in prange((vectors + 63) // 64):
        radius, angle = np.empty(16, np.float32), np.empty(16, np.float32)
        first = block * 64
        fill_normal(seed, first, min(64, vectors - first), out[first * 16 :], radius, angle)


def normal_vectors(seed: int, vectors: int) -> NDArray[np.float32]:
    """The first ``vectors`` (an even number) vectors of 16 standard normal values of a seed, ``[vectors · 16]``.

    Raises:
        ValueError: ``vectors`` is negative or odd.
    """
    if vectors < 0 or vectors % 2:
        raise ValueError(f"vectors must be even and at least 0, got {vectors}")
    out = np.empty(vectors * 16, np.float32)
    thread_count()
    _normal_kernel(seed, out)
    return out
