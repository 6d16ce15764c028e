from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
import torch

import nsvq_lightning
from nsvq_lightning.commands.benchmark import stopwatches
from nsvq_lightning.commands.benchmark.stopwatches import Own, Recorder, RecordingProfiler, timed_functions
from nsvq_lightning.commands.benchmark.workloads import synthetic_workload
from nsvq_lightning.rendering import rasterize
from nsvq_lightning.rendering.cpu import blend, rasterizer


@pytest.fixture
def wait(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """``wait(seconds)`` moves the clock that is read."""
    now = [100.0]

    def pass_by(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(stopwatches.time, "perf_counter", lambda: now[0])
    return pass_by


def test_time_belongs_to_the_innermost(wait: Callable[[float], None]) -> None:
    recorder = Recorder()
    inner = recorder.timed("inner", lambda: wait(3))

    def both() -> str:
        wait(1)
        inner()
        wait(0.5)
        inner()
        return "done"

    assert recorder.timed("outer", both)() == "done"
    assert recorder.take() == {"outer": Own(1.5, 1), "inner": Own(6, 2)}
    assert recorder.take() == {}


def test_what_is_still_open_is_counted_when_it_ends(wait: Callable[[float], None]) -> None:
    recorder = Recorder()
    profiler = RecordingProfiler(recorder)
    with profiler.profile("epoch"):
        wait(1)
        with profiler.profile("step"):
            wait(2)
        assert recorder.take() == {"step": Own(2, 1)}
        wait(4)
    assert recorder.take() == {"epoch": Own(5, 1)}


def test_failed_calls_are_closed(wait: Callable[[float], None]) -> None:
    recorder = Recorder()

    def fail() -> None:
        wait(2)
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        recorder.timed("outer", recorder.timed("inner", fail))()
    assert recorder.take() == {"outer": Own(0, 1), "inner": Own(2, 1)}


def test_other_threads_are_not_in_the_time(wait: Callable[[float], None]) -> None:
    recorder = Recorder()
    call = recorder.timed("work", lambda: wait(1))
    worker = threading.Thread(target=call)
    worker.start()
    worker.join()
    assert recorder.take() == {}


def test_kernels_functions_and_methods_are_timed_and_put_back() -> None:
    workload = synthetic_workload("A20k").crop(32, 32)
    leaves = nsvq_lightning.splats.splats.RawSplats(*(tensor.clone().requires_grad_() for tensor in workload.splats))

    def image_and_gradient() -> tuple[torch.Tensor, torch.Tensor]:
        image = rasterize.render(leaves, workload.camera).image
        return image.detach(), torch.autograd.grad(image, leaves.means, workload.image_gradient)[0]

    expected = image_and_gradient()
    before = dict(vars(rasterizer)), rasterizer._Blend.__dict__["backward"], blend.blend, rasterize.render
    recorder = Recorder()
    with timed_functions(recorder):
        found = image_and_gradient()
        # Compiled helpers are part of kernels and stay what they are.
        assert rasterizer.blend is not before[2]
        assert all(
            not value.targetoptions.get("parallel") for value in vars(rasterizer).values() if _is_compiled(value)
        )
    own = recorder.take()
    root = "nsvq_lightning.rendering."
    for name in ("cpu.blend.blend", "cpu.blend.blend_backward", "cpu.rasterizer._Blend.backward", "rasterize.render"):
        assert own[root + name].calls == 1
        assert own[root + name].seconds > 0
    assert not any(".lanes." in name or ".jit." in name or ".benchmark." in name for name in own)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    after = dict(vars(rasterizer)), rasterizer._Blend.__dict__["backward"], blend.blend, rasterize.render
    assert all(a is b for a, b in zip(before[1:], after[1:], strict=True))
    assert before[0] == after[0]
    image_and_gradient()
    assert recorder.take() == {}


def _is_compiled(value: object) -> bool:
    return isinstance(value, stopwatches.Dispatcher)
