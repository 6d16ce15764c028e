"""Independent tasks side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

__all__ = ["all_of"]

_T = TypeVar("_T")


def all_of(tasks: Mapping[str, Callable[[], _T]]) -> dict[str, _T]:
    """Results of independent tasks, run in as many threads as torch uses; the kernels release the GIL."""
    with ThreadPoolExecutor(max_workers=torch.get_num_threads()) as pool:
        futures = {name: pool.submit(task) for name, task in tasks.items()}
        return {name: future.result() for name, future in futures.items()}
