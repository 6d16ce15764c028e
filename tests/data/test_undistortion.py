from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from nsvq_lightning.data.colmap import SceneError, import_pycolmap
from nsvq_lightning.data.images import resized
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.data.undistortion import rectify

DISTORTED = {
    "SIMPLE_RADIAL": (300.0, 205.0, 148.0, -0.08),
    "RADIAL": (300.0, 205.0, 148.0, 0.05, -0.03),
    "OPENCV": (300.0, 310.0, 205.0, 148.0, -0.1, 0.03, 0.002, -0.003),
    "FULL_OPENCV": (300.0, 310.0, 205.0, 148.0, -0.1, 0.03, 0.002, -0.003, 0.01, 0.0, 0.02, 0.0),
    "OPENCV_FISHEYE": (300.0, 310.0, 205.0, 148.0, 0.02, -0.01, 0.003, 0.0),
    "SIMPLE_RADIAL_FISHEYE": (300.0, 205.0, 148.0, 0.02),
    "FOV": (300.0, 310.0, 205.0, 148.0, 0.4),
    "THIN_PRISM_FISHEYE": (300.0, 310.0, 205.0, 148.0, 0.02, -0.01, 0.002, -0.003, 0.0, 0.0, 0.001, 0.001),
}


def _camera(model: str, params: tuple[float, ...], width: int = 400, height: int = 300) -> object:
    return import_pycolmap().Camera(model=model, width=width, height=height, params=list(params), camera_id=7)


