"""Versions, threads, memory and disk of this machine."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numba
import torch

from nsvq_lightning.commands.benchmark.report import describe_machine
from nsvq_lightning.commands.doctor.finding import Finding, good, note, problem
from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.compute.jit import thread_count
from nsvq_lightning.training.memory_estimate import available_memory, readable_bytes

__all__ = [
    "check_disk",
    "check_memory",
    "check_opencv",
    "check_threads",
    "check_versions",
]

PACKAGES = ("lightning", "torchmetrics", "jsonargparse", "scipy", "pycolmap")
"""Packages used besides those that :func:`describe_machine` names."""

OPENCV = tuple(f"opencv-{part}python{screen}" for part in ("contrib-", "") for screen in ("-headless", ""))
"""Packages that provide ``cv2``; any of them will do."""

SMALL_MEMORY, SMALL_DISK = 4 << 30, 2 << 30
"""Bytes below which a run of usual size may not fit: pictures, splats and moments; checkpoints, report and exports."""
BUSY = 0.5
"""Share of the cores that other processes may use before times become unreliable."""


def check_versions() -> Iterator[Finding]:
    """Versions of Python and of the packages that results depend on."""
    machine = describe_machine()
    versions = {**machine["versions"], **{name: _version(name) for name in PACKAGES}}
    listed = ", ".join(f"{name} {number or 'missing'}" for name, number in versions.items())
    yield good("versions", listed, **versions)
    yield good("machine", f"{machine['system']}, {machine['cpu']}", **machine)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_opencv() -> Iterator[Finding]:
    """Whether OpenCV is installed, and only once: several packages overwrite each other's files."""
    installed = [name for name in OPENCV if _version(name) is not None]
    try:
        import cv2
    except ImportError as error:
        yield problem("opencv", f"cannot be loaded ({error}): pip install {OPENCV[0]}", packages=installed)
        return
    if len(installed) > 1:
        help_ = f"they overwrite each other's files: uninstall all of them, then pip install {OPENCV[0]}"
        yield note("opencv", f"{' and '.join(installed)} are installed: {help_}", packages=installed)
    else:
        yield good("opencv", f"{cv2.__version__} ({', '.join(installed) or 'not from pip'})", packages=installed)


def check_threads() -> Iterator[Finding]:
    """Whether the kernels use all cores, and do not wait for each other by spinning."""
    cores, used = usable_cores(), thread_count()
    torchs, numbas = torch.get_num_threads(), int(numba.config.NUMBA_NUM_THREADS)
    values = {"cores": cores, "torch": torchs, "numba": numbas, "used": used}
    counts = f"{used} used of {cores} cores (torch {torchs}, numba {numbas})"
    if used < cores and _is_apple_silicon() and not {"OMP_NUM_THREADS", "NUMBA_NUM_THREADS"} & os.environ.keys():
        yield good("threads", f"{counts}: only the fast ones; slow cores would hold them up", **values)
    elif used < cores:
        yield note("threads", f"{counts}: raise or unset OMP_NUM_THREADS and NUMBA_NUM_THREADS to use all", **values)
    elif used > cores:
        yield note("threads", f"{counts}: more threads than cores block each other; lower OMP_NUM_THREADS", **values)
    else:
        yield good("threads", counts, **values)
    policy = os.environ.get("OMP_WAIT_POLICY", "not set")
    if policy.lower() == "passive":
        yield good("waiting", "OMP_WAIT_POLICY is passive", policy=policy)
    else:
        help_ = "on a shared machine threads that wait by spinning slow a step down several times; set it to passive"
        yield note("waiting", f"OMP_WAIT_POLICY is {policy}: {help_}", policy=policy)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if load > BUSY * cores:
        yield note("load", f"{load:.1f} processes were running in the last minute: times will be longer", load=load)


def _is_apple_silicon() -> bool:
    """Whether torch skips the efficiency cores on its own."""
    return (platform.system(), platform.machine()) == ("Darwin", "arm64")


def check_memory() -> Iterator[Finding]:
    """Memory that is available to a run."""
    free = available_memory()
    if free is None:
        yield note("memory", "this system does not say how much is available")
    elif free < SMALL_MEMORY:
        help_ = "end other programs, or train with --data.max_width 800 --data.cache_bytes 500000000"
        yield note("memory", f"{readable_bytes(free)} available, a usual run takes 2 to 4 GB: {help_}", available=free)
    else:
        yield good("memory", f"{readable_bytes(free)} available", available=free)


def check_disk(folder: Path) -> Iterator[Finding]:
    """Disk space for checkpoints, report and exports where runs are written."""
    free = shutil.disk_usage(folder).free
    text = f"{readable_bytes(free)} free in {folder.resolve()}"
    if free < SMALL_DISK:
        yield note("disk", f"{text}: checkpoints of a run take about 1 GB; see --trainer.default_root_dir", free=free)
    elif not os.access(folder, os.W_OK):
        yield note("disk", f"{text}, which is read-only: give --trainer.default_root_dir", free=free)
    else:
        yield good("disk", text, free=free)
