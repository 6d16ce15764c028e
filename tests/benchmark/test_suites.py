"""Suites shrunk to a second: their rows are complete, our errors are small, and planted errors are found."""

from __future__ import annotations

import dataclasses
import fnmatch
import pkgutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba
import pytest
import torch

from nsvq_lightning import save
from nsvq_lightning.commands.benchmark import recipe_run, step_profile, suites, timing
from nsvq_lightning.commands.benchmark.cores import core_rows, serial_share
from nsvq_lightning.commands.benchmark.error_measures import relative_l2, worst_first
from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.suite_list import SUITES, Unavailable, load_suite, suite_names
from nsvq_lightning.commands.benchmark.suites import (
    codec,
    gpu,
    kmeans,
    loss,
    nearest,
    optimizer,
    profile,
    quantize,
    render,
    train,
)
from nsvq_lightning.commands.benchmark.workloads import synthetic_workload
from nsvq_lightning.skips import is_on
from nsvq_lightning.splats.arrays import SplatArrays
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

TINY = Scope((1,), quick=True, repeats=2, seconds=0.01, workloads=("A20k",), steps=8)
BY_STEP = ("train", "gpu", "size")
"""Suites that time steps instead of repeated calls, or besides."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with one splat in ten of the smallest workload."""
    path = tmp_path_factory.mktemp("scene") / "small.ply"
    save(RawSplats(*(tensor[::10] for tensor in synthetic_workload("A20k").splats)), path)
    return path


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 64)
    monkeypatch.setattr(render, "ORACLE_PAIRS", {True: 3e5})
    monkeypatch.setattr(nearest, "ROWS", {True: 200})
    monkeypatch.setattr(loss, "SIZE", (40, 48))
    monkeypatch.setattr(optimizer, "SPLATS", {True: (100,)})
    monkeypatch.setattr(optimizer, "CHECKED_SPLATS", 200)
    monkeypatch.setattr(quantize, "CHECKED_ROWS", 500)
    monkeypatch.setattr(kmeans, "CHECKED_ROWS", 500)
    monkeypatch.setattr(kmeans, "CHECKED_CODES", 20)
    monkeypatch.setattr(recipe_run, "QUICK_DEMO", ("--data.views=9", "--data.width=48", "--data.height=36"))
    monkeypatch.setattr(gpu, "COPIED", 2**16)
    for module in (train, profile, gpu):
        monkeypatch.setattr(module, "WARM_STEPS", {True: 2})
        monkeypatch.setattr(module, "STEPS", {True: 4})


def _run(name: str, scene: Path | None = None, **options: Any) -> list[Measurement]:
    return _rows(load_suite(name), dataclasses.replace(TINY, scene=scene, **options))


def _rows(measure: Callable[[Scope], Sequence[Measurement]], scope: Scope) -> list[Measurement]:
    try:
        return list(measure(scope))
    except Unavailable as reason:
        pytest.skip(str(reason))


def test_every_suite_is_a_file_and_every_file_a_suite() -> None:
    assert {module.name for module in pkgutil.iter_modules(suites.__path__)} == set(SUITES)
    assert suite_names("all") == tuple(SUITES)
    assert suite_names("loss") == ("loss",)
    assert suite_names("train,loss,train") == ("train", "loss")
    with pytest.raises(ValueError, match=r"'lose'; choose from render, .* or all"):
        suite_names("train,lose")


@pytest.mark.parametrize("name", [name for name in SUITES if name not in ("gpu", "profile", "size")])
def test_rows_are_complete(name: str, scene: Path) -> None:
    _check_rows(name, _run(name, scene))


@pytest.mark.slow
def test_sizes_are_measured_in_processes_of_their_own(scene: Path) -> None:
    rows = _run("size", scene)
    _check_rows("size", rows)
    assert [row.operation for row in rows] == ["step by splats", "step by pixels"]
    for row in rows:
        assert 100 < row.values["peak MB"] < 3000


def _check_rows(name: str, rows: list[Measurement]) -> None:
    assert {row.suite for row in rows} == {name}
    keys = [(row.workload, row.method, row.operation, row.threads) for row in rows]
    assert len(set(keys)) == len(keys) >= 2
    for row in rows:
        assert row.values
        assert all(value == value and value >= 0 for value in row.values.values())
        assert row.timing.ratio > 0
        if name not in (*BY_STEP, "compress"):
            assert 1 <= len(row.timing.samples) <= TINY.repeats
            assert len(row.timing.sgemm) == TINY.repeats


