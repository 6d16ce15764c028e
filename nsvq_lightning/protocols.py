"""What an object lacks of a protocol.

``isinstance`` with a protocol is used nowhere in this package: since Python 3.12 it looks members up without running
``__getattr__``, where an ``nn.Module`` keeps its parameters and buffers, and finds none of them.
"""

from __future__ import annotations

__all__ = ["missing_members"]


def missing_members(value: object, protocol: type) -> list[str]:
    """Names of the members of ``protocol`` that ``value`` does not have, sorted.

    Args:
        value: Any object.
        protocol: A :class:`typing.Protocol` that inherits from no other.
    """
    declared = (*protocol.__annotations__, *vars(protocol))
    return sorted({name for name in declared if not name.startswith("_") and not hasattr(value, name)})
