"""No call from Python corrupts memory: every function that hands arrays to a kernel refuses those that do not fit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from kernel_calls import NUMBA, TRITON
from kernel_entries import entry_points

HERE = Path(__file__).parent
TABLES = {"numba": NUMBA, "triton": TRITON}
ANSWERS = {"same", "other", "ValueError", "TypeError"}


@pytest.mark.parametrize("compiler", TABLES)
def test_every_function_that_calls_a_kernel_has_a_case(compiler: str) -> None:
    if compiler == "triton":
        pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    assert {name for name, by in entry_points().items() if by == compiler} == set(TABLES[compiler])


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


@cache
def _lines(compiler: str) -> tuple[list[list[str]], str]:
    """What all calls have come to, in a process of their own; and what it says when it ends badly."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
    if compiler == "triton":
        environment["TRITON_INTERPRET"] = "1"
    command = [sys.executable, str(HERE / "support" / "kernel_calls.py"), compiler]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", env=environment)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return lines, f"status {done.returncode}, last call {lines[-1:]}: ...{done.stderr[-3000:]}"


@pytest.mark.parametrize(("compiler", "name"), [(compiler, name) for compiler in TABLES for name in TABLES[compiler]])
def test_arrays_that_do_not_fit_are_refused_or_used_rightly(compiler: str, name: str) -> None:
    if compiler == "triton":
        pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    lines, ending = _lines(compiler)
    ours = [(call, outcome) for entry, call, outcome in lines if entry == name]
    assert ("", "done") in ours, ending
    wrong = [(call, outcome) for call, outcome in ours[:-1] if outcome != "begun" and not _is_right(call, outcome)]
    assert not wrong
    assert len(ours) > 1 or name.endswith(("normal_vectors", "decode_integers"))  # which take no array


def _is_right(call: str, outcome: str) -> bool:
    kind = outcome.partition(":")[0]
    if ": a number" in call:
        return kind == "ValueError"
    return kind in ANSWERS and (kind != "TypeError" or ": another" in call)
