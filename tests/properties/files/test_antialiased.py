"""Files say whether a scene is to be rendered with anti-aliasing, or warn that they cannot."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from compressed_scenes import scene as coded
from viewer_scenes import WRITTEN

from nsvq_lightning.io.formats import read_scene, save


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize("antialiased", [False, True])
def test_files_keep_it_or_warn(
    suffix: str, antialiased: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = replace(coded(50), config={"antialiased": antialiased})
    save(scene, tmp_path / f"a{suffix}")
    keeps = suffix != ".splat"
    assert read_scene(tmp_path / f"a{suffix}").antialiased == (antialiased and keeps)
    assert ("switch it on in the viewer" in caplog.text) == (antialiased and not keeps)


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        ("comment SplatRenderMode: mip\ncomment antialiased 1\n", True),  # what is written
        ("comment splatrendermode: MIP\r\n", True),
        ("comment antialiased 1\n", True),
        ("comment antialiased 1\ncomment SplatRenderMode: default\n", False),  # the last one counts
        ("comment SplatRenderMode: 2dgs\n", False),
        ("comment not antialiased 1\ncomment antialiased\n", False),
    ],
)
def test_a_ply_says_it_in_comments(comments: str, expected: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    save(replace(coded(5), config={"antialiased": True}), path)
    written = b"comment SplatRenderMode: mip\ncomment antialiased 1\n"
    assert written in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(written, comments.encode()))
    assert read_scene(path).antialiased == expected


@pytest.mark.parametrize("key", ["model", "antialias"])
def test_a_sog_says_it_in_two_ways_of_which_one_is_enough(key: str, tmp_path: Path) -> None:
    save(replace(coded(5), config={"antialiased": True}), tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as old, zipfile.ZipFile(tmp_path / "b.sog", "w") as new:
        meta = json.loads(old.read("meta.json"))
        assert (meta["model"], meta.pop("antialias")) == ("antialiased", True) if key == "model" else meta.pop("model")
        new.writestr("meta.json", json.dumps(meta))
        for name in old.namelist()[1:]:
            new.writestr(name, old.read(name))
    assert key in meta
    assert read_scene(tmp_path / "b.sog").antialiased
