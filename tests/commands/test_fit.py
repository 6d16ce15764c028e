"""The command line: configs by name, traps of LightningCLI, export, what a run leaves behind."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from small_demo import write_small_demo
from splat_scenes import random_splats

from nsvq_lightning.commands.fit import SplatCLI, summary
from nsvq_lightning.commands.main import main
from nsvq_lightning.io.formats import save
from nsvq_lightning.io.nsvq.file import read_nsvq
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

CODES = ["--model.quantizer=NSVQ", "--model.codebooks.scales=16", "--model.codebooks.sh0=8"]


def fit(scene: Path, folder: Path, *more: str, steps: int = 20) -> list[str]:
    return [
        "fit",
        f"--data.root={scene}",
        "--data.factor=2",
        f"--trainer.max_steps={steps}",
        f"--trainer.default_root_dir={folder}",
        "--trainer.accelerator=cpu",
        "--trainer.enable_progress_bar=false",
        "--model.sh_degree=1",
        *more,
    ]


@pytest.fixture(scope="module")
def finished(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of 20 steps."""
    root = tmp_path_factory.mktemp("cli")
    assert main(fit(demo_scene, root, *CODES, "--model.quantizer.kmeans_steps=3")) == 0
    return root / demo_scene.name / "version_0"


def test_a_run_leaves_scene_report_config_and_checkpoint(finished: Path) -> None:
    names = {path.name for path in finished.iterdir()}
    assert {"scene.nsvq", "scene.ply", "viewer.html", "report.html", "renders", "config.yaml", "checkpoints"} <= names
    assert {"metrics.json", "views.csv", "curve.csv", "metrics.csv"} <= names
    config = yaml.safe_load((finished / "config.yaml").read_text())
    assert config["model"]["quantizer"]["init_args"] == {"kmeans_steps": 3, "start": "sample"}
    assert config["model"]["codebooks"] == {"scales": 16, "sh0": 8}
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["level"] == "compact"
    assert metrics["paper_level"]["file_bytes"] > metrics["file_bytes"]
    assert [end["phase"] for end in metrics["phases"]] == [phase.name.lower() for phase in Phase]
    assert f"look at it: open {finished / 'viewer.html'}, or nsvq view" in summary(finished, metrics)
    assert f"look at it: nsvq view {finished.parent}" in summary(finished.parent, metrics)  # without a page


