"""That a GPU's formulas are those of the CPU."""

from __future__ import annotations

import inspect
from types import ModuleType

import numpy as np
import pytest

import nsvq_lightning.quality.formulas
import nsvq_lightning.rendering.formulas
from nsvq_lightning.compute.formulas import for_triton

BOTH = nsvq_lightning.rendering.formulas, nsvq_lightning.quality.formulas


@pytest.mark.parametrize("formulas", BOTH)
def test_triton_compiles_the_code_that_numba_does(formulas: ModuleType) -> None:
    pytest.importorskip("triton", reason="the CUDA back-end needs Triton")
    twin = for_triton(formulas)
    functions = {name: value.py_func for name, value in vars(formulas).items() if hasattr(value, "py_func")}
    assert len(functions) > 4
    for name, function in functions.items():
        compiled = getattr(twin, name)
        assert compiled.fn.__code__ is function.__code__
        assert compiled.fn.__globals__ is vars(twin)
        assert inspect.getsource(compiled.fn) == inspect.getsource(function)
    numbers = {name: float(value) for name, value in vars(formulas).items() if isinstance(value, np.float32)}
    assert {name: getattr(twin, name).value for name in numbers} == numbers


@pytest.mark.parametrize("formulas", BOTH)
def test_formulas_name_only_what_both_compilers_have(formulas: ModuleType) -> None:
    language = pytest.importorskip("triton.language", reason="the CUDA back-end needs Triton")
    twin = for_triton(formulas)
    for value in vars(formulas).values():
        if hasattr(value, "py_func"):
            for name in value.py_func.__code__.co_names:
                assert name in vars(twin) or hasattr(language, name), name
