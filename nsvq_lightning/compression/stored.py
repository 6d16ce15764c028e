"""From a trained module to the scene that is written to disk."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.io.compressed import QUANTIZABLE, CompressedScene
from nsvq_lightning.io.formats import FORMATS, save
from nsvq_lightning.io.nsvq.file import decode, encode
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quantize.base import Quantizer
from nsvq_lightning.quantize.scene import attribute_rows, codes_of
from nsvq_lightning.splats.arrays import finite_rows
from nsvq_lightning.splats.splats import RawSplats, sh_degree_of

__all__ = ["DEFAULT_EXPORT", "EXPORT_FORMATS", "compress", "export_scene", "formula_bytes", "save_as_stored"]

EXPORT_FORMATS = tuple(suffix.removeprefix(".") for suffix, entry in FORMATS.items() if entry.write is not None)
"""Formats that :func:`export_scene` writes: the compressed scene, and its decoded splats for viewers."""
DEFAULT_EXPORT = ("nsvq", "ply")
"""Those that a run writes unless told otherwise."""


@torch.no_grad()
def compress(splats: RawSplats, quantizers: Mapping[str, Quantizer]) -> CompressedScene:
    """The scene as it is stored: codes and codebooks where there are quantizers, plain float32 elsewhere.

    Splats with non-finite values are left out with a warning.

    Args:
        splats: Raw attributes.
        quantizers: Quantizer by attribute; empty stores everything as it is.
    """
    finite = finite_rows({name: _numpy(tensor) for name, tensor in splats._asdict().items()})
    codes = {name: _numpy(codes_of(splats, name, quantizer)) for name, quantizer in quantizers.items()}
    return CompressedScene(
        means=_numpy(splats.means)[finite],
        opacities=_numpy(splats.opacities)[finite],
        codes={name: values[finite] for name, values in codes.items()},
        codebooks={name: _numpy(quantizer.codebook) for name, quantizer in quantizers.items()},
        raw={name: _numpy(attribute_rows(splats, name))[finite] for name in QUANTIZABLE if name not in quantizers},
        sh_degree=sh_degree_of(splats.shN),
    )


def export_scene(
    scene: CompressedScene, folder: Path, storage: Storage, formats: tuple[str, ...] = DEFAULT_EXPORT
) -> dict[str, Path]:
    """Write ``scene.<format>`` into ``folder`` for each format, atomically; the same scene gives the same bytes.

    Returns:
        Path by format.

    Raises:
        ValueError: A format is not one of :data:`EXPORT_FORMATS`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in formats:
        if suffix not in EXPORT_FORMATS:
            raise ValueError(f"unknown export format {suffix!r}; choose from {', '.join(EXPORT_FORMATS)}")
    paths = {suffix: folder / f"scene.{suffix}" for suffix in formats}
    stored = _as_stored(scene, storage) if set(formats) - {"nsvq"} else scene
    for suffix, path in paths.items():
        if suffix == "nsvq":
            save_as_stored(scene, path, storage)
        else:
            save(stored, path)
    return paths


def save_as_stored(scene: CompressedScene, path: Path, storage: Storage) -> int:
    """Save a scene in the format of the suffix: ``.nsvq`` as a run stores it, any other from what that file decodes to.

    Returns:
        Bytes of the file.
    """
    if path.suffix.lower() == ".nsvq":
        return save(scene, path, level=storage.level, precision=storage.precision)
    return save(_as_stored(scene, storage), path)


def _as_stored(scene: CompressedScene, storage: Storage) -> CompressedScene:
    """What a run's ``.nsvq`` file decodes to, so that all files of a scene hold the same splats.

    A scene without codebooks stays as it is: rounding it would only cost quality, and its record is the ``.ply``.
    """
    if not scene.codes:
        return scene
    header, streams = encode(scene, storage.level, storage.precision)
    return decode(header, {name: memoryview(data) for name, data in streams.items()})


def formula_bytes(scene: CompressedScene, header_bytes: int) -> int:
    """Bytes the paper's count gives: 16·N + ⌈N·Σ bits / 8⌉ + Σ 4·K·D + header, plus 4·N·D of what is not quantized.

    Counted here from the numbers of the scene alone, independently of the code that writes the file.
    """
    n = len(scene)
    bits = sum((len(codebook) - 1).bit_length() for codebook in scene.codebooks.values())
    floats = sum(codebook.size for codebook in scene.codebooks.values()) + sum(raw.size for raw in scene.raw.values())
    return 16 * n + (n * bits + 7) // 8 + 4 * floats + header_bytes


def _numpy(tensor: Tensor) -> NDArray[Any]:
    array: NDArray[Any] = tensor.detach().cpu().numpy()
    return array
