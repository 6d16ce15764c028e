"""Environment variables that torch and OpenMP read when they are loaded, and the cores that there are."""

import os
import sys

DEFAULTS = {
    # Idle OpenMP threads otherwise spin: as soon as anything else runs on the machine, the threads that have work
    # wait for cores that idle ones occupy, and a step takes several times as long.
    "OMP_WAIT_POLICY": "passive",
    # Allocate large tensors in huge pages: a step of 100k splats takes 3 % less time, one of 500k splats 4 %.
    "THP_MEM_ALLOC_ENABLE": "1",
    # Ask the driver whether there is a GPU: torch's own way would start CUDA, and a notebook could not fork any more.
    "PYTORCH_NVML_BASED_CUDA_CHECK": "1",
}
if sys.platform == "darwin":
    # The wheels of torch and of pycolmap each bring an OpenMP, the second of which would abort the process.
    DEFAULTS["KMP_DUPLICATE_LIB_OK"] = "TRUE"
if sys.platform == "linux":
    # Splats grow, and with them every tensor: blocks of the old size would lie idle in a GPU's memory.
    DEFAULTS["PYTORCH_ALLOC_CONF"] = "expandable_segments:True"

# Names under which a user may have set the same.
_OTHER_ALLOC_CONF = {"PYTORCH_CUDA_ALLOC_CONF", "PYTORCH_HIP_ALLOC_CONF"}

# Whether idle threads spin because torch was loaded before :func:`set_defaults`.
came_late = False


def set_defaults() -> None:
    """Set the variables that the user has not set; too late in a process that has already loaded torch."""
    global came_late
    came_late = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ
    for name, value in DEFAULTS.items():
        if name != "PYTORCH_ALLOC_CONF" or not _OTHER_ALLOC_CONF & os.environ.keys():
            os.environ.setdefault(name, value)


def usable_cores() -> int:
    """Cores this process may run on, which containers and ``taskset`` make fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
