"""The switches themselves; what each skips is tested where it is wired."""

from __future__ import annotations

import pytest

from nsvq_lightning.skips import is_on, switched


def test_switches_are_restored_whatever_happens_in_the_body() -> None:
    def body() -> None:
        with switched(blocks=False, distance_bounds=False):
            assert not is_on("blocks")
            assert not is_on("distance_bounds")
            raise InterruptedError

    with pytest.raises(InterruptedError):
        body()
    assert is_on("blocks")
    assert is_on("distance_bounds")


def test_unknown_switches_are_refused_and_change_nothing() -> None:
    with pytest.raises(ValueError, match="unknown switches block; there are blocks, dist"), switched(block=False):
        pass
    assert is_on("blocks")
