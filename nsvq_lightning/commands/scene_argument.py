"""The argument SCENE of commands that look at a scene: a file, or the folder of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nsvq_lightning.commands.configs import check_config

if TYPE_CHECKING:
    from nsvq_lightning.rendering.camera import Camera

__all__ = ["cameras_of", "photos_of", "scene_file"]


def scene_file(path: Path) -> Path:
    """The scene file that is meant.

    Raises:
        FileNotFoundError: There is nothing of that name.
        ValueError: It is a folder without ``scene.nsvq``, or a checkpoint.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no file or folder {path}")
    if path.is_dir():
        file = path / "scene.nsvq"
        if not file.is_file():
            raise ValueError(f"{path} holds no scene.nsvq: name a scene file, or the folder of a finished run")
        return file
    if path.suffix == ".ckpt":
        raise ValueError(f"{path} is a checkpoint; 'nsvq export --ckpt_path {path}' writes its scene as a file")
    return path


def photos_of(path: Path) -> Path | None:
    """Folder of the photos that a scene was trained on, as the run that it lies in says; None if nothing says it.

    Raises:
        ValueError: Beside it is a ``config.yaml`` that is no table of settings.
    """
    config = (path if path.is_dir() else path.parent) / "config.yaml"
    if not config.is_file():
        return None
    data = check_config(str(config)).get("data")
    data = data.get("init_args", data) if isinstance(data, dict) else None
    root = data.get("root") if isinstance(data, dict) else None
    return Path(root) if isinstance(root, str) and Path(root).is_dir() else None


def cameras_of(path: Path) -> dict[str, Camera]:
    """Cameras by name that the run has recorded that a scene lies in, for when its photos are gone; none without it.

    Raises:
        ValueError: Its ``viewer.html`` is damaged.
    """
    from nsvq_lightning.report.viewer import page_cameras

    page = (path if path.is_dir() else path.parent) / "viewer.html"
    return page_cameras(page) if page.is_file() else {}
