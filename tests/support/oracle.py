"""A fast back-end against the float64 oracle: outputs and every gradient."""

from __future__ import annotations

import torch

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render, render
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import RawSplats

Gradients = dict[str, torch.Tensor]

ABSGRAD = "Σ |∂L/∂x|", "Σ |∂L/∂y|", "Σ weight · pixel weight"
"""Columns of what is absgrad, as the names of gradients."""
DEVICES = {"cuda": "cuda"} if torch.cuda.is_available() else {}
"""Where a back-end is run, if not on the CPU."""


def run(
    splats: RawSplats,
    camera: Camera,
    backend: str,
    dtype: torch.dtype,
    background: torch.Tensor | None = None,
    pixel_weights: torch.Tensor | None = None,
    **options: int,
) -> tuple[Render, Gradients]:
    """Render, and differentiate a random combination of image, alpha and depth; results are on the CPU."""
    device = torch.device(DEVICES.get(backend, "cpu"))
    leaves = RawSplats(*(tensor.to(device, dtype, copy=True).requires_grad_() for tensor in splats))
    background = None if background is None else background.to(device, dtype)
    result = render(leaves, camera, backend=backend, background=background, pixel_weights=pixel_weights, **options)  # type: ignore[arg-type]
    result.means2d.retain_grad()
    generator = torch.Generator().manual_seed(99)
    weights = [torch.randn(camera.height, camera.width, k, generator=generator).to(device, dtype) for k in (3, 1, 1)]
    outputs = (result.image, result.alpha[..., None], result.depth[..., None])
    torch.stack([(weight * output).sum() for weight, output in zip(weights, outputs, strict=True)]).sum().backward()
    gradients = {name: leaf.grad.cpu() for name, leaf in zip(ATTRIBUTES, leaves, strict=True) if leaf.grad is not None}
    assert result.means2d.grad is not None
    gradients["means2d"] = result.means2d.grad.cpu()
    if result.absgrad is not None:
        assert result.absgrad.grad is not None
        gradients |= dict(zip(ABSGRAD, result.absgrad.grad.cpu().unbind(1), strict=True))
    return Render(*(tensor.cpu() for tensor in result[:5])), gradients


def assert_same(
    backend: str,
    splats: RawSplats,
    camera: Camera,
    tolerance: float = 1e-4,
    sees_more: bool = False,
    **options: object,
) -> tuple[Render, Gradients]:
    """Images within 1e-4, gradients within a relative L2 error of 1e-4 of the float64 oracle.

    A back-end that ``sees_more`` may give centres and radii to splats that reach no pixel.

    Returns what the back-end gave, for more checks.
    """
    fast, fast_gradients = run(splats, camera, backend, torch.float32, **options)  # type: ignore[arg-type]
    oracle, gradients = run(splats, camera, "reference", torch.float64, **options)  # type: ignore[arg-type]
    torch.testing.assert_close(fast.image.double(), oracle.image, atol=tolerance, rtol=0)
    torch.testing.assert_close(fast.alpha.double(), oracle.alpha, atol=tolerance, rtol=0)
    torch.testing.assert_close(fast.depth.double(), oracle.depth, atol=10 * tolerance, rtol=tolerance)
    rows = oracle.radii > 0 if sees_more else torch.ones_like(oracle.radii, dtype=torch.bool)
    torch.testing.assert_close(fast.means2d[rows].double(), oracle.means2d[rows], atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(fast.radii[rows], oracle.radii[rows], atol=1, rtol=0)
    for name, expected in gradients.items():
        norm = expected.norm().item()
        assert torch.isfinite(fast_gradients[name]).all(), name
        error = (fast_gradients[name].double() - expected).norm().item()
        assert error <= tolerance * max(norm, 1e-12), f"{name}: relative error {error / max(norm, 1e-12):.1e}"
    return fast, fast_gradients
