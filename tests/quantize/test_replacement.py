"""Splitting codes: where new codes lie, and what it does to the distortion."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import NSVQ, nearest
from nsvq_lightning.quantize.replacement import copy_codes, split_codes
from nsvq_lightning.random import generator


def distortion(rows: Tensor, codebook: Tensor) -> float:
    return float(torch.cdist(rows, codebook).amin(1).square().sum())


def two_cells() -> tuple[Tensor, Tensor]:
    """900 rows close to the first code, 100 far around the second one."""
    g = generator(0)
    rows = torch.cat([0.01 * torch.randn(900, 3, generator=g), 10 + torch.randn(100, 3, generator=g)])
    return torch.tensor([[0.0, 0, 0], [10.0, 10, 10]]), rows


def test_a_new_code_lies_on_the_way_to_a_row_and_takes_it_over() -> None:
    active, rows = two_cells()
    new = split_codes(active, rows, 8, 0.25, generator(1))
    assert new.shape == (8, 3)
    candidates = active[nearest(rows, active)].lerp(rows, 0.25)
    found = torch.cdist(new, candidates, compute_mode="donot_use_mm_for_euclid_dist")
    assert found.amin(1).max() < 1e-5
    assert len(found.argmin(1).unique()) == 8
    codes = nearest(rows, torch.cat([active, new]))
    assert (torch.bincount(codes, minlength=10)[2:] > 0).all()
    # All but about 1/3000 of the distortion is in the second cell.
    assert (new.amin(1) > 5).all()


def test_splitting_helps_at_once_where_copies_do_not() -> None:
    active, rows = two_cells()
    before = distortion(rows, active)
    assert distortion(rows, torch.cat([active, split_codes(active, rows, 8, 0.5, generator(1))])) < 0.6 * before
    assert distortion(rows, torch.cat([active, copy_codes(active, 8, generator(1))])) == pytest.approx(before, rel=1e-5)


def test_a_quantizer_splits_where_it_gets_rows() -> None:
    x = torch.randn(400, 3, generator=generator(0))
    results = []
    for seed in (0, 0, 1):
        quantizer = NSVQ(8, 3)
        quantizer.fit(x, generator=generator(1))
        kept = quantizer.codebook.detach()[:5].clone()
        quantizer.window.fill_(100)
        quantizer.usage[:5] = 100
        assert quantizer.replace_unused(generator(seed), rows=x, jitter=0.5).tolist() == [5, 6, 7]
        assert torch.equal(quantizer.codebook[:5], kept)
        assert torch.bincount(quantizer.encode(x), minlength=8).all()
        assert int(quantizer.window) == 0
        results.append(quantizer.codebook.detach())
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_rows_that_are_their_codes_leave_nothing_to_split() -> None:
    quantizer = NSVQ(4, 2)
    x = torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    quantizer.fit(x)
    before = quantizer.codebook.detach().clone()
    quantizer.window.fill_(100)
    quantizer.usage[:3] = 100
    assert quantizer.replace_unused(generator(0), rows=x[:3]).numel() == 0
    assert torch.equal(quantizer.codebook, before)
