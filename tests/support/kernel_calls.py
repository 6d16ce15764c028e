"""Calls of every entry point with arrays that are wrong in one way each; run as a script, in a process of its own.

The right calls are those that a short use of the package makes. What reads or writes past the end of an array may crash
or hang the process, so each wrong call is printed before it is made. It is made twice, between two kinds of guard
words: a result that differs was read from beside an array. A line is a JSON list: entry point, call, and ``begun``,
``refused``, ``right``, or what is wrong.
"""

from __future__ import annotations

import copy
import faulthandler
import functools
import importlib
import inspect
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from guards import guarded
from kernel_entries import entry_points, stand_in_for_a_gpu
from splat_scenes import front_camera, random_splats, some_pixel_weights
from torch import Tensor

from nsvq_lightning.io import formats
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize import NSVQ, QUANTIZED, TrainedStraightThrough
from nsvq_lightning.quantize.attributes import decoded, noisy_rows
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.importance import row_weights
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

TIMEOUT = 500
"""Seconds after which a call that hangs is reported."""
MOST = {"numba": 3, "triton": 1}
"""Right calls of an entry point, which differ in the types or columns of their arrays."""
WORDS = 0xA5, 0x5A


# What calls every entry point


def compile_kernels(settings: dict[str, Any]) -> None:
    """Place the codebooks, train a step with noise and one with frozen codes, write the file and read it back.

    Args:
        settings: Arguments of the module.
    """
    module = SplatModule(**settings)
    # So many that some search trees have more than one level.
    module.splats = Splats.from_tensors(*random_splats(600, sh_degree=module.splats.sh_degree))
    module.phase = Phase.QUANTIZE
    for name, quantizer in module.quantizers.items():
        weight = None if name == "scales" else row_weights(torch.ones(600))
        quantizer.fit(module.scene.rows(name), weight, generator(0, 0, name))
    raw = module.splats.raw()
    rows = visible(raw, front_camera())
    for _ in range(2):  # the second search has something to remember
        _backward(noisy_rows(raw, rows, module.quantizers, lambda name: generator(0, 1, name)))
    for name, quantizer in module.quantizers.items():
        quantizer.freeze(quantizer.encode(module.scene.rows(name)))
    module.phase = Phase.FINETUNE
    _backward(decoded(raw, module.quantizers))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.nsvq"
        save(module.compressed(), path, module.storage)
        load(path)


def _backward(splats: RawSplats) -> None:
    torch.stack([tensor.sum() for tensor in splats]).sum().backward()  # type: ignore[no-untyped-call]


def use_cpu() -> None:
    """Train, store and read a few splats."""
    for quantizer in (NSVQ, TrainedStraightThrough):
        compile_kernels({"sh_degree": 1, "quantizer": quantizer, "codebooks": dict.fromkeys(QUANTIZED, 300)})
    draw(30, 20, "cpu", antialiased=True)
    nearest = importlib.import_module("nsvq_lightning.quantize.nearest")
    x, codebook = torch.randn(70, 3, generator=generator(0)), torch.randn(50, 3, generator=generator(1))
    nearest.cheapest(x, codebook, codebook[:, 0].abs(), x[:, 0].abs())
    importlib.import_module("nsvq_lightning.quantize.kmeans").distinct_rows(x)
    statistics = importlib.import_module("nsvq_lightning.rendering.cpu.rasterizer")
    radii = torch.arange(70, dtype=torch.int32) % 3
    statistics.add_view(tuple(torch.zeros(2, 70)), x[:, :2].contiguous(), radii, (2.0, 3.0))
    statistics.add_view(tuple(torch.zeros(3, 70)), x, radii, (2.0, 3.0))
    with tempfile.TemporaryDirectory() as folder:
        formats.save(Splats.from_tensors(*random_splats(300)), Path(folder, "a.sog"))


def use_triton() -> None:
    """The same on what stands for a GPU, with fewer numbers: the interpreter is slow."""
    stand_in_for_a_gpu()
    draw(8, 6, "cuda")
    x = torch.randn(9, 3, generator=generator(0)).requires_grad_()
    quantizer = NSVQ(4, 3)
    quantizer.fit(x.detach(), generator=generator(1))
    quantizer.codebook.data[-1] = 1e3  # no row has the last code, and below no code the last row
    quantizer(x, generator(2), torch.arange(0, 8, 2))[0].sum().backward()


