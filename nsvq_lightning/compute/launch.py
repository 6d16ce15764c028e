"""Compile options that all Triton kernels share; Triton itself is not imported."""

from __future__ import annotations

__all__ = ["COMPILE"]

COMPILE = {"enable_fp_fusion": True}
"""Options of every launch. Triton's default is about to change; values on which the forward and backward pass must
agree to the bit are computed with an explicit ``fma``."""
