"""The ``.spz`` file of Niantic: 65 bytes per splat, 12 to 25 compressed. Versions 3 and 4 are written, 1 to 4 read.

Six arrays, each over all splats; integers are little-endian.

===========  =================  =============================================================================
array        bytes per splat    content
===========  =================  =============================================================================
positions    9                  3 fixed-point numbers of 24 bits; version 1: 3 float16
opacities    1                  255ths
colours      3                  127.5 + 255 · 0.15 · sh0
scales       3                  16 (ln s + 10)
rotations    4                  smallest three: 2 bits say which component of xyzw is the largest, then sign and
                                9 bits of each other one, 511 being 1/√2; versions 1 and 2: 3 bytes xyz
SH           3 (d² + 2d)        128 + 128 x, coefficient by coefficient, three colours each
===========  =================  =============================================================================

Niantic's writer first rounds spherical harmonics to 5 and 4 bits, for a smaller file; that reduced a trained scene to
31 dB, so all 8 bits are used here.

Axes: the text of the format says right, up, back (RUB), but viewers and converters take those of ``.ply``, which are
ours: right, down, front (RDF). So these are the default, also of a file that does not say. Where others have the
opposite direction, coordinates change sign, and with them the coefficients of odd functions.

The container is one gzip stream up to version 3: a header of 16 bytes, the arrays, and perhaps extensions, of which
only that of the axes is read and written. With levels of detail, as Spark writes them, a tree follows the arrays, and
opacities are in 127.5ths: the finest level is read, the splats without children.

In version 4, the header is followed by the offset of a table, 12 zero bytes, extensions, the table, and one Zstandard
stream for each array that is not empty.
"""

import math
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from gzip import GzipFile
from importlib import import_module
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from nsvq_lightning.io.atomic import StrPath, atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, as_defect, check_room, check_start, naming_file
from nsvq_lightning.io.numbers import Clamped, bytes_of, logits_of_bytes
from nsvq_lightning.io.placing import UP_AXES, rotated
from nsvq_lightning.splats import conventions
from nsvq_lightning.splats.attributes import QUANTIZABLE
from nsvq_lightning.splats.conventions import Arrays, Float32s, Floats, Uint8s, Uint32s
from nsvq_lightning.top_level import log

_MAGIC, _GZIP = b"NGSP", b"\x1f\x8b"
# Magic, version, N, SH degree, fractional bits, flags, and number of streams (0 up to version 3).
_HEADER = Struct("<4sIIBBBB")
_TABLE_OFFSET = Struct("<I12x")
_HEAD = _HEADER.size + _TABLE_OFFSET.size
# Compressed and uncompressed bytes of a stream.
_ENTRY = Struct("<QQ")
# The flags of a scene that was trained with anti-aliasing, of extensions, and of levels of detail, as Spark has them.
ANTIALIASED, _EXTENDED, _LEVELS = 1, 2, 0x80
# Type and length, then the number of the axes.
_EXTENSION = Struct("<III")
# The extension that states the axes.
_AXES = 0xADBE0003
# Where x, y and z point by the number that the extension holds, from 1: right or left, down or up, front or back. The
# next eight, in which z is up or down, become these by a quarter turn.
_SYSTEMS = ("ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf")
# Bits of a position, and the largest number of them that are fractional.
_POSITION = 24
MAX_FRACTION = 30
_COLOR = 0.15
DEFAULT_AXES = "rdf"


