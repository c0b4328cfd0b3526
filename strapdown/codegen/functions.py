"""A function of the target while it is traced: statements in blocks, among them branches, calls and returns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from strapdown.codegen.symbols import Symbol, Trace, Values


@dataclass(eq=False)
class Block:
    """Statements that are executed together, or an arm of a selection, which has none."""

    parent: Block | None = None
    statements: list[Statement] = field(default_factory=list)
    depth: int = field(init=False)

    def __post_init__(self) -> None:
        self.depth = 0 if self.parent is None else self.parent.depth + 1


@dataclass(eq=False)
class Statement:
    """A statement: what it is, the symbols that it needs, and blocks inside it."""

    kind: str
    """``"store"``, ``"put"``, ``"if"``, ``"for"``, ``"loop"``, ``"break"``, ``"call"``, ``"return"``, ``"comment"``,
    ``"array"`` or ``"variable"``."""
    text: str = ""
    """Name of the called function, of the status returned, of an array; or a comment."""
    values: Sequence[Any] = ()
    targets: Sequence[str] = ()
    blocks: Sequence[Block] = ()
    result: Symbol | None = None
    number: int = 0
    """Place in the order of symbols and statements."""


class Member(Values):
    """An array with rows; on the target, where the indices of its elements may be known only there, or without a name, while tracing."""

    def __init__(self, function: Function, base: str, shape: tuple[int, ...], kind: str = "") -> None:
        super().__init__(function.trace, (lambda i: f"{base}[{i}]") if base else None, kind)
        self.function, self.base, self.shape = function, base, shape
        function.changing.add(base)

    def __len__(self) -> int:
        return self.shape[0]

    def _place(self, index: Any) -> Any:
        if not isinstance(index, tuple):
            return index
        row, column = index
        return row * self.shape[1] + column

    def __getitem__(self, index: Any) -> Any:
        place = self._place(index)
        if not isinstance(place, Symbol):
            return super().__getitem__(int(place))
        self.function.flush()
        self.loads += 1
        return self.trace.pinned("at", self.type, self.base, place, (id(self), self.loads))

    def __setitem__(self, index: Any, value: Any) -> None:
        place = self._place(index)
        if not isinstance(place, Symbol):
            super().__setitem__(int(place), value)
            return
        self.function.flush()
        self.function.add(Statement("put", self.base, values=(place, value)))
        self.trace.writes += 1
        self.forget()


class Local(Member):
    """A local array of the target, which is declared if it is used."""

    declared = False

    def _place(self, index: Any) -> Any:
        if not self.declared:
            self.declared = True
            self.function.body.statements.insert(0, Statement("array", self.base, values=(math.prod(self.shape),)))
        return super()._place(index)


class Variable(Values):
    """A number, or several, that a branch or a loop changes."""

    def __init__(self, function: Function, base: str, size: int, kind: str) -> None:
        super().__init__(function.trace, lambda i: f"{base}[{i}]" if size else base, kind)
        self.base, self.size = base, size

    def value(self) -> Any:
        """Return its present value."""
        return tuple(self[i] for i in range(self.size)) if self.size else self[0]

    def put(self, value: Any) -> None:
        """Change it."""
        for i, x in enumerate(value if isinstance(value, tuple) else (value,)):
            self[i] = x


class Function:
    """A function of the target."""

    def __init__(self, name: str, parameters: Sequence[tuple[str, Any]], *, returns: str = "") -> None:
        self.name, self.parameters, self.returns = name, parameters, returns
        self.trace = Trace()
        self.body = self.block = self.trace.place = Block()
        self.calls = 0
        self.results = 0
        """Number of results, if there are several."""
        self.names: dict[str, int] = {}
        self.changing: set[str] = set()
        """Arrays whose elements may change after they are read."""

    def argument(self, name: str) -> Any:
        """Return a parameter: a symbol, a tuple of them, or an array that the function writes."""
        size = dict(self.parameters)[name]
        if isinstance(size, str):
            return self.trace.pinned("parameter", size, name)
        if size < 0:
            return Member(self, name, (-size,))
        if size:
            return tuple(self.trace.symbol("load", f"{name}[{i}]", name) for i in range(size))
        return self.trace.symbol("parameter", name)

    def new_name(self, stem: str) -> str:
        """Return a name for a variable."""
        self.names[stem] = number = self.names.get(stem, 0) + 1
        return f"{stem}_v{number}"

    def type_of(self, *values: Any) -> str:
        """Return the type of a variable with these values."""
        types = {x.type if isinstance(x, Symbol) else "int" if isinstance(x, int) else "" for x in values}
        return "wide" if "wide" in types else "int" if types == {"int"} else ""

    def variable(self, stem: str, *values: Any, changes: bool = False) -> tuple[Variable, Statement]:
        """Return a variable for one of some values, and its declaration."""
        size = len(values[0]) if isinstance(values[0], tuple) else 0
        kind = "" if size else self.type_of(*values)
        name = self.new_name(stem)
        if changes:
            self.changing.add(name)
        return Variable(self, name, size, kind), Statement("variable", name, values=(size, kind))

    # ------------------------------------------------------------------------------------------------------------------------ statements

    def add(self, statement: Statement) -> None:
        """Add a statement to the present block."""
        statement.number = self.trace.count()
        self.block.statements.append(statement)

    def comment(self, text: str) -> None:
        """Add a comment."""
        self.add(Statement("comment", text))

    def flush(self) -> None:
        """Store the changed elements of all arrays."""
        targets, values = [], []
        for array in self.trace.arrays:
            if array.name is not None:
                for i in sorted(array.changed):
                    targets.append(array.name(i))
                    values.append(array.changed[i])
                    array.loaded[i] = array.changed[i]
                array.changed = {}
        if targets:
            self.add(Statement("store", targets=targets, values=values))

    def inside(self, block: Block, body: Callable[[], None]) -> None:
        """Trace a body into a block; what it knows of arrays is not known after it."""
        before = [(dict(array.known), dict(array.changed), dict(array.loaded)) for array in self.trace.arrays]
        outer = self.block
        self.block = self.trace.place = block
        body()
        self.flush()
        self.block = self.trace.place = outer
        left = bool(block.statements) and block.statements[-1].kind in ("return", "break")
        for array, state in zip(self.trace.arrays, before, strict=False):
            empty: Any = ({}, {}, {})
            array.known, array.changed, array.loaded = state if left or array.name is None else empty

    def branch(self, condition: Symbol, then: Callable[[], None], otherwise: Callable[[], None] | None = None) -> None:
        """Execute one of two bodies, according to a condition that is known only on the target."""
        self.flush()
        bodies = [then] if otherwise is None else [then, otherwise]
        blocks = [Block(self.block) for _ in bodies]
        self.add(Statement("if", values=(condition,), blocks=blocks))
        for block, body in zip(blocks, bodies, strict=True):
            self.inside(block, body)

    def leave_loop(self) -> None:
        """Leave the innermost loop."""
        self.flush()
        self.add(Statement("break"))

    def call(self, name: str, *arguments: Any, result: str | None = None) -> Any:
        """Call another function of the filter with numbers, tuples of them and local arrays; ``result``: type of its result."""
        self.flush()
        self.calls += 1
        value = None if result is None else self.trace.pinned("result", result, name, self.calls)
        values = [x.base if isinstance(x, Member) else x for x in arguments]
        self.add(Statement("call", name, values=values, result=value))
        for array in self.trace.arrays:
            array.forget()
        return value

    def give(self, value: Any, status: str = "") -> None:
        """Return a number, nothing, or a status."""
        self.flush()
        self.add(Statement("return", status, values=() if value is None else (value,)))
