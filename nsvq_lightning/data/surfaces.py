"""Surfaces of the demo room: textured quads and spheres with texture coordinates that rays can hit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["NEAR", "Array", "Quad", "Sphere", "Surface", "sample"]

Array = NDArray[np.float32]

NEAR = 1e-3
"""Hits nearer than this ray parameter are on the surface where the ray starts, and ignored."""


class Surface(Protocol):
    """A surface with coordinates ``uv [M, 2]`` in [0, 1]; all points and lengths in scene units."""

    texture: Array
    """Linear albedo ``[h, w, 3]`` in [0, 1]."""
    wraps: bool
    """Whether u = 0 and u = 1 are the same line."""
    gloss: float
    """Strength of the Phong highlight, 0 for a matt surface."""
    glow: float
    """Emitted light, 0 for all but the lamp's panel."""

    @property
    def size(self) -> tuple[float, float]:
        """Lengths along u and v."""

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Ray parameters ``[M]`` of the first hits of rays ``[3] or [M, 3]``, ``[M, 3]``; infinite where missed."""

    def coordinates(self, points: Array) -> Array:
        """``uv [M, 2]`` of points ``[M, 3]`` on the surface."""

    def points(self, uv: Array) -> Array:
        """Points ``[M, 3]`` at ``uv [M, 2]``."""

    def normals(self, points: Array) -> Array:
        """Unit outward normals ``[M, 3]`` at points on the surface."""


@dataclass(eq=False)
class Quad:
    """Parallelogram ``corner + u·across + v·along``, lit on the side where ``across`` is right and ``along`` down."""

    corner: Array
    across: Array
    along: Array
    texture: Array
    gloss: float = 0.0
    glow: float = 0.0
    wraps: bool = False

    def __post_init__(self) -> None:
        normal = np.cross(self.along, self.across)
        self.normal: Array = (normal / np.linalg.norm(normal)).astype(np.float32)
        self._u: Array = self.across / (self.across @ self.across)
        self._v: Array = self.along / (self.along @ self.along)

    @property
    def size(self) -> tuple[float, float]:
        """Lengths of the sides."""
        return float(np.linalg.norm(self.across)), float(np.linalg.norm(self.along))

    def intersect(self, origin: Array, direction: Array) -> Array:
        """See :class:`Surface`."""
        from_corner = origin - self.corner
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -(from_corner @ self.normal) / (direction @ self.normal)
            u = from_corner @ self._u + t * (direction @ self._u)
            v = from_corner @ self._v + t * (direction @ self._v)
        inside = (t > NEAR) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        return np.where(inside, t, np.float32(np.inf))

    def coordinates(self, points: Array) -> Array:
        """See :class:`Surface`."""
        return np.stack([(points - self.corner) @ self._u, (points - self.corner) @ self._v], axis=-1)

    def points(self, uv: Array) -> Array:
        """See :class:`Surface`."""
        points: Array = self.corner + uv[:, :1] * self.across + uv[:, 1:] * self.along
        return points

    def normals(self, points: Array) -> Array:
        """See :class:`Surface`."""
        return np.broadcast_to(self.normal, points.shape)


@dataclass(eq=False)
class Sphere:
    """Sphere; u runs around the vertical axis, v from the top (-y) to the bottom."""

    centre: Array
    radius: float
    texture: Array
    gloss: float = 0.0
    glow: float = 0.0
    wraps: bool = True

    @property
    def size(self) -> tuple[float, float]:
        """Equator and meridian."""
        return 2 * np.pi * self.radius, np.pi * self.radius

    def intersect(self, origin: Array, direction: Array) -> Array:
        """See :class:`Surface`."""
        offset = origin - self.centre
        a = np.einsum("ij,ij->i", direction, direction)
        b = direction @ offset if offset.ndim == 1 else np.einsum("ij,ij->i", direction, offset)
        c = (offset * offset).sum(-1) - np.float32(self.radius**2)
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        near, far = (-b - root) / a, (-b + root) / a
        t = np.where(near > NEAR, near, far)
        return np.where((b * b > a * c) & (t > NEAR), t, np.float32(np.inf))

    def coordinates(self, points: Array) -> Array:
        """See :class:`Surface`."""
        n = self.normals(points)
        u = np.arctan2(n[:, 2], n[:, 0]) / (2 * np.pi) + 0.5
        v = np.arccos(np.clip(-n[:, 1], -1, 1)) / np.pi
        return np.stack([u, v], axis=-1)

    def points(self, uv: Array) -> Array:
        """See :class:`Surface`."""
        azimuth, polar = (uv[:, 0] - 0.5) * (2 * np.pi), uv[:, 1] * np.pi
        ring = np.sin(polar)
        n = np.stack([ring * np.cos(azimuth), -np.cos(polar), ring * np.sin(azimuth)], axis=-1)
        return (self.centre + self.radius * n).astype(np.float32)

    def normals(self, points: Array) -> Array:
        """See :class:`Surface`."""
        return ((points - self.centre) / self.radius).astype(np.float32)


def sample(texture: Array, uv: Array, wraps: bool) -> Array:
    """Bilinear lookup of ``texture [h, w, C]`` at ``uv [M, 2]``; ``[M, C]``."""
    height, width, _ = texture.shape
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    fx, fy = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
    columns = [(left + i) % width if wraps else (left + i).clip(0, width - 1) for i in (0, 1)]
    rows = [(top + i).clip(0, height - 1) for i in (0, 1)]
    upper = texture[rows[0], columns[0]] * (1 - fx) + texture[rows[0], columns[1]] * fx
    lower = texture[rows[1], columns[0]] * (1 - fx) + texture[rows[1], columns[1]] * fx
    result: Array = upper * (1 - fy) + lower * fy
    return result
