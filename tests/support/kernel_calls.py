"""Calls of every entry point with arrays that are wrong in one way each; run as a script, in a process of its own.

What reads or writes past the end of an array may crash or hang the process, so it prints each call before it makes it,
and works between guard words. A line is a JSON list: entry point, call, and ``begun``, ``same`` (as the call with the
right arrays), ``other`` (another well-formed call), or the name of an exception and its text.
"""

from __future__ import annotations

import faulthandler
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from guards import guarded
from numba import prange
from torch import Tensor

from nsvq_lightning.compute.jit import kernel
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.splats.splats import RawSplats

__all__ = ["NUMBA", "SCALAR", "TRITON", "Case"]

TIMEOUT = 500
"""Seconds after which a call that hangs is reported."""


class Case(NamedTuple):
    """The right arguments of an entry point.

    Attributes:
        arguments: Makes them anew, by name; arrays may stand in named tuples and lists.
        rows: Arrays that say how many rows there are: with more or fewer it is another well-formed call.
        columns: Arrays that say how many numbers a row has.
        types: Arrays that may be of another type.
        numbers: Arrays of row numbers; with one that is no row the call must be refused.
        call: What is called with them, if not the function alone.
    """

    arguments: Callable[[], dict[str, Any]]
    rows: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    types: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ()
    call: Callable[..., Any] = lambda function, **arguments: function(**arguments)


def _normal(*shape: int, seed: int = 0) -> Any:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def _tensor(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(_normal(*shape, seed=seed))


def _camera(width: int = 36, height: int = 28) -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[30.0, 0, 0.5 * width], [0, 30.0, 0.5 * height], [0, 0, 1]])
    return Camera(K, viewmat, width, height)


def _splats() -> RawSplats:
    shapes = (70, 3), (70, 4), (70, 3), (70,), (70, 1, 3), (70, 3, 3)
    return RawSplats(*(0.5 * _tensor(*shape, seed=seed) for seed, shape in enumerate(shapes)))


def _rows(count: int = 40) -> Any:
    return np.sort(np.random.default_rng(1).permutation(70)[:count])


def _codes(count: int = 40, codes: int = 9) -> Any:
    return np.random.default_rng(2).integers(0, codes, count)


def _substitution(dim: int) -> dict[str, Any]:
    rows, codes = torch.from_numpy(_rows()), torch.from_numpy(_codes())
    return {"x": _tensor(70, dim), "rows": rows, "codebook": _tensor(9, dim, seed=1), "codes": codes}


def _gradient(dim: int) -> dict[str, Any]:
    return _substitution(dim) | {"grad": _tensor(40, dim, seed=2), "out": _tensor(40, dim, seed=3)}


def _box_search() -> dict[str, Any]:
    from nsvq_lightning.quantize.box_search import Memory, sort_into_leaves

    codebook = _normal(300, 3, seed=1)
    memory = Memory(_codes(70, 300).astype(np.int32), _normal(70, 3), np.full(70, 0.2))
    return {
        "x": _normal(70, 3), "codebook": codebook, "order": sort_into_leaves(codebook), "rows": _rows(),
        "memory": memory,
    }  # fmt: skip


def _priced() -> dict[str, Any]:
    table = {"x": _tensor(70, 3), "codebook": _tensor(50, 3, seed=1)}
    return table | {"rates": _tensor(50, seed=2).abs(), "prices": _tensor(70, seed=3).abs()}


def _search(function: Callable[..., Any], **arguments: Any) -> list[Tensor]:
    from nsvq_lightning.quantize.tracking import NearestTracker

    tracker = NearestTracker()
    return [function(tracker, **arguments) for _ in range(3)]


def _tracked(dim: int) -> dict[str, Any]:
    return {"x": _tensor(70, dim), "codebook": _tensor(50, dim, seed=1), "rows": torch.from_numpy(_rows())}


def _paths() -> dict[str, Any]:
    neighbours = np.arange(40, dtype=np.int32)[:, None] - np.array([1, 2], np.int32)
    return {"paths": _codes(40, 1 << 20), "bits": 20, "neighbours": np.maximum(neighbours, np.int32(-1))}


