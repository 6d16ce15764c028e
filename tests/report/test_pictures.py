from __future__ import annotations

import logging
import os
import re
import shutil
import tempfile
import unicodedata
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import pytest

from nsvq_lightning.report import pictures
from nsvq_lightning.report.pictures import file_stem, video_writer


def _pictures() -> list[np.ndarray[Any, Any]]:
    across, down = np.meshgrid(np.linspace(0, 200, 64), np.linspace(0, 200, 48))
    return [np.stack([across, down, np.full_like(down, 20.0 * k)], axis=2).astype(np.uint8) for k in range(10)]


def _frames(path: Path) -> list[np.ndarray[Any, Any]]:
    reader, frames = cv2.VideoCapture(str(path)), []
    assert reader.get(cv2.CAP_PROP_FPS) == 12
    while True:
        found, frame = reader.read()
        if not found:
            return frames
        frames.append(frame[:, :, ::-1].astype(float))


@pytest.fixture(params=["H.264", "VP9"])
def codec(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "VP9":
        monkeypatch.setattr(pictures.shutil, "which", lambda name: None)
    elif shutil.which("ffmpeg") is None:
        pytest.skip("ffmpeg is not installed")
    return str(request.param)


def test_pictures_come_back_from_the_video(tmp_path: Path, codec: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.mp4"
    with caplog.at_level(logging.INFO, "nsvq_lightning"), video_writer(path, 64, 48, 12.0) as add:
        for picture in _pictures():
            add(picture)
    assert caplog.messages == [f"{path}: {codec}"]
    frames = _frames(path)
    assert len(frames) == 10
    for frame, picture in zip(frames, _pictures(), strict=True):
        assert np.abs(frame - picture).mean() < 4
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_a_video_behind_a_link_is_made_where_that_leads(tmp_path: Path, codec: str) -> None:
    (tmp_path / "far:1").mkdir()
    (tmp_path / "a.mp4").symlink_to("far:1/b.mp4")
    with (
        mock.patch.object(pictures.tempfile, "TemporaryDirectory", wraps=tempfile.TemporaryDirectory) as made,
        video_writer(tmp_path / "a.mp4", 64, 48, 12.0) as add,
    ):
        add(_pictures()[0])
    assert made.call_args.kwargs["dir"] == tmp_path / "far:1"
    assert (tmp_path / "a.mp4").is_symlink()
    assert len(_frames(tmp_path / "far:1" / "b.mp4")) == 1


def test_what_opencv_could_not_write_is_no_video(tmp_path: Path, codec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a full disk, of which OpenCV says nothing."""
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")
    writer = cv2.VideoWriter
    frames = iter(range(3))

    class Full:
        fourcc = staticmethod(writer.fourcc)

        def __init__(self, *arguments: Any) -> None:
            self._writer = writer(*arguments)
            self.isOpened, self.release = self._writer.isOpened, self._writer.release

        def write(self, picture: np.ndarray) -> None:
            if next(frames, None) is not None:
                self._writer.write(picture)

    monkeypatch.setattr(cv2, "VideoWriter", Full)

    def written() -> None:
        with video_writer(path, 64, 48, 12.0) as add:
            for picture in _pictures():
                add(picture)

    with pytest.raises(OSError, match=r"a\.mp4 could not be written: has the disk room"):
        written()
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_an_error_leaves_the_old_video(tmp_path: Path, codec: str) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")

    def broken_off() -> None:
        with video_writer(path, 64, 48, 12.0) as add:
            add(_pictures()[0])
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        broken_off()
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_odd_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="even, got 63x48"), video_writer(tmp_path / "a.mp4", 63, 48, 12):
        pass
    assert not list(tmp_path.iterdir())


def test_what_ffmpeg_says_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho no such codec >&2\ncat > /dev/null\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(pictures.shutil, "which", lambda name: str(program))
    with (
        pytest.raises(OSError, match="could not write the video: no such codec"),
        video_writer(tmp_path / "a.mp4", 64, 48, 12) as add,
    ):
        add(_pictures()[0])
    assert not (tmp_path / "a.mp4").exists()


def test_files_of_different_views_differ_and_fit_any_file_system(tmp_path: Path) -> None:
    ordinary = ("view_000.png", "IMG 1.2.JPG", "left/é.jpg", "right/é.jpg")
    assert [file_stem(name, ordinary) for name in ordinary] == ["view_000", "IMG 1.2", "left_é", "right_é"]
    assert file_stem("a/b.png") == "a_b"  # of views that nobody has listed
    assert file_stem("C:\\me\\1.png") == "C__me_1"
    same = ("a/b.png", "a_b.png", "x.png", "x.jpg", "X.jpeg", "é.png", "e\u0301.png", "a/b.jpg~0123456789ab.png")
    deep = tuple("/".join(["ö" * 100] * 2 + [last]) for last in ("1.png", "2.png"))
    names = (*same, *deep, "y~0123456789ab.png", "z\udcff.png")
    stems = [file_stem(name, names) for name in names]
    assert len({unicodedata.normalize("NFC", stem).casefold() for stem in stems}) == len(names)
    for stem in stems:
        assert len(os.fsencode(stem)) <= 120
        (tmp_path / f"{stem}.png").touch()
    assert re.fullmatch("a_b~[0-9a-f]{12}", stems[0])
    assert len(list(tmp_path.iterdir())) == len(names)
