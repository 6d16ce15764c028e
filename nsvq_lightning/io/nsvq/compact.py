"""Level ``compact``: a scene rounded to what can be seen, entropy-coded.

* Splats are in **Morton order** of their positions. A position is stored as a cell whose width follows its splat's size
  and opacity (:class:`~nsvq_lightning.io.nsvq.precision.Precision`), so these come first in the file. A splat far
  outside the scene, which would make the grid coarse for all, keeps its position as float32, after the others.
* Codes are **paths down a tree** of the codebook's rows, which are ordered so that similar rows are neighbours; a
  decision is predicted from the codes of two nearby splats. Rows that no splat uses are left out, equal rows merged.
* Codebooks are integer multiples of a step that follows the distance between codes. Quaternions are normalised first.
* Opacities are rounded to equal steps of [0, 1] and coded like codes.
* Attributes without a codebook are integer multiples of a step. Spherical harmonics may instead be whole multiples of
  the rows of a basis, few of which are not 0.

Decoding never depends on floating-point arithmetic that two machines might round differently.

The streams, one by one: docs/nsvq_format.md.
"""

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from struct import Struct

import numpy as np
import torch

from nsvq_lightning.compute.jit import inline, kernel
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.io import morton
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FEW_ROWS, Bytes, FormatError, check_room
from nsvq_lightning.io.nsvq import entropy
from nsvq_lightning.io.nsvq.header import AttributeEntry, Header, StreamEntry
from nsvq_lightning.io.nsvq.precision import MAX_OPACITY_LEVELS, Precision
from nsvq_lightning.io.nsvq.rounding import SMALL, Stored, doublings_of, leaf_paths, position_grid, rounded
from nsvq_lightning.io.numbers import float_rows, logits_of
from nsvq_lightning.splats.attributes import QUANTIZABLE
from nsvq_lightning.splats.conventions import Int32s, Int64s, Uint64s, middle_of

# Attributes by when their streams come; the cells of the positions, which are between, follow from the early ones.
_EARLY = ("opacities", "scales")
_LATE = tuple(name for name in QUANTIZABLE if name != "scales")
_ORDER = (*_EARLY, "means", *_LATE)
# The last take the longest, and the longest task should not begin last.
_LONGEST_FIRST = _LATE[::-1]
_GRID = Struct("<qqqd")
# Where cells are wider than this share of the distance of four fifths of the splats from the middle, splats are stored
# as those far away are: as large as the scene, they must stay behind what they are behind.
_WIDE = 1 / 8

# Above every squared distance times the window.
_NONE = 2.0**52
# Rows before a row that are searched for neighbours. 64 instead of 16 would save another 0.05 of 8 bits of codes.
_WINDOW = 16

# Encodings of the streams that an attribute has, by its storage and the ends of their names.
_STREAMS = {
    "levels": {"": "paths"},
    "steps": {"": "integers"},
    "components": {".basis": "integers", "": "integers"},
    "codes": {".codebook": "integers", "": "paths"},
    "cells": {".grid": "grid", "": "keys", ".far": "float32"},
}
# The end of the name of the stream with the table that an attribute's values refer to.
_TABLES = {"codes": ".codebook", "components": ".basis"}


def encode_compact(scene: CompressedScene, precision: Precision) -> tuple[Header, dict[str, bytes]]:
    """Header and streams of a scene.

    Args:
        scene: The scene, all values finite.
        precision: The largest errors.

    Raises:
        ValueError: A value is too large for its step.
    """
    # As many threads as torch uses; they run side by side because the kernels release the GIL. Tasks begin in the order
    # in which they were submitted.
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        tasks = {name: pool.submit(rounded, scene, name, precision) for name in (*_EARLY, *_LONGEST_FIRST)}
        early = {name: tasks[name].result() for name in _EARLY}
        grid, doublings, depths = position_grid(scene.means, early, precision)
        cells, inside = grid.cells(scene.means)
        inside &= grid.step * 2.0 ** (morton.AXIS_BITS - depths) <= _WIDE * (len(scene) and middle_of(scene.means)[1])
        keys = morton.morton_keys(cells, depths)
        # The order of the file: along the Morton curve, the far splats at the end.
        order = np.lexsort([keys, ~inside])
        near, far = np.split(order, [np.count_nonzero(inside)])
        keys, depths = keys[near], depths[near]
        writing = [pool.submit(_encoded, early[name], order, _before(len(order))) for name in _EARLY]
        positions = pool.submit(entropy.encode_keys, keys, 3 * depths)
        neighbours = _neighbours(keys, depths, len(order))
        writing += [pool.submit(_encoded, tasks[name].result(), order, neighbours) for name in _LONGEST_FIRST]
        streams = {
            "means": positions.result(),
            "means.grid": _GRID.pack(*grid.base, doublings),
            "means.far": np.asarray(scene.means[far], "<f4").tobytes(),
        }
        for task in writing:
            streams |= task.result()
    entries = {name: task.result().entry for name, task in tasks.items()}
    entries["means"] = AttributeEntry("means", 3, "cells", step=grid.step)
    attributes = tuple(entries[name] for name in _ORDER)
    table = tuple(StreamEntry(name, len(streams[name]), encoding) for name, encoding in _stream_names(attributes))
    return Header.of(scene, "compact", attributes, table), streams