def _picture(width: int, height: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    small = rng.integers(0, 256, (height // 12, width // 12, 3), dtype=np.uint8)
    picture: np.ndarray = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return picture


@pytest.mark.parametrize("model", DISTORTED)
def test_camera_and_picture_agree_with_colmap(model: str) -> None:
    pycolmap = import_pycolmap()
    camera, image = _camera(model, DISTORTED[model]), _picture(400, 300)
    bitmap, ideal = pycolmap.undistort_image(  # oracle: COLMAP's own undistortion
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(image), camera
    )
    pinhole, undistortion = rectify(camera, 400, 300)
    assert undistortion is not None
    assert (pinhole.width, pinhole.height) == (ideal.width, ideal.height)
    np.testing.assert_array_equal(pinhole.K, ideal.calibration_matrix())
    expected = bitmap.to_array().astype(float)[2:-2, 2:-2]
    ours = undistortion(image)[0].astype(float)[2:-2, 2:-2]
    assert np.abs(ours - expected).mean() < 1.0  # grey levels; cubic against linear interpolation
    shifted = np.abs(ours[:, 1:] - expected[:, :-1]).mean()
    assert np.abs(ours - expected).mean() < 0.25 * shifted


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("OPENCV", DISTORTED["OPENCV"]),
        ("OPENCV_FISHEYE", DISTORTED["OPENCV_FISHEYE"]),
        ("OPENCV_FISHEYE", (300.0, 300.0, 200.0, 150.0, 0.0, 0.0, 0.0, 0.0)),  # no pinhole all the same
    ],
)
def test_no_blank_pixel_is_left(model: str, params: tuple[float, ...]) -> None:
    _, undistortion = rectify(_camera(model, params), 400, 300)
    assert undistortion is not None
    assert (undistortion(np.full((300, 400, 3), 200, np.uint8))[0] == 200).all()


@pytest.mark.parametrize("model", DISTORTED)
def test_a_photo_that_is_made_small_is_undistorted_afterwards(model: str) -> None:
    """Oracle: the other way round, which takes many times the memory of the result."""
    camera, image = _camera(model, DISTORTED[model]), _picture(1200, 900)
    kept = np.ones((900, 1200), bool)
    kept[:, 500:560] = False
    pinhole, undistortion = rectify(camera, 1200, 900)
    assert undistortion is not None
    small = pinhole.scaled(1 / 3, 1 / 3)
    expected, counted = resized(*undistortion(image, kept), (small.width, small.height))
    undistortion.scale_to(small)
    assert undistortion.size == (400, 300)
    found, counts = undistortion(*resized(image, kept, undistortion.size))
    assert found.shape == expected.shape
    assert counts is not None
    assert counted is not None
    assert (counts ^ counted).mean() < 0.01
    difference = np.abs(found.astype(int) - expected)[2:-2, 2:-2]
    assert difference.mean() < 1.5
    shifted = np.abs(found[:, 1:].astype(int) - expected[:, :-1])[2:-2, 2:-2]
    assert difference.mean() < 0.15 * shifted.mean()


@pytest.mark.parametrize(
    ("model", "params"), [("SIMPLE_PINHOLE", (300.0, 205.0, 148.0)), ("RADIAL", (300.0, 205.0, 148.0, 0.0, 0.0))]
)
def test_cameras_without_distortion_pass_straight_through(model: str, params: tuple[float, ...]) -> None:
    pinhole, undistortion = rectify(_camera(model, params), 400, 300)
    assert undistortion is None
    assert pinhole.K.tolist() == [[300, 0, 205], [0, 300, 148], [0, 0, 1]]
    assert (pinhole.width, pinhole.height) == (400, 300)


def test_files_of_half_the_models_size() -> None:
    # oracle: the picture undistorted at the model's size, then halved
    camera, image = _camera("OPENCV", DISTORTED["OPENCV"]), _picture(400, 300)
    full, undistort_full = rectify(camera, 400, 300)
    half, undistort_half = rectify(camera, 200, 150)
    assert undistort_full is not None
    assert undistort_half is not None
    np.testing.assert_allclose(half.K, full.scaled(0.5, 0.5).K)
    expected = cv2.resize(undistort_full(image)[0], (half.width, half.height), interpolation=cv2.INTER_AREA)
    ours = undistort_half(cv2.resize(image, (200, 150), interpolation=cv2.INTER_AREA))[0]
    assert np.abs(ours.astype(float) - expected).mean() < 1.5


def test_pixels_that_the_camera_never_saw_are_black_and_told_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, undistortion = rectify(_camera("OPENCV", DISTORTED["OPENCV"]), 400, 300, keep_maps=False)
    assert undistortion is not None
    pixels = undistortion._source_pixels()
    pixels[:4] = -5  # outside the file
    monkeypatch.setattr(undistortion, "_source_pixels", lambda: pixels)
    for _ in range(2):
        image, count = undistortion(np.full((300, 400, 3), 255, np.uint8))
        assert count is not None
        assert not count[:4].any()
        assert count[4:].all()
        assert np.array_equal(image, np.repeat(255 * count[..., None].astype(np.uint8), 3, 2))
    (message,) = caplog.messages
    assert "of the pinhole image is left out" in message


@pytest.mark.parametrize("focal", [300.0, 240.0])
def test_a_picture_is_shown_once_where_the_polynomial_turns_back(
    focal: float, caplog: pytest.LogCaptureFixture
) -> None:
    """r (1 + k r²) is largest at r² = -1 / 3k, and negative beyond r² = -1 / k."""
    pinhole, undistortion = rectify(_camera("SIMPLE_RADIAL", (focal, 200.0, 150.0, -0.35)), 400, 300)
    assert undistortion is not None
    count = undistortion(_picture(400, 300))[1]
    assert count is not None
    rows, columns = np.indices(count.shape) + 0.5
    radius = np.hypot((columns - pinhole.K[0, 2]) / pinhole.K[0, 0], (rows - pinhole.K[1, 2]) / pinhole.K[1, 1])
    turn = (1 / (3 * 0.35)) ** 0.5
    assert radius.max() > 1.3 * turn
    assert not count[radius > 1.02 * turn].any()
    assert count[radius < 0.98 * turn].all()
    assert "or for its lens polynomial" in caplog.text


def test_spherical_camera_is_refused() -> None:
    pycolmap = import_pycolmap()
    if "EQUIRECTANGULAR" not in pycolmap.CameraModelId.__members__:
        pytest.skip("this pycolmap has no spherical camera")
    camera = pycolmap.Camera.create_from_model_name(3, "EQUIRECTANGULAR", 100.0, 400, 200)
    with pytest.raises(SceneError, match=r"EQUIRECTANGULAR cannot be turned into a pinhole.*: cut the panoramas"):
        rectify(camera, 400, 200)


def test_raw_capture_becomes_the_undistorted_one(shared_scenes: Path) -> None:
    # oracle: the same photos undistorted and downscaled by another program (Lanczos, then JPEG quality 92)
    ready, raw = load_scene(shared_scenes / "fox"), load_scene(shared_scenes / "fox_raw")
    assert ready.names == raw.names
    assert len({id(source.undistortion) for source in raw.images.sources}) == 1  # that of their one camera
    assert ready.extent == pytest.approx(raw.extent, rel=1e-12)
    np.testing.assert_array_equal(ready.points.numpy(), raw.points.numpy())
    for i in (0, 31):
        expected, camera = ready.view(i).image.numpy().astype(float), raw.cameras[i]
        scale = np.array([448 / camera.width, 800 / camera.height])
        np.testing.assert_allclose(np.array(camera.intrinsics[:2]) * scale, ready.cameras[i].intrinsics[:2], rtol=1e-3)
        np.testing.assert_array_equal(camera.viewmat.numpy(), ready.cameras[i].viewmat.numpy())
        ours = cv2.resize(raw.view(i).image.numpy(), (448, 800), interpolation=cv2.INTER_AREA)
        assert 10 * np.log10(255**2 / np.square(ours - expected).mean()) > 40
