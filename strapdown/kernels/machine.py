"""Compilation of kernels: plain functions to numba dispatchers, with a disk cache that is invalidated by every edit of what they use.

A kernel refers to its helpers as ordinary module globals. :func:`compiled` follows those names, compiles each helper once, and binds the
compiled copies ("twins") together, so the source needs no decorator and remains plain Python.

A kernel may leave functions open: their names are in ``OPEN`` of its module, which has only their signatures. :func:`compiled` is given the
modules that define them; in this way :func:`strapdown.kernels.walk.walk` is the loop of every filter. A name in ``REPLACEABLE`` has a
default, which is used if no module defines it.
"""

from __future__ import annotations

import builtins
import functools
import hashlib
import platform
import re
import sys
from collections.abc import Callable, Hashable
from importlib import import_module
from importlib.abc import InspectLoader
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, cast

import numpy as np

PACKAGE = __package__
INTRINSIC = {f"{PACKAGE}.lane_values": f"{PACKAGE}.lanes", f"{PACKAGE}.argument_tables": f"{PACKAGE}.addresses"}
"""Modules whose functions are compiled by instructions of their own, which the other module writes."""


_SOURCES = {path.stem: path.read_bytes() for path in Path(__file__).parent.glob("*.py")}
"""Read on import: if a source is edited later, the code of this process is not stored as that of the edited one."""
TEMPLATE = "layout"
"""The module that reads constants which :func:`instance` gives."""
_COMPILER = ("machine", "cache", "compiler", "tracing", "lanes", "addresses")
"""Modules on which the code of every kernel depends."""
_IMPORTED = re.compile(rb"^ *from strapdown\.kernels(?:\.(\w+) import| import (.+))", re.MULTILINE)


@functools.cache
def _used(module: str) -> frozenset[str]:
    """Return the kernel modules that one of them imports, directly or indirectly, and itself."""
    names = re.findall(rb"\w+", b" ".join(map(b" ".join, _IMPORTED.findall(_SOURCES[module]))))
    return frozenset([module]).union(*(_used(name.decode()) for name in names))


@functools.cache
def sources_digest(*files: str) -> str:
    """Return a digest of kernel modules, given by their files, of all that they import, and of the compiler; other files are read.

    numba's own key misses edits of helper modules and constants.
    """
    here, paths = Path(__file__).parent, [Path(file) for file in files]
    inside = [path.stem for path in paths if path.parent == here]
    names = sorted(frozenset[str]().union(*map(_used, (*_COMPILER, *inside))))
    contents = [_SOURCES[name] for name in names] + [path.read_bytes() for path in paths if path.parent != here]
    return hashlib.sha256(b"".join(contents)).hexdigest()


def _is_kernel(value: object) -> bool:
    return isinstance(value, FunctionType) and (value.__module__ or "").startswith(PACKAGE)


def names_of(code: CodeType) -> tuple[str, ...]:
    """Return the global names in a function's code and in its generator expressions."""
    inner = (names_of(code_object) for code_object in code.co_consts if isinstance(code_object, CodeType))
    return sum(inner, code.co_names)


def _kernels_named(function: FunctionType) -> dict[str, FunctionType]:
    """Return the kernel functions that a function refers to, by name."""
    named = {name: function.__globals__.get(name) for name in names_of(function.__code__)}
    return {name: value for name, value in named.items() if isinstance(value, FunctionType) and _is_kernel(value)}


@functools.cache
def _depends_on_parts(function: FunctionType, parts: tuple[ModuleType, ...]) -> bool:
    """Return whether a function refers, directly or indirectly, to one that ``parts`` define."""
    return any(
        name in _open(function) or _depends_on_parts(value, parts) for name, value in _kernels_named(function).items()
    )


def _open(scope: FunctionType | ModuleType) -> tuple[str, ...]:
    """Return the names that a module, or the module of a function, leaves open."""
    names = scope.__globals__ if isinstance(scope, FunctionType) else vars(scope)
    return (*names.get("OPEN", ()), *names.get("REPLACEABLE", ()))


