"""A vector of 16 floats for Numba kernels.

Whether Numba vectorizes a plain loop is up to LLVM; the kernels of this package vectorize explicitly instead.
``Lanes`` and ``Mask`` are Numba types that hold one LLVM ``<16 x float>`` and ``<16 x i1>``. LLVM turns them into one
AVX-512, two AVX2 or four NEON/SSE registers, so one source serves every CPU. In operators, and in functions of vectors,
a scalar stands for a vector that holds it in every lane. All functions here are intrinsics: they only exist inside
``@njit`` code. Those that ``triton.language`` has, too, bear the same names, and what is written with them alone
compiles for a GPU as well (:mod:`nsvq_lightning.compute.formulas`).

Conventions: a memory argument is a pair (one-dimensional contiguous array, element offset); nothing is
bounds-checked. Floating-point code may be contracted (a·b + c with one rounding) but never reassociated, so NaN and
infinity keep their meaning.
"""

import operator
from functools import partial, wraps
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typeconv import Conversion
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model
from numba.types import Array, UniTuple, float32, int64, void

WIDTH = 16

_f32, _i1, _i8, _i16, _i32, _i64 = ir.FloatType(), *(ir.IntType(bits) for bits in (1, 8, 16, 32, 64))
_VF, _VI, _VM = (ir.VectorType(kind, WIDTH) for kind in (_f32, _i32, _i1))
_CONTRACT = ("contract", "nsz")
_add = partial(ir.IRBuilder.fadd, flags=_CONTRACT)

# Stands for the type of the elements of the first argument.
_ELEMENT = object()


class _VectorType(types.Type):
    """A Numba type that is one LLVM vector register."""

    def can_convert_from(self, typingctx, other):
        """A number where ``Lanes`` are expected is spread to every lane, if nothing else takes a number there."""
        is_number = isinstance(other, types.Integer | types.Float)
        return Conversion.unsafe if self == Lanes and is_number else None


Lanes = _VectorType("float32x16")
Mask = _VectorType("mask16")


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: _VectorType) -> None:
        super().__init__(manager, kind, _VM if kind == Mask else _VF)


@lower_cast(types.Number, Lanes)
def _spread(context, builder, kind, _, value):
    return _broadcast(builder, _VF, context.cast(builder, value, kind, float32))


# ---- declaring operators and functions
# --------------------------------------------------------------------------------


def _operator(symbol, result, parameters, emit):
    """Define the operator ``symbol`` for vectors; ``emit(builder, *values)`` builds the instructions."""
    infer_global(symbol)(type(symbol.__name__, (ConcreteTemplate,), {"cases": [signature(result, *parameters)]}))
    lower_builtin(symbol, *parameters)(lambda context, builder, sig, values: emit(builder, *values))


def _function(result, *parameters):
    """Turn ``emit(builder, *values)`` into an intrinsic.

    ``emit`` gets an array as the address of its elements and a tuple as a list, and returns a tuple as a list.
    ``parameters`` are the Numba types to which arguments are converted; a class of them leaves an argument as it is.
    """

    def decorate(emit):
        def lower(context, builder, sig, values):
            opened = (_opened(context, builder, *pair) for pair in zip(sig.args, values, strict=True))
            made = emit(builder, *opened)
            if isinstance(made, list):
                return context.make_tuple(builder, sig.return_type, made)
            return context.get_dummy_value() if sig.return_type == void else made

        @intrinsic
        @wraps(emit)  # from which Numba reads the number of arguments
        def declare(typingctx, *given):
            def settled(kind, argument=None):
                if kind is _ELEMENT:
                    return given[0].dtype
                return kind if isinstance(kind, types.Type) else argument

            return signature(settled(result), *map(settled, parameters, given)), lower

        return declare

    return decorate


def _opened(context, builder, kind, value):
    if isinstance(kind, Array):
        return cgutils.create_struct_proxy(kind)(context, builder, value).data
    return cgutils.unpack_tuple(builder, value, len(kind)) if isinstance(kind, types.BaseTuple) else value


# ---- building blocks in LLVM
# ------------------------------------------------------------------------------------------


def _constant(value):
    return ir.Constant(_VF, [float(np.float32(value))] * WIDTH)


