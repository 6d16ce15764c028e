"""Vector quantization of splat attributes."""

from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.quantize.codebook import CodebookQuantizer, Quantizer
from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.quantize.nearest import nearest, nearest_reference
from nsvq_lightning.quantize.nsvq import NSVQ, DiVeQ
from nsvq_lightning.quantize.straight_through import PostHoc, StraightThrough, TrainedStraightThrough
from nsvq_lightning.splats.attributes import QUANTIZED, codebook_sizes

__all__ = [
    "NSVQ",
    "QUANTIZED",
    "CodebookQuantizer",
    "DiVeQ",
    "PostHoc",
    "Quantizer",
    "StraightThrough",
    "TrainedStraightThrough",
    "codebook_sizes",
    "kmeans",
    "nearest",
    "nearest_reference",
    "take_rows",
]