def test_files_of_other_programs_are_measured_in_the_photos(scene: Path, demo_scene: Path) -> None:
    rows = _run("compress", demo_scene, init_from=scene, beside=(scene,))
    found = {row.method: row.values for row in rows}
    assert found[".ply of another program: small.ply"]["dB lost"] == 0
    assert found[".ply of another program: small.ply"]["bytes"] == scene.stat().st_size
    assert found["nsvq compress: 1k"]["bytes"] < found["nsvq compress: no codebooks"]["bytes"] < scene.stat().st_size
    with pytest.raises(Unavailable, match="--init-from"):
        load_suite("compress")(dataclasses.replace(TINY, scene=demo_scene))


def test_rasterizer_is_as_exact_as_plain_torch(scene: Path) -> None:
    rows = {(row.method, row.operation): row for row in _run("render", scene)}
    for method in ("cpu", "plain torch"):
        assert rows[method, "forward"].values["max error"] < 1e-5
        assert rows[method, "forward + backward"].values["gradient error"] < 1e-4
    assert rows["cpu", "forward"].note.startswith("errors on the middle")


def test_backends_of_a_device_are_compared_with_the_oracle_and_with_its_memory(scene: Path) -> None:
    # All of the suite but the events of a GPU's stream runs on a CPU, too.
    rows = gpu.run_on(torch.device("cpu"), dataclasses.replace(TINY, scene=scene))
    _check_rows("gpu", rows)
    assert [row.operation for row in rows[:2]] == ["forward", "forward + backward"]
    assert [row.operation for row in rows[2:]] == [f"{phase.name.lower()} step" for phase in Phase]
    assert {row.method for row in rows} == {"cpu"}
    assert rows[0].values["max error"] < 1e-5
    assert rows[1].values["gradient error"] < 1e-4
    assert rows[1].values["share of memory limit %"] > 0


def test_least_bytes_of_a_render() -> None:
    workload = synthetic_workload("A20k").crop(30, 20)
    few = dataclasses.replace(workload, splats=RawSplats(*(tensor[:10] for tensor in workload.splats)))
    # 11 numbers of geometry and 48 of colour a splat; 3 of colour, 1 of alpha and 1 of depth a pixel.
    forward = 4 * (10 * 11 + 7 * 48 + 600 * 5)
    assert gpu.least_bytes(few, 7, backward=False) == forward
    assert gpu.least_bytes(few, 7, backward=True) == forward + 4 * (7 * 59 + 10 * 59 + 600 * 3)


def test_a_gpu_is_measured_on_the_large_scenes_besides(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "workloads", lambda scope: list(scope.workloads))
    monkeypatch.setattr(gpu, "synthetic_workload", str)
    assert [*map(str, gpu._workloads(Scope((1,))))] == ["A20k", "B100k", "C500k", "D1M", "E3M"]
    assert [*map(str, gpu._workloads(Scope((1,), workloads=("D1M",))))] == ["D1M"]


def test_suite_of_a_gpu_says_that_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(Unavailable, match="torch finds no CUDA device"):
        gpu.run(TINY)


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


def test_less_accuracy_costs_what_the_rows_say(scene: Path) -> None:
    rows = {row.method: row.values for row in _run("render", scene) if row.operation == "forward"}
    methods = [f"cpu{accuracy.label}" for accuracy in render.accuracies(3)]
    assert methods == ["cpu", "cpu, SH 2", "cpu, SH 1", "cpu, SH 0", "cpu, half size", "cpu, quarter size"]
    by_degree = [rows[method]["mean error"] for method in methods[:4]]
    assert by_degree == sorted(by_degree)
    assert by_degree[1] > 100 * by_degree[0]
    assert rows["cpu, quarter size"]["mean error"] > rows["cpu, half size"]["mean error"] > 100 * by_degree[0]


def test_an_observed_pass_has_the_same_gradients_at_a_price(scene: Path) -> None:
    rows = _run("render", scene)
    (observed,) = [row for row in rows if row.method == "cpu, observed"]
    (alone,) = [
        row
        for row in rows
        if (row.workload, row.method, row.operation) == (observed.workload, "cpu", "forward + backward")
    ]
    assert observed.operation == alone.operation
    price = observed.timing.median / alone.timing.median
    assert observed.values == alone.values | {"times unobserved": pytest.approx(price)}


