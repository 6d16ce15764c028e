"""What a run has made of its scene, without Lightning: rendered as it is trained, stored as it is rendered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from splat_scenes import front_camera, random_splats
from torch import Tensor

from nsvq_lightning.quantize import NSVQ, PostHoc, Quantizer
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.splat_scene import SplatScene

CAMERA = front_camera()


def scene_of_splats(**replaced: Any) -> SplatScene:
    splats = Splats.from_tensors(*random_splats(30, sh_degree=1))
    settings: dict[str, Any] = {
        "frame": Frame(),
        "background": "black",
        "antialiased": False,
        "backend": "auto",
        "sh_degree": 1,
        "cameras": np.zeros((0, 4)),
    }
    return SplatScene(splats, {}, **settings | replaced)


def with_codebooks(scene: SplatScene, kind: type[Any], **codes: int) -> SplatScene:
    made: dict[str, Quantizer] = {}
    for name, count in codes.items():
        rows = scene.rows(name)
        made[name] = kind(count, rows.shape[1])
        made[name].fit(rows, generator=generator(0, 0, name))
    return replace(scene, quantizers=made)


def test_a_scene_is_rendered_with_its_own_settings() -> None:
    scene = scene_of_splats()
    raw = scene.splats.raw()
    assert torch.equal(scene.render(raw, CAMERA).image, render(raw, CAMERA, sh_degree=1).image)
    flat = replace(scene, sh_degree=0, background="white", antialiased=True)
    white = torch.ones(3)
    expected = render(raw, CAMERA, sh_degree=0, background=white, antialiased=True).image
    assert torch.equal(flat.render(raw, CAMERA).image, expected)
    assert torch.equal(
        flat.render(raw, CAMERA, sh_degree=1, background=None, antialiased=False).image, render(raw, CAMERA).image
    )
    # Other splats may have fewer coefficients than are rendered of the scene's own.
    other = random_splats(5, sh_degree=0)
    assert torch.equal(scene.render(other, CAMERA).image, render(other, CAMERA).image)


def test_files_and_cameras_have_other_coordinates_than_the_splats() -> None:
    """The pictures of a scene that is trained in a frame are those of what it stores, from the same camera."""
    scene = scene_of_splats(frame=Frame(2.0, (0.5, -0.25, 1.0)))
    stored = scene.compressed(Phase.WARMUP, {}).decode()
    seen = scene.render(scene.splats.raw(), CAMERA).image
    torch.testing.assert_close(render(stored, CAMERA).image, seen, atol=2e-5, rtol=0)
    assert not torch.allclose(stored.means, scene.splats.means)


def test_files_hold_codes_from_the_quantize_phase_on() -> None:
    scene = with_codebooks(scene_of_splats(), NSVQ, scales=6, sh0=4)
    for phase in Phase:
        hard, stored = scene.hard_splats(phase), scene.compressed(phase, {})
        assert bool(stored.codes) == (phase >= Phase.QUANTIZE)
        decoded = stored.decode()
        for name in ATTRIBUTES:
            assert torch.equal(getattr(decoded, name), getattr(hard, name)), (phase, name)
            assert not getattr(hard, name).requires_grad
    assert len(torch.unique(scene.hard_splats(Phase.QUANTIZE).scales, dim=0)) <= 6


def test_codebooks_that_are_fitted_for_an_evaluation_are_trained_afterwards() -> None:
    scene = with_codebooks(scene_of_splats(), PostHoc, scales=6)
    with torch.no_grad():
        scene.splats.scales.zero_()
    with torch.inference_mode():
        scene.hard_splats(Phase.QUANTIZE)
    assert len(scene.quantizers["scales"].codebook) == 1
    quantizer = scene.quantizers["scales"]
    assert not any(each.is_inference() for each in (*quantizer.parameters(), *quantizer.buffers()))


def test_before_the_codebooks_everything_is_stored_as_it_is(caplog: pytest.LogCaptureFixture) -> None:
    scene = with_codebooks(scene_of_splats(), NSVQ, scales=6)
    stored = scene.compressed(Phase.PRUNE, {})
    assert "the prune phase has no codebooks yet: the scene is stored unquantized" in caplog.text
    assert not stored.codes
    assert stored.config["codebooks"] == {}


class Tenth(NSVQ):
    """Decodes to something else than its codebook, which is all that files hold."""

    def decode(self, codes: Tensor) -> Tensor:
        return super().decode(codes) / 10


def test_codebooks_that_files_cannot_hold_are_refused() -> None:
    scene = replace(scene_of_splats(), quantizers={"scales": NSVQ(6, 3)})
    with pytest.raises(ValueError, match="the codebook of scales has never been placed: add CodebookInit"):
        scene.compressed(Phase.QUANTIZE, {})
    with pytest.raises(ValueError, match="Tenth of sh0 decodes to other rows than its codebook's"):
        with_codebooks(scene_of_splats(), Tenth, sh0=4).compressed(Phase.QUANTIZE, {})


def test_the_sizes_of_codebooks_that_storing_places_are_those_that_it_placed() -> None:
    scene = scene_of_splats()
    scene = replace(scene, quantizers={"scales": PostHoc(4096, 3), "sh0": PostHoc(8, 3)})
    for _ in range(2):
        stored = scene.compressed(Phase.QUANTIZE, {"seed": 3})
        assert stored.config["codebooks"] == {"scales": 30, "sh0": 8}
        assert stored.config["quantizers"] == {"scales": "PostHoc", "sh0": "PostHoc"}
        assert stored.config["seed"] == 3
        assert {name: len(rows) for name, rows in stored.codebooks.items()} == stored.config["codebooks"]


def test_the_file_says_how_it_is_to_be_shown() -> None:
    scene = scene_of_splats(background="white")
    assert scene.compressed(Phase.WARMUP, {}).config["background"] == "white"
    assert "antialiased" not in scene.compressed(Phase.WARMUP, {}).config
    assert replace(scene, antialiased=True).compressed(Phase.WARMUP, {}).config["antialiased"] is True


def test_nothing_cannot_be_stored() -> None:
    with pytest.raises(ValueError, match="there are no splats to store or to measure"):
        replace(scene_of_splats(), splats=Splats(1)).compressed(Phase.WARMUP, {})
