"""Which members of a protocol an object lacks.

``isinstance`` with a protocol is used nowhere in this package: since Python 3.12 it looks up members without calling
``__getattr__``, through which an ``nn.Module`` gives its parameters and buffers, and so finds none of them.
"""


def missing_members(value: object, protocol: type) -> list[str]:
    """Names of the members of ``protocol`` that ``value`` does not have, sorted.

    Args:
        value: Any object.
        protocol: A :class:`typing.Protocol`; what it inherits from others is not looked at.
    """
    declared = (*protocol.__annotations__, *vars(protocol))
    return sorted({name for name in declared if not name.startswith("_") and not hasattr(value, name)})
