from __future__ import annotations

import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import ThreadingHTTPServer
from pathlib import Path

import pytest
from chromium import chromium, needs_chromium
from splat_scenes import random_splats

from nsvq_lightning.commands.main import main
from nsvq_lightning.commands.view import Source, _Handler
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import read_nsvq, save
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.report.viewer import some_cameras, viewer_page
from nsvq_lightning.training import live


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


@pytest.fixture
def address(run: Path, demo_scene: Path) -> Iterator[str]:
    """A server that follows the run."""
    page = viewer_page(some_cameras(load_scene(demo_scene)), "run", live=0.2).encode()
    handler = type("Handler", (_Handler,), {"page": page, "source": Source(run / "scene.nsvq", run)})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_running_fit_is_asked_until_its_scene_is_there(run: Path, address: str) -> None:
    assert not live.asked(run)
    assert _get(f"{address}/scene.nsvq") == (503, b"waiting for the run to show its splats")
    assert not live.asked(run)
    assert _get(f"{address}/version")[0] == 503
    first = live.asked(run)
    assert first
    save(random_splats(5), run / live.LIVE_SCENE, Storage("paper"))
    status, version = _get(f"{address}/version")
    assert status == 200
    assert live.asked(run) > first
    assert _get(f"{address}/scene.nsvq") == (200, (run / live.LIVE_SCENE).read_bytes())
    live.end(run)
    save(random_splats(6), run / "scene.nsvq")
    status, last = _get(f"{address}/version")
    assert (status, last != version) == (200, True)
    assert not live.asked(run)
    assert _get(f"{address}/scene.nsvq") == (200, (run / "scene.nsvq").read_bytes())
    assert _get(f"{address}/")[1].startswith(b"<!doctype html>")
    assert _get(f"{address}/../secret")[0] == 404


@needs_chromium
def test_the_page_shows_each_version(run: Path, address: str, tmp_path: Path) -> None:
    save(random_splats(40, seed=1), run / live.LIVE_SCENE, Storage("paper"))
    with chromium(tmp_path / "profile") as tab:
        tab.open(address, 320, 240)
        tab.run("nsvqReady")
        first = tab.run("nsvqViewer.picture()")
        assert "40 splats" in tab.run("document.getElementById('facts').textContent")
        camera = tab.run("nsvqViewer.camera()")
        save(random_splats(55, seed=2), run / live.LIVE_SCENE, Storage("paper"))
        wait = """new Promise((resolve, reject) => {
            const seen = () => document.getElementById("facts").textContent.startsWith("55 splats");
            setInterval(() => seen() && nsvqViewer.camera(nsvqViewer.camera()).then(resolve), 50);
            setTimeout(() => reject(new Error("the new scene was not shown")), 20000);
        })"""
        tab.run(wait)
        assert tab.run("nsvqViewer.picture()") != first
        assert tab.run("nsvqViewer.camera()") == camera


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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["gone.nsvq"], "gone.nsvq"), (["."], "holds no scene.nsvq"), ([".", "--live"], "does not say where its photos")],
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


def test_a_port_in_use_is_told(
    tmp_path: Path, demo_scene: Path, address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save(random_splats(3), tmp_path / "scene.nsvq")
    port = address.rpartition(":")[2]
    arguments = ["view", str(tmp_path / "scene.nsvq"), "--data.root", str(demo_scene), "--port", port, "--no-open"]
    assert main(arguments) == 1
    assert f"cannot listen on 127.0.0.1:{port}" in capsys.readouterr().err
    assert len(read_nsvq(tmp_path / "scene.nsvq")) == 3
