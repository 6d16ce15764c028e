"""A codebook that is fitted, counted, repaired, frozen and stored; which codes are replaced and by what."""

import logging
from itertools import chain

import pytest
import torch
from torch import Tensor, nn

from nsvq_lightning.quantize import NSVQ, nearest
from nsvq_lightning.quantize import codebook as codebook_module
from nsvq_lightning.quantize.codebook import as_quantizer, copy_codes, split_codes
from nsvq_lightning.quantize.kmeans import lookup
from nsvq_lightning.quantize.tracking import NearestTracker
from nsvq_lightning.random import generator
from nsvq_lightning.skips import switched


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
    codes = nearest(rows[found.argmin(1)], torch.cat([active, new]))
    assert (codes >= len(active)).all()
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


def fitted(num_codes: int = 8, dim: int = 3, count: int = 100) -> tuple[NSVQ, Tensor]:
    x = torch.randn(count, dim, generator=generator(0))
    quantizer = NSVQ(num_codes, dim)
    quantizer.fit(x, generator=generator(1))
    return quantizer, x


def test_fit_shrinks_and_keeps_the_parameter() -> None:
    quantizer = NSVQ(16, 3)
    parameter = quantizer.codebook
    optimizer = torch.optim.Adam([parameter], eps=1e-15)
    x = torch.eye(3).repeat(10, 1)
    assert not quantizer.fitted
    quantizer.fit(x)
    assert quantizer.codebook is parameter
    assert quantizer.num_codes == 3
    assert quantizer.usage.shape == (3,)
    assert quantizer.fitted
    assert torch.equal(quantizer.decode(quantizer.encode(x)), x)
    x_q, _ = quantizer((x + 0.1).requires_grad_(), generator(0))
    x_q.square().sum().backward()
    optimizer.step()
    assert torch.isfinite(quantizer.codebook).all()


def test_gradient_of_decode_sums_by_code() -> None:
    codebook = torch.randn(10, 5, generator=generator(0)).requires_grad_()
    codes = torch.randint(9, (200,), generator=generator(1))
    grad = torch.randn(200, 5, generator=generator(2))
    lookup(codebook, codes).backward(grad)
    found, codebook.grad = codebook.grad, None
    codebook[codes].backward(grad)
    torch.testing.assert_close(found, codebook.grad, rtol=1e-5, atol=1e-6)
    assert torch.equal(found[9], torch.zeros(5))


def test_usage_counts_iterations_not_rows() -> None:
    quantizer, x = fitted()
    _, codes = quantizer(x, generator(0))
    quantizer(x[codes == 2], generator(1))
    assert int(quantizer.window) == 2
    assert quantizer.usage.tolist() == [2 if code == 2 else 1 for code in range(8)]
    quantizer.eval()
    quantizer(x)
    assert int(quantizer.window) == 2


ROWS, SEEN, TRAINED, FROZEN = 300, 200, 7, 2


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """The searches of a quantizer: with or without bounds, and of how many rows."""
    found: list[tuple[str, int]] = []
    track, plain = NearestTracker.search, codebook_module.nearest

    def tracking(tracker: NearestTracker, x: Tensor, codebook: Tensor, rows: Tensor | None = None) -> Tensor:
        found.append(("bounds", len(x if rows is None else rows)))
        return track(tracker, x, codebook, rows)

    def searching(x: Tensor, codebook: Tensor) -> Tensor:
        found.append(("plain", len(x)))
        return plain(x, codebook)

    monkeypatch.setattr(NearestTracker, "search", tracking)
    monkeypatch.setattr(codebook_module, "nearest", searching)
    return found


