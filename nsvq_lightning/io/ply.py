"""The ``.ply`` of 3D Gaussian Splatting, which every viewer reads (Kerbl et al. 2023, the authors' layout)."""

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, BinaryIO

import numpy as np

from nsvq_lightning.io.atomic import StrPath, atomic_write
from nsvq_lightning.io.compressed import CompressedScene, slices, warn_of_activations
from nsvq_lightning.io.errors import FormatError, as_defect, naming_file, wrong_start
from nsvq_lightning.io.numbers import FLAT, Clamped, finite_logs, logits_of, opacity_of
from nsvq_lightning.io.placing import FAR
from nsvq_lightning.splats import conventions
from nsvq_lightning.splats.attributes import ATTRIBUTES, attribute_dims
from nsvq_lightning.splats.conventions import SH_C0, ZERO, Arrays, Float32s, Float64s, Place, Records, white_of
from nsvq_lightning.top_level import log

_BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "half": "f2",
    "float": "f4",
    "double": "f8",
}
# Lowest bit and largest value of the numbers in each property of a compressed ``.ply``; opacities are in colours.
_PACKED = {
    "packed_position": ((21, 11, 0), (2047, 1023, 2047)),
    "packed_rotation": ((20, 10, 0), (1023, 1023, 1023)),
    "packed_scale": ((21, 11, 0), (2047, 1023, 2047)),
    "packed_color": ((24, 16, 8, 0), (255, 255, 255, 255)),
}
# Those between whose values in a chunk the numbers are shares of the way; some files have none of colours.
_BOUNDS = [
    f"{end}_{name}"
    for names in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")
    for end in ("min", "max")
    for name in names
]
# Splats of a compressed ``.ply`` that follow each other and share a row of bounds.
_CHUNK = 256
# Rows converted at a time, about 1 MB: they fit the cache and keep memory at one copy of the scene.
_ROWS = 1 << 12
_RGB = ["red", "green", "blue"]
# The normals of points, which other programs expect, are 0.
_UNUSED = ["nx", "ny", "nz"]
# Order of the columns.
_ORDER = tuple(dict.fromkeys(("means", "unused", "sh0", "shN", "opacities", "scales", "quats", *ATTRIBUTES)))


@dataclass(frozen=True)
class PlyHeader:
    """Where the vertices of a ``.ply`` file are and what they hold; vertices are splats or points.

    Attributes:
        encoding: ``binary_little_endian``, ``binary_big_endian`` or ``ascii``.
        count: Number of vertices N.
        dtype: Structured dtype of one row (for ascii, that of the parsed row).
        offset: Byte of the first row; for ascii, of the first line after the header.
        lines: Lines of other elements between ``offset`` and the first vertex (ascii only).
        antialiased: Whether a comment, or the filter of Mip-Splatting, says that they were trained with anti-aliasing.
        others: The other elements by name, described likewise; those after a list, whose length varies, are left out.
    """

    encoding: str
    count: int
    dtype: np.dtype[np.void]
    offset: int
    lines: int
    antialiased: bool = False
    others: "Mapping[str, PlyHeader]" = field(default_factory=dict)

    @property
    def packed(self) -> bool:
        """Whether it is a compressed ``.ply`` of PlayCanvas: numbers of few bits between the bounds of 256 splats."""
        return "chunk" in self.others and "packed_position" in self.properties

    @property
    def end(self) -> int:
        """The byte after the last row, unless it is ascii."""
        return self.offset + self.count * self.dtype.itemsize

    @property
    def properties(self) -> tuple[str, ...]:
        """Names of all properties in file order."""
        return self.dtype.names or ()


def read_ply_header(path: StrPath) -> PlyHeader:
    """Header of a ``.ply`` file that is long enough for its vertices.

    Raises:
        FormatError: The header is truncated or malformed, or has no vertices; or the rest is truncated.
    """
    with naming_file(path), open(path, "rb") as file:
        header = _parsed(file)
        file_bytes = os.fstat(file.fileno()).st_size
        needed = header.end
        if header.encoding == "ascii" and header.count:
            # A value takes at least one digit and one separator; the last separator may be missing.
            needed = header.offset + header.count * 2 * len(header.properties) - 1
        if header.packed:
            needed = max(needed, *(other.end for other in header.others.values()))
        if needed > file_bytes:
            raise FormatError(f"truncated: {header.count} vertices need {needed} bytes, the file has {file_bytes}")
    return header


