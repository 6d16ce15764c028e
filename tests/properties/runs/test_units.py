"""A run does not depend on the unit and the place of its scene: the same bits inside, the same scene in its files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from checkpoints import read
from moved_scenes import write_moved

from nsvq_lightning.commands.main import main
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import read_scene
from nsvq_lightning.quality.metrics import psnr
from nsvq_lightning.rendering.rasterize import render


def fitted(scene: Path, folder: Path) -> Path:
    arguments = ["fit", f"--data.root={scene}", "--trainer.max_steps=30", "--model.sh_degree=1", "--splats=400"]
    more = ["--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false", f"--trainer.run_folder={folder}"]
    assert main([*arguments, *more, "--model.codebooks={scales: 32, sh0: 16}", "--callbacks.canonical=null"]) == 0
    return folder


@pytest.fixture(scope="module")
def usual(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fitted(demo_scene, tmp_path_factory.mktemp("usual") / "run")


@pytest.mark.parametrize(
    ("unit", "shift"),
    [(2.0**-9, (0.0, 0.0, 0.0)), (0.03, (4.0, -1.0, 2.0)), (100.0, (0.0, 0.0, 0.0)), (1.0, (5e5, 4.1e6, 120.0))],
    ids=["a power of two", "another unit and place", "centimetres", "a map"],
)
def test_a_run_is_the_same_in_any_unit(
    demo_scene: Path, usual: Path, tmp_path: Path, unit: float, shift: Sequence[float]
) -> None:
    scene = write_moved(demo_scene, tmp_path / "scene", unit, shift)
    folder = fitted(scene, tmp_path / "run")
    one, other = (read(each / "checkpoints" / "last.ckpt")["state_dict"] for each in (usual, folder))
    if math.log2(unit).is_integer() and not any(shift):
        same = [key for key in one if key != "_extra_state" and torch.equal(one[key], other[key])]
        assert len(same) == len(one) - 1
    first, second = read_scene(usual / "scene.nsvq"), read_scene(folder / "scene.nsvq")
    for path in ("scene.nsvq", "scene.ply"):
        stored, photos = read_scene(folder / path), load_scene(scene)
        image = render(stored.decode(), photos.cameras[0]).image.detach()
        expected = render(first.decode(), load_scene(demo_scene).cameras[0]).image.detach()
        assert float(psnr(image, expected)) > 45
        assert float(psnr(image, photos.view(0).image / 255)) > 12
    assert any(second.origin) == (shift[0] > 1e4)
    middle = np.median(second.means, axis=0) + second.origin
    np.testing.assert_allclose(middle, unit * np.median(first.means, axis=0) + shift, atol=0.05 * unit)


def test_a_map_stays_in_its_place_when_photos_go(demo_scene: Path, tmp_path: Path) -> None:
    far = write_moved(demo_scene, tmp_path / "far", shift=(5e5, 4.1e6, 120.0))
    fitted(far, tmp_path / "run")
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    model = pycolmap.Reconstruction(str(far / "sparse" / "0"))
    names = sorted(image.name for image in model.images.values())
    for image in list(model.images.values()):
        if image.name in names[3:6]:
            model.deregister_frame(image.frame_id)
    model.write_binary(str(far / "sparse" / "0"))
    scene = read_scene(tmp_path / "run" / "scene.nsvq")
    assert np.abs(np.subtract(load_scene(far).frame.origin, scene.origin)).max() > 0.05
    options = [f"--data.root={far}", f"--trainer.run_folder={tmp_path / 'again'}", "--trainer.accelerator=cpu"]
    assert main(["test", f"--ckpt_path={checkpoint}", *options]) == 0
    again = read_scene(tmp_path / "again" / "scene.nsvq")
    assert again.origin == load_scene(far).frame.origin
    means = [found.means.mean(0, np.float64) + found.origin for found in (scene, again)]
    np.testing.assert_allclose(*means, atol=0.02, rtol=0)  # of rounded positions


def test_a_checkpoint_puts_its_scene_back(demo_scene: Path, usual: Path, tmp_path: Path) -> None:
    exported = tmp_path / "scene.nsvq"
    assert main(["export", f"--ckpt_path={usual / 'checkpoints' / 'last.ckpt'}", f"--output={exported}"]) == 0
    assert exported.read_bytes() == (usual / "scene.nsvq").read_bytes()


def test_a_file_that_a_run_starts_from_stays_in_its_place(demo_scene: Path, usual: Path, tmp_path: Path) -> None:
    more = [f"--model.init_from={usual / 'scene.ply'}", "--trainer.max_steps=1", f"--trainer.run_folder={tmp_path}"]
    still = ["--model.rates.means=1e-12", "--model.rates.means_final=1e-12", "--model.rates.scales=0"]
    quiet = ["--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false", "--callbacks.density=null"]
    plain = ["--callbacks.selection=null", "--callbacks.canonical=null", "--model.sh_degree=1"]
    command = ["fit", f"--data.root={demo_scene}", "--model.codebooks=null", *more, *still, *quiet, *plain]
    assert main([*command, "--callbacks.sh_degree=null"]) == 0
    before, after = (read_scene(folder / "scene.ply") for folder in (usual, tmp_path))
    order = [np.lexsort(scene.means.round(4).T) for scene in (before, after)]
    np.testing.assert_allclose(after.means[order[1]], before.means[order[0]], atol=2e-3)
