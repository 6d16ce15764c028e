"""What the digest of a kernel covers."""

from __future__ import annotations

from typing import Any

import pytest

from nsvq_lightning.compute import lanes
from nsvq_lightning.compute.stamp import digest


def test_meaning_of_operators_counts_for_all_that_names_their_module(monkeypatch: pytest.MonkeyPatch) -> None:
    def kernel(a: Any, b: Any) -> Any:
        return lanes.load(a, 0) * lanes.load(b, 0)

    before = digest(kernel)
    assert digest(kernel) == before
    monkeypatch.setattr("nsvq_lightning.compute.stamp._source", lambda module: f"another {module}")
    assert digest(kernel) != before


def test_what_cannot_be_followed_is_refused() -> None:
    with pytest.raises(TypeError, match="cannot be detected"):
        digest(object())
