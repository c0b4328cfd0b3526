"""Kernels in plain Python, for tests in which compiled ones would hide a fault in their source or cannot run (float32)."""

from collections.abc import Callable
from functools import cache
from types import FunctionType, ModuleType
from typing import Any

import numba

from strapdown.kernels.compiler import KernelCompiler
from strapdown.kernels.machine import _defined, helper, names_of

KERNELS = "strapdown.kernels"


@cache
def called(function: FunctionType, parts: tuple[ModuleType, ...] = ()) -> Callable[..., Any]:
    """Return a compiled function that calls a helper of a kernel: helpers themselves cannot be called from Python."""
    compiled = helper(function, parts)
    wrapped = numba.njit(pipeline_class=KernelCompiler, _nrt=False)
    return wrapped(lambda *arguments: compiled(*arguments))  # noqa: PLW0108 (the lambda is what gets the wrapper)


def plain(function: FunctionType, *parts: ModuleType) -> FunctionType:
    """Return the function that :func:`strapdown.kernels.machine.compiled` would compile, its open functions bound to ``parts``."""
    copies: dict[FunctionType, FunctionType] = {}

    def bound(original: FunctionType) -> FunctionType:
        if original not in copies:
            names = dict(original.__globals__)
            copies[original] = FunctionType(original.__code__, names, original.__name__, original.__defaults__)
            for name in names_of(original.__code__):
                value = names.get(name)
                if isinstance(value, FunctionType) and value.__module__.startswith(KERNELS):
                    names[name] = bound(_defined(name, value, original, parts))
        return copies[original]

    return bound(function) if parts else function