def test_crop_is_the_largest_that_the_oracle_can_do() -> None:
    workload = synthetic_workload("A20k")
    pairs = {crop.camera.height: render._pairs(crop) for crop in (workload.crop(36, 24), workload.crop(48, 32))}
    assert pairs[24] < pairs[32]
    for most, size in ((pairs[24], (36, 24)), (pairs[32] - 1, (36, 24)), (0, (24, 16)), (1e30, (400, 300))):
        camera = render.crop_for_oracle(workload, most).camera
        assert (camera.width, camera.height) == size


def test_smaller_picture_of_one_colour_is_that_colour() -> None:
    workload = synthetic_workload("A20k").crop(50, 33)
    workload = dataclasses.replace(workload, background=torch.tensor([0.1, 0.5, 0.9]))
    nothing = RawSplats(*(tensor[:0] for tensor in workload.splats))
    image = render.Method("cpu", render.Accuracy(shrink=4)).picture(nothing, workload)
    torch.testing.assert_close(image, workload.background.expand(33, 50, 3))


def test_every_lloyd_step_brings_the_codes_nearer(scene: Path) -> None:
    rows = _run("kmeans", scene)
    by_method = {method: [row for row in rows if row.method == method] for method in ("1 Lloyd step", "10 Lloyd steps")}
    assert len(by_method["1 Lloyd step"]) == len(by_method["10 Lloyd steps"]) == 5
    for once, often in zip(*by_method.values(), strict=True):
        assert once.workload == often.workload
        assert 0 < often.values["distortion"] < once.values["distortion"] < 1
        assert often.values["rounding error"] < 1e-4
    *each, whole = by_method["10 Lloyd steps"]
    assert whole.timing.samples[0] == pytest.approx(sum(row.timing.samples[0] for row in each))


def test_distortion_is_a_share_of_the_variance() -> None:
    rows = torch.tensor([[0.0, 1.0], [2.0, 1.0], [10.0, 1.0], [12.0, 1.0]])
    # Squared distances of 1 to the centres of the pairs; variance (36 + 16 + 16 + 36) / 4.
    assert kmeans.distortion(rows, torch.tensor([[1.0, 1.0], [11.0, 1.0]])) == pytest.approx(1 / 26)
    assert kmeans.distortion(rows, rows) == 0
    assert kmeans.distortion(rows[:1], rows[1:2]) == 4


