"""Compile one Triton kernel of the CUDA back-end for a GPU that need not be there: ``module kernel``."""

from __future__ import annotations

import importlib
import sys

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

CONSTANTS = {"DEGREE": 3, "BLOCK": 128, "BATCH": 32, "SLOTS": 8, "LANES": 16}
CONSTANTS |= {"WITH_ALPHA": True, "WITH_DEPTH": True}
TYPES = dict.fromkeys(("fx", "fy", "cx", "cy"), "fp32")
TYPES |= dict.fromkeys(("width", "height", "columns", "n", "count", "stride"), "i32")
TYPES |= dict.fromkeys(("radii", "boxes", "ranks", "slots", "offsets", "ends", "slot_ends"), "*i32")
TYPES |= {"ids": "*i64"}


def main(module: str, name: str) -> None:
    """Compile; pointers are to float32 where nothing else is said."""
    kernel = getattr(importlib.import_module(f"nsvq_lightning.rendering.cuda.{module}"), name)
    constants = {key: CONSTANTS[key] for key in kernel.arg_names if key in CONSTANTS}
    signature = {key: "constexpr" if key in constants else TYPES.get(key, "*fp32") for key in kernel.arg_names}
    places = {(kernel.arg_names.index(key),): value for key, value in constants.items()}
    source = ASTSource(fn=kernel, signature=signature, constexprs=places)
    compiled = triton.compile(source, target=GPUTarget("cuda", 90, 32), options={"num_warps": 1})
    assert compiled.asm["cubin"], name


if __name__ == "__main__":
    main(*sys.argv[1:])
