"""Straight-through quantizers, k-means after training, and the quantizer of another library."""

import sys
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import (
    CodebookQuantizer,
    PostHoc,
    StraightThrough,
    TrainedStraightThrough,
    VectorQuantizeAdapter,
    kmeans,
)
from nsvq_lightning.quantize.base import as_quantizer
from nsvq_lightning.random import generator
from nsvq_lightning.skips import switched

Kind = TypeVar("Kind", bound=CodebookQuantizer)


def fitted(
    kind: type[Kind] = StraightThrough,  # type: ignore[assignment]
    dim: int = 3,
    codes: int = 16,
    **settings: Any,
) -> tuple[Kind, Tensor]:
    x = torch.randn(200, dim, generator=generator(0))
    quantizer = kind(codes, dim, kmeans_steps=2, **settings)
    quantizer.fit(x, generator=generator(1))
    return quantizer, x.requires_grad_()


def nearest_codes(x: Tensor, codebook: Tensor) -> Tensor:
    """By torch alone."""
    return torch.cdist(x.double(), codebook.double()).argmin(1)


def distortion(quantizer: StraightThrough, x: Tensor) -> float:
    """Mean squared distance to the nearest code, by torch alone."""
    return float(torch.cdist(x.double(), quantizer.codebook.detach().double()).amin(1).square().mean())


@pytest.mark.parametrize("kind", [StraightThrough, TrainedStraightThrough])
@pytest.mark.parametrize("dim", [3, 45])
@pytest.mark.parametrize("chosen", [None, [0, 3, 4, 199], []])
def test_value_is_the_code_and_the_gradient_goes_to_the_rows(
    dim: int, chosen: list[int] | None, kind: type[CodebookQuantizer]
) -> None:
    quantizer, x = fitted(kind, dim)
    rows = None if chosen is None else torch.tensor(chosen, dtype=torch.int64)
    which = slice(None) if rows is None else rows
    x_q, codes = quantizer(x, generator(2), rows)
    assert torch.equal(codes, quantizer.encode(x)[which])
    assert torch.equal(x_q, quantizer.decode(quantizer.encode(x))[which])
    grad = torch.randn(x_q.shape, generator=generator(3))
    x_q.backward(grad)
    expected = torch.zeros_like(x)
    expected[which] = grad
    assert torch.equal(x.grad, expected)
    if kind is StraightThrough:
        assert quantizer.codebook.grad is None
    else:  # as of the codes themselves, which fine-tuning trains
        (to_codes,) = torch.autograd.grad(quantizer.decode(codes), quantizer.codebook, grad)
        assert torch.equal(quantizer.codebook.grad, to_codes)


def test_refit_lowers_the_distortion_and_stays_where_rows_stay() -> None:
    quantizer, x = fitted()
    moved = x.detach() + torch.tensor([1.0, -0.5, 0.25])
    parameter, distortions = quantizer.codebook, [distortion(quantizer, moved)]
    for steps in (1, 1, 5, 40):
        quantizer.refit(moved, steps)
        distortions.append(distortion(quantizer, moved))
    assert quantizer.codebook is parameter
    assert distortions == sorted(distortions, reverse=True)
    assert distortions[-1] < 0.6 * distortions[0]
    # At the fixed point every code in use is the mean of its rows.
    codes = quantizer.encode(moved)
    for code in codes.unique():
        torch.testing.assert_close(quantizer.codebook[code].detach(), moved[codes == code].mean(0))
    before = quantizer.codebook.detach().clone()
    quantizer.refit(moved, 1)
    torch.testing.assert_close(quantizer.codebook.detach(), before)


def test_searches_after_a_refit_are_exact() -> None:
    """The search remembers last codes, and a refit moves all of them at once."""
    quantizer, x = fitted(dim=45)
    for step in range(4):
        x = (x + 0.1).detach()
        quantizer.refit(x, 3)
        _, codes = quantizer(x, generator(step))
        assert torch.equal(codes, nearest_codes(x, quantizer.codebook))


