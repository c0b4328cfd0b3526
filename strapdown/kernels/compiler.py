"""numba compilers for kernels, and for the helpers that only kernels call.

numba treats each function as callable from Python: it optimises it together with its callees, generates machine code, and runs passes for
generators, closures, ``with`` and array expressions. Helpers are never called from Python, so here their LLVM code is optimised only as
part of the kernel's, those passes are left out, and the types of operators are resolved once. This halves the compile time.

A third of the remaining time is saved by shorter LLVM code: numba needs thirty instructions for an element of an array and passes an array
to a function as nine numbers; here it is five instructions and three numbers.
"""

from __future__ import annotations

import functools
import gc
import operator
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils, datamodel, typed_passes, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.cpu import CPUContext
from numba.core.datamodel import models
from numba.core.lowering import Lower


class _Lower(Lower):  # type: ignore[misc]
    """Lowers operators with the types already inferred; numba infers each again, four times if an operand is a constant."""

    def _apply(self, function: Any, signature: Any, variables: tuple[Any, ...]) -> Any:
        implementation = self.context.get_function(self.context.typing_context.resolve_value_type(function), signature)
        operands = [
            self.context.cast(self.builder, self.loadvar(variable.name), self.typeof(variable.name), kind)
            for variable, kind in zip(variables, signature.args, strict=True)
        ]
        return implementation(self.builder, operands)

    def lower_binop(self, resty: Any, expr: Any, op: Any) -> Any:
        signature = self.fndesc.calltypes[expr]
        if op is not expr.fn or op in (operator.pow, operator.ipow):  # a constant power has code of its own
            return super().lower_binop(resty, expr, op)
        result = self._apply(op, signature, (expr.lhs, expr.rhs))
        return self.context.cast(self.builder, result, signature.return_type, resty)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        result = self._apply(operator.getitem, signature, (value, index))
        return self.context.cast(self.builder, result, signature.return_type, resty)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        return self._apply(operator.setitem, signature, (target_var, index_var, value_var))


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(typed_passes.NativeLowering):  # type: ignore[misc]
    _name = "kernel_lowering"

    @property
    def lowering_class(self) -> Any:
        return _Lower


PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.IRProcessing,
    untyped_passes.DeadBranchPrune,
    untyped_passes.GenericRewrites,
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    _Lowering,
    typed_passes.NoPythonBackend,
)
"""The passes of numba that kernels need. Variables are not deleted after their last use: no references are counted."""


@contextmanager
def _uncollected() -> Iterator[None]:
    """Disable garbage collection: the collector would search all objects of numba a hundred times and find nothing."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class _Typing:
    """A typing context that resolves a builtin function only once for each set of argument types."""

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


class _Target(CPUContext):  # type: ignore[misc]
    """The CPU target, with short code for elements and lengths of contiguous arrays. Indices must not be negative."""

    def get_function(self, function: Any, signature: Any, _firstcall: bool = True) -> Any:
        operands = signature.args
        builtin = getattr(function, "typing_key", None)
        if operands and isinstance(operands[0], types.Array) and operands[0].layout == "C":
            if builtin is len:
                return lambda builder, values, *_: builder.extract_value(values[0], [SHAPE, 0])
            if builtin in (operator.getitem, operator.setitem) and _counts(operands[1], operands[0].ndim):
                return functools.partial(_element, self, operands)
        return super().get_function(function, signature, _firstcall)

    def get_getattr(self, kind: Any, name: str) -> Any:
        if isinstance(kind, types.Array) and name == "shape":
            return lambda _, builder, kind, value, name: builder.extract_value(value, SHAPE)
        return super().get_getattr(kind, name)


NITEMS, ITEMSIZE, DATA, SHAPE, STRIDES = range(2, 7)
"""Places of the members in numba's array structure."""


def _counts(index: types.Type, dimensions: int) -> bool:
    """Return whether an index is one integer for each dimension."""
    kinds = index.types if isinstance(index, types.BaseTuple) else (index,)
    return len(kinds) == dimensions and all(isinstance(kind, types.Integer) for kind in kinds)


