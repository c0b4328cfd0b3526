"""The filter of :class:`strapdown.ahrs.LiveAhrs` sample by sample, as it runs on the target: its kernels around the filter's steps.

As in :mod:`strapdown.codegen.program`, every function here asks a machine ``m`` for what depends on it; ``m.kernel`` executes a kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

from strapdown.ahrs import regions, starting
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.codegen import program as body
from strapdown.codegen.program import Table
from strapdown.kernels import headings, recording_steps
from strapdown.kernels.algebra import cross, dot, scale, square_root
from strapdown.kernels.live_imu import Imu
from strapdown.kernels.rotation import unit
from strapdown.units import STANDARD_GRAVITY

MIN_HORIZONTAL_SQUARED = 1e-6
"""Minimum squared sine of the angle between the first field and the vertical."""


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

    @property
    def rest(self) -> tuple[int, int] | None:
        """Number of parts of a span in which rest is looked for, and of samples of a part; None: the bias at rest is not measured."""
        return starting.rest_length(self.interval) if self.parameters.rest_bias_sigma else None

    @property
    def constants(self) -> headings.Constants:
        """Constants of the headings."""
        return self.imu.head.arguments[0]  # type: ignore[no-any-return]

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Arrays of the state, after those of the filter."""
        most, memory = len(self.imu.force), self.imu.head.arguments[2]
        field = (
            Array("field", (most, 3), "field at the samples of this step"),
            Array("held", (2, 3), "last mean field and specific force"),
            Array("vertical", (2, 3), "specific force, low-pass filtered once and twice"),
            Array(
                "mean", (3, 3), "mean field: as measured, without the iron that appears, without the iron subtracted"
            ),
            Array("deviation", (3,), "square deviation of each"),
            Array("ordered", memory.ordered.shape, "values of magnitude and dip of each, in order of size"),
            Array("median", (6,), "their medians"),
            Array("ring", memory.ring.shape, "field, attitude by the gyro and whether known of the last second"),
            Array("sums", (9,), "normal equations of the iron"),
            Array("iron", (3,), "iron"),
            Array("total", (4,), "sum of the directions of a heading, and of their information"),
            Array("strength", (1,), "first usual magnitude"),
            Array("field_level", (1,), "mean nis of the magnetometer"),
            Array("field_sums", (2,), "its sums"),
            Array("start", (2,), "time of the first sample, s; number of the last heading's interval", "wide"),
            Array("ring_time", memory.ring_time.shape, "times of the last second, s", "wide"),
            Array("counted", memory.counted.shape, "of the field's memory", "int"),
            Array("stride", (6, 2), "of the values in order", "int"),
        )
        rest: tuple[Array, ...] = ()
        if self.rest is not None:
            rest = (
                Array("tenths", (self.rest[0], 3), "sums of the rate over the parts of this second"),
                Array("halves", (4, 3), "sums of specific force and field over its halves"),
                Array("rest_rate", (3,), "last rate at rest, rad/s"),
                Array("rest_variance", (2,), "its variance, and that of the bias by all rests"),
                Array("rest_clock", (2,), "time of the first sample of this second, and of the last rest, s", "wide"),
                Array("halves_number", (4,), "number of samples in the halves", "int"),
                Array("resting", (2,), "samples in this second; 1: a rest, 2: the next step begins with it", "int"),
            )
        return (
            Array("q", (4,), "attitude at the last sample"),
            Array("variance", (6,), "variances of attitude and bias there"),
            Array("rate", (3,), "last rate, rad/s"),
            Array("turned", (4,), "attitude by the gyro alone, since the start"),
            Array("force", (most, 3), "specific force at the samples of this step"),
            Array("frame", (most, 4), "attitude by the gyro at its start and at its samples"),
            Array("scales", (4,), "of the reported sigma: tilt, added variance, heading, added variance"),
            *(field if self.magnetometer else ()),
            *rest,
            Array("clock", (3,), "time of the last sample, of the start of the step, of the first sample, s", "wide"),
            Array("samples", (2,), "whether the filter has started; samples in the step", "int"),
        )


