"""A run through all phases whose kernels work between guard words; other runs of these tests do without, for speed."""

from __future__ import annotations

from collections.abc import Callable

from guards import guarded
from lightning.pytorch import Trainer
from runs import Recipe

from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import run_folder


def test_no_kernel_of_a_run_writes_beside_its_arrays(
    run: Callable[..., tuple[Trainer, SplatModule]], recipe: Recipe
) -> None:
    with guarded():
        between_guards, _ = run(recipe().values())
    alone, _ = run(recipe().values())
    files = [(run_folder(trainer) / "scene.nsvq").read_bytes() for trainer in (between_guards, alone)]
    assert files[0] == files[1]
