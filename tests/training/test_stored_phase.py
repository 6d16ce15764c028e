"""What is stored belongs to the phase that a run is in."""

from __future__ import annotations

import logging

import pytest
import torch

from nsvq_lightning.quantize import PostHoc
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase


def splats(count: int = 40) -> Splats:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator)
    return Splats.from_points(points, torch.rand(count, 3, generator=generator))


def test_before_the_codebooks_everything_is_stored_as_it_is(caplog: pytest.LogCaptureFixture) -> None:
    module = SplatModule(codebooks="0.5k", splats=splats())
    with caplog.at_level(logging.WARNING):
        stored = module.compressed()
    assert "unquantized" in caplog.text
    assert not stored.codes
    decoded = stored.decode()
    for name in ATTRIBUTES:
        assert torch.equal(getattr(decoded, name), getattr(module.splats, name)), name


def test_the_sizes_of_codebooks_that_storing_places_are_those_that_it_placed() -> None:
    module = SplatModule(codebooks={"scales": 4096, "sh0": 8}, quantizer=PostHoc, splats=splats())
    module.phase = Phase.QUANTIZE
    for _ in range(2):
        stored = module.compressed()
        assert stored.config["codebooks"] == {"scales": 40, "sh0": 8}
        assert {name: len(rows) for name, rows in stored.codebooks.items()} == stored.config["codebooks"]
