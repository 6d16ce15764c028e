"""The demo scene of the package, and what tests make their scenes with."""

import numpy as np
import pytest
from demo_room import Lens, demo_poses, demo_room, render_view, surface_points
from skimage.metrics import peak_signal_noise_ratio

from nsvq_lightning.data.colmap import read_model
from nsvq_lightning.data.datamodule import DEMO, DemoDataModule


def test_the_package_contains_what_its_maker_makes() -> None:
    room, lens, poses = demo_room(), Lens(320, 240), demo_poses(40)
    points = surface_points(room, lens, poses, 4000)
    model = read_model(DEMO)
    np.testing.assert_allclose([image.viewmat for image in model.images], poses, rtol=0, atol=1e-12)
    np.testing.assert_allclose(model.points, points.xyz, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(model.colors, points.rgb)
    assert model.cameras[1].params.tolist() == pytest.approx(lens.params)
    scene = DemoDataModule().scene
    made, kept = render_view(room, poses[21], 320, 240), scene.view(21).image.numpy()
    assert peak_signal_noise_ratio(made, kept) > 36  # the error is that of WebP
    assert sum(path.stat().st_size for path in DEMO.rglob("*")) < 1_200_000
