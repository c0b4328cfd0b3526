"""Functions of a filter, its kernels among them, executed statement by statement on symbols.

Their ``if``, ``while`` and ``for`` become those of the target, unless what decides them is known while tracing. A name that a branch or a
loop changes is a variable of the target afterwards. Some become functions of the target, others are written where they are called.
"""

from __future__ import annotations

import ast
import functools
import inspect
import math
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType, MappingProxyType, ModuleType, SimpleNamespace
from typing import Any

from strapdown.codegen.functions import Block, Statement
from strapdown.codegen.symbols import Symbol, Trace, Values
from strapdown.kernels.machine import names_of

FORMULAS = ("strapdown.kernels", "strapdown.codegen")
"""Packages of functions that are executed on symbols."""
LOOPING = ("turned_by", "take_row", "minus_outer_by_elements")
"""Kernels of the filter with loops of the target."""
LONGEST_UNROLLED = 12
"""Maximum number of repetitions that are written one after the other."""

LEAVING = (ast.Return, ast.Continue)


@dataclass(frozen=True, eq=False)
class Range:
    """Integers of a loop of the target."""

    start: Any
    stop: Any


class Expressions(ast.NodeTransformer):
    """Replaces what Python decides by the truth of an operand: chains of comparisons, ``and``, ``or``, ``not``, ``a if c else b``.

    ``a += b`` becomes ``a = a + b``.
    """

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.stmt:
        """Assign the result of the operation."""
        self.generic_visit(node)
        return ast.Assign([node.target], ast.BinOp(node.target, node.op, node.value))

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        """Join a chain of comparisons."""
        self.generic_visit(node)
        parts: list[ast.expr] = []
        for left, sign, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            if isinstance(sign, ast.Eq | ast.NotEq):
                same = called("_equal_", left, right)
                parts.append(same if isinstance(sign, ast.Eq) else called("_no_", same))
            else:
                parts.append(ast.Compare(left, [sign], [right]))
        return parts[0] if len(parts) == 1 else called("_chain_", *parts)

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.expr:
        """Evaluate all operands, of which only the first may write to an array."""
        self.generic_visit(node)
        none = ast.arguments([], [], None, [], [], None, [])
        first, *others = node.values
        others = [called("_read_only_", ast.Lambda(none, operand)) for operand in others]
        return called("_and_" if isinstance(node.op, ast.And) else "_or_", first, *others)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        """Negate a condition."""
        self.generic_visit(node)
        return called("_no_", node.operand) if isinstance(node.op, ast.Not) else node

    def visit_IfExp(self, node: ast.IfExp) -> ast.expr:
        """Select a value."""
        self.generic_visit(node)
        none = ast.arguments([], [], None, [], [], None, [])
        return called("_select_", node.test, ast.Lambda(none, node.body), ast.Lambda(none, node.orelse))


def called(name: str, *arguments: ast.expr) -> ast.expr:
    """Return the call of a helper."""
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


