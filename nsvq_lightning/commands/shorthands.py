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

    Without a value the option is left to the parser, which then misses one.
    """
    expanded: list[str] = []
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        option, equals, value = argument.partition("=")
        name = option.removeprefix("--")
        if not option.startswith("--") or name not in SHORTHANDS or not (equals or rest):
            expanded.append(argument)
            continue
        value = value if equals else rest.pop(0)
        expanded += [f"{BUDGET}.{other}={value if other == name else 'null'}" for other in SHORTHANDS]
    return expanded
