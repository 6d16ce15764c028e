"""The memory that a run takes, before it takes it."""

import logging
import re
from pathlib import Path

from lightning.pytorch import Trainer

from nsvq_lightning.data.scene import Scene
from nsvq_lightning.training.scene_access import scene_of

log = logging.getLogger(__name__)

# Default of ``--data.cache_bytes``.
CACHE_BYTES = 4 << 30


def run_bytes(scene: Scene, splats: int, cache_bytes: int = CACHE_BYTES) -> float:
    """Most memory that a run on a CPU takes.

    Args:
        scene: What it is trained on.
        splats: Most splats that it has at a time.
        cache_bytes: Memory for decoded photos.
    """
    base = 1.2e9  # Python, torch, Lightning, compiled kernels and evaluations
    a_splat = 59 * 4 * 6  # 59 float32, each with gradient, two moments, and copies while quantizing or editing
    a_pixel = 100  # buffers of the renderer, the loss and the picture itself
    pixels = max(camera.width * camera.height for camera in scene.cameras)
    return base + min(scene.images.nbytes, cache_bytes) + a_splat * splats + a_pixel * pixels


def say_footprint(trainer: Trainer, splats: int) -> None:
    """Log how much memory a run of at most so many splats will take; warn if the machine has not got it."""
    scene = scene_of(trainer)
    if scene is None:
        return
    needed = run_bytes(scene, splats, getattr(trainer.datamodule, "cache_bytes", CACHE_BYTES))  # type: ignore[attr-defined]
    free, own = available_memory(), _resident()
    said = f"memory: at most about {readable_bytes(needed)} with up to {splats:,} splats"
    if free is None or needed <= free + own:
        log.info(said)
    else:
        log.warning(
            f"{said}, but only {readable_bytes(free + own)} are available: ask for fewer (--quality, --splats), or "
            "lower --data.max_width or --data.cache_bytes"
        )


def readable_bytes(count: float) -> str:
    """A number of bytes in readable form."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def available_memory() -> int | None:
    """Bytes that this process may still allocate: of the machine, or of its control group if less."""
    limits = [_kilobytes("/proc/meminfo", "MemAvailable"), _group_available()]
    return min((limit for limit in limits if limit is not None), default=None)


def _resident() -> int:
    """Bytes that this process occupies already."""
    return _kilobytes("/proc/self/status", "VmRSS") or 0


def _kilobytes(table: str, name: str) -> int | None:
    """An entry of a table of the system, in bytes; None where there is none."""
    try:
        found = re.search(rf"^{name}:\s+(\d+)", Path(table).read_text(encoding="ascii"), re.MULTILINE)
    except OSError:
        return None
    return 1024 * int(found[1]) if found else None


def _group_available() -> int | None:
    """What the container may still allocate; its usage includes page cache, which is reclaimable."""
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = ((group / name).read_text(encoding="ascii").strip() for name in ("memory.max", "memory.current"))
        return None if limit == "max" else max(0, int(limit) - int(used))
    except (OSError, ValueError):
        return None
