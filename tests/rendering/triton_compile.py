"""Compile Triton kernels for a GPU that need not be there: ``module:kernel[:name=type…] …`` on the command line."""

from __future__ import annotations

import importlib
import sys

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

CONSTANTS = {"DEGREE": 3, "BLOCK": 128, "BATCH": 32, "SLOTS": 8, "LANES": 16}
CONSTANTS |= {"WITH_ALPHA": True, "WITH_DEPTH": True, "WITH_MAP": True, "BYTES": True, "DERIVED": True}
CONSTANTS |= {"ROWS": 8, "COLUMNS": 128, "CODES": 128, "DIM": 45, "WIDTH": 64, "PARTS": 8, "PART": 256}
TYPES = dict.fromkeys(("fx", "fy", "cx", "cy", "aim", "spread", "dssim_weight", "l1_step", "ssim_step"), "fp32")
TYPES |= dict.fromkeys(("width", "height", "columns", "n", "count", "stride", "length", "programs"), "i32")
TYPES |= dict.fromkeys(("dim", "num_codes", "x_stride", "code_stride"), "i32")
TYPES |= dict.fromkeys(("radii", "boxes", "ranks", "slots", "offsets", "ends", "slot_ends"), "*i32")
TYPES |= dict.fromkeys(("ids", "rows", "codes", "order", "result"), "*i64")
TYPES |= {"seed": "i64", "target": "*u8"}


def compile_kernel(module: str, name: str, *overrides: str) -> None:
    """Compile; pointers are to float32 where nothing else is said. ``name=1`` makes a constant of an argument, which
    is what Triton does with an integer that is 1."""
    kernel = getattr(importlib.import_module(f"nsvq_lightning.{module}"), name)
    types = TYPES | dict(override.split("=") for override in overrides)
    constants = {key: CONSTANTS[key] for key in kernel.arg_names if key in CONSTANTS}
    constants |= {key: int(value) for key, value in types.items() if value.isdigit() and key in kernel.arg_names}
    signature = {key: "constexpr" if key in constants else types.get(key, "*fp32") for key in kernel.arg_names}
    places = {(kernel.arg_names.index(key),): value for key, value in constants.items()}
    source = ASTSource(fn=kernel, signature=signature, constexprs=places)
    compiled = triton.compile(source, target=GPUTarget("cuda", 90, 32), options={"num_warps": 1})
    assert compiled.asm["cubin"], name


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        compile_kernel(*argument.split(":"))
