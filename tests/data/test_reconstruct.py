from __future__ import annotations

import os
import re
import sqlite3
import struct
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import PIL.ImageCms
import pytest
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from nsvq_lightning.data import reconstruct
from nsvq_lightning.data.colmap import SceneError, import_pycolmap
from nsvq_lightning.data.images import ImageHead, image_head, read_image
from nsvq_lightning.data.reconstruct import copy_photos, oddities, photos_in, sharpness, some, stamps_in, write_frames
from nsvq_lightning.io.errors import FormatError


def _texture(shift: int = 0) -> np.ndarray[Any, Any]:
    noise = np.random.default_rng(4).integers(0, 255, (24, 48, 3), dtype=np.uint8)
    return np.roll(cv2.resize(noise, (192, 96), interpolation=cv2.INTER_NEAREST), shift, axis=1)


def _silent(step: str, done: int, total: int) -> None:
    pass


def _copied(source: Path, target: Path) -> list[str]:
    """The names of the copies of all photos; none is left out."""
    photos, left = photos_in(source)
    names, closed = copy_photos(photos, source, target, _silent)
    assert not left
    assert not closed
    return names


def _video(path: Path, pictures: list[np.ndarray[Any, Any]]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 24, (192, 96))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path: Path) -> None:
    sharp = {2, 11, 17, 20}
    pictures = [_texture(9 * k) if k in sharp else cv2.GaussianBlur(_texture(9 * k), None, 3) for k in range(24)]
    seen: list[tuple[int, int]] = []
    video = _video(tmp_path / "a.mp4", pictures)
    found = write_frames(video, tmp_path, 4, lambda _, done, total: seen.append((done, total)))
    assert found == [f"frame_{k:06d}.jpg" for k in sorted(sharp)]
    assert seen == [(k, 24) for k in range(1, 25)]
    for name, index in zip(found, sorted(sharp), strict=True):
        difference = read_image(tmp_path / name)[:, :, ::-1].astype(int) - pictures[index]
        assert np.abs(difference).mean() < 30  # chroma has half the resolution


@pytest.mark.parametrize(("shifts", "parts", "frames"), [([0] * 12 + [40] * 6 + [80] * 6, 8, 3), ([0, 30, 60], 100, 3)])
def test_still_parts_are_left_out_and_short_videos_give_what_they_have(
    tmp_path: Path, shifts: list[int], parts: int, frames: int
) -> None:
    video = _video(tmp_path / "a.mp4", [_texture(shift) for shift in shifts])
    assert len(write_frames(video, tmp_path, parts, _silent)) == frames


def test_a_video_that_was_cut_short_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    video = _video(tmp_path / "a.avi", [_texture(20 * k) for k in range(24)])
    for parts in (1, 4, 24):
        assert len(write_frames(video, tmp_path, parts, _silent)) == parts
    assert not caplog.messages
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    assert 1 < len(write_frames(video, tmp_path, 12, _silent)) < 9
    assert re.search(r"a\.avi ends near frame 1?\d of 24: copy it again", caplog.text)


def test_what_is_no_video_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"nothing")
    with pytest.raises(SceneError, match=r"a\.mp4: no frame can be read; convert it"):
        write_frames(tmp_path / "a.mp4", tmp_path, 10, _silent)


