from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import NSVQ, nearest
from nsvq_lightning.quantize import tracking as tracking_module
from nsvq_lightning.quantize.tracking import NearestTracker
from nsvq_lightning.random import generator
from nsvq_lightning.skips import switched


def walk(dim: int, steps: int, size: float, count: int = 600, codes: int = 100) -> Iterator[tuple[Tensor, ...]]:
    """A codebook and visible rows that move a little at each step."""
    draw = generator(dim)
    x, codebook = torch.randn(count, dim, generator=draw), torch.randn(codes, dim, generator=draw)
    for _ in range(steps):
        x = x + size * torch.randn(x.shape, generator=draw)
        codebook = codebook + size * torch.randn(codebook.shape, generator=draw)
        yield x, codebook, torch.randperm(count, generator=draw)[: count // 2].sort().values


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rows of each search over all codes."""
    counts: list[int] = []
    search = tracking_module.score_search

    def counting(x, codes, with_lists):  # type: ignore[no-untyped-def]
        counts.append(len(x))
        return search(x, codes, with_lists)

    monkeypatch.setattr(tracking_module, "score_search", counting)
    return counts


@pytest.mark.parametrize("size", [0.0, 1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("dim", [3, 9, 45])
def test_same_codes_as_a_search(dim: int, size: float) -> None:
    tracker = NearestTracker()
    for x, codebook, rows in walk(dim, 40, size):
        assert torch.equal(tracker.search(x, codebook, rows), nearest(x[rows], codebook))


def test_a_search_is_rare_where_little_moves(searched: list[int]) -> None:
    tracker = NearestTracker()
    for x, codebook, rows in walk(45, 40, 1e-4):
        tracker.search(x, codebook, rows)
    assert sum(searched) < 1.2 * 600


def test_equal_codes(searched: list[int]) -> None:
    """Copies of codes, as replacement makes them, tie exactly: the lower one is right, lists or not."""
    tracker = NearestTracker()
    for x, codebook, rows in walk(45, 5, 1e-4):
        codebook[50:] = codebook[:50]
        codes = tracker.search(x, codebook, rows)
        assert torch.equal(codes, nearest(x[rows], codebook))
        assert int(codes.max()) < 50


@pytest.mark.parametrize("dim", [3, 45])
def test_jumps_of_codes_and_other_codebooks(dim: int) -> None:
    tracker, draw = NearestTracker(), generator(1)
    for x, codebook, rows in walk(dim, 12, 1e-4):
        codebook[torch.randint(100, (20,), generator=draw)] = torch.randn(dim, generator=draw)
        assert torch.equal(tracker.search(x, codebook, rows), nearest(x[rows], codebook))
        assert torch.equal(tracker.search(x, codebook[:30], rows), nearest(x[rows], codebook[:30]))


def test_rows_that_are_numbered_anew_are_still_right() -> None:
    tracker = NearestTracker()
    for step, (x, codebook, rows) in enumerate(walk(45, 6, 1e-4)):
        x, numbers = x.roll(50 * step, 0), ((rows + 50 * step) % len(x)).sort().values
        assert torch.equal(tracker.search(x, codebook, numbers), nearest(x[numbers], codebook))


def test_codes_and_rows_that_are_not_numbers() -> None:
    tracker = NearestTracker()
    for x, codebook, rows in walk(45, 4, 1e-4):
        codebook[3, 4], x[rows[5]] = float("nan"), float("nan")
        found, expected = tracker.search(x, codebook, rows), nearest(x[rows], codebook)
        assert torch.equal(found, expected)


def test_other_dtypes_are_searched_plainly() -> None:
    tracker = NearestTracker()
    for x, codebook, rows in walk(9, 2, 1e-2):
        assert torch.equal(
            tracker.search(x.double(), codebook.double(), rows), nearest(x[rows].double(), codebook.double())
        )


def test_refusals() -> None:
    with pytest.raises(ValueError, match="rows"):
        NearestTracker().search(torch.zeros(3, 9), torch.zeros(2, 9), torch.tensor([0, 3]))
    with pytest.raises(ValueError, match="ascending"):
        NearestTracker().search(torch.zeros(3, 9), torch.zeros(2, 9), torch.tensor([1, 0]))
    with pytest.raises(ValueError, match="rows"):
        NearestTracker().search(torch.zeros(2, 9), torch.zeros(2, 9), torch.tensor([0, -1]))


@pytest.mark.parametrize("dim", [3, 45])
def test_a_quantizer_without_tracking_gives_the_same_codes(dim: int, searched: list[int]) -> None:
    quantizer = NSVQ(100, dim)
    for step, (x, codebook, rows) in enumerate(walk(dim, 5, 1e-3)):
        quantizer.codebook.data.copy_(codebook)
        results = []
        for tracks in (True, False):
            searched.clear()
            with switched(distance_bounds=tracks):
                results.append(quantizer(x, generator(0, step), rows))
        assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))
        assert not searched