# PostHoc


@pytest.mark.parametrize("chosen", [None, [0, 3, 199], []])
def test_training_sees_the_rows_and_counts_nothing(chosen: list[int] | None) -> None:
    quantizer, x = fitted(PostHoc)
    rows = None if chosen is None else torch.tensor(chosen, dtype=torch.int64)
    which = slice(None) if rows is None else rows
    before = quantizer.codebook.detach().clone()
    x_q, codes = quantizer(x, generator(2), rows)
    assert torch.equal(x_q, x[which])
    assert torch.equal(codes, torch.full((len(x_q),), -1))
    x_q.backward(torch.full_like(x_q, 2.0))
    expected = torch.zeros_like(x)
    expected[which] = 2.0
    assert torch.equal(x.grad, expected)
    assert quantizer.codebook.grad is None
    assert int(quantizer.window) == 0
    assert quantizer.replace_unused(generator(3)).numel() == 0
    assert torch.equal(quantizer.codebook, before)


def test_codes_are_kmeans_of_the_rows_that_are_encoded_whatever_came_before() -> None:
    quantizer, _ = fitted(PostHoc)
    for rows in (
        torch.randn(300, 3, generator=generator(5)),
        torch.ones(9, 3),
        torch.rand(99, 3, generator=generator(6)),
    ):
        codes = quantizer.encode(rows)
        expected = kmeans(rows, 16, generator(0), steps=2)
        assert torch.equal(quantizer.codebook, expected)
        assert quantizer.usage.shape == (len(expected),)
        assert torch.equal(codes, nearest_codes(rows, expected))
    quantizer.eval()
    hard, found = quantizer(rows, rows=torch.tensor([3, 50]))
    assert torch.equal(found, codes[[3, 50]])
    assert torch.equal(hard, quantizer.decode(found))


def test_rows_that_are_not_finite_have_no_part_in_the_codebook() -> None:
    quantizer, _ = fitted(PostHoc)
    rows = torch.randn(100, 3, generator=generator(5))
    expected = kmeans(rows[2:], 16, generator(0), steps=2)
    rows[0, 1], rows[1, 2] = torch.nan, torch.inf
    codes = quantizer.encode(rows)
    assert torch.equal(quantizer.codebook, expected)
    assert torch.equal(codes[2:], nearest_codes(rows[2:], expected))
    assert codes.shape == (100,)


def test_a_frozen_codebook_is_trained_and_not_fitted_again() -> None:
    quantizer, x = fitted(PostHoc)
    codes = quantizer.encode(x)
    quantizer.freeze(codes)
    book = quantizer.codebook.detach().clone()
    with switched(frozen_search=False, distance_bounds=False):
        x_q, found = quantizer(x + 1)
    assert torch.equal(found, codes)
    assert torch.equal(x_q, book[codes])
    assert torch.equal(quantizer.encode(x + 1), nearest_codes(x + 1, book))
    assert torch.equal(quantizer.codebook, book)
    x_q.sum().backward()
    assert torch.equal(quantizer.codebook.grad[:, 0], torch.bincount(codes, minlength=16).float())


def test_state_of_fewer_codes_loads_and_may_grow_again() -> None:
    source, _ = fitted(PostHoc)
    source.encode(torch.ones(9, 3))
    target = PostHoc(16, 3)
    target.load_state_dict(source.state_dict())
    assert torch.equal(target.codebook, torch.ones(1, 3))
    target.encode(torch.randn(50, 3, generator=generator(0)))
    assert target.num_codes == 16


# VectorQuantizeAdapter


def adapted(**settings: Any) -> tuple[VectorQuantizeAdapter, Tensor]:
    pytest.importorskip("vector_quantize_pytorch")
    return fitted(VectorQuantizeAdapter, codes=8, **settings)


def test_is_a_quantizer_whose_library_has_no_parameters() -> None:
    quantizer, _ = adapted()
    assert as_quantizer(quantizer)
    assert [name for name, _ in quantizer.named_parameters()] == ["codebook"]


