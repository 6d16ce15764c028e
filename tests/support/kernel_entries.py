"""Which functions hand memory to compiled kernels: found in the code, so that a new one is seen.

A kernel is what Numba or Triton has compiled and Python calls. A function *reaches* one if it names it, or names a
private function, method or class of its module that does; private ones are reached by nobody else. The public ones
that reach a kernel are the entry points: they have to check what they are given.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import torch
from numba.core.registry import CPUDispatcher

import nsvq_lightning

OPTIONAL = {"triton"}
MAKER = "kernel"
"""Name of the function that compiles: who names it makes a kernel."""

BY_DEVICE = (
    "quality.loss",
    "compute.rows",
    "quantize.nearest",
    "quantize.tracking",
    "quantize.nsvq",
    "quantize.kmeans",
)
"""The modules that choose kernels by device."""


def stand_in_for_a_gpu() -> None:
    """Let tensors that are on no GPU have its kernels, if they are float32."""
    for name in BY_DEVICE:
        module: Any = importlib.import_module(f"nsvq_lightning.{name}")
        module.kernels_for = lambda like: "cuda" if like.dtype == torch.float32 else None


def entry_points() -> dict[str, str]:
    """Compiler, ``numba`` or ``triton``, by full name of each entry point."""
    found = {}
    for module in _modules():
        kernels = _kernels(module)
        for alias, value in vars(module).items():
            if inspect.ismodule(value) and value.__name__.startswith("nsvq_lightning."):
                kernels |= {f"{alias}.{name}": kind for name, kind in _kernels(value).items()}
        if kernels or MAKER in vars(module):
            compiler = next(iter(kernels.values()), "numba")
            found |= {f"{module.__name__}.{name}": compiler for name in _reaching(module, set(kernels))}
    return found


def _kernels(module: ModuleType) -> dict[str, str]:
    """Compiler of each kernel among the names of a module."""
    return {name: kind for name, value in vars(module).items() if (kind := _compiler(value)) is not None}


def _modules() -> Iterator[ModuleType]:
    for info in pkgutil.walk_packages(nsvq_lightning.__path__, "nsvq_lightning."):
        if info.name.endswith(("__main__", ".compute.jit")):
            continue
        try:
            yield importlib.import_module(info.name)
        except ModuleNotFoundError as error:
            if error.name not in OPTIONAL:
                raise


def _compiler(value: Any) -> str | None:
    """What has compiled a value that Python calls as a kernel; None for helpers of kernels and all else."""
    if isinstance(value, CPUDispatcher):
        return None if value.targetoptions.get("forceinline") else "numba"
    return "triton" if type(value).__module__.startswith("triton.runtime") and hasattr(value, "fn") else None


def _reaching(module: ModuleType, kernels: set[str]) -> set[str]:
    """Public functions, and methods of public classes, from which a kernel can be reached."""
    names = _named(module)
    reaching = {name for name, others in names.items() if others & (kernels | {MAKER})}
    while True:
        private = {part for name in reaching for part in name.split(".") if _is_private(part)}
        more = {name for name, others in names.items() if others & private} | reaching
        if more == reaching:
            return {name for name in reaching if not any(map(_is_private, name.split(".")))}
        reaching = more


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def _named(module: ModuleType) -> dict[str, set[str]]:
    """All names in the body of each function and method that is not compiled itself."""
    definitions: dict[str, ast.AST] = {}
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.FunctionDef):
            value = vars(module)[node.name]
            if not isinstance(value, CPUDispatcher) and _compiler(value) is None:
                definitions[node.name] = node
        elif isinstance(node, ast.ClassDef):
            definitions |= {f"{node.name}.{m.name}": m for m in node.body if isinstance(m, ast.FunctionDef)}
    return {name: set(_names(node)) for name, node in definitions.items()}


def _names(node: ast.AST) -> Iterator[str]:
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            yield part.id
        elif isinstance(part, ast.Attribute):
            yield part.attr
            if isinstance(part.value, ast.Name):
                yield f"{part.value.id}.{part.attr}"
