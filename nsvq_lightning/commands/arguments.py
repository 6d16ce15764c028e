"""What the arguments of commands stand for: lists, numbers, and scenes with the photos behind them."""

import math
import os
import re
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from nsvq_lightning.commands import nearest
from nsvq_lightning.commands.settings import check_config
from nsvq_lightning.top_level import log

if TYPE_CHECKING:
    from nsvq_lightning.data.scene import Scene
    from nsvq_lightning.io.compressed import CompressedScene
    from nsvq_lightning.rendering.camera import Camera

    # Cameras by the names of their photos, and these.
    Views = tuple[dict[str, Camera], Scene | None]


class Parser(ArgumentParser):
    """:class:`ArgumentParser` that names the option that a misspelt one resembles, and reads ``-1e-9``."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$|-inf$", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        """Write usage and message to stderr and exit with status 2."""
        super().error(message + unknown_option(message, self._option_string_actions))


def unknown_option(message: str, options: Iterable[str]) -> str:
    """The nearest option to the one that a parser's message says is unknown; empty if the message is another one."""
    found = re.search(r"unrecognized arguments: --([\w.-]+)|[Oo]ption '([\w.]+)'", message)
    if found is None:
        return ""
    unwanted = (".help", "+", "model.splats")
    known = [option for option in options if option.startswith("--") and not option.endswith(unwanted)]
    return nearest(f"--{found[1] or found[2]}", known)


def names(text: str) -> tuple[str, ...]:
    """The entries of ``A,B``, each once; an empty one if there is none."""
    return tuple(dict.fromkeys(filter(None, map(str.strip, text.split(","))))) or ("",)


def some_of(known: Iterable[str]) -> Callable[[str], tuple[str, ...]]:
    """A function that reads ``A,B``, of known names, or ``all`` of them.

    Raises:
        ArgumentTypeError: By the function: an entry is none of them.
    """

    def parse(text: str) -> tuple[str, ...]:
        chosen = tuple(known) if text == "all" else names(text)
        if not set(chosen) <= set(known):
            raise ArgumentTypeError(f"choose some of {', '.join(known)}, or all, got {text!r}")
        return chosen

    return parse


def integers(text: str) -> tuple[int, ...]:
    """The numbers of ``1,2``, each once.

    Raises:
        ArgumentTypeError: An entry is not a whole number.
    """
    try:
        return tuple(dict.fromkeys(map(int, text.split(","))))
    except ValueError:
        raise ArgumentTypeError(f"expected whole numbers with commas between them, got {text!r}") from None


def positive(kind: type[int] | type[float]) -> Callable[[str], int | float]:
    """A function that reads a number of this kind.

    Raises:
        ArgumentTypeError: By the function: it is not above 0, or not finite.
    """

    def parse(text: str) -> int | float:
        value = kind(text)
        if not 0 < value < math.inf:
            raise ArgumentTypeError(f"must be above 0, got {text}")
        return value

    parse.__name__ = kind.__name__  # argparse says "invalid float value"
    return parse


def add_root(parser: ArgumentParser, use: str) -> None:
    """Add ``--data.root``, a scene folder.

    Args:
        parser: That of a command.
        use: What the folder is for, as the help says it.
    """
    parser.add_argument("--data.root", dest="root", type=Path, metavar="FOLDER", help=use)


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
            runs = sorted(path.glob("version_*/scene.nsvq"), key=os.path.getmtime)
            newest = f", such as {runs[-1].parent}" if runs else ""
            raise ValueError(f"{path} holds no scene.nsvq: name a scene file, or the folder of a finished run{newest}")
        return file
    if path.suffix == ".ckpt":
        raise ValueError(f"{path} is a checkpoint; 'nsvq export --ckpt_path {path}' writes its scene as a file")
    return path


def _run_of(path: Path) -> Path:
    """The folder of a run, given that or a scene file in it."""
    return path if path.is_dir() else path.parent


def folders_beside(path: Path) -> list[Path]:
    """Where a trainer may have left the cameras of a scene file: in its folder, and up to two above."""
    run = _run_of(path).resolve()
    return [run, *run.parents][:3]


# Options of the data that say what is read of a scene folder.
READ = "factor", "max_width", "test_every", "images_folder", "model", "masks", "allow_outside"


def _found_views(path: Path, root: Path | None, origin: tuple[float, ...]) -> "Views":
    """Cameras by name of the photos that a scene was trained on, and these photos, if a folder of them is named.

    That is ``root``, or the one in the settings of the scene's run; photos of a run are those that it has trained on,
    in their size. Cameras that are found are those that a run has recorded, or those in the scene's folder or up to two
    above; those of a folder are relative to the scene's origin.
    """
    from nsvq_lightning.data.colmap import NoPhotosError, SceneError
    from nsvq_lightning.data.scene import load_cameras, load_scene
    from nsvq_lightning.data.transforms import has_poses
    from nsvq_lightning.rendering.camera_paths import CAMERAS, read_cameras

    data, folder = {}, root
    try:
        own = {**check_config(str(_run_of(path) / "config.yaml"))["data"]["init_args"]}
        given = Path(own["root"]).expanduser()
        if not root or given.resolve() == root.resolve():
            data, folder = own, given if given.is_dir() else None
    except (KeyError, TypeError):  # a config of something else
        pass
    except ValueError as error:
        log.warning(f"{error}")
    if folder and (has_poses(folder) or not (folder / CAMERAS).is_file()):
        how = {name: data[name] for name in READ if name in data} | {"origin": origin}
        try:
            scene = load_scene(folder, **how)
        except SceneError as error:
            if root and not isinstance(error, NoPhotosError):
                raise
            log.info(f"{folder} has cameras, but not all photos: {error}")
            return load_cameras(folder, **how), None
        return dict(zip(scene.names, scene.cameras, strict=True)), scene
    for place in [folder] if folder else folders_beside(path):
        is_list = (place / CAMERAS).is_file()
        if is_list or has_poses(place):
            log.info(f"{path}: its cameras are taken from {place}")
            return read_cameras(place / CAMERAS) if is_list else load_cameras(place, origin=origin), None
    return {}, None