@dataclass(frozen=True)
class SpzHeader:
    """The contents of the first bytes.

    Attributes:
        version: 1 to 4.
        count: Number of splats N.
        sh_degree: Degree of the spherical harmonics, 0 to 4, of which 3 are read.
        fraction_bits: Fractional bits of the positions.
        flags: :data:`ANTIALIASED`, 2 where extensions follow, and 128 where splats are a tree.
        system: Number that says where x, y and z point, see :data:`_SYSTEMS`; 0 if the file does not say.
    """

    version: int
    count: int
    sh_degree: int
    fraction_bits: int
    flags: int
    system: int = 0

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes per splat of each array, in file order."""
        return {
            "means": 6 if self.version == 1 else 9,
            "opacities": 1,
            "sh0": 3,
            "scales": 3,
            "quats": 4 if self.version >= 3 else 3,
            "shN": 3 * ((self.sh_degree + 1) ** 2 - 1),
            # All numbers of children, then all indices of the first child: one with children stands for these.
            "tree": 6 if self.version < 4 and self.flags & _LEVELS else 0,
        }

    @property
    def streams(self) -> dict[str, int]:
        """Bytes of each array that is not empty, in file order: the streams of version 4."""
        return {name: self.count * size for name, size in self.sizes.items() if self.count and size}


# Bytes of extensions that are read; those in use have less than a hundred.
_MAX_EXTENDED = 1 << 20
# Coordinates that the real spherical harmonics of degree 1 to 3 are odd functions of.
_ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")


def _write_frame(path: StrPath, header: SpzHeader, arrays: Mapping[str, Arrays]) -> int:
    """Write header and arrays, by the names of :attr:`SpzHeader.sizes`; returns the bytes of the file."""
    contents = [np.ascontiguousarray(arrays[name]).data.cast("B") for name in header.streams]
    axes = b""
    flags = header.flags
    if header.system:
        axes = _EXTENSION.pack(_AXES, 4, header.system)
        flags |= _EXTENDED
    count = len(contents) if header.version == 4 else 0
    start = _HEADER.pack(_MAGIC, header.version, header.count, header.sh_degree, header.fraction_bits, flags, count)
    with atomic_write(path) as file:
        if header.version == 4:
            with naming_file(path):
                streams = [zstd_compress(content) for content in contents]
            table = [_ENTRY.pack(len(s), len(c)) for s, c in zip(streams, contents, strict=True)]
            file.writelines([start, _TABLE_OFFSET.pack(_HEAD + len(axes)), axes, *table, *streams])
        else:
            # No file name and no time stamp: the same scene gives the same bytes.
            with GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as stream:
                stream.writelines([start, *contents, axes])
        return file.tell()


def _unpack(data: bytes) -> tuple[SpzHeader, dict[str, bytes]]:
    """Header and arrays of version 4; the streams fill the rest of the file."""
    header = _parse(data[: _HEADER.size], len(data))
    if header.version < 4 or len(data) < _HEAD:
        defect = f"truncated or damaged: version {header.version} in {len(data)} bytes without gzip"
        raise FormatError(defect, "gzip it, if a browser has unzipped it")
    streams = data[_HEADER.size - 1]
    (offset,) = _TABLE_OFFSET.unpack_from(data, _HEADER.size)
    if streams != len(header.streams):
        raise FormatError(f"damaged: {streams} streams where there must be {len(header.streams)}")
    start = offset + _ENTRY.size * streams
    if not _HEAD <= offset <= start <= len(data):
        raise FormatError(f"truncated or damaged: a table of {streams} streams at {offset}, of {len(data)} bytes")
    end = start
    parts = {}
    entries = zip(header.streams.items(), _ENTRY.iter_unpack(data[offset:start]), strict=True)
    for (name, expected), (length, size) in entries:
        # One byte of Zstandard expands to 32 KiB at most: a block of 128 KiB of equal bytes takes four.
        if size != expected or size > length << 15:
            raise FormatError(f"damaged: {name} of {header.count} splats cannot be {size} bytes in {length}")
        parts[name] = memoryview(data)[end : end + length]
        end += length
    if end != len(data):
        raise FormatError(f"truncated or damaged: streams of {end - start} bytes in {len(data) - start}")
    contents = {name: zstd_decompress(part, header.streams[name]) for name, part in parts.items()}
    return _with_axes(header, data[_HEAD:offset]), contents


def zstd_compress(data: memoryview) -> bytes:
    """A Zstandard frame with its length and a checksum; the same data give the same bytes with the same release."""
    zstd = _zstd()
    options = {zstd.CompressionParameter.compression_level: 19, zstd.CompressionParameter.checksum_flag: 1}
    return bytes(zstd.compress(data, options=options))


def zstd_decompress(data: memoryview, size: int) -> bytes:
    """Content of a Zstandard frame that must have ``size`` bytes; no more than that is ever held in memory."""
    zstd = _zstd()
    stream = zstd.ZstdDecompressor()
    with as_defect("damaged: no valid Zstandard stream", zstd.ZstdError):
        content: bytes = stream.decompress(data, size + 1)
    if len(content) != size or not stream.eof or stream.unused_data:
        raise FormatError(f"damaged: a Zstandard stream does not hold the {size} bytes that it should")
    return content


def _zstd() -> Any:
    """Zstandard: Python's own from 3.14 on, a package before that."""
    for name in ("compression.zstd", "backports.zstd"):
        with suppress(ImportError):
            return import_module(name)
    raise FormatError(
        "version 4 of .spz needs Zstandard, which this Python does not have",
        "run pip install 'nsvq-lightning[spz]', or save the file as version 3",
    )


