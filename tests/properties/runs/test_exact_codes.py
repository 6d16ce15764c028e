"""The codes that training uses are the nearest ones, at every step and for every attribute."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from runs import fit
from torch import Tensor, nn

from nsvq_lightning.callbacks import CodebookInit, CodebookReplacement, PhaseSchedule
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.quantize import CodebookQuantizer, nearest_reference
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.module import SplatModule

WARM_UP = 30
"""Steps before the codebooks start, so that rows differ."""
TIE = 1e-5
"""Two codes whose distances differ by less than this share are equally near in float32."""


class Witness:
    """Compares the codes of every forward pass of a quantizer with a search over all codes in float64."""

    def __init__(self) -> None:
        self.steps: Counter[str] = Counter()
        self.rows: Counter[str] = Counter()
        self.ties: Counter[str] = Counter()
        self.moves: Counter[str] = Counter()
        self._last: dict[str, Tensor] = {}

    def watch(self, name: str, quantizer: nn.Module) -> None:
        def compare(module: nn.Module, arguments: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
            assert isinstance(module, CodebookQuantizer)
            table, _, rows = arguments
            self._compare(name, table.detach(), rows, module.codebook.detach().double(), output[1])

        quantizer.register_forward_hook(compare)

    def _compare(self, name: str, table: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor) -> None:
        x = table[rows].double()
        expected = nearest_reference(x, codebook)
        other = codes != expected
        found, least = ((x - codebook[chosen])[other].norm(dim=1) for chosen in (codes, expected))
        assert bool((found <= least * (1 + TIE)).all()), f"{name}, step {self.steps[name]}: {found - least}"
        self.steps[name] += 1
        self.rows[name] += len(rows)
        self.ties[name] += int(other.sum())
        last = self._last.setdefault(name, torch.full((len(table),), -1))
        self.moves[name] += int(((last[rows] != codes) & (last[rows] >= 0)).sum())
        last[rows] = codes


def train(scene: Path, factor: Any, points: int, steps: int) -> Witness:
    """The quantize phase from the first codebooks on, with replacements, witnessed."""
    data = ColmapDataModule(str(scene), factor=factor)
    some = slice(None, None, -(-len(data.scene.points) // points))
    splats = Splats.from_points(data.scene.points[some], data.scene.colors[some], sh_degree=3)
    module = SplatModule(codebooks={"scales": 300, "quats": 300, "sh0": 100, "shN": 100}, splats=splats)
    module.active_sh_degree = 3
    witness = Witness()
    for name, quantizer in module.codebooks.items():
        witness.watch(name, quantizer)
    total, every = WARM_UP + steps, max(10, steps // 20)
    phases = PhaseSchedule(
        reference_total=None,
        warmup_end=WARM_UP,
        prune_end=WARM_UP,
        quantize_end=total,
        min_replacement_interval=every,
    )
    replacement = CodebookReplacement(WARM_UP + every, total, every, total, every)
    fit(module, data, [phases, CodebookInit(), replacement], total)
    return witness


def check(witness: Witness, steps: int) -> None:
    assert dict(witness.steps) == dict.fromkeys(("scales", "quats", "sh0", "shN"), steps)
    for name, rows in witness.rows.items():
        assert witness.ties[name] <= 1e-3 * rows, name
        # Otherwise a tracker that never looks again would pass, too.
        assert witness.moves[name] > steps, name


def test_codes_in_training_are_the_nearest(demo_scene: Path) -> None:
    check(train(demo_scene, 2, 500, 40), 40)


@pytest.mark.long
@pytest.mark.parametrize("name", ["fox", "horns"])
def test_codes_in_a_thousand_steps_on_a_real_scene(shared_scenes: Path, name: str) -> None:
    if not (shared_scenes / name).is_dir():
        pytest.skip(f"the capture {name} is not here")
    check(train(shared_scenes / name, 8, 1500, 1000), 1000)
