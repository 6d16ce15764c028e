"""The error that quantization makes in the covariances of splats, by canonical form."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.quantize.nearest import nearest
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.reference import rotation_matrices, times_vectors
from nsvq_lightning.splats.canonical_covariance import FORMS, Form, canonical

# Size of a sample of splats that is enough to rank the forms.
SAMPLE = 1 << 15


def covariances(scales: Tensor, quats: Tensor) -> Tensor:
    """World covariances ``[N, 3, 3]`` of log-scales ``[N, 3]`` and quaternions ``[N, 4]``, wxyz, any length."""
    rotations = rotation_matrices(quats)
    squares = (2 * scales).exp()
    columns = [times_vectors(rotations, squares * rotations[:, row]) for row in range(3)]
    return torch.stack(columns, 2)


def covariance_error(found: Tensor, exact: Tensor) -> float:
    """Mean of ‖Σ̂ − Σ‖ / ‖Σ‖ in the Frobenius norm over ``[N, 3, 3]``: independent of the size of the splats."""
    norm = torch.linalg.matrix_norm
    return float((norm(found - exact) / norm(exact).clamp_min(torch.finfo(exact.dtype).tiny)).mean())


@torch.no_grad()
def form_errors(
    scales: Tensor, quats: Tensor, codes: Mapping[str, int], seed: int, steps: int = 5
) -> dict[Form, float]:
    """:func:`covariance_error` of k-means on a sample of the splats, for every canonical form.

    A sample gets proportionally fewer codes, so that a code represents as many splats as it will in the whole scene.

    Args:
        scales: Log-scales ``[N, 3]``, N > 0.
        quats: Quaternions ``[N, 4]``, wxyz, any length.
        codes: Number of codes of ``scales``, of ``quats`` or of both; the other one stays exact.
        seed: Seed of the sample and of k-means.
        steps: Lloyd steps.
    """
    count = len(scales)
    rows = torch.randperm(count, generator=generator(seed, 0, "sample"))[:SAMPLE].to(scales.device)
    scales, quats = scales.detach()[rows], quats.detach()[rows]
    exact = covariances(scales.double(), quats.double())
    errors: dict[Form, float] = {}
    for form in FORMS:
        attributes = {"scales": scales, "quats": quats}
        if form != "none":
            attributes["scales"], attributes["quats"], *_ = canonical(scales, quats, form)
        for name, number in codes.items():
            k = math.ceil(number * len(rows) / count)
            codebook = kmeans(attributes[name], k, generator(seed, 0, "kmeans", name), steps=steps)
            attributes[name] = codebook[nearest(attributes[name], codebook)]
        found = covariances(attributes["scales"].double(), attributes["quats"].double())
        errors[form] = covariance_error(found, exact)
    return errors
