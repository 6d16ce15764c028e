"""How kernels are compiled, cached and run in parallel, and how long compiling has taken.

A kernel is compiled at its first call on a machine and read from the disk cache from then on. Compiling is not
training, so clocks leave it out.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from time import perf_counter
from typing import Any
from weakref import WeakSet

import numba
import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core import cgutils, event
from numba.extending import intrinsic

from nsvq_lightning.compute import kernel_cache
from nsvq_lightning.top_level import log

# What this module has made; a user's own functions are none of its business.
_ours: WeakSet[Any] = WeakSet()
# The process that has started threads.
_started: list[int] = []
_OPTIONS: dict[str, Any] = {
    # Products and sums may fuse; NaN and infinity keep their meaning because this package's guards rely on them.
    "fastmath": {"contract", "nsz"},
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
    "no_cfunc_wrapper": True,
}
# What all threads see of a kernel: number of parts; the next one, and where to end; sum of what the calls return;
# number of those that failed; arguments.
PARTS, NEXT, END, SUM, FAILURES, ARGUMENTS = range(6)
_byte_p, _i64 = ir.IntType(8).as_pointer(), ir.IntType(64)


class _Compilations(event.Listener):
    """Times Numba's compilations, says so of the first, and has LLVM optimise helpers at a low level.

    LLVM optimises helpers again, with the kernel they are inlined into, whose level decides about speed. Helpers are
    most of what is compiled: at this level, and without a wrapper for Python, all takes half of the time.
    """

    def __init__(self) -> None:
        self.seconds = self.since = 0.0
        # LLVM's level before each compilation in progress, of a kernel and its helpers.
        self.levels: list[int] = []

    def on_start(self, compilation: Any) -> None:
        if compilation.data["dispatcher"] not in _ours:
            return
        if not self.levels:
            self.since = perf_counter()
            if self.seconds == 0:
                kept = kernel_cache.kernel_folder() or "no folder (NUMBA_CACHE_DIR names one)"
                log.info(f"compiling kernels, kept in {kept}: a quarter of a minute to one")
        level = numba.config.OPT
        self.levels.append(level)
        if compilation.data["dispatcher"].targetoptions.get("forceinline"):
            numba.config.OPT = type(level)(min(level, 1))

    def on_end(self, compilation: Any) -> None:
        dispatcher = compilation.data["dispatcher"]
        if dispatcher not in _ours:
            return
        failed = compilation.data["args"] not in dispatcher.overloads
        if failed and isinstance(dispatcher._cache, kernel_cache.KernelCache):
            dispatcher._cache.let_go()
        numba.config.OPT = self.levels.pop()
        if not self.levels:
            self.seconds += perf_counter() - self.since


_compilations = _Compilations()
event.register("numba:compile", _compilations)


def compile_seconds() -> float:
    """Seconds spent compiling CPU kernels in this process so far, or waiting for one that compiles them."""
    in_progress = perf_counter() - _compilations.since if _compilations.levels else 0.0
    return _compilations.seconds + in_progress + kernel_cache.seconds_waited


class _Cache(kernel_cache.KernelCache):
    """Its first question to the disk is the first that happens when a kernel is called."""

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        _start_threads()
        return super()._load_overload(sig, target_context)


@cache
def _start_threads() -> None:
    """Start Numba's threads, which tells OpenMP to use all cores, and give torch its own setting back.

    Processes that are forked from now on have none of these, and would wait for them for ever: they use one.
    """
    _started.append(os.getpid())
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))
    count = torch.get_num_threads()
    numba.set_num_threads(numba.get_num_threads())
    torch.set_num_threads(count)


def check_threads() -> None:
    """Refuse a process that was forked from one that had run kernels, and has none of its threads.

    Raises:
        RuntimeError: It is such a process.
    """
    if _started and os.getpid() not in _started:
        raise RuntimeError(
            "kernels have run before this process was forked, and it lacks their threads: start it by spawn "
            '(multiprocessing.get_context("spawn")); in a notebook restart it and fit before anything is rendered, or '
            "fit on one device (devices=1)"
        )


# More parts than this would not balance the threads better.
MAX_PARTS = 64
# Type of the numeric literals in kernels; Python floats would promote their operands to float64.
F = np.float32


def inline(function: Callable[..., Any]) -> Any:
    """Compile a helper that only other kernels call."""
    dispatcher = numba.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)(function)
    _ours.add(dispatcher)
    return dispatcher


def kernel(function: Callable[..., Any], allocates: bool = True) -> Any:
    """Compile a kernel once per machine, and keep it on the disk (:mod:`nsvq_lightning.compute.kernel_cache`).

    A kernel that allocates no arrays may pass ``allocates=False``: the arrays that it passes to inlined helpers are
    then not reference-counted, with atomic operations, at every call, and a loop of few instructions becomes seven
    times as fast.

    It is compiled again when its module, or one that this imports, has changed.
    """
    dispatcher = numba.njit(_nrt=allocates, **_OPTIONS)(function)
    _ours.add(dispatcher)
    with suppress(RuntimeError):  # nowhere to keep it
        dispatcher._cache = _Cache(function)
    return dispatcher


# What Numba's threads call; the last argument is the state.
_RANGE = ir.FunctionType(ir.VoidType(), [_byte_p.as_pointer(), _i64.as_pointer(), _i64.as_pointer(), _byte_p])
_PARALLEL_FOR = ir.FunctionType(ir.VoidType(), [_byte_p] * 5 + [_i64] * 3)


@intrinsic
def in_parallel(typingctx: Any, helper: Any, parts: Any, arguments: Any) -> Any:
    """``in_parallel(helper, parts, arguments)``: call ``helper(part, parts, *arguments)`` for every part.

    Each thread takes the next part when it is done with one, so that a slow or busy core delays nobody; a single part
    wakes no thread. Returns the sum of what the calls return where that is an integer, else 0. Numba's own ``prange``
    finds out by itself what may run in parallel, and makes a function of each loop: half of the time of a compilation.

    Raises:
        MemoryError: A call failed, for which there is no other reason.
    """
    given = types.int64, types.int64, *arguments
    typingctx.resolve_function_type(helper, given, {})  # compiles it
    _start_threads()

    def emit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        compiled = helper.dispatcher.overloads[given]
        context.active_code_library.add_linking_library(compiled.library)
        packed = cgutils.pack_struct(builder, [values[1], _i64(0), values[1], _i64(0), _i64(0), values[2]])
        state = cgutils.alloca_once_value(builder, packed)
        share = ir.Function(builder.module, _RANGE, f"{compiled.fndesc.mangled_name}.share")
        share.linkage = "internal"
        _emit_share(context, ir.IRBuilder(share.append_basic_block()), compiled, state.type, arguments)
        threads = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_i64, []), "get_num_threads")
        # All threads, also for fewer parts: Numba would keep a smaller number for the kernels that follow, and OpenMP
        # end the other threads. They find a base address that does not move from share to share.
        count = builder.call(threads, [])
        base, moves, counts = (cgutils.alloca_once_value(builder, value) for value in (_byte_p(None), _i64(0), count))
        pointers = [builder.bitcast(pointer, _byte_p) for pointer in (share, base, counts, moves, state)]
        run = cgutils.get_or_insert_function(builder.module, _PARALLEL_FOR, "numba_parallel_for")
        several = builder.and_(*(builder.icmp_signed(">", number, _i64(1)) for number in (values[1], count)))
        with builder.if_else(several) as (several, one):
            with several:
                builder.call(run, [*pointers, _i64(0), _i64(1), count])
            with one:
                builder.call(share, [base, counts, moves, pointers[-1]])
        failures = builder.load(cgutils.gep_inbounds(builder, state, 0, FAILURES))
        with builder.if_then(builder.icmp_signed("!=", failures, _i64(0)), likely=False):
            context.call_conv.return_user_exc(builder, MemoryError, ("a kernel could not allocate memory",))
        return builder.load(cgutils.gep_inbounds(builder, state, 0, SUM))

    return types.int64(helper, parts, arguments), emit


def _emit_share(context: Any, builder: Any, compiled: Any, state_type: Any, arguments: Any) -> None:
    """The calls of one thread: it takes parts until there are none."""
    state = builder.bitcast(builder.function.args[-1], state_type)
    fields = [cgutils.gep_inbounds(builder, state, 0, place) for place in range(ARGUMENTS + 1)]
    parts, end, packed = (builder.load(fields[place]) for place in (PARTS, END, ARGUMENTS))
    values = cgutils.unpack_tuple(builder, packed, len(arguments))
    sums = [cgutils.alloca_once_value(builder, _i64(0)) for _ in (SUM, FAILURES)]
    take, call, leave = map(builder.append_basic_block, ("take", "call", "leave"))
    builder.branch(take)
    builder.position_at_end(take)
    part = builder.atomic_rmw("add", fields[NEXT], _i64(1), "monotonic")
    builder.cbranch(builder.icmp_signed("<", part, end), call, leave)
    builder.position_at_end(call)
    given = [part, parts, *values]
    status, result = context.call_internal_no_propagate(builder, compiled.fndesc, compiled.signature, given)
    found = result if compiled.signature.return_type == types.int64 else _i64(0)
    for own, value in zip(sums, (found, builder.zext(status.is_error, _i64)), strict=True):
        builder.store(builder.add(builder.load(own), value), own)
    builder.branch(take)
    builder.position_at_end(leave)
    for place, own in zip((SUM, FAILURES), sums, strict=True):
        builder.atomic_rmw("add", fields[place], builder.load(own), "monotonic")
    builder.ret_void()


def parallel(function: Callable[..., Any]) -> Any:
    """Make a kernel, called ``kernel(parts, *arguments)``, of a function ``(part, parts, *arguments)`` of one part."""
    one = inline(function)

    def whole(parts, *arguments):
        return in_parallel(one, parts, arguments)

    whole.__module__, whole.__name__, whole.__qualname__ = function.__module__, function.__name__, function.__qualname__
    return kernel(whole)


def parts_of(count: int, each: int) -> int:
    """How many parts to make of ``count`` things, of ``each`` or more: the same on any number of threads, 1 to 64."""
    thread_count()
    return max(1, min(MAX_PARTS, count // each))


def thread_count() -> int:
    """Number of threads that kernels use: torch's setting, so that one setting controls both."""
    _start_threads()
    count = min(torch.get_num_threads(), int(numba.config.NUMBA_NUM_THREADS))
    numba.set_num_threads(count)  # which it keeps by calling thread
    return count
