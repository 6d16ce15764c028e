"""A camera is packed once, when it is made, wherever that is."""

from typing import Any

import numpy as np
import pytest
import torch

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.splats.splats import Splats

K = torch.tensor([[40.0, 0.0, 20.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_camera_made_without_version_counters_renders_the_same(backend: str) -> None:
    points = torch.tensor([[0.0, 0.0, 3.0], [0.5, 0.2, 4.0], [-0.4, 0.3, 5.0], [0.1, -0.4, 3.5]])
    splats = Splats.from_points(points, torch.rand(4, 3, generator=torch.Generator().manual_seed(0)))
    expected = render(splats, Camera(K, torch.eye(4), 40, 30), backend=backend).image.detach()
    with torch.inference_mode():
        camera = Camera(K.clone(), torch.eye(4), 40, 30)
        assert camera.viewmat.is_inference()
        assert torch.equal(render(splats, camera, backend=backend).image, expected)
        assert len(visible(splats, camera, backend=backend)) == 4


def test_a_moved_camera_keeps_its_numbers() -> None:
    camera = Camera(K, torch.eye(4), 40, 30)
    assert camera.to("cpu", torch.float32) is camera
    wide = camera.to(dtype=torch.float64)
    assert wide.K.dtype == wide.viewmat.dtype == torch.float64
    assert (wide.packed_view, wide.intrinsics) == (camera.packed_view, camera.intrinsics)
    assert camera.K.dtype == torch.float32


@pytest.mark.parametrize("kind", [torch.Tensor.clone, torch.Tensor.numpy])
def test_a_camera_keeps_its_place_when_the_callers_matrix_is_filled_anew(kind: Any) -> None:
    pose = torch.eye(4)
    camera = Camera(K, kind(pose), 40, 30)
    given = Camera(K, pose, 40, 30)
    pose[2, 3] = 7.0
    assert given.viewmat[2, 3] == camera.viewmat[2, 3] == 0 == given.position.abs().max()


@pytest.mark.parametrize(("matrix", "pose"), [(K.numpy(), np.eye(4)), (K.tolist(), np.eye(4).tolist())])
def test_arrays_and_lists_are_cameras_as_tensors_are(matrix: Any, pose: Any) -> None:
    camera = Camera(matrix, pose, 40, 30)
    assert camera.packed_view == Camera(K, torch.eye(4), 40, 30).packed_view
    assert torch.equal(camera.to("cpu", torch.float32).K, K)


def test_sizes_are_whole_numbers_of_any_kind() -> None:
    assert Camera(K, torch.eye(4), np.int64(40), np.int32(30)).size == (40, 30)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"whole numbers of pixels, at least one, got 40\.0x30"):
        Camera(K, torch.eye(4), 40.0, 30)  # type: ignore[arg-type]


def test_a_pose_that_asks_for_a_gradient_is_refused() -> None:
    """It would get none, without a word."""
    with pytest.raises(ValueError, match=r"Camera\.viewmat must be detached, of shape \[4, 4\]"):
        Camera(K, torch.eye(4).requires_grad_(), 40, 30)
