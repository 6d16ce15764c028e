"""What a run shows: pictures of its views, and videos, under names that every file system has."""

import os
import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

import cv2
import torch
from torch import Tensor

from nsvq_lightning.data.images import read_image, write_pixels
from nsvq_lightning.io.atomic import atomic_path, make_folder_of
from nsvq_lightning.splats.conventions import Uint8s
from nsvq_lightning.top_level import log

if TYPE_CHECKING:
    from lightning.pytorch.loggers import Logger

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
    plain = {name: re.sub(r"[/\\:]", "_", str(Path(name).with_suffix(""))) for name in names}
    # What file systems that do not tell case or composed characters apart make of them.
    folded = {name: normalize("NFKC", normalize("NFKC", stem).casefold()) for name, stem in plain.items()}
    uses = Counter(folded.values())
    stems = {}
    for name, stem in plain.items():
        if uses[folded[name]] > 1 or len(os.fsencode(stem)) > LONGEST or "~" in folded[name]:
            stem = f"{stem[: LONGEST // 5]}~{sha256(os.fsencode(name)).hexdigest()[:12]}"
        stems[name] = stem
    return stems


def comparison(image: Tensor, photo: Tensor) -> Tensor:
    """Photo, render and four times the absolute error, so that small ones show, side by side ``[H, 3·W, 3]``.

    Args:
        image: Rendered view ``[H, W, 3]`` in [0, 1].
        photo: Photo ``[H, W, 3]`` in [0, 1].
    """
    return torch.cat([photo, image, ((image - photo).abs() * 4).clamp(max=1.0)], dim=1)


def as_bytes(image: Tensor) -> Uint8s:
    """An image ``[H, W, 3]`` in [0, 1] with 8 bits."""
    return (image.clamp(0.0, 1.0) * 255).round().byte().numpy(force=True)


def write_png(path: Path, image: Tensor) -> None:
    """Write an RGB image ``[H, W, 3]`` in [0, 1] as 8-bit PNG, atomically, and make its folder."""
    write_pixels(path, as_bytes(image)[..., ::-1])


def log_pictures(loggers: "Sequence[Logger]", pictures: Sequence[Path], step: int) -> None:
    """Show PNG files in TensorBoard and Weights & Biases, as ``test/<file name>``; other loggers get none.

    Args:
        loggers: Loggers of a trainer.
        pictures: The files, 8-bit RGB.
        step: Iteration they belong to.
    """
    from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger  # slow to import

    for logger in loggers:
        if isinstance(logger, WandbLogger):
            names = [path.stem for path in pictures]
            logger.log_image("test/views", [str(path) for path in pictures], step, caption=names)
        elif isinstance(logger, TensorBoardLogger):
            for path in pictures:
                logger.experiment.add_image(f"test/{path.stem}", read_image(path), step, dataformats="HWC")


@contextmanager
def video_writer(path: Path, width: int, height: int, fps: float) -> Iterator[Callable[[Uint8s], Any]]:
    """Write a video atomically: it is there when the block ends without an error.

    The block gets a function that adds a picture ``[H, W, 3]``, RGB.

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
    program = shutil.which("ffmpeg")
    log.info(f"{path}: {'H.264' if program else 'VP9'}")
    # Both programs tell the container by the suffix, which the unfinished file does not have.
    with atomic_path(path) as unfinished, tempfile.TemporaryDirectory(dir=unfinished.parent, prefix=".") as folder:
        file = Path(folder) / f"video{VIDEO}"
        first = file.with_suffix(".avi") if program else file  # from which ffmpeg makes the other
        code = "FFV1" if program else "vp09"
        video = cv2.VideoWriter(str(first), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), fps, (width, height))
        if not video.isOpened():
            raise OSError(f"OpenCV cannot write {code} here: write PNGs into a folder")
        frames = []
        try:
            yield lambda rgb: frames.append(video.write(rgb[:, :, ::-1]))
        finally:
            video.release()
        # OpenCV itself says nothing where it could not write.
        if cv2.VideoCapture(str(first)).get(cv2.CAP_PROP_FRAME_COUNT) < len(frames):
            raise OSError(f"{path} could not be written: has the disk room for it?")
        if program:
            options = ["-c:v", "libx264", "-crf", "17", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
            command = [program, "-loglevel", "error", "-i", str(first), *options, str(file)]
            ended = subprocess.run(command, capture_output=True, check=False, stdin=subprocess.DEVNULL)
            if ended.returncode:
                raise OSError(f"ffmpeg could not write the video: {ended.stderr.decode(errors='replace').strip()}")
        file.replace(unfinished)


@contextmanager
def frame_writer(path: Path, width: int, height: int, fps: float) -> Iterator[Callable[[Tensor], object]]:
    """Write frames ``[H, W, 3]`` in [0, 1] into a video (:func:`video_writer`), or as PNGs into a folder.

    Args:
        path: A folder if it has no suffix.
        width: Pixels.
        height: Pixels.
        fps: Frames per second.
    """
    if path.suffix and not path.is_dir():
        make_folder_of(path)
        with video_writer(path, width, height, fps) as add:
            yield lambda picture: add(as_bytes(picture))
    else:
        names = (path / f"{index:05d}.png" for index in count())
        yield lambda picture: write_png(next(names), picture)
        if (older := next(names)).exists():
            log.warning(f"{older}, and what may follow, are frames of an earlier render")
