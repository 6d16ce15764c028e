"""What a whole training step asks of a GPU: operators, launches, and numbers that the host waits for.

Run by ``tests/properties/test_triton.py``; see ``tests/rendering/triton_cases.py`` on how. Tensors on the CPU stand for
those on a GPU, so a copy between the two is not seen; what is read is found by the operators that read, and told by
the function of the package that asks.
"""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer
from torch.utils._python_dispatch import TorchDispatchMode
from triton.runtime.interpreter import GridExecutor

import nsvq_lightning
from nsvq_lightning.data.scene import View
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

USERS = ("quality.loss", "compute.rows", "quantize.nearest", "quantize.tracking", "quantize.nsvq", "quantize.kmeans")
PACKAGE = Path(nsvq_lightning.__file__).parent
IDLE = {"detach", "view", "select", "slice", "t", "unbind", "transpose", "as_strided", "expand", "alias", "unsqueeze"}
IDLE |= {"empty", "new_empty", "empty_like", "_record_function_enter_new", "_record_function_exit"}
"""What gives a GPU nothing to do."""
READERS = {"aten._local_scalar_dense", "aten.nonzero", "aten.masked_select", "aten._unique2", "aten.bincount"}


class Census(TorchDispatchMode):
    """Counts what is done while it is active, kernels of Triton as one each."""

    def __init__(self) -> None:
        super().__init__()
        self.operators: Counter[str] = Counter()
        self.reads: Counter[str] = Counter()
        self.launches: list[str] = []
        self.inside = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not self.inside:
            name = func._overloadpacket._qualified_op_name.replace("::", ".")
            if name.rpartition(".")[2] not in IDLE:
                self.operators[name] += 1
            masks = name.startswith("aten.index") and any(
                isinstance(index, torch.Tensor) and index.dtype == torch.bool
                for index in (args[1] if isinstance(args[1], list | tuple) else [])
            )
            if name in READERS or masks:
                self.reads[asking()] += 1
        return func(*args, **(kwargs or {}))


def asking() -> str:
    """The innermost function of the package that is running."""
    frame = sys._getframe(2)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if PACKAGE in path.parents:
            return f"{path.stem}.{frame.f_code.co_name}"
        frame = frame.f_back  # type: ignore[assignment]
    return "outside"


@pytest.fixture
def census(monkeypatch: pytest.MonkeyPatch) -> Census:
    for name in USERS:
        module = importlib.import_module(f"nsvq_lightning.{name}")
        monkeypatch.setattr(module, "kernels_for", lambda like: "cuda" if like.dtype == torch.float32 else None)
    counted, call = Census(), GridExecutor.__call__

    def launch(executor: Any, *args: Any, **kwargs: Any) -> None:
        counted.launches.append(executor.fn.__name__)
        counted.inside = True
        call(executor, *args, **kwargs)
        counted.inside = False

    monkeypatch.setattr(GridExecutor, "__call__", launch)
    return counted


def module_and_view(phase: Phase) -> tuple[SplatModule, View]:
    draw = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draw)

    splats = Splats.from_tensors(
        rand(4, 3) * 0.3, rand(4, 4), rand(4, 3) * 0.2 - 2, rand(4), rand(4, 1, 3), rand(4, 15, 3)
    )
    codes = {"scales": 4, "quats": 4, "sh0": 4, "shN": 3}
    module = SplatModule(sh_degree=3, quantizer=NSVQ, codebooks=codes, splats=splats)
    module.backend, module.active_sh_degree, module.phase = "cuda", 3, phase
    for name, quantizer in module.quantizers.items():
        quantizer.fit(module.scene.rows(name), generator=generator(0, 0, name))
        if phase is Phase.FINETUNE:
            quantizer.freeze(quantizer.encode(module.scene.rows(name)))
    module._trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, max_steps=1000)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    camera = Camera(torch.tensor([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]]), viewmat, 8, 8)
    return module.train(), View("a.png", 0, camera, torch.zeros(8, 8, 3, dtype=torch.uint8))


def step(module: SplatModule, view: View, optimizer: torch.optim.Optimizer) -> None:
    outputs = module.training_step(view, 0)
    assert outputs is not None
    optimizer.zero_grad()
    outputs["loss"].backward()
    module.on_after_backward()
    optimizer.step()


RENDER = ["project_kernel", *2 * ["take_kernel"], "expand_kernel", "blend_kernel"]
LOSS = ["moments_kernel", "similarity_kernel", "loss_kernel"]
BACK = ["spread_kernel", "gradient_kernel", "blend_backward_kernel", "total_kernel", "project_backward_kernel"]
SEARCH = ["drift_kernel", "check_kernel", "queue_kernel", "search_kernel", "snapshot_kernel", "substitute_kernel"]
SUMS = ["part_kernel", "sum_kernel"]
# The number of splats in view, that of their pairs with tiles, and, behind the backward pass, the loss.
READS = {"projection.project": 1, "binning.list_tiles": 1, "devices.read": 1}


@pytest.mark.parametrize(
    ("phase", "launches", "reads", "most"),
    [
        (Phase.WARMUP, RENDER + LOSS + BACK, READS, 48),
        (
            Phase.QUANTIZE,
            ["project_kernel", *4 * SEARCH, *RENDER, *LOSS, *BACK, *4 * ["radial_kernel", *SUMS]],
            # Which splats are in view is asked before their codes are; the seeds of the noise are drawn on the host.
            READS | {"rasterizer.visible": 1, "nsvq.noise_substitution": 4},
            122,
        ),
        (Phase.FINETUNE, [*RENDER, *LOSS, *BACK, *(4 * SUMS)], READS, 58),
    ],
)
def test_a_step_asks_for_no_more(
    census: Census, phase: Phase, launches: list[str], reads: dict[str, int], most: int
) -> None:
    module, view = module_and_view(phase)
    optimizer = module.configure_optimizers()
    step(module, view, optimizer)  # the first one makes what the others find
    census.launches.clear()
    with census:
        step(module, view, optimizer)
    assert Counter(census.launches) == Counter(launches)
    assert dict(census.reads) == reads
    assert sum(census.operators.values()) <= most, census.operators.most_common()
