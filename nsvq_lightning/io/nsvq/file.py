"""Write and read ``.nsvq`` files, and what level ``paper`` holds."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nsvq_lightning.io.atomic import StrPath, atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import Bytes, FormatError, as_defect, naming_file
from nsvq_lightning.io.nsvq.header import AttributeEntry, Header, StreamEntry, frame, unframe
from nsvq_lightning.io.nsvq.precision import LEVELS, Precision, Storage
from nsvq_lightning.io.numbers import float_rows
from nsvq_lightning.splats.attributes import QUANTIZABLE, attribute_dims, listed
from nsvq_lightning.splats.conventions import Integers, Uint32s

# Attributes in file order.
_ORDER = ("means", "opacities", *QUANTIZABLE)


def encode(scene: CompressedScene, storage: Storage) -> tuple[Header, dict[str, bytes]]:
    """Header and streams of a scene; the same arguments give the same bytes.

    Args:
        scene: The scene.
        storage: Level and precision.

    Raises:
        ValueError: ``config`` is not made of JSON values, or a value is too large for its step.
    """
    # Import only the level's module: entropy coding needs Numba, which level ``paper`` does without.
    if storage.level == "compact":
        from nsvq_lightning.io.nsvq.compact import encode_compact

        told = {name: each for name, each in vars(storage.precision).items() if each != getattr(Precision, name)}
        if told or "precision" in scene.config:
            scene = replace(scene, config={**scene.config, "precision": told})
        return encode_compact(scene, storage.precision)
    return encode_paper(scene)


def write_nsvq(path: StrPath, scene: CompressedScene, storage: Storage | None = None) -> int:
    """Write a scene to a file, replaced atomically; the same arguments give the same bytes.

    Args:
        path: File to write.
        scene: The scene; :func:`nsvq_lightning.save` leaves out non-finite splats, which level ``compact`` refuses.
        storage: Level and precision; by default those of the file that it was read from, where these are others.

    Returns:
        Bytes of the file.

    Raises:
        ValueError: ``config`` is not made of JSON values, or level ``compact`` cannot store a value.
    """
    storage = storage or Storage.told(scene.config)
    if storage.level == "compact" and (culprits := scene.finite_rows()[1]):
        raise ValueError(
            f"numbers that are not finite ({listed(culprits)}): drop those splats, or take level 'paper', which has any"
        )
    with atomic_write(path) as file:
        file.writelines(frame(*encode(scene, storage)))
        return file.tell()


def as_stored(scene: CompressedScene, storage: Storage) -> CompressedScene:
    """What the ``.nsvq`` file of a scene decodes to, for files of other formats that hold the same splats.

    A scene without codebooks stays as it is: rounding it would only cost quality, and its reference is the ``.ply``.
    """
    return decode(*encode(scene, storage)) if scene.codes else scene


def read_nsvq(path: StrPath) -> CompressedScene:
    """Read a scene: exact for level ``paper``; within its precision, with splats reordered, for ``compact``.

    Raises:
        FormatError: The file is truncated, altered, of a newer version or level, or not a ``.nsvq`` file.
    """
    data = Path(path).read_bytes()
    with naming_file(path):
        return replace(decode(*unframe(data)), stored_bytes=len(data))


def decode(header: Header, streams: Mapping[str, Bytes]) -> CompressedScene:
    """Scene from header and streams of any level.

    Raises:
        FormatError: The level is newer, or the streams do not match the header.
    """
    if header.level == "compact":
        from nsvq_lightning.io.nsvq.compact import decode_compact

        return decode_compact(header, streams)
    if header.level == "paper":
        return decode_paper(header, streams)
    raise FormatError(f"level {header.level!r}; this release reads {', '.join(LEVELS)}", "update nsvq-lightning")


def pack_fields(fields: Sequence[Integers], widths: Sequence[int]) -> bytes:
    """Pack one record per row: field after field, lowest bit first, rows without any padding between them.

    Bit ``b`` of the stream is bit ``b % 8`` of byte ``b // 8``; row ``i`` starts at bit ``i · Σ widths``; the bits
    after the last row are 0.

    Args:
        fields: Integer arrays ``[N]``, at least one, each number not negative and within its width.
        widths: Bits of each field, 0 to 32. A field of 0 bits holds only zeros and takes no space.

    Returns:
        ⌈N · Σ widths / 8⌉ bytes.
    """
    columns = []
    for field, width in zip(fields, widths, strict=True):
        number_bytes = field[:, None].astype("<u4").view(np.uint8)
        columns.append(np.unpackbits(number_bytes, axis=1, count=width, bitorder="little"))
    return np.packbits(np.concatenate(columns, axis=1), bitorder="little").tobytes()


def unpack_fields(data: Bytes, rows: int, widths: Sequence[int]) -> list[Uint32s]:
    """Invert :func:`pack_fields`.

    Args:
        data: The packed stream.
        rows: N.
        widths: Bits of each field, 0 to 32.

    Returns:
        One array ``[N]`` per field.
    """
    record = sum(widths)
    bits = np.unpackbits(np.frombuffer(data, np.uint8), count=rows * record, bitorder="little").reshape(rows, record)
    columns = np.split(bits, np.cumsum(widths)[:-1], axis=1)
    numbers = (np.pad(column, ((0, 0), (0, 32 - column.shape[1]))) for column in columns)
    return [np.packbits(number, axis=1, bitorder="little").view("<u4")[:, 0] for number in numbers]


def paper_header(scene: CompressedScene) -> Header:
    """Header of the scene's file at level ``paper``; cheap, since it depends only on counts.

    The storage is as the paper counts it: positions and opacities are float32, the codes of all quantized attributes
    are one bit-packed stream, and codebooks are float32:

        16 · N + ⌈N · Σ bits / 8⌉ + Σ 4 · K · D + header bytes,

    with bits = ⌈log2 K⌉ (0 for a single row). An attribute that is not quantized adds 4 · N · D instead of its bits and
    its codebook. The header is the 32-byte prefix and the JSON.
    """
    dims = attribute_dims(scene.sh_degree)
    books = scene.codebooks
    attributes = tuple(
        AttributeEntry(name, dims[name], "codes" if name in books else "raw", len(books.get(name, ())))
        for name in _ORDER
    )
    return Header.of(scene, "paper", attributes, _layout(len(scene), attributes))


def encode_paper(scene: CompressedScene) -> tuple[Header, dict[str, bytes]]:
    """Header and streams of a scene at level ``paper``."""
    header = paper_header(scene)
    coded = [entry for entry in header.attributes if entry.storage == "codes"]
    floats = {name: scene.rows(name) for name in ("means", "opacities", *scene.raw)}
    floats |= {f"{name}.codebook": values for name, values in scene.codebooks.items()}
    streams = {name: np.asarray(values, "<f4").tobytes() for name, values in floats.items()}
    if coded:
        streams["codes"] = pack_fields([scene.codes[entry.name] for entry in coded], [entry.bits for entry in coded])
    return header, streams


def decode_paper(header: Header, streams: Mapping[str, Bytes]) -> CompressedScene:
    """Scene from header and streams.

    Raises:
        FormatError: The tables do not belong to this level, or a code is not a row of its codebook.
    """
    # Compared with the tables this release would write, before anything is allocated from their sizes.
    header.check_attributes(_ORDER, _possible)
    if header.streams != _layout(header.splats, header.attributes):
        raise FormatError("damaged: the stream table does not fit the attribute table and the number of splats")
    n = header.splats
    coded = [entry for entry in header.attributes if entry.storage == "codes"]
    packed = unpack_fields(streams["codes"], n, [entry.bits for entry in coded]) if coded else []
    raw = [entry for entry in header.attributes if entry.storage == "raw" and entry.name in QUANTIZABLE]
    with as_defect("damaged: its parts do not fit each other", ValueError):
        return CompressedScene(
            means=float_rows(streams["means"], n, 3),
            opacities=float_rows(streams["opacities"], n, 1)[:, 0],
            codes={entry.name: codes for entry, codes in zip(coded, packed, strict=True)},
            codebooks={each.name: float_rows(streams[f"{each.name}.codebook"], each.codes, each.dim) for each in coded},
            raw={entry.name: float_rows(streams[entry.name], n, entry.dim) for entry in raw},
            **header.of_scene,
        )


def _layout(n: int, attributes: tuple[AttributeEntry, ...]) -> tuple[StreamEntry, ...]:
    """The streams: raw attributes, codes, codebooks."""
    coded = [entry for entry in attributes if entry.storage == "codes"]
    bits = sum(entry.bits for entry in coded)
    return (
        *(StreamEntry(entry.name, 4 * n * entry.dim, "float32") for entry in attributes if entry.storage == "raw"),
        *([StreamEntry("codes", -(-n * bits // 8), "bits")] if coded else []),
        *(StreamEntry(f"{entry.name}.codebook", 4 * entry.codes * entry.dim, "float32") for entry in coded),
    )


def _possible(entry: AttributeEntry) -> bool:
    raw = entry.storage == "raw" and entry.codes == 0
    coded = entry.name in QUANTIZABLE and entry.storage == "codes" and 1 <= entry.codes <= 1 << 32
    return entry.step == 0 and (raw or coded)
