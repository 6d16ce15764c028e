"""The photometric loss with its gradient: four passes over the image, each one half of a separable blur.

Forward: vertical blur of the four moment planes, then their horizontal blur, SSIM and its derivatives with respect to
three of the blurred planes. Backward: vertical and horizontal blur of these derivatives (the blur is its own adjoint),
which is the gradient. A program reads its neighbourhood tap by tap and relies on the L1 cache to fetch it only once.

Every program writes its own sums and one program adds them up: no atomics, the same bits every time. Nothing is read
back from the device.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.language import constexpr

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.formulas import for_triton
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.quality import formulas as shared
from nsvq_lightning.quality.formulas import DERIVATIVES, MOMENTS, SSIM_RADIUS, ssim_window

formulas = for_triton(shared)

# The taps of the window, from the middle outwards.
TAPS, RADIUS = constexpr(tuple(ssim_window()[SSIM_RADIUS:].tolist())), constexpr(SSIM_RADIUS)
LOG_WEIGHT, MIN_ERROR = constexpr(shared.LOG_WEIGHT), constexpr(shared.MIN_ERROR)
# Image rows per program: four floats per thread, so that registers suffice for all taps.
ROWS = 4
# Floats of each row per program, three to a pixel.
COLUMNS = 128
# Further arguments of every kernel that works on planes.
TILE = {"ROWS": ROWS, "COLUMNS": COLUMNS, **COMPILE}
# Number of programs whose sums are added up at a time.
BLOCK = 1024


@triton.jit
def place(height, length, ROWS: constexpr, COLUMNS: constexpr):
    """Where this program works: rows ``[ROWS, 1]``, columns ``[1, COLUMNS]``; height and length of a plane."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)[:, None]
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    return row, column, height, length


@triton.jit
def program_number():
    """Number of this program among all that work on a plane."""
    return tl.program_id(0) * tl.num_programs(1) + tl.program_id(1)


@triton.jit
def plane_of(planes, number, at):
    """Where a plane begins; they follow one another."""
    _, _, height, length = at
    return planes + tl.cast(height, tl.int64) * length * number


@triton.jit
def pointers(plane, at, down, along):
    """To this program's place in a plane, moved so many rows down and floats along; and which are inside the plane."""
    row, column, height, length = at
    row, column = row + down, column + along
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < length)
    return plane + row.to(tl.int64) * length + column, inside


@triton.jit
def load_at(plane, at, down, along):
    """Values of a plane, 0 outside it."""
    place, inside = pointers(plane, at, down, along)
    return tl.load(place, mask=inside, other=0)


@triton.jit
def store_at(plane, at, values):
    """Store the values at this program's own place in a plane."""
    place, inside = pointers(plane, at, 0, 0)
    tl.store(place, values, mask=inside)


WHITE = constexpr(255.0)


@triton.jit
def pixels(image, target, at, down, BYTES: constexpr):
    """The image clamped to [0, 1], and the target in [0, 1], so many rows down."""
    p = formulas.clamped(load_at(image, at, down, 0))
    q = load_at(target, at, down, 0).to(tl.float32)
    if BYTES:
        q = tl.div_rn(q, tl.full(q.shape, WHITE, tl.float32))
    return p, q


@triton.jit
def moments_kernel(
    image, target, moments, sums, height, length, PSNR: constexpr, BYTES: constexpr, ROWS: constexpr, COLUMNS: constexpr
):  # fmt: skip
    """Vertical blur of the four moment planes; sum of absolute or squared differences into ``sums[2·program]``."""
    at = place(height, length, ROWS, COLUMNS)
    p, q = pixels(image, target, at, 0, BYTES)
    # Beyond the border both are 0.
    error = (p - q) * (p - q) if PSNR else tl.abs(p - q)
    tl.store(sums + 2 * program_number(), tl.sum(tl.sum(error, 1), 0))
    blurred = formulas.moments(TAPS[0], p, q)
    for k in tl.static_range(1, RADIUS + 1):
        p, q = pixels(image, target, at, -k, BYTES)
        r, s = pixels(image, target, at, k, BYTES)
        blurred = formulas.add_moments(blurred, TAPS[k], p, q, r, s)
    for plane in tl.static_range(4):
        store_at(plane_of(moments, plane, at), at, blurred[plane])


