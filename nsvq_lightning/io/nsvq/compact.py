"""Level ``compact``: a scene rounded to what can be seen, entropy-coded.

* Splats are in **Morton order** of their positions. A position is stored as a cell whose width follows its splat's size
  and opacity (:class:`~nsvq_lightning.io.nsvq.precision.Precision`), so these come first in the file. A splat far
  outside the scene, which would make the grid coarse for all, keeps its position as float32, after the others.
* Codes are **paths down a tree** of the codebook's rows, which are ordered so that similar rows are neighbours; a
  decision is predicted from the codes of two nearby splats. Rows that no splat uses are left out, equal rows merged.
* Codebooks are integer multiples of a step that follows the distance between codes. Quaternions are normalised first.
* Opacities are rounded to equal steps of [0, 1] and coded like codes.
* Attributes without a codebook are integer multiples of a step.

Decoding never depends on floating-point arithmetic that two machines might round differently.

==========================  ================================================================================
stream                      content
==========================  ================================================================================
``opacities``               levels as paths; neighbours: the two splats before
``scales``                  codes as paths, or integers; the same neighbours
``means.grid``              base of the grid (3 int64), doublings of its step for a splat of size 1 (float64)
``means``                   Morton keys of all splats but the far ones
``means.far``               float32 positions of the far splats
``quats`` ``sh0`` ``shN``   codes as paths, or integers; neighbours: two near splats among the 16 before
``<attribute>.codebook``    integers, before the stream of its codes
==========================  ================================================================================

In files of version 1, whose positions have the storage ``grid`` instead of ``cells``, the width of a cell follows the
size alone, and the opacities come after the positions, with near splats as neighbours.
"""

import math
import struct
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FEW_ROWS, FormatError, check_room
from nsvq_lightning.io.morton import AXIS_BITS, Grid, morton_keys, nearest_before, unmorton
from nsvq_lightning.io.nsvq import entropy
from nsvq_lightning.io.nsvq.codebook_order import leaf_paths
from nsvq_lightning.io.nsvq.header import AttributeEntry, Header, StreamEntry
from nsvq_lightning.io.nsvq.precision import MOST_OPACITY_LEVELS, Precision
from nsvq_lightning.io.nsvq.rounding import Stored, doublings_of, logits_of_levels, position_grid, rounded
from nsvq_lightning.splats.attributes import QUANTIZABLE, attribute_dims

_GRID = struct.Struct("<qqqd")

_POSITIONS = ("means.grid", "means", "means.far")
_STREAMS = {"grid": _POSITIONS, "cells": _POSITIONS, "codes": ("{}.codebook", "{}"), "steps": ("{}",)}
_ENCODINGS = {"means.grid": "grid", "means": "keys", "means.far": "float32"}
# Attributes whose streams come before those of the positions, by the storage of these.
_BEFORE_POSITIONS = {"cells": ("opacities", "scales"), "grid": ("scales",)}
# The other attributes, by the time they take: the longest task should not begin last.
_LARGEST_FIRST = sorted((name for name in QUANTIZABLE if name != "scales"), key=lambda name: -attribute_dims(3)[name])
# Three float32.
_FAR_BYTES = 12


class _Places(NamedTuple):
    """Where the splats are, but for the far ones, in the order of the file.

    Attributes:
        grid: The grid of the positions.
        doublings: Of its step, for an opaque splat of size 1.
        keys: Morton keys, ascending.
        depths: Bits per axis of each.
    """

    grid: Grid
    doublings: float
    keys: NDArray[np.uint64]
    depths: NDArray[np.int64]


