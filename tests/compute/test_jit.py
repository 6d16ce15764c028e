"""The number of threads that the user has set holds for all kernels, from the first one on."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from nsvq_lightning.compute.jit import compile_seconds, parallel, thread_count

SCRIPT = """
import sys
import torch
torch.set_num_threads(int(sys.argv[1]))
from nsvq_lightning.compute.jit import thread_count
from nsvq_lightning.quantize.nearest import nearest
nearest(torch.zeros(8, 3), torch.zeros(4, 3))
print(torch.get_num_threads(), thread_count())
"""


@pytest.mark.parametrize("threads", [1, 2])
def test_numba_leaves_the_number_of_threads_as_it_was(threads: int) -> None:
    ran = subprocess.run([sys.executable, "-c", SCRIPT, str(threads)], capture_output=True, text=True, check=True)
    in_torch, in_kernels = map(int, ran.stdout.split())
    assert in_torch == threads
    assert 1 <= in_kernels <= threads


FORKED = """
import multiprocessing
import nsvq_lightning as nl
import torch
torch.set_num_threads(2)
from splat_scenes import front_camera, random_splats
splats = random_splats(500)
def shown(number):
    image = nl.render(splats, front_camera()).image
    return float(image.double().mean()), float(torch.ones(1 << 22).cumsum(0)[-1])
own = shown(0)
with multiprocessing.get_context("fork").Pool(2) as pool:
    assert pool.map_async(shown, range(2)).get(60) == [own, own]
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_process_that_is_forked_after_a_render_renders() -> None:
    """It has none of the threads of the other one, which it would wait for."""
    support = str(Path(__file__).parents[1] / "support")
    paths = os.pathsep.join([*sys.path, support])
    subprocess.run([sys.executable, "-c", FORKED], check=True, timeout=120, env=os.environ | {"PYTHONPATH": paths})


FEW_PARTS = """
import os
import numba, numpy as np, torch
torch.set_num_threads(4)
from nsvq_lightning.compute.jit import thread_count
from nsvq_lightning.compute.rows import clear_all
threads = thread_count()
clear_all(64, np.zeros(64, np.float32))
running = set(os.listdir("/proc/self/task")) if os.path.isdir("/proc/self/task") else set()
clear_all(2, np.zeros(64, np.float32))
left = set(os.listdir("/proc/self/task")) if running else set()
print(threads, numba.get_num_threads(), len(running - left))
"""


def test_a_kernel_of_few_parts_leaves_the_others_their_threads() -> None:
    """Numba keeps the number that a kernel has run on for the next one, and OpenMP ends the threads beyond it."""
    four = {**os.environ, "NUMBA_NUM_THREADS": "4", "OMP_NUM_THREADS": "4"}
    ran = subprocess.run([sys.executable, "-c", FEW_PARTS], env=four, capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["4", "4", "0"]


@parallel
def _add_up(part, parts, values, room):
    _ = np.empty(room)
    total = 0
    for value in values[len(values) * part // parts : len(values) * (part + 1) // parts]:
        total += value
    return total


@pytest.mark.parametrize("parts", [1, 2, 7, 100])
def test_every_part_is_called_once_and_results_are_added(parts: int) -> None:
    thread_count()
    values = np.arange(50)
    assert _add_up(parts, values, 1) == values.sum()


def test_a_part_that_gets_no_memory_is_an_error() -> None:
    thread_count()
    with pytest.raises(MemoryError, match="a kernel could not allocate memory"):
        _add_up(2, np.arange(50), 1 << 60)


def test_functions_of_the_user_are_none_of_our_compilations(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    levels: list[int] = []
    before = compile_seconds()

    @numba.njit(forceinline=True)
    def users(x):
        return x + len(levels_seen(x))

    @numba.extending.overload(levels_seen)
    def _(x):
        levels.append(int(numba.config.OPT))  # while it is compiled
        return lambda x: (1, 2)

    assert users(1) == 3
    assert compile_seconds() == before
    assert set(levels) == {int(numba.config.OPT)}
    assert "compiling" not in caplog.text


def levels_seen(x):
    """Known to Numba only."""
