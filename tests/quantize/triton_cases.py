"""The quantizers' Triton kernels against float64 and the CPU's, on a GPU or under Triton's interpreter.

See ``tests/rendering/triton_cases.py`` on how this is run.
"""

import importlib
from collections.abc import Iterator

import pytest
import torch

from nsvq_lightning.compute.rows import sorted_by_key
from nsvq_lightning.quantize.cuda import search as search_module
from nsvq_lightning.quantize.cuda import substitution as substitution_module
from nsvq_lightning.quantize.cuda.search import DeviceTracker, nearest_codes
from nsvq_lightning.quantize.cuda.substitution import substitute, sum_rows
from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.quantize.nearest import nearest
from nsvq_lightning.quantize.nsvq import NSVQ, noise_substitution
from nsvq_lightning.quantize.substitution import substitute as substitute_cpu
from nsvq_lightning.random import generator

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture
def kernels_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the interpreter float32 tensors on the CPU stand for those on a GPU."""
    for name in ("nearest", "nsvq", "tracking"):
        module = importlib.import_module(f"nsvq_lightning.quantize.{name}")
        monkeypatch.setattr(module, "kernels_for", lambda x: "cuda" if x.dtype == torch.float32 else None)


def rows_and_codes(n: int, k: int, dim: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    return torch.randn(n, dim, generator=draw) + 3, torch.randn(k, dim, generator=draw) + 3


def oracle(x: torch.Tensor, codebook: torch.Tensor) -> torch.Tensor:
    return (x.double()[:, None] - codebook.double()).square().sum(2)


@pytest.mark.parametrize(("n", "k", "dim"), [(33, 300, 3), (40, 128, 4), (70, 129, 45), (1, 1, 1), (5, 7, 9)])
def test_nearest_code(n: int, k: int, dim: int) -> None:
    x, codebook = rows_and_codes(n, k, dim)
    codes = nearest_codes(x.to(DEVICE), codebook.to(DEVICE)).cpu()
    assert torch.equal(codes, oracle(x, codebook).argmin(1))


def test_of_equally_near_codes_the_lowest() -> None:
    x, codebook = rows_and_codes(9, 40, 3)
    codebook = codebook.repeat(8, 1)  # more than one program looks at together
    codes = nearest_codes(x.to(DEVICE), codebook.to(DEVICE)).cpu()
    assert torch.equal(codes, oracle(x, codebook[:40]).argmin(1))


def test_what_is_not_a_number_is_never_nearest() -> None:
    x, codebook = rows_and_codes(6, 150, 3)
    codebook[0], codebook[3], codebook[140] = torch.nan, torch.inf, torch.tensor([0.0, -torch.inf, 0.0])
    x[0], x[1] = torch.nan, torch.inf
    distances = oracle(x, codebook).nan_to_num(nan=torch.inf, posinf=torch.inf)
    assert torch.equal(nearest_codes(x.to(DEVICE), codebook.to(DEVICE)).cpu(), distances.argmin(1))
    assert nearest_codes(x.to(DEVICE), torch.full((5, 3), torch.nan, device=DEVICE)).tolist() == [0] * 6
    assert nearest_codes(x[:0].to(DEVICE), codebook.to(DEVICE)).shape == (0,)


def walk(dim: int, steps: int, size: float) -> Iterator[tuple[torch.Tensor, ...]]:
    """Rows, codes, and which rows are in view, as they move a little at each step."""
    draw = torch.Generator().manual_seed(dim)
    x, codebook = torch.randn(60, dim, generator=draw), torch.randn(150, dim, generator=draw)
    for _ in range(steps):
        x = x + size * torch.randn(x.shape, generator=draw)
        codebook = codebook + size * torch.randn(codebook.shape, generator=draw)
        yield x, codebook, torch.randperm(60, generator=draw)[:30].sort().values


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Length of the queue of each search."""
    lengths: list[int] = []
    follow_jump = DeviceTracker._follow_jump

    def counting(self: DeviceTracker, codebook: torch.Tensor, ends: torch.Tensor, count: int) -> None:
        lengths.append(int(ends[-1]))
        follow_jump(self, codebook, ends, count)

    monkeypatch.setattr(DeviceTracker, "_follow_jump", counting)
    return lengths


