"""Kernels that index arrays as Python does, once under Numba's own bounds checks; the others address memory themselves,
and only the guard words see what they do (tests/support/guards.py)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from kernel_calls import SCALAR

HERE = Path(__file__).parent


def _checked(what: str, cache: Path) -> subprocess.CompletedProcess[str]:
    """Run a part of kernel_calls.py with kernels that are compiled anew, with bounds checks; they would be slow."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)]),
        "NUMBA_BOUNDSCHECK": "1",  # goes before what `kernel` asks for
        "NUMBA_CACHE_DIR": str(cache),
        "NUMBA_NUM_THREADS": "1",  # errors of other threads are lost
    }
    command = [sys.executable, str(HERE / "support" / "kernel_calls.py"), what]
    return subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", env=environment)


@pytest.mark.long
def test_scalar_kernels_stay_within_their_arrays(tmp_path: Path) -> None:
    done = _checked("rightly", tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert [json.loads(line)[0] for line in done.stdout.splitlines()] == SCALAR


def test_bounds_checks_find_a_planted_overrun(tmp_path: Path) -> None:
    done = _checked("overrun", tmp_path)
    assert done.returncode == 1
    assert "IndexError: index is out of bounds" in done.stderr
