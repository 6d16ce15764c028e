"""Exact nearest code on a GPU: a running minimum over all codes, whose distances never leave the registers.

Distances are sums of squared differences in float32, one fused multiply-add per element in column order. The CPU
decides by the same sums, so both always choose the same code. Differences need no centring and lose nothing to
cancellation, as dot products would (and TF32 would give most rows a wrong code); they cost twice the arithmetic.

Codes are stored column by column and padded to whole tiles, so that no load of the inner loop has a mask. A program is
one warp, in which a thread compares 8 rows with 4 codes: 12 loads for 32 differences. The programs of a multiprocessor
pass over the codes side by side and find them in its L1 cache.

From step to step, bounds prove most codes of the last one, and only the other rows are searched. The bounds are those
of :mod:`nsvq_lightning.quantize.tracking`; here rows of any dimension have a list of near codes. How many rows have to
be searched is known to the GPU alone: it queues them and works the queue off, and the host reads nothing back.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.language import constexpr

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.quantize.box_search import ROUNDING
from nsvq_lightning.quantize.scores import LIST

ROWS = constexpr(8)  # rows per program of a search
CODES = constexpr(128)  # codes that it compares its rows with at a time
BLOCK = constexpr(64)  # rows, or codes, per program of a check
COPIED = constexpr(1024)  # numbers per program of a copy
MEMBERS = constexpr(LIST)  # codes in the list of a row
SLACK = constexpr(ROUNDING)
# A kernel that is compiled once for all numbers of rows.
kernel_of_any_count = triton.jit(do_not_specialize=["count"])


@triton.jit
def places(SIZE: constexpr):
    """The numbers ``[SIZE]`` of what this program works on, where each program has as many."""
    return tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)


@triton.jit
def load_if(pointer, mask):
    """What a pointer leads to; 0 where the mask is not set."""
    return tl.load(pointer, mask=mask, other=0)


@triton.jit
def compare(x, at, codebook, num_codes, code_stride, DIM: constexpr, WITH_SECOND: constexpr):
    """Compare rows with all codes ``[DIM, code_stride]``, which are infinite beyond ``num_codes``.

    Each column stands for every ``CODES``-th code. Returns their smallest distance to each row ``[ROWS, CODES]``, the
    code it belongs to and, with ``WITH_SECOND``, the next larger one (or the same, of equal ones). ``at`` is where the
    rows begin in ``x``.
    """
    code = tl.arange(0, CODES)
    smallest = tl.full([ROWS, CODES], float("inf"), tl.float32)
    second = smallest
    chosen = tl.zeros([ROWS, CODES], tl.int32) + code[None, :]
    for first in range(0, num_codes, CODES):
        distance = tl.zeros([ROWS, CODES], tl.float32)
        for j in range(DIM):
            value = tl.load(x + at + j)
            centre = tl.load(codebook + tl.cast(code_stride, tl.int64) * j + first + code)
            difference = centre[None, :] - value[:, None]
            distance = tl.fma(difference, difference, distance)
        # Of equally near codes the first is kept, and a NaN is never nearer.
        nearer = distance < smallest
        if WITH_SECOND:
            second = tl.where(nearer, smallest, tl.where(distance < second, distance, second))
        smallest = tl.where(nearer, distance, smallest)
        chosen = tl.where(nearer, (first + code)[None, :], chosen)
    return smallest, chosen, second


@triton.jit
def least_of(smallest, chosen, num_codes):
    """The smallest distance of each row, and the lowest code that has it."""
    least = tl.min(smallest, 1)
    return least, tl.min(tl.where(smallest == least[:, None], chosen, num_codes), 1)


@kernel_of_any_count
def nearest_kernel(x, codebook, result, count, num_codes, code_stride, DIM: constexpr):
    """Nearest code of each row ``[count, DIM]``."""
    row = places(ROWS)
    at = tl.minimum(row, tl.cast(count, tl.int64) - 1) * DIM
    smallest, chosen, _ = compare(x, at, codebook, num_codes, code_stride, DIM, False)
    _, nearest = least_of(smallest, chosen, num_codes)
    tl.store(result + row, nearest.to(tl.int64), mask=row < count)


PROGRAMS = 4096  # most programs of a search; they share the queue, whatever its length
SNAPSHOT_STEPS = 16  # searches between two snapshots, as on the CPU


def nearest_codes(x: Tensor, codebook: Tensor) -> Tensor:
    """Nearest codes ``[N]`` int64; of equally near ones the lowest, and 0 for a row with a NaN.

    Args:
        x: float32 rows ``[N, D]`` on a CUDA device.
        codebook: Codes ``[K, D]`` there.

    Raises:
        ValueError: Rows and codes do not fit together, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    check_fit("x [N, D], codebook [K, D]", x, codebook)
    result = x.new_empty(len(x), dtype=torch.int64)
    if len(x):
        codes = by_column(codebook)
        with torch.cuda.device_of(x):
            nearest_kernel[(triton.cdiv(len(x), ROWS.value),)](
                x, codes, result, len(x), len(codebook), codes.shape[1], DIM=x.shape[1], num_warps=1, **COMPILE
            )
    return result


