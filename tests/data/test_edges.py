"""Edges of photos: against the filter written out, and computed once a photo."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from nsvq_lightning.data import edges
from nsvq_lightning.data.edges import edges_of
from nsvq_lightning.data.scene import load_scene


def test_strength_is_what_a_pixel_has_above_its_neighbours() -> None:
    image = torch.randint(0, 256, (20, 30, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    grey = np.pad(cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY).astype(np.int64), 1, mode="reflect")
    around = sum(np.roll(grey, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1))
    passed = torch.from_numpy((9 * grey - around)[1:-1, 1:-1].clip(0, 255)).float()
    expected = (passed - passed.min()) / (passed.max() - passed.min())
    torch.testing.assert_close(edges_of(image).strength(), expected)


def test_edges_of_masks_do_not_count() -> None:
    kept = torch.zeros(32, 40, dtype=torch.bool)
    kept[:, 9:] = True
    image = torch.full((32, 40, 3), 90, dtype=torch.uint8)
    image[~kept] = 0
    assert edges_of(image).strength().max() == 1
    assert edges_of(image, kept).strength().max() == 0


@pytest.mark.parametrize("room", [0, 1, 9])
def test_edges_are_found_once_while_there_is_room_beside_the_photos(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    photos = load_scene(demo_scene).images.nbytes
    scene = load_scene(demo_scene, cache_bytes=photos + room * photos // 27)  # a byte a pixel, nine photos
    calls: list[int] = []
    monkeypatch.setattr("nsvq_lightning.data.images.edges_of", lambda *pair: calls.append(1) or edges.edges_of(*pair))
    found = [[scene.images.edges(index) for index in range(len(scene))] for _ in range(2)]
    assert len(calls) == 2 * len(scene) - room
    for index, (first, second) in enumerate(zip(*found, strict=True)):
        assert torch.equal(first.values, second.values)
        assert torch.equal(first.strength(), edges_of(*scene.images[index]).strength())
