"""The page that shows a scene: what is in it, and, in a browser, what it draws."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
import torch
from chromium import Page, PageError, chromium, needs_chromium
from PIL import Image
from splat_scenes import front_camera, random_splats

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.formats import read_scene, save
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.camera_paths import reframed
from nsvq_lightning.rendering.poses import up_of
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.rendering.sampling import focal_of
from nsvq_lightning.report import viewer
from nsvq_lightning.report.viewer import write_viewer
from nsvq_lightning.splats.splats import RawSplats

WEB = Path(viewer.__file__).parent / "web"
NASTY = '</title></script><script>alert(1)</script><img src="//x.y/$file" onerror=alert(2)> & <!--'
WHITE = {"background": "white"}
COLOR = (0.2, 0.4, 0.6)
DAMAGED = "The scene in this page is damaged"


class Parsed(HTMLParser):
    """Attributes and text of the elements of a page, in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None], str]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.elements:
            tag, attributes, text = self.elements[-1]
            self.elements[-1] = tag, attributes, text + data

    def text(self, tag: str, **attributes: str) -> str:
        (found,) = [text for name, has, text in self.elements if name == tag and attributes.items() <= has.items()]
        return found.strip("\n")


def _splats() -> RawSplats:
    """A quarter is quite opaque, an eighth large and faint."""
    splats = random_splats(600)
    splats.opacities[::4] = 9.0
    splats.scales[1::8] += 1.5
    splats.opacities[1::8] -= 2.0
    return splats


def _cameras() -> dict[str, Camera]:
    """The last one is amid the splats, its pictures have another shape, and its name is to be escaped."""
    K = torch.tensor([[70.0, 0, 33], [0, 80, 41], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    viewmat[:3, :3] *= torch.linalg.det(viewmat[:3, :3])
    viewmat[2, 3] = 0.8
    return {"front": front_camera(96, 64, cx=45.0, cy=34.5), NASTY: Camera(K, viewmat, 60, 90)}


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.nsvq"
    save(CompressedScene.from_splats(_splats(), config=WHITE), path)
    return path


@pytest.fixture(scope="module")
def page(scene_file: Path) -> Path:
    path = scene_file.with_name("viewer.html")
    size = write_viewer(path, scene_file, _cameras(), NASTY)
    assert size == path.stat().st_size
    return path


@pytest.fixture(scope="module")
def parsed(page: Path) -> Parsed:
    return Parsed(page.read_text(encoding="utf-8"))


def test_page_loads_nothing_and_may_load_nothing(page: Path, parsed: Parsed) -> None:
    for tag, attributes, _ in parsed.elements:
        assert tag not in {"iframe", "img", "object", "embed", "base", "form"}
        assert not {"src", "srcset", "action", "data"} & attributes.keys()
        assert (attributes.get("href") or "data:").startswith("data:")
    text = re.sub(r'<script id="(file|scene)".*?</script>', "", page.read_text(encoding="utf-8"), flags=re.S)
    text = re.sub(r'<(title|h1)>.*?</\1>|<meta property="og:title" content=".*?">', "", text)
    text = re.sub(r"(^|\s)//.*|^ \* .*", "", text, flags=re.M)  # comments
    assert not re.search(
        r"https?:|//\w+\.\w|fetch\(|XMLHttpRequest|WebSocket|importScripts|import\(|@import|url\(", text
    )
    (policy,) = [a["content"] for tag, a, _ in parsed.elements if tag == "meta" and "http-equiv" in a]
    assert (policy or "").startswith("default-src 'none';")


def test_page_holds_the_files_bytes(scene_file: Path, parsed: Parsed) -> None:
    assert base64.b64decode(parsed.text("script", id="file"), validate=True) == scene_file.read_bytes()


def test_cameras_are_exact_in_the_conventions_of_nerfstudio(parsed: Parsed) -> None:
    scene = json.loads(parsed.text("script", id="scene"))
    assert scene["background"] == [1, 1, 1]
    for (name, camera), entry in zip(_cameras().items(), scene["cameras"], strict=True):
        assert (entry["name"], entry["width"], entry["height"]) == (name, camera.width, camera.height)
        assert (entry["fx"], entry["fy"], entry["cx"], entry["cy"]) == camera.intrinsics
        to_world = torch.tensor(entry["camera_to_world"], dtype=torch.float64).view(4, 4)
        to_camera = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)) @ to_world.inverse()
        assert (to_camera - camera.viewmat).abs().max() < 1e-6
    assert scene["up"] == up_of(list(_cameras().values())).tolist()
    assert scene["start"] == 0


