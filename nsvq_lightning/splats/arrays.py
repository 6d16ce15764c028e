"""A scene as NumPy arrays, what every file format reads into and writes from, and which of its rows are finite."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.splats.conventions import shN_degree

if TYPE_CHECKING:
    from nsvq_lightning.splats.splats import Splats, SplatTensors

__all__ = ["SplatArrays", "check_floats", "dropped", "finite_rows", "listed"]


_Array = TypeVar("_Array")
"""NumPy arrays, or torch tensors on any device; torch is not imported for the former."""


def finite_rows(attributes: Mapping[str, _Array]) -> tuple[_Array, dict[str, int]]:
    """Which rows are finite in all attributes.

    Args:
        attributes: Arrays or tensors ``[N, ...]`` by name, at least one.

    Returns:
        A boolean mask ``[N]`` and, for each attribute with non-finite rows, how many it has.
    """
    mask: Any = None
    culprits: dict[str, int] = {}
    for name, values in attributes.items():
        array: Any = values
        flags = np.isfinite(array) if isinstance(array, np.ndarray) else array.isfinite()
        good = flags.reshape(len(array), math.prod(array.shape[1:])).all(1)
        mask = good if mask is None else mask & good
        if bad := len(array) - int(good.sum()):
            culprits[name] = bad
    return mask, culprits


def listed(culprits: Mapping[str, int]) -> str:
    """The attributes with non-finite rows, for a message."""
    return ", ".join(f"{name} in {count} rows" for name, count in culprits.items())


def dropped(mask: Any, culprits: Mapping[str, int]) -> str:
    """The warning about rows that are left out, from both results of :func:`finite_rows`."""
    return f"dropped {int((~mask).sum())} of {len(mask)} splats with non-finite values: {listed(culprits)}"


def check_floats(name: str, array: NDArray[np.float32], shape: tuple[int, ...]) -> None:
    """Refuse an array of another shape or dtype, naming it in the error.

    Raises:
        ValueError: The shape differs.
        TypeError: The array is not float32; nothing is rounded silently.
    """
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")
    if array.dtype != np.float32:
        raise TypeError(f"{name} must be float32, got {array.dtype}; convert it with .astype(np.float32)")


@dataclass(frozen=True, eq=False)
class SplatArrays:
    """Six raw attributes of N splats, float32; spaces as in :meth:`nsvq_lightning.Splats.from_tensors`.

    Attributes:
        means: World positions ``[N, 3]``.
        quats: Rotations ``[N, 4]``, wxyz, any norm.
        scales: Logarithms of the axis lengths ``[N, 3]``.
        opacities: Opacity logits ``[N]``.
        sh0: Constant colour coefficients ``[N, 1, 3]``.
        shN: Higher colour coefficients ``[N, (degree + 1)² - 1, 3]``.

    Raises:
        ValueError: A shape does not fit the others.
        TypeError: An array is not float32.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh0: NDArray[np.float32]
    shN: NDArray[np.float32]

    def __post_init__(self) -> None:
        n = len(self.means)
        coefficients = self.shN.shape[1] if self.shN.ndim == 3 else -1
        expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh0": (n, 1, 3)}
        for name, shape in {**expected, "shN": (n, coefficients, 3)}.items():
            check_floats(name, getattr(self, name), shape)
        shN_degree(coefficients)

    @classmethod
    def from_splats(cls, splats: SplatTensors) -> SplatArrays:
        """Copy of anything with the six raw attributes as tensors, on any device."""
        import torch

        def array(tensor: torch.Tensor) -> NDArray[np.float32]:
            values: NDArray[np.float32] = tensor.detach().to("cpu", torch.float32, copy=True).numpy()
            return values

        return cls(
            means=array(splats.means),
            quats=array(splats.quats),
            scales=array(splats.scales),
            opacities=array(splats.opacities),
            sh0=array(splats.sh0),
            shN=array(splats.shN),
        )

    def to_splats(self) -> Splats:
        """The scene as trainable parameters on the CPU."""
        import torch

        from nsvq_lightning.splats.splats import Splats

        names = ("means", "quats", "scales", "opacities", "sh0", "shN")
        return Splats.from_tensors(*(torch.from_numpy(np.ascontiguousarray(getattr(self, name))) for name in names))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest degree of the spherical harmonics."""
        return shN_degree(self.shN.shape[1])
