"""OpenUSD as text (``.usda``), 26.03 and later: one ``ParticleField3DGaussianSplat``, about 600 bytes a splat.

It has y up: our right, down, front turned half around z.
"""

import re
from pathlib import Path
from warnings import catch_warnings

import numpy as np

from nsvq_lightning.io.atomic import StrPath, atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, as_defect, check_start, naming_file
from nsvq_lightning.io.numbers import logits_of, logs_of_lengths, opacity_of
from nsvq_lightning.io.placing import HALF_TURN, UP_AXES, rotated
from nsvq_lightning.splats.conventions import Arrays, Float32s, sh_coefficients, unit
from nsvq_lightning.top_level import log

_ROWS = 1 << 12
BINARY_REMEDY = "write it as text: usdcat -o scene.usda FILE"
PRIM = "ParticleField3DGaussianSplat"
_COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
# Strings and comments. These begin with a set of letters, or all numbers are looked at with care: ten times as slow.
_WORDS = re.compile(r"""(["'\#])(?:(?<=\#)[^\n]*|\1\1(?:\\.|(?!\1{3}).)*+\1{3}|(?:\\.|(?!\1).)*+\1)""", re.DOTALL)


def write_usda(path: StrPath, scene: CompressedScene) -> int:
    """Write a scene as ``.usda``; numbers are the shortest that read back to within float32.

    Returns:
        Bytes of the file.
    """
    scene = rotated(scene, HALF_TURN)
    coefficients = 1 + sh_coefficients(scene.sh_degree)
    # Each as columns of rows, which are written as rows of so many numbers.
    arrays: dict[str, tuple[int, list[Arrays]]] = {
        "point3f[] positions": (3, [scene.means]),
        "quatf[] orientations": (4, [unit(scene.rows("quats"))]),
        "float3[] scales": (3, [np.exp(scene.rows("scales").astype(np.float64))]),
        "float[] opacities": (1, [opacity_of(scene.rows("opacities"))]),
        f"float3[] {_COEFFICIENTS}": (3, [scene.rows("sh0"), scene.rows("shN")]),
        "float3[] extent": (3, [np.stack([scene.means.min(0), scene.means.max(0)])]),
    }
    about_colors = f' (\n        elementSize = {coefficients}\n        interpolation = "vertex"\n    )'
    note = "    customData = { bool antialiased = 1 }\n" if scene.antialiased else ""
    with atomic_write(path) as file:
        file.write(
            f'#usda 1.0\n(\n    defaultPrim = "Splats"\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n\n'
            f'def {PRIM} "Splats" (\n{note})\n{{\n'
            f"    uniform int radiance:sphericalHarmonicsDegree = {scene.sh_degree}\n"
            '    uniform token projectionModeHint = "perspective"\n'
            '    uniform token sortingModeHint = "cameraDistance"\n'.encode()
        )
        for name, (width, columns) in arrays.items():
            file.write(f"    {name} = [".encode())
            row = ", ".join(["%.9g"] * width)
            if width > 1:
                row = f"({row})"
            for start in range(0, len(columns[0]), _ROWS):
                block = np.concatenate([each[start : start + _ROWS] for each in columns], axis=1).reshape(-1, width)
                text = ", ".join([row] * len(block)) % tuple(block.ravel().tolist())
                file.write((", " * bool(start) + text).encode())
            file.write(f"]{about_colors if _COEFFICIENTS in name else ''}\n".encode())
        file.write(b"}\n")
        return file.tell()


def read_usda(path: StrPath) -> CompressedScene:
    """Read the splats of a ``.usda`` file with one prim of splats, without transforms.

    Attributes may be half as precise (``positionsh``), or samples in time, of which the first is read. A stage with z
    up is turned, one that states another unit than metres is scaled.

    Raises:
        FormatError: It is truncated, damaged or something else.
    """
    data = Path(path).read_bytes()
    with naming_file(path):
        if data.startswith((b"PXR-USDC", b"PK")):
            raise FormatError("binary OpenUSD (.usdc or .usdz); only text is read", BINARY_REMEDY)
        check_start(".usda", data, b"#usda")
        # No comments, and no strings but a letter, as of an axis: both may say anything.
        text = _WORDS.sub(lambda found: found[0] * (len(found[0]) == 3), data.decode("utf-8", "replace"))
        about, *prims = re.split(r"[doc](?:(?<=\bd)ef|(?<=\bo)ver|(?<=\bc)lass)\s+", text)
        own = [prim for prim in prims if re.match(rf"{PRIM}\b", prim)]
        if len(own) != 1:
            raise FormatError(f"{len(own)} prims of the kind {PRIM}, not one", "export it anew with one")
        if b"lin_rec709" in data:
            log.warning(f"{path}: colours are linear light and are shown as they are, too dark")
        if "xformOp:" in text:
            raise FormatError("it has transforms (xformOp), which are not read", "export it anew, flattened")
        prim = own[0]
        if ".timeSamples" in prim:
            log.warning(f"{path} changes with time: the first sample is read")
        rows = {
            "means": _rows(prim, "positions", 3),
            "opacities": logits_of(_rows(prim, "opacities", 1)),
            "scales": logs_of_lengths(_rows(prim, "scales", 3)),
            "quats": _rows(prim, "orientations", 4),
        }
        colors = _rows(prim, _COEFFICIENTS, 3)
        with as_defect("truncated or damaged", ValueError):
            colors = colors.reshape(len(rows["means"]), -1)
            rows |= {"sh0": colors[:, :3], "shN": colors[:, 3:]}
            scene = CompressedScene.from_rows(rows, "bool antialiased = 1" in prim)
            # What takes the axes of the stage to ours, and its unit to metres where it states one.
            turn = HALF_TURN @ UP_AXES["z"] if re.search(r"\bupAxis\s*=\s*.Z", about) else HALF_TURN
            if found := re.search(r"\bmetersPerUnit\s*=\s*([-+.\deE]+)", about):
                turn = turn * float(found[1])
            return rotated(scene, turn)


def _rows(text: str, name: str, width: int) -> Float32s:
    """Rows ``[N, width]`` of an attribute, in full or in half precision."""
    for each in (name, f"{name}h"):
        value = r"(?:=|\.timeSamples\s*=\s*\{[^:\[]*:)\s*\[([^\]]*)\]"
        if found := re.search(rf"\[\]\s*{each}\s*{value}", text):
            numbers = found[1].translate(dict.fromkeys(b"(),", " ")).strip()
            with as_defect(f"damaged: {name}", (ValueError, DeprecationWarning)), catch_warnings(action="error"):
                return np.fromstring(numbers, np.float32, sep=" ").reshape(-1, width)
    raise FormatError(f"truncated: {name} has no end" if name in text else f"no attribute {name}")
