"""Formulas of kernels in float64 PyTorch, so that autograd can differentiate them."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace
from typing import Any

import torch

from nsvq_lightning.compute.formulas import in_language


def _of_tensors(function: Any) -> Any:
    return lambda *values: function(*(torch.as_tensor(value, dtype=torch.float64) for value in values))


LANGUAGE = SimpleNamespace(
    fma=lambda x, y, z: x * y + z,
    where=lambda mask, x, y: torch.where(mask, x, torch.as_tensor(y, dtype=torch.float64)),
    **{
        name: _of_tensors(getattr(torch, name))
        for name in ("minimum", "maximum", "sqrt", "abs", "floor", "ceil", "exp2", "log2")
    },
)
"""What ``simd`` and ``triton.language`` have, too."""


def in_torch(formulas: ModuleType) -> Any:
    return in_language(formulas, LANGUAGE, lambda function: function, float)
