"""The scene: six raw attributes of N Gaussian splats, and the canonical form of their covariances."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nsvq_lightning.splats.attributes import ATTRIBUTES, attribute_shapes
from nsvq_lightning.splats.conventions import MIN_SQUARED_NORM, SH_C0, sh_coefficients, shN_degree
from nsvq_lightning.top_level import log

# What attributes of N splats are, for :func:`nsvq_lightning.compute.memory.check_fit`.
FORM = "means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh0 [N, 1, 3], shN [N, C, 3]"


class RawSplats(NamedTuple):
    """The six raw attributes of N splats as plain tensors.

    Attributes:
        means: World positions ``[N, 3]``.
        quats: Rotations ``[N, 4]``, wxyz, any norm.
        scales: Logarithms of the axis lengths ``[N, 3]``, scene units.
        opacities: Opacity logits ``[N]``.
        sh0: Constant colour coefficients ``[N, 1, 3]``.
        shN: Higher colour coefficients ``[N, (degree + 1)² - 1, 3]``.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    shN: Tensor

    def take(self, rows: Tensor) -> "RawSplats":
        """Some of the splats, by index or mask."""
        return RawSplats(*(tensor[rows] for tensor in self))


def sh_degree_of(shN: Tensor) -> int:
    """Degree of the spherical harmonics whose higher coefficients are ``shN [N, (degree + 1)² - 1, 3]``.

    Raises:
        ValueError: No degree from 0 to 3 has that many coefficients.
    """
    return shN_degree(shN.shape[1])


def check_shapes(tensors: Mapping[str, Tensor]) -> None:
    """Refuse attributes whose shapes do not fit each other.

    Raises:
        ValueError: One does not fit.
    """
    shN = tensors["shN"]
    if shN.dim() != 3 or shN.shape[2] != 3:
        raise ValueError(f"shN must have shape [N, (degree + 1)^2 - 1, 3], got {list(shN.shape)}")
    for name, shape in attribute_shapes(sh_degree_of(shN)).items():
        expected = [len(tensors["means"]), *shape]
        if list(tensors[name].shape) != expected:
            raise ValueError(f"{name} must have shape {expected}, got {list(tensors[name].shape)}")


