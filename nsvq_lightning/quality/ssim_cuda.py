"""L1 and D-SSIM with their gradient: four passes over the image, each one half of a separable blur.

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

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.formulas import for_triton
from nsvq_lightning.compute.memory import check_tensor
from nsvq_lightning.quality import formulas as shared
from nsvq_lightning.quality.ssim import SSIM_RADIUS, check_pair, ssim_window

formulas = for_triton(shared)


@triton.jit
def place(ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Rows ``[ROWS, 1]`` and columns ``[1, COLUMNS]`` of this program, and its number."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)[:, None]
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    return row, column, tl.program_id(0) * tl.num_programs(1) + tl.program_id(1)


@triton.jit
def load_at(plane, row, column, height, length):
    """Values of a plane, 0 outside it."""
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < length)
    return tl.load(plane + row.to(tl.int64) * length + column, mask=inside, other=0.0)


@triton.jit
def clamped(image, row, column, height, length):
    """The image clamped to [0, 1]."""
    return formulas.clamped(load_at(image, row, column, height, length))


# The taps of the window, from the middle outwards.
TAPS, RADIUS = tl.constexpr(tuple(ssim_window()[SSIM_RADIUS:].tolist())), tl.constexpr(SSIM_RADIUS)
WHITE = tl.constexpr(255.0)


@triton.jit
def photo(target, row, column, height, length, BYTES: tl.constexpr):
    """The target in [0, 1]."""
    inside = (row >= 0) & (row < height) & (column < length)
    value = tl.load(target + row.to(tl.int64) * length + column, mask=inside, other=0).to(tl.float32)
    if BYTES:
        value = tl.div_rn(value, tl.full(value.shape, WHITE, tl.float32))
    return value


@triton.jit
def add_moments(sums, image, target, row, column, height, length, k, tap, BYTES: tl.constexpr):
    """Add the moments of the rows k above and below, which share a tap."""
    p, q = clamped(image, row - k, column, height, length), photo(target, row - k, column, height, length, BYTES)
    r, s = clamped(image, row + k, column, height, length), photo(target, row + k, column, height, length, BYTES)
    return formulas.add_moments(sums, tap, p, q, r, s)


@triton.jit
def moments_kernel(
    image, target, moments, sums, height, length, BYTES: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """Vertical blur of the four moment planes; sum of the absolute differences into ``sums[2·program]``."""
    row, column, program = place(ROWS, COLUMNS)
    p, q = clamped(image, row, column, height, length), photo(target, row, column, height, length, BYTES)
    # Beyond the border both are 0.
    tl.store(sums + 2 * program, tl.sum(tl.sum(tl.abs(p - q), 1), 0))
    blurred = formulas.moments(TAPS[0], p, q)
    for k in tl.static_range(1, RADIUS + 1):
        blurred = add_moments(blurred, image, target, row, column, height, length, k, TAPS[k], BYTES)
    inside = (row < height) & (column < length)
    size = tl.cast(height, tl.int64) * length
    at = moments + row.to(tl.int64) * length + column
    tl.store(at, blurred[0], mask=inside)
    tl.store(at + size, blurred[1], mask=inside)
    tl.store(at + 2 * size, blurred[2], mask=inside)
    tl.store(at + 3 * size, blurred[3], mask=inside)


@triton.jit
def blur_down(plane, row, column, height, length):
    """Eleven taps down a plane."""
    total = load_at(plane, row, column, height, length) * TAPS[0]
    for k in tl.static_range(1, RADIUS + 1):
        pair = load_at(plane, row - k, column, height, length) + load_at(plane, row + k, column, height, length)
        total += pair * TAPS[k]
    return total


@triton.jit
def blur_along(plane, row, column, height, length):
    """Eleven taps along the rows of interleaved RGB: neighbouring pixels are 3 floats apart."""
    total = load_at(plane, row, column, height, length) * TAPS[0]
    for k in tl.static_range(1, RADIUS + 1):
        pair = load_at(plane, row, column - 3 * k, height, length) + load_at(plane, row, column + 3 * k, height, length)
        total += pair * TAPS[k]
    return total


@triton.jit
def similarity_kernel(
    moments, derivatives, sums, height, length, DERIVED: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """Sum of SSIM into ``sums[2·program + 1]``; if ``DERIVED``, also its derivatives by blurred p, p² and p·q."""
    row, column, program = place(ROWS, COLUMNS)
    inside = (row < height) & (column < length)
    size = tl.cast(height, tl.int64) * length
    m1 = blur_along(moments, row, column, height, length)
    m2 = blur_along(moments + size, row, column, height, length)
    squares = blur_along(moments + 2 * size, row, column, height, length)
    product = blur_along(moments + 3 * size, row, column, height, length)
    similarity, by_mean, by_square, by_product = formulas.similarity(m1, m2, squares, product)
    tl.store(sums + 2 * program + 1, tl.sum(tl.sum(tl.where(inside, similarity, 0.0), 1), 0))
    if DERIVED:
        at = derivatives + row.to(tl.int64) * length + column
        tl.store(at, by_mean, mask=inside)
        tl.store(at + size, by_square, mask=inside)
        tl.store(at + 2 * size, by_product, mask=inside)


@triton.jit
def loss_kernel(sums, loss, programs, count, dssim_weight, BLOCK: tl.constexpr):
    """Add up the sums of all programs, in float64: (1 - w)·Σ|p - q|/n + w·(1 - ΣSSIM/n)."""
    difference, similarity = tl.zeros([BLOCK], tl.float64), tl.zeros([BLOCK], tl.float64)
    for start in range(0, programs, BLOCK):
        program = start + tl.arange(0, BLOCK)
        difference += tl.load(sums + 2 * program, mask=program < programs, other=0.0).to(tl.float64)
        similarity += tl.load(sums + 2 * program + 1, mask=program < programs, other=0.0).to(tl.float64)
    weight = tl.cast(dssim_weight, tl.float64)
    value = (1 - weight) * (tl.sum(difference, 0) / count) + weight * (1 - tl.sum(similarity, 0) / count)
    tl.store(loss, value.to(tl.float32))


@triton.jit
def spread_kernel(derivatives, blurred, height, length, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Vertical blur of one derivative plane, the one selected by the third axis of the grid."""
    row, column, _ = place(ROWS, COLUMNS)
    shift = tl.program_id(2).to(tl.int64) * height * length
    value = blur_down(derivatives + shift, row, column, height, length)
    at = row.to(tl.int64) * length + column
    tl.store(blurred + shift + at, value, mask=(row < height) & (column < length))