def encode_compact(scene: CompressedScene, precision: Precision | None = None) -> tuple[Header, dict[str, bytes]]:
    """Header and streams of a scene.

    Args:
        scene: The scene, all values finite.
        precision: The largest errors.

    Raises:
        ValueError: A value is too large for its step.
    """
    precision = precision or Precision()
    early = _BEFORE_POSITIONS["cells"]
    with _workers() as pool:
        # Positions follow two attributes. They give the order of the splats, in which all others are written.
        rounding = {name: pool.submit(rounded, scene, name, precision) for name in (*early, _LARGEST_FIRST[0])}
        placing = pool.submit(_places, scene.means, {name: rounding[name].result() for name in early}, precision)
        rounding |= {name: pool.submit(rounded, scene, name, precision) for name in _LARGEST_FIRST[1:]}
        places, order = placing.result()
        before, near = _before(len(order)), pool.submit(_neighbours, places, len(order))
        tasks = {"means": pool.submit(entropy.encode_keys, places.keys, 3 * places.depths)}
        for name in (*early, *_LARGEST_FIRST):
            neighbours = before if name in early else near.result()
            attribute = rounding[name].result()
            tasks[name] = pool.submit(_encode_values, attribute, order, neighbours)
            if attribute.codebook is not None:
                tasks[f"{name}.codebook"] = pool.submit(entropy.encode_integers, attribute.codebook)
    streams = {name: task.result() for name, task in tasks.items()}
    streams["means.grid"] = _GRID.pack(*places.grid.base, places.doublings)
    streams["means.far"] = scene.means[order[len(places.keys) :]].astype("<f4", copy=False).tobytes()
    entries = {name: task.result().entry for name, task in rounding.items()}
    entries["means"] = AttributeEntry("means", 3, "cells", step=places.grid.step)
    attributes = tuple(entries[name] for name in _order("cells"))
    entry_of = tuple(StreamEntry(name, len(streams[name]), kind) for name, kind in _stream_names(attributes))
    return Header.of(scene, "compact", attributes, entry_of), streams


def decode_compact(header: Header, streams: Mapping[str, memoryview]) -> CompressedScene:
    """Scene from header and streams.

    Raises:
        FormatError: The tables do not belong to this level, or a stream does not hold what they say.
    """
    entries = _checked_tables(header)
    early = _BEFORE_POSITIONS[entries["means"].storage]
    late = [name for name in (*_LARGEST_FIRST, "opacities") if name not in early]
    with _workers() as pool:
        before = _before(header.splats)
        values = {name: pool.submit(_decode_values, entries[name], streams, before) for name in early}
        codebooks = {name: pool.submit(_decode_codebook, entries[name], streams) for name in (*early, *late)}
        stored = {name: Stored(entries[name], values[name].result(), codebooks[name].result()) for name in early}
        places = _decode_places(entries["means"].step, stored, streams)
        near = _neighbours(places, header.splats)
        values |= {name: pool.submit(_decode_values, entries[name], streams, near) for name in late}
        means = pool.submit(_decode_means, places, streams["means.far"])
        stored |= {name: Stored(entries[name], values[name].result(), codebooks[name].result()) for name in late}
    levels = stored.pop("opacities")
    coded = {name: attribute for name, attribute in stored.items() if attribute.codebook is not None}
    return CompressedScene(
        means=means.result(),
        opacities=logits_of_levels(levels.entry.codes)[levels.values],
        codes={name: coded[name].values for name in QUANTIZABLE if name in coded},
        codebooks={name: coded[name].floats() for name in QUANTIZABLE if name in coded},
        raw={name: stored[name].floats() for name in QUANTIZABLE if name not in coded},
        **header.of_scene,
    )


# Streams


def _workers() -> ThreadPoolExecutor:
    """As many threads as torch uses; they run side by side because the kernels release the GIL.

    Tasks begin in the order in which they were submitted.
    """
    return ThreadPoolExecutor(max_workers=torch.get_num_threads())


def _places(
    means: NDArray[np.float32], stored: Mapping[str, Stored], precision: Precision
) -> tuple[_Places, NDArray[np.int64]]:
    """Where splats are, and the order ``[N]`` of the file: along the Morton curve, the far ones at the end."""
    grid, doublings, depths = position_grid(means, stored, precision)
    cells, inside = grid.cells(means)
    keys = morton_keys(cells, depths)
    near = np.flatnonzero(inside)
    near = near[np.argsort(keys[near], kind="stable")]
    return _Places(grid, doublings, keys[near], depths[near]), np.concatenate([near, np.flatnonzero(~inside)])


def _before(count: int) -> NDArray[np.int32]:
    """The two rows ``[N, 2]`` before each row, -1 where there is none."""
    rows = np.arange(count, dtype=np.int32)[:, None] - np.array([1, 2], np.int32)
    return np.maximum(rows, np.int32(-1))


def _neighbours(places: _Places, count: int) -> NDArray[np.int32]:
    """Two near rows ``[N, 2]`` before each row; for the far splats, which come last, the two rows before."""
    half = (np.int64(1) << (AXIS_BITS - places.depths)) >> 1
    neighbours = _before(count)
    neighbours[: len(places.keys)] = nearest_before(unmorton(places.keys) + half[:, None])
    return neighbours


