"""One function renders splats; the device determines the back-end."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.compute.devices import resolve_backend
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.sampling import Sampling, Shading, ViewSampling, focal_of
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import RawSplats, SplatTensors, check_shapes, sh_degree_of, warn_if_trained

# Largest relative difference of samplings that only rounding makes.
ROUNDING = 1e-5


class Render(NamedTuple):
    """What :func:`render` returns.

    Attributes:
        image: Blended colour over the background, not clamped ``[H, W, 3]``.
        alpha: Opacity of the pixel, 1 - transmittance ``[H, W]``.
        radii: Radius in pixels of the area a splat can change, rounded up; 0 for splats that are not in view ``[N]``
            int32.
        means2d: Projected centres ``[N, 2]`` in pixels, x right, y down. Call ``retain_grad()`` on it before the
            backward pass to get screen-space gradients.
        depth: Σ weight · view-space z ``[H, W]``; divide by ``alpha`` for the mean depth.
        absgrad: With ``pixel_weights``, zeros ``[N, 3]`` whose ``grad`` the backward pass of a loss L sets to sums over
            the pixels p: Σ abs(∂L/∂x at p), Σ abs(∂L/∂y at p) of the projected centre (x, y) in pixels (AbsGS, Ye et
            al. 2024), and Σ weight · ``pixel_weights``. Otherwise None.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor
    means2d: Tensor
    depth: Tensor
    absgrad: Tensor | None = None


def render(
    splats: SplatTensors,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | Sequence[float] | None = None,
    pixel_weights: Tensor | None = None,
    antialiased: bool = False,
    sampling: Sampling | Tensor | float | None = None,
    backend: str = "auto",
) -> Render:
    """Render splats as a camera sees them (3D Gaussian Splatting, eq. 3), differentiable in all six raw attributes.

    Args:
        splats: Raw attributes, see :class:`nsvq_lightning.splats.splats.RawSplats` for shapes and spaces. Those of a
            module are in coordinates of its training: it renders them itself, ``module(camera)``.
        camera: Where to look from; COLMAP axes.
        sh_degree: Highest degree of the spherical harmonics that is evaluated; all stored ones by default.
        background: RGB ``[3]`` behind the splats; black by default.
        pixel_weights: Weight of each pixel ``[H, W]``; the backward pass then also sums up what ``Render.absgrad``
            holds.
        antialiased: Make splats fainter as the rasterizer's blur makes them larger, so that those smaller than a pixel
            look alike from near and far (Mip-Splatting, Yu et al. 2024). For scenes that were trained so.
        sampling: How training saw the splats: the blur that was trained keeps its size in the scene, so that pictures
            of other sizes and from other distances look as those of training do, which do not change
            (:mod:`nsvq_lightning.rendering.sampling`). Or the pixels per unit of the scene that they were trained at,
            focal length / distance, one number or one a splat ``[N]``. Without effect with ``antialiased``.
        backend: One of :data:`nsvq_lightning.compute.devices.BACKENDS`.

    Returns:
        Image, alpha, radii, projected centres and depth; see :class:`Render`.

    Raises:
        ValueError: Unknown back-end, or a back-end that cannot take the device or type of the splats; attributes that
            differ in device or type, or whose shapes do not fit; ``sh_degree`` above the stored degree; a background
            that is not ``[3]``; pixel weights that is not ``[H, W]``; sampling of other splats, or not above 0.
        TypeError: ``splats`` has no such tensors, as a dictionary or a compressed scene.
    """
    warn_if_trained(splats)
    splats = _checked(splats)
    stored = sh_degree_of(splats.shN)
    degree = stored if sh_degree is None else sh_degree
    if degree not in range(stored + 1):
        raise ValueError(f"sh_degree must be between 0 and the stored degree {stored}, got {sh_degree}")
    means = splats.means
    behind = means.new_zeros(3) if background is None else torch.as_tensor(background).to(means).contiguous()
    if behind.shape != (3,):
        raise ValueError(f"background must be one RGB colour of shape [3], got {list(behind.shape)}")
    absgrad = None
    if pixel_weights is not None:
        if pixel_weights.shape != camera.size[::-1]:
            raise ValueError(f"pixel_weights must be {[camera.height, camera.width]}, got {list(pixel_weights.shape)}")
        absgrad = means.new_zeros(1, 1).expand(len(means), 3).requires_grad_()
        pixel_weights = pixel_weights.detach().to(means).contiguous()
    view_sampling = None
    if antialiased:  # no blur is kept
        view_sampling = ViewSampling(means.new_zeros(2, len(means)), 0.0)
    elif sampling is not None:
        view_sampling = _sampling(means, camera, sampling)
    shading = Shading(int(degree), view_sampling, behind, pixel_weights, absgrad)
    image, alpha, radii, means2d, depth = _module_of(backend, means).render(splats, camera, shading)
    return Render(image, alpha, radii, means2d, depth, absgrad)


