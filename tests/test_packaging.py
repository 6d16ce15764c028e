"""The facts that users, installers and type checkers rely on, without building anything."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import subprocess
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

import nsvq_lightning

ROOT = Path(__file__).resolve().parents[1]


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
    assert [version for version in ("2.5.5", "2.6.2", "2.6.3", "2.6.6", "3.0") if version in allowed] == [
        "2.5.5",
        "2.6.6",
    ]


def test_building_needs_no_torch() -> None:
    assert [Requirement(line).name for line in _project()["build-system"]["requires"]] == ["hatchling"]


def test_version_is_stated_once() -> None:
    assert _project()["project"]["version"] == nsvq_lightning.__version__
    try:
        installed = importlib.metadata.version("nsvq-lightning")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("the package is not installed; it is tested from the source tree")
    assert installed == nsvq_lightning.__version__


def test_every_dependency_is_pinned_to_an_allowed_version() -> None:
    pins = {name.lower(): version for name, version in _pins().items()}
    for name, requirement in _requirements().items():
        assert pins[name.lower()] in requirement.specifier, name


def test_constraints_start_with_torch_and_name_no_host() -> None:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert text.startswith("torch==")
    pattern = re.compile(r"[A-Za-z0-9_.-]+==[0-9][0-9a-z.]*")
    assert [line for line in text.splitlines() if not line.startswith("#") and not pattern.fullmatch(line)] == []


@pytest.mark.parametrize("folder", ["callbacks", "configs"])
def test_top_level_folder_is_part_of_the_package_by_a_relative_link(folder: str) -> None:
    if not (ROOT / folder).exists():
        pytest.skip("a source distribution has the folder in the package only")
    link = ROOT / "nsvq_lightning" / folder
    assert link.is_symlink(), "check the repository out with symbolic links"
    assert os.readlink(link) == f"../{folder}"


def test_callbacks_configs_and_type_marker_are_found_in_the_package() -> None:
    package = files("nsvq_lightning")
    specification = importlib.util.find_spec("nsvq_lightning.callbacks")
    assert specification is not None
    assert specification.origin == str(package / "callbacks" / "__init__.py")
    assert (package / "py.typed").is_file()
    assert any(entry.name.endswith(".yaml") for entry in (package / "configs").iterdir())


def test_scripts_point_to_modules_of_the_package() -> None:
    scripts = _project()["project"]["scripts"]
    assert scripts == {"nsvq": "nsvq_lightning.cli:main", "lightning": "nsvq_lightning.lightning_script:main"}
    for target in scripts.values():
        assert importlib.util.find_spec(target.split(":")[0]) is not None


@pytest.mark.parametrize("block", ["test", "demo"])
def test_readme_has_the_blocks_that_continuous_integration_runs(block: str) -> None:
    runner = ROOT / ".ci" / "run"
    if not runner.exists():
        pytest.skip("a source distribution has no .ci")
    assert os.access(runner, os.X_OK)
    assert f"readme_block {block}" in runner.read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(re.findall(rf"^<!-- ci:{block} -->\n```\w*\n(?!```)", readme, flags=re.MULTILINE)) == 1


def test_continuous_integration_is_a_valid_shell_script() -> None:
    runner = ROOT / ".ci" / "run"
    if not runner.exists():
        pytest.skip("a source distribution has no .ci")
    subprocess.run(["bash", "-n", str(runner)], check=True)
