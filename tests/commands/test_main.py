from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from nsvq_lightning.commands import main as front_end

Install = Callable[[str, str], None]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Arguments that our own front end was called with."""
    seen: list[list[str]] = []

    def main(argv: Sequence[str] | None = None) -> int:
        seen.append(list(argv or []))
        return 3

    monkeypatch.setattr(front_end, "main", main)
    return seen


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Makes ``importlib.metadata`` find exactly the distributions installed by it."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *(p for p in sys.path if "site-packages" not in p)])
    monkeypatch.setattr(sys, "argv", ["lightning"])

    def add(distribution: str, target: str) -> None:
        info = tmp_path / f"{distribution.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[console_scripts]\nlightning = {target}\n")

    (tmp_path / "foreign.py").write_text(
        "import sys\n\n"
        "def run():\n    print('foreign', *sys.argv)\n    return 5\n\n"
        "def wrong():\n    raise AssertionError('must not be called')\n"
    )
    return add


def test_the_words_are_those_of_the_front_end() -> None:
    from nsvq_lightning.commands.fit import SplatCLI
    from nsvq_lightning.commands.registry import COMMANDS

    assert {name for name, command in COMMANDS.items() if command.module is None} == set(SplatCLI.subcommands())


@pytest.mark.parametrize("arguments", [["fit", "--config", "a.yaml"], ["info", "x.ply"], ["validate"], ["--help"], []])
def test_our_words_run_our_command(calls: list[list[str]], install: Install, arguments: list[str]) -> None:
    install("lightning-sdk", "foreign:wrong")
    assert front_end.lightning(arguments) == 3
    assert calls == [arguments]


def test_foreign_words_go_to_the_other_distribution(
    calls: list[list[str]], install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("NSVQ_Lightning", "foreign:wrong")
    install("litserve", "foreign:wrong")
    install("lightning-sdk", "foreign:run")
    with pytest.raises(SystemExit, match="5"):
        front_end.lightning(["login", "--token", "x"])
    assert capsys.readouterr().out == "foreign lightning login --token x\n"
    assert calls == []


def test_without_another_distribution_the_known_words_are_listed(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("nsvq-lightning", "foreign:wrong")
    assert front_end.lightning(["login"]) == 2
    message = capsys.readouterr().err
    assert "unknown command 'login'" in message
    assert "fit, test, validate, predict" in message
    assert message.count("\n") == 1
