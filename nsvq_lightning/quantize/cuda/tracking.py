"""Searches that remember, on a GPU: bounds prove most codes of the last step, and only the other rows are searched.

The bounds are those of :mod:`nsvq_lightning.quantize.tracking`; here rows of any dimension have a list of near codes.
How many rows have to be searched is known to the GPU alone: it queues them and works the queue off, and the host reads
nothing back.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.launch import COMPILE
from nsvq_lightning.compute.memory import check_tensor
from nsvq_lightning.quantize.box_search import ROUNDING
from nsvq_lightning.quantize.cuda.nearest import CODES, ROWS, by_column, compare, least_of

__all__ = ["DeviceTracker"]

LIST = 8
"""Codes in the list of a row."""
BLOCK = 64
"""Rows per program of the check."""
PROGRAMS = 4096
"""Most programs of a search; they share the queue, whatever its length."""
SNAPSHOT_STEPS = 16
"""As in :mod:`nsvq_lightning.quantize.tracking`."""

SLACK = tl.constexpr(ROUNDING)
LARGEST = tl.constexpr(float(torch.finfo(torch.float32).max))


class Memory(NamedTuple):
    """What is known about rows from their last search.

    Attributes:
        last: Code, or -1 for a row that has not been searched, ``[N]`` int32.
        lists: The codes that were near ``[N, LIST]`` int32.
        anchors: Where the row was ``[N, D]``.
        clearance: Distance below which there was no code but the nearest, plus how far the codes had moved by then,
            ``[N]`` in float64, because movements add up over a whole run.
        limits: The same for codes outside the list.
    """

    last: Tensor
    lists: Tensor
    anchors: Tensor
    clearance: Tensor
    limits: Tensor


def empty_memory(count: int, dim: int, device: torch.device) -> Memory:
    """Memory of ``count`` rows that have not been searched."""
    return Memory(
        torch.full((count,), -1, dtype=torch.int32, device=device),
        torch.zeros(count, LIST, dtype=torch.int32, device=device),
        torch.zeros(count, dim, device=device),
        torch.full((count,), -torch.inf, dtype=torch.float64, device=device),
        torch.full((count,), -torch.inf, dtype=torch.float64, device=device),
    )


@triton.jit
def bound(squared):
    """A distance in float64, rounded up."""
    return tl.sqrt(squared.to(tl.float64)) * SLACK


@triton.jit(do_not_specialize=["count"])
def check_kernel(
    x, rows, codebook, last, lists, anchors, clearance, limits, travel, result, count, DIM: tl.constexpr,
    BLOCK: tl.constexpr, LIST: tl.constexpr,
):  # fmt: skip
    """Codes of the rows for which a bound proves one, -1 for the others.

    ``travel`` holds how far the codes have moved by the last snapshot, and since.
    """
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = place < count
    row = tl.load(rows + place, mask=inside, other=0)
    code = tl.load(last + row, mask=inside, other=-1)
    known = code >= 0
    drift = tl.load(travel + 1)
    way = tl.load(travel) + drift
    squared_move, squared = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for j in range(DIM):
        value = tl.load(x + row * DIM + j, mask=known, other=0.0)
        step = value - tl.load(anchors + row * DIM + j, mask=known, other=0.0)
        away = value - tl.load(codebook + code.to(tl.int64) * DIM + j, mask=known, other=0.0)
        squared_move, squared = tl.fma(step, step, squared_move), tl.fma(away, away, squared)
    moved = bound(squared_move)
    proven = known & (bound(squared) + moved < tl.load(clearance + row, mask=known, other=0.0) - way)
    open_ = known & ~proven
    if tl.max(open_.to(tl.int32), 0) > 0:
        member = tl.arange(0, LIST)
        listed = tl.load(lists + row[:, None] * LIST + member[None, :], mask=open_[:, None], other=0)
        distances = tl.zeros([BLOCK, LIST], tl.float32)
        for j in range(DIM):
            value = tl.load(x + row * DIM + j, mask=open_, other=0.0)
            away = tl.load(codebook + listed.to(tl.int64) * DIM + j, mask=open_[:, None], other=0.0) - value[:, None]
            distances = tl.fma(away, away, distances)
        least = tl.min(distances, 1)
        nearest = tl.min(tl.where(distances == least[:, None], listed, 0x7FFFFFFF), 1)
        limit = tl.load(limits + row, mask=open_, other=0.0)
        listed_is_nearest = open_ & (bound(least) + moved < limit - way)
        code = tl.where(listed_is_nearest, nearest, code)
        proven = proven | listed_is_nearest
        tl.store(last + row, code, mask=listed_is_nearest)
        # Where the gap to the second code exceeds how far the row has moved, a new anchor pays.
        others = tl.min(tl.where(listed == nearest[:, None], float("inf"), distances), 1)
        second = tl.sqrt(tl.minimum(others, LARGEST).to(tl.float64)) / SLACK
        anew = listed_is_nearest & (second - bound(least) > moved)
        for j in range(DIM):
            tl.store(anchors + row * DIM + j, tl.load(x + row * DIM + j, mask=anew, other=0.0), mask=anew)
        limit -= moved
        tl.store(limits + row, limit, mask=anew)
        tl.store(clearance + row, tl.minimum(limit, second - drift + (way - drift)), mask=anew)
    tl.store(result + place, tl.where(proven, code, -1).to(tl.int64), mask=inside)


@triton.jit
def search_kernel(
    x, rows, queue, length, codebook, last, lists, anchors, clearance, limits, travel, result, num_codes, code_stride,
    DIM: tl.constexpr, ROWS: tl.constexpr, CODES: tl.constexpr, LIST: tl.constexpr,
):  # fmt: skip
    """Search the first ``length[0]`` places of the queue and remember what was found."""
    count = tl.load(length)
    drift = tl.load(travel + 1)
    before = tl.load(travel) - drift
    for first in range(tl.program_id(0) * ROWS, count, tl.num_programs(0) * ROWS):
        turn = first + tl.arange(0, ROWS)
        inside = turn < count
        place = tl.load(queue + tl.minimum(turn, count - 1))
        row = tl.load(rows + place)
        smallest, chosen, second = compare(x, row * DIM, codebook, num_codes, code_stride, DIM, ROWS, CODES, True)
        least, nearest = least_of(smallest, chosen, num_codes)
        tl.store(result + place, nearest.to(tl.int64), mask=inside)
        tl.store(last + row, nearest, mask=inside)
        # A column's second code is outside the list whatever happens, and bounds it.
        outside = tl.min(second, 1)
        for member in tl.static_range(LIST):
            least, code = least_of(smallest, chosen, num_codes)
            if member == 1:
                near = tl.minimum(tl.minimum(least, outside), LARGEST)
                tl.store(clearance + row, tl.sqrt(near.to(tl.float64)) / SLACK + before, mask=inside)
            tl.store(lists + row * LIST + member, code, mask=inside)
            smallest = tl.where(chosen == code[:, None], float("inf"), smallest)
        far = tl.minimum(tl.minimum(tl.min(smallest, 1), outside), LARGEST)
        tl.store(limits + row, tl.sqrt(far.to(tl.float64)) / SLACK + before, mask=inside)
        for j in range(DIM):
            tl.store(anchors + row * DIM + j, tl.load(x + row * DIM + j), mask=inside)


class DeviceTracker:
    """Nearest codes of the same rows, step after step, on a CUDA device.

    What it remembers takes memory (52 bytes per row and 4 per column of it) but never changes a result.
    """

    def __init__(self, num_codes: int, dim: int, device: torch.device) -> None:
        self.num_codes, self.dim, self.device = num_codes, dim, device
        self._memory = empty_memory(0, dim, device)
        self._snapshot: Tensor | None = None
        self._steps = 0
        self._travel = torch.zeros(2, dtype=torch.float64, device=device)

    def fits(self, codebook: Tensor) -> bool:
        """Whether it remembers searches of as many codes, on this device."""
        return codebook.shape == (self.num_codes, self.dim) and codebook.device == self.device

    def search(self, x: Tensor, codebook: Tensor, rows: Tensor) -> Tensor:
        """Nearest codes ``[V]`` int64.

        Args:
            x: Contiguous rows ``[N, D]``.
            codebook: Contiguous codes ``[K, D]``.
            rows: Which rows, ``[V]`` int64, distinct and in range, which only the caller can know.

        Raises:
            ValueError: The tensors do not fit together.
            TypeError: A dtype is wrong.
        """
        check_tensor("x", x, (len(x), self.dim), self.device)
        check_tensor("codebook", codebook, (self.num_codes, self.dim), self.device)
        check_tensor("rows", rows, (len(rows),), self.device, torch.int64)
        result = torch.empty(len(rows), dtype=torch.int64, device=self.device)
        self._grow(len(x))
        self._follow(codebook)
        if len(rows) == 0:
            return result
        with torch.cuda.device_of(x):
            check_kernel[(triton.cdiv(len(rows), BLOCK),)](
                x, rows, codebook, *self._memory, self._travel, result, len(rows), DIM=self.dim, BLOCK=BLOCK,
                LIST=LIST, **COMPILE,
            )  # fmt: skip
            queue, length = _queue(result < 0)
            self._take_snapshot(codebook, 2 * length > len(rows))  # codes have jumped
            codes = by_column(codebook)
            search_kernel[(min(PROGRAMS, triton.cdiv(len(rows), ROWS)),)](
                x, rows, queue, length, codes, *self._memory, self._travel, result, self.num_codes, codes.shape[1],
                DIM=self.dim, ROWS=ROWS, CODES=CODES, LIST=LIST, num_warps=1, **COMPILE,
            )  # fmt: skip
        return result

    def _follow(self, codebook: Tensor) -> None:
        """Note how far codes have moved since the snapshot; now and then, take a new one."""
        if self._snapshot is None:
            self._snapshot = codebook.clone()
        squares = (codebook - self._snapshot).square().sum(1)
        self._travel[1] = squares.max().double().sqrt() * ROUNDING
        self._steps += 1
        if self._steps % SNAPSHOT_STEPS == 0:
            self._take_snapshot(codebook, torch.ones_like(squares[:1], dtype=torch.bool))

    def _take_snapshot(self, codebook: Tensor, wanted: Tensor) -> None:
        """Take a snapshot if ``wanted [1]``, which the device decides."""
        assert self._snapshot is not None
        torch.where(wanted, codebook, self._snapshot, out=self._snapshot)
        travelled, drift = self._travel.unbind()
        moved = torch.stack([travelled + drift, torch.zeros_like(drift)])
        torch.where(wanted, moved, self._travel, out=self._travel)

    def _grow(self, count: int) -> None:
        """Make room for ``count`` rows."""
        old = len(self._memory.last)
        if count > old:
            more = empty_memory(count - old, self.dim, self.device)
            self._memory = Memory(*(torch.cat(both) for both in zip(self._memory, more, strict=True)))


def _queue(chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Places ``[V]`` int32 of the chosen ones in order, then anything, and their number ``[1]`` int32."""
    ends = chosen.cumsum(0, dtype=torch.int32)
    queue = torch.empty(len(chosen) + 1, dtype=torch.int32, device=chosen.device)
    places = torch.arange(len(chosen), dtype=torch.int32, device=chosen.device)
    # Those that are not chosen all go to the last place, which nobody reads.
    queue.scatter_(0, torch.where(chosen, ends - 1, len(chosen)).long(), places)
    return queue, ends[-1:]
