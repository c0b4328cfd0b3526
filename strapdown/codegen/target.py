"""The functions of the exported filter, traced."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from strapdown.codegen import program as body
from strapdown.codegen import recording
from strapdown.codegen.functions import Function, Local, Member, Statement
from strapdown.codegen.interpreted import Interpreter
from strapdown.codegen.program import Program, work_size
from strapdown.codegen.symbols import Symbol, Values


class Kernels:
    """Kernels of a module, executed on symbols."""

    def __init__(self, module: ModuleType, execute: Callable[..., Any]) -> None:
        self.module, self.execute = module, execute

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.module, name)
        return functools.partial(self.execute, value) if callable(value) else value


class Target(Function):
    """A function of the filter while it is traced, as a machine for :mod:`strapdown.codegen.program`."""

    def __init__(
        self,
        program: Program,
        name: str,
        parameters: Sequence[tuple[str, Any]],
        *,
        returns: str,
        words: str,
        functions: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(name, parameters, returns=returns)
        self.words, self.n, self.program = words, program.n, program
        self.functions: dict[str, Any] = {} if functions is None else functions
        """Kernels that are functions of the target, and the number of their results."""
        trace = self.trace
        helpers: dict[str, Any] = {
            "far_turn": self._far_turn,
            "load": load,
            "broadcast": broadcast,
            "sum_lanes": sum_lanes,
        }
        self.kernel, self.spaces = Interpreter(self, helpers), {}
        self.kernels = Kernels(program.kernels, self.kernel.unrolled)
        self.select, self.root = trace.select, trace.square_root
        self.state = SimpleNamespace(
            x=self.array(name_of_state),
            P=Member(self, "f->P", (program.number_of_covariances,)),
            nis=self.array(lambda i: f"f->nis[{i}]"),
            coefficients=self.array(lambda i: f"f->coefficients[{i}]"),
            dt=self.array(lambda i: "f->step_dt"),
        )
        self.imu: Any = None
        if program.recording is not None:
            for a in program.recording.arrays:
                setattr(self.state, a.name, Member(self, f"f->{a.name}", a.shape, a.kind))
            self.imu = recording.imu_of(self)
            self.kernel.helpers |= recording.helpers(self)
            self.spaces = {"memory": self.state, "constants": self.imu.routines.head.arguments[0]}

    def another(self, name: str, parameters: Sequence[tuple[str, Any]], words: str) -> Target:
        """Return another function of the filter, not yet traced."""
        return Target(self.program, name, parameters, returns="", words=words, functions=self.functions)

    def local(self, name: str, shape: tuple[int, ...]) -> Member:
        """Return a local array with rows, declared if it is used."""
        return Local(self, name, shape)

    def passing(self, like: np.ndarray) -> Member:
        """Return an array as one of Python, which exists while tracing."""
        return Member(self, "", like.shape)

    def lowest(self, x: Any) -> Any:
        """Return x rounded down, however large."""
        return self.trace.symbol("lowest", x)

    def _far_turn(self, phi: Any) -> tuple[Any, Any]:
        values = self.trace.symbol("tuple", "far_turn", 13, *phi)
        items = tuple(self.trace.symbol("item", values, i) for i in range(13))
        return items[:4], items[4:]

    def whole(self, x: Any) -> Any:
        """Return x rounded down."""
        return self.trace.symbol("floor", x)

    def equal(self, a: Any, b: Any) -> Any:
        """Return whether two numbers are equal."""
        return self.trace.symbol("==", a, b)

    def no(self, condition: Any) -> Any:
        """Return whether a condition does not hold."""
        return self.trace.symbol("not", condition) if isinstance(condition, Symbol) else not condition

    def scratch(self) -> Values:
        """Return numbers that exist while tracing."""
        return self.array()

    def work(self) -> Member:
        """Return work space."""
        return self.local("work", (work_size(self.kernels),))

    def clear_status(self) -> None:
        """Clear the flags."""
        self.flush()
        self.add(Statement("clear"))


def name_of_state(i: int) -> str:
    """Return the member of the filter that holds element i of x."""
    if i < 4:
        return f"f->attitude[{i}]"
    return f"f->bias[{i - 4}]" if i < 7 else f"f->states[{i - 7}]"


def load(array: Any, start: int) -> Eight:
    """Return eight numbers as one value."""
    return Eight(array.reshape(-1)[start : start + 8].tolist())


def sum_lanes(x: Any) -> Any:
    """Return the sum of eight numbers, the upper half added to the lower until one is left."""
    while len(x) > 1:
        half = len(x) // 2
        x = [a + b for a, b in zip(x[:half], x[half:], strict=True)]
    return x[0]


def broadcast(x: Any) -> Eight:
    """Return a number eight times."""
    return Eight([x] * 8)


class Eight(list[Any]):
    """Eight numbers, which a kernel treats as one value."""

    def _with(self, other: Any, operation: Callable[[Any, Any], Any]) -> Eight:
        return Eight(
            [operation(a, b) for a, b in zip(self, other if isinstance(other, Eight) else [other] * 8, strict=True)]
        )

    def __add__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: a + b)

    __radd__ = __add__

    def __mul__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: a * b)

    __rmul__ = __mul__


def traced(program: Program) -> list[Target]:
    """Return the functions of the filter, in an order in which each calls only those before it."""
    kernels: dict[str, Any] = {}

    def function(
        formula: Callable[..., None],
        *parameters: tuple[str, Any],
        returns: str = "",
        more: tuple[Any, ...] = (),
        name: str = "",
        words: str = "",
    ) -> Target:
        words = words or " ".join((formula.__doc__ or "").split())
        m = Target(program, name or formula.__name__, parameters, returns=returns, words=words, functions=kernels)
        formula(m, program, m.state, *more, *(m.argument(parameter) for parameter, _ in parameters))
        m.flush()
        return m

    r, work = program.recording, ("work", -work_size(program.kernels))
    coefficients = [function(body.prepare, ("dt", 0))] if program.structure.chains else []
    functions = [
        function(body.far_turn, ("x", 0), ("y", 0), ("z", 0), ("turn", -13)),
        *coefficients,
        function(body.step, ("delta", 3), ("dt", 0)),
        function(body.take_row, ("residual", 0), ("variance", 0), work),
        function(body.subtract, ("line", "int"), work),
        function(body.apply_step, work),
    ]
    if r is None:
        functions.append(function(body.init, ("attitude", 4), returns="status"))
        functions.append(function(body.predict, ("gyro", 3), ("dt", 0), returns="status"))
    else:
        functions.append(function(body.propagate, ("delta", 3), ("dt", 0), returns="status"))
    for index, sensor in enumerate(program.sensors):
        values = [("value", sensor.size), *([] if r is None else [("sigma", 0)])]
        named: dict[str, Any] = {"name": f"update_{sensor.name}", "words": sensor.words, "more": (sensor, index)}
        functions.append(function(body.update, *values, returns="status", **named))
    if r is None:
        return functions
    at_rest = recording.find_rest, recording.clear_span, recording.use_rest
    last = [*map(function, at_rest)] if r.imu.rests else []
    last += [function(recording.carry_to_sample), function(recording.end_step)]
    last.append(function(recording.init, returns="status"))
    sample = [("time", "wide"), ("gyro", 3), ("accelerometer", 3), ("magnetometer", 3)][: 3 + r.magnetometer]
    words = " ".join((recording.update.__doc__ or "").split())
    words = words if r.magnetometer else words.partition(" magnetometer:")[0]
    last.append(function(recording.update, *sample, returns="status", words=words))
    return functions + [target for target, _ in kernels.values()] + last
