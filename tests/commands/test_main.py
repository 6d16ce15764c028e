"""The ``nsvq`` command before anything runs: version, help, settings and scenes that cannot be; and ``lightning``."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from viewer_scenes import plain_scene

import nsvq_lightning
from nsvq_lightning.commands import COMMANDS, OF_LIGHTNING, settings
from nsvq_lightning.commands import main as main_module
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.commands.main import main
from nsvq_lightning.io import write_ply


@pytest.mark.parametrize(("argument", "said"), [("--version", nsvq_lightning.__version__), ("--help", "benchmark")])
def test_version_and_overview_come_without_torch(argument: str, said: str) -> None:
    code = (
        "import sys; from nsvq_lightning.commands.main import main; status = main(sys.argv[1:]); "
        "exit(status or 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, argument], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert said in done.stdout
    if argument == "--help":
        assert all(
            re.search(rf"^  {name} +{re.escape(summary)}$", done.stdout, re.M) for name, summary in COMMANDS.items()
        )


def test_help_of_commands_without_training_comes_without_torch() -> None:
    code = (
        "import sys\nfrom nsvq_lightning.commands.main import main\n"
        "for name in sys.argv[1:]:\n"
        "    try: main([name, '--help'])\n"
        "    except SystemExit as end: assert not end.code\n"
        "assert not {'torch', 'numba', 'lightning'} & set(sys.modules)"
    )
    names = [name for name in COMMANDS if name not in OF_LIGHTNING]
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\nExamples:\n") == len(names) - 1  # info has none


def test_files_of_other_programs_are_made_and_described_without_torch(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", plain_scene(20, 3))
    names = ["b.ply", "b.compressed.ply", "b.splat", "b.spz", "b.glb", "b.usda"]
    code = (
        "import sys\nfrom nsvq_lightning.commands.main import main\n"
        "for name in sys.argv[1:]: assert not main(['convert', 'a.ply', name]) and not main(['info', name])\n"
        "assert not {'torch', 'numba', 'lightning'} & set(sys.modules)"
    )
    command = [sys.executable, "-c", code, *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_no_command_is_an_error_that_shows_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "nsvq COMMAND --help" in capsys.readouterr().out


@pytest.mark.usefixtures("help_of_here")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit"], "error: which scene? Name its folder: --data.root=path/to/scene\n"),
        (["fit", "--data", "{folder}"], "the folder of a scene is --data.root=path/to/scene"),
        (["fit", "{folder}"], "is no option; the scene folder is --data.root={folder}\n"),
        (["fit", "-s", "{folder}"], "error: -s is no option; the scene folder is --data.root={folder}\n"),
        (["fit", "--source_path={folder}"], "no option --source_path; the scene folder is --data.root={folder}\n"),
        (["fit", "--data", "no.Such"], "no.Such"),
        (["fit", "--data.root={folder}", "--bytes=abc"], "error: bytes: expected a whole number or null, got 'abc'\n"),
        (
            ["fit", "--data.root={folder}", "--data.factor", "3"],
            "error: data.factor: expected 1, 2, 4, 8 or null, got '3'\n",
        ),
        (
            ["fit", "--data.root={folder}", "--trainer.max_steps=x"],
            "trainer.max_steps: expected a whole number, got 'x'\n",
        ),
        (
            ["fit", "--data.root={folder}", "--model.background=gray"],
            "expected auto, black, white or random, got 'gray'\n",
        ),
        (
            ["fit", "--data.root={folder}", "--callbacks.density=NoSuch"],
            "expected BudgetedGrowth, Callback or null, got 'NoSuch'\n",
        ),
        (
            ["fit", "--data.root={folder}", "--callbacks.density=BudgetGrowth"],
            "'BudgetGrowth'; did you mean BudgetedGrowth?",
        ),
        (["fit", "--data.root={folder}", "--model.quantizer=NSVX"], "got 'NSVX'; did you mean NSVQ?"),
        (["fit", "--data.root={folder}", "--callbacks.densty=null"], "did you mean --callbacks.density?"),
        (["fit", "--data.root={folder}", "--callbacks.density.min_splat=5"], "did you mean --min_splats?"),
        (
            ["fit", "--data.root={folder}", "--callbacks.report.every=2", "--callbacks.sh_degree.every=abc"],
            "error: callbacks.sh_degree.every: expected a whole number, got 'abc'\n",
        ),
        (["fit", "--data.root={folder}", "--qualty=2"], "did you mean --quality?"),
        (
            ["fit", "--data.root={folder}", "--config", "fats.yaml"],
            "fats.yaml; did you mean fast?\nShipped ones: best, ",
        ),
        (["view", "{folder}", "--prot=3"], "did you mean --port?"),
        (["benchmark", "render", "--repeat=2", "--stesp=x"], "did you mean --steps?"),
        (["view", "{folder}", "--port", "web"], "argument --port: invalid int value: 'web'"),
        (["render", "{folder}", "--frames", "0"], "must be above 0"),
        (["render", "{folder}", "--frames", "5", "--seconds", "2"], "not allowed with"),
        (["render", "{folder}", "--size", "12"], "must be like 1280x720"),
        (["render", "{folder}", "--background", "2,0,0"], "three numbers from 0 to 1"),
        (["sweep", "--output={folder}", "--scenes", "a", "b"], "a list has commas between its entries, and no spaces"),
        (["benchmark", "train,rendre"], "choose some of render, quantize, codec, train, or all, got 'train,rendre'"),
        (["benchmark", "train", "--switches", "blocks,blokcs"], "got 'blocks,blokcs'"),
        (["benchmark", "train", "--emulate", "8,0"], "takes numbers of cores"),
        (["benchmark", "all", "--emulate", "8"], "is for the suite train alone"),
        (["benchmark", "render", "--init-from", "scene.ply"], "needs a COLMAP folder"),
        (["sweep", "--output={folder}", "--seeds", "1,two"], "got '1,two'"),
        (["benchmark", "render", "--repeats", "0"], "argument --repeats: must be above 0, got 0"),
        (["benchmark", "render", "--steps", "3"], "steps must be at least 4, one for each phase, got 3"),
        (["benchmark", "render", "--workloads", "A,Z"], "some of A20k, B100k, C500k, D1M, E3M, or all, got 'A,Z'"),
    ],
)
def test_wrong_arguments_are_explained(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "transforms.json").touch()
    with pytest.raises(SystemExit) as stop:
        main([argument.format(folder=tmp_path) for argument in arguments])
    assert stop.value.code == 2
    assert message.replace("{folder}", str(tmp_path)) in capsys.readouterr().err


@pytest.fixture
def help_of_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the stored help for that of the versions that are installed, whichever they are."""
    monkeypatch.setattr(settings, "FIT_HELP_OF", {name: version(name) for name in settings.FIT_HELP_OF})