def steps(dim: int) -> list[tuple[Tensor, ...]]:
    """x_q, codes, usage and both gradients of steps that move rows and codes; the last ones have frozen codes."""
    draw, quantizer = generator(dim), NSVQ(60, dim)
    x = torch.randn(ROWS, dim, generator=draw).requires_grad_()
    nn.init.normal_(quantizer.codebook, generator=draw)
    optimizer = torch.optim.SGD([x, quantizer.codebook], lr=0.02)
    results = []
    for step in range(TRAINED + FROZEN):
        if step == TRAINED - 2:
            quantizer.codebook.data[40:50] = quantizer.codebook.data[:10]
        if step == TRAINED:
            quantizer.freeze(torch.arange(ROWS) % 60)
        optimizer.zero_grad(set_to_none=False)
        rows = (torch.arange(ROWS) % 3 != step % 3).nonzero()[:, 0]
        x_q, codes = quantizer(x, generator(0, step), rows)
        (x_q * torch.randn(x_q.shape, generator=draw)).sum().backward()
        gradients = x.grad.clone(), quantizer.codebook.grad.clone()
        results.append((x_q.detach(), codes, quantizer.usage.clone(), *gradients))
        optimizer.step()
    return results


@pytest.mark.parametrize("dim", [3, 4, 45])
def test_only_rows_in_view_are_searched_and_bounds_change_no_bit(dim: int, searches: list[tuple[str, int]]) -> None:
    standard = steps(dim)
    assert searches == [("bounds", SEEN)] * TRAINED
    searches.clear()
    with switched(distance_bounds=False):
        other = steps(dim)
    assert searches == [("plain", SEEN)] * TRAINED
    assert all(map(torch.equal, chain(*standard), chain(*other)))
    moved = standard[0][1] != standard[3][1]  # the same rows
    assert 0 < int(moved.sum()) < SEEN


def test_replacement_rule() -> None:
    """A code hit in less than 1 % of 200 iterations, that is fewer than 2, is replaced by an active one."""
    quantizer, _ = fitted()
    before = quantizer.codebook.detach().clone()
    quantizer.window.fill_(200)
    quantizer.usage.copy_(torch.tensor([0, 1, 2, 3, 200, 0, 50, 1]))
    replaced = quantizer.replace_unused(generator(0))
    assert replaced.tolist() == [0, 1, 5, 7]
    active = torch.tensor([2, 3, 4, 6])
    after = quantizer.codebook.detach()
    assert torch.equal(after[active], before[active])
    source = torch.cdist(after[replaced], before[active]).argmin(1)
    assert sorted(source.tolist()) == [0, 1, 2, 3]
    torch.testing.assert_close(after[replaced], before[active][source], rtol=0, atol=1e-7)
    assert int(quantizer.window) == 0
    assert int(quantizer.usage.sum()) == 0


def test_more_to_replace_than_active() -> None:
    _, counts = copy_codes(torch.tensor([[3.0], [5.0], [9.0]]), 7, generator(0)).unique(return_counts=True)
    assert sorted(counts.tolist()) == [2, 2, 3]


def test_no_active_code_warns_and_changes_nothing(caplog: pytest.LogCaptureFixture) -> None:
    quantizer, _ = fitted()
    before = quantizer.codebook.detach().clone()
    assert quantizer.replace_unused(generator(0)).numel() == 0  # the window is empty
    quantizer.window.fill_(100)
    with caplog.at_level(logging.WARNING):
        assert quantizer.replace_unused(generator(0)).numel() == 0
    assert "no code was active in 100 iterations" in caplog.text
    assert torch.equal(quantizer.codebook, before)


@pytest.mark.parametrize("fix", ["freeze", "hold"])
def test_state_of_another_size_loads(fix: str) -> None:
    source, x = fitted(num_codes=200, count=50)
    source(x, generator(0))
    getattr(source, fix)(source.encode(x))
    target = NSVQ(7, 3)
    parameter = target.codebook
    target.load_state_dict(source.state_dict())
    assert target.codebook is parameter
    for name, value in source.state_dict().items():
        assert torch.equal(target.state_dict()[name], value), name
    assert target.frozen == (fix == "freeze")
    with pytest.raises(RuntimeError, match="codebook"):
        NSVQ(7, 4).load_state_dict(source.state_dict())


