"""Masks, transparency and EXIF orientation: which pixels of the photos count."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch
from lightning.pytorch import Trainer

from nsvq_lightning.data.datamodule import ColmapDataModule, DevicePhotos
from nsvq_lightning.data.scene import SceneError, edge_strength, load_scene
from nsvq_lightning.training.module import SplatModule
from tests.conftest import SceneFactory
from tests.support.transforms_scenes import write_blender, write_nerfstudio

HALF = np.zeros((32, 40), np.uint8)
HALF[:, :20] = 255


def quiet_trainer(folder: Path, steps: int) -> Trainer:
    return Trainer(
        max_steps=steps,
        accelerator="cpu",
        default_root_dir=folder,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )


def write_masks(root: Path, names: list[str], mask: np.ndarray = HALF) -> None:
    for name in names:
        path = root / "masks" / name
        path.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), mask)


def test_masks_of_colmap_and_nerfstudio_are_found_by_their_names(make_scene: SceneFactory) -> None:
    root = make_scene(views=4)
    write_masks(root, ["000.png.png", "001.png", "002.jpg"])
    scene = load_scene(root)
    for index in range(3):
        view = scene.view(index)
        assert view.mask is not None
        assert torch.equal(view.mask, torch.from_numpy(HALF > 0))
        assert (view.image[:, 20:] == 0).all()
        assert view.image[:, :20].float().mean() > 20
    assert scene.view(3).mask is None
    assert load_scene(root, masks=None).view(0).mask is None
    assert load_scene(root, masks="elsewhere").view(0).mask is None


@pytest.mark.parametrize("levels", [(0, 1), (0, 255), (3, 200)])
@pytest.mark.parametrize("size", [(40, 32), (80, 64), (20, 16)])
def test_masks_of_any_levels_and_sizes(
    make_scene: SceneFactory, levels: tuple[int, int], size: tuple[int, int]
) -> None:
    root = make_scene(views=2)
    mask = cv2.resize(np.where(HALF > 0, np.uint8(levels[1]), np.uint8(levels[0])), size, interpolation=0)
    write_masks(root, ["000.png", "001.png"], mask)
    assert torch.equal(load_scene(root).view(0).mask, torch.from_numpy(HALF > 0))  # type: ignore[arg-type]


def test_a_pixel_counts_only_if_all_that_it_is_made_of_counts(make_scene: SceneFactory) -> None:
    root = make_scene(views=2)
    mask = HALF.copy()
    mask[:, 20] = 255  # 21 columns: the middle one at half size is mixed
    write_masks(root, ["000.png"], mask)
    kept = load_scene(root, factor=2).view(0).mask
    assert kept is not None
    assert kept.shape == (16, 20)
    assert kept.sum(1).tolist() == [10] * 16


def test_masks_are_undistorted_with_their_photo(make_scene: SceneFactory) -> None:
    root = make_scene(views=2, model="SIMPLE_RADIAL", params=(30.0, 20.0, 16.0, 0.1))
    photo = np.repeat(HALF[..., None], 3, 2)
    for name in ("000.png", "001.png"):
        assert cv2.imwrite(str(root / "images" / name), photo)
    write_masks(root, ["000.png"])
    scene = load_scene(root)
    masked, whole = scene.view(0), scene.view(1)
    assert masked.mask is not None
    assert (whole.image[masked.mask] > 250).all()
    assert (whole.image[~masked.mask] > 250).float().mean() < 0.1


def test_pixels_that_a_wide_lens_never_saw_do_not_count(make_scene: SceneFactory) -> None:
    root = make_scene(views=2, model="SIMPLE_RADIAL", params=(30.0, 20.0, 16.0, 0.1))
    write_masks(root, ["000.png"])
    scene = load_scene(root)
    undistortion = scene.images.sources[0].undistortion
    assert undistortion is not None
    maps = undistortion.maps()
    blank = np.zeros(maps.x.shape, bool)
    blank[:4] = True
    undistortion._maps = maps._replace(blank=blank)
    kept = scene.view(1).mask
    assert kept is not None
    assert torch.equal(kept, torch.from_numpy(~blank))
    masked = scene.view(0).mask
    assert masked is not None
    assert not masked[:4].any()
    assert masked[4:].float().mean() < 0.6


def test_transparent_pixels_do_not_count(make_scene: SceneFactory) -> None:
    root = make_scene(views=3)
    for name, alpha in (("000.png", HALF), ("001.png", np.full_like(HALF, 255))):
        path = root / "images" / name
        assert cv2.imwrite(str(path), np.dstack([cv2.imread(str(path)), alpha]))
    scene = load_scene(root)
    assert torch.equal(scene.view(0).mask, torch.from_numpy(HALF > 0))  # type: ignore[arg-type]
    assert scene.view(1).mask is None
    upper = np.flipud(np.tri(32, 40, dtype=np.uint8) * 255)
    write_masks(root, ["000.png"], upper)
    both = torch.from_numpy((HALF > 0) & (upper > 0))
    assert torch.equal(load_scene(root).view(0).mask, both)  # type: ignore[arg-type]


def test_scenes_of_nerf_synthetic_are_in_front_of_white(demo_scene: Path, tmp_path: Path) -> None:
    root = write_blender(demo_scene, tmp_path / "lego")
    scene = load_scene(root)
    view = scene.view(4)
    assert view.mask is None
    assert (view.image[:, :24] == 255).all()
    assert (view.image[:, 24:] < 250).any()
    trainer = quiet_trainer(tmp_path, 2)
    module, data = SplatModule(sh_degree=0, codebooks=None), ColmapDataModule(str(root))
    trainer.fit(module, data)
    assert module.background == "white"
    with pytest.raises(ValueError, match=r"shown on white, model\.background is black: leave it at auto"):
        trainer.fit(SplatModule(sh_degree=0, codebooks=None, background="black"), ColmapDataModule(str(root)))


def test_masks_that_a_transforms_file_names(demo_scene: Path, tmp_path: Path) -> None:
    root = write_nerfstudio(demo_scene, tmp_path / "scene")
    (root / "other").mkdir()
    mask = np.full((72, 96), 255, np.uint8)
    mask[:10] = 0
    assert cv2.imwrite(str(root / "other/m.png"), mask)
    document = json.loads((root / "transforms.json").read_text())
    first = min(document["frames"], key=lambda frame: frame["file_path"])
    first["mask_path"] = "other/m.png"
    (root / "transforms.json").write_text(json.dumps(document))
    scene = load_scene(root)
    assert scene.view(0).mask is not None
    assert int((~scene.view(0).mask).sum()) == 960  # type: ignore[operator]
    assert scene.view(1).mask is None
    first["mask_path"] = "other/gone.png"
    (root / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(SceneError, match=r"1 masks do not exist, first .*gone\.png"):
        load_scene(root)


def test_useless_masks_are_named(make_scene: SceneFactory, caplog: pytest.LogCaptureFixture) -> None:
    root = make_scene(views=2)
    write_masks(root, ["nobody.png"])
    load_scene(root)
    assert "masks has no mask of any photo: that of 000.png would be 000.png.png or 000.png" in caplog.text
    write_masks(root, ["000.png"], np.zeros((32, 40), np.uint8))
    with pytest.raises(
        SceneError, match=r"no pixel of .*000\.png counts by its mask .*masks/000\.png: masks are white"
    ):
        load_scene(root).view(0)
    write_masks(root, ["000.png"], np.full((40, 32), 255, np.uint8))
    with pytest.raises(SceneError, match=r"mask .*000\.png is of 32x40, its photo of 40x32, another shape"):
        load_scene(root).view(0)
    (root / "masks/000.png").write_bytes(b"text")
    with pytest.raises(SceneError, match=r"masks/000\.png cannot be decoded"):
        load_scene(root).view(0)


def test_excluded_pixels_carry_no_loss_and_no_metric(demo_scene: Path, tmp_path: Path) -> None:
    """Two folders whose photos differ in excluded pixels only train to the same splats and scores, bit for bit."""
    mask = np.full((72, 96), 255, np.uint8)
    mask[20:50, 30:80] = 0
    results = []
    for number, spoiled in enumerate((False, True)):
        root = tmp_path / f"scene{number}"
        for folder in ("images", "masks"):
            (root / folder).mkdir(parents=True)
        os.symlink(demo_scene / "sparse", root / "sparse", target_is_directory=True)
        for path in sorted((demo_scene / "images").iterdir()):
            photo = cv2.imread(str(path))
            if spoiled:
                photo[mask == 0] = np.random.default_rng(1).integers(0, 256, (1500, 3))
            assert cv2.imwrite(str(root / "images" / path.name), photo)
            assert cv2.imwrite(str(root / "masks" / f"{path.name}.png"), mask)
        trainer = quiet_trainer(tmp_path, 5)
        module, data = SplatModule(sh_degree=0, codebooks=None), ColmapDataModule(str(root))
        trainer.fit(module, data)
        scores = trainer.test(module, data, verbose=False)[0]
        results.append((scores, module.splats.means.detach().clone(), module.splats.sh0.detach().clone()))
        image = module.render_splats(module.splats.raw(), data.scene.cameras[0]).image.detach()
        assert (image[mask == 0] > 0.05).any()  # something is there all the same
    (scores, *splats), (others, *others_splats) = results
    assert scores == others
    assert all(torch.equal(a, b) for a, b in zip(splats, others_splats, strict=True))
    assert 5 < scores["test/psnr"] < 40


def test_photos_and_masks_move_together(make_scene: SceneFactory) -> None:
    root = make_scene(views=2)
    write_masks(root, ["000.png"])
    scene = load_scene(root)
    photos = DevicePhotos(1 << 20)
    for _ in range(2):
        moved = photos.move(scene.view(0), torch.device("meta"))
        assert (moved.image.device.type, moved.mask.device.type) == ("meta", "meta")  # type: ignore[union-attr]
    assert photos.move(scene.view(1), torch.device("meta")).mask is None


def test_growth_ignores_the_edges_of_masks() -> None:
    image = torch.full((32, 40, 3), 90, dtype=torch.uint8)
    mask = torch.from_numpy(HALF > 0)
    image[~mask] = 0
    assert edge_strength(image).max() == 1
    assert edge_strength(image, mask).max() == 0


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_photos_are_turned_where_their_cameras_are(
    make_scene: SceneFactory, orientation: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Some programs calibrate photos as they are shown, COLMAP as they are stored."""
    caplog.set_level("INFO", logger="nsvq_lightning")
    root = make_scene(views=2, size=(32, 40))
    pixels = np.zeros((32, 40, 3), np.uint8)
    pixels[:8, :20] = 250, 10, 10
    tags = PIL.Image.Exif()
    tags[274] = orientation
    for path in (root / "images").iterdir():
        PIL.Image.fromarray(pixels).save(path, "JPEG", quality=95, exif=tags)
    scene = load_scene(root)
    assert "2 of 2 photos are turned by their EXIF orientation" in caplog.text
    with PIL.Image.open(root / "images/000.png") as stored:
        from PIL import ImageOps

        shown = np.asarray(ImageOps.exif_transpose(stored)).astype(int)
    assert np.abs(scene.view(0).image.numpy() - shown).max() < 25
    assert load_scene(make_scene("stored", views=2)).images.sources[0].orientation == 1
