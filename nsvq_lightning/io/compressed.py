"""A scene as files hold it, some of whose attributes are codes; it is turned and cropped without decoding these."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.splats import attributes as splat
from nsvq_lightning.splats.conventions import Bools, Float32s, Float64s, shN_degree, turned

if TYPE_CHECKING:
    from nsvq_lightning.rendering.frame import Frame
    from nsvq_lightning.splats.splats import Splats, SplatTensors

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CompressedScene:
    """N splats, some of whose attributes are codes into codebooks.

    Every attribute that may have a codebook is either in ``codes`` and ``codebooks`` or in ``raw``; spaces are those of
    :meth:`nsvq_lightning.Splats.from_tensors` (log-scales, quaternions wxyz, SH coefficients). What ``raw`` holds of an
    attribute in ``bases`` are whole numbers, its coefficients: its values are their product with the basis.

    Attributes:
        means: Positions ``[N, 3]`` float32, relative to ``origin``.
        opacities: Opacity logits ``[N]`` float32.
        codes: Codebook row of each splat, ``[N]`` of any integer type, by attribute.
        codebooks: Codebooks ``[K, D]`` float32 by attribute; ``shN`` as row-major ``[coefficients, 3]``.
        raw: Attributes without a codebook, ``[N, D]`` float32, or ``[N, C]`` coefficients.
        sh_degree: Degree of the spherical harmonics, 0 to 3.
        config: Settings of the run; JSON values only, keys are strings.
        metrics: Quality measured on the decoded scene; non-finite values are stored as None.
        origin: World coordinates of the point that is 0 in ``means``, float64.
        stored_bytes: Bytes of the file the scene was read from, None if it was not.
        bases: Bases ``[C, D]`` float32 by attribute, C from 1 to D; only ``shN`` may have one.

    Raises:
        ValueError: Shapes do not fit each other, a code is not a row of its codebook, or an attribute is missing or
            given twice.
        TypeError: An array is not float32 (codes: not of an integer type).
    """

    means: Float32s
    opacities: Float32s
    codes: Mapping[str, NDArray[np.integer]] = field(default_factory=dict)
    codebooks: Mapping[str, Float32s] = field(default_factory=dict)
    raw: Mapping[str, Float32s] = field(default_factory=dict)
    sh_degree: int = 3
    config: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stored_bytes: int | None = None
    bases: Mapping[str, Float32s] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, dims = len(self.means), splat.attribute_dims(self.sh_degree)
        _check_floats("means", self.means, (n, 3))
        _check_floats("opacities", self.opacities, (n,))
        if len(self.origin) != 3 or not np.isfinite(self.origin).all():
            raise ValueError(f"origin must be three finite numbers, got {self.origin}")
        if self.codes.keys() != self.codebooks.keys():
            raise ValueError(f"codes of {sorted(self.codes)} but codebooks of {sorted(self.codebooks)}")
        if sorted([*self.codes, *self.raw]) != sorted(splat.QUANTIZABLE):
            raise ValueError(
                f"each of {', '.join(splat.QUANTIZABLE)} must be either in codes and codebooks or in raw; "
                f"got codes of {sorted(self.codes)} and raw {sorted(self.raw)}"
            )
        if not set(self.bases) <= {"shN"} & set(self.raw):
            raise ValueError(f"only shN may have a basis, and then no codebook; got bases of {sorted(self.bases)}")
        for name, values in self.raw.items():
            _check_floats(f"raw[{name!r}]", values, (n, len(self.bases[name]) if name in self.bases else dims[name]))
        for name, basis in self.bases.items():
            _check_floats(f"bases[{name!r}]", basis, (max(1, min(len(basis), dims[name])), dims[name]))
        for name, codes in self.codes.items():
            _check_codes(name, codes, self.codebooks[name], n, dims[name])

    @classmethod
    def from_splats(cls, splats: "SplatTensors", **header: Any) -> "CompressedScene":
        """A copy of splats, on any device, without any codebook: valid, but not compressed.

        Args:
            splats: The splats.
            header: ``config``, ``metrics`` and ``origin``.

        Raises:
            ValueError: The shape of an attribute does not fit the others.
        """
        from nsvq_lightning.splats.splats import check_shapes

        tensors = {name: getattr(splats, name).detach() for name in splat.ATTRIBUTES}
        check_shapes(tensors)
        rows = {name: tensor.cpu().numpy().astype(np.float32) for name, tensor in tensors.items()}
        dims = splat.attribute_dims(shN_degree(rows["shN"].shape[1]))
        return cls(
            rows["means"],
            rows["opacities"],
            raw={name: rows[name].reshape(len(rows[name]), dims[name]) for name in splat.QUANTIZABLE},
            sh_degree=shN_degree(rows["shN"].shape[1]),
            **header,
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def antialiased(self) -> bool:
        """Whether it is to be rendered with anti-aliasing, as it was trained (``antialiased`` of :attr:`config`)."""
        return self.config.get("antialiased") is True

    def values(self, name: str, rows: slice = slice(None)) -> Float32s:
        """An attribute ``[N, ...]`` of all splats or some, bit for bit the rows of its codebook if it has one.

        Args:
            name: Attribute; positions are relative to ``origin``.
            rows: Which splats.
        """
        values: Float32s
        if name in self.codes:
            values = self.codebooks[name][self.codes[name][rows]]
        else:
            values = (self.raw[name] if name in self.raw else getattr(self, name))[rows]
        if name in self.bases:  # exact in float64 for whole numbers, so rounded once
            values = (values.astype(np.float64) @ self.bases[name].astype(np.float64)).astype(np.float32)
        return values.reshape(len(values), *splat.attribute_shapes(self.sh_degree)[name])

    def decode(self) -> "Splats":
        """The decoded scene as :class:`nsvq_lightning.Splats`.

        Positions stay relative to ``origin``: adding a large origin in float32 would lose the detail that
        subtracting it preserved.
        """
        import torch

        from nsvq_lightning.splats.splats import Splats

        return Splats.from_tensors(
            *(torch.from_numpy(np.ascontiguousarray(self.values(name))) for name in splat.ATTRIBUTES)
        )

    def take(self, splats: NDArray[np.integer] | Bools) -> "CompressedScene":
        """The scene of some of the splats, by index or by mask ``[N]``; codebooks stay as they are."""
        return replace(
            self,
            means=self.means[splats],
            opacities=self.opacities[splats],
            codes={name: codes[splats] for name, codes in self.codes.items()},
            raw={name: values[splats] for name, values in self.raw.items()},
            stored_bytes=None,
        )

    def in_use(self) -> "CompressedScene":
        """The same splats, with codebooks of only the rows that they use; without splats, of the first one."""
        rows = {name: np.unique(codes, return_inverse=True) for name, codes in self.codes.items()}
        return replace(
            self,
            codes={name: codes for name, (_, codes) in rows.items()},
            codebooks={name: self.codebooks[name][used if len(used) else [0]] for name, (used, _) in rows.items()},
        )

    def finite_rows(self) -> tuple[Bools, dict[str, int]]:
        """Which splats ``[N]`` have neither NaN nor infinite values, and how many do, by attribute."""
        bad = {name: np.where(np.isfinite(rows).all(1), 0, np.nan) for name, rows in self.codebooks.items()}
        flags = {name: flags.astype(np.float32)[self.codes[name]] for name, flags in bad.items()}
        return splat.finite_rows({"means": self.means, "opacities": self.opacities, **self.raw, **flags})

    def relative_to(self, origin: tuple[float, float, float]) -> "CompressedScene":
        """The same scene with another origin of its positions."""
        if self.origin == origin:
            return self
        means = self.means.astype(np.float64) + self.origin - origin
        return replace(self, means=means.astype(np.float32), origin=origin)

    def finite(self) -> "CompressedScene":
        """The splats without NaN or infinite values; a warning counts the others by attribute.

        Raises:
            FormatError: There are none.
        """
        keep, culprits = self.finite_rows()
        if not keep.any():
            reasons = f" ({splat.listed(culprits)} are not)" if culprits else ""
            raise FormatError(f"no finite splat among {len(self)}{reasons}", "give a scene with splats")
        if not culprits:
            return self
        log.warning(splat.dropped(keep, culprits))
        return self.take(keep)


def _check_floats(name: str, array: Float32s, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")
    if array.dtype != np.float32:  # nothing is rounded silently
        raise TypeError(f"{name} must be float32, got {array.dtype}; convert it with .astype(np.float32)")


def _check_codes(name: str, codes: NDArray[np.integer], codebook: Float32s, n: int, dim: int) -> None:
    if dim == 0:
        raise ValueError(
            f"{name} has no coefficients at SH degree 0, so no codebook; give it in raw with shape [{n}, 0]"
        )
    rows = len(codebook)
    _check_floats(f"codebooks[{name!r}]", codebook, (rows, dim))
    if codes.shape != (n,):
        raise ValueError(f"codes[{name!r}] must have shape [{n}], got {list(codes.shape)}")
    if not np.issubdtype(codes.dtype, np.integer):
        raise TypeError(f"codes[{name!r}] must be integers, got {codes.dtype}")
    if rows == 0:
        raise ValueError(f"codebooks[{name!r}] is empty; a codebook needs at least one row")
    if n and not (int(codes.min()) >= 0 and int(codes.max()) < rows):
        raise ValueError(f"codes[{name!r}] must be in 0..{rows - 1}, got {codes.min()}..{codes.max()}")


def in_morton_order(scene: CompressedScene) -> CompressedScene:
    """The splats in Morton order of their positions, in which many formats hold them: what is near follows."""
    from nsvq_lightning.io.morton import spatial_order  # imports Numba, which readers do without

    return scene.take(spatial_order(scene.means))


# Rotations that turn COLMAP's up, -y, to an axis; x stays.
UP_AXES = {
    "y": np.diag([1.0, -1.0, -1.0]),
    "minus-y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "minus-z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


def turn_up(up: Float64s, axis: str) -> Float64s:
    """The rotation ``[3, 3]`` that turns a direction to an axis: the shortest way to -y, then around x.

    Args:
        up: Direction ``[3]`` of length 1.
        axis: One of :data:`UP_AXES`.
    """
    goal = np.array([0.0, -1.0, 0.0])
    # Two reflections: one that swaps opposite directions needs another mirror than the one between them.
    between = up + goal
    if between @ between < 1e-12:
        return np.asarray(UP_AXES[axis] @ UP_AXES["y"])
    first, second = (np.eye(3) - 2 * np.outer(v, v) / (v @ v) for v in (goal, between))
    return np.asarray(UP_AXES[axis] @ first @ second)


# Half around z: right, down, front becomes left, up, front, the axes of glTF and USD.
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def rotated(scene: CompressedScene, rotation: Float64s) -> CompressedScene:
    """The scene turned about the world's origin by a rotation ``[3, 3]``, see :func:`moved`."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return moved(scene, matrix)


