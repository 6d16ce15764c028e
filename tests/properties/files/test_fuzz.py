"""Readers of damaged files, see tests/support/fuzzing.py.

``NSVQ_FUZZ_CASES=10000 pytest tests/properties/files/test_fuzz.py`` looks deeper.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from viewer_scenes import HAS_ZSTD

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="the memory of a case is limited in the way of Linux"
)

ROOT = Path(__file__).resolve().parents[3]
CASES = {
    "ply": 100,
    "nsvq": 80,
    "spz": 100,
    "spz4": 100,
    "sog": 100,
    "compressed-ply": 60,
    "glb": 100,
    "usda": 60,
    "lod": 60,
    "splat": 50,
    "colmap-bin": 60,
    "colmap-txt": 50,
    "photo": 100,
    "config": 10,
    "checkpoint": 60,
}
"""Cases in a quick test; in a slow one three times as many."""
ALIKE = ("spz4", "splat", "compressed-ply", "colmap-txt")
"""Kinds whose reader is mostly that of another: slow tests only."""
KINDS = [pytest.param(kind, marks=[pytest.mark.slow] if kind in ALIKE else []) for kind in CASES]


@pytest.mark.parametrize("times", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_read_or_refused_with_one_clear_error(kind: str, times: int, tmp_path: Path) -> None:
    if kind == "spz4" and not HAS_ZSTD:
        pytest.skip("no Zstandard: pip install 'nsvq-lightning[spz]'")
    cases = int(os.environ.get("NSVQ_FUZZ_CASES", times * CASES[kind]))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "tests" / "support" / "fuzzing.py"), kind, str(tmp_path), str(cases)]
    run = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", env=environment)
    assert run.returncode == 0, f"status {run.returncode}, damaged file kept in {tmp_path}: ...{run.stderr[-3000:]}"
    found = re.fullmatch(r"(\d+) read, (\d+) refused\n", run.stdout)
    assert found is not None, run.stdout
    assert int(found[1]) + int(found[2]) == cases
    assert int(found[1]) > 0
    assert int(found[2]) > cases / (20 if kind == "splat" else 5)  # a .splat is read unless its length is wrong
