"""Kernels that are compiled ahead: the list of them, and who compiles and who waits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

from nsvq_lightning.compute.ahead import LIST

SUPPORT = Path(__file__).parents[1] / "support"

FITS = """
import sys
from nsvq_lightning.commands.main import main
options = ["--data=DemoDataModule", "--trainer.max_steps=60"]
assert main(["fit", "--config=demo", *options]) == main(["fit", "--config=paper", *options]) == 0
from kernel_list import used
print("kernels:", *used(), sep="\\n")
"""


def run(code: str, folder: Path, **environment: str) -> str:
    """What a process says."""
    path = os.pathsep.join([str(SUPPORT), *filter(None, sys.path)])
    command, settings = [sys.executable, "-c", code], {**os.environ, "PYTHONPATH": path, **environment}
    ran = subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.slow
def test_the_list_has_the_kernels_of_a_run_and_no_others(tmp_path: Path) -> None:
    used = run(FITS, tmp_path).partition("kernels:\n")[2].splitlines()
    listed = LIST.read_text(encoding="utf-8").splitlines()
    if set(listed) != set(used):
        LIST.write_text("\n".join([*(line for line in listed if line in used), *sorted({*used} - {*listed})]) + "\n")
    assert set(listed) == set(used), f"{LIST} has been written anew: look at the difference, and commit it"


FIRST = """
from nsvq_lightning.compute import ahead, kernel_cache
kernel, arguments = next(found for found in ahead.kernels() if found[0].__name__ == "_search_before")
kernel_cache.waits, kernel_cache.PATIENCE = {waits}, 0.2
print(kernel._cache._cache_file._index_path)
try:
    kernel.compile(arguments)
    print("compiled", kernel._cache.is_there())
except kernel_cache.BusyError:
    print("busy")
"""


def test_a_kernel_that_another_process_compiles_is_left_to_it(tmp_path: Path) -> None:
    settings = {"NUMBA_CACHE_DIR": str(tmp_path)}
    index = Path(run(FIRST.partition("try:")[0].format(waits=True), tmp_path, **settings).strip())
    index.parent.mkdir()
    with FileLock(f"{index}.lock"):
        assert run(FIRST.format(waits=False), tmp_path, **settings).endswith("busy\n")
        assert not index.exists()
        assert run(FIRST.format(waits=True), tmp_path, **settings).endswith("compiled True\n")  # patience has an end
    stamp = index.stat().st_mtime_ns
    assert run(FIRST.format(waits=False), tmp_path, **settings).endswith("compiled True\n")
    assert index.stat().st_mtime_ns == stamp  # read from the disk
