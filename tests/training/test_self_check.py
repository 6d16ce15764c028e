"""Kernels against plain torch in float64, and what is remembered of it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from nsvq_lightning.training import self_check
from nsvq_lightning.training.self_check import TOLERANCE, check_kernels, kernel_errors, relative_l2
from nsvq_lightning.version import __version__


def test_the_kernels_of_the_cpu_are_right() -> None:
    errors = kernel_errors("cpu")["cpu"]
    assert {"image", "loss", "means", "shN", "codes", "noise", "codebook"} <= set(errors)
    assert max(errors.values()) < 1e-4


def test_errors_are_relative() -> None:
    assert relative_l2(torch.tensor([3.0, 4.4]), torch.tensor([3.0, 4.0])) == pytest.approx(0.08)
    assert relative_l2(torch.tensor([3.0, 4.0]), torch.zeros(2)) == 5


@pytest.mark.parametrize("error", [2 * TOLERANCE, float("nan"), 1e-6])
def test_a_device_is_checked_once(error: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def errors(device: str) -> dict[str, dict[str, float]]:
        calls.append(device)
        return {"cuda": {"image": error, "codes": 0.0}}

    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Some GPU")
    monkeypatch.setattr(self_check, "kernel_folder", lambda: tmp_path)
    monkeypatch.setattr(self_check, "kernel_errors", errors)
    (tmp_path / "checked-devices.txt").write_text(
        f"Some GPU, nsvq_lightning {__version__}, torch {torch.__version__}0\n"  # a version that begins like this one
    )
    for turn in range(2):
        if error < TOLERANCE:
            check_kernels(torch.device("cuda", 0))
            assert calls == ["cuda:0"]
        else:  # it is not remembered
            with pytest.raises(RuntimeError, match=r"Some GPU.*image .*wrong numbers.*--trainer.accelerator=cpu"):
                check_kernels(torch.device("cuda", 0))
            assert len(calls) == turn + 1
