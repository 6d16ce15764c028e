"""Work that a scene, a view or a phase may not need, and the switches that skip it.

All switches are on and do not change a bit of the result. They exist so that each can be measured and tested:

* in Python: ``with switched(blocks=False): ...``
* on the command line: ``nsvq benchmark train --switches all``

Switches hold for the whole process, so set them before work starts, not while another thread renders.
"""

from collections.abc import Iterator
from contextlib import contextmanager

# All switches by name: the work that is skipped while one is on, and when that work is not needed.
SKIPS = {
    "blocks": "skip 4x4 blocks of pixels: a splat cannot reach them",
    "distance_bounds": "skip the nearest code of a splat: bounds prove that it is the last one",
}

_ON = dict.fromkeys(SKIPS, True)


def is_on(name: str) -> bool:
    """Whether the work of the switch ``name`` is skipped."""
    return _ON[name]


@contextmanager
def switched(**switches: bool) -> Iterator[None]:
    """Set switches by name for the body of a ``with`` statement, and restore them afterwards.

    Raises:
        ValueError: There is no such switch.
    """
    if unknown := sorted(set(switches) - set(SKIPS)):
        raise ValueError(f"unknown switches {', '.join(unknown)}; there are {', '.join(SKIPS)}")
    before = dict(_ON)
    try:
        _ON.update(switches)
        yield
    finally:
        _ON.update(before)
