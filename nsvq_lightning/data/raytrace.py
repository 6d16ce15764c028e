"""A small ray tracer in NumPy: baked soft light and one Phong highlight.

Light that does not depend on the viewer (a rectangular lamp with soft shadows, and ambient light with occlusion) is
baked once into a light map per surface; a picture then costs one ray per sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.data.surfaces import NEAR, Array, Surface, sample

__all__ = ["Hit", "Lamp", "Room"]

_RAYS_AT_ONCE = 16384  # a block of rays stays in the processor's cache


@dataclass(frozen=True, eq=False)
class Lamp:
    """Rectangular lamp under the ceiling, shining down (+y).

    Attributes:
        centre: ``[3]``.
        side: Side length.
        power: Irradiance at distance 1 straight below it.
        ambient: Irradiance from all other directions where nothing is near.
    """

    centre: Array
    side: float
    power: float
    ambient: float


@dataclass(frozen=True, eq=False)
class Hit:
    """First hits of M rays.

    Attributes:
        t: Ray parameters ``[M]``, infinite where nothing was hit.
        surface: Indices of the surfaces ``[M]``.
    """

    t: Array
    surface: NDArray[np.int16]


@dataclass(eq=False)
class Room:
    """Surfaces, a lamp and the baked light maps.

    Attributes:
        surfaces: All surfaces of the room.
        lamp: The lamp that lights it.
        texels: Light map resolution, texels per scene unit.
    """

    surfaces: Sequence[Surface]
    lamp: Lamp
    texels: float = 12.0
    light: list[Array] = field(init=False)

    def __post_init__(self) -> None:
        self.light = [self._bake(surface) for surface in self.surfaces]

    def trace(self, origin: Array, direction: Array) -> Hit:
        """First hits of rays from ``origin [3]`` or ``[M, 3]`` along ``direction [M, 3]`` (any length)."""
        t = np.full(len(direction), np.inf, np.float32)
        hit = np.zeros(len(direction), np.int16)
        for start in range(0, len(direction), _RAYS_AT_ONCE):
            block = slice(start, start + _RAYS_AT_ONCE)
            rays_from = origin if origin.ndim == 1 else origin[block]
            for number, surface in enumerate(self.surfaces):
                distance = surface.intersect(rays_from, direction[block])
                closer = distance < t[block]
                t[block][closer] = distance[closer]
                hit[block][closer] = number
        return Hit(t, hit)

    def colours(self, origin: Array, direction: Array) -> Array:
        """Linear RGB ``[M, 3]`` seen from ``origin [3]`` along unit directions ``[M, 3]``."""
        hit = self.trace(origin, direction)
        out = np.zeros((len(direction), 3), np.float32)
        for number, surface in enumerate(self.surfaces):
            rays = np.flatnonzero((hit.surface == number) & np.isfinite(hit.t))
            points = origin + hit.t[rays, None] * direction[rays]
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

    def _bake(self, surface: Surface) -> Array:
        """Irradiance ``[h, w, 1]`` on a grid over the surface."""
        width, height = (max(4, round(length * self.texels)) for length in surface.size)
        u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
        points = surface.points(np.stack([u.ravel(), v.ravel()], -1).astype(np.float32))
        normals = surface.normals(points)
        points = (points + 4 * NEAR * normals).astype(np.float32)
        light = self._from_lamp(points, normals) + self.lamp.ambient * self._openness(points, normals)
        return light.reshape(height, width, 1).astype(np.float32)

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