def _integers(value):
    return ir.Constant(_VI, [value] * WIDTH)


def _shuffle(builder, first, second, lanes):
    return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(_i32, len(lanes)), list(lanes)))


def _broadcast(builder, kind, scalar):
    undefined = ir.Constant(kind, ir.Undefined)
    return _shuffle(builder, builder.insert_element(undefined, scalar, _i32(0)), undefined, [0] * kind.count)


def _llvm(builder, name, values, result=_VF):
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}"), values)


def _polynomial(builder, x, coefficients):
    """Horner's rule, highest power first."""
    value = _constant(coefficients[0])
    for coefficient in coefficients[1:]:
        value = _fused(builder, value, x, _constant(coefficient))
    return value


def _fused(builder, x, y, z):
    """``x * y + z``, with one rounding where the processor supports it."""
    # Not llvm.fma: where the target processor lacks that instruction, llvm.fma calls a library function for every lane,
    # while llvm.fmuladd multiplies and adds.
    return _llvm(builder, "fmuladd.v16f32", [x, y, z])


def _smaller(builder, x, y):
    """The smaller of two; the second one where the first is NaN."""
    return builder.select(builder.fcmp_ordered("<", x, y), x, y)


def _read(builder, address, count=WIDTH):
    return builder.load(builder.bitcast(address, ir.VectorType(_f32, count).as_pointer()), align=4)


def _write(builder, address, value):
    builder.store(value, builder.bitcast(address, value.type.as_pointer()), align=4)


# ---- operators
# --------------------------------------------------------------------------------------------------------


def _compared(symbol):
    return lambda builder, x, y: builder.fcmp_ordered(symbol, x, y)


_TWO = (Lanes, Lanes)
_operator(operator.add, Lanes, _TWO, _add)
_operator(operator.sub, Lanes, _TWO, partial(ir.IRBuilder.fsub, flags=_CONTRACT))
_operator(operator.mul, Lanes, _TWO, partial(ir.IRBuilder.fmul, flags=_CONTRACT))
_operator(operator.truediv, Lanes, _TWO, ir.IRBuilder.fdiv)
_operator(operator.neg, Lanes, (Lanes,), ir.IRBuilder.fneg)
_operator(operator.ge, Mask, _TWO, _compared(">="))
_operator(operator.le, Mask, _TWO, _compared("<="))
_operator(operator.lt, Mask, _TWO, _compared("<"))
_operator(operator.gt, Mask, _TWO, _compared(">"))
_operator(operator.and_, Mask, (Mask, Mask), ir.IRBuilder.and_)
_operator(operator.or_, Mask, (Mask, Mask), ir.IRBuilder.or_)

# ---- memory
# -----------------------------------------------------------------------------------------------------------


@_function(Lanes, Lanes)
def broadcast(builder, scalar):
    """The scalar in every lane."""
    return scalar


@_function(Lanes, Array, int64)
def load(builder, array, offset):
    """``load(array, offset)``: 16 consecutive floats."""
    return _read(builder, builder.gep(array, [offset]))


@_function(void, Array, int64, Lanes)
def store(builder, array, offset, lanes):
    """``store(array, offset, lanes)``: 16 consecutive floats."""
    _write(builder, builder.gep(array, [offset]), lanes)


@_function(_ELEMENT, Array, int64)
def get(builder, array, offset):
    """``get(array, offset)``: one element, without the sign check of Numba's indexing."""
    return builder.load(builder.gep(array, [offset]))


@intrinsic
def integer(typingctx, array, offset):
    """``integer(array, offset)``: one element as an int64, in which rows and places are counted."""

    def emit(context, builder, sig, values):
        address = builder.gep(_opened(context, builder, array, values[0]), [values[1]])
        return context.cast(builder, builder.load(address), array.dtype, int64)

    return int64(array, int64), emit


@_function(void, Array, int64, _ELEMENT)
def put(builder, array, offset, value):
    """``put(array, offset, value)``: one element, without the sign check of Numba's indexing."""
    builder.store(value, builder.gep(array, [offset]))


@_function(void, Array, int64)
def prefetch(builder, array, offset):
    """``prefetch(array, offset)``: ask for the cache line of one element."""
    address = builder.bitcast(builder.gep(array, [offset]), _i8.as_pointer())
    _llvm(builder, "prefetch.p0", [address, _i32(0), _i32(3), _i32(1)], ir.VoidType())


