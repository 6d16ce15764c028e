"""Every quantizer through a whole run: file, frozen codes, refits, resume."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import Recipe, RunFactory, paper_phases, paper_replacement

from nsvq_lightning.callbacks import CodebookRefit, MetricReport, RunCheckpoint
from nsvq_lightning.io.nsvq.file import read_nsvq
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quantize import (
    CodebookQuantizer,
    DiVeQ,
    PostHoc,
    StraightThrough,
    TrainedStraightThrough,
    kmeans,
)
from nsvq_lightning.random import generator
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Phase

Quantizers = type[CodebookQuantizer]

KINDS = [StraightThrough, TrainedStraightThrough, DiVeQ, PostHoc]
PAPER = Storage("paper")  # stores codes and codebooks as they are
STEPS, PRUNE_END, MIDDLE, QUANTIZE_END = 60, 27, 46, 57


class Books(Callback):
    """Notes every codebook at the end of each step."""

    def __init__(self) -> None:
        self.at: dict[int, dict[str, torch.Tensor]] = {}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, SplatModule)
        self.at[trainer.global_step] = {n: q.codebook.detach().clone() for n, q in pl_module.quantizers.items()}


class MiddleCheckpoint(RunCheckpoint):
    """A checkpoint in the middle of the quantize phase."""

    def __init__(self) -> None:
        super().__init__(keep=True)

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        return iteration == MIDDLE


def scene_path(trainer: Trainer) -> Path:
    return run_folder(trainer) / "scene.nsvq"


def assert_nearest(codes: torch.Tensor, rows: torch.Tensor, book: torch.Tensor) -> None:
    """Codes are as near as any, by torch alone; of copies any will do."""
    distances = torch.cdist(rows.double(), book.double())
    torch.testing.assert_close(distances.gather(1, codes[:, None])[:, 0], distances.amin(1), rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module")
def quantized_recipe(recipe: Recipe) -> Recipe:
    """The recipe with refits that fit 60 steps, and without evaluations."""
    return lambda **replaced: recipe(codebook_refit=CodebookRefit(every=6000), report=Callback(), **replaced)


Finished = tuple[Quantizers, Trainer, SplatModule, Books]


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: kind.__name__)
def finished(request: pytest.FixtureRequest, run: RunFactory, quantized_recipe: Recipe) -> Finished:
    """A run through all phases with each quantizer; the callbacks are the same."""
    books = Books()
    callbacks = [*quantized_recipe(checkpoint=MiddleCheckpoint()).values(), books]
    trainer, module = run(callbacks, module={"quantizer": request.param, "storage": PAPER})
    return request.param, trainer, module, books


def in_files(module: SplatModule, name: str, codebook: torch.Tensor) -> np.ndarray:
    """A codebook of the module's frame in the unit of its files: lengths are logarithms."""
    rows = codebook.detach().numpy()
    return rows if name != "scales" else (rows + np.log(module.frame.unit)).astype(np.float32)


def test_the_file_holds_the_frozen_codes_and_the_fine_tuned_codebooks(finished: Finished) -> None:
    kind, trainer, module, books = finished
    stored = read_nsvq(scene_path(trainer))
    assert stored.config["quantizers"] == dict.fromkeys(module.quantizers, kind.__name__)
    for name, quantizer in module.quantizers.items():
        assert np.array_equal(stored.codes[name], quantizer.codes.numpy())
        assert np.array_equal(stored.codebooks[name], in_files(module, name, quantizer.codebook))
        # Raw attributes stand still in fine-tuning; codes are the nearest ones of its start.
        rows, book = module.scene.rows(name), books.at[QUANTIZE_END][name]
        assert_nearest(quantizer.codes, rows, kmeans(rows, len(book), generator(0)) if kind is PostHoc else book)
        assert not torch.equal(books.at[QUANTIZE_END + 1][name], books.at[STEPS][name])


def test_a_resumed_run_is_the_run_not_interrupted(
    finished: Finished, run: RunFactory, quantized_recipe: Recipe
) -> None:
    kind, trainer, _, _ = finished
    path = run_folder(trainer) / "checkpoints" / f"step-{MIDDLE}.ckpt"
    callbacks = quantized_recipe(checkpoint=RunCheckpoint(every=0)).values()
    resumed, _ = run(callbacks, ckpt_path=path, module={"quantizer": kind, "storage": PAPER})
    assert resumed.global_step == STEPS
    assert scene_path(resumed).read_bytes() == scene_path(trainer).read_bytes()


def test_what_moves_the_codebooks_in_the_quantize_phase(finished: Finished) -> None:
    kind, _, module, books = finished
    steps = set(range(PRUNE_END + 2, QUANTIZE_END + 1))
    refits = {i for i in steps if CodebookRefit(every=6000).is_due(module, i)}
    replacements = {i for i in steps if paper_replacement().is_due(module, i)}
    assert len(refits) == 3
    for name in module.quantizers:
        moved = {i for i in steps if not torch.equal(books.at[i][name], books.at[i - 1][name])}
        if kind is StraightThrough:
            assert refits <= moved <= refits | replacements
        else:
            assert moved == (set() if kind is PostHoc else steps)


def test_neither_the_order_of_callbacks_nor_accumulation_matters_to_refits(
    run: RunFactory, quantized_recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    module = {"quantizer": StraightThrough, "codebooks": {"scales": 24}}
    one, _ = run(quantized_recipe().values(), module=module)
    other, _ = run(list(quantized_recipe().values())[::-1], module=module)
    assert scene_path(one).read_bytes() == scene_path(other).read_bytes()
    with caplog.at_level("DEBUG", logger="nsvq_lightning"):
        run(quantized_recipe().values(), module=module, accumulate_grad_batches=2)
    assert len([line for line in caplog.messages if "refitted the codebook of scales" in line]) == 3


def test_post_hoc_stores_kmeans_of_the_final_rows(run: RunFactory, recipe: Recipe) -> None:
    def fit(report: Callback) -> tuple[Trainer, SplatModule]:
        phases = paper_phases(quantize_end=45_000, min_density_interval=4, min_reset_interval=11)
        return run(recipe(phases=phases, report=report).values(), module={"quantizer": PostHoc, "storage": PAPER})

    trainer, module = fit(Callback())
    assert module.phase is Phase.QUANTIZE
    stored = read_nsvq(scene_path(trainer))
    for name, quantizer in module.quantizers.items():
        rows = module.scene.rows(name)
        expected = kmeans(rows, quantizer.codebook.shape[0], generator(0))
        assert np.array_equal(stored.codebooks[name], in_files(module, name, expected))
        assert_nearest(torch.from_numpy(stored.codes[name].astype(np.int64)), rows, expected)
    # To look at it on the way changes nothing.
    assert scene_path(fit(MetricReport(every=7))[0]).read_bytes() == scene_path(trainer).read_bytes()


def test_the_table_of_the_docs_is_complete() -> None:
    path = Path(__file__).resolve().parents[3] / "docs" / "quantizers.md"
    if not path.exists():
        pytest.skip("a source distribution has no docs")
    page = path.read_text()
    assert all(f"| `{kind.__name__}` |" in page for kind in KINDS)
