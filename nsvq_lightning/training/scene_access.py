"""What callbacks need from the train views, on all processes."""

from collections.abc import Iterator

from lightning.pytorch import Trainer
from torch import Tensor

from nsvq_lightning.compression.importance import contributions
from nsvq_lightning.data.scene import Scene
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.training.distributed import sum_over_processes
from nsvq_lightning.training.scene_module import SceneModule


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


def train_cameras(trainer: Trainer, *, share: bool = False) -> Iterator[Camera]:
    """Cameras of the train views; with ``share`` only this process's part of them.

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    scene = needed_scene(
        trainer,
        "contributions of splats and the floor of scales need the train views",
        "leave contribution pruning, weights by contribution and the floor off",
    )
    indices = scene.train[trainer.global_rank :: trainer.world_size] if share else scene.train
    return (scene.cameras[index] for index in indices)


def train_contributions(trainer: Trainer, module: SceneModule) -> Tensor:
    """Blending weight ``[N]`` of each splat in all train views (:mod:`nsvq_lightning.compression.importance`).

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    cameras = train_cameras(trainer, share=True)
    return sum_over_processes(trainer, contributions(module.splats, cameras, module.render_splats))
