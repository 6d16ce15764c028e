"""Spherical harmonics as whole multiples of a basis of few rows, chosen by weighted error and bits."""

import math

import torch
from torch import Tensor

from nsvq_lightning.splats.conventions import Float32s


@torch.no_grad()
def components(rows: Tensor, weights: Tensor, step: float) -> tuple[Float32s, Float32s]:
    """Coefficients and a basis of rows x, chosen by weighted error and bits.

    The basis are the principal axes of the rows, weighted, times a step. Of each row, the coefficients c have the least
    w·‖x − c·B‖² + :data:`PRICE` · step² · bits: one that hardly shows is cheap, and has few. The bits of a coefficient
    are −log2 of how often it has that value.

    Args:
        rows: ``[N, D]``, N > 0.
        weights: How much each row shows ``[N]``, not negative.
        step: In units of the root mean square of the numbers in the rows, weighted; above 0.

    Returns:
        Whole numbers ``[N, C]`` and the basis ``[C, D]``, C ≥ 1, float32.
    """
    weights = weights.double()
    weights = weights / weights.mean().clamp_min(torch.finfo(torch.float64).tiny)
    wide = rows.double()
    spread = (wide * weights[:, None]).T @ wide
    axes = torch.linalg.eigh(spread)[1].flip(1).T
    size = step * math.sqrt(float(spread.trace()) / rows.numel()) or 1.0
    unit = 2.0 ** round(math.log2(size / FINENESS))
    basis = (axes * (size / unit)).round() * unit
    # What each coefficient would be.
    places = (wide @ axes.T / size).float().clamp_(-MAX_COEFFICIENT, MAX_COEFFICIENT)
    worth = weights.float() / PRICE
    chosen = places.round()
    for _ in range(ROUNDS):
        for column in range(rows.shape[1]):
            chosen[:, column] = _cheapest(places[:, column], chosen[:, column], worth)
    used = chosen.any(0)
    used[0] = True
    return chosen[:, used].numpy(), basis[used].float().numpy()


# Numbers in the basis are whole multiples of 1/2048 of a step, about: so decoders multiply integers.
FINENESS = 2048
# What a bit costs in squared steps, for a row of mean weight. On fox, 0.2 lost 0.05 dB more at equal bits, 0.4 0.15 dB.
PRICE = 0.1
# Largest coefficient.
MAX_COEFFICIENT = 4095.0
# Times that bits are counted anew for those chosen.
ROUNDS = 3


def _cheapest(places: Tensor, before: Tensor, worth: Tensor) -> Tensor:
    """The values ``[N]`` with the least worth · squared distance to ``places`` + bits, if all others stay as before."""
    nearest = places.round()
    if not nearest.any():
        return nearest
    largest = int(torch.maximum(nearest.abs(), before.abs()).max())
    counts = torch.bincount((before + largest).long(), minlength=2 * largest + 1)
    bits = math.log2(len(places) + 1) - (counts + 0.5).log2()
    choices = torch.stack([nearest, nearest - nearest.sign(), torch.zeros_like(nearest)])
    costs = worth * (places - choices).square() + bits[(choices + largest).long()]
    return choices.gather(0, costs.argmin(0, keepdim=True))[0]
