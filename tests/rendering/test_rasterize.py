"""The CPU back-end against the float64 oracle, and the oracle against finite differences."""

import math
from functools import partial

import numba
import oracle
import pytest
import torch
from oracle import run
from splat_scenes import front_camera, random_splats, some_pixel_weights, uneven_splats

from nsvq_lightning.compute.devices import _warn_of_plain_torch, resolve_backend
from nsvq_lightning.io import CompressedScene
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.cpu import rasterizer
from nsvq_lightning.rendering.cpu.records import MAX_SIDE
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.rendering.reference import project
from nsvq_lightning.rendering.sampling import ViewSampling
from nsvq_lightning.skips import switched
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.importance import contributions

assert_same = partial(oracle.assert_same, "cpu")
DENSE = random_splats(400, seed=5, log_scale=-1.0)


@pytest.mark.parametrize(("sh_degree", "stored"), [(0, 0), (0, 3), (1, 1), (1, 2), (2, 3), (3, 3)])
def test_sh_degrees(sh_degree: int, stored: int) -> None:
    assert_same(random_splats(150, sh_degree=stored), front_camera(), sh_degree=sh_degree)


@pytest.mark.parametrize(("width", "height"), [(64, 64), (17, 31), (6, 3), (1, 1), (1, 50), (129, 5)])
def test_image_sizes(width: int, height: int) -> None:
    background = torch.tensor([0.2, 0.5, 0.9])
    assert_same(random_splats(120, seed=2), front_camera(width, height, cx=0.3 * width), background=background)


@pytest.mark.parametrize("count", [1, 15, 16, 17])
def test_counts_around_the_vector_width(count: int) -> None:
    assert_same(random_splats(count, seed=7), front_camera())


def test_splats_behind_and_beside_the_camera() -> None:
    splats = random_splats(200, seed=8)
    means = splats.means.clone()
    means[:50, 2] -= 8
    means[50:100, 0] += 5
    assert_same(splats._replace(means=means), front_camera())


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("count", [1, 300])
@pytest.mark.parametrize("absgrad", [False, True])
def test_bits_do_not_depend_on_the_number_of_threads(threads: int, count: int, absgrad: bool) -> None:
    if threads > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("this machine has one core")
    before = torch.get_num_threads()
    splats, camera = random_splats(count, seed=9), front_camera(150, 100)
    pixel_weights = some_pixel_weights(camera) if absgrad else None
    expected, gradients = run(splats, camera, "cpu", torch.float32, pixel_weights=pixel_weights)
    try:
        torch.set_num_threads(threads)
        result, again = run(splats, camera, "cpu", torch.float32, pixel_weights=pixel_weights)
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close((result, again), (expected, gradients), atol=0, rtol=0)


@pytest.mark.parametrize("antialiased", [False, True])
def test_no_splat_in_view_is_background(antialiased: bool) -> None:
    splats = random_splats(20)
    behind = splats._replace(means=splats.means - torch.tensor([0.0, 0.0, 50.0]))
    background = torch.tensor([0.1, 0.2, 0.3])
    result, gradients = run(
        behind, front_camera(), "cpu", torch.float32, background=background, antialiased=antialiased
    )
    assert len(visible(behind, front_camera())) == 0
    torch.testing.assert_close(result.image, background.expand_as(result.image))
    assert all((gradient == 0).all() for gradient in gradients.values())
    nothing = RawSplats(*(tensor[:0] for tensor in splats))
    for given in (background, (0.1, 0.2, 0.3), background.numpy()):
        torch.testing.assert_close(render(nothing, front_camera(), background=given).image, result.image.detach())


