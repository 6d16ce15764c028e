"""The types of settings: numbers with the bound that is checked when a callback is made."""

import math
from collections.abc import Callable
from typing import Annotated, NamedTuple, get_args, get_type_hints


class Bound(NamedTuple):
    """What a number must be unless it is None; it stands beside the type in ``Annotated``.

    Attributes:
        words: As an error says it: "must be …".
    """

    words: str
    holds: Callable[[float], bool]

    def __repr__(self) -> str:
        """As the API reference shows it."""
        return self.words


AT_LEAST_1 = Bound("at least 1", lambda value: value >= 1)
AT_LEAST_0 = Bound("at least 0", lambda value: value >= 0)
ABOVE_0 = Bound("above 0", lambda value: value > 0)

Count = Annotated[int, AT_LEAST_1]
Whole = Annotated[int, AT_LEAST_0]
Positive = Annotated[float, ABOVE_0]
NonNegative = Annotated[float, AT_LEAST_0]
Opacity = Annotated[float, Bound("between 0 and 1", lambda value: 0 < value < 1)]
Share = Annotated[float, Bound("in [0, 1)", lambda value: 0 <= value < 1)]
Factor = Annotated[float, Bound("in (0, 1]", lambda value: 0 < value <= 1)]


def check_settings(callback: object) -> None:
    """Check what is annotated, by the class of a callback or one above it.

    Raises:
        ValueError: A setting is out of its bound, not finite, or None where its type does not allow that.
    """
    for name, hint in get_type_hints(type(callback), include_extras=True).items():
        value = getattr(callback, name, None)
        kinds = hint, *get_args(hint)  # of ``Count | None``, each
        if value is None and getattr(type(callback), name, None) is not None and type(None) not in kinds:
            raise ValueError(f"{name} must have a value, got None")
        for kind in kinds:
            for bound in getattr(kind, "__metadata__", ()):
                if isinstance(bound, Bound) and value is not None and not (math.isfinite(value) and bound.holds(value)):
                    raise ValueError(f"{name} must be {bound.words}, got {value}")
