"""The oracle: Gaussian splatting in plain torch, on any device and in any floating-point type.

Written for correctness, not for speed: the fast back-ends are tested against it in float64.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from nsvq_lightning.rendering import constants
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.sampling import Layers, Shading, ViewSampling
from nsvq_lightning.rendering.sh import sh_colors
from nsvq_lightning.splats.conventions import MIN_SQUARED_NORM
from nsvq_lightning.splats.splats import RawSplats, SplatTensors, times_vectors


class Projection(NamedTuple):
    """Splats on the image plane.

    Attributes:
        means2d: Projected centres ``[N, 2]``, pixels.
        conics: Inverse covariances with the blur ``[N, 3]``: xx, xy, yy, 1 / square pixels.
        opacities: Opacities ``[N]`` in [0, 1].
        depths: View-space z ``[N]``.
        half_sizes: Half width and height ``[N, 2]`` in pixels of the box outside which α stays below 1/255; 0 for a
            splat that never reaches it.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    depths: Tensor
    half_sizes: Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations ``[N, 3, 3]`` of quaternions ``[N, 4]`` (wxyz, any norm; zero is the identity)."""
    # Squares of a huge quaternion would overflow.
    huge = quats.detach().abs().amax(-1, keepdim=True) > constants.HUGE_QUATERNION
    quats = quats * torch.where(huge, constants.SHRINK, 1.0)
    norm = quats.square().sum(-1, keepdim=True).clamp_min(MIN_SQUARED_NORM).sqrt()
    w, x, y, z = (quats / norm).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def image_axes(
    means: Tensor, quats: Tensor, scales: Tensor, camera: Camera
) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """View-space x, y, z ``[N]`` of splats, and their axes along x and along y of the image ``[N, 3]``, pixels."""
    viewmat = camera.viewmat.to(means).clone()  # one that was made for an evaluation cannot be trained with
    fx, fy, _, _ = camera.intrinsics
    x, y, z = (times_vectors(viewmat[:3, :3], means) + viewmat[:3, 3]).unbind(1)
    low_x, high_x, low_y, high_y = camera.slope_limits
    slope_x, slope_y = (x / z).clamp(low_x, high_x), (y / z).clamp(low_y, high_y)
    right, down, forward = viewmat[:3, :3]
    across = (right - slope_x[:, None] * forward) * (fx / z)[:, None]
    along = (down - slope_y[:, None] * forward) * (fy / z)[:, None]
    axes = rotation_matrices(quats) * scales.exp()[:, None, :]
    return (x, y, z), (across[:, :, None] * axes).sum(1), (along[:, :, None] * axes).sum(1)


def sampling_ratio(squared: Tensor, sampling: ViewSampling | None) -> Tensor:
    """r² ``[N]``: pixels per unit of world at splats of squared distances ``[N]``, relative to training, squared.

    Within the distances of training, that is (focal length here / there)²; 1 where training is not known.
    """
    if sampling is None:
        return torch.ones_like(squared)
    nearest, farthest = sampling.distances.to(squared).square()
    trained = torch.where(squared < nearest, nearest, squared.clamp_max(farthest))
    return sampling.size * (trained / squared).clamp_max(constants.MAX_RATIO)


def project(splats: SplatTensors, camera: Camera, sampling: ViewSampling | None = None) -> Projection:
    """Project splats through the local affine approximation of the camera (EWA splatting).

    The determinant uses Lagrange's identity, |u|²|v|² - (u·v)² = |u × v|²: the naive difference loses every digit for
    splats of thousands of pixels. The determinant of a huge splat is taken in units of its size, or it would overflow.

    The blur that splats were trained with is blur·r² here. Where that is less than a pixel's own, opacities are
    multiplied by √(det(Σ + blur·r²·I) / det(Σ + blur·I)): with r = 0, which is anti-aliasing, the factor of
    Mip-Splatting's 2D filter (Yu et al. 2024). The blur does not matter to huge splats.
    """
    fx, fy, cx, cy = camera.intrinsics
    (x, y, z), u, v = image_axes(splats.means, splats.quats, splats.scales, camera)
    xx, xy, yy = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    size = (xx + yy).detach()
    unit = torch.where(size > constants.HUGE_FOOTPRINT, 1 / size, 1.0)
    area = (torch.linalg.cross(u, v) * unit[:, None]).square().sum(-1)
    trained = constants.BLUR * sampling_ratio(x * x + y * y + z * z, sampling)
    blur = trained.clamp_min(constants.BLUR)
    kept, determinant = (area + b * (xx + yy + b) * unit * unit for b in (trained, blur))
    conics = torch.stack([yy + blur, -xy, xx + blur], -1) * (unit / determinant * unit)[:, None]
    light = (kept / determinant).clamp_min(constants.FAINTEST * constants.FAINTEST).sqrt()
    dimmed = (trained < constants.BLUR) & (size < constants.HUGE_FOOTPRINT)
    opacities = torch.sigmoid(splats.opacities) * torch.where(dimmed, light, 1.0)
    reach = 2 * (opacities.detach() / constants.ALPHA_MIN).log().clamp_min(0)
    half = (reach[:, None] * torch.stack([xx + blur, yy + blur], -1).detach()).sqrt()
    return Projection(torch.stack([fx * x / z + cx, fy * y / z + cy], -1), conics, opacities, z, half)


@torch.no_grad()
def visible(splats: SplatTensors, camera: Camera, sampling: ViewSampling | None = None) -> Tensor:
    """Rows ``[V]`` of the splats in front of the near plane that reach 1/255 at a pixel centre of the image.

    Those with a non-finite geometry are left out.
    """
    means2d, conics, _, depths, half_sizes = project(splats, camera, sampling)
    low = (means2d - half_sizes - 0.5).ceil().clamp_min(0)
    size = means2d.new_tensor([camera.width - 1, camera.height - 1])
    high = torch.minimum((means2d + half_sizes - 0.5).floor(), size)
    reached = (half_sizes > 0).all(-1) & (low <= high).all(-1)
    return ((depths > camera.near) & reached & torch.isfinite(conics).all(-1)).nonzero()[:, 0]


def render(splats: RawSplats, camera: Camera, shading: Shading) -> Layers:
    """Image ``[H, W, 3]``, alpha ``[H, W]``, radii ``[N]``, means2d ``[N, 2]`` and depth ``[H, W]``, differentiable.

    See :func:`nsvq_lightning.render` for the meaning of arguments and results.
    """
    sh_degree, sampling, background, pixel_weights, absgrad = shading
    rows = visible(splats, camera, sampling)
    shown = splats.take(rows)
    projection = project(shown, camera, None if sampling is None else sampling.of(rows))
    n = len(splats.means)
    means2d = splats.means.new_zeros(n, 2).index_copy(0, rows, projection.means2d)
    radii = rows.new_zeros(n, dtype=torch.int32)
    radii[rows] = projection.half_sizes.amax(-1).ceil().clamp_max(2**30).to(torch.int32)

    direction = shown.means - camera.to(shown.means.device, shown.means.dtype).position
    direction = direction / direction.square().sum(-1, keepdim=True).clamp_min(1e-20).sqrt()
    features = torch.cat([sh_colors(direction, shown.sh0, shown.shN, sh_degree), projection.depths[:, None]], -1)
    projection = projection._replace(means2d=means2d[rows])

    order = torch.sort(projection.depths.detach(), stable=True).indices
    low = (projection.means2d - projection.half_sizes).detach()[order]
    high = (projection.means2d + projection.half_sizes).detach()[order]
    if pixel_weights is None or absgrad is None:
        pixel_weights, absgrad = features.new_zeros(camera.height, camera.width), features.new_zeros(n, 3)
    watched = absgrad[rows]
    side = 32  # of the squares that are blended at a time, pixels
    strips = []
    for top in range(0, camera.height, side):
        bottom = min(top + side, camera.height)
        tiles = []
        for left in range(0, camera.width, side):
            right = min(left + side, camera.width)
            here = (low[:, 0] <= right) & (high[:, 0] >= left) & (low[:, 1] <= bottom) & (high[:, 1] >= top)
            near = order[here]
            down, across = torch.arange(top, bottom).to(features), torch.arange(left, right).to(features)
            pixels = torch.cartesian_prod(down, across).flip(1) + 0.5
            weights_here = pixel_weights[top:bottom, left:right].ravel()
            splats_here = Projection(*(each[near] for each in projection))
            inputs = pixels, splats_here, features[near], weights_here, watched[near]
            blended = checkpoint(_blend, *inputs, use_reentrant=False)
            tiles.append(blended.view(bottom - top, right - left, 5))
        strips.append(torch.cat(tiles, 1))
    blended = torch.cat(strips, 0)
    transmittance = blended[..., 4]
    return blended[..., :3] + transmittance[..., None] * background, 1 - transmittance, radii, means2d, blended[..., 3]


class _WatchOffsets(torch.autograd.Function):
    """Offsets ``[P, n, 2]`` unchanged; their absolute gradients, summed over the pixels, go to ``[n, 2]`` zeros."""

    @staticmethod
    def forward(ctx: Any, offsets: Tensor, zeros: Tensor) -> Tensor:
        return offsets.view_as(offsets)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor | None]:
        return gradient, gradient.abs().sum(0) if ctx.needs_input_grad[1] else None


class _WatchWeights(torch.autograd.Function):
    """Weights ``[P, n]`` unchanged; Σ weight · pixel weight over the pixels goes to ``[n]`` zeros as their gradient."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, pixel_weights: Tensor, zeros: Tensor) -> Tensor:
        ctx.save_for_backward(weights, pixel_weights)
        return weights.view_as(weights)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, Tensor | None]:
        weights, pixel_weights = ctx.saved_tensors
        return gradient, None, pixel_weights @ weights if ctx.needs_input_grad[2] else None


