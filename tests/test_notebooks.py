"""The notebooks run from top to bottom (at a small size), and do what they say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import matplotlib as mpl
import pytest

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
ALL = ("compress_ply", "own_quantizer", "quickstart", "read_a_sweep")
SMALL = (
    (r"^steps = \d+", "steps = 24"),
    (r"DemoDataModule\(\)", "DemoDataModule(factor=4)"),
    (r"--data\.root=\{DEMO\}\"", '--data.root={DEMO}", "--data.factor=4"'),
    (r'^sizes = ".*"', 'sizes = "1k,0.5k"'),
    (r"str\(small\)\]", 'str(small), "--minutes=0.1"]'),
)
"""What is smaller in a test."""


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Execute the cells in a folder, and return their variables."""
    monkeypatch.chdir(folder)
    mpl.use("Agg")
    namespace: dict[str, object] = {"__name__": "__main__"}
    for cell in json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())["cells"]:
        if cell["cell_type"] == "code":
            source = "".join(cell["source"])
            for pattern, replacement in SMALL:
                source = re.sub(pattern, replacement, source, flags=re.MULTILINE)
            exec(compile(source, name, "exec"), namespace)
    return namespace


def test_every_notebook_is_run() -> None:
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(ALL)


@pytest.mark.parametrize("name", ALL)
def test_notebooks_are_committed_without_output(name: str) -> None:
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())["cells"]
    assert len({cell["id"] for cell in cells}) == len(cells)
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in cells)


def test_quickstart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("quickstart", tmp_path, monkeypatch)
    (scene,) = (tmp_path / "runs/notebook").rglob("scene.nsvq")
    assert scene.stat().st_size > 0


@pytest.mark.slow
def test_own_quantizer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = run("own_quantizer", tmp_path, monkeypatch)
    runs = found["runs"]
    assert isinstance(runs, dict)
    results = {name: json.loads((run / "metrics.json").read_text()) for name, run in runs.items()}
    assert {name: metrics["num_splats"] > 0 for name, metrics in results.items()} == {"NSVQ": True, "Approaching": True}
    assert abs(results["NSVQ"]["psnr"] - results["Approaching"]["psnr"]) < 3
    taken = {int(quantizer.taken) for quantizer in found["module"].quantizers.values()}  # type: ignore[attr-defined]
    assert min(taken) > 0


@pytest.mark.slow
def test_compress_ply(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = run("compress_ply", tmp_path, monkeypatch)
    plain, small = found["plain"], found["small"]
    assert isinstance(plain, Path)
    assert isinstance(small, Path)
    assert plain.stat().st_size > 4 * small.stat().st_size
    assert 0 < float(found["error"]) < 0.02  # type: ignore[arg-type]
    assert sorted(path.suffix for path in small.parent.glob("scene.s*")) == [".sog", ".splat", ".spz"]


@pytest.mark.slow
def test_read_a_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = run("read_a_sweep", tmp_path, monkeypatch)
    assert found["status"] == 0
    runs = found["runs"]
    assert isinstance(runs, list)
    assert [row["codebooks"] for row in runs] == ["0.5k", "1k"]
    assert found["enough"] in runs
