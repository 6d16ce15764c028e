"""The CUDA back-end: its cases in a process of their own, and whether its kernels compile for a GPU."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nsvq_lightning.rendering.rasterize import resolve_backend

HERE = Path(__file__).parent


@pytest.mark.parametrize("cases", ["triton_cases.py", "triton_step_cases.py", "../quantize/triton_cases.py"])
def test_against_the_oracle(cases: str) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    environment = dict(os.environ, **({} if torch.cuda.is_available() else {"TRITON_INTERPRET": "1"}))
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", str(HERE / cases)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


BLEND, PROJECTION, LOSS = "rendering.cuda.blend", "rendering.cuda.projection", "quality.ssim_cuda"
NEAREST, TRACKING = "quantize.cuda.nearest", "quantize.cuda.tracking"
NOISE, SUMS, SUBSTITUTION = (f"quantize.cuda.{name}" for name in ("noise", "sums", "substitution"))


@pytest.mark.parametrize(
    "kernels",
    [
        [f"{BLEND}:blend_backward_kernel"],
        pytest.param([f"{BLEND}:blend_kernel", f"{BLEND}:total_kernel"], marks=pytest.mark.slow),
        # Most steps are observed by nobody.
        pytest.param(
            [f"{BLEND}:{name}_kernel:WITH_MAP=0" for name in ("blend_backward", "total")], marks=pytest.mark.slow
        ),
        pytest.param([f"{PROJECTION}:project_kernel"], marks=pytest.mark.slow),
        pytest.param([f"{PROJECTION}:project_backward_kernel"], marks=pytest.mark.slow),
        # Some with an argument that is 1, of which Triton makes a constant.
        [f"{LOSS}:similarity_kernel:height=1", f"{LOSS}:loss_kernel:programs=1"],
        [
            f"{SUBSTITUTION}:substitute_kernel",
            f"{SUMS}:part_kernel:partial=*fp64",
            f"{SUMS}:sum_kernel:partial=*fp64:sums=*fp64",
        ],
        pytest.param([f"{NEAREST}:nearest_kernel:num_codes=1"], marks=pytest.mark.slow),
        pytest.param([f"{LOSS}:moments_kernel:height=1", f"{LOSS}:spread_kernel:height=1"], marks=pytest.mark.slow),
        pytest.param([f"{LOSS}:gradient_kernel:height=1"], marks=pytest.mark.slow),
        pytest.param([f"{SUBSTITUTION}:radial_kernel:count=1", f"{NOISE}:normal_kernel"], marks=pytest.mark.slow),
    ],
)
def test_kernels_compile_for_a_gpu(kernels: list[str]) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    command = [sys.executable, str(HERE / "triton_compile.py"), *kernels]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("kernel", "changing"),
    [
        (f"{PROJECTION}:project_kernel", {"n"}),
        (f"{PROJECTION}:project_backward_kernel", {"count"}),
        (f"{NEAREST}:nearest_kernel", {"count"}),
        (f"{TRACKING}:check_kernel", {"count"}),
        (f"{SUBSTITUTION}:substitute_kernel", {"seed", "count", "height"}),
        (f"{SUBSTITUTION}:radial_kernel", {"count", "height"}),
        (f"{NOISE}:normal_kernel", {"seed", "count"}),
    ],
)
def test_numbers_that_change_from_step_to_step_compile_once(kernel: str, changing: set[str]) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    module, _, name = kernel.partition(":")
    function = getattr(importlib.import_module(f"nsvq_lightning.{module}"), name)
    assert {parameter.name for parameter in function.params if parameter.do_not_specialize} == changing


def test_error_without_gpu_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(ValueError, match=r"got torch.float32 on cpu; .*, or use backend='auto'"):
        resolve_backend("cuda", torch.zeros(1))


def test_error_without_triton_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setattr("nsvq_lightning.compute.devices._has_triton", lambda: False)
    with pytest.raises(ValueError, match="pip install triton"):
        resolve_backend("cuda", torch.zeros(1))
