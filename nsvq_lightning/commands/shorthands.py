"""Options of ``nsvq fit`` with a name of their own, for what users turn most."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["SHORTHANDS", "expand"]

BUDGET = "--callbacks.budget"

SHORTHANDS: dict[str, str] = {
    "quality": "Splats, as a multiple of the default for the photos; more look better and take more bytes and time",
    "splats": "Splats of the scene, instead of --quality",
    "bytes": "Size of the file, instead of --quality",
}
"""Name and meaning of the numbers of :class:`nsvq_lightning.callbacks.SplatBudget`, of which one holds."""


def expand(arguments: Sequence[str]) -> list[str]:
    """The arguments with every shorthand replaced by the options it stands for: its own number, and none of the others.

    Raises:
        ValueError: Two shorthands are given, of which only one can hold, or one without its number.
    """
    expanded: list[str] = []
    given: str | None = None
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        option, equals, value = argument.partition("=")
        name = option.removeprefix("--")
        if not option.startswith("--") or name not in SHORTHANDS:
            expanded.append(argument)
            continue
        if given not in (None, name):
            raise ValueError(f"--{given} and --{name} both say how large the scene is to be: give one of them")
        given = name
        if not (equals or rest):
            raise ValueError(f"{option} needs a number")
        value = value if equals else rest.pop(0)
        expanded += [f"{BUDGET}.{other}={value if other == name else 'null'}" for other in SHORTHANDS]
    return expanded
