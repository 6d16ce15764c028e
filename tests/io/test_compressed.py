"""Parts of compressed scenes hold the same splats."""

from __future__ import annotations

import numpy as np
from compressed_scenes import scene as coded


def test_a_crop_keeps_codebooks_and_what_is_inside() -> None:
    scene = coded(300, origin=(10.0, 0.0, 0.0))
    world = scene.means + np.array(scene.origin)
    low, high = np.array([9.5, -1.0, -0.5]), np.array([10.5, 1.0, np.inf])
    part = scene.cropped(low, high)
    inside = ((world >= low) & (world <= high)).all(1)
    assert 0 < len(part) == inside.sum() < 300
    small = part.in_use()
    for name in scene.codes:
        expected = scene.codebooks[name][scene.codes[name][inside]]
        np.testing.assert_array_equal(small.codebooks[name][small.codes[name]], expected)
        assert len(small.codebooks[name]) == len(np.unique(part.codes[name]))
