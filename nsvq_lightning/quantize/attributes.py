"""The vector-quantized attributes of a splat, and how many codes the paper gives each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from torch import Tensor

__all__ = ["QUANTIZED", "QuantizedAttribute", "check_attributes", "codebook_sizes"]


@dataclass(frozen=True)
class QuantizedAttribute:
    """One quantized attribute: its name in :class:`nsvq_lightning.Splats` and the shape of a row.

    Attributes:
        name: Name of the raw attribute.
        code_share: Number of codes relative to that for scales (paper, section 4: Ks = Kr = 4·Kc = 4·Ksh).
    """

    name: str
    code_share: float

    def rows(self, tensor: Tensor) -> Tensor:
        """The attribute ``[N, ...]`` as rows ``[N, D]``, one vector per splat (a view where possible)."""
        return tensor.reshape(tensor.shape[0], tensor.shape[1:].numel())

    def unrows(self, rows: Tensor, like: Tensor) -> Tensor:
        """Rows ``[V, D]`` in the shape of the attribute ``like [N, ...]``: ``[V, ...]``.

        Raises:
            ValueError: A row does not have as many elements as one splat of ``like``.
        """
        if rows.dim() != 2 or rows.shape[1] != like.shape[1:].numel():
            raise ValueError(
                f"{self.name}: rows must have shape [V, {like.shape[1:].numel()}] to become [V, "
                f"{', '.join(map(str, like.shape[1:]))}], got {list(rows.shape)}"
            )
        return rows.reshape(rows.shape[0], *like.shape[1:])


QUANTIZED = {
    attribute.name: attribute
    for attribute in (
        QuantizedAttribute("scales", 1.0),
        QuantizedAttribute("quats", 1.0),
        QuantizedAttribute("sh0", 0.25),
        QuantizedAttribute("shN", 0.25),
    )
}
"""The quantized attributes by name. Positions and opacities are not vector quantized."""


def check_attributes(name: str, attributes: Iterable[str]) -> None:
    """Refuse the argument ``name`` if one of its attributes is not vector quantized.

    Raises:
        ValueError: One is not.
    """
    if not set(attributes) <= set(QUANTIZED):
        raise ValueError(f"{name} must be among {', '.join(QUANTIZED)}, got {', '.join(attributes)}")


def codebook_sizes(name: str) -> dict[str, int]:
    """Number of codes for each attribute in one of the paper's settings.

    Args:
        name: ``"0.5k"``, ``"1k"``, ``"2k"``, ``"4k"``, ``"8k"``, ``"16k"``: codes for scales and rotations in units of
            1024; colours and SH have a quarter as many.

    Returns:
        Attribute name to number of codes; ``codebook_sizes("16k")["shN"]`` is 4096.

    Raises:
        ValueError: The name is unknown.
    """
    settings = {"0.5k": 512, "1k": 1024, "2k": 2048, "4k": 4096, "8k": 8192, "16k": 16384}
    if name not in settings:
        raise ValueError(f"unknown codebook setting {name!r}; choose one of {', '.join(settings)}")
    return {attribute.name: int(settings[name] * attribute.code_share) for attribute in QUANTIZED.values()}
