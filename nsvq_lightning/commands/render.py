"""``nsvq render``: pictures or a video along a path of cameras."""

from __future__ import annotations

import argparse
import logging
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsvq_lightning.commands.arguments import Parser, cameras_of, names, photos_of, positive, scene_file
from nsvq_lightning.commands.progress import progress

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from nsvq_lightning.rendering.camera import Camera
    from nsvq_lightning.rendering.rasterize import Render
    from nsvq_lightning.splats.splats import Splats

__all__ = ["main"]

log = logging.getLogger(__name__)

PATHS = ("through", "cameras", "orbit")
WHAT = ("color", "depth", "alpha")
FPS = 24.0
SECONDS = 10.0
PASSED = 3
"""The path through the cameras of photos passes every so manieth: photos are not evenly spaced."""
LIKELY = 24
"""Cameras that are guessed for a scene without photos."""
MEASURED = 8
"""Frames that the range of the depth's colours is taken from."""
UNIT = 1000
"""Steps of a scene unit in a 16-bit picture of the depth."""

EPILOG = """\
SCENE is a .nsvq, .ply, .sog, .spz or .splat file, or the folder of a run. PATH is 'through' (smoothly through the
cameras of the photos), 'cameras' (just these), 'orbit' (around what they look at; also without photos), or a camera
path in nerfstudio's JSON, as the viewer saves it.

examples:
  nsvq render runs/fox/version_0
  nsvq render scene.ply --path orbit --seconds 6 --size 1280x720 -o orbit.mp4
  nsvq render scene.nsvq --data.root scenes/fox --path cameras -o frames/ --what color,depth
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Render a path.

    Args:
        argv: Arguments after ``nsvq render``; those of the process if None.

    Returns:
        0, or 1 after an error in the user's files. Wrong arguments end the process with status 2.
    """
    parser = _parser()
    options = parser.parse_args(argv)
    if options.frames is not None and options.seconds is not None:
        parser.error("--frames and --seconds say the same: give one of them")
    if not options.what or not set(options.what) <= set(WHAT):
        parser.error(f"--what takes {', '.join(WHAT)}, with commas, got {','.join(options.what)!r}")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("nsvq_lightning").setLevel(logging.INFO)
    try:
        _render(options)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"nsvq render: {error}\n")
        return 1
    return 0


def _render(options: argparse.Namespace) -> None:
    import torch

    from nsvq_lightning.io.formats import read_scene
    from nsvq_lightning.rendering.rasterize import render
    from nsvq_lightning.report.video import SUFFIX

    file = scene_file(options.scene)
    output = options.output or file.with_name("render.mp4")
    suffix = output.suffix.lower()
    if suffix not in ("", SUFFIX):
        raise ValueError(f"{output}: name a video ({SUFFIX}), or a folder for PNGs")
    scene = read_scene(file)
    splats = scene.decode()
    if len(splats) == 0:
        raise ValueError(f"{file} holds no splat; there is nothing to render")
    cameras, fps = _path(options, splats, is_video=bool(suffix))
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    raw, background = splats.to(device).raw(), torch.tensor(options.background, device=device)

    @torch.no_grad()
    def look(camera: Camera) -> Render:
        return render(raw, camera, background=background, antialiased=scene.antialiased, backend=options.backend)

    pictures = _pictures(options.what, look, cameras)
    first = cameras[0]
    with ExitStack() as stack:
        writers = {
            name: stack.enter_context(_writer(path, name, first.width, first.height, fps))
            for name, path in _outputs(output, options.what).items()
        }
        for index, camera in enumerate(progress(cameras, "frames")):
            view = look(camera)
            for name, write in writers.items():
                write(index, *pictures[name](view))
    size = f"{first.width}x{first.height}"
    for name, path in _outputs(output, options.what).items():
        length = f", {len(cameras) / fps:.1f} s at {fps:g} frames per second" if suffix else ""
        sys.stdout.write(f"{path}: {len(cameras)} frames of {size}, {name}{length}\n")


def _path(options: argparse.Namespace, splats: Splats, is_video: bool) -> tuple[list[Camera], float]:
    """The cameras and frames per second that the options ask for."""
    from nsvq_lightning.compression.viewpoints import likely_cameras
    from nsvq_lightning.data.scene import load_scene
    from nsvq_lightning.rendering.camera_path import orbit, read_camera_path, reframed, smooth_path

    fps = options.fps or FPS
    frames = options.frames or max(1, round((options.seconds or SECONDS) * fps))
    root = options.root or photos_of(options.scene)
    recorded = list(cameras_of(options.scene).values()) if root is None else []
    kind = options.path or ("through" if root is not None or recorded else "orbit")
    if kind not in PATHS:
        cameras, own = read_camera_path(Path(kind))
        fps = options.fps or own
        width, height = _size(options, cameras[0], is_video)
        return [reframed(camera, width, height) for camera in cameras], fps
    if root is not None:
        given = list(load_scene(root).cameras)
    elif recorded:
        given = recorded
    elif kind == "orbit":
        log.info("no photos: their cameras are guessed from the scene; --data.root names the folder of the photos")
        given = likely_cameras(splats, LIKELY)
    else:
        raise ValueError(
            f"--path {kind} needs the cameras of photos: name their folder with --data.root, or take orbit"
        )
    width, height = _size(options, given[0], is_video)
    given = [reframed(camera, width, height) for camera in given]
    if kind == "cameras":
        return given, fps
    if kind == "orbit":
        return orbit(given, frames), fps
    every = min(PASSED, math.ceil(len(given) / 2))
    return smooth_path([*given[:-1:every], given[-1]], frames), fps


