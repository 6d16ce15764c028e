"""Finds the files of a COLMAP model and checks that they are complete before a reader allocates memory for them."""

from __future__ import annotations

import math
import mmap
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath

__all__ = ["ModelFiles", "SceneError", "check_binary_files", "check_name", "find_model", "has_model", "larger_models"]

FOLDERS = ("sparse/0", "sparse", ".")
"""Where a model may be inside a scene folder, in order of preference."""
TABLES = ("cameras", "images", "points3D")
"""The three tables every COLMAP model has."""

LARGEST_SIDE = (1 << 20) - 1
"""Pixels; a camera with a larger side is damaged."""

_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_REMEDY = "copy the model again or export it anew with `colmap model_converter`"

Buffer = mmap.mmap
RecordEnd = Callable[[Buffer, int], int]


class SceneError(ValueError):
    """A scene folder that cannot be used; the message names the file, what is wrong with it and what to do."""


@dataclass(frozen=True)
class ModelFiles:
    """A complete COLMAP model on disk.

    Attributes:
        folder: Folder with the three tables.
        suffix: ``".bin"`` or ``".txt"``.
    """

    folder: Path
    suffix: str

    def path(self, table: str) -> Path:
        """File of one table, for example ``"cameras"``."""
        return self.folder / f"{table}{self.suffix}"


def has_model(root: Path) -> bool:
    """Whether a scene folder has a complete COLMAP model where :func:`find_model` looks for one."""
    return any(
        all((root / folder / f"{table}{suffix}").is_file() for table in TABLES)
        for folder in FOLDERS
        for suffix in (".bin", ".txt")
    )


def find_model(root: Path, chosen: str | None = None) -> ModelFiles:
    """The model of a scene folder: ``sparse/0``, ``sparse`` or the folder itself, binary before text.

    Args:
        root: Scene folder.
        chosen: N for ``sparse/N``, or a folder inside ``root``; None looks in the three places.

    Raises:
        SceneError: The folder does not exist or holds no complete model.
    """
    if not root.is_dir():
        raise SceneError(f"scene folder {root} does not exist: give the folder that holds images/ and sparse/")
    folders: tuple[str, ...] = FOLDERS
    if chosen is not None:
        folders = (f"sparse/{chosen}" if chosen.isdecimal() else chosen,)
    missing: list[str] = []
    for folder in folders:
        for suffix in (".bin", ".txt"):
            files = ModelFiles((root / folder).resolve(), suffix)
            absent = [table for table in TABLES if not files.path(table).is_file()]
            if not absent:
                return files
            if len(absent) < len(TABLES):
                missing.append(f"{folder} has a {suffix} model without {', '.join(t + suffix for t in absent)}")
    looked = ", ".join(folders)
    details = "; ".join(missing) or "none of the three files is in any of them"
    if chosen is not None:
        others = sorted({str(path.parent.relative_to(root)) for path in (root / "sparse").glob("*/cameras.*")})
        raise SceneError(
            f"no COLMAP model in {root / looked}: looked for cameras, images and points3D (.bin or .txt); {details}. "
            f"Choose another (--data.model); there is {', '.join(others) or 'none in sparse/'}"
        )
    raise SceneError(
        f"no COLMAP model in {root}: looked for cameras, images and points3D (.bin or .txt) in {looked}; {details}; "
        "nor is there a transforms.json. Run COLMAP on the photos or copy the missing files"
    )


def larger_models(root: Path) -> str | None:
    """Which models of a scene folder have more images than :func:`find_model`'s ``sparse/0``, and what to do; or None.

    COLMAP numbers the parts of a scene that it could not join, not always in the order of their size.
    """
    counts = {}
    for path in sorted((root / "sparse").glob("*/images.bin")):
        with path.open("rb") as file:
            counts[path.parent.name] = int.from_bytes(file.read(_U64.size), "little")
    larger = [f"sparse/{name} has {count}" for name, count in counts.items() if count > counts.get("0", math.inf)]
    if not larger:
        return None
    return (
        f"sparse/0 has {counts['0']} images, {', '.join(larger)}: COLMAP could not join them; --data.model=N "
        "trains on sparse/N"
    )


