"""The interface that a quantizer must offer to the callbacks."""

from typing import Protocol, cast

import torch
from torch import Tensor, nn


class Quantizer(Protocol):
    """Vector quantizer of one attribute: maps rows ``[N, D]`` to codes ``[N]``, indices into a codebook ``[K, D]``.

    Implementations are ``nn.Module``s whose ``codebook`` is an ``nn.Parameter`` and whose usage counters and frozen
    codes are buffers, so that checkpoints and device moves carry them.

    Callbacks also use what they find of ``held`` and ``hold``, ``refit``, ``limit`` and ``mend`` of
    :class:`~nsvq_lightning.quantize.CodebookQuantizer`, and leave a quantizer without them alone.
    """

    codebook: Tensor
    """Codebook ``[K, D]`` in the raw space of the attribute."""
    codes: Tensor
    """Frozen codes ``[N]`` int64, empty until :meth:`freeze`."""
    usage: Tensor
    """Iterations of the current window in which each code was hit at least once, ``[K]`` int64."""
    window: Tensor
    """Iterations in the current window, scalar int64."""

    def fit(self, x: Tensor, weight: Tensor | None = None, generator: torch.Generator | None = None) -> None:
        """Place the codebook on the rows ``x [N, D]`` (k-means); ``K`` shrinks to the number of distinct rows."""

    def forward(
        self, x: Tensor, generator: torch.Generator | None = None, rows: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Quantize rows of ``x [N, D]`` in training: differentiable ``x_q [V, D]``, codes ``[V]``; counts the usage.

        A quantizer that leaves training alone returns the rows themselves, -1 as their codes, and counts nothing.

        ``rows [V]`` int64, ascending and distinct, selects the rows; without it all rows are quantized. Gathering them
        (:func:`nsvq_lightning.compute.rows.take_rows`) is left to the quantizer, whose kernels may do it themselves.
        """

    def encode(self, x: Tensor) -> Tensor:
        """Nearest codes ``[N]`` int64 of ``x [N, D]``."""

    def decode(self, codes: Tensor) -> Tensor:
        """Codebook rows ``[N, D]`` of ``codes [N]``, differentiable in the codebook."""

    def replace_unused(self, generator: torch.Generator, rows: Tensor | None = None, jitter: float = 0.5) -> Tensor:
        """Replace inactive codes by active ones and restart the window; returns the replaced codes ``[R]``.

        Callbacks pass ``rows [N, D]`` and ``jitter`` only if configured to split codes by the distortion of these rows;
        a quantizer that cannot do that may omit both parameters.
        """

    def freeze(self, codes: Tensor) -> None:
        """Fix the codes ``[N]``; from now on only the codebook is trained."""


def as_quantizer(module: object) -> Quantizer:
    """The module as a quantizer.

    Raises:
        TypeError: It lacks a member of :class:`Quantizer`; the message says which.
    """
    # Not by isinstance: since Python 3.12 it misses parameters and buffers, which an nn.Module gives by `__getattr__`.
    members = {name for name in (*Quantizer.__annotations__, *vars(Quantizer)) if not name.startswith("_")}
    lacks = sorted(name for name in members if not hasattr(module, name))
    if lacks:
        raise TypeError(
            f"{type(module).__name__} is not a quantizer; it lacks: {', '.join(lacks)}; derive it from "
            "nsvq_lightning.quantize.CodebookQuantizer, or offer the members of nsvq_lightning.quantize.Quantizer"
        )
    quantizer = cast(Quantizer, module)
    if not isinstance(module, nn.Module) or not isinstance(quantizer.codebook, nn.Parameter):
        raise TypeError(
            f"{type(module).__name__} is not a quantizer: it must be an nn.Module whose codebook is an nn.Parameter, "
            "so that checkpoints carry it and the optimiser trains it"
        )
    return quantizer


def held_codes(quantizer: object, count: int) -> Tensor | None:
    """The codes ``[count]`` that rows hold in training; None if they hold none, or are of another number."""
    held: Tensor | None = getattr(quantizer, "held", None)
    return held if held is not None and held.shape[0] == count > 0 else None