def test_refusals() -> None:
    quantizer, x = fitted()
    with pytest.raises(ValueError, match="num_codes must be at least 1"):
        NSVQ(0, 3)
    with pytest.raises(ValueError, match=r"\[N, 3\]"):
        quantizer.fit(x[:, :2])
    with pytest.raises(ValueError, match=r"\[0, 8\)"):
        quantizer.freeze(torch.tensor([0, 8]))
    with pytest.raises(ValueError, match="N > 0"):
        quantizer.freeze(torch.zeros(0, dtype=torch.int64))
    with pytest.raises(TypeError, match="int64"):
        quantizer.freeze(torch.tensor([0], dtype=torch.int32))
    with pytest.raises(ValueError, match=r"codes must be in \[0, 8\), got 0 to 8"):
        quantizer.hold(torch.arange(9))
    quantizer.hold(torch.zeros(0, dtype=torch.int64))
    quantizer.freeze(torch.tensor([0, 1, 2, 2]))
    with pytest.raises(ValueError, match="codes are frozen for 4 rows, got 3"):
        quantizer.mend(torch.tensor([1]), torch.zeros(3, 3), generator(0))


def test_held_codes_replace_the_nearest_ones_until_they_are_frozen() -> None:
    quantizer, x = fitted()
    held = torch.arange(100) % 8
    quantizer.hold(held)
    rows = torch.tensor([3, 10, 50])
    _, codes = quantizer(x, generator(0), rows)
    assert torch.equal(codes, held[rows])
    quantizer.eval()
    values, codes = quantizer(x)
    assert torch.equal(codes, held)
    assert torch.equal(values, quantizer.codebook[held])
    assert torch.equal(quantizer.encode(x), fitted()[0].encode(x))
    # A scene of another size has other rows.
    assert torch.equal(quantizer(x[:50])[1], quantizer.encode(x[:50]))
    quantizer.freeze(held)
    assert len(quantizer.held) == 0


def test_what_a_quantizer_lacks_is_named() -> None:
    class NearlyOne(NSVQ):
        freeze = property()  # type: ignore[assignment]  # reading it raises AttributeError

    assert as_quantizer(quantizer := NSVQ(4, 3)) is quantizer
    with pytest.raises(TypeError, match=r"NearlyOne is not a quantizer; it lacks: freeze; derive it from"):
        as_quantizer(NearlyOne(4, 3))
    with pytest.raises(TypeError, match=r"lacks: codebook, codes, decode, encode, fit, forward, freeze"):
        as_quantizer(object())


def test_a_quantizer_needs_a_forward_of_its_own() -> None:
    class Forgetful(NSVQ):
        forward = nn.Module.forward

    with pytest.raises(TypeError, match=r"Forgetful is not a quantizer: it must be an nn\.Module with a forward"):
        as_quantizer(Forgetful(4, 3))
    assert as_quantizer(compiled := torch.compile(NSVQ(4, 3), backend="eager")) is compiled


def test_a_codebook_that_nothing_trains_is_refused() -> None:
    quantizer = NSVQ(4, 3)
    del quantizer.codebook
    quantizer.register_buffer("codebook", torch.zeros(4, 3))
    with pytest.raises(TypeError, match=r"codebook is an nn\.Parameter"):
        as_quantizer(quantizer)


def test_parameters_beside_the_codebook_are_refused_and_buffers_are_not() -> None:
    quantizer = NSVQ(4, 3)
    quantizer.register_buffer("gain", torch.ones(()))
    quantizer.register_parameter("fixed", nn.Parameter(torch.ones(()), requires_grad=False))
    assert as_quantizer(quantizer) is quantizer
    quantizer.register_parameter("offset", nn.Parameter(torch.zeros(3)))
    with pytest.raises(TypeError, match=r"NSVQ has parameters beside its codebook, offset, .*: make them buffers"):
        as_quantizer(quantizer)
