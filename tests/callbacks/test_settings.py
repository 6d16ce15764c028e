"""The types of settings, in classes of users as in ours, and that each setting says what it is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import field, fields, is_dataclass
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import pytest
from jsonargparse import set_parsing_settings

from nsvq_lightning import callbacks
from nsvq_lightning.callbacks.base import SplatCallback
from nsvq_lightning.callbacks.settings import Bound, Count, Factor, NonNegative, Opacity, Positive, Share, Whole
from nsvq_lightning.commands.parser import class_help


class Mine(SplatCallback):
    """A user's callback, whose annotations are text."""

    count: Count = 1
    whole: Whole | None = None
    positive: Positive = 1.0
    least: NonNegative = 0.0
    opacity: Opacity = 0.5
    share: Share = 0.0
    factor: Factor = 1.0
    even: Annotated[int, Bound("even", lambda value: value % 2 == 0)] = 0


class Unset(SplatCallback):
    """What is None by the class itself may be None, whatever its type."""

    anything: Any = None
    reached: int = field(default=None, init=False)  # type: ignore[assignment]
    shared: ClassVar[int] = None  # type: ignore[assignment]


class Derived(Mine):
    """What is inherited is checked, too; what is declared anew has its own type."""

    count: Whole = 0


T = TypeVar("T")


class Typed(SplatCallback, Generic[T]):
    """One that has a type of its own, and makes its instances itself."""

    def __init__(self, size: int) -> None:
        self.size = size


class Narrow(Typed[int]):
    """One without settings of its own."""


def test_a_callback_may_be_generic_and_make_its_instances_itself() -> None:
    assert Narrow(3).size == 3
    assert Typed[int](4).size == 4


@pytest.mark.parametrize("kind", [Mine, Derived])
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("whole", -1, "at least 0"),
        ("positive", 0.0, "above 0"),
        ("positive", math.inf, "above 0"),
        ("least", math.nan, "at least 0"),
        ("opacity", 1.0, "between 0 and 1"),
        ("share", 1.0, "in [0, 1)"),
        ("factor", 0.0, "in (0, 1]"),
        ("even", 3, "even"),
    ],
)
def test_a_setting_out_of_its_bound_is_named(kind: type[Mine], name: str, value: float, words: str) -> None:
    with pytest.raises(ValueError) as error:  # noqa: PT011  the whole text is compared
        kind(**{name: value})  # type: ignore[arg-type]
    assert str(error.value) == f"{name} must be {words}, got {value}"


def test_limits_that_belong_to_a_bound_are_taken() -> None:
    mine = Mine(count=1, whole=0, least=0.0, share=0.0, factor=1.0, even=4)
    assert (mine.whole, mine.factor) == (0, 1.0)
    assert Derived().count == 0
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        Mine(count=0)


@pytest.fixture
def _texts_of_attributes() -> Iterator[None]:
    set_parsing_settings(docstring_parse_attribute_docstrings=True)
    yield
    set_parsing_settings(docstring_parse_attribute_docstrings=False)


@pytest.mark.usefixtures("_texts_of_attributes")
@pytest.mark.parametrize("name", [name for name in callbacks.__all__ if isinstance(getattr(callbacks, name), type)])
def test_every_setting_has_its_sentence_in_the_help(name: str) -> None:
    kind = getattr(callbacks, name)
    lines = class_help("x", kind).splitlines()
    options = [number for number, line in enumerate(lines) if line.startswith("  --x.")]
    if is_dataclass(kind):
        settings = {each.name for each in fields(kind) if each.init}
        assert {lines[number].partition("=")[0] for number in options} == {f"  --x.{each}" for each in settings}
    for number in options:
        assert lines[number + 1].startswith(" " * 8), lines[number]


def test_none_is_refused_where_a_setting_has_a_value() -> None:
    assert Unset().anything is None
    assert Mine(whole=None).whole is None
    with pytest.raises(ValueError, match="count must have a value, got None"):
        Mine(count=None)  # type: ignore[arg-type]
