"""The tables of a COLMAP model, binary or text, read record by record: what is wrong is named by its place.

Errors are ``ValueError`` without the name of the file. Text tables are read more leniently than COLMAP does: names with
spaces, images without a second line, colours of any kind, points without identifier, error and track.
"""

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from nsvq_lightning.io.errors import LFS, POINTER
from nsvq_lightning.splats.conventions import Float64s

# Camera models in the order of COLMAP's numbers, and how many parameters each has.
LENSES = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
# Identifier, position and colour of a point, then the images that saw it.
_Point = tuple[int | float, ...]
_U64 = struct.Struct("<Q")


class CameraRow(NamedTuple):
    """A camera: its identifier, COLMAP's name of its model, width and height in pixels, parameters."""

    number: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ImageRow(NamedTuple):
    """An image: its identifier, pose from world to camera (quaternion wxyz of any norm, scene units), camera, name."""

    number: int
    pose: tuple[float, ...]
    camera_id: int
    name: str


class PointTable(NamedTuple):
    """Points, sorted by identifier.

    Attributes:
        xyz: ``[P, 3]`` float64, scene units.
        rgb: ``[P, 3]`` float64, as they are in the file.
        tracks: Identifiers of the images that saw each point; none unless requested.
        seen: Whether two images saw any of them: SfM's are, those of scanners that others wrote into the table are not.
    """

    xyz: Float64s
    rgb: Float64s
    tracks: Sequence[Sequence[int]]
    seen: bool = False


def read_cameras(path: Path) -> list[CameraRow]:
    """The cameras in ``cameras.bin`` or ``cameras.txt``.

    Args:
        path: The file.

    Raises:
        ValueError: The file is damaged, or a camera has an unknown model.
    """
    if path.suffix.lower() == ".bin":
        return list(_records(path, _camera_record))
    return [_camera_line(line, text.split()) for line, text in _lines(path)]


def read_images(path: Path) -> list[ImageRow]:
    """The images in ``images.bin`` or ``images.txt``.

    Raises:
        ValueError: The file is damaged.
    """
    return list(_records(path, _image_record) if path.suffix.lower() == ".bin" else _image_lines(path))


def read_points(path: Path, tracks: bool = False) -> PointTable:
    """The points in ``points3D.bin`` or ``points3D.txt``.

    Args:
        path: The file.
        tracks: Also read which images saw each point.

    Raises:
        ValueError: The file is damaged.
    """
    if path.suffix.lower() == ".bin":
        records = _records(path, lambda data, start: _point_record(data, start, tracks))
    else:
        records = _point_lines(path, tracks)
    points = sorted(records, key=lambda point: point[0])
    values = np.array([point[1:7] for point in points], np.float64).reshape(-1, 6)
    images = [[int(image) for image in point[8:]] for point in points]
    return PointTable(values[:, :3], values[:, 3:], images, any(point[7] > 1 for point in points))


def announced_rows(path: Path) -> int:
    """Number of rows that the comment at the head of a text table gives; 0 if it gives none."""
    with path.open("rb") as file:
        found = re.search(rb"^# Number of \w+: (\d+)", file.read(1 << 12), re.MULTILINE)
    return int(found[1]) if found else 0


_Row = TypeVar("_Row")

_CAMERA = struct.Struct("<IiQQ")  # identifier, model, width, height
_IMAGE = struct.Struct("<I7dI")  # identifier, pose, camera; the name and the 2D points follow
_POINT = struct.Struct("<Q3d3BdQ")  # identifier, position, colour, error, length of the track, which follows


def _records(path: Path, record: Callable[[bytes, int], tuple[_Row, int]]) -> Iterator[_Row]:
    """The records of a binary table, none of which may end beyond the file.

    Args:
        path: The file.
        record: Reads the record that begins at a byte, and says where it ends.

    Raises:
        ValueError: The file is empty, truncated, or longer than its records.
    """
    data = path.read_bytes()  # not mapped: an error of the disk would end the process, and some disks map nothing
    size = len(data)
    if size < _U64.size:
        raise ValueError(f"it has {size} bytes, too few for a COLMAP table")
    if data[: len(LFS)] == LFS:
        raise ValueError(f"it is {POINTER}")
    (count,) = _U64.unpack_from(data, 0)
    end = _U64.size
    for row in range(1, count + 1):
        try:
            values, end = record(data, end)
            if end > size:
                raise struct.error("it ends beyond the file")
        except struct.error as error:
            raise ValueError(
                f"it is truncated or garbled: of {count} declared records, record {row} cannot be read ({error}; "
                f"the file has {size} bytes)"
            ) from error
        yield values
    if end != size:
        raise ValueError(f"it is garbled: its {count} declared records end at byte {end} of {size}")


