"""k-means, and D² sampling: frequencies, differences, and what it does for a start."""

import pytest
import torch
from threads import use_threads
from torch import Tensor

from nsvq_lightning.quantize import NSVQ, kmeans, nearest_reference
from nsvq_lightning.quantize.kmeans import distinct_rows, draw_far_rows, rows_far_apart, sum_by_code
from nsvq_lightning.random import generator


def test_rows_are_drawn_by_squared_distance() -> None:
    rows = torch.tensor([[1.0, 0, 0], [0, -3.0, 0], [0, 0, 0]])
    drawn = [int(draw_far_rows(rows, torch.zeros(1, 3), 1, generator(seed))) for seed in range(300)]
    assert 10 < drawn.count(0) < 50  # 1 in 10, deviation 5.2
    assert drawn.count(0) + drawn.count(1) == 300


def test_rows_on_their_codes_are_never_drawn() -> None:
    rows = torch.tensor([[0.0], [0.0], [2.0], [1.0]]).expand(4, 3)
    assert sorted(draw_far_rows(rows, torch.zeros(1, 3), 4, generator(0)).tolist()) == [2, 3]
    rows[3, 1] = torch.nan
    assert draw_far_rows(rows, torch.zeros(1, 3), 4, generator(0)).tolist() == [2]


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


def rows(count: int, dim: int, seed: int = 0) -> Tensor:
    return torch.randn(count, dim, generator=generator(seed))


def lloyd(x: Tensor, start: Tensor, steps: int, weight: Tensor | None = None) -> Tensor:
    """Oracle: textbook k-means in float64, code by code."""
    x, centroids = x.double(), start.double().clone()
    weight = torch.ones(len(x)).double() if weight is None else weight.double()
    for _ in range(steps):
        codes = nearest_reference(x, centroids)
        for code in range(len(centroids)):
            hit = codes == code
            if weight[hit].sum() > 0:
                centroids[code] = (weight[hit, None] * x[hit]).sum(0) / weight[hit].sum()
    return centroids


@pytest.mark.parametrize("dim", [3, 45])
@pytest.mark.parametrize("weighted", [False, True])
def test_equals_textbook(dim: int, weighted: bool) -> None:
    x = rows(600, dim)
    weight = torch.rand(600, generator=generator(5)) if weighted else None
    found = kmeans(x, 20, generator(0), weight, steps=4, start=x[:20])
    torch.testing.assert_close(found.double(), lloyd(x, x[:20], 4, weight), rtol=1e-5, atol=1e-6)


def test_start_is_distinct_rows() -> None:
    x = rows(40, 3).repeat_interleave(5, 0)
    centroids = kmeans(x, 30, generator(2), steps=0)
    assert len(torch.unique(centroids, dim=0)) == 30
    assert set(map(tuple, centroids.tolist())) <= set(map(tuple, x.tolist()))


def test_no_more_codes_than_distinct_rows() -> None:
    x = rows(7, 4)[torch.tensor([3, 1, 3, 3, 0, 1, 6])]
    assert torch.equal(kmeans(x, 100, generator(0)), x[torch.tensor([0, 1, 4, 6])])
    assert torch.equal(kmeans(x, 4, generator(0)), x[torch.tensor([0, 1, 4, 6])])


def test_empty_cluster_keeps_its_centroid() -> None:
    start = torch.tensor([[0.0], [100.0]])
    assert kmeans(torch.tensor([[1.0], [3.0]]), 2, generator(0), start=start).tolist() == [[2.0], [100.0]]


def test_rows_of_weight_zero_count_for_nothing() -> None:
    x = torch.cat((rows(50, 3), torch.full((50, 3), 1e6)))
    weight = torch.cat((torch.ones(50), torch.zeros(50)))
    assert torch.equal(kmeans(x, 8, generator(0), weight), kmeans(x[:50], 8, generator(0), torch.ones(50)))


def test_distinct_rows_of_signed_zeros_and_repeats() -> None:
    x = torch.tensor([[0.0, 1.0], [-0.0, 1.0], [2.0, 1.0], [0.0, 1.0], [2.0, 1.0], [1.0, 0.0]])
    assert distinct_rows(x).tolist() == [0, 2, 5]
    assert distinct_rows(x.double()).tolist() == [0, 2, 5]


def test_repeatable_for_any_threads() -> None:
    x, results = rows(3000, 3), []
    for count in (1, 2):
        with use_threads(count):
            results.append(kmeans(x, 64, generator(3)))
    assert torch.equal(*results)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="1 of 3 rows"):
        kmeans(torch.tensor([[0.0], [float("nan")], [1.0]]), 2, generator(0))
    with pytest.raises(ValueError, match="N > 0"):
        kmeans(torch.zeros(0, 3), 2, generator(0))
    with pytest.raises(ValueError, match="weight"):
        kmeans(rows(3, 3), 2, generator(0), -torch.ones(3))


def test_sums_agree_with_index_add() -> None:
    values, codes = rows(500, 7), torch.randint(30, (500,), generator=generator(1))
    expected = torch.zeros(31, 7).double().index_add_(0, codes, values.double())
    torch.testing.assert_close(sum_by_code(values, codes, 31).double(), expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(sum_by_code(values, codes, 31, torch.float64), expected, rtol=1e-12, atol=1e-12)
