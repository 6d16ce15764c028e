"""At what size and from where training saw splats: the blur that was trained belongs to the pixels of its photos.

The rasterizer adds 0.3 square pixels to every splat, and training makes up for it at the size of the photos. In a
picture with r times as many pixels per unit of the scene, the same blur has 0.3·r² square pixels. Where r > 1, that is
added; where r < 1, a pixel's own 0.3 are, and the opacity makes up for the rest (:mod:`nsvq_lightning.rendering.
formulas`). So scenes look the same at any size, as those of SA-GS (Song et al. 2024) do.

Photos are taken from several distances, and training is right at all of them. So r is the ratio of focal lengths in
pixels, times the ratio of distances only where a splat is nearer, or farther, than in any photo.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.linalg import norm

from nsvq_lightning.splats.conventions import Float64s

if TYPE_CHECKING:
    from torch import Tensor

    from nsvq_lightning.rendering.camera import Camera

# Most cameras that are kept of a scene.
MAX_CAMERAS = 64
# Focal lengths that differ by less count as one.
SAME_SIZE = 0.01
# A camera within this share of the spread of all cameras stands for another. With 0.2, splats beside a corridor of 130
# times their distance were shown as seen from afar, 28 dB from how they were trained; with 0.1 it is 44 dB.
NEAR_ENOUGH = 0.1


class ViewSampling(NamedTuple):
    """How splats were trained, for one camera.

    Attributes:
        distances: From the camera of training that is nearest to each splat, and from the farthest ``[2, N]``.
        size: (focal length here / there)², in pixels.
    """

    distances: "Tensor"
    size: float

    def of(self, rows: "Tensor") -> "ViewSampling":
        """That of some splats."""
        return ViewSampling(self.distances[:, rows], self.size)


class Shading(NamedTuple):
    """What a back-end is asked for besides splats and camera, see :func:`nsvq_lightning.render`.

    Attributes:
        sh_degree: Highest degree of the spherical harmonics that is evaluated.
        sampling: How the splats were trained, if their blur is to keep its size.
        background: RGB ``[3]``.
        pixel_weights: Weight of each pixel ``[H, W]``, if wanted.
        absgrad: Zeros ``[N, 3]`` whose gradient is then set.
    """

    sh_degree: int
    sampling: ViewSampling | None
    background: "Tensor"
    pixel_weights: "Tensor | None"
    absgrad: "Tensor | None"


# What a back-end gives: image, alpha, radii, means2d and depth of :class:`nsvq_lightning.Render`.
Layers: TypeAlias = "tuple[Tensor, Tensor, Tensor, Tensor, Tensor]"


class Sampling(NamedTuple):
    """How training saw N splats.

    Attributes:
        distances: Of each splat from the nearest camera, and from the farthest ``[2, N]``, scene units.
        focals: Focal lengths of the cameras, pixels; at least one.
    """

    distances: "Tensor"
    focals: Sequence[float]

    @classmethod
    def of(cls, means: "Tensor", cameras: Float64s) -> "Sampling":
        """How cameras ``[C, 4]`` of :func:`trained_by` see splats with centres ``[N, 3]``, wherever they look.

        Between them there have been others: distances reach as much farther as cameras are apart.
        """
        import torch

        nearest = torch.full_like(means[:, 0], math.inf)
        farthest = torch.zeros_like(nearest)
        places = torch.from_numpy(cameras[:, :3])
        for place in places.to(means):
            distance = (means - place).norm(dim=1)
            nearest, farthest = torch.minimum(nearest, distance), torch.maximum(farthest, distance)
        between = torch.cdist(places, places).fill_diagonal_(math.inf)
        gap = float(between.amin(1).median()) if len(places) > 1 else 0.0
        distances = torch.stack([torch.maximum(nearest - gap, nearest / 2), farthest + gap])
        return cls(distances, np.unique(cameras[:, 3]).tolist())

    def in_view(self, camera: "Camera") -> ViewSampling:
        """For a camera: its size is relative to that of the photos with the most similar focal length."""
        here = focal_of(camera)
        ratio = min((here / focal for focal in self.focals), key=lambda ratio: abs(math.log(ratio)))
        return ViewSampling(self.distances, 1.0 if abs(math.log(ratio)) < SAME_SIZE else ratio**2)


def focal_of(camera: "Camera") -> float:
    """Focal length in pixels; between both where they differ."""
    fx, fy, _, _ = camera.intrinsics
    return math.sqrt(fx * fy)


def trained_by(cameras: Sequence["Camera"]) -> Float64s:
    """Positions, and focal lengths in pixels, of the cameras of training ``[C, 4]``, without what changes little.

    They are at most :data:`MAX_CAMERAS`, each the farthest from those before it, and no more when every other camera is
    near one of them.
    """
    packed = [[*camera.packed_view[12:], focal_of(camera)] for camera in cameras]
    return fewer_cameras(np.array(packed).reshape(-1, 4))


def fewer_cameras(cameras: Float64s) -> Float64s:
    """Those of cameras ``[C, 4]`` that :func:`trained_by` keeps."""
    if len(cameras) == 0:
        return cameras
    apart = norm(cameras[:, :3] - np.median(cameras[:, :3], axis=0), axis=1)
    spread = apart.max()
    # A lens that magnifies e times is as far from another as the cameras' spread.
    positions = np.c_[cameras[:, :3], (spread or 1) * np.log(cameras[:, 3])]
    chosen = [apart.argmax()]
    apart = norm(positions - positions[chosen[0]], axis=1)
    while len(chosen) < MAX_CAMERAS and apart.max() > NEAR_ENOUGH * spread:
        chosen.append(apart.argmax())
        apart = np.minimum(apart, norm(positions - positions[chosen[-1]], axis=1))
    return cameras[np.sort(chosen)]  # type: ignore[no-any-return]
