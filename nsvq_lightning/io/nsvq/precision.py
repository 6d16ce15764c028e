"""How a scene is stored: at which level, and how exactly."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nsvq_lightning.splats.attributes import ATTRIBUTES

# Largest number of opacity levels that readers accept.
MAX_OPACITY_LEVELS = 1 << 20

# Smallest and largest error that the opacity may have.
OPACITY_ERRORS = 0.5 / MAX_OPACITY_LEVELS, 0.25


@dataclass(frozen=True)
class Precision:
    """Largest errors of level ``compact``, each half a quantization step.

    Attributes:
        position: Of each coordinate, as a share of the splat's size, the geometric mean of its axis lengths, over the
            square root of its opacity. Small opaque splats get the finest positions, down to 2⁻²⁰ of the extent of the
            scene; the thousandth that asks for the finest gets none finer than the rest.
        opacity: Of the opacity, which is in [0, 1]; at least 2⁻²¹.
        codebook: Of the values of a codebook, as a share of how much neighbouring codes typically differ.
        scales: Of log-scales without a codebook; 0.01 is one per cent of the length.
        quats: Of the components of normalised quaternions without a codebook.
        sh0: Of constant colour coefficients without a codebook.
        shN: Of higher colour coefficients without a codebook.

    Raises:
        ValueError: A value is not positive and finite, or that of the opacity is above 1/4 or below 2⁻²¹.
    """

    position: float = 0.05
    opacity: float = 1 / 128
    codebook: float = 0.0625
    scales: float = ATTRIBUTES["scales"].error
    quats: float = ATTRIBUTES["quats"].error
    sh0: float = ATTRIBUTES["sh0"].error
    shN: float = ATTRIBUTES["shN"].error

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < math.inf:
                raise ValueError(f"precision: {name} must be a positive number, got {value}")
        low, high = OPACITY_ERRORS
        if not low <= self.opacity <= high:
            raise ValueError(f"precision: opacity must be from {low:.3g} to {high:g}, got {self.opacity}")

    def of(self, name: str) -> float:
        """Largest error of an attribute without a codebook; one that has no option has the error that it declares."""
        return float(getattr(self, name, ATTRIBUTES[name].error))


# Compression levels: ``compact`` is small; ``paper`` stores float32 values and whole bits, as the paper counts.
LEVELS = ("compact", "paper")

DEFAULT_LEVEL = "compact"


@dataclass(frozen=True)
class Storage:
    """How a run stores its scene.

    Attributes:
        level: ``compact``, or ``paper``, which loses nothing.
        precision: Largest errors of level ``compact``; level ``paper`` has none.

    Raises:
        ValueError: Unknown level.
    """

    level: str = DEFAULT_LEVEL
    precision: Precision = field(default_factory=Precision)

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise ValueError(f"unknown compression level {self.level!r}; there are {', '.join(LEVELS)}")

    @classmethod
    def told(cls, config: Mapping[str, Any]) -> "Storage":
        """What the ``config`` of a scene says of the precision that it was stored with; else the default."""
        try:
            return cls(precision=Precision(**config["precision"]))
        except (KeyError, TypeError, ValueError):
            return cls()

    @classmethod
    def of(cls, given: "Storage | str | Mapping[str, Any]") -> "Storage":
        """The settings from their level, or from plain data, as stored in a checkpoint; settings stay as they are."""
        if isinstance(given, Mapping):
            return cls(given["level"], Precision(**given["precision"]))
        return cls(given) if isinstance(given, str) else given
