"""Compiling kernels: plain functions in, numba dispatchers out, with a disk cache that notices every edit.

A kernel names its helpers as ordinary module globals. :func:`compiled` follows those names, compiles each helper once, and binds the
compiled twins together, so that the source needs no decorator and stays plain Python.

A kernel may leave functions open: it names them in ``OPEN`` of its module, where they stand without a body, or are those of one of the
modules that define them. :func:`compiled` takes the modules that do; so :func:`strapdown.kernels.walk.walk` is the loop of every filter.
Those in ``REPLACEABLE`` are its own where no other defines them.
"""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

PACKAGE = __package__


@functools.cache
def sources_digest(parts: tuple[ModuleType, ...] = ()) -> str:
    """Return a digest of all kernel sources and of ``parts``: numba's own stamp misses an edited helper module or constant."""
    digest = hashlib.sha256()
    own = sorted(Path(__file__).parent.glob("**/*.py"))
    for path in (*own, *(Path(module.__file__ or "") for module in parts)):
        digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()


def _is_kernel(value: object) -> bool:
    return isinstance(value, FunctionType) and (value.__module__ or "").startswith(PACKAGE)


def _names(code: CodeType) -> tuple[str, ...]:
    """Return the names that a function's code asks for, and those of generator expressions in it."""
    inner = (_names(one) for one in code.co_consts if isinstance(one, CodeType))
    return sum(inner, code.co_names)


def _kernels_named(function: FunctionType) -> dict[str, FunctionType]:
    """Return the kernel functions that a function names, by name."""
    named = {name: function.__globals__.get(name) for name in _names(function.__code__)}
    return {name: value for name, value in named.items() if isinstance(value, FunctionType) and _is_kernel(value)}


@functools.cache
def _depends_on_parts(function: FunctionType) -> bool:
    """Return whether a function names, directly or not, one that its module leaves open."""
    named = _kernels_named(function)
    return any(name in _open(function) or _depends_on_parts(value) for name, value in named.items())


def _open(one: FunctionType | ModuleType) -> tuple[str, ...]:
    """Return the names that a module, or that of a function, leaves open."""
    names = one.__globals__ if isinstance(one, FunctionType) else vars(one)
    return (*names.get("OPEN", ()), *names.get("REPLACEABLE", ()))


def _defined(name: str, value: FunctionType, function: FunctionType, parts: tuple[ModuleType, ...]) -> FunctionType:
    """Return what a name in a function stands for: its value, or where it is open that of the first among ``parts`` that has it."""
    if name not in _open(function):
        return value
    for module in parts:
        found = getattr(module, name, None)
        if isinstance(found, FunctionType) and name not in _open(module):
            return found
    if name in function.__globals__.get("REPLACEABLE", ()):
        return value
    names = ", ".join(module.__name__ for module in parts) or "nothing"
    raise TypeError(f"{function.__module__} leaves {name} open, and {names} does not define it")


@functools.cache
def _checked(
    function: FunctionType, parts: tuple[ModuleType, ...]
) -> dict[str, tuple[FunctionType, tuple[ModuleType, ...]]]:
    """Return what defines each kernel that a function names, by name, with its own parts; wrong names, those of theirs too, are refused."""
    found = {}
    for name in _names(function.__code__):
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType) and value.__name__.startswith(PACKAGE):
            raise TypeError(f"kernel {function.__name__} names module {name}; import its functions by name instead")
        if isinstance(value, FunctionType) and _is_kernel(value):
            value = _defined(name, value, function, parts)
            found[name] = (value, parts if _depends_on_parts(value) else ())
            _checked(*found[name])
    return found


def _twin(function: FunctionType, parts: tuple[ModuleType, ...]) -> FunctionType:
    """Return a copy of ``function`` whose kernel globals are the compiled helpers."""
    bound: dict[str, Any] = {name: helper(*one) for name, one in _checked(function, parts).items()}
    others = (name for name in _names(function.__code__) if name in function.__globals__ and name not in bound)
    bound |= {"__name__": function.__module__, **{name: function.__globals__[name] for name in others}}
    twin = FunctionType(function.__code__, bound, function.__name__, function.__defaults__, function.__closure__)
    twin.__qualname__ = function.__qualname__
    twin.__doc__ = function.__doc__
    return twin


def _options() -> dict[str, Any]:
    # Only 'contract' (fused multiply-add): full fastmath silently breaks isnan and isfinite.
    # Kernels neither make nor return arrays, and so do not count references to them: counting costs more than the arithmetic of a hot
    # loop, and a third of all instructions to compile.
    return {"fastmath": {"contract"}, "error_model": "numpy", "nogil": True, "_nrt": False}


