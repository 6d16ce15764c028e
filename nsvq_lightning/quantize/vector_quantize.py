"""``VectorQuantize`` of the library vector_quantize_pytorch as a quantizer of this package."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.quantize.codebook import CodebookQuantizer


class VectorQuantizeAdapter(CodebookQuantizer):
    """Quantizer that leaves the search, the codebook updates and the gradients to the library vector_quantize_pytorch.

    In training the rows go through ``vector_quantize_pytorch.VectorQuantize``: it takes the nearest codes, passes the
    gradient straight through to the rows (or by the rotation trick, Fifty et al. 2024), and moves every code to the
    exponential moving average of its rows (van den Oord et al. 2017). ``codebook`` is copied to the library before each
    pass and from it afterwards; codes that were placed or replaced in between start a new average. All else, from
    k-means to frozen codes, is inherited from :class:`CodebookQuantizer`.

    The library holds the distances of all rows to all codes at once, 4·V·K bytes, so this suits only small codebooks;
    and it decides at construction whether processes share their averages, so this trains in a single process. It is not
    one of this package's dependencies: ``pip install 'vector-quantize-pytorch>=1.25'``.

    Args:
        num_codes: Codes K, at least 1.
        dim: Dimension D of a row.
        decay: Share of the old average that each step keeps.
        rotation_trick: Rotate and scale gradients from code to row instead of copying them; needs D > 1.
        **settings: Those of :class:`CodebookQuantizer`.

    Raises:
        ImportError: The library is not installed.
        ValueError: An argument is out of range.
    """

    library: Any

    def __init__(
        self, num_codes: int, dim: int, *, decay: float = 0.99, rotation_trick: bool = False, **settings: Any
    ) -> None:
        super().__init__(num_codes, dim, **settings)
        if not 0.0 <= decay < 1.0:
            raise ValueError(f"decay must be in [0, 1), got {decay}")
        self.decay = decay
        self.rotation_trick = rotation_trick
        self.library = self._build()

    def forward(
        self, x: Tensor, generator: torch.Generator | None = None, rows: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Quantize the rows ``rows [V]`` of ``x [N, D]``, in training with the library; no generator is needed.

        Raises:
            RuntimeError: Training runs in several processes.
        """
        if self.frozen or not self.training:
            return super().forward(x, generator, rows)
        x_q, codes = self._quantize(x, rows)
        self.count(codes)
        return x_q, codes

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None) -> Tensor:
        """The library's output for the rows ``rows [V]`` of ``x [N, D]``; it searches codes itself."""
        return self._quantize(x, rows)[0]

    def _quantize(self, x: Tensor, rows: Tensor | None) -> tuple[Tensor, Tensor]:
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            raise RuntimeError(
                "VectorQuantizeAdapter trains in one process; use another quantizer, or --trainer.devices=1"
            )
        chosen = x if rows is None else take_rows(x, rows)
        if len(chosen) == 0:
            return chosen, torch.zeros(0, dtype=torch.int64, device=x.device)
        self._to_library(self.library)
        quantized, codes, _ = self.library(chosen[None])
        self.codebook.data.copy_(self.library.codebook)
        return quantized[0], codes[0]

    @torch.no_grad()
    def _to_library(self, library: Any) -> None:
        """Copy the codebook; where it differs from the library's, averages restart from it with the weight of a row."""
        averages = library._codebook  # the averages are accessible only here
        placed = (averages.embed[0] != self.codebook).any(1)
        averages.embed[0] = self.codebook
        averages.embed_avg[0, placed] = self.codebook[placed]
        averages.cluster_size[0, placed] = 1.0

    def _build(self) -> Any:
        """The library's module for K codes, with our codebook."""
        try:
            from vector_quantize_pytorch import VectorQuantize
        except ImportError as error:
            raise ImportError(
                "VectorQuantizeAdapter needs a library: pip install 'vector-quantize-pytorch>=1.25'"
            ) from error
        library = VectorQuantize(
            dim=self.dim,
            codebook_size=self.num_codes,
            decay=self.decay,
            rotation_trick=self.rotation_trick,
            commitment_weight=0.0,  # the training loss has no such term
            threshold_ema_dead_code=0,  # callbacks replace codes
            sync_codebook=False,
        ).to(self.codebook.device)
        self._to_library(library)  # the library's own start is drawn from the global generator
        return library

    def _resize(self, num_codes: int) -> None:
        other = num_codes != self.num_codes
        super()._resize(num_codes)
        if other:
            self.library = self._build()