def known_views(path: Path, root: Path | None, scene: "CompressedScene | None" = None) -> "Views":
    """Cameras by name of the photos that a scene was trained on, or that its run or trainer has left beside it.

    They are looked for as ``cameras.json``, of a run or of INRIA's trainer, as a COLMAP model or as a transforms file.

    Args:
        path: A scene file, or the folder of a run.
        root: Folder whose cameras they are instead; it needs no photos.
        scene: The scene, if it has been read: cameras that do not show it are not its own, which is a warning.

    Returns:
        The cameras, and the photos, if there are any.

    Raises:
        SceneError: The folder is not a scene.
        ValueError: What the run has recorded is damaged.
    """
    from nsvq_lightning.data.scene import check_cameras, check_colors

    cameras, photos = _found_views(path, root, scene.origin if scene else (0, 0, 0))
    try:
        if scene and cameras:
            check_cameras(list(cameras.values()), scene.means, None if root else scene.cameras)
            if photos and (root or not len(scene.cameras)):
                check_colors(photos, scene.means, scene.values("sh0"))
    except ValueError as error:
        log.warning(f"{path}: the cameras of {root or 'the folders beside it'} are not used: {error}")
        return {}, None
    return cameras, photos


def trained_scene(path: Path, root: Path | None) -> "CompressedScene":
    """A scene with the cameras of its training, where these are known: its own, or those of :func:`known_views`.

    What is damaged beside it is no use, which is a warning.

    Args:
        path: Scene file.
        root: Folder with the cameras of the photos that it was trained on.

    Raises:
        SceneError: The folder ``root`` is not a scene.
        FormatError: The scene is damaged.
    """
    from nsvq_lightning.io.formats import read_scene

    scene = read_scene(path)
    return scene if len(scene.cameras) else scene_with_views(scene, path, root)[0]


def scene_with_views(
    scene: "CompressedScene", path: Path, root: Path | None
) -> "tuple[CompressedScene, list[Camera], Scene | None]":
    """A scene that was read, as :func:`trained_scene` gives it, and what is known of its photos, looked for once.

    Of a run's ``scene.ply`` and the like, the ``scene.nsvq`` beside it says origin and background.

    Args:
        scene: The scene; cameras of its own stay.
        path: Its file.
        root: Folder with the cameras of the photos that it was trained on.

    Returns:
        The scene, the cameras that show it, and the photos; no cameras and None for what is not known.

    Raises:
        ValueError: The folder ``root`` is not a scene. What is damaged beside the file is a warning.
    """
    from nsvq_lightning.io.compressed import on_white
    from nsvq_lightning.io.nsvq.header import read_header
    from nsvq_lightning.rendering.camera_paths import arguments_of
    from nsvq_lightning.rendering.sampling import trained_by

    cameras, photos = [], None
    own = path.with_name("scene.nsvq")
    with suppress(ValueError, OSError):  # what other formats cannot say, the file of the run does if there is one
        if path.name.startswith("scene.") and path != own and (run := read_header(own)).splats == len(scene):
            origin = scene.origin if path.suffix == ".glb" else run.origin
            config = {"background": run.config.get("background", "black"), **scene.config}
            scene = replace(scene, origin=origin, config=config)
    try:
        known, photos = known_views(path, root, scene)
        cameras = list(known.values())
    except (ValueError, OSError) as error:
        if root:
            raise
        log.warning(f"{path}: the cameras of its training cannot be read ({error})")
    if cameras and not len(scene.cameras):
        trained = photos.train_cameras if photos else cameras
        said = f"those of {len(trained)} cameras, {trained[0].width} pixels wide, that it was trained by"
        log.info(f"{path}: blur and size are {said}")
        scene = replace(scene, cameras=trained_by(trained))
    arguments = "".join(map(arguments_of, folders_beside(path)))
    if (photos and photos.white) or re.search(r"white_background=True|\n  background: white\n", arguments):
        scene = on_white(scene)
    return scene, cameras, photos


def views_of(path: Path, scene: "CompressedScene", most: int, root: Path | None) -> "list[Camera]":
    """At most ``most`` views of a scene file in which its pictures count; those to train on, where photos are known.

    Args:
        path: The file.
        scene: N > 0 splats; where no cameras are known, views are those from where they show detail.
        most: Number of views.
        root: Folder of the cameras, with their photos or without.

    Raises:
        SceneError: The folder is not a scene.
    """
    from nsvq_lightning.compression.viewpoints import square_views
    from nsvq_lightning.data.scene import spread

    cameras, photos = known_views(path, root, scene)
    known = list(cameras.values()) if photos is None else photos.train_cameras
    return spread(known, most) or square_views(scene.tensors(), most)
