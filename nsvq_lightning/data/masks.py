"""Where the masks of photos are."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from nsvq_lightning.data.colmap import ColmapImage, SceneError

__all__ = ["find_masks"]

log = logging.getLogger(__name__)


def find_masks(images: Sequence[ColmapImage], root: Path, folders: Sequence[str]) -> list[Path | None]:
    """The mask of each photo: the one that its model names, or the one of its name in a folder.

    Of ``cam/1.jpg`` that is ``cam/1.jpg.png`` (as COLMAP has it) or ``cam/1.png`` (as nerfstudio has it), with any
    suffix.

    Args:
        images: The photos.
        root: Scene folder.
        folders: Names of folders of masks in it; the first one that exists counts.

    Raises:
        SceneError: A mask that the model names does not exist.
    """
    folder = next((root / name for name in folders if (root / name).is_dir()), None)
    files = {} if folder is None else {
        path.relative_to(folder).with_suffix("").as_posix(): path
        for path in sorted(folder.rglob("*")) if path.is_file()
    }  # fmt: skip
    found = [
        image.mask or files.get(image.name) or files.get(Path(image.name).with_suffix("").as_posix())
        for image in images
    ]
    lost = [path for path in found if path is not None and not path.is_file()]
    if lost:
        raise SceneError(f"{len(lost)} masks do not exist, first {lost[0]}: copy them, or remove mask_path")
    if folder is not None and not any(found):
        name = Path(images[0].name)
        log.warning(
            "%s has no mask of any photo: that of %s would be %s.png or %s",
            folder, name, name, name.with_suffix(".png"),
        )  # fmt: skip
    return found
