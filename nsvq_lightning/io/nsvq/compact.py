"""Level ``compact``: a scene rounded to what can be seen, entropy-coded.

* Splats are in **Morton order** of their positions. A position is stored as a cell whose width follows its splat's
  size (:class:`~nsvq_lightning.io.nsvq.precision.Precision`), so scales come first in the file. A splat far outside the
  scene, which would make the grid coarse for all, keeps its position as float32, after the others.
* Codes are **paths down a tree** of the codebook's rows, which are ordered so that similar rows are neighbours; a
  decision is predicted from the codes of two nearby splats. Rows that no splat uses are left out, equal rows merged.
* Codebooks are integer multiples of a step that follows the distance between codes. Quaternions are normalised first.
* Opacities are rounded to equal steps of [0, 1] and coded like codes.
* Attributes without a codebook are integer multiples of a step.

Decoding never depends on floating-point arithmetic that two machines might round differently.

==========================  ================================================================================
stream                      content
==========================  ================================================================================
``scales``                  codes as paths, or integers; neighbours: the two splats before
``means.grid``              base of the grid (3 int64), doublings of its step for a splat of size 1 (float64)
``means``                   Morton keys of all splats but the far ones
``means.far``               float32 positions of the far splats
``opacities``               levels as paths; neighbours from here on: two near splats among the 16 before
``quats`` ``sh0`` ``shN``   codes as paths, or integers
``<attribute>.codebook``    integers, before the stream of its codes
==========================  ================================================================================
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from nsvq_lightning.io.compressed import QUANTIZABLE, CompressedScene, attribute_dims
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.morton import AXIS_BITS, Grid, morton_keys, nearest_before, unmorton
from nsvq_lightning.io.nsvq.bits import code_bits
from nsvq_lightning.io.nsvq.codebook_order import leaf_paths, sibling_distance, tree_order
from nsvq_lightning.io.nsvq.entropy import (
    decode_integers,
    decode_keys,
    decode_paths,
    encode_integers,
    encode_keys,
    encode_paths,
)
from nsvq_lightning.io.nsvq.header import AttributeEntry, Header, tile
from nsvq_lightning.io.nsvq.precision import MOST_OPACITY_LEVELS, Precision
from nsvq_lightning.io.opacity import opacity_of

__all__ = ["decode_compact", "encode_compact"]

_T = TypeVar("_T")

_GRID = struct.Struct("<qqqd")
_MOST_A_BYTE = 4096
"""Limit on splats or codebook rows per byte of stream; probabilities have a floor, so valid files have fewer."""
_LARGEST_LOG_SIZE = 300.0
"""Largest logarithm of a size in scene units whose multiples float64 still holds."""

_STREAMS = {"grid": ("means.grid", "means", "means.far"), "codes": ("{}.codebook", "{}"), "steps": ("{}",)}
_ENCODINGS = {"means.grid": "grid", "means": "keys", "means.far": "float32"}
_ORDER = ("scales", "means", "opacities", "quats", "sh0", "shN")
"""Attributes in the order of their streams."""


class _Stored(NamedTuple):
    """One attribute as integers.

    Attributes:
        entry: Its line in the header.
        values: Codes ``[N]`` (row of the codebook, or level) or integers ``[N, D]``, one row per splat.
        codebook: Integers ``[K, D]`` of the codebook; None if there is none.
    """

    entry: AttributeEntry
    values: NDArray[np.int64]
    codebook: NDArray[np.int64] | None = None

    def rows(self) -> NDArray[np.int64]:
        """Integers ``[N, D]`` of the splats."""
        return self.values if self.codebook is None else self.codebook[self.values]

    def in_order(self, order: NDArray[np.int64]) -> _Stored:
        """The same with the splats in another order."""
        return self._replace(values=self.values[order])


def encode_compact(scene: CompressedScene, precision: Precision | None = None) -> tuple[Header, dict[str, bytes]]:
    """Header and streams of a scene.

    Args:
        scene: The scene, all values finite.
        precision: The largest errors.

    Raises:
        ValueError: A value is not finite, or too large for its step.
    """
    precision = precision or Precision()
    _check_finite({"means": scene.means, "opacities": scene.opacities, **scene.raw})
    dims = attribute_dims(scene.sh_degree)
    stored = _all_of({name: partial(_stored, scene, name, dim, precision) for name, dim in dims.items()})
    stored["opacities"] = _levels(scene.opacities, precision.opacity_levels)
    sums, step = stored["scales"].rows().sum(1), stored["scales"].entry.step
    size = np.exp(np.minimum(sums * (step / 3), _LARGEST_LOG_SIZE))
    grid = Grid.around(scene.means, 2 * precision.position * size)
    doublings = math.log2(2 * precision.position / grid.step)
    depths = grid.depths(_doublings(sums, step, doublings))
    cells, inside = grid.cells(scene.means)
    keys = morton_keys(cells, depths)
    near = np.flatnonzero(inside)
    near, far = near[np.argsort(keys[near], kind="stable")], np.flatnonzero(~inside)
    order = np.concatenate([near, far])
    stored = {name: attribute.in_order(order) for name, attribute in stored.items()}

    neighbours = {"scales": _before(len(order))}
    streams = {
        "means.grid": _GRID.pack(*grid.base, doublings),
        "means": encode_keys(keys[near], 3 * depths[near]),
        "means.far": scene.means[far].astype("<f4", copy=False).tobytes(),
    }
    others = _neighbours(keys[near], depths[near], len(order))
    tasks: dict[str, Callable[[], bytes]] = {}
    for name, attribute in stored.items():
        if attribute.codebook is not None:
            tasks[f"{name}.codebook"] = partial(encode_integers, attribute.codebook)
        tasks[name] = partial(_encode_values, attribute, neighbours.get(name, others))
    streams |= _all_of(tasks)
    entries = {name: attribute.entry for name, attribute in stored.items()}
    entries["means"] = AttributeEntry("means", 3, "grid", step=grid.step)
    attributes = tuple(entries[name] for name in _ORDER)
    header = Header(
        level="compact",
        splats=len(scene),
        sh_degree=scene.sh_degree,
        origin=(float(scene.origin[0]), float(scene.origin[1]), float(scene.origin[2])),
        attributes=attributes,
        streams=tile([(name, len(streams[name]), kind) for name, kind in _stream_names(attributes)]),
        config=dict(scene.config),
        metrics=dict(scene.metrics),
    )
    return header, streams


def decode_compact(header: Header, streams: Mapping[str, memoryview]) -> CompressedScene:
    """Scene from header and streams.

    Raises:
        FormatError: The tables do not belong to this level, or a stream does not hold what they say.
    """
    entries = _checked_tables(header)
    n = header.splats
    stored = {"scales": _decode(entries["scales"], streams, _before(n))}
    means, others = _decode_means(entries["means"].step, stored["scales"], streams)
    names = [name for name in _ORDER if name not in ("scales", "means")]
    stored |= _all_of({name: partial(_decode, entries[name], streams, others) for name in names})
    levels = stored.pop("opacities")
    shares = (np.arange(levels.entry.codes) + 0.5) / levels.entry.codes
    logits = (np.log(shares) - np.log1p(-shares)).astype(np.float32)
    coded = {name: attribute for name, attribute in stored.items() if attribute.codebook is not None}
    return CompressedScene(
        means=means,
        opacities=logits[levels.values],
        codes={name: coded[name].values for name in QUANTIZABLE if name in coded},
        codebooks={name: _floats(coded[name].codebook, coded[name].entry) for name in QUANTIZABLE if name in coded},
        raw={name: _floats(stored[name].values, stored[name].entry) for name in QUANTIZABLE if name not in coded},
        sh_degree=header.sh_degree,
        config=header.config,
        metrics=header.metrics,
        origin=header.origin,
    )


# Attributes as integers


def _check_finite(arrays: Mapping[str, NDArray[np.float32]]) -> None:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(
                f"{name}: {int((~np.isfinite(array)).sum())} numbers are not finite; drop those splats, or use level "
                "'paper', which stores float32 as it is"
            )


def _stored(scene: CompressedScene, name: str, dim: int, precision: Precision) -> _Stored:
    if name in scene.raw:
        step = 2 * getattr(precision, name)
        rows = _normalised(scene.raw[name]) if name == "quats" else scene.raw[name]
        return _Stored(AttributeEntry(name, dim, "steps", step=step), _integers(name, rows, step))
    codebook, codes = _compacted(name, scene.codebooks[name], scene.codes[name])
    order = tree_order(codebook)
    codebook, codes = codebook[order], np.argsort(order)[codes]
    step = 2 * precision.codebook * sibling_distance(codebook) or 2.0**-16
    entry = AttributeEntry(name, dim, "codes", len(codebook), code_bits(len(codebook)), step)
    return _Stored(entry, codes, _integers(name, codebook, step))


def _compacted(
    name: str, codebook: NDArray[np.float32], codes: NDArray[np.integer]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The rows in use, each once, and the codes into them."""
    used = np.bincount(codes, minlength=len(codebook)) > 0
    rows = codebook[used] if len(codes) else np.zeros_like(codebook[:1])
    _check_finite({f"codebook of {name}": rows})
    rows, merged = np.unique(_normalised(rows) if name == "quats" else rows, axis=0, return_inverse=True)
    return rows, merged.reshape(-1)[np.cumsum(used)[codes] - 1]


