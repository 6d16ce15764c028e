"""The Triton kernels against the float64 oracle: on a GPU, or on the CPU under Triton's interpreter.

``test_triton.py`` runs this file in a process of its own, because Triton decides when it is imported whether it
interprets. Alone: ``TRITON_INTERPRET=1 pytest tests/rendering/triton_cases.py``. The interpreter takes some
milliseconds for a splat in a tile, so scenes are tiny.
"""

import math
from functools import partial
from itertools import pairwise

import numpy as np
import oracle
import pytest
import torch
import triton
import triton.language as tl
from guards import GuardError, guarded
from oracle import run
from splat_scenes import front_camera, random_splats, some_pixel_weights, uneven_splats
from triton.runtime.interpreter import InterpreterBuilder

from nsvq_lightning.compute.devices import resolve_backend
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.cuda.binning import list_tiles
from nsvq_lightning.rendering.cuda.blend import SLOTS, blend, tile_grid
from nsvq_lightning.rendering.cuda.projection import Lens, project
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.rendering.sampling import Sampling, focal_of
from nsvq_lightning.splats.splats import RawSplats

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
assert_same = partial(oracle.assert_same, "cuda")

# On a GPU the larger of a number and NaN is the number; in the interpreter it is NaN, unless it is told.
InterpreterBuilder.create_maxnumf = lambda self, a, b: self.binary_op(a, b, np.fmax)
InterpreterBuilder.create_minnumf = lambda self, a, b: self.binary_op(a, b, np.fmin)


def on_device(splats: RawSplats) -> RawSplats:
    """Leaves on the device of the kernels."""
    return RawSplats(*(tensor.to(DEVICE, copy=True).requires_grad_() for tensor in splats))


@pytest.mark.parametrize(("sh_degree", "stored"), [(0, 3), (1, 1), (2, 3)])
def test_sh_degrees(sh_degree: int, stored: int) -> None:
    assert_same(random_splats(12, sh_degree=stored), front_camera(16, 12), sh_degree=sh_degree)


@pytest.mark.parametrize(("width", "height"), [(16, 16), (1, 1)])
def test_image_sizes(width: int, height: int) -> None:
    assert_same(random_splats(12, seed=2), front_camera(width, height, cx=0.4 * width))


def test_background_and_its_gradient() -> None:
    splats, camera, background = random_splats(12, seed=3), front_camera(16, 12), torch.tensor([0.2, 0.5, 0.9])
    assert_same(splats, camera, background=background)
    colour = background.to(DEVICE).requires_grad_()
    result = render(on_device(splats), camera, background=colour, backend="cuda")
    result.image.sum().backward()
    torch.testing.assert_close(colour.grad, (1 - result.alpha.detach()).sum().expand(3))


def test_saturated_pixels_stop_early() -> None:
    splats, camera = random_splats(80, seed=5, log_scale=0.5), front_camera(16, 12)
    splats = splats._replace(opacities=splats.opacities + 5)
    assert_same(splats, camera)
    lens = Lens.of(camera, torch.device(DEVICE))
    projected = project(lens, tuple(tensor.to(DEVICE) for tensor in splats), 3)
    tiles = list_tiles(projected.boxes, *tile_grid(16, 12))
    *_, ends = blend(lens, projected.records, tiles, torch.zeros(3, device=DEVICE))
    assert 0 < int(ends[0]) < int(tiles.offsets[1])


def test_needles_keep_the_digits_of_their_gradients() -> None:
    splats = random_splats(16, sh_degree=0, seed=3)
    noise = 0.1 * torch.randn(16, 3, generator=torch.Generator().manual_seed(0))
    scales = torch.tensor([100.0, 1e-4, 1e-4]).log() + noise
    assert_same(splats._replace(scales=scales, opacities=splats.opacities - 1), front_camera(16, 20))


def test_nothing_overflows_that_the_cpu_can_draw() -> None:
    splats, camera = random_splats(4, sh_degree=0, seed=1), front_camera(12, 9)
    long = splats._replace(quats=splats.quats * 1e20)
    assert_same(long, camera)
    for scale in (1e7, 1e12):
        large = splats._replace(scales=splats.scales + math.log(scale))
        (ours, _), (expected, _) = run(large, camera, "cuda", torch.float32), run(large, camera, "cpu", torch.float32)
        assert expected.radii.all()
        assert torch.equal(ours.radii > 0, expected.radii > 0)
        torch.testing.assert_close(ours.image, expected.image, atol=1e-3, rtol=0)


def test_a_colour_that_is_no_number_shows() -> None:
    splats, camera = random_splats(4, sh_degree=0, seed=1), front_camera(16, 12)
    sh0 = splats.sh0.clone()
    sh0[0, 0, 1] = math.nan
    (ours, _), (expected, _) = (
        run(splats._replace(sh0=sh0), camera, backend, torch.float32) for backend in ("cuda", "cpu")
    )
    assert expected.image.isnan().any()
    assert ours.image[expected.image.isnan()].isnan().all()