def test_runs_with_and_without_a_switch(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    switches, seen, measured = ("sh_bands", "metrics"), set(), train._test_psnr

    def seeing_switches(module: SplatModule) -> float:
        seen.add(tuple(is_on(name) for name in switches))
        return measured(module)

    monkeypatch.setattr(train, "_test_psnr", seeing_switches)
    switched = dataclasses.replace(TINY, scene=scene, switches=switches)
    rows = {row.method: row for row in train.run(switched)}
    assert seen == {(True, True), (False, True), (True, False)}
    shipped, exact = rows["as shipped"], rows["no skip of sh_bands"]
    assert shipped.values["other numbers"] == exact.values["other numbers"] == 0
    assert shipped.values["PSNR dB"] == exact.values["PSNR dB"] > 5
    assert shipped.values["times as shipped"] == 1
    assert "saves %" not in shipped.values
    ratio = exact.values["times as shipped"]
    assert exact.values["saves %"] == pytest.approx(100 * (1 - 1 / ratio))  # on: what its absence costs
    assert {"warmup ms", "prune ms", "quantize ms", "finetune ms"} < shipped.values.keys()
    assert [point[0] for point in shipped.course] == sorted(point[0] for point in shipped.course)
    assert shipped.course[-1][1] == shipped.values["PSNR dB"]
    assert len(shipped.timing.samples) == TINY.steps
    step, render_alone = rows["training step, Lightning included"], rows["render forward + backward"]
    assert render_alone.values["times its render"] == 1
    assert step.values["times its render"] == pytest.approx(step.timing.median / render_alone.timing.median)


def test_variants_of_runs() -> None:
    names = [variant.name for variant in train.variants(Scope((1, 2), switches=("sh_bands", "metrics")))]
    assert names == ["as shipped", "1 thread", "no skip of sh_bands", "no skip of metrics"]
    plain = train.variants(Scope((2,)))
    assert [variant.options for variant in plain] == [(), ("--model.codebooks=null",)]


def test_different_numbers_are_counted_by_their_bits() -> None:
    one = {"a": torch.tensor([0.0, 1.0, torch.nan]), "b": torch.ones(2, 2)}
    assert train.different_numbers(one, {name: tensor.clone() for name, tensor in one.items()}) == 0
    assert train.different_numbers(one, {**one, "a": torch.tensor([-0.0, 1.0, torch.nan])}) == 1
    assert train.different_numbers(one, {**one, "b": torch.ones(3, 2)}) == 4
    assert train.different_numbers(one, {"a": one["a"]}) == 4


def test_parts_add_up_to_the_step_and_every_pattern_finds_its_functions(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: dict[str, set[str]] = {}
    part_of = step_profile.part_of

    def noted(function: str) -> str:
        found.setdefault(part_of(function), set()).add(function)
        return part_of(function)

    monkeypatch.setattr(step_profile, "part_of", noted)
    rows = _run("profile", scene)
    for part, patterns in step_profile.PARTS.items():
        idle = [pattern for pattern in patterns if not fnmatch.filter(found.get(part, ()), pattern)]
        assert not idle, f"no function belongs to {part} by {idle}: have they been renamed or moved?"
    operations = [f"{phase.name.lower()} step" for phase in Phase]
    assert list(dict.fromkeys(row.operation for row in rows)) == operations
    for operation in operations:
        whole, *parts = [row for row in rows if row.operation == operation]
        assert whole.method == step_profile.WHOLE
        assert sum(row.values["share %"] for row in parts) == pytest.approx(100)
        calls = {row.method: row.values["calls"] for row in parts if "calls" in row.values}
        once = ("sort", "blend", "projection backward")
        assert {name: calls.get(name) for name in once} == dict.fromkeys(once, 1)
        assert calls["blend backward"] == 2  # the kernel, and how much memory it needs
        assert calls["Adam"] > 1
        quantizing = [name in calls for name in ("quantizer: noise", "quantizer: noise backward", "quantizer: count")]
        assert quantizing == [operation == "quantize step"] * 3
        assert ("quantizer: decode" in calls) == (operation in ("quantize step", "finetune step"))
        (outside,) = (row.values["share %"] for row in parts if row.method == step_profile.OUTSIDE)
        assert -1 < outside < 10


def test_functions_belong_to_the_first_part_that_fits() -> None:
    expected = {
        "nsvq_lightning.rendering.cpu.blend.blend": "blend",
        "nsvq_lightning.rendering.cpu.blend.total_slots": "blend backward",
        "nsvq_lightning.rendering.cpu.rasterizer._Blend.forward": "rasterizer, its Python",
        "nsvq_lightning.callbacks.schedule.PhaseSchedule.setup": "other callbacks",
        "nsvq_lightning.training.module.SplatModule.training_step": "module, its Python",
        "/somewhere/else.py.function": step_profile.OTHER,
    }
    assert {function: step_profile.part_of(function) for function in expected} == expected


def test_serial_share_is_amdahls() -> None:
    assert serial_share(1, 10.0, 2, 5.0) == 0
    assert serial_share(1, 10.0, 2, 10.0) == 1
    assert serial_share(1, 10.0, 2, 5.5) == pytest.approx(0.1)  # 10 · (0.1 + 0.9 / 2)
    assert serial_share(2, 5.5, 4, 3.25) == pytest.approx(0.1)
    assert serial_share(1, 10.0, 2, 4.0) == 0  # a cache more
    assert serial_share(1, 10.0, 2, 12.0) == 1


@pytest.mark.skipif(int(numba.config.NUMBA_NUM_THREADS) < 2, reason="needs two threads")
def test_threads_are_compared_part_by_part_on_the_steps_of_a_run() -> None:
    rows = _rows(core_rows, dataclasses.replace(TINY, threads=(1, 2), steps=24))
    phases, parts = (
        [row for row in rows if row.operation == f"{what} with 1 and 2 threads"] for what in ("phases", "parts")
    )
    assert [row.method for row in phases] == [
        "all steps",
        *(f"{phase.name.lower()} step" for phase in Phase),
        timing.sgemm().name,
    ]
    assert {"blend", "blend backward", "Adam", "quantizer: search"} < {row.method for row in parts}
    assert {row.workload for row in rows} == {"demo, demo.yaml, 24 steps"}
    for row in rows:
        values = row.values
        assert values["times faster"] == pytest.approx(values["ms, 1"] / values["ms, 2"])
        assert 0 <= values["serial %"] <= 100
        assert values["ms, 16 expected"] <= values["ms, 8 expected"] <= 1.01 * max(values["ms, 1"], values["ms, 2"])


def test_steps_of_a_config_are_profiled_in_the_run_that_it_makes() -> None:
    rows = _run("profile", config="demo.yaml", steps=24)
    assert [row.method for row in rows].count(step_profile.WHOLE) == len(Phase)
    for phase in Phase:
        methods = {row.method for row in rows if row.operation == f"{phase.name.lower()} step"}
        assert {"blend", "Adam"} < methods
        assert "quantizer: search" in methods or phase is not Phase.QUANTIZE
        assert "quantizer: noise" not in methods  # its quantizer is another


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
    values = render.image_errors(image, truth)
    assert values["max error"] == pytest.approx(1e-6)
    assert values["mean error"] == pytest.approx(1e-6)
    assert values["pixels left out"] == values["pixels above 1e-3"] == 1
    assert set(render.image_errors(truth, truth).values()) == {0}
    # Where the pixels are given, the jump counts.
    every = render.image_errors(image, truth, torch.ones(8, 9, dtype=torch.bool))
    assert every["max error"] == pytest.approx(0.01, rel=1e-3)
    assert every["pixels left out"] == 0


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
    assert optimizer.errors_after(3, optimizer.METHODS["build_adam"])["update error"] < 1e-3


def test_wrong_quantize_step_is_found() -> None:
    splats = RawSplats(*(tensor[:2000] for tensor in synthetic_workload("A20k").splats))
    attributes = quantize.prepare(splats, "0.5k")
    results = quantize.step(attributes, 0)
    assert max(quantize.step_errors(attributes, results).values()) < 1e-4
    quantized, gradient, codes = results["quats"]
    table, rows, upstream = attributes["quats"].x.detach(), attributes["quats"].rows, attributes["quats"].upstream
    x, straight_through = table[rows], torch.zeros_like(table).index_copy(0, rows, upstream)
    for broken, key in (
        ((x + 1.01 * (quantized - x), gradient, codes), "length error"),
        ((quantized, straight_through, codes), "gradient error"),
        ((quantized, gradient, codes.roll(1)), "wrong codes"),
    ):
        assert quantize.step_errors(attributes, {**results, "quats": broken})[key] > 1e-3


def test_read_errors_follow_splats_to_their_new_order() -> None:
    arrays = SplatArrays.from_splats(RawSplats(*(tensor[:50] for tensor in synthetic_workload("A20k").splats)))
    fields = {field.name: getattr(arrays, field.name) for field in dataclasses.fields(arrays)}
    turned = SplatArrays(**{name: values[::-1].copy() for name, values in fields.items()})
    assert codec.read_errors(turned, arrays, arrays)["max error of the file"] == 0
    arrays.means[3] = arrays.means[4] + 1e-4  # the file may move them past each other
    turned.means[[46, 45]] = arrays.means[[4, 3]]
    assert codec.read_errors(turned, arrays, arrays)["max error of the file"] == pytest.approx(1e-4, rel=0.01)
    turned.scales[7] += 0.5
    assert codec.read_errors(turned, arrays, arrays)["max error of the file"] == pytest.approx(0.5)


def test_errors_are_relative_and_the_worst_comes_first() -> None:
    assert relative_l2(torch.tensor([3.0, 4.4]), torch.tensor([3.0, 4.0])) == pytest.approx(0.08)
    assert relative_l2(torch.tensor([3.0, 4.0]), torch.zeros(2)) == 5
    assert list(worst_first("error", {"a": 1.0, "b": 2.0}).items()) == [("error", 2.0), ("a", 1.0), ("b", 2.0)]


def test_plain_loss_is_the_loss_of_the_package_in_another_way() -> None:
    image, target = loss.image_pair(30, 41)
    value, gradient = loss.loss_and_gradient("plain torch", image.double(), target)
    expected, expected_gradient = loss.loss_and_gradient("fused", image.double(), target)  # plain torch too, in float64
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-9, atol=1e-15)
