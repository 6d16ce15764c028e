"""Compile, for a GPU that need not be there, the kernels that functions launch: names of CASES on the command line.

The functions are given tensors on torch's ``meta`` device, which stands for a GPU; instead of a launch, the kernel is
compiled with just the constants, types, alignments and warps of that launch. Prints a JSON list of what was compiled:
kernel, constants, warps, registers of a thread, and bytes of its stack, which hold what the registers could not.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
import triton
from kernel_entries import stand_in_for_a_gpu
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, make_backend
from triton.runtime.jit import JITFunction, create_function_from_signature

from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize.cuda.search import SNAPSHOT_STEPS, DeviceTracker, nearest_codes
from nsvq_lightning.quantize.cuda.substitution import sum_rows
from nsvq_lightning.quantize.nsvq import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.cuda import projection
from nsvq_lightning.rendering.cuda.binning import Tiles, tiles_of
from nsvq_lightning.rendering.cuda.blend import blend, blend_backward, tile_grid
from nsvq_lightning.rendering.cuda.projection import Lens
from nsvq_lightning.rendering.cuda.records import RECORD
from nsvq_lightning.rendering.sampling import ViewSampling

TARGET = GPUTarget("cuda", 90, 32)
SPLATS, SEEN, PAIRS, WIDTH, HEIGHT = 1000, 800, 3000, 100, 60


def tensor(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.empty(shape, dtype=dtype, device="meta")


def lens() -> Lens:
    return Lens(tensor(20), 90.0, 90.0, 50.5, 30.0, WIDTH, HEIGHT)


def attributes() -> tuple[torch.Tensor, ...]:
    shapes = (SPLATS, 3), (SPLATS, 4), (SPLATS, 3), (SPLATS,), (SPLATS, 1, 3), (SPLATS, 15, 3)
    return tuple(tensor(*shape) for shape in shapes)


def project(degree: int, sampling: ViewSampling | None = None) -> None:
    records, boxes = tensor(SPLATS, RECORD.value), tensor(SPLATS, 4, dtype=torch.int32)
    projection._launch_projection(lens(), attributes(), degree, sampling, records, boxes, tensor(SPLATS, 2))
    ids, rows = tensor(SEEN, dtype=torch.int64), tensor(SEEN, RECORD.value)
    projection.project_backward(lens(), attributes(), degree, ids, rows, rows, tensor(SPLATS, 2), sampling)


def tiles() -> Tiles:
    columns, rows = tile_grid(WIDTH, HEIGHT)
    lengths = columns * rows + 1, columns * rows, PAIRS, PAIRS, SEEN
    return Tiles(*(tensor(length, dtype=torch.int32) for length in lengths))


def render(*, everything: bool) -> None:
    columns, rows = tile_grid(WIDTH, HEIGHT)
    image, plane, records = tensor(HEIGHT, WIDTH, 3), tensor(HEIGHT, WIDTH), tensor(SEEN, RECORD.value)
    blend(lens(), records, tiles(), tensor(3))
    blend_backward(
        lens(), records, tensor(SEEN, dtype=torch.int64), SPLATS, tiles(),
        tensor(columns * rows, dtype=torch.int32), (image, plane, plane),
        (image, plane, plane) if everything else (image, None, None), plane if everything else None,
    )  # fmt: skip


def loss(height: int, dtype: torch.dtype, *, psnr: bool = False) -> None:
    image = tensor(height, WIDTH, 3).requires_grad_()
    photometric_loss(image, tensor(height, WIDTH, 3, dtype=dtype), psnr=psnr).backward()


def search(dim: int) -> None:
    tracker = DeviceTracker(tensor(4096, dim))
    for _ in range(SNAPSHOT_STEPS):  # the last one takes a snapshot
        tracker.search(tensor(SPLATS, dim), tensor(4096, dim), tensor(SEEN, dtype=torch.int64))


def substitute(dim: int) -> None:
    x, rows = tensor(SPLATS, dim).requires_grad_(), tensor(SEEN, dtype=torch.int64)
    NSVQ(4096, dim).to("meta")(x, generator(0), rows)[0].sum().backward()


def sums(dim: int, dtype: torch.dtype) -> None:
    sum_rows(tensor(SPLATS, dim), tensor(SPLATS, dtype=torch.int64), 4096, dtype)


CASES: dict[str, Callable[[], object]] = {
    "radii": lambda: projection.project_radii(lens(), attributes()),
    "project_0": lambda: project(0),
    "project_3": lambda: project(3),
    "project_sampled": lambda: project(3, ViewSampling(tensor(2, SPLATS), 0.25)),
    "tiles": lambda: tiles_of(tensor(SEEN, 4, dtype=torch.int32), tensor(SEEN, dtype=torch.int32), PAIRS, 7, 4),
    "blend": lambda: render(everything=False),
    "blend_and_observe": lambda: render(everything=True),
    "loss": lambda: loss(HEIGHT, torch.uint8),
    "loss_for_psnr": lambda: loss(HEIGHT, torch.uint8, psnr=True),
    "loss_of_one_row": lambda: loss(1, torch.float32),
    "nearest_3": lambda: nearest_codes(tensor(SPLATS, 3), tensor(4096, 3)),
    "nearest_45": lambda: nearest_codes(tensor(SPLATS, 45), tensor(4096, 45)),
    "search_3": lambda: search(3),
    "search_45": lambda: search(45),
    "substitute_3": lambda: substitute(3),
    "substitute_45": lambda: substitute(45),
    "sums_3": lambda: sums(3, torch.float32),
    "sums_45": lambda: sums(45, torch.float64),
}

compiled: dict[str, dict[str, Any]] = {}


@cache
def binder(kernel: JITFunction[Any]) -> Any:
    return create_function_from_signature(kernel.signature, kernel.params, make_backend(TARGET))


def compile_launch(kernel: JITFunction[Any], *args: Any, grid: object, warmup: bool, **kwargs: Any) -> None:
    """Stands for a launch; a configuration is compiled once."""
    bound, specialization, options = binder(kernel)(*args, **kwargs)
    key = f"{kernel.__name__} {specialization} {options}"
    if key in compiled:
        return
    parsed, signature, constants, attrs = kernel._pack_args(
        make_backend(TARGET), kwargs, bound, specialization, options
    )
    built = triton.compile(ASTSource(kernel, signature, constants, attrs), target=TARGET, options=parsed.__dict__)
    named = {kernel.arg_names[place[0]]: value for place, value in constants.items()}
    compiled[key] = {
        "kernel": kernel.__name__, "constants": named, "warps": parsed.num_warps, **usage(built.asm["cubin"])
    }  # fmt: skip


def usage(cubin: bytes) -> dict[str, int]:
    """Registers of a thread and bytes of its stack, as the machine code declares them."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        said = subprocess.run([tool, "--dump-resource-usage", file.name], capture_output=True, text=True, check=True)
    found = re.search(r"REG:(\d+) STACK:(\d+).* LOCAL:(\d+)", said.stdout)
    assert found is not None, said.stdout
    return {"registers": int(found[1]), "stack": int(found[2]) + int(found[3])}


if __name__ == "__main__":
    JITFunction.run = compile_launch  # type: ignore[method-assign]
    stand_in_for_a_gpu()
    for case in sys.argv[1:]:
        CASES[case]()
    print(json.dumps(list(compiled.values())))
