"""The filter of :class:`strapdown.ahrs.LiveAhrs` sample by sample, as it runs on the target, with checks and flags.

Its steps are the functions of :mod:`strapdown.kernels.live_imu`, executed on arrays of the target. As in :mod:`strapdown.codegen.program`,
every function here asks a machine ``m`` for what depends on it; ``m.kernel`` executes a kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from strapdown.ahrs import regions, starting
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.codegen import program as body
from strapdown.kernels import first_state, headings, live_imu, rests
from strapdown.kernels.algebra import dot
from strapdown.kernels.live_imu import Imu
from strapdown.kernels.rotation import unit

MIN_HORIZONTAL_SQUARED = 1e-6
"""Minimum squared sine of the angle between the first field and the vertical."""
LOCAL = ("found_direction", "found_sigma", "found_usual", "found_variance")
"""Arrays of :data:`strapdown.kernels.live_imu.PASSING` that a branch writes: those are local arrays of the target."""
FIELD = {
    "held": "last mean field and specific force",
    "vertical": "specific force, low-pass filtered once and twice",
    "mean": "mean field: as measured, without the iron that appears, without the iron subtracted",
    "deviation": "square deviation of each",
    "ordered": "values of magnitude and dip of each, in order of size",
    "median": "their medians",
    "ring": "field, attitude by the gyro and whether known of the last second",
    "sums": "normal equations of the iron",
    "iron": "iron",
    "total": "sum of the directions of a heading, and of their information",
    "strength": "first usual magnitude",
    "start": "time of the first sample, s; number of the last heading's interval",
    "ring_time": "times of the last second, s",
    "counted": "of the field's memory",
    "stride": "of the values in order",
}
"""Arrays of :class:`strapdown.kernels.headings.Memory`."""
REST = {
    "tenths": "sums of the rate over the parts of this second",
    "halves": "sums of specific force and field over its halves",
    "rest_rate": "last rate at rest, rad/s",
    "rest_variance": "its variance, and that of the bias by all rests",
    "rest_clock": "time of the first sample of this second, and of the last rest, s",
    "halves_number": "number of samples in the halves",
    "resting": "samples in this second; 1: a rest, 2: the next step begins with it",
}
"""Arrays of :class:`strapdown.kernels.rests.Memory`."""
TIMES = ("start", "ring_time", "rest_clock")


class Array(NamedTuple):
    """An array of the filter's state."""

    name: str
    shape: tuple[int, ...]
    words: str
    kind: str = ""
    """``"int"``, ``"wide"`` (double in single precision too), or ``""``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """The filter of an IMU in Python: of its arrays, only shapes and constants are used."""

    magnetometer: bool
    interval: float
    """Interval of the samples, s."""
    parameters: AhrsParameters
    imu: Imu
    field: headings.Memory
    rest: rests.Memory

    @property
    def lasting(self) -> dict[str, np.ndarray]:
        """Arrays of Python that last from one sample to the next, by name."""
        of_field = "field", "field_level", "field_sums"
        arrays = {
            name: getattr(self.imu.arrays, name)
            for name in live_imu.LASTING
            if self.magnetometer or name not in of_field
        }
        if self.magnetometer:
            arrays |= {name: getattr(self.field, name) for name in FIELD}
        if self.imu.rests:
            arrays |= {name: getattr(self.rest, name) for name in REST}
        return arrays

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Arrays of the state, after those of the filter: numbers, times, integers."""
        out = [
            Array("q", (4,), "attitude at the last sample"),
            Array("variance", (6,), "variances of attitude and bias there"),
        ]
        for name, array in self.lasting.items():
            _, kind, words = live_imu.LASTING.get(name) or ((), "", (FIELD | REST)[name])
            kind = "int" if array.dtype == np.int64 else "wide" if name in TIMES else kind
            out.append(Array(name, array.shape, words, kind))
        return tuple(sorted(out, key=lambda array: ("", "wide", "int").index(array.kind)))


class View:
    """Numbers that are read elsewhere, by row and column."""

    def __init__(self, read: Callable[[int, int], Any]) -> None:
        self.read = read

    def __getitem__(self, place: tuple[int, int]) -> Any:
        return self.read(*place)


