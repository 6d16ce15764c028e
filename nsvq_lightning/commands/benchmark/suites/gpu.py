"""The back-ends of a GPU side by side, beside the limit of its memory, and a training step of each phase on it.

Times are those between two events in the GPU's stream. No render can be faster than its memory gives and takes what it
must read and write once: ``share of memory limit %`` is that time, at the speed of a plain copy, as a share of the
measured one. What a back-end reads again, sorts or keeps for the backward pass is not in the limit.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

import torch

from nsvq_lightning.commands.benchmark.fitting import Step
from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.sizes import LARGE, STANDARD
from nsvq_lightning.commands.benchmark.suite_list import Unavailable
from nsvq_lightning.commands.benchmark.suites.render import (
    BOTH,
    FORWARD,
    ORACLE_PAIRS,
    Method,
    case_of,
    crop_for_oracle,
    crop_note,
    leaves_of,
    method_errors,
)
from nsvq_lightning.commands.benchmark.timing import Case, finish, measure, milliseconds, sgemm, use_threads
from nsvq_lightning.commands.benchmark.trainees import Trainee, trainee
from nsvq_lightning.commands.benchmark.workloads import Workload, synthetic_workload, workloads
from nsvq_lightning.data.scene import View
from nsvq_lightning.rendering.rasterize import fast_backends, resolve_backend, visible
from nsvq_lightning.training.schedule import Phase

__all__ = ["copy_speed", "least_bytes", "run", "run_on"]

log = logging.getLogger(__name__)

COMPARED = ("cuda",)
"""Back-ends whose absence is reported with its reason."""
COPIED = 2**28
"""Bytes of the copy that says how fast the memory is: more than any cache holds."""
COPIES = 5
FLOAT = 4
"""Bytes of a number."""
WARM_STEPS, STEPS = {True: 6, False: 60}, {True: 8, False: 200}
"""Steps that are not counted, and those that are: searches that remember need some to have something to."""
TOGETHER = {True: 2, False: 10}
"""Steps that are timed as one."""


def run(scope: Scope) -> list[Measurement]:
    """Measure on the first CUDA device.

    Raises:
        Unavailable: There is none, or no back-end for it.
    """
    if not torch.cuda.is_available():
        raise Unavailable("torch finds no CUDA device (nsvq doctor says why)")
    device = torch.device("cuda")
    for name in COMPARED:
        try:
            resolve_backend(name, torch.zeros(1, device=device))
        except ValueError as reason:
            log.warning("gpu: left out: %s", reason)
    return run_on(device, scope)


def run_on(device: torch.device, scope: Scope) -> list[Measurement]:
    """Measure every fast back-end that a device has.

    Raises:
        Unavailable: There is none.
    """
    names = fast_backends(torch.zeros(1, device=device))
    if not names:
        raise Unavailable(f"no fast back-end renders on {device}: pip install triton")
    with use_threads(max(scope.threads)):
        speed = copy_speed(device)
        rows: list[Measurement] = []
        for workload in _workloads(scope):
            rows += _render_rows(workload.to(device), names, speed, scope)
        return [*rows, *_step_rows(device, names, scope)]


def _workloads(scope: Scope) -> Iterator[Workload]:
    """What the user names; the standard scenes are followed, one at a time, by those that are too much for a CPU."""
    yield from workloads(scope)
    if scope.scene is None and scope.workloads == STANDARD:
        yield from map(synthetic_workload, LARGE)


# Renders


def _render_rows(workload: Workload, names: Sequence[str], speed: float, scope: Scope) -> list[Measurement]:
    device, methods = workload.splats.means.device, [Method(name) for name in names]
    crop = crop_for_oracle(workload, ORACLE_PAIRS[scope.quick])
    errors, note = method_errors(crop, methods), crop_note(crop, workload)
    seen = len(visible(workload.splats, workload.camera, backend=names[0]))
    keys, leaves = [(method, operation) for method in methods for operation in (FORWARD, BOTH)], leaves_of(workload)
    cases = [case_of(workload, leaves, *key) for key in keys]
    threads = max(scope.threads)
    timings = measure(cases, scope, threads, device).values()
    rows = []
    for (method, operation), case, timing in zip(keys, cases, timings, strict=True):
        limit = 1000 * least_bytes(workload, seen, backward=operation == BOTH) / speed
        values = {**errors[method, operation], "share of memory limit %": 100 * limit / timing.median}
        values.update(_peak_memory(case, device))
        rows.append(Measurement("gpu", str(workload), str(method), operation, threads, timing, values, note))
    return rows


def least_bytes(workload: Workload, seen: int, *, backward: bool) -> int:
    """Bytes that a render must read and write, each once.

    Forward: position, rotation, scale and opacity of all splats, colours of those seen, image, alpha and depth.
    Backward besides: all attributes of those seen, the gradient of the image, and that of every attribute.

    Args:
        workload: What is rendered.
        seen: Splats that can change the image.
        backward: Whether the backward pass is in it.
    """
    splats, camera = workload.splats, workload.camera
    count, pixels = len(splats.means), camera.width * camera.height
    geometry = sum(tensor[:1].numel() for tensor in splats[:4])
    color = sum(tensor[:1].numel() for tensor in splats[4:])
    numbers = geometry * count + color * seen + 5 * pixels
    if backward:
        numbers += (geometry + color) * (seen + count) + 3 * pixels
    return FLOAT * numbers


def copy_speed(device: torch.device) -> float:
    """Bytes a second that the memory of a device gives and takes: each byte of a copy is read and written."""
    source = torch.zeros(COPIED, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    case = Case("copy", lambda: target.copy_(source))
    return 1000 * 2 * COPIED / min(milliseconds(case, device) for _ in range(COPIES))


def _peak_memory(case: Case, device: torch.device) -> dict[str, float]:
    """Megabytes that a call needs on top of what is there; nothing on a CPU, where torch does not count."""
    if device.type != "cuda":
        return {}
    finish()
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    case.run()
    return {"peak MB": (torch.cuda.max_memory_allocated(device) - before) / 1e6}


# Training steps


def _step_rows(device: torch.device, names: Sequence[str], scope: Scope) -> list[Measurement]:
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
        subject = trainee(scope, Path(folder), "C500k")
        rows = []
        for phase in Phase:
            for name in names:
                timing = _steps(subject, phase, name, device, scope)
                values = {"steps a second": 1000 / median(timing.samples)}
                operation, threads = f"{phase.name.lower()} step", max(scope.threads)
                note = "whole steps by the clock, Lightning included"
                rows.append(Measurement("gpu", subject.name, name, operation, threads, timing, values, note))
        return rows


def _steps(subject: Trainee, phase: Phase, backend: str, device: torch.device, scope: Scope) -> Timing:
    """Steps of one phase with one back-end; some together are followed by a matrix product."""
    steps: list[float] = []
    products: list[float] = []
    product = sgemm(device)

    def between(_: object, __: View, step: Step) -> None:
        if step.iteration > WARM_STEPS[scope.quick]:
            steps.append(step.milliseconds)
            products.append(milliseconds(product, device))

    count = WARM_STEPS[scope.quick] + STEPS[scope.quick]
    together = TOGETHER[scope.quick]
    subject.train(phase, count, between, device.type, together, codebooks=scope.codebooks, backend=backend)
    return Timing(tuple(steps), tuple(products))
