"""What a run takes from its scene, and the part of the Lightning module that renders, measures and stores it."""

import logging
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule, Trainer
from scipy.spatial import cKDTree
from torch import Tensor, nn

from nsvq_lightning.compression.importance import contributions, sensitivity
from nsvq_lightning.compression.stored import to_compressed
from nsvq_lightning.compute.environment import came_late
from nsvq_lightning.compute.jit import compile_seconds
from nsvq_lightning.data.dense_start import dense_points
from nsvq_lightning.data.scene import ONE_PLACE, Scene, View
from nsvq_lightning.io.compressed import CompressedScene, placed
from nsvq_lightning.io.formats import read_scene
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quality.loss import apply_mask, ssim
from nsvq_lightning.quality.metrics import eight_bit, psnr
from nsvq_lightning.quantize.attributes import attribute_rows, decoded
from nsvq_lightning.quantize.codebook import Quantizer
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.frame import EXTENT, Frame
from nsvq_lightning.rendering.rasterize import Render, render
from nsvq_lightning.splats.splats import RawSplats, Splats, SplatTensors, detached, sh_degree_of
from nsvq_lightning.training.distributed import sum_over_processes
from nsvq_lightning.training.optim import LearningRates
from nsvq_lightning.training.schedule import Phase, Schedule
from nsvq_lightning.training.self_check import check_kernels
from nsvq_lightning.version import __version__


class SceneModule(LightningModule):
    """Splats, their codebooks and the settings that they are rendered and stored with; evaluates them.

    :class:`nsvq_lightning.SplatModule` adds the training.
    """

    splats: Splats
    """The splats, in :attr:`frame`; rows are edited only through :mod:`nsvq_lightning.training.row_ops`."""
    codebooks: nn.ModuleDict
    """Quantizer by attribute; empty for a run without quantization."""
    schedule: Schedule
    """Phases and milestones of the run."""
    phase: Phase
    """Phase of the current iteration."""
    active_sh_degree: int
    """SH degree that is rendered; higher coefficients are ignored."""
    extent: float
    """Of the cameras, in units of the frame; 0 while unknown."""
    frame: Frame
    """Coordinates of the splats. Cameras that the module is given, and files that it makes, have those of the files."""
    rates: LearningRates
    storage: Storage
    init_from: str | None
    first_points: int | None = None
    """How many points of SfM and of flow the first splats are made from; None for those of SfM, as in 3DGS."""
    background: str
    dssim_weight: float
    antialiased: bool
    backend: str
    seed: int
    evaluation_splats: SplatTensors | None
    """What validation, test and prediction render instead of the module's own splats, in :attr:`frame`."""

    @property
    def quantizers(self) -> Mapping[str, Quantizer]:
        """Quantizer by attribute."""
        return cast("Mapping[str, Quantizer]", dict(self.codebooks.items()))

    def rows(self, attribute: str) -> Tensor:
        """Rows ``[N, D]`` of a quantized attribute, detached."""
        return attribute_rows(self.splats.raw(), attribute)

    @torch.no_grad()
    def hard_splats(self, phase: Phase) -> RawSplats:
        """The splats as a file written in ``phase`` would hold them, detached: hard codes from ``QUANTIZE`` on.

        They are still in :attr:`frame`.
        """
        raw = detached(self.splats)
        return decoded(raw, self.quantizers) if phase >= Phase.QUANTIZE else raw

    def render_splats(self, splats: SplatTensors, camera: Camera, **options: Any) -> Render:
        """Render any splats at the active SH degree, over the module's background (``random``: black).

        Args:
            splats: Raw attributes, in :attr:`frame`.
            camera: Where to look from, in the coordinates of the files.
            **options: Arguments of :func:`nsvq_lightning.render` that replace the module's.
        """
        white = torch.ones(3, device=self.device) if self.background == "white" else None
        own = {
            "sh_degree": min(self.active_sh_degree, sh_degree_of(splats.shN)),
            "background": white,
            "antialiased": self.antialiased,
            "backend": self.backend,
        }
        return render(splats, self.frame.camera(camera), **(own | options))

    def compressed(self) -> CompressedScene:
        """The scene as it is stored: frozen or nearest codes, codebooks, positions, opacities and the settings.

        Before the quantize phase there are no codebooks yet, and everything is stored as it is.

        Raises:
            ValueError: There are no splats.
        """
        if len(self.splats) == 0:
            raise ValueError("there are no splats to store or to measure: pass the checkpoint of a run (--ckpt_path)")
        quantizers = self.quantizers if self.phase >= Phase.QUANTIZE else {}
        if self.quantizers and not quantizers:
            log.warning("the %s phase has no codebooks yet: the scene is stored unquantized", self.phase.name.lower())
        scene = to_compressed(self.splats.raw(), quantizers)  # PostHoc fits its codebooks only now
        # Nothing that differs between two runs with the same seed.
        settings = {
            "version": __version__,
            "codebooks": {name: int(q.codebook.shape[0]) for name, q in quantizers.items()},
            "quantizers": {name: type(q).__name__ for name, q in quantizers.items()},
            "phase_ends": list(self.schedule.ends),
            "rates": asdict(self.rates),
            "background": self.background,
            **({"antialiased": True} if self.antialiased else {}),
            "dssim_weight": self.dssim_weight,
            "extent": self.extent * self.frame.unit,
            "seed": self.seed,
        }
        return placed(replace(scene, config=settings), self.frame)

    def _start_evaluation(self) -> None:
        if len(self.splats) == 0:
            raise ValueError("there are no splats to render: pass the checkpoint of a run (--ckpt_path)")
        if self.evaluation_splats is None:
            self.evaluation_splats = self.hard_splats(self.phase)

    def _end_evaluation(self) -> None:
        self.evaluation_splats = None

    on_validation_start = on_test_start = on_predict_start = _start_evaluation
    on_validation_end = on_test_end = on_predict_end = _end_evaluation

    def _evaluated_image(self, camera: Camera) -> Tensor:
        if self.evaluation_splats is None:
            raise RuntimeError("evaluation steps run only inside Trainer.validate, test or predict")
        return eight_bit(self.render_splats(self.evaluation_splats, camera).image)

    def _evaluate(self, view: View, prefix: str) -> dict[str, Any]:
        image, photo = apply_mask(self._evaluated_image(view.camera), view.mask), eight_bit(view.image)
        scores = {"psnr": psnr(image, photo, view.mask).float(), "ssim": ssim(image, photo, view.mask)}
        self.log_dict({f"{prefix}/{name}": score for name, score in scores.items()}, batch_size=1, sync_dist=True)
        return {"image": image, **scores}

    def validation_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Score one view: ``image [H, W, 3]`` (8-bit values in [0, 1]), ``psnr``, ``ssim``."""
        return self._evaluate(batch, "val")

    def test_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Score one view: ``image [H, W, 3]`` (8-bit values in [0, 1]), ``psnr``, ``ssim``."""
        return self._evaluate(batch, "test")

    def predict_step(self, batch: View, batch_idx: int) -> dict[str, Any]:
        """Render one view: ``name`` and ``image [H, W, 3]`` (8-bit values in [0, 1])."""
        return {"name": batch.name, "image": self._evaluated_image(batch.camera)}


