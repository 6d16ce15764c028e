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
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

WIDTH = 16

_f32, _i1, _i8, _i16, _i32, _i64 = ir.FloatType(), *(ir.IntType(bits) for bits in (1, 8, 16, 32, 64))
_VF, _VI, _VM = (ir.VectorType(kind, WIDTH) for kind in (_f32, _i32, _i1))
_CONTRACT = ("contract", "nsz")


class _VectorType(types.Type):
    """A Numba type that is one LLVM vector register."""


Lanes = _VectorType("float32x16")
Mask = _VectorType("mask16")
_LLVM_TYPE = {Lanes.name: _VF, Mask.name: _VM}


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector_type: _VectorType) -> None:
        super().__init__(manager, vector_type, _LLVM_TYPE[vector_type.name])


# ---- declaring operators and functions
# --------------------------------------------------------------------------------


def _operator(symbol: Callable[..., Any], result: types.Type, arguments: tuple[types.Type, ...], emit: Any) -> None:
    """Define the operator ``symbol`` for vector arguments; ``emit(builder, *values)`` builds the instructions."""
    name = f"_{symbol.__name__}_{'_'.join(argument.name for argument in arguments)}"
    infer_global(symbol)(type(name, (ConcreteTemplate,), {"cases": [signature(result, *arguments)]}))
    lower_builtin(symbol, *arguments)(lambda context, builder, sig, values: emit(builder, *values))


def _binary(symbol: Callable[..., Any], result: types.Type, emit: Callable[..., Any]) -> None:
    """Define the operator ``symbol`` between two vectors, and between a vector and a scalar."""

    def spread(builder: Any, *values: Any) -> Any:
        return emit(builder, *(_broadcast(builder, _VF, x) if x.type == _f32 else x for x in values))

    for arguments in ((Lanes, Lanes), (Lanes, types.float32), (types.float32, Lanes)):
        _operator(symbol, result, arguments, spread)


def _function(result: Any, arity: int) -> Callable[[Any], Any]:
    """Turn ``emit(context, builder, sig, values)`` into an intrinsic of ``arity`` arguments.

    ``result`` is the Numba type of the result, or a function from the argument types to it.
    """

    def decorate(emit: Any) -> Any:
        names = ", ".join("abcdefgh"[:arity])

        def declare(*arguments: Any) -> tuple[Any, Any]:
            kind = result if isinstance(result, types.Type) else result(*arguments)
            return signature(kind, *arguments), emit

        # Numba reads the arity from the function itself, so it has to be spelled out.
        namespace: dict[str, Any] = {"declare": declare}
        exec(f"def {emit.__name__}(typingctx, {names}):\n    return declare({names})", namespace)
        made = namespace[emit.__name__]
        made.__doc__, made.__module__ = emit.__doc__, __name__
        return intrinsic(made)

    return decorate


# ---- building blocks in LLVM
# ------------------------------------------------------------------------------------------


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VF, [float(np.float32(value))] * WIDTH)


def _integers(value: int) -> ir.Constant:
    return ir.Constant(_VI, [value] * WIDTH)


def _shuffle(builder: Any, first: Any, second: Any, lanes: Sequence[int]) -> Any:
    return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(_i32, len(lanes)), list(lanes)))


def _broadcast(builder: Any, kind: ir.VectorType, scalar: Any) -> Any:
    undefined = ir.Constant(kind, ir.Undefined)
    inserted = builder.insert_element(undefined, scalar, _i32(0))
    return _shuffle(builder, inserted, undefined, [0] * kind.count)


def _llvm(builder: Any, name: str, result: Any, values: Sequence[Any]) -> Any:
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


def _fused(builder: Any, x: Any, y: Any, z: Any) -> Any:
    # Not llvm.fma: where the target processor lacks that instruction, llvm.fma calls a library function for every lane,
    # while llvm.fmuladd multiplies and adds.
    return _llvm(builder, "llvm.fmuladd.v16f32", _VF, [x, y, z])


def _polynomial(builder: Any, x: Any, coefficients: Sequence[float]) -> Any:
    """Horner's rule, highest power first."""
    value = _constant(coefficients[0])
    for coefficient in coefficients[1:]:
        value = _fused(builder, value, x, _constant(coefficient))
    return value


