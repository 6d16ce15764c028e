"""Compile the kernels of the later phases while the first ones compile and train.

A second process goes through those phases on a handful of splats. It reads the settings of the module from its standard
input, and leaves nothing behind but compiled kernels on the disk.
"""

import inspect
import logging
import os
import pickle
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.cli import instantiate_module

from nsvq_lightning.compression.importance import row_weights
from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.compute.jit import compile_watcher
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.quantize.attributes import decoded, noisy_rows
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import visible
from nsvq_lightning.splats.attributes import attribute_shapes
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

from .base import SplatCallback

log = logging.getLogger(__name__)


class CompileAhead(SplatCallback):
    """Compiles the kernels of quantization and of the file in a second process.

    The first kernel that the fit compiles starts that process: where all kernels are cached, nothing happens. It goes
    through the later phases on a handful of splats at a low priority, and leaves its kernels in Numba's cache. If it
    fails, the fit compiles them itself when it needs them. It ends with the fit.

    It does nothing on a single core, on a GPU, or without codebooks.

    Example:
        >>> from nsvq_lightning.callbacks import STANDARD, CompileAhead
        >>> STANDARD["kernels"] is CompileAhead  # --callbacks.kernels=null leaves it out
        True
    """

    def __init__(self) -> None:
        self._watching = ExitStack()
        self._process: Any = None
        self._settings: bytes | None = None

    def on_fit_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Wait for the first compilation."""
        if not module.quantizers or module.device.type != "cpu":
            return
        if trainer.is_global_zero and usable_cores() > 1:
            self._settings = settings_of(module)
            self._watching.enter_context(compile_watcher(self._start))

    def _start(self, _: str) -> None:
        if self._settings is None:
            return
        settings, self._settings = self._settings, None
        command = [sys.executable, "-c", f"from {__name__} import compile_what_is_sent; compile_what_is_sent()"]
        pipe, silence = subprocess.PIPE, subprocess.DEVNULL
        # The package is found where this process has found it, and one thread is enough.
        paths = os.pathsep.join(
            filter(None, (str(Path(inspect.getfile(SplatModule)).parents[2]), os.environ.get("PYTHONPATH")))
        )
        environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
        try:
            self._process = subprocess.Popen(command, stdin=pipe, stdout=silence, stderr=silence, env=environment)
            self._process.stdin.write(settings)
            self._process.stdin.close()
        except OSError as error:
            log.info("the kernels of later phases are compiled when they are needed: %s", error)

    def on_fit_end(self, *_: Any) -> None:
        """End the process."""
        self._watching.close()
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
            self._process = None

    def on_exception(self, *_: Any) -> None:
        """End the process."""
        self.on_fit_end()


def settings_of(module: SplatModule) -> bytes | None:
    """The settings of a module for another process; None if they hold something that cannot be sent to one."""
    try:
        return pickle.dumps(dict(module.hparams) | {"init_from": None, "backend": "cpu"})
    except (pickle.PicklingError, AttributeError, TypeError):
        return None


# Splats, so that some search trees have more than one level.
MIN_SPLATS = 600


def compile_kernels(settings: dict[str, Any]) -> None:
    """Place the codebooks, train a step with noise and one with frozen codes, write the file and read it back.

    Nothing is drawn: the kernels of drawing are those of the first phase, which the run itself compiles meanwhile.
    """
    # A module that the command line has made keeps what it was made from, not what became of it.
    from_config = settings.pop("_instantiator", None) is not None
    module = instantiate_module(SplatModule, settings) if from_config else SplatModule(**settings)
    count = max([MIN_SPLATS, *(q.codebook.shape[0] + 1 for q in module.quantizers.values())])
    module.splats = _random_splats(count, module.splats.sh_degree)
    module.phase = Phase.QUANTIZE
    for name, quantizer in module.quantizers.items():
        weight = None if name == "scales" else row_weights(torch.ones(count))
        quantizer.fit(module.rows(name), weight, generator(0, 0, name))
    raw = module.splats.raw()
    rows = visible(raw, Camera(torch.tensor([[60.0, 0, 36], [0, 60, 28], [0, 0, 1]]), torch.eye(4), 72, 56))
    for _ in range(2):  # the second search has something to remember
        _backward(noisy_rows(raw, rows, module.quantizers, lambda name: generator(0, 1, name)))
    for name, quantizer in module.quantizers.items():
        quantizer.freeze(quantizer.encode(module.rows(name)))
    module.phase = Phase.FINETUNE
    _backward(decoded(raw, module.quantizers))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.nsvq"
        save(module.compressed(), path, module.storage)
        load(path)


def _backward(splats: RawSplats) -> None:
    torch.stack([tensor.sum() for tensor in splats]).sum().backward()  # type: ignore[no-untyped-call]


def _random_splats(count: int, sh_degree: int) -> Splats:
    """Splats before a camera at the origin that looks along z."""
    shapes = attribute_shapes(sh_degree).items()
    raw = {name: torch.randn(count, *shape, generator=generator(0, 2, name)) for name, shape in shapes}
    raw["means"] += torch.tensor([0.0, 0.0, 4.0])
    raw["scales"] -= 3.0
    return Splats.from_tensors(**raw)


def compile_what_is_sent() -> None:
    """:func:`compile_kernels` with the settings on the standard input, as long as no other process wants the core."""
    if hasattr(os, "nice"):
        os.nice(10)
    compile_kernels(pickle.load(sys.stdin.buffer))
