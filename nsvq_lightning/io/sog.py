"""The ``.sog`` file of PlayCanvas, version 2: byte images that a web page can pass to the GPU unchanged.

A zip archive, or a folder, of ``meta.json`` and lossless WebP pictures. Version 1 is read, too: in place of level
indices it has 255ths of the way from a smallest to a largest number, and the opacity is one of them, a logit.

==================  ===========================================================================================
picture             texel
==================  ===========================================================================================
``means_l``         low bytes of the position: sign(x) ln(1 + |x|) in 65535ths from smallest to largest
``means_u``         high bytes
``quats``           smallest three of wxyz, 127.5 (1 + √2 q); alpha is 252 plus the index of the largest
``scales``          level indices, levels shared by the axes; logarithms
``sh0``             level indices, levels shared by the colours; alpha is the opacity in 255ths
``shN_labels``      row of the palette, low byte and high byte
``shN_centroids``   64 rows of the palette per line, one texel per coefficient: level indices
==================  ===========================================================================================

The palette corresponds to an SH codebook, so a scene with one needs no clustering: codes become labels. The file
depends only on the decoded splats: a scene gives the same file with its codebooks and without them.
"""

import json
import math
import re
import struct
import zlib
from codecs import BOM_UTF8
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import numpy as np

from nsvq_lightning.io.atomic import StrPath, atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, Json, as_defect, check_room, check_start, json_object, naming_file
from nsvq_lightning.io.numbers import bytes_of, logits_of_bytes, opacity_of
from nsvq_lightning.splats import conventions
from nsvq_lightning.splats.conventions import Arrays, Float32s, Float64s, Int64s, Integers, Uint8s, sh_coefficients
from nsvq_lightning.top_level import log

META = "meta.json"
# Number of rows that a 16-bit label can address.
PALETTE_LIMIT = 1 << 16
_ROWS_A_LINE = 64
_LEVELS = 256
_LARGEST = float(np.finfo(np.float32).max)
_ZIP = b"PK\x03\x04"
# What zipfile raises about an archive that is damaged, or of a kind that it does not read.
_BAD_ZIP = BadZipFile, zlib.error, struct.error, OSError, EOFError, RuntimeError, ValueError


def sog_contents(scene: CompressedScene, palette: int) -> dict[str, bytes]:
    """The files of an archive or folder by name, ``meta.json`` first; splats keep their order.

    A codebook of the spherical harmonics becomes the palette and its codes the labels, renumbered in order of first
    use. A scene without one, or with more rows in use than a label can address, gets a palette of means of similar
    rows, in which opaque and large splats count more; it is exact if there are no more distinct rows than it may have.

    Args:
        scene: The scene.
        palette: Largest number of rows of a palette that must be found: fewer make a smaller file, with less exact
            view-dependent colours.

    Raises:
        ValueError: The palette has no rows or more than 65536.
    """
    from PIL import Image

    if not 1 <= palette <= PALETTE_LIMIT:
        raise ValueError(f"palette must be in 1..{PALETTE_LIMIT}, got {palette}")
    logs = _signed_logs(scene.means)
    low, high = logs.min(0), logs.max(0)
    halves = _low_and_high(np.rint(65535 * ((logs - low) / np.where(high > low, high - low, 1))))
    # Unweighted, levels would be those of dust: large splats, as of walls and skies, would fall between them.
    scales, scale_levels = _leveled(scene.rows("scales"), _visibility(scene)[:, None])
    colors, color_levels = _leveled(scene.rows("sh0"))
    texels = {
        "means_l.webp": halves[..., 0],
        "means_u.webp": halves[..., 1],
        "quats.webp": _packed_quats(scene.rows("quats")),
        "scales.webp": scales,
        "sh0.webp": np.c_[colors, bytes_of(scene.opacities)],
    }
    meta = {
        "version": 2,
        "asset": {"generator": "nsvq-lightning"},
        "count": len(scene),
        # The second is how it was said before; readers know one of them.
        **({"model": "antialiased", "antialias": True} if scene.antialiased else {}),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_levels, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_levels, "files": ["sh0.webp"]},
    }
    pictures = {name: _picture(values) for name, values in texels.items()}
    if scene.sh_degree:
        rows, labels = _palette(scene, palette)
        indices, levels = _leveled(rows, np.bincount(labels, minlength=len(rows))[:, None])
        shape = math.ceil(len(rows) / _ROWS_A_LINE), _ROWS_A_LINE * sh_coefficients(scene.sh_degree)
        sh_pictures = {
            "shN_centroids.webp": _picture(indices.reshape(-1, 3), shape),
            "shN_labels.webp": _picture(_low_and_high(labels)),
        }
        meta["shN"] = {"count": len(rows), "bands": scene.sh_degree, "codebook": levels, "files": list(sh_pictures)}
        pictures |= sh_pictures
    contents = {META: json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()}
    for name, picture in pictures.items():
        buffer = BytesIO()
        # exact=True: otherwise colours under alpha 0 are changed.
        Image.fromarray(picture).save(buffer, "WEBP", lossless=True, exact=True, quality=75, method=3)
        contents[name] = buffer.getvalue()
    return contents


