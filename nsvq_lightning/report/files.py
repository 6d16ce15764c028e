"""The numbers of a report, ``metrics.json``, and its curve, ``curve.png``."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.compression.stored import formula_bytes
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.header import read_header
from nsvq_lightning.io.nsvq.paper import paper_header
from nsvq_lightning.io.ply import plain_ply_bytes
from nsvq_lightning.report.evaluation import ViewScore
from nsvq_lightning.report.figures import new_figure, write_figure
from nsvq_lightning.training.resume import ResumedModule
from nsvq_lightning.training.schedule import Phase, Schedule

PHASE_COLOURS = {Phase.WARMUP: "#dfe8f5", Phase.PRUNE: "#f8e6d0", Phase.QUANTIZE: "#dcefdc", Phase.FINETUNE: "#efe0f0"}


def summarize(
    path: Path,
    scene: CompressedScene,
    scores: Sequence[ViewScore],
    lpips: tuple[float | None, str | None],
    module: ResumedModule,
    paper: Mapping[str, Any],
) -> dict[str, Any]:
    """The content of ``metrics.json``; sizes in bytes, PSNR in dB, times in seconds.

    Args:
        path: The file that was decoded.
        scene: The decoded scene.
        scores: Score of each test view.
        lpips: Mean LPIPS and None, or None and the reason.
        module: The module, for its history and schedule.
        paper: :func:`paper_level` of the scene that was stored.
    """

    def mean(name: str) -> float:
        return float(sum(getattr(score, name) for score in scores)) / len(scores)

    file_bytes, header = path.stat().st_size, read_header(path)
    plain_bytes = plain_ply_bytes(len(scene), scene.sh_degree)
    last = {str(entry["phase"]): dict(entry) for entry in module.history}  # the last evaluation of each phase
    ends = [last[phase.name.lower()] for phase in Phase if phase.name.lower() in last]
    return {
        "psnr": mean("psnr"),
        "ssim": mean("ssim"),
        "cc_psnr": mean("cc_psnr"),
        "cc_ssim": mean("cc_ssim"),
        "lpips": lpips[0],
        "lpips_reason": lpips[1],
        "views": len(scores),
        "num_splats": len(scene),
        "file_bytes": file_bytes,
        "plain_bytes": plain_bytes,
        "ratio": plain_bytes / file_bytes,
        "level": header.level,
        "streams": {"header": header.size, **{stream.name: stream.length for stream in header.streams}},
        "codes": {name: _codes_in_use(codes, len(scene.codebooks[name])) for name, codes in scene.codes.items()},
        "paper_level": dict(paper),
        "train_seconds": module.stopwatch.seconds,
        "before_quantization": last.get(Phase.PRUNE.name.lower()) if scene.codebooks else None,
        "phases": ends,
    }


def paper_level(scene: CompressedScene) -> dict[str, Any]:
    """Bytes of the scene at level ``paper``, and by the paper's formula."""
    header = paper_header(scene)
    formula = formula_bytes(scene, header.size)
    return {
        "file_bytes": header.file_bytes,
        "header_bytes": header.size,
        "matches_formula": formula == header.file_bytes,
    }


def write_metrics(path: Path, metrics: Mapping[str, Any]) -> None:
    """Write the numbers as JSON, atomically; an infinite PSNR (no error at all) becomes null."""
    write_text(path, json.dumps(_json_value(metrics), indent=2, allow_nan=False) + "\n")


def write_curve(path: Path, history: Sequence[Mapping[str, Any]], schedule: Schedule) -> None:
    """Plot PSNR and number of splats over the iterations, with phases shaded, atomically."""
    figure = new_figure(8, 4)
    quality = figure.add_subplot()
    count = quality.twinx()
    iterations = [entry["iteration"] for entry in history]
    start = 0
    for phase, end in zip(Phase, schedule.ends, strict=True):
        if end > start:
            quality.axvspan(start, end, color=PHASE_COLOURS[phase], label=phase.name.lower(), linewidth=0)
        start = end
    quality.plot(iterations, [entry["psnr"] for entry in history], "o-", color="#1f4e9c", markersize=3)
    count.plot(iterations, [entry["splats"] for entry in history], "-", color="#b5651d")
    quality.set(xlabel="iteration", xlim=(0, max(schedule.ends[-1], 1)))
    quality.set_ylabel("test PSNR, dB", color="#1f4e9c")
    count.set_ylabel("splats", color="#b5651d")
    count.set_ylim(bottom=0)
    quality.legend(loc="lower right", fontsize="small")
    write_figure(path, figure)


def _codes_in_use(codes: NDArray[np.integer], size: int) -> dict[str, Any]:
    """Rows of the codebook, how many of them are used, and the entropy of the codes, bits each."""
    counts = np.bincount(codes, minlength=size)
    shares = counts[counts > 0] / max(1, len(codes))
    return {"codebook": size, "used": len(shares), "entropy": float(-(shares * np.log2(shares)).sum()) + 0.0}


def _json_value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
