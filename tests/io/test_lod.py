from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compressed_scenes import arrays_of
from viewer_scenes import coded_scene, nearest_in, plain_scene

from nsvq_lightning.io import FormatError, lod, read_scene, save
from nsvq_lightning.io.formats import describe


def leaves(node: dict[str, Any]) -> list[dict[str, Any]]:
    return [leaf for child in node["children"] for leaf in leaves(child)] if "children" in node else [node]


@pytest.fixture
def small_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lod, "LEAF", 100)
    monkeypatch.setattr(lod, "FILE", 300)


@pytest.mark.usefixtures("small_leaves")
@pytest.mark.parametrize("make", [plain_scene, coded_scene])
def test_each_level_has_all_its_splats_in_the_boxes_of_its_leaves(tmp_path: Path, make: Any) -> None:
    levels = [make(1000, 1), make(260, 1), plain_scene(30, 1)]
    path = tmp_path / "new" / "lod-meta.json"
    size = save(levels[0], path, coarser=levels[1:])
    assert size == sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())
    index = json.loads(path.read_text())
    assert (index["version"], index["count"], index["counts"], index["lodLevels"]) == (1, 1290, [1000, 260, 30], 3)
    found = leaves(index["tree"])
    assert len(found) >= 10
    for number, level in enumerate(levels):
        held = []
        for leaf in found:
            if (run := leaf["lods"].get(str(number))) is None:
                continue
            part = read_scene(path.parent / index["filenames"][run["file"]])
            assert len(part) <= 300
            means = part.means[run["offset"] : run["offset"] + run["count"]]
            assert (means >= leaf["bound"]["min"]).all()
            assert (means <= leaf["bound"]["max"]).all()
            held.append(means)
        expected, means = level.means, np.concatenate(held)
        assert len(means) == len(expected)
        assert len({int(np.abs(expected - row).sum(1).argmin()) for row in means}) == len(expected)
    nearest_in(arrays_of(read_scene(path)), arrays_of(levels[0]))
    facts = describe(path)
    assert (facts["splats"], facts["format"]) == (1000, "lod-meta.json")
    assert 0.5 * size < facts["bytes"] < size  # of the finest level


def test_an_index_of_the_first_writers_and_what_surrounds_a_scene(tmp_path: Path) -> None:
    path, scene, sky = tmp_path / "lod-meta.json", plain_scene(20, 1), plain_scene(8, 1, seed=1)
    save(scene, path, coarser=[plain_scene(7, 1).decode()])
    save(sky, tmp_path / "env.sog")
    index = json.loads(path.read_text())
    for name in ("version", "count", "counts"):
        del index[name]
    finest = index["filenames"][index["tree"]["lods"]["0"]["file"]]
    path.write_text(json.dumps(index | {"environment": None}))
    nearest_in(arrays_of(read_scene(path)), arrays_of(scene))
    path.write_text(json.dumps(index | {"environment": "env.sog"}))
    read = read_scene(path)
    assert read.stored_bytes == sum(
        file.stat().st_size for file in (path, tmp_path / "env.sog", *(tmp_path / finest).parent.iterdir())
    )
    nearest_in(arrays_of(read.take(np.arange(20))), arrays_of(scene))
    nearest_in(arrays_of(read.take(np.arange(20, 28))), arrays_of(sky))
    blurred = replace(sky, config={"antialiased": True})
    save(blurred, tmp_path / "env.sog")
    assert blurred.antialiased
    assert not read_scene(path).antialiased
    for file in tmp_path.rglob("*.*"):
        os.utime(file, (0, 0))  # as reproducible archives have it
    assert len(read_scene(path)) == 28
    path.write_text(json.dumps(index | {"environment": "../env.sog"}))
    with pytest.raises(FormatError, match=r"is no FOLDER/meta\.json or \.sog beside it"):
        read_scene(path)


def test_a_new_scene_takes_the_place_of_one_that_names_its_folders_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "lod-meta.json"
    save(plain_scene(20, 1), path)
    index = json.loads(path.read_text())
    (tmp_path / "mine").mkdir()
    path.write_text(json.dumps(index | {"filenames": [f"./{name}" for name in index["filenames"]]}))
    save(plain_scene(30, 1), path)
    assert len(read_scene(path)) == 30
    assert len(list(tmp_path.iterdir())) == 3  # the index, its one folder, and mine
    (tmp_path / "mine" / "meta.json").touch()
    path.write_text(json.dumps(index | {"asset": {"generator": "another"}, "filenames": ["mine/meta.json"]}))
    save(plain_scene(30, 1), path)
    assert (tmp_path / "mine" / "meta.json").exists()


def test_levels_of_other_origins_are_put_in_place(tmp_path: Path) -> None:
    scene, path = replace(plain_scene(20, 1), origin=(5e5, 4e6, 0.0)), tmp_path / "lod-meta.json"
    save(scene, path, coarser=[scene.take(np.arange(7)).relative_to((5e5 + 50, 4e6, 0.0))])
    bounds = json.loads(path.read_text())["tree"]["bound"]
    assert bounds["max"][0] - bounds["min"][0] < 1.5 * np.ptp(scene.means[:, 0])


def test_levels_that_are_not_read_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    path = tmp_path / "lod-meta.json"
    for coarser in ([], [plain_scene(7, 1)]):
        save(plain_scene(20, 1), path, coarser=coarser)
        caplog.clear()
        assert len(read_scene(path)) == 20
        assert ("coarser levels, 1 files, are not read" in caplog.text) == (len(coarser) == 1)


def test_levels_become_coarser(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"fewer splats than the one before it, got \[20, 20\]"):
        save(plain_scene(20, 1), tmp_path / "lod-meta.json", coarser=[plain_scene(20, 1)])
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_scene_and_a_new_one_its_own_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "lod-meta.json"
    save(plain_scene(20, 1), path, coarser=[plain_scene(7, 1)])
    (tmp_path / "mine").mkdir()
    before = read_scene(path)

    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(lod, "write_text", full)
    with pytest.raises(OSError, match="no space"):
        save(plain_scene(30, 1), path)
    np.testing.assert_array_equal(read_scene(path).means, before.means)
    monkeypatch.undo()
    save(plain_scene(30, 1), path)
    assert len(read_scene(path)) == 30
    assert len(list(tmp_path.iterdir())) == 3  # the index, its one folder, and mine


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda index: index["filenames"].__setitem__(0, "../meta.json"), "is no FOLDER/meta.json or .sog beside it"),
        (lambda index: index["filenames"].__setitem__(0, "/etc/meta.json"), "is no FOLDER/meta.json or .sog beside it"),
        (lambda index: index["filenames"].__setitem__(0, "gone/meta.json"), "incomplete: gone/meta.json is missing"),
        (lambda index: index.update(version=2), "version 2 of the format"),
        (lambda index: index["tree"]["lods"].clear(), "no leaf has splats of level 0"),
        (lambda index: index["tree"]["lods"]["0"].update(file=9), "not the index of a streamed SOG"),
        (lambda index: index.pop("tree"), "not the index of a streamed SOG"),
    ],
)
def test_a_damaged_index_is_told(tmp_path: Path, change: Any, message: str) -> None:
    path = tmp_path / "lod-meta.json"
    save(plain_scene(20, 1), path)
    index = json.loads(path.read_text())
    change(index)
    path.write_text(json.dumps(index))
    for read in (read_scene, describe):
        with pytest.raises(FormatError, match=message):
            read(path)
