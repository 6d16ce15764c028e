from __future__ import annotations

import gzip
import logging
import math
from pathlib import Path
from typing import Any

import compressed_scenes
import numpy as np
import pytest
import torch
from viewer_scenes import WRITTEN, coded_scene, plain_scene

from nsvq_lightning import Splats, load, save
from nsvq_lightning.io import CompressedScene, FormatError, describe, read_scene
from nsvq_lightning.io.compressed import on_white
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.io.numbers import logs_of_lengths
from nsvq_lightning.random import generator


def scene(n: int, degree: int) -> Splats:
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, (degree + 1) ** 2 - 1, 3))
    return Splats.from_tensors(*(torch.randn(s, generator=generator(1, i)) for i, s in enumerate(shapes)))


def test_lengths_are_logarithms_where_more_than_a_few_are_negative(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    logs = np.log(np.random.default_rng(0).uniform(0.01, 0.1, (300, 3))).astype(np.float32)
    lengths = np.exp(logs)
    lengths[7, 1] = -1e-9  # as by rounding
    np.testing.assert_allclose(np.delete(logs_of_lengths(lengths), 7, 0), np.delete(logs, 7, 0), rtol=1e-5)
    assert logs_of_lengths(lengths)[7, 1] == -20
    assert len(logs_of_lengths(lengths[:0])) == 0
    assert not caplog.messages
    record = np.zeros(300, [("means", "<f4", 3), ("lengths", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])
    record["lengths"], record["colors"], record["quats"] = logs, 200, [255, 128, 128, 128]
    (tmp_path / "x.splat").write_bytes(record.tobytes())
    np.testing.assert_allclose(read_scene(tmp_path / "x.splat").values("scales"), logs)
    assert "taken as logarithms" in caplog.text


@pytest.mark.parametrize("suffix", [".ply", ".NSVQ", ".Ply"])
def test_save_then_load_is_exact_whatever_the_case_of_the_suffix(tmp_path: Path, suffix: str) -> None:
    splats, path = scene(20, 2), tmp_path / f"x{suffix}"
    assert save(splats, path, Storage("paper")) == path.stat().st_size
    back = load(str(path))
    assert all(torch.equal(getattr(back, name), values) for name, values in splats.attributes().items())


def test_attributes_by_name_are_saved_as_they_come(tmp_path: Path) -> None:
    """As gsplat and nerfstudio have them, some as arrays, in other precisions, and with another shape of opacities."""
    splats = scene(7, 2)
    named: dict[str, Any] = {name: values.detach() for name, values in splats.attributes().items()}
    named |= {"means": named["means"].double().numpy().astype(">f8"), "opacities": named["opacities"][:, None]}
    named |= {"quats": named["quats"].numpy()[::-1].copy()[::-1], "scales": named["scales"].tolist()}
    named |= {"features_dc": named.pop("sh0").squeeze(1), "features_rest": named.pop("shN").bfloat16()}
    save({"step": 1, "splats": named}, tmp_path / "a.ply")  # as gsplat's checkpoints have them
    found = load(tmp_path / "a.ply")
    for name, values in splats.attributes().items():
        assert torch.equal(getattr(found, name), values.bfloat16().float() if name == "shN" else values)
    pipeline = {f"_model.gauss_params.{name}": values for name, values in named.items()}
    pipeline["_model.step"] = torch.ones(())
    save({"step": 1, "pipeline": pipeline, "optimizers": {}}, tmp_path / "b.ply")  # and those of nerfstudio
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    model = torch.nn.Module()  # as splatfacto's, which is among others in a model
    model.gauss_params = torch.nn.ParameterDict(splats.attributes())
    model.camera_optimizer = torch.nn.Linear(3, 3)
    save(model, tmp_path / "c.ply")
    assert all(torch.equal(getattr(load(tmp_path / "c.ply"), name), each) for name, each in splats.attributes().items())
    named |= {"features_rest": torch.zeros(7, 0, 3), "features_dc": torch.tensor([[0.0, 2, -2]]).repeat(7, 1)}
    save(named, tmp_path / "d.ply")  # those without harmonics are logits of colours there
    colours = 0.5 + 0.5 / math.sqrt(math.pi) * load(tmp_path / "d.ply").sh0[:, 0]
    assert torch.allclose(colours, torch.tensor([0.0, 2, -2]).sigmoid().expand(7, 3), atol=1e-6)
    del named["scales"]
    with pytest.raises(ValueError, match="the splats have no scales"):
        save(named, tmp_path / "a.ply")
    with pytest.raises(ValueError, match="the splats have no means, "):
        save({"state_dict": named, "name": "run 3"}, tmp_path / "a.ply")


def test_options_reach_the_format(tmp_path: Path) -> None:
    splats = scene(200, 3)
    assert save(splats, tmp_path / "few.sog", palette=8) < save(splats, tmp_path / "all.sog")
    coded = compressed_scenes.scene(200, {"shN": 64})
    for palette, rows in ((8, 8), (64, len(np.unique(coded.codes["shN"])))):
        save(coded, tmp_path / "coded.sog", palette=palette)
        assert len(read_scene(tmp_path / "coded.sog").codebooks["shN"]) == rows
    with pytest.raises(TypeError, match="palette"):
        save(splats, tmp_path / "x.nsvq", palette=8)
    save(splats, tmp_path / "paper.nsvq", storage="paper")
    assert describe(tmp_path / "paper.nsvq")["format"] == "nsvq, level paper"
    with pytest.raises(ValueError, match="unknown compression level 'zip'; there are compact, paper"):
        save(splats, tmp_path / "x.nsvq", storage="zip")


def test_unknown_suffix_lists_what_is_supported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'\.obj'; supported are \.ply .*\.nsvq"):
        save(scene(1, 0), tmp_path / "x.obj")
    for name, defect in (("x.ksplat", "unknown suffix"), ("meta.json", "only read")):
        with pytest.raises(ValueError, match=rf"{name}: .*{defect}"):
            save(scene(1, 0), tmp_path / name)
        assert not (tmp_path / name).exists()
    with pytest.raises(ValueError, match=r"x: unknown suffix ''"):
        load(tmp_path / "x")


def test_wrong_content_is_named(tmp_path: Path) -> None:
    save(scene(1, 0), tmp_path / "x.ply")
    (tmp_path / "x.ply").rename(tmp_path / "x.nsvq")
    with pytest.raises(FormatError, match=r"x\.nsvq: not a \.nsvq file"):
        load(tmp_path / "x.nsvq")
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "no.ply")


@pytest.mark.parametrize("suffix", WRITTEN)
def test_non_finite_rows_are_dropped_and_the_scene_itself_is_left_alone(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    splats = scene(10, 1)
    with torch.no_grad():
        splats.scales[3, 1] = torch.nan
        splats.shN[3, 2, 2] = torch.inf
        splats.means[8, 0] = -torch.inf
    path, keep = tmp_path / f"x{suffix}", [0, 1, 2, 4, 5, 6, 7, 9]
    with caplog.at_level(logging.WARNING):
        save(splats, path, Storage("paper"))
    assert "dropped 2 of 10 splats with non-finite values: means in 1 rows" in caplog.text
    back = load(path)
    assert len(back) == 8
    if suffix in (".nsvq", ".ply"):
        assert all(torch.equal(getattr(back, name), values[keep]) for name, values in splats.attributes().items())
    assert len(splats) == 10


@pytest.mark.parametrize("suffix", WRITTEN)
def test_splats_whose_code_is_not_finite_are_dropped(tmp_path: Path, suffix: str) -> None:
    coded = coded_scene(30, 1)
    coded.codebooks["scales"][int(coded.codes["scales"][4]), 1] = np.nan
    lost = int((coded.codes["scales"] == coded.codes["scales"][4]).sum())
    save(coded, tmp_path / f"x{suffix}")
    assert len(load(tmp_path / f"x{suffix}")) == 30 - lost


def test_an_origin_is_not_lost_silently(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    far = CompressedScene.from_splats(scene(5, 1), origin=(4e6, 0.0, 0.0))
    for step in (lambda: load(tmp_path / "x.nsvq"), lambda: save(far, tmp_path / "x.spz")):
        caplog.clear()
        save(far, tmp_path / "x.nsvq")
        assert caplog.text == ""
        step()
        assert "4000000.0" in caplog.text


def test_a_white_background_is_not_lost_silently(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    black = CompressedScene.from_splats(scene(5, 1))
    white = on_white(black)
    save(white, tmp_path / "x.nsvq")
    assert CompressedScene.joined([white, white]).background == (1, 1, 1)
    assert caplog.text == ""
    save(white, tmp_path / "x.ply")
    assert "x.ply: not stored: origin (0.0, 0.0, 0.0), background (1.0, 1.0, 1.0)" in caplog.text
    caplog.clear()
    load(tmp_path / "x.nsvq")
    assert "its splats alone do not say origin (0.0, 0.0, 0.0), background (1.0, 1.0, 1.0)" in caplog.text
    assert not any(CompressedScene.joined([black, white]).background)
    assert "the first decides what is behind all" in caplog.text


@pytest.mark.parametrize("suffix", sorted(WRITTEN))
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_is_saved_of_a_scene_without_finite_splats(tmp_path: Path, suffix: str, count: int) -> None:
    empty = plain_scene(count, 1)
    empty.means[:, 0] = np.nan
    with pytest.raises(FormatError, match=rf"x{suffix}: no finite splat among {count}"):
        save(empty, tmp_path / f"x{suffix}")
    assert not list(tmp_path.iterdir())


def test_splats_without_a_rotation_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    still = plain_scene(9, 0)
    still.raw["quats"][[2, 5]] = 0
    save(still, tmp_path / "x.ply")
    assert len(read_scene(tmp_path / "x.ply")) == 9
    assert "x.ply: 2 of 9 splats have the rotation 0 0 0 0" in caplog.text


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("a.usdz", "usdcat"),
        ("a.USDC", "usdcat"),
        ("a.ksplat", "splat-transform"),
        ("a.lcc", "splat-transform"),
        ("a.gltf", "as .glb"),
        ("a.zip", "name it .sog"),
        ("a.ssog", "unzip it"),
        ("a.pt", "torch.load"),
        ("runs/a", "name scene.nsvq in it"),
        ("last.ckpt", "nsvq export --ckpt_path"),
        ("a.obj", "name a file that ends so"),
    ],
)
def test_what_turns_other_files_into_some_that_are_read_is_said(name: str, way: str) -> None:
    with pytest.raises(ValueError, match=rf"unknown suffix .*; .*{way}"):
        read_scene(name)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".nsvq", ".glb", ".usda"])
def test_a_file_of_another_format_is_no_splat_file(suffix: str, tmp_path: Path) -> None:
    """It has no mark of its own: one in 32 of them was read as splats of random numbers."""
    path = tmp_path / f"scene{suffix}"
    save(plain_scene(40), path)
    content = path.read_bytes()
    renamed = tmp_path / "scene.splat"
    for written in (content, gzip.compress(content)):
        renamed.write_bytes(written + bytes(-len(written) % 32))
        with pytest.raises(FormatError, match=r"not a \.splat file: .* are no splats of 32"):
            load(renamed)
