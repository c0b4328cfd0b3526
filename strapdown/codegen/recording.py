"""The filter of :class:`strapdown.ahrs.LiveAhrs` sample by sample, as it runs on the target, with checks and flags.

Its steps are the functions of :mod:`strapdown.kernels.live_imu`, executed on arrays of the target; those in ``REPLACED`` are defined here.
As in :mod:`strapdown.codegen.program`, all are plain functions.
"""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from strapdown.ahrs import regions, starting
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.codegen import program as body
from strapdown.kernels import alignment, headings, live_imu, rests
from strapdown.kernels.algebra import dot
from strapdown.kernels.live_imu import Imu
from strapdown.kernels.rotation import unit

MIN_HORIZONTAL_SQUARED = 1e-6
"""Minimum squared sine of the angle between the first field and the vertical."""
LOCAL = ("heading_direction", "heading_sigma", "usual_field", "heading_iron_variance")
"""Arrays of :data:`strapdown.kernels.live_imu.PASSING` that a branch writes: those are local arrays of the target."""
OF_FIELD = (
    *("field", "field_innovation", "field_density", "field_averages", "mean_square"),
    *("field_before", "field_clock", "turned_slowly"),
)
"""Arrays that only a filter with a magnetometer has."""
TIMES = ("start", "ring_time", "rest_clock", "field_clock")


