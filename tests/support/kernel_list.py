"""The lines of ``kernels.txt`` that a process has come to need: :func:`used` after whatever it has done."""

from __future__ import annotations

import gc
import re
from typing import Any

from numba.core.registry import CPUDispatcher

from nsvq_lightning.compute.jit import parallel
from nsvq_lightning.compute.kernel_cache import KernelCache


def used() -> list[str]:
    """A line for each kernel and types of arguments."""
    gc.unfreeze()  # what the command line has imported
    return [
        f"{module_of(kernel)} {name_of(kernel)} {_types(arguments)}"
        for kernel in gc.get_objects()
        if isinstance(kernel, CPUDispatcher) and isinstance(kernel._cache, KernelCache)
        for arguments in kernel.overloads
    ]


def own_part(kernel: Any) -> Any:
    """The compiled function of one part, where a kernel has such, else the kernel."""
    is_whole = kernel.py_func.__code__.co_filename == parallel.__code__.co_filename
    return kernel.py_func.__closure__[0].cell_contents if is_whole else kernel


def module_of(kernel: Any) -> str:
    return kernel.py_func.__module__.removeprefix("nsvq_lightning.")


def name_of(kernel: Any) -> str:
    """What makes the kernel in its module: its name, or a call of the function around it."""
    maker, _, inner = kernel.py_func.__qualname__.partition(".<locals>.")
    if not inner:
        return maker
    function = own_part(kernel).py_func
    known = dict(zip(function.__code__.co_freevars, function.__closure__, strict=True))
    return f"{maker}({known['dim'].cell_contents})"


def _types(arguments: Any) -> str:
    """Types as Numba's own names, arrays as ``float32[:, ::1]``."""
    arrays = r"Array\((\w+), (\d), 'C', False, aligned=True\)"
    text = re.sub(arrays, lambda found: f"{found[1]}[{':, ' * (int(found[2]) - 1)}::1]", repr(arguments))
    return text.replace("bool", "boolean")