def check_name(name: str, source: object, allow_outside: bool = False) -> None:
    """Check the name of a file that a model gives relative to its scene folder.

    Args:
        name: The name.
        source: Where it is given, for the message.
        allow_outside: Also allow files that are not in the scene folder.

    Raises:
        SceneError: It leaves the folder, or is not UTF-8.
    """
    try:
        name.encode()
    except UnicodeEncodeError:
        raise SceneError(f"{source} names {name!r}, which is not UTF-8: rename that file or folder") from None
    path = PurePath(name)
    if not allow_outside and (path.anchor or ".." in path.parts):
        raise SceneError(
            f"{source} names {name}, which is not in the scene folder: copy it there, or allow it in fit and test with "
            "--data.allow_outside=true"
        )


def check_binary_files(files: ModelFiles, params_of_model: Mapping[int, int]) -> None:
    """Walk every record of a binary model, so that a damaged file gives an error instead of an endless allocation.

    COLMAP's reader trusts the counts in the files: an empty ``points3D.bin`` makes it allocate without end, and a
    truncated ``cameras.bin`` loads as garbage.

    Args:
        files: The model; ``rigs.bin`` and ``frames.bin`` (COLMAP 4) are checked too where they exist.
        params_of_model: Number of parameters of each camera model id.

    Raises:
        SceneError: A file is empty, truncated, longer than its records, or not a COLMAP table.
    """
    walks: dict[str, RecordEnd] = {
        "cameras": partial(_camera_end, params_of_model),
        "images": _image_end,
        "points3D": _point_end,
        "rigs": _rig_end,
        "frames": _frame_end,
    }
    for table, record_end in walks.items():
        path = files.path(table)
        if table in TABLES or path.is_file():
            _check_table(path, record_end)


def _check_table(path: Path, record_end: RecordEnd) -> None:
    size = path.stat().st_size
    if size < _U64.size:
        raise SceneError(f"{path} has {size} bytes, too few for a COLMAP table: {_REMEDY}")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = _U64.unpack_from(data, 0)
        end = _U64.size
        for row in range(1, count + 1):
            try:
                end = record_end(data, end)
                if end > size:
                    raise struct.error("it ends beyond the file")
            except struct.error as error:
                raise SceneError(
                    f"{path} is truncated or garbled: of {count} declared records, record {row} cannot be read "
                    f"({error}; the file has {size} bytes); {_REMEDY}"
                ) from error
        if end != size:
            raise SceneError(f"{path} is garbled: its {count} declared records end at byte {end} of {size}; {_REMEDY}")


def _camera_end(params_of_model: Mapping[int, int], data: Buffer, start: int) -> int:
    camera_id, model, width, height = _CAMERA.unpack_from(data, start)
    if model not in params_of_model or not 0 < min(width, height) <= max(width, height) <= LARGEST_SIDE:
        raise struct.error(
            f"camera {camera_id} has model id {model} and size {width}x{height}; this pycolmap knows the ids 0 to "
            f"{max(params_of_model)}, sizes go from 1 to {LARGEST_SIDE}"
        )
    return start + _CAMERA.size + 8 * params_of_model[model]


def _image_end(data: Buffer, start: int) -> int:
    name = start + 64  # u32 id, 7 doubles of pose, u32 camera id
    terminator = data.find(b"\0", name)
    if terminator < 0:
        raise struct.error("unterminated name")
    (points,) = _U64.unpack_from(data, terminator + 1)
    return terminator + 1 + _U64.size + 24 * int(points)


def _point_end(data: Buffer, start: int) -> int:
    (track,) = _U64.unpack_from(data, start + 43)  # u64 id, 3 doubles, 3 bytes of colour, double error
    return start + 51 + 8 * int(track)


def _rig_end(data: Buffer, start: int) -> int:
    (sensors,) = _U32.unpack_from(data, start + 4)  # after u32 rig id
    end = start + 8 + (8 if sensors else 0)  # the reference sensor has no pose
    for _ in range(1, sensors):
        end += 9 + (56 if data[end + 8 : end + 9] == b"\1" else 0)
        if end > len(data):
            break
    return end


def _frame_end(data: Buffer, start: int) -> int:
    (images,) = _U32.unpack_from(data, start + 64)  # u32 frame id, u32 rig id, 7 doubles of pose
    return start + 68 + 16 * int(images)


def announced_rows(path: Path) -> int | None:
    """Number of rows that the comment at the head of a text table declares; None where it has no such comment."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if not line.startswith("#"):
                return None
            if found := re.match(r"# Number of \w+: (\d+)", line):
                return int(found[1])
    return None
