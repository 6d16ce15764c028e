"""A notebook with two devices, as a script: ``notebook_fit.py SCENE FOLDER [render]``; prints what it then holds."""

from __future__ import annotations

import hashlib
import sys


def main(scene: str, folder: str, *more: str) -> None:
    sys.ps1 = ">>> "  # somebody types; Lightning asks when it is imported
    import torch

    import nsvq_lightning as nl
    from nsvq_lightning.callbacks import SplatBudget, standard

    data, module = nl.ColmapDataModule(scene, factor=2), nl.SplatModule(sh_degree=1, codebooks=None)
    if more:
        splats = nl.Splats.from_points(torch.rand(9, 3) + torch.tensor([0.0, 0.0, 3.0]), torch.rand(9, 3))
        nl.render(splats, data.scene.cameras[0])
    callbacks = standard(progress=None, report=None, budget=SplatBudget(splats=1500, start=1.2))
    trainer = nl.SplatTrainer(
        max_steps=6,
        accelerator="cpu",
        devices=2,
        callbacks=callbacks,
        default_root_dir=folder,
        enable_progress_bar=False,
    )
    trainer.fit(module, data)
    digest = hashlib.sha256(b"".join(each.detach().numpy().tobytes() for each in module.parameters())).hexdigest()
    nl.render(module.splats, data.scene.cameras[0])
    sys.stdout.write(f"trained {len(module.splats)} splats {digest}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