@triton.jit
def blur(plane, at, down, along):
    """Eleven taps of a plane that are so many rows and floats apart."""
    total = load_at(plane, at, 0, 0) * TAPS[0]
    for k in tl.static_range(1, RADIUS + 1):
        total += (load_at(plane, at, -k * down, -k * along) + load_at(plane, at, k * down, k * along)) * TAPS[k]
    return total


@triton.jit
def blur_along(plane, at):
    """Eleven taps along the rows of interleaved RGB: neighbouring pixels are 3 floats apart."""
    return blur(plane, at, 0, 3)


@triton.jit
def similarity_kernel(
    moments, derivatives, sums, height, length, DERIVED: constexpr, ROWS: constexpr, COLUMNS: constexpr
):  # fmt: skip
    """Sum of SSIM into ``sums[2·program + 1]``; if ``DERIVED``, also its derivatives by blurred p, p² and p·q."""
    at = place(height, length, ROWS, COLUMNS)
    program = program_number()  # first, which saves registers
    m1 = blur_along(moments, at)
    m2 = blur_along(plane_of(moments, 1, at), at)
    squares = blur_along(plane_of(moments, 2, at), at)
    product = blur_along(plane_of(moments, 3, at), at)
    similarity, slopes = formulas.similarity(m1, m2, squares, product)
    _, inside = pointers(moments, at, 0, 0)
    tl.store(sums + 2 * program + 1, tl.sum(tl.sum(tl.where(inside, similarity, 0.0), 1), 0))
    if DERIVED:
        for plane in tl.static_range(len(slopes)):
            store_at(plane_of(derivatives, plane, at), at, slopes[plane])


@triton.jit
def loss_kernel(sums, loss, programs, count, dssim_weight, PSNR: constexpr, BLOCK: constexpr):
    """Add up the sums of all programs, in float64; the loss is followed by the steps of its gradient.

    It is (1 - w)·Σ|p - q|/n + w·(1 - ΣSSIM/n), the first sum replaced by 0.016·ln(Σ(p - q)²/n + 1e-5) for PSNR.
    """
    difference = tl.zeros([BLOCK], tl.float64)
    similarity = tl.zeros([BLOCK], tl.float64)
    for start in range(0, programs, BLOCK):
        program = start + tl.arange(0, BLOCK)
        difference += tl.load(sums + 2 * program, mask=program < programs, other=0.0).to(tl.float64)
        similarity += tl.load(sums + 2 * program + 1, mask=program < programs, other=0.0).to(tl.float64)
    weight = tl.cast(dssim_weight, tl.float64)
    error = tl.sum(difference, 0) / count
    l1_step, l2_step = (1 - weight) / count, (1 - weight) * 0.0
    if PSNR:
        error += MIN_ERROR
        l1_step, l2_step = l2_step, l1_step * (2 * LOG_WEIGHT) / error
        error = LOG_WEIGHT * tl.log(error)
    value = (1 - weight) * error + weight * (1 - tl.sum(similarity, 0) / count)
    numbers = (value, l1_step, l2_step, weight / count)
    for k in tl.static_range(len(numbers)):
        tl.store(loss + k, numbers[k].to(tl.float32))


@triton.jit
def spread_kernel(derivatives, blurred, height, length, ROWS: constexpr, COLUMNS: constexpr):
    """Vertical blur of one derivative plane, the one selected by the third axis of the grid."""
    at = place(height, length, ROWS, COLUMNS)
    plane = tl.program_id(2)
    spread = blur(plane_of(derivatives, plane, at), at, 1, 0)
    store_at(plane_of(blurred, plane, at), at, spread)


