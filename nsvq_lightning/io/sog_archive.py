"""The container of a ``.sog`` file: a zip archive of ``meta.json`` and lossless WebP pictures."""

from __future__ import annotations

import io
import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.limits import FEW_SPLATS, check_room

__all__ = ["META", "ZIP_MAGIC", "SogArchive", "picture_shape", "write_archive"]

META = "meta.json"
ZIP_MAGIC = b"PK\x03\x04"
_EPOCH = (1980, 1, 1, 0, 0, 0)
_META_LIMIT = 1 << 20
_TEXEL_BYTES = 8
"""Most bytes of a picture for each texel that the file may hold; uncompressed, a texel has four."""


def picture_shape(count: int) -> tuple[int, int]:
    """Height and width of the smallest nearly square picture of ``count`` texels, both multiples of 4."""
    width = max(4, 4 * math.ceil(math.sqrt(count) / 4))
    return max(4, 4 * math.ceil(count / width / 4)), width


def write_archive(
    path: str | os.PathLike[str], meta: Mapping[str, Any], pictures: Mapping[str, NDArray[np.uint8]]
) -> int:
    """Write the file, replaced atomically; the same content gives the same bytes.

    Args:
        path: File to write.
        meta: Content of ``meta.json``.
        pictures: Texels ``[H, W, 4]`` by name.

    Returns:
        Bytes of the file.
    """
    text = json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()
    with atomic_write(path) as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, data in {META: text, **{name: _webp(texels) for name, texels in pictures.items()}}.items():
                entry = zipfile.ZipInfo(name, _EPOCH)
                entry.create_system = 3  # otherwise that of the machine
                archive.writestr(entry, data)
        return file.tell()


def _webp(texels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    # exact=True: otherwise colours under alpha 0 are changed.
    Image.fromarray(texels, "RGBA").save(buffer, "WEBP", lossless=True, exact=True, quality=75, method=3)
    return buffer.getvalue()


class SogArchive:
    """A ``.sog`` file opened for reading; use it in a ``with`` block.

    Args:
        path: File.

    Raises:
        FormatError: It is truncated, altered, or not a zip archive with a ``meta.json``.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._size = os.path.getsize(path)
        try:
            self._zip = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, ValueError, NotImplementedError, EOFError) as error:
            raise FormatError(f"truncated, or not a .sog file: no valid zip archive ({error})") from None

    def __enter__(self) -> SogArchive:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    @property
    def sizes(self) -> dict[str, int]:
        """Compressed size in bytes of each entry, by name."""
        return {entry.filename: entry.compress_size for entry in self._zip.infolist()}

    def meta(self) -> dict[str, Any]:
        """Content of ``meta.json``.

        Raises:
            FormatError: It is missing, damaged, or not a JSON object.
        """
        text = self._bytes(META, _META_LIMIT)
        try:
            meta = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise FormatError(f"damaged: {META} is not JSON ({error})") from None
        if not isinstance(meta, dict):
            raise FormatError(f"damaged: {META} is not a JSON object")
        return meta

    def check_count(self, texels: int) -> None:
        """Refuse more texels than a file of this size can hold.

        Raises:
            FormatError: There are too many.
        """
        check_room("splats or texels", texels, self._size)

    def texels(self, name: str, count: int) -> NDArray[np.uint8]:
        """The first ``count`` texels ``[count, 4]`` of a picture.

        Raises:
            FormatError: It is missing, damaged, or too small.
        """
        from PIL import Image

        data = self._bytes(name, _TEXEL_BYTES * max(FEW_SPLATS, self._size))
        try:
            with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
                if image.width * image.height < count:
                    raise FormatError(f"damaged: {name} has {image.width} x {image.height} texels, {count} are needed")
                self.check_count(image.width * image.height)
                return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:count]
        except FormatError:
            raise
        except Exception as error:  # damage can make Pillow's decoders raise anything
            raise FormatError(f"damaged: {name} is not a picture ({error})") from None

    def _bytes(self, name: str, most: int) -> bytes:
        try:
            entry = self._zip.getinfo(name)
            if entry.file_size > most:
                raise FormatError(f"damaged: {name} cannot have {entry.file_size} bytes")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # whose length can be limited
                raise FormatError(f"{name} is compressed by method {entry.compress_type} of zip, not 0 (none) or 8")
            with self._zip.open(entry) as file:
                return file.read(entry.file_size)  # not read(name), which unpacks all there is, whatever its length
        except KeyError:
            raise FormatError(f"not a whole .sog file: the archive has no {name}") from None
        except FormatError:
            raise
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, ValueError, struct.error) as error:
            raise FormatError(f"damaged: {name} cannot be unpacked ({error})") from None
