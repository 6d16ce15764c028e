from __future__ import annotations

import pickle
import struct
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch
from numpy.typing import NDArray

from nsvq_lightning.data.colmap import SceneError, import_pycolmap
from nsvq_lightning.data.images import (
    ImageSource,
    ImageStore,
    Picture,
    Pinhole,
    image_head,
    read_image,
    read_mask,
    rectify,
    same_shape,
)
from nsvq_lightning.data.scene import load_scene

RGB = np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8)


def test_colour_picture_is_rgb(tmp_path: Path) -> None:
    path = tmp_path / "müller 1.png"  # a name outside ASCII
    PIL.Image.fromarray(RGB).save(path)  # oracle: Pillow
    np.testing.assert_array_equal(read_image(path), RGB)
    assert image_head(path).size == (9, 6)


def test_grey_alpha_palette_and_16_bit_pictures(tmp_path: Path) -> None:
    grey = RGB[..., 0]
    PIL.Image.fromarray(grey).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png"), np.repeat(grey[..., None], 3, 2))
    PIL.Image.fromarray(np.dstack([RGB, grey])).save(tmp_path / "alpha.png")
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), RGB)
    palette = PIL.Image.fromarray(RGB).quantize(8)
    palette.save(tmp_path / "palette.png")
    np.testing.assert_array_equal(read_image(tmp_path / "palette.png"), np.array(palette.convert("RGB")))
    deep = RGB.astype(np.uint16) * 257  # 0..65535, exactly representable in 8 bit
    deep[0, 0] = (127, 129, 65535)  # rounds to 0, 1 and 255
    assert cv2.imwrite(str(tmp_path / "deep.png"), deep[..., ::-1])
    expected = RGB.copy()
    expected[0, 0] = (0, 1, 255)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), expected)


def test_exif_orientation_is_ignored_as_colmap_does(tmp_path: Path) -> None:
    exif = PIL.Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees
    picture = PIL.Image.fromarray(cv2.resize(RGB, (64, 48)))
    picture.save(tmp_path / "turned.jpg", quality=95, exif=exif)
    assert image_head(tmp_path / "turned.jpg").size == (64, 48)
    assert read_image(tmp_path / "turned.jpg").shape == (48, 64, 3)


def _tiff(picture: NDArray[np.uint8], orientation: int, order: str) -> bytes:
    """A plain RGB TIFF, written here as no library at hand writes both byte orders."""
    height, width, _ = picture.shape
    shorts = {256: width, 257: height, 258: 8, 259: 1, 262: 2, 274: orientation, 277: 3, 278: height}
    entries = [(tag, 3, struct.pack(f"{order}HH", value, 0)) for tag, value in shorts.items()]
    start = 8 + 2 + 12 * (len(entries) + 2) + 4
    entries += [(273, 4, struct.pack(f"{order}I", start)), (279, 4, struct.pack(f"{order}I", picture.nbytes))]
    table = b"".join(struct.pack(f"{order}HHI", tag, kind, 1) + value for tag, kind, value in sorted(entries))
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(entries))
    return head + table + struct.pack(f"{order}I", 0) + picture.tobytes()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", "<>")
def test_the_orientation_of_a_tiff_is_ignored_too(tmp_path: Path, orientation: int, order: str) -> None:
    """OpenCV and Pillow turn TIFFs unless they are kept from it."""
    path, picture = tmp_path / "x.tif", cv2.resize(RGB, (64, 48))
    path.write_bytes(_tiff(picture, orientation, order))
    assert image_head(path).size == (64, 48)
    np.testing.assert_array_equal(read_image(path), picture)


def test_a_picture_may_have_the_pixels_of_a_phone(tmp_path: Path) -> None:
    PIL.Image.new("1", (16_320, 12_240)).save(tmp_path / "x.png")
    assert image_head(tmp_path / "x.png").size == (16_320, 12_240)


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.9])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_damaged_pictures_are_named(tmp_path: Path, suffix: str, kept: float) -> None:
    path = tmp_path / f"broken{suffix}"
    PIL.Image.fromarray(cv2.resize(RGB, (200, 150))).save(path)
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(SceneError, match=rf"broken\{suffix} cannot be decoded"):
        read_image(path)


