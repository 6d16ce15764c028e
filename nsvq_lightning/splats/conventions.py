"""How splats are laid out: arrays, quaternions, coefficients of an SH degree. Without torch: files open fast."""

import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# NumPy arrays of any shape, by the type of their numbers.
Bools = NDArray[np.bool_]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Uint8s = NDArray[np.uint8]
Uint32s = NDArray[np.uint32]
Uint64s = NDArray[np.uint64]
Integers = NDArray[np.integer]
Floats = NDArray[np.floating]
Records = NDArray[np.void]
Arrays = NDArray[Any]
# x, y, z in the world.
Place: TypeAlias = tuple[float, float, float]
ZERO: Place = (0.0, 0.0, 0.0)

# Higher spherical-harmonic coefficients per colour channel by degree, (degree + 1)² - 1.
_COEFFICIENTS = 0, 3, 8, 15
# Value of the constant spherical harmonic: colour = 0.5 + SH_C0 * sh0.
SH_C0 = 0.5 / math.sqrt(math.pi)

# ``[4, 3]``: the components other than each one, ascending.
_OTHERS = np.array([[j for j in range(4) if j != i] for i in range(4)])


def white_of(colors: Arrays, fractions: bool) -> int:
    """What stands for white in colours of any kind: 1, 255, 4095 or 65535, the first that nearly all do not exceed.

    A few above it, of interpolation or bright reflections, do not make all others black.

    Args:
        colors: Of any shape; some may not be finite.
        fractions: Whether 1 may be white.
    """
    usual = np.quantile(np.append(colors[np.isfinite(colors) & (colors > 0)], 0), 0.9)
    return next((white for white in (1, 255, 4095) if usual <= white and (fractions or white > 1)), 65535)


def sh_coefficients(degree: int) -> int:
    """Number of higher spherical-harmonic coefficients per colour channel, (degree + 1)² - 1.

    Raises:
        ValueError: ``degree`` is not in 0..3.
    """
    if degree not in range(4):
        raise ValueError(f"the SH degree must be 0, 1, 2 or 3, got {degree}")
    return _COEFFICIENTS[degree]


def shN_degree(coefficients: int) -> int:
    """Degree that has this many higher coefficients per colour channel.

    Raises:
        ValueError: No degree from 0 to 3 has.
    """
    if coefficients not in _COEFFICIENTS:
        raise ValueError(f"SH degrees 0 to 3 have 0, 3, 8 or 15 higher coefficients, got {coefficients}")
    return _COEFFICIENTS.index(coefficients)


# Squared quaternion norms are floored here, so that a zero quaternion is the identity and has no gradient.
MIN_SQUARED_NORM = 1e-24


def unit(quats: Float32s) -> Float64s:
    """Quaternions wxyz ``[N, 4]`` scaled to length 1; zero becomes the identity."""
    wide = quats.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.where(length > 0, wide / np.where(length > 0, length, 1), [1.0, 0.0, 0.0, 0.0])


def turned(quats: Float32s, rotation: Float64s) -> Float32s:
    """Quaternions wxyz ``[N, 4]`` after all axes have turned by a rotation ``[3, 3]``, of length 1."""
    from scipy.spatial.transform import Rotation  # slow to import, and few files are turned

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray(unit(quats) @ product.T, np.float32)


def smallest_three(units: Float64s) -> tuple[NDArray[np.intp], Float64s]:
    """Index of the largest component ``[N]``, and the other three ``[N, 3]`` in order, each in ±1/√2.

    Args:
        units: Quaternions ``[N, 4]`` of length 1, components in any order.

    Returns:
        Both, of whichever of q and −q has a positive largest component.
    """
    largest = np.abs(units).argmax(1)
    negative = np.take_along_axis(units, largest[:, None], 1) < 0
    others = np.take_along_axis(units, _OTHERS[largest], 1)
    return largest, np.where(negative, -others, others)


def from_smallest_three(largest: NDArray[np.intp], others: Float64s) -> Float32s:
    """Unit quaternions ``[N, 4]`` from the two results of :func:`smallest_three`; the second may be rounded."""
    quats = np.empty((len(largest), 4))
    np.put_along_axis(quats, _OTHERS[largest], others, 1)
    np.put_along_axis(quats, largest[:, None], np.sqrt(np.maximum(0, 1 - np.square(others).sum(1)))[:, None], 1)
    return quats.astype(np.float32)


def middle_of(places: Float32s | Float64s) -> tuple[Float64s, float]:
    """The median ``[3]`` of places ``[P, 3]``, P > 0, and the distance from it that four fifths do not exceed."""
    middle = np.median(places.astype(np.float64), axis=0)
    return middle, usual_of(np.linalg.norm(places - middle, axis=1))


def usual_of(distances: Float64s) -> float:
    """What four fifths of distances ``[V]`` do not exceed; it is one of them."""
    return float(np.quantile(distances, 0.8, method="lower"))