@functools.cache
def words_of(memory: type) -> dict[str, str]:
    """Return what each array of a memory is: the string after it in its class."""
    (tree,) = ast.parse(inspect.getsource(memory)).body
    assert isinstance(tree, ast.ClassDef)
    words = {
        ast.unparse(line.target): ast.literal_eval(text.value).rstrip(".")
        for line, text in itertools.pairwise(tree.body)
        if isinstance(line, ast.AnnAssign) and isinstance(text, ast.Expr)
    }
    return {name: text[0].lower() + text[1:] for name, text in words.items()}


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

    parameters: AhrsParameters
    imu: Imu
    field: headings.Memory
    rest: rests.Memory

    @property
    def lasting(self) -> dict[str, np.ndarray]:
        """Arrays of Python that last from one sample to the next, by name."""
        arrays = {name: getattr(self.imu.arrays, name) for name in live_imu.LASTING}
        arrays |= self.field._asdict() if self.imu.magnetometer else {}
        arrays |= self.rest._asdict() if self.imu.rests else {}
        return {name: array for name, array in arrays.items() if self.imu.magnetometer or name not in OF_FIELD}

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Arrays of the state, after those of the filter: numbers, times, integers."""
        out = [
            Array("q", (4,), "attitude at the last sample"),
            Array("variance", (6,), "variances of attitude and bias there"),
        ]
        memory = words_of(headings.Memory) | words_of(rests.Memory)
        for name, array in self.lasting.items():
            _, kind, words = live_imu.LASTING.get(name) or ((), "", memory[name])
            kind = "int" if array.dtype == np.int64 else "wide" if name in TIMES else kind
            out.append(Array(name, array.shape, words, kind))
        return tuple(sorted(out, key=lambda array: ("", "wide", "int").index(array.kind)))


class View:
    """Numbers that are read elsewhere, by row and column."""

    def __init__(self, read: Callable[[int, int], Any]) -> None:
        self.read = read

    def __getitem__(self, place: tuple[int, int]) -> Any:
        return self.read(*place)


def imu_of(f: Any, local: Callable[..., Any], passing: Callable[..., Any]) -> Imu:
    """Return the filter of an IMU with the arrays of the filter ``f`` on the target instead of those of Python.

    ``local`` returns an array by name and shape that lasts for a step; ``passing`` one like one of Python that lasts for a function.
    """
    n, r, imu = f.program.n, f.program.recording, f.program.recording.imu
    carried = imu.routines.carry.arguments[-1]
    arrays = imu.arrays._asdict()
    own = {_key(array): getattr(f, name) for name, array in r.lasting.items()}
    own |= {_key(arrays[name]): local(name, arrays[name].shape) for name in LOCAL}
    own[_key(imu.attitude)] = View(lambda _, i: f.x[i])
    own[_key(imu.bias)] = View(lambda _, i: f.x[4 + i])
    own[_key(imu.variance)] = View(lambda _, i: f.P[body.place(n, i, i)])
    own[_key(imu.covariance)] = [View(lambda i, j: f.P[body.place(n, min(i, j), max(i, j))])]
    own[_key(carried.covariance)] = ()
    if not imu.rests:  # no rest, so no bias of one
        own[_key(r.rest.rest_bias)] = View(lambda _, i: 0.0)
    written = (arrays[name] for name in live_imu.PASSING)
    for array in (*written, *carried, imu.time, imu.gyro, imu.accelerometer, imu.magnetic):
        if _key(array) not in own:
            own[_key(array)] = passing(array)

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
    return here(imu._replace(**unused))._replace(filter=f, routines=live_imu.Routines(*routines))  # type: ignore[no-any-return]


def _key(array: np.ndarray) -> tuple[Any, ...]:
    """Return what is the same for all views of an array with its shape."""
    return (array.ctypes.data, array.shape)


# ------------------------------------------------------------------------------------------------------------------ start and samples


def init(f: Any) -> Any:
    """Wait for the first sample."""
    r = f.program.recording
    for i in range(4):
        f.x[i] = f.q[i] = 1.0 if i == 0 else 0.0
    body.clear(f)
    for i in range(6):
        f.variance[i] = f.program.covariance[i][i]
    f.count[0] = f.count[1] = 0
    for i, value in enumerate(starting.alignment_memory(unknown=False).tolist()):
        f.alignment[i] = value
    f.aligned_variance[0] = f.over_gap[0] = f.turned_by_gap[0] = 0.0
    for i, value in enumerate(r.imu.arrays.known_before.tolist()):
        f.known_before[i] = value
    f.rate_change[0] = live_imu.FIRST_RATE_CHANGE
    judged = [(f.force_density, f.force_averages, r.imu.arrays.force_averages)]
    if r.imu.magnetometer:
        judged.append((f.field_density, f.field_averages, r.imu.arrays.field_averages))
    for density, averages, at_start in judged:
        density[0] = regions.FIRST_DENSITY[0]
        for i, value in enumerate(at_start.tolist()):
            averages[i] = value
    if r.imu.magnetometer:
        for array in (f.counted, f.sums, f.iron, f.total, f.start):
            for i in range(len(array)):
                array[i] = 0
        for i in range(4):
            f.drift[i] = 1.0 if i == 0 else 0.0
    if r.imu.rests:
        rests.clear_span(f)
        f.resting[1] = f.steady_spans[0] = 0
        f.bias_variance[0], f.plausible_variance[0] = r.parameters.bias_sigma**2, starting.FIRST_BIAS_SIGMA**2
        for i in range(3):
            f.rest_bias[0, i] = 0.0
            if r.imu.magnetometer:
                f.field_before[0, i] = 0.0
    return body.OK


def update(f: Any, time: Any, gyro: Any, accelerometer: Any, magnetometer: Any = None) -> Any:
    """Take a sample.

    time: s, rising. gyro: rad/s, body axes. accelerometer: specific force, m/s^2, body axes; zero or null: missing. magnetometer: field,
    any unit, body axes; zero or null: missing.
    """
    imu = f.imu
    vectors = (accelerometer, magnetometer) if imu.magnetometer else (accelerometer,)
    usable = time >= -1e15 and time <= 1e15
    for x in gyro:
        usable = usable and abs(x) <= imu.largest_rate
    usable = usable and dot(accelerometer, accelerometer) <= imu.largest_force * imu.largest_force
    for vector in vectors:
        square = dot(vector, vector)
        usable = usable and (square >= body.SHORTEST_SQUARED or square == 0.0) and square <= body.LONGEST_SQUARED
    if not usable:
        return body.BAD_INPUT
    if f.count[0] == 0:
        return begin(f, time, gyro, accelerometer, magnetometer)
    dt = time - f.clock[0]
    if not (dt > 0.0 and dt <= body.MAX_INTERVAL and f.count[1] + 1 < len(f.force)):
        return body.BAD_INPUT
    put_sample(imu, time, gyro, accelerometer, magnetometer)
    live_imu.take_sample(imu)
    return body.OK


def put_sample(imu: Any, time: Any, gyro: Any, accelerometer: Any, magnetometer: Any) -> None:
    """Write a sample where the functions of the IMU read it."""
    imu.time[0] = time
    for i in range(3):
        imu.gyro[0, i] = gyro[i]
        imu.accelerometer[0, i] = accelerometer[i]
        if imu.magnetometer:
            imu.magnetic[0, i] = magnetometer[i]


def begin(f: Any, time: Any, gyro: Any, accelerometer: Any, magnetometer: Any) -> Any:
    """Start at a sample with a specific force and, with a magnetometer, a field: as strapdown.ahrs.starting.start."""
    imu, parameters = f.imu, f.program.recording.parameters
    if not dot(accelerometer, accelerometer) > 0.0:
        return body.NOT_STARTED
    sine, heading, iron, across = 0.0, 0.0, 0.0, magnetometer
    constants = starting.start_constants(parameters)
    tilt = alignment.tilt_variance(constants, accelerometer, gyro)
    if imu.magnetometer:
        if not dot(magnetometer, magnetometer) > 0.0:
            return body.NOT_STARTED
        sine = alignment.sine_of_dip(accelerometer, magnetometer)
        if not 1.0 - sine * sine > MIN_HORIZONTAL_SQUARED:
            return body.NO_HEADING
        heading = alignment.heading_variance(constants, sine, tilt)
        iron = alignment.iron_variance(parameters.first_iron_sigma, sine)
    else:
        across = alignment.least_axis(accelerometer)
    put_attitude(f, alignment.first_attitude(accelerometer, across), heading, accelerometer, tilt)
    f.iron_variance[0] = iron
    if imu.rests:
        f.rest_clock[1] = time
    put_sample(imu, time, gyro, accelerometer, magnetometer)
    live_imu.start(imu)
    return body.OK


def put_attitude(f: Any, q: Any, heading: Any, force: Any, tilt: Any) -> None:
    """Write an attitude, and its covariance as strapdown.ahrs.starting.attitude_covariance."""
    up = alignment.direction(force)
    for i in range(4):
        f.x[i] = q[i]
    for i in range(3):
        for j in range(i, 3):
            f.P[body.place(f.program.n, i, j)] = up[i] * up[j] * heading + (tilt if i == j else 0.0)


def use_alignment(f: Any) -> None:
    """Replace the attitude by that of a coarse alignment: as strapdown.ahrs.starting.align."""
    n, tilt, q = f.program.n, f.aligned_variance[0], tuple(f.x[i] for i in range(4))
    force, field = (tuple(a[0, i] for i in range(3)) for a in (f.aligned_force, f.aligned_field))
    unknown = f.alignment[alignment.UNKNOWN]
    if unknown > 0.0 or alignment.departs(q, force, tilt):
        covariance = tuple(f.P[body.place(n, i, j)] for i in range(3) for j in range(i, 3))
        constants = starting.start_constants(f.program.recording.parameters)
        mean, heading = alignment.aligned(constants, force, field, tilt, unknown, q, covariance)
        put_attitude(f, mean, heading, force, tilt)
        for i in range(3):
            for j in range(3, n):
                f.P[body.place(n, i, j)] = 0.0
    f.aligned_variance[0] = 0.0


# ------------------------------------------------------------------------------------- in place of functions of the filter in Python


def predict_filter(imu: Any, turn: Any) -> None:
    """Propagate the filter over the rotation of a step."""
    f = imu.filter
    body.propagate(f, (turn[0, 0], turn[0, 1], turn[0, 2]), f.clock[0] - f.clock[1])


def update_filter(imu: Any, index: int, vector: Any, sigma: Any, normalized: Any) -> None:
    """Update the filter with a vector of a sensor; write the innovations over their σ (1, m), 0 if they were not used."""
    f = imu.filter
    sensor = f.program.sensors[index]
    for i in range(2 - index):
        normalized[0, i] = 0.0
    body.update(f, sensor, (vector[0, 0], vector[0, 1], vector[0, 2]), sigma / sensor.length)


def show_filter(imu: Any) -> None:
    """Leave the state where it is read."""


def end_step(imu: Any) -> None:
    """Filter a step: its rotation, the mean of its samples, and a heading that ends with it."""
    if imu.rests > 0 and imu.resting[1] == 2:
        use_rest(imu.filter)
    if imu.arrays.aligned_variance[0] > 0.0:
        use_alignment(imu.filter)
    if imu.magnetometer > 0:
        for i in range(3):
            imu.arrays.heading_direction[0, i] = 0.0
    live_imu.end_step(imu)


def carry_to_sample(imu: Any) -> None:
    """Propagate the estimate to the last sample."""
    live_imu.carry_to_sample(imu)
    f, carried = imu.filter, imu.routines.carry.arguments[-1]
    for i in range(4):
        f.q[i] = carried.attitude[1, i]
    for i in range(6):
        f.variance[i] = carried.variance[1, i]


def forget_attitude(imu: Any) -> None:
    """Begin a coarse alignment after a rotation of which hardly anything is known."""
    f = imu.filter
    for i, value in enumerate(starting.alignment_memory(unknown=True).tolist()):
        f.alignment[i] = value
    f.aligned_variance[0] = 0.0


def add_turn_variance(imu: Any) -> None:
    """Add the variance of the rotation over gaps to that of the attitude."""
    f = imu.filter
    for i in range(3):
        f.P[body.place(f.program.n, i, i)] += f.over_gap[0]


_REPLACING = predict_filter, update_filter, show_filter, forget_attitude, add_turn_variance, end_step, carry_to_sample
REPLACED: dict[str, Any] = {function.__name__: function for function in _REPLACING}


def use_rest(f: Any) -> None:
    """Correct the state by a rate at rest."""
    k, n, work = f.kernels, f.program.n, f.work
    k.clear_step(work, 0.0)
    for i in range(3, 6):
        f.P[body.place(n, i, i)] += f.rest_gained[0]
    for i in range(3):
        for j in range(n):
            work[k.LINE * k.ROWS + j] = 1.0 if j == 3 + i else 0.0
        body.take_row(f, f.rest_rate[0, i] - f.x[4 + i], f.rest_variance[0], work)
    change = tuple(work[k.LINE * k.STEP + i] for i in range(n))
    both = k.turned_by(tuple(f.x[i] for i in range(4)), change[:3])
    q, J = unit(both[:4]), both[4:]
    for i in range(n + 1):
        f.x[i] = q[i] if i < 4 else f.x[i] + change[i - 1]
    P = {(i, j): f.P[body.place(n, i, j)] for i in range(3) for j in range(i, n)}
    half = [
        [sum((J[3 * i + c] * P[min(c, j), max(c, j)] for c in range(1, 3)), J[3 * i] * P[0, j]) for j in range(n)]
        for i in range(3)
    ]
    for i in range(3):
        for j in range(i, n):
            turned = half[i][j]
            if j < 3:
                turned = sum((half[i][c] * J[3 * j + c] for c in range(1, 3)), half[i][0] * J[3 * j])
            f.P[body.place(n, i, j)] = turned
    f.resting[1] = 0
