"""PNG files of rendered views."""

import re
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from unicodedata import normalize

import cv2
import torch
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from torch import Tensor

from nsvq_lightning.data.images import encode_png
from nsvq_lightning.io.atomic import atomic_write

# Bytes of a file name without suffix; file systems take 143 to 255 with it.
LONGEST = 120


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


def write_png(path: Path, image: Tensor) -> None:
    """Write an RGB image ``[H, W, 3]`` in [0, 1] as 8-bit PNG, atomically.

    Raises:
        OSError: The image could not be encoded.
    """
    data = encode_png((image.clamp(0.0, 1.0) * 255).round().to(torch.uint8).cpu().numpy())
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
