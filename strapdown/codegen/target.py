"""The functions of the exported filter, traced."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

from strapdown.codegen import program as body
from strapdown.codegen import recording
from strapdown.codegen.functions import Function, Member, Statement
from strapdown.codegen.interpreted import Interpreter
from strapdown.codegen.program import Kernels, Program, work_size
from strapdown.codegen.symbols import Symbol, Values, rebound
from strapdown.kernels.rotation import far_turn

BRANCHING = ("turned_by", "take_row", "minus_outer_by_elements")
"""Kernels of the filter with branches and loops of the target."""


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
        helpers = {
            "square_root": trace.square_root,
            "select": trace.select,
            "any_lane": lambda condition: condition,
            "far_turn": self._far_turn,
            "load": load,
            "broadcast": broadcast,
            "sum_lanes": sum_lanes,
            "math": SimpleNamespace(expm1=lambda x: trace.symbol("expm1", x), nan=float("nan"), pi=3.141592653589793),
        }
        self.kernel, self.spaces = Interpreter(self), {}
        wrapped = dict.fromkeys(BRANCHING, lambda function: functools.partial(self.kernel, function))
        self.kernels = Kernels(program.kernels, helpers, wrapped)
        self.select, self.root = trace.select, trace.square_root
        self.state = SimpleNamespace(
            x=self.array(name_of_state),
            P=Member(self, "f->P", (program.number_of_covariances,)),
            nis=self.array(lambda i: f"f->nis[{i}]"),
            coefficients=self.array(lambda i: f"f->coefficients[{i}]"),
            dt=self.array(lambda i: "f->step_dt"),
        )
        if program.recording is not None:
            for a in program.recording.arrays:
                setattr(self.state, a.name, Member(self, f"f->{a.name}", a.shape, a.kind))
            self.spaces = {"memory": self.state, "constants": program.recording.constants}

    def another(self, name: str, parameters: Sequence[tuple[str, Any]], words: str) -> Target:
        """Return another function of the filter, not yet traced."""
        return Target(self.program, name, parameters, returns="", words=words, functions=self.functions)

    def table(self, name: str, shape: tuple[int, ...]) -> Member:
        """Return a local array with rows."""
        self.add(Statement("array", name, values=(math.prod(shape),)))
        return Member(self, name, shape)

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
        return self.table("work", (work_size(self.kernels),))

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


UPDATE = (
    "Take a sample. time: s, rising. gyro: rad/s, body axes. accelerometer: specific force, m/s^2, body axes; zero or null: missing. "
    "magnetometer: field, any unit, body axes; zero or null: missing."
)


def traced(program: Program) -> list[Target]:
    """Return the functions of the filter, in an order in which each calls only those before it."""

    def function(
        name: str,
        words: str,
        parameters: Sequence[tuple[str, Any]],
        returns: str,
        formula: Callable[..., None],
        *more: Any,
    ) -> Target:
        m = Target(program, name, parameters, returns=returns, words=words, functions=kernels)
        formula(m, program, m.state, *more, *(m.argument(parameter) for parameter, _ in parameters))
        m.flush()
        return m

    kernels: dict[str, Any] = {}
    made = [turn_function(program)]
    if program.structure.chains:
        made.append(
            function(
                "prepare", "Coefficients of the states that decay, for steps of dt.", [("dt", 0)], "", body.prepare
            )
        )
    made += [
        function(
            "step", "Propagate over one step: delta is the rotation vector.", [("delta", 3), ("dt", 0)], "", body.step
        ),
        work_function(
            program,
            "take_row",
            "Update P and the correction with the row in the work space, in Joseph's form.",
            [("residual", 0), ("variance", 0)],
            body.take_row,
        ),
        work_function(
            program,
            "subtract",
            "Subtract the outer product of a line of the work space from P.",
            [("line", "int")],
            body.subtract,
        ),
        work_function(
            program,
            "apply_step",
            "Correct the state, and transform P to the tangent space of the corrected attitude.",
            [],
            body.apply_step,
        ),
    ]
    vector = [("value", 3), ("sigma", 0)]
    if program.recording is not None:
        made.append(
            function("propagate", "Propagate over a rotation.", [("delta", 3), ("dt", 0)], "status", body.propagate)
        )
        for index, sensor in enumerate(program.sensors):
            name = f"update_{sensor.name}"
            made.append(function(name, sensor.words, vector, "status", body.update, sensor, index))
        last = []
        if program.recording.rest is not None:
            last.append(function("find_rest", "Measure the bias at rest.", [], "", recording.find_rest))
            last.append(function("use_rest", "Correct the state by a rate at rest.", [], "", recording.use_rest))
        last += [
            function("carry", "Propagate the estimate to the last sample.", [], "", recording.carry),
            function("end_step", "Filter a step: the mean of its samples.", [], "", recording.end_step),
            function("init", "Wait for the first sample.", [], "status", recording.initialize),
        ]
        sample: list[tuple[str, Any]] = [("time", "wide"), ("gyro", 3), ("accelerometer", 3), ("magnetometer", 3)]
        words = UPDATE if program.recording.magnetometer else UPDATE.partition(" magnetometer:")[0]
        sample = sample[: 3 + program.recording.magnetometer]
        last.append(function("update", words, sample, "status", recording.update))
        return made + [target for target, _ in kernels.values()] + last
    made += [
        function(
            "init",
            "Start at an attitude, with the sigma of the setup and zero bias.",
            [("attitude", 4)],
            "status",
            body.initialize,
        ),
        function(
            "predict",
            "Propagate over a gyro sample: the mean rate over the last dt.",
            [("gyro", 3), ("dt", 0)],
            "status",
            body.predict,
        ),
    ]
    for index, sensor in enumerate(program.sensors):
        made.append(
            function(
                f"update_{sensor.name}", sensor.words, [("value", sensor.size)], "status", body.update, sensor, index
            )
        )
    return made


def work_function(
    program: Program, name: str, words: str, parameters: Sequence[tuple[str, Any]], formula: Callable[..., None]
) -> Target:
    """Return a function with the work space of an update as its last parameter."""
    size = work_size(program.kernels)
    m = Target(program, name, [*parameters, ("work", -size)], returns="", words=words)
    formula(m, program, m.state, *(m.argument(parameter) for parameter, _ in parameters), Member(m, "work", (size,)))
    m.flush()
    return m


def turn_function(program: Program) -> Target:
    """Return the rotation by a large correction."""
    m = Target(
        program,
        "far_turn",
        [("x", 0), ("y", 0), ("z", 0), ("turn", -13)],
        returns="",
        words="Quaternion and Jacobian of a rotation vector of any size, by doubling.",
    )
    turn = m.array(lambda i: f"turn[{i}]")
    formula: Any = far_turn
    q, J = rebound(formula, {"square_root": m.trace.square_root}, {})(tuple(m.argument(name) for name in "xyz"))
    for i, value in enumerate((*q, *J)):
        turn[i] = value
    m.flush()
    return m
