"""The pages of measured tables: there is one for every suite, and the switches are described as they are."""

from __future__ import annotations

from pathlib import Path

from nsvq_lightning.commands.benchmark.suite_list import SUITES
from nsvq_lightning.skips import SKIPS

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_every_suite_has_a_page_that_says_how_it_was_made() -> None:
    index = (DOCS / "benchmark.md").read_text()
    assert {page.stem for page in (DOCS / "measured").glob("*.md")} == set(SUITES)
    for name in SUITES:
        assert f"[measured](measured/{name}.md)" in index
        assert f"`nsvq benchmark {name}" in (DOCS / "measured" / f"{name}.md").read_text()


def test_every_switch_is_described_as_it_is() -> None:
    explained, measured = (DOCS / "skips.md").read_text(), (DOCS / "measured" / "train.md").read_text()
    for name, skip in SKIPS.items():
        assert f"| `{name}` | {skip.work} | {skip.when} |\n" in explained
        assert f"| `{name}` " in measured