_TYPES |= {np.dtype(code).name: code for code in _TYPES.values()}  # int8, ...
# Of a header; some programs write their cameras into its comments.
_MAX_HEADER = 1 << 26


def _parsed(file: BinaryIO) -> PlyHeader:
    """Header of a file."""
    start = file.readline(1 << 16)
    if not re.fullmatch(rb"ply[ \t]*\r?\n", start):
        raise wrong_start(".ply", start, b"ply")
    lines: list[list[str]] = []
    while lines[-1:] != [["end_header"]]:
        line = file.readline(_MAX_HEADER)
        if not line.endswith(b"\n") or file.tell() > _MAX_HEADER:
            raise FormatError("truncated or damaged: the header has no end_header line")
        lines.append(line.decode("latin-1").split())
    formats = [line[1] for line in lines if line[:1] == ["format"] and len(line) > 1]
    if len(formats) != 1 or formats[0] not in _BYTE_ORDER:
        raise FormatError(f"the header needs one format line with {', '.join(_BYTE_ORDER)}; got {formats}")
    elements = _elements(lines, formats[0], file)
    if "vertex" not in elements:
        raise FormatError("the header has no element vertex")
    antialiased = "filter_3D" in elements["vertex"].properties  # trained with a filter of the pixels, too
    for words in lines:  # the last comment that says how the splats were trained counts
        match [word.lower() for word in words]:
            case ["comment", "splatrendermode:", mode]:
                antialiased = mode == "mip"
            case ["comment", "antialiased", number]:
                antialiased = number == "1"
            case ["comment", "vertical", "axis:", "z"]:  # nerfstudio's
                about = "z is up, and cameras of a transforms.json beside it may be in another frame"
                log.info(f"{file.name}: {about}; to turn it: nsvq convert --up minus-y --up-from 0 0 1")
    return replace(elements.pop("vertex"), antialiased=antialiased, others=elements)


# What a point cloud editor (CloudCompare), and a converter for it, put before names.
_PREFIXES = "^(scalar_|scal_)+"


def _elements(lines: list[list[str]], encoding: str, file: BinaryIO) -> dict[str, PlyHeader]:
    """The elements by name up to the first list after the vertices, whose length varies."""
    offset = file.tell()
    order = _BYTE_ORDER[encoding]
    fields: list[tuple[str, int, list[tuple[str, ...]]]] = []
    for line in lines:
        match line:
            case [] | ["comment" | "obj_info" | "format" | "end_header", *_]:
                pass
            case ["element", name, number] if re.fullmatch(r"[0-9]{1,15}", number):
                fields.append((name, int(number), []))
            case ["property", "list", length, kind, name] if fields and {length, kind} <= _TYPES.keys():
                fields[-1][2].append((name, order + _TYPES[kind], order + _TYPES[length]))
            case ["property", kind, name] if fields and kind in _TYPES:
                fields[-1][2].append((re.sub(_PREFIXES, "", name), order + _TYPES[kind]))
            case _:
                raise FormatError(f"bad header line {' '.join(line)[:80]!r}")
    found = {}
    before = 0
    for name, count, properties in fields:
        if any(len(each) > 2 for each in properties):
            if "vertex" in found:
                break
            if name == "vertex":
                raise FormatError("element vertex holds lists; points and splats have plain numbers only")
            if encoding != "ascii":
                offset = _end_of_lists(file, offset, count, properties)
        else:
            if doubled := sorted(a for a, b in pairwise(sorted(each[0] for each in properties)) if a == b):
                raise FormatError(f"element {name} has the property {doubled[0]!r} twice")
            found[name] = PlyHeader(encoding, count, np.dtype(properties), offset, before)
            if encoding != "ascii":
                offset = found[name].end
        before += count
    return found


def _end_of_lists(file: BinaryIO, offset: int, count: int, properties: list[tuple[str, ...]]) -> int:
    """The byte after the rows of an element with lists, whose lengths only the rows themselves say."""
    file.seek(offset)
    for _ in range(count):
        for _, kind, *length in properties:
            number = np.fromfile(file, length[0], 1) if length else np.ones(1)
            if not number.size:
                raise FormatError(f"truncated: {count} rows of lists before the vertices end beyond the file")
            file.seek(max(0, int(number[0])) * np.dtype(kind).itemsize, os.SEEK_CUR)
    return file.tell()


