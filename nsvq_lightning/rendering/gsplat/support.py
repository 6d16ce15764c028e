"""Whether gsplat can render here; checked only where its back-end is requested by name."""

from __future__ import annotations

import importlib
import importlib.util
import textwrap
from functools import cache

from torch import Tensor

from nsvq_lightning.compute.devices import not_on_cuda

__all__ = ["obstacle"]

INSTALL = "pip install 'nsvq-lightning[gsplat]'"
COMPILING = "it needs nvcc of torch's CUDA version and a C++ compiler, or a wheel built for this torch"


def obstacle(like: Tensor) -> str | None:
    """Why gsplat cannot take tensors such as ``like``, with a remedy; None where it can.

    The first call with tensors on a GPU loads gsplat's CUDA code, which may compile it: minutes, once per machine.
    """
    problem = not_on_cuda(like)
    if problem is not None:
        return problem
    if importlib.util.find_spec("gsplat") is None:
        return f"it needs the package gsplat: {INSTALL}"
    return missing_kernels()


@cache
def missing_kernels() -> str | None:
    """Why gsplat's CUDA code is unavailable; None once it is loaded."""
    try:
        # Its functions import this at their first call, and fail with an AttributeError on None where nvcc is missing.
        backend = importlib.import_module("gsplat.cuda._backend")
    except (ImportError, OSError, RuntimeError) as error:
        said = textwrap.shorten(str(error), 300)  # a compiler's output can fill pages
        return f"gsplat could not compile or load its CUDA code ({said}); {COMPILING}"
    if getattr(backend, "_C", None) is None:
        return f"gsplat is installed without its CUDA code and found no CUDA toolkit to compile it with; {COMPILING}"
    return None
