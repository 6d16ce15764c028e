"""Exact nearest code: the search on which every training step of the quantize phase rests.

TF32 and bfloat16 products give half to nine tenths of the rows a wrong code, so nothing here ever runs under autocast
or with a reduced matmul precision.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.quantize.box_search import MAX_DIM, box_search
from nsvq_lightning.quantize.boxes import build_boxes
from nsvq_lightning.quantize.scores import centre_codes, score_search

__all__ = ["check_rows", "distance_parts", "least", "nearest", "nearest_reference"]

_CPU_CHUNK, _DEVICE_CHUNK = 1 << 22, 1 << 26
"""Distances that the plain version holds at once: what fits the caches of a CPU, or enough to keep a GPU busy."""


def check_rows(x: Tensor, codebook: Tensor) -> None:
    """Refuse rows and codes that do not fit together.

    Raises:
        ValueError: ``x`` is not ``[N, D]``, ``codebook`` not ``[K, D]`` with at least one code.
        TypeError: They differ in dtype or are not floating point.
    """
    if x.dim() != 2 or codebook.dim() != 2 or x.shape[1] != codebook.shape[1] or x.shape[1] == 0:
        raise ValueError(
            f"x [N, D] and codebook [K, D] must share D > 0, got {list(x.shape)} and {list(codebook.shape)}"
        )
    if codebook.shape[0] == 0:
        raise ValueError(f"the codebook has no code, shape {list(codebook.shape)}; fit it first")
    if x.dtype != codebook.dtype or not x.dtype.is_floating_point:
        raise TypeError(f"x and codebook must have one floating-point dtype, got {x.dtype} and {codebook.dtype}")


def nearest_reference(x: Tensor, codebook: Tensor) -> Tensor:
    """Nearest codes by the definition: all distances, as sums of squared differences, in chunks.

    Any device, any floating-point dtype; in float64 the oracle of the fast searches.

    Args:
        x: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``.

    Returns:
        Codes ``[N]`` int64; of equally near codes the lowest.
    """
    check_rows(x, codebook)
    return torch.cat([least(distances) for _, distances in distance_parts(x, codebook)])


def distance_parts(x: Tensor, codebook: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Rows of ``x [N, D]``, part by part, and their exact distances ``[rows, K]`` to the codes ``[K, D]``, detached."""
    rows = max(1, (_CPU_CHUNK if x.device.type == "cpu" else _DEVICE_CHUNK) // codebook.shape[0])
    for start in range(0, max(1, x.shape[0]), rows):
        part = slice(start, start + rows)
        with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
            distances = torch.cdist(x[part], codebook, compute_mode="donot_use_mm_for_euclid_dist")
        yield part, distances


def least(costs: Tensor) -> Tensor:
    """Column ``[N]`` int64 of the least of the costs ``[N, K]`` of each row; NaN counts as the largest, as infinity."""
    # argmin would treat NaN as the smallest
    return costs.nan_to_num(nan=torch.inf, posinf=torch.inf).argmin(1)


def nearest(x: Tensor, codebook: Tensor) -> Tensor:
    """Nearest codes in exact float32: a code differs from the float64 one only where distances tie up to rounding.

    Args:
        x: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``, same dtype and device.

    Returns:
        Codes ``[N]`` int64; of equally near codes the lowest. A row with a NaN gets code 0.

    Raises:
        ValueError: The shapes do not fit together, or there is no code.
        TypeError: The dtypes differ or are not floating point.
    """
    check_rows(x, codebook)
    x, codebook = x.detach().contiguous(), codebook.detach().contiguous()
    kernels = kernels_for(x)
    if kernels == "cpu":
        return torch.from_numpy(_search(x.numpy(), codebook.numpy()))
    if kernels == "cuda":
        from nsvq_lightning.quantize.cuda.nearest import nearest_codes

        return nearest_codes(x, codebook)
    return nearest_reference(x, codebook)


def _search(x: NDArray[np.float32], codebook: NDArray[np.float32]) -> NDArray[np.int64]:
    if x.shape[1] <= MAX_DIM:
        return box_search(x, codebook, build_boxes(codebook))
    return score_search(x, centre_codes(codebook))[0]
