"""Entropy coding of paths down a tree, sorted keys, and integers: each to bytes and back.

All three write binary decisions with :mod:`nsvq_lightning.io.nsvq.range_coder` and differ in the contexts by which the
probability of a decision is kept. One kernel writes and reads: with ``reads`` None, what it is given, else into it.
"""

from functools import partial

import numpy as np
from numba import int64, uint64

from nsvq_lightning.compute.jit import inline, kernel
from nsvq_lightning.compute.memory import check_fit, check_inside
from nsvq_lightning.io.errors import Bytes, FormatError
from nsvq_lightning.io.nsvq import range_coder as rc
from nsvq_lightning.splats.conventions import Int32s, Int64s, Integers, Uint32s, Uint64s

# Bits of a key; the highest is bit 62.
KEY_BITS = 63

# Decisions of a path that have contexts; those further down are written without a model.
_MODELLED_BITS = 16

# What two neighbours say about a decision: each one has left the path before, takes 0 here, or takes 1 here.
_RELATIONS = 9

# Integers are below it in size: they and their sums are exact in float64.
_TOO_LARGE = 1 << 52
_KEY_MASK = uint64((1 << KEY_BITS) - 1)
# What a reader returns instead of the number of words when it meets a value out of range.
_OUTSIDE = -1
# Decisions that encode a number's bit length, 0 to 63.
_LENGTH_BITS = 6
# Number of size classes of the previous difference.
_BEFORE = 11
_KEY_CONTEXTS = (KEY_BITS + 1) * _BEFORE << _LENGTH_BITS
# Contexts per column: the tree of the lengths, and the second bit by length.
_INTEGER_CONTEXTS = 2 << _LENGTH_BITS
# How a column of integers is written: 1 for differences from row to row, plus 2 for those from column to column.
_MODES = 4
# Whoever calls one gives it all the memory that it needs.
_stream_kernel = partial(kernel, allocates=False)


def encode_paths(paths: Int64s, bits: int, neighbours: Int32s) -> bytes:
    """Bytes of paths ``[N]`` of ``bits`` decisions each, the first one in the highest bit.

    A decision has two contexts: the node of the tree where it is taken, which follows what changes along the paths,
    and that with the branches which two earlier paths took there.

    Args:
        paths: The paths, in [0, 2^bits).
        bits: Length of each, 0 to 32.
        neighbours: Two earlier rows ``[N, 2]`` that are likely to be similar, -1 where there is none.

    Raises:
        ValueError: The arrays do not fit together, one is not contiguous, or a neighbour is out of range.
        TypeError: A dtype is wrong.
    """
    check_fit("paths [N] int64", paths, N=len(neighbours))
    contexts = _path_contexts(bits, neighbours, True)
    words = _room(len(paths) * bits)
    return _bytes(words, _code_paths(paths, bits, neighbours, words, contexts, True, None))


def _path_contexts(bits: int, neighbours: Int32s, two: bool) -> Uint32s:
    """New contexts for the decisions of paths, one or two of each; refuses neighbours that no path may have."""
    check_fit("neighbours [N, 2] int32", neighbours)
    check_inside("neighbours", neighbours, len(neighbours), -1)
    return rc.new_contexts((_RELATIONS + two) << min(bits, _MODELLED_BITS), rc.TWO_START * two)


def decode_paths(data: Bytes, bits: int, neighbours: Int32s, two: bool = True) -> Int64s:
    """Invert :func:`encode_paths` with the same ``bits`` and ``neighbours``.

    Args:
        data: The bytes.
        bits: Length of each path.
        neighbours: Two earlier rows ``[N, 2]``.
        two: Whether decisions have two contexts; before version 4 of the format, they had the second one alone.

    Raises:
        FormatError: There are more or fewer bytes than N paths take.
        ValueError: As for :func:`encode_paths`.
        TypeError: A dtype is wrong.
    """
    contexts = _path_contexts(bits, neighbours, two)
    paths, words = np.empty(len(neighbours), np.int64), _words(data)
    _check_used(words, _code_paths(paths, bits, neighbours, words, contexts, two, True))
    return paths


def encode_keys(keys: Uint64s, depths: Int64s) -> bytes:
    """Bytes of ascending keys ``[N]``, of each only the highest ``depths [N]`` of 63 bits; the others must be 0.

    What is written is the difference from the previous key, in units of the key's own depth: its number of bits by an
    adaptive model, and the bits after the first without a model. So the order of N points, which nobody needs, costs
    nothing: about log2(N!) bits fewer than the keys themselves.

    Raises:
        ValueError: The arrays do not fit together, one is not contiguous, or keys do not ascend or are out of range.
        TypeError: A dtype is wrong.
    """
    check_fit("keys [N] uint64, depths [N] int64", keys, depths)
    check_inside("depths", depths, KEY_BITS + 1)
    if (keys[1:] < keys[:-1]).any() or (len(keys) and keys[-1] > _KEY_MASK):
        raise ValueError(f"keys must ascend and be below 2^{KEY_BITS}, got {keys}; sort them")
    words = _room(depths.sum() + 8 * len(keys))
    return _bytes(words, _code_keys(keys, depths, words, rc.new_contexts(_KEY_CONTEXTS), None))


