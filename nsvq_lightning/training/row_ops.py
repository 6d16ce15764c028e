"""The only code that adds, removes or replaces rows of the splats.

A splat is one row of six parameters, of their Adam moments and of every side table. All of them change together here:
new ``nn.Parameter`` objects are bound in the module, in their parameter group (found by its name) and in the state of
the optimiser. The step count of Adam belongs to the parameter, not to a row, and is kept.
"""

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from nsvq_lightning.splats.attributes import ATTRIBUTES, dropped, finite_rows, listed
from nsvq_lightning.splats.splats import RawSplats, Splats, check_shapes, times_vectors
from nsvq_lightning.top_level import log
from nsvq_lightning.training.optim import find_group

# Up to here (8e13 scene units) float32 holds the square of a splat's extent on the near plane of any camera; no view
# shows larger splats, so nothing would ever train or prune them.
MAX_LOG_SCALE = 32.0

# Means of gradients; other numbers of each row are of their squares.
FIRST_MOMENTS = ("exp_avg", "momentum_buffer")


def append_rows(splats: Splats, optimizer: Optimizer, new: RawSplats) -> None:
    """Add splats at the end; their Adam moments and side tables start at zero.

    Args:
        splats: The ``N`` splats to extend.
        optimizer: Optimiser with one group per attribute, named after it.
        new: Raw attributes of the ``M`` new ones.

    Raises:
        ValueError: The shapes of the attributes do not fit each other.
    """
    check_shapes(new._asdict())
    count = len(new.means)
    if count == 0:
        return
    values = (torch.cat([old, more.to(old)]) for old, more in zip(_one_by_one(splats), new, strict=True))
    _rebind(splats, optimizer, values, lambda rows: torch.cat([rows, rows.new_zeros(count, *rows.shape[1:])]))


def keep_rows(splats: Splats, optimizer: Optimizer, mask: Tensor) -> None:
    """Keep the splats where ``mask [N]`` (bool) is true, in their order, and drop the others.

    Raises:
        ValueError: The mask is not one boolean per splat.
    """
    if mask.dtype != torch.bool or mask.shape != (len(splats),):
        raise ValueError(f"mask must be [{len(splats)}] bool, got {list(mask.shape)} {mask.dtype}")
    rows = mask.nonzero()[:, 0]
    if len(rows) < len(splats):
        _rebind(splats, optimizer, (numbers[rows] for numbers in _one_by_one(splats)), lambda numbers: numbers[rows])


def replace_attribute(splats: Splats, name: str, values: Tensor) -> None:
    """Overwrite all rows of one attribute; the moments stay, see :func:`reset_moments`.

    Raises:
        ValueError: ``values`` has another shape than the attribute.
    """
    parameter = splats.attributes()[name]
    if values.shape != parameter.shape:
        raise ValueError(f"{name} must keep its shape {list(parameter.shape)}, got {list(values.shape)}")
    parameter.detach().copy_(values)


def change_coordinates(splats: Splats, optimizer: Optimizer, name: str, values: Tensor, maps: Tensor) -> None:
    """Overwrite all rows of one attribute with other coordinates of the same splats, and transform the moments.

    The mean of gradients becomes ``maps · mean``, that of their squares ``maps² · mean``, which is exact where a map
    only permutes and scales components, and otherwise assumes that they are uncorrelated.

    Args:
        splats: The ``N`` splats.
        optimizer: Their optimiser.
        name: The attribute, with rows of D columns.
        values: Its rows ``[N, D]`` in the new coordinates.
        maps: ``[N, D, D]``; maps a gradient with respect to the old coordinates to one with respect to the new.

    Raises:
        ValueError: The shape of ``values`` or ``maps`` does not fit the attribute.
    """
    if maps.shape != (*values.shape, values.shape[-1]):
        raise ValueError(f"maps of {name} must be {[*values.shape, values.shape[-1]]}, got {list(maps.shape)}")
    replace_attribute(splats, name, values)
    for key, moment in _moments(optimizer, name).items():
        moment.copy_(times_vectors(maps if key in FIRST_MOMENTS else maps.square(), moment))


def reset_moments(optimizer: Optimizer, name: str, rows: Tensor | None = None) -> None:
    """Set the Adam moments of the group ``name`` to zero, for all rows or for ``rows`` (indices or a mask)."""
    for moment in _moments(optimizer, name).values():
        moment[slice(None) if rows is None else rows] = 0.0


def _moments(optimizer: Optimizer, name: str) -> dict[str, Tensor]:
    """Numbers of each row of the group ``name``, such as Adam's moments, which it has once it has been stepped."""
    rows = find_group(optimizer, name)["params"][0]
    found = optimizer.state.get(rows, {})
    return {key: value for key, value in found.items() if getattr(value, "shape", None) == rows.shape}


def trainable_rows(splats: Splats) -> tuple[Tensor, dict[str, int]]:
    """Which splats are finite in every attribute and in projection (:data:`MAX_LOG_SCALE`).

    Returns:
        A mask ``[N]`` (bool) and, for each attribute with non-finite rows, how many it has.
    """
    attributes = {name: parameter.detach() for name, parameter in splats.attributes().items()}
    attributes["scales"] = attributes["scales"].masked_fill(attributes["scales"] > MAX_LOG_SCALE, torch.inf)
    return finite_rows(attributes)


def drop_non_finite(splats: Splats, optimizer: Optimizer, step: int) -> Tensor:
    """Drop splats that :func:`trainable_rows` leaves out, with a warning that names attribute, rows and step.

    Returns:
        Which of the splats before were kept, ``[N]`` bool.

    Raises:
        FloatingPointError: No finite splat is left.
    """
    kept, culprits = trainable_rows(splats)
    if culprits:
        if not kept.any():
            raise FloatingPointError(
                f"step {step}: all {len(splats)} splats are non-finite ({listed(culprits)}); lower the learning rates"
            )
        log.warning(f"step {step}: {dropped(kept, culprits)}")
    keep_rows(splats, optimizer, kept)
    return kept


def _one_by_one(splats: Splats) -> Iterator[Tensor]:
    """The attributes, each when it is asked for, so that those that have been replaced until then take no memory."""
    return (getattr(splats, name).detach() for name in ATTRIBUTES)


def _rebind(splats: Splats, optimizer: Optimizer, values: Iterable[Tensor], edit: Callable[[Tensor], Tensor]) -> None:
    """Bind ``values`` as the new parameters everywhere the old ones were referenced; edit all else that has rows."""
    for name, rows in zip(ATTRIBUTES, values, strict=True):
        group = find_group(optimizer, name)
        old = group["params"][0]
        new = nn.Parameter(rows, requires_grad=old.requires_grad)
        moments = _moments(optimizer, name)
        if (state := optimizer.state.pop(old, None)) is not None:
            optimizer.state[new] = state | {key: edit(moment) for key, moment in moments.items()}
        group["params"][0] = new
        setattr(splats, name, new)
    splats.edits += 1
    for name, table in splats.tables().items():
        setattr(splats, name, edit(table))
