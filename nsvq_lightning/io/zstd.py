"""Zstandard, which compresses version 4 of ``.spz``: Python's own from 3.14 on, a package before that."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from typing import Any

from nsvq_lightning.io.errors import FormatError

__all__ = ["MOST_A_BYTE", "compress", "decompress"]

MOST_A_BYTE = 1 << 15
"""Most bytes that one byte can expand to: a block of 128 KiB of equal bytes takes four."""
_LEVEL = 19


def compress(data: bytes | memoryview) -> bytes:
    """A frame with its length and a checksum; the same data give the same bytes with the same release of Zstandard.

    Raises:
        FormatError: Zstandard is not installed.
    """
    zstd = _zstd()
    options = {zstd.CompressionParameter.compression_level: _LEVEL, zstd.CompressionParameter.checksum_flag: 1}
    frame: bytes = zstd.compress(data, options=options)
    return frame


def decompress(data: bytes | memoryview, size: int) -> bytes:
    """Content of a frame that must have ``size`` bytes; no more than that is ever held in memory.

    Raises:
        FormatError: It is damaged, truncated, or of another size; or Zstandard is not installed.
    """
    zstd = _zstd()
    stream = zstd.ZstdDecompressor()
    try:
        content: bytes = stream.decompress(data, size)
        beyond = b"" if stream.eof else stream.decompress(b"", 1)
    except zstd.ZstdError as error:
        raise FormatError(f"damaged: no valid Zstandard stream ({error})") from None
    if len(content) < size or beyond or not stream.eof or stream.unused_data:
        raise FormatError(f"damaged: a Zstandard stream does not hold the {size} bytes that it should")
    return content


def _zstd() -> Any:
    for name in ("compression.zstd", "backports.zstd"):
        with suppress(ImportError):
            return import_module(name)
    raise FormatError(
        "version 4 of .spz needs Zstandard, which this Python does not have",
        "run pip install 'nsvq-lightning[spz]', or save the file as version 3",
    )