def test_frames_that_cannot_be_decoded_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of AV1: OpenCV counts them, and reads none."""
    video = _video(tmp_path / "a.mp4", [_texture(20 * k) for k in range(12)])
    monkeypatch.setattr(cv2.VideoCapture, "read", lambda _: (False, None), raising=False)
    with pytest.raises(SceneError, match=r"a\.mp4: no frame can be read; convert it"):
        write_frames(video, tmp_path, 4, _silent)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    (tmp_path / "from").mkdir()
    (tmp_path / "to").mkdir()
    return tmp_path / "from", tmp_path / "to"


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_photos_are_turned_upright(folders: tuple[Path, Path], orientation: int, suffix: str) -> None:
    upright = np.zeros((32, 64, 3), np.uint8)
    upright[:, :32, 0] = 255  # red on the left
    turns = {1: 0, 3: 2, 6: 1, 8: 3}[orientation]
    stored = np.rot90(upright, turns)  # the tag says how to turn it back
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    exif[0x010F] = "maker"
    source, target = folders
    PIL.Image.fromarray(np.ascontiguousarray(stored)).save(source / f"a.{suffix}", quality=95, exif=exif)
    (name,) = _copied(source, target)
    assert image_head(target / name).size == (64, 32)
    assert np.abs(read_image(target / name).astype(int) - upright).mean() < 5
    with PIL.Image.open(target / name) as image:
        assert image.getexif().get(0x0112, 1) == 1
        assert image.getexif().get(0x010F, "maker") == "maker"  # Pillow loses the tags of a TIFF that it turns
    if suffix != "webp":
        as_it_was = (target / name).read_bytes() == (source / f"a.{suffix}").read_bytes()
        assert as_it_was == (orientation == 1)


def _tag(number: int, kind: int, count: int, value: bytes) -> bytes:
    return struct.pack(">HHI4s", number, kind, count, value)


# A unit and a resolution as text, which Pillow cannot write; an entry of the camera that leads nowhere.
ODD = {
    "unit": [_tag(0x0112, 3, 1, b"\0\6"), _tag(0x0128, 2, 2, b"2")],
    "resolution": [_tag(0x0112, 3, 1, b"\0\6"), _tag(0x011A, 2, 3, b"72")],
    "nowhere": [_tag(0x0112, 3, 1, b"\0\6"), _tag(0x8769, 4, 1, b"\0\1")],
}


@pytest.mark.parametrize("name", [*ODD, "none"])
def test_photos_with_odd_tags_are_copied(folders: tuple[Path, Path], name: str) -> None:
    tags = ODD.get(name, [])
    head = b"MM\0*\0\0\0\x08" + struct.pack(">H", len(tags)) + b"".join(tags) + bytes(4)
    source, target = folders
    PIL.Image.fromarray(_texture()).save(source / "a.jpg", exif=b"Exif\0\0" + (head if tags else b"garbage!"))
    assert _copied(source, target) == ["a.jpg"]
    assert image_head(target / "a.jpg").size == ((96, 192) if tags else (192, 96))
    assert [reconstruct._lens_of(folder / "a.jpg") for folder in folders] == ["[None, None, None]"] * 2


def _written(path: Path) -> np.ndarray[Any, Any]:
    """Write a photo in the format that its name says; returns its pixels."""
    pixels = cv2.resize(_texture(), (96, 48), interpolation=cv2.INTER_AREA)
    pixels = cv2.GaussianBlur(pixels, None, 3)
    if path.stem == "deep":
        pixels = np.repeat(pixels[..., :1], 3, axis=2)
        cv2.imwrite(str(path), pixels[..., 0].astype(np.uint16) * 257)
    elif path.stem == "clear":
        image = PIL.Image.fromarray(pixels).convert("RGBA")
        image.putpixel((0, 0), (0, 0, 0, 100))
        image.save(path, quality=95)
    elif path.stem == "misnamed":
        PIL.Image.fromarray(pixels).save(path, "WEBP", quality=95)
    elif path.stem == "grey":
        pixels = np.repeat(pixels[..., :1], 3, axis=2)
        PIL.Image.fromarray(pixels[..., 0]).save(path, quality=95)
    elif path.stem == "print":
        PIL.Image.fromarray(pixels).convert("CMYK").save(path, quality=95)
    else:
        PIL.Image.fromarray(pixels).save(path, "JPEG" if path.suffix == ".jfif" else None, quality=95)
    return pixels


@pytest.mark.parametrize(
    ("name", "copy"),
    [
        ("a.WEBP", "a.jpg"),
        ("a.avif", "a.jpg"),
        ("a.gif", "a.jpg"),
        ("a.jp2", "a.jpg"),
        ("a.jfif", "a.jpg"),
        ("misnamed.jpg", "misnamed.jpg"),
        ("clear.webp", "clear.png"),
        ("deep.png", "deep.png"),
        ("deep.tif", "deep.png"),
        ("a.bmp", "a.bmp"),
        ("print.jpg", "print.jpg"),
        ("grey.PNG", "grey.PNG"),
        ("grey.jpg", "grey.jpg"),
        ("ein Bild ü.JPEG", "ein Bild ü.JPEG"),
    ],
)
def test_what_is_copied_can_be_read_by_colmap(folders: tuple[Path, Path], name: str, copy: str) -> None:
    """The pixels as written are the oracle, of COLMAP's reader and of ours."""
    source, target = folders
    try:
        pixels = _written(source / name).astype(int)
    except (KeyError, ValueError):
        pytest.skip("this Pillow does not write it")
    assert _copied(source, target) == [copy]
    seen = import_pycolmap().Bitmap.read(target / copy, True).to_array()[..., :3]
    assert np.abs(seen.astype(int) - pixels).mean() < 4
    assert np.abs(read_image(target / copy).astype(int) - pixels).mean() < 4
    assert image_head(target / copy).has_alpha == name.startswith("clear")


