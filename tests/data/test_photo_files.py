"""Photos and masks under other names than the model's."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import numpy as np
import pytest

from nsvq_lightning.data.colmap import ColmapImage, NoPhotosError, SceneError
from nsvq_lightning.data.photo_files import find_masks, locate, photo_folder, photos_below


def write(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"")


def masks_of(root: Path, folder: str, *names: str) -> list[Path | None]:
    photos = [ColmapImage(name, 1, np.eye(4)) for name in names]
    return find_masks(photos, [root / "images" / name for name in names], root / "images", root, [folder])


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["IMG_1.JPG"], ["img_1.jpg", "img_1.png", "img_1.xmp"]),
        (["1.jpg"], ["1.JPEG", "1.png"]),
        (["1.jpg"], ["1.png", "1.jpg.png", "1.xmp"]),
        (["1"], ["1.tiff", "1.txt"]),
        (["v1.0"], ["v1.0.webp"]),
        (
            [unicodedata.normalize("NFD", "K\u00fcche/\u00e4.jpg")],
            [unicodedata.normalize("NFC", "K\u00fcche/\u00e4.jpg")],
        ),
        (["cam0\\1.jpg", "cam1\\1.jpg"], ["cam0/1.jpg", "cam1/1.jpg"]),
        (["images/cam0/1.jpg", "images/cam1/1.jpg"], ["cam0/1.jpg", "cam1/1.jpg"]),
        (["/home/me/scan/1.jpg"], ["1.jpg"]),
        (["C:\\scan\\1.jpg"], ["1.jpg"]),
        (["../raw/1.jpg"], ["1.jpg"]),
        (["1.jpg", "2.jpg"], ["sub/1.jpg", "sub/2.jpg"]),
        (["IMG_1.HEIC", "a/2.CR2"], ["img_1.jpg", "a/2.png", "3.jpg"]),
    ],
)
def test_a_name_is_taken_for_the_nearest_photo(
    tmp_path: Path, names: list[str], files: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    write(tmp_path, *files)
    found = locate(names, tmp_path, "the model")
    assert [found[name] for name in names] == [tmp_path / file for file in files[: len(names)]]
    assert f"{len(names)} of {len(names)} files have other names than in the model" in caplog.text


@pytest.mark.parametrize(
    ("names", "files", "message"),
    [
        (["1.JPG"], ["1.png", "1.tif"], r"names 1\.JPG, which may be .*1\.png or .*1\.tif: remove or rename"),
        (["1.jpg"], ["a/1.jpg", "b/1.jpg"], r"may be .*a/1\.jpg or .*b/1\.jpg"),
        (["a/1.jpg", "b/1.jpg"], ["1.jpg"], r"names a/1\.jpg and b/1\.jpg, but there is only .*/1\.jpg"),
        (["../2.jpg"], ["1.jpg"], r"names \.\./2\.jpg, which is not in the scene folder.*allow_outside"),
    ],
)
def test_what_is_not_clear_is_refused(tmp_path: Path, names: list[str], files: list[str], message: str) -> None:
    write(tmp_path, *files)
    with pytest.raises(SceneError, match=message):
        locate(names, tmp_path, "the model")


def test_a_photo_of_another_folder_is_not_taken_for_one_that_is_gone(tmp_path: Path) -> None:
    write(tmp_path, "a/1.jpg", "a/2.jpg")
    assert not locate(["a/1.jpg", "b/2.jpg"], tmp_path, "the model")["b/2.jpg"].exists()


@pytest.mark.parametrize("suffix", [".jpg", ".JPG"])
def test_a_depth_map_is_not_taken_for_a_photo_that_is_gone(tmp_path: Path, suffix: str) -> None:
    write(tmp_path, "1.jpg", "1.png", "2.png")
    first, second = locate([f"1{suffix}", f"2{suffix}"], tmp_path, "the model").values()
    assert first == tmp_path / "1.jpg"
    assert not second.exists()
    write(tmp_path / "scaled", "1.jpg", "2.png")  # here the suffix is that of all that there is
    assert locate(["1.jpg", "2.jpg"], tmp_path / "scaled", "the model")["2.jpg"] == tmp_path / "scaled/2.png"


@pytest.mark.parametrize(("name", "file"), [("img.0001", "img.jpg"), ("scan.v1/2", "scan.jpg"), ("1.HEIC", "2.jpg")])
def test_what_is_no_suffix_is_part_of_a_name(tmp_path: Path, name: str, file: str) -> None:
    write(tmp_path, file)
    assert not locate([name], tmp_path, "the model")[name].exists()


def test_maps_are_not_taken_for_photos_that_are_gone(tmp_path: Path) -> None:
    write(tmp_path, "depths/1.png", "depths/2.png", "my_masks/1.png", "normals/1.png")
    for name in ("images/1.png", "1.png"):
        assert not locate([name], tmp_path, "the model")[name].exists()
    with pytest.raises(NoPhotosError, match="no other folder"):
        photo_folder(tmp_path, "images", None, ["1.png", "2.png"])
    named = locate(["my_masks/1.PNG"], tmp_path, "the model")
    assert named["my_masks/1.PNG"] == tmp_path / "my_masks/1.png"


def test_photos_that_are_named_in_a_folder_of_small_ones_are_small_already(tmp_path: Path) -> None:
    write(tmp_path / "images_4", "1.jpg")
    assert photo_folder(tmp_path, "images_4", 4, ["1.jpg"]) == (tmp_path / "images_4", 1)
    assert photo_folder(tmp_path, "images_4", 2, ["1.jpg"]) == (tmp_path / "images_4", 2)


@pytest.mark.parametrize("place", [".", "input", "colmap/pictures", "sparse/0", "Alpha"])
def test_the_only_folder_that_has_the_photos_is_used(tmp_path: Path, place: str) -> None:
    names = ["cam/1.jpg", "cam/2.jpg"]
    write(tmp_path / place, *names)
    write(tmp_path / "masks", *names)
    assert photo_folder(tmp_path, "images", 2, names) == (tmp_path / place, 2)
    write(tmp_path / "other", *names)
    with pytest.raises(SceneError, match=r"set images_folder .*; they are in (.* and other|other and .*)"):
        photo_folder(tmp_path, "images", None, names)


@pytest.mark.parametrize(
    "name",
    [
        "mask/{}.png",
        "Masks/{}.JPG.PNG",
        "images/{}_mask.png",
        "images/{}.jpg.png",
        "images/{}.jpg.mask.png",
        "mask/{}.JPG_mask.png",
        "images_masks/mask_{}.PNG",
        "images/masks/{}.png",
    ],
)
def test_masks_are_found_in_the_only_place_that_has_some(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    write(tmp_path, "images/1.jpg", "images/2.jpg", name.format("1"))
    assert masks_of(tmp_path, "masks", "1.jpg", "2.jpg") == [tmp_path / name.format("1"), None]
    assert "masks are read from" in caplog.text or name.startswith("Masks")
    write(tmp_path, "more_masks/2.png")
    assert masks_of(tmp_path, "masks", "1.jpg", "2.jpg") == [None, None]
    assert "are not used: choose a folder (--data.masks)" in caplog.text
    assert masks_of(tmp_path, "more_masks", "1.jpg", "2.jpg") == [None, tmp_path / "more_masks/2.png"]


@pytest.mark.parametrize("other", ["png", "webp", "tif"])
def test_a_photo_of_another_kind_and_the_same_name_is_no_mask(tmp_path: Path, other: str) -> None:
    write(tmp_path, "images/1.jpg", f"images/1.{other}")
    assert masks_of(tmp_path, "masks", "1.jpg") == [None]


def test_a_mask_of_what_a_photo_was_converted_from_is_its_own(tmp_path: Path) -> None:
    write(tmp_path, "images/1.jpg", "images/2.jpg", "masks/1.HEIC.png", "masks/2.avif.png")
    assert masks_of(tmp_path, "masks", "1.jpg", "2.jpg") == [
        tmp_path / "masks/1.HEIC.png",
        tmp_path / "masks/2.avif.png",
    ]


def test_masks_lie_on_the_way_to_the_photos_and_nowhere_else(tmp_path: Path) -> None:
    photos = tmp_path / "dense/0/images"
    write(tmp_path, "dense/0/images/1.jpg", "dense/0/masks/1.png", "old/masks/1.png", "dense/0/masks/old_masks/1.png")
    found = find_masks([ColmapImage("1.jpg", 1, np.eye(4))], [photos / "1.jpg"], photos, tmp_path, ["masks"])
    assert found == [tmp_path / "dense/0/masks/1.png"]


def test_what_a_mac_leaves_beside_photos_is_none(tmp_path: Path) -> None:
    write(tmp_path, "images/1.jpg", "images/._1.jpg", "images/.hidden/2.jpg")
    assert photos_below(tmp_path) == [tmp_path / "images/.hidden/2.jpg", tmp_path / "images/1.jpg"]


def test_a_photo_is_no_mask(tmp_path: Path) -> None:
    write(tmp_path, "images/1.jpg", "images/mask_1.jpg", "images/2.jpg", "unmasked/1.jpg", "unmasked/3.jpg")
    photos = [ColmapImage(name, 1, np.eye(4)) for name in ("1.jpg", "mask_1.jpg", "2")]
    files = [tmp_path / "images" / name for name in ("1.jpg", "mask_1.jpg", "2.jpg")]
    assert find_masks(photos, files, tmp_path / "images", tmp_path, ["masks"]) == [None, None, None]
    assert photo_folder(tmp_path, "pictures", None, ["3.jpg"])[0] == tmp_path / "unmasked"


def test_masks_that_are_not_clear_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, "images/1.jpg", "images/dynamic_mask_1.png")
    assert masks_of(tmp_path, "masks", "1.jpg") == [None]
    assert "white leaves out in them" in caplog.text
    assert masks_of(tmp_path, "missing", "1.jpg") == [None]
    assert "there is no folder" in caplog.text
    write(tmp_path, "foreground_mask/one.png")
    assert masks_of(tmp_path, "masks", "1.jpg") == [None]
    assert f"{tmp_path / 'foreground_mask'} has no mask of any photo: that of 1.jpg would be" in caplog.text
    write(tmp_path, "masks/1.png", "masks/1.jpg")
    with pytest.raises(SceneError, match=r"1\.jpg and .*1\.png are masks of 1\.jpg: remove one"):
        masks_of(tmp_path, "masks", "1.jpg")