def test_the_library_passes_gradients_straight_through_and_averages_its_codebook() -> None:
    quantizer, x = adapted(decay=0.9)
    before = quantizer.codebook.detach().clone()
    rows = torch.arange(0, 200, 2)
    x_q, codes = quantizer(x, rows=rows)
    assert torch.equal(codes, nearest_codes(x[rows], before))
    torch.testing.assert_close(x_q, before[codes])
    assert quantizer.usage.tolist() == [1] * 8
    x_q.backward(torch.full_like(x_q, 3.0))
    expected = torch.zeros_like(x)
    expected[rows] = 3.0
    torch.testing.assert_close(x.grad, expected)
    # Exponential moving averages from a weight of 1 a code, by hand.
    count = torch.bincount(codes, minlength=8)[:, None]
    total = torch.zeros(8, 3).index_add_(0, codes, x.detach()[rows])
    moved = (0.9 * before + 0.1 * total) / (0.9 + 0.1 * count)
    torch.testing.assert_close(quantizer.codebook.detach(), moved, rtol=1e-4, atol=1e-5)
    assert quantizer.codebook.grad is None


def test_the_rotation_trick_is_the_librarys() -> None:
    quantizer, x = adapted(rotation_trick=True)
    x_q, _ = quantizer(x)
    x_q.backward(torch.ones_like(x_q))
    assert not torch.allclose(x.grad, torch.ones_like(x))


def test_codes_replaced_from_outside_start_a_new_average() -> None:
    quantizer, x = adapted(decay=0.5)
    quantizer(x)
    quantizer.window.fill_(1000)
    quantizer.usage.fill_(1000)
    quantizer.usage[2] = 0
    kept = quantizer.codebook.detach().clone()
    assert quantizer.replace_unused(generator(2)).tolist() == [2]
    placed = quantizer.codebook.detach()[2].clone()
    quantizer(x.detach() + 100, rows=torch.tensor([7]))  # one far row moves its own code alone
    still = [i for i in range(8) if i != int(quantizer.encode(x.detach()[7:8] + 100))]
    for i in still:
        torch.testing.assert_close(quantizer.codebook[i].detach(), placed if i == 2 else kept[i], rtol=1e-3, atol=1e-4)


def test_averages_of_another_size_load() -> None:
    source, _ = adapted()
    source.fit(torch.eye(3))
    source(torch.rand(20, 3, generator=generator(0)))
    target = VectorQuantizeAdapter(8, 3)
    target.load_state_dict(source.state_dict())
    assert target.num_codes == 3
    rows = torch.rand(20, 3, generator=generator(1))
    for quantizer in (source, target):
        quantizer(rows)
    for name, value in source.state_dict().items():
        assert torch.equal(target.state_dict()[name], value), name


def test_evaluation_frozen_codes_and_no_rows_leave_the_library_alone() -> None:
    quantizer, x = adapted()
    before = quantizer.codebook.detach().clone()
    assert quantizer(x, rows=torch.zeros(0, dtype=torch.int64))[0].shape == (0, 3)
    quantizer.eval()
    assert torch.equal(quantizer(x)[0], before[quantizer.encode(x)])
    quantizer.train()
    quantizer.freeze(quantizer.encode(x))
    x_q, _ = quantizer(x)
    assert torch.equal(quantizer.codebook, before)
    x_q.sum().backward()
    assert torch.equal(quantizer.codebook.grad[:, 0], torch.bincount(quantizer.codes, minlength=8).float())


def test_without_the_library_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vector_quantize_pytorch", None)
    with pytest.raises(ImportError, match="pip install 'vector-quantize-pytorch"):
        VectorQuantizeAdapter(4, 3)


def test_what_the_adapter_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="decay must be"):
        VectorQuantizeAdapter(4, 3, decay=1.0)
    quantizer, x = adapted()
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    with pytest.raises(RuntimeError, match="one process"):
        quantizer(x)
