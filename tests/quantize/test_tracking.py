from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import nearest
from nsvq_lightning.quantize import tracking as tracking_module
from nsvq_lightning.quantize.tracking import NearestTracker
from nsvq_lightning.random import generator


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
    """Rows of each search over all codes, of rows that have moved."""
    counts: list[int] = []
    by_scores, by_boxes = tracking_module.score_search, tracking_module.box_search

    def counting_scores(x, codes, with_lists):  # type: ignore[no-untyped-def]
        counts.append(len(x))
        return by_scores(x, codes, with_lists)

    def counting_boxes(x, codebook, boxes, rows, memory, travelled):  # type: ignore[no-untyped-def]
        found = by_boxes(x, codebook, boxes, rows, memory, travelled)
        # A row that a bound has settled is still remembered where it was.
        counts.append(int((memory[1][rows] == x[rows]).all(1).sum()))
        return found

    monkeypatch.setattr(tracking_module, "score_search", counting_scores)
    monkeypatch.setattr(tracking_module, "box_search", counting_boxes)
    return counts


@pytest.mark.parametrize("size", [0.0, 1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("dim", [3, 9, 45])
def test_same_codes_as_a_search(dim: int, size: float) -> None:
    tracker = NearestTracker()
    for x, codebook, rows in walk(dim, 40, size):
        assert torch.equal(tracker.search(x, codebook, rows), nearest(x[rows], codebook))


@pytest.mark.parametrize("dim", [3, 4, 45])
def test_a_search_is_rare_where_little_moves(dim: int, searched: list[int]) -> None:
    tracker = NearestTracker()
    for x, codebook, rows in walk(dim, 40, 1e-4):
        tracker.search(x, codebook, rows)
    assert searched[0] == 300
    assert 0 <= sum(searched) - 600 < 0.02 * 40 * 300


def test_a_jump_of_codes_is_paid_for_once(searched: list[int]) -> None:
    """As a refit makes them: every row is searched anew when it is next in view, not in each search."""
    tracker, jump = NearestTracker(), torch.zeros(100, 45)
    jump[::10] = torch.randn(10, 45, generator=generator(1))
    for step, (x, codebook, rows) in enumerate(walk(45, 40, 1e-4)):
        codebook = codebook + jump if step >= 5 else codebook
        assert torch.equal(tracker.search(x, codebook, rows), nearest(x[rows], codebook))
        if step == 4:
            before = sum(searched)
    assert 600 <= sum(searched) - before < 1.1 * 600


def test_equal_codes() -> None:
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