def test_the_end_of_a_thumbnail_is_not_that_of_the_picture(tmp_path: Path) -> None:
    path = tmp_path / "broken.jpg"
    PIL.Image.fromarray(cv2.resize(RGB, (200, 150))).save(
        path, exif=b"Exif\0\0II*\0\x08\0\0\0\0\0\0\0\0\0\xff\xda \xff\xd9"
    )
    assert read_image(path).shape == (150, 200, 3)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SceneError, match=r"broken\.jpg cannot be decoded \(truncated"):
        read_image(path)


def _png(width: int, height: int, data: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [30_000, 1 << 20])
def test_a_head_that_promises_more_than_the_file_holds(tmp_path: Path, side: int) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(_png(side, side, zlib.compress(b"\0" * 1000)))
    for read in (image_head, read_image):
        with pytest.raises(SceneError, match=r"bomb\.png cannot be decoded"):
            read(path)


def test_a_chunk_longer_than_the_file_is_not_allocated(tmp_path: Path) -> None:
    path = tmp_path / "long.png"
    whole = _png(3, 2, zlib.compress(b"\0" * 20))
    path.write_bytes(whole)
    assert read_image(path).shape == (2, 3, 3)
    place = whole.index(b"IDAT") - 4
    path.write_bytes(whole[:place] + struct.pack(">I", 0x7FFFFF00) + whole[place + 4 :])
    assert image_head(path).size == (3, 2)
    started = time.process_time()  # OpenCV fills 2 GB with zeros before it finds the end of the file
    with pytest.raises(SceneError, match=r"long\.png cannot be decoded \(truncated"):
        read_image(path)
    assert time.process_time() - started < 0.2


def test_floating_point_pictures_are_refused(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "deep.tiff"), RGB[..., 0].astype(np.float32))
    with pytest.raises(SceneError, match="float32"):
        read_mask(tmp_path / "deep.tiff", 9, 6)


KEPT = np.arange(9) >= np.full((6, 1), 4)
GREY = np.uint8(255) * KEPT
LABELS = np.array([0, 1, 2, 3, 4, 5])[:, None] * KEPT + KEPT
PALETTE = [0, 0, 0, 64, 0, 0, 0, 64, 0, 0, 0, 128, 128, 128, 0, 192, 128, 0, 224, 224, 224]


def _palette(indices: np.ndarray, colours: list[int]) -> PIL.Image.Image:
    picture = PIL.Image.fromarray(indices.astype(np.uint8))
    picture.putpalette(colours)
    return picture


@pytest.mark.parametrize(
    "picture",
    [
        PIL.Image.fromarray(GREY).convert("1"),
        PIL.Image.fromarray(np.uint16(1) * KEPT),
        PIL.Image.fromarray(np.uint16(65535) * KEPT),
        _palette(KEPT, [0, 0, 0, 255, 255, 255]),
        _palette(~KEPT, [255, 255, 255, 0, 0, 0]),
        _palette(KEPT, [0, 0, 0, 128, 0, 0]),
        _palette(LABELS, PALETTE),
        PIL.Image.fromarray(np.dstack([np.full((6, 9, 3), 255, np.uint8), GREY])),
        PIL.Image.fromarray(np.dstack([RGB, GREY])),
        PIL.Image.fromarray(np.dstack([np.full((6, 9), 255, np.uint8), GREY]), "LA"),
        PIL.Image.fromarray(np.dstack([GREY, GREY, GREY, np.full((6, 9), 255, np.uint8)])),
        PIL.Image.fromarray(np.maximum(RGB, 40) * KEPT[..., None].astype(np.uint8)),
    ],
)
def test_masks_of_any_kind(tmp_path: Path, picture: PIL.Image.Image) -> None:
    picture.save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", 9, 6), KEPT)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((194, 130), True), ((25, 16), True), ((24, 16), True), ((97, 65), True), ((130, 194), False), ((25, 25), False)],
)
def test_shapes_are_compared_up_to_a_pixel(size: tuple[int, int], expected: bool) -> None:
    assert same_shape(size, (194, 130)) is expected
    assert same_shape((99, 100), (100, 99)) is False