@pytest.mark.parametrize("attribute", ["means", "quats", "scales", "opacities"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_broken_splats_leave_the_rest_alone(attribute: str, value: float) -> None:
    splats = random_splats(100, seed=10)
    broken = splats._replace(**{attribute: splats._asdict()[attribute].clone()})
    getattr(broken, attribute)[:7] = value
    result, gradients = run(broken, front_camera(), "cpu", torch.float32)
    assert torch.isfinite(result.image).all()
    assert all(torch.isfinite(gradient).all() for gradient in gradients.values())
    if attribute in ("means", "scales") and value != -float("inf"):
        rest = RawSplats(*(tensor[7:] for tensor in splats))
        torch.testing.assert_close(result.image, render(rest, front_camera()).image, atol=1e-6, rtol=0)


@pytest.mark.parametrize("parts", [1, 20])
def test_visible_is_radii(parts: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rasterizer, "parts_of", lambda count, each: parts)
    splats, camera = random_splats(200, seed=11), front_camera(40, 30, cx=3.0)
    result = render(splats, camera)
    for backend in ("cpu", "reference"):
        assert torch.equal(visible(splats, camera, backend=backend), result.radii.nonzero()[:, 0])
    assert 0 < int((result.radii > 0).sum()) < 200


def test_two_renders_are_alive_at_once() -> None:
    splats = random_splats(100, seed=12)
    leaves = RawSplats(*(tensor.clone().requires_grad_() for tensor in splats))
    cameras = front_camera(), front_camera(50, 60)
    images = [render(leaves, camera).image for camera in cameras]
    sum(image.square().sum() for image in images).backward()
    together = leaves.means.grad
    apart = torch.zeros_like(leaves.means)
    for camera in cameras:
        single = RawSplats(*(tensor.clone().requires_grad_() for tensor in splats))
        render(single, camera).image.square().sum().backward()
        assert single.means.grad is not None
        apart += single.means.grad
    torch.testing.assert_close(together, apart)


def test_backward_twice_gives_the_same() -> None:
    leaves = RawSplats(*(tensor.clone().requires_grad_() for tensor in random_splats(50)))
    loss = render(leaves, front_camera()).image.sum()
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    second = torch.autograd.grad(loss, leaves)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_projected_centres_alone_can_be_differentiated() -> None:
    splats, camera = random_splats(60, seed=14), front_camera()
    weights = torch.randn(60, 2, generator=torch.Generator().manual_seed(0))
    gradients = []
    for backend, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        leaves = RawSplats(*(tensor.to(dtype).clone().requires_grad_() for tensor in splats))
        result = render(leaves, camera, backend=backend)
        if backend == "cpu":
            # What an earlier pass through the image has left behind must not be counted again.
            torch.autograd.grad(result.image.sum(), leaves, retain_graph=True)
        (result.means2d * weights.to(dtype)).sum().backward()
        assert leaves.means.grad is not None
        gradients.append(leaves.means.grad.double())
    torch.testing.assert_close(*gradients, atol=1e-3, rtol=1e-4)


def test_oracle_against_finite_differences() -> None:
    splats = random_splats(6, seed=13, sh_degree=1, log_scale=-1.2)
    leaves = RawSplats(*(tensor.double().requires_grad_() for tensor in splats))
    camera = front_camera(12, 9)

    def image(*tensors: torch.Tensor) -> torch.Tensor:
        return render(RawSplats(*tensors), camera, backend="reference").image

    assert torch.autograd.gradcheck(image, tuple(leaves), eps=1e-6, atol=1e-5)


@pytest.mark.parametrize(
    ("splats", "camera"),
    [
        (random_splats(120, seed=2), front_camera()),
        (random_splats(120, seed=2), front_camera(64, 64)),
        (random_splats(120, seed=2), front_camera(17, 31)),
        (random_splats(120, seed=2), front_camera(1, 50)),
        (DENSE._replace(opacities=DENSE.opacities + 5), front_camera(129, 33)),
        (random_splats(1, seed=7), front_camera()),
        (uneven_splats(120), front_camera(90, 61)),
    ],
    ids=["plain", "whole tiles", "small", "column", "saturated", "one", "uneven"],
)
def test_what_is_observed_is_that_of_the_oracle(splats: RawSplats, camera: Camera) -> None:
    _, gradients = assert_same(splats, camera, pixel_weights=some_pixel_weights(camera))
    assert all(gradients[name].any() for name in oracle.ABSGRAD)


@pytest.mark.parametrize(("backend", "dtype"), [("cpu", torch.float32), ("reference", torch.float64)])
def test_absolute_gradients_are_those_of_one_pixel_at_a_time(backend: str, dtype: torch.dtype) -> None:
    splats, camera = random_splats(6, seed=13, sh_degree=0, log_scale=-1.2), front_camera(19, 9)
    leaves = RawSplats(*(tensor.to(dtype).requires_grad_() for tensor in splats))
    result = render(leaves, camera, pixel_weights=some_pixel_weights(camera), backend=backend)
    outputs = torch.cat([result.image, result.alpha[..., None], result.depth[..., None]], -1)
    weights = torch.randn(outputs.shape, generator=torch.Generator().manual_seed(2)).to(dtype)
    losses = (weights * outputs).sum(-1).flatten()
    expected = torch.zeros(6, 2, dtype=dtype)
    for loss in losses:
        expected += torch.autograd.grad(loss, result.means2d, retain_graph=True)[0].abs()
    assert result.absgrad is not None
    summed, absgrad = torch.autograd.grad(losses.sum(), [result.means2d, result.absgrad])
    assert (expected > 1.5 * summed.abs()).any()
    torch.testing.assert_close(absgrad[:, :2], expected, atol=1e-4 if backend == "cpu" else 1e-12, rtol=1e-4)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_weights_by_a_map_of_ones_are_the_contributions(backend: str) -> None:
    splats, camera = random_splats(150, seed=3), front_camera()
    expected = contributions(splats, [camera], partial(render, backend=backend))
    leaves = RawSplats(*(tensor.requires_grad_() for tensor in splats))
    result = render(leaves, camera, pixel_weights=torch.ones(45, 70), backend=backend)
    result.image.sum().backward()
    assert result.absgrad is not None
    assert result.absgrad.grad is not None
    torch.testing.assert_close(result.absgrad.grad[:, 2], expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_observing_changes_no_bit_of_the_rest(backend: str) -> None:
    splats, camera = random_splats(300, seed=5), front_camera()
    alone, gradients = run(splats, camera, backend, torch.float32)
    result, absgrad = run(splats, camera, backend, torch.float32, pixel_weights=some_pixel_weights(camera))
    torch.testing.assert_close(result, alone, atol=0, rtol=0)
    for name in oracle.ABSGRAD:
        assert absgrad.pop(name).any()
    torch.testing.assert_close(absgrad, gradients, atol=0, rtol=0)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_nothing_is_observed_unless_asked_and_nothing_where_nothing_is_in_view(backend: str) -> None:
    splats, camera = random_splats(20), front_camera()
    assert render(splats, camera, backend=backend).absgrad is None
    behind = splats._replace(means=splats.means - torch.tensor([0.0, 0.0, 50.0]))
    _, gradients = run(behind, camera, backend, torch.float32, pixel_weights=some_pixel_weights(camera))
    assert not any(gradients[name].any() for name in oracle.ABSGRAD)


def test_a_map_is_taken_in_any_type_and_layout_and_gets_no_gradient() -> None:
    splats, camera = random_splats(40, seed=2), front_camera()
    strength = some_pixel_weights(camera).double().T.contiguous().T.requires_grad_()
    _, expected = run(splats, camera, "cpu", torch.float32, pixel_weights=strength.detach().float().contiguous())
    _, gradients = run(splats, camera, "cpu", torch.float32, pixel_weights=strength)
    torch.testing.assert_close(gradients, expected, atol=0, rtol=0)
    assert strength.grad is None


def test_auto_takes_the_fast_backend_or_says_once_that_a_device_has_none(caplog: pytest.LogCaptureFixture) -> None:
    assert resolve_backend("auto", torch.zeros(1)) == "cpu"
    like = torch.zeros(1, device="meta")
    _warn_of_plain_torch.cache_clear()
    assert resolve_backend("auto", like.double()) == "reference"
    assert caplog.messages == []
    assert [resolve_backend("auto", like) for _ in range(2)] == ["reference", "reference"]
    (message,) = caplog.messages
    assert message.startswith("rendering on meta in plain torch")
    assert "got torch.float32 on meta" in message


def test_bad_arguments_say_what_to_do() -> None:
    splats, camera = Splats.from_tensors(*random_splats(3)), front_camera()
    with pytest.raises(ValueError, match="choose one of"):
        render(splats, camera, backend="vulkan")
    with pytest.raises(ValueError, match="sh_degree"):
        render(splats, camera, sh_degree=4)
    with pytest.raises(ValueError, match="background"):
        render(splats, camera, background=torch.zeros(4))
    for shape in ((70, 45), (45, 70, 1), (45 * 70,)):
        with pytest.raises(ValueError, match=rf"must be \[45, 70\], got \[{', '.join(map(str, shape))}\]"):
            render(splats, camera, pixel_weights=torch.zeros(shape))
    with pytest.raises(ValueError, match="float64"):
        render(RawSplats(*(tensor.double() for tensor in splats.raw())), camera, backend="cpu")


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "sh0", "shN"])
def test_attributes_that_do_not_belong_together_are_refused(name: str) -> None:
    """Kernels would read foreign memory."""
    splats, camera = random_splats(20), front_camera()
    for function in (render, visible):
        with pytest.raises(ValueError, match=f"{name} must be torch.float32 on cpu as the means are"):
            function(splats._replace(**{name: getattr(splats, name).double()}), camera)
        with pytest.raises(ValueError, match=f"{name} must have shape"):
            function(splats._replace(**{name: getattr(splats, name)[:5]}), camera)


def test_what_has_no_tensors_is_refused_with_a_way() -> None:
    splats, camera = random_splats(20), front_camera()
    for other in (splats._asdict(), CompressedScene.from_splats(splats), None):
        for function in (render, visible):
            with pytest.raises(TypeError, match=r"must be Splats, as Splats.from_tensors.*, got .*class"):
                function(other, camera)  # type: ignore[arg-type]


def test_cameras_that_no_back_end_renders_are_refused() -> None:
    camera = front_camera()
    for entry, value, message in (
        ((0, 1), 30.0, r"without skew, got \[\[.*30.0"),
        ((0, 0), math.inf, "positive, finite focal"),
    ):
        K = camera.K.clone()
        K[entry] = value
        with pytest.raises(ValueError, match=message):
            Camera(K, camera.viewmat, camera.width, camera.height)


def test_cameras_that_are_not_rigid_are_refused() -> None:
    """Such as INRIA's transposed ``world_view_transform``."""
    camera = front_camera()
    rigid = camera.viewmat.clone()
    rigid[:3, 3] = torch.tensor([0.1, 0.2, 3.0])
    assert Camera(camera.K, rigid, 4, 3).packed_view[9:12] == pytest.approx((0.1, 0.2, 3.0))
    mirrored, scaled = torch.diag(torch.tensor([-1.0, 1, 1, 1])), torch.diag(torch.tensor([2.0, 2, 2, 1]))
    unknown = rigid.clone()
    unknown[1, 3] = math.nan
    for wrong in (rigid.T, rigid @ mirrored, rigid @ scaled, unknown):
        with pytest.raises(ValueError, match=r"viewmat must be world to camera.* transposed, mirrored or scaled"):
            Camera(camera.K, wrong, 4, 3)
    for entry, value in (((2, 2), 2.0), ((1, 0), 5.0), ((0, 2), math.nan)):
        K = camera.K.clone()
        K[entry] = value
        with pytest.raises(ValueError, match=r"Camera\.K"):
            Camera(K, rigid, 4, 3)


def test_degrees_and_types_that_cannot_be_rendered_are_refused() -> None:
    splats, camera = random_splats(20), front_camera()
    whole = render(splats, camera, sh_degree=1).image
    assert torch.equal(render(splats, camera, sh_degree=torch.tensor(1)).image, whole)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="sh_degree must be between 0 and the stored degree"):
        render(splats, camera, sh_degree=0.5)  # type: ignore[arg-type]
    for dtype in (torch.bfloat16, torch.float16):
        with pytest.raises(ValueError, match=f"float32 or float64 to be rendered, got {dtype}"):
            render(type(splats)(*(tensor.to(dtype) for tensor in splats)), camera)


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_what_the_rasterizer_skips_changes_no_bit(sh_degree: int) -> None:
    splats, camera = random_splats(3000, log_scale=-1.5)._replace(opacities=torch.full((3000,), 4.0)), front_camera()
    standard, gradients = run(splats, camera, "cpu", torch.float32, sh_degree=sh_degree)
    assert (standard.alpha > 0.999).float().mean() > 0.5
    with switched(blocks=False):
        everything, all_gradients = run(splats, camera, "cpu", torch.float32, sh_degree=sh_degree)
    assert torch.equal(everything.image, standard.image)
    assert torch.equal(everything.depth, standard.depth)
    assert [key for key in gradients if not torch.equal(gradients[key], all_gradients[key])] == []


