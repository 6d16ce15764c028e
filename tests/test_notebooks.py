"""The notebooks run from top to bottom (at a small size)."""

from __future__ import annotations

import json
import re
from pathlib import Path

import matplotlib as mpl
import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_run(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    namespace: dict[str, object] = {}
    for cell in json.loads(notebook.read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        source = "".join(cell["source"])
        source = re.sub(r"^steps = \d+", "steps = 60", source, flags=re.MULTILINE)
        source = re.sub(r"DemoDataModule\((.*)\)", r"DemoDataModule(\1, views=9, width=64, height=48)", source)
        exec(compile(source, str(notebook), "exec"), namespace)
    (scene,) = (tmp_path / "runs/notebook").rglob("scene.nsvq")
    assert scene.stat().st_size > 0