def by_column(codebook: Tensor) -> Tensor:
    """Codes ``[K, D]`` transposed to ``[D, M]``, K rounded up to whole tiles; infinite where there is no code."""
    count, dim = codebook.shape
    columns = codebook.new_full((dim, triton.cdiv(count, CODES.value) * CODES.value), torch.inf)
    columns[:, :count] = codebook.t()
    return columns


def empty_memory(count: int, dim: int, device: torch.device) -> tuple[Tensor, ...]:
    """What is known from their last search about ``count`` rows that have not been searched.

    Code ``[N]`` int32, here -1; the codes that were near ``[N, LIST]`` int32; where the row was ``[N, D]``; the
    distance below which there was no code but the nearest, plus how far the codes had moved by then, ``[N]`` in
    float64, because movements add up over a whole run; and the same for codes outside the list.
    """
    codes = torch.full((count,), -1, dtype=torch.int32, device=device)
    lists = torch.zeros(count, LIST, dtype=torch.int32, device=device)
    clearance, limits = torch.full((2, count), -torch.inf, dtype=torch.float64, device=device)
    return codes, lists, torch.zeros(count, dim, device=device), clearance, limits


LARGEST = constexpr(float(torch.finfo(torch.float32).max))


@triton.jit
def bound(squared):
    """A distance in float64, rounded up."""
    return tl.sqrt(squared.to(tl.float64)) * SLACK


@triton.jit
def bound_below(squared):
    """A distance in float64, rounded down, and finite."""
    return tl.sqrt(tl.minimum(squared, LARGEST).to(tl.float64)) / SLACK


@triton.jit
def drift_kernel(codebook, snapshot, squared_drift, num_codes, DIM: constexpr):
    """Raise ``squared_drift[0]``, the bits of a float32, to how far any of the codes has moved since the snapshot."""
    code = places(BLOCK)
    inside = code < num_codes
    squared = tl.zeros([BLOCK], tl.float32)
    for j in range(DIM):
        at = code * DIM + j
        step = load_if(codebook + at, inside) - load_if(snapshot + at, inside)
        squared = tl.fma(step, step, squared)
    # A code that is not a number may have been anywhere. The largest is the same in whatever order programs end.
    largest = tl.max(tl.where(squared == squared, squared, float("inf")), 0)
    tl.atomic_max(squared_drift, largest.to(tl.int32, bitcast=True))


@triton.jit
def drift_of(squared_drift):
    """The distance that :func:`drift_kernel` has left, in float64, rounded up."""
    return bound(tl.load(squared_drift).to(tl.float32, bitcast=True))


@triton.jit
def have_jumped(ends, count):
    """Whether more than half of the rows are searched: then codes have jumped, and a new snapshot pays."""
    return 2 * tl.load(ends + count - 1) > count


@kernel_of_any_count
def snapshot_kernel(codebook, snapshot, travelled, squared_drift, ends, count, size):
    """Take a snapshot of the codes, if they have jumped."""
    if have_jumped(ends, count):
        place = places(COPIED)
        tl.store(snapshot + place, load_if(codebook + place, place < size), mask=place < size)
        if tl.program_id(0) == 0:
            tl.store(travelled, tl.load(travelled) + drift_of(squared_drift))