def decode_keys(data: Bytes, depths: Int64s) -> Uint64s:
    """Invert :func:`encode_keys` with the same ``depths``.

    Raises:
        FormatError: There are more or fewer bytes than N keys take, or a key is not below 2⁶³.
        ValueError: As for :func:`encode_keys`.
        TypeError: The depths are not int64.
    """
    check_fit("depths [N] int64", depths)
    check_inside("depths", depths, KEY_BITS + 1)
    keys, words = np.empty(len(depths), np.uint64), _words(data)
    used = _code_keys(keys, depths, words, rc.new_contexts(_KEY_CONTEXTS), True)
    _check_used(words, used, "a position is outside its grid")
    return keys


def encode_integers(values: Integers, order: Int64s | None = None) -> bytes:
    """Bytes of integers ``[N, D]`` of absolute value below 2⁵², of the rows in an order ``[N]``.

    Each column is written as values, as differences from row to row, from column to column, or as differences of these,
    whichever is smallest; one byte per column says which. An integer is written as its number of bits, by an adaptive
    model of its column, its sign, the bit after the leading one by a model, and the other bits without a model.

    Raises:
        ValueError: The values are not ``[N, D]``, one is too large, or the order is not of their rows.
        TypeError: They are neither int64 nor int32.
    """
    if values.dtype not in (np.int32, np.int64):
        raise TypeError(f"values must be int64 or int32, got {values.dtype}")
    largest = max(-int(values.min(initial=0)), int(values.max(initial=0)))
    if values.ndim != 2 or largest >= _TOO_LARGE:
        raise ValueError(f"values must have shape [N, D] and be below 2^52 in size, got {list(values.shape)}")
    order = np.arange(len(values)) if order is None else order
    check_fit("order [N] int64", order, N=len(values))
    check_inside("order", order, len(values))
    bits = np.empty((_MODES, values.shape[1]), np.int64)  # about as many as each mode takes
    left = 0
    for column, numbers in enumerate(values.T):
        ordered = numbers[order].astype(np.int64)
        both = [(each, np.diff(each, prepend=0)) for each in (ordered, ordered - left)]
        bits[:, column] = [np.frexp(np.abs(each))[1].sum() for pair in both for each in pair]
        left = ordered
    # Differences of differences are to be below 2^53, too.
    modes = bits[: _MODES if largest < _TOO_LARGE >> 1 else 2].argmin(0).astype(np.uint8)
    words = _room(bits.min(0).sum() + 8 * values.size)
    used = _code_integers(values, order, modes, words, rc.new_contexts(_INTEGER_CONTEXTS * values.shape[1]), None)
    return bytes(modes) + _bytes(words, used)


def decode_integers(data: Bytes, rows: int, columns: int) -> Int64s:
    """Invert :func:`encode_integers`.

    Raises:
        FormatError: There are more or fewer bytes than these integers take, or one is not below 2⁵² in size.
    """
    if len(data) < columns:
        raise FormatError(f"damaged: {len(data)} bytes for {columns} columns of integers")
    modes = np.frombuffer(data[:columns], np.uint8)
    if (modes >= _MODES).any():
        raise FormatError(f"damaged: a column of integers has mode {modes.max()}, the largest is {_MODES - 1}")
    values, words = np.empty((rows, columns), np.int64), _words(data[columns:])
    used = _code_integers(values, np.arange(rows), modes, words, rc.new_contexts(_INTEGER_CONTEXTS * columns), True)
    _check_used(words, used, "an integer is not below 2^52 in size")
    return values


# Words and bytes