class Stopwatch:
    """Adds the time between two laps to :attr:`seconds`, without pauses and the compilation of kernels."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """Seconds spent training, over all resumed parts of the run."""
        self._since: float | None = None

    def start(self) -> None:
        """Start counting now; earlier time is forgotten."""
        self._since = _working_time()

    def lap(self) -> None:
        """Add the time since the last lap; does nothing if the watch is not running."""
        if self._since is not None:
            now = _working_time()
            self.seconds += now - self._since
            self._since = now

    def stop(self) -> None:
        """Add the time since the last lap and stop."""
        self.lap()
        self._since = None

    @contextmanager
    def paused(self, device: torch.device) -> Iterator[None]:
        """Leave out the time of the body. Work already queued on ``device`` still counts as training."""
        running = self._since is not None
        if running:
            torch.get_device_module(device).synchronize()
            self.stop()
        try:
            yield
        finally:
            if running:
                torch.get_device_module(device).synchronize()
                self.start()


def _working_time() -> float:
    """Seconds on a clock that stops while kernels are compiled."""
    return time.perf_counter() - compile_seconds()


log = logging.getLogger(__name__)


def scene_of(trainer: Trainer | None) -> Scene | None:
    """The scene of the trainer's data module; None if it has none."""
    return cast("Scene | None", getattr(getattr(trainer, "datamodule", None), "scene", None))


def needed_scene(trainer: Trainer, need: str, otherwise: str) -> Scene:
    """The scene of the trainer's data module.

    Args:
        trainer: The trainer.
        need: What needs it, for the error.
        otherwise: What to do where there is none.

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    scene = scene_of(trainer)
    if scene is None:
        raise ValueError(f"{need}: fit with a data module that has a scene, or {otherwise}")
    return scene


def train_contributions(trainer: Trainer, module: SceneModule) -> Tensor:
    """Blending weight ``[N]`` of each splat in all train views (:mod:`nsvq_lightning.compression.importance`).

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    need = "contributions of splats need the train views"
    scene = needed_scene(trainer, need, "leave weights by contribution off")
    cameras = (scene.cameras[index] for index in scene.train[trainer.global_rank :: trainer.world_size])
    return sum_over_processes(trainer, contributions(module.splats, cameras, module.render_splats))


