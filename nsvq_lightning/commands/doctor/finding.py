"""The result of a check: one line with a verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["Finding", "Verdict", "good", "note", "problem", "report"]

Verdict = Literal["good", "note", "problem"]

Check = Callable[[], Iterable["Finding"]]


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's report.

    Attributes:
        verdict: ``good``; ``note`` for what costs quality or time; ``problem`` for what keeps a run from working.
        subject: What was checked, one or two words.
        text: What was found and, unless it is good, what would help.
        values: The figures behind it, as JSON values.
    """

    verdict: Verdict
    subject: str
    text: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.verdict:<8} {self.subject:<12} {self.text}"


def good(subject: str, text: str, **values: Any) -> Finding:
    """Nothing to do."""
    return Finding("good", subject, text, values)


def note(subject: str, text: str, **values: Any) -> Finding:
    """Works, but not as well or as fast as it could."""
    return Finding("note", subject, text, values)


def problem(subject: str, text: str, **values: Any) -> Finding:
    """A run would fail or be worthless."""
    return Finding("problem", subject, text, values)


def report(subject: str, check: Check) -> Iterator[Finding]:
    """The findings of a check; a check that raises is a problem itself and does not keep the others from running."""
    try:
        yield from check()
    except (ValueError, OSError) as error:  # bad files: the message says what and where
        yield problem(subject, " ".join(str(error).split()))
    except Exception as error:  # third-party code may fail in any way on this machine or folder
        yield problem(subject, f"the check itself failed: {type(error).__name__}: {' '.join(str(error).split())}")
