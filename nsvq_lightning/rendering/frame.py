"""Coordinates in which a scene is trained: every length in them means the same, whatever unit its files have.

The unit of COLMAP is arbitrary, and so is that of a phone or a map. Here the middle of the cameras is 0, and their
extent is 5, as it is in most scenes of COLMAP: learning rates, first sizes and the near plane are told in this unit.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.poses import viewmat_of
from nsvq_lightning.rendering.sampling import Sampling
from nsvq_lightning.splats.conventions import ZERO, Float64s, Place, usual_of
from nsvq_lightning.splats.conventions import middle_of as middle_of  # known from here, too
from nsvq_lightning.splats.splats import RawSplats, SplatTensors, detached

# Extent of the cameras in a frame.
EXTENT = 5.0
# Places are rounded to so many steps a unit, a thousandth of a pixel: cameras have the same bits in any unit.
STEPS = 2.0**18
# Cameras more than so many times as far from their middle as four fifths of them do not count: one lost camera is no
# extent.
REACH = 2.0


class Frame(NamedTuple):
    """Coordinates of a scene; x is at ``middle + unit · x`` in its files.

    Attributes:
        unit: Length of 1, in the unit of the files.
        middle: Where 0 is, in the coordinates of the files.
        origin: World coordinates of the 0 of the files; other than 0 only where that is far away, as on a map.
    """

    unit: float = 1.0
    middle: Place = ZERO
    origin: Place = ZERO

    @classmethod
    def around(cls, centres: Float64s) -> "Frame":
        """The frame of cameras: 0 is the median of their centres ``[V, 3]``, and their extent is :data:`EXTENT`.

        The extent is 1.1 × the largest distance from the middle, without cameras that are :data:`REACH` times as far
        as four fifths of them. Of cameras in one place, the unit is that of the files.
        """
        middle = np.median(centres, axis=0)
        return cls(1.1 * reach_of(np.linalg.norm(centres - middle, axis=1)) / EXTENT or 1.0, tuple(middle.tolist()))

    def relative_to(self, origin: Place) -> "Frame":
        """The same coordinates of files whose positions are relative to another origin."""
        return Frame(self.unit, tuple(np.add(self.middle, np.subtract(self.origin, origin)).tolist()), origin)

    @property
    def near(self) -> float:
        """Distance of the near plane in the files."""
        return NEAR * self.unit

    def points(self, points: Float64s) -> Float64s:
        """Points ``[P, 3]`` of the files, here; rounded."""
        return np.rint((points - self.middle) / self.unit * STEPS) / STEPS

    @lru_cache(4096)  # noqa: B019  both are small, and every step asks for one
    def camera(self, camera: Camera) -> Camera:
        """A camera of the files, here."""
        if self == Frame():
            return camera
        packed = np.array(camera.packed_view)
        view = viewmat_of(packed[:9].reshape(3, 3), self.points(packed[None, 12:])[0])
        near = float(f"{camera.near / self.unit:.6g}")
        here = Camera(camera.K.double(), torch.from_numpy(view), *camera.size, near, camera.limits)
        return here.to(dtype=torch.float32)

    def sampling(self, sampling: Sampling | None) -> Sampling | None:
        """The sampling of splats of the files, here."""
        return None if sampling is None else sampling._replace(distances=sampling.distances / self.unit)

    def splats(self, splats: SplatTensors) -> RawSplats:
        """Splats of the files, here; detached."""
        raw = detached(splats)
        middle = raw.means.new_tensor(self.middle, dtype=torch.float64)
        means = ((raw.means.double() - middle) / self.unit).to(raw.means)
        return raw._replace(means=means, scales=(raw.scales.double() - math.log(self.unit)).to(raw.scales))


def reach_of(distances: Float64s) -> float:
    """The largest of distances ``[V]`` that is at most :data:`REACH` times what four fifths of them do not exceed."""
    usual = usual_of(distances)
    return float(distances[distances <= REACH * usual].max() if usual > 0 else distances.max())
