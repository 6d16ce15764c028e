"""Copies that nobody waits for; what a GPU does is played by a stand-in."""

import pytest
import torch

from nsvq_lightning.compute.devices import AsyncScalar, to_device


def test_a_tensor_that_is_there_stays_itself() -> None:
    tensor = torch.ones(3)
    assert to_device(tensor, "cpu") is tensor
    assert to_device(tensor, torch.device("meta")).is_meta


def test_a_copy_to_a_gpu_starts_from_pinned_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[object] = []

    def to(tensor: torch.Tensor, device: torch.device, **options: object) -> torch.Tensor:
        said.append((device.type, options))
        return tensor

    def pin(tensor: torch.Tensor) -> torch.Tensor:
        said.append("pinned")
        return tensor

    monkeypatch.setattr(torch.Tensor, "to", to)
    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    to_device(torch.ones(3), "cuda")
    assert said == ["pinned", ("cuda", {"non_blocking": True})]


@pytest.mark.parametrize("value", [1.5, float("inf")])
def test_a_number_of_the_host_is_there_at_once(value: float) -> None:
    number = AsyncScalar(torch.tensor(value, requires_grad=True))
    assert number.is_here
    assert number.read() == value


def test_a_number_of_a_gpu_is_read_after_its_own_copy() -> None:
    if not torch.cuda.is_available():
        pytest.skip("this machine has no GPU")
    value = torch.tensor(2.5, device="cuda")
    number = AsyncScalar(value)
    value.fill_(3.0)
    assert not number.is_here
    assert number.read() == 2.5
