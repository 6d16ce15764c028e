"""Random damage to small valid files, and what readers may do with it: read it, or raise one clear error.

Runs as a program, so that a reader that aborts, hangs or allocates without end takes only itself along:
``python tests/support/fuzzing.py NAME FOLDER CASES [SEED]``. A case that fails stays in FOLDER, and its number is
shown.
"""

from __future__ import annotations

import faulthandler
import gzip
import io
import re
import resource
import sys
import zipfile
from collections.abc import Callable
from contextlib import redirect_stderr, suppress
from dataclasses import dataclass
from functools import cache, partial
from hashlib import blake2b
from pathlib import Path

import numpy as np
from compressed_scenes import on_basis, scene
from guards import guarded

from nsvq_lightning.io.compressed import CompressedScene

SECONDS = 20
"""A case that takes longer hangs."""
MEMORY = 3 << 30
"""Bytes of address space that a case may add to what the process has before."""
REMEDY = re.compile(
    r"\b(copy|save|export|pass|run|update|correct|give|set|undistort|register|rename|remove|All options)\b", re.I
)
"""What messages tell the user to do."""
NUMBERS = (0, 1, 2, 127, 128, 255, 256, 65535, 65536, 1 << 31, (1 << 32) - 1, 1 << 60, (1 << 64) - 1)
TOKENS = (b"0", b"-1", b"1", b"7", b"99", b"65536", b"4294967296", b"1e400", b"nan", b"-inf", b"", b"x", b"\xff", b"[]")


@dataclass(frozen=True)
class Target:
    """One kind of file.

    Attributes:
        build: Writes valid files into a folder and returns those to be damaged.
        read: Reads the damaged one; gets its path.
        errors: What it may raise.
        mend: Makes what guards the whole file fit its content again, so that damage gets further.
    """

    build: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
    errors: tuple[type[Exception], ...]
    mend: Callable[[bytes], bytes] = bytes


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """One to three random changes: bytes, numbers, words, cuts, moved pieces."""
    changes = (_bytes, _bytes, _number, _word, _word, _cut, _move, _drop)
    for _ in range(int(rng.integers(1, 4))):
        data = changes[int(rng.integers(len(changes)))](data, rng)
    return data


def _span(data: bytes, rng: np.random.Generator, longest: int = 64) -> tuple[int, int]:
    # Half of the time near the start, where headers and counts are.
    start = int(rng.integers(max(1, min(len(data), 64 if rng.random() < 0.5 else len(data)))))
    return start, min(len(data), start + int(rng.integers(1, longest + 1)))


def _bytes(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng, 4)
    return data[:start] + rng.bytes(end - start) + data[end:]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    start, _ = _span(data, rng)
    size, value = int(rng.choice((1, 2, 4, 8))), NUMBERS[int(rng.integers(len(NUMBERS)))]
    return data[:start] + (value % (1 << 8 * size)).to_bytes(size, "little") + data[start + size :]


def _word(data: bytes, rng: np.random.Generator) -> bytes:
    words = [found.span() for found in re.finditer(rb"[0-9A-Za-z_.+-]+", data[:100_000])]
    if not words:
        return data
    start, end = words[int(rng.integers(len(words)))]
    if rng.random() < 0.7:
        word = TOKENS[int(rng.integers(len(TOKENS)))]
    else:
        other = words[int(rng.integers(len(words)))]
        word = data[other[0] : other[1]]
    return data[:start] + word + data[end:]


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _move(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    place, _ = _span(data, rng)
    return data[:place] + data[start:end] + data[place:]


def _drop(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def run(target: Target, folder: Path, cases: int, seed: int = 0) -> tuple[int, int]:
    """Damage files and read them.

    Returns:
        Number of cases that were read, and that were refused.

    Raises:
        AssertionError: A reader raised something else; the file stays in the folder.
    """
    files = target.build(folder)
    originals = {path: path.read_bytes() for path in files}
    for path in files:
        target.read(path)  # valid as it is; and whatever is compiled or imported at first is there
    _limit_memory()
    refused = 0
    for case in range(cases):
        rng = np.random.default_rng([seed, case])
        path = files[int(rng.integers(len(files)))]
        path.write_bytes(target.mend(damaged(originals[path], rng)))
        sys.stderr.write(f"\rcase {case} of seed {seed}: {path}\n")
        faulthandler.dump_traceback_later(SECONDS, exit=True)
        try:
            target.read(path)
        except target.errors as error:
            refused += 1
            _check_message(str(error), folder)
        except BaseException as error:
            raise AssertionError(f"case {case} of seed {seed}, {path}: {type(error).__name__}: {error}") from error
        finally:
            faulthandler.cancel_dump_traceback_later()
        path.write_bytes(originals[path])
    return cases - refused, refused


def _check_message(message: str, folder: Path) -> None:
    """It names the file, or the folder of a scene, and what to do."""
    assert str(folder) in message, f"no file is named: {message}"
    assert REMEDY.search(message), f"no remedy: {message}"


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY,) * 2)


