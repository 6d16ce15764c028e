"""A machine with more cores: the parts of each kernel one after the other, and when so many cores would be done.

Numba starts all parallel work through one C function; another one takes its place here. It lets a kernel's parts run
one by one and times each; cores that take them in turn would be done after the longest queue, plus the time to wake
them. What lies between the kernels counts as it is. Each core is assumed to be as fast as one alone: what cores share,
above all memory, shows where one and two of them are compared with what one and two threads really take.
"""

import ctypes
import sys
import time
from collections.abc import Sequence
from heapq import heapreplace
from statistics import median

import numpy as np
from llvmlite import binding

from nsvq_lightning.compute import jit
from nsvq_lightning.compute.rows import clear_all

# Seconds of each part of a kernel that was run part by part, and of the kernel as a whole.
Region = tuple[list[float], float]

# Name of the function, and its arguments: share, base, counts, steps, state; two numbers, threads.
PARALLEL_FOR = "numba_parallel_for"
_FOR = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5, *[ctypes.c_int64] * 3)
_SHARE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4)
# Modules that make as many parts as there are threads.
BY_THREADS = ("nsvq_lightning.quality.ssim_cpu", "nsvq_lightning.quantize.kmeans")


class Regions:
    """What kernels do in parallel, from the first on that a process runs.

    Attributes:
        seen: Since the last look.
        wake: Seconds to wake a second thread, measured.

    Raises:
        ValueError: There is only one thread.
    """

    def __init__(self) -> None:
        if jit.thread_count() == 1:
            raise ValueError("with one thread, kernels have no parts to be timed: allow two (OMP_NUM_THREADS=2)")
        self.seen: list[Region] = []
        self._one_by_one, self._call = False, 0.0
        self._plain = _FOR(binding.address_of_symbol(PARALLEL_FOR))
        self._timed = _FOR(self._run)
        binding.add_symbol(PARALLEL_FOR, ctypes.cast(self._timed, ctypes.c_void_p).value)
        self.wake = median(whole for _, whole in self._idle())
        self._one_by_one = True
        self._call = median(seconds[0] for seconds, _ in self._idle())
        self._one_by_one = False

    def _idle(self) -> list[Region]:
        """Kernels that do nothing; the first ones are left out, as they compile and start threads."""
        for _ in range(200):
            clear_all(2, np.zeros(32, np.float32))
        return self.taken()[50:]

    def taken(self) -> list[Region]:
        """What was seen since the last call."""
        seen, self.seen = self.seen, []
        return seen

    def emulate(self, cores: int) -> None:
        """From now on, run the parts of a machine with so many cores one by one; 0 for kernels as they are."""
        self._one_by_one = cores > 0
        for name in BY_THREADS:
            vars(sys.modules[name])["thread_count"] = (lambda: cores) if cores else jit.thread_count

    def _run(self, share: int, base: int, counts: int, steps: int, state: int, *numbers: int) -> None:
        start = time.perf_counter()
        seconds = []
        if self._one_by_one:
            fields = ctypes.cast(state, ctypes.POINTER(ctypes.c_int64))
            for part in range(fields[jit.PARTS]):
                fields[jit.NEXT], fields[jit.END] = part, part + 1
                began = time.perf_counter()
                _SHARE(share)(base, counts, steps, state)
                seconds.append(max(0.0, time.perf_counter() - began - self._call))
        else:
            self._plain(share, base, counts, steps, state, *numbers)
        self.seen.append((seconds, time.perf_counter() - start))


def makespan(seconds: Sequence[float], cores: int) -> float:
    """When the last of some cores is done, each of which takes the next part when it is done with one."""
    busy = [0.0] * cores
    for each in seconds:
        heapreplace(busy, busy[0] + each)
    return max(busy)
