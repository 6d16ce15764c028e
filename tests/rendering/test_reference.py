"""Pieces of the oracle that others use, against independent programs."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nsvq_lightning.rendering.reference import rotation_matrices


def test_rotations_are_scipys() -> None:
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    oracle = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rotation_matrices(quats).numpy(), oracle, atol=1e-12)
    assert torch.equal(rotation_matrices(torch.zeros(1, 4)), torch.eye(3)[None])
