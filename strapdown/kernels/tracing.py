"""Helpers that are formulas are not compiled by numba but traced: run in Python on symbols that write LLVM instructions.

Most helpers have neither long loops nor branches on what is computed. Traced, they cost numba no function, no typing and no lowering, which
take it a millisecond an operation. Each operation is still numba's: its types, its instructions, its lanes. A function that asks a symbol
for its value is no formula, and numba compiles it.
"""

from __future__ import annotations

import dis
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
from numba.core import cgutils
from numba.extending import intrinsic

from strapdown.kernels.packed import EMIT

LONGEST = 4
"""Turns of a loop that a trace writes out; those of a generator expression it writes out all."""


class NotAFormula(Exception):  # noqa: N818 - says what a function is, and never leaves this module
    """A function asks for the value of a symbol."""


class Trace:
    """Writes instructions; without a builder only types are found."""

    now: ClassVar[Trace]
    _signatures: ClassVar[dict[Any, Any]] = {}

    def __init__(self, typing: Any, target: Any = None, builder: Any = None) -> None:
        self.typing, self.target, self.builder = typing, target, builder
        self._implementations: dict[Any, Any] = {}

    @contextmanager
    def running(self) -> Iterator[None]:
        """Let operations of symbols go here."""
        before = getattr(Trace, "now", self)
        Trace.now = self
        try:
            yield
        finally:
            Trace.now = before

    def signature(self, function: Any, given: tuple[Any, ...]) -> tuple[Any, Any]:
        """Return numba's type of a function and its signature for arguments of these types."""
        kind = self.typing._lookup_global(function) or self.typing.resolve_value_type(function)
        key = (function, given)
        known = self._signatures.get(key)
        if known is None or known[0] != kind:
            known = self._signatures[key] = (kind, self.typing.resolve_function_type(kind, given, {}))
        return known

    def apply(self, function: Any, *arguments: Any) -> Any:
        """Return what a function that numba knows makes of symbols and numbers."""
        given = tuple(map(type_of, arguments))
        kind, signature = self.signature(function, given)
        if self.builder is None:
            return symbols(signature.return_type)
        key = (function, given)
        if key not in self._implementations:
            self._implementations[key] = self.target.get_function(kind, signature)
        values = [self.value(a, t) for a, t in zip(arguments, signature.args, strict=True)]
        return symbols(signature.return_type, self._implementations[key](self.builder, values))

    def value(self, argument: Any, wanted: Any) -> Any:
        """Return the LLVM value of a symbol, number, or tuple of such, as of type ``wanted``."""
        kind = type_of(argument)
        if isinstance(argument, Symbol):
            value = argument.value
        elif argument is None:
            value = self.target.get_dummy_value()
        elif isinstance(argument, tuple):
            parts = [self.value(a, k) for a, k in zip(argument, kind, strict=True)]
            value = self.target.make_tuple(self.builder, kind, parts)
        else:
            value = self.target.get_constant(kind, argument)
        return value if kind == wanted else self.target.cast(self.builder, value, kind, wanted)


def type_of(value: Any) -> Any:
    """Return numba's type of a symbol, number, or tuple of such."""
    if isinstance(value, Symbol):
        return value.type
    if isinstance(value, tuple):
        pytype = type(value) if hasattr(value, "_fields") else None
        return types.BaseTuple.from_types([type_of(one) for one in value], pytype)
    if not isinstance(value, bool | int | float | np.number | type(None)):
        raise NotAFormula
    return types.float64 if isinstance(value, float) else numba.typeof(value)


def symbols(kind: Any, value: Any = None) -> Any:
    """Return a value as a symbol, and a tuple's as a tuple of such."""
    if isinstance(kind, types.NoneType):
        return None
    if not isinstance(kind, types.BaseTuple):
        return Symbol(kind, value)
    parts = [None] * len(kind) if value is None else cgutils.unpack_tuple(Trace.now.builder, value, len(kind))
    inside = [symbols(k, part) for k, part in zip(kind, parts, strict=True)]
    return kind.instance_class(*inside) if isinstance(kind, types.BaseNamedTuple) else tuple(inside)