def _stored_paths() -> dict[str, Any]:
    from nsvq_lightning.io.nsvq.entropy import encode_paths

    arguments = _paths()
    paths = arguments.pop("paths")
    return {"data": encode_paths(paths, **arguments)} | arguments


def _keys() -> dict[str, Any]:
    depths = _codes(40, 64)
    keys = np.sort(np.random.default_rng(3).integers(0, 1 << 63, 40, np.uint64))
    return {"keys": keys, "depths": depths}


def _stored_keys() -> dict[str, Any]:
    from nsvq_lightning.io.nsvq.entropy import encode_keys

    return {"data": encode_keys(**_keys()), "depths": _keys()["depths"]}


def _stored_integers() -> dict[str, Any]:
    from nsvq_lightning.io.nsvq.entropy import encode_integers

    return {"data": encode_integers(_codes(40).reshape(20, 2)), "rows": 20, "columns": 2}


def _statistics() -> dict[str, Any]:
    radii = torch.from_numpy(_codes(70, 3).astype(np.int32))
    return {
        "sums": _tensor(70), "views": _tensor(70, seed=1), "gradients": _tensor(70, 2, seed=2), "radii": radii,
        "factors": (2.0, 3.0),
    }  # fmt: skip


def _observed() -> dict[str, Any]:
    names = ("gradients", "views", "weights")
    tables = {name: _tensor(70, seed=seed) for seed, name in enumerate(names)}
    radii = torch.from_numpy(_codes(70, 3).astype(np.int32))
    return tables | {"observed": _tensor(70, 3, seed=3), "radii": radii, "factors": (2.0, 3.0)}


def _pictures(kind: torch.dtype = torch.float32) -> dict[str, Any]:
    target = (255 * _tensor(30, 40, 3, seed=1).abs().clamp(max=1)).to(torch.uint8)
    target = target if kind == torch.uint8 else target / 255
    return {"image": _tensor(30, 40, 3), "target": target, "dssim_weight": 0.2}


def _render() -> dict[str, Any]:
    return {
        "splats": _splats(), "camera": _camera(), "sh_degree": 1, "background": _tensor(3), "pixel_map": _tensor(28, 36)
    }  # fmt: skip


def _render_and_back(function: Callable[..., Any], splats: RawSplats, **arguments: Any) -> list[Any]:
    """The picture, the gradients and what was observed."""
    leaves = RawSplats(*(tensor.detach().requires_grad_() for tensor in splats))
    observed = torch.zeros(len(splats.means), 3, requires_grad=True)
    image, alpha, radii, means2d, depth = function(leaves, observed=observed, **arguments)
    gradients = torch.autograd.grad(image.sum() + alpha.sum() + depth.sum(), [*leaves, observed])
    return [image.detach(), radii, means2d.detach(), *gradients]


def _kept_and_back(function: Callable[..., Any], splats: RawSplats, **arguments: Any) -> list[Any]:
    """The factors and the gradients."""
    leaves = RawSplats(*(tensor.detach().requires_grad_() for tensor in splats))
    factors = function(leaves, **arguments)
    return [factors.detach(), *torch.autograd.grad(factors.sum(), leaves[:3])]


_Q, _IO, _CPU = "nsvq_lightning.quantize", "nsvq_lightning.io", "nsvq_lightning.rendering.cpu"
_ROWS, _SSIM = "nsvq_lightning.compute.rows", "nsvq_lightning.quality.ssim"