def draw(width: int, height: int, backend: str, **options: Any) -> None:
    """Render with all that can be absgrad, compare with photos of floats and of bytes, and back."""
    camera, splats = front_camera(width, height), random_splats(6, sh_degree=1)
    leaves = RawSplats(*(tensor.requires_grad_() for tensor in splats))
    visible(leaves, camera, backend=backend)
    result = render(leaves, camera, pixel_weights=some_pixel_weights(camera), backend=backend, **options)
    photo = torch.rand(height, width, 3, generator=generator(0))
    losses = [photometric_loss(result.image, photo), photometric_loss(result.image, (255 * photo).byte(), psnr=True)]
    (sum(losses) + result.alpha.sum() + result.depth.sum()).backward()


class Call(NamedTuple):
    """A call of an entry point."""

    function: Callable[..., Any]
    arguments: inspect.BoundArguments

    def with_arguments(self, arguments: dict[str, Any]) -> Call:
        return Call(self.function, inspect.BoundArguments(self.arguments.signature, arguments))  # type: ignore[arg-type]

    @property
    def arrays(self) -> dict[str, Any]:
        return dict(_arrays(self.arguments.arguments))


@contextmanager
def recorded(names: list[str], most: int) -> Iterator[dict[str, dict[str, Call]]]:
    """Note how entry points are called in the body of a ``with`` statement, by name and kind of arrays."""
    calls: dict[str, dict[str, Call]] = {name: {} for name in names}
    aliases = [(module, key, value) for module in list(sys.modules.values()) for key, value in _items(module)]
    with pytest.MonkeyPatch.context() as patch:
        for name in names:
            owner, attribute = _owner(name)
            function = getattr(owner, attribute)
            record = _recorder(function, calls[name], most)
            for place, key in {
                (owner, attribute),
                *((place, key) for place, key, value in aliases if value is function),
            }:
                patch.setattr(place, key, record)
        yield calls


def _items(module: Any) -> list[tuple[str, Any]]:
    return list(vars(module).items()) if module.__name__.startswith("nsvq_lightning") else []


def _owner(name: str) -> tuple[Any, str]:
    """The module or class that an entry point belongs to, and its name there."""
    before, _, attribute = name.rpartition(".")
    try:
        return importlib.import_module(before), attribute
    except ModuleNotFoundError:
        return getattr(*_owner(before)), attribute


def _recorder(function: Callable[..., Any], calls: dict[str, Call], most: int) -> Callable[..., Any]:
    signature = inspect.signature(function)

    @functools.wraps(function)
    def record(*args: Any, **options: Any) -> Any:
        arguments = signature.bind(*args, **options)
        call = Call(function, arguments)
        kind = " ".join(f"{path} {a.dtype} {tuple(a.shape[1:])}" for path, a in call.arrays.items())
        if kind not in calls and len(calls) < most:
            calls[kind] = call.with_arguments(_copied(arguments.arguments))
        return function(*args, **options)

    return record


# What can be wrong with an array

TYPES = {"float32": "float64", "float64": "float32", "int32": "int64", "int64": "int32", "uint64": "int64"}
STORED: dict[str, Callable[[Any], Any]] = {
    "another type": lambda array: array.astype(TYPES.get(str(array.dtype), "int32")),
    "gaps": lambda array: np.stack([array, array], -1)[..., 0],
}
"""The same numbers, otherwise stored."""
SIZES: dict[str, Callable[[Any], Any]] = {
    "too short": lambda array: array[:-1].copy(),
    "too long": lambda array: np.concatenate([array, array]),
    "too narrow": lambda array: np.ascontiguousarray(array[..., :-1]),
    "too wide": lambda array: np.concatenate([array, array], -1),
}
NUMBERS: dict[str, Callable[[Any], Any]] = {
    "a number below": lambda array: np.where(np.arange(array.size).reshape(array.shape) == 1, -2, array),
    "a number above": lambda array: np.where(np.arange(array.size).reshape(array.shape) == 1, array.max() + 300, array),
}


def wrong_calls(call: Call, numbers: bool) -> Iterator[tuple[str, Call, bool]]:
    """Each call with one wrong array, or numbers in it: what is wrong, and whether the numbers are still the same."""
    for path, array in call.arrays.items():
        ways = STORED | (SIZES if array.ndim else {})
        if numbers and array.ndim and _numbers(array).dtype.kind == "i":
            ways |= NUMBERS
        for way, change in ways.items():
            changed = change(_numbers(array))
            if isinstance(array, Tensor):
                changed = torch.from_numpy(changed).requires_grad_(array.requires_grad and changed.dtype.kind == "f")
            arguments = {
                name: _replaced(value, name, path, changed) for name, value in call.arguments.arguments.items()
            }
            yield f"{path}: {way}", call.with_arguments(arguments), way in STORED


