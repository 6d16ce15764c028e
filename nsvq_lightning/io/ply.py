"""The ``.ply`` of 3D Gaussian Splatting, which every viewer reads (Kerbl et al. 2023, the authors' layout)."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.numbers import finite_logits, logits_of_bytes
from nsvq_lightning.splats.arrays import SplatArrays
from nsvq_lightning.splats.conventions import from_smallest_three, sh_coefficients, shN_degree

__all__ = [
    "MIP_COMMENTS",
    "PLY_MAGIC",
    "PlyHeader",
    "attribute_of",
    "plain_ply_bytes",
    "read_ply",
    "read_ply_columns",
    "read_ply_header",
    "read_ply_size",
    "splat_degree",
    "splat_properties",
    "write_ply",
]


PLY_MAGIC = b"ply"

MIP_COMMENTS = {"SplatRenderMode:": "mip", "antialiased": "1"}
"""Comments of Brush and of Postshot, and the word after each that says: trained with anti-aliasing."""

_HEADER_LIMIT = 1 << 20
_BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_PACKED = {f"packed_{name}": "u4" for name in ("position", "rotation", "scale", "color")}
_BOUNDS = {f"{end}_{part}{axis}": "f4" for part in ("", "scale_") for end in ("min", "max") for axis in "xyz"}


@dataclass(frozen=True)
class PlyHeader:
    """Where the vertices of a ``.ply`` file are and what they hold; vertices are splats or points.

    Attributes:
        encoding: ``binary_little_endian``, ``binary_big_endian`` or ``ascii``.
        count: Number of vertices N.
        dtype: Structured dtype of one row (for ascii, that of the parsed row).
        offset: Byte of the first row; for ascii, of the first line after the header.
        lines: Lines of other elements between ``offset`` and the first vertex (ascii only).
        antialiased: Whether a comment says that the splats were trained with anti-aliasing.
        others: The other elements by name, described likewise; those after a list, whose length varies, are left out.
    """

    encoding: str
    count: int
    dtype: np.dtype[np.void]
    offset: int
    lines: int
    antialiased: bool = False
    others: Mapping[str, PlyHeader] = field(default_factory=dict)

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


@dataclass
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]]
    has_list: bool = False

    def dtype(self) -> np.dtype[np.void]:
        names = [name for name, _ in self.fields]
        doubled = sorted(a for a, b in pairwise(sorted(names)) if a == b)
        if doubled:
            raise FormatError(f"element {self.name} has the property {doubled[0]!r} twice")
        return np.dtype(self.fields)


def read_ply_header(path: str | os.PathLike[str]) -> PlyHeader:
    """Parse only the header; the size of the data is not checked.

    Raises:
        FormatError: The header is truncated or malformed, or has no vertices.
    """
    with open(path, "rb") as file:
        start = file.read(_HEADER_LIMIT)
    end = re.search(rb"\nend_header[ \t]*\r?\n", start)
    if not re.match(rb"ply[ \t]*\r?\n", start):
        raise FormatError("not a .ply file: it does not start with the line 'ply'")
    if end is None:
        raise FormatError("truncated or damaged: the header has no end_header line")
    lines = [line.split() for line in start[: end.start()].decode("latin-1").split("\n")[1:]]
    encoding = _encoding(lines)
    return replace(_locate(encoding, _elements(lines, _BYTE_ORDER[encoding]), end.end()), antialiased=_mip(lines))


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
        missing = [name for name in _REQUIRED if name not in names]
        if missing:
            raise FormatError(f"not a .ply of Gaussian splats: it has no property {', '.join(missing)}")
    rest = [name for name in names if name.startswith("f_rest_")]
    strange = sorted({*rest} - {f"f_rest_{i}" for i in range(len(rest))})
    if strange or len(rest) not in (0, 9, 24, 45):
        got = f"{len(rest)}, among them {strange[0]}" if strange else f"{len(rest)}"
        raise FormatError(f"SH degrees 0 to 3 have 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ...; got {got}")
    return shN_degree(len(rest) // 3)


def _check_packed(header: PlyHeader) -> None:
    chunk, sh = header.others["chunk"], header.others.get("sh")
    expected = [(header, _PACKED), (chunk, _BOUNDS)]
    if sh:
        expected.append((sh, dict.fromkeys(sh.properties, "u1")))
    for table, kinds in expected:
        for name, kind in kinds.items():
            if name not in table.properties or table.dtype[name].str[1:] != kind:
                raise FormatError(f"not a compressed .ply of Gaussian splats: no property {name} of type {kind}")
    if header.encoding == "ascii" or chunk.count < -(-header.count // 256) or (sh and sh.count != header.count):
        raise FormatError(
            f"damaged: {header.count} compressed splats, {chunk.count} chunks of 256"
            f"{f', harmonics of {sh.count}' if sh else ''}, {header.encoding}"
        )


def splat_properties(sh_degree: int) -> tuple[str, ...]:
    """Names of the properties that make up splats."""
    return (*_REQUIRED, *(f"f_rest_{i}" for i in range(3 * sh_coefficients(sh_degree))))


def attribute_of(name: str) -> str:
    """Attribute that a property belongs to; ``other`` for all other properties."""
    families = {"f_dc": "sh0", "f_rest": "shN", "scale": "scales", "rot": "quats"}
    singles = {"x": "means", "y": "means", "z": "means", "opacity": "opacities"}
    singles |= dict(zip(_PACKED, ("means", "quats", "scales", "sh0"), strict=True))
    return singles.get(name) or families.get(re.sub(r"_[0-9]+$", "", name), "other")


def _encoding(lines: list[list[str]]) -> str:
    formats = [line[1] for line in lines if line and line[0] == "format" and len(line) > 1]
    if len(formats) != 1 or formats[0] not in _BYTE_ORDER:
        raise FormatError(f"the header needs one format line with {', '.join(_BYTE_ORDER)}; got {formats}")
    return formats[0]


def _mip(lines: list[list[str]]) -> bool:
    """Whether the last comment that says how the splats were trained says: with anti-aliasing."""
    meaning = {key.lower(): value for key, value in MIP_COMMENTS.items()}
    said = [line[1:] for line in lines if len(line) == 3 and line[0] == "comment" and line[1].lower() in meaning]
    return bool(said) and meaning[said[-1][0].lower()] == said[-1][1].lower()


def _elements(lines: list[list[str]], byte_order: str) -> list[_Element]:
    elements: list[_Element] = []
    for line in lines:
        match line:
            case [] | ["comment" | "obj_info" | "format", *_]:
                pass
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append(_Element(name, int(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_list = True
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].fields.append((name, byte_order + _TYPES[kind]))
            case _:
                raise FormatError(f"bad header line {' '.join(line)[:80]!r}")
    return elements


def _locate(encoding: str, elements: list[_Element], offset: int) -> PlyHeader:
    found: dict[str, PlyHeader] = {}
    lines = 0
    for element in elements:
        if element.has_list and "vertex" in found:
            break
        if element.has_list:
            raise FormatError(f"element {element.name} holds lists; points and splats have plain numbers only")
        found[element.name] = PlyHeader(encoding, element.count, element.dtype(), offset, lines)
        if encoding == "ascii":
            lines += element.count
        else:
            offset = found[element.name].end
    if "vertex" not in found:
        raise FormatError("the header has no element vertex")
    return replace(found.pop("vertex"), others=found)


_ROWS = 1 << 12
"""Rows converted at a time, about 1 MB: they fit the cache and keep memory at one copy of the scene."""
_SH_C0 = 0.5 / math.sqrt(math.pi)


def read_ply(path: str | os.PathLike[str]) -> SplatArrays:
    """Read the splats of a ``.ply`` file.

    Properties may come in any order and any number type, binary (either byte order) or ascii; with or without normals.
    The number of ``f_rest`` properties gives the SH degree, 0 to 3; other properties and elements are skipped. A
    compressed ``.ply`` of PlayCanvas is known by its header.

    Raises:
        FormatError: The file is truncated, or not a ``.ply`` of Gaussian splats.
    """
    header, _ = read_ply_size(path)
    with naming_file(path):
        sh_degree = splat_degree(header)
        if header.packed:
            return _read_packed(path, header, sh_degree)
    splats = _empty(header.count, sh_degree)
    start = 0
    for table in read_ply_columns(path, header, splat_properties(sh_degree)):
        _store(table, splats, slice(start, start + len(table)))
        start += len(table)
    return splats


def read_ply_columns(
    path: str | os.PathLike[str], header: PlyHeader, names: Sequence[str]
) -> Iterator[NDArray[np.float32]]:
    """Tables ``[rows, len(names)]`` of some properties of the vertices of a ``.ply`` file, which follow each other.

    Raises:
        FormatError: The file is truncated, or has something other than numbers.
        ValueError: There is no such property.
    """
    columns = [header.properties.index(name) for name in names]
    # A double beyond float32's range becomes inf, which is what a float file would hold.
    with naming_file(path), open(path, "rb") as file, np.errstate(over="ignore"):
        file.seek(header.offset)
        yield from (_read_ascii if header.encoding == "ascii" else _read_binary)(file, header, columns)


def read_ply_size(path: str | os.PathLike[str]) -> tuple[PlyHeader, int]:
    """Header and size in bytes of a ``.ply`` file that is long enough for its vertices.

    Raises:
        FormatError: The file is truncated, or no ``.ply``.
    """
    with naming_file(path):
        header, file_bytes = read_ply_header(path), Path(path).stat().st_size
        _check_room(header, file_bytes)
    return header, file_bytes


def write_ply(path: str | os.PathLike[str], splats: SplatArrays, antialiased: bool = False) -> int:
    """Write splats as little-endian ``.ply``, 62 float32 per splat at SH degree 3.

    Args:
        path: File to write, replaced atomically.
        splats: The scene; :func:`nsvq_lightning.save` leaves out non-finite splats, on which viewers fail.
        antialiased: Say in comments that they were trained with anti-aliasing.

    Returns:
        Bytes of the file.
    """
    header = _header_text(len(splats), splats.sh_degree, antialiased)
    with atomic_write(path) as file:
        file.write(header)
        for start in range(0, len(splats), _ROWS):
            file.write(_rows(splats, slice(start, start + _ROWS)).tobytes())
        return file.tell()


def plain_ply_bytes(splats: int, sh_degree: int) -> int:
    """Size in bytes of the file that :func:`write_ply` makes: the reference for a compressed scene."""
    return len(_header_text(splats, sh_degree)) + 4 * splats * len(_property_names(sh_degree))


def _property_names(sh_degree: int) -> list[str]:
    return [
        *"xyz",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * sh_coefficients(sh_degree))),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def _header_text(count: int, sh_degree: int, antialiased: bool = False) -> bytes:
    comments = "".join(f"comment {key} {value}\n" for key, value in MIP_COMMENTS.items()) if antialiased else ""
    properties = "".join(f"property float {name}\n" for name in _property_names(sh_degree))
    return f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {count}\n{properties}end_header\n".encode(
        "ascii"
    )


def _rows(splats: SplatArrays, rows: slice) -> NDArray[np.float32]:
    means = splats.means[rows]
    # Channel-major: all red coefficients first; ours are [coefficient, channel].
    rest = splats.shN[rows].transpose(0, 2, 1).reshape(len(means), -1)
    columns = [
        means,
        np.zeros_like(means),
        splats.sh0[rows, 0],
        rest,
        splats.opacities[rows, None],
        splats.scales[rows],
        splats.quats[rows],
    ]
    return np.concatenate(columns, axis=1).astype("<f4", copy=False)


def _check_room(header: PlyHeader, file_bytes: int) -> None:
    # An ascii value takes at least one digit and one separator; the last separator may be missing.
    row_bytes = 2 * len(header.properties) if header.encoding == "ascii" else header.dtype.itemsize
    needed = header.offset + header.count * row_bytes - (header.encoding == "ascii" and header.count > 0)
    if header.packed:
        needed = max(needed, *(header.others[name].end for name in ("chunk", "sh") if name in header.others))
    if needed > file_bytes:
        raise FormatError(f"truncated: {header.count} vertices need {needed} bytes, the file has {file_bytes}")


def _read_binary(file: BinaryIO, header: PlyHeader, columns: list[int]) -> Iterator[NDArray[np.float32]]:
    names = [header.properties[column] for column in columns]
    for start in range(0, header.count, _ROWS):
        rows = min(_ROWS, header.count - start)
        data = file.read(rows * header.dtype.itemsize)
        if len(data) < rows * header.dtype.itemsize:
            raise FormatError("truncated while it was read")
        table = np.frombuffer(data, header.dtype)
        yield np.stack([table[name] for name in names], axis=1, dtype=np.float32, casting="unsafe")


def _read_ascii(file: BinaryIO, header: PlyHeader, columns: list[int]) -> Iterator[NDArray[np.float32]]:
    if header.count == 0:
        return
    try:
        table = np.loadtxt(file, np.float64, comments=None, skiprows=header.lines, max_rows=header.count, ndmin=2)
    except ValueError as error:
        raise FormatError(f"bad ascii data: {error}") from None
    if table.shape != (header.count, len(header.properties)):
        raise FormatError(
            f"expected {header.count} lines of {len(header.properties)} values, got {' x '.join(map(str, table.shape))}"
        )
    yield table[:, columns].astype(np.float32)


def _read_packed(path: str | os.PathLike[str], header: PlyHeader, sh_degree: int) -> SplatArrays:
    """The splats of a compressed ``.ply``; 256 that follow each other share a row of bounds."""
    chunks, vertices = (
        np.fromfile(path, table.dtype, table.count, offset=table.offset) for table in (header.others["chunk"], header)
    )

    def within(parts: NDArray[np.float64], names: Sequence[str]) -> NDArray[np.float64]:
        """Shares of the ways from the smallest to the largest values of the chunk, ``[N, 3]``."""
        ends = (np.stack([chunks[f"{end}_{name}"] for name in names], 1, dtype=np.float64) for end in ("min", "max"))
        low, high = (np.repeat(end, 256, axis=0)[: header.count] for end in ends)
        return low * (1 - parts) + high * parts

    rotations, colors = vertices["packed_rotation"], _parts(vertices["packed_color"], 8, 8, 8, 8)
    rgb = within(colors[:, :3], "rgb") if "min_r" in header.others["chunk"].properties else colors[:, :3]
    others = (_parts(rotations, 10, 10, 10) - 0.5) * math.sqrt(2)
    shN = np.zeros((header.count, 0, 3), np.float32)
    if sh_degree:
        sh = header.others["sh"]
        rows = np.fromfile(path, sh.dtype, sh.count, offset=sh.offset)
        # Bytes stand for the middles of 256ths, the first and the last for the ends.
        values = (8 * (np.r_[0, (np.arange(1, 255) + 0.5) / 256, 1] - 0.5)).astype(np.float32)
        columns = [values[rows[f"f_rest_{i}"]] for i in range(3 * sh_coefficients(sh_degree))]
        shN = np.stack(columns, axis=1).reshape(header.count, 3, -1).transpose(0, 2, 1)
    return SplatArrays(
        means=within(_parts(vertices["packed_position"], 11, 10, 11), "xyz").astype(np.float32),
        quats=from_smallest_three((rotations >> 30).astype(np.intp), others),
        scales=within(
            _parts(vertices["packed_scale"], 11, 10, 11), [f"scale_{axis}" for axis in "xyz"]
        ).astype(np.float32),
        opacities=logits_of_bytes((vertices["packed_color"] & 255).astype(np.uint8)),
        sh0=((rgb[:, None] - 0.5) / _SH_C0).astype(np.float32),
        shN=np.ascontiguousarray(shN),
    )  # fmt: skip


def _parts(words: NDArray[np.uint32], *bits: int) -> NDArray[np.float64]:
    """Numbers of so many bits, the last one in the lowest, as shares of the largest ``[N, len(bits)]``."""
    shifts = np.cumsum((0, *bits[:0:-1]))[::-1]
    shares = [(words >> shift) % (1 << size) / ((1 << size) - 1) for size, shift in zip(bits, shifts, strict=True)]
    return np.stack(shares, axis=1)


def _empty(count: int, sh_degree: int) -> SplatArrays:
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 1, 3), (count, sh_coefficients(sh_degree), 3))
    return SplatArrays(*(np.empty(shape, np.float32) for shape in shapes))


def _store(table: NDArray[np.float32], splats: SplatArrays, rows: slice) -> None:
    """Distribute a table in the order of :func:`~nsvq_lightning.io.ply.splat_properties`."""
    means, sh0, opacities, scales, quats, rest = np.split(table, np.cumsum([3, 3, 1, 3, 4]), axis=1)
    splats.means[rows] = means
    splats.sh0[rows, 0] = sh0
    # Writers that store opacity as a byte make 0 and 255 infinite logits.
    splats.opacities[rows] = finite_logits(opacities[:, 0])
    splats.scales[rows] = scales
    splats.quats[rows] = quats
    splats.shN[rows] = rest.reshape(len(table), 3, -1 if rest.size else 0).transpose(0, 2, 1)