NUMBA: dict[str, list[Case]] = {
    f"{_SSIM}_cpu.l1_dssim": [Case(_pictures), Case(lambda: _pictures(torch.uint8))],
    f"{_CPU}.rasterizer.render": [Case(_render, call=_render_and_back)],
    f"{_CPU}.rasterizer.visible": [Case(lambda: {"splats": _splats(), "camera": _camera()})],
    f"{_CPU}.rasterizer.light_kept": [
        Case(
            lambda: {"splats": _splats(), "camera": _camera(), "rows": torch.arange(3, 60, 2)},
            rows=("splats", "rows"),
            numbers=("rows",),
            call=_kept_and_back,
        )
    ],
    f"{_ROWS}.gather_rows": [
        Case(
            lambda: {"table": _tensor(70, 5), "rows": torch.from_numpy(_rows())},
            rows=("table", "rows"),
            columns=("table",),
            numbers=("rows",),
        )
    ],
    f"{_ROWS}.spread_rows": [
        Case(
            lambda: {"values": _tensor(40, 5), "rows": torch.from_numpy(_rows()), "count": 70},
            columns=("values",),
            numbers=("rows",),
        )
    ],
    f"{_CPU}.statistics.add_view": [Case(_statistics)],
    f"{_CPU}.statistics.add_observed": [Case(_observed)],
    f"{_Q}.box_search.box_search": [Case(_box_search, rows=("x", "rows"), numbers=("order", "rows"))],
    f"{_Q}.box_search.sort_into_leaves": [
        Case(lambda: {"codebook": _normal(300, 3)}, rows=("codebook",), columns=("codebook",))
    ],
    f"{_Q}.nearest.cheapest": [Case(_priced, rows=("x", "prices"), types=("x", "codebook"))],
    f"{_Q}.scores.score_search": [
        Case(
            lambda: {"x": _normal(70, 12), "codebook": _normal(50, 12, seed=1), "with_lists": True},
            rows=("x", "codebook"),
        )
    ],
    f"{_Q}.substitution.substitute": [
        Case(lambda dim=dim: {"seed": 5} | _substitution(dim), rows=("x", "codebook"), numbers=("rows", "codes"))
        for dim in (3, 20)
    ],
    f"{_Q}.substitution.substitute_backward": [
        Case(lambda dim=dim: _gradient(dim), rows=("x", "codebook"), numbers=("rows", "codes")) for dim in (3, 20)
    ],
    f"{_Q}.kmeans.sum_by_code": [
        Case(
            lambda: {"values": _tensor(40, 5), "codes": torch.from_numpy(_codes()), "num_codes": 9},
            columns=("values",),
            types=("values",),
        )
    ],
    f"{_Q}.tracking.NearestTracker.search": [
        Case(lambda dim=dim: _tracked(dim), rows=("x", "codebook", "rows"), numbers=("rows",), call=_search)
        for dim in (3, 20)
    ],
    f"{_IO}.nsvq.codebook_order.tree_order": [
        Case(lambda: {"codebook": _normal(50, 3)}, rows=("codebook",), columns=("codebook",))
    ],
    f"{_IO}.nsvq.entropy.encode_paths": [Case(_paths, numbers=("neighbours",))],
    f"{_IO}.nsvq.entropy.decode_paths": [Case(_stored_paths, rows=("neighbours",), numbers=("neighbours",))],
    f"{_IO}.nsvq.entropy.encode_keys": [Case(_keys, numbers=("depths",))],
    f"{_IO}.nsvq.entropy.decode_keys": [Case(_stored_keys, rows=("depths",), numbers=("depths",))],
    f"{_IO}.nsvq.entropy.encode_integers": [
        Case(lambda: {"values": _codes().reshape(20, 2)}, rows=("values",), columns=("values",))
    ],
    f"{_IO}.nsvq.entropy.decode_integers": [Case(_stored_integers)],
    f"{_IO}.palette.find_palette": [
        Case(
            lambda: {"rows": _normal(60, 5), "weight": np.ones(60), "count": 7}, columns=("rows",), types=("weight",)
        )
    ],
    f"{_IO}.morton.morton_keys": [
        Case(
            lambda: {"cells": _codes(60).reshape(20, 3), "depths": np.full(20, 18)},
            rows=("cells", "depths"),
            numbers=("depths",),
        )
    ],
    f"{_IO}.morton.unmorton": [Case(lambda: {"keys": _codes(20).astype(np.uint64)}, rows=("keys",))],
    f"{_IO}.morton.nearest_before": [Case(lambda: {"cells": _codes(60).reshape(20, 3)}, rows=("cells",))],
}  # fmt: skip


