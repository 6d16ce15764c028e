import pytest

from nsvq_lightning.quantize import QUANTIZED, codebook_sizes
from nsvq_lightning.splats.attributes import ATTRIBUTES, QUANTIZABLE, attribute_dims


def test_those_with_most_codes_come_first() -> None:
    dims = attribute_dims(3)
    assert list(QUANTIZED) == sorted(QUANTIZABLE, key=lambda name: (-ATTRIBUTES[name].code_share, dims[name]))


def test_paper_sizes() -> None:
    assert codebook_sizes("16k") == {"scales": 16384, "quats": 16384, "sh0": 4096, "shN": 4096}
    assert codebook_sizes("0.5k") == {"scales": 512, "quats": 512, "sh0": 128, "shN": 128}


def test_unknown_setting_names_the_choices() -> None:
    with pytest.raises(ValueError, match=r"'3k'.*16k.*0\.5k"):
        codebook_sizes("3k")
