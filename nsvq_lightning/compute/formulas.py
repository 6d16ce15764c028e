"""Formulas that are written once, and compiled by Numba for a CPU and by Triton for a GPU.

A module of formulas has helpers for Numba (:func:`nsvq_lightning.compute.jit.inline`) that know nothing but their
arguments, numbers (float32 of NumPy), one another, and of :mod:`nsvq_lightning.compute.simd` what ``triton.language``
has under the same name. So they have neither loops nor memory: kernels read and write, formulas compute.
"""

from collections.abc import Callable
from functools import cache
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from nsvq_lightning.compute import simd


def in_language(
    formulas: ModuleType, language: Any, compiler: Callable[[Any], Any], number: Callable[[float], Any]
) -> ModuleType:
    """The formulas and numbers of a module, the same code in another language.

    Args:
        formulas: The module.
        language: What stands for ``simd``.
        compiler: Makes of a Python function what others call.
        number: Makes of a constant what they calculate with.
    """
    twin = ModuleType(formulas.__name__, formulas.__doc__)
    names = vars(twin)
    for name, value in vars(formulas).items():
        if hasattr(value, "py_func"):
            names[name] = compiler(FunctionType(value.py_func.__code__, names, name))
        elif isinstance(value, np.float32):
            names[name] = number(float(value))
        elif value is simd:
            names[name] = language
    return twin


@cache
def for_triton(formulas: ModuleType) -> ModuleType:
    """The formulas and numbers of a module for the kernels of Triton."""
    import triton
    import triton.language as tl
    from triton.runtime.jit import JITFunction

    # In Triton's interpreter, the product of a constant of the compiler and a tensor would be such a constant.
    number = tl.constexpr if isinstance(triton.jit(in_language), JITFunction) else float
    return in_language(formulas, tl, triton.jit, number)