def splat_columns(sh_degree: int) -> dict[str, list[str]]:
    """Properties of each attribute; of the colours, all of red come first."""
    columns = {}
    for name, dim in attribute_dims(sh_degree).items():
        stem = ATTRIBUTES[name].ply
        columns[name] = [f"{stem}{i}" for i in range(dim)] if stem.endswith("_") else stem.split()
    return columns


def splat_degree(header: PlyHeader) -> int:
    """Degree of the spherical harmonics of the splats in a file, 0 to 3.

    Raises:
        FormatError: It holds something other than Gaussian splats.
    """
    if header.packed:
        _check_packed(header)
        names = header.others["sh"].properties if "sh" in header.others else ()
    else:
        names = header.properties
        if missing := [name for columns in _needed(header, 0).values() for name in columns if name not in names]:
            raise FormatError(f"not a .ply of Gaussian splats: it has no property {', '.join(missing)}")
    # All that stands beside the splats of a compressed file is harmonics, also by other names, as gsply 0.2 has them.
    rest = [name for name in names if header.packed or name.startswith("f_rest_")]
    strange = sorted({*rest} - {f"f_rest_{i}" for i in range(len(rest))})
    if strange or len(rest) not in (0, 9, 24, 45):
        got = f"{len(rest)}, among them {strange[0]}" if strange else f"{len(rest)}"
        raise FormatError(f"SH degrees 0 to 3 have 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ...; got {got}")
    return conventions.shN_degree(len(rest) // 3)


def _needed(header: PlyHeader, sh_degree: int) -> dict[str, list[str]]:
    """Properties to read of each attribute: discs may have no third scale, splats colours in place of coefficients.

    Those of the higher coefficients are in our order: the three colours of each.
    """
    columns = splat_columns(sh_degree)
    columns["shN"] = np.reshape(columns["shN"], (3, -1)).T.ravel().tolist()
    names = header.properties
    if "scale_2" not in names:
        columns["scales"] = columns["scales"][:2]
    if columns["sh0"][0] not in names and set(_RGB) <= set(names):
        columns["sh0"] = _RGB
    return columns


def _check_packed(header: PlyHeader) -> None:
    chunk = header.others["chunk"]
    sh = header.others.get("sh")
    expected = [(header, _PACKED, "u4"), (chunk, _bounds(chunk), "f4")]
    if sh:
        expected.append((sh, sh.properties, "u1"))
    for table, columns, kind in expected:
        for name in columns:
            if name not in table.properties or table.dtype[name].str[1:] != kind:
                raise FormatError(f"not a compressed .ply of Gaussian splats: no property {name} of type {kind}")
    if header.encoding == "ascii" or chunk.count < -(-header.count // _CHUNK) or (sh and sh.count != header.count):
        raise FormatError(
            f"damaged: {header.count} compressed splats, {chunk.count} chunks of 256"
            f"{f', harmonics of {sh.count}' if sh else ''}, {header.encoding}"
        )


def _bounds(chunk: PlyHeader) -> list[str]:
    """Those of :data:`_BOUNDS` that a file has."""
    return _BOUNDS if "min_r" in chunk.properties else _BOUNDS[:12]


def read_ply(path: StrPath) -> CompressedScene:
    """Read the splats of a ``.ply`` file.

    Properties may come in any order and any number type, binary (either byte order) or ascii; with or without normals.
    The number of ``f_rest`` properties gives the SH degree, 0 to 3; other properties and elements are skipped. Discs (a
    third scale of -inf, or none) get the thickness :data:`~nsvq_lightning.io.numbers.FLAT`; ``red green blue`` stand in
    for ``f_dc_0`` to 2. Doubles far from 0, as on a map, become relative to an origin. The widths ``filter_3D`` of
    Mip-Splatting (Yu et al. 2024) are added to those of the splats, √(σ² + f²), opacities fall by as much as these
    grow, and the scene is one to be rendered with anti-aliasing, as it was trained. A compressed ``.ply`` of PlayCanvas
    is known by its header.

    Raises:
        FormatError: The file is truncated, or not a ``.ply`` of Gaussian splats.
    """
    header = read_ply_header(path)
    with naming_file(path):
        sh_degree = splat_degree(header)
    rows = (_read_packed if header.packed else _read_plain)(path, header, sh_degree)
    means, origin = _near(rows["means"])
    return CompressedScene.from_rows({**rows, "means": means}, header.antialiased, origin=origin)


def _near(means: Arrays) -> tuple[Arrays, Place]:
    """Positions ``[N, 3]`` relative to an origin, which is their middle if that is too far away for float32."""
    if means.dtype == np.float64 and len(finite := means[np.isfinite(means).all(1)]):
        middle, usual = conventions.middle_of(finite)
        if np.linalg.norm(middle) > FAR * usual:
            return means - middle, tuple(middle.tolist())
    return means, ZERO


def _read_plain(path: StrPath, header: PlyHeader, sh_degree: int) -> dict[str, Arrays]:
    """Rows ``[N, D]`` of each attribute."""
    columns = _needed(header, sh_degree)
    needed = [name for names in columns.values() for name in names]
    known = {*needed, *_UNUSED, *_RGB, "alpha", "filter_3D"}
    if others := [name for name in header.properties if name not in known]:
        shown = " ".join(others[:5])
        log.warning(f"{path}: {len(others)} other properties are left out ({shown}): motion, say, does not show")
    # A third scale that is not there stays flat.
    rows = {name: np.full((header.count, dim), FLAT, np.float32) for name, dim in attribute_dims(sh_degree).items()}
    kind = np.float64 if header.dtype["x"].itemsize == 8 else np.float32  # of positions on a map
    rows["means"] = rows["means"].astype(kind)
    ends = np.cumsum([len(names) for names in columns.values()])
    start = 0
    for table in read_ply_columns(path, header, needed, kind):
        for name, part in zip(columns, np.split(table, ends[:-1], axis=1), strict=True):
            rows[name][start : start + len(table), : part.shape[1]] = part
        start += len(table)
    if columns["sh0"] == _RGB:
        white = white_of(rows["sh0"], fractions=header.dtype["red"].kind == "f")
        rows["sh0"] = ((rows["sh0"] / white - 0.5) / SH_C0).astype(np.float32)
    if "filter_3D" in header.properties:
        rows["scales"] = finite_logs(rows["scales"])
        log.info(f"{path}: filter_3D, the widths of Mip-Splatting, become part of scales and opacities")
        widths = np.concatenate([*read_ply_columns(path, header, ["filter_3D"])])
        wider = np.log(np.hypot(np.exp(rows["scales"]), widths))
        kept = np.exp((rows["scales"] - wider).sum(1, keepdims=True))
        rows |= {"scales": wider, "opacities": logits_of(kept * opacity_of(rows["opacities"]))}
    warn_of_activations(rows["opacities"], rows["scales"])
    return rows


def read_ply_columns(
    path: StrPath, header: PlyHeader, names: Sequence[str], dtype: type[Any] = np.float32
) -> Iterator[Arrays]:
    """Tables ``[rows, len(names)]`` of some properties of the vertices of a ``.ply`` file, which follow each other.

    Raises:
        FormatError: The file is truncated, or has something other than numbers.
        ValueError: There is no such property.
    """
    columns = [header.properties.index(name) for name in names]
    # A double beyond float32's range becomes inf, which is what a float file would hold.
    with naming_file(path), open(path, "rb") as file, np.errstate(over="ignore"):
        file.seek(header.offset)
        if header.encoding == "ascii":
            yield _read_ascii(file, header)[:, columns].astype(dtype)
            return
        for start in range(0, max(1, header.count), _ROWS):
            rows = min(_ROWS, header.count - start)
            table = np.fromfile(file, header.dtype, rows)
            if len(table) < rows:
                raise FormatError("truncated while it was read")
            yield np.stack([table[name] for name in names], axis=1, dtype=dtype, casting="unsafe")


def _read_ascii(file: BinaryIO, header: PlyHeader) -> Float64s:
    shape = header.count, len(header.properties)
    if header.count == 0:
        return np.empty(shape)
    with as_defect("bad ascii data", ValueError):
        table = np.loadtxt(file, np.float64, comments=None, skiprows=header.lines, max_rows=header.count, ndmin=2)
    if table.shape != shape:
        raise FormatError(f"expected {shape[0]} lines of {shape[1]} values, got {' x '.join(map(str, table.shape))}")
    return table


def _read_packed(path: StrPath, header: PlyHeader, sh_degree: int) -> dict[str, Arrays]:
    """Rows ``[N, D]`` of each attribute of a compressed ``.ply``."""
    chunk = header.others["chunk"]
    vertices = np.fromfile(path, header.dtype, header.count, offset=header.offset)
    bounds = finite_logs(np.concatenate([*read_ply_columns(path, chunk, _bounds(chunk))]))
    rows = {name: np.empty((header.count, dim), np.float32) for name, dim in attribute_dims(0).items()}
    for several in slices(header.count):
        for name, part in _of_chunks(vertices[several], bounds[several.start // _CHUNK :]).items():
            rows[name][several] = part
    if sh_degree:
        names = _needed(header, sh_degree)["shN"]
        levels = np.concatenate([*read_ply_columns(path, header.others["sh"], names, np.uint8)])
        # Bytes stand for the middles of 256ths, the first and the last for the ends.
        values = (8 * (np.r_[0, (np.arange(1, 255) + 0.5) / 256, 1] - 0.5)).astype(np.float32)
        rows["shN"] = values[levels]
    return rows


def _of_chunks(vertices: Records, bounds: Float32s) -> dict[str, Float64s]:
    """Rows ``[N, D]`` of each attribute of packed splats, which begin with a chunk."""
    shares = {}
    for name, (lowest, largest) in _PACKED.items():
        numbers = vertices[name][:, None] >> np.array(lowest, np.uint32) & np.array(largest, np.uint32)
        shares[name] = numbers / largest
    dropped = (vertices["packed_rotation"] >> 30).astype(np.intp)
    rows: dict[str, Arrays] = {
        "means": shares["packed_position"],
        "scales": shares["packed_scale"],
        "sh0": shares["packed_color"][:, :3],
        "opacities": logits_of(shares["packed_color"][:, 3:]),
        "quats": conventions.from_smallest_three(dropped, (shares["packed_rotation"] - 0.5) * math.sqrt(2)),
    }
    ends = np.split(_for_each(bounds, len(vertices)), bounds.shape[1] // 3, axis=1)
    for part, low, high in zip(rows.values(), ends[::2], ends[1::2], strict=False):
        part[:] = low * (1 - part) + high * part
    return rows | {"sh0": (rows["sh0"] - 0.5) / SH_C0}


def _for_each(bounds: Float32s, count: int) -> Float64s:
    """The bounds ``[N, ...]`` of each splat from those of chunks."""
    return bounds[: -(-count // _CHUNK)].repeat(_CHUNK, axis=0)[:count].astype(np.float64)


def write_ply(path: StrPath, scene: CompressedScene) -> int:
    """Write splats as little-endian ``.ply``, 62 float32 per splat at SH degree 3.

    Args:
        path: File to write, replaced atomically.
        scene: The scene; :func:`nsvq_lightning.save` leaves out non-finite splats, on which viewers fail.

    Returns:
        Bytes of the file.
    """
    with atomic_write(path) as file:
        file.write(_header({"vertex": (len(scene), _plain_row(scene.sh_degree))}, scene.antialiased))
        for part in scene.parts():
            columns = {name: part.rows(name) for name in ATTRIBUTES}
            columns["shN"] = _by_color(columns["shN"])
            columns["unused"] = np.zeros((len(part), len(_UNUSED)), np.float32)
            file.write(np.concatenate([columns[name] for name in _ORDER], axis=1, dtype="<f4").tobytes())
        return file.tell()


def _by_color(rows: Arrays) -> Arrays:
    """Higher coefficients ``[N, D]``, the three colours of each, in the order of files: all of red first."""
    return rows.reshape(len(rows), rows.shape[1] // 3, 3).mT.reshape(rows.shape)


def write_compressed_ply(path: StrPath, scene: CompressedScene) -> int:
    """Write splats as compressed ``.ply``, 16 bytes each and a byte for each SH coefficient, in Morton order.

    Coefficients beyond ±4 are clamped, with a warning.

    Returns:
        Bytes of the file.
    """
    scene = scene.in_morton_order()
    clamped = Clamped()
    parts = [_packed_part(part, clamped) for part in scene.parts()]
    clamped.warn(path, len(scene))
    tables = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return write_elements(path, tables, scene.antialiased)


def _packed_part(scene: CompressedScene, clamped: Clamped) -> dict[str, Records]:
    """The elements of a part that begins with a chunk."""
    values = np.stack([scene.means, scene.rows("scales").clip(-20, 20), 0.5 + SH_C0 * scene.rows("sh0")], axis=1)
    starts = np.arange(0, len(scene), _CHUNK)
    bounds = np.stack([each.reduceat(values, starts) for each in (np.minimum, np.maximum)], axis=2)
    low, high = np.moveaxis(_for_each(bounds, len(scene)), 2, 0)
    shares = (values - low) / np.where(high > low, high - low, 1)
    dropped, others = conventions.smallest_three(conventions.unit(scene.rows("quats")))
    parts = {
        "packed_position": shares[:, 0],
        "packed_rotation": others / math.sqrt(2) + 0.5,
        "packed_scale": shares[:, 1],
        "packed_color": np.c_[shares[:, 2], opacity_of(scene.opacities)],
    }
    words = {}
    for name, (lowest, largest) in _PACKED.items():
        numbers = np.rint(parts[name].clip(0, 1) * largest).astype(np.uint32)
        words[name] = np.bitwise_or.reduce(numbers << np.array(lowest, np.uint32), axis=1)
    words["packed_rotation"] |= dropped.astype(np.uint32) << 30
    tables = {"chunk": dict(zip(_BOUNDS, bounds.reshape(len(starts), -1).T, strict=True)), "vertex": words}
    if scene.sh_degree:
        steps = 32 * _by_color(scene.rows("shN"))
        # What is read is the middle of a step: for 0 that above or below, by turns, or all pictures were too bright.
        levels = np.floor(steps + 128 - np.indices(steps.shape).sum(0) % 2 / 512)
        levels = clamped.nearest("shN", levels, (0, 255)).astype(np.uint8)
        tables["sh"] = dict(zip(splat_columns(scene.sh_degree)["shN"], levels.T, strict=True))
    return {name: np.rec.fromarrays([*table.values()], names=[*table]) for name, table in tables.items()}  # type: ignore[call-overload]  # its types ask for formats, too


def write_elements(path: StrPath, elements: Mapping[str, Records], antialiased: bool = False) -> int:
    """Write tables as little-endian ``.ply``.

    Args:
        path: File to write, replaced atomically.
        elements: Structured arrays ``[N]`` by the names of their elements; their fields are the properties.
        antialiased: Whether comments say that splats were trained with anti-aliasing.

    Returns:
        Bytes of the file.
    """
    with atomic_write(path) as file:
        file.write(_header({name: (len(rows), rows.dtype) for name, rows in elements.items()}, antialiased))
        for rows in elements.values():
            file.write(np.asarray(rows, rows.dtype.newbyteorder("<")).tobytes())
        return file.tell()


def plain_ply_bytes(splats: int, sh_degree: int) -> int:
    """Size in bytes of the file that :func:`write_ply` makes: the reference for a compressed scene."""
    row = _plain_row(sh_degree)
    return len(_header({"vertex": (splats, row)})) + splats * row.itemsize


def _plain_row(sh_degree: int) -> np.dtype[np.void]:
    """The row of a splat in a plain ``.ply``."""
    columns = splat_columns(sh_degree) | {"unused": _UNUSED}
    return np.dtype([(column, "<f4") for name in _ORDER for column in columns[name]])


def _header(elements: Mapping[str, tuple[int, np.dtype[np.void]]], antialiased: bool = False) -> bytes:
    """Header of a file with rows of elements, so many and of such a kind."""
    kinds = {code: name for name, code in reversed(_TYPES.items())}
    lines = ["ply", "format binary_little_endian 1.0"]
    if antialiased:  # as Brush and Postshot say it
        lines += ["comment SplatRenderMode: mip", "comment antialiased 1"]
    for name, (count, row) in elements.items():
        lines.append(f"element {name} {count}")
        lines += [f"property {kinds[row[column].str[1:]]} {column}" for column in row.names or ()]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")
