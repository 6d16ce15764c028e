"""The rules of the rooms (docs/architecture.md): imports go one way and never in a circle, and tests mirror files."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import nsvq_lightning
from nsvq_lightning.top_level import folder_of

PACKAGE = Path(nsvq_lightning.__file__).parent
NAME = PACKAGE.name
FLOORS = (
    {"commands"},
    {"compression"},
    {"callbacks"},
    {"report"},
    {"training"},
    {"data"},
    {"io"},
    {"rendering", "quantize", "quality"},
    {"splats"},
    {"compute"},
    {"random", "skips", "top_level", "version"},
)
"""Rooms from the top floor down; those of one floor do not know each other."""
FRONT_DOOR = {NAME, f"{NAME}.__main__"}


def _files() -> dict[str, Path]:
    """The file of each module of the package by its dotted name."""
    found = {}
    for folder, prefix in ((PACKAGE, [NAME]), (folder_of("callbacks"), [NAME, "callbacks"])):
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            if prefix != [NAME] or parts[0] != "callbacks":
                found[".".join([*prefix, *parts]).removesuffix(".__init__")] = path
    return found


@cache
def _import_statements(source: str) -> list[ast.Import | ast.ImportFrom]:
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)]


def imported(module: str, source: str, known: set[str]) -> Iterator[str]:
    """The modules of the package that a module's source imports, anywhere in it."""
    package = module if module in {NAME, f"{NAME}.callbacks"} else module.rpartition(".")[0]
    for node in _import_statements(source):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, base]).rstrip(".")
            names = [f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base for alias in node.names]
        yield from (name for name in names if name.split(".")[0] == NAME)


def problems(sources: dict[str, str]) -> list[str]:
    """What breaks the rule, in words, among modules given as source text by name."""
    floor = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
    graph = {module: set(imported(module, source, set(sources))) - {module} for module, source in sources.items()}
    found = []
    for module, targets in graph.items():
        if module in FRONT_DOOR:
            continue
        room = module.split(".")[1]
        if room not in floor:
            found.append(f"{module} is in no room")
            continue
        for target in sorted(targets):
            if target in FRONT_DOOR:
                found.append(f"{module} imports the front door")
            elif (other := target.split(".")[1]) != room and floor[other] <= floor[room]:
                found.append(f"{module} imports {target}, which is no floor below it")
    try:
        TopologicalSorter({module: targets for module, targets in graph.items() if module != NAME}).prepare()
    except CycleError as error:
        found.append(f"in a circle: {' <- '.join(error.args[1])}")
    return found


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    return {module: path.read_text(encoding="utf-8") for module, path in _files().items()}


def test_imports_go_down(sources: dict[str, str]) -> None:
    assert len(sources) > 100
    assert problems(sources) == []


@pytest.mark.parametrize(
    ("module", "line", "problem"),
    [
        ("quantize.kmeans", "from nsvq_lightning.rendering import camera", "no floor below"),
        ("io.nsvq.entropy", "import nsvq_lightning.training.optim", "no floor below"),
        ("compute.rows", "from ..splats.splats import Splats", "no floor below"),
        ("training.optim", "from nsvq_lightning import __version__", "front door"),
        ("splats.splats", "def late():\n    from nsvq_lightning.splats.attributes import ATTRIBUTES", None),
        ("training.optim", "from nsvq_lightning.training.row_ops import keep_rows", "circle"),
    ],
)
def test_the_rule_sees_a_planted_import(sources: dict[str, str], module: str, line: str, problem: str | None) -> None:
    planted = sources | {f"{NAME}.{module}": sources[f"{NAME}.{module}"] + f"\n{line}\n"}
    found = problems(planted)
    assert (problem is None) == (found == [])
    if problem is not None:
        assert problem in found[0]
        assert module in found[0]


def test_a_module_in_no_room_is_named(sources: dict[str, str]) -> None:
    assert problems(sources | {f"{NAME}.helpers": ""}) == [f"{NAME}.helpers is in no room"]


def test_tests_mirror_the_package() -> None:
    """Each ``tests/ROOM/test_FILE.py`` is about ``ROOM/FILE.py`` or the folder ``ROOM/FILE``; others are properties."""
    tests = Path(__file__).parent
    sources = {"callbacks": folder_of("callbacks")}
    for test in tests.glob("*/**/test_*.py"):
        room, *parts = test.relative_to(tests).parts
        name = test.stem.removeprefix("test_")
        file = sources.get(room, PACKAGE / room).joinpath(*parts[:-1], name)
        mirrors = file.is_dir() or file.with_suffix(".py").is_file()
        assert mirrors or room == "properties", test


DEFINITION = ast.FunctionDef | ast.ClassDef


def _names(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


def _assigned(node: ast.stmt) -> set[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)}


def late_constants(source: str) -> set[str]:
    """Loggers, and names that several definitions use, that are assigned after the first definition of a module.

    Those that are made of a definition have to be.
    """
    body = ast.parse(source).body
    definitions = [node for node in body if isinstance(node, DEFINITION)]
    made_of = {node.name for node in definitions}
    found = set()
    for node in body[body.index(definitions[0]) :] if definitions else ():
        names = _assigned(node)
        if not names:
            continue
        if made_of & (_names(node) - names):
            made_of |= names
        elif "log" in names or sum(bool(names & _names(each)) for each in definitions) > 1:
            found |= names
    return found


def test_what_several_definitions_share_stands_at_the_top() -> None:
    found = {module: late_constants(path.read_text(encoding="utf-8")) for module, path in _files().items()}
    assert not {module: names for module, names in found.items() if names}


def test_a_constant_of_one_definition_may_stand_beside_it() -> None:
    one = "def f(): ...\nA = 1\ndef g(): A\n"
    assert late_constants(one) == set()
    assert late_constants(one + "def h(): A\n") == {"A"}
    assert late_constants("A = 1\ndef f(): A\ndef g(): A\n") == set()
    assert late_constants("class C: ...\nA: C = C()\nB = [A]\ndef f(): A, B\ndef g(): A, B\n") == set()
    assert late_constants("def f(): ...\nlog = 0\n") == {"log"}
