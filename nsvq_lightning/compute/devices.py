"""Which compiled kernels take a tensor, how Triton's are launched, and copies that wait for nothing but themselves.

Triton itself is not imported. It compiles a kernel anew for integers that are 1 or multiples of 16. Numbers that change
from step to step, such as that of the splats in view, are named in ``do_not_specialize``, or kernels would compile in
the middle of a run.
"""

import os
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from nsvq_lightning.top_level import log

# Options of every launch. Triton's default is about to change; values on which the forward and backward pass must
# agree to the bit are computed with an explicit ``fma``.
COMPILE = {"enable_fp_fusion": True}
# Why there are no kernels for a CUDA device.
NEEDS_TRITON = "it needs Triton 3.4 or later, which CUDA builds of PyTorch 2.8 for Linux bring (pip install -U torch)"


def kernels_for(like: Tensor) -> Literal["cpu", "cuda"] | None:
    """``cpu`` (Numba) or ``cuda`` (Triton) for float32 tensors on that device; None where only plain torch works.

    None is for any other dtype or device, and for CUDA without Triton. Under Triton's interpreter, tensors on the CPU
    still go to Numba: the interpreter is for tests, which call the Triton kernels directly.
    """
    return _kernels_of(like.device.type) if like.dtype == torch.float32 else None


def _kernels_of(device: str) -> Literal["cpu", "cuda"] | None:
    """What :func:`kernels_for` gives for float32 on a type of device."""
    if device == "cpu":
        return "cpu"
    return "cuda" if device == "cuda" and _has_triton() else None


@cache
def best_device() -> torch.device:
    """The fastest device that has kernels here, looked for once: CUDA where Triton is installed, else the CPU.

    Lightning's own choice may be one without any, Apple's MPS or, on Windows, CUDA: plain torch is slower than the CPU.
    """
    if torch.cuda.is_available():
        if _has_triton():
            return torch.device("cuda")
        log.warning(f"the CPU is used and not the CUDA device: {NEEDS_TRITON}")
    return torch.device("cpu")


def devices_with_kernels() -> list[str]:
    """Types of device that have kernels here: ``cpu`` and, where it is the best one, ``cuda``."""
    return sorted({"cpu", best_device().type})


def check_can_train(device: torch.device, backend: str) -> None:
    """Refuse a device without kernels, on which a run of minutes would take days.

    Args:
        device: Where the splats are.
        backend: The rasterizer; ``reference`` asks for plain torch, which trains anywhere but on Apple's MPS.

    Raises:
        ValueError: It has none.
    """
    if _kernels_of(device.type) is None and (backend != "reference" or device.type == "mps"):
        raise ValueError(
            f"there are no kernels for {device.type} here, and training without them takes days: train on the CPU. "
            'Write nsvq_lightning.SplatTrainer(…), which chooses by itself, or Trainer(accelerator="cpu", …); for '
            "nsvq fit leave out --trainer.accelerator"
        )


def _obstacle(kernels: str, like: Tensor) -> str | None:
    """Why ``cpu`` or ``cuda`` kernels cannot take tensors such as ``like``, with a remedy; None where they can.

    Under Triton's interpreter those of ``cuda`` take float32 tensors on the CPU: slow, for tests.
    """
    got = f"got {like.dtype} on {like.device}"
    if kernels == "cpu":
        fits = like.dtype == torch.float32 and like.device.type == "cpu"
        return None if fits else f"it renders float32 tensors on the CPU, {got}; move the splats"
    interpreted = os.environ.get("TRITON_INTERPRET", "0") == "1"
    if like.dtype != torch.float32 or not (like.is_cuda or interpreted):
        help_ = "move the splats (nsvq fit --trainer.accelerator=cuda)"
        if not torch.cuda.is_available():
            help_ = "torch finds no CUDA device here (nsvq doctor says why)"
        return f"it renders float32 tensors on a CUDA device, {got}; {help_}"
    return None if _has_triton() else NEEDS_TRITON


@cache
def _has_triton() -> bool:
    """Whether a Triton that can compile the kernels is installed; a render with ``backend="cuda"`` asks each time."""
    triton = find_spec("triton")
    folders = (triton and triton.submodule_search_locations) or ()
    # Before 3.4, without this file, it has no tuples of tuples.
    return any(Path(folder, "knobs.py").is_file() for folder in folders)


# Names that ``render(backend=...)`` takes; ``auto`` is this package's fastest one for the device of the splats.
BACKENDS = ("auto", "reference", "cpu", "cuda")


def resolve_backend(backend: str, like: Tensor) -> str:
    """The back-end that ``backend`` stands for with tensors such as ``like``.

    ``auto`` is ``cpu`` for float32 on the CPU, ``cuda`` for float32 on a CUDA device where Triton is installed, and
    otherwise ``reference``: plain torch, for any dtype and any device of torch, and slow.

    Raises:
        ValueError: It is unknown, or cannot take this device or floating-point type.
    """
    if backend not in BACKENDS:
        raise ValueError(f"unknown render backend {backend!r}; choose one of {', '.join(BACKENDS)}")
    if backend == "auto":
        kernels = kernels_for(like)
        # Another dtype is meant for the oracle.
        if kernels is None and like.dtype == torch.float32 and (problem := _obstacle("cuda", like)):
            _warn_of_plain_torch(like.device.type, problem)
        return kernels or "reference"
    if backend != "reference" and (problem := _obstacle(backend, like)):
        raise ValueError(f"backend {backend!r} cannot be used: {problem}, or use backend='auto'")
    return backend


def fast_backends(like: Tensor) -> list[str]:
    """Back-ends other than plain torch that take tensors such as ``like``."""
    return [name for name in ("cpu", "cuda") if _obstacle(name, like) is None]


@cache
def _warn_of_plain_torch(device: str, problem: str) -> None:
    """Warn once that a device has no kernels of its own; a run of hours would else silently become one of weeks."""
    log.warning(
        f"rendering on {device} in plain torch, much slower than on the CPU (--trainer.accelerator=cpu); "
        f"backend 'cuda' cannot be used: {problem}"
    )


def to_device(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on a device, or itself if it is there already; the copy to a GPU runs beside what is queued there."""
    device = torch.device(device)
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()  # from other memory, the driver copies before the call returns
    return tensor.to(device, non_blocking=True)


class AsyncScalar:
    """A number from a device, which can be read without waiting for what has been queued since.

    ``tensor.item()`` waits until a GPU has done all its work, and the GPU then waits for the next launch. Here the copy
    starts at once, and :meth:`read` waits for that copy alone.

    Attributes:
        is_here: Whether the number was on the host from the start, so that nobody ever waits for it.

    Args:
        value: Scalar tensor on any device.
    """

    def __init__(self, value: Tensor) -> None:
        self._host, self.is_here = value.detach(), not value.is_cuda
        if not self.is_here:
            self._host = torch.empty((), dtype=value.dtype, pin_memory=True)
            self._host.copy_(value.detach(), non_blocking=True)
            self._copied = torch.cuda.current_stream(value.device).record_event()

    def read(self) -> float:
        """The number."""
        if not self.is_here:
            self._copied.synchronize()
        return float(self._host)