def _room(bits: int) -> Uint32s:
    """Enough words for this many modelled bits: an unlikely bit costs up to 11 bits."""
    return np.zeros(11 * bits // 32 + 4, np.uint32)


def _bytes(words: Uint32s, used: int) -> bytes:
    return words[:used].astype("<u4", copy=False).tobytes()


def _words(data: Bytes) -> Uint32s:
    if len(data) % 4:
        raise FormatError(f"damaged: an entropy-coded stream of {len(data)} bytes, not a multiple of 4")
    return np.frombuffer(data, "<u4").astype(np.uint32)


def _check_used(words: Uint32s, used: int, outside: str = "") -> None:
    """Refuse a stream with a value ``outside`` its range, or that is not used up; the decoder reads one word ahead."""
    if used == _OUTSIDE:
        raise FormatError(f"damaged: {outside}")
    if used != len(words) + 1:
        raise FormatError(f"damaged: an entropy-coded stream of {len(words)} words, of which {used - 1} were read")


@inline
def _ended(words, state):  # type: ignore[no-untyped-def]
    """Whether more words were read than there are: what follows is worth no time."""
    _, _, used = state
    return used > len(words) + 1


# Paths


@inline
def _path_of(paths, row):  # type: ignore[no-untyped-def]
    """The path of a row, or -1 without a row, which agrees with no path."""
    return paths[row] if row >= 0 else int64(-1)


@inline
def _way(neighbour, path, left):  # type: ignore[no-untyped-def]
    """What a neighbour's path did at a decision with ``left`` more to come: 1 or 2, or 0 if it has left ``path``."""
    return 1 + ((neighbour >> left) & 1) if neighbour >> (left + 1) == path else 0


@_stream_kernel
def _code_paths(paths, bits, neighbours, words, contexts, two, reads):  # type: ignore[no-untyped-def]
    state = rc.start(words, reads)
    plain = max(0, bits - _MODELLED_BITS)
    for i in range(len(paths)):
        first, second = _path_of(paths, neighbours[i, 0]), _path_of(paths, neighbours[i, 1])
        path = int64(0)
        for left in range(bits - 1, plain - 1, -1):
            # The node where the decision is taken, with the branches of the two neighbours there, and alone.
            node = (int64(1) << (bits - 1 - left)) + path
            context = _RELATIONS * node + 3 * _way(first, path, left) + _way(second, path, left)
            quick = (_RELATIONS << min(bits, _MODELLED_BITS)) + node if two else context
            bit = (paths[i] >> left) & 1
            bit, state = rc.code_bit(bit, context, quick, contexts, state, words, reads)
            path = 2 * path + bit
        rest, state = rc.code_plain(paths[i], plain, state, words, reads)
        if reads is not None:
            paths[i] = (path << plain) + int64(rest)
            if _ended(words, state):
                break
    return rc.end(state, words, reads)


# Lengths of numbers


@inline
def _length(size):  # type: ignore[no-untyped-def]
    """Bit length of a number; 0 for 0."""
    length = 0
    while length < KEY_BITS and size >> uint64(length):
        length += 1
    return length


@inline
def _code_length(length, start, contexts, state, words, reads):  # type: ignore[no-untyped-def]
    node = int64(1)
    for left in range(_LENGTH_BITS - 1, -1, -1):
        bit = (length >> left) & 1
        bit, state = rc.code_bit(bit, start + node, start + node, contexts, state, words, reads)
        node = 2 * node + bit
    return node - (1 << _LENGTH_BITS), state


# Keys


@_stream_kernel
def _code_keys(keys, depths, words, contexts, reads):  # type: ignore[no-untyped-def]
    state = rc.start(words, reads)
    last, before = uint64(0), int64(0)
    for i in range(len(keys)):
        shift = uint64(KEY_BITS - depths[i])
        step, length = uint64(0), int64(0)
        if reads is None:
            step = (keys[i] >> shift) - (last >> shift)
            length = _length(step)
        start = (depths[i] * _BEFORE + before // 6) << _LENGTH_BITS
        length, state = _code_length(length, start, contexts, state, words, reads)
        if length > depths[i]:
            return _OUTSIDE
        rest, state = rc.code_plain(step, length - 1, state, words, reads)
        step = (uint64(1) << uint64(length - 1)) | rest if length else uint64(0)
        last = ((last >> shift) + step) << shift  # of two numbers below 2^63: no carry is lost
        if last > _KEY_MASK:
            return _OUTSIDE
        before = length + int64(shift) if length else int64(0)
        if reads is not None:
            keys[i] = last
            if _ended(words, state):
                break
    return rc.end(state, words, reads)


# Integers


@inline
def _expected(values, row, before, column, mode):  # type: ignore[no-untyped-def]
    """What a number is written as the difference from; the row before is -1 for the first one."""
    from_column, from_row = (mode & 2) > 0 and column > 0, (mode & 1) > 0 and before >= 0
    found = int64(values[row, column - 1]) if from_column else int64(0)
    if from_row:
        found += int64(values[before, column]) - (int64(values[before, column - 1]) if from_column else 0)
    return found


@_stream_kernel
def _code_integers(values, order, modes, words, contexts, reads):  # type: ignore[no-untyped-def]
    state = rc.start(words, reads)
    for i in range(values.shape[0]):
        row, before = order[i], order[i - 1] if i > 0 else -1
        for j in range(values.shape[1]):
            start = _INTEGER_CONTEXTS * j
            expected = _expected(values, row, before, j, modes[j])
            value, size, length = int64(0), uint64(0), int64(0)
            if reads is None:
                value = int64(values[row, j]) - expected
                size = uint64(abs(value))
                length = _length(size)
            length, state = _code_length(length, start, contexts, state, words, reads)
            sign, state = rc.code_plain(uint64(value < 0), min(length, 1), state, words, reads)
            if length > 1:
                context = start + (1 << _LENGTH_BITS) + length  # of the bit after the leading one
                second = int64(size >> uint64(length - 2)) & 1
                second, state = rc.code_bit(second, context, context, contexts, state, words, reads)
                rest, state = rc.code_plain(size, length - 2, state, words, reads)
                size = ((uint64(2) | uint64(second)) << uint64(length - 2)) | rest
            if reads is not None:
                size = size if length > 1 else uint64(length)
                value = (-int64(size) if sign else int64(size)) + expected
                if size >= uint64(2 * _TOO_LARGE) or not -_TOO_LARGE < value < _TOO_LARGE:
                    return _OUTSIDE
                values[row, j] = value
        if _ended(words, state):
            break
    return rc.end(state, words, reads)
