"""Counter-based randomness: every draw is a function of (seed, step, salts), never of the order of calls.

The global generators of torch, NumPy and Python are not used anywhere in this package, so results depend neither on
the number of threads, nor on the number of processes, nor on whether a run was interrupted and resumed.
"""

from hashlib import sha256

import torch
from torch import Generator, Tensor


def generator(seed: int, step: int = 0, *salts: int | str) -> Generator:
    """A fresh ``torch.Generator`` on the CPU for one draw.

    Its own seed is a mix of these in 63 bits (SHA-256: neighbouring inputs give unrelated outputs).

    Args:
        seed: Seed of the run.
        step: Iteration the draw belongs to.
        salts: What the draw is for, for example ``"noise"``, an attribute's name, a rank.
    """
    key = "/".join(map(str, (seed, step, *salts)))
    return Generator().manual_seed(int.from_bytes(sha256(key.encode()).digest()[:8], "little") >> 1)


def draw_rows(weight: Tensor, count: int, generator: Generator) -> Tensor:
    """Mask ``[N]`` of ``count`` rows drawn without replacement in proportion to their weight; never one of weight 0.

    The ``count`` largest of log weight + Gumbel noise are such a sample (Efraimidis and Spirakis 2006): one draw per
    row, whatever is chosen.

    Args:
        weight: Weight of each row ``[N]``, not negative; with fewer positive ones than ``count``, all those.
        count: How many to draw.
        generator: Source of the draws, on the CPU.
    """
    uniform = torch.rand(len(weight), generator=generator, dtype=torch.float64)
    tiny = torch.finfo(torch.float64).tiny
    key = weight.detach().cpu().double().log() - (-uniform.clamp_min(tiny).log()).clamp_min(tiny).log()
    return top_rows(key, min(max(count, 0), int((weight > 0).sum()))).to(weight.device)


def top_rows(values: Tensor, count: int) -> Tensor:
    """Mask ``[N]`` of the ``count`` rows with the largest values; ties go to the first.

    Args:
        values: Values ``[N]``.
        count: Number of rows, not negative; all if there are no more.
    """
    mask = torch.zeros_like(values, dtype=torch.bool)
    mask[values.argsort(descending=True, stable=True)[:count]] = True
    return mask
