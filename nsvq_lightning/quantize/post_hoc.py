"""k-means of the finished splats: the cost of vector quantization of which training knows nothing."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.quantize.codebook import CodebookQuantizer

__all__ = ["PostHoc"]


class PostHoc(CodebookQuantizer):
    """Quantizer that leaves training alone: its codebook is fitted by k-means to the rows that are encoded.

    In training the rows pass unchanged; nothing is searched or counted, so no code is ever replaced. Codes are made
    only when needed, when the scene is evaluated, frozen or stored: :meth:`encode` fits the codebook to the rows it
    is given, by k-means from a fixed start, and returns their nearest codes. So the codebook depends only on the rows,
    whatever the process and however often the scene was evaluated before; a file holds the k-means of the final rows,
    all with equal weight. Once codes are frozen, codebook and codes are those of that moment, as with every other
    quantizer.

    ``configs/post_hoc_4k.yaml`` has no fine-tune phase, because that would train the codebooks after all.

    Args:
        num_codes: Codes K, at least 1.
        dim: Dimension D of a row.
        **settings: Those of :class:`CodebookQuantizer`.
    """

    def __init__(self, num_codes: int, dim: int, **settings: Any) -> None:
        super().__init__(num_codes, dim, **settings)
        self.most_codes = num_codes

    def limit(self, codes: int) -> None:
        """Have at most ``codes`` codes from the next :meth:`fit` on.

        Raises:
            ValueError: ``codes`` is below 1.
        """
        super().limit(codes)
        self.most_codes = self.num_codes

    def fit(self, x: Tensor, weight: Tensor | None = None, generator: torch.Generator | None = None) -> None:
        """Fit the codebook as :meth:`CodebookQuantizer.fit` does; K may grow again if earlier rows made it smaller."""
        self._resize(self.most_codes)
        super().fit(x, weight, generator)

    def forward(
        self, x: Tensor, generator: torch.Generator | None = None, rows: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """In training, the rows ``[V, D]`` themselves, and -1 as the code of each; otherwise hard codes."""
        if self.frozen or not self.training:
            return super().forward(x, generator, rows)
        count = len(x) if rows is None else len(rows)
        codes = torch.full((count,), -1, dtype=torch.int64, device=x.device)
        return self.approximate(x, codes, generator, rows), codes

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator | None, rows: Tensor | None) -> Tensor:
        """The rows ``rows [V]`` of ``x [N, D]`` themselves."""
        return x if rows is None else take_rows(x, rows)

    def encode(self, x: Tensor) -> Tensor:
        """Nearest codes ``[N]`` int64 of ``x [N, D]``, in a codebook that is fitted to ``x`` unless it is frozen.

        The codebook ignores non-finite rows, which a run drops at its next search.
        """
        if not self.frozen:
            rows = x.detach()
            self.fit(rows[rows.isfinite().all(1)])
        return super().encode(x)

    def _search(self, x: Tensor, rows: Tensor | None) -> Tensor:
        codes = self.encode(x)
        return codes if rows is None else codes[rows]
