from __future__ import annotations

from collections.abc import Iterator

from nsvq_lightning.commands.doctor.finding import Finding, good, report


def test_a_check_that_breaks_is_a_problem_and_keeps_what_it_said_before() -> None:
    def check() -> Iterator[Finding]:
        yield good("disk", "enough")
        raise ZeroDivisionError("of\nsomething")

    first, second = report("disk", check)
    assert str(first) == "good     disk         enough"
    assert (second.verdict, second.text) == ("problem", "the check itself failed: ZeroDivisionError: of something")


def test_an_error_in_a_file_is_told_in_its_own_words() -> None:
    def check() -> Iterator[Finding]:
        raise ValueError("a.jpg is cut: copy it again")
        yield

    assert [finding.text for finding in report("photos", check)] == ["a.jpg is cut: copy it again"]
