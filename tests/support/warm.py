"""Compile the kernels that many tests need, one half of them: ``rendering`` or ``quantizing`` on the command line.

A kernel is compiled once and then found on the disk. Two processes that compile a half each are done sooner than test
processes that all need the same kernels first.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from splat_scenes import front_camera, random_splats

from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.io import CompressedScene, SplatArrays
from nsvq_lightning.io.morton import spatial_order
from nsvq_lightning.io.nsvq.file import decode, encode
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize import NSVQ, StraightThrough
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.splats.splats import RawSplats

DIMS = (3, 4, 9, 45)
"""Numbers of a row: scales and colours, rotations, spherical harmonics of degree 1 and 3."""


def rendering() -> None:
    """A training step without quantization, on photos of bytes and of floats."""
    camera = front_camera()
    for photo in (torch.zeros(camera.height, camera.width, 3), torch.zeros(camera.height, camera.width, 3).byte()):
        splats = RawSplats(*(tensor.requires_grad_() for tensor in random_splats(200)))
        visible(splats, camera)
        photometric_loss(render(splats, camera).image, photo).backward()


def quantizing() -> None:
    """Codebooks from the start to the file and back."""
    for dim in DIMS:
        x = torch.randn(600, dim, generator=generator(0, dim)).requires_grad_()
        rows = torch.arange(0, 600, 2)
        for kind in (NSVQ, StraightThrough):
            quantizer = kind(300, dim)
            quantizer.fit(x.detach(), None, generator(1))
            for _ in range(2):  # the second search has something to remember
                quantizer(x, generator(2), rows)[0].sum().backward()
            quantizer.freeze(quantizer.encode(x.detach()))
        take_rows(x, rows).sum().backward()
    arrays = SplatArrays.from_splats(random_splats(600))
    spatial_order(arrays.means)
    scene = CompressedScene.from_arrays(arrays)
    codes = {name: np.arange(600) % 40 for name in scene.raw}
    books = {name: values[:40] for name, values in scene.raw.items()}
    for stored in (scene, CompressedScene(scene.means, scene.opacities, codes, books)):
        header, streams = encode(stored)
        decode(header, {name: memoryview(data) for name, data in streams.items()})


if __name__ == "__main__":
    {"rendering": rendering, "quantizing": quantizing}[sys.argv[1]]()