def _with_axes(header: SpzHeader, extensions: bytes) -> SpzHeader:
    """The header with the axes that the extensions state."""
    start = 0
    while header.flags & _EXTENDED and start + _EXTENSION.size <= len(extensions):
        kind, length, system = _EXTENSION.unpack_from(extensions, start)
        if (kind, length) == (_AXES, 4):
            if system > 16:
                raise FormatError(
                    f"damaged, or newer than this release: coordinate system {system}, not 0 to 16",
                    "update nsvq-lightning",
                )
            return replace(header, system=system)
        start += 8 + length
    return header


def _unzip(data: bytes) -> tuple[SpzHeader, dict[str, bytes]]:
    """Header and arrays of versions 1 to 3."""
    check_start(".spz", data, _GZIP)
    gunzip = zlib.decompressobj(wbits=31)
    header = _parse(_inflate(gunzip, data, _HEADER.size), len(data))
    if header.version > 3:
        raise FormatError(f"damaged: version {header.version} in a gzip stream, which only versions 1 to 3 are")
    contents = {}
    for name, size in header.streams.items():
        contents[name] = _inflate(gunzip, gunzip.unconsumed_tail, size)
        if len(contents[name]) < size:
            raise FormatError(f"truncated: {name} of {header.count} splats has {len(contents[name])} of {size} bytes")
    # Extensions follow the arrays; reading to the end of the stream verifies its checksum.
    extensions = _inflate(gunzip, gunzip.unconsumed_tail, _MAX_EXTENDED)
    if not gunzip.eof:
        raise FormatError(f"truncated, or more than {_MAX_EXTENDED} bytes of extensions: the gzip stream has no end")
    return _with_axes(header, extensions), contents


def _inflate(gunzip: "zlib._Decompress", data: bytes, most: int) -> bytes:
    """At most ``most`` bytes of the stream; ``most`` must be above 0, which zlib takes as no limit."""
    with as_defect("damaged: no valid gzip stream", zlib.error):
        return gunzip.decompress(data, most)


def _parse(start: bytes, file_bytes: int) -> SpzHeader:
    """Header of any version; refuses more splats than a file of that many bytes can hold."""
    check_start(".spz", start, _MAGIC, _HEADER.size)
    _, version, count, sh_degree, fraction_bits, flags, _ = _HEADER.unpack(start)
    if not 1 <= version <= 4:
        raise FormatError(f"version {version} of the format; this release reads 1 to 4", "save it as version 3 or .ply")
    if sh_degree > 4:
        raise FormatError(f"damaged: SH degree {sh_degree}, not 0 to 4")
    if fraction_bits > MAX_FRACTION:
        raise FormatError(f"damaged: {fraction_bits} fractional bits, more than {MAX_FRACTION}")
    check_room("splats", count, file_bytes)
    header = SpzHeader(version, count, sh_degree, fraction_bits, flags)
    if strange := flags & ~(ANTIALIASED | _EXTENDED | (_LEVELS if header.sizes["tree"] else 0)):
        log.warning(f"unknown flags 0x{strange:02x} of .spz")
    return header


def _signs(axes: str, sh_degree: int) -> tuple[Float32s, Float32s, Float32s]:
    """What changes sign between right, down, front and other axes.

    Returns:
        Signs of positions ``[3]``, of quaternions wxyz ``[4]``, and of all spherical harmonics ``[D]``.
    """
    sign = {axis: 1 if a == b else -1 for axis, a, b in zip("xyz", axes, DEFAULT_AXES, strict=True)}
    xyz = np.array([*sign.values()], np.float32)
    odd = _ODD[: conventions.sh_coefficients(sh_degree)]
    harmonics = np.array([math.prod(sign[axis] for axis in names) for names in odd], np.float32)
    # A rotation's axis does not mirror as positions do.
    return xyz, np.array([1, *(xyz.prod() * xyz)], np.float32), harmonics.repeat(3)


