"""The switches themselves; what each skips is tested where it is wired."""

from __future__ import annotations

import pytest

from nsvq_lightning.skips import is_on, switch, switched


def test_switches_are_restored_whatever_happens_in_the_body() -> None:
    def body() -> None:
        with switched(blocks=False):
            switch(saturated=False)
            assert not is_on("blocks")
            assert not is_on("saturated")
            raise InterruptedError

    with pytest.raises(InterruptedError):
        body()
    assert is_on("blocks")
    assert is_on("saturated")


def test_unknown_switches_are_refused_and_change_nothing() -> None:
    with pytest.raises(ValueError, match=r"unknown switches block; there are blocks, saturated"), switched(block=False):
        pass
    assert is_on("blocks")
