from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pytest

from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.images import image_head, read_image
from nsvq_lightning.data.reconstruct import copy_photos, photos_in, sharpness, write_frames


def _texture(shift: int = 0) -> np.ndarray[Any, Any]:
    noise = np.random.default_rng(4).integers(0, 255, (24, 48, 3), dtype=np.uint8)
    return np.roll(cv2.resize(noise, (192, 96), interpolation=cv2.INTER_NEAREST), shift, axis=1)


def _video(path: Path, pictures: list[np.ndarray[Any, Any]]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 24, (192, 96))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path: Path) -> None:
    sharp = {2, 11, 17, 20}
    pictures = [_texture(9 * k) if k in sharp else cv2.GaussianBlur(_texture(9 * k), None, 3) for k in range(24)]
    seen: list[int] = []
    found = write_frames(_video(tmp_path / "a.mp4", pictures), tmp_path, 4, seen.append)
    assert [path.name for path in found] == [f"frame_{k:06d}.jpg" for k in sorted(sharp)]
    assert seen == list(range(1, 25))
    for path, index in zip(found, sorted(sharp), strict=True):
        difference = read_image(path)[:, :, ::-1].astype(int) - pictures[index]
        assert np.abs(difference).mean() < 30  # chroma has half the resolution


@pytest.mark.parametrize(("shifts", "parts", "frames"), [([0] * 12 + [40] * 6 + [80] * 6, 8, 3), ([0, 30, 60], 100, 3)])
def test_still_parts_are_left_out_and_short_videos_give_what_they_have(
    tmp_path: Path, shifts: list[int], parts: int, frames: int
) -> None:
    video = _video(tmp_path / "a.mp4", [_texture(shift) for shift in shifts])
    assert len(write_frames(video, tmp_path, parts, lambda _: None)) == frames


def test_what_is_no_video_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"nothing")
    with pytest.raises(SceneError, match=r"a\.mp4: no frame can be read; convert it"):
        write_frames(tmp_path / "a.mp4", tmp_path, 10, lambda _: None)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    (tmp_path / "from").mkdir()
    (tmp_path / "to").mkdir()
    return tmp_path / "from", tmp_path / "to"


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_photos_are_turned_upright(folders: tuple[Path, Path], orientation: int) -> None:
    upright = np.zeros((32, 64, 3), np.uint8)
    upright[:, :32, 0] = 255  # red on the left
    turns = {1: 0, 3: 2, 6: 1, 8: 3}[orientation]
    stored = np.rot90(upright, turns)  # the tag says how to turn it back
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    exif[0x010F] = "maker"
    source, target = folders
    PIL.Image.fromarray(np.ascontiguousarray(stored)).save(source / "a.jpg", quality=95, exif=exif)
    assert copy_photos(photos_in(source), target, lambda _: None) == []
    assert image_head(target / "a.jpg").size == (64, 32)
    assert np.abs(read_image(target / "a.jpg").astype(int) - upright).mean() < 5
    with PIL.Image.open(target / "a.jpg") as image:
        assert image.getexif().get(0x0112, 1) == 1
        assert image.getexif()[0x010F] == "maker"
    assert (orientation == 1) == ((target / "a.jpg").read_bytes() == (source / "a.jpg").read_bytes())


def test_damaged_photos_are_named_and_left_out(folders: tuple[Path, Path]) -> None:
    source, target = folders
    PIL.Image.fromarray(_texture()).save(source / "a.png")
    (source / "b.jpg").write_bytes((source / "a.png").read_bytes()[:200])
    (source / "notes.txt").write_text("no photo")
    steps: list[int] = []
    ((path, _),) = copy_photos(photos_in(source), target, steps.append)
    assert path.name == "b.jpg"
    assert [each.name for each in target.iterdir()] == ["a.png"]
    assert steps == [1, 2]


def test_folders_without_usable_photos_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no photos; it must hold files that end in"):
        photos_in(tmp_path)
    (tmp_path / "a.HEIC").write_bytes(b"x")
    with pytest.raises(SceneError, match=r"a\.HEIC and 0 more cannot be read: convert them to JPEG"):
        photos_in(tmp_path)


def test_sharpness_does_not_depend_on_the_size() -> None:
    large = cv2.resize(_texture(), (1920, 960), interpolation=cv2.INTER_CUBIC)
    small = cv2.resize(large, (960, 480), interpolation=cv2.INTER_AREA)
    assert sharpness(large) == pytest.approx(sharpness(small), rel=0.1)
    assert sharpness(cv2.GaussianBlur(large, None, 12)) < 0.5 * sharpness(large)