# Versions that are written.
SPZ_VERSIONS = (3, 4)
DEFAULT_VERSION = 3
# Axes that are written; viewers take a file to have the default, whatever it says.
SPZ_AXES = ("rdf", "rub")


def write_spz(
    path: StrPath, scene: CompressedScene, *, version: int = DEFAULT_VERSION, axes: str = DEFAULT_AXES
) -> int:
    """Write a scene as ``.spz``.

    Positions get as many fractional bits as the smallest splats need. Values out of the format's range are clamped,
    with a warning; :func:`nsvq_lightning.io.save` leaves out splats with a value that is not finite.

    Args:
        path: File to write, replaced atomically.
        scene: The scene.
        version: 3, or 4, which uses Zstandard.
        axes: One of :data:`SPZ_AXES`: ``rdf`` (right, down, front), or ``rub`` (right, up, back).

    Returns:
        Bytes of the file.

    Raises:
        ValueError: Another version, or other axes.
        FormatError: Version 4 needs Zstandard, and it is not installed.
    """
    if version not in SPZ_VERSIONS:
        raise ValueError(f"version of .spz must be {' or '.join(map(str, SPZ_VERSIONS))}, got {version}")
    if axes not in SPZ_AXES:
        raise ValueError(f"axes of .spz must be {' or '.join(SPZ_AXES)}, got {axes!r}")
    # By their codes, then by position. Those of the spherical harmonics, the last, sort first: equal rows compress best
    # when close together.
    scene = scene.in_morton_order()
    codes = [scene.codes[name] for name in QUANTIZABLE if name in scene.codes]
    scene = scene.in_order(np.lexsort([np.arange(len(scene)), *codes]))
    clamped = Clamped()
    xyz, quats, harmonics = _signs(axes, scene.sh_degree)
    fraction = _fraction_bits(scene)
    # Viewers expect version 3 to be silent, in the default axes; Babylon.js turns a scene that says so upside down.
    stated = _SYSTEMS.index(axes) + 1 if version == 4 or axes != DEFAULT_AXES else 0
    end = 1 << _POSITION - 1
    means = clamped.nearest("means", scene.means * xyz * (1 << fraction), (-end, end - 1))
    arrays: dict[str, Arrays] = {
        "means": means.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3],
        "opacities": bytes_of(scene.opacities),
        "sh0": _packed(scene, "sh0", _COLOR * 255, 127.5, clamped),
        "scales": _packed(scene, "scales", 16, 160, clamped),
        "quats": _packed_quats(scene.rows("quats") * quats),
        "shN": _packed(scene, "shN", 128 * harmonics, 128, clamped),
    }
    clamped.warn(path, len(scene))
    if fraction * math.log(2) < -np.median(scene.rows("scales")):
        log.warning(f"{path}: positions are rounded by half a splat, as they are far from 0: move them there first")
    flags = ANTIALIASED * scene.antialiased
    return _write_frame(path, SpzHeader(version, len(scene), scene.sh_degree, fraction, flags, stated), arrays)


_USUAL_FRACTION = 12


def _fraction_bits(scene: CompressedScene) -> int:
    """Fractional bits: what the smallest splats need, unless that puts the farthest out of range.

    A few distant splats do not make positions coarser than the format's usual 12 bits; they are clamped. A sky, of a
    thousandth of the splats or more, may have as many of these bits as half of the splats do not need.
    """
    sizes = scene.rows("scales").mean(1)
    # No coordinate is off by more than a twentieth of the splat's size, but for the smallest thousandth of the splats.
    needed, usual = map(math.ceil, -math.log2(2 * 0.05) - np.quantile(sizes, (0.001, 0.5)) / math.log(2))
    reach = np.abs(scene.means).max(1)
    fits, sky_fits, mostly_fits = (_POSITION - 1 - math.frexp(end)[1] for end in np.quantile(reach, (1, 0.999, 0.99)))
    return int(min(max(min(needed, fits), min(_USUAL_FRACTION, mostly_fits, max(sky_fits, usual)), 0), MAX_FRACTION))


