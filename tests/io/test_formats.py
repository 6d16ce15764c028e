from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch

from nsvq_lightning import Splats, load, save
from nsvq_lightning.io import FormatError, plain_ply_bytes, read_nsvq
from nsvq_lightning.random import generator


def scene(n: int, degree: int) -> Splats:
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, (degree + 1) ** 2 - 1, 3))
    return Splats.from_tensors(*(torch.randn(s, generator=generator(1, i)) for i, s in enumerate(shapes)))


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("suffix", [".ply", ".nsvq", ".PLY"])
def test_save_then_load_is_exact(tmp_path: Path, suffix: str, degree: int) -> None:
    splats, path = scene(20, degree), tmp_path / f"x{suffix}"
    options = {"level": "paper"} if suffix == ".nsvq" else {}
    assert save(splats, path, **options) == path.stat().st_size
    back = load(str(path))
    for name, values in splats.attributes().items():
        assert torch.equal(getattr(back, name), values)


def test_options_reach_the_format(tmp_path: Path) -> None:
    splats = scene(20, 3)
    assert save(splats, tmp_path / "x.ply", normals=False) == plain_ply_bytes(20, 3, normals=False)
    save(splats.raw(), tmp_path / "x.nsvq", config={"seed": 1}, metrics={"psnr": 30.0})
    assert read_nsvq(tmp_path / "x.nsvq").config == {"seed": 1}
    with pytest.raises(TypeError, match="normals"):
        save(splats, tmp_path / "x.nsvq", normals=False)


def test_unknown_suffix_lists_what_is_supported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'\.obj'; supported are \.ply .*\.nsvq"):
        save(scene(1, 0), tmp_path / "x.obj")
    with pytest.raises(ValueError, match=r"cannot read .*unknown suffix ''"):
        load(tmp_path / "x")


def test_wrong_content_is_named(tmp_path: Path) -> None:
    save(scene(1, 0), tmp_path / "x.ply")
    (tmp_path / "x.ply").rename(tmp_path / "x.nsvq")
    with pytest.raises(FormatError, match=r"x\.nsvq: not a \.nsvq file"):
        load(tmp_path / "x.nsvq")
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "no.ply")


def test_non_finite_rows_are_dropped_and_the_scene_itself_is_left_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    splats = scene(5, 1)
    with torch.no_grad():
        splats.quats[2, 0] = torch.nan
    with caplog.at_level(logging.WARNING):
        save(splats, tmp_path / "x.nsvq")
    assert "dropped 1 of 5" in caplog.text
    assert len(load(tmp_path / "x.nsvq")) == 4
    assert len(splats) == 5


def test_an_origin_is_not_lost_silently(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(scene(5, 1), tmp_path / "x.nsvq", origin=(4e6, 0.0, 0.0))
    with caplog.at_level(logging.WARNING):
        load(tmp_path / "x.nsvq")
    assert "4000000.0" in caplog.text
