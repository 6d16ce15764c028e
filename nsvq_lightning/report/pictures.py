"""PNG files of rendered views."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from nsvq_lightning.data.images import encode_png
from nsvq_lightning.io.atomic import atomic_write

__all__ = ["comparison", "file_stem", "write_png"]


def file_stem(name: str) -> str:
    """File name without suffix for a view: folders of its name become underscores."""
    return str(Path(name).with_suffix("")).replace("/", "_").replace("\\", "_")


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