@kernel_of_any_count
def queue_kernel(ends, queue, count):
    """Line up the places at which the running sum ``ends`` rises."""
    place = places(COPIED)
    end = load_if(ends + place, place < count)
    before = load_if(ends + place - 1, (place < count) & (place > 0))
    tl.store(queue + before, place.to(tl.int32), mask=end > before)


@kernel_of_any_count
def check_kernel(
    x, rows, codebook, last, lists, anchors, clearance, limits, travelled, squared_drift, result, searched, count,
    DIM: constexpr,
):  # fmt: skip
    """Codes of the rows for which a bound proves one; 1 in ``searched`` for the others.

    ``travelled`` is how far the codes have moved by the last snapshot, ``squared_drift`` since.
    """
    place = places(BLOCK)
    inside = place < count
    row = load_if(rows + place, inside)
    code = tl.load(last + row, mask=inside, other=-1)
    known = code >= 0
    drift = drift_of(squared_drift)
    way = tl.load(travelled) + drift
    squared_move = tl.zeros([BLOCK], tl.float32)
    squared = squared_move
    for j in range(DIM):
        value = load_if(x + row * DIM + j, known)
        step = value - load_if(anchors + row * DIM + j, known)
        away = value - load_if(codebook + code.to(tl.int64) * DIM + j, known)
        squared_move = tl.fma(step, step, squared_move)
        squared = tl.fma(away, away, squared)
    moved = bound(squared_move)
    proven = known & (bound(squared) + moved < load_if(clearance + row, known) - way)
    open_ = known & ~proven
    if tl.max(open_.to(tl.int32), 0) > 0:
        member = tl.arange(0, MEMBERS)
        listed = load_if(lists + row[:, None] * MEMBERS + member[None, :], open_[:, None])
        distances = tl.zeros([BLOCK, MEMBERS], tl.float32)
        for j in range(DIM):
            value = load_if(x + row * DIM + j, open_)
            away = load_if(codebook + listed.to(tl.int64) * DIM + j, open_[:, None]) - value[:, None]
            distances = tl.fma(away, away, distances)
        least, nearest = least_of(distances, listed, 0x7FFFFFFF)
        limit = load_if(limits + row, open_)
        listed_is_nearest = open_ & (bound(least) + moved < limit - way)
        code = tl.where(listed_is_nearest, nearest, code)
        proven = proven | listed_is_nearest
        tl.store(last + row, code, mask=listed_is_nearest)
        # Where the gap to the second code exceeds how far the row has moved, a new anchor pays.
        others = tl.min(tl.where(listed == nearest[:, None], float("inf"), distances), 1)
        second = bound_below(others)
        anew = listed_is_nearest & (second - bound(least) > moved)
        for j in range(DIM):
            tl.store(anchors + row * DIM + j, load_if(x + row * DIM + j, anew), mask=anew)
        limit -= moved
        tl.store(limits + row, limit, mask=anew)
        tl.store(clearance + row, tl.minimum(limit, second - drift + (way - drift)), mask=anew)
    tl.store(result + place, code.to(tl.int64), mask=inside)
    tl.store(searched + place, (~proven).to(tl.int32), mask=inside)


