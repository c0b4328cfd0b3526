"""numba compilers for kernels, and for the helpers that only kernels call.

numba takes each function for one that might be called from Python: it optimises it with all that it calls and makes machine code of it, and
looks in it for generators, closures, ``with`` and array expressions. Helpers are never called from Python: their LLVM code is optimised as
part of the kernel's. And types of operators are resolved once, not at each place. All three together halve the time.
"""

from __future__ import annotations

import gc
import operator
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

from numba.core import typed_passes, types, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import PassManager

PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.IRProcessing,
    untyped_passes.DeadBranchPrune,
    untyped_passes.GenericRewrites,
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    typed_passes.IRLegalization,
    typed_passes.NativeLowering,
    typed_passes.NoPythonBackend,
)
"""Those of numba's passes that kernels need."""


@contextmanager
def _uncollected() -> Iterator[None]:
    """Leave Python's garbage until later: the collector would go through all that numba has made a hundred times in vain."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class _Typing:
    """A typing context that resolves a builtin function for the same types of arguments once."""

    _known: ClassVar[dict[int, tuple[types.Function, dict[tuple[types.Type, ...], Any]]]] = {}
    """By the function's identity, which new overloads change."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def resolve_function_type(self, function: Any, args: tuple[types.Type, ...], kws: dict[str, types.Type]) -> Any:
        context = self._context
        builtin = function if isinstance(function, types.Type) else context._lookup_global(function)
        if kws or type(builtin) is not types.Function:
            return context.resolve_function_type(function, args, kws)
        if getattr(builtin.typing_key, "__module__", "") == "_operator" and not isinstance(args[0], types.BaseTuple):
            args = tuple(map(types.unliteral, args))  # numbers' and arrays' operators do not look at literals
        signatures = self._known.setdefault(id(builtin), (builtin, {}))[1]
        if args not in signatures:
            signatures[args] = context.resolve_function_type(function, args, kws)
        return signatures[args]

    def resolve_setitem(self, target: types.Type, index: types.Type, value: types.Type) -> Any:
        return self.resolve_function_type(operator.setitem, (target, index, value), {})


class KernelCompiler(Compiler):  # type: ignore[misc]
    """The compiler of kernels."""

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        super().__init__(typing, target, library, *rest)
        self.state.typingctx = _Typing(typing)

    def compile_extra(self, function: Any) -> Any:
        """Compile a function."""
        with _uncollected():
            return super().compile_extra(function)

    def define_pipelines(self) -> list[PassManager]:
        """Return the one pipeline there is."""
        passes = PassManager("kernel")
        for one in PASSES:
            passes.add_pass(one, one.__name__)
        passes.finalize()
        return [passes]


class HelperCompiler(KernelCompiler):
    """The compiler of what only kernels call."""

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        super().__init__(typing, target, library or _HelperLibrary(target.codegen(), "helper"), *rest)


class _HelperLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code for callers: of one function alone, simplified, and never machine code."""

    @property
    def codegen(self) -> Any:
        return _Nowhere(self._codegen)

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0


class _Nowhere:
    """A code generator for what has no address: nothing can be stored there."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Store nothing."""
