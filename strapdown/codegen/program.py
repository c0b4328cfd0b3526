"""The filter sample by sample, as it runs on the target: the formulas of :mod:`strapdown.kernels.filter` with checks, flags and a gate.

Every function here asks a *machine* ``m`` for what depends on it: branches, calls, flags. Executed on symbols
(:class:`strapdown.codegen.functions.Function`) it writes a function of the target; executed on floats it is the same filter in Python.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

from strapdown.kernels import filter as filter_kernels
from strapdown.kernels import machine
from strapdown.kernels.algebra import dot, scale
from strapdown.kernels.filter import ROWS_OF_KIND
from strapdown.kernels.measurement import ATTITUDE, DIRECTION, VECTOR, degrees_of_freedom
from strapdown.kernels.rotation import far_turn as far_turn_kernel
from strapdown.kernels.series import LARGEST_ANGLE, SQUARED_RANGE
from strapdown.kernels.structure import Measured, Model, Structure
from strapdown.kernels.walk import turn_squared

MAX_TURN = 100.0
"""Maximum rotation in one gyro sample, rad; it is divided into steps of a third of a radian."""
MAX_INTERVAL = 3600.0
"""Maximum interval of a gyro sample, s."""
MAX_VECTOR = 1e4
"""Maximum length of a measured whole vector over that of its reference."""
SHORTEST_SQUARED = 1e-24
"""Minimum squared length of a measured vector that has a direction."""
LONGEST_SQUARED = 1e24
UNIT = 2e-6
"""A direction whose squared length differs from 1 by less than this is used as it is, as in :class:`strapdown.estimation.LiveFilter`."""

NOT_STARTED = {"NOT_STARTED": ("16", "Waits for a sample with a specific force and, with a magnetometer, a field.")}
STATUS = {
    "OK": ("0", "The sample was used."),
    "BAD_INPUT": (
        "1",
        "Not a number, infinite, no length, dt not in (0, 3600] s, or a turn of over 100 rad: not used.",
    ),
    "REJECTED": ("2", "The gate refused the measurement: not used."),
    "NO_HEADING": ("4", "The vector was vertical and has no heading: not used."),
    "TOO_PRECISE": ("8", "So much more precise than the state that the covariance would keep no digits: not used."),
}
"""Statuses: their bits, and what they mean."""


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
    max_precision: float
    """Maximum ratio of an innovation's variance to the measurement's."""
    covariance: tuple[tuple[float, ...], ...]
    """Initial covariance of all states (n, n)."""
    state_names: tuple[str, ...] = ()
    """Names of the error states, with their units."""
    offsets: tuple[tuple[float, ...], ...] = ()
    """Effect of each error state on the gyro as an offset, for the whole bias."""
    recording: Any = None
    """Of the filter of an IMU: :class:`strapdown.codegen.recording.Recording`."""

    @property
    def statuses(self) -> dict[str, tuple[str, str]]:
        """Statuses: their bits, and what they mean."""
        return STATUS if self.recording is None else STATUS | NOT_STARTED

    @property
    def kernels(self) -> ModuleType:
        """Kernels of the structure, in the layout in which each element of P is a number."""
        return machine.instance(filter_kernels, STRUCTURE=self.structure, LANES=2)

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


def far_turn(m: Any, program: Program, f: SimpleNamespace, x: Any, y: Any, z: Any, turn: Any) -> None:
    """Quaternion and Jacobian of a rotation vector of any size, by doubling."""
    q, J = m.kernel.unrolled(far_turn_kernel, (x, y, z))
    for i, value in enumerate((*q, *J)):
        turn[i] = value


# ------------------------------------------------------------------------------------------------------------------------- prediction


def predict(m: Any, program: Program, f: SimpleNamespace, gyro: Any, dt: Any) -> None:
    """Propagate over a gyro sample: the mean rate over the last dt."""
    propagate(m, program, f, scale(dt, gyro), dt)


def propagate(m: Any, program: Program, f: SimpleNamespace, delta: Any, dt: Any) -> None:
    """Propagate over a rotation."""
    turn = turn_squared(delta, dt, tuple(f.x[4 + i] for i in range(3)))
    limit = program.model.limit
    within = turn <= SQUARED_RANGE
    usable = (dt > 0.0) & (dt <= MAX_INTERVAL) & (turn <= MAX_TURN * MAX_TURN)
    m.unless(usable, lambda: m.leave("BAD_INPUT"))
    if limit < MAX_INTERVAL:
        within = within & (dt <= limit)

    def divided() -> None:
        m.comment("a rotation beyond the range of the polynomials: equal steps at the same rate, which compose exactly")
        count = m.whole(m.root(turn) / LARGEST_ANGLE + (dt / limit if limit < MAX_INTERVAL else 0.0)) + 1.0
        part = 1.0 / count
        m.repeat(count, lambda: m.call("step", scale(part, delta), part * dt))

    m.branch(within, lambda: m.call("step", delta, dt), divided)
    m.leave("OK")


def step(m: Any, program: Program, f: SimpleNamespace, delta: Any, dt: Any) -> None:
    """Propagate over one step: delta is the rotation vector."""
    k = m.kernels
    if program.structure.chains:
        m.unless(m.equal(f.dt[0], dt), lambda: m.call("prepare", dt))
    m.comment("attitude, and covariance: Phi P Phi' + Q, exact at constant rate")
    k.advance(f.x, f.P, delta, dt, program.model, f.coefficients, 0.0)


def prepare(m: Any, program: Program, f: SimpleNamespace, dt: Any) -> None:
    """Coefficients of the states that decay, for steps of dt."""
    m.kernels.fill_coefficients(f.coefficients, dt, program.model)
    f.dt[0] = dt


# ----------------------------------------------------------------------------------------------------------------------------- update


def update(
    m: Any, program: Program, f: SimpleNamespace, sensor: Sensor, index: int, value: Any, sigma: Any = 0
) -> None:
    """Update with a measurement of a sensor."""
    k, s = m.kernels, sensor.shape
    z, frame = measured_values(m, sensor, value)
    measured = Measured(z, frame, sensor.noise or (sigma * sigma,), sensor.length, (0.0,) * 9)
    m.comment("innovations and gains")
    g = k.gains(s, f.x, f.P, None, measured, program.model.numbers, None, 0.0)
    m.unless(g.valid, lambda: m.leave("NO_HEADING"))
    degrees, nis = degrees_of_freedom(sensor.kind), g.nis
    sound: Any = True
    lost: Any = False
    for S, variance in zip(g.variances, g.noise, strict=True):
        sound = sound & (S > 0.0)
        lost = lost | (program.max_precision * variance < S)
    m.unless(sound, lambda: m.leave("BAD_INPUT"))
    f.nis[index] = nis
    if program.thresholds is not None:
        accepted = nis <= program.thresholds[degrees - 1]
        if sensor.kind == DIRECTION:
            accepted = accepted & (g.angle[1] >= 0.0)
        m.unless(accepted, lambda: m.leave("REJECTED"))
    m.unless(m.no(lost), lambda: m.leave("TOO_PRECISE"))

    work = m.work()

    def precisely() -> None:
        m.comment("much more precise than the state: Joseph's form, row after row")
        rows = m.scratch()
        k.store_rows(s, f.x, rows, measured, program.model.numbers, False, 0.0)
        k.clear_step(work, 0.0)
        for i in range(ROWS_OF_KIND[sensor.kind]):
            line = k.LINE * (k.ROWS + i)
            put_row(k, work, tuple(rows[line + j] for j in range(program.n)))
            m.call("take_row", rows[line + k.RESIDUAL], rows[line + k.VARIANCE], "work")
        m.call("apply_step", "work")
        m.leave("OK")

    m.branch(g.precise, precisely)
    m.comment("correction, covariance, and its transformation to the tangent space of the corrected attitude")
    for j in range(program.n):
        for i, gain in enumerate(g.gain):
            work[k.LINE * (k.GAINS + i) + j] = gain[j]
        work[k.LINE * k.STEP + j] = k.products(g.steps, tuple(gain[j] for gain in g.gain))
    for i in range(len(g.gain)):
        m.call("subtract", k.LINE * (k.GAINS + i), "work")
    m.call("apply_step", "work")
    m.leave("OK")


def measured_values(m: Any, sensor: Sensor, value: Any) -> tuple[Any, Any]:
    """Return a measurement and its frame as the kernels take them, after a check."""
    if sensor.kind == VECTOR:
        z = tuple(x / sensor.length for x in value) if sensor.length != 1.0 else value
        m.unless(dot(z, z) <= MAX_VECTOR * MAX_VECTOR, lambda: m.leave("BAD_INPUT"))
        return z, sensor.frame
    squared = sum((x * x for x in value[1:]), value[0] * value[0])
    m.unless((squared >= SHORTEST_SQUARED) & (squared <= LONGEST_SQUARED), lambda: m.leave("BAD_INPUT"))
    norm = m.root(squared)
    if sensor.kind == ATTITUDE:
        return sensor.variances, (*(x / norm for x in value), 0.0, 0.0, 0.0, 0.0, 0.0)
    off = squared - 1.0
    as_it_is = (off > -UNIT) & (off < UNIT)
    return tuple(m.select(as_it_is, x, x / norm) for x in value), sensor.frame


def put_row(k: Any, work: Any, row: Any) -> None:
    """Write a row h to the work space."""
    for j, h in enumerate(row):
        work[k.LINE * k.ROWS + j] = h


def take_row(m: Any, program: Program, f: SimpleNamespace, residual: Any, variance: Any, work: Any) -> None:
    """Update P and the correction with the row in the work space, in Joseph's form."""
    k = m.kernels
    k.take_row(f.P, work, k.ROWS, residual, variance, 0.0)