SCALAR = [
    name for name in NUMBA if name.startswith(_IO) or name.rpartition(".")[2] in ("sort_into_leaves", "sum_by_code")
]
"""Entry points whose kernels index arrays as Python does, so that Numba can check the bounds."""


def _lens() -> Any:
    from nsvq_lightning.rendering.cuda.projection import Lens

    return Lens.of(_camera(16, 12), torch.device("cpu"))  # one tile: the interpreter is slow


@cache
def _projected() -> Any:
    from nsvq_lightning.rendering.cuda.projection import project

    return project(_lens(), tuple(_splats()), 1)


def _by_attribute(function: Callable[..., Any], splats: RawSplats, **arguments: Any) -> Any:
    return function(attributes=tuple(splats), **arguments)


def _blending() -> dict[str, Any]:
    from nsvq_lightning.rendering.cuda.binning import list_tiles
    from nsvq_lightning.rendering.cuda.blend import tile_grid

    projected = _projected()
    tiles = list_tiles(projected.boxes, *tile_grid(16, 12))
    return {"lens": _lens(), "records": projected.records, "tiles": tiles, "background": _tensor(3)}


class _Pictures(NamedTuple):
    image: Tensor
    alpha: Tensor
    depth: Tensor


@cache
def _blended() -> Any:
    from nsvq_lightning.rendering.cuda.blend import blend

    return blend(**_blending())


def _blending_backward() -> dict[str, Any]:
    arguments, (image, transmittance, depth, ends) = _blending(), _blended()
    del arguments["background"]
    gradients = _Pictures(_tensor(12, 16, 3), _tensor(12, 16, seed=1), _tensor(12, 16, seed=2))
    outputs = _Pictures(image, transmittance, depth)
    return arguments | {
        "ids": _projected().ids, "n": 70, "ends": ends, "outputs": outputs, "gradients": gradients,
        "pixel_map": _tensor(12, 16, seed=3),
    }  # fmt: skip


def _projection_backward() -> dict[str, Any]:
    projected = _projected()
    totals = _tensor(*projected.records.shape)
    return {
        "lens": _lens(), "splats": _splats(), "degree": 1, "ids": projected.ids, "records": projected.records,
        "totals": totals, "g_means2d": _tensor(70, 2),
    }  # fmt: skip


@cache
def _derivatives() -> Any:
    from nsvq_lightning.quality.ssim_cuda import l1_dssim

    return l1_dssim(**_pictures())[1]


def _pictures_backward() -> dict[str, Any]:
    return _pictures() | {"derivatives": _derivatives(), "scale": torch.ones(())}


_CUDA = "nsvq_lightning.rendering.cuda"


def _pairs() -> dict[str, Any]:
    boxes = _projected().boxes
    ends = (boxes[:, 2] * boxes[:, 3]).cumsum(0).int()
    return {"boxes": boxes, "ends": ends, "total": int(ends[-1]), "columns": 1, "rows": 1}


def _search_on_device(function: Callable[..., Any], **arguments: Any) -> Any:
    from nsvq_lightning.quantize.cuda.search import DeviceTracker

    return function(DeviceTracker(9, 3, torch.device("cpu")), **arguments)


