"""A long record smoothed as eight stretches side by side, each in a lane of the machine's vectors.

Filter and smoother are chains in time, in which each step waits for the one before. A long record is cut into eight stretches instead, and
what is not known of a stretch before the one ahead of it is done is told by linear maps of it, which are small:

1. a filter that takes many steps as one (:data:`BUNDLE`) runs over the record and guesses where each stretch begins;
2. the filter runs over all stretches from there, and carries how their ends depend on their starts;
3. the ends are joined to the starts, one after the other, and the filter runs again from where each stretch truly begins;
4. what each stretch tells of its start is added up from the last to the first, and all are smoothed backward from their ends.

The maps are exact for a linear filter; this one is linear but for terms of the second order in what the guess is off by, a few hundredths
of a σ. So each end is compared with the start behind it (:data:`TOLERANCE`), and the stretches run once more where they differ. The result
is that of one pass to a few times the tolerance, as a rule to a tenth of it.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array
from strapdown.kernels import filter_loop, stretch_back, stretch_loop, stretch_seams
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled
from strapdown.kernels.stretch_lanes import ABSENT, PRESENT, STATE
from strapdown.kernels.stretch_loop import SENSITIVITY, SUMMED, SUMS
from strapdown.mekf.memory import side_by_side
from strapdown.mekf.running import LEAST_DIGITS, gaps
from strapdown.mekf.scheduling import Schedule, innovations_by_sensor, places, schedule, skipped_too
from strapdown.mekf.states import ProcessNoise, State, covariance_matrices, pack
from strapdown.records import Estimate, ImuRecord

FEWEST_STEPS = 8192
"""Gyro intervals of a record that is worth cutting."""
TOLERANCE = 1e-4
"""Of a σ: how far the end of a stretch may be off the start of the next one, in the direction in which it is off most."""
MOST_WAITING = 2.0
"""Times the measurements of a sensor: what the lanes spend on it, those that wait for another included."""
MOST_RUNS = 5
"""Runs over all stretches until ends and starts agree; a record that takes more is smoothed in one pass."""
LEAST_GAIN = 3.0
"""By so much at least each run brings them nearer, or it is given up."""
BUNDLE = 32
"""Steps that are taken as one to guess where the stretches begin: those of a period of the sensors, if that is not less than a quarter of
this, for a bundle of one measurement leaves nothing to guess."""
_FEWEST_BEFORE = 32
"""Intervals before the first stretch, at least."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cut:
    """A record cut into eight stretches, as the kernels take it."""

    first: int
    """Interval that the first stretch begins with."""
    steps: int
    """Intervals of a stretch."""
    bundle: int
    """Steps that are taken as one."""
    increments: Array
    """Flat."""
    dts: Array
    """(steps, lanes), flat."""
    values: Array
    places: np.ndarray
    complete: np.ndarray
    rows: np.ndarray
    """(sensors, steps, lanes), flat."""
    variances: Array
    """(sensors, steps, lanes), flat."""
    frames: Array
    """(sensors, 9)."""
    before: np.ndarray
    """Measurements of each sensor before the first stretch."""
    kept: Array
    """Room for the states of all stretches."""
    starts: Array
    ends: Array
    errors: Array
    """Room for a state of each stretch; the errors for those by which the filter's ends, and then its starts, are smoothed."""
    sensitivity: Array
    scratch: Array

    @property
    def taken(self) -> tuple[object, ...]:
        """What each pass takes of the gyro."""
        return self.increments, self.first, self.steps, self.dts

    @property
    def measured(self) -> tuple[object, ...]:
        """What it takes of the measurements."""
        return self.values, self.places, self.complete, self.rows, self.variances, self.frames, self.scratch


class _UnfitError(Exception):
    """A record is not fit to be cut into stretches."""


def _need(holds: bool | np.bool_) -> None:
    if not holds:
        raise _UnfitError


def smoothed(record: ImuRecord, process_noise: ProcessNoise, initial: State, full_covariance: bool) -> Estimate | None:
    """Return what :func:`strapdown.smoother.run` does without options; None of a record that is not fit to be cut.

    Fit is one of :data:`FEWEST_STEPS` gyro intervals or more, in none of which the body turns by more than a third of a radian, with
    directions and vectors of fixed references only, each with one σ, all measured at edges of the gyro's intervals, none so sharp that it
    wants Joseph's form once the first intervals are over; and one of which the seams agree.
    """
    try:
        return _smoothed(record, process_noise, initial, full_covariance)
    except _UnfitError:
        return None


