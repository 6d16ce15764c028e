from __future__ import annotations

import json
from pathlib import Path

import pytest
from splat_scenes import random_splats

from nsvq_lightning.commands.arguments import cameras_of, views_of

ENTRY = {"img_name": "a", "width": 8, "height": 6, "fx": 7, "fy": 7, "position": [0, 0, -3]}
ENTRY["rotation"] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize("above", range(4))
def test_cameras_of_inrias_trainer_lie_up_to_two_folders_above_the_scene(tmp_path: Path, above: int) -> None:
    scene = tmp_path / "run" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    scene.parent.mkdir(parents=True)
    (scene.parents[above] / "cameras.json").write_text(json.dumps([ENTRY]))
    assert list(cameras_of(scene, None)) == ["a"] * (above < 3)
    if above < 3:
        views, photos = views_of(scene, random_splats(9), 5, None)
        assert ([(view.width, view.height) for view in views], photos) == ([(8, 6)], None)
        assert views[0].position.tolist() == [0, 0, -3]


def test_no_cameras_are_found_where_there_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert cameras_of(Path("scene.ply"), None) == {}
    Path("cameras.json").write_text("[{}]")
    with pytest.raises(ValueError, match=r"cameras\.json is no list of cameras as INRIA's trainer writes it"):
        cameras_of(Path("scene.ply"), None)
