"""The gsplat back-end: against the oracle with a stand-in for gsplat, and with gsplat itself where there is a GPU."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import gsplat_standin
import oracle
import pytest
import torch
from oracle import run
from splat_scenes import front_camera, random_splats

from nsvq_lightning.commands.main import main
from nsvq_lightning.rendering.gsplat import support
from nsvq_lightning.rendering.rasterize import BACKENDS, fast_backends, render, resolve_backend, visible
from nsvq_lightning.splats.splats import RawSplats

assert_same = partial(oracle.assert_same, "gsplat", sees_more=True)
ADAPTER = "nsvq_lightning.rendering.gsplat.rasterizer"


@pytest.fixture
def standin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The stand-in in the place of gsplat, on tensors of the CPU."""
    sys.modules.pop(ADAPTER, None)
    monkeypatch.setitem(sys.modules, "gsplat", gsplat_standin)  # type: ignore[arg-type]
    monkeypatch.setattr(support, "obstacle", lambda like: None)
    monkeypatch.setattr(oracle, "DEVICES", {})
    yield
    sys.modules.pop(ADAPTER, None)


@pytest.mark.usefixtures("standin")
@pytest.mark.parametrize(("sh_degree", "stored"), [(0, 0), (1, 3), (3, 3)])
@pytest.mark.parametrize(("width", "height"), [(40, 28), (17, 3)])
def test_image_and_gradients_are_those_of_the_oracle(sh_degree: int, stored: int, width: int, height: int) -> None:
    splats, camera = random_splats(30, seed=2, sh_degree=stored), front_camera(width, height, cx=0.4 * width)
    assert_same(splats, camera, sh_degree=sh_degree, background=torch.tensor([0.2, 0.5, 0.9]))


@pytest.mark.usefixtures("standin")
def test_background_has_its_gradient() -> None:
    colour = torch.tensor([0.2, 0.5, 0.9], requires_grad=True)
    result = render(random_splats(12, seed=3), front_camera(16, 12), background=colour, backend="gsplat")
    result.image.sum().backward()
    torch.testing.assert_close(colour.grad, (1 - result.alpha.detach()).sum().expand(3))


@pytest.mark.usefixtures("standin")
def test_its_backward_pass_cannot_be_observed() -> None:
    with pytest.raises(ValueError, match="'gsplat' cannot observe its backward pass; use backend='auto'"):
        render(random_splats(12, seed=3), front_camera(16, 12), observe=torch.ones(12, 16), backend="gsplat")


@pytest.mark.usefixtures("standin")
def test_splats_behind_and_beside_the_camera() -> None:
    splats = random_splats(40, seed=8)
    means = splats.means.clone()
    means[:10, 2] -= 8
    means[10:20, 0] += 3
    means[20:24, 2] -= 3.75  # some of them between gsplat's near plane of 0.01 and ours
    splats, camera = splats._replace(means=means), front_camera(20, 16)
    assert_same(splats, camera)
    rows = visible(splats, camera, backend="gsplat").tolist()
    assert rows == render(splats, camera, backend="gsplat").radii.nonzero()[:, 0].tolist()
    assert set(visible(splats, camera, backend="reference").tolist()) <= set(rows)
    assert 0 < len(rows) < 30


@pytest.mark.usefixtures("standin")
def test_far_splats_are_drawn() -> None:
    splats, camera = random_splats(3, seed=1, log_scale=25.0), front_camera(9, 7)
    assert_same(splats._replace(means=camera.viewmat[2, :3] * 3e10 + splats.means * 1e9), camera)


@pytest.mark.usefixtures("standin")
def test_no_splat_in_view_is_background() -> None:
    splats, camera, background = random_splats(20), front_camera(20, 9), torch.tensor([0.1, 0.2, 0.3])
    behind = splats._replace(means=splats.means - torch.tensor([0.0, 0.0, 50.0]))
    result, gradients = run(behind, camera, "gsplat", torch.float32, background=background)
    assert torch.equal(result.image, background.expand_as(result.image))
    assert not result.means2d.any()
    assert all((gradient == 0).all() for gradient in gradients.values())