def _normalised(quats: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit quaternions of the same rotations; zero becomes the identity, as in rendering."""
    rows = quats.astype(np.float64)
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    return np.where(norm > 0, rows / np.where(norm > 0, norm, 1), identity).astype(np.float32)


def _integers(name: str, rows: NDArray[np.float32], step: float) -> NDArray[np.int64]:
    values = np.rint(rows.astype(np.float64) / step)
    if not (np.abs(values) < 2.0**52).all():
        raise ValueError(f"{name}: {np.abs(rows).max():.3g} is too large for steps of {step:.3g}; use level 'paper'")
    return values.astype(np.int64)


def _floats(values: NDArray[np.int64] | None, entry: AttributeEntry) -> NDArray[np.float32]:
    assert values is not None
    return (values * entry.step).astype(np.float32)


def _levels(logits: NDArray[np.float32], count: int) -> _Stored:
    shares = opacity_of(logits)
    values = np.minimum((shares * count).astype(np.int64), count - 1)
    return _Stored(AttributeEntry("opacities", 1, "levels", count, code_bits(count)), values)


def _doublings(sums: NDArray[np.int64], step: float, for_size_one: float) -> NDArray[np.float64]:
    """Base-2 logarithm ``[N]`` of the width of each splat's widest cell, in steps of the grid.

    It uses only sums, products and quotients, whose rounding is the same everywhere: key depths depend on it.

    Args:
        sums: Sum ``[N]`` of the three integers of each splat's log-scales.
        step: The step that these are multiples of.
        for_size_one: The result for a splat of size 1.
    """
    factor = step / 3 / math.log(2.0)
    return sums.astype(np.float64) * factor + for_size_one


# Streams


def _before(count: int) -> NDArray[np.int32]:
    """The two rows ``[N, 2]`` before each row, -1 where there is none."""
    rows = np.arange(count, dtype=np.int32)[:, None] - np.array([1, 2], np.int32)
    return np.maximum(rows, np.int32(-1))


def _neighbours(keys: NDArray[np.uint64], depths: NDArray[np.int64], count: int) -> NDArray[np.int32]:
    """Two near rows ``[N, 2]`` before each row; for the far splats, which follow the keys, the two rows before."""
    half = (np.int64(1) << (AXIS_BITS - depths)) >> 1
    neighbours = _before(count)
    neighbours[: len(keys)] = nearest_before(unmorton(keys) + half[:, None])
    return neighbours


def _encode_values(attribute: _Stored, neighbours: NDArray[np.int32]) -> bytes:
    entry = attribute.entry
    if entry.storage == "steps":
        return encode_integers(attribute.values)
    return encode_paths(leaf_paths(entry.codes)[attribute.values], entry.bits, neighbours)


def _decode(entry: AttributeEntry, streams: Mapping[str, memoryview], neighbours: NDArray[np.int32]) -> _Stored:
    if entry.storage == "steps":
        return _Stored(entry, decode_integers(streams[entry.name], len(neighbours), entry.dim))
    paths = decode_paths(streams[entry.name], entry.bits, neighbours)
    leaf_of = np.full(1 << entry.bits, -1)
    leaf_of[leaf_paths(entry.codes)] = np.arange(entry.codes)
    values = leaf_of[paths]
    if (values < 0).any():
        raise FormatError(f"damaged: a code of {entry.name} is not one of {entry.codes}")
    codebook = None
    if entry.storage == "codes":
        codebook = decode_integers(streams[f"{entry.name}.codebook"], entry.codes, entry.dim)
    return _Stored(entry, values, codebook)


def _decode_means(
    step: float, scales: _Stored, streams: Mapping[str, memoryview]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Positions ``[N, 3]``, and two near rows ``[N, 2]`` for each."""
    *base, doublings = _GRID.unpack(streams["means.grid"])
    grid = Grid(step, (base[0], base[1], base[2]))
    far = np.frombuffer(streams["means.far"], "<f4").astype(np.float32).reshape(-1, 3)
    count = len(scales.values)
    depths = grid.depths(_doublings(scales.rows().sum(1), scales.entry.step, doublings))[: count - len(far)]
    keys = decode_keys(streams["means"], 3 * depths)
    means = np.concatenate([grid.centers(unmorton(keys), depths), far])
    return means, _neighbours(keys, depths, count)


def _all_of(tasks: Mapping[str, Callable[[], _T]]) -> dict[str, _T]:
    """Results of independent tasks, run in as many threads as torch uses; the kernels release the GIL."""
    with ThreadPoolExecutor(max_workers=torch.get_num_threads()) as pool:
        futures = {name: pool.submit(task) for name, task in tasks.items()}
        return {name: future.result() for name, future in futures.items()}


def _stream_names(attributes: tuple[AttributeEntry, ...]) -> list[tuple[str, str]]:
    """Name and encoding of the streams that the attributes have."""
    names = []
    for entry in attributes:
        for pattern in _STREAMS.get(entry.storage, ("{}",)):
            name = pattern.format(entry.name)
            integers = name.endswith(".codebook") or entry.storage == "steps"
            names.append((name, _ENCODINGS.get(name, "integers" if integers else "paths")))
    return names


def _checked_tables(header: Header) -> dict[str, AttributeEntry]:
    """Compare with the tables this release would write, before anything is allocated from their sizes."""
    dims = {"means": 3, "opacities": 1, **attribute_dims(header.sh_degree)}
    if [(entry.name, entry.dim) for entry in header.attributes] != [(name, dims[name]) for name in _ORDER]:
        raise FormatError(f"damaged: the attribute table must list {', '.join(_ORDER)}, got {header.attributes}")
    lengths = {stream.name: stream.length for stream in header.streams}
    for entry in header.attributes:
        if not _possible(entry, lengths):
            raise FormatError(f"damaged: impossible attribute {entry}")
    if [(stream.name, stream.encoding) for stream in header.streams] != _stream_names(header.attributes):
        raise FormatError("damaged: the stream table does not fit the attribute table")
    if lengths["means.grid"] != _GRID.size or lengths["means.far"] % 12 or lengths["means.far"] // 12 > header.splats:
        raise FormatError("damaged: the streams of the positions do not have their sizes")
    if header.splats > _MOST_A_BYTE * sum(lengths.values()):
        raise FormatError(f"damaged: {header.splats} splats in {sum(lengths.values())} bytes")
    return {entry.name: entry for entry in header.attributes}


def _possible(entry: AttributeEntry, lengths: Mapping[str, int]) -> bool:
    if entry.name == "means":
        return entry.storage == "grid" and entry.codes == entry.bits == 0 and entry.step > 0
    if entry.storage == "steps":
        return entry.name in QUANTIZABLE and entry.codes == entry.bits == 0 and entry.step > 0
    if not 1 <= entry.codes <= 1 << 32 or entry.bits != code_bits(entry.codes):
        return False
    if entry.name == "opacities":
        return entry.storage == "levels" and entry.codes <= MOST_OPACITY_LEVELS and entry.step == 0
    enough = entry.codes <= _MOST_A_BYTE * lengths.get(f"{entry.name}.codebook", 0)
    return entry.storage == "codes" and entry.step > 0 and enough and entry.dim > 0
