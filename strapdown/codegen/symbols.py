"""Symbols that trace formulas: :mod:`strapdown.codegen.interpreted` executes functions on them, and equal operations are recorded once.

A number that is known while tracing stays a Python float, and zeros and ones vanish as they do in the kernels. What differs between two
outcomes without other effects becomes a selection, which :mod:`strapdown.codegen.regions` writes as an ``if``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

PINNED = ("load", "at", "result", "parameter")
"""Kinds of symbols that stay in the block in which they were made."""
INTEGER = ("+", "-", "*", "neg", "//", "%", "|", "select")
"""Operations whose result is an integer, if the operands are."""
CONDITIONS = ("<", ">", "<=", ">=", "==", "&&", "||", "not")


def binary(kind: str) -> Callable[[Symbol, Any], Any]:
    """Return the method of an operator with the symbol on its left."""
    return lambda self, other: self.trace.symbol(kind, self, other)


def reflected(kind: str) -> Callable[[Symbol, Any], Any]:
    """Return the method of an operator with the symbol on its right."""
    return lambda self, other: self.trace.symbol(kind, other, self)


class Symbol:
    """Result of an operation: ``kind`` and operands, other symbols or numbers."""

    __array_ufunc__ = None
    """Operations with NumPy arrays are refused, not applied to each element."""

    def __init__(self, trace: Trace, kind: str, operands: tuple[Any, ...], result: str, number: int, run: int) -> None:
        self.trace, self.kind, self.operands, self.number, self.run = trace, kind, operands, number, run
        self.place = trace.place
        self.type = result
        """``"int"``, ``"wide"`` (of times, which are double in single precision too), or ``""``."""

    def __bool__(self) -> bool:
        raise TypeError(f"a condition ({self.kind}) that is known only on the target; write an if, or select")

    def __add__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, list) else self.trace.sum(self, other)

    def __radd__(self, other: Any) -> Any:
        return self.trace.sum(other, self)

    def __sub__(self, other: Any) -> Any:
        return self if other == 0 and not isinstance(other, Symbol) else self.trace.symbol("-", self, other)

    def __mul__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, list) else self.trace.product(self, other)

    def __rmul__(self, other: Any) -> Any:
        return self.trace.product(other, self)

    def __pow__(self, other: int) -> Any:
        return self * self if other == 2 else NotImplemented

    def __neg__(self) -> Any:
        return self.trace.symbol("neg", self)

    def __abs__(self) -> Any:
        return self.trace.symbol("fabs", self)

    def __or__(self, other: Any) -> Any:
        return self.trace.symbol("|", self, other) if type(other) is int else self.trace.condition("||", self, other)

    __ror__ = __or__
    __rsub__, __truediv__, __rtruediv__ = reflected("-"), binary("/"), reflected("/")
    __floordiv__, __mod__ = binary("//"), binary("%")
    __lt__, __gt__, __le__, __ge__ = binary("<"), binary(">"), binary("<="), binary(">=")


def type_of(kind: str, operands: tuple[Any, ...]) -> str:
    """Return the type of an operation's result. The difference of two times as they are stored is a duration, of the usual type."""
    if kind in PINNED:
        return ""
    if kind in (*CONDITIONS, "trunc"):
        return "int"
    types = [x.type if isinstance(x, Symbol) else "int" if isinstance(x, int) else "" for x in operands]
    if "wide" in types:
        stored = types == ["wide", "wide"] and all(x.kind in PINNED for x in operands)
        return "" if kind == "-" and stored else "wide"
    if kind == "select":
        del types[0]
    return "int" if kind in INTEGER and "" not in types else ""


