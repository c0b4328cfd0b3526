"""Helpers that are formulas are not compiled by numba but traced: executed in Python on symbols, which emit LLVM instructions.

Most helpers have neither long loops nor branches on computed values. Tracing them saves numba's typing and lowering, about a millisecond
for each operation. Types, instructions and lanes of each operation are still those of numba. A function that needs the value of a symbol is
not a formula; numba compiles it.
"""

from __future__ import annotations

import dis
import functools
import inspect
import math
import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CellType, FunctionType, ModuleType
from typing import Any, ClassVar

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from strapdown.kernels.packed import EMIT

LONGEST = 4
"""Maximum number of iterations of a loop that a trace unrolls; generator expressions are always unrolled."""


class NotAFormula(Exception):  # noqa: N818 - caught in this module, no error
    """A function needs the value of a symbol."""


class Trace:
    """Emits instructions; without a builder only types are inferred."""

    now: ClassVar[Trace]
    _signatures: ClassVar[dict[Any, Any]] = {}

    def __init__(self, typing: Any, target: Any = None, builder: Any = None) -> None:
        self.typing, self.target, self.builder = typing, target, builder
        self._implementations: dict[Any, Any] = {}
        self.tuples: dict[int, tuple[Any, Any, Any]] = {}
        """Tuples of symbols that are parts of one value, by identity: the tuple, its type, and a function that returns the value."""

    @contextmanager
    def running(self) -> Iterator[None]:
        """Direct the operations of symbols to this trace."""
        before = getattr(Trace, "now", self)
        Trace.now = self
        try:
            yield
        finally:
            Trace.now = before

    def signature(self, function: Any, operands: tuple[Any, ...]) -> tuple[Any, Any]:
        """Return numba's type of a function and its signature for arguments of these types."""
        kind = self.typing._lookup_global(function) or self.typing.resolve_value_type(function)
        key = (function, *map(id, operands))  # numba has one object for each type; its hash runs in Python
        known = self._signatures.get(key)
        if known is None or known[0] != kind:
            known = self._signatures[key] = (kind, self.typing.resolve_function_type(kind, operands, {}), operands)
        return known[:2]

    def apply(self, function: Any, *arguments: Any) -> Any:
        """Return the result of a function known to numba for symbols and numbers."""
        operands = tuple(map(type_of, arguments))
        if self.builder is None:
            return symbols(self.signature(function, operands)[1].return_type)
        key = (function, *map(id, operands))
        if key not in self._implementations:
            kind, signature = self.signature(function, operands)
            self._implementations[key] = self.target.get_function(kind, signature), signature
        implementation, signature = self._implementations[key]
        values = [self.value(a, t) for a, t in zip(arguments, signature.args, strict=True)]
        return symbols(signature.return_type, implementation(self.builder, values))

    def value(self, argument: Any, wanted: Any) -> Any:
        """Return the LLVM value of a symbol, number, or tuple of these, cast to type ``wanted``."""
        if isinstance(argument, Symbol) and argument.type is wanted:
            return argument.value
        kind = type_of(argument)
        if isinstance(argument, Symbol):
            value = argument.value
        elif argument is None:
            value = self.target.get_dummy_value()
        elif id(argument) in self.tuples:
            value = self.tuples[id(argument)][2]()
        elif isinstance(argument, tuple):
            parts = [self.value(a, k) for a, k in zip(argument, kind, strict=True)]
            value = self.target.make_tuple(self.builder, kind, parts)
        else:
            value = self.target.get_constant(kind, argument)
        return value if kind == wanted else self.target.cast(self.builder, value, kind, wanted)


def type_of(value: Any) -> Any:
    """Return numba's type of a symbol, number, or tuple of these."""
    if type(value) is Symbol:
        return value.type
    if isinstance(value, tuple):
        if id(value) in Trace.now.tuples:
            return Trace.now.tuples[id(value)][1]
        pytype = type(value) if hasattr(value, "_fields") else None
        return types.BaseTuple.from_types([type_of(item) for item in value], pytype)
    if not isinstance(value, bool | int | float | np.number | type(None)):
        raise NotAFormula
    return types.float64 if isinstance(value, float) else numba.typeof(value)


def symbols(kind: Any, value: Any = None) -> Any:
    """Return a value, or a function that emits it when it is first needed, as a symbol, a tuple as a tuple of symbols."""
    if isinstance(kind, types.NoneType):
        return None
    if not isinstance(kind, types.BaseTuple):
        return Symbol(kind, value)
    whole = value if callable(value) else lambda: value
    parts = [None if value is None else _part(Trace.now.builder, whole, i) for i in range(len(kind))]
    inside = tuple(symbols(k, part) for k, part in zip(kind, parts, strict=True))
    result = kind.instance_class(*inside) if isinstance(kind, types.BaseNamedTuple) else inside
    if inside:
        Trace.now.tuples[id(result)] = (result, kind, whole)
    return result


def _part(builder: Any, whole: Any, place: int) -> Any:
    """Return a function that emits part of a tuple once: most parts of a tuple are not used."""
    return functools.cache(lambda: builder.extract_value(whole(), place))


class Symbol:
    """A value computed at run time."""

    __slots__ = ("_value", "type")

    def __init__(self, kind: Any, value: Any) -> None:
        self.type, self._value = kind, value

    @property
    def value(self) -> Any:
        """LLVM's value."""
        if callable(self._value):
            self._value = self._value()
        return self._value

    def __len__(self) -> int:
        """Return the number of lanes."""
        count = getattr(self.type, "count", None)
        if count is None:
            raise NotAFormula
        return int(count)