def _blend(pixels: Tensor, splats: Projection, features: Tensor, pixel_weights: Tensor, absgrad: Tensor) -> Tensor:
    """Front-to-back blend of sorted splats at ``pixels [P, 2]``: Σ w·feature and the transmittance left ``[P, 5]``."""
    means2d, conics, opacities, _, _ = splats
    offsets: Tensor = _WatchOffsets.apply(pixels[:, None] - means2d[None], absgrad[:, :2])  # type: ignore[no-untyped-call]
    dx, dy = offsets.unbind(-1)
    power = -0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) - conics[:, 1] * dx * dy
    alpha = (opacities * power.clamp_max(0).exp()).clamp_max(constants.ALPHA_MAX)
    alpha = torch.where(alpha >= constants.ALPHA_MIN, alpha, 0.0)
    with torch.no_grad():
        running = (1 - alpha).cumprod(1) >= constants.TRANSMITTANCE_MIN
    alpha = torch.where(running, alpha, 0.0)
    transmittance = torch.cat([pixels.new_ones(len(pixels), 1), (1 - alpha).cumprod(1)], 1)
    weights = alpha * transmittance[:, :-1]
    weights = _WatchWeights.apply(weights, pixel_weights, absgrad[:, 2])  # type: ignore[no-untyped-call]
    return torch.cat([weights @ features, transmittance[:, -1:]], 1)
