"""Where each operation of a traced function belongs: in the innermost block, or arm of a selection, that contains all its uses."""

from __future__ import annotations

import collections
import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from strapdown.codegen.functions import Block, Function, Statement
from strapdown.codegen.symbols import PINNED, Symbol

WORTH_A_BRANCH = 4
"""Operations in the arms of a selection from which on it is written as ``if``."""


@dataclass(eq=False)
class Group:
    """Selections with the same condition, made one after the other, as one ``if`` in a block."""

    members: list[Symbol] = field(default_factory=list)
    block: Block = field(default_factory=Block)
    arms: tuple[Block, ...] = ()


def symbols_of(values: Iterable[Any]) -> Iterator[Symbol]:
    """Return the symbols among values, and in tuples of them."""
    for value in values:
        if isinstance(value, Symbol):
            yield value
        elif isinstance(value, tuple):
            yield from symbols_of(value)


def blocks_of(block: Block) -> Iterator[Block]:
    """Return a block and all inside it."""
    yield block
    for statement in block.statements:
        for inner in statement.blocks:
            yield from blocks_of(inner)


def uses_of(body: Block) -> Iterator[tuple[Symbol, Statement, Block]]:
    """Return the symbols that the statements of a block and of those inside it use, with the statement and its block."""
    for block in blocks_of(body):
        for statement in block.statements:
            for symbol in symbols_of(statement.values):
                yield symbol, statement, block


def common(a: Block, b: Block) -> Block:
    """Return the innermost block that contains both."""
    while a is not b:
        if a.depth < b.depth:
            a, b = b, a
        assert a.parent is not None
        a = a.parent
    return a


class Placement:
    """Blocks of all live symbols of a function, and the number of uses of each."""

    def __init__(self, function: Function) -> None:
        self.alive = self._alive(function.body)
        self.groups = self._grouped()
        self.places = self._placed(function.body)
        sizes = collections.Counter(self.places[symbol] for symbol in self.alive)
        for symbol, group in list(self.groups.items()):
            if sum(sizes[arm] for arm in group.arms) < WORTH_A_BRANCH:
                del self.groups[symbol]
        self.places = self._placed(function.body)
        branches = ((x, block) for block in blocks_of(function.body) for x in block.statements if x.kind == "if")
        self.conditions = [x.values[0] for x, block in branches if self.places.get(x.values[0]) is block]
        """Conditions of statements ``if`` that are computed in the block of the statement."""

    def _alive(self, body: Block) -> list[Symbol]:
        """Return the symbols that are needed, in order, and count their uses."""
        self.uses: dict[Symbol, int] = collections.Counter()
        waiting: list[Symbol] = []
        for symbol, statement, _ in uses_of(body):
            # The condition of an `if` may be written into it, as an operand into an operation; no other root is.
            self.uses[symbol] += 1 if statement.kind == "if" else 2
            waiting.append(symbol)
        known = set()
        while waiting:
            symbol = waiting.pop()
            if symbol not in known:
                known.add(symbol)
                for operand in symbols_of(symbol.operands):
                    self.uses[operand] += 1
                    waiting.append(operand)
        return sorted(known, key=lambda symbol: symbol.number)

    def _grouped(self) -> dict[Symbol, Group]:
        """Return the group of each live selection."""
        groups: dict[tuple[Any, int], Group] = collections.defaultdict(Group)
        selections = [symbol for symbol in self.alive if symbol.kind == "select"]
        for symbol in selections:
            groups[symbol.operands[0], symbol.run].members.append(symbol)
        return {symbol: groups[symbol.operands[0], symbol.run] for symbol in selections}

    def _placed(self, body: Block) -> dict[Symbol, Block]:
        """Return the innermost block that contains all uses of each symbol."""
        places: dict[Symbol, Block] = {}

        def use(value: Any, block: Block) -> None:
            if isinstance(value, Symbol):
                places[value] = common(places[value], block) if value in places else block

        for symbol, _, block in uses_of(body):
            use(symbol, block)
        for group in self.groups.values():
            group.arms = ()
        for symbol in reversed(self.alive):
            if symbol.kind in PINNED:
                places[symbol] = symbol.place
            if symbol not in self.groups:
                for operand in symbols_of(symbol.operands):
                    use(operand, places[symbol])
                continue
            group = self.groups[symbol]
            if not group.arms:
                group.block = functools.reduce(common, (places[member] for member in group.members))
                group.arms = Block(group.block), Block(group.block)
            places[symbol] = group.block
            for value, block in zip(symbol.operands, (group.block, *group.arms), strict=True):
                use(value, block)
        return places

    def needed(self, values: Iterable[Any], block: Block, written: set[Symbol]) -> list[Symbol]:
        """Return the symbols of a block that are needed for values and not yet written, in order."""
        waiting, visited = list(symbols_of(values)), set()
        while waiting:
            symbol = waiting.pop()
            if symbol not in visited and symbol not in written:
                visited.add(symbol)
                waiting.extend(symbols_of(symbol.operands))
        return sorted((x for x in visited if self.places[x] is block), key=lambda symbol: symbol.number)


def values_in(statement: Statement) -> Iterator[Any]:
    """Return the values that a statement and the blocks inside it need."""
    yield from statement.values
    for block in statement.blocks:
        for inner in block.statements:
            yield from values_in(inner)
