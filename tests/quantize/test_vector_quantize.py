from __future__ import annotations

import builtins
from typing import Any

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import VectorQuantizeAdapter
from nsvq_lightning.quantize.base import as_quantizer
from nsvq_lightning.random import generator


@pytest.fixture(autouse=True)
def _library() -> None:
    pytest.importorskip("vector_quantize_pytorch")


def fitted(**settings: Any) -> tuple[VectorQuantizeAdapter, Tensor]:
    x = torch.randn(200, 3, generator=generator(0))
    quantizer = VectorQuantizeAdapter(8, 3, **settings)
    quantizer.fit(x, generator=generator(1))
    return quantizer, x.requires_grad_()


def test_is_a_quantizer_whose_library_has_no_parameters() -> None:
    quantizer, _ = fitted()
    assert as_quantizer(quantizer)
    assert [name for name, _ in quantizer.named_parameters()] == ["codebook"]


def test_the_library_passes_gradients_straight_through_and_averages_its_codebook() -> None:
    quantizer, x = fitted(decay=0.9)
    before = quantizer.codebook.detach().clone()
    rows = torch.arange(0, 200, 2)
    x_q, codes = quantizer(x, rows=rows)
    assert torch.equal(codes, torch.cdist(x[rows].double(), before.double()).argmin(1))
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
    quantizer, x = fitted(rotation_trick=True)
    x_q, _ = quantizer(x)
    x_q.backward(torch.ones_like(x_q))
    assert not torch.allclose(x.grad, torch.ones_like(x))


def test_codes_replaced_from_outside_start_a_new_average() -> None:
    quantizer, x = fitted(decay=0.5)
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


def test_states_of_another_size_load() -> None:
    source = VectorQuantizeAdapter(8, 3)
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
    quantizer, x = fitted()
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
    real = builtins.__import__

    def missing(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("vector_quantize_pytorch"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match="pip install 'vector-quantize-pytorch"):
        VectorQuantizeAdapter(4, 3)


def test_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="decay must be"):
        VectorQuantizeAdapter(4, 3, decay=1.0)
    quantizer, x = fitted()
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    with pytest.raises(RuntimeError, match="one process"):
        quantizer(x)