@kernel_of_any_count
def search_kernel(
    x, rows, queue, ends, codebook, last, lists, anchors, clearance, limits, travelled, squared_drift, result, count,
    num_codes, code_stride, DIM: constexpr,
):  # fmt: skip
    """Search the rows in the queue and remember what was found; ``ends[count - 1]`` is its length."""
    length = tl.load(ends + count - 1)
    drift = drift_of(squared_drift)
    # If codes have jumped, these very codes are the next snapshot.
    before = tl.load(travelled) + tl.where(have_jumped(ends, count), drift, -drift)
    for first in range(tl.program_id(0) * ROWS, length, tl.num_programs(0) * ROWS):
        turn = first + tl.arange(0, ROWS)
        inside = turn < length
        place = tl.load(queue + tl.minimum(turn, length - 1))
        row = tl.load(rows + place)
        smallest, chosen, second = compare(x, row * DIM, codebook, num_codes, code_stride, DIM, True)
        least, nearest = least_of(smallest, chosen, num_codes)
        tl.store(result + place, nearest.to(tl.int64), mask=inside)
        tl.store(last + row, nearest, mask=inside)
        # A column's second code is outside the list whatever happens, and bounds it.
        outside = tl.min(second, 1)
        for member in tl.static_range(MEMBERS):
            least, code = least_of(smallest, chosen, num_codes)
            if member == 1:
                tl.store(clearance + row, bound_below(tl.minimum(least, outside)) + before, mask=inside)
            tl.store(lists + row * MEMBERS + member, code, mask=inside)
            smallest = tl.where(chosen == code[:, None], float("inf"), smallest)
        far = tl.minimum(tl.min(smallest, 1), outside)
        tl.store(limits + row, bound_below(far) + before, mask=inside)
        for j in range(DIM):
            tl.store(anchors + row * DIM + j, tl.load(x + row * DIM + j), mask=inside)


class DeviceTracker:
    """Nearest codes of the same rows, step after step, on a CUDA device.

    What it remembers takes memory (52 bytes per row and 4 per column of it) but never changes a result.
    """

    def __init__(self, codebook: Tensor) -> None:
        self._snapshot = codebook.clone()
        self._memory = empty_memory(0, codebook.shape[1], codebook.device)
        self._steps = 0
        self._travelled = codebook.new_zeros(1, dtype=torch.float64)
        self._squared_drift = codebook.new_zeros(1, dtype=torch.int32)

    def fits(self, codebook: Tensor) -> bool:
        """Whether it remembers searches of as many codes, on this device."""
        return codebook.shape == self._snapshot.shape and codebook.device == self._snapshot.device

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
        (num_codes, dim), device = self._snapshot.shape, self._snapshot.device
        check_fit("snapshot [K, D], x [N, D], codebook [K, D], rows [V] int64", self._snapshot, x, codebook, rows)
        count = len(rows)
        result = torch.empty_like(rows)
        more = len(x) - len(self._memory[0])
        if more > 0:
            self._memory = tuple(map(torch.cat, zip(self._memory, empty_memory(more, dim, device), strict=True)))
        if count == 0:
            return result
        searched, queue = rows.new_empty(2, count, dtype=torch.int32)
        travel, codes = (self._travelled, self._squared_drift), by_column(codebook)
        with torch.cuda.device_of(x):
            self._follow(codebook)
            check_kernel[(triton.cdiv(count, BLOCK.value),)](
                x, rows, codebook, *self._memory, *travel, result, searched, count, DIM=dim, **COMPILE
            )
            ends = searched.cumsum(0, dtype=torch.int32)
            queue_kernel[(triton.cdiv(count, COPIED.value),)](ends, queue, count, **COMPILE)
            search_kernel[(min(PROGRAMS, triton.cdiv(count, ROWS.value)),)](
                x, rows, queue, ends, codes, *self._memory, *travel, result, count, num_codes, codes.shape[1],
                DIM=dim, num_warps=1, **COMPILE,
            )  # fmt: skip
            self._follow_jump(codebook, ends, count)
        return result

    def _follow(self, codebook: Tensor) -> None:
        """Note how far codes have moved since the snapshot; now and then, take a new one."""
        self._steps += 1
        self._squared_drift.zero_()
        num_codes, dim = codebook.shape
        drift_kernel[(triton.cdiv(num_codes, BLOCK.value),)](
            codebook, self._snapshot, self._squared_drift, num_codes, DIM=dim, **COMPILE
        )
        if self._steps % SNAPSHOT_STEPS == 0:
            self._travelled += self._squared_drift.view(torch.float32).double().sqrt() * ROUNDING
            self._snapshot.copy_(codebook)
            self._squared_drift.zero_()

    def _follow_jump(self, codebook: Tensor, ends: Tensor, count: int) -> None:
        """Take a snapshot if codes have jumped."""
        size = codebook.numel()
        snapshot_kernel[(triton.cdiv(size, COPIED.value),)](
            codebook, self._snapshot, self._travelled, self._squared_drift, ends, count, size, **COMPILE
        )
