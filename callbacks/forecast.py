"""How long a run will take: steps measured on this machine, on the scene with as many splats as the run will have."""

import math
import time
from collections.abc import Sequence

import torch
from lightning.pytorch import Trainer

from nsvq_lightning.data.scene import Scene, View, detailed_pixels, spread
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import Splats, detached
from nsvq_lightning.training import optim, run_scene
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Schedule

from .growth import splats_for_photos

# An iteration of a run over a step as it is measured here: what callbacks, codebooks and the loop take.
LOOP = 1.3
# Views that a step is measured on; the first is rendered once more, before them.
VIEWS = 12


def step_seconds(scene: Scene, count: int, device: torch.device | str = "cpu") -> float:
    """Mean time of a training step without codebooks and callbacks: render, loss, backward pass and Adam.

    Args:
        scene: Its cameras, photos and points.
        count: Number of splats.
        device: Where to train.
    """
    scene = scene.standard.thinned(count)  # as many as a run takes
    splats = grown(scene, count).to(device)
    adam = optim.build_adam(optim.param_groups(splats, {}, optim.LearningRates(), scene.extent))
    views = [scene.view(index).to(device) for index in spread(scene.train, VIEWS)]

    def train(some: Sequence[View]) -> None:
        for view in some:
            adam.zero_grad()
            image = render(splats, view.camera).image
            photometric_loss(image, view.image, mask=view.mask).backward()  # type: ignore[no-untyped-call]
            del image
            adam.step()
        torch.get_device_module(device).synchronize()

    train(views[:1])  # compiles the kernels, and grows the buffers
    start = time.perf_counter()
    train(views)
    return (time.perf_counter() - start) / len(views)


def grown(scene: Scene, count: int) -> Splats:
    """The scene's points as splats, repeated with small shifts until there are ``count``, and shrunk to match.

    Args:
        scene: In its frame.
        count: Number of splats.
    """
    start = detached(Splats.from_points(scene.points, scene.colors))
    points = len(start.means)
    copies = math.ceil(count / points)
    rows = torch.arange(max(count, points)) % points
    copied = start.take(rows)
    draw = generator(0, 0, "forecast")
    # More splats cover the surfaces with smaller ones, and trained ones overlap in many layers. With these two numbers,
    # renders of fox, bonsai and photos of two megapixels take about as long as those of the trained scenes.
    shrunk = copied._replace(
        means=copied.means + copied.scales.exp() * torch.randn(len(rows), 3, generator=draw),
        scales=copied.scales - math.log(copies) / 2 + 0.5,
        opacities=torch.randn(len(rows), generator=draw) - 0.5,
    )
    return Splats.from_tensors(*shrunk)


# Splats of the paper's density control, on average over its run, as a multiple of the default for the photos.
PAPER_SPLATS = 4.0


def iteration_seconds(scene: Scene, parts: list[tuple[float, int]], device: torch.device | str = "cpu") -> float:
    """Mean time of an iteration of a run with so many splats in each share of its time."""
    return LOOP * sum(share * step_seconds(scene, count, device) for share, count in parts if share > 0)


def iterations_within(minutes: float, trainer: Trainer, module: SplatModule, schedule: Schedule) -> int:
    """How many iterations a run has time for, the same in all processes.

    Args:
        minutes: Time to train.
        trainer: Its data module has the scene.
        module: Has its budget, and says how splats grow.
        schedule: Phases of a run of any length.

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    scene = run_scene.needed_scene(trainer, "minutes are measured on the photos", "give trainer.max_steps")
    budget = module.splat_budget
    if budget is None:
        parts = [(1.0, round(PAPER_SPLATS * splats_for_photos(len(scene.train), detailed_pixels(scene))))]
    elif module.stretches is None:
        parts = [(1.0, budget)]
    else:
        parts = module.stretches(schedule, max(len(scene.points), module.first_points or 0), budget)
    seconds = trainer.accumulate_grad_batches * iteration_seconds(scene, parts, trainer.strategy.root_device)
    return int(trainer.strategy.broadcast(max(1, round(60 * minutes / seconds))))