def init(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Wait for the first sample."""
    r = program.recording
    for i in range(4):
        f.x[i] = f.q[i] = 1.0 if i == 0 else 0.0
    body.clear(m, program, f)
    for i in range(6):
        f.variance[i] = program.covariance[i][i]
    f.samples[0] = f.samples[1] = 0
    if r.magnetometer:
        for name in ("counted", "sums", "iron", "total", "start"):
            array = getattr(f, name)
            for i in range(len(array)):
                array[i] = 0
    if r.rest is not None:
        clear_span(m, r, f)
        f.resting[1] = 0
        f.rest_variance[1] = r.parameters.bias_sigma**2
    m.leave("OK")


def update(m: Any, program: Any, f: SimpleNamespace, time: Any, gyro: Any, force: Any, field: Any = None) -> None:
    """Take a sample.

    time: s, rising. gyro: rad/s, body axes. accelerometer: specific force, m/s^2, body axes; zero or null: missing. magnetometer: field,
    any unit, body axes; zero or null: missing.
    """
    r = program.recording
    usable = (time >= -1e15) & (time <= 1e15)
    for x in gyro:
        usable = usable & (abs(x) <= r.imu.largest_rate)
    vectors = (force, field) if r.magnetometer else (force,)
    for vector in vectors:
        square = dot(vector, vector)
        usable = usable & ((square >= body.SHORTEST_SQUARED) | m.equal(square, 0.0)) & (square <= body.LONGEST_SQUARED)
    m.unless(usable, lambda: m.leave("BAD_INPUT"))
    m.branch(m.equal(f.samples[0], 0), lambda: begin(m, program, f, time, gyro, vectors))
    before, first = f.clock[0], f.clock[2]
    dt, n = time - before, f.samples[1] + 1
    m.unless((dt > 0.0) & (dt <= body.MAX_INTERVAL) & (n < len(r.imu.force)), lambda: m.leave("BAD_INPUT"))
    m.comment("attitude by the gyro alone")
    times, rates, attitude = (0.0, dt), Table([tuple(f.rate[i] for i in range(3)), gyro]), m.scratch()
    for i in range(4):
        attitude[0, i] = f.turned[i]
    m.kernel(recording_steps.follow_gyro, times, rates, attitude)
    turned = tuple(attitude[1, i] for i in range(4))
    f.clock[0] = time
    f.samples[1] = n
    for i in range(3):
        f.rate[i] = gyro[i]
        f.force[n, i] = force[i]
        if r.magnetometer:
            f.field[n, i] = field[i]
    for i in range(4):
        f.turned[i] = f.frame[n, i] = turned[i]
    m.comment("a step of the filter ends with the last sample before a multiple of its interval")
    old, new = (m.lowest((t + r.interval - first) / r.imu.step + 1e-6) for t in (before, time))
    m.unless(m.equal(old, new), lambda: m.call("end_step"))
    m.call("carry")
    if r.rest is not None:
        keep_for_rest(m, r, f, time, gyro, vectors)
        ended = m.no(m.equal(old, new)) & m.equal(f.resting[1], 1)
        m.branch(ended, lambda: put(f.resting, 1, 2))
    m.leave("OK")


# ------------------------------------------------------------------------------------------------------------------------------ start


def begin(m: Any, program: Any, f: SimpleNamespace, time: Any, gyro: Any, vectors: Any) -> None:
    """Start at a sample with a specific force and, with a magnetometer, a field: :func:`strapdown.ahrs.starting.start`."""
    r, force = program.recording, vectors[0]
    present: Any = True
    for vector in vectors:
        present = present & (dot(vector, vector) > 0.0)
    m.unless(present, lambda: m.leave("NOT_STARTED"))
    size = m.root(dot(force, force))
    up = scale(1.0 / size, force)
    north = m.kernel(least_axis, force)
    level = 1.0
    if r.magnetometer:
        north = scale(1.0 / m.root(dot(vectors[1], vectors[1])), vectors[1])
        sine = dot(up, north)
        level = 1.0 - sine * sine
        m.unless(level > MIN_HORIZONTAL_SQUARED, lambda: m.leave("NO_HEADING"))
    q = m.kernel(first_attitude, up, north)
    moved, swing = size / STANDARD_GRAVITY - 1.0, starting.SWING_TIME * m.root(dot(gyro, gyro))
    tilt = m.root(r.parameters.attitude_sigma**2 + moved * moved + swing * swing)
    tilt = m.select(tilt < starting.MAX_TILT_SIGMA, tilt, starting.MAX_TILT_SIGMA)
    heading = 0.0
    if r.magnetometer:
        steep = m.select(level > starting.MIN_LEVEL, level, starting.MIN_LEVEL)
        heading = (sine * sine * (tilt * tilt) + starting.FIRST_HEADING**2) / steep
    for i in range(4):
        f.x[i] = q[i]
        f.turned[i] = f.frame[0, i] = 1.0 if i == 0 else 0.0
    for i in range(3):
        f.rate[i] = gyro[i]
        f.clock[i] = time
        for j in range(i, 3):
            own = tilt * tilt if i == j else 0.0
            f.P[body.place(program.n, i, j)] = up[i] * up[j] * heading + own
    iron = 0.0
    if r.magnetometer:
        f.start[0] = time
        first_level, weight = regions.FIRST_LEVEL
        f.field_level[0], f.field_sums[0], f.field_sums[1] = first_level, first_level * weight, weight
        iron = r.parameters.iron_sigma**2 / m.select(level > 1e-12, level, 1e-12)
    f.scales[3] = iron
    f.samples[0], f.samples[1] = 1, 0
    begin_step(m, program, f)
    m.call("carry")
    if r.rest is not None:
        f.rest_clock[1] = time
        keep_for_rest(m, r, f, time, gyro, vectors)
    m.leave("OK")


def least_axis(v: Any) -> Any:
    """Return the axis to which a vector has the smallest component."""
    x, y, z = abs(v[0]), abs(v[1]), abs(v[2])
    if x <= y and x <= z:
        return (1.0, 0.0, 0.0)
    if y <= z:
        return (0.0, 1.0, 0.0)
    return (0.0, 0.0, 1.0)


def first_attitude(up: Any, north: Any) -> Any:
    """Return the attitude in East, North, up axes by TRIAD, from unit vectors in body axes."""
    east = cross(north, up)
    e = scale(1.0 / square_root(dot(east, east)), east)
    n, u = cross(up, e), up
    a, b = 1.0 + (e[0] + n[1] + u[2]), 1.0 + (e[0] - n[1] - u[2])
    c, d = 1.0 + (n[1] - e[0] - u[2]), 1.0 + (u[2] - e[0] - n[1])
    if a >= b and a >= c and a >= d:
        q = (a, u[1] - n[2], e[2] - u[0], n[0] - e[1])
    elif b >= c and b >= d:
        q = (u[1] - n[2], b, n[0] + e[1], e[2] + u[0])
    elif c >= d:
        q = (e[2] - u[0], n[0] + e[1], c, u[1] + n[2])
    else:
        q = (n[0] - e[1], e[2] + u[0], u[1] + n[2], d)
    q = unit(q)
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    return q


# -------------------------------------------------------------------------------------------------------------------------------- rest


def put(array: Any, i: int, value: Any) -> None:
    """Write an element."""
    array[i] = value


def clear_span(m: Any, r: Recording, f: SimpleNamespace) -> None:
    """Begin another second in which rest is looked for."""
    assert r.rest is not None
    f.resting[0] = 0
    for i in range(4):
        f.halves_number[i] = 0
    for array in (f.tenths, f.halves):
        for i in range(len(array)):
            for j in range(3):
                array[i, j] = 0.0


def keep_for_rest(m: Any, r: Recording, f: SimpleNamespace, time: Any, gyro: Any, vectors: Any) -> None:
    """Add a sample to the sums of this second, and look for rest at its end."""
    assert r.rest is not None
    k = f.resting[0]
    m.branch(m.equal(k, 0), lambda: put(f.rest_clock, 0, time))
    k, (parts, part) = f.resting[0], r.rest
    tenth, half = k // part, k // ((parts * part + 1) // 2)
    for i in range(3):
        f.tenths[tenth, i] = f.tenths[tenth, i] + gyro[i]
    for v, vector in enumerate(vectors):
        number = m.select(dot(vector, vector) > 0.0, 1, 0)
        f.halves_number[2 * v + half] = f.halves_number[2 * v + half] + number
        for i in range(3):
            f.halves[2 * v + half, i] = f.halves[2 * v + half, i] + vector[i]
    f.resting[0] = k + 1

    def last() -> None:
        m.call("find_rest")
        clear_span(m, r, f)

    m.branch(m.equal(k + 1, parts * part), last)


def find_rest(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Measure the bias at rest."""
    r = program.recording
    parts, part = r.rest
    tenths = [tuple(f.tenths[p, i] / part for i in range(3)) for p in range(parts)]
    rate = tuple(sum((tenth[i] for tenth in tenths[1:]), tenths[0][i]) / parts for i in range(3))
    spread = 0.0
    for tenth in tenths:
        spread = spread + sum((tenth[i] - rate[i]) * (tenth[i] - rate[i]) for i in range(3))
    variance = r.parameters.rest_bias_sigma**2 + spread / parts
    agree, square = 0.0, 0.0
    for v in range(2 if r.magnetometer else 1):
        counts = f.halves_number[2 * v], f.halves_number[2 * v + 1]
        sums = [tuple(f.halves[2 * v + half, i] for i in range(3)) for half in range(2)]
        total = tuple(x + y for x, y in zip(*sums, strict=True))
        size = m.root(dot(total, total)) / (counts[0] + counts[1])
        some = (counts[0] > 0) & (counts[1] > 0) & (size > 0.0)
        first, second = (
            tuple(x / (m.select(some, size, 1.0) * m.select(some, count, 1.0)) for x in half)
            for half, count in zip(sums, counts, strict=True)
        )
        expected = cross(rate, tuple(-0.25 * starting.QUIET_SPAN * (x + y) for x, y in zip(first, second, strict=True)))
        change = tuple(y - x for x, y in zip(first, second, strict=True))
        agree = agree + m.select(some, dot(change, expected), 0.0)
        square = square + m.select(some, dot(expected, expected), 0.0)
    turning = dot(rate, rate) > starting.TURNING_RATE**2
    still = (variance < starting.MAX_REST_SIGMA**2) & (f.clock[0] - f.rest_clock[0] < 1.5 * starting.QUIET_SPAN)
    still = still & (f.halves_number[0] + f.halves_number[1] > parts * part // 2)
    still = still & m.no(turning & (agree > 0.5 * square))
    drifted = f.rest_variance[1] + r.parameters.rate_random_walk**2 * (f.clock[0] - f.rest_clock[1])

    def rest_found() -> None:
        f.resting[1] = 1
        f.rest_clock[1] = f.clock[0]
        f.rest_variance[0], f.rest_variance[1] = variance, 1.0 / (1.0 / drifted + 1.0 / variance)
        for i in range(3):
            f.rest_rate[i] = rate[i]

    m.branch(still & (variance < drifted), rest_found)


def use_rest(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Correct the state by a rate at rest."""
    k, n = m.kernels, program.n
    work = m.work()
    k.clear_step(work, 0.0)
    for i in range(3):
        body.put_row(k, work, tuple(1.0 if j == 3 + i else 0.0 for j in range(n)))
        m.call("take_row", f.rest_rate[i] - f.x[4 + i], f.rest_variance[0], "work")
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


# ------------------------------------------------------------------------------------------------------------------------------- steps


def begin_step(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Start a step at the last sample, and compute the scales of the reported sigma."""
    r = program.recording
    tilt, floor, heading = m.scratch(), m.scratch(), m.scratch()
    level = (f.field_level[0],) if r.magnetometer else (0.0,)
    m.kernel(recording_steps.scale_factors, level, r.imu.scale.arguments[1], tilt, floor, heading)
    f.scales[0], f.scales[1], f.scales[2] = tilt[0], floor[0], heading[0]


def end_step(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Filter a step: the mean of its samples."""
    r = program.recording
    if r.rest is not None:
        m.branch(m.equal(f.resting[1], 2), lambda: m.call("use_rest"))
    n = f.samples[1]
    edges = (0, n)
    total, number, mean, turn = m.scratch(), m.scratch(), m.scratch(), m.scratch()
    m.kernel(recording_steps.average_samples, f.force, f.frame, edges, total, number)
    m.kernel(recording_steps.end_steps, f.frame, edges, total, number, mean, turn)
    m.call("propagate", row(turn), f.clock[0] - f.clock[1])
    known = number[0] > 0

    def measured() -> None:
        sigma = r.imu.noise / m.root(number[0] * r.interval) / program.sensors[0].length
        m.call("update_accelerometer", row(mean), sigma)

    m.branch(known, measured)
    if r.magnetometer:
        end_field(m, program, f, edges, total, number)
    m.comment("the next step")
    f.samples[1] = 0
    f.clock[1] = f.clock[0]
    for i in range(4):
        f.frame[0, i] = f.turned[i]
    begin_step(m, program, f)


def end_field(m: Any, program: Any, f: SimpleNamespace, edges: Any, force: Any, force_number: Any) -> None:
    """Process the field of a step, and update with a heading that ends with it."""
    r, n = program.recording, edges[1]
    total, number = m.scratch(), m.scratch()
    m.kernel(recording_steps.average_samples, f.field, f.frame, edges, total, number)
    middle = (n + 1) // 2
    steps = SimpleNamespace(
        field=Table([row(total)]),
        number=(number[0],),
        length=(number[0] * r.interval,),
        frame=Table([tuple(f.frame[middle, i] for i in range(4))]),
        force=Table([row(force)]),
        force_number=(force_number[0],),
        end=Table([tuple(f.turned[i] for i in range(4))]),
        time=(f.clock[0],),
        turn_variance=(0.0,),
    )
    shapes = {"direction": (1, 3), "sigma": (1,), "usual": (1, 2), "variance": (1,)}
    out = SimpleNamespace(iron=m.scratch(), **{name: m.table(f"found_{name}", shape) for name, shape in shapes.items()})
    for i in range(3):
        out.direction[0, i] = 0.0
    m.kernel(headings.heading_steps, r.constants, steps, f, out)

    def turned() -> None:
        status = m.call("update_magnetometer", row(out.direction), out.sigma[0], result="status")
        nis = m.select(m.equal(status, 0), f.nis[1], 0.0)
        m.kernel(recording_steps.running_mean, (nis,), r.imu.field_mean.arguments[1], f.field_sums, f.field_level)

    m.branch(out.sigma[0] > 0.0, turned)
    f.scales[3] = out.variance[0]


def carry(m: Any, program: Any, f: SimpleNamespace) -> None:
    """Propagate the estimate to the last sample."""
    r, n = program.recording, program.n
    P = [[f.P[body.place(n, min(i, j), max(i, j))] for j in range(6)] for i in range(6)]
    rate, none = tuple(f.rate[i] for i in range(3)), (0.0, 0.0, 0.0)
    steps = SimpleNamespace(
        edge=(0,),
        attitude=Table([[f.x[i] for i in range(4)]]),
        bias=Table([[f.x[4 + i] for i in range(3)]]),
        variance=Table([[P[i][i] for i in range(6)]]),
        covariance=[Table(P)],
        **{name: (f.scales[i],) for i, name in enumerate(("tilt", "floor", "heading", "iron"))},
    )
    stamps = SimpleNamespace(
        time=(f.clock[1], f.clock[0]),
        rate=Table([none, rate]),
        turned=Table([[f.frame[0, i] for i in range(4)], [f.turned[i] for i in range(4)]]),
        late=(r.imu.late, r.imu.late),
        ahead=Table([none, scale(r.imu.late, rate)]),
    )
    out = SimpleNamespace(attitude=m.scratch(), bias=m.scratch(), variance=m.scratch(), covariance=())
    m.kernel(recording_steps.carry_to_stamps, steps, stamps, r.imu.carry.arguments[2], out)
    for i in range(4):
        f.q[i] = out.attitude[1, i]
    for i in range(6):
        f.variance[i] = out.variance[1, i]


def row(array: Any) -> Any:
    """Return the first row of an array (1, 3)."""
    return tuple(array[0, i] for i in range(3))
