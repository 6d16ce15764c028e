"""Whether a folder is a good scene."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from nsvq_lightning.commands.doctor.budget import check_budget
from nsvq_lightning.commands.doctor.finding import Finding, good, note, problem, report
from nsvq_lightning.commands.doctor.model_checks import check_cameras, check_overlap, check_points
from nsvq_lightning.commands.doctor.photo_checks import (
    check_exposure,
    check_masks,
    check_photos,
    check_sizes,
    read_photos,
)
from nsvq_lightning.data.colmap import ColmapModel, larger_models
from nsvq_lightning.data.scene import ONE_PLACE, Scene, load_scene
from nsvq_lightning.data.transforms import read_poses

__all__ = ["check_folder"]

FEW_VIEWS = 20
IMAGES = "images"

T = TypeVar("T")


def check_folder(root: Path) -> Iterator[Finding]:
    """All findings about a scene folder; an unusable folder is a finding, not an exception."""
    model, failures = _attempt("model", lambda: read_poses(root, observations=True))
    yield from failures
    if model is None:
        return
    larger = larger_models(root) if model.source == "COLMAP" else None
    if larger is not None:
        yield problem("model", larger)
    for subject, check in (("cameras", check_cameras), ("points", check_points), ("overlap", check_overlap)):
        yield from report(subject, lambda check=check: check(model))  # type: ignore[misc]
    scene, failures = _attempt("scene", lambda: load_scene(root))
    yield from failures
    if scene is not None:
        yield from _check_scene(scene, model)


def _check_scene(scene: Scene, model: ColmapModel) -> Iterator[Finding]:
    yield from report("sizes", lambda: check_sizes(scene, model))
    with _quiet():
        photos, failures = _attempt("photos", lambda: read_photos(scene, model))
    yield from failures
    if photos is not None:
        yield from report("photos", lambda: check_photos(scene, photos, scene.root / (model.images_folder or IMAGES)))
        yield from report("masks", lambda: check_masks(scene, photos))
        yield from report("exposure", lambda: check_exposure(scene, photos))
    yield from report("split", lambda: _check_split(scene))
    yield from report("extent", lambda: _check_extent(scene))
    yield from report("run time", lambda: check_budget(scene))


def _check_split(scene: Scene) -> Iterator[Finding]:
    text = f"{len(scene.train)} train and {len(scene.test)} test photos ({scene.split})"
    values = {"train": len(scene.train), "test": len(scene.test)}
    if len(scene.train) < FEW_VIEWS:
        help_ = "what lies between them is guessed, and the test score says little; take more photos"
        yield note("split", f"{text}: few; {help_}", **values)
    else:
        yield good("split", text, **values)


def _check_extent(scene: Scene) -> Iterator[Finding]:
    if not scene.extent > 0:
        yield problem("extent", f"all train photos {ONE_PLACE}", extent=scene.extent)
        return
    yield good(
        "extent", f"{scene.extent:.3g} scene units, 1.1 × the farthest camera from their mean", extent=scene.extent
    )


def _attempt(subject: str, make: Callable[[], T]) -> tuple[T | None, list[Finding]]:
    """The result of a loader, or its error as a finding."""
    made: list[T] = []

    def check() -> list[Finding]:
        made.append(make())
        return []

    findings = list(report(subject, check))
    return (made[0] if made else None), findings


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the loaders' warnings, which would appear in the middle of the report that says the same."""
    log = logging.getLogger("nsvq_lightning")
    before, log.level = log.level, logging.ERROR
    try:
        yield
    finally:
        log.setLevel(before)