@pytest.mark.parametrize(
    ("dim", "size", "programs"),
    [(3, 1e-4, 1), (4, 1e-2, 4096), (45, 1e-4, 4096)],
)
def test_codes_that_a_bound_proves_are_those_of_a_search(
    dim: int, size: float, programs: int, searched: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_module, "PROGRAMS", programs)  # one works off the whole queue
    monkeypatch.setattr(search_module, "SNAPSHOT_STEPS", 4)
    tracker = DeviceTracker(next(walk(dim, 1, size))[1].to(DEVICE))
    for x, codebook, rows in walk(dim, 9 if size < 1e-2 else 5, size):
        found = tracker.search(x.to(DEVICE), codebook.to(DEVICE), rows.to(DEVICE))
        assert torch.equal(found.cpu(), nearest(x[rows], codebook))
    assert searched[0] == 30
    if size < 1e-2:
        assert 50 < sum(searched) <= 62  # each row once, and hardly ever again


def test_a_jump_of_codes_is_paid_for_once_on_the_device(searched: list[int]) -> None:
    tracker, everything = DeviceTracker(next(walk(9, 1, 1e-4))[1].to(DEVICE)), torch.arange(60)
    for step, (x, codebook, _) in enumerate(walk(9, 8, 1e-4)):
        if step >= 3:
            codebook = torch.where(torch.arange(150)[:, None] % 10 == 0, codebook + 1.0, codebook)
        found = tracker.search(x.to(DEVICE), codebook.to(DEVICE), everything.to(DEVICE))
        assert torch.equal(found.cpu(), nearest(x, codebook))
    assert searched[:4] == [60, 0, 0, 60]
    assert sum(searched[4:]) < 10


def test_equal_codes_and_numbers_that_are_none_on_the_device() -> None:
    tracker, everything = DeviceTracker(next(walk(9, 1, 1e-4))[1].to(DEVICE)), torch.arange(60)
    for x, codebook, _ in walk(9, 4, 1e-4):
        codebook[75:] = codebook[:75]
        codebook[3, 4], x[5] = torch.nan, torch.nan
        found = tracker.search(x.to(DEVICE), codebook.to(DEVICE), everything.to(DEVICE))
        assert torch.equal(found.cpu(), nearest(x, codebook))


def test_few_codes_and_more_rows_on_the_device() -> None:
    tracker = DeviceTracker(rows_and_codes(5, 3, 4, seed=1)[1].to(DEVICE))
    for count in (5, 9, 2, 0, 7):
        x, codebook = rows_and_codes(count, 3, 4, seed=1)
        found = tracker.search(x.to(DEVICE), codebook.to(DEVICE), torch.arange(count, device=DEVICE))
        assert torch.equal(found.cpu(), nearest(x, codebook))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize(("n", "k", "dim"), [(100, 9, 3), (30, 2, 70), (0, 4, 3), (3000, 3, 4)])
def test_sums_by_code(n: int, k: int, dim: int, dtype: torch.dtype, tolerance: float) -> None:
    draw = torch.Generator().manual_seed(n)
    values, codes = torch.randn(n, dim, generator=draw), torch.randint(0, k, (n,), generator=draw)
    codes[codes == 1] = 0  # one code without rows
    found = sum_rows(values.to(DEVICE), codes.to(DEVICE), k, dtype)
    expected = torch.zeros(k, dim, dtype=torch.float64).index_add_(0, codes, values.double())
    assert found.dtype == dtype
    torch.testing.assert_close(found.cpu().double(), expected, rtol=0, atol=tolerance)


def test_frozen_codes_are_sorted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sorted_codes: list[int] = []

    def counting(codes: torch.Tensor, num_codes: int) -> tuple[torch.Tensor, torch.Tensor]:
        sorted_codes.append(num_codes)
        return sorted_by_key(codes, num_codes)

    monkeypatch.setattr(substitution_module, "sorted_by_key", counting)
    values, codes = torch.randn(30, 3, device=DEVICE), torch.arange(30, device=DEVICE) % 4
    first = sum_rows(values, codes, 4, torch.float32)
    assert torch.equal(sum_rows(values, codes, 4, torch.float32), first)
    assert sorted_codes == [4]
    codes[0] = 1
    assert not torch.equal(sum_rows(values, codes, 4, torch.float32), first)
    sum_rows(values, codes, 5, torch.float32)
    assert sorted_codes == [4, 4, 5]