def _scene(n: int) -> CompressedScene:
    return scene(n, {"quats": 8, "scales": 5, "shN": 3}, 1, config={"seed": 1})


def _build_ply(folder: Path) -> list[Path]:
    from nsvq_lightning.io.ply import write_ply

    binary, ascii_ = folder / "binary.ply", folder / "ascii.ply"
    scene = _scene(5)
    write_ply(binary, scene)
    data = binary.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    rows = np.frombuffer(body, "<f4").reshape(len(scene), -1)
    text = "".join(" ".join(f"{value:.6g}" for value in row) + "\n" for row in rows)
    ascii_.write_bytes(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text.encode())
    return [binary, ascii_]


def _build_nsvq(folder: Path) -> list[Path]:
    from nsvq_lightning.io.formats import save
    from nsvq_lightning.io.nsvq.precision import LEVELS, Storage

    files = [folder / f"{level}.nsvq" for level in LEVELS]
    for path in files:
        save(_scene(40), path, Storage(path.stem))
    files.append(folder / "basis.nsvq")
    save(on_basis(scene(40, {})), files[-1])
    return files


def _mend_nsvq(data: bytes) -> bytes:
    """Make magic, version and checksum fit, and mostly the length of the JSON, too."""
    rest = data[24:]
    end = rest.rfind(b"}]}")
    if len(rest) > 8 and end > 0:
        rest = (3).to_bytes(4, "little") + (end + 3 - 8).to_bytes(4, "little") + rest[8:]
    return b"\x89NSVQ\r\n\x1a" + blake2b(rest, digest_size=16).digest() + rest


def _build_viewer(folder: Path, suffix: str, **options: int) -> list[Path]:
    from nsvq_lightning.io.formats import save

    path = folder / f"scene{suffix}"
    save(_scene(40), path, **options)
    if suffix == ".spz" and not options:
        path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()), 0, mtime=0))
    return [path]


def _read_scene(path: Path) -> object:
    from nsvq_lightning.io.errors import FormatError
    from nsvq_lightning.io.formats import describe, read_scene

    with suppress(FormatError):
        describe(path)
    scene = read_scene(path)
    finite = {".ply": (), ".nsvq": (), ".glb": (), ".usda": (), ".splat": ("opacities", "sh0")}
    values = {name: scene.values(name) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    for name in finite.get(path.suffix, ("quats", "scales", "opacities", "sh0", "shN")):
        assert np.isfinite(values[name]).all(), name
    return scene


def _mend_spz(data: bytes) -> bytes:
    """Mostly a new gzip stream around what may be the content: without the 15 bytes before and the 8 behind."""
    return data if data[-1:] > b"\xc0" or len(data) % 5 == 0 else gzip.compress(data[15:-8], 1, mtime=0)


def _mend_sog(data: bytes) -> bytes:
    """Mostly a new archive of what stands between the signatures of its entries."""
    if len(data) % 5 == 0:
        return data
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as new:
        for entry in data.split(b"PK\x01\x02")[0].split(b"PK\x03\x04")[1:]:
            length = int.from_bytes(entry[22:24], "little")
            name = entry[26 : 26 + length].decode("latin-1").replace("\0", "") or "x"
            if name not in new.namelist():
                new.writestr(name, entry[26 + length :])
    return archive.getvalue()


def _build_colmap(folder: Path, suffix: str) -> list[Path]:
    from small_demo import write_small_demo

    from nsvq_lightning.data.colmap import import_pycolmap

    model = write_small_demo(folder / "scene", views=3, width=16, height=12, points=8) / "sparse" / "0"
    if suffix == ".txt":
        reconstruction = import_pycolmap().Reconstruction(str(model))
        for path in model.iterdir():
            path.unlink()
        reconstruction.write_text(str(model))
    return sorted(model.iterdir())


def _read_colmap(path: Path) -> object:
    from nsvq_lightning.data.colmap import read_model
    from nsvq_lightning.data.scene import load_scene

    root = path.parents[2]
    read_model(root, observations=True)
    scene = load_scene(root)
    for camera in scene.cameras:
        assert np.isfinite([*camera.intrinsics, *camera.viewmat.flatten().tolist()]).all()
    assert np.isfinite(scene.extent)
    return scene


def _build_checkpoint(folder: Path) -> list[Path]:
    import torch

    from nsvq_lightning.training.module import SplatModule

    path = folder / "small.ckpt"
    rest = {"pytorch-lightning_version": "2.6.6", "global_step": 3, "history": [], "schedule": {}}
    state = SplatModule(codebooks={}).state_dict()
    torch.save({"state_dict": state, "quantizer_settings": {}, **rest}, path)
    return [path]


def _read_checkpoint(path: Path) -> object:
    from nsvq_lightning.training.resume import read_checkpoint

    return read_checkpoint(path)


def _build_config(folder: Path) -> list[Path]:
    from nsvq_lightning.commands.settings import find_config

    files = []
    for name in ("paper", "best", "demo"):
        files.append(folder / f"{name}.yaml")
        files[-1].write_bytes(Path(find_config(name)).read_bytes())
    return files


@cache
def _parser() -> Callable[[list[str]], object]:
    """The parser of the command line, built once: it takes longer than reading a config."""
    from nsvq_lightning.commands.fit import SplatCLI

    class Cli(SplatCLI):
        def parse_arguments(self, parser: object, args: object) -> None:
            raise StopIteration(parser)

    try:
        Cli([])
    except StopIteration as built:
        return built.value.parse_args  # type: ignore[no-any-return]
    raise AssertionError("the command line has no parser")


def _read_config(path: Path) -> object:
    """Parse it as ``nsvq fit`` would; what is wrong ends the command with status 2 and a message."""
    from nsvq_lightning.commands.settings import check_config

    check_config(str(path))
    status: object = 0
    with redirect_stderr(io.StringIO()) as said:
        try:
            _parser()(["fit", "--config", str(path), "--data.root=scene"])
        except SystemExit as end:
            status = end.code
    message = said.getvalue()
    if status == 2 and message.startswith("error: "):
        raise ValueError(f"{path}: {message}")  # the command adds which files the settings came from
    assert status == 0, message
    return path


def _build_photos(folder: Path) -> list[Path]:
    import cv2

    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 256, (3, 4, 4), dtype=np.uint8), (20, 15), interpolation=cv2.INTER_LINEAR)
    pictures = {
        "rgb.png": smooth[..., :3],
        "rgba.png": smooth,
        "grey16.png": smooth[..., 0].astype(np.uint16) * 257,
        "rgb.jpg": smooth[..., :3],
        "grey.jpg": smooth[..., 0],
        "rgb.tiff": smooth[..., :3],
        "rgb.bmp": smooth[..., :3],
        "rgb.webp": smooth[..., :3],
    }
    for name, picture in pictures.items():
        assert cv2.imwrite(str(folder / name), picture)
    return [folder / name for name in pictures]


