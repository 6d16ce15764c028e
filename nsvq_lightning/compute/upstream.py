"""What this package replaces in others without being asked to: it must be there, or nothing would be replaced."""

from importlib.metadata import version
from typing import Any


def check_replaced(distribution: str, owner: Any, *names: str) -> None:
    """Refuse a version of another package that lacks what is replaced in it: all would run, and do something else.

    Args:
        distribution: Its name, as pip knows it.
        owner: The module or class.
        names: What it must have.

    Raises:
        ImportError: Something is missing.
    """
    if missing := [name for name in names if not hasattr(owner, name)]:
        raise ImportError(
            f"{owner.__name__} of {distribution} {version(distribution)} has no {', '.join(missing)}, which "
            "nsvq-lightning replaces: install the version that constraints.txt names"
        )
