"""Compile the kernels that many tests need, one half of them: ``rendering`` or ``quantizing`` on the command line.

A kernel is compiled once and then found on the disk. Two processes that compile a half each are done sooner than test
processes that all need the same kernels first.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from splat_scenes import front_camera, random_splats

from nsvq_lightning.compression.importance import row_weights
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize import NSVQ, QUANTIZED, StraightThrough
from nsvq_lightning.quantize.attributes import decoded, noisy_rows
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase


def compile_kernels(settings: dict[str, Any]) -> None:
    """Place the codebooks, train a step with noise and one with frozen codes, write the file and read it back.

    Args:
        settings: Arguments of the module.
    """
    module = SplatModule(**settings)
    # So many that some search trees have more than one level.
    module.splats = Splats.from_tensors(*random_splats(600, sh_degree=module.splats.sh_degree))
    module.phase = Phase.QUANTIZE
    for name, quantizer in module.quantizers.items():
        weight = None if name == "scales" else row_weights(torch.ones(600))
        quantizer.fit(module.rows(name), weight, generator(0, 0, name))
    raw = module.splats.raw()
    rows = visible(raw, front_camera())
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


def rendering() -> None:
    """A file without codebooks and back, then a training step on photos of bytes and of floats."""
    compile_kernels({"codebooks": None})
    camera = front_camera()
    for photo in (torch.zeros(camera.height, camera.width, 3), torch.zeros(camera.height, camera.width, 3).byte()):
        splats = RawSplats(*(tensor.requires_grad_() for tensor in random_splats(200)))
        visible(splats, camera)
        photometric_loss(render(splats, camera).image, photo).backward()


def quantizing() -> None:
    """Codebooks from the start to the file and back."""
    for degree in (1, 3):
        for quantizer in (NSVQ, StraightThrough):
            compile_kernels({"sh_degree": degree, "quantizer": quantizer, "codebooks": dict.fromkeys(QUANTIZED, 300)})


if __name__ == "__main__":
    {"rendering": rendering, "quantizing": quantizing}[sys.argv[1]]()
