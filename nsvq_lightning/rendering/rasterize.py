"""One function renders splats; the device determines the back-end."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for, triton_obstacle
from nsvq_lightning.rendering.antialias import compensated
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.reference import render_reference, visible_rows
from nsvq_lightning.splats.splats import ATTRIBUTES, SplatTensors, check_shapes, sh_degree_of

__all__ = ["BACKENDS", "Render", "fast_backends", "render", "resolve_backend", "visible"]

log = logging.getLogger(__name__)

_Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]

BACKENDS = ("auto", "reference", "cpu", "cuda")
"""Names that ``render(backend=...)`` takes; ``auto`` is this package's fastest one for the device of the splats."""


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
        observed: With ``observe``, zeros ``[N, 3]`` whose ``grad`` the backward pass of a loss L sets to sums over the
            pixels p: Σ abs(∂L/∂x at p), Σ abs(∂L/∂y at p) of the projected centre (x, y) in pixels (AbsGS, Ye et al.
            2024), and Σ weight · ``observe``. Otherwise None.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor
    means2d: Tensor
    depth: Tensor
    observed: Tensor | None = None


def render(
    splats: SplatTensors,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    observe: Tensor | None = None,
    antialiased: bool = False,
    backend: str = "auto",
) -> Render:
    """Render splats as a camera sees them (3D Gaussian Splatting, eq. 3), differentiable in all six raw attributes.

    Args:
        splats: Raw attributes, see :class:`nsvq_lightning.splats.splats.SplatTensors` for shapes and spaces.
        camera: Where to look from; COLMAP axes.
        sh_degree: Highest degree of the spherical harmonics that is evaluated; all stored ones by default.
        background: RGB ``[3]`` behind the splats; black by default.
        observe: Strength of each pixel ``[H, W]``; the backward pass then also sums up what ``Render.observed`` holds.
        antialiased: Make splats fainter as the rasterizer's blur makes them larger, so that those smaller than a pixel
            look alike from near and far (:func:`nsvq_lightning.rendering.antialias.compensated`). For scenes that were
            trained so.
        backend: One of :data:`BACKENDS`.

    Returns:
        Image, alpha, radii, projected centres and depth; see :class:`Render`.

    Raises:
        ValueError: Unknown back-end, or a back-end that cannot take the device or type of the splats; attributes that
            differ in device or type, or whose shapes do not fit; ``sh_degree`` above the stored degree; a background
            that is not ``[3]``; a map to observe that is not ``[H, W]``.
    """
    _check_alike(splats)
    stored = sh_degree_of(splats.shN)
    degree = stored if sh_degree is None else sh_degree
    if not 0 <= degree <= stored:
        raise ValueError(f"sh_degree must be between 0 and the stored degree {stored}, got {sh_degree}")
    means = splats.means
    if background is None:
        background = torch.zeros(3, dtype=means.dtype, device=means.device)
    elif tuple(background.shape) != (3,):
        raise ValueError(f"background must be one RGB colour of shape [3], got {list(background.shape)}")
    background = background.to(means)
    name = resolve_backend(backend, means)
    if antialiased:
        splats = compensated(splats, camera, visible(splats, camera, backend=name))
    if observe is None:
        return Render(*_rasterizer(name)(splats, camera, degree, background))
    if tuple(observe.shape) != (camera.height, camera.width):
        raise ValueError(f"observe must be [{camera.height}, {camera.width}], got {list(observe.shape)}")
    observed = means.new_zeros(means.shape[0], 3).requires_grad_()
    pixel_map = observe.detach().to(means).contiguous()
    return Render(*_rasterizer(name)(splats, camera, degree, background, pixel_map, observed), observed)


def _check_alike(splats: SplatTensors) -> None:
    """Refuse attributes whose dtype or device differs from that of the means, which the kernels assume for all."""
    tensors = {name: getattr(splats, name) for name in ATTRIBUTES}
    check_shapes(tensors)
    kinds = {name: (tensor.dtype, tensor.device) for name, tensor in tensors.items()}
    for name, kind in kinds.items():
        if kind != kinds["means"]:
            expected = " on ".join(map(str, kinds["means"]))
            raise ValueError(f"{name} must be {expected} as the means are, got {' on '.join(map(str, kind))}")


@torch.no_grad()
def visible(splats: SplatTensors, camera: Camera, *, backend: str = "auto") -> Tensor:
    """Rows ``[V]`` int64, ascending, of the splats that can change the image: ``radii > 0`` without rendering.

    Args:
        splats: Raw attributes; only means, quats, scales and opacities are read.
        camera: Where to look from.
        backend: One of :data:`BACKENDS`.

    Raises:
        ValueError: As for :func:`render`.
    """
    _check_alike(splats)
    name = resolve_backend(backend, splats.means)
    if name == "reference":
        return visible_rows(splats, camera)
    rows: Tensor = _fast_function("visible", name)(splats, camera)
    return rows


def resolve_backend(backend: str, like: Tensor) -> str:
    """The back-end that ``backend`` stands for with tensors such as ``like``.

    ``auto`` is ``cpu`` for float32 on the CPU, ``cuda`` for float32 on a CUDA device where Triton is installed, and
    otherwise ``reference``: plain torch, for any dtype and any device of torch, and slow.

    Raises:
        ValueError: It is unknown, or cannot take this device or floating-point type.
    """
    if backend not in BACKENDS:
        raise ValueError(f"unknown render backend {backend!r}; choose one of {', '.join(BACKENDS)}")
    if backend == "auto":
        return _automatic(like)
    problem = _obstacle(backend, like)
    if problem is not None:
        raise ValueError(f"backend {backend!r} cannot be used: {problem}, or use backend='auto'")
    return backend


def fast_backends(like: Tensor) -> list[str]:
    """Back-ends other than plain torch that take tensors such as ``like``."""
    return [name for name in BACKENDS if name not in ("auto", "reference") and _obstacle(name, like) is None]


def _automatic(like: Tensor) -> str:
    kernels = kernels_for(like)
    if kernels is not None:
        return kernels
    problem = _obstacle("cuda", like)
    if problem is not None and like.dtype == torch.float32:  # another dtype is meant for the oracle
        _warn_of_plain_torch(like.device.type, problem)
    return "reference"


@cache
def _warn_of_plain_torch(device: str, problem: str) -> None:
    """Warn once that a device has no kernels of its own; a run of hours would else silently become one of weeks."""
    log.warning(
        "rendering on %s in plain torch, much slower than on the CPU (--trainer.accelerator=cpu); "
        "backend 'cuda' cannot be used: %s",
        device,
        problem,
    )


def _obstacle(backend: str, like: Tensor) -> str | None:
    """Why a back-end cannot take tensors such as ``like``, with a remedy; None where it can."""
    if backend == "cpu" and not (like.device.type == "cpu" and like.dtype == torch.float32):
        return f"it renders float32 tensors on the CPU, got {like.dtype} on {like.device}; move the splats"
    return triton_obstacle(like) if backend == "cuda" else None


def _rasterizer(backend: str) -> Callable[..., _Outputs]:
    return render_reference if backend == "reference" else _fast_function("render", backend)


def _fast_function(name: str, backend: str) -> Callable[..., Any]:
    """The function ``name`` of a fast back-end, imported only now because that imports the kernels' compiler."""
    module = importlib.import_module(f"nsvq_lightning.rendering.{backend}.rasterizer")
    function: Callable[..., Any] = getattr(module, f"{name}_{backend}")
    return function
