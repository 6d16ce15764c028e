"""Codes in boxes, for :mod:`box_search`: split by medians into leaves of 16 (one vector), leaves into nodes of 16."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from nsvq_lightning.compute.jit import inline, kernel, thread_count
from nsvq_lightning.compute.memory import FLOAT32, INT32, aligned_empty, check_array, check_table, outside

__all__ = ["NO_CODE", "Boxes", "build_boxes", "check_boxes"]

NO_CODE = np.int32(np.iinfo(np.int32).max)
"""Label of a lane without a code."""


class Boxes(NamedTuple):
    """Codes sorted into boxes.

    Attributes:
        codes: Leaves, ``[nodes · 16, D, 16]``; lanes without a code are at infinity.
        labels: Codes of the lanes, ``[nodes · 16, 16]`` int32.
        leaves: Lower and upper corners of the leaves of a node, ``[nodes, D, 2, 16]``.
        nodes: Lower and upper corners of the nodes, ``[nodes / 16, D, 2, 16]``.
        order: Codes in lane order, ``[K]`` int32.
    """

    codes: NDArray[np.float32]
    labels: NDArray[np.int32]
    leaves: NDArray[np.float32]
    nodes: NDArray[np.float32]
    order: NDArray[np.int32]


@inline
def _widest_axis(points, order, start, stop):  # type: ignore[no-untyped-def]
    axis, widest = 0, np.float32(-1.0)
    for j in range(points.shape[0]):
        low = high = points[j, order[start]]
        for i in range(start + 1, stop):
            value = points[j, order[i]]
            low, high = min(low, value), max(high, value)
        if high - low > widest:
            axis, widest = j, high - low
    return axis


@inline
def _split(values, order, start, stop, middle):  # type: ignore[no-untyped-def]
    """Quickselect: the ``middle - start`` smallest of ``order[start:stop]`` come first."""
    stop -= 1
    while start < stop:
        pivot = values[order[(start + stop) // 2]]
        low, high = start, stop
        while low <= high:
            while values[order[low]] < pivot:
                low += 1
            while values[order[high]] > pivot:
                high -= 1
            if low <= high:
                order[low], order[high] = order[high], order[low]
                low, high = low + 1, high - 1
        if middle <= high:
            stop = high
        elif middle >= low:
            start = low
        else:
            return


@inline
def _sort_into_leaves(points, order, start, stop):  # type: ignore[no-untyped-def]
    """Split by medians at multiples of 256 codes (a node), then of 16 (a leaf)."""
    stack = np.empty((64, 2), np.int64)
    stack[0, 0], stack[0, 1] = start, stop
    depth = 1
    while depth > 0:
        depth -= 1
        start, stop = stack[depth, 0], stack[depth, 1]
        size = 256 if stop - start > 256 else 16
        if stop - start <= size:
            continue
        middle = start + (stop - start + size - 1) // size // 2 * size
        _split(points[_widest_axis(points, order, start, stop)], order, start, stop, middle)
        stack[depth, 0], stack[depth, 1] = start, middle
        stack[depth + 1, 0], stack[depth + 1, 1] = middle, stop
        depth += 2


@kernel
def _order_codes(points, order, cuts):  # type: ignore[no-untyped-def]
    """Sort the parts between ``cuts`` into leaves, in parallel."""
    for part in prange(cuts.shape[0] - 1):
        _sort_into_leaves(points, order, cuts[part], cuts[part + 1])


@kernel
def _pack(points, order, codes, labels, leaves, nodes):  # type: ignore[no-untyped-def]
    dim, count = points.shape
    for node in prange(leaves.shape[0]):
        for j in range(dim):
            node_low, node_high = np.float32(np.inf), np.float32(-np.inf)
            for child in range(16):
                leaf = node * 16 + child
                low, high = np.float32(np.inf), np.float32(-np.inf)
                for lane in range(16):
                    place = leaf * 16 + lane
                    value, label = np.float32(np.inf), NO_CODE
                    if place < count:
                        label = order[place]
                        value = points[j, label]
                        low, high = min(low, value), max(high, value)
                    codes[leaf, j, lane] = value
                    labels[leaf, lane] = label
                leaves[node, j, 0, child] = low
                leaves[node, j, 1, child] = high
                node_low, node_high = min(node_low, low), max(node_high, high)
            nodes[node // 16, j, 0, node % 16] = node_low
            nodes[node // 16, j, 1, node % 16] = node_high


def build_boxes(codebook: NDArray[np.float32], order: NDArray[np.int32] | None = None) -> Boxes:
    """Put the codes ``[K, D]`` into boxes. Codes with a NaN are placed at infinity and never chosen.

    ``order`` may be that of earlier boxes: much faster, correct in any case, and good while codes have moved little.

    Raises:
        ValueError: There is no code, the codebook is not contiguous, or ``order`` does not hold ``[K]`` codes.
        TypeError: A dtype is wrong.
    """
    check_table("codebook", codebook)
    count, dim = codebook.shape
    if count == 0:
        raise ValueError(f"the codebook must have at least one code, got shape {list(codebook.shape)}; fit it first")
    points = np.ascontiguousarray(codebook.T)
    points[np.isnan(points)] = np.inf
    nodes = -(-count // 4096) * 16
    thread_count()
    if order is None:
        order = np.arange(count, dtype=np.int32)
        _order_codes(points, order, np.array([0, count]))
    else:
        check_array("order", order, (count,), INT32)
        if order.min() < 0 or order.max() >= count:
            raise outside("order", order, count)
    boxes = Boxes(
        aligned_empty((nodes * 16, dim, 16)),
        np.empty((nodes * 16, 16), np.int32),
        aligned_empty((nodes, dim, 2, 16)),
        aligned_empty((nodes // 16, dim, 2, 16)),
        order,
    )
    _pack(points, order, *boxes[:4])
    return boxes


def check_boxes(boxes: Boxes, codebook: NDArray[np.float32]) -> None:
    """Refuse boxes that do not fit a codebook ``[K, D]`` with K at least 1.

    Raises:
        ValueError: There is no code, or an array has another shape or is not contiguous.
        TypeError: A dtype is wrong.
    """
    count, dim = codebook.shape
    nodes = -(-count // 4096) * 16
    if count == 0:
        raise ValueError(f"the codebook must have at least one code, got shape {list(codebook.shape)}; fit it first")
    check_array("boxes.codes", boxes.codes, (nodes * 16, dim, 16), FLOAT32)
    check_array("boxes.labels", boxes.labels, (nodes * 16, 16), INT32)
    check_array("boxes.leaves", boxes.leaves, (nodes, dim, 2, 16), FLOAT32)
    check_array("boxes.nodes", boxes.nodes, (nodes // 16, dim, 2, 16), FLOAT32)
