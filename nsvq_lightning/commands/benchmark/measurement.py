"""One measurement: what was done, how long it took, how wrong the result is."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Measurement", "Timing"]


@dataclass(frozen=True)
class Timing:
    """Times of one case and of the matrix products that were interleaved with it.

    Attributes:
        samples: Milliseconds of each call, in the order of the calls.
        sgemm: Milliseconds of each 2048³ float32 matrix product of torch.

    Raises:
        ValueError: There is no sample.
    """

    samples: tuple[float, ...]
    sgemm: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.samples or not self.sgemm:
            raise ValueError("a timing needs at least one sample and one matrix product to compare with")

    @property
    def median(self) -> float:
        """Median, ms."""
        return statistics.median(self.samples)

    @property
    def minimum(self) -> float:
        """Fastest call, ms."""
        return min(self.samples)

    @property
    def quartiles(self) -> tuple[float, float]:
        """First and third quartile, ms; the sample itself where there is only one."""
        if len(self.samples) == 1:
            return self.samples[0], self.samples[0]
        first, _, third = statistics.quantiles(self.samples, n=4, method="inclusive")
        return first, third

    @property
    def ratio(self) -> float:
        """Median as a multiple of the median matrix product: comparable between machines and between busy hours."""
        return self.median / statistics.median(self.sgemm)

    def as_json(self) -> dict[str, Any]:
        """Summary and samples."""
        return {
            "median_ms": self.median,
            "min_ms": self.minimum,
            "quartiles_ms": list(self.quartiles),
            "sgemm_ratio": self.ratio,
            "samples_ms": list(self.samples),
            "sgemm_ms": list(self.sgemm),
        }


@dataclass(frozen=True)
class Measurement:
    """One row of a table.

    Attributes:
        suite: Name of the suite.
        workload: What it was done to.
        method: How it was done; measurements of one operation differ in the method.
        operation: What was done; measurements of one operation are compared with each other.
        threads: Threads it was done with.
        timing: How long it took.
        values: Errors and sizes by name, the unit in the name where there is one; the first is drawn against the time.
        note: How the errors were measured, where that is not on the workload itself.
        course: Seconds and the first value during a run, ``(s, value)``; drawn as a line. Empty for single calls.
    """

    suite: str
    workload: str
    method: str
    operation: str
    threads: int
    timing: Timing
    values: Mapping[str, float] = field(default_factory=dict)
    note: str = ""
    course: tuple[tuple[float, float], ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The measurement as JSON values."""
        return {
            "suite": self.suite,
            "workload": self.workload,
            "method": self.method,
            "operation": self.operation,
            "threads": self.threads,
            **self.timing.as_json(),
            "values": dict(self.values),
            "note": self.note,
            "course": [list(point) for point in self.course],
        }
