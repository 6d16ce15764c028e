"""Binary arithmetic coding with adaptive probabilities, in integers only: every machine decodes the same values.

A range coder (Martin 1979) with a 64-bit window that moves by 32-bit words: the interval ``[low, low + width)`` is
divided in proportion to the probability of a bit. A carry out of ``low`` is added to the words already written.

The probability of a bit is kept per *context* as a 16-bit number that moves towards each bit it meets, by 1/(n + 1.6)
at the n-th and finally by 1/128: as exact as a count at first, as adaptive as a running mean later. A bit may have two
contexts, and the mean of their probabilities: one that knows much and moves by 1/62 in the end, and one that knows
little and follows quickly, by 1/8.
"""

import numpy as np
from numba import int64, uint32, uint64

from nsvq_lightning.compute.jit import inline
from nsvq_lightning.splats.conventions import Uint32s

# Number of bits after which the probability of a context moves at its slowest: of one alone, ...
COUNT_LIMIT = 126
# ... and of two; and how many these seem to have met at first, as the few that contexts of large codebooks meet tell
# little.
SLOW_LIMIT, QUICK_LIMIT, TWO_START = 60, 6, 2

_FULL = uint64(0xFFFFFFFFFFFFFFFF)
_LOW_WORD = uint64(0xFFFFFFFF)
# The state of a writer before the first bit; that of a reader has a number in the interval in place of its lower end.
START = uint64(0), _FULL, 0
# Largest number of bits written at once without a model.
PLAIN_BITS = 16


def new_contexts(count: int, met: int = 0) -> Uint32s:
    """States ``[count]``: the probability of a 1 in 65536ths times 256, plus how many bits were met."""
    return np.full(count, (1 << 23) + met, np.uint32)


@inline
def _chance(context, quick, contexts):
    return ((contexts[context] >> uint32(8)) + uint64(contexts[quick] >> uint32(8))) >> uint64(1)


_RATES = np.rint(65536 / (np.arange(COUNT_LIMIT + 1) + 1.6)).astype(np.int64)
# No probability is below 48/65536: an unlikely bit costs at most 11 bits.
_MIN_CHANCE = 48


@inline
def _learn(bit, context, contexts, limit):
    """Move the probability towards the bit; without branches, which would be unpredictable."""
    n = int64(contexts[context] & uint32(255))
    chance = int64(contexts[context] >> uint32(8))
    target = _MIN_CHANCE + int64(bit) * (65536 - 2 * _MIN_CHANCE)
    chance += ((target - chance) * _RATES[n]) >> 16
    contexts[context] = uint32((chance << 8) + n + (n < limit))


@inline
def _learn_both(bit, context, quick, contexts):
    _learn(bit, context, contexts, COUNT_LIMIT if context == quick else SLOW_LIMIT)
    if context != quick:
        _learn(bit, quick, contexts, QUICK_LIMIT)


@inline
def _carry(words, used):
    """Add one to the number that the written words form."""
    last = used - 1
    while words[last] == _LOW_WORD:
        words[last] = 0
        last -= 1
    words[last] += 1


@inline
def _shift_out(low, width, words, used):
    """Write the upper word of an interval that has become narrow."""
    if width <= _LOW_WORD:
        words[used] = low >> uint64(32)
        used += 1
        low <<= uint64(32)
        width <<= uint64(32)
    return low, width, used


@inline
def encode_bit(bit, context, quick, contexts, state, words):
    """Write a bit, of two contexts or of the same one twice; returns the new state ``low, width, used``.

    Start with :data:`START`.
    """
    low, width, used = state
    part = (width >> uint64(16)) * _chance(context, quick, contexts)
    one = uint64(0) - uint64(bit)  # all bits set for 1, none for 0
    before = low
    low += part & ~one
    width = (part & one) | ((width - part) & ~one)
    if low < before:
        _carry(words, used)
    _learn_both(bit, context, quick, contexts)
    return _shift_out(low, width, words, used)


@inline
def encode_plain(value, bits, state, words):
    """Write the lower ``bits`` (0 to 62) of a number, each as likely 0 as 1; returns the new state."""
    low, width, used = state
    while bits > 0:
        now = min(bits, PLAIN_BITS)
        bits -= now
        width >>= uint64(now)
        before = low
        low += width * ((uint64(value) >> uint64(bits)) & uint64((1 << now) - 1))
        if low < before:
            _carry(words, used)
        low, width, used = _shift_out(low, width, words, used)
    return low, width, used


@inline
def encode_end(state, words):
    """Write the one word that identifies the last interval; returns the number of words."""
    low, _, used = state
    if low > _FULL - _LOW_WORD:
        _carry(words, used)
        words[used] = 0
    else:
        words[used] = (low + _LOW_WORD) >> uint64(32)
    return used + 1


@inline
def _word(words, at):
    """A word of the stream; 0 beyond its end."""
    return uint64(words[at]) if at < len(words) else uint64(0)


@inline
def decode_start(words):
    """The state ``code, width, used`` before the first bit."""
    return (_word(words, 0) << uint64(32)) | _word(words, 1), _FULL, 2


@inline
def _shift_in(code, width, words, used):
    if width <= _LOW_WORD:
        code = (code << uint64(32)) | _word(words, used)
        width <<= uint64(32)
        used += 1
    return code, width, used


@inline
def decode_bit(context, quick, contexts, state, words):
    """Read a bit; returns it and the new state."""
    code, width, used = state
    part = (width >> uint64(16)) * _chance(context, quick, contexts)
    bit = int64(code < part)
    one = uint64(0) - uint64(bit)
    code -= part & ~one
    width = (part & one) | ((width - part) & ~one)
    _learn_both(bit, context, quick, contexts)
    return bit, _shift_in(code, width, words, used)


@inline
def decode_plain(bits, state, words):
    """Read a number of ``bits`` (0 to 62) bits; returns it and the new state."""
    code, width, used = state
    value = uint64(0)
    while bits > 0:
        now = min(bits, PLAIN_BITS)
        bits -= now
        width >>= uint64(now)
        # Only an altered stream exceeds the range.
        digit = min(code // width, uint64((1 << now) - 1))
        code -= digit * width
        value = (value << uint64(now)) | digit
        code, width, used = _shift_in(code, width, words, used)
    return value, (code, width, used)