def train_sensitivities(
    trainer: Trainer, module: SceneModule, splats: SplatTensors, most: int
) -> Iterator[tuple[View, RawSplats, Tensor]]:
    """How much the numbers of splats show in the train views: each view, its estimate and its picture.

    See :func:`nsvq_lightning.compression.importance.sensitivity`.

    Args:
        trainer: The trainer; several processes share the views.
        module: Renders the splats.
        splats: Raw attributes.
        most: Most views to render.

    Raises:
        ValueError: The trainer has no data module with a scene.
    """
    need = "what shows of splats is seen in the train views"
    scene = needed_scene(trainer, need, "leave out the callbacks that ask (selection, rate_distortion)")
    for index in scene.some_train(most)[trainer.global_rank :: trainer.world_size]:
        view = scene.view(index).to(module.device)
        signs = generator(module.seed, trainer.global_step, "signs", index)
        yield view, *sensitivity(splats, view.camera, module.render_splats, signs, view.mask)


def extent_of(trainer: Trainer) -> float:
    """Extent of the trainer's scene in its frame, above 0.

    Raises:
        ValueError: There is no scene, or all its cameras are in one place.
    """
    scene = needed_scene(trainer, "the extent of the scene is unknown", "set the module's extent")
    if scene.extent <= 0.0:
        raise ValueError(f"the {len(scene)} photos of {scene.root} {ONE_PLACE}")
    return EXTENT


# First splats of a run with a budget (docs/recipe.md): opacity; largest size in pixels of the nearest photo, as a lone
# point would hide what is behind it.
FIRST_OPACITY, MOST_PIXELS = 0.3, 50.0


def first_splats(module: SceneModule) -> Splats:
    """What the module starts from, in its frame: a scene file without non-finite splats, or a splat for each point.

    Points are those of SfM and, where the module asks for more, those of :mod:`nsvq_lightning.data.dense_start`.

    Raises:
        ValueError: There is neither a file nor a scene, or the file has another SH degree than the module.
        SceneError: A photo cannot be decoded.
    """
    sh_degree, path = module.splats.sh_degree, module.init_from
    if path is not None:
        loaded = read_scene(path).relative_to(module.frame.origin)
        if (degree := loaded.sh_degree) != sh_degree:
            raise ValueError(f"{path} has SH degree {degree}, the module has {sh_degree}; set sh_degree={degree}")
        return Splats.from_tensors(*module.frame.splats(loaded.decode()))
    scene = needed_scene(module.trainer, "no splats to start from", "set init_from").standard
    points, colors = scene.points, scene.colors
    if module.first_points is None:
        return Splats.from_points(points, colors, sh_degree)
    if (missing := module.first_points - len(points)) > 0:
        log.info("dense start: looking for %d points that neighbouring photos show, beside those of SfM", missing)
        start = time.perf_counter()
        more, their_colors = dense_points(scene, missing, module.seed)
        log.info("dense start: %d points beside %d of SfM, %.1f s", len(more), len(points), time.perf_counter() - start)
        if not len(more):
            log.warning("neighbouring photos show nothing that could be followed: training starts from SfM's points")
        points, colors = torch.cat([points, more]), torch.cat([colors, their_colors])
    splats = Splats.from_points(points, colors, sh_degree, FIRST_OPACITY)
    cameras = [scene.cameras[index] for index in scene.train]
    distances, _ = cKDTree([camera.packed_view[12:] for camera in cameras]).query(splats.means.detach())
    pixel = torch.from_numpy(distances).float() / max(camera.intrinsics[0] for camera in cameras)
    splats.scales.data.clamp_(max=(MOST_PIXELS * pixel).log()[:, None])
    return splats


def background_of(scene: Scene, asked: str) -> str:
    """What the photos have behind their objects, for ``asked="auto"``; otherwise ``asked``.

    Raises:
        ValueError: The photos are shown on white, and another background was asked for.
    """
    background = asked if asked != "auto" else "white" if scene.white else "black"
    if scene.white and background != "white":
        raise ValueError(
            f"the photos of {scene.root} are transparent around their objects and are shown on white, "
            f"model.background is {background}: leave it at auto"
        )
    return background


def check_device(device: torch.device) -> None:
    """Check the kernels of a GPU at its first use; on a CPU, warn of other processes that want the same cores."""
    if device.type == "cuda":
        check_kernels(device)
    elif came_late and torch.get_num_threads() > 1 and hasattr(os, "getloadavg") and os.getloadavg()[0] > 1.0:
        log.warning(
            "other processes also need the cores, and idle threads occupy them: a run may take twice as long; "
            "import nsvq_lightning before torch, or set OMP_WAIT_POLICY=passive"
        )