@pytest.mark.parametrize("log_scale", [-5.0, -2.0])
def test_anti_aliasing(log_scale: float) -> None:
    splats, camera = random_splats(24, log_scale=log_scale), front_camera(16, 12)
    ours, _ = assert_same(splats, camera, antialiased=True)
    plain = render(on_device(splats), camera, backend="cuda").image.detach().cpu()
    assert (plain - ours.image).abs().max() > 0.01


@pytest.mark.parametrize("times", [0.4, 1.0, 3.0])
def test_sampling(times: float) -> None:
    splats, camera = random_splats(24, log_scale=-3.5), front_camera(16, 12)
    away = (splats.means - camera.position).norm(dim=1)
    sampling = Sampling(torch.stack([away * torch.linspace(0.5, 1.5, 24), 1.2 * away]), [focal_of(camera) / times])
    ours, _ = assert_same(splats, camera, sampling=sampling)
    plain = render(on_device(splats), camera, backend="cuda").image.detach().cpu()
    assert (plain - ours.image).abs().max() > 0.01


def test_a_huge_splat_keeps_its_light() -> None:
    splats, camera = random_splats(4, sh_degree=0, seed=1), front_camera(12, 9)
    large = splats._replace(scales=splats.scales + math.log(1e12))
    ours, gradients = run(large, camera, "cuda", torch.float32, antialiased=True)
    plain, _ = run(large, camera, "cuda", torch.float32)
    assert torch.equal(ours.image, plain.image)
    assert all(gradient.isfinite().all() for gradient in gradients.values())


def test_more_splats_than_a_program_takes() -> None:
    assert_same(random_splats(129, seed=7, log_scale=-4.0), front_camera(8, 6))


def test_splats_behind_and_beside_the_camera() -> None:
    splats = random_splats(40, seed=8)
    means = splats.means.clone()
    means[:10, 2] -= 8
    means[10:20, 0] += 3
    means[20:24, 2] -= 3.2
    assert_same(splats._replace(means=means), front_camera(20, 16))


def test_equal_depths_keep_their_order() -> None:
    splats = random_splats(12, seed=4, log_scale=-1.0)
    assert_same(splats._replace(means=splats.means[:1].repeat(12, 1)), front_camera(16, 12))


def test_no_splat_in_view_is_background() -> None:
    splats, camera = random_splats(20), front_camera(20, 9)
    behind = splats._replace(means=splats.means - torch.tensor([0.0, 0.0, 50.0]))
    background = torch.tensor([0.1, 0.2, 0.3])
    result, gradients = run(
        behind, camera, "cuda", torch.float32, background=background, pixel_weights=some_pixel_weights(camera)
    )
    assert set(oracle.ABSGRAD) <= set(gradients)
    assert torch.equal(result.image, background.expand_as(result.image))
    assert all((gradient == 0).all() for gradient in gradients.values())
    nothing, gradients = run(RawSplats(*(tensor[:0] for tensor in splats)), camera, "cuda", torch.float32)
    assert not nothing.image.any()
    assert gradients["shN"].shape == (0, 15, 3)


def test_broken_splats_leave_the_rest_alone() -> None:
    splats, camera = random_splats(16, seed=10), front_camera(16, 12)
    broken = RawSplats(*(tensor.clone() for tensor in splats))
    for row, values in enumerate((broken.means, broken.quats, broken.scales, broken.opacities)):
        values[2 * row], values[2 * row + 1] = math.nan, -math.inf if values.ndim == 1 else math.inf
    result, gradients = run(broken, camera, "cuda", torch.float32)
    assert all(torch.isfinite(gradient).all() for gradient in gradients.values())
    rest, _ = run(RawSplats(*(tensor[8:] for tensor in splats)), camera, "cuda", torch.float32)
    assert torch.equal(result.image, rest.image)
    assert not result.radii[:8].any()


def test_visible_is_radii() -> None:
    splats, camera = random_splats(130, seed=11, log_scale=-4.0), front_camera(8, 6, cx=3.0)
    with torch.no_grad():
        rows = visible(on_device(splats), camera, backend="cuda").cpu()
        radii = render(on_device(splats), camera, backend="cuda").radii.cpu()
    assert torch.equal(rows, radii.nonzero()[:, 0])
    assert torch.equal(rows, visible(splats, camera, backend="reference"))
    assert 0 < len(rows) < 130


