"""Scenes for the tests of the formats of viewers, and the errors that the bits of a format allow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io import CompressedScene, SplatArrays


def plain_scene(n: int, degree: int = 3, seed: int = 0) -> CompressedScene:
    """Splats within the range of every format, all numbers different."""
    rng = np.random.default_rng([n, degree, seed])
    return CompressedScene.from_arrays(
        SplatArrays(
            means=rng.normal(0, 5, (n, 3)).astype(np.float32),
            quats=rng.normal(0, 3, (n, 4)).astype(np.float32),
            scales=rng.uniform(-7, 1, (n, 3)).astype(np.float32),
            opacities=rng.normal(0, 2, n).astype(np.float32),
            sh0=rng.uniform(-1.7, 1.7, (n, 1, 3)).astype(np.float32),
            shN=rng.uniform(-0.9, 0.9, (n, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
        )
    )


def coded_scene(n: int, degree: int = 3, rows: int = 20) -> CompressedScene:
    """The same with codebooks, of which the last row is not used; rotations are plain."""
    plain = plain_scene(n, degree)
    rng = np.random.default_rng([n, degree, rows])
    names = ("scales", "sh0", "shN") if degree else ("scales", "sh0")
    source = plain_scene(rows, degree, seed=1)
    return CompressedScene(
        plain.means,
        plain.opacities,
        codes={name: rng.integers(0, rows - 1, n) for name in names},
        codebooks={name: source.raw[name] for name in names},
        raw={name: values for name, values in plain.raw.items() if name not in names},
        sh_degree=degree,
    )


def nearest_in(read: SplatArrays, written: SplatArrays) -> NDArray[np.intp]:
    """For each splat that was read the one that was written, by position: formats may reorder."""
    distance = np.abs(read.means[:, None].astype(np.float64) - written.means[None]).max(2)
    order = distance.argmin(1)
    assert len(set(order.tolist())) == len(written)
    return order


def angles(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Angles between rotations ``[N, 4]`` of any norm, radians."""
    a64, b64 = (q.astype(np.float64) / np.linalg.norm(q.astype(np.float64), axis=1, keepdims=True) for q in (a, b))
    # The length of the difference, not the scalar product: that loses small angles.
    return 4 * np.arcsin(np.minimum(np.linalg.norm(a64 - b64, axis=1), np.linalg.norm(a64 + b64, axis=1)) / 2)


def sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float64]:
    return 1 / (1 + np.exp(-logits.astype(np.float64)))


__all__ = ["angles", "coded_scene", "nearest_in", "plain_scene", "sigmoid"]
