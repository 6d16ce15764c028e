"""A vector-quantized scene: what a ``.nsvq`` file holds."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.ply import plain_ply_bytes
from nsvq_lightning.splats.arrays import SplatArrays, check_floats, dropped, finite_rows
from nsvq_lightning.splats.conventions import sh_coefficients

if TYPE_CHECKING:
    from nsvq_lightning.splats.splats import Splats

log = logging.getLogger(__name__)

_T = TypeVar("_T", bound=np.generic)

__all__ = ["QUANTIZABLE", "CompressedScene", "attribute_dims"]

QUANTIZABLE = ("quats", "scales", "sh0", "shN")
"""Attributes that may be stored as codes, in file order; positions and opacities never are (paper, section 3)."""


def attribute_dims(sh_degree: int) -> dict[str, int]:
    """Values per splat, D, of each attribute in :data:`QUANTIZABLE`; ``shN`` is the flattened ``[coefficients, 3]``."""
    return {"quats": 4, "scales": 3, "sh0": 3, "shN": 3 * sh_coefficients(sh_degree)}


@dataclass(frozen=True, eq=False)
class CompressedScene:
    """N splats, some of whose attributes are codes into codebooks.

    Every attribute of :data:`QUANTIZABLE` is either in ``codes`` and ``codebooks`` or in ``raw``; spaces are those of
    :meth:`nsvq_lightning.Splats.from_tensors` (log-scales, quaternions wxyz, SH coefficients).

    Attributes:
        means: Positions ``[N, 3]`` float32, relative to ``origin``.
        opacities: Opacity logits ``[N]`` float32.
        codes: Codebook row of each splat, ``[N]`` of any integer type, by attribute.
        codebooks: Codebooks ``[K, D]`` float32 by attribute; ``shN`` as row-major ``[coefficients, 3]``.
        raw: Attributes that are not quantized, ``[N, D]`` float32.
        sh_degree: Degree of the spherical harmonics, 0 to 3.
        config: Settings of the run; JSON values only, keys are strings.
        metrics: Quality measured on the decoded scene; non-finite values are stored as None.
        origin: World coordinates of the point that is 0 in ``means``, float64.
        stored_bytes: Bytes of the file the scene was read from, None if it was not.

    Raises:
        ValueError: Shapes do not fit each other, a code is not a row of its codebook, or an attribute is missing or
            given twice.
        TypeError: An array is not float32 (codes: not of an integer type).
    """

    means: NDArray[np.float32]
    opacities: NDArray[np.float32]
    codes: Mapping[str, NDArray[np.integer]] = field(default_factory=dict)
    codebooks: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    raw: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    sh_degree: int = 3
    config: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stored_bytes: int | None = None

    def __post_init__(self) -> None:
        n, dims = len(self.means), attribute_dims(self.sh_degree)
        check_floats("means", self.means, (n, 3))
        check_floats("opacities", self.opacities, (n,))
        if len(self.origin) != 3 or not np.isfinite(self.origin).all():
            raise ValueError(f"origin must be three finite numbers, got {self.origin}")
        if self.codes.keys() != self.codebooks.keys():
            raise ValueError(f"codes of {sorted(self.codes)} but codebooks of {sorted(self.codebooks)}")
        if sorted([*self.codes, *self.raw]) != sorted(QUANTIZABLE):
            raise ValueError(
                f"each of {', '.join(QUANTIZABLE)} must be either in codes and codebooks or in raw; "
                f"got codes of {sorted(self.codes)} and raw {sorted(self.raw)}"
            )
        for name, values in self.raw.items():
            check_floats(f"raw[{name!r}]", values, (n, dims[name]))
        for name, codes in self.codes.items():
            _check_codes(name, codes, self.codebooks[name], n, dims[name])

    @classmethod
    def from_arrays(cls, arrays: SplatArrays, **header: Any) -> CompressedScene:
        """A scene without any codebook: valid, but not compressed.

        Args:
            arrays: The scene.
            header: ``config``, ``metrics`` and ``origin``.
        """
        dims = attribute_dims(arrays.sh_degree)
        # Not -1, which NumPy cannot infer where an axis is empty.
        raw = {name: getattr(arrays, name).reshape(len(arrays), dims[name]) for name in QUANTIZABLE}
        return cls(arrays.means, arrays.opacities, raw=raw, sh_degree=arrays.sh_degree, **header)

    def __len__(self) -> int:
        return len(self.means)

    def table(self, name: str) -> tuple[NDArray[np.float32], NDArray[np.integer] | None]:
        """Distinct rows ``[K, D]`` of an attribute and the row of each splat ``[N]``; None where row i is splat i's."""
        return (self.raw[name], None) if name in self.raw else (self.codebooks[name], self.codes[name])

    def uses(self, name: str) -> NDArray[np.int64] | None:
        """How many splats use each row of :meth:`table` ``[K]``; None where each splat has its own."""
        if name in self.raw:
            return None
        return np.bincount(self.codes[name], minlength=len(self.codebooks[name])).astype(np.int64)

    def spread(
        self, name: str, function: Callable[[NDArray[np.float32], NDArray[np.int64] | None], NDArray[_T]]
    ) -> NDArray[_T]:
        """A function of the rows of an attribute, for each splat: computed once per row of the codebook.

        Args:
            name: Attribute.
            function: Maps the rows ``[K, D]`` and how many splats use each ``[K]`` (None: one each) to ``[K, ...]``.

        Returns:
            ``[N, ...]``.
        """
        values = function(self.table(name)[0], self.uses(name))
        return values if name in self.raw else values[self.codes[name]]

    def take(self, splats: NDArray[np.integer] | NDArray[np.bool_]) -> CompressedScene:
        """The scene of some of the splats, by index or by mask ``[N]``; codebooks stay as they are."""
        return replace(
            self,
            means=self.means[splats],
            opacities=self.opacities[splats],
            codes={name: codes[splats] for name, codes in self.codes.items()},
            raw={name: values[splats] for name, values in self.raw.items()},
            stored_bytes=None,
        )

    def in_use(self) -> CompressedScene:
        """The same splats, with codebooks of only the rows that they use; without splats, of the first one."""
        rows = {name: np.unique(codes, return_inverse=True) for name, codes in self.codes.items()}
        return replace(
            self,
            codes={name: codes for name, (_, codes) in rows.items()},
            codebooks={name: self.codebooks[name][used if len(used) else [0]] for name, (used, _) in rows.items()},
        )

    def finite(self) -> CompressedScene:
        """The splats without NaN or infinite values; a warning counts the others by attribute."""
        bad = {name: np.where(np.isfinite(rows).all(1), 0, np.nan) for name, rows in self.codebooks.items()}
        flags = {name: flags.astype(np.float32)[self.codes[name]] for name, flags in bad.items()}
        keep, culprits = finite_rows({"means": self.means, "opacities": self.opacities, **self.raw, **flags})
        if not culprits:
            return self
        log.warning(dropped(keep, culprits))
        return self.take(keep)

    def arrays(self) -> SplatArrays:
        """The decoded scene, bit for bit the rows of the codebooks; positions stay relative to ``origin``."""
        rows = {name: self.raw[name] if name in self.raw else self._look_up(name) for name in QUANTIZABLE}
        return SplatArrays(
            means=self.means,
            quats=rows["quats"],
            scales=rows["scales"],
            opacities=self.opacities,
            sh0=rows["sh0"].reshape(len(self), 1, 3),
            shN=rows["shN"].reshape(len(self), sh_coefficients(self.sh_degree), 3),
        )

    def decode(self) -> Splats:
        """The decoded scene as :class:`nsvq_lightning.Splats`.

        Positions stay relative to ``origin``: adding a large origin in float32 would lose the detail that
        subtracting it preserved.
        """
        return self.arrays().to_splats()

    @property
    def antialiased(self) -> bool:
        """Whether it is to be rendered with anti-aliasing, as it was trained (``antialiased`` of :attr:`config`)."""
        return self.config.get("antialiased") is True

    @property
    def plain_bytes(self) -> int:
        """Bytes of the plain ``.ply`` of the same scene."""
        return plain_ply_bytes(len(self), self.sh_degree)

    def _look_up(self, name: str) -> NDArray[np.float32]:
        rows: NDArray[np.float32] = self.codebooks[name][self.codes[name]]
        return rows


def _check_codes(name: str, codes: NDArray[np.integer], codebook: NDArray[np.float32], n: int, dim: int) -> None:
    if dim == 0:
        raise ValueError(
            f"{name} has no coefficients at SH degree 0, so no codebook; give it in raw with shape [{n}, 0]"
        )
    rows = len(codebook)
    check_floats(f"codebooks[{name!r}]", codebook, (rows, dim))
    if codes.shape != (n,):
        raise ValueError(f"codes[{name!r}] must have shape [{n}], got {list(codes.shape)}")
    if not np.issubdtype(codes.dtype, np.integer):
        raise TypeError(f"codes[{name!r}] must be integers, got {codes.dtype}")
    if rows == 0:
        raise ValueError(f"codebooks[{name!r}] is empty; a codebook needs at least one row")
    if n and not (int(codes.min()) >= 0 and int(codes.max()) < rows):
        raise ValueError(f"codes[{name!r}] must be in 0..{rows - 1}, got {codes.min()}..{codes.max()}")