@triton.jit
def gradient_kernel(
    image, target, blurred, steps, scale, gradient, height, length,
    BYTES: constexpr, ROWS: constexpr, COLUMNS: constexpr,
):  # fmt: skip
    """Gradient of ``scale`` times the loss, 0 where the image was clamped."""
    at = place(height, length, ROWS, COLUMNS)
    squares, products = plane_of(blurred, 1, at), plane_of(blurred, 2, at)  # first, which saves registers
    raw = load_at(image, at, 0, 0)
    p, q = pixels(image, target, at, 0, BYTES)
    slopes = (blur_along(blurred, at), blur_along(squares, at), blur_along(products, at))
    steps = (tl.load(steps), tl.load(steps + 1), tl.load(steps + 2))
    value = formulas.pixel_gradient(raw, p, q, slopes, steps)
    store_at(gradient, at, value * tl.load(scale))


def _launch(image: Tensor, target: Tensor, *more: Tensor) -> tuple[tuple[int, int], tuple[int, int], bool]:
    """How kernels are launched on a pair of pictures, after a check of these and of what else a backward pass gets.

    Returns:
        Programs down and along them; their rows, and floats in a row; whether the target is uint8.
    """
    of_bytes = target.dtype == torch.uint8
    pair = f"image [H, W, 3], target [H, W, 3] {'uint8' if of_bytes else 'float32'}"
    check_fit(f"{pair}, derivatives [{DERIVATIVES}, H, W, 3], steps [3], scale []", image, target, *more)
    height, width, _ = image.shape
    grid = triton.cdiv(height, ROWS), triton.cdiv(3 * width, COLUMNS)
    return grid, (height, 3 * width), of_bytes


def fused_loss(
    image: Tensor, target: Tensor, dssim_weight: float, *, psnr: bool = False, derived: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """Loss of ``image``, which is clamped to [0, 1] first, a float32 scalar on the device; and what its gradient needs.

    That is derivatives of SSIM with respect to blurred p, p² and p·q ``[3, H, W, 3]``, and the steps ``[3]`` of
    :func:`nsvq_lightning.quality.formulas.pixel_gradient`.

    Args:
        image: Contiguous float32 ``[H, W, 3]`` on a CUDA device, H and W at least 1.
        target: Contiguous ``[H, W, 3]`` there, float32 in [0, 1] or uint8.
        dssim_weight: Share of 1 - SSIM.
        psnr: Whether the rest is for PSNR instead of L1.
        derived: Whether :func:`fused_loss_backward` will follow; without it there are no derivatives.

    Raises:
        ValueError: The pictures differ in shape or device or are not ``[H, W, 3]``, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    grid, size, of_bytes = _launch(image, target)
    programs = grid[0] * grid[1]
    moments = image.new_empty(MOMENTS, *image.shape)
    planes = image.new_empty(DERIVATIVES, *image.shape) if derived else moments
    sums = image.new_empty(programs, 2)
    loss = image.new_empty(4)
    with torch.cuda.device_of(image):
        moments_kernel[grid](image, target, moments, sums, *size, PSNR=psnr, BYTES=of_bytes, **TILE)
        similarity_kernel[grid](moments, planes, sums, *size, DERIVED=derived, **TILE)
        loss_kernel[(1,)](sums, loss, programs, image.numel(), dssim_weight, PSNR=psnr, BLOCK=BLOCK, **COMPILE)
    return loss[0], planes, loss[1:]


def fused_loss_backward(image: Tensor, target: Tensor, derivatives: Tensor, steps: Tensor, scale: Tensor) -> Tensor:
    """Gradient ``[H, W, 3]`` of ``scale`` times the loss with respect to ``image``.

    Args:
        image: As in :func:`fused_loss`.
        target: As in :func:`fused_loss`.
        derivatives: What :func:`fused_loss` returned.
        steps: What :func:`fused_loss` returned.
        scale: float32 scalar on the device.

    Raises:
        ValueError: As in :func:`fused_loss`, or the derivatives belong to another picture.
        TypeError: A dtype is wrong.
    """
    grid, size, of_bytes = _launch(image, target, derivatives, steps, scale)
    blurred = torch.empty_like(derivatives)
    gradient = torch.empty_like(image)
    with torch.cuda.device_of(image):
        spread_kernel[(*grid, DERIVATIVES)](derivatives, blurred, *size, **TILE)
        gradient_kernel[grid](image, target, blurred, steps, scale, gradient, *size, BYTES=of_bytes, **TILE)
    return gradient