def _signed_logs(means: Float32s) -> Float64s:
    """What is stored of positions, in even steps: ±ln(1 + abs(x))."""
    wide = means.astype(np.float64)
    return np.copysign(np.log1p(np.abs(wide)), wide)


def write_sog(path: StrPath, scene: CompressedScene, *, palette: int = PALETTE_LIMIT) -> int:
    """Write a scene as ``.sog``, in Morton order.

    Args:
        path: File to write, replaced atomically.
        scene: The scene.
        palette: See :func:`sog_contents`.

    Returns:
        Bytes of the file.

    Raises:
        ValueError: The palette has no rows or more than 65536.
    """
    steps = np.ptp(_signed_logs(scene.means), axis=0) / 65535 * (1 + np.abs(scene.means))
    if np.median(steps.max(1)) > np.exp(np.median(scene.rows("scales"))):
        log.warning(f"{path}: positions are rounded by half a splat, as they are far from 0: .spz keeps them")
    contents = sog_contents(scene.in_morton_order(), palette)
    with atomic_write(path) as file:
        with ZipFile(file, "w") as archive:
            for name, data in contents.items():
                entry = ZipInfo(name)  # of 1980, stored as it is
                entry.create_system = 3  # otherwise that of the machine
                archive.writestr(entry, data)
        return file.tell()


