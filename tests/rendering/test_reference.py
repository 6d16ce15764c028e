"""Pieces of the oracle that others use, against independent programs."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from splat_scenes import front_camera, random_splats

from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.rendering.reference import rotation_matrices
from nsvq_lightning.splats.splats import Splats


def test_rotations_are_scipys() -> None:
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    oracle = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rotation_matrices(quats).numpy(), oracle, atol=1e-12)
    assert torch.equal(rotation_matrices(torch.zeros(1, 4)), torch.eye(3)[None])


def test_a_camera_that_an_evaluation_has_used_is_trained_with() -> None:
    splats = Splats.from_tensors(*random_splats(5))
    with torch.inference_mode():
        camera = Frame(unit=2.0).camera(front_camera())
        render(splats, camera, backend="reference")
    render(splats, camera, backend="reference").image.sum().backward()
    assert splats.means.grad is not None
