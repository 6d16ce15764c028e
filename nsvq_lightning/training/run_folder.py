"""Where a run writes: a folder of its own, which never overwrites another run."""

import atexit
import os
import platform
from contextlib import suppress
from itertools import count
from pathlib import Path
from weakref import WeakKeyDictionary

from filelock import FileLock, Timeout
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from nsvq_lightning.io.atomic import StrPath, remove_temporaries, write_text
from nsvq_lightning.top_level import log
from nsvq_lightning.training.distributed import on_first_process

_FOLDERS: WeakKeyDictionary[Trainer, Path] = WeakKeyDictionary()
_RESERVED: WeakKeyDictionary[Trainer, Path] = WeakKeyDictionary()

# File that names the process of a run and its machine, and the one that this process keeps locked.
MARKER, LOCK = ".running", ".running.lock"
# The lock of each folder that this process writes a run to.
_HELD: dict[Path, FileLock] = {}


def run_folder(trainer: Trainer) -> Path:
    """Folder of the trainer's run, which exists; the same one for everything that this trainer does.

    It is the first of these that is given: the trainer's ``run_folder`` (:class:`nsvq_lightning.SplatTrainer`), the
    folder of a logger that has one for each run (CSV, TensorBoard), or a new
    ``<default_root_dir>/<scene>/version_<n>``. The first process chooses: the first call is a collective, which every
    process must make.

    Raises:
        FileExistsError: The folder holds another run, or another process writes to it. The run of the checkpoint that a
            fit continues from is its own.
    """
    folder = _FOLDERS.get(trainer)
    if folder is None:
        folder = _FOLDERS[trainer] = on_first_process(trainer, lambda: _choose(trainer))
    return folder


def is_fast_dev_run(trainer: Trainer) -> bool:
    """Whether this is ``fast_dev_run``, which must leave no files."""
    return bool(getattr(trainer, "fast_dev_run", False))


def reserve(trainer: Trainer, checkpoint: StrPath | None) -> None:
    """Claim a given folder before the trainer starts: its loggers write, and remove existing files, at once.

    Args:
        trainer: Trainer that is about to start.
        checkpoint: Checkpoint that a fit continues from, if any.

    Raises:
        FileExistsError: The folder holds another run.
        ValueError: Processes would be copies of this one, which holds the folder.
    """
    if getattr(trainer.strategy, "_start_method", "popen") != "popen":
        raise ValueError("processes of a command are commands, too: use --trainer.strategy=view_parallel")
    folder = _given(trainer)
    if folder and trainer.is_global_zero and not is_fast_dev_run(trainer):
        take(folder, checkpoint)
        _RESERVED[trainer] = folder


def claim_version(parent: Path) -> Path:
    """Create and return the next folder ``version_<n>`` in ``parent``; runs that start together get different ones."""
    parent.mkdir(parents=True, exist_ok=True)
    numbers = [path.name.removeprefix("version_") for path in parent.glob("version_*")]
    for number in count(max((int(number) + 1 for number in numbers if number.isdecimal()), default=0)):
        folder = parent / f"version_{number}"
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError  # count() has no end


def take(folder: Path, checkpoint: StrPath | None) -> None:
    """Hold the folder; set aside the log of the run in it, before a CSV logger removes it.

    Args:
        folder: Folder that was given for a run.
        checkpoint: Checkpoint that a fit continues from, if any.

    Raises:
        FileExistsError: It holds a run, and the checkpoint is not in it; or another process writes to it.
    """
    _refuse_other_run(folder, checkpoint)
    hold(folder)
    _refuse_other_run(folder, checkpoint)  # one that has come and gone in between
    log_file = folder / "metrics.csv"  # of Lightning's CSV logger, which removes an existing one
    if log_file.exists():
        log_file.rename(next(p for n in count(1) if not (p := folder / f"metrics_{n}.csv").exists()))


def hold(folder: Path) -> None:
    """Make a folder and keep other processes from writing a run there until :func:`let_go`, or this one ends, however.

    The system unlocks what a process has locked when that ends: what a killed run has left is an unlocked file, and
    temporary files, which are removed.

    Raises:
        FileExistsError: Another process holds the folder.
    """
    if folder.resolve() in _HELD:
        return
    folder.mkdir(parents=True, exist_ok=True)
    marker = folder / MARKER
    owner = marker.read_text(encoding="utf-8", errors="replace") if marker.is_file() else ""
    lock = FileLock(folder / LOCK, blocking=False, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        raise FileExistsError(
            f"another run is writing to {folder} now, process {owner.strip() or 'that has just started'}: wait until "
            "it has ended, or name another folder"
        ) from None
    except OSError as error:  # some network file systems have no locks
        log.warning(f"{folder} cannot be locked ({error.strerror}): write no other run there meanwhile")
    remove_temporaries(folder, owner.partition(" ")[0])
    write_text(marker, f"{os.getpid()} on {platform.node()}\n")
    _HELD[folder.resolve()] = lock


def let_go(folder: Path) -> None:
    """Let other processes write to a folder that this one holds; does nothing otherwise."""
    if lock := _HELD.pop(folder.resolve(), None):
        for name in (MARKER, LOCK):
            with suppress(OSError):  # Windows removes no open file; an unlocked one does no harm
                (folder / name).unlink()
        lock.release()


@atexit.register
def _let_go_of_all() -> None:
    for folder in list(_HELD):
        let_go(folder)


# Files that show that a folder holds a run.
RUN_FILES = (
    "scene.nsvq",
    "cameras.json",
    "metrics.json",
    "metrics.csv",
    "curve.csv",
    "checkpoints",
    "last.ckpt",
    "renders",
    "predictions",
)


def _refuse_other_run(folder: Path, checkpoint: StrPath | None) -> None:
    if not any((folder / name).exists() for name in RUN_FILES):
        return
    if checkpoint is None or not Path(checkpoint).resolve().is_relative_to(folder.resolve()):
        raise FileExistsError(
            f"{folder} already holds a run, and no run is overwritten: name another folder or version, or none "
            "(--trainer.run_folder=null) to take the next free one; its --ckpt_path=…/last.ckpt, if any, continues it"
        )


def _given(trainer: Trainer) -> Path | None:
    """The folder that the trainer or one of its loggers was given for this run, if any."""
    own = [logger.log_dir for logger in trainer.loggers if isinstance(logger, CSVLogger | TensorBoardLogger)]
    given = getattr(trainer, "run_folder", None) or next(iter(own), None)
    return None if given is None else Path(given)


def _choose(trainer: Trainer) -> Path:
    if is_fast_dev_run(trainer):
        return Path(trainer.default_root_dir)
    if trainer in _RESERVED:
        return _RESERVED.pop(trainer)
    folder = _given(trainer)
    if folder is None:
        root = getattr(getattr(trainer, "datamodule", None), "root", None)
        scene = (root is not None and Path(root).resolve().name) or "scene"
        folder = claim_version(Path(trainer.default_root_dir) / scene)
    take(folder, trainer.ckpt_path if trainer.state.fn == "fit" else None)
    return folder
