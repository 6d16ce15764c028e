"""One HTML file that shows a compressed scene in any browser with WebGL 2, offline."""

import base64
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from nsvq_lightning.data.points import projected
from nsvq_lightning.data.scene import spread
from nsvq_lightning.io.atomic import StrPath, write_text
from nsvq_lightning.io.errors import Json
from nsvq_lightning.io.nsvq.file import read_nsvq
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.poses import up_of
from nsvq_lightning.splats.splats import SplatTensors

# File whose time of modification says when a viewer last asked.
REQUEST = "live.request"


# Most cameras of a page.
MAX_CAMERAS = 300


def write_viewer(path: StrPath, scene_file: StrPath, cameras: Mapping[str, Camera], title: str) -> int:
    """Write a page that holds a ``.nsvq`` file, its reader, a renderer and cameras; it loads nothing from elsewhere.

    It orbits about the direction that is up for the cameras (:func:`nsvq_lightning.rendering.poses.up_of`).

    Args:
        path: HTML file to write, replaced atomically.
        scene_file: The ``.nsvq`` file, of which the page holds every byte.
        cameras: At least one, by name, of which the page holds at most :data:`MAX_CAMERAS`, evenly spaced; it starts
            at the :func:`best_view`. They have the coordinates of the file's positions.
        title: Name of the scene, plain text.

    Returns:
        Bytes of the page.

    Raises:
        FormatError: ``scene_file`` is damaged or not a ``.nsvq`` file.
        ValueError: There are no cameras.
    """
    return write_text(path, viewer_page(scene_file, cameras, title))


def viewer_page(scene_file: StrPath, cameras: Mapping[str, Camera], title: str, live: float | None = None) -> str:
    """The page of :func:`write_viewer`; arguments and errors are the same.

    Args:
        scene_file: See there; with ``live``, it may be yet to come, and the page then starts at the first camera.
        cameras: See there.
        title: See there.
        live: None for a page that holds the file. Another one asks its server for ``scene.nsvq``, and after so many
            seconds for ``version`` again, to show a new one; 0 for never.
    """
    if not cameras:
        raise ValueError("a page needs at least one camera to start from, got none")
    cameras = dict(spread(list(cameras.items()), MAX_CAMERAS))
    views = list(cameras.values())
    about, start, behind = "", 0, (0.0, 0.0, 0.0)
    if live is None or Path(scene_file).is_file():
        stored = read_nsvq(scene_file)
        behind = stored.background
        about = f"{len(stored):,} splats, {(stored.stored_bytes or 0) / 1e6:.2f} MB. "
        start = best_view(stored.tensors(), views)
    if live is None:
        file = base64.b64encode(Path(scene_file).read_bytes()).decode()
        source = f'<script id="file" type="text/plain">{file}</script>'
        connect = ""
    else:
        source = f'<script data-seconds="{live}">\n{web_source("served.js")}</script>'
        connect = " connect-src 'self';"
    scene = {
        "cameras": [{"name": name, **camera_entry(camera)} for name, camera in cameras.items()],
        "background": behind,
        "up": up_of(views).tolist(),
        "near": float(min(camera.near for camera in views)),
        "start": start,
    }
    return fill(
        "viewer",
        title=escape(title.encode("utf-8", "replace").decode()),
        about=about,
        scene=script_json(scene),
        source=source,
        connect=connect,
        decoder=web_source("nsvq.js"),
    )


def best_view(splats: SplatTensors, cameras: Sequence[Camera]) -> int:
    """Place of the camera in whose picture most is: opaque splats and those near its middle count most.

    Where there is detail, there are many splats; what hides behind others counts, too. At most about 50 000 of the
    splats are looked at, evenly spaced.
    """
    means = spread(splats.means.detach(), 50_000).double().numpy()
    weights = spread(splats.opacities.detach(), 50_000).sigmoid().numpy()

    def shown(camera: Camera) -> float:
        column, row, depth = projected(means, camera.to("cpu"))
        across = 1 - np.abs(2 * column / camera.width - 1)
        down = 1 - np.abs(2 * row / camera.height - 1)
        return float((weights * (across.clip(0) * down.clip(0)))[depth > camera.near].sum())

    return max(range(len(cameras)), key=lambda place: shown(cameras[place]))


def camera_entry(camera: Camera) -> Json:
    """A camera as the page's JSON has it.

    Returns:
        ``camera_to_world``, 16 numbers row by row, of a camera that looks along -z with y up, as in OpenGL and
        nerfstudio; ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` in pixels.
    """
    right, down, forward, _, position = np.reshape(camera.packed_view, (5, 3))
    pose = [*np.stack([right, -down, -forward, position], axis=1).ravel(), 0.0, 0.0, 0.0, 1.0]
    return {"camera_to_world": [float(f"{value:.9g}") + 0.0 for value in pose], **lens_entry(camera)}


def lens_entry(camera: Camera) -> dict[str, float]:
    """Width, height, focal lengths and principal point of a camera in pixels, as JSON files have them."""
    lens = dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics, strict=True))
    return {"width": int(camera.width), "height": int(camera.height), **lens}


def write_cameras(path: Path, cameras: Mapping[str, Camera]) -> None:
    """Write cameras as INRIA's trainer lists them, which viewers read, with principal points and near planes."""
    entries = [
        {
            "id": number,
            "img_name": name,
            "position": camera.position.tolist(),
            "rotation": camera.viewmat[:3, :3].T.tolist(),
            **lens_entry(camera),
            "near": camera.near,
        }
        for number, (name, camera) in enumerate(cameras.items())
    ]
    write_text(path, json.dumps(entries))


def web_source(name: str) -> str:
    """Text of a file that pages are made of."""
    return files("nsvq_lightning.report").joinpath("web", name).read_text(encoding="utf-8")


def fill(page: str, **parts: str) -> str:
    """The page of this name, with its own style sheet and script, what all pages look like, and ``parts`` of it."""
    mark = web_source("mark.svg").strip()
    parts["css"] = web_source("look.css") + web_source(f"{page}.css")
    parts["script"] = web_source(f"{page}.js")
    parts["icon"] = data_address("svg+xml", mark.encode())
    parts["mark"] = mark.replace(' xmlns="http://www.w3.org/2000/svg"', "")  # HTML knows it
    return Template(web_source(f"{page}.html")).substitute(parts)


def data_address(kind: str, data: bytes) -> str:
    """The content of a picture file as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def script_json(value: Any) -> str:
    """JSON for a ``<script>``."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", r"\u003c")


# The splats of a running fit, while somebody looks.
LIVE_SCENE = "live.nsvq"


def ask_live(folder: Path) -> None:
    """Ask the fit that writes to a folder for its splats."""
    write_text(folder / REQUEST, "a viewer would like to see the splats of this run\n")


def live_asked(folder: Path) -> int:
    """When somebody last asked, as a number that changes with each time; 0 for never."""
    try:
        return (folder / REQUEST).stat().st_mtime_ns
    except OSError:
        return 0


def end_live(folder: Path) -> None:
    """Remove both files: the run has ended."""
    for name in (REQUEST, LIVE_SCENE):
        with suppress(OSError):  # Windows removes no file that somebody reads
            (folder / name).unlink(missing_ok=True)
