"""Write pictures as a video that browsers and players open."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.atomic import atomic_path

__all__ = ["SUFFIX", "VideoWriter", "video_writer"]

SUFFIX = ".mp4"
"""Suffix of videos."""
X264_QUALITY = 17
"""Constant rate factor of H.264: nearly without visible loss."""


class VideoWriter(Protocol):
    """Takes the pictures of a video."""

    codec: str
    """Name of the video's codec."""

    def write(self, rgb: NDArray[np.uint8]) -> None:
        """Add a picture ``[H, W, 3]``, RGB."""


@contextmanager
def video_writer(path: Path, width: int, height: int, fps: float) -> Iterator[VideoWriter]:
    """Write a video atomically: it is there when the block ends without an error.

    It is H.264 where the program ``ffmpeg`` is installed, which every player opens; otherwise VP9, which browsers and
    most players open.

    Args:
        path: File, ``.mp4``.
        width: Pixels, even.
        height: Pixels, even.
        fps: Frames per second.

    Raises:
        ValueError: Another suffix, or an odd size.
        OSError: The video cannot be written.
    """
    if path.suffix.lower() != SUFFIX:
        raise ValueError(f"{path}: a video ends in {SUFFIX}")
    if width % 2 or height % 2:
        raise ValueError(f"{path}: width and height of a video must be even, got {width}x{height}")
    with atomic_path(path) as unfinished:
        program = shutil.which("ffmpeg")
        # Both tell the container by the suffix, which the unfinished file does not have.
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            file = Path(folder) / f"video{SUFFIX}"
            writer = _X264(program, file, width, height, fps) if program else _VP9(file, width, height, fps)
            try:
                yield writer
            except BaseException:
                writer.close(given_up=True)
                raise
            writer.close()
            file.replace(unfinished)


class _VP9:
    codec = "VP9"

    def __init__(self, path: Path, width: int, height: int, fps: float) -> None:
        code = cv2.VideoWriter.fourcc(*"vp09")
        self._writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, (width, height))
        if not self._writer.isOpened():
            raise OSError("OpenCV cannot write VP9 here: install ffmpeg, or write PNGs into a folder")

    def write(self, rgb: NDArray[np.uint8]) -> None:
        self._writer.write(np.ascontiguousarray(rgb[:, :, ::-1]))

    def close(self, given_up: bool = False) -> None:
        self._writer.release()


class _X264:
    codec = "H.264"

    def __init__(self, program: str, path: Path, width: int, height: int, fps: float) -> None:
        command = [program, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        command += ["-r", str(fps), "-i", "-", "-c:v", "libx264", "-crf", str(X264_QUALITY), "-pix_fmt", "yuv420p"]
        command += ["-movflags", "+faststart", str(path)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)

    def write(self, rgb: NDArray[np.uint8]) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(rgb).data)
        except BrokenPipeError:
            self.close()
            raise

    def close(self, given_up: bool = False) -> None:
        if given_up:
            self._process.kill()
        _, said = self._process.communicate()
        if self._process.returncode and not given_up:
            raise OSError(f"ffmpeg could not write the video: {said.decode(errors='replace').strip()}")
