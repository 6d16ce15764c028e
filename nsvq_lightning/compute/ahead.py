"""Compile the kernels of a run in further processes, while it imports, loads its photos and compiles from the front.

``kernels.txt`` names them with the types of their arguments; the first are those that a first iteration needs last. Who
needs a kernel that another process compiles waits for it (:mod:`nsvq_lightning.compute.kernel_cache`).
"""

import atexit
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from numba import types

from nsvq_lightning.compute import kernel_cache
from nsvq_lightning.compute.environment import usable_cores

LIST = Path(__file__).with_name("kernels.txt")


def kernels() -> Iterator[tuple[Any, Any]]:
    """Each kernel of the list with the types of its arguments."""
    for line in LIST.read_text(encoding="utf-8").splitlines():
        module, name, arguments = line.split(maxsplit=2)
        yield eval(name, vars(import_module(f"nsvq_lightning.{module}"))), eval(arguments, vars(types))


def start() -> None:
    """Start a process for each further core, unless the first kernel is on the disk; they end with this one."""
    cache = next(kernels())[0]._cache
    if not isinstance(cache, kernel_cache.KernelCache) or cache.is_there():
        return
    for _ in range(min(4, usable_cores() - 1)):  # more would wait for one another
        with suppress(OSError):
            process = subprocess.Popen(
                [sys.executable, "-m", __name__],
                # They find the package where this process has found it.
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            atexit.register(process.terminate)


if __name__ == "__main__":
    kernel_cache.waits = False
    for kernel, arguments in kernels():
        with suppress(kernel_cache.BusyError):
            kernel.compile(arguments)
        if hasattr(os, "nice"):
            os.nice(1)  # the run waits for the first ones, and trains while the last ones are compiled