TRITON: dict[str, list[Case]] = {
    f"{_CUDA}.binning.tiles_of": [Case(_pairs)],
    f"{_CUDA}.blend.blend": [Case(_blending)],
    f"{_CUDA}.blend.blend_backward": [Case(_blending_backward)],
    f"{_SSIM}_cuda.l1_dssim": [Case(_pictures), Case(lambda: _pictures(torch.uint8))],
    f"{_SSIM}_cuda.l1_dssim_backward": [Case(_pictures_backward)],
    f"{_CUDA}.projection.project": [
        Case(lambda: {"lens": _lens(), "splats": _splats(), "degree": 1}, call=_by_attribute)
    ],
    f"{_CUDA}.projection.project_radii": [Case(lambda: {"lens": _lens(), "splats": _splats()}, call=_by_attribute)],
    f"{_CUDA}.projection.project_backward": [Case(_projection_backward, call=_by_attribute)],
    f"{_Q}.cuda.search.nearest_codes": [
        Case(lambda: {"x": _tensor(20, 3), "codebook": _tensor(9, 3, seed=1)}, rows=("x", "codebook"))
    ],
    f"{_Q}.cuda.search.DeviceTracker.search": [
        Case(
            lambda: {
                "x": _tensor(20, 3), "codebook": _tensor(9, 3, seed=1), "rows": torch.tensor([0, 2, 3, 9])
            },
            rows=("x", "rows"),
            call=_search_on_device,
        )
    ],
    f"{_Q}.cuda.substitution.substitute": [
        Case(lambda dim=dim: {"seed": 5} | _substitution(dim), rows=("x", "codebook")) for dim in (3, 20)
    ],
    f"{_Q}.cuda.substitution.substitute_backward": [
        Case(lambda dim=dim: _gradient(dim), rows=("x", "codebook")) for dim in (3, 20)
    ],
    f"{_Q}.cuda.substitution.sum_rows": [
        Case(
            lambda: {
                "values": _tensor(40, 5), "codes": torch.from_numpy(_codes()), "num_codes": 9, "dtype": torch.float32
            },
            columns=("values",),
            types=("values",),
        )
    ],
}  # fmt: skip


# What can be wrong with an array


def _other_type(array: Any) -> Any:
    """The same numbers in another type."""
    if isinstance(array, Tensor):
        return array.to(torch.float64 if array.dtype != torch.float64 else torch.float32)
    return array.astype(np.float64 if array.dtype != np.float64 else np.float32)


def _other_width(array: Any) -> Any:
    """The same numbers in a type of the same kind and another width."""
    widths = {"float32": "float16", "float64": "float32", "int32": "int64", "int64": "int32", "uint64": "uint32"}
    name = str(array.dtype).removeprefix("torch.")
    other = widths.get(name, "int32")
    return array.to(getattr(torch, other)) if isinstance(array, Tensor) else array.astype(other)


def _with_gaps(array: Any) -> Any:
    """The same numbers, every second one of an array."""
    if isinstance(array, Tensor):
        return torch.stack([array, array], -1)[..., 0]
    return np.stack([array, array], -1)[..., 0]


def _doubled(array: Any, axis: int) -> Any:
    return torch.cat([array, array], axis) if isinstance(array, Tensor) else np.concatenate([array, array], axis)


def _cut(array: Any, axis: int) -> Any:
    part = array[:-1] if axis == 0 else array[..., :-1]
    return part.contiguous() if isinstance(part, Tensor) else np.ascontiguousarray(part)


def _with(array: Any, number: int) -> Any:
    array = array.clone() if isinstance(array, Tensor) else array.copy()
    array[(-1,) * array.ndim] = number
    return array


_WRONG: dict[str, Callable[[Any], Any]] = {
    "too short": lambda array: _cut(array, 0),
    "too long": lambda array: _doubled(array, 0),
    "too narrow": lambda array: _cut(array, -1),
    "too wide": lambda array: _doubled(array, -1),
    "another type": _other_type,
    "another width": _other_width,
    "gaps": _with_gaps,
}
_ROWS, _COLUMNS, _TYPES = ("too short", "too long"), ("too narrow", "too wide"), ("another type", "another width")
_MISSING = {"a number below": lambda array: _with(array, -(10**6)), "a number above": lambda array: _with(array, 10**6)}


