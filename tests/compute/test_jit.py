"""The number of threads that the user has set holds for all kernels, from the first one on."""

import subprocess
import sys

import pytest

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
