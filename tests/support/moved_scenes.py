"""The same COLMAP scene in another unit and at another place, as somebody else's program writes it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nsvq_lightning.data.colmap import import_pycolmap


def write_moved(scene: Path, root: Path, unit: float = 1.0, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Path:
    """Write a scene whose world x is at ``unit · x + shift``, with links to the photos."""
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    model.transform(pycolmap.Sim3d(unit, pycolmap.Rotation3d(), np.array(shift)))
    (root / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(root / "sparse" / "0"))
    os.symlink(scene / "images", root / "images", target_is_directory=True)
    return root