def _camera_record(data: bytes, start: int) -> tuple[CameraRow, int]:
    number, model, width, height = _CAMERA.unpack_from(data, start)
    if not 0 <= model < len(LENSES):
        raise struct.error(
            f"camera {number} has model id {model} and size {width}x{height}; known are the ids 0 to {len(LENSES) - 1}"
        )
    name, count = list(LENSES.items())[model]
    params = struct.unpack_from(f"<{count}d", data, start + _CAMERA.size)
    return CameraRow(number, name, width, height, params), start + _CAMERA.size + 8 * count


def _image_record(data: bytes, start: int) -> tuple[ImageRow, int]:
    number, *pose, camera_id = _IMAGE.unpack_from(data, start)
    end = data.find(b"\0", start + _IMAGE.size)
    if end < 0:
        raise struct.error("its name does not end")
    name = data[start + _IMAGE.size : end].decode(errors="surrogateescape")
    (points,) = _U64.unpack_from(data, end + 1)
    return ImageRow(number, tuple(pose), camera_id, name), end + 1 + _U64.size + 24 * points


def _point_record(data: bytes, start: int, tracks: bool) -> tuple[_Point, int]:
    *values, _, length = _POINT.unpack_from(data, start)
    first = start + _POINT.size
    end = first + 8 * length
    if end > len(data) or not tracks:
        return (*values, length), end
    return (*values, length, *struct.unpack_from(f"<{2 * length}I", data, first)[::2]), end


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text table with their numbers, without comments and empty ones."""
    with path.open("rb") as file:
        start = file.read(2)
    # UTF-8 with or without a mark, or UTF-16, which PowerShell writes.
    encoding = "utf-16" if start in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    with path.open(encoding=encoding, errors="surrogateescape") as file:
        for number, line in enumerate(file, 1):
            text = line.strip()
            if text and not text.startswith("#"):
                yield number, text


def _numbers(line: int, words: Sequence[str]) -> list[float]:
    """Words of a line as numbers.

    Raises:
        ValueError: One is none.
    """
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            hint = "; decimals need a point, not a comma" if "," in word else ""
            raise ValueError(f"line {line} has {word[:40]!r} in place of a number{hint}") from None
    return numbers


def _camera_line(line: int, words: Sequence[str]) -> CameraRow:
    if len(words) < 4:
        raise ValueError(f"line {line} has {len(words)} words; a camera has identifier, model, width, height, numbers")
    number, width, height, *params = _numbers(line, [words[0], *words[2:]])
    model = words[1].upper()
    if model not in LENSES:
        raise ValueError(f"line {line}: camera {number:g} has the model {model}; known are {', '.join(LENSES)}")
    if len(params) != LENSES[model]:
        raise ValueError(
            f"line {line}: camera {number:g} of model {model} has {len(params)} parameters in place of {LENSES[model]}"
        )
    return CameraRow(int(number), model, round(width), round(height), tuple(params))


def _image_lines(path: Path) -> Iterator[ImageRow]:
    """The images of a text table. A line of 2D points, three numbers each, may follow the line of an image."""
    after_image = False
    for line, text in _lines(path):
        words = text.split(maxsplit=9)
        if after_image and re.fullmatch(r"[-+.\deEnaifd()\s]+", text) and len(text.split()) % 3 == 0:
            after_image = False
            continue
        if len(words) < 10:
            raise ValueError(f"line {line} has {len(words)} words; an image has identifier, pose of 7, camera, name")
        number, *pose, camera_id = _numbers(line, words[:9])
        yield ImageRow(int(number), tuple(pose), int(camera_id), words[9])
        after_image = True


def _point_lines(path: Path, tracks: bool) -> Iterator[_Point]:
    """The points of a text table; a line of six numbers, or whose first has decimals, has no identifier."""
    for line, text in _lines(path):
        words = text.split()
        if len(words) < 6:
            raise ValueError(f"line {line} has {len(words)} words; a point has identifier, position of 3, colour of 3")
        if len(words) == 6 or _numbers(line, words[:1])[0] % 1:  # DPVO's have an error and a track
            words = [str(line), *words]
        images = words[8::2]
        yield (*_numbers(line, words[:7]), len(images), *_numbers(line, images if tracks else ()))