def decode_compact(header: Header, streams: Mapping[str, Bytes]) -> CompressedScene:
    """Scene from header and streams.

    Raises:
        FormatError: The tables do not belong to this level, or a stream does not hold what they say.
    """
    _check_tables(header)
    entries = {entry.name: entry for entry in header.attributes}
    *base, doublings = _GRID.unpack(streams["means.grid"])
    if not math.isfinite(doublings):
        raise FormatError(f"damaged: the cells of the positions have {doublings} doublings, not a finite number")
    grid = morton.Grid(entries["means"].step, tuple(base))
    far = float_rows(streams["means.far"], -1, 3)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        two = header.version > 3
        early = {name: pool.submit(_decoded, entries[name], streams, _before(header.splats), two) for name in _EARLY}
        stored = {name: early[name].result() for name in _EARLY}
        depths = grid.depths(doublings_of(stored, doublings))[: header.splats - len(far)]
        keys = entropy.decode_keys(streams["means"], 3 * depths)
        neighbours = _neighbours(keys, depths, header.splats)
        late = {name: pool.submit(_decoded, entries[name], streams, neighbours, two) for name in _LONGEST_FIRST}
        means = np.concatenate([grid.centers(morton.unmorton(keys), depths), far])
        stored |= {name: late[name].result() for name in _LATE}
    levels = stored.pop("opacities")
    codes, codebooks, raw, bases = {}, {}, {}, {}
    for name, attribute in stored.items():
        if attribute.entry.storage == "codes":
            codes[name] = attribute.values
            codebooks[name] = attribute.floats()
        elif attribute.entry.storage == "components":
            raw[name] = attribute.values.astype(np.float32)
            bases[name] = attribute.floats()
        else:
            raw[name] = attribute.floats()
    opacities = logits_of((np.arange(levels.entry.codes) + 0.5) / levels.entry.codes)[levels.values]
    return CompressedScene(means, opacities, codes, codebooks, raw, bases=bases, **header.of_scene)


def _before(count: int) -> Int32s:
    """The two rows ``[N, 2]`` before each row, -1 where there is none."""
    return np.maximum(np.arange(count, dtype=np.int32)[:, None] - np.array([1, 2], np.int32), -1)


def _neighbours(keys: Uint64s, depths: Int64s, count: int) -> Int32s:
    """Two near rows ``[N, 2]`` before each row; for the far splats, which come last, the two rows before."""
    half = (1 << (morton.AXIS_BITS - depths)) >> 1
    neighbours = _before(count)
    neighbours[: len(keys)] = nearest_before(morton.unmorton(keys) + half[:, None])
    return neighbours


def nearest_before(cells: Int64s) -> Int32s:
    """The two nearest ``[N, 2]`` of the 16 rows before each row of ``cells [N, 3]``, nearest first; -1 where none is.

    Distances are integers, and the earlier of two equally near rows is taken: every machine finds the same rows.

    Raises:
        ValueError: ``cells`` is not ``[N, 3]``, or not contiguous.
        TypeError: It is not int64.
    """
    check_fit("cells [N, 3] int64", cells)
    found = np.empty((len(cells), 2), np.int32)
    _search_before(np.ascontiguousarray(cells.T, np.float64), found)
    return found


# Rows that are searched side by side.
_BLOCK = 256