class Symbol:
    """A value that the machine will know."""

    __slots__ = ("type", "value")

    def __init__(self, kind: Any, value: Any) -> None:
        self.type, self.value = kind, value

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
    """``math``, of symbols too."""

    def __getattr__(self, name: str) -> Any:
        known = getattr(math, name)
        if not callable(known):
            return known
        return lambda *arguments: (
            Trace.now.apply(known, *arguments) if any(isinstance(a, Symbol) for a in arguments) else known(*arguments)
        )


def _shape(argument: Any) -> Any:
    if isinstance(argument, tuple):
        return tuple(map(_shape, argument))
    return argument.type if isinstance(argument, Symbol) else (argument,)


class Formula:
    """A helper in a trace: run on symbols if it is a formula, else called as numba has it (``plain``)."""

    def __init__(self, function: FunctionType, plain: Any, *, called: bool) -> None:
        self.function, self.plain = function, plain
        self.pack = EMIT.get(function.__name__) if function.__module__.endswith(".algebra") else None
        self.never = called
        self.signature = inspect.signature(function)
        self.known: dict[Any, bool] = {}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Return what the helper makes of symbols and numbers."""
        trace = Trace.now
        if named:
            arguments = self.signature.bind(*arguments, **named).args
        if self.pack is not None and all(type_of(x) == types.float64 for a in arguments for x in a):
            if trace.builder is None:
                return tuple(Symbol(types.float64, None) for _ in range(9))
            given = [[trace.value(x, types.float64) for x in a] for a in arguments]
            return tuple(Symbol(types.float64, value) for value in self.pack(trace.builder, *given))
        key = _shape(arguments)
        if trace.builder is None and key not in self.known and not self.never:
            try:
                result = self.function(*arguments)
            except (NotAFormula, TypeError):  # what Python cannot do with symbols, numba may
                self.known[key] = False
            else:
                self.known[key] = True
                return result
        if self.known.get(key):
            return self.function(*arguments)
        return trace.apply(self.plain, *arguments)


def _short_range(*bounds: Any) -> range:
    """Return a range that a trace writes out; of one that is longer, or unknown, numba makes a loop."""
    if any(isinstance(one, Symbol) for one in bounds) or len(range(*bounds)) > LONGEST:
        raise NotAFormula
    return range(*bounds)


def _global(value: Any) -> Any:
    """Return what a global name stands for in a trace."""
    if value is math:
        return _Mathematics()
    if isinstance(value, ModuleType):
        return Symbol(None, None)  # refuses its attributes
    if hasattr(value, "formula"):
        return value.formula
    if isinstance(value, numba.core.dispatcher.Dispatcher | numba.extending._Intrinsic):
        return lambda *arguments: Trace.now.apply(value, *arguments)
    return value


def traced(twin: FunctionType, plain: Any, *, called: bool) -> Any:
    """Return what kernels call for a helper: its formula if it is one, else ``plain``, its dispatcher.

    ``twin`` is the function with globals that are compiled or traced; ``called``: it is long enough to be called by itself.
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

    def define(typing: Any, *given: Any, **named: Any) -> Any:
        given = formula.signature.bind(*given, **named).args
        finding = Trace(typing)
        try:
            with finding.running():
                result = type_of(formula(*map(symbols, given)))
        except NotAFormula:
            kind, wanted = finding.signature(plain, given)
            return wanted, lambda target, builder, _, values: target.get_function(kind, wanted)(builder, values)

        def write(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            writing = Trace(typing, target, builder)
            with writing.running():
                return writing.value(formula(*map(symbols, given, values)), signature.return_type)

        return result(*given), write

    parameters = [inspect.Parameter("typing", inspect.Parameter.POSITIONAL_ONLY)]
    define.__signature__ = inspect.Signature([*parameters, *formula.signature.parameters.values()])  # type: ignore[attr-defined]
    one = intrinsic(define)
    one.formula = formula
    return one