def imu_of(m: Any) -> Imu:
    """Return the filter of an IMU with the arrays of a machine instead of those of Python."""
    program, f = m.program, m.state
    r, imu = program.recording, program.recording.imu
    *carried, _ = imu.routines.carry.arguments[3]
    passing = {name: array for name, array in imu.arrays._asdict().items() if name in live_imu.PASSING}
    own = {_key(array): getattr(f, name) for name, array in r.lasting.items()}
    own |= {_key(passing[name]): m.local(name, passing[name].shape) for name in LOCAL}
    for array in (*passing.values(), *carried, imu.time, imu.gyro, imu.accelerometer, imu.magnetic):
        own.setdefault(_key(array), m.passing(array))
    own[_key(imu.attitude)] = View(lambda _, i: f.x[i])
    own[_key(imu.bias)] = View(lambda _, i: f.x[4 + i])
    own[_key(imu.variance)] = View(lambda _, i: f.P[body.place(program.n, i, i)])
    own[_key(imu.covariance)] = [View(lambda i, j: f.P[body.place(program.n, min(i, j), max(i, j))])]
    own[_key(imu.routines.carry.arguments[3].covariance)] = ()

    def here(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return own.get(_key(value), value.tolist())
        if isinstance(value, tuple):
            parts = map(here, value)
            return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
        return value

    routines = (
        live_imu.Routine(kernel, here(routine.arguments))
        for kernel, routine in zip(live_imu.KERNELS, imu.routines, strict=True)
    )
    unused = dict.fromkeys(("filter", "state", "numbers", "places", "refused", "routines"))
    return here(imu._replace(**unused))._replace(routines=live_imu.Routines(*routines))  # type: ignore[no-any-return]


def _key(array: np.ndarray) -> tuple[Any, ...]:
    """Return what is the same for all views of an array with its shape."""
    return (array.ctypes.data, array.shape)


def helpers(m: Any) -> dict[str, Any]:
    """Return what the functions of :mod:`strapdown.kernels.live_imu` call on the target: by name."""
    program, f = m.program, m.state

    def update_filter(imu: Any, sensor: int, vector: Any, sigma: Any) -> Any:
        declared = program.sensors[sensor]
        status = m.call(
            f"update_{declared.name}", row(vector), sigma / declared.length, result="status" if sensor else None
        )
        return m.select(m.equal(status, 0), f.nis[sensor], 0.0) if sensor else 0.0

    called = "end_step", "carry_to_sample", "find_rest", "clear_span"
    return {
        "call": lambda kernel, arguments, like: m.kernel(kernel, *arguments),
        "predict_filter": lambda imu, turn: m.call("propagate", row(turn), f.clock[0] - f.clock[1]),
        "update_filter": update_filter,
        "show_filter": lambda imu: None,
        **{name: lambda *_, name=name: m.call(name) for name in called},
    }


def init(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Wait for the first sample."""
    r = program.recording
    for i in range(4):
        f.x[i] = f.q[i] = 1.0 if i == 0 else 0.0
    body.clear(m, program, f)
    for i in range(6):
        f.variance[i] = program.covariance[i][i]
    f.count[0] = f.count[1] = 0
    for array in (f.force_deviation, f.force_sums):
        for i in range(len(array)):
            array[i] = 0
    if r.magnetometer:
        for array in (f.counted, f.sums, f.iron, f.total, f.start):
            for i in range(len(array)):
                array[i] = 0
        level, weight = regions.FIRST_LEVEL
        f.field_level[0], f.field_sums[0], f.field_sums[1] = level, level * weight, weight
    if r.imu.rests:
        m.call("clear_span")
        f.resting[1] = 0
        f.rest_variance[1] = r.parameters.bias_sigma**2
    m.leave("OK")


def update(m: Any, program: Any, f: SimpleNamespace, time: Any, gyro: Any, force: Any, field: Any = None) -> None:
    """Take a sample.

    time: s, rising. gyro: rad/s, body axes. accelerometer: specific force, m/s^2, body axes; zero or null: missing. magnetometer: field,
    any unit, body axes; zero or null: missing.
    """
    r, imu = program.recording, m.imu
    usable = (time >= -1e15) & (time <= 1e15)
    for x in gyro:
        usable = usable & (abs(x) <= imu.largest_rate)
    vectors = (force, field) if r.magnetometer else (force,)
    for vector in vectors:
        square = dot(vector, vector)
        usable = usable & ((square >= body.SHORTEST_SQUARED) | m.equal(square, 0.0)) & (square <= body.LONGEST_SQUARED)
    m.unless(usable, lambda: m.leave("BAD_INPUT"))
    imu.time[0] = time
    for array, vector in zip((imu.gyro, imu.accelerometer, imu.magnetic), (gyro, *vectors), strict=False):
        for i in range(3):
            array[0, i] = vector[i]
    m.branch(m.equal(f.count[0], 0), lambda: begin(m, program, f, time, gyro, vectors))
    dt = time - f.clock[0]
    usable = (dt > 0.0) & (dt <= body.MAX_INTERVAL) & (f.count[1] + 1 < len(f.force))
    m.unless(usable, lambda: m.leave("BAD_INPUT"))
    m.kernel(live_imu.take_sample, imu)
    m.leave("OK")


def end_step(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Filter a step: its rotation, the mean of its samples, and a heading that ends with it."""
    if program.recording.imu.rests:
        m.branch(m.equal(f.resting[1], 2), lambda: m.call("use_rest"))
    if program.recording.magnetometer:
        for i in range(3):
            m.imu.arrays.found_direction[0, i] = 0.0
    m.kernel(live_imu.end_step, m.imu)


def carry_to_sample(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Propagate the estimate to the last sample."""
    m.kernel(live_imu.carry_to_sample, m.imu)
    carried = m.imu.routines.carry.arguments[3]
    for i in range(4):
        f.q[i] = carried.attitude[1, i]
    for i in range(6):
        f.variance[i] = carried.variance[1, i]


def row(array: Any) -> Any:
    """Return the first row of an array (1, 3)."""
    return tuple(array[0, i] for i in range(3))


# ------------------------------------------------------------------------------------------------------------------------------ start


def begin(m: Any, program: Any, f: SimpleNamespace, time: Any, gyro: Any, vectors: Any) -> None:
    """Start at a sample with a specific force and, with a magnetometer, a field: :func:`strapdown.ahrs.starting.start`."""
    r, force = program.recording, vectors[0]
    present: Any = True
    for vector in vectors:
        present = present & (dot(vector, vector) > 0.0)
    m.unless(present, lambda: m.leave("NOT_STARTED"))
    constants, sine = starting.start_constants(r.parameters), 0.0
    if r.magnetometer:
        sine = m.kernel(first_state.sine_of_dip, *vectors)
        m.unless(1.0 - sine * sine > MIN_HORIZONTAL_SQUARED, lambda: m.leave("NO_HEADING"))
    up, across = m.kernel(first_state.direction, force), vectors[-1]
    if not r.magnetometer:
        across = m.kernel(first_state.least_axis, force)
    q = m.kernel(first_state.first_attitude, force, across)
    tilt = m.kernel(first_state.tilt_variance, constants, force, gyro)
    heading = m.kernel(first_state.heading_variance, constants, sine, tilt) if r.magnetometer else 0.0
    iron = m.kernel(first_state.iron_variance, r.parameters.iron_sigma, sine) if r.magnetometer else 0.0
    for i in range(4):
        f.x[i] = q[i]
    for i in range(3):
        for j in range(i, 3):
            f.P[body.place(program.n, i, j)] = up[i] * up[j] * heading + (tilt if i == j else 0.0)
    f.iron_variance[0] = iron
    if r.imu.rests:
        f.rest_clock[1] = time
    m.kernel(live_imu.start, m.imu)
    m.leave("OK")


# -------------------------------------------------------------------------------------------------------------------------------- rest


def find_rest(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Decide at the end of a span whether it was a rest."""
    constants, *_, memory, _ = m.imu.routines.watch.arguments
    m.kernel(rests.find_rest, constants, f.clock[0], memory)


def clear_span(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Begin another span in which rest is looked for."""
    m.kernel(rests.clear_span, f)


def use_rest(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Correct the state by a rate at rest."""
    k, n = m.kernels, program.n
    work = m.work()
    k.clear_step(work, 0.0)
    for i in range(3):
        body.put_row(k, work, tuple(1.0 if j == 3 + i else 0.0 for j in range(n)))
        m.call("take_row", f.rest_rate[0, i] - f.x[4 + i], f.rest_variance[0], "work")
    change = [work[k.LINE * k.STEP + i] for i in range(n)]
    both = k.turned_by(tuple(f.x[i] for i in range(4)), tuple(change[:3]))
    q, J = m.kernel(unit, both[:4]), both[4:]
    for i in range(n + 1):
        f.x[i] = q[i] if i < 4 else f.x[i] + change[i - 1]
    P = {(i, j): f.P[body.place(n, i, j)] for i in range(3) for j in range(i, n)}
    half = [
        [sum((J[3 * i + c] * P[min(c, j), max(c, j)] for c in range(1, 3)), J[3 * i] * P[0, j]) for j in range(n)]
        for i in range(3)
    ]
    for i in range(3):
        for j in range(i, n):
            turned = (
                sum((half[i][c] * J[3 * j + c] for c in range(1, 3)), half[i][0] * J[3 * j]) if j < 3 else half[i][j]
            )
            f.P[body.place(n, i, j)] = turned
    f.resting[1] = 0
