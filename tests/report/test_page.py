from __future__ import annotations

import base64
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from chromium import chromium, needs_chromium
from splat_scenes import random_splats

from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.report.numbers import evaluate
from nsvq_lightning.report.page import write_page
from nsvq_lightning.report.pictures import comparison, write_png
from nsvq_lightning.training.schedule import Phase, Schedule

SCHEDULE = Schedule(total=450)
VOID = {"meta", "img", "input", "link", "br"}
METRICS: dict[str, Any] = {
    "psnr": 31.25,
    "psnr_half": 32.5,
    "psnr_quarter": 33.0,
    "ssim": 0.9,
    "lpips": None,
    "num_splats": 1000,
    "file_bytes": 4000,
    "ratio": 41.5,
    "train_seconds": 90.0,
    "streams": {"header": 500, "means": 3500, "means.far": 0},
    "codes": {"quats": {"codebook": 64, "used": 40, "entropy": 5.125}},
}
VIEWS = [
    {"name": "a.jpg", "psnr": 30.0, "ssim": 0.8, "picture": "a.png"},
    {"name": "sub/<b>.jpg", "psnr": 32.5, "ssim": 1.0, "picture": "sub_<b>.png"},
]


def _entry(iteration: int, phase: str, psnr: float, seconds: float) -> dict[str, Any]:
    return {"iteration": iteration, "phase": phase, "splats": 1000, "psnr": psnr, "ssim": 0.5, "seconds": seconds}


HISTORY = [_entry(100, "warmup", 20.0, 5.0), _entry(150, "warmup", 21.0, 7.5), _entry(450, "finetune", 31.0, 67.5)]


