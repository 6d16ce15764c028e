"""Quantizers for comparison: straight-through ones, and k-means after training."""

from typing import Any

import torch
from torch import Generator, Tensor

from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.quantize.codebook import CodebookQuantizer, Quantized, Start
from nsvq_lightning.quantize.kmeans import kmeans, lookup
from nsvq_lightning.random import generator as seeded


class StraightThrough(CodebookQuantizer):
    """Quantizer that renders the nearest code itself and copies the gradient to the input (Bengio et al. 2013).

    In training ``x_q = c + x − sg(x)`` with c the nearest code and sg the stop-gradient operator: the value is c to the
    bit, the gradient of x is that of the result. The codebook gets none; :meth:`refit` fits it to the rows from time to
    time, as in CompGS (Navaneet et al. 2024), and :class:`nsvq_lightning.callbacks.CodebookRefit` schedules this.
    CompGS searches codes only at its refits; here a row has its nearest code in every step.
    """

    def approximate(self, x: Tensor, codes: Tensor, generator: Generator, rows: Tensor | None) -> Tensor:
        """The codes of the rows ``rows [V]`` of ``x [N, D]``, whose gradient goes to the rows."""
        return lookup(self.codebook.detach(), codes, x, rows)

    @torch.no_grad()
    def refit(self, x: Tensor, steps: int) -> None:
        """Fit the codebook to the rows ``x [N, D]`` by ``steps`` Lloyd steps from its current state; K stays."""
        # With a given start, k-means draws nothing from the generator.
        self.codebook.copy_(kmeans(x, self.num_codes, seeded(0), steps=steps, start=self.codebook))


class TrainedStraightThrough(CodebookQuantizer):
    """Straight-through quantizer whose codes are trained by their own gradient: x_q = c + x − sg(x).

    The gradient g of the result goes to the row, as in :class:`StraightThrough`, and to its code, summed over the rows
    that have it. So codes follow their rows without refits, each of which costs up to half a dB of test PSNR for about
    fifty iterations, and training may end at any iteration.
    """

    def __init__(self, num_codes: int, dim: int, *, start: Start = "spread", **settings: Any) -> None:
        super().__init__(num_codes, dim, start=start, **settings)

    def approximate(self, x: Tensor, codes: Tensor, generator: Generator, rows: Tensor | None) -> Tensor:
        """The codes of the rows ``rows [V]`` of ``x [N, D]``; the gradient goes to both."""
        return lookup(self.codebook, codes, x, rows)


class PostHoc(CodebookQuantizer):
    """Quantizer that leaves training alone: its codebook is fitted by k-means to the rows that are encoded.

    In training the rows pass unchanged; nothing is searched or counted, so no code is ever replaced. Codes are made
    only when needed, when the scene is evaluated, frozen or stored: :meth:`encode` fits the codebook to the rows it
    is given, by k-means from a fixed start, and returns their nearest codes. So the codebook depends only on the rows,
    whatever the process and however often the scene was evaluated before; a file holds the k-means of the final rows,
    all with equal weight. Once codes are frozen, codebook and codes are those of that moment, as with every other
    quantizer.

    Leave the fine-tune phase out (``phases.quantize_end`` at the end of the run): it would train the codebooks.
    """

    # Codes that rows hold would keep the codebook of that moment: there is no such method here.
    hold = property()

    def forward(self, x: Tensor, generator: Generator | None = None, rows: Tensor | None = None) -> Quantized:
        """In training, the rows ``[V, D]`` themselves, and -1 as the code of each; otherwise hard codes."""
        if self.frozen or not self.training:
            return super().forward(x, generator, rows)
        codes = x.new_full((len(x if rows is None else rows),), -1, dtype=torch.int64)
        return self.approximate(x, codes, generator, rows), codes

    def approximate(self, x: Tensor, codes: Tensor, generator: Generator | None, rows: Tensor | None) -> Tensor:
        """The rows ``rows [V]`` of ``x [N, D]`` themselves."""
        return x if rows is None else take_rows(x, rows)

    def encode(self, x: Tensor) -> Tensor:
        """Nearest codes ``[N]`` int64 of ``x [N, D]``, in a codebook that is fitted to ``x`` unless it is frozen.

        The codebook ignores non-finite rows, which a run drops at its next search.
        """
        if not self.frozen:
            self.fit(x[x.isfinite().all(1)])
        return super().encode(x)

    def _search(self, x: Tensor, rows: Tensor | None) -> Tensor:
        codes = self.encode(x)
        return codes if rows is None else codes[rows]
