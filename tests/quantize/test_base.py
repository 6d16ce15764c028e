"""What a quantizer lacks and what it offers, with members that only an nn.Module's ``__getattr__`` finds."""

import pytest
import torch

from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.quantize.base import as_quantizer


def test_what_a_quantizer_lacks_is_named() -> None:
    class NearlyOne(NSVQ):
        freeze = property()  # type: ignore[assignment]  # reading it raises AttributeError

    assert as_quantizer(quantizer := NSVQ(4, 3)) is quantizer
    with pytest.raises(TypeError, match=r"NearlyOne is not a quantizer; it lacks: freeze; derive it from"):
        as_quantizer(NearlyOne(4, 3))
    with pytest.raises(TypeError, match=r"lacks: codebook, codes, decode, encode, fit, forward, freeze"):
        as_quantizer(object())


def test_a_codebook_that_nothing_trains_is_refused() -> None:
    quantizer = NSVQ(4, 3)
    del quantizer.codebook
    quantizer.register_buffer("codebook", torch.zeros(4, 3))
    with pytest.raises(TypeError, match=r"codebook is an nn\.Parameter"):
        as_quantizer(quantizer)
