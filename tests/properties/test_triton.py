"""The CUDA back-end: its cases in a process of their own, and whether its kernels compile for a GPU."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nsvq_lightning.compute.devices import resolve_backend

TESTS = Path(__file__).parents[1]


CASES = (
    "training/triton_step_cases.py",
    *(
        pytest.param(cases, marks=pytest.mark.slow)
        for cases in ("rendering/triton_cases.py", "rendering/triton_loss_cases.py", "quantize/triton_cases.py")
    ),
)


@pytest.mark.parametrize("cases", CASES)
def test_against_the_oracle(cases: str) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    # What a step asks for is counted where tensors on the CPU stand for those on a GPU, on a machine with one, too.
    interpreted = {"TRITON_INTERPRET": "1", "CUDA_VISIBLE_DEVICES": ""}
    on_gpu = torch.cuda.is_available() and "step" not in cases
    environment = {**os.environ, **({} if on_gpu else interpreted)}
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", str(TESTS / cases)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr


REGISTERS = {
    "project_kernel": 80,
    "project_backward_kernel": 72,
    "take_kernel": 32,
    "blend_kernel": 112,
    "blend_backward_kernel": 152,
    "total_kernel": 104,
    "expand_kernel": 48,
    "moments_kernel": 112,
    "similarity_kernel": 144,
    "loss_kernel": 64,
    "spread_kernel": 40,
    "gradient_kernel": 144,
    "nearest_kernel": 168,
    "drift_kernel": 32,
    "check_kernel": 72,
    "queue_kernel": 40,
    "snapshot_kernel": 32,
    "search_kernel": 232,
    "substitute_kernel": 96,
    "radial_kernel": 96,
    "part_kernel": 128,
    "sum_kernel": 48,
}
"""Most registers that a thread of each kernel may take on sm_90; a multiprocessor has 65 536 for all its threads."""
SAMPLED_REGISTERS = 24
"""How many more it may take where splats have a sampling."""


@pytest.mark.parametrize(
    "cases",
    [
        "radii blend search_45",
        pytest.param(
            "project_0 project_3 project_sampled tiles blend_and_observe loss loss_for_psnr loss_of_one_row",
            marks=pytest.mark.slow,
        ),
        pytest.param("nearest_3 nearest_45 search_3 substitute_3 substitute_45 sums_3 sums_45", marks=pytest.mark.slow),
    ],
)
def test_kernels_compile_as_they_are_launched(cases: str) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    command = [sys.executable, str(TESTS / "support" / "gpu_launches.py"), *cases.split()]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    built = json.loads(done.stdout)
    assert built
    for kernel in built:
        assert kernel["stack"] == 0, kernel
        name, constants = kernel["kernel"], kernel["constants"]
        more = SAMPLED_REGISTERS if name.startswith("project") and "distances" not in constants else 0
        assert kernel["registers"] <= REGISTERS[name] + more, kernel


def test_no_kernel_is_left_out() -> None:
    package = TESTS.parent / "nsvq_lightning"
    sources = [*package.glob("*/cuda/*.py"), package / "quality" / "ssim_cuda.py"]
    launch = r"(?:_launch\((?=\w+_kernel)|(?=\w+_kernel\[))(\w+_kernel)"
    launched = {name for path in sources for name in re.findall(launch, path.read_text())}
    defined = {name for path in sources for name in re.findall(r"def (\w+_kernel)\(", path.read_text())}
    assert launched == defined == set(REGISTERS)


@pytest.mark.parametrize(
    ("kernels", "changing"),
    [
        ("rendering.cuda.projection: project project_backward take", "n"),
        ("rendering.cuda.blend: total", "count"),
        ("rendering.cuda.binning: expand", "total count halvings"),
        ("quantize.cuda.search: nearest check queue search snapshot", "count"),
        ("quantize.cuda.substitution: substitute", "seed count height"),
        ("quantize.cuda.substitution: radial", "count height"),
    ],
)
def test_numbers_that_change_from_step_to_step_compile_once(kernels: str, changing: str) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    path, _, names = kernels.partition(": ")
    module = importlib.import_module(f"nsvq_lightning.{path}")
    for name in names.split():
        parameters = getattr(module, f"{name}_kernel").params
        assert [parameter.name for parameter in parameters if parameter.do_not_specialize] == changing.split()


def test_error_without_gpu_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(ValueError, match=r"got torch.float32 on cpu; .*, or use backend='auto'"):
        resolve_backend("cuda", torch.zeros(1))


def test_error_without_triton_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setattr("nsvq_lightning.compute.devices._has_triton", lambda: False)
    with pytest.raises(ValueError, match="pip install -U torch"):
        resolve_backend("cuda", torch.zeros(1))
