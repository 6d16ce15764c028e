"""The memory that a run takes, before it takes it."""

import re
from pathlib import Path

from nsvq_lightning.data.scene import Scene

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


def readable_bytes(count: float) -> str:
    """A number of bytes in readable form."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def available_memory() -> int | None:
    """Bytes that this process may still allocate: of the machine, or of its control group if less."""
    limits = [_machine_available(), _group_available()]
    return min((limit for limit in limits if limit is not None), default=None)


def _machine_available() -> int | None:
    try:
        found = re.search(r"^MemAvailable:\s+(\d+)", Path("/proc/meminfo").read_text(encoding="ascii"), re.MULTILINE)
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
