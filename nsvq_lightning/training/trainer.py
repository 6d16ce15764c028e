"""Lightning's trainer with the defaults, devices and strategies that train splats."""

import sys
from pathlib import Path
from typing import Any

from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch import Trainer
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities import rank_zero_only

from nsvq_lightning.compute.devices import best_device
from nsvq_lightning.io.atomic import make_folder_of
from nsvq_lightning.io.formats import save
from nsvq_lightning.top_level import log
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.resume import PlainCheckpointIO, read_checkpoint

# What Lightning's trainer has otherwise.
TRAINER_DEFAULTS: dict[str, Any] = {
    "max_epochs": -1,  # the sampler is endless: steps end the run
    "limit_val_batches": 0,  # MetricReport evaluates, outside the training time
    "num_sanity_val_steps": 0,
    "devices": 1,  # more must be requested, because they change what a step is
    "use_distributed_sampler": False,  # the sampler knows its rank
    "enable_model_summary": False,
    "default_root_dir": "runs",
}


class SplatTrainer(Trainer):
    """:class:`lightning.pytorch.Trainer` with :data:`TRAINER_DEFAULTS`; its public methods are subcommands of ``nsvq``.

    Checkpoints are read by :class:`~nsvq_lightning.training.resume.PlainCheckpointIO` unless a plugin does it.

    ``accelerator="auto"`` is the fastest one that has kernels (:func:`nsvq_lightning.compute.devices.best_device`).
    If several devices or machines are requested but no strategy, it uses ``view_parallel``, in a notebook
    ``view_parallel_notebook``: DDP, which Lightning would choose, cannot handle a changing number of splats.

    Args:
        run_folder: Folder for all files of the run; None uses that of the logger if it has one for each run, else a new
            ``<default_root_dir>/<scene>/version_<n>``. An existing run is not overwritten.
        allow_other_scene: Use a checkpoint on another scene than the one it was trained on.
    """

    def __init__(
        self, *args: Any, run_folder: str | None = None, allow_other_scene: bool = False, **kwargs: Any
    ) -> None:
        kwargs = TRAINER_DEFAULTS | {"logger": False} | kwargs
        if kwargs.get("accelerator", "auto") == "auto":
            kwargs["accelerator"] = best_device().type
        if kwargs["max_epochs"] not in (None, -1):
            log.warning("max_epochs ends nothing, or with limited epochs the run too early; max_steps does")
        several = "view_parallel_notebook" if hasattr(sys, "ps1") else "view_parallel"
        if kwargs.get("strategy") == "view_parallel":
            kwargs["strategy"] = several
        super().__init__(*args, **kwargs)
        if kwargs.get("strategy", "auto") == "auto" and isinstance(self.strategy, DDPStrategy):
            super().__init__(*args, **(kwargs | {"strategy": several}))
        # Not that of a launcher whose processes each train alone: they would log nothing.
        rank_zero_only.rank = self.global_rank  # type: ignore[attr-defined]
        # SLURM's would write a checkpoint in the middle of an iteration, and every later run would begin from it.
        environment: Any = self._accelerator_connector.cluster_environment
        if not kwargs.get("plugins"):
            environment.auto_requeue = False
            if (others := environment.world_size()) > self.world_size:
                log.warning(f"if {others} processes are started, each trains the whole scene: set devices to share it")
        self.run_folder, self.allow_other_scene = run_folder, allow_other_scene
        if type(self.strategy.checkpoint_io) is TorchCheckpointIO:  # Lightning's own
            self.strategy.checkpoint_io = PlainCheckpointIO()

    def validate(self, *args: Any, **kwargs: Any) -> Any:
        """Lightning's, of all test views where :data:`TRAINER_DEFAULTS` have left none."""
        self.limit_val_batches = self.limit_val_batches or 1.0
        return super().validate(*args, **kwargs)

    def export(self, model: SplatModule, ckpt_path: str, output: str = "scene.nsvq", datamodule: Any = None) -> Path:
        """Write the scene of a checkpoint as a file.

        Args:
            model: Module that the checkpoint is loaded into.
            ckpt_path: Checkpoint of a run.
            output: File to write; its suffix selects the format: .nsvq is the compressed scene, any other one holds the
                decoded splats.
            datamodule: As of the trainer's other methods; it is not needed.

        Raises:
            FileNotFoundError: No such checkpoint.
            FormatError: It is damaged.
        """
        path = Path(output)
        if output == "scene.nsvq" and path.exists():  # nobody has named it
            raise FileExistsError(f"{output} exists here: name another file with --output, or remove it")
        checkpoint = read_checkpoint(ckpt_path)
        model.on_load_checkpoint(checkpoint)
        model.load_state_dict(checkpoint["state_dict"])
        make_folder_of(path)
        scene = model.compressed()
        size = save(scene, path, model.storage)
        log.info(f"wrote {path}: {len(scene)} splats, {size} bytes")
        return path
