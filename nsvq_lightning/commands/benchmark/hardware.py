"""What the times were measured on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import torch
from llvmlite import binding

from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.version import __version__

__all__ = ["describe_machine"]

SIMD_BITS = (("avx512f", 512), ("avx2", 256), ("avx", 256), ("neon", 128), ("sse2", 128))
"""Widest vectors by the feature that gives them, widest first."""

NOTABLE = (
    "avx512f",
    "avx512vl",
    "avx512_bf16",
    "avx512bf16",
    "avx512fp16",
    "amx-tile",
    "avx2",
    "fma",
    "f16c",
    "neon",
    "sve",
)


def describe_machine() -> dict[str, Any]:
    """Processor, vector width, versions and how busy the machine was, as JSON values."""
    features = _cpu_features()
    simd = next(((name, bits) for name, bits in SIMD_BITS if name in features), ("none", 32))
    return {
        "cpu": _cpu_model(),
        "llvm_cpu": binding.get_host_cpu_name(),
        "cores": os.cpu_count(),
        "usable_cores": usable_cores(),
        "simd_bits": simd[1],
        "simd": [name for name in NOTABLE if name in features],
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "system": f"{platform.system()} {platform.machine()}",
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": {
            "nsvq-lightning": __version__,
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in ("numpy", "torch", "numba", "llvmlite")},
        },
    }


def _cpu_features() -> set[str]:
    """What LLVM knows of the processor; on a Mac that may be nothing, but 64-bit ARM always has NEON."""
    always = {"neon"} if platform.machine().lower() in ("arm64", "aarch64") else set()
    return always | {name for name, present in binding.get_host_cpu_features().items() if present}


def _cpu_model() -> str:
    """Name of the processor; the platform module knows only its architecture on Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
