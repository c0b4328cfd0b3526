"""A traced function as text in C or JavaScript, which differ in few words."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from strapdown.codegen.functions import Block, Function, Statement
from strapdown.codegen.regions import Group, Placement, values_in
from strapdown.codegen.symbols import PINNED, Symbol

PRECEDENCE = {"||": 1, "&&": 2, "|": 2.5, "<": 3, ">": 3, "<=": 3, ">=": 3, "==": 3, "+": 4, "-": 4}
PRECEDENCE |= dict.fromkeys(("*", "/", "//", "%"), 5)
FUNCTIONS = ("sqrt", "fabs", "exp", "expm1", "sin", "cos", "tan", "asin", "atan2", "lowest")
LONGEST = 72
"""Longest expression, in characters, that is written into another."""
WIDTH = 118


@dataclass(frozen=True, kw_only=True, eq=False)
class Language:
    """Words of a language."""

    variable: dict[str, str]
    """Declaration of a variable, by its type."""
    constant: dict[str, str]
    """Declaration of a constant."""
    member: str
    """Between the filter and its member."""
    number: Callable[[float], str]
    function: Callable[[str], str]
    """Name of a mathematical function."""
    numbers: Callable[[Iterable[str]], str]
    """A list of numbers as an argument."""
    array: Callable[[str, int], str]
    """Declaration of an array of zeros."""
    status: Callable[[str], str]
    """A status of the filter."""
    truncated: Callable[[str], str]
    """A number as an integer, rounded towards zero."""
    real: Callable[[str], str]
    """An integer, or a duration (the difference of two times), as a number of the usual type."""
    quotient: Callable[[str], str]
    """A quotient of positive integers rounded down."""


class Writer:
    """The lines of a function."""

    def __init__(self, function: Function, language: Language) -> None:
        self.function, self.language = function, language
        self.placement = Placement(function)
        self.lines: list[str] = []
        self.indent = 1
        self.names: dict[Symbol, str] = {}
        self.used: dict[str, int] = {}
        self.written: set[Symbol] = set()
        self._block(function.body)

    def line(self, text: str) -> None:
        """Add a line."""
        self.lines.append("    " * self.indent + text)

    # ------------------------------------------------------------------------------------------------------------------------ statements

    def _block(self, block: Block) -> None:
        for statement in block.statements:
            if statement.kind not in ("comment", "array", "variable"):
                self._symbols(self._loads_before(statement, block), block)
                self._symbols(self.placement.needed(values_in(statement), block, self.written), block)
            getattr(self, f"_{statement.kind}")(statement)

    def _loads_before(self, statement: Statement, block: Block) -> list[Symbol]:
        """Return the loads that a statement with an effect must not overtake."""
        alive, places = self.placement.alive, self.placement.places
        kinds = ("load", "at")
        loads = [x for x in alive if x.kind in kinds and x.number < statement.number and places[x] is block]
        return self.placement.needed(loads, block, self.written)

    def _comment(self, statement: Statement) -> None:
        self.line(f"/* {statement.text} */")

    def _array(self, statement: Statement) -> None:
        self.line(self.language.array(statement.text, statement.values[0]))

    def _store(self, statement: Statement) -> None:
        for target, value in zip(statement.targets, statement.values, strict=True):
            self.line(f"{self._member(target)} = {self.text(value, 'int' if isinstance(value, int) else '')};")

    def _put(self, statement: Statement) -> None:
        index, value = statement.values
        self.line(f"{self._member(statement.text)}[{self.text(index, 'int')}] = {self.text(value)};")

    def _variable(self, statement: Statement) -> None:
        size, kind = statement.values
        declared = self.language.variable[kind]
        self.line(self.language.array(statement.text, size) if size else f"{declared} {statement.text};")

    def _if(self, statement: Statement) -> None:
        self.line(f"if ({self._operand(statement.values[0], 0, right=False)}) {{")
        for i, block in enumerate(statement.blocks):
            if i and not block.statements:
                continue
            if i:
                self.line("} else {")
            self.indent += 1
            self._block(block)
            self.indent -= 1
        self.line("}")

    def _for(self, statement: Statement) -> None:
        name, (start, stop) = statement.text, (self.text(x, "int") for x in statement.values)
        self._repeated(
            f"for ({self.language.variable['int']} {name} = {start}; {name} < {stop}; {name}++) {{", statement
        )

    def _loop(self, statement: Statement) -> None:
        self._repeated("for (;;) {", statement)

    def _break(self, statement: Statement) -> None:
        self.line("break;")

    def _repeated(self, head: str, statement: Statement) -> None:
        self.line(head)
        self.indent += 1
        self._block(statement.blocks[0])
        self.indent -= 1
        self.line("}")

    def _call(self, statement: Statement) -> None:
        arguments = ["f"]
        for value in statement.values:
            if isinstance(value, str):
                arguments.append(value)
            elif isinstance(value, tuple):
                texts = [self.text(x) for x in value]
                vectors = ((name, size) for name, size in self.function.parameters if isinstance(size, int))
                whole = [name for name, size in vectors if texts == [f"{name}[{i}]" for i in range(size)]]
                arguments.append(whole[0] if whole else self.language.numbers(texts))
            else:
                arguments.append(self.text(value, "int" if isinstance(value, int) else ""))
        text = f"{statement.text}({', '.join(arguments)})"
        if statement.result in self.placement.places:
            assert statement.result is not None
            name = self.names[statement.result] = self._new("s")
            self.written.add(statement.result)
            text = f"{self.language.constant[statement.result.type]} {name} = {text}"
        self.line(f"{text};")

    def _return(self, statement: Statement) -> None:
        if statement.text:
            status = self.language.status(statement.text)
            if statement.text != "OK":
                self.line(f"{self._member('f->status')} |= {status};")
            self.line(f"return {status};")
        elif statement.values:
            self.line(f"return {self.text(statement.values[0])};")
        else:
            self.line("return;")

    # --------------------------------------------------------------------------------------------------------------------------- symbols

    def _symbols(self, symbols: list[Symbol], block: Block) -> None:
        for symbol in symbols:
            if symbol in self.written:
                continue
            group = self.placement.groups.get(symbol)
            if group is not None:
                self._group(group, block)
            elif not self._inlined(symbol):
                self._declare(symbol)

    def _declare(self, symbol: Symbol) -> None:
        self.written.add(symbol)
        if symbol.kind == "tuple":
            name, size, *arguments = symbol.operands
            here = self.names[symbol] = self._new(f"{name}_")
            self.line(self.language.array(here, int(size)))
            self.line(f"{name}({', '.join([*(self.text(x) for x in arguments), here])});")
            return
        if symbol.kind == "parameter" or (symbol.kind == "load" and self._is_constant(symbol.operands[0])):
            self.names[symbol] = symbol.operands[0]
            return
        text = self._expression(symbol)
        member = symbol.kind == "load" and symbol.operands[0].startswith("f->")
        name = self._new(re.sub(r"f->|\]", "", symbol.operands[0]).replace("[", "_") if member else "t")
        self.names[symbol] = name
        self.line(f"{self.language.constant[symbol.type]} {name} = {text};")

    def _is_constant(self, place: str) -> bool:
        """Return whether a place is a parameter or a local array that nothing changes while its elements are used."""
        return not place.startswith("f->") and place.partition("[")[0] not in self.function.changing

    def _group(self, group: Group, block: Block) -> None:
        """Write selections with the same condition as one branch."""
        members = group.members
        self._symbols(self.placement.needed((x for m in members for x in m.operands), block, self.written), block)
        names = [self._new("m") for _ in members]
        for kind in dict.fromkeys(member.type for member in members):
            own = [name for name, member in zip(names, members, strict=True) if member.type == kind]
            self.line(f"{self.language.variable[kind]} {', '.join(own)};")
        self.line(f"if ({self.text(members[0].operands[0])}) {{")
        for i, arm in enumerate(group.arms, 1):
            if i == 2:
                self.line("} else {")
            self.indent += 1
            self._symbols(self.placement.needed((m.operands[i] for m in members), arm, self.written), arm)
            for name, member in zip(names, members, strict=True):
                self.line(f"{name} = {self._as(member.type, member.operands[i], 0, right=False, kind=member.type)};")
            self.indent -= 1
        self.line("}")
        for name, member in zip(names, members, strict=True):
            self.names[member] = name
            self.written.add(member)

    def _inlined(self, symbol: Symbol) -> bool:
        """Return whether an operation is written into the only one that uses it."""
        if symbol.kind == "item":
            return True
        if symbol.kind in (*PINNED, "select", "tuple") or self.placement.uses[symbol] != 1:
            return False
        return symbol in self.user_here and len(self._expression(symbol)) <= LONGEST

    @functools.cached_property
    def user_here(self) -> set[Symbol]:
        """Operations whose users, statements ``if`` among them, are in the same block, outside the arms of a selection."""
        places, groups, here = self.placement.places, self.placement.groups, set(self.placement.conditions)
        for user in self.placement.alive:
            group = groups.get(user)
            if group is not None:
                pairs = list(zip(user.operands[1:], group.arms, strict=True))
            else:
                pairs = [] if user.kind in PINNED else [(x, places[user]) for x in user.operands]
            here |= {x for x, block in pairs if isinstance(x, Symbol) and places[x] is block}
        return here

    def _new(self, stem: str) -> str:
        number = self.used[stem] = self.used.get(stem, 0) + 1
        if stem in ("t", "m", "s"):
            return f"{stem}{number}"
        return stem if number == 1 else f"{stem}_{number}"

    # ----------------------------------------------------------------------------------------------------------------------- expressions

    def _member(self, text: str) -> str:
        return text.replace("->", self.language.member)

    def text(self, value: Any, kind: str = "") -> str:
        """Return a value where a number of a type is used."""
        if isinstance(value, Symbol):
            return self.names[value] if value in self.names else self._expression(value)  # an item has no name
        if kind == "int" and float(value).is_integer():
            return str(int(value))
        return repr(float(value)) if kind == "wide" else self.language.number(float(value))

    def _operand(self, value: Any, level: float, *, right: bool, kind: str = "") -> str:
        if isinstance(value, Symbol) and value not in self.names:
            own = PRECEDENCE.get(value.kind, 6 if value.kind in (*FUNCTIONS, "load", "at", "item") else 0)
            text = self._expression(value)
            return text if own > level or (own == level and not right) else f"({text})"
        text = self.text(value, kind)
        return f"({text})" if text.startswith("-") else text

    def _as(self, result: str, value: Any, level: float, *, right: bool, kind: str = "") -> str:
        """Return an operand of an operation with a result of a type."""
        if result == "" and isinstance(value, Symbol) and value.type == "int":
            return self.language.real(self._operand(value, 6, right=True))
        return self._operand(value, level, right=right, kind=kind)

    def _expression(self, symbol: Symbol) -> str:
        kind, operands, language = symbol.kind, symbol.operands, self.language
        if kind in PRECEDENCE:
            return self._binary(symbol)
        if kind == "load":
            return self._member(operands[0])
        if kind in ("at", "item"):
            array = self._member(operands[0]) if kind == "at" else self.names[operands[0]]
            return f"{array}[{self._operand(operands[1], 0, right=False, kind='int')}]"
        if kind == "select":
            a, b = (self._as(symbol.type, x, 5, right=True, kind=symbol.type) for x in operands[1:])
            return f"{self._operand(operands[0], 5, right=True)} ? {a} : {b}"
        if kind in ("neg", "not"):
            inner = self._operand(operands[0], 6 if kind == "neg" else 0, right=kind == "neg")
            return f"-{inner}" if kind == "neg" else f"!({inner})"
        inner = ", ".join(self._as(symbol.type, x, 0, right=False) for x in operands)
        return f"{language.function(kind)}({inner})" if kind in FUNCTIONS else language.truncated(inner)

    def _binary(self, symbol: Symbol) -> str:
        kind, operands, language = symbol.kind, symbol.operands, self.language
        level, types = PRECEDENCE[kind], [x.type for x in operands if isinstance(x, Symbol)]
        own = "wide" if "wide" in types else "int" if {"int", "status"} & {*types} and kind != "/" else ""
        pair = [self._as(symbol.type, x, level, right=i > 0, kind=own) for i, x in enumerate(operands)]
        left, right = (f"({x})" if kind == "||" and "&&" in x else x for x in pair)
        if "wide" in types and symbol.type == "":
            return language.real(f"({left} - {right})")
        if kind == "//":
            return language.quotient(f"{left} / {right}")
        return f"{left} {kind} {right}"
