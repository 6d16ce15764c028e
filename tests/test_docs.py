"""The examples of README and docs: Python blocks run, commands are understood, settings are accepted."""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from compressed_scenes import scene as coded_scene

import nsvq_lightning.callbacks
import nsvq_lightning.io
from nsvq_lightning.commands import COMMANDS, OF_LIGHTNING
from nsvq_lightning.commands.main import main
from nsvq_lightning.io import save

ROOT = Path(__file__).resolve().parents[1]
if not (ROOT / "docs").is_dir():
    pytest.skip("a source distribution has no docs", allow_module_level=True)
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SMALL = ((r"max_steps=\d+", "max_steps=8"), (r'codebooks="4k"', 'codebooks="0.5k", steps=8'))
"""What is smaller in a test."""
EXECUTED = ("info", "convert")
"""Commands that are quick enough to be run, not only parsed."""
SLOW_OPTIONS = ("--floaters", "--measure", "--up")
ELSEWHERE = ("nsvq_format",)
"""Pages whose code has tests of its own: ``tests/properties/files/test_readers.py``."""


class Block(NamedTuple):
    """A fenced block."""

    page: str
    line: int
    language: str
    text: str


def blocks() -> Iterator[Block]:
    for path in PAGES:
        page, text = path.relative_to(ROOT).with_suffix("").as_posix().removeprefix("docs/"), path.read_text()
        for found in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
            yield Block(page, text[: found.start()].count("\n") + 1, found[1], found[2])


def commands() -> Iterator[tuple[str, list[str]]]:
    """Each ``nsvq`` command of the pages, and its arguments."""
    for block in blocks():
        if block.language not in ("", "sh"):
            continue
        for number, line in enumerate(block.text.replace("\\\n", " ").splitlines()):
            words = shlex.split(line, comments=True)
            starts = [i for i, word in enumerate(words) if word in ("nsvq", "nsvq_lightning", ".venv/bin/nsvq")]
            if starts:
                end = words.index(">") if ">" in words else None
                yield f"{block.page}-{block.line}-{number}", words[starts[0] + 1 : end]


COMMAND_LINES = dict(commands())


@pytest.fixture
def workplace(tmp_path: Path, demo_scene: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with everything that the pages name."""
    monkeypatch.chdir(tmp_path)
    for name in ("path/to/scene", "my/scene", "nsvq_lightning/data/demo", "fox", "old/scene", "new/scene"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).symlink_to(demo_scene, target_is_directory=True)
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    scene = coded_scene(200)
    for name in ("scene.nsvq", "scene.ply", "scene.sog", "house.ply", "garden.spz", "old.nsvq"):
        save(scene, tmp_path / name)
    run = tmp_path / "runs/scene/version_0"
    (run / "checkpoints").mkdir(parents=True)
    shutil.copy(ROOT / "configs/fast.yaml", run / "config.yaml")
    (run / "checkpoints/last.ckpt").touch()
    return tmp_path


class Understood(Exception):
    """An argparse command has parsed its arguments."""


def test_there_are_examples_of_every_kind() -> None:
    assert len(COMMAND_LINES) > 30
    assert {arguments[0] for arguments in COMMAND_LINES.values()} >= {*COMMANDS} - {
        "validate",
        "predict",
        "export",
        "test",
    }
    assert sum(block.language == "python" for block in blocks()) > 15


def test_every_block_is_of_a_kind_that_is_tested() -> None:
    for block in blocks():
        assert block.language in ("", "sh", "python", "yaml", "html"), block


@pytest.mark.parametrize(
    "page", sorted({block.page for block in blocks() if block.language == "python"} - {*ELSEWHERE})
)
def test_python_blocks_run(page: str, workplace: Path) -> None:
    """In the order of the page, with each other's names."""
    namespace: dict[str, Any] = {"__name__": "docs"}
    for block in blocks():
        if (block.page, block.language) == (page, "python"):
            text = block.text
            for pattern, replacement in SMALL:
                text = re.sub(pattern, replacement, text)
            exec(compile("\n" * block.line + text, f"{page}.md", "exec", dont_inherit=True), namespace)
    if page == "viewer":
        assert "My scene" in (workplace / "viewer.html").read_text()


@pytest.mark.parametrize("example", COMMAND_LINES)
def test_commands_are_understood(
    example: str, workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = COMMAND_LINES[example]
    assert arguments[0] in COMMANDS
    if arguments[0] in OF_LIGHTNING:
        with pytest.raises(SystemExit) as stop:
            main([*arguments, "--print_config"])
        assert stop.value.code == 0, capsys.readouterr().err
        return
    if arguments[0] in EXECUTED and not set(SLOW_OPTIONS) & set(arguments):
        assert main(arguments) == 0, capsys.readouterr().err
        return
    parse = argparse.ArgumentParser.parse_known_args

    def parse_only(parser: Any, *args: Any, **kwargs: Any) -> Any:
        _, unknown = parse(parser, *args, **kwargs)
        assert not unknown or arguments[0] in ("sweep", "split"), unknown
        raise Understood

    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", parse_only)
    with pytest.raises(Understood):
        main(arguments)


@pytest.mark.parametrize("block", [b for b in blocks() if b.language == "yaml"], ids=lambda block: block.page)
def test_settings_are_accepted(block: Block, workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (workplace / "own.yaml").write_text(block.text)
    with pytest.raises(SystemExit) as stop:
        main(["fit", "--config", "paper", "--config", "own.yaml", "--data.root=my/scene", "--print_config"])
    assert stop.value.code == 0, capsys.readouterr().err


def test_the_table_of_formats_is_that_of_the_package() -> None:
    first, _, _ = (ROOT / "docs/formats.md").read_text().partition("\n## ")
    rows = re.findall(r"^\| `([\w.-]+)`.* \|$", first, re.MULTILINE)
    assert sorted(rows) == sorted(nsvq_lightning.io.FORMATS)


@pytest.mark.slow
def test_the_api_reference_is_built_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("sphinx")
    build = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", str(ROOT / "docs/api"), str(tmp_path)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "index.html").read_text()
    public = {*nsvq_lightning.__all__, *nsvq_lightning.callbacks.__all__, *nsvq_lightning.io.__all__}
    assert {name for name in public if not name.isupper() and f">{name}<" not in page} == set()


def test_the_index_names_every_page() -> None:
    index = (ROOT / "docs/README.md").read_text()
    assert {page.name for page in (ROOT / "docs").glob("*.md")} - {"README.md"} == set(
        re.findall(r"\((\w+\.md)\)", index)
    )
    for page in PAGES:
        for target in re.findall(r"\]\(([\w./]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
