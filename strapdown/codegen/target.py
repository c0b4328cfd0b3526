"""The functions of the exported filter, traced."""

from __future__ import annotations

import ast
import functools
import math
import operator
from collections.abc import Callable, Mapping
from types import FunctionType, SimpleNamespace
from typing import Any

from strapdown.codegen import program as body
from strapdown.codegen import recording
from strapdown.codegen.functions import Function, Local, Member
from strapdown.codegen.interpreted import Interpreter, Module, parsed
from strapdown.codegen.program import Program, work_size
from strapdown.codegen.symbols import Symbol, Values
from strapdown.kernels import headings, rests
from strapdown.units import DEGREE

OWN: set[Any] = {
    *(body.far_turn, body.prepare, body.step, body.propagate, body.take_row),
    *(body.subtract, body.apply_step, body.update),
    *(recording.begin, recording.carry_to_sample, recording.end_step, recording.use_rest),
    *(headings.look, headings.insert, headings.iron_step, rests.find_rest, rests.clear_span),
}
"""Functions that are functions of the target: called at several places, long, or with an early return."""


class Target(Function):
    """A function of the filter while it is traced."""

    def __init__(
        self, program: Program, name: str, parameters: Mapping[str, Any], functions: dict[str, Target]
    ) -> None:
        super().__init__(name, list(parameters.items()))
        self.words, self.program, self.functions = "", program, functions
        """Functions of the target by name."""
        helpers: dict[str, Any] = {"load": load, "broadcast": broadcast, "sum_lanes": sum_lanes}
        helpers |= {"far_turn": self._far_turn, "comment": self.comment}
        helpers["call"] = lambda kernel, arguments, like: self.kernel(kernel, *arguments)
        self.kernel: Interpreter = Interpreter(self, helpers, OWN, recording.REPLACED)
        array = functools.partial(Values, self.trace)
        self.state = f = SimpleNamespace(
            program=program,
            kernels=Module(program.kernels, self.kernel.unrolled),
            prediction=Module(program.prediction, self.kernel.unrolled),
            x=array(name_of_state),
            P=Member(self, "f->P", (program.number_of_covariances,)),
            nis=array(lambda i: f"f->nis[{i}]"),
            coefficients=array(lambda i: f"f->coefficients[{i}]"),
            dt=array(lambda i: "f->step_dt"),
            status=array(lambda i: "f->status"),
            work=Local(self, "work", (work_size(program.kernels),)),
        )
        if program.recording is not None:
            for a in program.recording.arrays:
                setattr(f, a.name, Member(self, f"f->{a.name}", a.shape, a.kind))
            local, passing = functools.partial(Local, self), (lambda array: Member(self, "", array.shape))
            f.imu = recording.imu_of(f, local, passing)

    def name_of(self, function: FunctionType, known: Mapping[str, Any]) -> str:
        """Return the name of a function of the target."""
        return f"update_{known['sensor'].name}" if "sensor" in known else function.__name__

    def define(self, function: Any, sizes: Mapping[str, Any], known: Mapping[str, Any]) -> None:
        """Trace a function of the target: with parameters, what is known of the others, and the filter's state."""
        name = self.name_of(function, known)
        m = Target(self.program, name, sizes, self.functions)
        m.words = known["sensor"].words if "sensor" in known else " ".join((function.__doc__ or "").split())
        tree = parsed(function)
        if function.__module__.startswith(__package__) and any(isinstance(x, ast.Return) for x in ast.walk(tree)):
            m.returns = "status"
        own = {"f": m.state, "memory": m.state}
        if self.program.recording is not None:
            of_rests = function.__module__ == rests.__name__
            own["imu"] = m.state.imu
            own["constants"] = (m.state.imu.routines.watch if of_rests else m.state.imu.routines.head).arguments[0]
        arguments = [m.argument(x.arg) if x.arg in sizes else {**known, **own}[x.arg] for x in tree.args.args]
        m.kernel.trace_function(function, arguments)
        self.functions[name] = m

    def give(self, value: Any, status: str = "") -> None:
        """Return a number, nothing, or a status, which may be known by its bit."""
        if self.returns == "status" and not isinstance(value, Symbol):
            value, status = None, next(name for name, (bit, _) in self.program.statuses.items() if bit == value)
        super().give(value, status)

    def _far_turn(self, phi: Any) -> tuple[Any, Any]:
        if "far_turn" not in self.functions:
            self.define(body.far_turn, {"x": 0, "y": 0, "z": 0, "turn": -13}, {})
        values = self.trace.symbol("tuple", "far_turn", 13, *phi)
        items = tuple(self.trace.symbol("item", values, i) for i in range(13))
        return items[:4], items[4:]


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


def elementwise(operation: Callable[[Any, Any], Any]) -> Callable[[Eight, Any], Any]:
    """Return the method of an operation on eight numbers, with eight others or with one."""
    return lambda self, other: Eight(map(operation, self, other if isinstance(other, Eight) else [other] * 8))


class Eight(list[Any]):
    """Eight numbers, which a kernel treats as one value."""

    __add__ = __radd__ = elementwise(operator.add)
    __mul__ = __rmul__ = elementwise(operator.mul)


def traced(program: Program) -> list[Target]:
    """Return the functions of the filter, in an order in which each calls only those before it."""
    r = program.recording
    m = Target(program, "", {}, {})
    if r is None:
        m.define(body.init, {"attitude": 4}, {})
        angle, bias = (math.sqrt(program.covariance[i][i]) for i in (0, 3))
        start = f"Start at an attitude, sigma {angle:.6g} rad = {angle / DEGREE:.4g} deg about each axis"
        m.functions["init"].words = f"{start}, and at zero bias, sigma {bias:.6g} rad/s."
        m.define(body.predict, {"gyro": 3, "dt": 0}, {})
        for sensor in program.sensors:
            m.define(body.update, {"value": sensor.size}, {"sensor": sensor, "sigma": 0})
    else:
        m.define(recording.init, {}, {})
        sample = {"time": "wide", "gyro": 3, "accelerometer": 3} | ({"magnetometer": 3} if r.imu.magnetometer else {})
        m.define(recording.update, sample, {"magnetometer": None})
    functions = list(m.functions.values())
    if r is not None and not r.imu.magnetometer:
        functions[-1].words = functions[-1].words.partition(" magnetometer:")[0]
    return functions