def test_downscaling_averages_areas(tmp_path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    PIL.Image.fromarray(image).save(tmp_path / "a.png")
    source = ImageSource(tmp_path / "a.png", (12, 8), None, Pinhole(np.eye(3), 6, 4))
    expected = image.reshape(4, 2, 6, 2, 3).astype(float).mean(axis=(1, 3))
    assert np.abs(source.load().image.numpy() - expected).max() <= 0.5
    assert source.nbytes == source.load().nbytes


def test_pictures_of_their_own_size_and_of_another_than_when_they_were_loaded(tmp_path: Path) -> None:
    PIL.Image.fromarray(RGB).save(tmp_path / "a.png")
    source = ImageSource(tmp_path / "a.png", (9, 6), None, Pinhole(np.eye(3), 9, 6))
    np.testing.assert_array_equal(source.load().image.numpy(), RGB)
    with pytest.raises(SceneError, match="decoded to 9x6, its head says 10x6"):
        ImageSource(tmp_path / "a.png", (10, 6), None, Pinhole(np.eye(3), 10, 6)).load()


class _Counting(ImageSource):
    """A source that remembers on which threads it was decoded."""

    threads: list[str]

    def load(self) -> Picture:
        self.threads.append(threading.current_thread().name)
        return super().load()


@pytest.fixture
def sources(tmp_path: Path) -> list[_Counting]:
    made = []
    for i in range(4):
        path = tmp_path / f"{i}.png"
        PIL.Image.fromarray(np.full((2, 3, 3), i, np.uint8)).save(path)
        source = _Counting(path, (3, 2), None, Pinhole(np.eye(3), 3, 2))
        object.__setattr__(source, "threads", [])
        made.append(source)
    return made


@pytest.mark.parametrize(
    ("budget", "decodings"),
    [(0, [3, 3, 3, 3]), (17, [3, 3, 3, 3]), (36, [1, 1, 3, 3]), (71, [1, 1, 1, 3]), (72, [1, 1, 1, 1])],
)
def test_budget_keeps_what_fits(sources: list[_Counting], budget: int, decodings: list[int]) -> None:
    store = ImageStore(sources, cache_bytes=budget)  # 18 bytes a picture
    for _ in range(3):
        for i in range(4):
            assert set(store[i].image.flatten().tolist()) == {i}
    assert [len(source.threads) for source in sources] == decodings


def test_prefetched_pictures_are_decoded_once_and_elsewhere(sources: list[_Counting]) -> None:
    store = ImageStore(sources, cache_bytes=0)
    store.prefetch(2)
    store.prefetch(2)
    assert set(store[2].image.flatten().tolist()) == {2}
    assert sources[2].threads == ["nsvq-image_0"]
    for i in range(4):  # announced and never fetched: few are held
        store.prefetch(i)
    assert len(store._coming) <= 2


def test_errors_surface_when_a_picture_is_asked_for(sources: list[_Counting]) -> None:
    with pytest.raises(ValueError, match="cache_bytes must be at least 0, got -1"):
        ImageStore(sources, cache_bytes=-1)
    store = ImageStore(sources)
    sources[1].path.write_bytes(b"gone")
    store.prefetch(1)
    with pytest.raises(SceneError, match=r"1\.png cannot be decoded"):
        store[1]


def test_store_survives_pickling_with_a_prefetch_under_way(sources: list[_Counting]) -> None:
    store = ImageStore([ImageSource(s.path, s.size, None, s.pinhole) for s in sources])
    store.prefetch(1)
    torch.testing.assert_close(pickle.loads(pickle.dumps(store))[1].image, store[1].image)


SceneFactory = Callable[..., Path]

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
    np.testing.assert_allclose(half.K, full.resized(half.width, half.height).K)
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