@pytest.mark.parametrize("num_codes", [32_767, 32_768, 40_001])
def test_codes_beyond_sixteen_bits(num_codes: int) -> None:
    last = num_codes - 1
    order, offsets = sorted_by_key(torch.tensor([last, 0, last, 32_766], device=DEVICE), num_codes)
    starts = offsets.tolist()
    assert [order[starts[code] : starts[code + 1]].tolist() for code in (0, last)] == [
        [1],
        [0, 2] if last > 32_766 else [0, 2, 3],
    ]
    assert starts[1] == 1
    assert starts[-1] == 4


@pytest.mark.parametrize(("seed", "n", "dim"), [(5, 300, 3), (2**63 - 1, 21, 45), (5, 0, 3)])
@pytest.mark.parametrize(("aim", "spread"), [(0.0, 1.0), (1.0, 1e-3)])
def test_substitution_is_that_of_the_cpu(seed: int, n: int, dim: int, aim: float, spread: float) -> None:
    x, codebook = rows_and_codes(2 * n, 7, dim)
    inputs = (x, torch.arange(n) * 2, codebook, torch.arange(n) % 7)
    found = substitute(seed, *(tensor.to(DEVICE) for tensor in inputs), aim=aim, spread=spread).cpu()
    expected = substitute_cpu(seed, *inputs, aim=aim, spread=spread)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("kernels_of_a_gpu")
@pytest.mark.parametrize(("n", "dim"), [(60, 3), (20, 45), (0, 4)])
@pytest.mark.parametrize("all_rows", [False, True])
def test_gradients_are_the_closed_form(n: int, dim: int, all_rows: bool) -> None:
    x, codebook = rows_and_codes(n, 5, dim)
    if n:
        x[0] = codebook[0]  # no error, no direction
    rows = None if all_rows else torch.arange(0, n, 3)
    count = n if rows is None else len(rows)
    codes = torch.arange(count) % 5
    leaves = [tensor.to(DEVICE).requires_grad_() for tensor in (x, codebook)]
    chosen = None if rows is None else rows.to(DEVICE)
    out = noise_substitution(*leaves, codes.to(DEVICE), generator(3), chosen)
    slope = torch.randn(count, dim, generator=torch.Generator().manual_seed(1))
    out.backward(slope.to(DEVICE))

    values = x.double() if rows is None else x.double()[rows]
    residual = values - codebook.double()[codes]
    length = residual.norm(dim=1, keepdim=True)
    moved = out.detach().cpu().double() - values
    torch.testing.assert_close(moved.norm(dim=1, keepdim=True), length, rtol=1e-4, atol=1e-6)
    radial = (slope * moved).sum(1, keepdim=True) * residual / length.square().clamp_min(1e-30)
    expected = torch.zeros_like(x, dtype=torch.float64)
    expected[slice(None) if rows is None else rows] = slope + radial
    torch.testing.assert_close(leaves[0].grad.cpu().double(), expected, rtol=1e-4, atol=1e-4)
    by_code = torch.zeros(5, dim, dtype=torch.float64).index_add_(0, codes, -radial)
    torch.testing.assert_close(leaves[1].grad.cpu().double(), by_code, rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("kernels_of_a_gpu")
def test_kmeans_searches_with_the_kernel() -> None:
    x, _ = rows_and_codes(120, 1, 3)
    found = kmeans(x.to(DEVICE), 6, generator(1), steps=2).cpu()
    expected = x[torch.randperm(120, generator=generator(1))[:6]].double()
    for _ in range(2):
        codes = oracle(x, expected).argmin(1)
        expected = torch.stack([x[codes == code].double().mean(0) for code in range(6)])
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-6)


@pytest.mark.usefixtures("kernels_of_a_gpu")
def test_a_step_of_the_quantizer() -> None:
    """The whole way of a training step: search, count, substitute, and back."""
    x, codebook = rows_and_codes(50, 8, 4)
    quantizer = NSVQ(8, 4).to(DEVICE)
    with torch.no_grad():
        quantizer.codebook.copy_(codebook)
    leaf = x.to(DEVICE).requires_grad_()
    rows = torch.arange(0, 50, 2)
    out, codes = quantizer(leaf, generator(0), rows.to(DEVICE))
    out.square().sum().backward()
    assert leaf.grad.isfinite().all()
    assert quantizer.codebook.grad.isfinite().all()
    assert (leaf.grad[1::2] == 0).all()
    assert torch.equal(codes.cpu(), oracle(x[rows], codebook).argmin(1))
    assert torch.equal(quantizer.usage.cpu() > 0, torch.bincount(codes.cpu(), minlength=8) > 0)
