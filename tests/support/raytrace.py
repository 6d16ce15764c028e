"""A small ray tracer in NumPy: textured quads and spheres, baked soft light and one Phong highlight.

Light that does not depend on the viewer (a rectangular lamp with soft shadows, and ambient light with occlusion) is
baked once into a light map per surface; a picture then costs one ray per sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

_RAYS_AT_ONCE = 16384  # a block of rays stays in the processor's cache
NEAR = 1e-3
"""Hits nearer than this ray parameter are on the surface where the ray starts, and ignored."""


@dataclass(eq=False)
class Quad:
    """Parallelogram ``corner + u·across + v·along``, lit on the side where ``across`` is right and ``along`` down.

    A surface has coordinates ``uv [M, 2]`` in [0, 1], a texture of linear albedo ``[h, w, 3]``, the strength of its
    Phong highlight and of the light that it emits, and says whether u = 0 and u = 1 are the same line.
    """

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
        """Lengths along u and v."""
        return float(np.linalg.norm(self.across)), float(np.linalg.norm(self.along))

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Ray parameters ``[M]`` of the first hits of rays ``[3] or [M, 3]``, ``[M, 3]``; infinite where missed."""
        from_corner = origin - self.corner
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -(from_corner @ self.normal) / (direction @ self.normal)
            u = from_corner @ self._u + t * (direction @ self._u)
            v = from_corner @ self._v + t * (direction @ self._v)
        inside = (t > NEAR) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        return np.where(inside, t, np.float32(np.inf))

    def coordinates(self, points: Array) -> Array:
        return np.stack([(points - self.corner) @ self._u, (points - self.corner) @ self._v], axis=-1)

    def points(self, uv: Array) -> Array:
        points: Array = self.corner + uv[:, :1] * self.across + uv[:, 1:] * self.along
        return points

    def normals(self, points: Array) -> Array:
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
        offset = origin - self.centre
        a = np.einsum("ij,ij->i", direction, direction)
        b = direction @ offset if offset.ndim == 1 else np.einsum("ij,ij->i", direction, offset)
        c = (offset * offset).sum(-1) - np.float32(self.radius**2)
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        near, far = (-b - root) / a, (-b + root) / a
        t = np.where(near > NEAR, near, far)
        return np.where((b * b > a * c) & (t > NEAR), t, np.float32(np.inf))

    def coordinates(self, points: Array) -> Array:
        n = self.normals(points)
        u = np.arctan2(n[:, 2], n[:, 0]) / (2 * np.pi) + 0.5
        v = np.arccos(np.clip(-n[:, 1], -1, 1)) / np.pi
        return np.stack([u, v], axis=-1)

    def points(self, uv: Array) -> Array:
        azimuth, polar = (uv[:, 0] - 0.5) * (2 * np.pi), uv[:, 1] * np.pi
        ring = np.sin(polar)
        n = np.stack([ring * np.cos(azimuth), -np.cos(polar), ring * np.sin(azimuth)], axis=-1)
        return (self.centre + self.radius * n).astype(np.float32)

    def normals(self, points: Array) -> Array:
        return ((points - self.centre) / self.radius).astype(np.float32)


Surface = Quad | Sphere


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


@dataclass(frozen=True, eq=False)
class Lamp:
    """Rectangular lamp under the ceiling, shining down (+y).

    ``power`` is the irradiance at distance 1 straight below it, ``ambient`` that from all other directions where
    nothing is near.
    """

    centre: Array
    side: float
    power: float
    ambient: float


