"""Kernels of which every thread does a part.

Numba's ``prange`` finds out by itself what may run in parallel and makes a function of each loop, which takes as long
as all else in a compilation. Here the function is there already, and Numba's threads call it.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from nsvq_lightning.compute.jit import kernel, part, start_threads

_byte_p, _i64 = ir.IntType(8).as_pointer(), ir.IntType(64)
# What Numba's threads call, with where a range of parts begins and how many it has.
_RANGE = ir.FunctionType(ir.VoidType(), [_byte_p.as_pointer(), _i64.as_pointer(), _i64.as_pointer(), _byte_p])
_PARALLEL_FOR = ir.FunctionType(ir.VoidType(), [_byte_p] * 5 + [_i64] * 3)


@intrinsic
def in_parallel(typingctx: Any, function: Any, parts: Any, arguments: Any) -> Any:
    """``in_parallel(function, parts, arguments)``: call ``function(part, parts, *arguments)`` for every part.

    Returns the sum of what the calls return where that is an integer, else 0.

    Raises:
        MemoryError: A call failed, for which there is no other reason.
    """
    given = types.int64, types.int64, *arguments
    typingctx.resolve_function_type(function, given, {})  # compiles it
    start_threads()

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        compiled = function.dispatcher.overloads[given]
        context.active_code_library.add_linking_library(compiled.library)
        # What all threads see: number of parts, sum of what the calls return, number of those that failed, arguments.
        state = cgutils.alloca_once(builder, ir.LiteralStructType([_i64, _i64, _i64, values[2].type]))
        for place, value in enumerate((values[1], _i64(0), _i64(0), values[2])):
            builder.store(value, cgutils.gep_inbounds(builder, state, 0, place))
        share = ir.Function(builder.module, _RANGE, f"{compiled.fndesc.mangled_name}.share")
        share.linkage = "internal"
        _emit_share(context, ir.IRBuilder(share.append_basic_block()), compiled, state.type, arguments)
        # A base address of 0 that moves by 1 from part to part: the number of the part.
        base, moves = cgutils.alloca_once_value(builder, _byte_p(None)), cgutils.alloca_once_value(builder, _i64(1))
        count = cgutils.alloca_once_value(builder, values[1])
        pointers = [builder.bitcast(pointer, _byte_p) for pointer in (share, base, count, moves, state)]
        run = cgutils.get_or_insert_function(builder.module, _PARALLEL_FOR, "numba_parallel_for")
        threads = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_i64, []), "get_num_threads")
        builder.call(run, [*pointers, _i64(0), _i64(1), builder.call(threads, [])])
        failures = builder.load(cgutils.gep_inbounds(builder, state, 0, 2))
        with builder.if_then(builder.icmp_signed("!=", failures, _i64(0)), likely=False):
            context.call_conv.return_user_exc(builder, MemoryError, ("a kernel could not allocate memory",))
        return builder.load(cgutils.gep_inbounds(builder, state, 0, 1))

    return types.int64(function, parts, arguments), emit


def _emit_share(context: Any, builder: Any, compiled: Any, state_type: Any, arguments: Any) -> None:
    """The calls for a range of parts, by one thread."""
    bases, counts, _, data = builder.function.args
    state = builder.bitcast(data, state_type)
    first = builder.ptrtoint(builder.load(bases), _i64)
    parts, _, _, packed = (builder.load(cgutils.gep_inbounds(builder, state, 0, place)) for place in range(4))
    values = cgutils.unpack_tuple(builder, packed, len(arguments))
    with cgutils.for_range(builder, builder.load(counts)) as loop:
        given = [builder.add(first, loop.index), parts, *values]
        status, result = context.call_internal_no_propagate(builder, compiled.fndesc, compiled.signature, given)
        found = [(2, builder.zext(status.is_error, _i64))]
        if compiled.signature.return_type == types.int64:
            found.append((1, result))
        for place, value in found:
            builder.atomic_rmw("add", cgutils.gep_inbounds(builder, state, 0, place), value, "monotonic")
    builder.ret_void()


def parallel(function: Callable[..., Any]) -> Any:
    """Make a kernel, called ``kernel(parts, *arguments)``, of a function ``(part, parts, *arguments)`` of one part."""
    one = part(function)

    def whole(parts, *arguments):
        return in_parallel(one, parts, arguments)

    whole.__module__, whole.__name__, whole.__qualname__ = function.__module__, function.__name__, function.__qualname__
    return kernel(whole)
