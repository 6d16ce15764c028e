"""Look at a scene in the browser, with the cameras of its photos.

Examples:
  nsvq view runs/fox/version_0
  nsvq view runs/fox/version_1 --live           a fit that is running
  nsvq view scene.ply --data.root scenes/fox    with the cameras of its photos
  nsvq view scene.nsvq -o scene.html            one file to send to somebody, no server
"""

import os
import sys
import webbrowser
from argparse import ArgumentError, ArgumentParser, Namespace
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from ipaddress import ip_address
from pathlib import Path
from shutil import copyfileobj
from socket import AF_INET, SOCK_DGRAM, socket
from tempfile import TemporaryDirectory
from threading import Thread
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from nsvq_lightning.commands import say
from nsvq_lightning.commands.arguments import add_root, known_views, scene_file, trained_scene
from nsvq_lightning.io.atomic import make_folder_of

if TYPE_CHECKING:
    from nsvq_lightning.rendering.camera import Camera


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq view`` takes."""
    add = parser.add_argument
    add("scene", type=Path, metavar="SCENE", help="file of any format that convert reads, or the folder of a run")
    add("--live", action="store_true", help="follow a fit that is running, given its folder")
    add_root(parser, "folder of the photos, whose cameras are offered; that of the run by default")
    add("-o", "--output", type=Path, metavar="OUT.html", help="write one page with the scene instead")
    add("--port", type=int, default=7007, help="%(default)s by default; 0 for any that is free")
    add("--host", default="127.0.0.1", help="127.0.0.1, this machine only, by default; 0.0.0.0 for all of the network")
    add("--no-open", dest="open", action="store_false", help="do not open the browser")


# Bytes of a scene, four characters of a page for three of them; V8 has strings of at most 2²⁹.
_LARGEST = 400_000_000


def run(options: Namespace) -> None:
    """Serve a scene until Ctrl-C, or write its page.

    Raises:
        ArgumentError: Options contradict each other.
        ValueError: The scene is empty, or it is not known where the photos of a running fit are.
        OSError: A file cannot be read or written, or the port is taken.
    """
    from nsvq_lightning.report.viewer import LIVE_SCENE, viewer_page, write_viewer

    if options.live and (options.output or not options.scene.is_dir()):
        raise ArgumentError(None, "--live follows a running fit: give the folder of the run, and no --output")
    if options.output and options.output.suffix.lower() not in (".html", ".htm"):
        raise ArgumentError(None, f"{options.output}: a page is named .html; nsvq convert writes scene files")
    path = options.scene.resolve()
    title = f"{path.parent.name} / {path.name}" if path.is_dir() else path.name
    with _nsvq_file(options) as file:
        if options.output and file.stat().st_size > _LARGEST:
            raise ValueError(f"{path}: browsers open no page so large: nsvq compress makes it smaller")
        cameras = _cameras(options, file)
        if options.output:
            make_folder_of(options.output)
            size = write_viewer(options.output, file, cameras, title)
            say(f"{options.output}: {size:,} bytes")
            return
        # Seconds between two looks.
        page = viewer_page(file, cameras, title, live=3.0 if options.live else 0.0).encode()
        live = options.scene / LIVE_SCENE if options.live else None
        handler = type("Handler", (_Handler,), {"page": page, "file": file, "live": live, "host": options.host})
        try:
            server = _Server((options.host, options.port), handler)
        except (OSError, OverflowError) as error:
            raise OSError(
                f"cannot listen on {options.host}:{options.port} ({error}); choose another --port or --host"
            ) from None
        with server:
            address = f"http://{options.host}:{server.server_port}/"
            say(f"{title} is at {address.replace('0.0.0.0', _own_address())} until Ctrl-C")
            if options.open:
                # A browser in this terminal returns when it is left.
                Thread(target=webbrowser.open, args=(address,), daemon=True).start()
            server.serve_forever()


@contextmanager
def _nsvq_file(options: Namespace) -> Iterator[Path]:
    """The scene that is meant, as a ``.nsvq`` file; that of a running fit is yet to come."""
    from nsvq_lightning.io.formats import save
    from nsvq_lightning.io.nsvq.header import read_header
    from nsvq_lightning.io.nsvq.precision import Storage

    file = options.scene / "scene.nsvq" if options.live else scene_file(options.scene)
    header = read_header(file) if file.suffix.lower() == ".nsvq" and not options.live else None
    # What has no cameras gets those of --data.root.
    if options.live or (header and (options.root is None or header.cameras)):
        yield file
        return
    with TemporaryDirectory() as folder:
        made = Path(folder) / "scene.nsvq"
        scene = trained_scene(file, options.root)
        # As small, and as exact, as it is.
        save(scene, made, Storage(header.level if header else "paper", Storage.told(scene.config).precision))
        yield made


def _cameras(options: Namespace, file: Path) -> "dict[str, Camera]":
    """Cameras of the photos, or guessed ones."""
    from nsvq_lightning.io.formats import read_scene

    scene = None if options.live else read_scene(file)
    cameras, _ = known_views(options.scene, options.root, scene)
    if cameras:
        return cameras
    if scene is None:
        raise ValueError(f"{options.scene} does not say where its photos are: name their folder with --data.root")
    from nsvq_lightning.compression.viewpoints import likely_cameras

    sys.stderr.write("no photos: cameras are guessed from the scene (-y is up); --data.root names their folder\n")
    return {f"guess {index}": camera for index, camera in enumerate(likely_cameras(scene.decode(), 8), 1)}


class _Server(ThreadingHTTPServer):
    """Says nothing of connections that break."""

    allow_reuse_address = os.name != "nt"  # where it would share the port with another view

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), OSError):  # a client that hangs up, or takes nothing any more
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Answers a browser.

    Attributes:
        file: A ``.nsvq`` file; that of a running fit is yet to come.
        live: File with the splats of a fit that is followed.
        timeout: Seconds after which a connection is closed on which nothing moves.
        followed: Whether splats of the running fit have been shown.
    """

    page: bytes
    file: Path
    live: Path | None
    host: str
    timeout = 20.0
    followed = False

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]  # messengers add a query to a link
        if not _is_own(self.headers.get("Host", ""), self.host):
            self._answer(403, b"open the address that nsvq view has printed")
        elif path == "/":
            self._answer(200, self.page, "text/html; charset=utf-8")
        elif path in ("/scene.nsvq", "/version"):
            self._scene(path == "/version")
        else:
            self._answer(404, b"there is no such page")

    def _scene(self, is_question: bool) -> None:
        from nsvq_lightning.report.viewer import ask_live, end_live

        if is_question and self.live:
            # What was asked of a run that has ended in between is taken back.
            ask = end_live if self.file.exists() else ask_live
            try:
                ask(self.live.parent)
            except OSError as error:  # a folder of somebody else, or a full disk
                self._answer(503, f"the run cannot be asked: {error}".encode())
                return
        file = self.live if self.live and self.live.is_file() else self.file
        try:
            if not file.is_file():
                message = b"waiting for the run to show its splats"
                if self.followed:
                    message = b"the run trains no more; its scene is not there yet"
                self._answer(503, message)
            elif is_question:
                self._answer(200, f"{file.name} {file.stat().st_mtime_ns}".encode())
            else:
                self._answer(200, file.read_bytes(), "application/octet-stream")
                type(self).followed = file != self.file
        except FileNotFoundError:  # the run has ended in between
            self._answer(503, b"the scene is being written")

    def _answer(self, status: int, content: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        # A slow client has the whole timeout for each part.
        copyfileobj(BytesIO(content), self.wfile, 1 << 16)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of each request."""


def _own_address() -> str:
    """The address that other machines of the network have for this one."""
    with suppress(OSError), socket(AF_INET, SOCK_DGRAM) as way:
        way.connect(("192.0.2.1", 9))  # sends nothing
        return str(way.getsockname()[0])
    return "0.0.0.0"


def _is_own(header: str, bound: str) -> bool:
    """Whether a request names this server: a web page could otherwise read the scene through a name of its own.

    Args:
        header: The request's Host.
        bound: The address or name that the server was told to listen on. On all addresses, each of them is its own.
    """
    try:
        name = urlsplit(f"//{header}").hostname or ""
        is_here = name in ("localhost", "127.0.0.1", "::1", bound.lower())
        return is_here or (bound in ("0.0.0.0", "::") and bool(ip_address(name)))
    except ValueError:
        return False
