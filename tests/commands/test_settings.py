from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from nsvq_lightning.commands import settings
from nsvq_lightning.commands.settings import (
    SHORTHANDS,
    check_config,
    check_early,
    configs_among,
    expand,
    find_config,
    joined,
    settings_of,
    values_by_name,
)


def test_an_option_and_its_value_become_one_argument() -> None:
    arguments = ["fit", "--a", "1", "--b=2", "3", "-c", "x", "-c=y", "-h", "z", "--last"]
    assert joined(arguments) == ["fit", "--a=1", "--b=2", "3", "--config=x", "--config=y", "--help", "z", "--last"]


def test_configs_are_expanded_to_paths_and_come_before_options(tmp_path: Path) -> None:
    shipped, mine = find_config("paper"), tmp_path / "paper.yaml"
    arguments = ["fit", "--config", "paper", "--data.root", "paper", "--config=paper", "-c", str(mine)]
    assert expand(arguments) == [
        *("fit", f"--config={shipped}", f"--config={shipped}", f"--config={mine}", "--data.root=paper")
    ]


def test_shorthands_are_expanded_to_the_setting_that_holds_and_end_the_others() -> None:
    expanded = {
        "quality": ["--callbacks.budget.quality=2", "--callbacks.budget.splats=null", "--callbacks.budget.bytes=null"],
        "splats": ["--callbacks.budget.splats=2", "--callbacks.budget.bytes=null"],
        "bytes": ["--callbacks.budget.bytes=2", "--callbacks.budget.splats=null"],
        "minutes": ["--callbacks.phases.minutes=2"],
    }
    assert expanded.keys() == SHORTHANDS.keys()
    for name, options in expanded.items():
        assert expand(["fit", f"--{name}", "2"]) == ["fit", *options]
    assert expand(["fit", "--minutes=3", "--splats=2"]) == ["fit", *expand(["--minutes=3"]), *expanded["splats"]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--splats=1", "--bytes=2"], "--splats and --bytes both say how large the scene is to be"),
        (["--quality"], "--quality needs a number"),
        (["--minutes="], "--minutes needs a number"),
    ],
)
def test_shorthands_that_cannot_hold_are_refused(arguments: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        expand(["fit", *arguments])


def test_configs_are_found_as_files_first_then_by_name(tmp_path: Path) -> None:
    mine = tmp_path / "paper.yaml"
    mine.write_text("{}")
    shipped = find_config("paper")
    assert shipped.endswith("configs/paper.yaml")
    assert find_config(str(mine)) == str(mine)
    assert find_config("configs/paper.yaml").endswith("configs/paper.yaml")
    assert find_config("no_such_config") == "no_such_config"


def test_what_configs_set_are_options_too(tmp_path: Path) -> None:
    first, second = tmp_path / "a.yaml", tmp_path / "b.yaml"
    first.write_text("trainer: {max_steps: 5}\ndata: {class_path: X, init_args: {root: here}}\n")
    second.write_text("model: {codebooks: null}\n")
    arguments = ["fit", f"--config={first}", "--data.root=there", f"--config={second}"]
    assert configs_among(arguments) == [str(first), str(second)]
    assert list(settings_of(configs_among(arguments))) == [
        *("--trainer.max_steps=5", "--data.class_path=X", "--data.init_args.root=here", "--model.codebooks=None")
    ]


def test_values_are_found_by_the_name_that_an_option_has_without_its_class() -> None:
    options = ["--data.init_args.root=a=b", "--trainer.callbacks+=X", "--print_config"]
    assert values_by_name(options) == {"data.root": "a=b", "trainer.callbacks": "X", "print_config": ""}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "holds nothing: give settings by name"),
        (b"- 1\n", "holds list: give settings by name"),
        (b"5", "holds int: give"),
        (b"a: [1, {", "is not YAML .*: correct the file"),
        (b"\xff\xfe\0", "is not YAML .*can't decode"),
        (b"#" * 200_000, "has 200000 bytes"),
        (b"[" * 100_000, "is not YAML .*recursion"),
        (b"a: &a {b: *a}", "is not YAML .*Circular"),
        (b"trainer: {a: 1}\nmodel: {}\ntrainer: {b: 1}\n", "is not YAML .*line 1 begins a part that has trainer twice"),
        (b"model:\n  a: {b: 1, c: 2, b: 1}", "is not YAML .*line 2 begins a part that has b twice"),
        (b"callbacks:\n#  selection: null\n", "has nothing below callbacks: remove that line"),
    ],
)
def test_what_cannot_be_a_config(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"mine\.yaml {message}"):
        check_config(str(path))
    check_config(str(tmp_path / "none.yaml"))  # the parser's to complain about


def test_a_config_may_use_aliases(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("a: &a {b: [1, 2]}\nc: *a\n")
    assert check_config(str(path)) == {"a": {"b": [1, 2]}, "c": {"b": [1, 2]}}


def test_what_is_merged_does_not_stand_twice(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("a: &a {x: 1}\nb: {c: &b {<<: *a, x: 2}}\nmodel: {<<: *b, y: 3}\nd: {1: 2, '1': 3}\n")
    assert check_config(str(path))["model"] == {"x": 2, "y": 3}


def test_a_config_that_does_not_exist_is_refused_early() -> None:
    with pytest.raises(argparse.ArgumentError, match=r"there is no config papr; did you mean paper\?\nShipped ones: "):
        check_early(["fit", "--config=papr"])


def test_a_tilde_is_the_home_folder(make_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(make_scene().parent))
    check_early(["fit", "--data.root=~/scene"])
    with pytest.raises(FileNotFoundError, match=r"scene folder ~/other does not exist"):
        check_early(["fit", "--data.root=~/other"])


@pytest.mark.parametrize("asks", ["--help", "--print_config", "--callbacks.density.help"])
def test_a_question_needs_no_scene(asks: str) -> None:
    check_early(["fit", asks])
    check_early(["fit", "--data.root=nowhere", asks])


def test_options_of_classes_are_left_to_the_parser(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").touch()
    nested = ["--callbacks.density=mine.Own", "--callbacks.density.own=1", "--model.quantizer.kmeans_steps=3"]
    check_early(["fit", f"--data.root={tmp_path}", *nested])
    check_early(["fit", "--data=mine.Data", "--data.own=1"])


@pytest.mark.parametrize("name", ["lightning", "jsonargparse"])
def test_options_of_another_lightning_are_left_to_its_parser(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    installed = {each: version(each) for each in settings.FIT_HELP_OF}
    monkeypatch.setattr(settings, "FIT_HELP_OF", installed)
    (tmp_path / "transforms.json").touch()
    options = ["fit", f"--data.root={tmp_path}", "--trainer.of_tomorrow=1"]
    with pytest.raises(argparse.ArgumentError, match=r"no option --trainer\.of_tomorrow"):
        check_early(options)
    monkeypatch.setitem(settings.FIT_HELP_OF, name, "0.0")
    check_early(options)


def test_the_stored_help_is_of_the_versions_that_were_tested() -> None:
    pins = (Path(__file__).parents[2] / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert {f"{name}=={version}" for name, version in settings.FIT_HELP_OF.items()} <= set(pins)


def test_export_has_no_short_options_of_a_fit() -> None:
    """They went to callbacks that an export does not ask: all splats were written, without a word."""
    arguments = ["export", "--ckpt_path=last.ckpt", "--splats=1000", "--minutes=3"]
    assert expand(arguments) == arguments  # which its parser refuses
