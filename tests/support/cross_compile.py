"""Compile CPU kernels for a processor that need not be there: ``TRIPLE PROCESSOR KERNEL…`` on the command line.

Prints as JSON, by kernel: its machine instructions, how many of them move vectors from or to the stack, the bytes of
its stack, and the names of what it calls. Loops run on one thread here, as only the code inside them is looked at.
"""

from __future__ import annotations

import json
import re
import sys
from typing import Any

import llvmlite.binding as llvm
from kernel_list import module_of, name_of, own_part

from nsvq_lightning.compute.ahead import kernels


def aim_at(triple: str, processor: str) -> None:
    """Let Numba compile for another processor; it could not run what comes out."""
    from numba.core import config

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    llvm.get_process_triple = lambda: triple
    config.CPU_NAME, config.CPU_FEATURES = processor, ""


def assembly(name: str) -> str:
    """Assembly of what a thread does of a kernel."""
    from numba import types
    from numba.core import compiler, compiler_lock
    from numba.core.registry import cpu_target

    kernel, (_, arguments) = next(found for found in kernels() if name == f"{module_of(found[0])}.{name_of(found[0])}")
    part = own_part(kernel)
    flags = compiler.Flags()
    cpu_target.options.parse_as_flags(flags, part.targetoptions)
    flags.no_compile = True
    contexts = cpu_target.typing_context, cpu_target.target_context
    given = types.int64, types.int64, *arguments
    library = compiler.compile_extra(*contexts, part.py_func, given, types.none, flags, {}).library
    with compiler_lock.global_compiler_lock:
        library._ensure_finalized()
    return str(library.get_asm_str())


def measured(text: str) -> dict[str, Any]:
    """What the kernel itself is made of, without the wrappers that Python calls."""
    body: list[str] = []
    inside = False
    for line in text.splitlines():
        if label := re.match(r'"?([^\s".][^\s"]*)"?:', line):
            inside = label[1].startswith("_ZN14nsvq_lightning")
        elif inside and re.match(r"\s+[a-z]", line):
            body.append(line.strip())
    code = "\n".join(body)
    stack = re.findall(r"^sub\w*\s+(?:sp, sp, #(\d+)|\$(\d+), %rsp)", code, re.MULTILINE)
    return {
        "instructions": len(body),
        "spills": len(re.findall(r"^(?=.*(?:%[xyz]mm|\bq\d))(?=.*(?:\(%r[sb]p\)|\[sp|\[x29))", code, re.MULTILINE)),
        "stack": max((int(arm or intel) for arm, intel in stack), default=0),
        "calls": sorted(set(re.findall(r"^(?:bl\s+|callq?\s+|movabsq\s+\$)([A-Za-z_]\w*)", code, re.MULTILINE))),
    }


if __name__ == "__main__":
    aim_at(*sys.argv[1:3])
    json.dump({name: measured(assembly(name)) for name in sys.argv[3:]}, sys.stdout)