@intrinsic(prefer_literal=True)
def scratch(typingctx, count):
    """``scratch(count)``: as many floats, a constant, of whatever content, on the stack: gone when the kernel ends."""
    kind, size = Array(float32, 1, "C"), count.literal_value

    def emit(context, builder, sig, values):
        with builder.goto_entry_block():
            memory = builder.alloca(ir.ArrayType(_f32, size))
        memory.align = 64
        # Hidden from LLVM: what it knew of it would decide what is contracted, and so the bits.
        pointer = _f32.as_pointer()
        data = builder.asm(ir.FunctionType(pointer, [pointer]), "", "=r,0", [builder.bitcast(memory, pointer)], False)
        array = context.make_array(kind)(context, builder)
        context.populate_array(array, data=data, shape=[_i64(size)], strides=[_i64(4)], itemsize=_i64(4), meminfo=None)
        return array._getvalue()

    return kind(count), emit


# ---- arithmetic
# -------------------------------------------------------------------------------------------------------


fma = _function(Lanes, Lanes, Lanes, Lanes)(_fused)


@_function(Lanes, Lanes, Lanes, Lanes)
def fnma(builder, x, y, z):
    """``z - x * y``, with one rounding where the processor supports it."""
    return _fused(builder, builder.fneg(x), y, z)


minimum = _function(Lanes, Lanes, Lanes)(_smaller)


@_function(Lanes, Lanes, Lanes)
def maximum(builder, x, y):
    """The larger of two; the second one where the first is NaN."""
    return builder.select(builder.fcmp_ordered(">", x, y), x, y)


def _of_llvm(name):
    """A function that LLVM has for numbers and vectors."""
    return _function(Lanes, Lanes)(lambda builder, x: _llvm(builder, f"{name}.v16f32", [x]))


sqrt = _of_llvm("sqrt")  # NaN below zero
floor = _of_llvm("floor")
ceil = _of_llvm("ceil")
abs = _of_llvm("fabs")


@_function(Lanes, Mask, Lanes, Lanes)
def where(builder, mask, x, y):
    """``where(mask, x, y)``: x where the mask is set, else y."""
    return builder.select(mask, x, y)


@_function(Lanes, Lanes)
def exp2(builder, x):
    """2**x for |x| < 126, relative error 2e-7; no check outside."""
    # Adding 1.5·2^23 rounds to an integer in the low bits of the sum, ready to become an exponent.
    magic = _constant(12582912.0)
    shifted = builder.fadd(x, magic)
    fraction = builder.fsub(x, builder.fsub(shifted, magic))
    # Minimax polynomial of 2**f on [-1/2, 1/2].
    powers = (1.32764715e-3, 9.67554133e-3, 5.55071327e-2, 2.40221197e-1, 6.93146967e-1, 1.00000007)
    power = _polynomial(builder, fraction, powers)
    exponent = builder.shl(builder.bitcast(shifted, _VI), _integers(23))
    return builder.bitcast(builder.add(builder.bitcast(power, _VI), exponent), _VF)


@_function(Lanes, Lanes)
def log2(builder, x):
    """Binary logarithm of a positive normal number, absolute error 1e-7."""
    bits = builder.bitcast(x, _VI)
    # Split into m·2^e with m in [1/√2, √2): the offset moves the split from 1 to 1/√2.
    offset = _integers(0x3F3504F3)
    exponent = builder.ashr(builder.sub(bits, offset), _integers(23))
    mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, _integers(23))), _VF)
    one = _constant(1.0)
    s = builder.fdiv(builder.fsub(mantissa, one), builder.fadd(mantissa, one))
    squared = builder.fmul(s, s)
    # log m = 2 artanh(s), s = (m - 1)/(m + 1)
    series = _polynomial(builder, squared, (1 / 11, 1 / 9, 1 / 7, 1 / 5, 1 / 3, 1.0))
    scaled = builder.fmul(s, _constant(2 * 1.4426950408889634))
    return _fused(builder, scaled, series, builder.sitofp(exponent, _VF))


# ---- masks
# ------------------------------------------------------------------------------------------------------------