def _operation(function: Callable[..., Any]) -> Any:
    return lambda self, *others: Trace.now.apply(function, self, *others)


def _turned(function: Callable[..., Any]) -> Any:
    return lambda self, other: Trace.now.apply(function, other, self)


def _refuse(self: Any, *arguments: Any) -> Any:
    raise NotAFormula


for _name in ("add", "sub", "mul", "truediv", "and_", "or_"):
    setattr(Symbol, f"__{_name.strip('_')}__", _operation(getattr(operator, _name)))
    setattr(Symbol, f"__r{_name.strip('_')}__", _turned(getattr(operator, _name)))
for _name in ("lt", "le", "gt", "ge", "eq", "ne", "neg", "invert", "getitem", "setitem"):
    setattr(Symbol, f"__{_name}__", _operation(getattr(operator, _name)))
Symbol.__abs__ = _operation(abs)  # type: ignore[attr-defined]
for _name in ("bool", "int", "float", "index", "iter", "getattr", "pow", "rpow", "mod", "floordiv"):
    setattr(Symbol, f"__{_name}__", _refuse)


class _Mathematics:
    """``math``, extended to symbols."""

    def __getattr__(self, name: str) -> Any:
        known = getattr(math, name)
        if not callable(known):
            return known
        return lambda *arguments: (
            Trace.now.apply(known, *arguments) if any(isinstance(a, Symbol) for a in arguments) else known(*arguments)
        )


def _shape(argument: Any) -> Any:
    if type(argument) is Symbol:
        return argument.type
    return tuple(map(_shape, argument)) if isinstance(argument, tuple) else (type(argument), argument)


class Formula:
    """A helper in a trace: executed on symbols if it is a formula, otherwise called as compiled by numba (``plain``)."""

    def __init__(self, function: FunctionType, plain: Any, *, called: bool) -> None:
        self.function, self.plain = function, plain
        self.pack = EMIT.get(function.__name__) if function.__module__.endswith(".algebra") else None
        self.never = called
        self.signature = inspect.signature(function)
        self.results: dict[Any, Any] = {}
        """Results without values by the types of the arguments, from the first trace of types; :class:`NotAFormula` if it is none."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Return the result of the helper for symbols and numbers."""
        trace = Trace.now
        if named:
            arguments = self.signature.bind(*arguments, **named).args
        if self.pack is not None and all(type_of(x) == types.float64 for a in arguments for x in a):
            if trace.builder is None:
                return tuple(Symbol(types.float64, None) for _ in range(9))
            operands = [[trace.value(x, types.float64) for x in a] for a in arguments]
            return tuple(Symbol(types.float64, value) for value in self.pack(trace.builder, *operands))
        key = _shape(arguments)
        if trace.builder is None and key not in self.results and not self.never:
            try:
                self.results[key] = self.function(*arguments)
            except (NotAFormula, TypeError):  # not possible with symbols, perhaps with numba
                self.results[key] = NotAFormula
        result = self.results.get(key, NotAFormula)
        if result is NotAFormula:
            return trace.apply(self.plain, *arguments)
        return result if trace.builder is None else self.function(*arguments)


def _short_range(*bounds: Any) -> range:
    """Return a range to unroll; if it is longer, or not a constant, numba compiles a loop."""
    if any(isinstance(bound, Symbol) for bound in bounds) or len(range(*bounds)) > LONGEST:
        raise NotAFormula
    return range(*bounds)


def _global(value: Any) -> Any:
    """Return the value of a global name in a trace."""
    if value is math:
        return _Mathematics()
    if isinstance(value, ModuleType):
        return Symbol(None, None)  # its attributes are refused
    if hasattr(value, "formula"):
        return value.formula
    if isinstance(value, numba.core.dispatcher.Dispatcher | numba.extending._Intrinsic):
        return lambda *arguments: Trace.now.apply(value, *arguments)
    return value


def traced(twin: FunctionType, plain: Any, *, called: bool) -> Any:
    """Return the object that kernels call for a helper: its formula if it is one, else its dispatcher ``plain``.

    ``twin`` is the function with compiled or traced globals; ``called``: whether it is long enough not to be inlined.
    """
    names = {name: _global(value) for name, value in twin.__globals__.items()}
    if any(step.opname.startswith("JUMP_BACKWARD") for step in dis.get_instructions(twin)):
        names["range"] = _short_range
    cells = tuple(CellType(_global(cell.cell_contents)) for cell in twin.__closure__ or ())
    function = FunctionType(twin.__code__, names, twin.__name__, twin.__defaults__, cells)
    function.__module__ = twin.__module__
    formula = Formula(function, plain, called=called)
    if formula.never:
        plain.formula = formula
        return plain

    def define(typing: Any, *operands: Any, **named: Any) -> Any:
        operands = formula.signature.bind(*operands, **named).args
        with Trace(typing).running():
            result = type_of(formula(*map(symbols, operands)))

        def write(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            writing = Trace(typing, target, builder)
            with writing.running():
                return writing.value(formula(*map(symbols, operands, values)), signature.return_type)

        return result(*operands), write

    parameters = [inspect.Parameter("typing", inspect.Parameter.POSITIONAL_ONLY)]
    define.__signature__ = inspect.Signature([*parameters, *formula.signature.parameters.values()])  # type: ignore[attr-defined]
    routine = intrinsic(define)
    routine.formula = formula
    return routine