def moved(scene: CompressedScene, matrix: Float64s) -> CompressedScene:
    """The scene turned, scaled and moved.

    Positions, scales, rotations and spherical harmonics change, the last three by the rows of their codebooks; numbers
    are rounded once, to float32.

    Args:
        scene: The scene.
        matrix: From old to new world coordinates ``[4, 4]``: a rotation times a positive number, and a translation.

    Raises:
        ValueError: It stretches, mirrors or is not finite.
    """
    import torch

    from nsvq_lightning.rendering.sh import sh_rotation

    linear, shift = matrix[:3, :3], matrix[:3, 3]
    size = float(np.cbrt(np.linalg.det(linear)))
    if not (
        np.isfinite(matrix).all()
        and size > 0
        and np.allclose(linear @ linear.T, size**2 * np.eye(3), 0, 1e-5 * size**2)
    ):
        raise ValueError(
            f"{linear.tolist()} is no rotation times a number: splats can be turned and scaled evenly only"
        )
    rotation = linear / size
    harmonics = sh_rotation(torch.from_numpy(rotation), scene.sh_degree).numpy()

    def rows(tables: Mapping[str, Float32s]) -> dict[str, Float32s]:
        found = dict(tables)
        if "scales" in found and size != 1:
            found["scales"] = (found["scales"] + np.log(size)).astype(np.float32)
        if "quats" in found:
            found["quats"] = turned(found["quats"], rotation)
        if "shN" in found:
            wide = found["shN"].reshape(len(found["shN"]), len(harmonics), 3).astype(np.float64)
            found["shN"] = (harmonics @ wide).reshape(found["shN"].shape).astype(np.float32)
        return found

    has_origin = any(scene.origin)
    means = scene.means.astype(np.float64) @ linear.T + (0 if has_origin else shift)
    x, y, z = (linear @ np.array(scene.origin) + (shift if has_origin else 0)).tolist()
    return replace(
        scene,
        means=means.astype(np.float32),
        codebooks=rows(scene.codebooks),
        raw={**scene.raw, **rows({name: values for name, values in scene.raw.items() if name not in scene.bases})},
        bases=rows(scene.bases),
        origin=(x, y, z),
        stored_bytes=None,
    )


