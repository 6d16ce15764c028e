"""The attributes of a splat, declared once, and which rows of them are finite. Without torch: files open fast."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from nsvq_lightning.splats.conventions import sh_coefficients

# NumPy arrays, or torch tensors on any device; torch is not imported for the former.
_Array = TypeVar("_Array", bound=Any)


class Attribute(NamedTuple):
    """What the rooms above know of one raw attribute.

    Attributes:
        shape: Of the values of one splat; -1 stands for the number of higher SH coefficients.
        ply: Its properties in ``.ply``: their names, or what precedes their numbers.
        rate: Learning rate at the start (docs/recipe.md); that of the positions is times a distance.
        code_share: Number of codes relative to that for scales (paper, section 4: Ks = Kr = 4·Kc = 4·Ksh); 0 for means
            and opacities, which files store in ways of their own. Others need one above 0, also without a codebook.
        error: Largest error in files of level ``compact``, where it has no codebook.
        row_bits: Bits of a code there beyond log2 of the number of codes: colours of neighbours are alike.
        code_bits: Bits there of each number of the codebook.
    """

    shape: tuple[int, ...]
    ply: str
    rate: float
    code_share: float = 0.0
    error: float = 0.0
    row_bits: float = 0.0
    code_bits: float = 0.0


# The raw attributes by name, in the order of :meth:`nsvq_lightning.Splats.from_tensors`.
ATTRIBUTES = {
    "means": Attribute((3,), "x y z", 4.5e-4),
    "quats": Attribute((4,), "rot_", 2e-3, 1.0, error=0.005, row_bits=-0.1, code_bits=5.7),
    "scales": Attribute((3,), "scale_", 0.01, 1.0, error=0.02, row_bits=-0.5, code_bits=5.8),
    "opacities": Attribute((), "opacity", 0.025),
    "sh0": Attribute((1, 3), "f_dc_", 2.5e-3, 0.25, error=0.01, row_bits=-2.1, code_bits=6.0),
    "shN": Attribute((-1, 3), "f_rest_", 5e-4, 0.25, error=0.01, row_bits=-2.2, code_bits=5.1),
}

# Codes of scales and rotations by the paper's names of codebook sizes, from the largest.
SIZES = {"16k": 16384, "8k": 8192, "4k": 4096, "2k": 2048, "1k": 1024, "0.5k": 512}

# What a trained scene is compressed with.
DEFAULT_SIZE = "16k"

# Attributes that may have a codebook, in file order; positions and opacities never have (paper, section 3).
QUANTIZABLE = tuple(name for name, attribute in ATTRIBUTES.items() if attribute.code_share)
# The same, those with most codes first, of these those of fewest numbers, as the paper has them (section 4).
QUANTIZED = "scales", "quats", "sh0", "shN"


def codebook_bits(codebooks: Mapping[str, Sequence[float]]) -> tuple[float, float]:
    """Bits of all codebooks, and of the codes of one splat, in files of level ``compact``, about.

    Args:
        codebooks: Codes and dimension of each codebook by attribute.
    """
    books = splat = 0.0
    for name, (codes, dim) in codebooks.items():
        books += codes * dim * ATTRIBUTES[name].code_bits
        splat += math.log2(codes) + ATTRIBUTES[name].row_bits
    return books, splat


def attribute_shapes(sh_degree: int) -> dict[str, tuple[int, ...]]:
    """Shape of one splat's values by attribute."""
    coefficients = sh_coefficients(sh_degree)
    return {
        name: tuple(coefficients if size < 0 else size for size in attribute.shape)
        for name, attribute in ATTRIBUTES.items()
    }


def attribute_dims(sh_degree: int) -> dict[str, int]:
    """Values per splat, D, by attribute; ``shN`` is the flattened ``[coefficients, 3]``."""
    return {name: math.prod(shape) for name, shape in attribute_shapes(sh_degree).items()}


# Splats of a part, where what is made of one part at a time takes little memory.
ROWS = 1 << 16


def finite_rows(attributes: Mapping[str, _Array]) -> tuple[_Array, dict[str, int]]:
    """Which rows are finite in all attributes.

    Args:
        attributes: Arrays or tensors ``[N, ...]`` by name, at least one.

    Returns:
        A boolean mask ``[N]`` and, for each attribute with non-finite rows, how many it has.
    """
    kept: Any = True
    culprits = {}
    for name, values in attributes.items():
        rows = values.reshape(len(values), math.prod(values.shape[1:]))
        if isinstance(rows, np.ndarray):
            mask: Any = np.isfinite(rows).all(1)
        else:  # torch makes a copy on the way
            import torch

            mask = torch.cat([part.isfinite().all(1) for part in rows.split(ROWS)])
        kept = kept & mask
        if lost := len(mask) - int(mask.sum()):
            culprits[name] = lost
    return kept, culprits


def listed(culprits: Mapping[str, int]) -> str:
    """The attributes with non-finite rows, for a message."""
    return ", ".join(f"{name} in {count} rows" for name, count in culprits.items())


def dropped(mask: _Array, culprits: Mapping[str, int]) -> str:
    """The warning about rows that are left out, from both results of :func:`finite_rows`."""
    return f"dropped {int((~mask).sum())} of {len(mask)} splats with non-finite values: {listed(culprits)}"


def codebook_sizes(name: str) -> dict[str, int]:
    """Number of codes for each attribute in one of the paper's settings.

    Args:
        name: ``"0.5k"``, ``"1k"``, ``"2k"``, ``"4k"``, ``"8k"``, ``"16k"``: codes for scales and rotations in units of
            1024; colours and SH have a quarter as many.

    Returns:
        Attribute name to number of codes; ``codebook_sizes("16k")["shN"]`` is 4096.

    Raises:
        ValueError: The name is unknown.
    """
    if name not in SIZES:
        raise ValueError(f"unknown codebook setting {name!r}; choose one of {', '.join(SIZES)}")
    return {attribute: int(SIZES[name] * ATTRIBUTES[attribute].code_share) for attribute in QUANTIZED}
