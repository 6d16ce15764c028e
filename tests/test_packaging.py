"""The facts that users, installers and type checkers rely on, without building anything."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement

import nsvq_lightning
from nsvq_lightning.top_level import folder_of

ROOT = Path(__file__).resolve().parents[1]
TOP_LEVEL = ("callbacks", "configs")
"""Folders of the package that stand at the top level of the repository."""


def _project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def _requirements() -> dict[str, Requirement]:
    project = _project()["project"]
    extras = project["optional-dependencies"]
    parsed = [Requirement(line) for line in [*project["dependencies"], *extras["test"], *extras["tensorboard"]]]
    return {requirement.name: requirement for requirement in parsed}


def _pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


def test_compromised_releases_of_lightning_cannot_be_installed() -> None:
    allowed = _requirements()["lightning"].specifier
    assert [version for version in ("2.6.1", "2.6.2", "2.6.3", "2.6.6", "3.0") if version in allowed] == [
        "2.6.1",
        "2.6.6",
    ]


def test_every_dependency_is_pinned_to_an_allowed_version() -> None:
    pins = {name.lower(): version for name, version in _pins().items()}
    for name, requirement in _requirements().items():
        assert pins[name.lower()] in requirement.specifier, name


def test_constraints_start_with_torch_and_name_no_host() -> None:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert text.startswith("torch==")
    pattern = re.compile(r"[A-Za-z0-9_.-]+==[0-9][0-9a-z.]*")
    assert [line for line in text.splitlines() if not line.startswith("#") and not pattern.fullmatch(line)] == []


@pytest.mark.skipif(sys.platform == "win32", reason="bash may be that of another system")
def test_workflow_tests_every_python_with_readmes_command() -> None:
    path = ROOT / ".github" / "workflows" / "ci.yml"
    if not path.exists():
        pytest.skip("a source distribution has no workflow beside the tests")
    test = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]["test"]
    prefix = "Programming Language :: Python :: 3."
    stated = {line.removeprefix(prefix) for line in _project()["project"]["classifiers"] if line.startswith(prefix)}
    assert {f"3.{minor}" for minor in stated} <= set(test["strategy"]["matrix"]["python"])
    script = test["steps"][2]["run"].replace('eval "$command"', 'echo "$command"')
    for system, folder in (("Linux", "bin"), ("Windows", "Scripts")):
        environment = os.environ | {"RUNNER_OS": system}
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True
        )
        assert done.stdout.endswith(f'pip install -c constraints.txt -e ".[test]" && .venv/{folder}/pytest\n'), (
            done.stderr
        )


@pytest.mark.parametrize("folder", TOP_LEVEL)
def test_type_checkers_find_top_level_folders_by_a_relative_link(folder: str) -> None:
    link = ROOT / "nsvq_lightning" / folder
    if not link.is_symlink():
        pytest.skip("no links here: git could not make any, or this is a source distribution")
    assert os.readlink(link) == f"../{folder}"


@pytest.fixture
def without_links(tmp_path: Path) -> Path:
    """The repository as git checks it out where there are no symbolic links: text files in their place."""
    for folder in ("nsvq_lightning", *TOP_LEVEL):
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path)
    for folder in TOP_LEVEL:
        link = tmp_path / "nsvq_lightning" / folder
        link.unlink(missing_ok=True)
        link.write_text(f"../{folder}", encoding="utf-8")
    return tmp_path


def _build(root: Path, function: str) -> None:
    """Build into ``dist`` with a function of Hatchling."""
    pytest.importorskip("hatchling", reason="builds the wheel; it is in the test extra")
    call = f"from hatchling.build import {function} as build; build('dist')"
    subprocess.run([sys.executable, "-c", call], cwd=root, check=True)


def _built(root: Path, kind: str) -> dict[str, bytes]:
    """Files of the package in a wheel, ``standard`` or ``editable``."""
    _build(root, "build_wheel" if kind == "standard" else "build_editable")
    (wheel,) = (root / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist() if name.startswith("nsvq_lightning/")}


@pytest.mark.parametrize("links", [False, True])
def test_wheel_is_whole_with_links_and_without(without_links: Path, links: bool) -> None:
    for folder in TOP_LEVEL if links else ():
        (without_links / "nsvq_lightning" / folder).unlink()
        (without_links / "nsvq_lightning" / folder).symlink_to(f"../{folder}")
    expected = {f"nsvq_lightning/{path.relative_to(ROOT).as_posix()}": path for path in _files(*TOP_LEVEL)}
    expected |= {path.relative_to(ROOT).as_posix(): path for path in _files("nsvq_lightning")}
    assert _built(without_links, "standard") == {name: path.read_bytes() for name, path in expected.items()}


def test_source_distribution_has_the_demo(without_links: Path) -> None:
    _build(without_links, "build_sdist")
    (source,) = (without_links / "dist").glob("*.tar.gz")
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {path.relative_to(ROOT).as_posix() for path in _files("nsvq_lightning/data/demo")} <= names
    assert "nsvq_lightning/data/demo/images/view_039.webp" in names


def test_editable_install_copies_nothing(without_links: Path) -> None:
    """Type checkers would find a copy before the links."""
    assert _built(without_links, "editable") == {}


def _files(*folders: str) -> Iterator[Path]:
    """Files of the package and of the folders at the top level, none of them twice."""
    for folder in folders:
        for path in (ROOT / folder).rglob("*"):
            inside = path.relative_to(ROOT).parts
            linked = inside[0] == "nsvq_lightning" and inside[1] in TOP_LEVEL
            if path.is_file() and "__pycache__" not in inside and not linked:
                yield path


def test_checkout_runs_without_links(without_links: Path) -> None:
    """Class paths, relative imports and pickles of callbacks, configs by name, and nothing else of the top level."""
    lines = [
        "import importlib.util, os, pickle",
        "from nsvq_lightning.callbacks.density import DensityControl",
        "from nsvq_lightning.commands.settings import find_config",
        "assert pickle.loads(pickle.dumps(DensityControl)) is DensityControl",
        "assert DensityControl.__module__ == 'nsvq_lightning.callbacks.density'",
        "assert os.path.samefile(find_config('demo'), 'configs/demo.yaml')",
        "assert importlib.util.find_spec('nsvq_lightning.configs') is None",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], cwd=without_links, check=True)


def test_callbacks_configs_and_type_marker_are_found_in_the_package() -> None:
    specification = importlib.util.find_spec("nsvq_lightning.callbacks")
    assert specification is not None
    assert specification.origin == str(folder_of("callbacks") / "__init__.py")
    assert (Path(nsvq_lightning.__file__).parent / "py.typed").is_file()
    assert any(entry.suffix == ".yaml" for entry in folder_of("configs").iterdir())