@pytest.mark.parametrize("collects", [True, False])
def test_a_host_keeps_its_collector(monkeypatch: pytest.MonkeyPatch, collects: bool) -> None:
    frozen = gc.get_freeze_count()
    monkeypatch.setitem(sys.modules, "nsvq_lightning.commands.fit", None)  # importing it fails
    (gc.enable if collects else gc.disable)()
    try:
        with pytest.raises(ImportError):
            main_module._import_cli.__wrapped__(own_process=False)
        assert gc.isenabled() == collects
        assert gc.get_freeze_count() == frozen
        with pytest.raises(ImportError):
            main_module._import_cli.__wrapped__(own_process=True)
        assert gc.isenabled()
    finally:
        gc.unfreeze()
        gc.enable()


def test_commands_that_do_not_exist_or_contradict_themselves_are_told_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compres", "a.ply", "b.nsvq"]) == 2
    assert "there is no command 'compres'; did you mean compress?" in capsys.readouterr().err
    assert main(["fit", "--splats", "1000", "--quality=2"]) == 1
    assert "--splats and --quality both say how large the scene is" in capsys.readouterr().err
    assert main(["fit", "--splats"]) == 1
    assert "--splats needs a number" in capsys.readouterr().err


def test_a_missing_opencv_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def without_opencv(name: str) -> None:
        raise ModuleNotFoundError("No module named 'cv2'", name="cv2")

    monkeypatch.setattr(main_module, "import_module", without_opencv)
    assert main(["compress"]) == 1
    assert capsys.readouterr().err.startswith("error: OpenCV (cv2) is missing: pip install opencv-")


