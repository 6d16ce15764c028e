"""Binary arithmetic coding with adaptive probabilities, in integers only: every machine decodes the same values.

A range coder (Martin 1979) with a 64-bit window that moves by 32-bit words: the interval ``[low, low + width)`` is
divided in proportion to the probability of a bit. A carry out of ``low`` is added to the words already written.

The probability of a bit is kept per *context* as a 16-bit number that moves towards each bit it meets, by 1/(n + 1.6)
at the n-th and finally by 1/128: as exact as a count at first, as adaptive as a running mean later. A bit may have two
contexts, and the mean of their probabilities: one that knows much and moves by 1/62 in the end, and one that knows
little and follows quickly, by 1/8.

The functions write where ``reads`` is None, else they read, and the code of the other half is not there. Their state is
``low, width, used``: a reader has in place of ``low`` how far above it the number is that the stream holds.
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
# Largest number of bits written at once without a model.
PLAIN_BITS = 16


def new_contexts(count: int, met: int = 0) -> Uint32s:
    """States ``[count]``: the probability of a 1 in 65536ths times 256, plus how many bits were met."""
    return np.full(count, (1 << 23) + met, np.uint32)


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
def _carry(words, used):
    """Add one to the number that the written words form."""
    last = used - 1
    while words[last] == _LOW_WORD:
        words[last] = 0
        last -= 1
    words[last] += 1


@inline
def _word(words, at):
    """A word of the stream; 0 beyond its end."""
    return uint64(words[at]) if at < len(words) else uint64(0)


@inline
def start(words, reads):
    """The state before the first bit."""
    if reads is None:
        return uint64(0), _FULL, 0
    return (_word(words, 0) << uint64(32)) | _word(words, 1), _FULL, 2


@inline
def _narrowed(low, step, width, used, words, reads):
    """The state in a part of the interval, which begins a step higher; by a word further where that is narrow."""
    if reads is None:
        before = low
        low += step
        if low < before:
            _carry(words, used)
    else:
        low -= step
    if width <= _LOW_WORD:
        if reads is None:
            words[used] = low >> uint64(32)
            low <<= uint64(32)
        else:
            low = (low << uint64(32)) | _word(words, used)
        width <<= uint64(32)
        used += 1
    return low, width, used


@inline
def code_bit(bit, context, quick, contexts, state, words, reads):
    """Write a bit, or read one, of two contexts or of the same one twice; returns it and the new state."""
    low, width, used = state
    chance = ((contexts[context] >> uint32(8)) + uint64(contexts[quick] >> uint32(8))) >> uint64(1)
    part = (width >> uint64(16)) * chance
    if reads is not None:
        bit = int64(low < part)
    one = uint64(0) - uint64(bit)  # all bits set for 1, none for 0
    width = (part & one) | ((width - part) & ~one)
    _learn(bit, context, contexts, COUNT_LIMIT if context == quick else SLOW_LIMIT)
    if context != quick:
        _learn(bit, quick, contexts, QUICK_LIMIT)
    return bit, _narrowed(low, part & ~one, width, used, words, reads)


@inline
def code_plain(value, bits, state, words, reads):
    """Write the lower ``bits`` (0 to 62) of a number, each as likely 0 as 1, or read them; returns both, too."""
    low, width, used = state
    found = uint64(0)
    while bits > 0:
        now = min(bits, PLAIN_BITS)
        bits -= now
        width >>= uint64(now)
        largest = uint64((1 << now) - 1)
        digit = (uint64(value) >> uint64(bits)) & largest
        if reads is not None:
            digit = min(low // width, largest)  # only an altered stream exceeds the range
        found = (found << uint64(now)) | digit
        low, width, used = _narrowed(low, digit * width, width, used, words, reads)
    return found, (low, width, used)


@inline
def end(state, words, reads):
    """Write the one word that identifies the last interval; returns the number of words written, or read."""
    low, _, used = state
    if reads is not None:
        return used
    if low > _FULL - _LOW_WORD:
        _carry(words, used)
        words[used] = 0
    else:
        words[used] = (low + _LOW_WORD) >> uint64(32)
    return used + 1
