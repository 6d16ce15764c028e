"""Means, tables and pictures of rows that were made up."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from nsvq_lightning.commands.sweep.results import Row, as_markdown, draw_sweep, grouped, moments, series_of
from nsvq_lightning.report.files import write_csv


def row(seed: int = 0, psnr: float | None = 30.0, **other: object) -> Row:
    values = {"scene": "fox", "config": "nsvq_1k", "quantizer": "NSVQ", "codebooks": "1k", "steps": 9, "splats": 7}
    values |= {"ssim": 0.9, "bytes": 2_000_000, "seconds": 50.0, "psnr_before": 31.0}
    return values | {"seed": seed, "psnr": psnr, "folder": Path("none"), "error": ""} | other


def test_mean_and_spread_are_over_the_seeds() -> None:
    rows = [row(0, 30.0), row(1, 31.0), row(2, 35.0), row(0, 20.0, scene="horns")]
    fox, horns = grouped(rows)
    assert moments(fox, "psnr") == pytest.approx((32.0, 7.0**0.5))  # ((2² + 1² + 3²) / 2)^½
    assert moments(fox, "bytes", 1e-6) == pytest.approx((2.0, 0.0))
    assert moments(horns, "psnr") == (20.0, 0.0)


def test_an_infinite_psnr_is_no_number_and_a_failed_run_no_member() -> None:
    (group,) = grouped([row(0, None), row(1, 31.0), row(2, error="out of luck", psnr=None)])
    assert [member["seed"] for member in group] == [0, 1]
    assert moments(group, "psnr") == (31.0, 0.0)
    assert "  – |" in as_markdown([row(0, None)])


def test_curves_are_called_by_what_tells_them_apart() -> None:
    sizes = [row(config=f"nsvq_{size}", codebooks=size) for size in ("1k", "4k")]
    plain = row(config="plain", quantizer="", codebooks="")
    assert series_of([*sizes, plain]) == ["NSVQ", "NSVQ", "not quantized"]
    assert series_of([sizes[0], row(config="own")]) == ["nsvq_1k, NSVQ", "own, NSVQ"]
    both = [row(config=config, quantizer=quantizer) for config in "ab" for quantizer in ("A", "")]
    assert series_of(both) == ["a, A", "a, not quantized", "b, A", "b, not quantized"]


def test_the_table_has_a_line_a_group_and_names_failures() -> None:
    text = as_markdown([row(0, 30.0), row(1, 31.0), row(0, codebooks="4k", error="killed by signal 9")])
    (line,) = [line for line in text.splitlines() if line.startswith("| fox")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells == [
        *("fox", "nsvq_1k", "NSVQ", "1k", "2", "30.50 ± 0.71", "0.9000 ± 0.0000"),
        *("2.000 ± 0.000", "7 ± 0", "31.00 ± 0.00", "50 ± 0"),
    ]
    assert "* fox, nsvq_1k, 4k, seed 0: killed by signal 9" in text


def test_the_picture_shows_every_point(tmp_path: Path) -> None:
    blue, orange = (180, 119, 31), (14, 127, 255)  # the first two of tab10, BGR

    def drawn(rows: list[Row], colour: tuple[int, int, int] = blue) -> int:
        """Pixels in the colour of a curve, the first by default."""
        draw_sweep(tmp_path / "sweep.png", rows)
        image = np.asarray(cv2.imread(str(tmp_path / "sweep.png")))
        return int((abs(image.astype(int) - colour).max(-1) < 20).sum())

    one = drawn([row(0)])
    whiskers = drawn([row(0), row(1, 34.0)])
    curve = drawn([row(0), row(1, 34.0), row(0, 36.0, codebooks="4k", bytes=3_000_000)])
    assert 0 < one < whiskers < curve
    plain = row(config="plain", quantizer="", codebooks="", bytes=90_000_000)
    # A dashed line across the panel, which does not squeeze the curve into a corner.
    assert drawn([row(0), row(0, 36.0, codebooks="4k", bytes=3_000_000), plain], orange) > 2 * one
    assert drawn([row(0), row(0, scene="horns")]) > one
    assert drawn([plain]) > 0  # nothing else to compare it with: a point
    write_csv(tmp_path / "curve.csv", [{"seconds": 10.0 * k, "psnr": 25.0 + k} for k in range(5)])
    assert drawn([row(0, folder=tmp_path)]) > 1.5 * one  # and a line over the time
    draw_sweep(tmp_path / "none.png", [row(psnr=None)])
    assert not (tmp_path / "none.png").exists()