def _address(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    return builder.gep(cgutils.create_struct_proxy(array_type)(context, builder, array).data, [offset])


def _read(builder: Any, address: Any, count: int = WIDTH) -> Any:
    return builder.load(builder.bitcast(address, ir.VectorType(_f32, count).as_pointer()), align=4)


def _write(builder: Any, address: Any, value: Any) -> None:
    builder.store(value, builder.bitcast(address, value.type.as_pointer()), align=4)


# ---- operators
# --------------------------------------------------------------------------------------------------------


def _flagged(name: str) -> Callable[..., Any]:
    return lambda builder, x, y: getattr(builder, name)(x, y, flags=_CONTRACT)


def _compared(symbol: str) -> Callable[..., Any]:
    return lambda builder, x, y: builder.fcmp_ordered(symbol, x, y)


_binary(operator.add, Lanes, _flagged("fadd"))
_binary(operator.sub, Lanes, _flagged("fsub"))
_binary(operator.mul, Lanes, _flagged("fmul"))
_binary(operator.truediv, Lanes, lambda builder, x, y: builder.fdiv(x, y))
_operator(operator.neg, Lanes, (Lanes,), lambda builder, x: builder.fneg(x))
for _symbol, _comparison in ((operator.ge, ">="), (operator.le, "<="), (operator.lt, "<"), (operator.gt, ">")):
    _binary(_symbol, Mask, _compared(_comparison))
_operator(operator.and_, Mask, (Mask, Mask), lambda builder, x, y: builder.and_(x, y))
_operator(operator.or_, Mask, (Mask, Mask), lambda builder, x, y: builder.or_(x, y))
_operator(operator.invert, Mask, (Mask,), lambda builder, x: builder.not_(x))

# ---- memory
# -----------------------------------------------------------------------------------------------------------


@_function(Lanes, 1)
def broadcast(context, builder, sig, values):
    """The scalar in every lane."""
    return _broadcast(builder, _VF, context.cast(builder, values[0], sig.args[0], types.float32))


@_function(Lanes, 2)
def load_one(context, builder, sig, values):
    """``load_one(array, offset)``: one float in every lane."""
    return _broadcast(builder, _VF, builder.load(_address(context, builder, sig.args[0], *values)))


@_function(Lanes, 2)
def load(context, builder, sig, values):
    """``load(array, offset)``: 16 consecutive floats."""
    return _read(builder, _address(context, builder, sig.args[0], *values))


@_function(types.void, 3)
def store(context, builder, sig, values):
    """``store(array, offset, lanes)``: 16 consecutive floats."""
    (value,) = _spread(context, builder, sig.args[2:], values[2:])
    _write(builder, _address(context, builder, sig.args[0], *values[:2]), value)
    return context.get_dummy_value()


@_function(lambda array, offset: array.dtype, 2)
def get(context, builder, sig, values):
    """``get(array, offset)``: one element, without the sign check of Numba's indexing."""
    return builder.load(_address(context, builder, sig.args[0], *values))


@_function(types.void, 3)
def put(context, builder, sig, values):
    """``put(array, offset, value)``: one element, without the sign check of Numba's indexing."""
    value = context.cast(builder, values[2], sig.args[2], sig.args[0].dtype)
    builder.store(value, _address(context, builder, sig.args[0], *values[:2]))
    return context.get_dummy_value()


@_function(types.void, 2)
def prefetch(context, builder, sig, values):
    """``prefetch(array, offset)``: ask for the cache line of one element."""
    address = builder.bitcast(_address(context, builder, sig.args[0], *values), _i8.as_pointer())
    _llvm(builder, "llvm.prefetch.p0", ir.VoidType(), [address, _i32(0), _i32(3), _i32(1)])
    return context.get_dummy_value()


@_function(types.int64, 3)
def fetch_add(context, builder, sig, values):
    """``fetch_add(int64_array, offset, amount)``: atomically add and return the old value (for handing out work)."""
    address = _address(context, builder, sig.args[0], *values[:2])
    return builder.atomic_rmw("add", address, values[2], "monotonic")


# ---- arithmetic
# -------------------------------------------------------------------------------------------------------


def _spread(context: Any, builder: Any, kinds: Sequence[Any], values: Sequence[Any]) -> list[Any]:
    """The arguments, with vectors in place of scalars."""
    return [
        value if kind in (Lanes, Mask) else _broadcast(builder, _VF, context.cast(builder, value, kind, types.float32))
        for kind, value in zip(kinds, values, strict=True)
    ]


@_function(Lanes, 3)
def fma(context, builder, sig, values):
    """``x * y + z``, with one rounding where the processor supports it."""
    return _fused(builder, *_spread(context, builder, sig.args, values))


@_function(Lanes, 3)
def fnma(context, builder, sig, values):
    """``z - x * y``, with one rounding where the processor supports it."""
    x, y, z = _spread(context, builder, sig.args, values)
    return _fused(builder, builder.fneg(x), y, z)


def _choice(name: str, symbol: str, doc: str) -> Any:
    def emit(context, builder, sig, values):
        x, y = _spread(context, builder, sig.args, values)
        return builder.select(builder.fcmp_ordered(symbol, x, y), x, y)

    emit.__name__, emit.__doc__ = name, doc
    return _function(Lanes, 2)(emit)


minimum = _choice("minimum", "<", "The smaller of two; the second one where the first is NaN.")
maximum = _choice("maximum", ">", "The larger of two; the second one where the first is NaN.")


def _unary(name: str, doc: str) -> Any:
    def emit(context, builder, sig, values):
        return _llvm(builder, f"llvm.{name}.v16f32", _VF, values)

    emit.__name__, emit.__doc__ = name, doc
    return _function(Lanes, 1)(emit)


sqrt = _unary("sqrt", "Square root; NaN below zero.")
floor = _unary("floor", "Largest integer not above.")
ceil = _unary("ceil", "Smallest integer not below.")
abs = _unary("fabs", "Absolute value.")


@_function(Lanes, 3)
def where(context, builder, sig, values):
    """``where(mask, x, y)``: x where the mask is set, else y."""
    return builder.select(*_spread(context, builder, sig.args, values))


@_function(Lanes, 1)
def exp2(context, builder, sig, values):
    """2**x for |x| < 126, relative error 2e-7; no check outside."""
    # Adding 1.5·2^23 rounds to an integer in the low bits of the sum, ready to become an exponent.
    magic = _constant(12582912.0)
    shifted = builder.fadd(values[0], magic)
    fraction = builder.fsub(values[0], builder.fsub(shifted, magic))
    # Minimax polynomial of 2**f on [-1/2, 1/2].
    powers = (1.32764715e-3, 9.67554133e-3, 5.55071327e-2, 2.40221197e-1, 6.93146967e-1, 1.00000007)
    power = _polynomial(builder, fraction, powers)
    exponent = builder.shl(builder.bitcast(shifted, _VI), _integers(23))
    return builder.bitcast(builder.add(builder.bitcast(power, _VI), exponent), _VF)


@_function(Lanes, 1)
def log2(context, builder, sig, values):
    """Binary logarithm of a positive normal number, absolute error 1e-7."""
    bits = builder.bitcast(values[0], _VI)
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


@_function(types.int64, 1)
def mask_bits(context, builder, sig, values):
    """The mask as an integer, lane 0 in the lowest bit."""
    return builder.zext(builder.bitcast(values[0], _i16), _i64)


@_function(types.int64, 1)
def lowest_bit(context, builder, sig, values):
    """Position of the lowest set bit of an integer; 64 for 0."""
    return builder.cttz(values[0], _i1(0))


@_function(types.int64, 3)
def column_bits(context, builder, sig, values):
    """``column_bits(uint16_array, offset, k)``: bit k of 64 consecutive elements as one 64-bit integer."""
    kind = ir.VectorType(_i16, 64)
    address = _address(context, builder, sig.args[0], *values[:2])
    elements = builder.load(builder.bitcast(address, kind.as_pointer()), align=2)
    bit = _broadcast(builder, kind, builder.shl(_i16(1), builder.trunc(values[2], _i16)))
    return builder.bitcast(builder.icmp_unsigned("!=", builder.and_(elements, bit), ir.Constant(kind, [0] * 64)), _i64)


# ---- sums and layout
# --------------------------------------------------------------------------------------------------


def _folded(builder: Any, value: Any, combine: Callable[[Any, Any], Any]) -> Any:
    """The 16 lanes combined to a scalar, always in the same order."""
    for step in (8, 4, 2, 1):
        rotated = _shuffle(builder, value, value, [(lane + step) % WIDTH for lane in range(WIDTH)])
        value = combine(value, rotated)
    return builder.extract_element(value, _i32(0))


@_function(types.float32, 1)
def lane_sum(context, builder, sig, values):
    """Sum of the 16 lanes, always in the same order."""
    return _folded(builder, values[0], lambda x, y: builder.fadd(x, y, flags=_CONTRACT))


@_function(types.float32, 1)
def lane_min(context, builder, sig, values):
    """Smallest of the 16 lanes; a NaN lane may be passed over or returned."""
    return _folded(builder, values[0], lambda x, y: builder.select(builder.fcmp_ordered("<", y, x), y, x))


@_function(Lanes, 1)
def lane_sums(context, builder, sig, values):
    """``lane_sums((v0, v1, …))``: lane i of the result is the sum of the lanes of vector i, 0 beyond the last."""
    vectors = list(cgutils.unpack_tuple(builder, values[0], len(sig.args[0])))
    vectors += [_constant(0.0)] * (WIDTH - len(vectors))
    for step in (1, 2, 4, 8):
        # Lanes with this bit now belong to the second of two vectors; each lane adds its partner's half sum.
        second_half = [bool(lane & step) for lane in range(WIDTH)]
        kept = ir.Constant(_VM, second_half)
        moved = [(lane ^ step) + WIDTH * of_second for lane, of_second in enumerate(second_half)]
        merged = []
        for first, second in zip(vectors[0::2], vectors[1::2], strict=True):
            own, other = builder.select(kept, second, first), _shuffle(builder, first, second, moved)
            merged.append(builder.fadd(own, other, flags=_CONTRACT))
        vectors = merged
    return vectors[0]


def _transposed(builder: Any, rows: Sequence[Any]) -> list[Any]:
    """Transpose 16 vectors as a 16x16 matrix: four rounds that swap blocks of 8, 4, 2 and 1 lanes."""
    rows = list(rows)
    for block in (8, 4, 2, 1):
        low = [lane if not lane & block else WIDTH + lane - block for lane in range(WIDTH)]
        high = [lane + block if not lane & block else WIDTH + lane for lane in range(WIDTH)]
        swapped: list[Any] = [None] * WIDTH
        for i in range(WIDTH):
            if not i & block:
                swapped[i] = _shuffle(builder, rows[i], rows[i + block], low)
                swapped[i + block] = _shuffle(builder, rows[i], rows[i + block], high)
        rows = swapped
    return rows


_SIXTEEN = types.UniTuple(Lanes, WIDTH)


@_function(_SIXTEEN, 2)
def load_vectors(context, builder, sig, values):
    """``load_vectors(array, offset)``: 256 consecutive floats as sixteen vectors."""
    first = _address(context, builder, sig.args[0], *values)
    vectors = [_read(builder, builder.gep(first, [_i64(WIDTH * part)])) for part in range(WIDTH)]
    return context.make_tuple(builder, sig.return_type, vectors)


@_function(_SIXTEEN, 1)
def transpose(context, builder, sig, values):
    """``transpose((v0, …, v15))``: vector i of the result holds lane i of every argument."""
    rows = _transposed(builder, cgutils.unpack_tuple(builder, values[0], WIDTH))
    return context.make_tuple(builder, sig.return_type, rows)


def _row_address(
    context: Any, builder: Any, sig: Any, array: Any, indices: Any, start: Any, lane: int, stride: Any
) -> Any:
    """Where the row of ``array`` begins whose number is ``indices[start + lane]``."""
    index = builder.load(_address(context, builder, sig.args[1], indices, builder.add(start, _i64(lane))))
    index = context.cast(builder, index, sig.args[1].dtype, types.int64)
    return _address(context, builder, sig.args[0], array, builder.mul(index, stride))


@_function(_SIXTEEN, 5)
def gather_columns(context, builder, sig, values):
    """``gather_columns(array, indices, start, stride, column)``: 16 columns of 16 chosen rows.

    Vector c of the result holds ``array[indices[start + lane] * stride + column + c]`` for each lane.
    """
    array, indices, start, stride, column = values
    rows = []
    for lane in range(WIDTH):
        address = _row_address(context, builder, sig, array, indices, start, lane, stride)
        rows.append(_read(builder, builder.gep(address, [column])))
    return context.make_tuple(builder, sig.return_type, _transposed(builder, rows))


def _gatherer(columns: int) -> Any:
    def emit(context, builder, sig, values):
        array, indices, start = values
        vectors = [ir.Constant(_VF, ir.Undefined)] * columns
        for lane in range(WIDTH):
            address = _row_address(context, builder, sig, array, indices, start, lane, _i64(columns))
            for column in range(columns):
                element = builder.load(builder.gep(address, [_i64(column)]))
                vectors[column] = builder.insert_element(vectors[column], element, _i32(lane))
        return context.make_tuple(builder, sig.return_type, vectors)

    emit.__name__ = f"gather_rows{columns}"
    emit.__doc__ = f"``gather_rows{columns}(array, indices, start)``: 16 chosen rows of {columns} floats as vectors."
    return _function(types.UniTuple(Lanes, columns), 3)(emit)


def _scatterer(columns: int) -> Any:
    def emit(context, builder, sig, values):
        array, indices, start, rows = values
        vectors = cgutils.unpack_tuple(builder, rows, columns)
        for lane in range(WIDTH):
            address = _row_address(context, builder, sig, array, indices, start, lane, _i64(columns))
            for column in range(columns):
                element = builder.extract_element(vectors[column], _i32(lane))
                builder.store(element, builder.gep(address, [_i64(column)]))
        return context.get_dummy_value()

    emit.__name__ = f"scatter_rows{columns}"
    emit.__doc__ = f"``scatter_rows{columns}(array, indices, start, rows)``: the inverse of ``gather_rows{columns}``."
    return _function(types.void, 4)(emit)


gather_rows1, gather_rows3, gather_rows4 = (_gatherer(columns) for columns in (1, 3, 4))
scatter_rows1, scatter_rows3, scatter_rows4 = (_scatterer(columns) for columns in (1, 3, 4))


def _row_loader(columns: int) -> Any:
    def emit(context, builder, sig, values):
        rows = _read(builder, _address(context, builder, sig.args[0], *values), WIDTH * columns)
        vectors = [_shuffle(builder, rows, rows, range(column, WIDTH * columns, columns)) for column in range(columns)]
        return context.make_tuple(builder, sig.return_type, vectors)

    emit.__name__ = f"load_rows{columns}"
    emit.__doc__ = f"``load_rows{columns}(array, offset)``: 16 consecutive rows of {columns} floats as vectors."
    return _function(types.UniTuple(Lanes, columns), 2)(emit)


load_rows3, load_rows4 = _row_loader(3), _row_loader(4)


def _line(context: Any, builder: Any, sig: Any, image: Any, offset: Any, stride: Any, row: int) -> Any:
    """Where a row of a block of an image begins."""
    return _address(context, builder, sig.args[0], image, builder.add(offset, builder.mul(_i64(row), stride)))


def _joined(builder: Any, parts: Sequence[Any]) -> Any:
    """The lanes of two or four vectors of one width, one after the other."""
    while len(parts) > 1:
        pairs = zip(parts[0::2], parts[1::2], strict=True)
        parts = [_shuffle(builder, *pair, range(2 * pair[0].type.count)) for pair in pairs]
    return parts[0]


def _block_loader(channels: int) -> Any:
    """``offset`` is the element of a block's first pixel, ``stride`` the floats from the start of a row to the next."""

    def emit(context, builder, sig, values):
        lines = [_line(context, builder, sig, *values, row) for row in range(4)]
        block = _joined(builder, [_read(builder, line, 4 * channels) for line in lines])
        planes = [_shuffle(builder, block, block, range(k, WIDTH * channels, channels)) for k in range(channels)]
        return context.make_tuple(builder, sig.return_type, planes)

    emit.__name__ = f"load_block{channels}"
    emit.__doc__ = f"``load_block{channels}(image, offset, stride)``: a 4x4 block of an image, {channels} channels."
    return _function(types.UniTuple(Lanes, channels), 3)(emit)


def _block_storer(channels: int) -> Any:
    def emit(context, builder, sig, values):
        *place, planes = values
        planes = cgutils.unpack_tuple(builder, planes, channels)
        block = _joined(builder, [*planes, planes[0]])
        for row in range(4):
            order = [16 * channel + 4 * row + column for column in range(4) for channel in range(channels)]
            _write(builder, _line(context, builder, sig, *place, row), _shuffle(builder, block, block, order))
        return context.get_dummy_value()

    emit.__name__ = f"store_block{channels}"
    emit.__doc__ = f"``store_block{channels}(image, offset, stride, planes)``: the inverse of ``load_block{channels}``."
    return _function(types.void, 4)(emit)


load_block1, load_block3 = _block_loader(1), _block_loader(3)
store_block1, store_block3 = _block_storer(1), _block_storer(3)
