"""Which attributes are quantized, with which codebooks, and a scene whose rows are replaced by their codes."""

from collections.abc import Callable, Mapping

import torch
from torch import Generator, Tensor, nn

from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.quantize.codebook import Quantizer, as_quantizer, held_codes
from nsvq_lightning.splats.attributes import QUANTIZED, codebook_sizes
from nsvq_lightning.splats.splats import RawSplats, Splats


def build_quantizers(
    quantizer: Callable[[int, int], nn.Module], codebooks: str | Mapping[str, int] | None, splats: Splats
) -> dict[str, nn.Module]:
    """Quantizers by attribute, in the order of ``QUANTIZED``.

    Args:
        quantizer: Makes one from (number of codes, dimension).
        codebooks: The paper's name for the sizes, or number of codes by attribute, or None.
        splats: Gives the dimensions; without higher SH coefficients there is no quantizer for them.

    Raises:
        ValueError: A codebook is for an unknown attribute, or has no code.
        TypeError: What ``quantizer`` makes does not implement :class:`~nsvq_lightning.quantize.codebook.Quantizer`.
    """
    sizes = codebook_sizes(codebooks) if isinstance(codebooks, str) else dict(codebooks or {})
    if unknown := sorted(set(sizes) - set(QUANTIZED)):
        raise ValueError(f"codebooks: unknown attributes {', '.join(unknown)}; choose from {', '.join(QUANTIZED)}")
    built = {}
    for name in QUANTIZED:
        dim = getattr(splats, name).shape[1:].numel()
        if name not in sizes or dim == 0:
            continue
        if sizes[name] < 1:
            raise ValueError(f"codebooks: {name} needs at least 1 code, got {sizes[name]}")
        built[name] = made = quantizer(sizes[name], dim)
        codebook = as_quantizer(made).codebook
        if codebook.dtype != torch.float32 or codebook.shape[1:] != (dim,):
            found = f"{list(codebook.shape)} {codebook.dtype}"
            raise TypeError(f"{type(made).__name__}: the codebook of {name} must be [K, {dim}] float32, it is {found}")
    return built


def attribute_rows(splats: RawSplats, attribute: str) -> Tensor:
    """Rows ``[N, D]`` of a quantized attribute, one vector per splat, detached."""
    return getattr(splats, attribute).detach().flatten(1)  # type: ignore[no-any-return]


def codes_of(splats: RawSplats, attribute: str, quantizer: Quantizer) -> Tensor:
    """Codes ``[N]`` of an attribute: the frozen ones, those that are held, or the nearest ones now."""
    if (held := held_codes(quantizer, len(splats.means))) is not None:
        return held
    if len(quantizer.codes) == len(splats.means):
        return quantizer.codes
    return quantizer.encode(attribute_rows(splats, attribute))


def decoded(splats: RawSplats, quantizers: Mapping[str, Quantizer]) -> RawSplats:
    """Every quantized attribute replaced by its codebook rows; gradients reach codebooks, positions and opacities."""
    values = {
        name: quantizer.decode(codes_of(splats, name, quantizer)).reshape(getattr(splats, name).shape)
        for name, quantizer in quantizers.items()
    }
    return splats._replace(**values)


def noisy_rows(
    splats: RawSplats, rows: Tensor, quantizers: Mapping[str, Quantizer], noise: Callable[[str], Generator]
) -> RawSplats:
    """Some of the splats, their quantized attributes replaced by the training stand-in (paper, section 3.2).

    Args:
        splats: Raw attributes of ``N`` splats.
        rows: Which of them ``[V]``, int64, distinct.
        quantizers: Quantizer by attribute; each counts the codes it uses.
        noise: Generator for an attribute.

    Returns:
        ``V`` splats; gradients reach the chosen rows and the codebooks.
    """
    subset = {}
    for name, tensor in splats._asdict().items():
        if name not in quantizers:
            subset[name] = take_rows(tensor, rows)
            continue
        # Call the module, not its forward: hooks of user-made quantizers must run.
        quantized, _ = quantizers[name](tensor.flatten(1), noise(name), rows)  # type: ignore[operator]
        subset[name] = quantized.reshape(len(rows), *tensor.shape[1:])
    return RawSplats(**subset)
