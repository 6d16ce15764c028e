"""The limits on how much a reader has to hold: what was made smaller stays so. ``pytest -s`` shows the table."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

import nsvq_lightning

PACKAGE = Path(nsvq_lightning.__file__).parent
ROOT = PACKAGE.parent
# To be lowered with what the code loses. What a reader has to hold are the tokens: what a feature adds above the limit,
# it has to remove. Lines are there to breathe, so tokens a line have a limit, too.
LIMITS = {
    "tokens": 195_000,
    "tokens a line": 12.0,
    "code lines": 18_500,
    "files": 165,
    "files under 60 lines": 25,
    "private functions used once": 250,
    "lines of README.md": 100,
    "lines of the longest config": 25,
    "commands, per cent of the code": 17,
    "files of callbacks": 15,
    "methods of the largest class": 22,
}
NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER),
}


def lines_of_tokens(source: str) -> Iterator[tuple[int, int]]:
    """First and last line of each token of code; a formatted string is one, in every Python (3.12 takes it apart)."""
    opened: list[int] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        kind, first, last = tokenize.tok_name[token.type], token.start[0], token.end[0]
        if kind == "FSTRING_START":
            opened.append(first)
        elif kind == "FSTRING_END":
            first = opened.pop()
        if token.type not in NO_CODE and not opened:
            yield first, last


def code_lines(source: str) -> int:
    """Lines that hold a token of code: no blanks, comments or docstrings."""
    lines: set[int] = set()
    texts: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            texts.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    for first, last in lines_of_tokens(source):
        if first not in texts:
            lines.update(range(first, last + 1))
    return len(lines)


def tokens(source: str) -> tuple[int, int]:
    """Tokens of code and the lines that hold them, without imports, ``__all__``, docstrings and comments."""
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        is_list = isinstance(node, ast.Assign) and any(getattr(each, "id", "") == "__all__" for each in node.targets)
        is_text = isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)
        if isinstance(node, ast.Import | ast.ImportFrom) or is_list or is_text:
            left_out.update(range(node.lineno, (node.end_lineno or 0) + 1))
    count, lines = 0, set()
    for first, last in lines_of_tokens(source):
        if first not in left_out:
            count += 1
            lines.update(range(first, last + 1))
    return count, len(lines)


def methods_of_the_largest_class(sources: Iterable[str]) -> int:
    """Most methods of a class, with those that it inherits from classes of the package."""
    nodes = (node for source in sources for node in ast.walk(ast.parse(source)))
    classes = {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}

    def methods(name: str) -> set[str]:
        own = {each.name for each in classes[name].body if isinstance(each, ast.FunctionDef)}
        bases = {getattr(base, "attr", getattr(base, "id", "")) for base in classes[name].bases}
        return own.union(*(methods(base) for base in bases & classes.keys() - {name}))

    return max(len(methods(name)) for name in classes)


def private_functions_used_once(source: str) -> int:
    functions = {node.name for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)}
    private = [name for name in functions if name.startswith("_") and not name.startswith("__")]
    return sum(len(re.findall(rf"\b{name}\b", source)) == 2 for name in private)


def measured() -> dict[str, float]:
    callbacks = ROOT / "callbacks"
    inside = [path for path in PACKAGE.rglob("*.py") if path.resolve().is_relative_to(PACKAGE.resolve())]
    sources = {path: path.read_text(encoding="utf-8") for path in [*inside, *callbacks.rglob("*.py")]}
    code = {path: code_lines(source) for path, source in sources.items()}
    commands = sum(lines for path, lines in code.items() if path.is_relative_to(PACKAGE / "commands"))
    long = {path: source.count("\n") for path, source in sources.items()}
    counted = [tokens(source) for source in sources.values()]
    readme = ROOT / "README.md"
    configs = [path.read_text(encoding="utf-8") for path in (ROOT / "configs").rglob("*.yaml")]
    return {
        "tokens": sum(count for count, _ in counted),
        "tokens a line": round(sum(count for count, _ in counted) / sum(lines for _, lines in counted), 1),
        "code lines": sum(code.values()),
        "files": len(sources),
        "files under 60 lines": sum(count < 60 and path.name != "__init__.py" for path, count in long.items()),
        "private functions used once": sum(map(private_functions_used_once, sources.values())),
        "lines of README.md": readme.read_text(encoding="utf-8").count("\n") if readme.exists() else 0,
        "lines of the longest config": max(config.count("\n") for config in configs),
        "commands, per cent of the code": round(100 * commands / sum(code.values())),
        "files of callbacks": sum(path.is_relative_to(callbacks) for path in sources),
        "methods of the largest class": methods_of_the_largest_class(sources.values()),
    }


def test_what_a_reader_has_to_hold_stays_small() -> None:
    found = measured()
    table = "\n".join(f"{name:36}{found[name]:8,} of {limit:,}" for name, limit in LIMITS.items())
    print(f"\n{table}")
    assert all(found[name] <= limit for name, limit in LIMITS.items()), f"over a limit:\n{table}"


def test_the_measures_count_what_they_say() -> None:
    lines = ['"""About."""', "", "from a import b", "", "X = 1", "# Text.", "", "def f() -> None:", "    # nothing"]
    source = "\n".join([*lines, "    _g()", "", "def _g() -> None:", '    """Text."""', ""])
    assert code_lines(source) == 5
    assert tokens(source) == (20, 4)
    assert tokens('x = f"{a:{b}} c" + f"""{d}\n"""\n') == (5, 2)
    assert methods_of_the_largest_class(["class A:\n def f(): 0\n def g(): 0", "class B(x.A):\n def h(): 0"]) == 3
    assert private_functions_used_once(source) == 1
