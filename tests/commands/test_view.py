from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import chromium, needs_chromium
from splat_scenes import random_splats

from nsvq_lightning.commands.arguments import known_views
from nsvq_lightning.commands.main import main
from nsvq_lightning.commands.view import _Handler, _is_own, _Server
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import read_nsvq, save
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.precision import Precision, Storage
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.report import viewer


def _get(address: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(address, timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    return folder


def _photos(root: Path) -> dict[str, Camera]:
    scene = load_scene(root)
    return dict(zip(scene.names, scene.cameras, strict=True))


@pytest.fixture
def address(run: Path, demo_scene: Path) -> Iterator[str]:
    """A server that follows the run."""
    page = viewer.viewer_page(run / "scene.nsvq", _photos(demo_scene), "run", live=0.2)
    files = {"file": run / "scene.nsvq", "live": run / viewer.LIVE_SCENE}
    attributes = {"page": page.encode(), **files, "host": "127.0.0.1", "timeout": 0.5}
    with _Server(("127.0.0.1", 0), type("Handler", (_Handler,), attributes)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_run_that_cannot_be_asked_says_why(run: Path, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def ask_live(folder: Path) -> None:
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr(viewer, "ask_live", ask_live)
    status, text = _get(f"{address}/version")
    assert (status, text.startswith(b"the run cannot be asked: [Errno 13] Permission denied")) == (503, True)


def test_a_query_behind_the_address_changes_nothing(address: str) -> None:
    assert _get(f"{address}/?from=chat") == _get(f"{address}/")
    assert _get(f"{address}/version?now")[0] == 503
    assert _get(f"{address}/else?from=chat")[0] == 404


@pytest.mark.skipif(
    not hasattr(signal, "SIGHUP") or signal.getsignal(signal.SIGHUP) != signal.SIG_DFL,
    reason="terminals that are closed end nothing here",
)
@pytest.mark.parametrize("numbers", [["SIGTERM"], ["SIGHUP", "SIGHUP"]])
def test_the_end_of_a_terminal_leaves_no_file(tmp_path: Path, numbers: list[str]) -> None:
    """A .ply is shown as a copy in .nsvq; shell and system may both say that the terminal was closed."""
    save(random_splats(5), tmp_path / "scene.ply")
    (copies := tmp_path / "copies").mkdir()
    command = [sys.executable, "-m", "nsvq_lightning", "view", str(tmp_path / "scene.ply"), "--no-open", "--port=0"]
    environment = os.environ | {"TMPDIR": str(copies), "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert "http" in process.stdout.readline()
        assert list(copies.glob("*/scene.nsvq"))
        for number in numbers:
            process.send_signal(getattr(signal, number))
        assert process.wait(30) == -signal.SIGTERM
    assert not list(copies.glob("*"))


def test_a_running_fit_is_asked_until_its_scene_is_there(run: Path, address: str) -> None:
    assert not viewer.live_asked(run)
    assert _get(f"{address}/scene.nsvq") == (503, b"waiting for the run to show its splats")
    assert not viewer.live_asked(run)
    assert _get(f"{address}/version")[0] == 503
    first = viewer.live_asked(run)
    assert first
    save(random_splats(5), run / viewer.LIVE_SCENE, Storage("paper"))
    status, version = _get(f"{address}/version")
    assert status == 200
    assert viewer.live_asked(run) > first
    assert _get(f"{address}/scene.nsvq") == (200, (run / viewer.LIVE_SCENE).read_bytes())
    viewer.end_live(run)
    assert _get(f"{address}/version") == (503, b"the run trains no more; its scene is not there yet")
    save(random_splats(6), run / "scene.nsvq")
    status, last = _get(f"{address}/version")
    assert (status, last != version) == (200, True)
    assert not viewer.live_asked(run)
    assert _get(f"{address}/scene.nsvq") == (200, (run / "scene.nsvq").read_bytes())
    assert _get(f"{address}/")[1].startswith(b"<!doctype html>")
    assert _get(f"{address}/../secret")[0] == 404


@pytest.mark.parametrize(
    ("header", "bound", "is_own"),
    [
        ("localhost:7007", "127.0.0.1", True),
        ("127.0.0.1", "127.0.0.1", True),
        ("[::1]:7007", "127.0.0.1", True),
        ("box.lan:7007", "Box.lan", True),
        ("192.168.1.5:7007", "0.0.0.0", True),
        ("[fe80::1]", "::", True),
        ("192.168.1.5:7007", "127.0.0.1", False),
        ("evil.example:7007", "127.0.0.1", False),
        ("evil.example", "0.0.0.0", False),
        ("localhost.evil.example", "0.0.0.0", False),
        ("", "127.0.0.1", False),
        ("[", "0.0.0.0", False),
    ],
)
def test_only_the_names_of_the_server_are_served(header: str, bound: str, is_own: bool) -> None:
    assert _is_own(header, bound) is is_own


def test_a_page_of_another_name_gets_nothing(run: Path, address: str) -> None:
    save(random_splats(5), run / "scene.nsvq")
    for path in ("/", "/scene.nsvq", "/version"):
        request = urllib.request.Request(address + path, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request, timeout=10)


def test_connections_that_say_nothing_are_closed(address: str) -> None:
    with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])), timeout=10) as silent:
        assert silent.recv(1) == b""
    assert _get(f"{address}/")[0] == 200


def test_a_client_that_hangs_up_is_no_traceback(run: Path, address: str, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "scene.nsvq").write_bytes(bytes(20_000_000))
    client = socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])))
    client.sendall(b"GET /scene.nsvq HTTP/1.0\r\nHost: localhost\r\n\r\n")
    client.recv(10)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset
    client.close()
    time.sleep(0.3)
    assert _get(f"{address}/")[0] == 200
    assert capsys.readouterr().err == ""


