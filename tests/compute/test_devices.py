"""Which device trains, and copies that nobody waits for; what a GPU does is played by a stand-in."""

import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch

from nsvq_lightning.compute import devices
from nsvq_lightning.compute.devices import (
    AsyncScalar,
    best_device,
    check_can_train,
    devices_with_kernels,
    to_device,
)


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


@pytest.mark.parametrize(
    ("cuda", "triton", "best"),
    [(True, True, "cuda"), (True, False, "cpu"), (False, True, "cpu"), (False, False, "cpu")],
)
def test_the_best_device_is_one_with_kernels(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, cuda: bool, triton: bool, best: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(devices, "_has_triton", lambda: triton)
    monkeypatch.setattr(devices, "best_device", best_device.__wrapped__)
    assert devices.best_device() == torch.device(best)
    assert devices_with_kernels() == list(dict.fromkeys(["cpu", best]))
    assert ("Triton 3.4 or later" in caplog.text) == (cuda and not triton)


@pytest.mark.parametrize(("files", "enough"), [(["__init__"], False), (["__init__", "knobs"], True)])
def test_a_triton_that_cannot_compile_the_kernels_is_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, files: list[str], enough: bool
) -> None:
    (tmp_path / "triton").mkdir()
    for name in files:
        (tmp_path / "triton" / f"{name}.py").touch()
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    assert devices._has_triton.__wrapped__() == enough


@pytest.mark.parametrize(
    ("device", "backend", "fits"),
    [
        ("cpu", "auto", True),
        ("mps", "auto", False),
        ("mps", "reference", False),  # it has no float64
        ("cuda", "auto", False),
        ("cuda", "reference", True),
        ("meta", "auto", False),
    ],
)
def test_without_kernels_only_plain_torch_that_was_asked_for_trains(
    monkeypatch: pytest.MonkeyPatch, device: str, backend: str, fits: bool
) -> None:
    monkeypatch.setattr(devices, "_has_triton", lambda: False)
    with nullcontext() if fits else pytest.raises(ValueError, match=rf'{device} here.*accelerator="cpu"'):
        check_can_train(torch.device(device), backend)