def _arrays(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Name and array of all arrays in an argument."""
    if isinstance(value, np.ndarray | Tensor):
        yield name, value
    elif hasattr(value, "_asdict"):
        for field, part in value._asdict().items():
            yield from _arrays(part, f"{name}.{field}")


def _replaced(value: Any, name: str, path: str, array: Any) -> Any:
    """The argument with another array at a place in it."""
    if name == path:
        return array
    if hasattr(value, "_asdict"):
        parts = {field: _replaced(part, f"{name}.{field}", path, array) for field, part in value._asdict().items()}
        return type(value)(**parts)
    return value


class _Call(NamedTuple):
    """A call with one wrong array: its name, its arguments, and whether it is a well-formed call of another size."""

    name: str
    arguments: dict[str, Any]
    other: bool


def _calls(case: Case) -> Iterator[_Call]:
    for argument, value in case.arguments().items():
        for path, array in _arrays(value, argument):
            free = (case.rows, _ROWS), (case.columns, _COLUMNS), (case.types, _TYPES)
            others = {way for names, ways in free if argument in names for way in ways}
            for way, make in (_WRONG | (_MISSING if argument in case.numbers else {})).items():
                if (array.ndim < 2 and way in _COLUMNS) or (array.ndim == 0 and way in _ROWS):
                    continue
                arguments = case.arguments()
                arguments[argument] = _replaced(arguments[argument], argument, path, make(array))
                yield _Call(f"{path}: {way}", arguments, way in others)


# Calling


def _outcome(result: Any) -> list[Any]:
    """All numbers that a call has returned."""
    if isinstance(result, tuple | list):
        return [number for part in result for number in _outcome(part)]
    return [result.detach().cpu().numpy()] if isinstance(result, Tensor) else [result]


def _in_place(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """All arrays in arguments, by name."""
    return {path: _outcome(array)[0] for name, value in arguments.items() for path, array in _arrays(value, name)}


def _same(found: list[Any], expected: list[Any]) -> bool:
    return len(found) == len(expected) and all(
        a == b if isinstance(b, bytes | float | None) else np.array_equal(a, b, equal_nan=True)
        for a, b in zip(found, expected, strict=True)
    )


def _function(name: str) -> Callable[..., Any]:
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError:
        return getattr(_function(module), attribute)


class _Expected(NamedTuple):
    """What the right call returns, and the arrays that it changes."""

    result: list[Any]
    changed: dict[str, Any]

    @classmethod
    def of(cls, case: Case, function: Callable[..., Any]) -> _Expected:
        arguments = case.arguments()
        before = {path: array.copy() for path, array in _in_place(arguments).items()}
        result = _outcome(case.call(function, **arguments))
        after = _in_place(arguments)
        return cls(result, {path: array for path, array in after.items() if not _same([array], [before[path]])})


def _run(case: Case, function: Callable[..., Any], call: _Call, expected: _Expected) -> str:
    try:
        result = case.call(function, **call.arguments)
    except Exception as error:
        kind = next((kind for kind in (ValueError, TypeError) if isinstance(error, kind)), type(error))
        return f"{kind.__name__}: {error}"
    if call.other:
        return "other"
    after = _in_place(call.arguments)
    changed = [after[path] for path in expected.changed]
    return "same" if _same([*_outcome(result), *changed], [*expected.result, *expected.changed.values()]) else "wrong"


def _say(*parts: str) -> None:
    sys.stdout.write(json.dumps(parts) + "\n")
    sys.stdout.flush()


def call_wrongly(table: dict[str, list[Case]]) -> None:
    """Every call with one wrong array."""
    for name in table:
        function = _function(name)
        for number, case in enumerate(table[name]):
            expected = _Expected.of(case, function)
            for call in _calls(case):
                _say(name, f"{number} {call.name}", "begun")
                _say(name, f"{number} {call.name}", _run(case, function, call, expected))
        _say(name, "", "done")


def call_rightly() -> None:
    """The right calls of kernels whose bounds Numba checks, which the environment asks it to."""
    for name in SCALAR:
        for case in NUMBA[name]:
            case.call(_function(name), **case.arguments())
        _say(name, "", "done")


def overrun() -> None:
    """Write past the end of an array, in a kernel as the package compiles them."""

    def write(array: Any) -> None:
        for i in prange(len(array) + 1):
            array[i] = 1

    kernel(write)(np.zeros(10))


if __name__ == "__main__":
    faulthandler.enable()
    faulthandler.dump_traceback_later(TIMEOUT, exit=True)
    np.seterr(all="ignore")
    with guarded():
        if sys.argv[1] in ("numba", "triton"):
            call_wrongly({"numba": NUMBA, "triton": TRITON}[sys.argv[1]])
        else:
            {"rightly": call_rightly, "overrun": overrun}[sys.argv[1]]()
