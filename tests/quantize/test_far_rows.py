"""D² sampling: frequencies, differences, and what it does for a start of k-means."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import NSVQ, kmeans
from nsvq_lightning.quantize.kmeans import draw_far_rows, rows_far_apart
from nsvq_lightning.random import generator


def test_rows_are_drawn_by_squared_distance() -> None:
    rows = torch.tensor([[1.0, 0, 0], [0, -3.0, 0], [0, 0, 0]])
    drawn = [int(draw_far_rows(rows, torch.zeros(1, 3), 1, generator(seed))) for seed in range(1000)]
    assert 60 < drawn.count(0) < 140  # 1 in 10, deviation 9.5
    assert drawn.count(0) + drawn.count(1) == 1000


def test_rows_on_their_codes_are_never_drawn() -> None:
    rows = torch.tensor([[0.0], [0.0], [2.0], [1.0]]).expand(4, 3)
    assert sorted(draw_far_rows(rows, torch.zeros(1, 3), 4, generator(0)).tolist()) == [2, 3]


@pytest.mark.parametrize("count", [1, 7, 8, 63, 64])
def test_a_spread_start_is_different_rows(count: int) -> None:
    rows = torch.randn(64, 3, generator=generator(0))
    chosen = rows_far_apart(rows, count, generator(1))
    matches = (chosen[:, None] == rows).all(2)
    assert chosen.shape == (count, 3)
    assert (matches.sum(1) == 1).all()
    assert (matches.sum(0) <= 1).all()


def test_a_spread_start_of_rows_too_close_to_tell_apart_ends() -> None:
    rows = torch.arange(100.0)[:, None].expand(100, 3) * 1e-25  # squares below float32
    chosen = rows_far_apart(rows, 90, generator(1))
    assert len(chosen[:, 0].unique()) == 90


def lopsided() -> Tensor:
    """5000 rows in a point, 50 clusters of 4 rows far from it and from each other."""
    g = generator(3)
    corners = (100 * torch.randn(50, 3, generator=g)).repeat(4, 1)
    return torch.cat([torch.zeros(5000, 3), corners]) + 0.1 * torch.randn(5200, 3, generator=g)


def test_a_spread_start_finds_what_a_sample_misses() -> None:
    rows, error = lopsided(), {}
    for spread in (False, True):
        centroids = kmeans(rows, 120, generator(0), spread=spread)
        error[spread] = float(torch.cdist(rows, centroids).amin(1).square().mean())
    assert error[True] < 0.1 * error[False]


def test_a_quantizer_offers_both_starts() -> None:
    rows = lopsided()
    sample, spread = (NSVQ(120, 3), NSVQ(120, 3, start="spread"))
    for quantizer in (sample, spread):
        quantizer.fit(rows, generator=generator(0))
    assert torch.equal(sample.codebook, kmeans(rows, 120, generator(0)))
    assert torch.equal(spread.codebook, kmeans(rows, 120, generator(0), spread=True))
    spread.fit(rows[:30].repeat(2, 1), generator=generator(0))
    assert spread.num_codes == 30
    with pytest.raises(ValueError, match="start must be 'sample' or 'spread'"):
        NSVQ(4, 3, start="random")  # type: ignore[arg-type]