def _without_literals(dispatcher: Any) -> Any:
    """Return a dispatcher that takes a literal number for any number of its type: numba would compile it anew for each literal."""
    from numba import types

    resolve = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: resolve(
        tuple(types.unliteral(one) for one in args), {name: types.unliteral(one) for name, one in kws.items()}
    )
    return dispatcher


@functools.cache
def helper(function: FunctionType, parts: tuple[ModuleType, ...] = ()) -> Any:
    """Return ``function`` compiled for use inside another kernel, inlined: a call costs more than a 3-vector's work.

    A module names in ``CALLED`` those of its functions that are long enough to be called. ``parts`` define open functions.
    """
    import numba

    from strapdown.kernels.compiler import HelperCompiler
    from strapdown.kernels.tracing import traced

    if function.__module__ == f"{PACKAGE}.lane_values":
        from strapdown.kernels.lanes import INTRINSICS

        return INTRINSICS[function.__name__]
    called = function.__name__ in function.__globals__.get("CALLED", ())
    # Nothing calls it from Python or C: without those two wrappers it compiles in two thirds of the time.
    options = {"forceinline": not called, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, **_options()}
    twin = _twin(function, parts)
    plain = _without_literals(numba.njit(pipeline_class=HelperCompiler, **options)(twin))
    return traced(twin, plain, called=called)


@functools.cache
def compiled(function: Callable[..., Any], *parts: ModuleType) -> Any:
    """Return ``function`` compiled for calls from Python, cached on disk under the digest of all kernel sources and those of ``parts``.

    ``parts`` are the modules that define the functions left open, the first that has one of them. It releases the GIL, so records can be
    spread over threads.
    """
    import numba
    from numba.core.caching import FunctionCache

    from strapdown.kernels.compiler import KernelCompiler

    if not isinstance(function, FunctionType) or not _is_kernel(function):
        raise TypeError(f"{function!r} does not live in {PACKAGE}; move it there before compiling it")
    _checked(function, parts)
    # Twins are built only to compile: a tenth of a warm `strapdown estimate`.
    twin = functools.partial(_twin, function, parts)

    class KernelCache(FunctionCache):  # type: ignore[misc]
        def _index_key(self, signature: Any, codegen: Any) -> Any:
            names = tuple(module.__name__ for module in parts)
            return (*super()._index_key(signature, codegen), names, sources_digest(parts))

        def load_overload(self, signature: Any, target: Any) -> Any:
            # Not numba's own, which first imports and declares all that might be compiled, SciPy's linear algebra included.
            found = None
            with self._guard_against_spurious_io_errors():
                found = self._load_overload(signature, target)
            if found is None:
                dispatcher._compiler.py_func = twin()
            return found

    options = {"pipeline_class": KernelCompiler, "no_cfunc_wrapper": True, **_options()}
    dispatcher = numba.njit(**options)(function)
    try:
        dispatcher._cache = KernelCache(function)
    except RuntimeError:  # no writable place for a cache: compile in every process
        dispatcher._compiler.py_func = twin()
    return dispatcher


def read_only(array: np.ndarray) -> np.ndarray:
    """Return an array as the kernels that only read it are compiled for: contiguous, aligned, and a read-only view.

    numba compiles a kernel anew for each layout and for arrays that may be written to.
    """
    view = np.require(array, requirements=("C", "A")).view()
    view.flags.writeable = False
    return view


def has_vectors() -> bool:
    """Return whether the machine has vectors of doubles with fused multiply-add: where not, lanes are taken one at a time."""
    from numba.core.codegen import get_host_cpu_features

    features = set(get_host_cpu_features().split(","))
    if platform.machine() in ("x86_64", "AMD64"):
        return {"+avx2", "+fma"} <= features
    return platform.machine() in ("aarch64", "arm64")


def describe() -> dict[str, str]:
    """Return what the kernels run on: CPU, numba and LLVM, for `strapdown info` and benchmark headings."""
    import llvmlite.binding
    import numba

    return {
        "machine": platform.machine(),
        "cpu": llvmlite.binding.get_host_cpu_name(),
        "numba": numba.__version__,
        "llvm": ".".join(str(part) for part in llvmlite.binding.llvm_version_info),
        "lanes": "8 runs at once in float64, 16 in float32" if has_vectors() else "1 run at once: no vectors",
    }