def test_damaged_photos_are_named_and_left_out(folders: tuple[Path, Path]) -> None:
    source, target = folders
    PIL.Image.fromarray(_texture()).save(source / "a.png")
    (source / "b.jpg").write_bytes((source / "a.png").read_bytes()[:200])
    (source / "notes.txt").write_text("no photo")
    PIL.Image.fromarray(_texture().astype(np.float32)[..., 0]).save(source / "depth.tif")
    PIL.Image.fromarray(_texture()).save(source / "preview.dng", "TIFF")
    steps: list[int] = []
    names, left = copy_photos(photos_in(source)[0], source, target, lambda _, done, total: steps.append(done))
    assert names == ["a.png"]
    reasons = {name: reason for reason, files in left.items() for name in files}
    assert set(reasons) == {"b.jpg", "depth.tif", "preview.dng"}
    assert "convert to JPEG" in reasons["preview.dng"]
    assert [each.name for each in target.iterdir()] == ["a.png"]
    assert steps == [1, 2, 3, 4]


def test_copies_follow_their_photos(folders: tuple[Path, Path]) -> None:
    source, target = folders
    for name in ("same.webp", "other.png"):
        PIL.Image.fromarray(_texture()).save(source / name)
    names = _copied(source, target)
    assert names == ["other.png", "same.jpg"]
    before = (target / "same.jpg").stat().st_ino
    PIL.Image.fromarray(_texture(40)).save(source / "other.png")
    assert _copied(source, target) == names
    os.utime(source / "other.png", ns=(0, 0))
    assert _copied(source, target) == names
    PIL.Image.fromarray(_texture(50)).save(source / "other.png", compress_level=1)
    os.utime(source / "other.png", ns=(0, 0))  # as programs do that keep times
    (target / "other.png").chmod(0o600)  # after it: where changes have no time, as on Windows, the size tells
    assert _copied(source, target) == names
    assert np.array_equal(read_image(target / "other.png"), _texture(50))
    PIL.Image.fromarray(_texture(40)).save(source / "other.png")
    assert _copied(source, target) == names
    assert (target / "same.jpg").stat().st_ino == before  # a copy has a new one
    assert np.array_equal(read_image(target / "other.png"), _texture(40))


