"""The ``lightning`` command: our subcommands, and a passthrough to other distributions that install the same name.

Lightning itself has shipped no ``lightning`` script since 2.5.1, but lightning-sdk and litserve do, and pip lets the
distribution installed last own the name. This one runs ``lightning fit`` and passes on what it does not know.
"""

import re
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points

from nsvq_lightning.commands.registry import COMMANDS

_OURS = "nsvq-lightning"


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lightning ARGUMENTS``.

    Args:
        argv: Arguments; those of the process if None. No arguments, or an option first, is ours too.

    Returns:
        Exit status: that of our command or of the other distribution's; 2 if none knows the command.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0].startswith("-") or arguments[0] in COMMANDS:
        from nsvq_lightning.commands.main import main as nsvq

        return _status(nsvq(arguments))
    others = _other_scripts()
    if not others:
        sys.stderr.write(
            f"lightning: unknown command {arguments[0]!r}; nsvq-lightning has {', '.join(COMMANDS)}, "
            "and no other installed package has a lightning command\n"
        )
        return 2
    sys.argv = ["lightning", *arguments]
    return _status(others[0].load()())


def _other_scripts() -> list[EntryPoint]:
    """``lightning`` scripts of other distributions, in the order of their names."""
    found = {
        _normalized(point.dist.name): point
        for point in entry_points(group="console_scripts", name="lightning")
        if point.dist is not None and _normalized(point.dist.name) != _OURS
    }
    return [found[name] for name in sorted(found)]


def _normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _status(result: object) -> int:
    """Exit status as :func:`sys.exit` reads it from what a script returns."""
    if result is None or isinstance(result, int):
        return int(result or 0)
    sys.stderr.write(f"{result}\n")
    return 1
