"""The numbers of a run: scores of views, ``metrics.json``, and tables."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from csv import DictWriter
from io import StringIO
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.data.scene import View
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import Json
from nsvq_lightning.io.nsvq.header import Header, read_header
from nsvq_lightning.io.ply import plain_ply_bytes
from nsvq_lightning.quality.loss import apply_mask, ssim
from nsvq_lightning.quality.metrics import eight_bit, psnr
from nsvq_lightning.splats.conventions import Integers
from nsvq_lightning.splats.splats import SplatTensors
from nsvq_lightning.training.importance import Renderer
from nsvq_lightning.training.schedule import Phase

if TYPE_CHECKING:
    from nsvq_lightning.training.module import SplatModule  # imports Lightning

Values = Mapping[str, Any]
Rows = Sequence[Values]
# How many times smaller pictures are compared, too, by the name of their PSNR.
SMALLER = {"psnr_half": 2, "psnr_quarter": 4}


@torch.no_grad()
def evaluate(
    render: Renderer,
    splats: SplatTensors,
    views: Iterable[View],
    show: Callable[[Tensor, Tensor], None] | None = None,
    reduce: Callable[[Tensor], Tensor] = lambda sums: sums,
) -> tuple[float, float]:
    """Mean PSNR, dB, and SSIM of rendered views against their photos.

    Args:
        render: The rasterizer.
        splats: Raw attributes of what it renders.
        views: What to compare with.
        show: Called with the first image and its photo.
        reduce: Adds the sums of other processes, which have other views.

    Raises:
        ValueError: There are no views.
    """
    sums = splats.means.new_zeros(3, dtype=torch.float64)  # of PSNR, of SSIM, and of views
    for view in views:
        view = view.to(sums.device)
        image = apply_mask(render(splats, view.camera).image, view.mask)
        if show:
            show(image, view.image)
            show = None
        pair = eight_bit(image), eight_bit(view.image)
        sums += torch.stack([psnr(*pair, view.mask), ssim(*pair, view.mask).double(), sums.new_ones(())])
    sums = reduce(sums)
    if sums[2] == 0:
        raise ValueError("there are no views to evaluate; the scene needs at least one test view")
    mean_psnr, mean_ssim = (sums[:2] / sums[2]).float().tolist()
    return mean_psnr, mean_ssim


def summarize(
    path: Path, scene: CompressedScene, scores: Rows, lpips_reason: str | None, module: "SplatModule", paper: Header
) -> Json:
    """The content of ``metrics.json``; sizes in bytes, PSNR in dB, times in seconds.

    Args:
        path: The file that was decoded.
        scene: The decoded scene.
        scores: Row of each test view in ``views.csv``: its name, ``psnr``, ``ssim``, ``lpips``, those of
            :data:`SMALLER`, ``cc_psnr`` and ``cc_ssim``.
        lpips_reason: Why the rows have no ``lpips``; None where they have it.
        module: The module, for its history and schedule.
        paper: Header of the scene that was stored at level ``paper``, with the bytes of the paper's formula.
    """
    scored = "psnr", "ssim", *SMALLER, "cc_psnr", "cc_ssim"
    file_bytes = path.stat().st_size
    header = read_header(path)
    plain_bytes = plain_ply_bytes(len(scene), scene.sh_degree)
    last = {entry["phase"]: entry for entry in module.history}  # the last evaluation of each phase
    return {
        **{name: sum(score[name] for score in scores) / len(scores) for name in scored},
        "lpips": None if lpips_reason else fmean(score["lpips"] for score in scores),
        "lpips_reason": lpips_reason,
        "views": len(scores),
        "num_splats": len(scene),
        "file_bytes": file_bytes,
        "plain_bytes": plain_bytes,
        "ratio": plain_bytes / file_bytes,
        "level": header.level,
        "streams": {"header": header.size, **{stream.name: stream.length for stream in header.streams}},
        "codes": {name: _codes_in_use(codes, len(scene.codebooks[name])) for name, codes in scene.codes.items()},
        "paper_level": {"file_bytes": paper.file_bytes, "header_bytes": paper.size},
        "train_seconds": module.stopwatch.seconds,
        "before_quantization": last.get(Phase(Phase.QUANTIZE - 1).name.lower()) if scene.codebooks else None,
        "phases": list(last.values()),
    }


def write_metrics(path: Path, metrics: Values) -> None:
    """Write the numbers as JSON, atomically; an infinite PSNR (no error at all) becomes null."""
    finite = json.loads(json.dumps(metrics), parse_constant=lambda name: None)
    write_text(path, f"{json.dumps(finite, indent=2)}\n")


def _codes_in_use(codes: Integers, size: int) -> Json:
    """Rows of the codebook, how many of them are used, and the entropy of the codes, bits each."""
    from scipy import stats  # slow to import

    counts = np.unique_counts(codes).counts
    return {"codebook": size, "used": len(counts), "entropy": float(stats.entropy(counts, base=2))}


def write_csv(path: Path, rows: Rows) -> None:
    """Write rows with the same keys as CSV, atomically; the keys of the first row, in order, are the header."""
    text = StringIO()
    writer = DictWriter(text, fieldnames=rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())
