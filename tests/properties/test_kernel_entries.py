"""No call from Python corrupts memory: every function that hands arrays to a kernel refuses those that do not fit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from kernel_entries import entry_points

ROOT = Path(__file__).parents[2]


def test_a_new_entry_point_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search itself: public, private and compiled functions of a module that is new in the package."""
    source = """
from nsvq_lightning.compute.jit import kernel

@kernel
def compiled(array):
    array[0] = 1

class _Inner:
    def call(self, array):
        compiled(array)

class Outer:
    def use(self, array):
        _Inner().call(array)

    def rest(self):
        return 1

def _helper(array):
    Outer().use(array)
    compiled(array)

def through_private(array):
    _helper(array)

def through_public(array):
    through_private(array)

def makes_one():
    return kernel(max)
"""
    import nsvq_lightning

    (tmp_path / "planted.py").write_text(source)
    monkeypatch.setattr(nsvq_lightning, "__path__", [*nsvq_lightning.__path__, str(tmp_path)])
    found = {name.removeprefix("nsvq_lightning.planted.") for name in entry_points() if ".planted." in name}
    assert found == {"Outer.use", "through_private", "makes_one"}
    sys.modules.pop("nsvq_lightning.planted")


@pytest.mark.parametrize("compiler", ["numba", pytest.param("triton", marks=pytest.mark.slow)])
def test_arrays_that_do_not_fit_are_refused_or_used_rightly(compiler: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if compiler == "triton":
        pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
        environment["TRITON_INTERPRET"] = "1"
    command = [sys.executable, str(ROOT / "tests" / "support" / "kernel_calls.py"), compiler]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", env=environment)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"status {done.returncode}, last call {lines[-1:]}: ...{done.stderr[-3000:]}"
    assert len(lines) > 500
    assert [line for line in lines if line[2] not in ("begun", "refused", "right", "done")] == []
