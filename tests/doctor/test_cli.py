from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from nsvq_lightning.doctor import machine
from nsvq_lightning.doctor.cli import main


def test_json_has_every_finding_and_the_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    subjects = {finding["subject"] for finding in document["findings"]}
    assert document["ok"]
    assert subjects >= {"versions", "cpu", "gpu", "lpips", "tensorboard", "threads", "memory", "disk", "self-test"}


def test_a_bad_folder_gives_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith(f"problem  model        no COLMAP model in {tmp_path}")]
    assert lines[-1].startswith("1 problem,")


def test_help_answers_before_torch_is_imported() -> None:
    code = "import sys; from nsvq_lightning.cli import main\ntry: main(['doctor', '--help'])\n"
    code += "finally: assert 'torch' not in sys.modules"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_threads_and_waiting_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    for used, verdict in ((2, "note"), (4, "good"), (8, "note")):
        monkeypatch.setattr(machine, "usable_cores", lambda: 4)
        monkeypatch.setattr(machine.jit, "thread_count", lambda used=used: used)
        assert next(iter(machine.check_threads())).verdict == verdict
    for policy, verdict in (("passive", "good"), ("ACTIVE", "note")):
        monkeypatch.setenv("OMP_WAIT_POLICY", policy)
        assert list(machine.check_threads())[1].verdict == verdict


def test_little_memory_and_disk_are_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 10**9)
    assert [finding.verdict for finding in machine.check_memory()] == ["note"]
    monkeypatch.setattr(machine, "SMALL_DISK", 1 << 70)
    assert [finding.verdict for finding in machine.check_disk(tmp_path)] == ["note"]
