"""What the functions of a training step do on a GPU stays there, shown without one.

They are given tensors on torch's ``meta`` device, which have shapes but no numbers: whatever would read one back
raises (``item()``, ``numpy()``, ``cpu()``, ``if tensor:``, an operator whose result has a size that depends on
numbers), and so does mixing them with tensors of the CPU. Forward and backward pass are those of a GPU; only the launch
of a kernel is left out, which ``triton_cases.py`` and its like do under the interpreter.

What reads back by design is not here: the rasterizer reads two sizes a render, the module the loss.
"""

from __future__ import annotations

import importlib
from typing import Any

import pytest
import torch

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.quality.loss import photometric_loss, ssim
from nsvq_lightning.quantize.kmeans import lookup, sum_by_code
from nsvq_lightning.quantize.nsvq import NSVQ, DiVeQ
from nsvq_lightning.quantize.straight_through import StraightThrough, TrainedStraightThrough
from nsvq_lightning.random import generator

USERS = (
    "quality.loss",
    "compute.rows",
    "quantize.nearest",
    "quantize.tracking",
    "quantize.nsvq",
    "quantize.kmeans",
    "callbacks.density",
)
"""The modules that choose kernels by device."""


@pytest.fixture
def launches(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The ``meta`` device stands for a GPU; names of the kernels that would have run."""
    jit = pytest.importorskip("triton.runtime.jit", reason="the kernels of a GPU need Triton")
    names: list[str] = []

    def run(kernel: Any, *args: Any, grid: tuple[int, ...], **kwargs: Any) -> None:
        assert all(isinstance(x, int | float) or x.device.type == "meta" for x in args), kernel.__name__
        assert all(x.is_contiguous() for x in args if isinstance(x, torch.Tensor)), kernel.__name__
        assert len(args) + len(set(kwargs) & set(kernel.arg_names)) == len(kernel.arg_names), kernel.__name__
        assert 1 <= grid[0] < 2**31
        assert all(1 <= size < 2**16 for size in grid[1:])
        names.append(kernel.__name__)

    def chosen(like: torch.Tensor) -> str | None:
        return "cuda" if like.is_meta and like.dtype == torch.float32 else kernels_for(like)

    monkeypatch.setattr(jit.JITFunction, "run", run)
    for module in USERS:
        monkeypatch.setattr(importlib.import_module(f"nsvq_lightning.{module}"), "kernels_for", chosen)
    return names


def on_device(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.empty(shape, dtype=dtype, device="meta")


def test_a_tensor_without_numbers_tells() -> None:
    offences = (
        lambda x: x.item(),
        lambda x: x.numpy(),
        lambda x: x.cpu(),
        lambda x: x.nonzero(),
        lambda x: x + torch.zeros(3),
        lambda x: bool(x.sum() > 0),
        lambda x: torch.bincount(x.long()),
    )
    for offence in offences:
        with pytest.raises((RuntimeError, TypeError)):
            offence(on_device(3))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_loss(launches: list[str], dtype: torch.dtype) -> None:
    image, photo = on_device(1080, 1920, 3).requires_grad_(), on_device(1080, 1920, 3, dtype=dtype)
    loss = photometric_loss(image, photo)
    assert launches == ["moments_kernel", "similarity_kernel", "loss_kernel"]
    (0.5 * loss + 1).backward()
    assert image.grad is not None
    assert image.grad.shape == image.shape
    assert launches[3:] == ["spread_kernel", "gradient_kernel"]
    with torch.no_grad():
        ssim(image, photo.float())
    assert launches[5:] == ["moments_kernel", "similarity_kernel", "loss_kernel"]


@pytest.mark.parametrize("dim", [3, 4, 45])
@pytest.mark.parametrize("kind", [NSVQ, DiVeQ, StraightThrough, TrainedStraightThrough])
@pytest.mark.parametrize("some", [True, False])
def test_quantizer(launches: list[str], dim: int, kind: type[Any], some: bool) -> None:
    x, rows = on_device(1000, dim).requires_grad_(), on_device(100, dtype=torch.int64)
    quantizer = kind(64, dim).to("meta")
    result, codes = quantizer(x, generator(0), rows if some else None)
    assert codes.shape == (100 if some else 1000,)
    result.sum().backward()
    assert x.grad is not None
    assert x.grad.shape == x.shape
    expected = ["drift_kernel", "check_kernel", "queue_kernel", "search_kernel", "snapshot_kernel"]
    if kind in (NSVQ, DiVeQ):
        expected += ["substitute_kernel", "radial_kernel"]
    if kind is not StraightThrough:
        expected += ["part_kernel", "sum_kernel"]
        assert quantizer.codebook.grad.shape == (64, dim)
    assert launches == expected


def test_rows_codes_and_statistics(launches: list[str]) -> None:
    table, rows = on_device(1000, 15, 3).requires_grad_(), on_device(100, dtype=torch.int64)
    take_rows(table, rows).sum().backward()
    codebook, codes = on_device(64, 45).requires_grad_(), on_device(1000, dtype=torch.int64)
    lookup(codebook, codes).sum().backward()
    sum_by_code(on_device(1000, 45), codes, 64, torch.float64)
    assert launches == ["part_kernel", "sum_kernel"] * 2
    rules = importlib.import_module("nsvq_lightning.callbacks.density")
    rules.add_view(on_device(1000), on_device(1000), on_device(1000, 2), on_device(1000, dtype=torch.int32), 800, 600)