def test_photos_in_their_place_are_only_added_to(tmp_path: Path) -> None:
    for name in ("deep.png", "a.webp"):
        _written(tmp_path / name)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert _copied(tmp_path, tmp_path) == ["a.jpg", "deep.png"]
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    photos, left = photos_in(tmp_path)
    assert copy_photos(photos, tmp_path, tmp_path, _silent)[0] == ["a.jpg", "deep.png"]
    assert list(left.values()) == [["a.webp"]]
    _written(tmp_path / "misnamed.jpg")
    _, closed = copy_photos(photos_in(tmp_path)[0], tmp_path, tmp_path, _silent)
    assert closed == {"cannot be read (it is of another format than its name says: rename it)": ["misnamed.jpg"]}
    _touch(tmp_path, "x.jpg", "y.jpg")
    _, closed = copy_photos(photos_in(tmp_path)[0], tmp_path, tmp_path, _silent)
    assert closed["cannot be read (cannot identify image file)"] == ["x.jpg", "y.jpg"]


def _touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


def _names_in(folder: Path) -> tuple[list[str], dict[str, list[str]]]:
    photos, left = photos_in(folder)
    return [path.relative_to(folder).as_posix() for path in photos], left


def test_photos_that_are_turned_keep_their_colours(tmp_path: Path) -> None:
    """Those of a profile are no longer the pixels' where these are converted to RGB."""
    profile = PIL.ImageCms.ImageCmsProfile(PIL.ImageCms.createProfile("sRGB")).tobytes()
    (source := tmp_path / "source").mkdir()
    tags = PIL.Image.Exif()
    tags[274] = 6
    for mode in ("RGB", "CMYK"):
        PIL.Image.new(mode, (8, 6)).save(source / f"{mode}.jpg", exif=tags, icc_profile=profile)
    names, _ = copy_photos(photos_in(source)[0], source, tmp_path / "photos", _silent)
    found = {}
    for name in names:
        with PIL.Image.open(tmp_path / "photos" / name) as photo:
            found[name] = (photo.size, photo.mode, photo.info.get("icc_profile"))
    assert found == {"CMYK.jpg": ((6, 8), "RGB", None), "RGB.jpg": ((6, 8), "RGB", profile)}


def test_of_files_of_one_name_one_is_taken(tmp_path: Path) -> None:
    _touch(
        tmp_path, "1.HEIC", "1.jpg", "2.dng", "2.JPG", "3.CR2", "3.heic", "4.png", "4.jpeg", "img_5.heic", "IMG_5.JPG"
    )
    names, left = _names_in(tmp_path)
    assert names == ["1.jpg", "2.JPG", "3.heic", "4.jpeg", "IMG_5.JPG"]
    assert left == {"another file of that name is taken": ["4.png", "1.HEIC", "img_5.heic", "2.dng", "3.CR2"]}


def test_photos_of_folders_keep_apart(tmp_path: Path) -> None:
    _touch(tmp_path, "left/1.jpg", "right/1.jpg", "right/far/1.jpg", "masks/1.png", ".trash/1.jpg", "left/._1.jpg")
    _touch(tmp_path, "made/prepare.json", "made/images/1.jpg", "images_4/1.jpg")
    names, left = _names_in(tmp_path)
    assert names == ["left/1.jpg", "right/1.jpg", "right/far/1.jpg"]
    assert {name for files in left.values() for name in files} == {".trash/1.jpg", "images_4/1.jpg", "masks/1.png"}
    _touch(tmp_path, "1.jpg")
    names, left = _names_in(tmp_path)
    assert names == ["1.jpg"]
    assert sum(map(len, left.values())) == 6


def test_masks_of_colmap_and_realityscan_are_no_photos(tmp_path: Path) -> None:
    _touch(tmp_path, "1.jpg", "1.jpg.png", "2.jpg", "2.jpg.mask.png", "3.jpg.jpg")
    found, left = photos_in(tmp_path)
    assert [path.name for path in found] == ["1.jpg", "2.jpg", "3.jpg.jpg"]
    assert sum(map(len, left.values())) == 2


