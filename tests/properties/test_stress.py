"""Scenes and quantizers at the limits of float32: finite and right, or refused with the culprit's name."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import nsvq_step
import numpy as np
import pytest
import torch
from extremes import BACKENDS, BROKEN_ROWS, extremes, quantizer_errors, quantizers, step, stress_errors, stress_table

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.row_ops import MAX_LOG_SCALE, trainable_rows

SCENES = extremes()
COARSE = {"scene at 1e+03": 2e-3, "scene at 1e+06": 1.0}
"""Largest relative errors where float32 does not know the positions themselves."""


@pytest.fixture(scope="module", autouse=True)
def table_that_is_asked_for(request: pytest.FixtureRequest) -> Iterator[None]:
    """``--stress-table PATH`` leaves a table of all scenes, larger ones than are tested."""
    yield
    path = request.config.getoption("--stress-table")
    if path is not None:
        Path(path).write_text(stress_table(extremes(200, 10_000)), encoding="utf-8")


@pytest.mark.parametrize("name", [name for name, scene in SCENES.items() if not scene.culprit])
def test_an_extreme_scene_is_rendered_and_trained_as_in_float64(name: str) -> None:
    scene, tolerance = SCENES[name], COARSE.get(name, 1e-4)
    ours = stress_errors(scene, "cpu")
    assert ours["not finite"] == ours["step refused"] == ours["rows named"] == ours["other rows lost"] == 0
    assert ours["max error"] <= tolerance * max(1.0, ours["largest value"])
    # Rotations of a splat 1e12 long have gradients of 1e-16 of the others'.
    assert ours["gradient error"] <= (1e-3 if name == "scales 1e+12" else tolerance)
    assert ours["pixels left out"] <= 0.2 * scene.workload.camera.width * scene.workload.camera.height


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", [name for name, scene in SCENES.items() if scene.culprit])
def test_a_number_that_is_none_hurts_no_other_splat_and_is_named(name: str, backend: str) -> None:
    scene = SCENES[name]
    values, (refused, named, lost) = stress_errors(scene, backend), step(scene, backend)
    assert lost == 0
    assert named == {scene.culprit: BROKEN_ROWS}
    if values["not finite"]:
        assert refused
        assert scene.culprit in ("sh0", "shN")
    else:
        assert values["max error"] < 1e-5
        assert values["gradient error"] < 1e-4


@pytest.mark.parametrize("name", quantizers())
def test_a_quantizer_with_nothing_to_do_or_to_choose(name: str) -> None:
    attribute = quantizers()[name]
    values = quantizer_errors(attribute)
    assert values["not finite"] == values["wrong codes"] == 0
    assert values["gradient error"] < 1e-5
    assert values["length error"] < 1e-4
    quantized, gradient, _ = nsvq_step.step({name: attribute}, 0)[name]
    if name in ("every row on a code", "more codes than rows", "all rows equal"):
        # Without a residual there is no noise, and the gradient passes as it is.
        assert torch.equal(quantized, attribute.x)
        assert torch.equal(gradient, attribute.upstream)
    codes = {"every row on a code": 5, "more codes than rows": 200, "all rows equal": 1, "one code": 1}
    assert len(attribute.quantizer.codebook) == codes.get(name, 16)


def _one_splat(log_scale: float) -> RawSplats:
    return RawSplats(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0.5, 0.2, 0.1]]),
        torch.full((1, 3), log_scale),
        torch.zeros(1),
        torch.ones(1, 1, 3),
        torch.zeros(1, 0, 3),
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_determinant_that_would_under_or_overflow(backend: str) -> None:
    """One splat far larger than the picture covers it evenly, α is its opacity everywhere; a tiny one is a dot."""
    camera = SCENES["one splat"].workload.camera
    for scale in (1e3, 1e6, 1e9, 1e12):
        image = render(_one_splat(math.log(scale)), camera, backend=backend).alpha
        torch.testing.assert_close(image, torch.full_like(image, 0.5), atol=1e-5, rtol=0)
    dot = render(_one_splat(-math.inf), camera, backend=backend).alpha
    for scale in (1e-12, 1e-30, 1e-45):
        torch.testing.assert_close(render(_one_splat(math.log(scale)), camera, backend=backend).alpha, dot)
    assert 0 < dot.max() <= 0.5


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("log_scale", [MAX_LOG_SCALE + 1, 88.8, math.inf])
def test_inf_scale_is_named(log_scale: float, backend: str) -> None:
    """Sizes whose squares, or which themselves, are infinite in float32."""
    both = RawSplats(*map(torch.cat, zip(_one_splat(-2.0), _one_splat(log_scale), strict=True)))
    image = render(both, SCENES["one splat"].workload.camera, backend=backend).image
    assert image.isfinite().all()
    rows, named = trainable_rows(Splats.from_tensors(*both))
    assert rows.tolist() == [True, False]
    assert named == {"scales": 1}


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("log_scale", [18.0, 24.5, MAX_LOG_SCALE])
def test_the_largest_sizes_that_are_kept_train(log_scale: float, antialiased: bool) -> None:
    """On the near plane, where a splat covers most pixels; plain torch overflows there, and then drops the splat."""
    camera = SCENES["one splat"].workload.camera
    place = camera.position + (1.01 * NEAR) * camera.viewmat[2, :3]
    splat = _one_splat(log_scale)._replace(means=place[None])
    leaves = RawSplats(*(tensor.requires_grad_() for tensor in splat))
    image = render(leaves, camera, antialiased=antialiased, backend="cpu").image
    gradients = torch.autograd.grad(image.square().sum(), leaves)
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)
    assert gradients[RawSplats._fields.index("scales")].any()


def test_sfm_point_at_a_camera_centre_or_duplicated() -> None:
    camera: Camera = SCENES["one splat"].workload.camera
    points = torch.cat([camera.position[None].repeat(3, 1), torch.zeros(2, 3), torch.eye(3)])
    splats = Splats.from_points(points, torch.full_like(points, 0.5), sh_degree=1)
    assert len(splats) == 5
    assert all(bool(torch.isfinite(value).all()) for value in splats.raw())
    leaves = splats.raw()
    image = render(leaves, camera).image
    # The one at the centre has no direction: this camera does not see it.
    assert torch.equal(image, render(RawSplats(*(value[1:] for value in leaves)), camera).image)
    gradients = torch.autograd.grad(image.sum(), leaves)
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)
    assert not any(bool(gradient[0].any()) for gradient in gradients)


def test_two_points_a_hair_apart_get_the_smallest_scale() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [1e-30, 0.0, 0.0]])
    splats = Splats.from_points(points, torch.zeros(2, 3))
    np.testing.assert_allclose(splats.scales.detach().exp().numpy(), math.sqrt(1e-7), rtol=1e-5)


def test_table_has_a_row_for_each_scene_and_backend() -> None:
    head, _, *rows = stress_table({name: SCENES[name] for name in ("one splat", "sh0 nan")}).splitlines()
    assert head.split()[1:4:2] == ["scene", "back-end"]
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    assert [row[:2] for row in cells] == [[n, b] for n in ("one splat", "sh0 nan") for b in BACKENDS]
    assert [row[-3:] for row in cells] == [["0", "0", "0"], ["0", "0", "0"], *[["1", str(BROKEN_ROWS), "0"]] * 2]
