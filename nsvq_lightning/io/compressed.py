"""A scene as files hold it: some of its attributes are codes, which most changes leave as they are."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.morton import spatial_order
from nsvq_lightning.io.numbers import finite_logits, finite_logs
from nsvq_lightning.rendering.sampling import MAX_CAMERAS, Sampling, fewer_cameras
from nsvq_lightning.splats import attributes as splat
from nsvq_lightning.splats import conventions
from nsvq_lightning.splats.conventions import ZERO, Arrays, Bools, Float32s, Float64s, Integers, Place, shN_degree
from nsvq_lightning.top_level import log

if TYPE_CHECKING:
    from torch.nn import Module

    from nsvq_lightning.rendering.camera import Camera
    from nsvq_lightning.rendering.rasterize import Render
    from nsvq_lightning.splats.splats import RawSplats, Splats, SplatTensors

AnySplats: TypeAlias = "CompressedScene | SplatTensors | Mapping[str, Any] | Module"

# Attributes by their names here and in nerfstudio.
NAMES = {name: name for name in splat.ATTRIBUTES} | {"features_dc": "sh0", "features_rest": "shN"}


def slices(count: int) -> "Iterator[slice]":
    """Parts of a table of so many rows, one after another: what is made of one at a time takes little memory."""
    for start in range(0, count, splat.ROWS):
        yield slice(start, start + splat.ROWS)


def warn_of_activations(logits: Arrays, scales: Arrays) -> None:
    """Warn where opacities of any shape, which should be logits, or scales ``[N, 2 or more]``, logarithms, are none.

    Of surfels, the third scale is small. Of logarithms above 0, as in millimetres, the largest are near the usual one.
    """
    axes = scales[..., :2]
    if logits.size and (0 <= logits.min() < logits.max() <= 1 or (axes.min() > 0 and axes.max() > 4 * np.median(axes))):
        log.warning("all scales above 0, or all opacities are in [0, 1]: logits are expected, and logarithms of scales")


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
        cameras: Positions, relative to ``origin``, and focal lengths in pixels of the cameras of training ``[C, 4]``,
            C ≤ :data:`nsvq_lightning.rendering.sampling.MAX_CAMERAS`; none where they are not known.

    Raises:
        ValueError: Shapes do not fit each other, a code is not a row of its codebook, or an attribute is missing or
            given twice.
        TypeError: An array is not float32 (codes: not of an integer type).
    """

    means: Float32s
    opacities: Float32s
    codes: Mapping[str, Integers] = field(default_factory=dict)
    codebooks: Mapping[str, Float32s] = field(default_factory=dict)
    raw: Mapping[str, Float32s] = field(default_factory=dict)
    sh_degree: int = 3
    config: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    origin: Place = ZERO
    stored_bytes: int | None = None
    bases: Mapping[str, Float32s] = field(default_factory=dict)
    cameras: Float64s = field(default_factory=lambda: np.zeros((0, 4)))

    def __post_init__(self) -> None:
        n = len(self.means)
        dims = splat.attribute_dims(self.sh_degree)
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
        widths = dims | {name: len(basis) for name, basis in self.bases.items()}
        for name, values in self.raw.items():
            _check_floats(f"raw[{name!r}]", values, (n, widths[name]))
        for name, basis in self.bases.items():
            _check_floats(f"bases[{name!r}]", basis, (max(1, min(len(basis), dims[name])), dims[name]))
        for name, codes in self.codes.items():
            _check_codes(name, codes, self.codebooks[name], n, dims[name])
        fits = self.cameras.shape[1:] == (4,) and len(self.cameras) <= MAX_CAMERAS
        if not (fits and np.isfinite(self.cameras).all() and (self.cameras[:, 3] > 0).all()):
            raise ValueError(f"cameras must be at most {MAX_CAMERAS} finite positions and focal lengths above 0")

    @classmethod
    def from_splats(cls, splats: AnySplats, **header: Any) -> "CompressedScene":
        """A copy of splats, on any device, without any codebook: valid, but not compressed.

        Args:
            splats: The splats, or their attributes by their names here or in nerfstudio, tensors or arrays of any
                numbers, or a checkpoint or a model of gsplat or nerfstudio with these; or a module that was trained,
                whose :meth:`~nsvq_lightning.SplatModule.compressed` it is; a compressed scene is returned as it is.
            header: ``antialiased``, ``metrics`` and ``origin``; or ``config``.

        Raises:
            ValueError: The shape of an attribute does not fit the others, or one is missing.
            TypeError: ``splats`` is nothing of these, as a path.
        """
        if isinstance(splats, CompressedScene):
            return splats
        if hasattr(splats, "compressed"):
            return splats.compressed()  # type: ignore[no-any-return, operator, union-attr]  # a module
        import torch

        from nsvq_lightning.splats.splats import RawSplats, warn_if_trained

        warn_if_trained(splats)
        tensors = splats.state_dict() if isinstance(splats, torch.nn.Module) else splats
        named: Any = tensors._asdict() if isinstance(tensors, RawSplats) else tensors
        if not isinstance(named, Mapping):
            raise TypeError(f"splats must be Splats, or tensors by name, got {type(splats)}; nl.load reads a file")
        of_trainer = named.get("splats", named.get("pipeline", named))  # gsplat, nerfstudio
        given = {name.rpartition(".")[2]: values for name, values in of_trainer.items()}
        rows = {
            NAMES[name]: values.detach().to("cpu", torch.float32, copy=True).numpy()
            if isinstance(values, torch.Tensor)
            else np.array(values, np.float32)
            for name, values in given.items()
            if name in NAMES
        }
        if missing := set(splat.ATTRIBUTES) - {"shN"} - rows.keys():
            raise ValueError(f"the splats have no {', '.join(sorted(missing))}")
        if "features_dc" in given and not rows.get("shN", rows["sh0"]).size:  # nerfstudio's of degree 0: logits
            rows["sh0"] = 0.5 * np.tanh(0.5 * rows["sh0"]) / conventions.SH_C0
        if "shN" in rows and rows["shN"].shape[2:] != (3,):
            raise ValueError(f"shN must have shape [N, (degree + 1)^2 - 1, 3], got {list(rows['shN'].shape)}")
        warn_of_activations(rows["opacities"], rows["scales"])
        return cls.from_rows(rows, **header)

    @classmethod
    def from_rows(cls, rows: Mapping[str, Arrays], antialiased: bool = False, **header: Any) -> "CompressedScene":
        """N splats without any codebook, as most formats hold them.

        Args:
            rows: Attributes ``[N, ...]`` in numbers of any kind, which become float32; without ``shN``, colours do not
                change with the view.
            antialiased: Whether :attr:`config` says that it is to be rendered with anti-aliasing.
            header: ``config``, ``metrics`` and ``origin``.

        Raises:
            ValueError: The shape of an attribute does not fit the others.
        """
        if antialiased:
            header["config"] = {"antialiased": True}
        found = {"shN": np.zeros((len(rows["means"]), 0), np.float32)}
        for name, values in rows.items():
            found[name] = np.ascontiguousarray(values, np.float32).reshape(len(values), math.prod(values.shape[1:]))
        # Opacities of exactly 0 and 1 are infinite logits, lengths of 0 logarithms of -inf.
        found["scales"] = finite_logs(found["scales"])
        return cls(
            found["means"],
            finite_logits(found["opacities"].ravel()),
            raw={name: found[name] for name in splat.QUANTIZABLE if name in found},
            sh_degree=shN_degree(found["shN"].shape[1] // 3),
            **header,
        )

    @classmethod
    def joined(cls, scenes: Sequence["CompressedScene"]) -> "CompressedScene":
        """The splats of scenes, one after another, up to their highest degree; origin and settings are the first's.

        Where all have a codebook, that is the rows of all, and the codes count on.

        Raises:
            ValueError: Only some are to be rendered with anti-aliasing.
        """
        first = scenes[0]
        if len(scenes) == 1:
            return first
        if len({scene.antialiased for scene in scenes}) > 1:
            raise ValueError("some scenes were trained with anti-aliasing and some were not; they cannot be joined")
        if len({scene.background for scene in scenes}) > 1:
            log.warning("some scenes are seen before white, some before black; the first decides what is behind all")
        if len({any(scene.origin) for scene in scenes}) > 1:
            log.warning("only some scenes say where 0 is on a map: those that do not, such as a .ply, may be misplaced")
        degree = max(scene.sh_degree for scene in scenes)
        scenes = [scene.with_degree(degree) for scene in scenes]
        codes, codebooks, raw = {}, {}, {}
        for name in splat.QUANTIZABLE:
            if all(name in scene.codes for scene in scenes):
                books = [scene.codebooks[name] for scene in scenes]
                starts = np.cumsum([0, *map(len, books[:-1])])
                codes[name] = np.concatenate([scene.codes[name] + i for scene, i in zip(scenes, starts, strict=True)])
                codebooks[name] = np.concatenate(books)
            else:
                raw[name] = np.concatenate([scene.rows(name) for scene in scenes])
        # Steps of one are too coarse for another.
        same = len({str(scene.config.get("precision")) for scene in scenes}) == 1
        scenes = [scene.relative_to(first.origin) for scene in scenes]
        cameras = [scene.cameras for scene in scenes]
        if not all(map(len, cameras)):
            if any(map(len, cameras)):
                log.warning("of some scenes the cameras of their training are known, of some not: none are kept")
            cameras = [np.zeros((0, 4))]
        return cls(
            np.concatenate([scene.means for scene in scenes]),
            np.concatenate([scene.opacities for scene in scenes]),
            codes,
            codebooks,
            raw,
            sh_degree=degree,
            config=first.config if same else {**first.config, "precision": {}},
            origin=first.origin,
            cameras=fewer_cameras(np.concatenate(cameras)),
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def antialiased(self) -> bool:
        """Whether it is to be rendered with anti-aliasing, as it was trained (``antialiased`` of :attr:`config`)."""
        return self.config.get("antialiased") is True

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB of what it is shown in front of, as it was trained: white where :attr:`config` says so, else black."""
        return (1.0, 1.0, 1.0) if self.config.get("background") == "white" else (0.0, 0.0, 0.0)

    def sampling(self) -> Sampling | None:
        """How the cameras of training saw the decoded splats; None where they are not known, or with anti-aliasing."""
        import torch

        if self.antialiased or len(self.cameras) == 0:
            return None
        return Sampling.of(torch.from_numpy(self.means), self.cameras)

    def rows(self, name: str) -> Float32s:
        """An attribute ``[N, D]``, bit for bit the rows of its codebook if it has one; positions without ``origin``."""
        if name in self.codes:
            rows = self.codebooks[name][self.codes[name]]
        else:
            rows = self.raw[name] if name in self.raw else getattr(self, name)
        if name in self.bases:  # exact in float64 for whole numbers, so rounded once
            rows = (rows @ self.bases[name].astype(np.float64)).astype(np.float32)
        return rows.reshape(len(rows), splat.attribute_dims(self.sh_degree)[name])

    def values(self, name: str) -> Float32s:
        """An attribute of all splats in the shape that :class:`nsvq_lightning.Splats` have it, see :meth:`rows`."""
        return self.rows(name).reshape(len(self), *splat.attribute_shapes(self.sh_degree)[name])

    def decode(self) -> "Splats":
        """The decoded scene as :class:`nsvq_lightning.Splats`.

        Positions stay relative to ``origin``: adding a large origin in float32 would lose the detail that
        subtracting it preserved.
        """
        from nsvq_lightning.splats.splats import Splats

        return Splats.from_tensors(*self.tensors())

    def tensors(self) -> "RawSplats":
        """As :meth:`decode`, but without a copy of what is raw: not to be changed."""
        import torch

        from nsvq_lightning.splats.splats import RawSplats

        return RawSplats(*(torch.from_numpy(np.ascontiguousarray(self.values(name))) for name in splat.ATTRIBUTES))

    def take(self, splats: Integers | Bools | slice) -> "CompressedScene":
        """The scene of some of the splats, by index, mask ``[N]`` or slice; codebooks stay as they are."""
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
        codes, codebooks = {}, {}
        for name, rows in self.codes.items():
            used, codes[name] = np.unique_inverse(rows)
            codebooks[name] = self.codebooks[name][used if len(used) else [0]]
        return replace(self, codes=codes, codebooks=codebooks)

    def in_morton_order(self) -> "CompressedScene":
        """The splats in Morton order of their positions, in which many formats hold them: what is near follows."""
        return self.in_order(spatial_order(self.means))

    def in_order(self, order: Integers) -> "CompressedScene":
        """All splats in an order ``[N]``; itself, and no copy, if they are in it."""
        return self if np.array_equal(order, np.arange(len(self))) else self.take(order)

    def parts(self) -> "Iterator[CompressedScene]":
        """The scene in parts of splats that follow each other (:func:`slices`), at least one."""
        return map(self.take, slices(max(1, len(self))))

    def finite_rows(self) -> tuple[Bools, dict[str, int]]:
        """Which splats ``[N]`` have neither NaN nor infinite values, and how many do, by attribute."""
        found: dict[str, Any] = {"means": self.means, "opacities": self.opacities, **self.raw}
        for name, codes in self.codes.items():
            found[name] = np.where(np.isfinite(self.codebooks[name]).all(1), 0, np.nan)[codes]
        return splat.finite_rows(found)

    def relative_to(self, origin: Place) -> "CompressedScene":
        """The same scene with another origin of its positions."""
        if self.origin == origin:
            return self
        means = self.means + self.origin - origin
        cameras = self.cameras + np.append(np.subtract(self.origin, origin), 0)
        return replace(self, means=means.astype(np.float32), origin=origin, cameras=cameras)

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

    def changed(self, changes: Mapping[str, Callable[[Float32s], Arrays]], **fields: Any) -> "CompressedScene":
        """The scene with other values of attributes, by the rows of their codebooks or bases where they have those.

        Args:
            changes: By attribute, what makes rows ``[.., D]`` others, each by itself; they are rounded to float32.
            fields: Fields of the scene that change, too.
        """
        tables: dict[str, Any] = {kind: dict(getattr(self, kind)) for kind in ("codebooks", "bases", "raw")}
        for name, change in changes.items():
            table = next(each for each in tables.values() if name in each)
            rows = table[name]
            table[name] = np.empty((len(rows), change(rows[:1]).shape[1]), np.float32)
            for part in slices(len(rows)):
                table[name][part] = change(rows[part])
        return replace(self, **tables, stored_bytes=None, **fields)

    def with_degree(self, degree: int) -> "CompressedScene":
        """The scene with spherical harmonics up to a degree, 0 to 3: higher ones are left out, missing ones are 0."""
        if degree == self.sh_degree:
            return self
        width = splat.attribute_dims(degree)["shN"]
        scene = self
        if degree == 0 or "shN" in self.bases:  # no codebook at degree 0, nor a basis of another width
            codes = {name: codes for name, codes in self.codes.items() if name != "shN"}
            codebooks = {name: self.codebooks[name] for name in codes}
            scene = replace(self, codes=codes, codebooks=codebooks, raw={**self.raw, "shN": self.rows("shN")}, bases={})
        fitted = {"shN": lambda rows: np.pad(rows[:, :width], ((0, 0), (0, max(0, width - rows.shape[1]))))}
        return scene.changed(fitted, sh_degree=degree)


def on_white(scene: CompressedScene) -> CompressedScene:
    """The same scene, to be shown in front of white."""
    return replace(scene, config={**scene.config, "background": "white"})


def renderer(scene: CompressedScene, **options: Any) -> "Callable[[SplatTensors, Camera], Render]":
    """:func:`nsvq_lightning.render` with the anti-aliasing and the background of a scene, and with these options."""
    from nsvq_lightning.rendering.rasterize import render

    return partial(render, **{"background": scene.background, "antialiased": scene.antialiased, **options})


def _check_floats(name: str, array: Float32s, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")
    if array.dtype != np.float32:  # nothing is rounded silently
        raise TypeError(f"{name} must be float32, got {array.dtype}")


def _check_codes(name: str, codes: Integers, codebook: Float32s, n: int, dim: int) -> None:
    if dim == 0:
        raise ValueError(f"{name} has no coefficients at SH degree 0, so no codebook; give it in raw, shape [{n}, 0]")
    rows = len(codebook)
    _check_floats(f"codebooks[{name!r}]", codebook, (rows, dim))
    if codes.shape != (n,):
        raise ValueError(f"codes[{name!r}] must have shape [{n}], got {list(codes.shape)}")
    if not np.isdtype(codes.dtype, "integral"):
        raise TypeError(f"codes[{name!r}] must be integers, got {codes.dtype}")
    if rows == 0:
        raise ValueError(f"codebooks[{name!r}] is empty; a codebook needs at least one row")
    if n and not (codes.min() >= 0 and codes.max() < rows):
        raise ValueError(f"codes[{name!r}] must be in 0..{rows - 1}, got {codes.min()}..{codes.max()}")
