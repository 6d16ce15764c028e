"""The switches themselves; what each skips is tested where it is wired."""

from __future__ import annotations

import pytest

from nsvq_lightning.skips import SKIPS, is_on, switch, switched


def test_only_exact_skips_are_on_by_default() -> None:
    assert {name: is_on(name) for name in SKIPS} == {name: skip.exact for name, skip in SKIPS.items()}


def test_switches_are_restored_whatever_happens_in_the_body() -> None:
    def body() -> None:
        with switched(blocks=False):
            switch(adam_rows=True)
            assert not is_on("blocks")
            assert is_on("adam_rows")
            raise InterruptedError

    with pytest.raises(InterruptedError):
        body()
    assert is_on("blocks")
    assert not is_on("adam_rows")


def test_unknown_switches_are_refused_and_change_nothing() -> None:
    with pytest.raises(ValueError, match=r"unknown switches block; there are blocks, saturated"), switched(block=False):
        pass
    assert is_on("blocks")


def test_the_summary_says_whether_the_bits_stay() -> None:
    assert SKIPS["blocks"].summary == "skip 4x4 blocks of pixels: a splat cannot reach them (same bits)"
    assert "momentum" in SKIPS["adam_rows"].summary
