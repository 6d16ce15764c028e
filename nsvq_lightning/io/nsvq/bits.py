"""Codes of a few bits each, packed without gaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["code_bits", "pack_fields", "packed_bytes", "unpack_fields"]

_CHUNK = 1 << 14
"""Rows per chunk: a multiple of 8, so that every chunk ends on a whole byte, and small enough for the cache."""

_MAX_BITS = 32


def code_bits(codes: int) -> int:
    """Bits that distinguish ``codes`` values: ⌈log2 codes⌉, and 0 for a single one.

    Raises:
        ValueError: ``codes`` is not in 1..2³².
    """
    if not 1 <= codes <= 1 << _MAX_BITS:
        raise ValueError(f"a codebook must have 1 to 2^{_MAX_BITS} rows, got {codes}")
    return (codes - 1).bit_length()


def packed_bytes(rows: int, widths: Sequence[int]) -> int:
    """Length of the packed stream, ⌈rows · Σ widths / 8⌉ bytes."""
    return -(-rows * sum(widths) // 8)


def pack_fields(fields: Sequence[NDArray[np.integer]], widths: Sequence[int]) -> bytes:
    """Pack one record per row: field after field, lowest bit first, rows without any padding between them.

    Bit ``b`` of the stream is bit ``b % 8`` of byte ``b // 8``; row ``i`` starts at bit ``i · Σ widths``; the bits
    after the last row are 0.

    Args:
        fields: Non-negative integer arrays ``[N]``, at least one.
        widths: Bits of each field, 0 to 32. A field of 0 bits holds only zeros and takes no space.

    Returns:
        :func:`packed_bytes` bytes.

    Raises:
        ValueError: A value does not fit into its width, or the arrays differ in length.
    """
    _check_widths(widths)
    rows = len(fields[0])
    for field, width in zip(fields, widths, strict=True):
        if field.shape != (rows,):
            raise ValueError(f"all fields must have shape [{rows}], got {list(field.shape)}")
        if rows and (int(field.min()) < 0 or int(field.max()) >> width):
            raise ValueError(f"values {field.min()}..{field.max()} do not fit into {width} bits")
    return b"".join(
        _pack_chunk([field[start : start + _CHUNK] for field in fields], widths) for start in range(0, rows, _CHUNK)
    )


def unpack_fields(data: bytes | memoryview, rows: int, widths: Sequence[int]) -> list[NDArray[np.unsignedinteger]]:
    """Invert :func:`pack_fields`.

    Args:
        data: The packed stream.
        rows: N.
        widths: Bits of each field, 0 to 32.

    Returns:
        One array ``[N]`` per field: uint16 up to 16 bits, uint32 above.

    Raises:
        ValueError: ``data`` does not have exactly :func:`packed_bytes` bytes.
    """
    _check_widths(widths)
    if len(data) != packed_bytes(rows, widths):
        raise ValueError(f"{rows} rows of {sum(widths)} bits need {packed_bytes(rows, widths)} bytes, got {len(data)}")
    packed = np.frombuffer(data, np.uint8)
    fields: list[NDArray[np.unsignedinteger]] = [
        np.zeros(rows, np.uint16 if width <= 16 else np.uint32) for width in widths
    ]
    chunk_bytes = _CHUNK * sum(widths) // 8
    for chunk, start in enumerate(range(0, rows, _CHUNK)):
        parts = [field[start : start + _CHUNK] for field in fields]
        _unpack_chunk(packed[chunk * chunk_bytes : (chunk + 1) * chunk_bytes], parts, widths)
    return fields


def _check_widths(widths: Sequence[int]) -> None:
    if any(not 0 <= width <= _MAX_BITS for width in widths):
        raise ValueError(f"fields must have 0 to {_MAX_BITS} bits, got {list(widths)}")


def _pack_chunk(fields: Sequence[NDArray[np.integer]], widths: Sequence[int]) -> bytes:
    columns = [
        np.unpackbits(field.astype("<u4").view(np.uint8).reshape(-1, 4), axis=1, count=width, bitorder="little")
        for field, width in zip(fields, widths, strict=True)
        if width
    ]
    return np.packbits(np.concatenate(columns, axis=1), bitorder="little").tobytes() if columns else b""


def _unpack_chunk(
    packed: NDArray[np.uint8], fields: Sequence[NDArray[np.unsignedinteger]], widths: Sequence[int]
) -> None:
    rows, record = len(fields[0]), sum(widths)
    bits = np.unpackbits(packed, count=rows * record, bitorder="little").reshape(rows, record)
    start = 0
    for field, width in zip(fields, widths, strict=True):
        if width:
            value_bytes = np.packbits(bits[:, start : start + width], axis=1, bitorder="little")
            for position in range(value_bytes.shape[1]):
                field |= value_bytes[:, position].astype(field.dtype) << np.array(8 * position, field.dtype)
        start += width
