"""Cameras without distortion need no pycolmap, and are those of pycolmap."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from nsvq_lightning.data.colmap import SceneError, import_pycolmap, lens
from nsvq_lightning.data.pinhole import Pinhole


@pytest.mark.parametrize(
    ("model", "params"), [("PINHOLE", (50.0, 40.0, 11.0, 7.5)), ("SIMPLE_PINHOLE", (50.0, 11.0, 7.5))]
)
def test_a_pinhole_is_that_of_pycolmap(model: str, params: tuple[float, ...]) -> None:
    expected = import_pycolmap().Camera(model=model, width=24, height=16, params=list(params), camera_id=3)
    found = lens(3, model, 24, 16, params)
    assert isinstance(found, Pinhole)
    np.testing.assert_array_equal(found.calibration_matrix(), expected.calibration_matrix())
    assert (found.width, found.height, found.camera_id) == (24, 16, 3)
    np.testing.assert_array_equal(found.resized(48, 8).K, np.diag([2, 0.5, 1]) @ found.K)


def test_a_lens_with_distortion_needs_pycolmap(monkeypatch: pytest.MonkeyPatch) -> None:
    params = (50.0, 11.0, 7.5, 0.1)
    assert lens(1, "SIMPLE_RADIAL", 24, 16, params).model_name == "SIMPLE_RADIAL"
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert lens(1, "PINHOLE", 24, 16, (5.0, 5.0, 1.0, 1.0)).model_name == "PINHOLE"
    with pytest.raises(
        SceneError, match=r"not installed \(it has no wheel for Linux on ARM64\): build it, or undistort"
    ):
        lens(1, "SIMPLE_RADIAL", 24, 16, params)
