"""The CUDA back-end: its cases in a process of their own, and whether its kernels compile for a GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nsvq_lightning.rendering.rasterize import resolve_backend

HERE = Path(__file__).parent


def test_against_the_oracle() -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    environment = dict(os.environ, **({} if torch.cuda.is_available() else {"TRITON_INTERPRET": "1"}))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(HERE / "triton_cases.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("module", "kernel"),
    [
        ("blend", "blend_backward"),
        pytest.param("blend", "blend", marks=pytest.mark.slow),
        pytest.param("blend", "total", marks=pytest.mark.slow),
        pytest.param("projection", "project", marks=pytest.mark.slow),
        pytest.param("projection", "project_backward", marks=pytest.mark.slow),
    ],
)
def test_kernels_compile_for_a_gpu(module: str, kernel: str) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    command = [sys.executable, str(HERE / "triton_compile.py"), module, f"{kernel}_kernel"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def test_error_without_gpu_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(ValueError, match=r"got torch.float32 on cpu; .*, or use backend='auto'"):
        resolve_backend("cuda", torch.zeros(1))


def test_error_without_triton_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setattr("nsvq_lightning.rendering.cuda.support.has_triton", lambda: False)
    with pytest.raises(ValueError, match="pip install triton"):
        resolve_backend("cuda", torch.zeros(1))