@functools.cache
def parsed(function: FunctionType) -> ast.FunctionDef:
    """Return a kernel's syntax tree, with calls of helpers for what the truth of an operand decides."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    tree = Expressions().visit(node)
    assert isinstance(tree, ast.FunctionDef)
    return tree


@functools.cache
def code_of(node: ast.expr) -> Any:
    """Return an expression as code; that of a target reads its value."""
    return compile(ast.unparse(node), "<kernel>", "eval")


def assigned(statements: Sequence[ast.stmt]) -> set[str]:
    """Return the names that statements assign, but not those that only count or name the elements of a loop."""
    nodes = [x for s in statements for x in ast.walk(s)]
    loops = {id(x) for node in nodes if isinstance(node, ast.For) for x in ast.walk(node.target)}
    return {x.id for x in nodes if isinstance(x, ast.Name) and not isinstance(x.ctx, ast.Load) and id(x) not in loops}


def contains(statements: Sequence[ast.stmt], kinds: tuple[type, ...]) -> bool:
    """Return whether there is a statement of a kind in statements."""
    return any(isinstance(x, kinds) for s in statements for x in ast.walk(s))


def mathematics(trace: Trace) -> dict[str, Any]:
    """Return the functions that kernels use, on symbols or numbers."""

    def function(name: str, kind: str | None = None) -> Callable[..., Any]:
        plain = getattr(math, name)
        return lambda *x: trace.symbol(kind or name, *x) if any(isinstance(t, Symbol) for t in x) else plain(*x)

    def joined(sign: str) -> Callable[..., Any]:
        return lambda *x: functools.reduce(functools.partial(trace.condition, sign), x)

    names = ("sqrt", "exp", "expm1", "sin", "cos", "tan", "asin", "atan2", "trunc")
    space = SimpleNamespace(
        **{name: function(name) for name in names},
        floor=function("floor", "lowest"),
        copysign=lambda a, b: trace.select(b < 0.0, -abs(a), abs(a)),
        inf=math.inf,
        nan=math.nan,
        pi=math.pi,
    )
    return {
        "math": space,
        "abs": abs,
        "min": lambda a, b: trace.select(b < a, b, a),
        "max": lambda a, b: trace.select(b > a, b, a),
        "square_root": trace.square_root,
        "select": trace.select,
        "any_lane": lambda condition: condition,
        "value_at": lambda array, i, like: array[i],
        "put_at": lambda array, i, value: array.__setitem__(i, value),
        "_select_": lambda c, a, b: trace.select(c, a(), b()) if isinstance(c, Symbol) else a() if c else b(),
        "_and_": joined("&&"),
        "_chain_": joined("&&"),
        "_or_": joined("||"),
        "_read_only_": trace.read_only,
        "_no_": lambda x: trace.symbol("not", x) if isinstance(x, Symbol) else not x,
        "_equal_": lambda a, b: trace.symbol("==", a, b) if isinstance(a, Symbol) or isinstance(b, Symbol) else a == b,
    }


def executed(value: Any, execute: Callable[..., Any]) -> Any:
    """Return a function of the filter, or a module of such functions, so that a call executes it on symbols; other values as they are."""
    if isinstance(value, FunctionType) and value.__module__.startswith(FORMULAS):
        return functools.partial(execute, value)
    return Module(value, execute) if isinstance(value, ModuleType) and value.__name__.startswith(FORMULAS) else value


class Module:
    """A module whose functions are executed on symbols."""

    def __init__(self, module: ModuleType, execute: Callable[..., Any]) -> None:
        self.module, self.execute = module, execute

    def __getattr__(self, name: str) -> Any:
        return executed(getattr(self.module, name), self.execute)


class Interpreter:
    """Executes kernels for a function of the target."""

    def __init__(
        self,
        m: Any,
        helpers: Mapping[str, Callable[..., Any]],
        own: Collection[FunctionType] = (),
        replaced: Mapping[str, FunctionType] = MappingProxyType({}),
    ) -> None:
        self.m, self.trace = m, m.trace
        self.helpers = {**mathematics(m.trace), "range": self._range, **helpers}
        """What is called by these names, on symbols."""
        self.own, self.replaced = own, replaced
        """Functions that become functions of the target; functions that are executed instead of others of the same names."""
        self.scopes: dict[FunctionType, dict[str, Any]] = {}
        """Functions and constants that a kernel names, by name."""
        self.outer = False
        """Whether the kernel is the function of the target, which may return anywhere."""
        self.loops = True
        """Whether long loops are loops of the target."""
        self.of_filter = False
        """Whether the function is no kernel, but one that is written for the target: its loops are not."""

    def _range(self, *bounds: Any) -> Any:
        if len(bounds) == 3:
            return range(*bounds)
        start, stop = bounds if len(bounds) == 2 else (0, bounds[0])
        known = not isinstance(start, Symbol) and not isinstance(stop, Symbol)
        unrolled = known and (not self.loops or self.of_filter or stop - start <= LONGEST_UNROLLED)
        return range(start, stop) if unrolled else Range(start, stop)

    def __call__(self, function: FunctionType, *arguments: Any) -> Any:
        """Return the result of a kernel."""
        if function in self.own:
            return self._call_own(function, arguments)
        return self._body(function, arguments)

    def unrolled(self, function: FunctionType, *arguments: Any) -> Any:
        """Return the result of a kernel whose loops are written one repetition after the other, except in those of ``LOOPING``."""
        before, self.loops = self.loops, False
        result = self(function, *arguments)
        self.loops = before
        return result

    def _body(self, function: FunctionType, arguments: Sequence[Any], *, outer: bool = False) -> Any:
        before = self.outer, self.loops, self.of_filter
        self.outer, self.loops = outer, self.loops or function.__name__ in LOOPING
        self.of_filter = function.__module__.startswith(FORMULAS[1])
        node = parsed(function)
        names, defaults = [a.arg for a in node.args.args], function.__defaults__ or ()
        env = dict(zip(names, (*arguments, *defaults[len(arguments) + len(defaults) - len(names) :]), strict=True))
        if function not in self.scopes:
            module = function.__globals__ | {n: x for n, x in self.replaced.items() if n in function.__globals__}
            self.scopes[function] = {n: executed(module[n], self) for n in names_of(function.__code__) if n in module}
            self.scopes[function] |= self.helpers
        result = self._statements(list(node.body), self.scopes[function] | env)
        self.outer, self.loops, self.of_filter = before
        return result[0] if result else None

    def _value(self, node: ast.expr, env: dict[str, Any]) -> Any:
        """Return the value of an expression."""
        try:
            return eval(code_of(node), env)
        except Exception as error:
            error.add_note(f"in a kernel: {ast.unparse(node)}")
            raise

    # ---------------------------------------------------------------------------------------------------------------------- statements

    def _statements(self, items: list[Any], env: dict[str, Any]) -> tuple[Any, ...]:
        """Execute statements; return the value returned by them in a tuple, or an empty one."""
        while items:
            node = items.pop(0)
            if isinstance(node, ast.Return):
                return (None if node.value is None else self._value(node.value, env),)
            if isinstance(node, ast.Assign | ast.AnnAssign):
                assert node.value is not None
                value = self._value(node.value, env)
                for target in [node.target] if isinstance(node, ast.AnnAssign) else node.targets:
                    self._assign(target, value, env)
            elif isinstance(node, ast.Expr):
                self._value(node.value, env)
            elif isinstance(node, ast.Continue):
                return ()
            elif isinstance(node, ast.While):
                test: Any = node.test
                condition = self._value(test, env)
                if isinstance(condition, Symbol):
                    operands = test.args if isinstance(test, ast.Call) and ast.unparse(test.func) == "_and_" else [test]
                    self._loop(Statement("loop"), operands, node.body, env)
                elif condition:
                    items[:0] = [*node.body, node]
            elif isinstance(node, ast.For):
                values = self._value(node.iter, env)
                if isinstance(values, Range):
                    self._count(values, node, env)
                else:
                    assert not contains(node.body, (ast.Return,)), "an unrolled loop is left"
                    for value in values:
                        self._assign(node.target, value, env)
                        self._statements(list(node.body), env)
            elif isinstance(node, ast.If):
                condition = self._value(node.test, env)
                if not isinstance(condition, Symbol):
                    items[:0] = node.body if condition else node.orelse
                elif self.outer and contains(node.body, (ast.Return,)):
                    self._leave_if(condition, node.body, env)
                    items[:0] = node.orelse
                else:
                    otherwise = list(node.orelse)
                    if contains(node.body, LEAVING):
                        otherwise, items = otherwise + items, []
                    result = self._branch(condition, (node.body, otherwise), env)
                    if result:
                        return result
            else:
                raise TypeError(f"a statement that cannot be exported: {ast.unparse(node)}")
        return ()

    def _assign(self, target: ast.expr, value: Any, env: dict[str, Any]) -> None:
        if isinstance(target, ast.Name):
            env[target.id] = value
        elif isinstance(target, ast.Tuple):
            for part, x in zip(target.elts, value, strict=True):
                self._assign(part, x, env)
        else:
            assert isinstance(target, ast.Subscript)
            self._value(target.value, env)[self._value(target.slice, env)] = value

    def _leave_if(self, condition: Symbol, body: Sequence[ast.stmt], env: dict[str, Any]) -> None:
        """Return from the function of the target, if a condition holds."""

        def then() -> None:
            (value,) = self._statements(list(body), dict(env))
            self.m.give(value)

        self.m.branch(condition, then)

    def _branch(
        self, condition: Symbol, bodies: tuple[Sequence[ast.stmt], ...], env: dict[str, Any]
    ) -> tuple[Any, ...]:
        """Execute both outcomes; what differs between them is a variable afterwards."""
        m, ends = self.m, []
        parent = m.block
        m.flush()
        known = [(array.known, array.loaded) for array in self.trace.arrays]

        def arm(body: Sequence[ast.stmt], outcome: bool) -> Callable[[], None]:
            def execute() -> None:
                here = dict(env)
                before, self.outer = self.outer, False
                self.trace.outcomes[condition] = outcome
                result = self._statements(list(body), here)
                del self.trace.outcomes[condition]
                self.outer = before
                ends.append(here | ({"": result[0]} if result else {}))

            return execute

        m.branch(condition, arm(bodies[0], True), arm(bodies[1], False))
        place = len(parent.statements) - 1
        blocks = parent.statements[place].blocks
        pure = not any(block.statements for block in blocks)
        if pure:
            created = [x for x in self.trace.symbols.values() if x.place in blocks]
            pure = all(x.kind != "at" for x in created)
            if pure:
                parent.statements.pop()
                for x in created:
                    x.place = parent
                for array, (elements, loaded) in zip(self.trace.arrays, known, strict=False):
                    array.known, array.loaded = elements, loaded
        for name in sorted({*assigned(bodies[0]), *assigned(bodies[1]), ""}):
            values = [end[name] for end in ends if name in end]
            env.pop(name, None)
            if len(values) == 2:
                if pure:
                    env[name] = self._selected(condition, *values)
                else:
                    env[name] = self._merged(name, values, parent, place, blocks)
        return (env.pop(""),) if "" in env else ()

    def _selected(self, condition: Symbol, a: Any, b: Any) -> Any:
        """Return one of two values without a branch."""
        if isinstance(a, tuple):
            return tuple(self._selected(condition, x, y) for x, y in zip(a, b, strict=True))
        return self.trace.select(condition, a, b)

    def _merged(self, name: str, values: list[Any], parent: Block, place: int, blocks: Sequence[Block]) -> Any:
        """Return a variable that has one of two values, according to the block that was executed."""
        variable, declaration = self.m.variable(name or "result", *values)
        parent.statements.insert(place, declaration)
        for block, value in zip(blocks, values, strict=True):
            numbers = value if isinstance(value, tuple) else (value,)
            targets = [variable.name(i) for i in range(len(numbers))]
            block.statements.append(Statement("store", targets=targets, values=numbers, number=self.trace.count()))
        return variable.value()

    # --------------------------------------------------------------------------------------------------------------------------- loops

    def _count(self, values: Range, node: ast.For, env: dict[str, Any]) -> None:
        assert isinstance(node.target, ast.Name)
        name = self.m.new_name(node.target.id.strip("_") or "i")
        statement = Statement("for", name, values=(values.start, values.stop))
        counter = self.trace.pinned("parameter", "int", name)
        self._loop(statement, [], node.body, env, (node.target.id, counter))

    def _loop(
        self,
        statement: Statement,
        conditions: Sequence[ast.expr],
        body: Sequence[ast.stmt],
        env: dict[str, Any],
        counter: tuple[str, Any] | None = None,
    ) -> None:
        m = self.m
        variables = {}
        for name in sorted(assigned(body) & set(env)):
            variables[name], declaration = m.variable(name, env[name], changes=True)
            m.add(declaration)
            variables[name].put(env[name])
        m.flush()

        def execute() -> None:
            for array in self.trace.arrays:
                array.forget()
            here = env | {name: variable.value() for name, variable in variables.items()}
            for condition in conditions:
                m.branch(self.helpers["_no_"](self._value(condition, here)), m.leave_loop)
            if counter is not None:
                here[counter[0]] = counter[1]
            result = self._statements(list(body), here)
            assert not result, "a loop of the target returns nothing"
            for name, variable in variables.items():
                variable.put(here[name])

        statement.blocks = [Block(m.block)]
        m.add(statement)
        m.inside(statement.blocks[0], execute)
        for name, variable in variables.items():
            env[name] = variable.value()

    # ------------------------------------------------------------------------------------------------------ functions of the target

    def _call_own(self, function: FunctionType, arguments: Sequence[Any]) -> Any:
        m = self.m
        names = [a.arg for a in parsed(function).args.args]
        known = dict(zip(names, arguments, strict=False))
        numeric = Symbol | int | float
        passed = {n: x for n, x in known.items() if type(x) is tuple or isinstance(x, numeric) or n == "work"}
        name = m.name_of(function, known)
        if name not in m.functions:
            sizes = {
                n: len(x) if type(x) is tuple else -len(x) if n == "work" else m.type_of(x) for n, x in passed.items()
            }
            m.define(function, sizes, known)
        target = m.functions[name]
        self.trace.writes += target.trace.writes
        if not target.results:
            result = {"": None, "real": ""}.get(target.returns, target.returns)
            return m.call(name, *passed.values(), result=result)
        variable, declaration = m.variable(name, (0.0,) * target.results)
        m.add(declaration)
        m.call(name, *passed.values(), variable.base)
        return variable.value()

    def trace_function(self, function: FunctionType, arguments: Sequence[Any]) -> None:
        """Execute a function as the one of the target."""
        m, result = self.m, self._body(function, arguments, outer=True)
        if isinstance(result, tuple):
            m.results = len(result)
            m.parameters = [*m.parameters, ("result", -len(result))]
            out = Values(m.trace, lambda i: f"result[{i}]")
            for i, value in enumerate(result):
                out[i] = value
        elif result is not None:
            m.returns = m.returns or "real"
            m.give(result)
        m.flush()
