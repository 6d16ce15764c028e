"""The machine code of the CPU kernels for processors that are not here; see cross_compile.py."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cross_compile
import llvmlite.binding as llvm
import pytest

ARM, INTEL = "aarch64-unknown-linux-gnu", "x86_64-unknown-linux-gnu"
PROCESSORS = {"generic": ARM, "apple-m1": ARM, "haswell": INTEL, "nehalem": INTEL, "skylake-avx512": INTEL}
"""Target by processor: 128 bits a vector twice, 256 bits, 128 bits without fused multiply-add, 512 bits."""
RUNTIME = {"NRT_incref", "NRT_decref", "memset"}
"""What a kernel may call beside functions of Numba itself: reference counts of arrays, and to clear its locals."""
LONGEST = 20_000
"""Instructions; a kernel that takes its vectors apart, lane by lane, has several times as many."""

MAIN = ("rendering.cpu.blend.blend", "rendering.cpu.blend.blend_backward")
ALL = (
    *MAIN,
    "rendering.cpu.projection.project_splats",
    "rendering.cpu.projection_backward.project_backward",
    "quality.ssim_cpu.sweep_image",
)


def _compiled(processor: str, *kernels: str) -> dict[str, Any]:
    llvm.initialize_all_targets()
    try:
        llvm.Target.from_triple(PROCESSORS[processor])
    except RuntimeError as error:
        pytest.skip(f"this llvmlite was built without that target: {error}")
    script = Path(cross_compile.__file__)
    command = [sys.executable, str(script), PROCESSORS[processor], processor, *kernels]
    measured: dict[str, Any] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return measured


@pytest.mark.parametrize(
    ("processor", "kernels"),
    [
        pytest.param("generic", MAIN, marks=pytest.mark.slow),
        pytest.param("nehalem", MAIN[:1], marks=pytest.mark.slow),
        *(pytest.param(processor, ALL, marks=pytest.mark.long) for processor in PROCESSORS),
    ],
)
def test_kernels_stay_vectors_and_call_no_library(processor: str, kernels: tuple[str, ...]) -> None:
    """Above all no ``fmaf``, which would be called for each lane where one instruction is not to be had."""
    compiled = _compiled(processor, *kernels)
    assert compiled.keys() == set(kernels)
    for name, code in compiled.items():
        assert 100 < code["instructions"] < LONGEST, name
        assert {call for call in code["calls"] if not call.startswith("_ZN5numba")} <= RUNTIME, name
