"""Counter-based randomness: every draw is a function of (seed, step, salts), never of the order of calls.

The global generators of torch, NumPy and Python are not used anywhere in this package, so results depend neither on
the number of threads, nor on the number of processes, nor on whether a run was interrupted and resumed.
"""

import hashlib

import torch


def derive_seed(seed: int, step: int = 0, *salts: int | str) -> int:
    """Mix a seed, a step and any salts into 63 bits (SHA-256: neighbouring inputs give unrelated outputs).

    Args:
        seed: Seed of the run.
        step: Iteration the draw belongs to.
        salts: What the draw is for, for example ``"noise"``, an attribute's name, a rank.

    Returns:
        An integer in ``[0, 2**63)``.
    """
    key = "/".join(str(part) for part in (seed, step, *salts))
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "little") >> 1


def generator(seed: int, step: int = 0, *salts: int | str, device: torch.device | str = "cpu") -> torch.Generator:
    """A fresh ``torch.Generator`` for one draw, see :func:`derive_seed`."""
    return torch.Generator(device=device).manual_seed(derive_seed(seed, step, *salts))
