from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from nsvq_lightning.commands.benchmark.scope import Scope


def test_full_and_quick_runs_have_their_own_defaults() -> None:
    full, quick = (Scope.of(quick=quick, most_threads=4) for quick in (False, True))
    assert (full.threads, full.repeats, full.workloads) == ((1, 4), 15, ("A20k", "B100k", "C500k"))
    assert (quick.threads, quick.repeats, quick.workloads) == ((4,), 3, ("A20k",))
    assert quick.seconds < full.seconds
    assert quick.steps < full.steps
    assert Scope.of(quick=False, most_threads=1).threads == (1,)


def test_what_is_given_wins() -> None:
    scope = Scope.of(
        quick=True, most_threads=2, threads=(2, 1), repeats=9, workloads=("B100k",), scene=Path("x.ply"), steps=None
    )
    assert (scope.threads, scope.repeats, scope.workloads) == ((2, 1), 9, ("B100k",))
    assert scope.scene == Path("x.ply")
    assert scope.steps == Scope.of(quick=True, most_threads=2).steps


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"threads": ()}, "at least 1"),
        ({"threads": (1, 0)}, "at least 1, got"),
        ({"threads": (1,), "repeats": 0}, "repeats must be at least 1, got 0"),
        ({"threads": (1,), "seconds": math.nan}, "seconds must be finite"),
        ({"threads": (1,), "seconds": 0.0}, "above 0"),
        ({"threads": (1,), "workloads": ("A20k", "Z")}, "some of A20k, B100k, C500k, D1M, E3M, got Z"),
        ({"threads": (1,), "workloads": ()}, "got none"),
        ({"threads": (1,), "steps": 3}, "steps must be at least 4, one for each phase, got 3"),
        ({"threads": (1,), "switches": ("blocks", "blokcs")}, "some of blocks, .*, got blokcs"),
        ({"threads": (1,), "init_from": Path("x.ply")}, "needs a COLMAP folder"),
        ({"threads": (1,), "init_from": Path("x.ply"), "scene": Path("y.ply")}, "needs a COLMAP folder"),
    ],
)
def test_values_out_of_range_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Scope(**arguments)


def test_more_threads_than_there_are_would_be_a_lie() -> None:
    with pytest.raises(ValueError, match="at most 2 threads can be measured here, got 3"):
        Scope.of(quick=True, most_threads=2, threads=(1, 3))