@triton.jit
def gradient_kernel(
    image, target, blurred, scale, gradient, height, length, l1_step, ssim_step, BYTES: tl.constexpr,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Gradient of ``scale`` times the loss, 0 where the image was clamped."""
    row, column, _ = place(ROWS, COLUMNS)
    size = tl.cast(height, tl.int64) * length
    raw = load_at(image, row, column, height, length)
    p, q = clamped(image, row, column, height, length), photo(target, row, column, height, length, BYTES)
    by_mean = blur_along(blurred, row, column, height, length)
    by_square = blur_along(blurred + size, row, column, height, length)
    by_product = blur_along(blurred + 2 * size, row, column, height, length)
    value = formulas.pixel_gradient(raw, p, q, by_mean, by_square, by_product, l1_step, ssim_step) * tl.load(scale)
    at = row.to(tl.int64) * length + column
    tl.store(gradient + at, value, mask=(row < height) & (column < length))


MOMENTS = 4
DERIVATIVES = 3
# Image rows per program: four floats per thread, so that registers suffice for all taps.
ROWS = 4
# Floats of each row per program, three to a pixel.
COLUMNS = 128
# Number of programs whose sums are added up at a time.
BLOCK = 1024


def _grid(image: Tensor) -> tuple[int, int]:
    """Programs down and along an image."""
    return triton.cdiv(image.shape[0], ROWS), triton.cdiv(3 * image.shape[1], COLUMNS)


def _check_pictures(image: Tensor, target: Tensor) -> None:
    check_pair(image, target)
    check_tensor("image", image, image.shape, image.device)
    kind = torch.uint8 if target.dtype == torch.uint8 else torch.float32
    check_tensor("target", target, image.shape, image.device, kind)


def l1_dssim(image: Tensor, target: Tensor, dssim_weight: float, *, derived: bool = True) -> tuple[Tensor, Tensor]:
    """Loss of ``image``, which is clamped to [0, 1] first, a float32 scalar on the device; and derivatives of SSIM.

    The derivatives, with respect to blurred p, p² and p·q, are ``[3, H, W, 3]``.

    Args:
        image: Contiguous float32 ``[H, W, 3]`` on a CUDA device, H and W at least 1.
        target: Contiguous ``[H, W, 3]`` there, float32 in [0, 1] or uint8.
        dssim_weight: Share of 1 - SSIM.
        derived: Whether :func:`l1_dssim_backward` will follow; without it there are no derivatives.

    Raises:
        ValueError: The pictures differ in shape or device or are not ``[H, W, 3]``, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    _check_pictures(image, target)
    height, width = image.shape[:2]
    length, grid = 3 * width, _grid(image)
    programs = grid[0] * grid[1]
    tile = {"ROWS": ROWS, "COLUMNS": COLUMNS, **COMPILE}
    moments = image.new_empty(MOMENTS, height, width, 3)
    planes = image.new_empty(DERIVATIVES, height, width, 3) if derived else moments
    sums, loss = image.new_empty(programs, 2), image.new_empty(())
    with torch.cuda.device_of(image):
        moments_kernel[grid](image, target, moments, sums, height, length, BYTES=target.dtype == torch.uint8, **tile)
        similarity_kernel[grid](moments, planes, sums, height, length, DERIVED=derived, **tile)
        loss_kernel[(1,)](sums, loss, programs, height * length, dssim_weight, BLOCK=BLOCK, **COMPILE)
    return loss, planes


def l1_dssim_backward(image: Tensor, target: Tensor, dssim_weight: float, derivatives: Tensor, scale: Tensor) -> Tensor:
    """Gradient ``[H, W, 3]`` of ``scale`` times the loss with respect to ``image``.

    Args:
        image: As in :func:`l1_dssim`.
        target: As in :func:`l1_dssim`.
        dssim_weight: As in :func:`l1_dssim`.
        derivatives: What :func:`l1_dssim` returned.
        scale: float32 scalar on the device.

    Raises:
        ValueError: As in :func:`l1_dssim`, or the derivatives belong to another picture.
        TypeError: A dtype is wrong.
    """
    _check_pictures(image, target)
    check_tensor("derivatives", derivatives, (DERIVATIVES, *image.shape), image.device)
    check_tensor("scale", scale, (), image.device)
    height, width = image.shape[:2]
    length, grid, count = 3 * width, _grid(image), image.numel()
    tile = {"ROWS": ROWS, "COLUMNS": COLUMNS, **COMPILE}
    blurred, gradient = torch.empty_like(derivatives), torch.empty_like(image)
    with torch.cuda.device_of(image):
        spread_kernel[(*grid, DERIVATIVES)](derivatives, blurred, height, length, **tile)
        gradient_kernel[grid](
            image, target, blurred, scale, gradient, height, length, (1 - dssim_weight) / count, dssim_weight / count,
            BYTES=target.dtype == torch.uint8, **tile,
        )  # fmt: skip
    return gradient