@pytest.mark.parametrize("upright", [True, False])
def test_the_largest_image_is_right_and_a_larger_one_refused(upright: bool) -> None:
    """Against a small image of the same view by the oracle. More tiles have no place in a record of 16 bits."""
    splats, largest, small = random_splats(5, seed=8, log_scale=0.0), MAX_SIDE, 2048

    def camera(side: int) -> Camera:
        width, height = (1, side) if upright else (side, 1)
        K = torch.tensor([[width, 0, 0.5 * width], [0, height, 0.5 * height], [0, 0, 1]])
        return Camera(K, front_camera().viewmat, width, height)

    image = render(splats, camera(largest), backend="cpu").image.reshape(largest, 3)
    expected = render(splats, camera(small), backend="reference").image.reshape(small, 3)
    assert expected.amax(1).count_nonzero() > small // 4
    middles = ((torch.arange(small) + 0.5) * (largest / small)).long()
    assert (image[middles] - expected).abs().max() < 1e-2
    for function in (render, visible):
        with pytest.raises(ValueError, match=f"may have {largest} pixels.*render it in parts"):
            function(splats, camera(largest + 1), backend="cpu")


@pytest.mark.parametrize("name", RawSplats._fields)
def test_data_exchanged_before_the_backward_pass_are_refused(name: str) -> None:
    """Autograd does not see an assignment to ``.data``; the gradients would be written over other memory."""
    leaves = RawSplats(*(tensor.requires_grad_() for tensor in random_splats(50)))
    image = render(leaves, front_camera(), backend="cpu").image
    tensor = getattr(leaves, name)
    tensor.data = tensor.data[:20]
    with pytest.raises(ValueError, match=rf"{name} had shape \[50.*add or remove splats only after it"):
        image.sum().backward()


