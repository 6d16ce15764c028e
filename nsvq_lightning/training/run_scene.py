"""What a run takes from its scene: extent, background, first splats, how much each splat shows in the train views."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from lightning.pytorch import Trainer
from scipy.spatial import cKDTree
from torch import Tensor
from torch.optim import Optimizer

from nsvq_lightning.compute.memory import trim
from nsvq_lightning.data.dense_start import dense_points, far_points
from nsvq_lightning.data.scene import FEW_POINTS, ONE_PLACE, Scene, View, check_cameras, check_colors, colors_at, spread
from nsvq_lightning.io.formats import read_scene
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.frame import EXTENT
from nsvq_lightning.splats.splats import RawSplats, Splats, SplatTensors, detached, distinct_rows
from nsvq_lightning.top_level import log
from nsvq_lightning.training.distributed import sum_over_processes
from nsvq_lightning.training.importance import contributions, sensitivity
from nsvq_lightning.training.splat_scene import SplatScene

# First splats of a run with a budget (docs/recipe.md): opacity; largest size in pixels of the usual photo, from the
# nearest camera, as a lone point would hide what is behind it; most points of those that there are, as a multiple of
# those to start with; share of the photos in which points must lie, as a scanner that reaches a few metres has many
# points there, and none behind.
FIRST_OPACITY, MAX_PIXELS, MAX_POINTS, MIN_COVERED = 0.3, 50.0, 8, 0.75
# A point is lone whose neighbours are farther than this share of its distance from the nearest camera, and in the way
# if that distance is below this share of the median: of SfM's points of six scenes, at most 0.16 % are.
LONE, NEAR_BY = 0.1, 0.3


def scene_of(trainer: Trainer | None) -> Scene | None:
    """The scene of the trainer's data module; None if it has none, or a name of its own."""
    scene = getattr(getattr(trainer, "datamodule", None), "scene", None)
    return scene if hasattr(scene, "train") else None


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


# What contributions need, and what to do without.
FOR_WEIGHTS = "contributions of splats need the train views", "take CodebookInit(weighted=False)"


def train_contributions(trainer: Trainer, trained: SplatScene) -> Tensor:
    """Blending weight ``[N]`` of each splat in all train views (:mod:`nsvq_lightning.training.importance`).

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    scene = needed_scene(trainer, *FOR_WEIGHTS)
    cameras = scene.train_cameras[trainer.global_rank :: trainer.world_size]
    return sum_over_processes(trainer, contributions(trained.splats, cameras, trained.render))


def train_sensitivities(
    trainer: Trainer, trained: SplatScene, seed: int, splats: SplatTensors, most: int
) -> Iterator[tuple[View, RawSplats, Tensor]]:
    """How much the numbers of splats show in the train views: each view, its estimate and its picture.

    See :func:`nsvq_lightning.training.importance.sensitivity`.

    Args:
        trainer: The trainer; several processes share the views.
        trained: Renders the splats.
        seed: Seed of the run.
        splats: Raw attributes.
        most: Most views to render, or a fourth of the train photos where that is more.

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    need = "what shows of splats is seen in the train views"
    scene = needed_scene(trainer, need, "leave out the callbacks that ask (selection, rate_distortion)")
    for index in telling_views(scene, most)[trainer.global_rank :: trainer.world_size]:
        view = scene.view(index).to(splats.means.device)
        signs = generator(seed, trainer.global_step, "signs", index)
        yield view, *sensitivity(splats, view.camera, trained.render, signs, view.mask)


