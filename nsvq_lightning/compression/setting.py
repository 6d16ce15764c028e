"""How a scene is compressed, and what some bytes have room for; it needs no torch."""

from dataclasses import dataclass

from nsvq_lightning.splats.attributes import ATTRIBUTES, SIZES, attribute_dims, codebook_bits, codebook_sizes


@dataclass(frozen=True)
class Setting:
    """How a scene is compressed.

    Attributes:
        splats: How many are left.
        codebooks: The paper's name of their sizes, or "none".
        step: Of spherical harmonics on a basis (:func:`nsvq_lightning.compression.stored.components`), without
            codebooks; 0 stores them as the others.
        kept: Share of these that are stored.
        more: Codes of spherical harmonics beyond those of the size.
    """

    splats: int
    codebooks: str
    step: float = 0.0
    kept: float = 1.0
    more: int = 0


# Steps of spherical harmonics on a basis.
STEPS = (0.2, 1.6)
# Bits a splat from which on they are on a basis, without any codebooks.
ON_BASIS = 125
# Bits of a splat's position and opacity, about.
PLACE = 22.0
# Rather than keep fewer splats than this share, a file takes smaller codebooks.
SHARE = 0.7
# It has at least so many splats, if there are as many.
MIN_SPLATS = 100


def setting_for(size: int, most: int, sh_degree: int) -> Setting:
    """The setting that ``size`` bytes have room for, about, with at most ``most`` splats.

    Raises:
        ValueError: There is none.
    """
    if 8 * size >= ON_BASIS * most:
        return Setting(most, "none", STEPS[0] if sh_degree else 0.0)
    dims = attribute_dims(sh_degree)
    for name in SIZES:
        sizes = {each: (codes, dims[each]) for each, codes in codebook_sizes(name).items() if dims[each]}
        fixed, bits = codebook_bits(sizes)
        room = int((8 * size - fixed) / (PLACE + bits))
        if room >= SHARE * most:
            break
    if room < min(MIN_SPLATS, most):
        raise ValueError(f"{size} bytes leave room for {max(room, 0)} of {most} splats beside codebooks: allow more")
    codes, dim = sizes.get("shN", (0, 1))
    spare = max(0.0, 8 * size - fixed - most * (PLACE + bits))
    bits_a_code = dim * ATTRIBUTES["shN"].code_bits
    more = min(spare / bits_a_code, codes, most / 8)
    return Setting(min(most, room), name, more=int(more))