def _smoothed(record: ImuRecord, process_noise: ProcessNoise, initial: State, full_covariance: bool) -> Estimate:
    _need(len(record.increments) >= FEWEST_STEPS)
    events = schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    cut = _cut(record, events)
    edges = len(record.time)
    width = 6 if "vector" in events.kinds else 4
    shapes = (edges, 4), (edges, 3), (edges, 6), (edges if full_covariance else 0, 21), (int(events.bounds[-1]), width)
    *outputs, innovation = side_by_side(*((shape, float) for shape in shapes))
    state = pack(initial.attitude, initial.bias, initial.covariance)
    segments = np.empty((cut.first + 1, 32))  # one more tells whether a step was cut
    noise = process_noise.angle_random_walk**2, process_noise.rate_random_walk**2
    _run_before(record, events, noise, cut, state, innovation, segments)
    _guess_starts(record, cut, noise, state)
    _run(cut, noise, events.bounds, innovation)
    _go_back(cut, noise, outputs)
    compiled(stretch_seams.smooth_before)(segments[:-1], state, cut.errors, *noise, *outputs)
    attitude, bias, variance, blocks = outputs
    end = cut.ends.reshape(STATE, WIDTH)[:, -1]
    attitude[-1], bias[-1], variance[-1] = end[:4], end[4:7], end[[7, 10, 12, 22, 25, 27]]
    if full_covariance:
        blocks[-1] = end[7:]
    innovations = innovations_by_sensor(events, innovation, parted=True)
    return Estimate(
        time=record.time,
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=covariance_matrices(blocks) if full_covariance else None,
        innovations=innovations,
        skipped=skipped_too(events, innovations),
        events=tuple(gaps(record.time)),
    )


def _run(cut: _Cut, noise: tuple[float, float], bounds: np.ndarray, innovation: Array) -> None:
    """Run the filter over all stretches, from where each begins; leave their ends, and how these depend on the starts."""
    base, ends, sensitivity = cut.starts, cut.ends, cut.sensitivity
    starts = cut.errors  # which are not known yet
    work = np.empty((8, 6, 6))
    ends[:], sensitivity[:] = base, 0.0
    sensitivity.reshape(SENSITIVITY, WIDTH)[:36:7] = 1.0
    _need(compiled(stretch_loop.run_with_sensitivity)(*cut.taken, *noise, *cut.measured, ends, sensitivity))
    join = compiled(stretch_seams.join_starts)
    _need(join(base, ends, sensitivity, starts, work) < np.inf)
    width = innovation.shape[1]
    begins = width * (bounds[:-1] + np.where(cut.complete, cut.before, 0))
    run = compiled(stretch_loop.run_stretches)
    off = np.inf
    for _ in range(MOST_RUNS):
        base, starts = starts, base
        ends[:] = base
        _need(run(*cut.taken, *noise, *cut.measured, ends, cut.kept, innovation.reshape(-1), begins, width))
        off = _nearer(off, join(base, ends, sensitivity, starts, work))
        if off <= TOLERANCE:
            break
    _need(off <= TOLERANCE)
    share = compiled(stretch_loop.least_kept_share)(cut.kept, cut.steps, np.empty(STATE), np.empty((7, 6)))
    _need(share >= LEAST_DIGITS[1])
    # What the stretches behind tell is told of where they began.
    ends.reshape(STATE, WIDTH)[:, :-1] = base.reshape(STATE, WIDTH)[:, 1:]
    cut.kept[-len(ends) :] = ends


def _nearer(before: float, now: float) -> float:
    """Return how far seams are off now, if that is good or much better than before."""
    _need(now <= max(TOLERANCE, before / LEAST_GAIN))
    return now


