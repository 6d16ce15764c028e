"""The version of this package, and what those of others must have."""

from importlib.metadata import version
from typing import Any

__version__ = "0.1.0"


def check_replaced(distribution: str, owner: Any, *names: str) -> None:
    """Refuse a version of another package that lacks what this one replaces in it: all would run, but differently.

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