@_function(int64, Mask)
def mask_bits(builder, mask):
    """The mask as an integer, lane 0 in the lowest bit."""
    return builder.zext(builder.bitcast(mask, _i16), _i64)


@_function(int64, int64)
def lowest_bit(builder, bits):
    """Position of the lowest set bit of an integer; 64 for 0."""
    return builder.cttz(bits, _i1(0))


@_function(int64, Array, int64, int64)
def column_bits(builder, array, offset, k):
    """``column_bits(uint16_array, offset, k)``: bit k of 64 consecutive elements as one 64-bit integer."""
    kind = ir.VectorType(_i16, 64)
    elements = builder.load(builder.bitcast(builder.gep(array, [offset]), kind.as_pointer()), align=2)
    bit = _broadcast(builder, kind, builder.shl(_i16(1), builder.trunc(k, _i16)))
    return builder.bitcast(builder.icmp_unsigned("!=", builder.and_(elements, bit), ir.Constant(kind, [0] * 64)), _i64)


# ---- sums and layout
# --------------------------------------------------------------------------------------------------


def _folded(builder, value, combine):
    """The 16 lanes combined to a scalar, always in the same order."""
    for step in (8, 4, 2, 1):
        rotated = _shuffle(builder, value, value, [(lane + step) % WIDTH for lane in range(WIDTH)])
        value = combine(builder, value, rotated)
    return builder.extract_element(value, _i32(0))


@_function(float32, Lanes)
def lane_sum(builder, lanes):
    """Sum of the 16 lanes, always in the same order."""
    return _folded(builder, lanes, _add)


@_function(float32, Lanes)
def lane_min(builder, lanes):
    """Smallest of the 16 lanes; a NaN lane may be passed over or returned."""
    return _folded(builder, lanes, lambda builder, x, y: _smaller(builder, y, x))


@_function(Lanes, UniTuple)
def lane_sums(builder, vectors):
    """``lane_sums((v0, v1, …))``: lane i of the result is the sum of the lanes of vector i, 0 beyond the last."""
    vectors = vectors + [_constant(0.0)] * (WIDTH - len(vectors))
    for step in (1, 2, 4, 8):
        # Lanes with this bit now belong to the second of two vectors; each lane adds its partner's half sum.
        second_half = [bool(lane & step) for lane in range(WIDTH)]
        kept = ir.Constant(_VM, second_half)
        moved = [(lane ^ step) + WIDTH * of_second for lane, of_second in enumerate(second_half)]
        merged = []
        for first, second in zip(vectors[0::2], vectors[1::2], strict=True):
            own, other = builder.select(kept, second, first), _shuffle(builder, first, second, moved)
            merged.append(_add(builder, own, other))
        vectors = merged
    return vectors[0]


def _transposed(builder, rows):
    """``transpose((v0, …, v15))``: vector i of the result holds lane i of every argument."""
    # Four rounds that swap blocks of 8, 4, 2 and 1 lanes.
    for block in (8, 4, 2, 1):
        low = [lane if not lane & block else WIDTH + lane - block for lane in range(WIDTH)]
        high = [lane + block if not lane & block else WIDTH + lane for lane in range(WIDTH)]
        swapped = [None] * WIDTH
        for i in range(WIDTH):
            if not i & block:
                swapped[i] = _shuffle(builder, rows[i], rows[i + block], low)
                swapped[i + block] = _shuffle(builder, rows[i], rows[i + block], high)
        rows = swapped
    return rows


_SIXTEEN = UniTuple(Lanes, WIDTH)


@_function(_SIXTEEN, Array, int64)
def load_vectors(builder, array, offset):
    """``load_vectors(array, offset)``: 256 consecutive floats as sixteen vectors."""
    first = builder.gep(array, [offset])
    return [_read(builder, builder.gep(first, [_i64(WIDTH * part)])) for part in range(WIDTH)]


transpose = _function(_SIXTEEN, _SIXTEEN)(_transposed)


def _row_addresses(builder, array, indices, start, stride):
    """Where the rows of ``array`` begin whose numbers are ``indices[start:start + 16]``."""
    for lane in range(WIDTH):
        index = builder.load(builder.gep(indices, [builder.add(start, _i64(lane))]))
        yield builder.gep(array, [builder.mul(builder.sext(index, _i64), stride)])