def _element(target: Any, operands: tuple[types.Type, ...], builder: Any, values: Any, *_: Any) -> Any:
    """Read an element of an array, or write it if a third value is given."""
    array, index = values[:2]
    several = isinstance(operands[1], types.BaseTuple)
    counts = cgutils.unpack_tuple(builder, index) if several else [index]
    place = None
    for i, (count, kind) in enumerate(zip(counts, operands[1].types if several else operands[1:2], strict=True)):
        along = target.cast(builder, count, kind, types.intp)
        if isinstance(along, ir.Constant) and along.constant < 0:
            raise IndexError(f"an index of a kernel counts from the front; {along.constant} does not")
        place = builder.add(builder.mul(place, builder.extract_value(array, [SHAPE, i])), along) if i > 0 else along
    pointer = builder.gep(builder.extract_value(array, DATA), [place])
    dtype, align = operands[0].dtype, None if operands[0].aligned else 1
    if len(values) == 2:
        return target.unpack_value(builder, dtype, pointer, align)
    return target.pack_value(builder, dtype, target.cast(builder, values[2], operands[2], dtype), pointer, align)


class _Array(models.ArrayModel):  # type: ignore[misc]
    """An array, passed to a function as address and shape if it is contiguous; the other members follow from these or are not needed."""

    def get_argument_type(self) -> Any:
        whole = super().get_argument_type()
        return (whole[DATA], whole[SHAPE]) if self._fe_type.layout == "C" else whole

    def as_argument(self, builder: Any, value: Any) -> Any:
        if self._fe_type.layout != "C":
            return super().as_argument(builder, value)
        return tuple(self._models[i].as_argument(builder, self.get(builder, value, i)) for i in (DATA, SHAPE))

    def from_argument(self, builder: Any, value: Any) -> Any:
        if self._fe_type.layout != "C":
            return super().from_argument(builder, value)
        data, shape = value
        size = step = ir.IntType(64)(getattr(self._fe_type.dtype, "bitwidth", 8) // 8)
        strides: list[Any] = []
        for length in reversed(shape):
            strides.insert(0, step)
            step = builder.mul(step, length)
        array = ir.Constant(self.get_value_type(), None)
        parts = [([NITEMS], builder.udiv(step, size)), ([ITEMSIZE], size), ([DATA], data)]
        parts += [([SHAPE, i], length) for i, length in enumerate(shape)]
        parts += [([STRIDES, i], stride) for i, stride in enumerate(strides)]
        for place, part in parts:
            array = builder.insert_value(array, part, place)
        return array


_MODELS = datamodel.DataModelManager().chain(datamodel.default_manager)
_MODELS.register(types.Array, _Array)
_INTERNAL: dict[Any, Any] = {}
"""Functions of numba compiled for arrays passed in this way."""


class KernelCompiler(Compiler):  # type: ignore[misc]
    """The compiler of kernels."""

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        if library is None:
            library = _Library(target.codegen(), "kernel")
            library.enable_object_caching()
        super().__init__(typing, target, library, *rest)
        self.state.typingctx = _Typing(typing)
        self.state.targetctx.__class__ = _Target  # of this compiler only
        self.state.targetctx.data_model_manager = _MODELS
        self.state.targetctx.cached_internal_func = _INTERNAL

    def compile_extra(self, function: Any) -> Any:
        """Compile a function."""
        with _uncollected():
            return super().compile_extra(function)

    def define_pipelines(self) -> list[PassManager]:
        """Return the only pipeline."""
        passes = PassManager("kernel")
        for stage in PASSES:
            passes.add_pass(stage, stage.__name__)
        passes.finalize()
        return [passes]


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code with explicit vectors: loops are neither vectorised nor unrolled, which took half of the time of LLVM."""

    def _builder(self, level: int) -> Any:
        tuning = llvm.create_pipeline_tuning_options(level)
        tuning.loop_unrolling = False
        return llvm.create_pass_builder(self._codegen._tm, tuning)

    def _optimize_functions(self, ll_module: Any) -> None:
        # Simplified before they are inlined, at the first level: higher ones take a third longer and give the same code in the end.
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            builder = self._builder(1)
            builder.getFunctionPassManager().run(function, builder)

    def _optimize_final_module(self) -> None:
        builder = self._builder(0)
        first = builder.getModulePassManager()  # inlines
        first.add_loop_rotate_pass()
        first.add_instruction_combine_pass()
        first.add_jump_threading_pass()
        first.run(self._final_module, builder)
        builder = self._builder(3)
        builder.getModulePassManager().run(self._final_module, builder)


class HelperCompiler(KernelCompiler):
    """The compiler of functions that only kernels call."""

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        super().__init__(typing, target, library or _HelperLibrary(target.codegen(), "helper"), *rest)


class _HelperLibrary(_Library):
    """LLVM code of one function for its callers, without machine code."""

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
    """A code generator for functions without an address, in which no environment can be stored."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Store nothing."""