class Tags(HTMLParser):
    """Checks that tags are closed in order; keeps addresses and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.words = ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.words += data + " "


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "a & <i>" / "version_0"
    (folder / "renders").mkdir(parents=True)
    photo = torch.zeros(30, 40, 3)
    photo[:, 20:] = torch.tensor([1.0, 0.0, 0.0])
    write_png(folder / "renders" / "a.png", comparison(torch.ones_like(photo), photo))
    write_png(folder / "renders" / "sub_<b>.png", comparison(photo, photo))
    (folder / "config.yaml").write_text("model: {note: '</pre><script>'}\n")
    return folder


def _picture(address: str) -> Any:
    kind, data = address.split(",", 1)
    assert kind in ("data:image/jpeg;base64", "data:image/png;base64")
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)


def test_page_of_a_finished_run_needs_no_other_file(run: Path) -> None:
    path = write_page(run, HISTORY, SCHEDULE, METRICS, VIEWS)
    text = path.read_text(encoding="utf-8")
    page = Tags(text)
    assert "http-equiv" not in text
    assert not re.search(r"https?://|url\(|@import", text)
    icon, *pictures = page.addresses
    assert base64.b64decode(icon.removeprefix("data:image/svg+xml;base64,")).startswith(b"<svg ")
    photo, render, error, *same = map(_picture, pictures)
    for picture, left, right in ((photo, (0, 0, 0), (0, 0, 255)), (render, (255,) * 3, (255,) * 3)):
        assert picture.shape == (30, 40, 3)
        assert np.abs(picture[15, 5].astype(int) - left).max() < 8
        assert np.abs(picture[15, 35].astype(int) - right).max() < 8
    assert np.abs(error[15, 35].astype(int) - (255, 255, 0)).max() < 8
    assert np.array_equal(same[0], same[1])
    assert same[2].max() < 8
    for words in ("a & <i> / version_0", "31.25 dB", "0.004 MB", "41.5 x", "a.jpg: 30.00 dB, SSIM 0.8000, the lowest"):
        assert words in page.words
    for words in ("sub/<b>.jpg: 32.50 dB", "model: {note: '</pre><script>'}"):
        assert words in page.words
    for row in (r"means +3,500 +28\.00", r"quats +64 +40 +5\.12", r"warmup +150 +7\.5 s +50\.0"):
        assert re.search(row, page.words)
    assert re.search(r"finetune +300 +1 min 0 s +200\.0", page.words)
    assert not re.search(r"means\.far", page.words)
    places = [text.index(words) for words in ("31.25 dB", 'class="views"', 'id="curve"', "<table>", "config.yaml")]
    assert places == sorted(places)
    curve = json.loads(text.split("const trained = ")[1].split(";</script>")[0])
    assert curve["history"] == [[100, 20.0, 1000], [150, 21.0, 1000], [450, 31.0, 1000]]
    assert curve["phases"] == [[phase.name.lower(), end] for phase, end in zip(Phase, SCHEDULE.ends, strict=True)]


@needs_chromium
def test_page_fits_a_phone_and_its_pictures_slide(run: Path, tmp_path: Path) -> None:
    history = [*HISTORY, _entry(451, "finetune", math.inf, 68.0)]
    path = write_page(run, history, SCHEDULE, METRICS, VIEWS)
    with chromium(tmp_path / "profile") as tab:
        tab.open(path.as_uri(), 390, 844, mobile=True)
        tab.run("new Promise(resolve => requestAnimationFrame(() => setTimeout(resolve)))")  # the curve is drawn
        assert tab.run("document.documentElement.scrollWidth") == 390
        assert tab.run("[...document.querySelectorAll('.scroll')].every(e => e.scrollWidth <= e.clientWidth)")
        words = tab.run("[...document.querySelectorAll('#curve text')].map(text => text.textContent)")
        assert {"warmup", "prune", "quantize", "finetune", "iteration", "test PSNR, dB", "splats"} <= set(words)
        assert tab.run("document.querySelectorAll('#curve circle').length") == len(HISTORY)
        tab.run("document.querySelector('.pair input').focus()")
        tab.send("Input.dispatchKeyEvent", type="keyDown", key="ArrowRight", windowsVirtualKeyCode=39)
        assert tab.run("document.querySelector('.pair').style.getPropertyValue('--cut')") == "51%"
        tab.run("document.querySelector('.pair').scrollIntoView({block: 'center'})")
        box = tab.run("document.querySelector('.pair').getBoundingClientRect().toJSON()")
        for kind in ("mousePressed", "mouseReleased"):
            place = {"x": box["x"] + box["width"] / 4, "y": box["y"] + box["height"] / 2}
            tab.send("Input.dispatchMouseEvent", type=kind, **place, button="left", buttons=1, clickCount=1)
        assert round(float(tab.run("document.querySelector('.pair').style.getPropertyValue('--cut')")[:-1])) == 25


def test_page_of_a_running_fit_shows_a_view_and_is_read_again(run: Path) -> None:
    write_png(run / "preview.png", torch.cat([torch.zeros(20, 1100, 3), torch.ones(20, 1100, 3)], dim=1))
    text = write_page(run, HISTORY[:2], SCHEDULE).read_text(encoding="utf-8")
    tags = Tags(text)
    assert '<meta http-equiv="refresh" content="5">' in text
    assert "150 of 450" in tags.words
    assert "21.00 dB" in tags.words
    preview = _picture(tags.addresses[1])
    assert preview.shape[1] == 1000
    assert preview[:, 450].max() < 8
    assert preview[:, 550].min() > 247


def test_a_measurement_waits_for_no_other_process(demo_scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A script may compress in one process of several: nobody else measures then."""

    def waits(*_: Any) -> None:
        raise AssertionError("the other processes never answer")

    scene = load_scene(demo_scene)
    views = [scene.view(index) for index in scene.test]
    torch.distributed.init_process_group("gloo", store=torch.distributed.HashStore(), rank=0, world_size=1)
    try:
        monkeypatch.setattr(torch.distributed, "all_reduce", waits)
        found = evaluate(render, random_splats(50), views)
        assert evaluate(render, random_splats(50), views, reduce=lambda sums: 2 * sums) == found
    finally:
        torch.distributed.destroy_process_group()


def test_of_many_views_the_page_has_the_lowest(run: Path) -> None:
    views = [VIEWS[0] | {"name": f"{number:03d}.jpg", "psnr": 20.0 + number % 53} for number in range(53)]
    text = write_page(run, HISTORY, SCHEDULE, METRICS, views).read_text()
    assert "The 50 lowest of 53" in text
    assert [f"{number:03d}.jpg" in text for number in (0, 49, 50, 52)] == [True, True, False, False]
    assert text.count(", the lowest") == 1


def test_a_picture_that_is_none_any_more_is_named(run: Path) -> None:
    (run / "renders" / "a.png").write_bytes(b"nothing")
    with pytest.raises(OSError, match=r"a\.png is not a picture any more; run 'nsvq test' again"):
        write_page(run, HISTORY, SCHEDULE, METRICS, VIEWS)
    assert not (run / "report.html").exists()