def _packed(scene: CompressedScene, name: str, factor: float | Float32s, zero: float, clamped: Clamped) -> Uint8s:
    values = (factor * part.rows(name) + zero for part in scene.parts())
    return np.concatenate([clamped.nearest(name, each, (0, 255)).astype(np.uint8) for each in values])


def _packed_quats(rows: Float32s) -> Uint32s:
    largest, others = conventions.smallest_three(conventions.unit(rows)[:, [1, 2, 3, 0]])
    packed = largest.astype("<u4")
    for part in others.T:
        magnitude = np.minimum(np.rint(511 * math.sqrt(2) * np.abs(part)), 511).astype(np.uint32)
        packed = packed << 10 | (part < 0).astype(np.uint32) << 9 | magnitude
    return packed


def read_spz(path: StrPath) -> CompressedScene:
    """Read a ``.spz`` file of version 1 to 4, with any axes; other extensions are ignored.

    Raises:
        FormatError: The file is truncated, altered, of another version, or not a ``.spz`` file; or version 4 needs
            Zstandard, and it is not installed.
    """
    data = Path(path).read_bytes()
    with naming_file(path):
        header, contents = _unpack(data) if data.startswith(_MAGIC) else _unzip(data)
    arrays = {
        name: np.frombuffer(contents.get(name, b""), np.uint8).reshape(header.count, size)
        for name, size in header.sizes.items()
    }
    if not header.system:
        advice = "If it is upside down: nsvq convert IN.spz OUT --up minus-y --up-from 0 1 0"
        log.info(f"{path}: the file does not say where its axes point; taken as right, down, front. {advice}")
    degree = min(header.sh_degree, 3)
    if header.sh_degree > degree:
        log.warning(f"{path}: of SH degree {header.sh_degree}, degrees up to {degree} are read")
    factor = 2 if arrays["tree"].size else 1  # a splat that stands for several may be above 1
    levels = np.minimum(arrays["opacities"].astype(np.uint16) * factor, 255).astype(np.uint8)
    system = header.system or _SYSTEMS.index(DEFAULT_AXES) + 1
    xyz, quats, harmonics = _signs(_SYSTEMS[(system - 1) % 8], degree)
    shN = arrays["shN"][:, : len(harmonics)].astype(np.float32)
    shN -= 128
    shN *= harmonics / 128  # powers of two
    scene = CompressedScene.from_rows(
        {
            "means": _unpacked_means(header, arrays["means"]) * xyz,
            "quats": _unpacked_quats(header, arrays["quats"]) * quats,
            "scales": arrays["scales"].astype(np.float32) / 16 - 10,
            "opacities": logits_of_bytes(levels),
            "sh0": (arrays["sh0"] / 255 - 0.5) / _COLOR,
            "shN": shN,
        },
        antialiased=bool(header.flags & ANTIALIASED),
    )
    if arrays["tree"].size:
        scene = scene.take(np.flatnonzero(arrays["tree"].ravel()[: 2 * header.count].view("<u2") == 0))
        log.info(f"{path}: levels of detail; the finest is read, {len(scene)} of {header.count} splats")
    # Signs first, then the turn, as Niantic's library does it, which writes such files.
    return rotated(scene, UP_AXES["z"]) if system > 8 else scene


def _unpacked_means(header: SpzHeader, data: Uint8s) -> Floats:
    if header.version == 1:
        return data.view("<f2")
    # Put three bytes at the top of four, then shift down with the sign.
    wide = np.zeros((header.count, 3, 4), np.uint8)
    wide[:, :, 1:] = data.reshape(header.count, 3, 3)
    return (wide.view("<i4")[:, :, 0] >> 8).astype(np.float32) / (1 << header.fraction_bits)  # exact


def _unpacked_quats(header: SpzHeader, data: Uint8s) -> Float32s:
    if header.version < 3:
        largest = np.full(header.count, 3)
        others = data / 127.5 - 1
    else:
        packed = data.view("<u4")
        parts = packed >> np.array([20, 10, 0], np.uint32) & 1023
        largest = packed[:, 0] >> 30
        others = (parts & 511) / (511 * math.sqrt(2)) * np.where(parts & 512, -1, 1)
    return conventions.from_smallest_three(largest.astype(np.intp), others)[:, [3, 0, 1, 2]]
