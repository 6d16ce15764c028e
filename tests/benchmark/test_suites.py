"""Suites shrunk to a second: their rows are complete, our errors are small, and planted errors are found."""

from __future__ import annotations

import dataclasses
import pkgutil
from pathlib import Path

import pytest
import torch

from nsvq_lightning import save
from nsvq_lightning.benchmark import suites, timing
from nsvq_lightning.benchmark.errors import relative_l2, worst_first
from nsvq_lightning.benchmark.registry import SUITES, load_suite, suite_names
from nsvq_lightning.benchmark.row import Row
from nsvq_lightning.benchmark.settings import Settings
from nsvq_lightning.benchmark.suites import codec, loss, nearest, optimizer, quantize, render
from nsvq_lightning.benchmark.workloads import synthetic_workload
from nsvq_lightning.io.arrays import SplatArrays
from nsvq_lightning.splats import RawSplats

TINY = Settings((1,), quick=True, repeats=2, seconds=0.01, workloads=("A20k",))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with one splat in ten of the smallest workload."""
    path = tmp_path_factory.mktemp("scene") / "small.ply"
    save(RawSplats(*(tensor[::10] for tensor in synthetic_workload("A20k").splats)), path)
    return path


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 64)
    monkeypatch.setattr(render, "ORACLE_WORK", {True: 2e6})
    monkeypatch.setattr(nearest, "ROWS", {True: 200})
    monkeypatch.setattr(loss, "SIZE", (40, 48))
    monkeypatch.setattr(optimizer, "SPLATS", {True: (100,)})
    monkeypatch.setattr(optimizer, "CHECKED_SPLATS", 200)
    monkeypatch.setattr(quantize, "CHECKED_ROWS", 500)
    monkeypatch.setattr(quantize, "CHECKED_CODES", 20)


def _run(name: str, scene: Path) -> list[Row]:
    return list(load_suite(name)(dataclasses.replace(TINY, scene=scene)))


def test_every_suite_is_a_file_and_every_file_a_suite() -> None:
    assert {module.name for module in pkgutil.iter_modules(suites.__path__)} == set(SUITES)
    assert suite_names("all") == tuple(SUITES)
    assert suite_names("loss") == ("loss",)
    with pytest.raises(ValueError, match=r"'lose'; choose one of render, .* or all"):
        suite_names("lose")


@pytest.mark.parametrize("name", SUITES)
def test_rows_are_complete(name: str, scene: Path) -> None:
    rows = _run(name, scene)
    assert {row.suite for row in rows} == {name}
    keys = [(row.workload, row.method, row.operation, row.threads) for row in rows]
    assert len(set(keys)) == len(keys) >= 2
    for row in rows:
        assert row.values
        assert all(value == value and value >= 0 for value in row.values.values())
        assert 1 <= len(row.timing.samples) <= TINY.repeats
        assert len(row.timing.sgemm) == TINY.repeats


def test_rasterizer_is_as_exact_as_plain_torch(scene: Path) -> None:
    rows = {(row.method, row.operation): row for row in _run("render", scene)}
    for method in ("cpu", "plain torch"):
        assert rows[method, "forward"].values["max error"] < 1e-5
        assert rows[method, "forward + backward"].values["gradient error"] < 1e-4
    assert rows["cpu", "forward"].note.startswith("errors on the middle")


def test_searches_find_the_codes(scene: Path) -> None:
    rows = _run("nearest", scene)
    assert {row.method for row in rows} == set(nearest.METHODS)
    ours = [row for row in rows if row.method == "nsvq_lightning"]
    assert len(ours) == 4
    for row in ours:
        # Codes may differ between equals to rounding.
        assert row.values["added distance"] < 1e-6


def test_loss_and_optimizer_and_quantizer_are_right(scene: Path) -> None:
    errors = {(row.suite, row.method): row.values for name in ("loss", "optimizer") for row in _run(name, scene)}
    assert errors["loss", "fused"]["gradient error"] < 1e-4
    assert errors["loss", "fused"]["loss error"] < 1e-5
    assert errors["optimizer", "build_adam"]["update error"] < 1e-3
    quantizer = _run("quantize", scene)
    step = next(row.values for row in quantizer if row.method == "NSVQ")
    assert step["gradient error"] < 1e-4
    assert step["length error"] < 1e-5
    assert max(row.values["distortion error"] for row in quantizer if row.method == "kmeans") < 1e-4


def test_files_of_level_paper_and_ply_lose_nothing(scene: Path) -> None:
    rows = {(row.method, row.operation): row.values for row in _run("codec", scene)}
    for method in (".nsvq paper", ".ply"):
        assert rows[method, "read"]["max error of the file"] == 0
    assert rows[".ply", "write"]["max error with codebooks"] == 0
    assert rows[".nsvq paper", "write"]["bytes"] < rows[".ply", "write"]["bytes"] == scene.stat().st_size


def test_image_errors_leave_out_a_flipped_pixel_and_count_it() -> None:
    truth = torch.rand(8, 9, 3, generator=torch.Generator().manual_seed(0)).double()
    image = truth + 1e-6
    image[2, 3, 1] += 0.01
    values, usual = render.image_errors(image, truth)
    assert values["max error"] == pytest.approx(1e-6)
    assert values["mean error"] == pytest.approx(1e-6)
    assert values["pixels left out"] == values["pixels above 1e-3"] == 1
    assert not usual[2, 3]
    assert int(usual.sum()) == 71
    same, _ = render.image_errors(truth, truth)
    assert set(same.values()) == {0}


def test_wrong_codes_are_counted_with_what_they_add() -> None:
    search = nearest.Search("scales", torch.tensor([[0.0], [1.0], [2.1]]), torch.tensor([[0.5], [2.0], [2.0]]))
    best = torch.tensor([0, 0, 1])
    # Distances 0.5 + 0.5 + 0.1; the second code is 1 away from row 1; code 2 equals code 1.
    values = nearest.code_errors(search, torch.tensor([0, 1, 2]), best)
    assert values["wrong codes"] == 1
    assert values["added distance"] == pytest.approx(0.5 / 1.1)


def test_wrong_optimizer_is_found() -> None:
    def wrong(groups: list[dict[str, object]]) -> torch.optim.Optimizer:
        return torch.optim.Adam(groups, eps=1e-8)

    assert optimizer.errors_after(3, wrong)["update error"] > 1e-3
    assert optimizer.errors_after(3, optimizer.build_adam)["update error"] < 1e-3


def test_wrong_quantize_step_is_found() -> None:
    splats = RawSplats(*(tensor[:2000] for tensor in synthetic_workload("A20k").splats))
    attributes = quantize.prepare(splats, "0.5k")
    results = quantize.step(attributes, 0)
    assert max(quantize.step_errors(attributes, results).values()) < 1e-4
    quantized, gradient, codes = results["quats"]
    x = attributes["quats"].x.detach()[attributes["quats"].rows]
    for broken, key in (
        ((x + 1.01 * (quantized - x), gradient, codes), "length error"),
        ((quantized, gradient.roll(1, 0), codes), "gradient error"),
        ((quantized, gradient, codes.roll(1)), "wrong codes"),
    ):
        assert quantize.step_errors(attributes, {**results, "quats": broken})[key] > 1e-3


def test_read_errors_follow_splats_to_their_new_order() -> None:
    arrays = SplatArrays.from_splats(RawSplats(*(tensor[:50] for tensor in synthetic_workload("A20k").splats)))
    fields = {field.name: getattr(arrays, field.name) for field in dataclasses.fields(arrays)}
    turned = SplatArrays(**{name: values[::-1].copy() for name, values in fields.items()})
    assert codec.read_errors(turned, arrays, arrays)["max error of the file"] == 0
    turned.scales[7] += 0.5
    assert codec.read_errors(turned, arrays, arrays)["max error of the file"] == pytest.approx(0.5)


def test_errors_are_relative_and_the_worst_comes_first() -> None:
    assert relative_l2(torch.tensor([3.0, 4.4]), torch.tensor([3.0, 4.0])) == pytest.approx(0.08)
    assert relative_l2(torch.tensor([3.0, 4.0]), torch.zeros(2)) == 5
    assert list(worst_first("error", {"a": 1.0, "b": 2.0}).items()) == [("error", 2.0), ("a", 1.0), ("b", 2.0)]


def test_plain_loss_is_the_loss_of_the_package_in_another_way() -> None:
    image, target = (tensor.double() for tensor in loss.image_pair(30, 41))
    value, gradient = loss.loss_and_gradient("plain torch", image, target)
    expected, expected_gradient = loss.loss_and_gradient("fused", image, target)  # plain torch too, in float64
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-9, atol=1e-15)
