from __future__ import annotations

from itertools import islice

import pytest

from nsvq_lightning.data.datamodule import ViewSampler


def test_every_epoch_is_a_permutation_and_epochs_differ() -> None:
    order = list(islice(ViewSampler(11, seed=3), 33))
    epochs = [tuple(order[i : i + 11]) for i in (0, 11, 22)]
    assert all(sorted(epoch) == list(range(11)) for epoch in epochs)
    assert len(set(epochs)) == 3


def test_known_order() -> None:
    # the order is part of a run's identity: a change here breaks resuming old checkpoints
    assert list(islice(ViewSampler(5, seed=0), 10)) == [4, 0, 1, 3, 2, 2, 4, 0, 3, 1]


@pytest.mark.parametrize("start", [0, 1, 10, 11, 57])
def test_starts_at_any_draw(start: int) -> None:
    whole = list(islice(ViewSampler(11, seed=1), 80))
    assert list(islice(ViewSampler(11, seed=1, start=start), 80 - start)) == whole[start:]


@pytest.mark.parametrize("world_size", [2, 3, 4])
def test_ranks_share_one_sequence(world_size: int) -> None:
    whole = list(islice(ViewSampler(7, seed=5), 12 * world_size))
    ranks = [list(islice(ViewSampler(7, 5, rank, world_size), 12)) for rank in range(world_size)]
    assert [view for draws in zip(*ranks, strict=True) for view in draws] == whole


def test_random_access_leaves_iteration_alone() -> None:
    sampler = ViewSampler(6, seed=2)
    expected = list(islice(ViewSampler(6, seed=2), 20))
    iterator = iter(sampler)
    assert [(next(iterator), sampler.view_at(1000))[0] for _ in range(20)] == expected


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"n_views": 0}, "n_views"),
        ({"n_views": 3, "rank": 2, "world_size": 2}, "rank"),
        ({"n_views": 3, "start": -1}, "start"),
    ],
)
def test_rejects_numbers_out_of_range(arguments: dict[str, int], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        ViewSampler(**arguments)