def _go_back(cut: _Cut, noise: tuple[float, float], outputs: Sequence[Array]) -> None:
    """Smooth all stretches from their ends to their starts, of which the errors are left."""
    adjoints, work, assumed = np.empty((WIDTH, 6, 7)), np.empty((8, 6, 6)), np.empty_like(cut.errors)
    flat = [out.reshape(-1) for out in outputs]
    match = compiled(stretch_seams.match_ends)
    off = np.inf
    for _ in range(MOST_RUNS):
        _need(compiled(stretch_seams.join_ends)(cut.ends, cut.sensitivity, adjoints, cut.errors, work))
        assumed[:] = cut.errors
        _need(compiled(stretch_back.smooth_stretches)(*cut.taken, *noise, cut.kept, cut.errors, *flat))
        off = _nearer(off, match(cut.ends, cut.sensitivity, adjoints, assumed, cut.errors, work))
        if off <= TOLERANCE:
            return
    raise _UnfitError


def _edges_seen(edges: Array, time: Array) -> np.ndarray | range:
    """Return the number of the edge that each measurement stands at, rising."""
    if len(time) and np.array_equal(time, edges[-len(time) :]):  # most often: from some edge on at each
        return range(len(edges) - len(time), len(edges))
    edge = np.searchsorted(edges, time)
    _need(np.array_equal(edges[edge], time) and np.all(edge[1:] > edge[:-1]))
    return edge