def test_what_apps_export_beside_photos_is_left_out(tmp_path: Path) -> None:
    keyframes = [f"keyframes/{folder}/17.{kind}" for folder, kind in (("images", "jpg"), ("corrected_images", "jpg"))]
    _touch(tmp_path / "polycam", "thumbnail.jpg", *keyframes, "keyframes/confidence/17.png", "keyframes/depth/17.png")
    assert _names_in(tmp_path / "polycam")[0] == keyframes[:1]
    _touch(tmp_path / "scans", "frame_00001.jpg", "thumb_00001.jpg", "conf_00001.png", "depth_00001.png", "1_depth.png")
    names, left = _names_in(tmp_path / "scans")
    assert names == ["frame_00001.jpg"]
    assert list(left) == ["no photos by their names, or that of their folder"]
    _touch(tmp_path / "nerfies", "rgb/1x/1.png", "rgb/2x/1.png", "rgb/4x/1.png")
    assert _names_in(tmp_path / "nerfies")[0] == ["rgb/1x/1.png"]
    _touch(tmp_path / "lego", "train/r_0.png", "test/r_0.png", "test/r_0_depth_0001.png", "test/r_0_normal_0001.png")
    assert _names_in(tmp_path / "lego")[0] == ["test/r_0.png", "train/r_0.png"]
    others = ("dense/0/images/1.jpg", "undistorted/images/1.jpg", "depth_maps/1.png", "semantics/1.png", "conf/1.png")
    _touch(tmp_path / "odm", "images/1.jpg", *others)
    assert _names_in(tmp_path / "odm")[0] == ["images/1.jpg"]
    thumbs = ("day/@eaDir/1.jpg/SYNOPHOTO_THUMB_XL.jpg", "#recycle/2.jpg", "$RECYCLE.BIN/3.jpg")
    _touch(tmp_path / "nas", "day/1.jpg", *thumbs)
    assert _names_in(tmp_path / "nas")[0] == ["day/1.jpg"]
    _touch(tmp_path / "samsung", "1.jpg", "2.SRW", "3.gpr")
    assert _names_in(tmp_path / "samsung")[0] == ["1.jpg", "2.SRW", "3.gpr"]


def test_lenses_are_told_by_zoom_and_in_any_format(tmp_path: Path) -> None:
    seen = []
    for suffix in ("jpg", "tif", "png"):
        for focal, zoom in ((24.0, 1.0), (48.0, 1.0), (24.0, 2.0)):
            how = {Base.FocalLength: IFDRational(int(focal)), Base.DigitalZoomRatio: IFDRational(int(zoom))}
            tags: Any = PIL.Image.Exif() if suffix != "tif" else ImageFileDirectory_v2()
            tags[Base.Model.value] = "M"
            tags[IFD.Exif.value] = how
            path = tmp_path / f"{focal}_{zoom}.{suffix}"
            PIL.Image.new("RGB", (40, 30)).save(path, **{"tiffinfo" if suffix == "tif" else "exif": tags})
            seen.append(reconstruct._lens_of(path))
    assert len(set(seen)) == 3
    assert seen[:3] == seen[3:6] == seen[6:]


def test_masks_are_written_as_colmap_takes_them(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / "images").mkdir(exist_ok=True)
        PIL.Image.new("RGB", (40, 30)).save(tmp_path / "images" / name)
    heads = {name: image_head(tmp_path / "images" / name) for name in ("a.jpg", "b.jpg")}
    assert reconstruct._write_masks(tmp_path, heads, tmp_path / "kept") == {}
    mask = np.full((15, 20), 255, np.uint8)  # half as large
    mask[:5] = 0
    PIL.Image.fromarray(mask).save(tmp_path / "masks" / "a.HEIC.png")  # converted since
    sums = reconstruct._write_masks(tmp_path, heads, tmp_path / "kept")
    assert len(set(sums.values())) == 2
    written = [np.asarray(PIL.Image.open(tmp_path / "kept" / f"{name}.png")) for name in heads]
    assert [picture.shape for picture in written] == [(30, 40), (30, 40)]
    assert not written[0][:10].any()
    assert (written[0][10:] == 255).all()
    assert (written[1] == 255).all()


