"""Measures of error that several suites share; differences are taken in float64."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

__all__ = ["relative_l2", "worst_first"]


def relative_l2(value: Tensor, truth: Tensor) -> float:
    """‖value − truth‖ / ‖truth‖; the plain ‖value‖ where the truth is 0."""
    truth = truth.detach().double()
    distance = torch.linalg.vector_norm(value.detach().double() - truth)
    scale = torch.linalg.vector_norm(truth)
    return float(distance / scale if scale > 0 else distance)


def worst_first(what: str, errors: Mapping[str, float]) -> dict[str, float]:
    """The largest of some errors under the name ``what``, then each of them under its own."""
    return {what: max(errors.values()), **errors}
