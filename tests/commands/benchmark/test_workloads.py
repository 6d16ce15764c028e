from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nsvq_lightning import save
from nsvq_lightning.commands.benchmark.timing import Scope
from nsvq_lightning.commands.benchmark.workloads import synthetic_workload, workloads
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import CompressedScene, write_ply
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import RawSplats


def test_a_name_always_gives_the_same_numbers() -> None:
    """Published figures refer to them."""
    workload = synthetic_workload("A20k")
    numbers = (*workload.splats, workload.image_gradient, workload.camera.viewmat)
    sums = [float(tensor.double().abs().sum()) for tensor in numbers]
    expected = [49405.72752, 34121.12526, 242787.69977, 28965.13064, 43135.67841, 57458.15703, 0.79802539, 9.37933010]
    assert sums == pytest.approx(expected, rel=1e-7)


def test_crop_shows_the_middle_of_the_view() -> None:
    workload = synthetic_workload("A20k")
    small = workload.crop(64, 40)
    whole, cropped = (render(each.splats, each.camera).image for each in (workload, small))
    # The Jacobian of splats outside is clamped beyond a margin of the view, which a crop moves.
    errors = [float((cropped - whole[top : top + 40, 168:232]).abs().mean()) for top in (130, 131)]
    assert errors[0] < 1e-3 < 20 * errors[0] < errors[1]
    assert torch.equal(small.image_gradient, workload.image_gradient[130:170, 168:232])
    near = replace(workload, camera=replace(workload.camera, near=0.07))
    assert near.crop(64, 40).camera.near == 0.07


def test_scene_file_is_seen_whole_and_without_broken_splats(tmp_path: Path) -> None:
    source = RawSplats(*(tensor[:500].clone() for tensor in synthetic_workload("A20k").splats))
    source.means.add_(torch.tensor([10.0, -3.0, 7.0]))
    path = tmp_path / "scene.ply"
    save(source, path)
    scope = Scope(scene=path)
    (whole,) = workloads(scope)
    assert str(whole) == "scene.ply 800x533"
    assert float((render(whole.splats, whole.camera).radii > 0).float().mean()) > 0.7
    # Our own writer drops such rows; files of others have them.
    source.opacities[3] = torch.nan
    write_ply(path, CompressedScene.from_splats(source))
    assert len(workloads(scope)[0].splats.means) == 499
    source.opacities.fill_(torch.nan)
    write_ply(path, CompressedScene.from_splats(source))
    with pytest.raises(ValueError, match="no finite splat"):
        workloads(scope)


def test_folder_is_seen_by_its_first_train_camera(demo_scene: Path) -> None:
    scene = load_scene(demo_scene).standard
    (workload,) = workloads(Scope(scene=demo_scene))
    assert torch.equal(workload.camera.viewmat, scene.cameras[scene.train[0]].viewmat)
    assert torch.equal(workload.splats.means, scene.points)
