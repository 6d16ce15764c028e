from __future__ import annotations

import pickle
import struct
import threading
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch
from numpy.typing import NDArray
from PIL import ImageCms

from nsvq_lightning.data.colmap import Pinhole, SceneError
from nsvq_lightning.data.images import (
    ImageSource,
    ImageStore,
    Picture,
    edges_of,
    head_for,
    image_head,
    is_cut,
    read_image,
    read_mask,
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


def test_the_orientation_of_a_png_is_known(tmp_path: Path) -> None:
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    PIL.Image.fromarray(cv2.resize(RGB, (64, 48))).save(tmp_path / "turned.png", exif=exif)
    assert image_head(tmp_path / "turned.png")[:2] == ((64, 48), 6)
    assert head_for(tmp_path / "turned.png", (48, 64))[:2] == ((48, 64), 6)
    assert read_image(tmp_path / "turned.png").shape == (48, 64, 3)


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


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_colours_are_not_those_before_black(tmp_path: Path, suffix: str) -> None:
    """OpenCV multiplies the colours of TIFFs by their alpha."""
    path, alpha = tmp_path / f"x{suffix}", np.full((6, 9, 1), 200, np.uint8)
    PIL.Image.fromarray(np.concatenate([RGB, alpha], axis=2)).save(path)
    picture = ImageSource(path, (9, 6), None, Pinhole(np.eye(3), 9, 6), has_alpha=True).load()
    np.testing.assert_array_equal(picture.image, RGB)
    assert picture.mask is None or picture.mask.all()
    np.testing.assert_array_equal(read_image(path), RGB)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_colours_of_another_profile_become_those_of_srgb(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Here of a device whose red shines green, and whose green red."""
    caplog.set_level("INFO", logger="nsvq_lightning")
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    other = srgb.replace(b"rXYZ", b"tmp1").replace(b"gXYZ", b"rXYZ").replace(b"tmp1", b"gXYZ")
    other = other.replace("sRGB".encode("utf-16-be"), suffix.encode("utf-16-be"))
    pixels = np.full((6, 9, 3), (200, 60, 90), np.uint8)
    seen = []
    for number, profile in enumerate((None, srgb, other, b"damaged")):
        path = tmp_path / f"{number}{suffix}"
        PIL.Image.fromarray(pixels).save(path, quality=100, icc_profile=profile)
        picture = ImageSource(path, (9, 6), None, Pinhole(np.eye(3), 9, 6)).load()
        seen.append(picture.image[3, 4].tolist())
    assert seen[0] == seen[1] == seen[3]
    assert seen[2] == pytest.approx([seen[0][1], seen[0][0], seen[0][2]], abs=3)
    assert caplog.text.count(f"in the colours of {suffix} built-in, and are turned into those of sRGB") == 1


@pytest.mark.parametrize(("mode", "suffix"), [("LA", ".png"), ("LA", ".tif"), ("L", ".png")])
def test_grey_photos_may_be_transparent(tmp_path: Path, mode: str, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    if mode == "L":
        PIL.Image.fromarray(GREY).save(path, transparency=int(GREY[2, 3]))
        clear = GREY[2, 3] == GREY
    else:
        clear = np.arange(54).reshape(6, 9) % 5 == 0
        PIL.Image.fromarray(np.dstack([GREY, np.where(clear, 0, 255).astype(np.uint8)]), "LA").save(path)
    assert image_head(path).has_alpha
    picture = ImageSource(path, (9, 6), None, Pinhole(np.eye(3), 9, 6), has_alpha=True).load()
    assert picture.mask is not None
    np.testing.assert_array_equal(picture.mask, ~clear)
    np.testing.assert_array_equal(picture.image, np.repeat((GREY * ~clear)[..., None], 3, axis=2))


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


def test_pointers_of_git_lfs_are_told(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    with pytest.raises(SceneError, match=r"1\.jpg cannot be decoded \(a pointer of Git LFS, .*'git lfs pull'"):
        read_image(tmp_path / "1.jpg")
    with pytest.raises(SceneError, match=r"2\.jpg cannot be read any more"):
        read_image(tmp_path / "2.jpg")


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
        read_mask(tmp_path / "deep.tiff", (9, 6))


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
        PIL.Image.fromarray(np.dstack([GREY, GREY, GREY, np.arange(202, 256, dtype=np.uint8).reshape(6, 9)])),
        PIL.Image.fromarray(LABELS.astype(np.uint8)),
        PIL.Image.fromarray(LABELS.astype(np.uint16)),
        PIL.Image.fromarray(np.maximum(RGB, 40) * KEPT[..., None].astype(np.uint8)),
    ],
)
def test_masks_of_any_kind(tmp_path: Path, picture: PIL.Image.Image) -> None:
    picture.save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", (9, 6)), KEPT)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((194, 130), True), ((25, 16), True), ((24, 16), True), ((97, 65), True), ((130, 194), False), ((25, 25), False)],
)
def test_shapes_are_compared_up_to_a_pixel(size: tuple[int, int], expected: bool) -> None:
    assert same_shape(size, (194, 130)) is expected
    assert same_shape((99, 100), (100, 99)) is False
    assert is_cut(size, (194, 130)) is not expected


def test_sizes_that_differ_little_were_cut() -> None:
    assert is_cut((371, 278), (400, 300))
    assert not is_cut((200, 150), (400, 300))
    assert not is_cut((398, 299), (400, 300))
    assert same_shape((371, 278), (400, 300))  # of a mask, or a photo on its side


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


def test_masks_that_are_held_are_boolean() -> None:
    image = torch.zeros(2, 3, 3, dtype=torch.uint8)
    held = [Picture(image, None), Picture(image, torch.ones(2, 3, dtype=torch.bool))]
    assert ImageStore((), held=held)[1].image is image
    with pytest.raises(ValueError, match=r"masks must be bool, got torch\.uint8"):
        ImageStore((), held=[Picture(image, torch.full((2, 3), 255, dtype=torch.uint8))])


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


def test_strength_is_what_a_pixel_has_above_its_neighbours() -> None:
    image = torch.randint(0, 256, (20, 30, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    grey = np.pad(cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY).astype(np.int64), 1, mode="reflect")
    around = sum(np.roll(grey, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1))
    passed = torch.from_numpy((9 * grey - around)[1:-1, 1:-1].clip(0, 255)).float()
    expected = (passed - passed.min()) / (passed.max() - passed.min())
    torch.testing.assert_close(edges_of(image).strength(), expected)


def test_edges_of_masks_do_not_count() -> None:
    kept = torch.zeros(32, 40, dtype=torch.bool)
    kept[:, 9:] = True
    image = torch.full((32, 40, 3), 90, dtype=torch.uint8)
    image[~kept] = 0
    assert edges_of(image).strength().max() == 1
    assert edges_of(image, kept).strength().max() == 0


@pytest.mark.parametrize("room", [0, 1, 9])
def test_edges_are_found_once_while_there_is_room_beside_the_photos(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    photos = load_scene(demo_scene).images.nbytes
    scene = load_scene(demo_scene, cache_bytes=photos + room * photos // 27)  # a byte a pixel, nine photos
    calls: list[int] = []
    monkeypatch.setattr("nsvq_lightning.data.images.edges_of", lambda *pair: calls.append(1) or edges_of(*pair))
    found = [[scene.images.edges(index) for index in range(len(scene))] for _ in range(2)]
    assert len(calls) == 2 * len(scene) - room
    for index, (first, second) in enumerate(zip(*found, strict=True)):
        assert torch.equal(first.values, second.values)
        assert torch.equal(first.strength(), edges_of(*scene.images[index]).strength())