SCENE = ["--config=demo", "--callbacks.progress=null"]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--trainer.accelerator=tpu", "torch_xla"),
        ("--trainer.devices=0", "devices='0'"),
        ("--trainer.strategy=nothing", "strategy='nothing'"),
        ("--callbacks.density.budget=1", "budget must be at least min_splats=10, got 1"),
        ('--callbacks.density={"class_path": "DensityControl", "init_args": {"max_splats": -1}}', "max_splats must be"),
        ("--callbacks.report.every=-1", "every must be at least 0, got -1"),
        ("--callbacks.density.every=null", "every must have a value, got None"),
        ("--trainer.logger=MLFlowLogger", "mlflow"),
        ("--trainer.accelerator=gpu", "No supported gpu backend found"),
        ("--model.quantizer=nn_modules.NoQuantizer", "NoQuantizer is not a quantizer; it lacks: codebook, codes"),
        ("--seed_everything=-1", "-1 is not in bounds"),
    ],
)
def test_settings_that_cannot_be_are_one_line(
    option: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if option.endswith("gpu") and (torch.cuda.is_available() or torch.backends.mps.is_available()):
        pytest.skip("this machine has a GPU")
    if "mlflow" in message and (find_spec("mlflow") or find_spec("mlflow_skinny")):
        pytest.skip("MLflow is installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "nn_modules", raising=False)
    Path("nn_modules.py").write_text("import torch\nclass NoQuantizer(torch.nn.Linear): ...\n")
    assert main(["fit", *SCENE, option]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "available" not in line and "Tip" not in line]
    assert [line.partition(":")[0] for line in lines] == ["error", "(NSVQ_TRACEBACK=1 shows where)"]
    assert message in lines[0]
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "__pycache__") == ["nn_modules.py"]


def test_a_missing_file_is_named_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fit", *SCENE, "--model.init_from=none.ply", "--trainer.max_steps=1"]) == 1
    assert "error: none.ply: No such file or directory\n(NSVQ_TRACEBACK=1 shows where)" in capsys.readouterr().err


def test_ctrl_c_in_a_function_that_c_calls_comes_again() -> None:
    said = subprocess.run(
        [sys.executable, "-c", LOST], capture_output=True, text=True, timeout=120, check=False, env=os.environ
    )
    assert (said.returncode, said.stdout.split()) == (130, ["begun"]), said.stderr


# As LLVM calls back while kernels are compiled: what is raised in there is ignored.
LOST = """
import ctypes, signal, sys, time
from nsvq_lightning.commands import main as module
def run(options):
    print("begun")
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()
    for _ in range(600):
        time.sleep(0.1)
    print("lost")
module.run_command = lambda name, arguments: run(arguments)
sys.argv = ["nsvq", "info", "x"]
sys.exit(module.main())
"""


def test_a_bug_in_a_class_of_ones_own_shows_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "with_a_bug", raising=False)
    Path("with_a_bug.py").write_text(
        "from lightning.pytorch import Callback\nclass Bug(Callback):\n    def __init__(self): {}['first']\n"
    )
    with pytest.raises(KeyError, match="first"):
        main(["fit", *SCENE, "--trainer.callbacks+=with_a_bug.Bug"])


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes")]
)
def test_a_lack_of_memory_is_one_line(
    error: Exception, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path) -> None:
        raise error

    monkeypatch.setattr("nsvq_lightning.commands.info.describe", fail)
    assert main(["info", "a.ply"]) == 1
    assert re.fullmatch(r"error: there is not enough memory: close .* \(--splats\).*\n", capsys.readouterr().err)
    monkeypatch.setenv("NSVQ_TRACEBACK", "1")
    with pytest.raises(type(error)):
        main(["info", "a.ply"])


