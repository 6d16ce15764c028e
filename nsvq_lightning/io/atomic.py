"""Files that are either complete or absent."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from nsvq_lightning.top_level import log

StrPath = str | os.PathLike[str]


@contextmanager
def atomic_path(path: StrPath) -> Iterator[Path]:
    """Path of a temporary file to write, which is renamed to ``path`` only when the block ends without an error.

    The file is in the same folder, is flushed to disk (fsync), and is renamed over ``path`` in one step
    (:func:`os.replace`). A block that raises, a full disk or a killed process leaves the previous file as it was; an
    exception also removes the temporary file. A symbolic link is followed: its target is replaced, the link stays.

    Args:
        path: Final name; the folder must exist. A new file keeps the permissions it was written with; a file that is
            replaced passes its permissions on.

    Yields:
        The temporary name; the block must write a file there.

    Raises:
        FileNotFoundError: The folder does not exist.
        IsADirectoryError: ``path`` is a folder, a pipe or a device.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():  # a pipe or a device would be replaced, too
        kind = "a folder; add a file name" if target.is_dir() else "no ordinary file"
        raise IsADirectoryError(f"cannot write {path}: it is {kind}")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {target.parent} does not exist; create it first")
    # Not mkstemp: it creates files that only their owner can read, and renaming would keep that.
    temporary = target.parent / f".{os.getpid()}-{secrets.token_hex(8)}.tmp"
    try:
        yield temporary
        sync(temporary, os.O_RDWR)  # not read-only: Windows flushes only files that are open for writing
        with suppress(OSError):  # no file before, or one where modes cannot be set
            temporary.chmod(target.stat().st_mode & 0o7777)
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):  # not there, or in a folder that is read only
            temporary.unlink()
        # That of a full disk does not say which file, or names this one.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    # Make the new name itself survive a power failure, where the system can open folders.
    with suppress(OSError):
        sync(target.parent, os.O_RDONLY)


@contextmanager
def atomic_write(path: StrPath) -> Iterator[BinaryIO]:
    """Open a binary file for writing that is renamed to ``path`` only when the block ends without an error.

    Arguments and errors are those of :func:`atomic_path`; a new file gets default permissions.

    Yields:
        The temporary file, opened for writing.
    """
    with atomic_path(path) as temporary, open(temporary, "xb") as file:
        yield file


def make_folder_of(path: Path) -> None:
    """Make the folder that a file is to be in, and those around it, where they are missing.

    Raises:
        PermissionError: Nothing can be written there.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"cannot write {path}: its folder is read-only")


def write_bytes(path: StrPath, content: bytes) -> int:
    """Write a file in one step, see :func:`atomic_write`; returns its bytes."""
    with atomic_write(path) as file:
        return file.write(content)


def write_text(path: StrPath, text: str) -> int:
    """Write a text file as UTF-8 in one step, see :func:`atomic_write`; returns its bytes."""
    return write_bytes(path, text.encode())


@contextmanager
def optional(path: Path) -> Iterator[Path]:
    """Warn if what the block writes to ``path`` cannot be written, and go on: for what a run can do without.

    A program may hold the file open, as Windows lets it, or the disk be full.
    """
    try:
        yield path
    except OSError as error:
        log.warning(f"{path} cannot be written ({error.strerror or error}); the run goes on without it")


def remove_temporaries(folder: Path, process: str) -> None:
    """Remove what a killed process has left unfinished.

    Args:
        folder: Where to look, in folders inside it, too.
        process: Number of the process, which does not run any more; what is no number is the number of none.
    """
    if process.isdecimal():
        for path in folder.rglob(f".{process}-*.tmp"):
            path.unlink(missing_ok=True)


def sync(path: Path, access: int) -> None:
    """Flush a file or folder to disk."""
    descriptor = os.open(path, access)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
