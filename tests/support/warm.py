"""Compile the kernels that many tests need, one half of them: ``rendering`` or ``quantizing`` on the command line.

A kernel is compiled once and then found on the disk. Two processes that compile a half each are done sooner than test
processes that all need the same kernels first.
"""

from __future__ import annotations

import sys

import torch
from splat_scenes import front_camera, random_splats

from nsvq_lightning.callbacks.precompile import compile_kernels
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize import NSVQ, QUANTIZED, StraightThrough
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.splats.splats import RawSplats


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