@pytest.mark.parametrize("log_scale", [-5.0, -3.5, -2.0])
def test_anti_aliasing_is_that_of_the_oracle(log_scale: float) -> None:
    splats, camera = random_splats(300, log_scale=log_scale), front_camera()
    ours, _ = assert_same(splats, camera, antialiased=True, tolerance=2e-4)
    assert (render(splats, camera).image - ours.image).abs().max() > 0.01


def test_the_factor_is_that_of_the_determinants() -> None:
    """A splat of known size, straight ahead: √(s² / (s² + 0.3)) along each axis of the picture."""
    camera = front_camera()
    depth, pixels = 4.0, 0.5
    forward, position = camera.viewmat[2, :3], -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    scale = pixels * depth / camera.intrinsics[0]
    splats = RawSplats(
        means=(position + depth * forward)[None].float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), scale).log(),
        opacities=torch.tensor([0.3]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )
    along = camera.intrinsics[1] / camera.intrinsics[0]
    expected = math.prod((size / (size + 0.3)) ** 0.5 for size in (pixels**2, (pixels * along) ** 2))
    found = project(splats, camera, ViewSampling(torch.zeros(2, 1), 0.0)).opacities / splats.opacities.sigmoid()
    assert float(found) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_pictures_are_alike_at_half_and_double_resolution(factor: float) -> None:
    """Against the mean of many small pixels, in which the blur is nothing."""
    splats, camera = random_splats(400, log_scale=-4.2), front_camera(64, 48)

    def scaled(factor: float) -> Camera:
        stretch = torch.diag(torch.tensor([factor, factor, 1.0]))
        return Camera(stretch @ camera.K, camera.viewmat, int(64 * factor), int(48 * factor))

    fine = render(splats, scaled(16 * factor)).image
    fine = fine.reshape(int(48 * factor), 16, int(64 * factor), 16, 3).mean((1, 3))
    errors = {
        antialiased: float((render(splats, scaled(factor), antialiased=antialiased).image - fine).abs().mean())
        for antialiased in (False, True)
    }
    assert errors[True] < 0.5 * errors[False]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("sampling", [None, 1e-30, 1e30, 40.0])
def test_broken_and_huge_splats_do_no_harm_to_sampling(backend: str, sampling: float | None) -> None:
    camera, splats = front_camera(), random_splats(40)
    splats.means[0], splats.scales[1], splats.quats[2] = torch.nan, 40.0, 0.0
    splats.opacities[3], splats.opacities[4], splats.scales[5] = 60.0, -60.0, -60.0
    splats.means[6] = -splats.means[6] * 10
    dtype = torch.float32 if backend == "cpu" else torch.float64
    result, gradients = run(splats, camera, backend, dtype, antialiased=sampling is None, sampling=sampling)
    assert result.image.isfinite().all()
    assert all(gradient[1:].isfinite().all() for gradient in gradients.values())
