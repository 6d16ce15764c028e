"""A notebook as a script, ``notebook_fit.py SCENE FOLDER two|one|rendered``: prints a digest of what it then holds.

It trains on two devices, or on one with two views a step; or on two, after it has rendered.
"""

from __future__ import annotations

import hashlib
import sys
from typing import Any


def main(scene: str, folder: str, how: str) -> None:
    sys.ps1 = ">>> "  # somebody types; Lightning asks when it is imported
    import torch

    import nsvq_lightning as nl
    from nsvq_lightning.callbacks import SplatBudget, standard

    data, module = nl.ColmapDataModule(scene, factor=2), nl.SplatModule(sh_degree=1, codebooks=None)
    if how == "rendered":
        splats = nl.Splats.from_points(torch.rand(9, 3) + torch.tensor([0.0, 0.0, 3.0]), torch.rand(9, 3))
        nl.render(splats, data.scene.cameras[0])
    callbacks = standard(progress=None, report=None, budget=SplatBudget(splats=1500, start=1.2))
    views = {"accumulate_grad_batches": 2} if how == "one" else {"devices": 2}
    quiet: dict[str, Any] = {"accelerator": "cpu", "enable_progress_bar": False, "default_root_dir": folder}
    nl.SplatTrainer(max_steps=6, callbacks=callbacks, **views, **quiet).fit(module, data)
    digest = hashlib.sha256(b"".join(each.detach().numpy().tobytes() for each in module.parameters())).hexdigest()
    nl.render(module.splats, data.scene.cameras[0])
    sys.stdout.write(f"trained {digest}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