@dataclass(eq=False)
class Room:
    """Surfaces, a lamp and the baked light maps, of so many ``texels`` per scene unit."""

    surfaces: Sequence[Surface]
    lamp: Lamp
    texels: float = 12.0
    light: list[Array] = field(init=False)

    def __post_init__(self) -> None:
        self.light = self._bake()

    def trace(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int16]]:
        """First hits of rays from ``origin [3]`` along ``direction [M, 3]``: parameters, or infinity, and surfaces."""
        t = np.full(len(direction), np.inf, np.float32)
        hit = np.zeros(len(direction), np.int16)
        for start in range(0, len(direction), _RAYS_AT_ONCE):
            block = slice(start, start + _RAYS_AT_ONCE)
            for number, surface in enumerate(self.surfaces):
                distance = surface.intersect(origin, direction[block])
                closer = distance < t[block]
                t[block][closer] = distance[closer]
                hit[block][closer] = number
        return t, hit

    def colours(self, origin: Array, direction: Array) -> Array:
        """Linear RGB ``[M, 3]`` seen from ``origin [3]`` along unit directions ``[M, 3]``."""
        t, hit = self.trace(origin, direction)
        out = np.zeros((len(direction), 3), np.float32)
        for number, surface in enumerate(self.surfaces):
            rays = np.flatnonzero((hit == number) & np.isfinite(t))
            points = origin + t[rays, None] * direction[rays]
            out[rays] = self.diffuse(number, surface.coordinates(points))
            if surface.gloss:
                out[rays] += surface.gloss * self._highlight(surface, points, direction[rays])[:, None]
        return out

    def diffuse(self, number: int, uv: Array) -> Array:
        """View-independent linear RGB ``[M, 3]`` of surface ``number`` at ``uv [M, 2]``."""
        surface = self.surfaces[number]
        albedo = sample(surface.texture, uv, surface.wraps)
        return albedo * (sample(self.light[number], uv, surface.wraps) + surface.glow)

    def _highlight(self, surface: Surface, points: Array, direction: Array) -> Array:
        """Phong's mirror term ``[M]``."""
        n = surface.normals(points)
        mirrored = direction - 2 * np.einsum("ij,ij->i", direction, n)[:, None] * n
        to_lamp = self.lamp.centre - points
        to_lamp = to_lamp / np.linalg.norm(to_lamp, axis=1, keepdims=True)
        cosine: Array = np.maximum(np.einsum("ij,ij->i", mirrored, to_lamp), 0)
        return cosine**40

    def _bake(self) -> list[Array]:
        """Irradiance ``[h, w, 1]`` on a grid over each surface."""
        shapes, points, normals = [], [], []
        for surface in self.surfaces:
            width, height = (max(4, round(length * self.texels)) for length in surface.size)
            u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
            shapes.append((height, width, 1))
            points.append(surface.points(np.stack([u.ravel(), v.ravel()], -1).astype(np.float32)))
            normals.append(surface.normals(points[-1]))
        normal = np.concatenate(normals)
        point = (np.concatenate(points) + 4 * NEAR * normal).astype(np.float32)
        light = self._from_lamp(point, normal) + self.lamp.ambient * self._openness(point, normal)
        parts = np.split(light.astype(np.float32), np.cumsum([len(part) for part in points])[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def _from_lamp(self, points: Array, normals: Array, side: int = 5) -> Array:
        """Irradiance ``[M]`` from a grid of ``side²`` points of the lamp, with shadows."""
        steps = ((np.arange(side) + 0.5) / side - 0.5) * self.lamp.side
        total = np.zeros(len(points), np.float32)
        for x in steps:
            for z in steps:
                ray = self.lamp.centre + np.array([x, 0, z], np.float32) - points
                squared = np.einsum("ij,ij->i", ray, ray)
                facing = np.maximum(np.einsum("ij,ij->i", ray, normals), 0) * np.maximum(-ray[:, 1], 0)
                lit = np.flatnonzero(facing)
                total[lit] += facing[lit] / squared[lit] ** 2 * self._free(points[lit], ray[lit], 1.0)
        return (total * (self.lamp.power / side**2)).astype(np.float32)

    def _openness(self, points: Array, normals: Array, rays: int = 32, reach: float = 0.9) -> Array:
        """Cosine-weighted share ``[M]`` of directions in which nothing is nearer than ``reach`` (ambient occlusion)."""
        golden = np.pi * (3 - np.sqrt(5))
        tangent = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 0, 1.0]]))
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        binormal = np.cross(normals, tangent)
        total = np.zeros(len(points), np.float32)
        for i in range(rays):
            ring, turn = np.sqrt((i + 0.5) / rays), i * golden
            direction = ring * (np.cos(turn) * tangent + np.sin(turn) * binormal) + np.sqrt(1 - ring**2) * normals
            total += self._free(points, (reach * direction).astype(np.float32), 1.0)
        return (total / rays).astype(np.float32)

    def _free(self, origin: Array, direction: Array, until: float) -> Array:
        """1 where no matt surface lies before ray parameter ``until``, else 0; ``[M]``."""
        blocked = np.zeros(len(direction), bool)
        for surface in self.surfaces:
            if not surface.glow:
                blocked |= surface.intersect(origin, direction) < until
        return (~blocked).astype(np.float32)