def test_the_best_view_has_the_splats_near_its_middle() -> None:
    away = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    front = front_camera(96, 64)
    turned = torch.eye(4)
    turned[:3, :3] = torch.tensor([[0.9, 0, -(0.19**0.5)], [0, 1, 0], [0.19**0.5, 0, 0.9]])
    poses = away @ front.viewmat, turned @ front.viewmat, front.viewmat
    cameras = [Camera(front.K, pose, front.width, front.height) for pose in poses]
    assert viewer.best_view(_splats(), cameras) == 2
    assert viewer.best_view(_splats(), cameras[:2]) == 1
    faint = _splats()._replace(opacities=torch.full((600,), -200.0))
    assert viewer.best_view(faint, cameras) == 0  # nothing to choose by


def test_the_page_says_what_it_is(parsed: Parsed, scene_file: Path) -> None:
    said = {a.get("name") or a.get("property"): a.get("content") for tag, a, _ in parsed.elements if tag == "meta"}
    assert said["og:title"] == parsed.text("title") == f"{NASTY}: a 3D scene"
    size = f"{scene_file.stat().st_size / 1e6:.2f} MB"
    assert said["description"] == said["og:description"] == f"600 splats, {size}. Gaussian splats to look around in."


def test_names_are_text_whatever_they_contain(parsed: Parsed) -> None:
    assert parsed.text("h1") == NASTY
    scripts = [(attributes.get("id"), text) for tag, attributes, text in parsed.elements if tag == "script"]
    assert [name for name, _ in scripts] == ["scene", "file", "decoder", None]
    sources = {name: (WEB / name).read_text(encoding="utf-8") for name in ("nsvq.js", "viewer.js", "viewer.css")}
    assert [text.strip() for _, text in scripts[2:]] == [sources[name].strip() for name in ("nsvq.js", "viewer.js")]
    for text in sources.values():
        assert not any(end in text.lower() for end in ("</script", "</style", "<!--"))


def test_a_page_without_a_camera_is_refused(tmp_path: Path, scene_file: Path) -> None:
    with pytest.raises(ValueError, match="at least one camera"):
        write_viewer(tmp_path / "page.html", scene_file, {}, "t")
    assert list(tmp_path.iterdir()) == []


def test_damaged_file_is_refused_and_the_old_page_stays(tmp_path: Path, scene_file: Path) -> None:
    damaged, old = tmp_path / "damaged.nsvq", tmp_path / "page.html"
    damaged.write_bytes(scene_file.read_bytes()[:-1])
    old.write_text("old")
    with pytest.raises(FormatError, match=r"damaged\.nsvq: truncated or altered"):
        write_viewer(old, damaged, _cameras(), "t")
    assert old.read_text() == "old"


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


@torch.no_grad()
def _psnr(tab: Page, scene_file: Path, camera: Camera, background: tuple[float, ...] | None = None) -> float:
    """PSNR in dB of what the page draws against this package's own picture, both of 8 bits."""
    picture = base64.b64decode(tab.run("nsvqViewer.picture()").split(",")[1])
    drawn, scene = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")), read_scene(scene_file)
    how = {"antialiased": scene.antialiased, "sampling": scene.sampling()}
    image = render(scene.decode(), camera, background=background or scene.background, **how).image
    expected = (image.clamp(0, 1) * 255).round().numpy()
    return float(10 * np.log10(255**2 / np.square(drawn - expected).mean()))


