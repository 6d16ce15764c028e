"""Compile the kernels of the later phases while the first ones compile and train."""

import logging
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer

from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.compute.jit import compile_watcher
from nsvq_lightning.training import precompile
from nsvq_lightning.training.module import SplatModule

from .base import SplatCallback

log = logging.getLogger(__name__)


class CompileAhead(SplatCallback):
    """Compiles the kernels of quantization and of the file in a second process.

    The first kernel that the fit compiles starts that process: where all kernels are cached, nothing happens. It goes
    through the later phases on a handful of splats (:mod:`nsvq_lightning.training.precompile`) at a low priority, and
    leaves its kernels in Numba's cache. If it fails, the fit compiles them itself when it needs them. It ends with the
    fit.

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
            self._settings = precompile.settings_of(module)
            self._watching.enter_context(compile_watcher(self._start))

    def _start(self, _: str) -> None:
        if self._settings is None:
            return
        settings, self._settings = self._settings, None
        command = [sys.executable, "-m", precompile.__name__]
        pipe, silence = subprocess.PIPE, subprocess.DEVNULL
        # The package is found where this process has found it, and one thread is enough.
        paths = os.pathsep.join(filter(None, (str(Path(precompile.__file__).parents[2]), os.environ.get("PYTHONPATH"))))
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