class Splats(nn.Module):
    """N Gaussian splats as six trainable raw attributes (3D Gaussian Splatting, Kerbl et al. 2023).

    Side tables (:meth:`add_table`) hold one row per splat, for example the statistics of density control; they are
    buffers, so checkpoints carry them, and :mod:`nsvq_lightning.training.row_ops` keeps their rows together with the
    attributes.

    Attributes:
        edits: How often rows were added or removed. Data for the rows at one count does not fit the rows at another,
            even if their number is the same.

    Args:
        sh_degree: Highest degree of the spherical harmonics, 0 to 3.

    Raises:
        ValueError: ``sh_degree`` is out of range.
    """

    means: nn.Parameter
    quats: nn.Parameter
    scales: nn.Parameter
    opacities: nn.Parameter
    sh0: nn.Parameter
    shN: nn.Parameter

    def __init__(self, sh_degree: int = 3) -> None:
        super().__init__()
        for name, shape in attribute_shapes(sh_degree).items():
            self.register_parameter(name, nn.Parameter(torch.zeros(0, *shape)))
        self.edits = 0

    @classmethod
    def from_tensors(
        cls, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh0: Tensor, shN: Tensor
    ) -> "Splats":
        """Splats from raw attributes, which may also be NumPy arrays.

        Args:
            means: World positions ``[N, 3]``.
            quats: Rotations ``[N, 4]``, wxyz, any norm.
            scales: Logarithms of the axis lengths ``[N, 3]``, log of scene units.
            opacities: Opacity logits ``[N]``.
            sh0: Constant colour coefficients ``[N, 1, 3]``; colour = 0.5 + 0.2821 · sh0.
            shN: Higher colour coefficients ``[N, (degree + 1)² - 1, 3]``.

        Raises:
            ValueError: A shape does not fit the others.
        """
        tensors = RawSplats(*map(torch.as_tensor, (means, quats, scales, opacities, sh0, shN)))._asdict()
        check_shapes(tensors)
        splats = cls(sh_degree_of(tensors["shN"]))
        for name, tensor in tensors.items():
            setattr(splats, name, nn.Parameter(tensor.detach().clone()))
        return splats

    @classmethod
    def from_points(cls, points: Tensor, colors: Tensor, sh_degree: int = 3, opacity: float = 0.1) -> "Splats":
        """One isotropic splat per point, as 3D Gaussian Splatting starts from a COLMAP model.

        No rotation, constant colour, axes as long as the root of the mean squared distance to the three nearest
        neighbours; the square is clamped to [1e-7, 4], in squared units of ``points``. Non-finite and duplicate points
        are dropped: a duplicate adds nothing and has no distance of its own.

        Args:
            points: World positions ``[N, 3]``.
            colors: RGB in [0, 1], ``[N, 3]``.
            sh_degree: Highest degree of the spherical harmonics; the coefficients above 0 start at 0.
            opacity: Of each splat, between 0 and 1.

        Raises:
            ValueError: No usable point is left, or colours are not in [0, 1].
        """
        points, colors = points.detach().cpu().float(), colors.detach().cpu().float()
        finite = torch.isfinite(points).all(1) & torch.isfinite(colors).all(1)
        rows = finite.nonzero()[:, 0][distinct_rows(points[finite])]
        points, colors = points[rows], colors[rows]
        n = len(points)
        if n == 0:
            raise ValueError("the point cloud has no finite point; reconstruct the scene again or start from a .ply")
        odd = colors.max() if colors.min() >= 0 else colors.min()
        if not 0 <= odd <= 1:
            raise ValueError(f"colours of points are up to {odd:g}, not in [0, 1]: divide bytes by 255")
        spread = _mean_squared_neighbour_distance(points)
        # Where cameras stand in one place, all that they show is many units away.
        spread = spread.clamp(1e-7, max(4.0, 10 * float(spread.median())))
        return cls.from_tensors(
            means=points,
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            scales=(0.5 * spread.log())[:, None].repeat(1, 3),
            opacities=torch.full((n,), math.log(opacity / (1 - opacity))),
            sh0=((colors - 0.5) / SH_C0)[:, None, :],
            shN=torch.zeros(n, sh_coefficients(sh_degree), 3),
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest degree of the spherical harmonics."""
        return sh_degree_of(self.shN)

    def attributes(self) -> dict[str, nn.Parameter]:
        """The six raw attributes by name, in the order of :data:`ATTRIBUTES`."""
        return {name: getattr(self, name) for name in ATTRIBUTES}

    def raw(self) -> RawSplats:
        """The six raw attributes, attached to the graph."""
        return RawSplats(**self.attributes())

    def add_table(self, name: str) -> Tensor:
        """Add (or get) a side table ``[N]`` of zeros that follows the rows through every edit and checkpoint."""
        if name not in self._buffers:
            self.register_buffer(name, self.means.new_zeros(len(self)))
        return self.get_buffer(name)

    def tables(self) -> dict[str, Tensor]:
        """The side tables by name."""
        return dict(self.named_buffers())

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *args: Any) -> None:
        """Resize to the stored number of rows before the values are copied."""
        for key, stored in state_dict.items():
            name = key.removeprefix(prefix)
            if not key.startswith(prefix) or "." in name:
                continue
            if name in ATTRIBUTES:
                current = getattr(self, name)
                if current.shape != stored.shape:
                    setattr(self, name, nn.Parameter(current.new_zeros(stored.shape)))
            elif (table := self.add_table(name)).shape != stored.shape:
                setattr(self, name, table.new_zeros(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *args)


# What has the six raw attributes as tensors; :func:`nsvq_lightning.render` takes it.
SplatTensors = Splats | RawSplats


def warn_if_trained(splats: object) -> None:
    """Warn of the splats of a module after its training, which are not where its cameras and files are."""
    if getattr(splats, "edits", 0):
        log.warning("splats of a module are in coordinates of training: give the module itself, or call module(camera)")


def detached(splats: SplatTensors) -> RawSplats:
    """The raw attributes outside the graph; they share the memory of ``splats``."""
    return RawSplats(*(getattr(splats, name).detach() for name in ATTRIBUTES))


def distinct_rows(x: Tensor) -> Tensor:
    """Indices ``[M]`` int64, ascending, of the first occurrence of every distinct row of ``x [N, D]``."""
    rows = (x + 0.0).contiguous().numpy(force=True)  # + 0.0 turns -0 into 0
    # As bytes: NumPy would compare the rows of a table number by number, ten times as slowly.
    _, first = np.unique(rows.view(f"V{rows.itemsize * rows.shape[1]}"), return_index=True)
    return torch.from_numpy(np.sort(first)).to(x.device)


def _mean_squared_neighbour_distance(points: Tensor) -> Tensor:
    """Mean squared distance ``[N]`` of distinct points ``[N, 3]`` to their three nearest neighbours."""
    neighbours = min(3, len(points) - 1)
    if neighbours == 0:
        return torch.ones(1)
    from scipy.spatial import cKDTree  # takes longer to import than all that a render needs beside torch

    positions = points.double().numpy()
    distance, _ = cKDTree(positions).query(positions, k=neighbours + 1, workers=-1)
    return torch.from_numpy(np.square(distance[:, 1:]).mean(1)).float()


def _right_products(quats: Tensor) -> Tensor:
    """Matrices ``[M, 4, 4]`` with ``matrix @ q`` the product ``q ⊗ r`` for each quaternion r of ``quats [M, 4]``."""
    w, x, y, z = quats.unbind(1)
    rows = [[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


_H = math.sqrt(0.5)
# For each order of the axes, a rotation whose columns are, up to sign, the unit vectors in that order.
_AXIS_TURNS = torch.tensor(
    [
        [1.0, 0.0, 0.0, 0.0],  # axes 0 1 2
        [_H, _H, 0.0, 0.0],  # 0 2 1
        [_H, 0.0, 0.0, _H],  # 1 0 2
        [0.5, 0.5, 0.5, 0.5],  # 1 2 0
        [0.5, -0.5, -0.5, -0.5],  # 2 0 1
        [_H, 0.0, _H, 0.0],  # 2 1 0
    ],
    dtype=torch.float64,
)


# ``[6, 4, 4, 4]``: for each order of the axes and each of four half turns, the product from the right as a matrix.
_TURNS = _right_products(torch.eye(4, dtype=torch.float64)) @ _right_products(_AXIS_TURNS)[:, None]


class Canonical(NamedTuple):
    """Scales and rotations in a canonical form, and the maps that carry gradients over to it.

    Attributes:
        scales: Log-scales ``[N, 3]``.
        quats: Quaternions ``[N, 4]``, wxyz, of length 1.
        scale_maps: ``[N, 3, 3]``; maps a gradient with respect to the old log-scales to one with respect to the new.
        quat_maps: ``[N, 4, 4]``, the same for the quaternions.
    """

    scales: Tensor
    quats: Tensor
    scale_maps: Tensor
    quat_maps: Tensor


def canonical(scales: Tensor, quats: Tensor) -> Canonical:
    """Scales and rotations of the same covariances in a canonical form.

    The covariance R·diag(s²)·Rᵀ does not change when the three axes change their order or direction (24 rotations of
    the cube), nor when the quaternion changes its sign or length. Vectors that mean the same but lie apart waste codes
    of a codebook; here one of the 48 pairs of scale and rotation stands for all of them.

    The axes are sorted, longest first; of the remaining rotations it is the smallest one, with the largest w; and the
    quaternion has length 1. One too short to have a direction is the identity, as for the renderer; NaN and infinity
    are kept.

    Args:
        scales: Log-scales ``[N, 3]``.
        quats: Quaternions ``[N, 4]``, wxyz, of any length up to 1e19.
    """
    squared = quats.square().sum(1, keepdim=True)
    directed = ~(squared < MIN_SQUARED_NORM)
    quats = torch.where(directed, quats, torch.eye(4).to(quats)[0])
    lengths = torch.where(directed, squared, 1.0).sqrt()
    order = scales.argsort(dim=1, descending=True, stable=True)
    # The order fixes a rotation up to half turns around the axes; of these four, the one with the largest w.
    number = 2 * order[:, 0] + (order[:, 1] > order[:, 2])
    each = _TURNS.to(quats)
    turns = each[number, times_vectors(each[:, :, 0][number], quats).abs().argmax(1)]
    turned = times_vectors(turns, quats)
    signs = torch.where(turned[:, :1] < 0, -1.0, 1.0).to(quats)
    axes = torch.eye(3).to(scales)
    quat_maps = (signs * lengths)[:, :, None] * turns
    return Canonical(scales.gather(1, order), signs * turned / lengths, axes[order], quat_maps)


def times_vectors(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Products ``[N, I]`` of ``matrices [N, I, J]`` or one ``[I, J]`` and ``vectors [N, J]``.

    Elementwise, in float32 wherever the inputs are: a GPU may round ``matmul`` and ``einsum`` to fewer digits (TF32).
    """
    return (matrices * vectors[:, None]).sum(2)