def _read_photo(path: Path) -> object:
    """Load it as the photo of a view."""
    from nsvq_lightning.data.colmap import Pinhole
    from nsvq_lightning.data.images import ImageSource, image_head

    size = image_head(path).size
    return ImageSource(path, size, None, Pinhole(np.eye(3), *size)).load()


def targets() -> dict[str, Target]:
    """Kinds of files by name."""
    from nsvq_lightning.data.colmap import SceneError
    from nsvq_lightning.io.errors import FormatError

    return {
        "ply": Target(_build_ply, _read_scene, (FormatError,)),
        "nsvq": Target(_build_nsvq, _read_scene, (FormatError,), _mend_nsvq),
        "spz": Target(partial(_build_viewer, suffix=".spz"), _read_scene, (FormatError,), _mend_spz),
        "spz4": Target(partial(_build_viewer, suffix=".spz", version=4), _read_scene, (FormatError,)),
        "sog": Target(partial(_build_viewer, suffix=".sog"), _read_scene, (FormatError,), _mend_sog),
        "compressed-ply": Target(partial(_build_viewer, suffix=".compressed.ply"), _read_scene, (FormatError,)),
        "glb": Target(partial(_build_viewer, suffix=".glb"), _read_scene, (FormatError,)),
        "usda": Target(partial(_build_viewer, suffix=".usda"), _read_scene, (FormatError,)),
        "lod": Target(partial(_build_viewer, suffix="lod-meta.json"), _read_scene, (FormatError,)),
        "splat": Target(partial(_build_viewer, suffix=".splat"), _read_scene, (FormatError,)),
        "colmap-bin": Target(partial(_build_colmap, suffix=".bin"), _read_colmap, (SceneError,)),
        "colmap-txt": Target(partial(_build_colmap, suffix=".txt"), _read_colmap, (SceneError,)),
        "photo": Target(_build_photos, _read_photo, (SceneError,)),
        "config": Target(_build_config, _read_config, (ValueError,)),
        "checkpoint": Target(_build_checkpoint, _read_checkpoint, (FormatError,)),
    }


if __name__ == "__main__":
    name, place, count, *rest = sys.argv[1:]
    with guarded():
        read, refused_ = run(targets()[name], Path(place), int(count), int(rest[0]) if rest else 0)
    sys.stdout.write(f"{read} read, {refused_} refused\n")