@kernel
def _search_before(axes, found):  # type: ignore[no-untyped-def]
    count = len(found)
    for block in range(-(-count // _BLOCK)):
        start = block * _BLOCK
        end = min(start + _BLOCK, count)
        # A distance and, for equal ones, the place in the window in one number, exact in float64: two minima without
        # branches, in vectors along the rows.
        first = np.full(_BLOCK, _NONE)
        second = np.full(_BLOCK, _NONE)
        for back in range(1, _WINDOW + 1):
            for i in range(max(start, back), end):
                x = axes[0, i] - axes[0, i - back]
                y = axes[1, i] - axes[1, i - back]
                z = axes[2, i] - axes[2, i - back]
                found_now = (x * x + y * y + z * z) * _WINDOW + (_WINDOW - back)
                least = first[i - start]
                later = found_now if least < found_now else least
                first[i - start] = found_now if found_now < least else least
                second[i - start] = later if later < second[i - start] else second[i - start]
        for i in range(start, end):
            found[i, 0] = _row(i, first[i - start])
            found[i, 1] = _row(i, second[i - start])


@inline
def _row(i, place):  # type: ignore[no-untyped-def]
    """The row that a number of the search stands for; -1 for none."""
    return i - (_WINDOW - np.int64(place) % _WINDOW) if place < _NONE else -1


def _stream_names(attributes: tuple[AttributeEntry, ...]) -> list[tuple[str, str]]:
    """Name and encoding of the streams that the attributes have."""
    return [(entry.name + end, kind) for entry in attributes for end, kind in _STREAMS[entry.storage].items()]


def _encoded(attribute: Stored, order: Int64s, neighbours: Int32s) -> dict[str, bytes]:
    """The streams of an attribute, but not of the positions, for splats in an order."""
    entry = attribute.entry
    if _STREAMS[entry.storage][""] == "paths":
        paths = leaf_paths(entry.codes)[attribute.values[order]]
        streams = {entry.name: entropy.encode_paths(paths, entry.bits, neighbours)}
    else:
        streams = {entry.name: entropy.encode_integers(attribute.values, order)}
    if attribute.codebook is not None:
        streams[entry.name + _TABLES[entry.storage]] = entropy.encode_integers(attribute.codebook)
    return streams


def _decoded(entry: AttributeEntry, streams: Mapping[str, Bytes], near: Int32s, two: bool) -> Stored:
    """Invert :func:`_encoded`, for decisions of one context or two."""
    own = streams[entry.name]
    codebook = None
    if entry.storage in _TABLES:
        codebook = entropy.decode_integers(streams[entry.name + _TABLES[entry.storage]], entry.codes, entry.dim)
    if _STREAMS[entry.storage][""] == "paths":
        leaf_of = np.full(1 << entry.bits, -1)
        leaf_of[leaf_paths(entry.codes)] = np.arange(entry.codes)
        values = leaf_of[entropy.decode_paths(own, entry.bits, near, two)]
        if (values < 0).any():
            raise FormatError(f"damaged: a code of {entry.name} is not one of {entry.codes}")
    else:
        values = entropy.decode_integers(own, len(near), entry.codes or entry.dim)
    if codebook is not None and entry.storage == "components":
        for integers in (codebook, values):
            if np.abs(integers).max(initial=0) >= SMALL:
                raise FormatError(f"damaged: a component of {entry.name} is not below 2^23 in size")
    return Stored(entry, values, codebook)


def _check_tables(header: Header) -> None:
    """Compare with the tables this release would write, before anything is allocated from their sizes."""
    header.check_attributes(_ORDER, _possible)
    if [(stream.name, stream.encoding) for stream in header.streams] != _stream_names(header.attributes):
        raise FormatError("damaged: the stream table does not fit the attribute table")
    lengths = {stream.name: stream.length for stream in header.streams}
    far, rest = divmod(lengths["means.far"], 12)  # three float32
    if lengths["means.grid"] != _GRID.size or rest or far > header.splats:
        raise FormatError("damaged: the streams of the positions do not have their sizes")
    check_room("splats", header.splats, sum(lengths.values()))
    for entry in header.attributes:
        if entry.storage == "codes":
            name = f"{entry.name}.codebook"
            check_room(f"rows of {name}", entry.codes, lengths[name], FEW_ROWS, each=1)


def _possible(entry: AttributeEntry) -> bool:
    if entry.storage == "levels":
        return entry.name == "opacities" and entry.step == 0 and 1 <= entry.codes <= MAX_OPACITY_LEVELS
    if entry.storage == "codes":
        return entry.name in QUANTIZABLE and entry.step > 0 and entry.dim > 0 and 1 <= entry.codes <= 1 << 32
    if entry.storage == "components":
        # Float32 has all multiples of such a step below 2^23.
        power_of_two = math.frexp(entry.step)[0] == 0.5
        return entry.name == "shN" and power_of_two and 2.0**-149 <= entry.step <= 1 and 1 <= entry.codes <= entry.dim
    names = {"cells": ("means",), "steps": QUANTIZABLE}.get(entry.storage, ())
    return entry.name in names and entry.step > 0 and entry.codes == 0