def _size(options: argparse.Namespace, camera: Camera, is_video: bool) -> tuple[int, int]:
    """Width and height in pixels; those of a video are even."""
    width, height = options.size or (camera.width, camera.height)
    if is_video and (width % 2 or height % 2):
        width, height = max(2, width - width % 2), max(2, height - height % 2)
        log.info("videos have even sides: %dx%d", width, height)
    return width, height


def _outputs(output: Path, names: Sequence[str]) -> dict[str, Path]:
    """File or folder of each kind of picture: the first has the name that was given."""
    return {name: output if name == names[0] else output.with_stem(f"{output.stem}_{name}") for name in names}


def _pictures(
    names: Sequence[str], look: Callable[[Camera], Render], cameras: Sequence[Camera]
) -> dict[str, Callable[[Render], tuple[NDArray[np.uint8], Any]]]:
    """Functions that make an RGB picture of a render, and of the depth also one of 16 bits."""
    import cv2
    import numpy as np

    def color(view: Render) -> tuple[NDArray[np.uint8], None]:
        return _bytes(view.image.cpu().numpy()), None

    def alpha(view: Render) -> tuple[NDArray[np.uint8], None]:
        return np.repeat(_bytes(view.alpha.cpu().numpy())[:, :, None], 3, axis=2), None

    def distances(view: Render) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Mean depth of the pixels, scene units, and where there is one."""
        opacity = view.alpha.cpu().numpy()
        return view.depth.cpu().numpy() / np.maximum(opacity, 1e-6), opacity >= 0.5

    near, far = 1.0, 2.0
    if "depth" in names:
        chosen = cameras[:: -(-len(cameras) // MEASURED)]
        seen = np.concatenate([found[where] for found, where in map(distances, map(look, chosen))])
        if len(seen):
            near, far = (float(value) for value in np.quantile(seen, [0.01, 0.99]))
            log.info("colours of the depth: red %.3g, blue %.3g scene units", near, far)

    def depth(view: Render) -> tuple[NDArray[np.uint8], Any]:
        found, where = distances(view)
        closeness = (1 / np.clip(found, near, far) - 1 / far) / max(1 / near - 1 / far, 1e-9)
        shades = cv2.applyColorMap(_bytes(closeness), cv2.COLORMAP_TURBO)[:, :, ::-1]
        steps = np.clip(np.rint(found * UNIT), 1, 65535).astype(np.uint16)
        return np.where(where[:, :, None], shades, 0).astype(np.uint8), np.where(where, steps, 0).astype(np.uint16)

    return {"color": color, "alpha": alpha, "depth": depth}


def _bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Values in [0, 1] as 8 bits."""
    import numpy as np

    bytes_: NDArray[np.uint8] = np.rint(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)
    return bytes_


@contextmanager
def _writer(path: Path, name: str, width: int, height: int, fps: float) -> Iterator[Callable[..., None]]:
    """A function that writes the picture of a frame, and its 16-bit form into folders."""
    from nsvq_lightning.data.images import encode_png
    from nsvq_lightning.io.atomic import atomic_write
    from nsvq_lightning.report.video import video_writer

    if path.suffix:
        path.parent.mkdir(parents=True, exist_ok=True)
        with video_writer(path, width, height, fps) as video:
            log.info("%s: %s, %s", path, name, video.codec)
            yield lambda index, picture, _: video.write(picture)
        return
    path.mkdir(parents=True, exist_ok=True)

    def write(index: int, picture: NDArray[np.uint8], steps: Any) -> None:
        import cv2

        with atomic_write(path / f"{index:05d}.png") as file:
            file.write(encode_png(picture))
        if steps is not None:
            with atomic_write(path / f"{index:05d}_16bit.png") as file:
                file.write(cv2.imencode(".png", steps)[1].tobytes())

    yield write


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsvq render",
        description="Render pictures or a video along a path of cameras.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene file, or the folder of a run")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT",
        help=".mp4 file, or a folder for PNGs; by default render.mp4 beside the scene",
    )
    parser.add_argument(
        "--data.root",
        dest="root",
        type=Path,
        metavar="FOLDER",
        help="folder of the photos, whose cameras the path follows; that of the run by default",
    )
    parser.add_argument(
        "--path", metavar="PATH", help="through, cameras, orbit or a .json; through by default, orbit without photos"
    )
    parser.add_argument(
        "--what",
        type=names,
        default=("color",),
        metavar="NAMES",
        help=f"of {', '.join(WHAT)}, with commas; color by default. PNGs of the depth are also written with 16 bits, "
        f"{UNIT} steps a scene unit",
    )
    parser.add_argument("--size", type=_size_argument, metavar="WxH", help="pixels; those of the cameras by default")
    parser.add_argument("--frames", type=positive(int), metavar="N", help="number of frames, of through and orbit")
    parser.add_argument("--seconds", type=positive(float), metavar="S", help=f"length instead; {SECONDS:g} by default")
    parser.add_argument("--fps", type=positive(float), metavar="F", help=f"frames per second; {FPS:g} by default")
    parser.add_argument(
        "--background",
        type=_color,
        default=(0.0, 0.0, 0.0),
        metavar="COLOR",
        help="black, white, or R,G,B in [0, 1]",
    )
    parser.add_argument("--backend", default="auto", metavar="NAME", help="auto, cpu, cuda or reference")
    return parser


def _size_argument(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise argparse.ArgumentTypeError(f"must be like 1280x720, got {text}")
    return int(width), int(height)


def _color(text: str) -> tuple[float, ...]:
    if text in ("black", "white"):
        return (float(text == "white"),) * 3
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(0 <= value <= 1 for value in values):
        raise argparse.ArgumentTypeError(f"must be black, white, or three numbers from 0 to 1 like 1,0.5,0, got {text}")
    return values
