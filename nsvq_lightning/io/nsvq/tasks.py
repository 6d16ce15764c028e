"""Tasks side by side."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import torch

__all__ = ["workers"]


def workers() -> ThreadPoolExecutor:
    """A pool of as many threads as torch uses; they run side by side because the kernels release the GIL.

    Tasks begin in the order in which they were submitted.
    """
    return ThreadPoolExecutor(max_workers=torch.get_num_threads())
