"""Streamed SOG of PlayCanvas: a folder with levels of detail, which viewers load coarse first, then fine.

``lod-meta.json`` has a tree of boxes. Each leaf says, for each level, which run of splats of which file lies in its
box; level 0 is the finest. A file is a folder of SOG (:mod:`nsvq_lightning.io.sog`) with the runs of several leaves of
one level, each in Morton order.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path, PurePosixPath
from shutil import rmtree

import numpy as np

from nsvq_lightning.io.atomic import StrPath, make_folder_of, write_bytes, write_text
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, Json, as_defect, naming_file
from nsvq_lightning.io.morton import spatial_order
from nsvq_lightning.io.sog import META, PALETTE_LIMIT, read_sog, sog_contents
from nsvq_lightning.splats.conventions import Float64s, Integers, unit
from nsvq_lightning.top_level import log

NAME = "lod-meta.json"

# Most splats of the finest level in a leaf, and of any level in a file.
LEAF, FILE = 1 << 14, 1 << 17
_ASSET = {"generator": "nsvq-lightning"}


def write_lod(
    path: StrPath, scene: CompressedScene, *, coarser: Sequence[CompressedScene] = (), palette: int = PALETTE_LIMIT
) -> int:
    """Write a scene as streamed SOG: ``lod-meta.json`` and, beside it, the folders that it names.

    Folders are named after their content, and the index is replaced last: a failed write leaves the old scene whole.
    Folders that only the old index names are removed, if it is one of these.

    Args:
        path: The ``lod-meta.json``.
        scene: The finest level.
        coarser: Coarser levels of the same scene, finest first, each as :func:`nsvq_lightning.save` takes them.
        palette: See :func:`nsvq_lightning.io.sog.sog_contents`.

    Returns:
        Bytes of all files.

    Raises:
        ValueError: A level is not coarser than the one before it.
    """
    path = Path(path)
    coarse = [CompressedScene.from_splats(level).finite() for level in coarser]
    levels = [scene, *(level.relative_to(scene.origin) if any(level.origin) else level for level in coarse)]
    counts = [len(level) for level in levels]
    if counts != sorted({*counts}, reverse=True):
        raise ValueError(f"each level must have fewer splats than the one before it, got {counts}")
    tree, leaves = _tree(levels)
    old = []
    with suppress(FileNotFoundError, FormatError):
        old = _index(path)["own"]
    make_folder_of(path)
    folders: list[str] = []
    total = 0
    for number, splats in enumerate(levels):
        for part, runs in enumerate(_files([(rows[number], node) for rows, node in leaves])):
            contents = sog_contents(splats.take(np.concatenate([rows for rows, _ in runs])), palette)
            # Those of two indices in one folder differ.
            folder = f"{path.name[: -len(NAME)]}{number}_{part}_{sha256(b''.join(contents.values())).hexdigest()[:8]}"
            (path.parent / folder).mkdir(exist_ok=True)
            for name, data in contents.items():
                total += write_bytes(path.parent / folder / name, data)
            offset = 0
            for rows, node in runs:
                node["lods"][str(number)] = {"file": len(folders), "offset": offset, "count": len(rows)}
                offset += len(rows)
            folders.append(folder)
    about = {
        "version": 1,
        "asset": _ASSET,
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "filenames": [f"{folder}/{META}" for folder in folders],
        "tree": tree,
    }
    total += write_text(path, json.dumps(about, separators=(",", ":")))
    for folder in {name.partition("/")[0] for name in old if name.count("/") == 1}.difference(folders):
        rmtree(path.parent / folder, ignore_errors=True)
    return total


def _tree(levels: Sequence[CompressedScene]) -> tuple[Json, list[tuple[list[Integers], Json]]]:
    """The root, and in their order the leaves with the splats of each level in them."""
    # Splats of all levels, one level after another, and the first of each.
    means = np.concatenate([level.means for level in levels])
    boxes = np.concatenate([_boxes(level) for level in levels])
    starts = np.cumsum([0, *map(len, levels)])
    leaves = []

    def node(splats: Integers) -> Json:
        low, high = boxes[splats, 0].min(0), boxes[splats, 1].max(0)
        found: Json = {"bound": {"min": _decimals(low), "max": _decimals(high)}}
        of_levels = np.split(splats, np.searchsorted(splats, starts[1:-1]))
        finest = of_levels[0]
        axis = means[finest].std(0).argmax()
        below = means[splats, axis] < np.median(means[finest, axis])
        if len(finest) > LEAF and below[: len(finest)].any():
            found["children"] = [node(splats[below]), node(splats[~below])]
            return found
        found["lods"] = {}
        rows = [each[spatial_order(means[each])] - start for each, start in zip(of_levels, starts, strict=False)]
        leaves.append((rows, found))
        return found

    return node(np.arange(len(means))), leaves


def _decimals(position: Float64s) -> list[float]:
    return [float(f"{x:.7g}") for x in position]


# The box of a splat ends where its density is that of so many standard deviations.
_REACH = 3.0


def _boxes(scene: CompressedScene) -> Float64s:
    """Smallest and largest coordinates ``[N, 2, 3]`` of the ellipsoid of each splat."""
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(unit(scene.rows("quats")), scalar_first=True).as_matrix()
    half_axes = axes * np.exp(scene.rows("scales").astype(np.float64))[:, None, :]
    reach = _REACH * np.sqrt(np.square(half_axes).sum(2))
    return np.stack([scene.means - reach, scene.means + reach], axis=1)


def _files(runs: list[tuple[Integers, Json]]) -> Iterator[list[tuple[Integers, Json]]]:
    """The leaves with any splats, by the file that they share."""
    some: list[tuple[Integers, Json]] = []
    count = 0
    for rows, node in runs:
        if some and count + len(rows) > FILE:
            yield some
            some, count = [], 0
        if len(rows):
            some.append((rows, node))
            count += len(rows)
    yield some


# Of an index; one of 100 million splats has a fifth of it.
_MAX_BYTES = 1 << 26


def _index(path: Path) -> dict[str, list[str]]:
    """Of ``lod-meta.json``, names: ``shown``, the finest level and what surrounds it; ``all``; ``own``, all of ours."""
    with naming_file(path):
        if path.stat().st_size > _MAX_BYTES:
            raise FormatError(f"damaged: an index cannot have {path.stat().st_size} bytes")
        with as_defect("damaged: not the index of a streamed SOG"):
            index = json.loads(path.read_bytes())
            names, nodes = [str(PurePosixPath(name)) for name in index["filenames"]], [index["tree"]]
            finest: dict[str, None] = {}  # an ordered set: names of the files with splats of level 0
            while nodes:
                node = nodes.pop()
                nodes += reversed(node.get("children", ()))
                if "0" in node.get("lods", {}):
                    finest[names[node["lods"]["0"]["file"]]] = None
            shown = list(finest)
            if around := index.get("environment"):
                shown.append(str(PurePosixPath(around)))
        if strange := [name for name in (*names, *shown) if not _is_beside(PurePosixPath(name))]:
            raise FormatError(f"damaged: {strange[0][:80]!r} is no FOLDER/{META} or .sog beside it")
        if not finest:
            raise FormatError("damaged: no leaf has splats of level 0")
        if absent := [name for name in shown if not (path.parent / name).is_file()]:
            raise FormatError(f"incomplete: {absent[0]} is missing", "copy the whole folder again")
        if (version := index.get("version", 1)) != 1:  # the first writers stated none
            raise FormatError(f"version {str(version)[:40]} of the format; this release reads version 1")
    return {"shown": shown, "all": names, "own": names if index.get("asset") == _ASSET else []}


def _is_beside(name: PurePosixPath) -> bool:
    """Whether a name is that of a SOG in the folder of the index, or below it."""
    return not name.is_absolute() and ".." not in name.parts and (name.name == META or name.suffix == ".sog")


def read_lod(path: StrPath) -> CompressedScene:
    """Read the finest level of a streamed SOG, and its environment.

    Raises:
        FormatError: A file is truncated, altered or of another version.
        OSError: A file cannot be read.
    """
    path = Path(path)
    index = _index(path)
    parts = [read_sog(path.parent / name) for name in index["shown"]]
    if coarser := len({*index["all"]}.difference(index["shown"])):
        log.info(f"{path}: coarser levels, {coarser} files, are not read: nsvq compress makes them anew")
    size = path.stat().st_size + sum(part.stored_bytes or 0 for part in parts)
    # The surroundings may be of another kind; splats are shown as one.
    return replace(CompressedScene.joined([replace(part, config=parts[0].config) for part in parts]), stored_bytes=size)