def _shown(tab: Page, page: str, width: int, height: int, script: str = "") -> None:
    """Open a page, after a script, and wait until it has drawn."""
    identifier = tab.send("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
    tab.open(page, width, height)
    try:
        tab.run("nsvqReady")
    finally:
        tab.send("Page.removeScriptToEvaluateOnNewDocument", identifier=identifier)


@needs_chromium
def test_anti_aliasing_is_what_the_file_says(tab: Page, tmp_path: Path) -> None:
    small = _splats()._replace(scales=_splats().scales - 2)
    for antialiased in (False, True):
        scene = CompressedScene.from_splats(small, config={"antialiased": antialiased})
        save(scene, tmp_path / f"{antialiased}.nsvq")
        page = tmp_path / "viewer.html"
        write_viewer(page, tmp_path / f"{antialiased}.nsvq", _cameras(), "t")
        text, found = re.subn(r'"background": ?\[0\.0, ?0\.0, ?0\.0\]', f'"background": {[*COLOR]}', page.read_text())
        assert found == 1
        page.write_text(text)
        camera = _cameras()["front"]
        _shown(tab, (tmp_path / "viewer.html").as_uri(), camera.width, camera.height)
        assert _psnr(tab, tmp_path / f"{antialiased}.nsvq", camera, COLOR) > 55
        assert _psnr(tab, tmp_path / "False.nsvq", camera, COLOR) > 55 or antialiased
    assert _psnr(tab, tmp_path / "False.nsvq", camera, COLOR) < 40


@needs_chromium
@pytest.mark.parametrize("times", [0.5, 1.0, 2.0])
def test_blur_has_the_size_of_training(tab: Page, tmp_path: Path, times: float) -> None:
    """At other sizes, and from nearer and farther than the cameras of training."""
    camera = _cameras()["front"]
    focal, x, y, z = focal_of(camera), *camera.packed_view[12:]
    small = CompressedScene.from_splats(_splats()._replace(scales=_splats().scales - 1), config=WHITE)
    save(small, tmp_path / "plain.nsvq")
    stretch = torch.diag(torch.tensor([times, times, 1.0]))
    enlarged = Camera(stretch @ camera.K, camera.viewmat, int(96 * times), int(64 * times))
    for shift in (0.0, -1.5, 4.0):
        scene = replace(small, cameras=np.array([[x, y, z + shift, focal]]))
        save(scene, tmp_path / "scene.nsvq")
        write_viewer(tmp_path / "viewer.html", tmp_path / "scene.nsvq", {"front": camera}, "t")
        _shown(tab, (tmp_path / "viewer.html").as_uri(), enlarged.width, enlarged.height)
        assert _psnr(tab, tmp_path / "scene.nsvq", enlarged) > 48
        same = times == 1 and shift == 0
        assert same or _psnr(tab, tmp_path / "plain.nsvq", enlarged) < 44


@needs_chromium
@pytest.mark.parametrize("workers", [True, False])
def test_browser_draws_what_the_package_renders(tab: Page, page: Path, scene_file: Path, workers: bool) -> None:
    camera = _cameras()["front"]
    _shown(tab, page.as_uri(), camera.width, camera.height, "" if workers else "delete window.Worker")
    assert _psnr(tab, scene_file, camera) > 57
    assert tab.run("document.getElementById('message').hidden && document.getElementById('facts').textContent") == (
        f"600 splats · {scene_file.stat().st_size / 1e6:.2f} MB"
    )
    urls = [event["params"]["request"]["url"] for event in tab.events if event["method"] == "Network.requestWillBeSent"]
    assert {url.split(":")[0] for url in urls} <= {"file", "blob"}


@needs_chromium
def test_a_wide_window_shows_a_photo_of_portrait_shape_as_it_was_trained(
    tab: Page, tmp_path: Path, scene_file: Path
) -> None:
    camera = front_camera(64, 96)
    write_viewer(tmp_path / "viewer.html", scene_file, {"front": camera}, "t")
    wide = reframed(camera, 240, 96)
    _shown(tab, (tmp_path / "viewer.html").as_uri(), wide.width, wide.height)
    assert _psnr(tab, scene_file, wide) > 55
    assert _psnr(tab, scene_file, replace(wide, limits=())) < 45


@needs_chromium
def test_address_names_a_camera_and_tools_move_it(tab: Page, page: Path, scene_file: Path) -> None:
    name, camera = list(_cameras().items())[1]
    tab.open("about:blank", camera.width, camera.height)  # or the browser would only scroll
    _shown(tab, f"{page.as_uri()}#camera={quote(name, safe='')}", camera.width, camera.height)
    assert _psnr(tab, scene_file, camera) > 57
    front = _cameras()["front"]
    tab.run(f"nsvqViewer.camera({json.dumps(viewer.camera_entry(front))})")
    seen = tab.run("nsvqViewer.camera()")
    assert np.allclose(seen["camera_to_world"], viewer.camera_entry(front)["camera_to_world"])
    # The whole frame is in the window: 96 pixels of it in 60.
    assert seen["fx"] == pytest.approx(front.intrinsics[0] * 60 / 96)
    assert (seen["width"], seen["height"]) == (60, 90)


@needs_chromium
def test_keys_move_however_short_they_are_pressed(tab: Page, page: Path) -> None:
    _shown(tab, page.as_uri(), 97, 64)
    before = np.array(tab.run("nsvqViewer.camera()")["camera_to_world"])
    # both before the next picture
    tab.run("for (const type of ['keydown', 'keyup']) dispatchEvent(new KeyboardEvent(type, { key: 'd' })); true")
    moved = np.array(tab.run("nsvqViewer.camera()")["camera_to_world"]) - before
    assert np.abs(moved).max() > 1e-3


@needs_chromium
def test_the_list_of_cameras_keeps_the_keyboard(tab: Page, page: Path) -> None:
    _shown(tab, page.as_uri(), 97, 64)
    choose = "cameras.selectedIndex = {}; cameras.dispatchEvent(new Event('change')); document.activeElement.id"
    tab.run("globalThis.cameras = document.getElementById('cameras'); cameras.focus(); true")
    assert [tab.run(choose.format(index)) for index in (1, 2)] == ["cameras", "cameras"]
    tab.run("cameras.dispatchEvent(new Event('pointerdown')); true")
    assert tab.run(choose.format(0)) == "canvas"


@needs_chromium
def test_a_graphics_device_that_comes_back_shows_the_same(tab: Page, page: Path) -> None:
    _shown(tab, page.as_uri(), 97, 64)
    drawn = "nsvqViewer.camera(nsvqViewer.camera()).then(nsvqViewer.picture)"
    before = tab.run(drawn)
    for name in ("canvas", "message"):
        tab.run(f"globalThis.{name} = document.getElementById('{name}'); true")
    tab.run(
        "globalThis.device = canvas.getContext('webgl2').getExtension('WEBGL_lose_context'); device.loseContext(); 1"
    )
    words = "new Promise((resolve) => setTimeout(resolve, 300)).then(() => message.hidden ? '' : message.textContent)"
    assert "taken away" in tab.run(words)
    assert tab.run(f"device.restoreContext(); {words}") == ""
    assert tab.run(drawn) == before


@needs_chromium
def test_keyframes_become_a_camera_path(tab: Page, page: Path) -> None:
    _shown(tab, page.as_uri(), 97, 64)
    poses = []
    for key in "kfk":
        tab.send("Input.dispatchKeyEvent", type="keyDown", key=key)
        tab.send("Input.dispatchKeyEvent", type="keyUp", key=key)
        poses.append(tab.run("nsvqViewer.camera()"))
    path = tab.run("nsvqViewer.path()")
    frames = path.pop("camera_path")
    assert path == {
        "camera_type": "perspective", "render_height": 64, "render_width": 96, "fps": 24, "seconds": len(frames) / 24
    }  # fmt: skip
    for frame, pose in ((frames[0], poses[0]), (frames[-1], poses[2])):
        assert np.allclose(frame["camera_to_world"], pose["camera_to_world"], atol=1e-6)
        assert frame["fov"] == pytest.approx(np.degrees(2 * np.arctan(32 / pose["fy"])))
        assert frame["aspect"] == pytest.approx(97 / 64)
    for frame in frames:
        rotation = np.array(frame["camera_to_world"]).reshape(4, 4)[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1)


@needs_chromium
def test_a_slow_device_sorts_what_shows_most(tab: Page, page: Path) -> None:
    """Oracle: numpy."""
    _shown(tab, page.as_uri(), 97, 64)
    draws = np.random.default_rng(3)
    means, scales, opacities = draws.normal(size=(50, 3)), draws.uniform(0.1, 2, (50, 3)), draws.uniform(0, 1, 50)
    floats = {"means": means, "scales": scales, "opacities": opacities}
    given = ", ".join(f"{name}: Float32Array.from({values.ravel().tolist()})" for name, values in floats.items())
    for share in (1, 0.3):
        some = round(50 * share)
        order = tab.run(f"Array.from(makeSorter({{count: 50, {given}}})([0.6, 0, 0.8], {share}))")
        area = np.sort(scales, axis=1)[:, 1:].prod(1)
        shown = np.argsort(-opacities * area)[:some]
        depths = means[shown] @ [0.6, 0, 0.8]
        assert order[:some] == shown[np.argsort(-depths)].tolist()
        assert order[some:] == [some] * (2048 - some) if share == 1 else set(order[some:]) == {50}


@needs_chromium
def test_a_drag_orbits_what_is_in_front_and_reset_returns(tab: Page, scene_file: Path, tmp_path: Path) -> None:
    page = tmp_path / "upright.html"
    write_viewer(page, scene_file, {"front": _cameras()["front"]}, "t")
    _shown(tab, page.as_uri(), 400, 300)
    start = tab.run("nsvqViewer.camera()")
    for kind, x in (("mousePressed", 200), ("mouseMoved", 230), ("mouseReleased", 230)):
        tab.send("Input.dispatchMouseEvent", type=kind, x=x, y=100, button="left", buttons=1, clickCount=1)
    seen = tab.run("nsvqViewer.camera()")
    before, after = (np.array(camera["camera_to_world"]).reshape(4, 4) for camera in (start, seen))
    assert np.abs(after - before).max() > 0.1
    assert (after[:3, 3] - before[:3, 3]) @ before[:3, 0] < 0  # the scene follows the hand: the camera goes left
    tab.run("document.getElementById('reset').click()")
    assert tab.run("nsvqViewer.camera()") == start


@needs_chromium
def test_it_orbits_until_somebody_takes_over(tab: Page, page: Path) -> None:
    tab.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "no-preference"}])
    # The position at every frame, without a call that would end the orbit.
    spy = "const seen = []; const draw = Renderer.prototype.draw; Renderer.prototype.draw = "
    spy += "function (view, ...rest) { seen.push(view.position[0]); draw.call(this, view, ...rest); }; seen"
    wait = "new Promise(resolve => setTimeout(resolve, %d))"
    try:
        _shown(tab, page.as_uri(), 96, 64)
        tab.run(spy)
        tab.run(wait % 2500)
        assert len(set(tab.run("seen"))) > 3
        tab.send("Input.dispatchKeyEvent", type="keyDown", key="Shift")
        tab.run(wait % 1000)
        drawn = tab.run("seen.length")
        tab.run(wait % 500)
        assert tab.run("seen.length") == drawn
        tab.open("about:blank", 96, 64)
        _shown(tab, f"{page.as_uri()}#camera=front", 96, 64)
        tab.run(spy)
        tab.run(wait % 2000)
        assert tab.run("seen") == []
    finally:
        tab.send("Emulation.setEmulatedMedia", features=[])