def _defined(name: str, value: FunctionType, function: FunctionType, parts: tuple[ModuleType, ...]) -> FunctionType:
    """Return the value of a name in a function: if the name is open, its definition in the first of ``parts`` that has one."""
    if name not in _open(function):
        return value
    for module in parts:
        definition = getattr(module, name, None)
        if isinstance(definition, FunctionType) and name not in _open(module):
            return definition
    if name in function.__globals__.get("REPLACEABLE", ()):
        return value
    names = ", ".join(module.__name__ for module in parts) or "nothing"
    raise TypeError(f"{function.__module__} leaves {name} open, and {names} does not define it")


@functools.cache
def _checked(
    function: FunctionType, parts: tuple[ModuleType, ...]
) -> dict[str, tuple[FunctionType, tuple[ModuleType, ...]]]:
    """Return definition and parts of each kernel that a function refers to, by name; invalid references are refused, recursively."""
    checked = {}
    for name in names_of(function.__code__):
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType) and value.__name__.startswith(PACKAGE):
            raise TypeError(f"kernel {function.__name__} names module {name}; import its functions by name instead")
        if isinstance(value, FunctionType) and _is_kernel(value):
            value = _defined(name, value, function, parts)
            checked[name] = (value, parts if _depends_on_parts(value, parts) else ())
            _checked(*checked[name])
    return checked


def _bound_name(function: FunctionType, parts: tuple[ModuleType, ...]) -> str:
    """Return the qualified name of a function, with a digest of the modules that it is bound to.

    numba names symbols by the qualified name and a number that begins anew in each process: two versions of a function, from the caches of
    two processes, would have one name, and an address would be that of either.
    """
    digest = hashlib.sha256(" ".join(module.__name__ for module in parts).encode()).hexdigest()
    return f"{function.__qualname__}_{digest[:16]}" if parts else function.__qualname__


def _twin(function: FunctionType, parts: tuple[ModuleType, ...]) -> FunctionType:
    """Return a copy of ``function`` whose kernel globals are the compiled helpers."""
    bound: dict[str, Any] = {name: helper(*checked) for name, checked in _checked(function, parts).items()}
    others = (name for name in names_of(function.__code__) if name in function.__globals__ and name not in bound)
    bound |= {"__name__": function.__module__, **{name: function.__globals__[name] for name in others}}
    twin = FunctionType(function.__code__, bound, function.__name__, function.__defaults__, function.__closure__)
    twin.__qualname__ = _bound_name(function, parts)
    twin.__doc__ = function.__doc__
    return twin


def _options() -> dict[str, Any]:
    # Only 'contract' (fused multiply-add): full fastmath silently breaks isnan and isfinite.
    # Kernels neither create nor return arrays, so references are not counted: that would cost more than the arithmetic of a hot loop, and a
    # third of all instructions to compile.
    return {"fastmath": {"contract"}, "error_model": "numpy", "nogil": True, "_nrt": False}


def _without_literals(dispatcher: Any) -> Any:
    """Return a dispatcher that ignores the value of a literal number; numba would compile it again for each literal."""
    from numba import types

    resolve = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: resolve(
        tuple(types.unliteral(kind) for kind in args), {name: types.unliteral(kind) for name, kind in kws.items()}
    )
    return dispatcher


@functools.cache
def helper(function: FunctionType, parts: tuple[ModuleType, ...] = ()) -> Any:
    """Return ``function`` compiled for use inside another kernel, inlined: a call costs more than an operation on a 3-vector.

    Functions in ``CALLED`` of their module are long enough to be called instead. ``parts`` define open functions.
    """
    import numba

    from strapdown.kernels.compiler import HelperCompiler
    from strapdown.kernels.tracing import traced

    if function.__module__ in INTRINSIC:
        return import_module(INTRINSIC[function.__module__]).INTRINSICS[function.__name__]
    called = function.__name__ in function.__globals__.get("CALLED", ())
    # It is not called from Python or C: without the two wrappers it compiles in two thirds of the time.
    options = {"forceinline": not called, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, **_options()}
    twin = _twin(function, parts)
    plain = _without_literals(numba.njit(pipeline_class=HelperCompiler, **options)(twin))
    return traced(twin, plain, called=called)


