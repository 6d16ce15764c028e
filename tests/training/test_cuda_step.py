"""What a training step does on a GPU stays there, shown without one.

The functions of a step are given tensors that say they are on a CUDA device and have shapes but no numbers
(``FakeTensorMode``): every operator checks devices and dtypes as on a GPU, and what would read a number back, such as
``item()``, ``numpy()`` or an operator whose result depends on numbers in its size, raises. A mode on top refuses copies
between the devices. Kernels are not launched; ``tests/rendering/triton_cases.py`` and its like do that.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from nsvq_lightning.callbacks.density_rules import add_view
from nsvq_lightning.losses import _CudaLoss, photometric_loss, ssim
from nsvq_lightning.optim import SplatAdam, build_adam
from nsvq_lightning.quantize.nsvq import _Substitution
from nsvq_lightning.quantize.sums import count_hits, lookup, sum_by_code
from nsvq_lightning.quantize.tracking import NearestTracker
from nsvq_lightning.skips import switched
from nsvq_lightning.subset import _TakeRows, take_rows


class StaysOnDevice(TorchDispatchMode):
    """Refuses copies between devices."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        before, after = ({x.device for x in tree_leaves(part) if isinstance(x, torch.Tensor)} for part in (args, result))
        if len(before | after) > 1 and any(tensor.dim() for tensor in tree_leaves(args) if torch.is_tensor(tensor)):
            raise RuntimeError(f"{func} copies between devices: {before} to {after}")
        return result


@pytest.fixture
def launches(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Fake tensors on a device that is not there; names of the kernels that would have run."""
    jit = pytest.importorskip("triton.runtime.jit", reason="the kernels of a GPU need Triton")
    # Imported at first use, but their constants are no fake tensors.
    for module in ("rendering.cuda.dssim", "rendering.cuda.adam", "quantize.cuda.nearest", "quantize.cuda.substitution"):
        importlib.import_module(f"nsvq_lightning.{module}")
    names: list[str] = []

    def run(kernel: Any, *args: Any, grid: Any, **kwargs: Any) -> None:
        assert all(isinstance(x, (int, float)) or x.device.type == "cuda" for x in args)
        assert all(1 <= size < 2**31 for size in grid[:1])
        assert all(1 <= size < 2**16 for size in grid[1:])
        names.append(kernel.__name__)

    monkeypatch.setattr(jit.JITFunction, "run", run)
    monkeypatch.setattr("torch.cuda.device_of", lambda _: torch.no_grad())
    with FakeTensorMode(), torch.no_grad(), StaysOnDevice():
        yield names


def on_device(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.empty(shape, dtype=dtype, device="cuda")


def context(*saved: torch.Tensor, **values: Any) -> Any:
    """What the backward function of an operator is called with; fake tensors of a GPU cannot enter a graph."""
    return SimpleNamespace(saved_tensors=saved, **values)


def test_the_fakes_tell() -> None:
    with FakeTensorMode(), StaysOnDevice():
        for offence in (
            lambda x: x.item(),
            lambda x: x.numpy(),
            lambda x: x.cpu(),
            lambda x: x.nonzero(),
            lambda x: x + torch.zeros(1),
            lambda x: bool(x > 0),
        ):
            with pytest.raises((RuntimeError, TypeError)):
                offence(on_device(1))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_loss(launches: list[str], dtype: torch.dtype) -> None:
    image, photo = on_device(1080, 1920, 3), on_device(1080, 1920, 3, dtype=dtype)
    assert photometric_loss(image, photo).shape == ()
    ssim(image, on_device(1080, 1920, 3))
    saved = context(needs_input_grad=(True, False, False), save_for_backward=lambda *_: None)
    loss = _CudaLoss.forward(saved, image, photo, 0.2)
    gradient, _, _ = _CudaLoss.backward(context(image, photo, derivatives=saved.derivatives), loss)
    assert gradient.shape == image.shape
    assert launches[-2:] == ["spread_kernel", "gradient_kernel"]


@pytest.mark.parametrize("rows_only", [False, True])
def test_optimiser(launches: list[str], rows_only: bool) -> None:
    # Parameters cannot be fake ones of a GPU either; the optimiser only needs tensors with gradients.
    tables = [on_device(1000, 15, 3), on_device(1000, 3), on_device(1000), on_device(0, 3)]
    optimizer = build_adam([{"params": [table], "lr": 1e-3, "columns": 9} for table in tables])
    assert isinstance(optimizer, SplatAdam)
    with switched(adam_rows=rows_only):
        for table in tables:
            table.grad = torch.empty_like(table)
        optimizer.step()
        optimizer.step()
    assert launches == 2 * 3 * ["update_rows_kernel" if rows_only else "update_columns_kernel"]


@pytest.mark.parametrize("dim", [3, 4, 45])
def test_quantizer(launches: list[str], dim: int) -> None:
    x, codebook, rows = on_device(1000, dim), on_device(64, dim), on_device(100, dtype=torch.int64)
    codes = NearestTracker().search(x, codebook, rows)
    count_hits(codes, on_device(64, dtype=torch.int64))
    for chosen in (rows, None):
        codes = codes if chosen is not None else on_device(1000, dtype=torch.int64)
        mix = 5, 0.0, 1.0
        out = _Substitution.forward(context(save_for_backward=lambda *_: None), x, codebook, codes, chosen, mix)
        where = torch.arange(1000, device="cuda") if chosen is None else chosen
        saved = context(x, codebook, codes, where, out, kernels="cuda", mix=mix)
        gradients = _Substitution.backward(saved, torch.empty_like(out))
        assert [tuple(gradient.shape) for gradient in gradients[:2]] == [(1000, dim), (64, dim)]
    assert launches.count("nearest_kernel") == 1
    assert launches.count("substitute_kernel") == launches.count("radial_kernel") == 2


def test_rows_and_statistics(launches: list[str]) -> None:
    x, rows, codes = on_device(1000, 15, 3), on_device(100, dtype=torch.int64), on_device(1000, dtype=torch.int64)
    taken = take_rows(x, rows)
    _TakeRows.backward(context(rows, count=1000), taken)
    lookup(on_device(64, 45), codes)
    sum_by_code(x.view(1000, 45), codes, 64, torch.float64)
    radii = on_device(1000, dtype=torch.int32)
    add_view(on_device(1000), on_device(1000), on_device(1000, 2), radii, 800, 600)
    assert launches == ["sum_kernel"]
