"""Write pictures as a video that browsers and players open."""

import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.atomic import atomic_path

# Suffix of videos.
SUFFIX = ".mp4"


class VideoWriter(NamedTuple):
    """Takes the pictures of a video.

    Attributes:
        codec: Name of the video's codec.
        write: Adds a picture ``[H, W, 3]``, RGB.
    """

    codec: str
    write: Callable[[NDArray[np.uint8]], Any]


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
            with _h264(program, file, width, height, fps) if program else _vp9(file, width, height, fps) as writer:
                yield writer
            file.replace(unfinished)


@contextmanager
def _vp9(path: Path, width: int, height: int, fps: float) -> Iterator[VideoWriter]:
    video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"vp09"), fps, (width, height))
    if not video.isOpened():
        raise OSError("OpenCV cannot write VP9 here: install ffmpeg, or write PNGs into a folder")
    try:
        yield VideoWriter("VP9", lambda rgb: video.write(np.ascontiguousarray(rgb[:, :, ::-1])))
    finally:
        video.release()


@contextmanager
def _h264(program: str, path: Path, width: int, height: int, fps: float) -> Iterator[VideoWriter]:
    command = [program, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", str(fps), "-i", "-", "-c:v", "libx264", "-crf", "17", "-pix_fmt", "yuv420p"]  # 17: nearly no loss
    command += ["-movflags", "+faststart", str(path)]
    broken = False
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        pipe = process.stdin
        assert pipe is not None
        try:
            yield VideoWriter("H.264", lambda rgb: pipe.write(np.ascontiguousarray(rgb).data))
        except BrokenPipeError:  # what ffmpeg says is the cause
            broken = True
        except BaseException:
            process.kill()
            raise
        _, said = process.communicate()
    if broken or process.returncode:
        raise OSError(f"ffmpeg could not write the video: {said.decode(errors='replace').strip()}")