def telling_views(scene: Scene, most: int) -> Sequence[int]:
    """At most so many of the train views, or a fourth of them where that is more.

    Of a walk, few photos show each place, and splats that none of these shows would cost nothing.
    """
    return spread(scene.train, max(most, len(scene.train) // 4))


def extent_of(trainer: Trainer) -> float:
    """Extent of the trainer's scene in its frame, above 0.

    Raises:
        ValueError: There is no scene, or all its cameras are in one place.
    """
    scene = needed_scene(trainer, "the extent of the scene is unknown", "set the module's extent")
    if scene.extent <= 0.0:
        raise ValueError(f"the {len(scene)} photos of {scene.root} {ONE_PLACE}")
    return EXTENT


def camera_distances(cameras: Iterable[Camera], means: Tensor) -> Tensor:
    """Distance ``[N]`` of positions ``[N, 3]`` from the nearest camera, at least the near plane's; finite."""
    distances, _ = cKDTree([camera.packed_view[12:] for camera in cameras]).query(means.nan_to_num().cpu())
    return torch.from_numpy(distances).to(means).clamp_min(NEAR)


def move_by_distance(trainer: Trainer, optimizer: Optimizer, splats: Splats, extent: float) -> None:
    """Multiply the steps of positions by their distance from the nearest train camera over the extent.

    It is the distance that a splat had when it was added. Without a scene, steps are as they are.
    """
    scene = scene_of(trainer)
    if scene is None:
        return
    starts: list[Tensor] = []
    edits = -1

    def scale(*_: object) -> None:
        nonlocal edits
        means, distances = splats.means.detach(), splats.add_table("distance")
        if edits != splats.edits:
            edits = splats.edits
            new = distances == 0
            distances[new] = camera_distances(scene.standard.train_cameras, means[new])
        torch.lerp(starts.pop(), means, (distances / extent)[:, None], out=means)

    optimizer.register_step_pre_hook(lambda *_: starts.append(splats.means.detach().clone()))
    optimizer.register_step_post_hook(scale)


def splats_of_file(path: str, trained: SplatScene) -> Splats:
    """The splats of a scene file of any format, without non-finite ones, in the frame of a run that starts from them.

    Raises:
        ValueError: They have another SH degree.
    """
    scene = read_scene(path)
    middle = np.median(scene.means, axis=0)
    # Most formats cannot say an origin: their positions are the world's, or relative to that of the run they are of.
    if any(scene.origin) or np.linalg.norm(middle - trained.frame.origin) < np.linalg.norm(middle):
        scene = scene.relative_to(trained.frame.origin)
    degree, own = scene.sh_degree, trained.splats.sh_degree
    if degree != own:
        raise ValueError(f"{path} has SH degree {degree}, the module {own}; set sh_degree={degree}")
    for name in "antialiased", "background":
        was, now = scene.config.get(name), getattr(trained, name)
        if was not in (None, now):
            log.warning(f"{path} was trained with {name}={was}, this run has {now}: it looks different at first")
    return Splats.from_tensors(*trained.frame.splats(scene.decode()))


def warn_of_others(trainer: Trainer, splats: Splats, own: bool) -> None:
    """Warn where the trainer's photos do not show the splats that it starts from, in its frame.

    Args:
        trainer: The trainer.
        splats: The splats.
        own: Whether they are of the scene's own points, of which some photos may show few.
    """
    scene = scene_of(trainer)
    if scene is None or (own and not scene.cloud) or not trainer.is_global_zero:
        return
    try:
        check_cameras(scene.standard.train_cameras, splats.means.numpy(force=True))
        if not own:
            check_colors(scene.standard, splats.means.numpy(force=True), splats.sh0.numpy(force=True))
    except ValueError as error:
        log.warning(f"the splats to start from do not fit the photos of {scene.root}: its {error}")


def first_splats(trainer: Trainer, sh_degree: int, count: int | None, seed: int) -> Splats:
    """A splat for each point of the trainer's scene, in its frame.

    Args:
        trainer: The trainer.
        sh_degree: Of the splats, whose higher coefficients are 0.
        count: How many points, of SfM and, where these are fewer, of the flow between photos; far ones come on top
            (:mod:`nsvq_lightning.data.dense_start`). None for those of SfM alone, as in 3DGS.
        seed: Of the dense start.

    Raises:
        ValueError: The trainer has no data module with a scene.
        SceneError: A photo cannot be decoded.
    """
    scene = needed_scene(trainer, "no splats to start from", "set init_from").standard
    if count is None:
        return Splats.from_points(scene.points, scene.colors, sh_degree)
    rows = distinct_rows(scene.points)  # meshes have a corner once for each of its triangles
    grey = scene.grey or len(rows) < FEW_POINTS
    scene = replace(scene, points=scene.points[rows], colors=scene.colors[rows], grey=grey)
    if any(source.masked for source in scene.images.sources):
        # What is always masked is not trained, only in the way.
        scene = scene.thinned(MAX_POINTS * count or len(scene.points))
        shown = torch.from_numpy(colors_at(scene, scene.points.double().numpy(), 1)[1][:, 0] > 0)
        scene = replace(scene, points=scene.points[shown], colors=scene.colors[shown]) if shown.any() else scene
    is_part = len(scene.points) > count // 2 and scene.covered() < MIN_COVERED
    points, colors = _with_dense_points(scene, count, seed, least=count // 2 if is_part else 0)
    points, colors = (torch.cat(parts) for parts in zip((points, colors), far_points(scene, points), strict=True))
    splats = Splats.from_points(points, colors, sh_degree, FIRST_OPACITY)
    cameras = scene.train_cameras
    apart = camera_distances(cameras, splats.means.detach())
    if len(splats) > 2 * FEW_POINTS:  # of a few, each is lone
        kept = (splats.scales[:, 0].exp() < LONE * apart) | (apart > NEAR_BY * apart.median())
        splats, apart = Splats.from_tensors(*(values[kept] for values in detached(splats))), apart[kept]
    pixel = apart / float(np.median([camera.intrinsics[0] for camera in cameras]))
    splats.scales.data.clamp_(max=(MAX_PIXELS * pixel).log()[:, None])
    return splats


def _with_dense_points(scene: Scene, count: int, seed: int, least: int = 0) -> tuple[Tensor, Tensor]:
    """Positions and colours ``[P, 3]`` of the points of SfM and, up to ``count``, or ``least``, of the dense start.

    Those without colours stay only where that finds too few, or photos are white around their objects. Of many more
    points than that, some are taken: splats get their sizes from the distances of these, and most would go.
    """
    fills = scene.grey and not scene.white
    points, colors = (spread(each, MAX_POINTS * count or len(each)) for each in (scene.points, scene.colors))
    known = 0 if fills else len(points)
    room = max(count - known, least)
    if room <= 0:
        return points, colors
    start = time.perf_counter()
    dense, dense_colors = dense_points(scene, room, seed)
    trim()
    log.info(f"dense start: {len(dense)} points beside {known} of SfM, {time.perf_counter() - start:.1f} s")
    if 2 * len(dense) < (room if fills else 1):
        log.warning(
            "photos show little to follow, or hardly move: training starts from SfM's points, or random ones; are the "
            "cameras right (focal lengths in pixels; in a transforms file camera to world, y up, z backward)?"
        )
    order, most = slice(None, None, -1 if fills else 1), known + room
    return torch.cat([points, dense][order])[:most], torch.cat([colors, dense_colors][order])[:most]


def background_of(scene: Scene, asked: str) -> str:
    """What the photos have behind their objects, for ``asked="auto"``; otherwise ``asked``.

    Raises:
        ValueError: The photos are shown on white, and another background was asked for.
    """
    if scene.white and asked not in ("auto", "white"):
        raise ValueError(
            f"the photos of {scene.root} are white around their objects, model.background is {asked}: leave it at auto"
        )
    return asked if asked != "auto" else "white" if scene.white else "black"
