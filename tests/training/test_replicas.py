"""Replicas: what a checksum sees, and what happens when two differ."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.training.distributed import check_replicas, checksum, follow_first

ROWS = torch.randn(40, 3, generator=generator(0))


def test_a_checksum_is_the_sum_over_bits_and_places() -> None:
    # 1.0 is 0x3f800000, -0.0 is -2³¹ as an integer.
    assert int(checksum(torch.tensor([1.0, -0.0]))) == 1 * 0x3F800000 + 2 * -(2**31)
    assert int(checksum(torch.zeros(0, 3))) == 0


@pytest.mark.parametrize("change", ["last bit", "sign of zero", "rows swapped", "a row less"])
def test_a_checksum_sees_every_change(change: str) -> None:
    tensor = ROWS.clone()
    tensor[3, 1] = 0.0
    other = tensor.clone()
    if change == "last bit":
        other.view(torch.int32)[7, 2] ^= 1
    elif change == "sign of zero":
        other[3, 1] = -0.0
    elif change == "rows swapped":
        other[[1, 2]] = tensor[[2, 1]]
    else:
        other = other[:-1]
    assert int(checksum(tensor)) != int(checksum(other))
    assert int(checksum(tensor)) == int(checksum(tensor.clone()))


def trainer(world_size: int, parameters: dict[str, Tensor], first: Tensor | None = None) -> Any:
    """One of ``world_size`` processes; the first one's checksums are ``first`` or the same, the others agree."""

    def broadcast(own: Tensor) -> Tensor:
        return own if first is None else first

    return SimpleNamespace(
        world_size=world_size,
        global_step=600,
        optimizers=[SimpleNamespace(param_groups=[{"name": n, "params": [p]} for n, p in parameters.items()])],
        strategy=SimpleNamespace(broadcast=broadcast, reduce=lambda tensor, reduce_op: tensor),
    )


def test_replicas_that_differ_end_the_run_and_say_where() -> None:
    parameters = {"means": ROWS, "scales": ROWS + 1}
    same = torch.stack([checksum(tensor) for tensor in parameters.values()])
    check_replicas(trainer(2, parameters), "pruning")
    check_replicas(trainer(2, parameters, same), "pruning")
    check_replicas(trainer(1, parameters, same + 1), "pruning")  # alone there is nothing to compare
    with pytest.raises(RuntimeError, match=r"iteration 600, after pruning: .* 2 processes differ in scales\."):
        check_replicas(trainer(2, parameters, same + torch.tensor([0, 1])), "pruning")


def test_a_quantizer_takes_over_the_first_one_with_fewer_codes() -> None:
    first, other = NSVQ(64, 3), NSVQ(64, 3)
    first.fit(ROWS)
    parameter = other.codebook
    sent = first.state_dict()
    follow_first(SimpleNamespace(broadcast=lambda own: sent), other)  # type: ignore[arg-type]
    assert other.codebook is parameter  # the optimiser knows it
    assert torch.equal(other.codebook, first.codebook)
    assert other.usage.shape == (40,)
    assert bool(other.fitted)
