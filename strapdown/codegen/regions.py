"""Where each operation of a traced function belongs: in the innermost block, or arm of a selection, that contains all its uses."""

from __future__ import annotations

import collections
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from strapdown.codegen.functions import Block, Function, Statement
from strapdown.codegen.symbols import PINNED, Symbol

WORTH_A_BRANCH = 4
"""Operations in the arms of a selection from which on it is written as ``if``."""


@dataclass(eq=False)
class Slot:
    """A place for operations: a block, or an arm of a selection."""

    parent: Slot | None
    depth: int


@dataclass(eq=False)
class Group:
    """Selections with the same condition, made one after the other, as one ``if``."""

    members: list[Symbol] = field(default_factory=list)
    slot: Slot | None = None
    arms: tuple[Slot, Slot] | None = None


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


def common(a: Slot, b: Slot) -> Slot:
    """Return the innermost slot that contains both."""
    while a is not b:
        if a.depth >= b.depth:
            assert a.parent is not None
            a = a.parent
        else:
            assert b.parent is not None
            b = b.parent
    return a


class Placement:
    """Slots of all live symbols of a function, and the number of uses of each."""

    def __init__(self, function: Function) -> None:
        self.blocks: dict[Block, Slot] = {}
        self._add_blocks(function.body, None)
        self.alive = self._alive(function.body)
        self.groups = self._grouped()
        self._place(function.body)
        sizes = collections.Counter(self.places[symbol] for symbol in self.alive)
        for symbol, group in list(self.groups.items()):
            assert group.arms is not None
            if sum(sizes[arm] for arm in group.arms) < WORTH_A_BRANCH:
                del self.groups[symbol]
        self._place(function.body)
        branches = ((x, slot) for block, slot in self.blocks.items() for x in block.statements if x.kind == "if")
        self.conditions = [x.values[0] for x, slot in branches if self.places.get(x.values[0]) is slot]
        """Conditions of statements ``if`` that are computed in the block of the statement."""

    def _add_blocks(self, block: Block, parent: Slot | None) -> None:
        slot = self.blocks[block] = Slot(parent, 0 if parent is None else parent.depth + 1)
        for statement in block.statements:
            for inner in statement.blocks:
                self._add_blocks(inner, slot)

    def _alive(self, body: Block) -> list[Symbol]:
        """Return the symbols that are needed, in order, and count their uses."""
        self.uses: dict[Symbol, int] = {}
        waiting: list[Symbol] = []
        for block in blocks_of(body):
            for statement in block.statements:
                for symbol in symbols_of(statement.values):
                    # The condition of an `if` may be written into it, as an operand into an operation; no other root is.
                    self.uses[symbol] = self.uses.get(symbol, 0) + (1 if statement.kind == "if" else 2)
                    waiting.append(symbol)
        known = set()
        while waiting:
            symbol = waiting.pop()
            if symbol not in known:
                known.add(symbol)
                for operand in symbols_of(symbol.operands):
                    self.uses[operand] = self.uses.get(operand, 0) + 1
                    waiting.append(operand)
        return sorted(known, key=lambda symbol: symbol.number)

    def _grouped(self) -> dict[Symbol, Group]:
        """Return the group of each live selection."""
        groups: dict[tuple[Any, int], Group] = collections.defaultdict(Group)
        selections = [symbol for symbol in self.alive if symbol.kind == "select"]
        for symbol in selections:
            groups[symbol.operands[0], symbol.run].members.append(symbol)
        return {symbol: groups[symbol.operands[0], symbol.run] for symbol in selections}

    def _place(self, body: Block) -> None:
        places: dict[Symbol, Slot] = {}

        def use(value: Any, slot: Slot) -> None:
            if isinstance(value, Symbol):
                places[value] = common(places[value], slot) if value in places else slot

        for block in blocks_of(body):
            for statement in block.statements:
                for symbol in symbols_of(statement.values):
                    use(symbol, self.blocks[block])
        for known in self.groups.values():
            known.slot = known.arms = None
        for symbol in reversed(self.alive):
            if symbol.kind in PINNED:
                places[symbol] = self.blocks[symbol.place]
            group = self.groups.get(symbol)
            if group is None:
                for operand in symbols_of(symbol.operands):
                    use(operand, places[symbol])
                continue
            if group.slot is None:
                slot = places[symbol]
                for member in group.members:
                    slot = common(slot, places[member])
                group.slot = slot
                group.arms = Slot(slot, slot.depth + 1), Slot(slot, slot.depth + 1)
            assert group.arms is not None
            places[symbol] = group.slot
            condition, a, b = symbol.operands
            use(condition, group.slot)
            use(a, group.arms[0])
            use(b, group.arms[1])
        self.places = places

    def needed(self, values: Iterable[Any], slot: Slot, written: set[Symbol]) -> list[Symbol]:
        """Return the symbols of a slot that are needed for values and not yet written, in order."""
        waiting, visited = list(symbols_of(values)), set()
        while waiting:
            symbol = waiting.pop()
            if symbol not in visited and symbol not in written:
                visited.add(symbol)
                waiting.extend(symbols_of(symbol.operands))
        return sorted((x for x in visited if self.places[x] is slot), key=lambda symbol: symbol.number)


def values_in(statement: Statement) -> Iterator[Any]:
    """Return the values that a statement and the blocks inside it need."""
    yield from statement.values
    for block in statement.blocks:
        for inner in block.statements:
            yield from values_in(inner)