def test_backward_twice_gives_the_same_bits() -> None:
    leaves = on_device(random_splats(12))
    result = render(leaves, front_camera(20, 12), pixel_weights=torch.ones(12, 20), backend="cuda")
    loss, inputs = result.image.square().sum(), [*leaves, result.absgrad]
    first = torch.autograd.grad(loss, inputs, retain_graph=True)
    second = torch.autograd.grad(loss, inputs)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize(
    ("splats", "camera"),
    [
        (random_splats(24, seed=2), front_camera(17, 3)),
        (random_splats(40, seed=5, log_scale=0.5), front_camera(16, 12)),
        (uneven_splats(24), front_camera(20, 16)),
    ],
    ids=["small", "saturated", "uneven"],
)
def test_what_is_observed_is_that_of_the_oracle(splats: RawSplats, camera: Camera) -> None:
    _, gradients = assert_same(splats, camera, pixel_weights=some_pixel_weights(camera))
    assert all(gradients[name].any() for name in oracle.ABSGRAD)


def test_a_splat_of_many_tiles_is_observed_in_all_of_them() -> None:
    splats = random_splats(2, seed=2, log_scale=0.5)
    assert_same(splats, camera := front_camera(70, 36), pixel_weights=some_pixel_weights(camera))
    lens = Lens.of(camera, torch.device(DEVICE))
    boxes = project(lens, tuple(tensor.to(DEVICE) for tensor in splats), 3).boxes
    assert int((boxes[:, 2] * boxes[:, 3]).max()) > SLOTS


def test_observing_changes_nothing_else() -> None:
    splats, camera = random_splats(24, seed=5), front_camera(20, 12)
    alone, gradients = run(splats, camera, "cuda", torch.float32)
    assert alone.absgrad is None
    result, absgrad = run(splats, camera, "cuda", torch.float32, pixel_weights=some_pixel_weights(camera))
    torch.testing.assert_close(result, alone, atol=0, rtol=0)
    for name in oracle.ABSGRAD:
        assert absgrad.pop(name).any()
    # The compiler of a GPU may fuse other products and sums where there are more of them.
    rtol = 1e-5 if DEVICE == "cuda" else 0
    for name, gradient in gradients.items():
        assert (absgrad[name] - gradient).norm() <= rtol * gradient.norm(), name


@pytest.mark.parametrize("output", ["means2d", "image", "alpha", "depth"])
def test_one_output_alone_can_be_differentiated(output: str) -> None:
    splats, camera = random_splats(8, seed=14), front_camera(12, 9)
    double = RawSplats(*(tensor.double().requires_grad_() for tensor in splats))
    gradients = []
    for leaves, backend in ((on_device(splats), "cuda"), (double, "reference")):
        value = getattr(render(leaves, camera, backend=backend), output)
        weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(0)).to(value)
        (means,) = torch.autograd.grad((value * weights).sum(), leaves.means)
        gradients.append(means.cpu().double())
    torch.testing.assert_close(*gradients, atol=1e-4 * gradients[1].abs().max().item(), rtol=0)


def test_tiles_list_their_splats_front_to_back() -> None:
    boxes = torch.tensor([[1, 0, 2, 2], [0, 0, 1, 1], [0, 0, 3, 2], [2, 1, 1, 1]], dtype=torch.int32)
    tiles = list_tiles(boxes.to(DEVICE), 3, 2)
    offsets, ranks, slots = tiles.offsets.tolist(), tiles.ranks.tolist(), tiles.slots.tolist()
    lists = [ranks[begin:end] for begin, end in pairwise(offsets)]
    assert lists == [[1, 2], [0, 2], [0, 2], [2], [0, 2], [0, 2, 3]]
    assert tiles.ends.tolist() == [4, 5, 11, 12]
    assert sorted(slots) == list(range(12))
    owners = [0] * 4 + [1] + [2] * 6 + [3]
    assert [owners[slot] for slot in slots] == ranks


def test_backend_is_chosen_by_device_and_type() -> None:
    like = torch.zeros(1, device=DEVICE)
    assert resolve_backend("cuda", like) == "cuda"
    assert resolve_backend("auto", like) == ("cuda" if DEVICE == "cuda" else "cpu")
    with pytest.raises(ValueError, match="float32 tensors on a CUDA device"):
        resolve_backend("cuda", like.double())


@triton.jit
def fill_kernel(out, SIZE: tl.constexpr):
    tl.store(out + tl.arange(0, SIZE), 1.0)


@pytest.mark.skipif(DEVICE == "cuda", reason="guard words lie around what is interpreted")
def test_guard_words_find_a_planted_overrun() -> None:
    out = torch.zeros(16)
    with guarded():
        fill_kernel[(1,)](out, SIZE=16)
        assert out.sum() == 16
        with pytest.raises(GuardError, match="fill_kernel has written beside array 0"):
            fill_kernel[(1,)](out[:8], SIZE=16)
