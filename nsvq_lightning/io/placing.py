"""Turn and crop scenes without decoding them: codebooks stay codebooks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.splats.conventions import sh_coefficients, turned

__all__ = ["UP_AXES", "cropped", "rotated", "turn_up"]

UP_AXES = {
    "y": np.diag([1.0, -1.0, -1.0]),
    "minus-y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "minus-z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotations that turn COLMAP's up, -y, to an axis; x stays."""


def turn_up(up: NDArray[np.float64], axis: str) -> NDArray[np.float64]:
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
    mirrors = (np.eye(3) - 2 * np.outer(v, v) / (v @ v) for v in (goal, between))
    first, second = mirrors
    return np.asarray(UP_AXES[axis] @ first @ second)


def rotated(scene: CompressedScene, rotation: NDArray[np.float64]) -> CompressedScene:
    """The scene turned about the world's origin.

    Positions, rotations and spherical harmonics turn, the last two by the rows of their codebooks; numbers are rounded
    once, to float32.

    Args:
        scene: The scene.
        rotation: ``[3, 3]``, of determinant 1.
    """
    import torch

    from nsvq_lightning.rendering.sh import sh_rotation

    matrix = sh_rotation(torch.from_numpy(rotation), scene.sh_degree).numpy()

    def rows(name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
        if name == "quats":
            return turned(values, rotation)
        if name == "shN":
            wide = values.reshape(len(values), sh_coefficients(scene.sh_degree), 3).astype(np.float64)
            return (matrix @ wide).reshape(values.shape).astype(np.float32)
        return values

    x, y, z = (rotation @ np.array(scene.origin)).tolist()
    return replace(
        scene,
        means=(scene.means.astype(np.float64) @ rotation.T).astype(np.float32),
        codebooks={name: rows(name, values) for name, values in scene.codebooks.items()},
        raw={name: rows(name, values) for name, values in scene.raw.items()},
        origin=(x, y, z),
        stored_bytes=None,
    )


def cropped(scene: CompressedScene, low: NDArray[np.float64], high: NDArray[np.float64]) -> CompressedScene:
    """The splats whose centres are in a box, its sides included; codebooks stay as they are.

    Args:
        scene: The scene.
        low: Smallest world coordinates ``[3]``.
        high: Largest ``[3]``.
    """
    positions = scene.means.astype(np.float64) + np.array(scene.origin)
    return scene.take(((positions >= low) & (positions <= high)).all(1))
