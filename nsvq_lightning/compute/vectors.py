"""What the quantizers' kernels need beside the vector type: a minimum over the lanes, and helpers that cost no call."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.typing.templates import Signature, signature
from numba.extending import intrinsic
from numpy.typing import NDArray

from nsvq_lightning.compute.lanes import WIDTH, Lanes

__all__ = ["aligned_empty", "lane_min"]


@intrinsic
def lane_min(typingctx: Any, lanes: types.Type) -> tuple[Signature, Any] | None:
    """Smallest of the 16 lanes; a NaN lane may be passed over or returned."""
    if lanes != Lanes:
        return None

    def emit(context: Any, builder: Any, sig: Signature, values: Any) -> Any:
        smallest = values[0]
        for step in (8, 4, 2, 1):
            turned = [(lane + step) % WIDTH for lane in range(WIDTH)]
            order = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), turned)
            other = builder.shuffle_vector(smallest, smallest, order)
            smallest = builder.select(builder.fcmp_ordered("<", other, smallest), other, smallest)
        return builder.extract_element(smallest, ir.IntType(32)(0))

    return signature(types.float32, lanes), emit


def aligned_empty(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """An uninitialised float32 array that starts on a cache line, so that no vector of it lies on two."""
    size = math.prod(shape)
    memory = np.empty(size + WIDTH, np.float32)
    start = -(memory.ctypes.data // 4) % WIDTH
    return memory[start : start + size].reshape(shape)
