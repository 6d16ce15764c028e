"""Photos on a device: moved once, kept within the budget, never those of another view."""

from __future__ import annotations

import pickle

import pytest
import torch

from nsvq_lightning.data import datamodule
from nsvq_lightning.data.datamodule import DevicePhotos
from nsvq_lightning.data.scene import View
from nsvq_lightning.rendering.camera import Camera

ELSEWHERE = torch.device("meta")
BYTES = 3 * 4 * 5


def view(index: int) -> View:
    return View(
        f"{index}.png", index, Camera(torch.eye(3), torch.eye(4), 5, 4), torch.zeros(4, 5, 3, dtype=torch.uint8)
    )


def test_on_a_cpu_nothing_is_moved_or_kept() -> None:
    photos, first = DevicePhotos(10 * BYTES), view(0)
    assert photos.move(first, torch.device("cpu")) is first


def test_the_first_photos_stay_while_the_budget_lasts() -> None:
    photos, views = DevicePhotos(2 * BYTES + 1), [view(i) for i in range(3)]
    first = [photos.move(each, ELSEWHERE) for each in views]
    again = [photos.move(each, ELSEWHERE) for each in views]
    assert [a.image is b.image for a, b in zip(first, again, strict=True)] == [True, True, False]
    assert all(moved.image.is_meta and moved.camera is each.camera for moved, each in zip(again, views, strict=True))
    assert all(moved.name == each.name for moved, each in zip(again, views, strict=True))


def test_a_photo_that_has_been_exchanged_is_moved_anew() -> None:
    photos, original, masked = DevicePhotos(10 * BYTES), view(0), view(0)
    kept = photos.move(original, ELSEWHERE)
    assert photos.move(masked, ELSEWHERE).image is not kept.image
    assert photos.move(original, ELSEWHERE).image is kept.image


def test_a_gpu_gives_a_part_of_what_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datamodule, "_spare", lambda _: BYTES)
    photos, views = DevicePhotos(10 * BYTES), [view(i) for i in range(2)]
    first = [photos.move(each, ELSEWHERE) for each in views]
    assert photos.move(views[0], ELSEWHERE).image is first[0].image
    assert photos.move(views[1], ELSEWHERE).image is not first[1].image


def test_photos_of_a_device_are_not_pickled() -> None:
    photos, first = DevicePhotos(10 * BYTES), view(0)
    kept = photos.move(first, ELSEWHERE)
    copy = pickle.loads(pickle.dumps(photos))
    assert copy.move(first, ELSEWHERE).image is not kept.image
