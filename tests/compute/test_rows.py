import pytest
import torch

from nsvq_lightning.compute import rows as rows_module
from nsvq_lightning.compute.rows import put_rows, take_rows
from nsvq_lightning.random import generator


@pytest.mark.parametrize("shape", [(9,), (9, 3), (9, 15, 3)])
@pytest.mark.parametrize("chosen", [[], [0], [8], [2, 3, 7], list(range(9))])
def test_rows_go_back_into_a_table_over_old_memory(
    shape: tuple[int, ...], chosen: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rows_module, "recycled", lambda shape: torch.full(shape, torch.nan))
    table, rows = torch.randn(shape, generator=generator(0)), torch.tensor(chosen, dtype=torch.int64)
    expected = torch.zeros(shape)
    expected[rows] = table[rows]
    assert torch.equal(put_rows(table[rows], rows, 9), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("chosen", [[0, 3, 4], []])
def test_taking_rows_has_the_gradient_of_index_select(dtype: torch.dtype, chosen: list[int]) -> None:
    x = torch.randn(6, 15, 3, generator=generator(0), dtype=dtype, requires_grad=True)
    rows = torch.tensor(chosen, dtype=torch.int64)
    weight = torch.randn(len(chosen), 15, 3, generator=generator(1), dtype=dtype)
    (ours,) = torch.autograd.grad((take_rows(x, rows) * weight).sum(), x)
    (theirs,) = torch.autograd.grad((x.index_select(0, rows) * weight).sum(), x)
    assert torch.equal(take_rows(x, rows), x.index_select(0, rows))
    assert torch.equal(ours, theirs)
