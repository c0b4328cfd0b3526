"""The filter sample by sample, as it runs on the target: the formulas of :mod:`strapdown.kernels.filter` with checks, flags and a gate.

These are plain functions of a filter ``f``: arrays of its state, and what is known while it is exported. Executed on symbols by
:mod:`strapdown.codegen.interpreted` they become functions of the target; those that return a status set its flag too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from strapdown.kernels import live_imu, machine
from strapdown.kernels import model as model_kernels
from strapdown.kernels import update as update_kernels
from strapdown.kernels.algebra import dot, scale, square_root
from strapdown.kernels.measurement import ATTITUDE, DIRECTION, VECTOR, degrees_of_freedom
from strapdown.kernels.rotation import far_turn as far_turn_kernel
from strapdown.kernels.series import LARGEST_ANGLE, SQUARED_RANGE
from strapdown.kernels.structure import MAX_PRECISION, MAX_PRECISION_SINGLE, Measured, Model, Structure
from strapdown.kernels.walk import turn_squared

MAX_TURN = 100.0
"""Maximum rotation in one gyro sample, rad; it is divided into steps of a third of a radian."""
MAX_INTERVAL = live_imu.MAX_INTERVAL
"""Maximum interval of a gyro sample, s."""
MAX_VECTOR = 1e4
"""Maximum length of a measured whole vector over that of its reference."""
SHORTEST_SQUARED = 1e-24
"""Minimum squared length of a measured vector that has a direction."""
LONGEST_SQUARED = 1e24
UNIT = 2e-6
"""A direction whose squared length differs from 1 by less than this is used as it is, as in :class:`strapdown.estimation.LiveFilter`."""

OK, BAD_INPUT, REJECTED, NO_HEADING, TOO_PRECISE, NOT_STARTED = 0, 1, 2, 4, 8, 16
"""Statuses."""
MEANINGS = {
    "OK": (OK, "The sample was used."),
    "BAD_INPUT": (BAD_INPUT, "Not finite, no length, dt not in (0, 3600] s, or a turn of over 100 rad: not used."),
    "REJECTED": (REJECTED, "The gate rejected the measurement: not used. After many in a row, start again by init."),
    "NO_HEADING": (NO_HEADING, "The vector was vertical and has no heading: not used."),
    "TOO_PRECISE": (TOO_PRECISE, "So much more precise than the state that P would keep no digits: not used."),
    "NOT_STARTED": (NOT_STARTED, "Waits for a sample with a specific force and, with a magnetometer, a field."),
}
"""Their names, and what they mean."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """A sensor of the exported filter."""

    name: str
    kind: int
    shape: int
    """Index in the sensors of the structure."""
    frame: tuple[float, ...]
    """Right-handed frame about the reference by rows (9)."""
    length: float
    """Length of the reference of a whole vector, else 1."""
    noise: tuple[float, ...]
    """Variance, or covariance in body axes (6), over the squared length; empty: its root is an argument of the update."""
    variances: tuple[float, float, float]
    """Variances about the body axes of an attitude."""
    words: str
    """What it measures, for comments."""

    @property
    def size(self) -> int:
        """Number of values of a measurement."""
        return 4 if self.kind == ATTITUDE else 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """A filter to be exported."""

    structure: Structure
    model: Model
    sensors: tuple[Sensor, ...]
    thresholds: tuple[float, ...] | None
    """Maximum NIS for 1, 2, 3 degrees of freedom; None: no gate."""
    single: bool
    """Whether numbers are of single precision."""
    covariance: tuple[tuple[float, ...], ...]
    """Initial covariance of all states (n, n)."""
    state_names: tuple[str, ...] = ()
    """Names of the error states, with their units."""
    offsets: tuple[tuple[float, ...], ...] = ()
    """Effect of each error state on the gyro as an offset, for the whole bias."""
    recording: Any = None
    """Of the filter of an IMU: :class:`strapdown.codegen.recording.Recording`."""

    @property
    def statuses(self) -> dict[str, tuple[int, str]]:
        """Statuses of this filter: their bits, and what they mean."""
        return {
            name: meaning for name, meaning in MEANINGS.items() if name != "NOT_STARTED" or self.recording is not None
        }

    @property
    def max_precision(self) -> float:
        """Maximum ratio of an innovation's variance to the measurement's."""
        return MAX_PRECISION_SINGLE if self.single else MAX_PRECISION

    @property
    def kernels(self) -> ModuleType:
        """Kernels of an update for the structure, in the layout in which each element of P is a number."""
        return machine.instance(update_kernels, STRUCTURE=self.structure, LANES=2, SINGLE=self.single)

    @property
    def prediction(self) -> ModuleType:
        """Those of a prediction."""
        return machine.instance(model_kernels, STRUCTURE=self.structure, LANES=2)

    @property
    def n(self) -> int:
        """Number of states."""
        return self.structure.n

    @property
    def number_of_covariances(self) -> int:
        """Number of elements of the upper triangle of P."""
        return self.n * (self.n + 1) // 2


def work_size(k: Any) -> int:
    """Return the number of values in the work space of an update."""
    return int(k.LINE * (k.ROUNDING + 1))


class Table(list[Any]):
    """Rows that are read by two indices, as those of an array."""

    def __getitem__(self, place: Any) -> Any:
        return super().__getitem__(place[0])[place[1]] if isinstance(place, tuple) else super().__getitem__(place)


def place(n: int, i: int, j: int) -> int:
    """Return the place of P[i, j], i ≤ j, among the numbers of the upper triangle."""
    return i * n - i * (i - 1) // 2 + j - i


def far_turn(x: Any, y: Any, z: Any, turn: Any) -> None:
    """Quaternion and Jacobian of a rotation vector of any size, by doubling."""
    q, J = far_turn_kernel((x, y, z))
    for i, value in enumerate((*q, *J)):
        turn[i] = value


def comment(text: str) -> None:
    """Write a comment on the target."""


# ------------------------------------------------------------------------------------------------------------------------- prediction


def predict(f: Any, gyro: Any, dt: Any) -> Any:
    """Propagate over a gyro sample: the mean rate over the last dt."""
    return propagate(f, scale(dt, gyro), dt)


def propagate(f: Any, delta: Any, dt: Any) -> Any:
    """Propagate over a rotation."""
    turn = turn_squared(delta, dt, (f.x[4], f.x[5], f.x[6]))
    limit = f.program.model.limit
    if not (dt > 0.0 and dt <= MAX_INTERVAL and turn <= MAX_TURN * MAX_TURN):
        return BAD_INPUT
    if turn <= SQUARED_RANGE and (limit >= MAX_INTERVAL or dt <= limit):
        step(f, delta, dt)
    else:
        comment("a rotation beyond the range of the polynomials: equal steps at the same rate, which compose exactly")
        count = math.trunc(square_root(turn) / LARGEST_ANGLE + (dt / limit if limit < MAX_INTERVAL else 0.0)) + 1
        part = 1.0 / count
        for _ in range(count):
            step(f, scale(part, delta), part * dt)
    return OK


def step(f: Any, delta: Any, dt: Any) -> None:
    """Propagate over one step: delta is the rotation vector."""
    if len(f.program.structure.chains) > 0 and f.dt[0] != dt:
        prepare(f, dt)
    comment("attitude, and covariance: Phi P Phi' + Q, exact at constant rate")
    f.prediction.advance(f.x, f.P, delta, dt, f.program.model, f.coefficients, 0.0)


def prepare(f: Any, dt: Any) -> None:
    """Coefficients of the states that decay, for steps of dt."""
    f.prediction.fill_coefficients(f.coefficients, dt, f.program.model)
    f.dt[0] = dt


# ----------------------------------------------------------------------------------------------------------------------------- update


def update(f: Any, sensor: Sensor, value: Any, sigma: Any = 0) -> Any:
    """Update with a measurement of a sensor."""
    k, model = f.kernels, f.program.model
    z, frame = value, sensor.frame
    if sensor.kind == VECTOR:
        if sensor.length != 1.0:
            z = tuple(x / sensor.length for x in value)
        usable = dot(z, z) <= MAX_VECTOR * MAX_VECTOR
    else:
        squared = sum((x * x for x in value[1:]), value[0] * value[0])
        usable = squared >= SHORTEST_SQUARED and squared <= LONGEST_SQUARED
    if not usable:
        return BAD_INPUT
    if sensor.kind != VECTOR:
        norm, off = square_root(squared), squared - 1.0
        as_it_is = sensor.kind != ATTITUDE and off > -UNIT and off < UNIT
        z = tuple(x if as_it_is else x / norm for x in value)
    if sensor.kind == ATTITUDE:
        z, frame = sensor.variances, (*z, 0.0, 0.0, 0.0, 0.0, 0.0)
    noise = sensor.noise if len(sensor.noise) > 0 else (sigma * sigma,)
    measured = Measured(z, frame, noise, sensor.length, (0.0,) * 9)
    comment("innovations and gains")
    g = k.gains(sensor.shape, f.x, f.P, None, measured, model.numbers, None, 0.0)
    if not g.valid:
        return NO_HEADING
    sound, lost = True, False
    for S, variance in zip(g.variances, g.noise, strict=True):
        sound = sound and S > 0.0
        lost = lost or f.program.max_precision * variance < S
    if not sound:
        return BAD_INPUT
    f.nis[f.program.sensors.index(sensor)] = g.nis
    if f.program.recording is not None:
        last = f.force_innovation if sensor is f.program.sensors[0] else f.field_innovation
        for i in range(min(len(g.errors), 2)):
            last[0, i] = g.errors[i] / square_root(g.variances[i])
    if f.program.thresholds is not None:
        accepted = g.nis <= f.program.thresholds[degrees_of_freedom(sensor.kind) - 1]
        if sensor.kind == DIRECTION:
            accepted = accepted and g.angle[1] >= 0.0
        if not accepted:
            return REJECTED
    if lost:
        return TOO_PRECISE
    correct(f, sensor, measured, g)
    apply_step(f, f.work)
    return OK


def correct(f: Any, sensor: Sensor, measured: Measured, g: Any) -> None:
    """Update P, and write the correction to the work space."""
    k, n, work = f.kernels, f.program.n, f.work
    if g.precise:
        comment("much more precise than the state: Joseph's form, row after row")
        rows: dict[int, Any] = {}
        k.store_rows(sensor.shape, f.x, rows, measured, f.program.model.numbers, False, 0.0)
        k.clear_step(work, 0.0)
        for i in range(degrees_of_freedom(sensor.kind)):
            line = k.LINE * (k.ROWS + i)
            for j in range(n):
                work[k.LINE * k.ROWS + j] = rows[line + j]
            take_row(f, rows[line + k.RESIDUAL], rows[line + k.VARIANCE], work)
    else:
        comment("correction, covariance, and its transformation to the tangent space of the corrected attitude")
        for j in range(n):
            for i, gain in enumerate(g.gain):
                work[k.LINE * (k.GAINS + i) + j] = gain[j]
            work[k.LINE * k.STEP + j] = g.step[j]
        for i in range(len(g.gain)):
            subtract(f, k.LINE * (k.GAINS + i), work)


def take_row(f: Any, residual: Any, variance: Any, work: Any) -> None:
    """Update P and the correction with the row in the work space, in Joseph's form."""
    f.kernels.take_row(f.P, work, f.kernels.ROWS, residual, variance, 0.0)


