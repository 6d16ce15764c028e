import pytest
import torch

from nsvq_lightning.quantize import QUANTIZED, codebook_sizes


def test_paper_sizes() -> None:
    assert codebook_sizes("16k") == {"scales": 16384, "quats": 16384, "sh0": 4096, "shN": 4096}
    assert codebook_sizes("0.5k") == {"scales": 512, "quats": 512, "sh0": 128, "shN": 128}


def test_unknown_setting_names_the_choices() -> None:
    with pytest.raises(ValueError, match=r"'3k'.*0\.5k.*16k"):
        codebook_sizes("3k")


@pytest.mark.parametrize(
    ("name", "shape"), [("scales", (3,)), ("quats", (4,)), ("sh0", (1, 3)), ("shN", (15, 3)), ("shN", (0, 3))]
)
@pytest.mark.parametrize("count", [0, 5])
def test_rows_and_back(name: str, shape: tuple[int, ...], count: int) -> None:
    tensor = torch.arange(count * torch.Size(shape).numel(), dtype=torch.float32).reshape(count, *shape)
    rows = QUANTIZED[name].rows(tensor)
    assert rows.shape == (count, torch.Size(shape).numel())
    assert torch.equal(QUANTIZED[name].unrows(rows, tensor), tensor)
    assert torch.equal(QUANTIZED[name].unrows(rows[1:3], tensor), tensor[1:3])


def test_unrows_refuses_other_rows() -> None:
    with pytest.raises(ValueError, match=r"shN.*\[V, 45\]"):
        QUANTIZED["shN"].unrows(torch.zeros(2, 44), torch.zeros(2, 15, 3))
