"""Render pictures or a video along a path of cameras.

SCENE is a scene file of any format, or the folder of a run. PATH is 'through' (smoothly through the
cameras of the photos), 'cameras' (just these), 'orbit' (around what they look at; also without photos), or a camera
path in nerfstudio's JSON, as the viewer saves it.

Examples:
  nsvq render runs/fox/version_0
  nsvq render scene.ply --path orbit --seconds 6 --size 1280x720 -o orbit.mp4
  nsvq render scene.nsvq --data.root scenes/fox --path cameras -o frames/
"""

import math
import re
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from dataclasses import replace
from pathlib import Path
from statistics import mode
from typing import TYPE_CHECKING

from tqdm import tqdm

from nsvq_lightning.commands import say
from nsvq_lightning.commands.arguments import add_root, positive, scene_file, scene_with_views
from nsvq_lightning.top_level import log

if TYPE_CHECKING:
    from nsvq_lightning.rendering.camera import Camera
    from nsvq_lightning.splats.splats import Splats

FPS = 24.0
SECONDS = 10.0


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq render`` takes."""
    add = parser.add_argument
    add("scene", type=Path, metavar="SCENE", help="file of any format that convert reads, or the folder of a run")
    help_ = ".mp4 file, or a folder for PNGs; by default render.mp4 beside the scene"
    add("-o", "--output", type=Path, metavar="OUT", help=help_)
    add_root(parser, "folder of the photos, whose cameras the path follows; that of the run by default")
    add("--path", help="through, cameras, orbit or a .json; through by default, orbit without photos")
    add("--size", type=_size, metavar="WxH", help="pixels; those of the cameras by default")
    length = parser.add_mutually_exclusive_group().add_argument
    length("--frames", type=positive(int), metavar="N", help="number of frames, of through and orbit")
    length("--seconds", type=positive(float), metavar="S", help=f"length instead; {SECONDS:g} by default")
    add("--fps", type=positive(float), metavar="F", help=f"frames per second; {FPS:g} by default")
    add("--background", type=_color, metavar="COLOR", help="black, white, or R,G,B in [0, 1]; the scene's by default")
    add("--backend", default="auto", metavar="NAME", help="auto, cpu, cuda or reference")


def _size(text: str) -> tuple[int, int]:
    if match := re.fullmatch(r"0*([1-9]\d*)x0*([1-9]\d*)", text.lower()):
        return int(match[1]), int(match[2])
    raise ArgumentTypeError(f"must be like 1280x720, got {text}")


def _color(text: str) -> tuple[float, ...]:
    named = {"black": "0,0,0", "white": "1,1,1"}
    try:
        values = tuple(map(float, named.get(text, text).split(",")))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(0 <= value <= 1 for value in values):
        raise ArgumentTypeError(f"must be black, white, or three numbers from 0 to 1 like 1,0.5,0, got {text}")
    return values


def run(options: Namespace) -> None:
    """Render a path.

    Raises:
        ValueError: The output is neither a video nor a folder, there are no cameras to follow, or no finite splats.
        OSError: A file cannot be read or written.
    """
    import torch

    from nsvq_lightning.compute.devices import best_device
    from nsvq_lightning.io.compressed import renderer
    from nsvq_lightning.io.formats import read_scene
    from nsvq_lightning.report.pictures import VIDEO, frame_writer

    file = scene_file(options.scene)
    output = options.output or file.with_name("render.mp4")
    is_video = output.suffix.lower() == VIDEO
    if output.suffix and not is_video and not output.is_dir():
        raise ValueError(f"{output}: name a video ({VIDEO}), or a folder for PNGs")
    scene, known, _ = scene_with_views(read_scene(file), file, options.root)
    splats = scene.decode()
    cameras, fps = _path(options, splats, known, is_video)
    raw = splats.to(best_device()).raw()
    behind = options.background or scene.background
    look = renderer(scene, background=behind, sampling=scene.sampling(), backend=options.backend)
    width, height = cameras[0].size
    with torch.no_grad(), frame_writer(output, width, height, fps) as write:
        for camera in tqdm(cameras, unit=" frames", mininterval=1):
            write(look(raw, camera).image)
    length = f", {len(cameras) / fps:.1f} s at {fps:g} frames per second" if is_video else ""
    say(f"{output}: {len(cameras)} frames of {width}x{height}{length}")


def _path(
    options: Namespace, splats: "Splats", cameras: "list[Camera]", is_video: bool
) -> "tuple[list[Camera], float]":
    """The cameras and frames per second that the options ask for, given those of the photos, if any are known."""
    from nsvq_lightning.compression.viewpoints import likely_cameras
    from nsvq_lightning.rendering.camera_paths import orbit, read_camera_path, reframed, smooth_path

    kind = options.path or ("through" if cameras else "orbit")
    fps = options.fps or FPS
    if kind not in ("through", "cameras", "orbit"):
        if not Path(kind).is_file():
            raise ValueError(f"--path {kind}: no such file; or name through, cameras or orbit")
        known = cameras or likely_cameras(splats, 1)  # of what the path does not say
        near, limits = min(camera.near for camera in known), known[0].slope_limits
        path, own = read_camera_path(Path(kind))
        cameras = [replace(camera, near=near, limits=limits) for camera in path]
        fps = options.fps or own
    elif not cameras:
        if kind != "orbit":
            raise ValueError(f"--path {kind} needs cameras of photos: name their folder (--data.root), or take orbit")
        log.info("no photos: cameras are guessed from the scene (-y is up); --data.root names their folder")
        cameras = likely_cameras(splats, 24)
    if kind not in ("through", "orbit") and (options.frames or options.seconds):
        raise ValueError(f"--frames and --seconds are for the paths through and orbit; {kind} has frames of its own")
    width, height = options.size or mode(camera.size for camera in cameras)
    if is_video and (width % 2 or height % 2):
        width, height = max(2, width - width % 2), max(2, height - height % 2)
        log.info(f"videos have even sides: {width}x{height}")
    cameras = [reframed(camera, width, height) for camera in cameras]
    frames = options.frames or max(1, round((options.seconds or SECONDS) * fps))
    if kind == "orbit":
        cameras = orbit(cameras, frames)
    elif kind == "through":
        every = min(3, math.ceil(len(cameras) / 2))  # photos are not evenly spaced
        cameras = smooth_path([*cameras[:-1:every], cameras[-1]], frames)
    return cameras, fps