@pytest.mark.parametrize(
    ("options", "seeds"),
    [(["--seed_everything=3"], (3, 3)), (["--seed_everything=3", "--model.seed=4"], (4, 3))],
)
def test_the_seed_of_everything_is_that_of_every_draw(
    options: list[str], seeds: tuple[int, int], demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []

    def look(command: SplatCLI, subcommand: str) -> None:
        seen.append((command.model.seed, command.datamodule.seed))

    monkeypatch.setattr(SplatCLI, "_run_subcommand", look)
    assert main(fit(demo_scene, tmp_path, *options)) == 0
    assert seen == [seeds]


def test_a_run_is_repeated_with_another_seed(demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = "--model.codebooks=null", "--trainer.max_steps=2"
    assert main(fit(demo_scene, tmp_path, "--seed_everything=3", *short)) == 0
    config = tmp_path / demo_scene.name / "version_0" / "config.yaml"
    seen = []
    monkeypatch.setattr(SplatCLI, "_run_subcommand", lambda command, _: seen.append(command.model.seed))
    for more in ([], ["--seed_everything=5"]):
        assert main(["fit", f"--config={config}", *more]) == 0
    assert seen == [3, 5]


OWN = """
from nsvq_lightning.quantize import TrainedStraightThrough

class Mine(TrainedStraightThrough):
    def __init__(self, num_codes, dim, *, weight=2.0, **settings):
        super().__init__(num_codes, dim, **settings)
        self.weight = weight
"""


def test_a_quantizer_of_ones_own_takes_the_place_of_the_one_it_derives_from(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_quantizer.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    seen = []
    monkeypatch.setattr(SplatCLI, "_run_subcommand", lambda command, _: seen.append(command.config.fit.model.quantizer))
    kind = "own_quantizer.Mine"
    for more in ([], ["--model.quantizer.weight=3.0"]):
        options = ["--model.quantizer.kmeans_steps=7", f"--model.quantizer={kind}", *more]
        assert main(fit(demo_scene, tmp_path, *options)) == 0
    assert [each.class_path for each in seen] == [kind, kind]
    assert [each.init_args.kmeans_steps for each in seen] == [7, 7]  # that was asked for
    assert [each.init_args.weight for each in seen] == [2.0, 3.0]


def test_checkpoints_of_the_command_line_are_plain_data_and_load(finished: Path) -> None:
    path = finished / "checkpoints" / "last.ckpt"
    stored = torch.load(path, weights_only=True)
    assert stored["hyper_parameters"]["quantizer"]["class_path"].endswith("NSVQ")
    module = SplatModule.load_from_checkpoint(path, weights_only=True)
    assert set(module.quantizers) == {"scales", "sh0"}
    assert getattr(module.quantizers["scales"], "kmeans_steps", None) == 3


def test_a_bare_trainer_needs_no_other_option(demo_scene: Path, tmp_path: Path) -> None:
    assert main(fit(demo_scene, tmp_path, "--trainer.barebones=true", steps=2)) == 0
    assert not list(tmp_path.rglob("last.ckpt"))


def test_a_run_goes_on_with_the_options_given_and_counts_its_lines(
    demo_scene: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = finished / "checkpoints" / "last.ckpt"
    more = ["--model.rates.opacities=0.0123", f"--ckpt_path={checkpoint}", "--callbacks.phases.total=20"]
    shown = ["--trainer.enable_progress_bar=true", "--callbacks.progress.refresh_rate=1", "--callbacks.rate_decay=null"]
    assert main(fit(demo_scene, tmp_path, *CODES, *more, *shown, steps=22)) == 0
    folder = tmp_path / demo_scene.name / "version_0"
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["model"]["rates"]["opacities"] == 0.0123
    assert config["ckpt_path"] is None
    # Lightning restores the optimiser with its stored rates; ours must still be the new one.
    stored = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    rates = {group["name"]: group["lr"] for group in stored["optimizer_states"][0]["param_groups"]}
    assert rates["opacities"] == 0.0123
    out = capsys.readouterr().out
    said = r"^iteration (\d+) of 22 \(\d+ %\), \S+ elapsed, \S+ left, until \d\d:\d\d: finetune \d+ splats"
    assert re.findall(said, out, re.MULTILINE) == ["21", "22"]
    assert "\r" not in out


def test_a_checkpoint_of_another_phase_is_refused_with_the_way_out(
    demo_scene: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = finished / "checkpoints" / "last.ckpt"
    assert main(fit(demo_scene, tmp_path, *CODES, f"--ckpt_path={checkpoint}", steps=40)) == 1
    assert re.search(
        r"^error: the module is in its finetune phase, but iteration 20 .*callbacks\.phases\.total",
        capsys.readouterr().err,
        re.MULTILINE,
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "--data.root=scene\udcff"], "which is not UTF-8: rename"),
        (["fit", "--model.codebooks=3k"], "choose one of 16k"),
        (["fit", "--trainer.max_steps=0"], "set trainer.max_steps"),
        (["fit", "--trainer.precision=bf16-mixed"], "whatever trainer.precision says"),
        (["fit", "--trainer.run_folder=file/run"], "the folder of the run, file/run, cannot be made ("),
        (["fit", "--ckpt_path=last"], "last: no such checkpoint"),
        (["test"], "--ckpt_path"),
    ],
)
def test_errors_of_the_user_are_one_line(
    arguments: list[str],
    message: str,
    demo_scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert main([*arguments, f"--data.root={demo_scene}"]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def damaged(whole: bytes) -> bytes:
    """A checkpoint with one byte changed, in the middle of its largest part."""
    place = len(whole) // 2
    return whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :]


@pytest.mark.parametrize(
    ("command", "what"),
    [
        *(("fit", "missing"), ("fit", "damaged")),
        *(("test", "damaged"), ("validate", "foreign"), ("export", "truncated")),
    ],
)
def test_a_checkpoint_that_cannot_be_used_is_named_with_the_reason(
    command: str, what: str, finished: Path, demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, whole = tmp_path / "a.ckpt", (finished / "checkpoints" / "last.ckpt").read_bytes()
    if what == "foreign":
        torch.save({"state_dict": {"weight": torch.ones(2)}, "pytorch-lightning_version": "2.6.6"}, path)
    elif what != "missing":
        path.write_bytes(damaged(whole) if what == "damaged" else whole[:-100])
    arguments = [] if command == "export" else [f"--data.root={demo_scene}", f"--trainer.default_root_dir={tmp_path}"]
    assert main([command, f"--ckpt_path={path}", *arguments]) == 1
    error, hint = capsys.readouterr().err.splitlines()[-2:]
    reason = {"missing": "no such checkpoint", "foreign": "a checkpoint of another model"}.get(what, what)
    assert error.startswith(f"error: {path}: {reason}")
    assert "pass a checkpoint that nsvq fit has written" in error
    assert hint == "(NSVQ_TRACEBACK=1 shows where)"
    assert not (tmp_path / demo_scene.name).exists()  # nothing was begun


def test_test_takes_the_model_from_the_checkpoint(demo_scene: Path, finished: Path, tmp_path: Path) -> None:
    checkpoint = finished / "checkpoints" / "last.ckpt"
    arguments = [f"--ckpt_path={checkpoint}", f"--data.root={demo_scene}", "--data.factor=2"]
    assert main(["test", *arguments, f"--trainer.default_root_dir={tmp_path}", "--callbacks.progress=null"]) == 0
    folder = tmp_path / demo_scene.name / "version_0"
    assert (folder / "scene.nsvq").read_bytes() == (finished / "scene.nsvq").read_bytes()
    ours, theirs = (json.loads((f / "metrics.json").read_text()) for f in (folder, finished))
    assert ours.pop("train_seconds") == pytest.approx(theirs.pop("train_seconds"), abs=0.1)
    assert ours == theirs


def test_only_the_command_line_names_what_is_imported(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    mark = tmp_path / "mark"
    (tmp_path / "elsewhere.py").write_text(
        f"from nsvq_lightning import quantize\nopen({str(mark)!r}, 'w')\nclass Mine(quantize.NSVQ): ...\n"
    )
    checkpoint = torch.load(finished / "checkpoints" / "last.ckpt", weights_only=True)
    checkpoint["hyper_parameters"]["quantizer"]["class_path"] = "elsewhere.Mine"
    for settings in checkpoint["quantizer_settings"].values():
        settings["quantizer"] = "Mine"
    torch.save(checkpoint, tmp_path / "last.ckpt")
    for command in (["export"], ["predict", "--data.root=."]):
        assert main([*command, "--ckpt_path=last.ckpt"]) == 1
        assert "name it: --model.quantizer=elsewhere.Mine, or" in capsys.readouterr().err
        assert not mark.exists()
    export = ["export", "--ckpt_path=last.ckpt", "--model.quantizer=elsewhere.Mine"]
    assert main(export) == 0
    assert mark.exists()
    assert main(export) == 1
    assert "scene.nsvq exists here: name another file" in capsys.readouterr().err
    assert read_nsvq(tmp_path / "scene.nsvq").config["quantizers"]["sh0"] == "Mine"


def test_export_reads_no_scene_and_its_options_win_over_the_checkpoint(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    arguments = ["export", f"--ckpt_path={finished / 'checkpoints' / 'last.ckpt'}"]
    for name, more in (("out.nsvq", []), ("out.ply", []), ("paper.nsvq", ["--model.storage.level", "paper"])):
        assert main([*arguments, f"--output={tmp_path / name}", *more]) == 0
    for suffix in (".nsvq", ".ply"):
        assert (tmp_path / f"out{suffix}").read_bytes() == (finished / f"scene{suffix}").read_bytes()
    compact, paper = (read_nsvq(tmp_path / name) for name in ("out.nsvq", "paper.nsvq"))
    assert len(paper.codebooks["scales"]) == 16  # of the checkpoint
    assert len(paper) == len(compact)
    capsys.readouterr()
    assert main([*arguments, f"--output={tmp_path / 'x.nsvq'}", "--model.codebooks=0.5k"]) == 1
    assert "the checkpoint is of a run that quantizes with " in capsys.readouterr().err
    assert main([*arguments, f"--output={tmp_path / 'x.nsvq'}", "--model.antialiased=true"]) == 0
    assert "of a run with other settings: pass --model.antialiased=False to" in caplog.text
    assert main([*arguments, f"--output={tmp_path / 'www/lod-meta.json'}"]) == 0
    size = sum(path.stat().st_size for path in (tmp_path / "www").rglob("*") if path.is_file())
    assert f"{size} bytes" in caplog.text
    assert (tmp_path / "out.nsvq").stat().st_size < (tmp_path / "paper.nsvq").stat().st_size


def test_predict_and_validate_take_a_checkpoint(
    demo_scene: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [f"--ckpt_path={finished / 'checkpoints' / 'last.ckpt'}", f"--data.root={demo_scene}"]
    arguments += [f"--trainer.default_root_dir={tmp_path}", "--callbacks.progress=null"]
    folder = f"--callbacks.predictions.folder={tmp_path / 'pictures'}"
    assert main(["predict", *arguments, "--data.factor=2", folder]) == 0
    photos = {path.stem for path in (demo_scene / "images").iterdir()}
    assert {path.stem for path in (tmp_path / "pictures").iterdir()} == photos
    assert main(["validate", f"--config={finished / 'config.yaml'}", *arguments]) == 0
    assert "val/psnr" in capsys.readouterr().out


def test_a_checkpoint_of_another_scene_is_refused_unless_allowed(
    finished: Path, demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_small_demo(tmp_path / "garden", views=8, width=48, height=36, points=300)
    arguments = [f"--ckpt_path={finished / 'checkpoints' / 'last.ckpt'}", f"--data.root={other}"]
    arguments += [f"--trainer.default_root_dir={tmp_path}", "--callbacks.progress=null"]
    assert main(["validate", *arguments]) == 1
    message = rf"^error: .* trained on {demo_scene.name} with 9 views, and 1 of the 8 views of {other} are .*--data"
    assert re.search(message, capsys.readouterr().err, re.MULTILINE)
    assert main(["validate", *arguments, "--trainer.allow_other_scene=true"]) == 0


def settings(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    """The settings that a fit would have."""
    with pytest.raises(SystemExit) as stop:
        main(["fit", *arguments, "--print_config"])
    printed = capsys.readouterr()
    assert stop.value.code == 0, printed.err
    parsed: dict[str, Any] = yaml.safe_load(printed.out)
    return parsed


def test_callbacks_can_be_configured_exchanged_removed_and_added(capsys: pytest.CaptureFixture[str]) -> None:
    config = settings(
        capsys,
        *("--data.root=x", "--callbacks.density=DensityControl", "--callbacks.density.max_splats=99"),
        *("--callbacks.selection=null", "--callbacks.opacity.weight=0.5", "--trainer.callbacks+=LearningRateMonitor"),
    )
    assert config["callbacks"]["density"]["class_path"].endswith("DensityControl")
    assert config["callbacks"]["density"]["init_args"]["max_splats"] == 99
    assert config["callbacks"]["density"]["init_args"]["grad_threshold"] == 0.0002  # not that of the class before
    assert config["callbacks"]["selection"] is None
    assert config["callbacks"]["opacity"]["init_args"]["weight"] == 0.5
    assert config["trainer"]["callbacks"][0]["class_path"].endswith("LearningRateMonitor")


def test_shipped_configs_are_what_their_names_say(capsys: pytest.CaptureFixture[str]) -> None:
    default = settings(capsys, "--data.root=x")
    assert default == settings(capsys, "--data.root=x", "--config=fast")
    assert (default["trainer"]["max_steps"], default["callbacks"]["budget"]["init_args"]["quality"]) == (4500, 0.9)
    assert default["trainer"]["devices"] == 1  # whatever the machine has
    assert default["model"]["quantizer"]["class_path"].endswith("TrainedStraightThrough")
    plain = settings(capsys, "--config=plain", "--data.root=x")
    assert plain["model"]["codebooks"] is None
    assert plain["callbacks"]["phases"]["init_args"]["warmup_end"] == 15_000
    assert plain["callbacks"]["density"]["init_args"]["prune_every"] == 0
    assert settings(capsys, "--config=demo.yaml")["data"]["class_path"].endswith("DemoDataModule")


def test_the_papers_settings_survive_another_class(capsys: pytest.CaptureFixture[str]) -> None:
    config = settings(capsys, "--config=paper", "--data.root=x", "--model.codebooks=4k", "--model.quantizer=PostHoc")
    assert (config["trainer"]["max_steps"], config["model"]["codebooks"]) == (45_000, "4k")
    assert config["model"]["quantizer"]["class_path"].endswith("PostHoc")
    assert config["model"]["rates"]["shN"] == 0.000125
    callbacks = config["callbacks"]
    assert [callbacks[name] for name in ("rate_decay", "budget", "selection", "canonical")] == [None] * 4
    assert callbacks["phases"]["init_args"]["quantize_end"] == 43_000
    assert callbacks["density"]["class_path"].endswith("DensityControl")
    assert callbacks["density"]["init_args"]["start"] == 600


def test_wrong_settings_name_the_file_they_came_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.yaml"
    (tmp_path / "transforms.json").touch()
    for settings, said in (
        ("model: {nonsense: 3}", "nonsense"),
        ("callbacks: {density: {init_args: {budget: abc}}}", "callbacks.density.init_args.budget: expected"),
    ):
        path.write_text(settings)
        with pytest.raises(SystemExit) as stop:
            main(["fit", "--config", str(path), f"--data.root={tmp_path}"])
        assert stop.value.code == 2
        message = capsys.readouterr().err
        assert said in message
        assert f"Settings came from {path} and the command line" in message


def test_a_folder_that_cannot_be_used_leaves_no_run_behind(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    runs = tmp_path / "runs"
    assert main(["fit", f"--data.root={tmp_path / 'photos'}", f"--trainer.default_root_dir={runs}"]) == 1
    assert not runs.exists()


def test_a_run_without_checkpoints_or_bar_leaves_none(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(demo_scene.parent)
    monkeypatch.setenv("HOME", str(demo_scene.parent))  # which shells leave to others after --data.root=
    root, demo_scene = demo_scene.resolve(), Path("~", demo_scene.name)
    save(random_splats(300, sh_degree=1), tmp_path / "start.ply")
    start = f"--model.init_from={os.path.relpath(tmp_path / 'start.ply')}"
    assert main(fit(demo_scene, tmp_path, *CODES, start, "--trainer.enable_checkpointing=false", steps=3)) == 0
    folder = tmp_path / demo_scene.name / "version_0"
    assert (folder / "scene.nsvq").is_file()
    assert not (folder / "checkpoints").exists()
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["data"]["init_args"]["root"] == str(root)  # whatever folder it is read from
    assert config["model"]["init_from"] == str(tmp_path / "start.ply")


def test_a_quantizer_of_the_current_folder_trains(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "quantizers.md").read_text(encoding="utf-8")
    (source,) = re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    (tmp_path / "my_quantizers.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    assert main(fit(demo_scene, tmp_path, *CODES[1:], "--model.quantizer=my_quantizers.Halfway", steps=4)) == 0
    stored = read_nsvq(tmp_path / demo_scene.name / "version_0" / "scene.nsvq")
    assert stored.config["quantizers"] == {"scales": "Halfway", "sh0": "Halfway"}