def subtract(m: Any, program: Program, f: SimpleNamespace, line: Any, work: Any) -> None:
    """Subtract the outer product of a line of the work space from P."""
    m.kernels.minus_outer_by_elements(f.P, work, line, line, 1.0, 0.0)


def apply_step(m: Any, program: Program, f: SimpleNamespace, work: Any) -> None:
    """Correct the state, and transform P to the tangent space of the corrected attitude."""
    m.kernels.apply_step(f.x, f.P, work, 0.0)


# ------------------------------------------------------------------------------------------------------------------------------ start


def init(m: Any, program: Program, f: SimpleNamespace, attitude: Any) -> None:
    """Start at an attitude, with the sigma of the setup and zero bias."""
    squared = sum((x * x for x in attitude[1:]), attitude[0] * attitude[0])
    usable = (squared >= SHORTEST_SQUARED) & (squared <= LONGEST_SQUARED)
    norm = m.root(squared)
    for i, x in enumerate(attitude):
        f.x[i] = m.select(usable, x / norm, 1.0 if i == 0 else 0.0)
    clear(m, program, f)
    m.unless(usable, lambda: m.leave("BAD_INPUT"))
    m.leave("OK")


def clear(m: Any, program: Program, f: SimpleNamespace) -> None:
    """Set all but the attitude to the start."""
    for i in range(4, program.n + 1):
        f.x[i] = 0.0
    for i in range(program.n):
        for j in range(i, program.n):
            f.P[place(program.n, i, j)] = program.covariance[i][j]
    for i in range(len(program.sensors)):
        f.nis[i] = 0.0
    if program.structure.chains:
        f.dt[0] = 0.0
    m.clear_status()