def placed(scene: CompressedScene, frame: "Frame") -> CompressedScene:
    """The scene in the coordinates of its files, from those of the frame that it was trained in."""

    def rows(tables: Mapping[str, Float32s]) -> dict[str, Float32s]:
        longer = np.log(frame.unit)
        return {name: (rows + longer).astype(np.float32) if name == "scales" else rows for name, rows in tables.items()}

    means = (frame.unit * scene.means.astype(np.float64) + frame.middle).astype(np.float32)
    raw, codebooks = rows(scene.raw), rows(scene.codebooks)
    return replace(scene, means=means, raw=raw, codebooks=codebooks, origin=frame.origin, stored_bytes=None)


def with_degree(scene: CompressedScene, degree: int) -> CompressedScene:
    """The scene with spherical harmonics up to a degree, 0 to 3: higher ones are left out, missing ones are 0."""
    if degree == scene.sh_degree:
        return scene
    dims = splat.attribute_dims(scene.sh_degree)["shN"], splat.attribute_dims(degree)["shN"]

    def rows(tables: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        found = dict(tables)
        if "shN" in found:
            found["shN"] = np.pad(found["shN"][:, : dims[1]], ((0, 0), (0, max(0, dims[1] - dims[0]))))
        return found

    if degree == 0 or "shN" in scene.bases:  # no codebook at degree 0, nor a basis of another width
        values = scene.values("shN").reshape(len(scene), dims[0])
        codes = {name: codes for name, codes in scene.codes.items() if name != "shN"}
        codebooks = {name: scene.codebooks[name] for name in codes}
        raw = rows({**scene.raw, "shN": values})
        return replace(scene, codes=codes, codebooks=codebooks, raw=raw, bases={}, sh_degree=degree)
    return replace(scene, codebooks=rows(scene.codebooks), raw=rows(scene.raw), sh_degree=degree)


def joined(scenes: Sequence[CompressedScene]) -> CompressedScene:
    """The splats of scenes, one after another, up to their highest degree; origin and settings are those of the first.

    Where all have a codebook, that is the rows of all, and the codes count on.

    Raises:
        ValueError: Only some are to be rendered with anti-aliasing.
    """
    first = scenes[0]
    if len(scenes) == 1:
        return first
    if len({scene.antialiased for scene in scenes}) > 1:
        raise ValueError("some of the scenes were trained with anti-aliasing and some were not; they cannot be joined")
    degree = max(scene.sh_degree for scene in scenes)
    scenes = [with_degree(scene, degree) for scene in scenes]
    shared = [name for name in splat.QUANTIZABLE if all(name in scene.codes for scene in scenes)]
    starts = {name: np.cumsum([0, *(len(scene.codebooks[name]) for scene in scenes)]) for name in shared}
    means = [scene.means + (np.array(scene.origin) - np.array(first.origin)) for scene in scenes]
    dims = splat.attribute_dims(degree)
    return CompressedScene(
        np.concatenate(means).astype(np.float32),
        np.concatenate([scene.opacities for scene in scenes]),
        codes={
            name: np.concatenate(
                [scene.codes[name] + start for scene, start in zip(scenes, starts[name], strict=False)]
            )
            for name in shared
        },
        codebooks={name: np.concatenate([scene.codebooks[name] for scene in scenes]) for name in shared},
        raw={
            name: np.concatenate([scene.values(name).reshape(len(scene), dims[name]) for scene in scenes])
            for name in splat.QUANTIZABLE
            if name not in shared
        },
        sh_degree=degree,
        config=first.config,
        origin=first.origin,
    )


def cropped(scene: CompressedScene, low: Float64s, high: Float64s) -> CompressedScene:
    """The splats whose centres are in a box, its sides included; codebooks stay as they are.

    Args:
        scene: The scene.
        low: Smallest world coordinates ``[3]``.
        high: Largest ``[3]``.
    """
    positions = scene.means.astype(np.float64) + np.array(scene.origin)
    return scene.take(((positions >= low) & (positions <= high)).all(1))