class _Archive:
    """The content of a ``.sog`` file: what ``meta.json`` says, and texels.

    Attributes:
        meta: Content of ``meta.json``; that of version 1 with what version 2 says and its pictures show.
        version: 1 or 2.
        count: Number of splats.
        sh_degree: Degree of the spherical harmonics, 0 to 3.

    Raises:
        FormatError: It is truncated, altered, of another version, or not a zip archive with a ``meta.json``.
    """

    def __init__(self, data: bytes) -> None:
        self._size = len(data)
        check_start(".sog", data, _ZIP)
        with as_defect("truncated: no valid zip archive", _BAD_ZIP):
            self._zip = ZipFile(BytesIO(data))
        self.meta = json_object(self._bytes(META, 1 << 20).removeprefix(BOM_UTF8), META)
        self.version = self.meta.get("version", 1)
        if self.version not in (1, 2):
            raise FormatError(f"version {str(self.version)[:40]} of the format; this release reads 1 and 2")
        if self.version == 1:
            shape = self._entry("means").get("shape")
            self.meta["count"] = shape[0] if isinstance(shape, list) and shape else None
        self.count = self._integer(self.meta, "count", 0, 1 << 40)
        check_room("splats", self.count, self._size)
        if self.meta.get("shN") and "count" not in self._entry("shN"):  # its picture shows how large the palette is
            height, width = self._picture("shN", 0).shape[:2]
            bands = {_ROWS_A_LINE * sh_coefficients(degree): degree for degree in (1, 2, 3)}.get(width)
            self.meta["shN"] |= {"bands": bands, "count": min(_ROWS_A_LINE * height, PALETTE_LIMIT)}
        self.sh_degree = self._integer(self._entry("shN"), "bands", 0, 3) if self.meta.get("shN") else 0

    def _bytes(self, name: str, most: int) -> bytes:
        entry = self._zip.NameToInfo.get(name)
        if entry is None:
            raise FormatError(
                f"incomplete: there is no {name}", "copy all of its files again, or zip them without their folder"
            )
        if entry.file_size > most:
            raise FormatError(f"damaged: {name} cannot have {entry.file_size} bytes")
        if entry.compress_type not in (ZIP_STORED, ZIP_DEFLATED):  # whose length can be limited
            raise FormatError(f"{name} is compressed by method {entry.compress_type} of zip, not 0 (none) or 8")
        with as_defect(f"damaged: {name} cannot be unpacked", _BAD_ZIP), self._zip.open(entry) as file:
            return file.read(entry.file_size)  # not read(name), which unpacks all there is, whatever its length

    def _entry(self, name: str) -> Json:
        entry = self.meta.get(name)
        if not isinstance(entry, dict):
            raise FormatError(f"damaged: {META} has no object {name!r}")
        return entry

    @staticmethod
    def _integer(entry: Mapping[str, Any], name: str, low: int, high: int) -> int:
        value = entry.get(name)
        if type(value) is not int or not low <= value <= high:
            raise FormatError(f"damaged: {name!r} in {META} must be an integer in {low}..{high}, got {str(value)[:40]}")
        return value

    def _numbers(self, attribute: str, name: str, count: range, largest: float = _LARGEST) -> Float64s:
        found = self._entry(attribute).get(name)
        values = [np.nan if value is None else value for value in (found if isinstance(found, list) else [found])]
        if len(values) not in count:
            raise FormatError(f"damaged: {name!r} in {META} must be a list of {count[0]} to {count[-1]} numbers")
        if not all(type(value) in (int, float) and not abs(value) > largest for value in values):
            raise FormatError(f"damaged: {name!r} in {META} must hold numbers of at most {largest:.4g}")
        return np.array(values, np.float64)

    def texels(self, attribute: str, number: int = 0, count: int | None = None) -> Uint8s:
        """The first ``count`` texels ``[count, 4]`` of one of the pictures of an attribute; one a splat if None."""
        picture = self._picture(attribute, number)
        count = self.count if count is None else count
        height, width = picture.shape[:2]
        if width * height < count:
            raise FormatError(f"damaged: a picture of {attribute} has {width} x {height} texels, {count} are needed")
        return picture.reshape(-1, 4)[:count]

    def _picture(self, attribute: str, number: int) -> Uint8s:
        """One of the pictures of an attribute ``[H, W, 4]``."""
        from PIL import Image

        files = self._entry(attribute).get("files")
        if not (isinstance(files, list) and len(files) > number and isinstance(files[number], str)):
            raise FormatError(f"damaged: {META} does not name the pictures of {attribute!r}")
        name = files[number]
        # Those of splats, or of the rows of the largest palette; and twice the bytes that uncompressed ones have.
        most = max(self._size // 2, 15 * PALETTE_LIMIT)
        data = BytesIO(self._bytes(name, 8 * most))
        # Damage can make Pillow's decoders raise anything.
        with as_defect(f"damaged: {name} is not a picture", Exception), Image.open(data, "r", ("WEBP", "PNG")) as image:
            check_room("texels", image.width * image.height, self._size, most)
            return np.asarray(image.convert("RGBA"))

    def values(self, attribute: str, texels: Uint8s) -> Float32s:
        """The values ``[N, C]`` of an attribute that texels ``[N, C]`` have the level indices of."""
        if self.version == 1:
            ends = 1 if attribute == "shN" else texels.shape[1]
            low, high = (self._numbers(attribute, end, range(ends, ends + 1)) for end in ("mins", "maxs"))
            return (low + (high - low) * (texels / 255)).astype(np.float32)
        levels = self._levels(attribute)
        if texels.size and texels.max() >= len(levels):
            raise FormatError(f"damaged: level {texels.max()} of {attribute}, there are {len(levels)}")
        return levels.astype(np.float32)[texels]

    def _levels(self, attribute: str) -> Float64s:
        """The codebook of an attribute; levels that are null, as older writers left NaN, in line with the others."""
        levels = self._numbers(attribute, "codebook", range(1, _LEVELS + 1))
        known = np.flatnonzero(np.isfinite(levels))
        if len(known) == len(levels):
            return levels
        if len(known) < 2:
            raise FormatError(f"damaged: the 'codebook' of {attribute} holds no numbers")
        from scipy.interpolate import make_interp_spline  # slow to import

        log.warning(f"{len(levels) - len(known)} levels of {attribute} are null: taken in line with those beside")
        return make_interp_spline(known, levels[known], k=1)(np.arange(len(levels)))  # type: ignore[no-any-return]

    def colors(self) -> tuple[Float32s, Float32s]:
        """Constant coefficients ``[N, 3]`` and opacity logits ``[N]``."""
        texels = self.texels("sh0")
        if self.version == 1:
            values = self.values("sh0", texels)
            return values[:, :3], values[:, 3]
        return self.values("sh0", texels[:, :3]), logits_of_bytes(texels[:, 3])

    def means(self) -> Float32s:
        """Positions ``[N, 3]``."""
        mins, maxs = (self._numbers("means", name, range(3, 4), math.log1p(_LARGEST)) for name in ("mins", "maxs"))
        low, high = (self.texels("means", number)[:, :3] for number in range(2))
        logs = mins + (maxs - mins) * ((low + 256.0 * high) / 65535)
        means = np.copysign(np.expm1(np.abs(logs)), logs)
        # The logarithm of the largest float32 may round up, beyond it.
        return means.clip(-3.4e38, 3.4e38).astype(np.float32)

    def quats(self) -> Float32s:
        """Rotations ``[N, 4]``; NaN where the mark is none."""
        texels = self.texels("quats")
        marked = texels[:, 3] >= 252
        if marked.sum() < 0.5 * self.count:
            raise FormatError("damaged: most rotations have no mark of 252 to 255")
        if not marked.all():
            log.warning(f"{np.sum(~marked)} of {self.count} rotations have no mark of 252 to 255")
        others = (texels[:, :3] / 127.5 - 1) / math.sqrt(2)
        quats = conventions.from_smallest_three((texels[:, 3] % 4).astype(np.intp), others)  # 252 is a multiple of 4
        quats[~marked] = np.nan
        return quats

    def palette(self) -> tuple[Float32s, Integers]:
        """Palette of the spherical harmonics ``[K, D]`` and the label of each splat ``[N]``."""
        rows = self._integer(self._entry("shN"), "count", 1, PALETTE_LIMIT)
        coefficients = sh_coefficients(self.sh_degree)
        centroids = self.texels("shN", 0, math.ceil(rows / _ROWS_A_LINE) * _ROWS_A_LINE * coefficients)
        palette = self.values("shN", centroids[: rows * coefficients, :3]).reshape(rows, 3 * coefficients)
        texels = self.texels("shN", 1)
        labels = texels[:, 0] + (texels[:, 1].astype(np.uint16) << 8)
        if self.count and labels.max() >= rows:
            raise FormatError(f"damaged: label {labels.max()} of a palette of {rows} rows")
        return palette, labels


def _palette(scene: CompressedScene, most: int) -> tuple[Float32s, Int64s]:
    """Palette of spherical harmonics ``[K, D]`` in order of first use, and the row of each splat ``[N]``."""
    from nsvq_lightning.io.palette import find_palette, in_order_of_use  # imports Numba, which readers do without

    if "shN" not in scene.codes:
        return in_order_of_use(*find_palette(scene.rows("shN"), _visibility(scene), most))
    rows, codes = in_order_of_use(scene.codebooks["shN"], scene.codes["shN"])
    if len(rows) <= most:
        return rows, codes
    rows, labels = find_palette(rows, np.bincount(codes, _visibility(scene)), most)
    return in_order_of_use(rows, labels[codes])


def _visibility(scene: CompressedScene) -> Float64s:
    """How much the colour of each splat matters ``[N]`` when no view is known: opacity times width.

    Every splat counts a little, however small it is compared with the largest.
    """
    sizes = np.sort(scene.rows("scales"), axis=1)[:, 1:].mean(1).astype(np.float64)
    weight: Float64s = opacity_of(scene.opacities) * np.exp(sizes - sizes.max())
    return weight / float(weight.mean()) + 0.01


def _low_and_high(numbers: Arrays) -> Uint8s:
    """The two bytes ``[..., 2]`` of whole numbers below 65536."""
    return numbers.astype("<u2")[..., None].view(np.uint8)


def _packed_quats(rows: Float32s) -> Uint8s:
    largest, others = conventions.smallest_three(conventions.unit(rows))
    packed = np.rint(127.5 * (1 + math.sqrt(2) * others).clip(0, 2))
    return np.column_stack([packed, 252 + largest]).astype(np.uint8)


def _leveled(values: Float32s, weight: Arrays | int = 1) -> tuple[Uint8s, list[float]]:
    """Index of the level of each value, and the levels: the shortest decimals that give the same float32."""
    from nsvq_lightning.io.palette import nearest_level, scalar_kmeans

    levels = scalar_kmeans(values, weight, _LEVELS)
    return nearest_level(values, levels), [float(str(level)) for level in levels]


def _picture(texels: Uint8s, shape: tuple[int, int] | None = None) -> Uint8s:
    """Texels ``[N, C]`` as a picture ``[H, W, 4]``; missing texels are black and opaque.

    By default it is the smallest that is nearly square, with sides that are multiples of 4.
    """
    count, channels = texels.shape
    if shape is None:
        width = 4 * math.ceil(math.sqrt(count) / 4)
        shape = 4 * math.ceil(count / width / 4), width
    picture = np.zeros((math.prod(shape), 4), np.uint8)
    picture[:, 3] = 255
    picture[:count, :channels] = texels
    return picture.reshape(*shape, 4)


_PICTURES = (".webp", ".png")


def _archived(path: Path) -> tuple[bytes, int]:
    """The zip archive and its size; of a folder, whose ``meta.json`` is given, one with the pictures in it."""
    if path.suffix.lower() != ".json":
        data = path.read_bytes()
        return data, len(data)
    buffer = BytesIO()
    text = path.read_text(encoding="utf-8", errors="replace")
    named = {name: path.parent / name for name in re.findall(r'"([^"]+)"', text) if name.lower().endswith(_PICTURES)}
    pictures = {name: file for name, file in named.items() if file.is_file()}
    with ZipFile(buffer, "w", strict_timestamps=False) as archive:  # some are of 1970
        archive.write(path, META)
        for name, picture in pictures.items():
            archive.write(picture, name)
    return buffer.getvalue(), sum(file.stat().st_size for file in (path, *pictures.values()))


def read_sog(path: StrPath) -> CompressedScene:
    """Read a ``.sog`` file or a ``meta.json`` in its folder; the palette becomes the codebook of the harmonics.

    Raises:
        FormatError: The file is truncated, altered, of another version, or not a ``.sog`` file.
    """
    with naming_file(path):
        data, size = _archived(Path(path))
        archive = _Archive(data)
        raw = {"quats": archive.quats(), "scales": archive.values("scales", archive.texels("scales")[:, :3])}
        raw["sh0"], opacities = archive.colors()
        codes, codebooks = {}, {}
        if degree := archive.sh_degree:
            codebooks["shN"], codes["shN"] = archive.palette()
        else:
            raw["shN"] = np.zeros((archive.count, 0), np.float32)
        antialiased = archive.meta.get("model") == "antialiased" or archive.meta.get("antialias") is True
        config = {"antialiased": True} if antialiased else {}
        return CompressedScene(archive.means(), opacities, codes, codebooks, raw, degree, config, stored_bytes=size)