def subtract(f: Any, line: Any, work: Any) -> None:
    """Subtract the outer product of a line of the work space from P."""
    f.kernels.minus_outer_by_elements(f.P, work, line, line, 1.0, 0.0)


def apply_step(f: Any, work: Any) -> None:
    """Correct the state, and transform P to the tangent space of the corrected attitude."""
    f.kernels.apply_step(f.x, f.P, work, 0.0)


# ------------------------------------------------------------------------------------------------------------------------------ start


def init(f: Any, attitude: Any) -> Any:
    """Start at an attitude, with the sigma of the setup and zero bias."""
    squared = sum((x * x for x in attitude[1:]), attitude[0] * attitude[0])
    usable = squared >= SHORTEST_SQUARED and squared <= LONGEST_SQUARED
    norm = square_root(squared)
    for i in range(4):
        f.x[i] = attitude[i] / norm if usable else (1.0 if i == 0 else 0.0)
    clear(f)
    if not usable:
        return BAD_INPUT
    return OK


def clear(f: Any) -> None:
    """Set all but the attitude to the start."""
    n = f.program.n
    for i in range(4, n + 1):
        f.x[i] = 0.0
    for i in range(n):
        for j in range(i, n):
            f.P[place(n, i, j)] = f.program.covariance[i][j]
    for i in range(len(f.program.sensors)):
        f.nis[i] = 0.0
    if len(f.program.structure.chains) > 0:
        f.dt[0] = 0.0
    f.status[0] = 0
