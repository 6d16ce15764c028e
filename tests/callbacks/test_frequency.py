"""The 3D limit: scales stay above a share of a pixel until codebooks are placed."""

from __future__ import annotations

from pathlib import Path

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.callbacks import FrequencyLimit, PhaseSchedule
from nsvq_lightning.compression.importance import pixel_sizes
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io.formats import read_scene, save
from nsvq_lightning.training.edit import append_rows
from nsvq_lightning.training.module import SplatModule


def fit(scene: Path, folder: Path, steps: int, *first: Callback) -> tuple[Trainer, SplatModule]:
    trainer = Trainer(
        max_steps=steps,
        accelerator="cpu",
        default_root_dir=folder,
        logger=False,
        callbacks=[
            *first,
            PhaseSchedule(100, None, warmup_end=100, prune_end=100, quantize_end=100),
            FrequencyLimit(3.0),
        ],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    module = SplatModule(sh_degree=0, codebooks=None, antialiased=True)
    trainer.fit(module, ColmapDataModule(str(scene)))
    return trainer, module


def test_no_scale_falls_below_the_limit(demo_scene: Path, tmp_path: Path) -> None:
    trainer, module = fit(demo_scene, tmp_path, 12)
    scene = trainer.datamodule.scene  # type: ignore[attr-defined]
    sizes = pixel_sizes(module.splats.means.detach(), [scene.cameras[i] for i in scene.train])
    floors = (3.0 * sizes).log()
    seen = sizes.isfinite()
    assert seen.float().mean() > 0.9
    lowest = module.splats.scales.detach().min(1).values
    assert (lowest[seen] > floors[seen] - 0.1).all()  # splats have moved a little since
    assert (lowest[seen] < floors[seen] + 0.1).float().mean() > 0.2  # and some would have been smaller
    save(module.compressed(), tmp_path / "a.nsvq")
    assert read_scene(tmp_path / "a.nsvq").antialiased


class Doubled(Callback):
    """Adds every splat once more, far too small."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: object) -> None:
        if trainer.global_step == 5:
            copies = {name: value.detach().clone() for name, value in pl_module.splats.attributes().items()}
            copies["scales"] -= 10
            append_rows(pl_module.splats, trainer.optimizers[0], copies)


def test_new_splats_have_a_limit_at_once(demo_scene: Path, tmp_path: Path) -> None:
    _, module = fit(demo_scene, tmp_path, 5, Doubled())
    known, lowest = module.splats.tables()["pixel_sizes"], module.splats.scales.detach().min(1).values
    half = len(known) // 2
    assert (known > 0).all()
    seen = known > 1e-20
    assert (lowest[seen] >= (3.0 * known[seen]).log()).all()
    # Those that were there are as they were looked at in the first step, the new ones as they are now.
    scene = load_scene(demo_scene)
    sizes = pixel_sizes(module.splats.means.detach(), [scene.cameras[i] for i in scene.train])
    assert torch.equal(known[half:], sizes[half:].nan_to_num(posinf=1e-30))
    assert not torch.equal(known[:half], sizes[:half].nan_to_num(posinf=1e-30))
