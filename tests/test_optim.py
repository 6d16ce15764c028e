"""Learning rates against the values of 3D Gaussian Splatting; Adam against torch's own single-tensor loop."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from nsvq_lightning.optim import LearningRates, build_adam, param_groups, position_lr, set_lr
from nsvq_lightning.splats import Splats
from nsvq_lightning.subset import take_rows


class Codebook(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.codebook = nn.Parameter(torch.zeros(4, 3))


def splats() -> Splats:
    return Splats.from_points(torch.rand(5, 3, generator=torch.Generator().manual_seed(0)), torch.rand(5, 3))


def test_every_attribute_and_codebook_has_its_group_and_rate() -> None:
    rates = LearningRates(codebook_factor=2.0)
    groups = param_groups(splats(), {"scales": Codebook(), "shN": Codebook()}, rates, extent=3.0)
    assert {group["name"]: group["lr"] for group in groups} == {
        "means": pytest.approx(4.8e-4),
        "quats": 1e-3,
        "scales": 5e-3,
        "opacities": 0.05,
        "sh0": 2.5e-3,
        "shN": 1.25e-4,
        "codebook_scales": 1e-2,
        "codebook_shN": 2.5e-4,
    }


def test_the_position_rate_falls_log_linearly_and_then_stays() -> None:
    rates = LearningRates()
    assert position_lr(0, 2.0, rates, 30_000) == pytest.approx(3.2e-4)
    assert position_lr(15_000, 2.0, rates, 30_000) == pytest.approx(2.0 * math.sqrt(1.6e-4 * 1.6e-6))
    assert position_lr(30_000, 2.0, rates, 30_000) == pytest.approx(3.2e-6)
    assert position_lr(45_000, 2.0, rates, 30_000) == pytest.approx(3.2e-6)


def test_adam_is_the_textbook_one() -> None:
    scene = splats()
    optimizer = build_adam(param_groups(scene, {}, LearningRates(), extent=1.0))
    reference = [p.detach().clone().requires_grad_() for p in scene.attributes().values()]
    rates = [group["lr"] for group in optimizer.param_groups]
    slow = torch.optim.Adam(
        [{"params": [p], "lr": lr} for p, lr in zip(reference, rates, strict=True)], eps=1e-15, foreach=False
    )
    for step in range(5):
        for fast, other in zip(scene.attributes().values(), reference, strict=True):
            grad = torch.randn(fast.shape, generator=torch.Generator().manual_seed(step))
            fast.grad, other.grad = grad, grad.clone()
        optimizer.step()
        slow.step()
    for fast, other in zip(scene.attributes().values(), reference, strict=True):
        torch.testing.assert_close(fast.detach(), other.detach(), rtol=1e-6, atol=1e-7)


def test_a_codebook_without_gradient_is_left_alone() -> None:
    book = Codebook()
    optimizer = build_adam(param_groups(splats(), {"scales": book}, LearningRates(), extent=1.0))
    optimizer.step()
    assert book.codebook not in optimizer.state


def test_set_lr_finds_the_group_by_name() -> None:
    optimizer = build_adam(param_groups(splats(), {}, LearningRates(), extent=1.0))
    set_lr(optimizer, "means", 0.5)
    assert [group["lr"] for group in optimizer.param_groups if group["name"] == "means"] == [0.5]
    with pytest.raises(ValueError, match="no parameter group 'albedo'"):
        set_lr(optimizer, "albedo", 0.5)


@pytest.mark.parametrize("bad", [{"means": 0.0}, {"opacities": -1.0}, {"shN": math.nan}])
def test_impossible_rates_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"rate {next(iter(bad))} must be finite"):
        LearningRates(**bad)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(6,), (6, 3), (6, 15, 3)])
@pytest.mark.parametrize("chosen", [[0, 3, 4], [5], [0, 1, 2, 3, 4, 5], []])
def test_taking_rows_has_the_gradient_of_index_select(
    shape: tuple[int, ...], dtype: torch.dtype, chosen: list[int]
) -> None:
    x = torch.randn(shape, generator=torch.Generator().manual_seed(0), dtype=dtype, requires_grad=True)
    rows = torch.tensor(chosen, dtype=torch.int64)
    weight = torch.randn((len(chosen), *shape[1:]), generator=torch.Generator().manual_seed(1), dtype=dtype)
    (ours,) = torch.autograd.grad((take_rows(x, rows) * weight).sum(), x)
    (theirs,) = torch.autograd.grad((x.index_select(0, rows) * weight).sum(), x)
    assert torch.equal(take_rows(x, rows), x.index_select(0, rows))
    assert torch.equal(ours, theirs)
