from __future__ import annotations

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splat_scenes import random_splats

from nsvq_lightning.commands.main import main
from nsvq_lightning.io import FORMATS, CompressedScene, save, write_nsvq, write_ply
from nsvq_lightning.io.nsvq.precision import Storage


def _plain(n: int) -> CompressedScene:
    return CompressedScene.from_splats(random_splats(n))


def _scene(n: int) -> CompressedScene:
    plain = _plain(n)
    raw = {name: values for name, values in plain.raw.items() if name != "shN"}
    codes, codebooks = {"shN": np.arange(n) % 16384}, {"shN": np.ones((16384, 45), np.float32)}
    return replace(plain, codes=codes, codebooks=codebooks, raw=raw, config={"seed": 42}, metrics={"psnr": 25.5})


def test_text_for_a_compressed_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, _scene(1000), Storage("paper"))
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    lines = [line.replace("|", " ").split() for line in text.splitlines()]
    assert ["splats", "1,000"] in lines
    assert ["shN", "codes", "45", "16,384", "14"] in lines
    assert ["codes", "bits", "1,750", "14.00", f"{100 * 1750 / path.stat().st_size:.1f}", "%"] in lines
    assert '"seed": 42' in text
    assert '"psnr": 25.5' in text


def test_names_that_the_output_cannot_show_are_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_ply(tmp_path / "höhle.ply", _plain(3))
    printed = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, encoding="ascii"))
    assert main(["info", str(tmp_path / "höhle.ply")]) == 0
    sys.stdout.flush()
    assert b"h?hle.ply" in printed.getvalue()


def test_streams_add_up_to_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nsvq(tmp_path / "x.nsvq", _scene(1000))
    write_ply(tmp_path / "x.ply", _plain(1000))
    for name in ("x.nsvq", "x.ply"):
        assert main(["info", str(tmp_path / name), "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert sum(stream["bytes"] for stream in facts.get("streams", ())) in (0, facts["bytes"])
        assert facts["bytes"] == (tmp_path / name).stat().st_size
        assert facts["ratio"] == (tmp_path / "x.ply").stat().st_size / facts["bytes"]


@pytest.mark.parametrize("suffix", [suffix for suffix, entry in FORMATS.items() if entry.write and not entry.native])
def test_what_is_said_of_every_format(tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str) -> None:
    path = tmp_path / f"a{suffix}" if suffix.startswith(".") else tmp_path / suffix
    size = save(_plain(300), path)
    assert main(["info", str(path)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["format", suffix.removeprefix(".")] in lines
    assert ["splats", "300"] in lines
    assert ["SH", "degree", "0" if suffix == ".splat" else "3"] in lines
    said = next(line for line in lines if line[0] == "bytes")
    assert (said[1], said[-4:]) == (f"{size:,}", [f"{8 * size / 300:.2f}", "bits", "per", "splat"])


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"ply\n", id="ply without header"),
        pytest.param(b"PK\x03\x04" + bytes(50), id="zip"),
        pytest.param(b"\x89NSVQ\r\n\x1a" + bytes(90), id="nsvq of zeros"),
    ],
)
def test_bad_files_are_one_line_and_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes
) -> None:
    (tmp_path / "bad.nsvq").write_bytes(content)
    for path in (tmp_path / "bad.nsvq", tmp_path / "missing.nsvq", tmp_path):
        assert main(["info", str(path)]) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert captured.err.startswith(f"nsvq info: {path}: ")
