from __future__ import annotations

import ast
import errno
import os
from functools import cache
from pathlib import Path

import pytest

import nsvq_lightning
from nsvq_lightning.io.atomic import atomic_path, atomic_write
from nsvq_lightning.top_level import folder_of


def test_failure_keeps_the_old_file_and_leaves_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")

    def interrupted_write() -> None:
        with atomic_write(path) as file:
            file.write(b"half of the new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_write()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["scene.ply"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes with names")
def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "scene.ply")
    with pytest.raises(OSError, match="it is no ordinary file"), atomic_write(pipe):
        pass
    assert pipe.is_fifo()


def test_a_full_disk_is_told_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"

    def write() -> None:
        # One in the other, as for checkpoints.
        with atomic_path(path) as outer, atomic_write(outer):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match=r"No space left on device: '.*[/\\]scene\.ply'"):
        write()


def test_a_folder_that_became_read_only_is_told_with_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OSError, match="Read-only file system") as caught, atomic_path(tmp_path / "scene.ply") as path:
        refuse(path)
    assert caught.value.filename == str(tmp_path / "scene.ply")


def test_permissions_are_those_of_an_ordinary_file_or_of_the_old_one(tmp_path: Path) -> None:
    plain, ours = tmp_path / "plain", tmp_path / "ours"
    plain.write_bytes(b"")
    for _ in range(2):
        with atomic_write(ours) as file:
            file.write(b"x")
        assert ours.stat().st_mode == plain.stat().st_mode
        plain.chmod(0o640)
        ours.chmod(0o640)


def test_a_file_is_replaced_where_modes_cannot_be_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(b"old")

    def refuse(*_: object) -> None:
        raise PermissionError("no modes on this share")

    monkeypatch.setattr(Path, "chmod", refuse)
    with atomic_write(tmp_path / "a") as file:
        file.write(b"new")
    assert (tmp_path / "a").read_bytes() == b"new"


def test_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    target, link = tmp_path / "store" / "v1.ply", tmp_path / "latest.ply"
    target.write_bytes(b"old")
    link.symlink_to(target)
    with atomic_write(link) as file:
        file.write(b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no_such"), atomic_write(tmp_path / "no_such" / "x.ply"):
        pass
    with pytest.raises(IsADirectoryError, match="folder"), atomic_write(tmp_path):
        pass


def test_a_file_written_by_its_name_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    path.write_bytes(b"old")
    with atomic_path(path) as temporary:
        assert temporary.parent == tmp_path
        temporary.write_bytes(b"first")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"first"
    with pytest.raises(FileNotFoundError), atomic_path(path):
        pass  # writes nothing

    def broken_write() -> None:
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half")
            raise ValueError("disk")

    with pytest.raises(ValueError, match="disk"):
        broken_write()
    assert path.read_bytes() == b"first"
    assert os.listdir(tmp_path) == ["last.ckpt"]


def test_files_are_synced_where_only_those_open_for_writing_can_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl = pytest.importorskip("fcntl", reason="this system itself refuses the others")
    synced = []

    def fsync_of_windows(descriptor: int) -> None:
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        synced.append(descriptor)

    monkeypatch.setattr(os, "fsync", fsync_of_windows)
    with atomic_write(tmp_path / "scene.ply") as file:
        file.write(b"new")
    assert (tmp_path / "scene.ply").read_bytes() == b"new"
    assert len(synced) == 1  # and not the folder, which such a system cannot sync


@cache
def _modules() -> list[tuple[str, ast.Module]]:
    """Name and syntax of every file of the package."""
    package = Path(nsvq_lightning.__file__).parent
    callbacks = {f"callbacks/{path.name}": path for path in folder_of("callbacks").glob("*.py")}
    others = {path.relative_to(package).as_posix(): path for path in package.rglob("*.py")}
    return [(name, ast.parse(path.read_text(encoding="utf-8"))) for name, path in (others | callbacks).items()]


def test_text_files_are_utf_8_whatever_the_locale() -> None:
    """The default is the locale's character set, which on Windows is another one."""
    bare = []
    for name, module in _modules():
        for call in (node for node in ast.walk(module) if isinstance(node, ast.Call)):
            function = ast.unparse(call.func)
            binary = any(isinstance(a, ast.Constant) and "b" in str(a.value) for a in call.args)
            reads = function.endswith(".read_text") or (function == "open" and not binary)
            named = any(keyword.arg == "encoding" for keyword in call.keywords)
            if reads and not named and function != "reconstruction.read_text":  # that one is COLMAP's
                bare.append(f"{name}:{call.lineno} {ast.unparse(call)}")
    assert bare == []


def test_no_file_of_the_package_is_written_in_place() -> None:
    # Every call that writes a file, outside of what makes writing atomic. Those listed write into a temporary folder
    # that takes its name when it is complete, or a log that grows.
    allowed = {
        ("io/atomic.py", "open"),
        ("commands/sweep.py", "open"),
        ("commands/main.py", "open"),  # to nowhere
        ("training/resume.py", "save"),  # into memory
    }
    writers = {"write_text", "write_bytes", "imwrite", "savefig", "savez", "tofile", "write_binary"}
    found = set()
    for path, module in _modules():
        for node in ast.walk(module):
            if not isinstance(node, ast.Call):
                continue
            function = node.func
            name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
            modes = [a.value for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant)]
            opens = name == "open" and any(isinstance(m, str) and set(m) & set("wax") and len(m) < 4 for m in modes)
            writes = name in writers and isinstance(function, ast.Attribute)
            saves = isinstance(function, ast.Attribute) and ast.unparse(function) in ("torch.save", "np.save")
            if opens or writes or saves:
                found.add((path, name))
    assert found == allowed
