"""The examples in the docstrings of the callbacks, run as a user would who copies them."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

from nsvq_lightning import callbacks

MODULES = [
    importlib.import_module(f"{callbacks.__name__}.{found.name}") for found in pkgutil.iter_modules(callbacks.__path__)
]
EXAMPLES = {
    test.name: test
    for module in MODULES
    for test in doctest.DocTestFinder().find(module, globs={})  # each imports what it needs
    if test.examples
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_does_what_it_shows(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    failed, attempted = doctest.DocTestRunner().run(EXAMPLES[name])
    assert failed == 0, capsys.readouterr().out
    assert attempted == len(EXAMPLES[name].examples)