@pytest.mark.usefixtures("standin")
@pytest.mark.parametrize("attribute", ["means", "quats", "scales"])
def test_broken_splats_leave_the_rest_alone(attribute: str) -> None:
    splats, camera = random_splats(16, seed=10), front_camera(16, 12)
    broken = splats._replace(**{attribute: splats._asdict()[attribute].clone()})
    getattr(broken, attribute)[:2] = float("nan")
    result, gradients = run(broken, camera, "gsplat", torch.float32)
    rest, expected = run(RawSplats(*(tensor[2:] for tensor in splats)), camera, "gsplat", torch.float32)
    assert torch.equal(result.image, rest.image)
    assert not result.radii[:2].any()
    assert all(torch.equal(gradients[name][2:], gradient) for name, gradient in expected.items())


@pytest.mark.usefixtures("standin")
def test_very_opaque_splats_are_the_stated_difference() -> None:
    splats, camera = random_splats(8, seed=5, log_scale=0.5), front_camera(16, 12)
    splats = splats._replace(opacities=torch.full((8,), 20.0))
    result, expected = (render(splats, camera, backend=backend) for backend in ("gsplat", "reference"))
    difference = (result.alpha - expected.alpha).max()
    assert 0.001 < difference <= gsplat_standin.ALPHA_MAX - 0.99 + 1e-6


def test_auto_is_never_gsplat_and_never_imports_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gsplat.py").write_text("raise AssertionError('gsplat was imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    like = torch.zeros(1)
    assert "gsplat" in BACKENDS
    assert {resolve_backend("auto", like.to(dtype)) for dtype in (torch.float32, torch.float64)} == {"cpu", "reference"}
    assert fast_backends(like)[0] == "cpu"
    with pytest.raises(ValueError, match=r"'gsplat'.*float32 tensors on a CUDA device, got torch.float32 on cpu;"):
        resolve_backend("gsplat", like)


def test_error_without_gsplat_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(support, "not_on_cuda", lambda like: None)
    monkeypatch.setitem(sys.modules, "gsplat", None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"pip install 'nsvq-lightning\[gsplat\]', or use backend='auto'"):
        resolve_backend("gsplat", torch.zeros(1))


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("_C = None", "found no CUDA toolkit to compile it with; it needs nvcc"),
        ("raise RuntimeError('Error building\\nextension')", r"\(Error building extension\); it needs nvcc"),
        ("_C = object()", None),
    ],
)
def test_error_without_cuda_code_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, said: str | None
) -> None:
    (tmp_path / "gsplat" / "cuda").mkdir(parents=True)
    for path, text in (("__init__.py", ""), ("cuda/__init__.py", ""), ("cuda/_backend.py", code)):
        (tmp_path / "gsplat" / path).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(support, "not_on_cuda", lambda like: None)
    before = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "gsplat"}
    for name in before:
        monkeypatch.delitem(sys.modules, name)
    support.missing_kernels.cache_clear()
    try:
        if said is None:
            assert resolve_backend("gsplat", torch.zeros(1)) == "gsplat"
        else:
            with pytest.raises(ValueError, match=said):
                resolve_backend("gsplat", torch.zeros(1))
    finally:
        support.missing_kernels.cache_clear()
        for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend"):
            sys.modules.pop(name, None)


def test_option_of_the_command_line(
    make_scene: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["fit", "--config", "plain.yaml", f"--data.root={make_scene()}", "--model.backend=gsplat"]
    arguments += ["--trainer.accelerator=cpu", "--trainer.max_steps=4", f"--trainer.default_root_dir={tmp_path}"]
    assert main(arguments) == 1
    last = capsys.readouterr().err.strip().splitlines()[-2]
    assert last.startswith("error: backend 'gsplat' cannot be used: it renders float32 tensors on a CUDA device")


@pytest.mark.gpu
def test_gsplat_itself() -> None:
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    problem = support.obstacle(torch.zeros(1, device="cuda"))
    if problem is not None:
        pytest.skip(problem)
    camera, background = front_camera(70, 45, cx=20.3), torch.tensor([0.2, 0.5, 0.9])
    splats = random_splats(300, seed=8)
    splats = splats._replace(opacities=splats.opacities.clamp_max(4.0))  # below both caps
    for sh_degree in (0, 3):
        # gsplat is compiled with fast mathematics.
        assert_same(splats, camera, tolerance=1e-3, sh_degree=sh_degree, background=background)
    there = RawSplats(*(tensor.cuda() for tensor in splats))
    rows = visible(there, camera, backend="gsplat")
    assert torch.equal(rows, render(there, camera, backend="gsplat").radii.nonzero()[:, 0])
