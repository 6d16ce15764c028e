"""What a run takes from the scene of its data module: its start, and what callbacks need from the train views."""

import logging
import os

import torch
from lightning.pytorch import Trainer
from torch import Tensor

from nsvq_lightning.compression.importance import contributions
from nsvq_lightning.compute.environment import threads_spin
from nsvq_lightning.data.scene import ONE_PLACE, Scene
from nsvq_lightning.io.formats import load
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.distributed import sum_over_processes
from nsvq_lightning.training.row_ops import finite_splats
from nsvq_lightning.training.scene_module import SceneModule

log = logging.getLogger(__name__)


def scene_of(trainer: Trainer | None) -> Scene | None:
    """The scene of the trainer's data module; None if it has none."""
    scene: Scene | None = getattr(getattr(trainer, "datamodule", None), "scene", None)
    return scene


def needed_scene(trainer: Trainer, need: str, otherwise: str) -> Scene:
    """The scene of the trainer's data module.

    Args:
        trainer: The trainer.
        need: What needs it, for the error.
        otherwise: What to do where there is none.

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    scene = scene_of(trainer)
    if scene is None:
        raise ValueError(f"{need}: fit with a data module that has a scene, or {otherwise}")
    return scene


def train_contributions(trainer: Trainer, module: SceneModule) -> Tensor:
    """Blending weight ``[N]`` of each splat in all train views (:mod:`nsvq_lightning.compression.importance`).

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    need = "contributions of splats need the train views"
    scene = needed_scene(trainer, need, "leave weights by contribution off")
    cameras = (scene.cameras[index] for index in scene.train[trainer.global_rank :: trainer.world_size])
    return sum_over_processes(trainer, contributions(module.splats, cameras, module.render_splats))


def extent_of(scene: Scene | None) -> float:
    """Extent of the scene, scene units, above 0.

    Raises:
        ValueError: There is no scene, or all its cameras are in one place.
    """
    if scene is None:
        raise ValueError("the extent of the scene is unknown; fit with a data module that has a scene")
    if scene.extent <= 0.0:
        raise ValueError(f"the {len(scene.train)} train photos of {scene.root} {ONE_PLACE}")
    return scene.extent


def first_splats(path: str | None, scene: Scene | None, sh_degree: int) -> Splats:
    """The splats of a scene file without the non-finite ones, or one for each point of the scene.

    Args:
        path: Scene file of any format; None for the points.
        scene: The photos' scene, if there is one.
        sh_degree: Degree of the module's spherical harmonics.

    Raises:
        ValueError: There is neither, or the file has another degree.
    """
    if path is None:
        if scene is None:
            raise ValueError("no splats to start from: fit with a data module that has a scene, or set init_from")
        return Splats.from_points(scene.points, scene.colors, sh_degree)
    loaded = load(path)
    if loaded.sh_degree != sh_degree:
        raise ValueError(
            f"{path} has SH degree {loaded.sh_degree}, the module has {sh_degree}; set sh_degree={loaded.sh_degree}"
        )
    return finite_splats(loaded, path)


def background_of(scene: Scene, asked: str) -> str:
    """What the photos have behind their objects, for ``asked="auto"``; otherwise ``asked``.

    Raises:
        ValueError: The photos are shown on white, and another background was asked for.
    """
    background = asked if asked != "auto" else "white" if scene.white else "black"
    if scene.white and background != "white":
        raise ValueError(
            f"the photos of {scene.root} are transparent around their objects and are shown on white, "
            f"model.background is {background}: leave it at auto"
        )
    return background


def warn_of_device(device: torch.device) -> None:
    """Warn of kernels that have never run on such a device, and of other processes that want the same cores."""
    if device.type == "cuda":
        log.warning(
            "training on %s with kernels that are tested under Triton's interpreter, but have never run on a GPU: "
            "--trainer.accelerator=cpu trains without them, and docs/backends.md says more",
            torch.cuda.get_device_name(device),
        )
    elif threads_spin() and torch.get_num_threads() > 1 and hasattr(os, "getloadavg") and os.getloadavg()[0] > 1.0:
        log.warning(
            "other processes also need the cores, and idle threads occupy them: a run may take twice as long; "
            "import nsvq_lightning before torch, or set OMP_WAIT_POLICY=passive"
        )
