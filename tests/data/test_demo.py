"""The demo scene of the package."""

import sys

import pytest

from nsvq_lightning.data.datamodule import DEMO, DemoDataModule


def test_the_demo_scene_is_small_and_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # which has no wheel for Linux on ARM64
    scene = DemoDataModule().scene
    assert (len(scene), len(scene.points)) == (40, 4000)
    assert {tuple(scene.view(index).image.shape) for index in range(40)} == {(240, 320, 3)}
    assert sum(path.stat().st_size for path in DEMO.rglob("*")) < 1_200_000
