from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from nsvq_lightning import save
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.sizes import STANDARD
from nsvq_lightning.commands.benchmark.views import FADING, write_views
from nsvq_lightning.commands.benchmark.workloads import scene_workload, single_workload, synthetic_workload, workloads
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import RawSplats, Splats


@pytest.fixture(scope="module")
def definition() -> ModuleType:
    """The definition of the workloads that published figures refer to."""
    path = Path(__file__).resolve().parents[3] / "shared" / "bench" / "workloads.py"
    if not path.is_file():
        pytest.skip(f"the definition of the workloads is not here ({path} is missing)")
    specification = importlib.util.spec_from_file_location("workload_definition", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", STANDARD)
def test_scene_has_the_bits_of_its_definition(name: str, definition: ModuleType) -> None:
    expected = definition.scene(name)
    workload = synthetic_workload(name)
    splats, camera = workload.splats, expected["cam"]
    pairs = [
        (splats.means, expected["means"]),
        (splats.quats, expected["quats"]),
        (splats.scales, expected["lscales"]),
        (splats.opacities, expected["opac"]),
        (splats.sh0, expected["sh"][:, :1]),
        (splats.shN, expected["sh"][:, 1:]),
        (workload.camera.viewmat, camera["viewmat"]),
        (workload.background, expected["bg"]),
        (workload.image_gradient, expected["v_img"]),
    ]
    for found, wanted in pairs:
        np.testing.assert_array_equal(found.numpy(), wanted, strict=True)
    assert workload.camera.intrinsics == tuple(camera[key] for key in ("fx", "fy", "cx", "cy"))
    assert (workload.camera.width, workload.camera.height) == (camera["W"], camera["H"])


def test_crop_shows_the_middle_of_the_view() -> None:
    workload = synthetic_workload("A20k")
    small = workload.crop(64, 40)
    whole = render(workload.splats, workload.camera).image
    cropped = render(small.splats, small.camera).image

    def difference(top: int, left: int) -> float:
        return float((cropped - whole[top : top + 40, left : left + 64]).abs().mean())

    # Not equal: the Jacobian of splats outside is clamped beyond a margin of the view, which a crop moves.
    assert difference(130, 168) < 1e-3
    assert min(difference(131, 168), difference(130, 169)) > 20 * difference(130, 168)
    assert torch.equal(small.image_gradient, workload.image_gradient[130:170, 168:232])


def test_crop_must_fit() -> None:
    with pytest.raises(ValueError, match="cannot crop 400x300 to 401x10"):
        synthetic_workload("A20k").crop(401, 10)


def test_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match="'X1'; choose one of A20k, B100k, C500k"):
        synthetic_workload("X1")


def test_scene_file_is_seen_whole_and_without_broken_splats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = RawSplats(*(tensor[:500].clone() for tensor in synthetic_workload("A20k").splats))
    source.means.add_(torch.tensor([10.0, -3.0, 7.0]))
    path = tmp_path / "scene.ply"
    save(source, path)
    whole = scene_workload(path)
    assert str(whole) == "scene.ply 800x533"
    assert float((render(whole.splats, whole.camera).radii > 0).float().mean()) > 0.7
    assert [workload.name for workload in workloads(Scope((1,), scene=path))] == ["scene.ply"]
    # Our own writer drops such rows; files of others have them.
    source.opacities[3] = torch.nan
    monkeypatch.setattr("nsvq_lightning.commands.benchmark.workloads.load", lambda _: Splats.from_tensors(*source))
    assert len(scene_workload(path).splats.means) == 499


def test_empty_scene_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.ply"
    save(Splats(3), path)
    with pytest.raises(ValueError, match="no splat"):
        scene_workload(path)


def test_folder_is_seen_by_its_first_train_camera(demo_scene: Path, tmp_path: Path) -> None:
    scene = load_scene(demo_scene)
    (workload,) = workloads(Scope((1,), scene=demo_scene))
    assert str(workload) == "scene 96x72"
    assert workload.camera is not scene.cameras[0]
    assert torch.equal(workload.camera.viewmat, scene.cameras[scene.train[0]].viewmat)
    assert torch.equal(workload.splats.means, scene.points)
    path = tmp_path / "trained.ply"
    save(RawSplats(*(tensor[:50] for tensor in synthetic_workload("A20k").splats)), path)
    other = single_workload(Scope((1,), scene=demo_scene, init_from=path), "B100k")
    assert str(other) == "scene trained.ply 96x72"
    assert torch.equal(other.camera.viewmat, workload.camera.viewmat)
    assert len(other.splats.means) == 50


def test_quick_runs_take_the_smallest_scene() -> None:
    assert single_workload(Scope((1,), quick=True), "B100k").name == "A20k"


def test_views_are_photos_of_the_workload_from_around(tmp_path: Path) -> None:
    source = synthetic_workload("A20k").crop(64, 48)
    scene = load_scene(write_views(source, tmp_path / "views", views=9))
    assert len(scene) == 9
    middle = scene.view(4)
    torch.testing.assert_close(middle.camera.viewmat, source.camera.viewmat)
    assert middle.camera.intrinsics == pytest.approx(source.camera.intrinsics)
    expected = FADING * render(source.splats, source.camera).image.clamp(0, 1)
    assert float((middle.image / 255 - expected).abs().max()) < 0.51 / 255
    # All look at the middle of the splats from the same distance.
    depth = [float((source.splats.means @ c.viewmat[2, :3] + c.viewmat[2, 3]).median()) for c in scene.cameras]
    assert max(depth) - min(depth) < 0.05 * max(depth)
    turns = [float(torch.linalg.vector_norm(c.viewmat[:3, :3] - source.camera.viewmat[:3, :3])) for c in scene.cameras]
    assert turns[0] == pytest.approx(turns[-1], rel=1e-3)
    assert turns[0] > turns[3] > 0.05