def _sampling(means: Tensor, camera: Camera, sampling: Sampling | Tensor | float) -> ViewSampling:
    n = len(means)
    if not isinstance(sampling, Sampling):
        density = torch.as_tensor(sampling).to(means)
        if density.dim() > 1 or not (density > 0).all():
            raise ValueError(
                "sampling must be pixels per unit of the scene that the splats were trained at, above 0, a number or "
                f"one a splat, got {list(density.shape)}"
            )
        distance = (focal_of(camera) / density).expand(density.shape or [n])
        # What is meant to be that of training is it, whatever was rounded.
        sampling = Sampling(torch.stack([(1 - ROUNDING) * distance, (1 + ROUNDING) * distance]), [focal_of(camera)])
    distances, size = sampling.in_view(camera)
    if distances.shape != (2, n):
        raise ValueError(f"sampling must be that of {n} splats, got {list(distances.shape)}")
    return ViewSampling(distances.detach().to(means).contiguous(), size)


def _checked(splats: SplatTensors) -> RawSplats:
    """The attributes, contiguous; refuses those of another dtype or on another device than the means."""
    if not isinstance(getattr(splats, "means", None), Tensor):
        raise TypeError(f"splats must be Splats, as Splats.from_tensors(**them) or scene.decode(), got {type(splats)}")
    tensors = {name: getattr(splats, name).contiguous() for name in ATTRIBUTES}
    check_shapes(tensors)
    kinds = {name: (tensor.dtype, tensor.device) for name, tensor in tensors.items()}
    if kinds["means"][0] not in (torch.float32, torch.float64):
        raise ValueError(f"splats must be float32 or float64 to be rendered, got {kinds['means'][0]}")
    for name, kind in kinds.items():
        if kind != kinds["means"]:
            expected = " on ".join(map(str, kinds["means"]))
            raise ValueError(f"{name} must be {expected} as the means are, got {' on '.join(map(str, kind))}")
    return RawSplats(**tensors)


@torch.no_grad()
def visible(splats: SplatTensors, camera: Camera, *, backend: str = "auto") -> Tensor:
    """Rows ``[V]`` int64, ascending, of the splats that can change the image: ``radii > 0`` without rendering.

    Args:
        splats: Raw attributes; only means, quats, scales and opacities are read.
        camera: Where to look from.
        backend: One of :data:`nsvq_lightning.compute.devices.BACKENDS`.

    Raises:
        ValueError: As for :func:`render`.
    """
    splats = _checked(splats)
    return _module_of(backend, splats.means).visible(splats, camera)  # type: ignore[no-any-return]


def _module_of(backend: str, like: Tensor) -> Any:
    """The module of a back-end, imported only now because that imports the kernels' compiler.

    It has the functions ``render`` and ``visible``; see :mod:`nsvq_lightning.rendering.reference`.
    """
    name = resolve_backend(backend, like)
    return import_module(f"{__package__}.{name}{'' if name == 'reference' else '.rasterizer'}")