Install = Callable[[str, str], None]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Arguments that our own front end was called with."""
    seen: list[list[str]] = []

    def main(argv: Sequence[str] | None = None) -> int:
        seen.append(list(argv or []))
        return 3

    monkeypatch.setattr(main_module, "main", main)
    return seen


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Makes ``importlib.metadata`` find exactly the distributions installed by it."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *(p for p in sys.path if "site-packages" not in p)])
    monkeypatch.setattr(sys, "argv", ["lightning"])

    def add(distribution: str, target: str) -> None:
        info = tmp_path / f"{distribution.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[console_scripts]\nlightning = {target}\n")

    (tmp_path / "foreign.py").write_text(
        "import sys\n\n"
        "def run():\n    print('foreign', *sys.argv)\n    return 5\n\n"
        "def wrong():\n    raise AssertionError('must not be called')\n"
    )
    return add


def test_the_words_are_those_of_the_main_module() -> None:
    assert set(OF_LIGHTNING) == set(SplatCLI.subcommands()) < set(COMMANDS)


@pytest.mark.parametrize("arguments", [["fit", "--config", "a.yaml"], ["info", "x.ply"], ["validate"], ["--help"], []])
def test_our_words_run_our_command(calls: list[list[str]], install: Install, arguments: list[str]) -> None:
    install("lightning-sdk", "foreign:wrong")
    assert main_module.lightning(arguments) == 3
    assert calls == [arguments]


def test_foreign_words_go_to_the_other_distribution(
    calls: list[list[str]], install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("NSVQ_Lightning", "nsvq_lightning.commands.main:lightning")
    install("lightning-sdk", "foreign:run")
    with pytest.raises(SystemExit, match="5"):
        main_module.lightning(["login", "--token", "x"])
    assert capsys.readouterr().out == "foreign lightning login --token x\n"
    assert calls == []


def test_without_another_distribution_the_known_words_are_listed(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("nsvq-lightning", "nsvq_lightning.commands.main:lightning")
    assert main_module.lightning(["login"]) == 2
    message = capsys.readouterr().err
    assert "unknown command 'login'" in message
    assert "fit, test, validate, predict" in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize(
    "command",
    [
        "info x.ply",
        "convert x.ply y.sog",
        "convert x.ply y.ply",
        "compress x.ply y.nsvq",
        "render x.ply -o y.mp4",
        "view x.ply --no-open",
    ],
)
def test_no_command_goes_on_with_an_empty_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str, count: int
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = plain_scene(count, 0)
    scene.raw["scales"][:] = np.inf
    write_ply("x.ply", scene)
    assert main(command.split()) == 1
    reason = " (scales in 3 rows are not)" if count else ""
    error = f"nsvq {command.split()[0]}: x.ply: no finite splat among {count}{reason}; give a scene with splats\n"
    assert capsys.readouterr().err.endswith(error)
    assert [path.name for path in tmp_path.iterdir()] == ["x.ply"]


def test_a_closed_output_ends_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As daemons and pythonw have it."""
    write_ply(tmp_path / "scene.ply", plain_scene(5, 0))
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert main(["info", str(tmp_path / "scene.ply")]) == 0
    nowhere = map(str, (-1e-9, -1e-9, -1e-9, 1e-9, 1e-9, 1e-9))
    assert main(["convert", str(tmp_path / "scene.ply"), str(tmp_path / "x.nsvq"), "--crop", *nowhere]) == 1
    for stream in (sys.stdout, sys.stderr):
        stream.close()


def test_settings_of_a_callback_may_be_in_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "density.yaml").write_text("budget: 1")
    assert main(["fit", *SCENE, f"--callbacks.density={tmp_path / 'density.yaml'}"]) == 1
    assert "budget must be at least min_splats=10, got 1" in capsys.readouterr().err


def test_commands_find_classes_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those that resolve the options of fit, as a sweep does."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    Path("of_this_folder.py").write_text("value = 3")
    assert main(["--version"]) == 0
    assert import_module("of_this_folder").value == 3


@pytest.mark.skipif(os.name == "nt", reason="where folders in use cannot be deleted")
def test_a_deleted_folder_ends_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert main(["--version"]) == 0
    monkeypatch.chdir(tmp_path)


def test_home_is_found_behind_an_equals_sign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where no shell puts it."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    write_ply("x.ply", plain_scene(5, 0))
    assert main(["render", "x.ply", "--output=~/missing/x.pdf"]) != 0
    assert f"{tmp_path}/missing/x.pdf" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "quote"), [("posix", "'"), ("nt", '"')])
def test_commands_that_are_said_are_for_the_shell_of_the_system(name: str, quote: str) -> None:
    code = (
        f"import os, subprocess, nsvq_lightning; os.name = {name!r}\n"
        "from nsvq_lightning.commands import join; print(join(['nsvq', 'a b']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"nsvq {quote}a b{quote}\n"
