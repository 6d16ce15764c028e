"""How Triton's kernels are compiled, all of them alike; Triton itself is not imported."""

from __future__ import annotations

__all__ = ["COMPILE"]

COMPILE = {"enable_fp_fusion": True}
"""Options of every launch. Triton's own default is about to change; what forward and backward pass must agree on to the
bit is written as ``fma``."""