def _arrays(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Path and array of all arrays in an argument, which may be in tuples."""
    if isinstance(value, np.ndarray | Tensor):
        yield path, value
    elif isinstance(value, dict | tuple | list):
        fields = value if isinstance(value, dict) else getattr(value, "_asdict", lambda: dict(enumerate(value)))()
        for name, part in fields.items():
            yield from _arrays(part, f"{path}.{name}".lstrip("."))


def _replaced(value: Any, path: str, wanted: str, array: Any) -> Any:
    """The argument with another array at a place in it."""
    if path == wanted:
        return array
    if isinstance(value, tuple):
        names = getattr(value, "_fields", range(len(value)))
        parts = [_replaced(part, f"{path}.{name}", wanted, array) for name, part in zip(names, value, strict=True)]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def _copied(value: Any) -> Any:
    """A copy without the history of gradients."""
    if isinstance(value, Tensor):
        return value.detach().clone().requires_grad_(value.requires_grad)
    if isinstance(value, dict):
        return {name: _copied(part) for name, part in value.items()}
    if isinstance(value, tuple):
        parts = map(_copied, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value if isinstance(value, memoryview) else copy.deepcopy(value)


def _numbers(value: Any) -> Any:
    return value.detach().numpy() if isinstance(value, Tensor) else value


# Calling


def outcome(call: Call, word: int = WORDS[0]) -> list[Any]:
    """All that a call between guard words computes: results, gradients, what it has changed; state is used twice."""
    call = call.with_arguments(_copied(call.arguments.arguments))
    arguments = call.arguments
    with guarded(word):
        for _ in range(2 if "self" in arguments.arguments else 1):
            result = call.function(*arguments.args, **arguments.kwargs)
        results = [part for _, part in _arrays((result,))] or [result]
        sums = [part.sum() for part in results if isinstance(part, Tensor) and part.requires_grad]
        leaves = [array for array in call.arrays.values() if isinstance(array, Tensor) and array.requires_grad]
        gradients = torch.autograd.grad(sums, leaves, allow_unused=True) if sums else []
    return [_numbers(value) for value in (*results, *gradients, *call.arrays.values())]


def judged(call: Call, expected: list[Any] | None) -> str:
    """``refused``, ``right``, or what is wrong with a call that may have to give certain results."""
    try:
        found = outcome(call, WORDS[1])
        wanted = outcome(call) if expected is None else expected
    except (ValueError, TypeError, RuntimeError):  # the last one is autograd's
        return "refused"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    if _alike(found, wanted, 0.0 if expected is None else 1e-4):
        return "right"
    return "it depends on what lies beside its arrays" if expected is None else "the same numbers give another result"


def _alike(found: list[Any], expected: list[Any], tolerance: float) -> bool:
    for a, b in zip(found, expected, strict=True):
        if not isinstance(a, np.ndarray):
            if a != b:
                return False
        elif a.shape != b.shape or not np.allclose(a, b, tolerance, tolerance, equal_nan=True):
            return False
    return True


def _say(*parts: str) -> None:
    print(json.dumps(parts), flush=True)


def main(compiler: str) -> None:
    """Every call of the entry points of a compiler with one wrong array."""
    # Commands are given no arrays.
    names = [name for name, by in entry_points().items() if by == compiler and ".commands." not in name]
    with recorded(names, MOST[compiler]) as calls:
        {"numba": use_cpu, "triton": use_triton}[compiler]()
    for name, right in calls.items():
        for number, call in enumerate(right.values()):
            expected = outcome(call)
            # Numbers on a GPU are not looked at: the host would have to wait for them.
            for what, wrong, same in wrong_calls(call, numbers=compiler == "numba"):
                _say(name, f"{number} {what}", "begun")
                _say(name, f"{number} {what}", judged(wrong, expected if same else None))
        _say(name, f"{len(right)} calls", "done" if right else "not called")


if __name__ == "__main__":
    faulthandler.enable()
    faulthandler.dump_traceback_later(TIMEOUT, exit=True)
    np.seterr(all="ignore")
    torch.use_deterministic_algorithms(True)  # fills what nothing else has written
    main(sys.argv[1])
