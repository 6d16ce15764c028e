"""Rendered views as PNG files, and as a video that browsers and players open."""

import logging
import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any
from unicodedata import normalize

import cv2
import numpy as np
import torch
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.data.images import encode_png
from nsvq_lightning.io.atomic import atomic_path, atomic_write

log = logging.getLogger(__name__)

# Bytes of a file name without suffix; file systems take 143 to 255 with it.
LONGEST = 120
# Suffix of videos.
VIDEO = ".mp4"


def file_stem(name: str, names: tuple[str, ...] = ()) -> str:
    """File name without suffix for a view: folders of its name become underscores.

    A name that is too long, or would be that of another view too where case makes no difference, ends in a digest.

    Args:
        name: Of the view.
        names: Of all views whose files go into one folder.
    """
    return _file_stems(names if name in names else (name,))[name]


@lru_cache(maxsize=8)
def _file_stems(names: tuple[str, ...]) -> dict[str, str]:
    """A file name without suffix for each name; those that are too long or used twice end in a digest."""
    plain = {name: str(Path(name).with_suffix("")).replace("/", "_").replace("\\", "_") for name in names}
    uses = Counter(map(_folded, plain.values()))
    stems = {}
    for name, stem in plain.items():
        data = stem.encode(errors="surrogateescape")
        if uses[_folded(stem)] > 1 or len(data) > LONGEST or re.search("~[0-9a-f]{12}$", _folded(stem)):
            ending = f"~{sha256(name.encode(errors='surrogateescape')).hexdigest()[:12]}"
            stem = data[: LONGEST - len(ending)].decode(errors="ignore") + ending
        stems[name] = stem
    return stems


def _folded(stem: str) -> str:
    """What file systems that do not tell case or composed characters apart make of a name."""
    return normalize("NFKC", normalize("NFKC", stem).casefold())


def comparison(image: Tensor, photo: Tensor, gain: float = 4.0) -> Tensor:
    """Photo, render and absolute error times ``gain``, side by side ``[H, 3·W, 3]``.

    Args:
        image: Rendered view ``[H, W, 3]`` in [0, 1].
        photo: Photo ``[H, W, 3]`` in [0, 1].
        gain: Factor that makes small errors visible.
    """
    return torch.cat([photo, image, ((image - photo).abs() * gain).clamp(max=1.0)], dim=1)


def as_bytes(image: Tensor) -> NDArray[np.uint8]:
    """An image ``[H, W, 3]`` in [0, 1] with 8 bits."""
    pixels: NDArray[np.uint8] = (image.clamp(0.0, 1.0) * 255).round().to(torch.uint8).cpu().numpy()
    return pixels


def write_png(path: Path, image: Tensor) -> None:
    """Write an RGB image ``[H, W, 3]`` in [0, 1] as 8-bit PNG, atomically.

    Raises:
        OSError: The image could not be encoded.
    """
    data = encode_png(as_bytes(image))
    with atomic_write(path) as file:
        file.write(data)


def log_pictures(loggers: Sequence[Logger], pictures: Sequence[Path], step: int) -> None:
    """Show PNG files in TensorBoard and Weights & Biases, as ``test/<file name>``; other loggers get none.

    Args:
        loggers: Loggers of a trainer.
        pictures: The files, 8-bit RGB.
        step: Iteration they belong to.
    """
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            names = [path.stem for path in pictures]
            logger.log_image("test/views", [str(path) for path in pictures], step, caption=names)
        elif isinstance(logger, TensorBoardLogger):
            for path in pictures:
                image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
                logger.experiment.add_image(f"test/{path.stem}", image, step, dataformats="HWC")


# Adds a picture ``[H, W, 3]``, RGB, to a video.
AddPicture = Callable[[NDArray[np.uint8]], Any]


@contextmanager
def video_writer(path: Path, width: int, height: int, fps: float) -> Iterator[AddPicture]:
    """Write a video atomically: it is there when the block, which gets the pictures, ends without an error.

    It is H.264 where the program ``ffmpeg`` is installed, which every player opens; otherwise VP9, which browsers and
    most players open.

    Args:
        path: File, ``.mp4``.
        width: Pixels, even.
        height: Pixels, even.
        fps: Frames per second.

    Raises:
        ValueError: An odd size.
        OSError: The video cannot be written.
    """
    if width % 2 or height % 2:
        raise ValueError(f"{path}: width and height of a video must be even, got {width}x{height}")
    # Both programs tell the container by the suffix, which the unfinished file does not have.
    with atomic_path(path) as unfinished, tempfile.TemporaryDirectory(dir=path.parent) as folder:
        file, program = Path(folder) / f"video{VIDEO}", shutil.which("ffmpeg")
        log.info("%s: %s", path, "H.264" if program else "VP9")
        with _h264(program, file, width, height, fps) if program else _vp9(file, width, height, fps) as add:
            yield add
        file.replace(unfinished)


@contextmanager
def _vp9(path: Path, width: int, height: int, fps: float) -> Iterator[AddPicture]:
    video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"vp09"), fps, (width, height))
    if not video.isOpened():
        raise OSError("OpenCV cannot write VP9 here: install ffmpeg, or write PNGs into a folder")
    try:
        yield lambda rgb: video.write(np.ascontiguousarray(rgb[:, :, ::-1]))
    finally:
        video.release()


@contextmanager
def _h264(program: str, path: Path, width: int, height: int, fps: float) -> Iterator[AddPicture]:
    command = [program, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", str(fps), "-i", "-", "-c:v", "libx264", "-crf", "17", "-pix_fmt", "yuv420p"]  # 17: nearly no loss
    command += ["-movflags", "+faststart", str(path)]
    broken = False
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        pipe = process.stdin
        assert pipe is not None
        try:
            yield lambda rgb: pipe.write(np.ascontiguousarray(rgb).data)
        except BrokenPipeError:  # what ffmpeg says is the cause
            broken = True
        except BaseException:
            process.kill()
            raise
        _, said = process.communicate()
    if broken or process.returncode:
        raise OSError(f"ffmpeg could not write the video: {said.decode(errors='replace').strip()}")
