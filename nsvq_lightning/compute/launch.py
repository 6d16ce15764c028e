"""Compile options that all Triton kernels share; Triton itself is not imported.

Triton compiles a kernel anew for integers that are 1 or multiples of 16. Numbers that change from step to step, such as
that of the splats in view, are named in ``do_not_specialize``, or kernels would compile in the middle of a run.
"""

from __future__ import annotations

__all__ = ["COMPILE"]

COMPILE = {"enable_fp_fusion": True}
"""Options of every launch. Triton's default is about to change; values on which the forward and backward pass must
agree to the bit are computed with an explicit ``fma``."""