def test_what_is_transparent_is_masked(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    pixels = np.zeros((30, 40, 4), np.uint8)
    pixels[..., 3] = 255
    PIL.Image.fromarray(pixels).save(tmp_path / "images" / "a.png")  # all of it is opaque, and black
    heads = {"a.png": image_head(tmp_path / "images" / "a.png")}
    assert reconstruct._write_masks(tmp_path, heads, tmp_path / "kept") == {}
    pixels[:10, :, 3] = 0
    PIL.Image.fromarray(pixels).save(tmp_path / "images" / "b.png")
    heads["b.png"] = image_head(tmp_path / "images" / "b.png")
    assert set(reconstruct._write_masks(tmp_path, heads, tmp_path / "kept")) == set(heads)
    written = [np.asarray(PIL.Image.open(tmp_path / "kept" / f"{name}.png")) for name in heads]
    assert (written[0] == 255).all()
    np.testing.assert_array_equal(written[1], pixels[..., 3])


def test_copies_in_folders_keep_their_names(folders: tuple[Path, Path]) -> None:
    source, target = folders
    for name in ("left/1.png", "right/1.webp"):
        (source / name).parent.mkdir()
        PIL.Image.fromarray(_texture()).save(source / name)
    assert _copied(source, target) == ["left/1.png", "right/1.jpg"]
    assert (target / "right/1.jpg").is_file()


def test_folders_without_photos_are_refused(tmp_path: Path) -> None:
    _touch(tmp_path, "masks/a.png", "notes.txt")
    with pytest.raises(SceneError, match=r"no photos; it must hold files that end in .* a video is given by itself"):
        photos_in(tmp_path)


def test_many_names_are_cut_short() -> None:
    assert some(["a", "b"]) == "a, b"
    assert some([str(k) for k in range(10)]) == "0, 1, 2, 3, 4, 5, 6, 7 and 2 more"


def test_panoramas_and_few_photos_have_their_own_words() -> None:
    wide, usual = ImageHead((64, 32), 1, has_alpha=False), ImageHead((32, 24), 1, has_alpha=False)
    assert list(oddities({"a.png": wide, "b.png": wide, "c.png": usual, "d.png": usual})) == []  # a few may be cut so
    (said,) = oddities({"a.png": wide, "b.png": wide, "c.png": usual, "d.png": wide})
    assert "twice as wide as high: 360° panoramas must be cut" in said
    large = ImageHead((1024, 512), 1, has_alpha=False)
    (said,) = oddities({"a.png": usual, "b.png": usual, "c.png": usual, "d.png": usual, "e.png": large})
    assert said.startswith("e.png are twice as wide as high: 360° panoramas must be cut")
    (said,) = oddities({"c.png": usual, "d.png": usual, "e.png": usual})
    assert said.startswith("3 photos are hardly enough")


def _photo(path: Path, seed: int = 0, focal: float | None = None, model: str = "phone") -> str:
    """Write a photo with texture; returns its name."""
    exif = PIL.Image.Exif()
    if focal is not None:
        exif[0x0110] = model
        exif[0x8769] = {0x920A: focal}
    noise = np.random.default_rng(seed).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    PIL.Image.fromarray(noise).resize((128, 96)).save(path, exif=exif)
    return path.name


def _extracted(scene: Path, names: list[str]) -> dict[str, str]:
    heads = {name: image_head(scene / "images" / name) for name in names}
    return reconstruct._extract(scene, heads, _silent, 400, 1)


def test_photos_of_other_lenses_have_other_cameras(tmp_path: Path) -> None:
    images, photos = tmp_path / "images", {}
    for index, (name, focal, model) in enumerate(
        [("1.jpg", 4.2, "phone"), ("2.png", 4.2, "phone"), ("3.jpg", 2.2, "phone"), ("4.jpg", 4.2, "another")]
    ):
        photos[name] = _photo(images / name, index, focal, model)
    _photo(images / "more/1.jpg", 9, 4.2)
    names = [*photos, "more/1.jpg"]
    _extracted(tmp_path, names)
    found = dict(reconstruct._rows(tmp_path, "select name, camera_id from images"))
    assert found["1.jpg"] == found["2.png"]
    assert len({found[name] for name in names}) == 4


def test_features_are_found_once_unless_a_photo_changes(tmp_path: Path) -> None:
    images = tmp_path / "images"
    names = [_photo(images / f"{seed}.png", seed) for seed in range(3)]

    def extract(names: list[str]) -> dict[str, Any]:
        stamps = _extracted(tmp_path, names)
        assert list(stamps) == names
        assert stamps_in(tmp_path).items() >= stamps.items()
        rows = reconstruct._rows(tmp_path, "select name, data from images join keypoints using (image_id)")
        return dict(rows)

    first = extract(names[:2])
    later = extract(names[1:])
    assert later.keys() == set(names)  # a photo that is gone may come back
    assert all(later[name] == first[name] for name in first)
    _photo(images / names[1], 7)
    changed = extract(names[1:])
    assert changed.keys() == set(names[1:])
    assert changed["1.png"] != first["1.png"]
    assert changed["2.png"] == later["2.png"]


def test_stamps_of_a_database_that_is_gone_are_forgotten(tmp_path: Path) -> None:
    names = [_photo(tmp_path / "images" / f"{seed}.png", seed) for seed in range(2)]
    _extracted(tmp_path, names)
    reconstruct.remove_database(tmp_path)
    _extracted(tmp_path, names[1:])
    assert stamps_in(tmp_path).keys() == {names[1]}


def _compared(scene: Path, names: list[str], monkeypatch: pytest.MonkeyPatch) -> list[set[str]]:
    """The pairs of photos that COLMAP is asked to compare, each once."""
    pairs: list[set[str]] = []

    def listed(_: object, pairing_options: Any, **__: object) -> None:
        lines = Path(pairing_options.match_list_path).read_text(encoding="utf-8").splitlines()
        pairs.extend(set(line.split()) for line in lines)

    monkeypatch.setattr(import_pycolmap(), "match_image_pairs", listed)
    scene.mkdir(exist_ok=True)
    reconstruct._compare(scene, dict.fromkeys(names, ImageHead((8, 8), 1, False)), _silent, False, 1)
    assert len({frozenset(pair) for pair in pairs}) == len(pairs)
    return pairs


def test_photos_of_two_cameras_and_unpadded_numbers_are_compared_with_near_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = _compared(tmp_path, [f"{side}/{k}.jpg" for side in ("left", "right") for k in range(100)], monkeypatch)
    assert all({f"left/{k}.jpg", f"right/{k}.jpg"} in pairs for k in range(100))
    assert all({f"left/{k}.jpg", f"left/{k + 2}.jpg"} in pairs for k in range(98))
    parts = _compared(tmp_path, [f"{part}/{k}.jpg" for part in range(5) for k in range(30)], monkeypatch)
    assert all({f"{part}/{k}.jpg", f"{part}/{k + 1}.jpg"} in parts for part in range(5) for k in range(29))
    near = _compared(tmp_path, [f"{k}.jpg" for k in range(150)], monkeypatch)
    assert all({f"{k}.jpg", f"{k + step}.jpg"} in near for step in (1, 2, 3, 4, 5, 6) for k in range(144))
    assert len(near) < 12 * 150
    sequences: list[object] = []
    monkeypatch.setattr(import_pycolmap(), "match_sequential", lambda path, **_: sequences.append(path))
    for name in ("IMG (1).jpg", "#1.jpg"):
        assert _compared(tmp_path, [f"{k}.jpg" for k in range(150)] + [name], monkeypatch) == []
    assert len(sequences) == 2


def test_a_damaged_database_is_told(tmp_path: Path) -> None:
    (tmp_path / reconstruct.DATABASE).write_bytes(b"SQLite format 3" + bytes(4000))
    told = r"database\.db \(file is not a database\); if it is damaged, as after a power loss, remove it"
    with pytest.raises(FormatError, match=told):
        reconstruct._rows(tmp_path, "select name from images")


def test_the_progress_of_comparing_is_read_by_colmaps_own_sqlite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python's would take no notice of the locks of a process that is its own, and empty the index of COLMAP's log."""
    pycolmap = import_pycolmap()
    seen = []

    def matching(path: Path, **_: object) -> None:
        with pycolmap.Database.open(path) as database:
            camera = pycolmap.Camera.create(0, "PINHOLE", 10.0, 8, 8)
            camera.camera_id = database.write_camera(camera)
            for k in range(1, 4):
                image = pycolmap.Image(name=f"{k}.jpg", camera_id=camera.camera_id)
                image.image_id = database.write_image(image)
            for pair in ((1, 2), (1, 3)):
                found = pycolmap.TwoViewGeometry()
                found.config = 2
                found.inlier_matches = np.array([[0, 0]])
                database.write_two_view_geometry(*pair, found)
        time.sleep(2.5)

    def connect(path: Path) -> sqlite3.Connection:
        raise AssertionError(path)

    monkeypatch.setattr(sqlite3, "connect", connect)
    monkeypatch.setattr(pycolmap, "match_exhaustive", matching)
    photos = {f"{k}.jpg": ImageHead((8, 8), 1, False) for k in range(9)}
    reconstruct._compare(tmp_path, photos, lambda _, done, total: seen.append((done, total)), False, 1)
    assert seen[-2:] == [(2, 36), (36, 36)]


def test_cameras_are_placed_again_for_other_photos_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pycolmap = import_pycolmap()
    demo = pycolmap.Reconstruction(Path(reconstruct.__file__).parent / "demo/sparse/0")
    found, asked = {0: demo}, []

    def mapping(*_: object, options: Any, **__: object) -> dict[int, Any]:
        asked.append(set(options.image_names))
        return found

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapping)

    def placed(*names: str) -> int:
        return len(reconstruct._map(tmp_path, dict.fromkeys(names, "1"), _silent, 1))

    assert (placed("a", "b"), placed("a", "b"), placed("a")) == (1, 1, 1)
    assert asked == [{"a", "b"}, {"a"}]
    found = {}
    assert placed("a", "c") == 0
    assert stamps_in(tmp_path / "sparse") == {"a": "1"}  # the scene of before stays
    assert placed("a") == 1
    assert asked == [{"a", "b"}, {"a"}, {"a", "c"}]


def test_sharpness_does_not_depend_on_the_size() -> None:
    large = cv2.resize(_texture(), (1920, 960), interpolation=cv2.INTER_CUBIC)
    small = cv2.resize(large, (960, 480), interpolation=cv2.INTER_AREA)
    assert sharpness(large) == pytest.approx(sharpness(small), rel=0.1)
    assert sharpness(cv2.GaussianBlur(large, None, 12)) < 0.5 * sharpness(large)


def test_blurred_photos_are_named_whether_they_have_a_place_or_not(tmp_path: Path) -> None:
    sharp = _texture(96)
    for name in ("a", "b", "c", "d"):
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), sharp if name < "c" else cv2.GaussianBlur(sharp, (0, 0), 9))
    verdict = reconstruct.Verdict(("a.png", "b.png", "c.png"), {"d.png": 0}, 100, 0.5, 3.0, 1)
    said = list(verdict.told(tmp_path))
    assert "  blurred, the scene is better without: c.png" in said
    assert "    d.png: blurred" in said
    assert "blurred" not in " ".join(verdict._replace(registered=("a.png", "b.png"), missing={}).told(tmp_path))
