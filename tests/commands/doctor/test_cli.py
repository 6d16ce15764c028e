from __future__ import annotations

import json
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite import binding

from nsvq_lightning.commands.doctor import machine
from nsvq_lightning.commands.doctor.backends import check_backends
from nsvq_lightning.commands.doctor.cli import main


def test_json_has_every_finding_and_the_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    subjects = {finding["subject"] for finding in document["findings"]}
    assert document["ok"]
    assert subjects >= {
        "versions",
        "opencv",
        "cpu",
        "gpu",
        "lpips",
        "tensorboard",
        "threads",
        "memory",
        "disk",
        "self-test",
    }


def test_a_bad_folder_gives_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith(f"problem  model        no COLMAP model in {tmp_path}")]
    assert lines[-1].startswith("1 problem,")


def test_help_answers_before_torch_is_imported() -> None:
    code = "import sys; from nsvq_lightning.commands.main import main\ntry: main(['doctor', '--help'])\n"
    code += "finally: assert 'torch' not in sys.modules"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_threads_and_waiting_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    for used, verdict in ((2, "note"), (4, "good"), (8, "note")):
        monkeypatch.setattr(machine, "usable_cores", lambda: 4)
        monkeypatch.setattr(machine, "thread_count", lambda used=used: used)
        assert next(iter(machine.check_threads())).verdict == verdict
    for policy, verdict in (("passive", "good"), ("ACTIVE", "note")):
        monkeypatch.setenv("OMP_WAIT_POLICY", policy)
        assert list(machine.check_threads())[1].verdict == verdict


def test_the_slow_cores_of_a_mac_are_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "usable_cores", lambda: 8)
    monkeypatch.setattr(machine, "thread_count", lambda: 4)
    monkeypatch.setattr(platform, "system", lambda: "Darwin")
    monkeypatch.setattr(platform, "machine", lambda: "arm64")
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert next(machine.check_threads()).verdict == "good"
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    assert next(machine.check_threads()).verdict == "note"


def test_one_opencv_of_any_name_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    versions: dict[str, str] = {"opencv-python": "5.0"}
    monkeypatch.setattr(machine, "_version", versions.get)
    (finding,) = machine.check_opencv()
    assert (finding.verdict, finding.values["packages"]) == ("good", ["opencv-python"])
    versions["opencv-contrib-python-headless"] = "5.0"
    (finding,) = machine.check_opencv()
    assert (finding.verdict, "uninstall" in finding.text) == ("note", True)
    monkeypatch.setitem(sys.modules, "cv2", None)
    (finding,) = machine.check_opencv()
    assert (finding.verdict, "pip install opencv" in finding.text) == ("problem", True)


def test_neon_is_no_reason_to_look_for_another_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "arm64")
    monkeypatch.setattr(binding, "get_host_cpu_features", dict)  # LLVM says nothing, as on a Mac
    finding = next(check_backends())
    assert (finding.verdict, finding.values["simd_bits"], finding.values["fma"]) == ("good", 128, True)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    assert next(check_backends()).verdict == "note"


def test_little_memory_and_disk_are_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 10**9)
    assert [finding.verdict for finding in machine.check_memory()] == ["note"]
    monkeypatch.setattr(machine, "SMALL_DISK", 1 << 70)
    assert [finding.verdict for finding in machine.check_disk(tmp_path)] == ["note"]