@functools.cache
def compiled(function: Callable[..., Any], *parts: ModuleType) -> Any:
    """Return ``function`` compiled for calls from Python, cached on disk under a digest of the sources that it uses.

    ``parts`` are the modules that define the open functions; of several definitions the first is used. The compiled function releases the
    GIL, so records can be distributed over threads.
    """
    import numba

    from strapdown.kernels.cache import KernelCache
    from strapdown.kernels.compiler import KernelCompiler

    if not isinstance(function, FunctionType) or not _is_kernel(function):
        raise TypeError(f"{function!r} does not live in {PACKAGE}; move it there before compiling it")
    _checked(function, parts)
    # Built only if something is compiled: it takes a tenth of a warm `strapdown estimate`.
    twin = functools.partial(_twin, function, parts)

    class Cache(KernelCache):
        def load_overload(self, signature: Any, target: Any) -> Any:
            entry = super().load_overload(signature, target)
            if entry is None:
                dispatcher._compiler.py_func = twin()
            return entry

    options = {"pipeline_class": KernelCompiler, "no_cfunc_wrapper": True, **_options()}
    dispatcher = numba.njit(**options)(function)
    files = (function.__code__.co_filename, *(str(module.__file__) for module in parts))
    try:
        dispatcher._cache = Cache(function, _bound_name(function, parts), sources_digest(*files))
    except (RuntimeError, OSError):  # no writable directory for a cache: compile in every process
        dispatcher._compiler.py_func = twin()
    return dispatcher


def address_of(dispatcher: Any, arguments: tuple[Any, ...]) -> int:
    """Return the address of a compiled function's machine code for arguments of these types."""
    types = tuple(map(dispatcher.typeof_pyval, arguments))
    dispatcher.compile(types)
    compilation = dispatcher.overloads[types]
    return int(compilation.library.get_pointer_to_function(compilation.fndesc.llvm_func_name))


@functools.cache
def instance(module: ModuleType, **constants: Hashable) -> ModuleType:
    """Return a copy of a kernel module with other values of constants, and with copies of the modules that it imports if these use them.

    A template reads the constants from its globals while it is imported (:data:`TEMPLATE`), or imports one that does. They are known while
    its functions are compiled, like the parameters of a template in C++. Equal constants give the same copy.
    """
    digest = hashlib.sha256(repr(sorted(constants.items())).encode()).hexdigest()[:16]
    copy = ModuleType(f"{module.__name__}_{digest}", module.__doc__)

    def import_copy(name: str, *arguments: Any) -> ModuleType:
        imported = __import__(name, *arguments)
        package, _, stem = name.rpartition(".")
        return instance(imported, **constants) if package == PACKAGE and TEMPLATE in _used(stem) else imported

    copy.__file__ = module.__file__
    copy.__dict__.update(constants, __builtins__={**vars(builtins), "__import__": import_copy})
    sys.modules[copy.__name__] = copy  # numba looks there for the module of a function that it reads from its cache
    # Python's byte code, from its cache: to compile the source would take most of the time.
    code = cast(InspectLoader, module.__loader__).get_code(module.__name__)
    exec(cast(CodeType, code), copy.__dict__)
    return copy


def read_only(array: np.ndarray) -> np.ndarray:
    """Return an array in the form for which kernels that only read it are compiled: a contiguous, aligned, read-only view.

    numba compiles a kernel again for each layout, and for writable arrays.
    """
    flags = array.flags
    view = array.view() if flags.c_contiguous and flags.aligned else np.require(array, requirements=("C", "A")).view()
    view.flags.writeable = False
    return view


def has_vectors() -> bool:
    """Return whether the CPU has SIMD vectors of doubles with fused multiply-add."""
    from numba.core.codegen import get_host_cpu_features

    features = set(get_host_cpu_features().split(","))
    if platform.machine() in ("x86_64", "AMD64"):
        return {"+avx2", "+fma"} <= features
    return platform.machine() in ("aarch64", "arm64")


def describe() -> dict[str, str]:
    """Return CPU, numba and LLVM versions, for `strapdown info` and the headings of benchmarks."""
    import llvmlite.binding
    import numba

    return {
        "machine": platform.machine(),
        "cpu": llvmlite.binding.get_host_cpu_name(),
        "numba": numba.__version__,
        "llvm": ".".join(str(part) for part in llvmlite.binding.llvm_version_info),
        "lanes": "8 runs at once" if has_vectors() else "8 runs at once, without vectors",
    }
