"""The later phases of a run on a handful of splats, so that their kernels are compiled before the run gets there.

``python -m nsvq_lightning.training.precompile`` reads the settings of a module from its standard input, as
:func:`settings_of` wrote them, and leaves nothing behind but compiled kernels on the disk.
"""

import os
import pickle
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.cli import instantiate_module

from nsvq_lightning.compression.importance import row_weights
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.quantize.attributes import decoded, noisy_rows
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import visible
from nsvq_lightning.splats.attributes import attribute_shapes
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase


def settings_of(module: SplatModule) -> bytes | None:
    """The settings of a module for another process; None if they hold something that cannot be sent to one."""
    try:
        return pickle.dumps(dict(module.hparams) | {"init_from": None, "backend": "cpu"})
    except (pickle.PicklingError, AttributeError, TypeError):
        return None


# Splats, so that some search trees have more than one level.
MIN_SPLATS = 600


def compile_kernels(settings: dict[str, Any]) -> None:
    """Place the codebooks, train a step with noise and one with frozen codes, write the file and read it back.

    Nothing is drawn: the kernels of drawing are those of the first phase, which the run itself compiles meanwhile.
    """
    # A module that the command line has made keeps what it was made from, not what became of it.
    from_config = settings.pop("_instantiator", None) is not None
    module = instantiate_module(SplatModule, settings) if from_config else SplatModule(**settings)
    count = max([MIN_SPLATS, *(q.codebook.shape[0] + 1 for q in module.quantizers.values())])
    module.splats = _random_splats(count, module.splats.sh_degree)
    module.phase = Phase.QUANTIZE
    for name, quantizer in module.quantizers.items():
        weight = None if name == "scales" else row_weights(torch.ones(count))
        quantizer.fit(module.rows(name), weight, generator(0, 0, name))
    raw = module.splats.raw()
    rows = visible(raw, Camera(torch.tensor([[60.0, 0, 36], [0, 60, 28], [0, 0, 1]]), torch.eye(4), 72, 56))
    for _ in range(2):  # the second search has something to remember
        _backward(noisy_rows(raw, rows, module.quantizers, lambda name: generator(0, 1, name)))
    for name, quantizer in module.quantizers.items():
        quantizer.freeze(quantizer.encode(module.rows(name)))
    module.phase = Phase.FINETUNE
    _backward(decoded(raw, module.quantizers))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.nsvq"
        save(module.compressed(), path, module.storage)
        load(path)


def _backward(splats: RawSplats) -> None:
    torch.stack([tensor.sum() for tensor in splats]).sum().backward()  # type: ignore[no-untyped-call]


def _random_splats(count: int, sh_degree: int) -> Splats:
    """Splats before a camera at the origin that looks along z."""
    shapes = attribute_shapes(sh_degree).items()
    raw = {name: torch.randn(count, *shape, generator=generator(0, 2, name)) for name, shape in shapes}
    raw["means"] += torch.tensor([0.0, 0.0, 4.0])
    raw["scales"] -= 3.0
    return Splats.from_tensors(**raw)


if __name__ == "__main__":
    if hasattr(os, "nice"):
        os.nice(10)
    compile_kernels(pickle.load(sys.stdin.buffer))
