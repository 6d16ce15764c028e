"""From a trained module to the scene that is written to disk."""

import logging
from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.quantize.attributes import attribute_rows, codes_of
from nsvq_lightning.quantize.codebook import Quantizer
from nsvq_lightning.splats.attributes import QUANTIZABLE, dropped, finite_rows
from nsvq_lightning.splats.splats import RawSplats, sh_degree_of

log = logging.getLogger(__name__)


@torch.no_grad()
def to_compressed(splats: RawSplats, quantizers: Mapping[str, Quantizer]) -> CompressedScene:
    """The scene as it is stored: codes and codebooks where there are quantizers, plain float32 elsewhere.

    Splats with non-finite values are left out with a warning.

    Args:
        splats: Raw attributes.
        quantizers: Quantizer by attribute; empty stores everything as it is.
    """
    # Check before quantizing: the code of a row with NaN would be finite.
    finite, culprits = finite_rows(splats._asdict())
    scene = CompressedScene(
        means=_numpy(splats.means),
        opacities=_numpy(splats.opacities),
        codes={name: _numpy(codes_of(splats, name, quantizer)) for name, quantizer in quantizers.items()},
        codebooks={name: _numpy(quantizer.codebook) for name, quantizer in quantizers.items()},
        raw={name: _numpy(attribute_rows(splats, name)) for name in QUANTIZABLE if name not in quantizers},
        sh_degree=sh_degree_of(splats.shN),
    )
    if not culprits:
        return scene
    log.warning(dropped(finite, culprits))
    return scene.take(_numpy(finite))


def _numpy(tensor: Tensor) -> NDArray[Any]:
    array: NDArray[Any] = tensor.detach().cpu().numpy()
    return array
