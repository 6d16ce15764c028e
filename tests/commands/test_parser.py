"""Help and errors of Lightning's commands."""

from __future__ import annotations

import inspect
import io
import re
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from nsvq_lightning.callbacks import STANDARD
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.commands.main import main
from nsvq_lightning.commands.parser import class_help, first_sentence, in_plain_words
from nsvq_lightning.commands.settings import FIT_HELP


@pytest.fixture(scope="module")
def fit_help() -> str:
    """What Lightning's parser says."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as printed:
        patch.setenv("COLUMNS", "80")
        with pytest.raises(SystemExit):
            SplatCLI(["fit", "--help"])
    return printed.getvalue()


def test_the_stored_help_of_fit_is_that_of_the_parser(fit_help: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "--help"]) == 0
    stored = capsys.readouterr().out
    if stored != fit_help:
        FIT_HELP.write_text(fit_help, encoding="utf-8")
    assert stored == fit_help, f"{FIT_HELP} has been written anew: look at the difference, and commit it"


def test_help_says_what_there_is_and_names_none_of_torchs_classes(fit_help: str) -> None:
    for key, kind in STANDARD.items():
        assert f"--callbacks.{key}" in fit_help or not inspect.signature(kind).parameters
    assert "--data.root\n        Scene folder" in fit_help
    assert "--trainer.max_steps=4500" in fit_help
    assert "torch.nn" not in fit_help
    assert len(fit_help.splitlines()) < 510
    assert max(len(line) for line in fit_help.splitlines() if line.startswith("        ")) <= 80


def test_options_that_the_readme_names_are_in_the_help(fit_help: str) -> None:
    root = Path(__file__).resolve().parents[2]
    if not (root / "README.md").exists():
        pytest.skip("a source distribution has no README beside the tests")
    pages = "".join(path.read_text(encoding="utf-8") for path in (root / "README.md", root / "docs" / "your_photos.md"))
    named = {
        name
        for name in re.findall(r"--((?:callbacks|data|model|trainer)\.[\w.]*\w)", pages)
        if "quantizer." not in name
    }
    assert {"data.root", "data.factor"} <= named
    known = fit_help + "".join(class_help(f"callbacks.{key}", kind) for key, kind in STANDARD.items())
    assert {name for name in named if f"--{name}" not in known} == set()


def test_one_callback_says_what_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["fit", "--callbacks.density.help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith("callbacks.density:\n  Splits splats where the photos have edges")
    assert "--callbacks.density.grad_threshold=0.0003\n" in out


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, ""),
        ("One. Two.", "One"),
        ("See :class:`~a.b.Name` and ``x``, e.g. this:\n    or that. More", "See Name and x, e.g. this: or that"),
        ("50 %% of it [0, 1]. The rest", "50 % of it [0, 1]"),
    ],
)
def test_the_first_sentence_is_in_plain_words(text: str | None, sentence: str) -> None:
    assert first_sentence(text) == sentence


UNION = """Parser key "factor":
  Does not validate against any of the Union subtypes
  Subtypes: [typing.Literal[1, 2, 4, 8], <class 'NoneType'>]
  Errors:
    - Expected a typing.Literal[1, 2, 4, 8]
    - Expected a <class 'NoneType'>
  Given value type: <class 'str'>
  Given value: 3"""
READ = """Parser key "bytes":
  Subtypes: [<class 'int'>, <class 'NoneType'>]
  Errors:
    - Expected a <class 'int'>. Got value: 1000000.0
    - Expected a <class 'NoneType'>. Got value: 1000000.0
  Given value: 1e6"""
NUMBERS = """Parser key "model.codebooks":
  Subtypes: [<class 'str'>, dict[str, int], <class 'NoneType'>]
  Given value: 3.5"""
CLASS = """Parser key "model.quantizer":

  - Expected a path but NSVX either not accessible or invalid
  - Expected a dot import path string: NSVX"""
INVALID = """Parser key "data":
  - Problem with given class_path 'a.B':
      No module named 'a'
  - Expected a path
  Given value: a.B"""


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ("another message", "another message"),
        ("Parser key \"a.b\":\n  Expected a <class 'int'>. Got value: x", "a.b: expected a whole number, got 'x'"),
        (UNION, "data.factor: expected 1, 2, 4, 8 or null, got '3'"),
        (NUMBERS, "model.codebooks: expected text, dict or null, got '3.5'"),
        (READ, "bytes: expected a whole number or null, got '1e6'"),
        (CLASS, "model.quantizer: expected the name of a class, got 'NSVX'; did you mean NSVQ?"),
        (INVALID, "data: Problem with given class_path 'a.B': No module named 'a'"),
    ],
)
def test_messages_about_values_say_what_is_allowed(message: str, said: str) -> None:
    assert in_plain_words(message, ["fit", "--other.factor=2", "--data.factor=3"]) == said
