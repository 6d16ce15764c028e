from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("given", "waiting", "blocks"),
    [
        ({}, "passive", "expandable_segments:True"),
        ({"OMP_WAIT_POLICY": "active", "PYTORCH_ALLOC_CONF": "backend:native"}, "active", "backend:native"),
        ({"PYTORCH_CUDA_ALLOC_CONF": "backend:native"}, "passive", None),  # the name of old, which would be overruled
    ],
)
def test_the_environment_is_set_by_the_import_unless_the_user_has(
    given: dict[str, str], waiting: str, blocks: str | None
) -> None:
    code = "import json, os, nsvq_lightning; print(json.dumps(dict(os.environ)))"
    ours = ("OMP_WAIT_POLICY", "PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF")
    environment = {key: value for key, value in os.environ.items() if key not in ours} | given
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    found = json.loads(done.stdout)
    assert (found["OMP_WAIT_POLICY"], found["THP_MEM_ALLOC_ENABLE"]) == (waiting, "1")
    assert found.get("PYTORCH_ALLOC_CONF") == (blocks if sys.platform == "linux" else given.get("PYTORCH_ALLOC_CONF"))


@pytest.mark.parametrize(
    ("first", "given", "spin"),
    [("torch", {}, True), ("torch", {"OMP_WAIT_POLICY": "passive"}, False)],
)
def test_who_imports_torch_first_is_known(first: str, given: dict[str, str], spin: bool) -> None:
    code = f"import {first}, nsvq_lightning; from nsvq_lightning.compute import environment as e; print(e.came_late)"
    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"} | given
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == f"{spin}\n"
