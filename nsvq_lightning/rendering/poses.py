"""Where cameras are, and what several have in common: what they look at, and where up is."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.linalg import norm
from scipy.spatial.transform import Rotation
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.splats.conventions import Float64s

# Weight of what decides where cameras that all look the same way leave a direction open: which way is up, and how far
# away they look, as those of a drone, held level to a degree or two, say nothing of that.
LITTLE, LEVEL = 1e-5, 1e-3


def poses(cameras: Sequence[Camera]) -> tuple[Float64s, Rotation]:
    """Positions ``[N, 3]``, and rotations from camera to world."""
    packed = np.array([camera.packed_view for camera in cameras])
    return packed[:, 12:], Rotation.from_matrix(packed[:, :9].reshape(-1, 3, 3).mT)


def looked_at(cameras: Sequence[Camera]) -> Float64s:
    """The point ``[3]`` nearest to all lines of sight, in front of the cameras; where these are parallel, some way off.

    Where they part, they meet behind the cameras: what these show is about as far away on the other side.
    """
    positions, rotations = poses(cameras)
    arms = positions - positions.mean(0)
    forward = rotations.as_matrix()[:, :, 2]
    ahead = forward.mean(0)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    spread = norm(arms, axis=1).max() or 1.0
    weight = LEVEL * len(positions)
    total = across.sum(0) + weight * np.eye(3)
    met = np.linalg.solve(total, np.einsum("nij,nj->i", across, arms) + weight * (2 * spread * ahead))
    return np.asarray(positions.mean(0) + met - 2 * min(met @ ahead, 0) * ahead)


def up_of(cameras: Sequence[Camera]) -> Float64s:
    """The direction ``[3]`` that is up for cameras most of which are held level, unit length.

    It is at right angles to where their right is, the sum of the sines of their rolls being least, so that a minority
    of photos in portrait format or askew does not count; where that leaves a choice, it is near their upper edges.
    Looking up or down does not matter; where all look one way and their upper edges do not agree, as from a drone that
    turns above the ground, that way is down.
    """
    axes = poses(cameras)[1].as_matrix()
    right, upper, forward = axes[:, :, 0], -axes[:, :, 1].mean(0), axes[:, :, 2].mean(0)
    if norm(upper) < 0.3 and norm(forward) > 0.9:
        return np.asarray(-forward / norm(forward))
    if norm(upper) < 0.1:  # they are turned in all directions
        return -axes[0, :, 1]  # type: ignore[no-any-return]
    weights = np.ones(len(axes))
    for _ in range(20):  # weighted again by how level they are
        level = (weights * right.T) @ right / weights.sum()
        up = np.linalg.solve(level + LITTLE * np.eye(3), upper)
        up /= norm(up)
        weights = 1 / np.maximum(np.abs(right @ up), 0.02)  # sine of the roll below which a camera counts as level
    return up


def view_towards(target: Float64s, eye: Float64s, up: Float64s) -> Tensor:
    """World to camera ``[4, 4]`` float32: from ``eye [3]`` a camera looks at ``target [3]``, with ``up [3]`` above."""
    forward = (target - eye) / (norm(target - eye) or 1.0)
    right = np.cross(forward, up)
    right /= norm(right) or 1.0
    return view_from(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


def view_from(rotation: Float64s, position: Float64s) -> Tensor:
    """World to camera ``[4, 4]`` float32, from the rotation to the world and the position in it."""
    return torch.from_numpy(viewmat_of(rotation.T, position).astype(np.float32))


def transformed(points: Float64s, matrix: Float64s) -> Float64s:
    """Points ``[P, 3]`` after a matrix ``[3, 4]``, a linear map and a translation; a fourth row may follow."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def viewmat_of(rotation: Float64s, position: Float64s) -> Float64s:
    """World to camera ``[4, 4]``, from the rotation to the camera and the position in the world."""
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = -view[:3, :3] @ position
    return view
