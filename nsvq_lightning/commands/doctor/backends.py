"""Which back-ends and extras are available, and why others are not."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import torch

from nsvq_lightning.commands.benchmark.report import describe_machine
from nsvq_lightning.commands.doctor.finding import Finding, good, note
from nsvq_lightning.compute import lanes
from nsvq_lightning.rendering.rasterize import fast_backends

__all__ = ["check_backends", "check_extras", "usable_backends"]

WIDE = 256
"""Vector register width in bits below which kernels take about twice the time on x86; ARM64 has none wider."""


def usable_backends() -> dict[str, str]:
    """Device of each fast back-end of this machine, by name."""
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    return {name: device for device in devices for name in fast_backends(torch.zeros(1, device=device))}


def check_backends() -> Iterator[Finding]:
    """The renderers: Numba on the CPU, and those for a GPU."""
    yield _cpu()
    yield _gpu()


def _cpu() -> Finding:
    machine = describe_machine()
    bits, features = machine["simd_bits"], ", ".join(machine["simd"])
    text = f"{lanes.WIDTH} floats at a time in {bits}-bit registers ({features or 'no vector extension'})"
    fused = not {"fma", "neon"}.isdisjoint(machine["simd"])
    values = {"simd_bits": bits, "simd": machine["simd"], "fma": fused}
    if bits < WIDE and "neon" not in machine["simd"]:
        return note("cpu", f"{text}: a processor with AVX2 or AVX-512 is about twice as fast", **values)
    if not fused:
        return note("cpu", f"{text}, no fused multiply-add: somewhat slower, last digits may differ", **values)
    return good("cpu", f"{text}, fused multiply-add", **values)


def _gpu() -> Finding:
    if torch.version.cuda is None and torch.version.hip is None:
        return note("gpu", f"torch {torch.__version__} is built without CUDA; with an NVIDIA GPU install a CUDA build")
    if not torch.cuda.is_available():
        return note("gpu", "torch finds none: check whether nvidia-smi does, and CUDA_VISIBLE_DEVICES")
    name, fast = torch.cuda.get_device_name(), [name for name in usable_backends() if name != "cpu"]
    if not fast:
        return note("gpu", f"{name}: this version renders on it in plain torch, slower than on the CPU: use the CPU")
    return good("gpu", f"{name}, back-ends {', '.join(fast)}", name=name, backends=fast)


def check_extras() -> Iterator[Finding]:
    """Optional packages that a run uses if installed."""
    if find_spec("torchvision") is None:
        yield note("lpips", "not measured: pip install 'nsvq-lightning[lpips]'")
    elif not any((Path(torch.hub.get_dir()) / "checkpoints").glob("vgg16-*.pth")):
        yield note("lpips", "torchvision is here; the first test downloads the weights of VGG-16 (528 MB)")
    else:
        yield good("lpips", "torchvision and the weights of VGG-16 are here")
    if find_spec("tensorboard") is None:
        yield note("tensorboard", "no curves in TensorBoard, only as CSV: pip install 'nsvq-lightning[tensorboard]'")
    else:
        yield good("tensorboard", "installed: curves are written for it")
