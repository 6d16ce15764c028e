"""What a run writes besides its report: scene files, predicted pictures, and the scene to look at while it trains."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import BasePredictionWriter

from nsvq_lightning.io.atomic import optional
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import FORMATS, save
from nsvq_lightning.io.nsvq.file import as_stored
from nsvq_lightning.io.placing import placed
from nsvq_lightning.rendering.camera_paths import CAMERAS
from nsvq_lightning.report import pictures, viewer
from nsvq_lightning.top_level import log
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import is_fast_dev_run, run_folder
from nsvq_lightning.training.run_scene import scene_of

from .base import WritingCallback, picture_file


class ExportScene(WritingCallback):
    """Writes the scene when training ends.

    The compressed scene is ``scene.nsvq``, and ``scene.ply`` has its decoded splats, for any viewer, or without
    codebooks those that were trained. With ``scene.nsvq`` come ``viewer.html``, a page that holds it and shows it in a
    browser, and ``cameras.json``, the cameras of the photos, for commands that look at the run where there are none.

    Raises:
        ValueError: An unknown format.
    """

    formats: Sequence[str] = ("nsvq", "ply")
    """Suffixes without the dot; ``sog``, ``spz`` and ``splat`` are smaller files for viewers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        known = [suffix.removeprefix(".") for suffix, entry in FORMATS.items() if entry.write]
        if unknown := sorted(set(self.formats) - set(known)):
            raise ValueError(f"unknown export formats {', '.join(unknown)}; choose from {', '.join(known)}")

    def on_fit_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Write the files, on the first process."""
        folder = run_folder(trainer)
        if is_fast_dev_run(trainer) or not trainer.is_global_zero:
            return
        scene = module.compressed().finite()
        # The files of viewers hold what the compressed one decodes to: found once, however many there are.
        decoded = as_stored(scene, module.storage) if set(self.formats) - {"nsvq"} else scene
        for suffix in self.formats:
            with optional(folder / f"scene.{suffix}") as path:
                size = save(scene, path, module.storage) if suffix == "nsvq" else save(decoded, path)
                log.info(f"wrote {path} ({size} bytes)")
        photos = scene_of(trainer)
        if "nsvq" in self.formats and photos is not None:
            cameras = dict(zip(photos.names, photos.cameras, strict=True))
            with optional(folder / "viewer.html") as page:
                viewer.write_cameras(folder / CAMERAS, cameras)
                size = viewer.write_viewer(page, folder / "scene.nsvq", cameras, photos.root.resolve().name)
                log.info(f"wrote {page} ({size} bytes)")


class RenderWriter(BasePredictionWriter):
    """Writes every predicted view as a PNG named after its photo.

    Args:
        folder: Where; None is ``predictions`` in the folder of the run.
    """

    def __init__(self, folder: str | None = None) -> None:
        super().__init__()  # after each batch
        self.folder = folder
        self._target = Path()

    def on_predict_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Find the folder in a hook that all processes call: some have fewer views than others.

        Raises:
            FileExistsError: The folder of the run holds another one.
        """
        self._target = run_folder(trainer) / "predictions" if self.folder is None else Path(self.folder)

    def write_on_batch_end(self, trainer: Trainer, module: SplatModule, prediction: Any, *args: Any) -> None:
        """Write one picture."""
        if not is_fast_dev_run(trainer):
            pictures.write_png(picture_file(trainer, self._target, prediction["name"]), prediction["image"])

    def on_predict_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Say where the pictures are."""
        if not is_fast_dev_run(trainer):
            log.info(f"rendered views are in {self._target}")


# Iterations after which the callback sees whether somebody asks; it takes some microseconds.
CHECKED_EVERY = 20
# Largest share of the time that goes into showing.
SHARE = 0.05


class LiveScene(WritingCallback):
    """Shows the splats of a running fit to ``nsvq view --live``.

    It writes them into the folder of the run when somebody asks, and not otherwise. They are those that a file written
    at that moment would hold, stored without loss in ``live.nsvq``. At most a twentieth of the time goes into it, and
    none of that counts as training time. The file goes when the run ends.
    """

    _running = False

    def on_train_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Forget who asked an earlier part of the run."""
        self._running = not is_fast_dev_run(trainer)
        self._answered, self._next = viewer.live_asked(run_folder(trainer)), 0.0

    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Answer a viewer."""
        due = iteration % CHECKED_EVERY == 1 and time.monotonic() >= self._next
        if not (self._running and due and trainer.is_global_zero):
            return
        folder = run_folder(trainer)
        asked = viewer.live_asked(folder)
        if asked == self._answered:
            return
        began = time.monotonic()
        with module.stopwatch.paused(module.device):
            splats = module.scene.hard_splats(module.phase)
            state = {"iteration": iteration, "of": trainer.max_steps, "phase": module.phase.name.lower()}
            if module.history:
                state["psnr"] = f"{module.history[-1]['psnr']:.2f}"
            config = {"antialiased": module.antialiased, "background": module.background, "live": state}
            scene = CompressedScene.from_splats(splats, config=config)
            scene = placed(scene, module.frame, cameras=module.cameras)
            with optional(folder / viewer.LIVE_SCENE) as path:
                save(scene, path, "paper")
        self._answered, ended = asked, time.monotonic()
        self._next = ended + (ended - began) / SHARE

    def on_fit_end(self, trainer: Trainer, module: SplatModule, *_: Any) -> None:
        """Leave the finished scene alone, and nothing behind that only a running fit has."""
        if self._running and trainer.is_global_zero:
            viewer.end_live(run_folder(trainer))
        self._running = False

    on_exception = on_fit_end
