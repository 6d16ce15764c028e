"""The text header of a ``.ply`` file: of Gaussian splats, or of any points."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.splats.conventions import sh_coefficients, shN_degree

__all__ = [
    "MIP_COMMENTS",
    "PLY_MAGIC",
    "PlyHeader",
    "attribute_of",
    "read_ply_header",
    "splat_degree",
    "splat_properties",
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
