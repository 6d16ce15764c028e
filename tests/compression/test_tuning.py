"""Tuning a quantized scene on the pictures of the original."""

from __future__ import annotations

import numpy as np
import pytest
from ring import cameras_around
from splat_scenes import ball

from nsvq_lightning.compression.ladder import LADDER, Compressor
from nsvq_lightning.compression.pictures import picture_error, pictures
from nsvq_lightning.compression.tuning import tuned
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.splats.splats import RawSplats

ORIGINAL = RawSplats(*(tensor.detach() for tensor in ball(600).to_splats().raw()))
VIEWS = cameras_around(ball(600).means, 12, 80, 60)


@pytest.fixture(scope="module")
def quantized() -> CompressedScene:
    """The scene with 32 codes each, its splats in the order of the original."""
    sizes = {"quats": 32, "scales": 32, "sh0": 32, "shN": 32}
    return Compressor(ball(600), VIEWS[:4], Storage())._quantized(sizes)


def error(scene: CompressedScene) -> float:
    """In views that tuning does not use."""
    others = cameras_around(ball(600).means, 7, 96, 64)
    return picture_error(scene.decode(), others, pictures(ORIGINAL, others))


def test_pictures_come_nearer_in_other_views_too(quantized: CompressedScene) -> None:
    found = tuned(quantized, ORIGINAL, VIEWS, 60, 0)
    assert error(found) < 0.92 * error(quantized)
    for name, codes in quantized.codes.items():
        np.testing.assert_array_equal(found.codes[name], codes)
    assert found.codebooks["sh0"].shape == quantized.codebooks["sh0"].shape


def test_no_steps_change_nothing_and_the_same_steps_give_the_same_bits(quantized: CompressedScene) -> None:
    assert tuned(quantized, ORIGINAL, VIEWS, 0, 0) is quantized
    first, second, other = (tuned(quantized, ORIGINAL, VIEWS, 3, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.codebooks["quats"], second.codebooks["quats"])
    np.testing.assert_array_equal(first.means, second.means)
    assert not np.array_equal(first.means, other.means)


def test_the_compressor_tunes_what_has_codebooks() -> None:
    rung = LADDER[-1]
    plain, steps = (Compressor(ball(600), VIEWS, Storage(), tuning=count).at(rung) for count in (0, 40))
    assert steps.error < 0.95 * plain.error
