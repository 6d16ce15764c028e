"""Vector quantization of splat attributes."""

from nsvq_lightning.quantize.attributes import QUANTIZED, QuantizedAttribute, codebook_sizes
from nsvq_lightning.quantize.base import Quantizer
from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.quantize.nearest import nearest, nearest_reference
from nsvq_lightning.quantize.nsvq import NSVQ

__all__ = [
    "NSVQ",
    "QUANTIZED",
    "CodebookQuantizer",
    "QuantizedAttribute",
    "Quantizer",
    "codebook_sizes",
    "kmeans",
    "nearest",
    "nearest_reference",
]