@_function(_SIXTEEN, Array, Array, int64, int64, int64)
def gather_columns(builder, array, indices, start, stride, column):
    """``gather_columns(array, indices, start, stride, column)``: 16 columns of 16 chosen rows.

    Vector c of the result holds ``array[indices[start + lane] * stride + column + c]`` for each lane.
    """
    addresses = _row_addresses(builder, array, indices, start, stride)
    return _transposed(builder, [_read(builder, builder.gep(address, [column])) for address in addresses])


def _gatherer(columns):
    @_function(UniTuple(Lanes, columns), Array, Array, int64)
    def gather_rows(builder, array, indices, start):
        """``gather_rows(array, indices, start)``: 16 chosen rows, column by column."""
        vectors = [ir.Constant(_VF, ir.Undefined)] * columns
        for lane, address in enumerate(_row_addresses(builder, array, indices, start, _i64(columns))):
            for column in range(columns):
                element = builder.load(builder.gep(address, [_i64(column)]))
                vectors[column] = builder.insert_element(vectors[column], element, _i32(lane))
        return vectors

    return gather_rows


def _scatterer(columns):
    @_function(void, Array, Array, int64, UniTuple(Lanes, columns))
    def scatter_rows(builder, array, indices, start, vectors):
        """``scatter_rows(array, indices, start, vectors)``: the inverse of ``gather_rows``."""
        for lane, address in enumerate(_row_addresses(builder, array, indices, start, _i64(columns))):
            for column in range(columns):
                element = builder.extract_element(vectors[column], _i32(lane))
                builder.store(element, builder.gep(address, [_i64(column)]))

    return scatter_rows


gather_rows1, gather_rows3, gather_rows4 = map(_gatherer, (1, 3, 4))
scatter_rows1, scatter_rows3, scatter_rows4 = map(_scatterer, (1, 3, 4))


def _columns(builder, rows, count):
    """The columns of 16 rows that lie one after the other."""
    return [_shuffle(builder, rows, rows, range(column, WIDTH * count, count)) for column in range(count)]


def _row_loader(columns):
    @_function(UniTuple(Lanes, columns), Array, int64)
    def load_rows(builder, array, offset):
        """``load_rows(array, offset)``: 16 consecutive rows, column by column."""
        return _columns(builder, _read(builder, builder.gep(array, [offset]), WIDTH * columns), columns)

    return load_rows


load_rows3, load_rows4 = map(_row_loader, (3, 4))


def _line_addresses(builder, image, offset, stride):
    """Where the rows of a block of an image begin."""
    return [builder.gep(image, [builder.add(offset, builder.mul(_i64(row), stride))]) for row in range(4)]


def _joined(builder, parts):
    """The lanes of two or four vectors of one width, one after the other."""
    while len(parts) > 1:
        pairs = zip(parts[0::2], parts[1::2], strict=True)
        parts = [_shuffle(builder, *pair, range(2 * pair[0].type.count)) for pair in pairs]
    return parts[0]


def _block_loader(channels):
    """``offset`` is the element of a block's first pixel, ``stride`` the floats from the start of a row to the next."""

    @_function(UniTuple(Lanes, channels), Array, int64, int64)
    def load_block(builder, image, offset, stride):
        """``load_block(image, offset, stride)``: a 4x4 block of an image, channel by channel."""
        addresses = _line_addresses(builder, image, offset, stride)
        lines = [_read(builder, address, 4 * channels) for address in addresses]
        return _columns(builder, _joined(builder, lines), channels)

    return load_block


def _block_storer(channels):
    @_function(void, Array, int64, int64, UniTuple(Lanes, channels))
    def store_block(builder, image, offset, stride, planes):
        """``store_block(image, offset, stride, planes)``: the inverse of ``load_block``."""
        block = _joined(builder, [*planes, planes[0]])
        for row, address in enumerate(_line_addresses(builder, image, offset, stride)):
            order = [WIDTH * channel + 4 * row + column for column in range(4) for channel in range(channels)]
            _write(builder, address, _shuffle(builder, block, block, order))

    return store_block


load_block1, load_block3 = map(_block_loader, (1, 3))
store_block1, store_block3 = map(_block_storer, (1, 3))
