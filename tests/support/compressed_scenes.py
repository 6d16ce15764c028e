"""Compressed scenes of random numbers."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nsvq_lightning.compression.basis import components
from nsvq_lightning.io import CompressedScene
from nsvq_lightning.splats.attributes import ATTRIBUTES, QUANTIZABLE, attribute_dims

SIZES = {"quats": 64, "scales": 100, "sh0": 33, "shN": 16}


def scene(n: int, sizes: dict[str, int] = SIZES, degree: int = 3, **header: Any) -> CompressedScene:
    """A scene whose attributes have realistic sizes."""
    rng = np.random.default_rng([n, degree, *sizes.values()])
    dims = {name: attribute_dims(degree)[name] for name in QUANTIZABLE}
    centre = {"quats": 0.0, "scales": -4.0, "sh0": 0.0, "shN": 0.0}
    spread = {"quats": 1.0, "scales": 1.0, "sh0": 1.0, "shN": 0.1}

    def rows(name: str, count: int) -> NDArray[np.float32]:
        return (centre[name] + spread[name] * rng.standard_normal((count, dims[name]))).astype(np.float32)

    return CompressedScene(
        means=(3 * rng.standard_normal((n, 3))).astype(np.float32),
        opacities=(2 + 2 * rng.standard_normal(n)).astype(np.float32),
        codes={name: rng.integers(0, k, n) for name, k in sizes.items()},
        codebooks={name: rows(name, k) for name, k in sizes.items()},
        raw={name: rows(name, n) for name in dims if name not in sizes},
        sh_degree=degree,
        **header,
    )


def on_basis(scene: CompressedScene) -> CompressedScene:
    """The scene, N > 0, with coefficients and a basis in place of spherical harmonics without a codebook."""
    coefficients, basis = components(torch.from_numpy(scene.raw["shN"]), torch.ones(len(scene)), 0.3)
    return replace(scene, raw=dict(scene.raw) | {"shN": coefficients}, bases={"shN": basis})


ON_NO_BASIS: dict[str, Callable[[Any], object]] = {
    "no row": lambda header: header["attributes"][5].__setitem__(3, 0),
    "more rows than columns": lambda header: header["attributes"][5].__setitem__(3, 46),
    "step of no power of two": lambda header: header["attributes"][5].__setitem__(4, 0.1),
    "step above 1": lambda header: header["attributes"][5].__setitem__(4, 2.0),
    "step below float32": lambda header: header["attributes"][5].__setitem__(4, 2.0**-150),
    "no column": lambda header: (
        header.update(sh_degree=0),
        header["attributes"][5].__setitem__(slice(1, 5), [0, "components", 0, 1.0]),
    ),
    "other attribute": lambda header: header["attributes"][4].__setitem__(slice(2, 5), ["components", 3, 1.0]),
    "basis of codes": lambda header: header["attributes"][5].__setitem__(2, "codes"),
    "coefficients first": lambda header: header["streams"].__setitem__(slice(-2, None), header["streams"][:-3:-1]),
    "codebook for a basis": lambda header: header["streams"][-2].__setitem__(0, "shN.codebook"),
}
"""Changes of the header of a file of :func:`on_basis` at degree 3 that no reader accepts."""


def scene_of(**arrays: NDArray[np.float32]) -> CompressedScene:
    """A scene without codebooks from the six attributes, in the shapes of ``Splats``."""
    rows = {name: values.reshape(len(values), math.prod(values.shape[1:])) for name, values in arrays.items()}
    return CompressedScene(
        arrays["means"],
        arrays["opacities"],
        raw={name: rows[name] for name in QUANTIZABLE},
        sh_degree=math.isqrt(arrays["shN"].shape[1] + 1) - 1,
    )


def arrays_of(scene: CompressedScene) -> SimpleNamespace:
    """The decoded attributes by name, in the shapes of ``Splats``."""
    return SimpleNamespace(**{name: scene.values(name) for name in ATTRIBUTES})


def framed(path: Path, text: bytes, body: bytes, version: int = 2) -> None:
    """Write a ``.nsvq`` file of any header and streams, whose checksum fits."""
    rest = struct.pack("<II", version, len(text)) + text + body
    path.write_bytes(b"\x89NSVQ\r\n\x1a" + hashlib.blake2b(rest, digest_size=16).digest() + rest)


def text_and_body(path: Path) -> tuple[bytes, bytes]:
    """The JSON of a ``.nsvq`` file, and its streams."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 28)
    return data[32 : 32 + length], data[32 + length :]


def forge(path: Path, change: Callable[[Any], object], version: int | None = None, body: bytes | None = None) -> None:
    """Change the header of a ``.nsvq`` file, and perhaps its version and streams; the checksum fits."""
    text, old = text_and_body(path)
    version = version or path.read_bytes()[24]
    header = json.loads(text)
    change(header)
    framed(path, json.dumps(header).encode(), old if body is None else body, version)