@needs_chromium
def test_the_page_shows_each_version(run: Path, address: str, tmp_path: Path) -> None:
    save(random_splats(40, seed=1), run / viewer.LIVE_SCENE, Storage("paper"))
    with chromium(tmp_path / "profile") as tab:
        tab.open(address, 320, 240)
        tab.run("nsvqReady")
        first = tab.run("nsvqViewer.picture()")
        assert "40 splats" in tab.run("document.getElementById('facts').textContent")
        camera = tab.run("nsvqViewer.camera()")
        state = {"iteration": 40, "of": 90, "phase": "quantize", "psnr": "21.50"}
        scene = CompressedScene.from_splats(random_splats(55, seed=2), config={"live": state})
        save(scene, run / viewer.LIVE_SCENE, Storage("paper"))
        wait = """new Promise((resolve, reject) => {
            const seen = () => document.getElementById("facts").textContent.startsWith("55 splats");
            setInterval(() => seen() && nsvqViewer.camera(nsvqViewer.camera()).then(resolve), 50);
            setTimeout(() => reject(new Error("the new scene was not shown")), 20000);
        })"""
        tab.run(wait)
        assert tab.run("nsvqViewer.picture()") != first
        assert tab.run("nsvqViewer.camera()") == camera
        facts = tab.run("document.getElementById('facts').textContent")
        assert facts.endswith(" · iteration 40 of 90 · quantize · test PSNR 21.50 dB")
        save(random_splats(60, seed=2), run / "scene.nsvq")
        viewer.end_live(run)
        tab.run(wait.replace("55", "60"))
        assert tab.run("document.getElementById('facts').textContent").endswith(" MB · the run has ended")


def test_any_scene_becomes_one_page(tmp_path: Path, demo_scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(random_splats(30), tmp_path / "scene.ply")
    page = tmp_path / "out" / "page.html"
    assert main(["view", str(tmp_path / "scene.ply"), "-o", str(page), "--data.root", str(demo_scene)]) == 0
    assert f"{page}: {page.stat().st_size:,} bytes" in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert "view_000.png" in text
    assert "fetch(" not in text.split('<script id="decoder">')[1].partition("</script>")[2]
    assert main(["view", str(tmp_path / "scene.ply"), "-o", str(page)]) == 0
    assert "guess 1" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("finer", [1, 16])
def test_a_compact_scene_that_gets_cameras_makes_a_page_as_small_as_it_is(
    tmp_path: Path, demo_scene: Path, finer: int
) -> None:
    precision = Precision(**{name: value / finer for name, value in vars(Precision()).items()})
    save(random_splats(3000), tmp_path / "scene.nsvq", Storage("compact", precision))
    page = tmp_path / "page.html"
    sizes = []
    for options in ([], ["--data.root", str(demo_scene)]):
        assert main(["view", str(tmp_path / "scene.nsvq"), "-o", str(page), *options]) == 0
        sizes.append(page.stat().st_size)
    assert sizes[1] == pytest.approx(sizes[0], rel=0.03)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["gone.nsvq"], "there is no file or folder gone.nsvq"),
        (["no/run"], "there is no file or folder no/run"),
        (["."], "holds no scene.nsvq"),
        ([".", "--live"], "does not say where its photos"),
    ],
)
def test_errors_are_one_line(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["view", *arguments, "--no-open"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("nsvq view: ")
    assert words in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "words"),
    [("[1, 2]", "config.yaml holds list"), ("data: {", "is not YAML"), ("a: !!python/object:x.Y {}", "is not YAML")],
)
def test_a_config_that_cannot_be_read_is_told_and_names_no_photos(
    settings: str, words: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "config.yaml").write_text(settings)
    save(random_splats(30), tmp_path / "scene.ply")
    assert main(["view", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "page.html")]) == 0
    assert words in caplog.text
    assert "guess 1" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("settings", ["data: 3", "data: {init_args: [1]}", "data: {root: 5}", "model: {}"])
def test_a_config_of_something_else_names_no_photos(settings: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(settings)
    assert known_views(tmp_path / "scene.nsvq", None) == ({}, None)


def test_a_port_that_cannot_be_had_is_told(
    tmp_path: Path, demo_scene: Path, address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save(random_splats(3), tmp_path / "scene.nsvq")
    arguments = ["view", str(tmp_path / "scene.nsvq"), "--data.root", str(demo_scene), "--no-open"]
    for port in (address.rpartition(":")[2], "99999", "-1"):
        assert main([*arguments, f"--port={port}"]) == 1
        assert f"cannot listen on 127.0.0.1:{port}" in capsys.readouterr().err
    assert len(read_nsvq(tmp_path / "scene.nsvq")) == 3


def test_a_page_takes_the_place_of_no_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(random_splats(9), tmp_path / "scene.ply")
    before = (tmp_path / "scene.ply").read_bytes()
    with pytest.raises(SystemExit):
        main(["view", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "scene.ply")])
    assert "scene.ply: a page is named .html; nsvq convert writes scene files" in capsys.readouterr().err
    assert (tmp_path / "scene.ply").read_bytes() == before