@needs_chromium
def test_a_page_says_how_to_embed_it(tab: Page, page: Path) -> None:
    _shown(tab, page.as_uri(), 400, 300)
    tab.run("document.getElementById('embed').click()")
    said = tab.run("document.getElementById('message').textContent")
    (frame,) = Parsed(said[said.index("<") :]).elements
    assert frame[1]["src"] == "viewer.html"
    assert frame[1]["title"] == f"{NASTY}: a 3D scene"
    tab.send("Input.dispatchKeyEvent", type="keyDown", key="Escape")
    assert tab.run("document.getElementById('message').hidden")


@needs_chromium
@pytest.mark.parametrize(
    ("script", "change", "message"),
    [
        ("", lambda file: file[:100] + ("A" if file[100] != "A" else "B") + file[101:], DAMAGED),
        ("", lambda file: file[:1000] + "!" + file[1000:], DAMAGED),
        ("delete window.WebGL2RenderingContext", lambda file: file, "no WebGL 2"),
        ("HTMLCanvasElement.prototype.getContext = () => null", lambda file: file, "no WebGL 2"),
    ],
)
def test_a_page_that_cannot_show_says_why(
    tab: Page, page: Path, parsed: Parsed, tmp_path: Path, script: str, change: Callable[[str], str], message: str
) -> None:
    file = parsed.text("script", id="file")
    broken = tmp_path / "broken.html"
    broken.write_text(page.read_text(encoding="utf-8").replace(file, change(file)), encoding="utf-8")
    with pytest.raises(PageError, match=message):
        _shown(tab, broken.as_uri(), 300, 200, script)
    assert message in tab.run("document.getElementById('message').textContent")