def _encode_values(attribute: Stored, order: NDArray[np.int64], neighbours: NDArray[np.int32]) -> bytes:
    entry, values = attribute.entry, attribute.values[order]
    if entry.storage == "steps":
        return entropy.encode_integers(values)
    return entropy.encode_paths(leaf_paths(entry.codes)[values], entry.bits, neighbours)


def _decode_values(
    entry: AttributeEntry, streams: Mapping[str, memoryview], neighbours: NDArray[np.int32]
) -> NDArray[np.int64]:
    if entry.storage == "steps":
        return entropy.decode_integers(streams[entry.name], len(neighbours), entry.dim)
    leaf_of = np.full(1 << entry.bits, -1)
    leaf_of[leaf_paths(entry.codes)] = np.arange(entry.codes)
    values = leaf_of[entropy.decode_paths(streams[entry.name], entry.bits, neighbours)]
    if (values < 0).any():
        raise FormatError(f"damaged: a code of {entry.name} is not one of {entry.codes}")
    return values


def _decode_codebook(entry: AttributeEntry, streams: Mapping[str, memoryview]) -> NDArray[np.int64] | None:
    if entry.storage != "codes":
        return None
    return entropy.decode_integers(streams[f"{entry.name}.codebook"], entry.codes, entry.dim)


def _decode_places(step: float, stored: Mapping[str, Stored], streams: Mapping[str, memoryview]) -> _Places:
    *base, doublings = _GRID.unpack(streams["means.grid"])
    if not math.isfinite(doublings):
        raise FormatError(f"damaged: the cells of the positions have {doublings} doublings, not a finite number")
    grid, far = Grid(step, (base[0], base[1], base[2])), len(streams["means.far"]) // _FAR_BYTES
    depths = grid.depths(doublings_of(stored, doublings))
    depths = depths[: len(depths) - far]
    return _Places(grid, doublings, entropy.decode_keys(streams["means"], 3 * depths), depths)


def _decode_means(places: _Places, far: memoryview) -> NDArray[np.float32]:
    near = places.grid.centers(unmorton(places.keys), places.depths)
    return np.concatenate([near, np.frombuffer(far, "<f4").astype(np.float32).reshape(-1, 3)])


def _order(storage: str) -> tuple[str, ...]:
    """Attributes in the order of their streams, by the storage of the positions."""
    first = _BEFORE_POSITIONS[storage]
    return (*first, "means", *(name for name in ("opacities", *QUANTIZABLE) if name not in first))


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
    dims = attribute_dims(header.sh_degree)
    orders = [[(name, dims[name]) for name in _order(storage)] for storage in _BEFORE_POSITIONS]
    entries = {entry.name: entry for entry in header.attributes}
    if [(entry.name, entry.dim) for entry in header.attributes] not in orders:
        raise FormatError(f"damaged: the attribute table must list {', '.join(dims)}, got {header.attributes}")
    lengths = {stream.name: stream.length for stream in header.streams}
    for entry in header.attributes:
        if not _possible(entry):
            raise FormatError(f"damaged: impossible attribute {entry}")
    if [(stream.name, stream.encoding) for stream in header.streams] != _stream_names(header.attributes):
        raise FormatError("damaged: the stream table does not fit the attribute table")
    if (
        lengths["means.grid"] != _GRID.size
        or lengths["means.far"] % _FAR_BYTES
        or lengths["means.far"] // _FAR_BYTES > header.splats
    ):
        raise FormatError("damaged: the streams of the positions do not have their sizes")
    check_room("splats", header.splats, sum(lengths.values()))
    for entry in header.attributes:
        if entry.storage == "codes":
            name = f"{entry.name}.codebook"
            check_room(f"rows of {name}", entry.codes, lengths[name], FEW_ROWS, each=1)
    return entries


def _possible(entry: AttributeEntry) -> bool:
    if entry.name == "means":
        return entry.storage in _BEFORE_POSITIONS and entry.codes == 0 and entry.step > 0
    if entry.storage == "steps":
        return entry.name in QUANTIZABLE and entry.codes == 0 and entry.step > 0
    if not 1 <= entry.codes <= 1 << 32:
        return False
    if entry.name == "opacities":
        return entry.storage == "levels" and entry.codes <= MOST_OPACITY_LEVELS and entry.step == 0
    return entry.storage == "codes" and entry.step > 0 and entry.dim > 0
