"""Numbers in few bits: opacities as bytes, values clamped to a range, powers of two."""

import math
from collections import Counter

import numpy as np

from nsvq_lightning.io.atomic import StrPath
from nsvq_lightning.io.errors import Bytes
from nsvq_lightning.splats.conventions import Float32s, Float64s, Floats, Int32s, Uint8s
from nsvq_lightning.top_level import log

# Logarithm that stands for that of an axis length of 0, which discs have: too thin to show, and not beyond any format's
# range by more than it must be.
FLAT = -20.0


def opacity_of(logits: Float32s) -> Float64s:
    """Opacities in [0, 1] of logits of any shape."""
    return 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -80, 80)))


# Magnitude of the logit that replaces ±inf: its sigmoid is 1 in float32, and training can still move it.
_OPAQUE = 20.0


def finite_logits(logits: Float32s) -> Float32s:
    """The logits with ±20 in place of ±inf, which 0 and 255 become where opacities are stored as bytes."""
    return np.where(np.isinf(logits), np.copysign(_OPAQUE, logits), logits)


def logits_of(opacities: Floats) -> Float32s:
    """Logits of opacities of any shape: finite in [0, 1], otherwise NaN.

    Where more than a hundredth are negative, not by rounding, all are logits already.
    """
    if (opacities < 0).sum() > 0.01 * opacities.size:
        log.warning("opacities are negative: taken as logits")
        return finite_logits(opacities.astype(np.float32))
    wide = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return finite_logits((np.log(wide) - np.log1p(-wide)).astype(np.float32))


def bytes_of(logits: Float32s) -> Uint8s:
    """The opacities of logits of any shape in 255ths."""
    return np.rint(255 * opacity_of(logits)).astype(np.uint8)


def logits_of_bytes(levels: Uint8s) -> Float32s:
    """Finite logits of opacities given in 255ths."""
    return logits_of(np.arange(256) / 255)[levels]


def finite_logs(logs: Float32s) -> Float32s:
    """The logarithms with :data:`FLAT` in place of -inf."""
    return np.where(np.isneginf(logs), np.float32(FLAT), logs)


def logs_of_lengths(lengths: Float32s) -> Float32s:
    """Logarithms of axis lengths of any shape, :data:`FLAT` where there is no length; NaN and infinite ones stay.

    Where more than a hundredth are negative, all are logarithms already, as in ``.glb`` until the middle of 2026.
    """
    if np.count_nonzero(lengths < 0) > lengths.size / 100:
        log.warning("scales are negative numbers: taken as logarithms of lengths")
        return lengths
    with np.errstate(divide="ignore"):
        return finite_logs(np.log(lengths.clip(np.float32(0))))  # of whole numbers, too, in float32


# What float32 rounding may add to a distance of one half.
_ROUNDING = 1e-3


class Clamped(Counter[str]):
    """Rounds and clamps values to a range; counts the splats outside it, by attribute."""

    def nearest(self, name: str, values: Floats, ends: tuple[int, int]) -> Int32s:
        """The nearest integers that the format has.

        Args:
            name: Attribute, for the message.
            values: Values ``[N, D]`` in units of the format.
            ends: Smallest and largest integer of the format.

        Returns:
            Integers ``[N, D]``.
        """
        rounded = np.clip(np.rint(values), *ends)
        self[name] += (np.abs(rounded - values) > 0.5 + _ROUNDING).any(1).sum()
        return np.asarray(np.nan_to_num(rounded), np.int32)

    def warn(self, path: StrPath, count: int) -> None:
        """Warn how many of ``count`` splats were clamped to the format's range."""
        if changed := ", ".join(f"{name} {splats}" for name, splats in self.items() if splats):
            log.warning(f"{path}: out of the range of its format, clamped to it: {changed} (of {count} splats)")


def float_rows(data: Bytes, rows: int, dim: int) -> Float32s:
    """The table ``[rows, dim]`` of float32 that bytes of a file hold; -1 rows are all that there are."""
    return np.frombuffer(data, "<f4").astype(np.float32).reshape(rows, dim)


def power_below(value: float) -> float:
    """The largest power of two that is at most a positive ``value``; exact, unlike a logarithm."""
    return math.ldexp(1.0, math.frexp(value)[1] - 1)


def power_above(value: float) -> float:
    """The smallest power of two that is at least a positive ``value``."""
    below = power_below(value)
    return below if below == value else 2 * below


def coarsest_power(values: Float32s) -> float:
    """The largest power of two of which all ``values`` are integer multiples, 0 if all are 0; they must be finite."""
    mantissas, exponents = np.frexp(values[values != 0])
    wholes = np.ldexp(mantissas, 24).astype(np.int64)  # float32 has so many bits
    powers = np.ldexp(wholes & -wholes, exponents - 24)  # of the lowest bit that is set
    return float(powers.min()) if powers.size else 0.0