def _cut(record: ImuRecord, events: Schedule) -> _Cut:
    """Return a record cut into eight stretches."""
    intervals, sensors = len(record.increments), len(events.sensors)
    _need(events.standing_noise is None and sensors <= 256)
    _need(set(events.kinds) <= {"direction", "vector"} and not np.any(events.frames[:, 1]))
    seen = [_edges_seen(record.time, time) for time in events.series_time]
    # Stretches of whole periods of all sensors: else some lane is measured at nearly every step, and the others wait.
    period = math.lcm(*(int(edge[1] - edge[0]) if len(edge) > 1 else 1 for edge in seen))
    steps = (intervals - _FEWEST_BEFORE) // WIDTH // period
    # Odd: else lanes may lie a power of two apart in memory, and crowd each other out of the cache.
    steps = period * (steps - 1 + steps % 2)
    _need(WIDTH * steps >= intervals // 2)
    first = intervals - WIDTH * steps
    room = 3 * [(STATE * WIDTH,)]
    shapes = (steps * WIDTH,), (sensors, steps, WIDTH), ((steps + 1) * STATE * WIDTH,), *room, (SENSITIVITY * WIDTH,)
    scratch_shape = (WIDTH * (SUMS + SUMMED * sensors),)
    dts, variances, *places_for = side_by_side(*((shape, float) for shape in (*shapes, scratch_shape)))
    kept, starts, ends, errors, sensitivity, scratch = places_for
    compiled(stretch_loop.lay_out)(record.time, first, steps, dts)
    before = np.array([bisect.bisect_right(edge, first) for edge in seen], np.int64)
    complete = np.array([len(edge) for edge in seen], np.int64) - before == WIDTH * steps
    rows = np.empty((0 if np.all(complete) else sensors, steps, WIDTH), np.int64)
    values, begins = places(events.series_vector_b)
    for s, (edge, sigma) in enumerate(zip(seen, events.series_sigma, strict=True)):
        if complete[s]:
            _need(compiled(stretch_loop.lay_out_variances)(sigma, before[s], steps, variances[s].reshape(-1)))
            continue
        _need(np.max(sigma, initial=0.0) < math.sqrt(PRESENT))
        place = np.asarray(edge[before[s] :]) - (first + 1)
        flat_rows, flat_variances = np.full(WIDTH * steps, -1), np.full(WIDTH * steps, ABSENT)
        flat_rows[place], flat_variances[place] = np.arange(before[s], len(edge)), np.square(sigma[before[s] :])
        rows[s], variances[s] = flat_rows.reshape(WIDTH, steps).T, flat_variances.reshape(WIDTH, steps).T
        _need(WIDTH * np.count_nonzero(np.any(rows[s] >= 0, axis=1)) <= MOST_WAITING * len(place) + WIDTH)
    return _Cut(
        first=first,
        steps=steps,
        bundle=period if BUNDLE // 4 <= period <= BUNDLE else BUNDLE,
        increments=np.ascontiguousarray(record.increments).reshape(-1),
        dts=dts,
        values=values,
        places=begins + 3 * np.where(complete, before, 0),
        complete=complete,
        rows=rows.reshape(-1),
        variances=variances.reshape(-1),
        frames=np.ascontiguousarray(events.triads[events.frames[:, 0]]),
        before=before,
        kept=kept,
        starts=starts,
        ends=ends,
        errors=errors,
        sensitivity=sensitivity,
        scratch=scratch,
    )


def _run_before(
    record: ImuRecord,
    events: Schedule,
    noise: tuple[float, float],
    cut: _Cut,
    state: Array,
    innovation: Array,
    segments: Array,
) -> None:
    """Run the filter over the intervals before the first stretch, and leave the state there."""
    series = [time[:number] for time, number in zip(events.series_time, cut.before, strict=True)]
    ends = np.cumsum([0, *cut.before])
    number = int(ends[-1])
    time, row, sensor = np.empty(number), np.empty(number, np.uint32), np.empty(number, np.uint8)
    standing = np.concatenate([np.empty(0), *series])
    compiled(filter_loop.merge_order)(standing, ends[:-1].copy(), ends[1:], time, row, sensor)
    row += (events.bounds[:-1] - ends[:-1]).astype(np.uint32)[sensor]
    columns = [places(column) for column in (events.series_vector_b, events.series_sigma)]
    begins = [begin - wide * events.bounds[:-1] for (_, begin), wide in zip(columns, (3, 1), strict=True)]
    taken, stopped, _ = compiled(filter_loop.run_filter)(
        record.time[: cut.first + 1],
        cut.increments.reshape(-1, 3)[: cut.first],
        *noise,
        time,
        row,
        sensor,
        *(column for column, _ in columns),
        np.stack(begins, axis=1),
        events.bounds,
        events.codes,
        events.frames,
        events.triads,
        state,
        cut.first + 1,
        np.empty((1, 4)),
        np.empty((1, 3)),
        np.empty((1, 6)),
        np.empty((0, 21)),
        innovation,
        segments,
        *LEAST_DIGITS,
        np.empty(STATE),
        np.empty((7, 6)),
    )
    _need(taken == cut.first and stopped < 0)


def _guess_starts(record: ImuRecord, cut: _Cut, noise: tuple[float, float], state: Array) -> None:
    """Write where the stretches begin, the first at ``state``, the others by a filter over bundles."""
    sensors = len(cut.complete)
    bundles = -(-cut.steps // cut.bundle)
    rows = (WIDTH - 1) * bundles
    turns, seen = np.empty((WIDTH * bundles, 4)), np.empty((sensors, WIDTH * bundles, 8))
    flat = turns.reshape(-1), seen.reshape(-1)
    compiled(stretch_loop.bundle)(*cut.taken, state[4:7].copy(), *cut.measured, cut.bundle, *flat)
    number = sensors * rows
    edges, increments = np.empty(rows + 1), np.empty((rows, 3))
    time, row, sensor = np.empty(number), np.empty(number, np.uint32), np.empty(number, np.uint8)
    value, sigma = np.empty(3 * number), np.empty(number)
    events = compiled(stretch_loop.record_of_bundles)(
        record.time, cut.first, cut.steps, cut.bundle, turns, seen, edges, increments, time, row, sensor, value, sigma
    )
    sigma.flags.writeable = False  # as that of a record is: one more form of the kernel takes seconds to compile
    states = [np.empty((WIDTH, columns)) for columns in (4, 3, 6, 21)]
    frames = np.zeros((sensors, 2), np.int64)
    frames[:, 0] = range(sensors)
    _, stopped, _ = compiled(filter_loop.run_filter)(
        edges,
        increments,
        *noise,
        time[:events],
        row[:events],
        sensor[:events],
        value,
        sigma,
        np.zeros((sensors, 2), np.int64),
        rows * np.arange(sensors + 1),
        np.full(sensors, filter_loop.DIRECTION, np.uint8),
        frames,
        cut.frames,
        state.copy(),
        bundles,
        *states,
        np.empty((number, 4)),
        np.empty((0, 32)),
        *LEAST_DIGITS,
        np.empty(STATE),
        np.empty((7, 6)),
    )
    attitude, bias, _, blocks = states
    for memory, part in zip(np.split(cut.starts.reshape(STATE, WIDTH), (4, 7)), (attitude, bias, blocks), strict=True):
        memory[:] = part.T
    _need(stopped < 0)