class Trace:
    """The operations of a function of the target, in order."""

    def __init__(self) -> None:
        self.symbols: dict[tuple[Any, ...], Symbol] = {}
        self.number = 0
        self.run = 0
        self.group: tuple[Any, ...] = ()
        self.outcomes: dict[Any, bool] = {}
        """Conditions in the branches that are traced at present."""
        self.arrays: list[Values] = []
        self.writes = 0
        """Number of writes to elements of arrays."""
        self.place: Any = None
        """Block of the function in which symbols are made at present."""

    def count(self) -> int:
        """Return the next number in the order of symbols and statements."""
        self.number += 1
        return self.number

    def symbol(self, kind: str, *operands: Any) -> Symbol:
        """Return the symbol of an operation."""
        result = type_of(kind, operands)
        key = (kind, result, *operands)
        known = self.symbols.get(key)
        if known is None:
            group = (operands[0],) if kind == "select" else ()
            members = any(isinstance(x, Symbol) and x.kind == "select" and x.run == self.run for x in operands)
            if group != self.group or not group or members:
                self.run, self.group = self.run + 1, group
            known = self.symbols[key] = Symbol(self, kind, operands, result, self.count(), self.run)
        return known

    def pinned(self, kind: str, result: str, *operands: Any) -> Symbol:
        """Return a symbol that stays in its block (:data:`PINNED`), of a type."""
        symbol = self.symbol(kind, *operands)
        symbol.type = result
        return symbol

    def sum(self, a: Any, b: Any) -> Any:
        """Return a + b."""
        if not isinstance(a, Symbol) and a == 0:
            return b
        return a if not isinstance(b, Symbol) and b == 0 else self.symbol("+", a, b)

    def product(self, a: Any, b: Any) -> Any:
        """Return a b."""
        for x, y in ((a, b), (b, a)):
            if not isinstance(x, Symbol) and x in (0, 1, -1):
                return 0.0 if x == 0 else y if x == 1 else -y
        return self.symbol("*", a, b)

    def condition(self, kind: str, a: Any, b: Any) -> Any:
        """Return a and b, or a or b."""
        for x, y in ((a, b), (b, a)):
            if isinstance(x, bool):
                return y if x == (kind == "&&") else x
        return self.symbol(kind, a, b)

    def read_only(self, operand: Callable[[], Any]) -> Any:
        """Return the value of an operand, which the target evaluates even if Python would not."""
        before, value = self.writes, operand()
        if self.writes > before:
            raise TypeError("an operand of `and` or `or` after the first writes to an array; write it as an `if`")
        return value

    # ------------------------------------------------------------------------------------ functions that kernels find by these names

    def square_root(self, x: Any) -> Any:
        """Return √x."""
        return self.symbol("sqrt", x) if isinstance(x, Symbol) else math.sqrt(x)

    def select(self, condition: Any, a: Any, b: Any) -> Any:
        """Return a where the condition holds, else b."""
        condition = self.outcomes.get(condition, condition)
        if not isinstance(condition, Symbol):
            return a if condition else b
        if a is b or (not isinstance(a, Symbol) and not isinstance(b, Symbol) and a == b):
            return a
        return self.symbol("select", condition, a, b)


class Values:
    """An array of the target: each element is loaded when it is first read, and stored by the function that changed it.

    ``name`` maps an index to the place on the target; None: the elements exist only while tracing.
    """

    def __init__(self, trace: Trace, name: Callable[[int], str] | None = None, kind: str = "") -> None:
        self.trace, self.name, self.type = trace, name, kind
        self.known: dict[Any, Any] = {}
        self.changed: dict[Any, Any] = {}
        self.loaded: dict[Any, Any] = {}
        """Elements as they are on the target."""
        self.loads = 0
        """Number of loads, by which those of one element at two places are two symbols."""
        trace.arrays.append(self)

    def __getitem__(self, i: Any) -> Any:
        if i not in self.known:
            if self.name is None:
                raise KeyError(f"element {i} is read before it is written")
            if i not in self.loaded:
                self.loads += 1
                self.loaded[i] = self.trace.pinned("load", self.type, self.name(i), (id(self), self.loads))
            self.known[i] = self.loaded[i]
        return self.known[i]

    def __setitem__(self, i: Any, value: Any) -> None:
        self.known[i] = self.changed[i] = value
        self.trace.writes += 1

    def forget(self) -> None:
        """Forget the elements: the target may have other values now."""
        if self.name is not None:
            self.known, self.changed, self.loaded = {}, {}, {}
