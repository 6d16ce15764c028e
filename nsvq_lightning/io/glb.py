"""glTF 2.0 in one file (``.glb``) with the extension KHR_gaussian_splatting, for exchange: 240 bytes a splat.

Splats are the points of a mesh primitive. Its attributes are ``POSITION``, ``COLOR_0`` for readers without the
extension, and those of the extension: ``ROTATION`` (xyzw), ``SCALE`` (lengths), ``OPACITY``, and a vector of three
colours for each spherical harmonic. glTF has y up: our right, down, front turned half around z.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from struct import Struct

import numpy as np

from nsvq_lightning.io.atomic import StrPath, atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, Json, as_defect, check_room, check_start, json_object, naming_file
from nsvq_lightning.io.numbers import logits_of, logs_of_lengths, opacity_of
from nsvq_lightning.io.placing import HALF_TURN, moved, rotated
from nsvq_lightning.splats.conventions import SH_C0, Arrays, Float64s, sh_coefficients, unit
from nsvq_lightning.top_level import log

EXTENSION = "KHR_gaussian_splatting"
OPACITY = f"{EXTENSION}:OPACITY"
KERNEL = "ellipse"

# Magic, version, length of the file, and what each chunk begins with, here the first: length and type.
_HEAD, _CHUNK = Struct("<4sIII4s"), Struct("<I4s")
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def _harmonic(number: int) -> str:
    """Name of a coefficient, counted over all degrees from 0."""
    degree = int(number**0.5)
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number - degree * degree}"


_FLOAT, _BYTE, _ARRAY_BUFFER = 5126, 5121, 34962
_COMPONENTS = {5120: "i1", _BYTE: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", _FLOAT: "<f4"}


def write_glb(path: StrPath, scene: CompressedScene) -> int:
    """Write a scene as ``.glb``, in float32; the translation of its node, in float64, is its origin.

    Returns:
        Bytes of the file.
    """
    scene = rotated(scene, HALF_TURN)
    opacities = opacity_of(scene.rows("opacities"))
    base, higher = scene.rows("sh0"), scene.values("shN")
    # The fallback is linear light; what the splats have is meant for display.
    shown = np.clip(0.5 + SH_C0 * base.astype(np.float64), 0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    arrays = {
        "POSITION": scene.means,
        "COLOR_0": np.rint(255 * np.c_[linear, opacities]).astype(np.uint8),
        f"{EXTENSION}:ROTATION": unit(scene.rows("quats"))[:, [1, 2, 3, 0]].astype(np.float32),
        f"{EXTENSION}:SCALE": np.exp(scene.rows("scales")),
        OPACITY: opacities.astype(np.float32),
        _harmonic(0): base,
        **{_harmonic(number + 1): higher[:, number] for number in range(higher.shape[1])},
    }
    kinds = {width: name for name, width in _WIDTHS.items()}
    views = []
    accessors = []
    end = 0
    for number, values in enumerate(arrays.values()):
        is_byte = values.dtype == np.uint8
        views.append({"buffer": 0, "byteOffset": end, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
        accessors.append(
            {
                "bufferView": number,
                "count": len(scene),
                "type": kinds[values.shape[1]],
                "componentType": _BYTE if is_byte else _FLOAT,
                "normalized": is_byte,
            }
        )
        end += values.nbytes
    accessors[0] |= {"min": scene.means.min(0).tolist(), "max": scene.means.max(0).tolist()}
    about = {
        "kernel": KERNEL,
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    attributes = {name: number for number, name in enumerate(arrays)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: about}}
    asset: Json = {"version": "2.0", "generator": "nsvq-lightning"}
    if scene.antialiased:
        asset["extras"] = {"antialiased": True}
    document = {
        "asset": asset,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": scene.origin}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": end}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = _HEAD.size + len(text) + _CHUNK.size + end
    if total >> 32:  # lengths have 32 bits
        raise ValueError(f"{path}: {total} bytes are more than a .glb can have: write .ply, .nsvq or .spz")
    with atomic_write(path) as file:
        file.write(_HEAD.pack(b"glTF", 2, total, len(text), b"JSON") + text + _CHUNK.pack(end, b"BIN\0"))
        for values in arrays.values():
            file.write(np.ascontiguousarray(values).data)
    return total


def read_glb(path: StrPath) -> CompressedScene:
    """Read all splats of the scene of a ``.glb`` file, where its nodes put them.

    Raises:
        FormatError: The file is truncated, altered, no ``.glb`` file, or holds no Gaussian splats that are read:
            numbers in sparse accessors or other files, compressed ones, and nodes that stretch splats unevenly are not.
            Lengths that are logarithms, and the names of drafts of the extension, are.
    """
    with naming_file(path), as_defect("of a kind that is not read, or altered", remedy="save it as a plain .glb"):
        document, data = _parsed(Path(path).read_bytes())
        parts, count = [], 0
        for primitive, matrix in _primitives(document):
            parts.append(moved(_splats(document, data, primitive), matrix))
            count += len(parts[-1])
            check_room("splats", count, len(data))  # primitives may share their numbers
        if not parts:
            used = ", ".join(map(str, document.get("extensionsUsed", ()))) or "none"
            raise FormatError(f"no primitive has the extension {EXTENSION}; used are: {used}", "export splats so")
        return rotated(CompressedScene.joined(parts), HALF_TURN)


_MAX_JSON = 1 << 26


def _parsed(data: bytes) -> tuple[Json, memoryview]:
    """JSON and binary chunk."""
    check_start(".glb", data, b"glTF", _HEAD.size)
    _, version, total, length, kind = _HEAD.unpack_from(data)
    end = _HEAD.size + length
    if version != 2 or max(total, end) > len(data) or kind != b"JSON" or length > _MAX_JSON:
        raise FormatError(f"truncated or damaged: version {version}, {total} of {len(data)} bytes, a chunk of {length}")
    return json_object(data[_HEAD.size : end], "the first chunk"), memoryview(data)[end + _CHUNK.size :]


def _primitives(document: Json) -> Iterator[tuple[Json, Float64s]]:
    """Those with splats, and the matrix ``[4, 4]`` of the node that each is in."""
    nodes = dict(enumerate(document["nodes"]))
    stack = [(number, np.eye(4)) for number in reversed(document["scenes"][document.get("scene", 0)]["nodes"])]
    while stack:
        number, outer = stack.pop()
        if number not in nodes:
            raise ValueError("a node is in two others, or missing")
        node = nodes.pop(number)
        matrix = outer @ _matrix(node)
        stack += [(child, matrix) for child in reversed(node.get("children", ()))]
        if "mesh" not in node:
            continue
        for primitive in document["meshes"][node["mesh"]]["primitives"]:
            if EXTENSION in primitive.get("extensions", {}):
                if "EXT_mesh_gpu_instancing" in (node.get("extensions") or ()):
                    log.warning("a node has EXT_mesh_gpu_instancing, which is not read: its splats are shown once")
                yield primitive, matrix


def _matrix(node: Json) -> Float64s:
    """What a node does to what is in it ``[4, 4]``."""
    from scipy.spatial.transform import Rotation

    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _splats(document: Json, data: memoryview, primitive: Json) -> CompressedScene:
    """The splats of a primitive, in the axes of the file."""
    about = primitive["extensions"][EXTENSION]
    if inner := about.get("extensions"):
        raise FormatError(f"splats are compressed by {', '.join(inner)}, which is not read", "save them without it")
    if about.get("colorSpace") == "lin_rec709_display":
        log.warning("colorSpace lin_rec709_display: colours are linear light and are shown as they are, too dark")
    if (kernel := about.get("kernel", KERNEL)) != KERNEL:
        log.warning(f"splats of the kernel {kernel} are shown as of {KERNEL}")
    given = primitive["attributes"]
    names = {f"{EXTENSION}:{name[1:]}": number for name, number in given.items() if name.startswith("_")} | given
    if len(names) > len(given):
        log.warning(f"attributes have the names of a draft of {EXTENSION}, such as _ROTATION")

    def values(name: str) -> Arrays:
        if name not in names:
            raise FormatError(f"splats without the attribute {name}")
        return _accessor(document, data, names[name])

    degree = max((int(number**0.5) for number in range(16) if _harmonic(number) in names), default=0)
    rows = {
        "means": values("POSITION"),
        "quats": values(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]],
        "scales": logs_of_lengths(values(f"{EXTENSION}:SCALE")),
    }
    # In drafts, colours and opacities were those of the points.
    shown = values(OPACITY if OPACITY in names else "COLOR_0")
    # Without alpha, colours are opaque.
    rows["opacities"] = logits_of(np.ones(len(shown)) if shown.shape[1] == 3 else shown[:, -1])
    base = _harmonic(0)
    rows["sh0"] = values(base) if base in names else (values("COLOR_0")[:, :3] - 0.5) / SH_C0
    if degree:
        higher = [values(_harmonic(number + 1)) for number in range(sh_coefficients(degree))]
        rows["shN"] = np.concatenate(higher, axis=1)
    extras = document["asset"].get("extras")
    antialiased = isinstance(extras, dict) and extras.get("antialiased") is True
    points = _accessor(document, data, primitive["indices"])[:, 0] if "indices" in primitive else slice(None)
    return CompressedScene.from_rows(rows, antialiased=antialiased).take(points)


def _accessor(document: Json, data: memoryview, number: int) -> Arrays:
    """Rows ``[N, D]`` of an accessor, whole numbers where the file has them."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    if packed := view.get("extensions"):
        raise FormatError(f"numbers are compressed by {', '.join(packed)}, which is not read", "save them without it")
    if "sparse" in accessor or view.get("buffer", 0) or "uri" in document["buffers"][0]:
        raise FormatError("numbers in sparse accessors or in other files are not read", "save it as a plain .glb")
    dtype = np.dtype(_COMPONENTS[accessor["componentType"]])
    width = _WIDTHS[accessor["type"]]
    count = accessor["count"]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    row = width * dtype.itemsize
    stride = view.get("byteStride", row)
    if start < 0 or stride < row:
        raise ValueError(f"accessor {number} is out of range")
    if start + (count - 1) * stride + row > len(data):
        raise FormatError(f"truncated: accessor {number} ends beyond the file")
    rows = np.array(np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize)))
    if dtype.kind != "f" and accessor.get("normalized"):
        rows = np.maximum(rows / np.iinfo(dtype).max, -1)
    return rows
