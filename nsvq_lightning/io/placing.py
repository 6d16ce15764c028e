"""Scenes turned, scaled, moved and cropped, by the rows of their codebooks."""

from typing import TYPE_CHECKING, Any

import numpy as np

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.rendering.sh import sh_rotation
from nsvq_lightning.splats.conventions import Float64s, middle_of, turned

if TYPE_CHECKING:
    from nsvq_lightning.rendering.frame import Frame

# Rotations that turn COLMAP's up, -y, to an axis; x stays.
_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
UP_AXES = {"y": np.diag([1.0, -1.0, -1.0]), "minus-y": np.eye(3), "z": _Z, "minus-z": _Z.T}


def turn_up(up: Float64s, axis: str) -> Float64s:
    """The rotation ``[3, 3]`` that turns a direction to an axis: to -y, x as near to itself as may be, then around x.

    Args:
        up: Direction ``[3]`` of length 1.
        axis: One of :data:`UP_AXES`.
    """
    from scipy.spatial.transform import Rotation

    lift, _ = Rotation.align_vectors([[0, -1, 0], [1, 0, 0]], [up, [1, 0, 0]], [np.inf, 1])
    return UP_AXES[axis] @ lift.as_matrix()  # type: ignore[no-any-return]


# Half around z: right, down, front becomes left, up, front, the axes of glTF and USD.
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


# From so many times the distance that four fifths of the splats have from their middle, float32 would be too coarse.
FAR = 1000.0


def rotated(scene: CompressedScene, rotation: Float64s) -> CompressedScene:
    """The scene turned about the world's origin, and scaled, by a matrix ``[3, 3]``, see :func:`moved`."""
    return moved(scene, np.c_[rotation, np.zeros(3)])


def moved(scene: CompressedScene, matrix: Float64s) -> CompressedScene:
    """The scene turned, scaled and moved.

    Positions, scales, rotations and spherical harmonics change, the last three by the rows of their codebooks; numbers
    are rounded once, to float32. What moves far away, as to a map, moves by its origin.

    Args:
        scene: The scene.
        matrix: From old to new world coordinates ``[3, 4]``: a rotation times a positive number, and a translation; a
            fourth row may follow.

    Raises:
        ValueError: It stretches, mirrors or is not finite.
    """
    linear, shift = matrix[:3, :3], matrix[:3, 3] + matrix[:3, :3] @ scene.origin
    size = np.cbrt(np.linalg.det(linear))
    if not (
        np.isfinite(matrix).all()
        and size > 0
        and np.allclose(linear @ linear.T, size**2 * np.eye(3), 0, 1e-5 * size**2)
    ):
        raise ValueError(f"{linear.tolist()} is no scaled rotation: splats can be turned and scaled evenly only")
    rotation = linear / size
    harmonics = sh_rotation(rotation, scene.sh_degree)
    means, origin = scene.means @ linear.T, np.zeros(3)
    if len(means) and np.linalg.norm(shift) > FAR * middle_of(means)[1] > 0:
        origin, shift = shift, origin  # which moves, then, and not what is relative to it
    cameras = scene.cameras.copy()
    cameras[:, :3] = cameras[:, :3] @ linear.T + shift
    return scene.changed(
        {
            "scales": lambda rows: rows + np.log(size),
            "quats": lambda rows: turned(rows, rotation),
            "shN": lambda rows: (harmonics @ rows.reshape(len(rows), len(harmonics), 3)).reshape(rows.shape),
        },
        means=(means + shift).astype(np.float32),
        origin=tuple(origin.tolist()),
        cameras=cameras,
    )


def placed(scene: CompressedScene, frame: "Frame", **fields: Any) -> CompressedScene:
    """The scene in the coordinates of its files, from those of the frame that it was trained in, with these fields."""
    means = frame.unit * scene.means.astype(np.float64) + frame.middle
    scales = {"scales": lambda rows: rows + np.log(frame.unit)}
    return scene.changed(scales, means=means.astype(np.float32), origin=frame.origin, **fields)


def cropped(scene: CompressedScene, low: Float64s, high: Float64s) -> CompressedScene:
    """The splats whose centres are in a box, its sides included; codebooks stay as they are.

    Args:
        scene: The scene.
        low: Smallest world coordinates ``[3]``.
        high: Largest ``[3]``.
    """
    positions = scene.means + np.array(scene.origin)
    return scene.take(((positions >= low) & (positions <= high)).all(1))
