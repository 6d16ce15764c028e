"""OpenUSD as text (``.usda``), 26.03 and later: one ``ParticleField3DGaussianSplat``, about 600 bytes a splat.

It has y up: our right, down, front turned half around z.
"""

import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.compressed import HALF_TURN, CompressedScene, rotated
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.numbers import logits_of, opacity_of
from nsvq_lightning.splats.conventions import sh_coefficients, unit

_ROWS = 1 << 12
PRIM = "ParticleField3DGaussianSplat"
_COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"


def write_usda(path: str | os.PathLike[str], scene: CompressedScene) -> int:
    """Write a scene as ``.usda``; numbers are the shortest that read back to within float32.

    Returns:
        Bytes of the file.
    """
    scene = rotated(scene, HALF_TURN)
    colors = np.concatenate([scene.values("sh0"), scene.values("shN")], axis=1)
    per_splat = sh_coefficients(scene.sh_degree) + 1
    arrays: list[tuple[str, NDArray[np.floating], str]] = [
        ("point3f[] positions", scene.means, ""),
        ("quatf[] orientations", unit(scene.values("quats")), ""),
        ("float3[] scales", np.exp(scene.values("scales").astype(np.float64)), ""),
        ("float[] opacities", opacity_of(scene.opacities)[:, None], ""),
        (
            f"float3[] {_COEFFICIENTS}",
            colors.reshape(-1, 3),
            f' (\n        elementSize = {per_splat}\n        interpolation = "vertex"\n    )',
        ),
    ]
    if len(scene):
        arrays.append(("float3[] extent", np.stack([scene.means.min(0), scene.means.max(0)]), ""))
    note = "    customData = { bool antialiased = 1 }\n" if scene.antialiased else ""
    with atomic_write(path) as file:
        file.write(
            f'#usda 1.0\n(\n    defaultPrim = "Splats"\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n\n'
            f'def {PRIM} "Splats" (\n{note})\n{{\n'
            f"    uniform int radiance:sphericalHarmonicsDegree = {scene.sh_degree}\n"
            '    uniform token projectionModeHint = "perspective"\n'
            '    uniform token sortingModeHint = "cameraDistance"\n'.encode()
        )
        for name, values, details in arrays:
            file.write(f"    {name} = [".encode())
            row = "(" + ", ".join(["%.9g"] * values.shape[1]) + ")" if values.shape[1] > 1 else "%.9g"
            for start in range(0, len(values), _ROWS):
                block = values[start : start + _ROWS]
                text = ", ".join([row] * len(block)) % tuple(block.ravel().tolist())
                file.write((", " * bool(start) + text).encode())
            file.write(f"]{details}\n".encode())
        file.write(b"}\n")
        return file.tell()


def read_usda(path: str | os.PathLike[str]) -> CompressedScene:
    """Read the splats of a ``.usda`` file with one prim of splats, with y up, at the root, without transforms.

    Raises:
        FormatError: It is truncated, damaged or something else.
    """
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    with naming_file(path):
        if not text.startswith("#usda") or text.count(f"def {PRIM}") != 1 or "xformOp" in text:
            raise FormatError(f"not a .usda file with one {PRIM} and no transforms", "export it anew, flattened")

        def rows(name: str, width: int) -> NDArray[np.float32]:
            found = re.search(rf"\[\] {name} = \[([^\]]*)\]", text)
            numbers = [] if found is None else re.sub(r"[(),]", " ", found[1]).split()
            try:
                return np.array(numbers, np.float64).astype(np.float32).reshape(-1, width)
            except ValueError as error:
                raise FormatError(f"damaged: {name} ({error})") from None

        means, logits = rows("positions", 3), logits_of(rows("opacities", 1)[:, 0])
        scales = np.log(rows("scales", 3).clip(np.finfo(np.float32).tiny))
        stated = re.search(r"radiance:sphericalHarmonicsDegree = ([0-3])\b", text)
        degree = int(stated[1]) if stated else 0
        try:
            colors = rows(_COEFFICIENTS, 3).reshape(len(means), 3 + 3 * sh_coefficients(degree))
            raw = {"quats": rows("orientations", 4), "scales": scales, "sh0": colors[:, :3], "shN": colors[:, 3:]}
            config = {"antialiased": True} if "bool antialiased = 1" in text else {}
            scene = CompressedScene(means, logits, raw=raw, sh_degree=degree, config=config)
        except ValueError as error:
            raise FormatError(f"truncated or damaged: {error}") from None
    return rotated(scene, HALF_TURN)
