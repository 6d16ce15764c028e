"""How many splats photos support, and how many fit into a number of bytes."""

import math
from collections.abc import Mapping, Sequence

from nsvq_lightning.io.nsvq.precision import Precision
from nsvq_lightning.splats.attributes import ATTRIBUTES, QUANTIZABLE, attribute_dims

# A scene of fewer splats is no scene.
LEAST = 1000


def splats_for_photos(photos: int, detail: float, quality: float = 1.0) -> int:
    """A default for the number of splats: quality · 0.165 · ∛photos · detail.

    Detail asks for splats; more photos of it show more of its sides, and support more without fitting the noise.

    Args:
        photos: Number of train photos.
        detail: Detailed pixels of a photo (:func:`nsvq_lightning.data.scene.detailed_pixels`).
        quality: Factor.
    """
    return max(LEAST, round(quality * 0.165 * math.cbrt(photos) * detail))


def splats_for_bytes(
    size: int,
    codebooks: Mapping[str, Sequence[int]],
    sh_degree: int,
    precision: Precision | None = None,
    strength: float = 0.0,
) -> int:
    """Number of splats in a file of level ``compact``, within a tenth; a fifth where codes are chosen by their rate.

    Args:
        size: Bytes of the file.
        codebooks: Codes and dimension of each codebook by attribute.
        sh_degree: Of the splats.
        precision: Largest errors of the file.
        strength: Of the choice of codes by rate and distortion.

    Raises:
        ValueError: There is no room for splats beside the codebooks.
    """
    usual, precision = Precision(), precision or Precision()
    position, opacity = precision.position / usual.position, precision.opacity / usual.opacity
    fixed = 8 * 2048.0  # the header
    # Position and opacity of a splat take 22 to 25 bits on the measured scenes.
    bits = 23.5 - 3 * math.log2(position) - math.log2(opacity)
    # What remains of codes and codebooks where codes are chosen by rate and distortion, as measured.
    coded = 1 / (1 + 0.28 * strength)
    for name in QUANTIZABLE:
        if name in codebooks:
            codes, dim = codebooks[name]
            fixed += coded * codes * dim * ATTRIBUTES[name].code_bits
            bits += coded * (math.log2(codes) + ATTRIBUTES[name].row_bits)
        else:
            bits += 32 * attribute_dims(sh_degree)[name]
    splats = int((8 * size - fixed) / bits)
    if splats < LEAST:
        raise ValueError(
            f"{size} bytes leave room for {max(splats, 0)} splats beside codebooks of {round(fixed / 8)} bytes; allow "
            "more, or take smaller codebooks (--model.codebooks=0.5k)"
        )
    return splats
