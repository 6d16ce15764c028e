"""Work that a scene, a view or a phase may not need, and the switches that skip it.

All switches are on and do not change a bit of the result. They exist so that each can be measured and tested:

* in Python: ``with switched(blocks=False): ...``
* on the command line: ``nsvq fit --skips.blocks=false``, in a config ``skips: {blocks: false}``

Switches hold for the whole process, so set them before work starts, not while another thread renders.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Skip:
    """One switch.

    Attributes:
        name: Its name.
        work: The work that is skipped while it is on.
        when: In which case that work is not needed.
    """

    name: str
    work: str
    when: str

    @property
    def summary(self) -> str:
        """One line for the help of a command."""
        return f"skip {self.work}: {self.when}"


# All switches by name.
SKIPS = {
    skip.name: skip
    for skip in (
        # rendering
        Skip("blocks", "4x4 blocks of pixels", "a splat cannot reach them"),
        Skip("saturated", "blocks of pixels", "all their pixels are opaque"),
        # quantization
        Skip("distance_bounds", "the nearest code of a splat", "bounds prove that it is the last one"),
    )
}

_ON = dict.fromkeys(SKIPS, True)


def is_on(name: str) -> bool:
    """Whether the work of the switch ``name`` is skipped."""
    return _ON[name]


def switch(**switches: bool) -> None:
    """Set switches by name.

    Raises:
        ValueError: There is no such switch.
    """
    unknown = sorted(set(switches) - set(SKIPS))
    if unknown:
        raise ValueError(f"unknown switches {', '.join(unknown)}; there are {', '.join(SKIPS)}")
    _ON.update(switches)


@contextmanager
def switched(**switches: bool) -> Iterator[None]:
    """Set switches by name for the body of a ``with`` statement, and restore them afterwards.

    Raises:
        ValueError: There is no such switch.
    """
    before = dict(_ON)
    try:
        switch(**switches)
        yield
    finally:
        _ON.update(before)
