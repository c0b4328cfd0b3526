"""Smoothers: attitude, gyro bias and error states at each edge from the measurements before *and after* it.

A Rauch–Tung–Striebel smoother on the manifold (Rauch, Tung & Striebel 1965; Särkkä 2013, section 8.2) over the stored states of the
filter. Each correction of the attitude moves the filter's tangent space and its covariance; the backward pass carries covariances from
one tangent space to the next by the Jacobians of the rotation vector (:mod:`strapdown.kernels.smoother`, for six states
:mod:`strapdown.kernels.smoother_loop`). To first order in the errors this is the least-squares estimate over the whole record.

A recovery of a gate divides the record, and no information crosses it, not even about the bias, for which the candidate has the σ given by
:class:`strapdown.estimation.Gate`:

- up to the first of the refusals that led to it, from the measurements before it;
- from the start of the candidate that took over, from the measurements after it. That start usually is the first refusal, so that the
  interval in which the filter was wrong is estimated correctly;
- any interval between the two, if candidates failed, from the measurements in it: it is wrong there, as the event reports.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.estimation import forward
from strapdown.estimation.angular_acceleration import turning
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.forward import Options, Passed, Problem, filtered, most_segments
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import (
    GateMemory,
    ProcessNoise,
    State,
    covariance_blocks,
)
from strapdown.kernels import chains, smoother, smoother_loop
from strapdown.kernels.gate_rules import FIRST_BIAS, PASSES, SINCE, WIDE_PASSES, restart_attitude, step_aside
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.smoother_loop import locate_edges
from strapdown.records import Estimate, ImuRecord

MAX_CUT = 64
"""Maximum ratio of the number of sub-steps to that expected from the increments; above it the filter has diverged."""
MIN_SMOOTHED = 1e-11
"""Minimum smoothed variance, relative to what a backward step subtracts, at which it keeps enough digits."""
UPPER = np.triu_indices(6)


def smooth(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates] = (),
    *,
    full_covariance: bool = False,
    error_state_covariance: bool = True,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> Estimate:
    """Return the smoother's estimate at every edge of a record.

    Parameters
    ----------
    record : ImuRecord
        As for :func:`strapdown.estimation.run`.
    process_noise : ProcessNoise
        Angle random walk and rate random walk of the gyro, as the filter models them.
    initial : State
        State at the first edge before any measurement, as for :func:`strapdown.estimation.run`.
    error_states : sequence of ErrorStates
        As for :func:`strapdown.estimation.run`.
    full_covariance : bool
        Whether to return whole covariance matrices too.
    error_state_covariance : bool
        Whether those include the error states; without them the smoother is faster.
    gate, robust : optional
        As for :func:`strapdown.estimation.run`; refused measurements and weights are those of the filter.

    Returns
    -------
    Estimate
        Smoothed attitude, bias, error states and variances; at the last edge those of the filter, unless its gate recovered shortly before:
        the smoother starts again from the samples of the recovery. Innovations and events are the filter's.

    Notes
    -----
    Memory for the filter's states: 256 bytes per gyro interval and per measurement; with error states 8 (n (n + 1)/2 + n + 5), for n states
    in total.
    """
    problem = forward.prepared(record, process_noise, initial, error_states)
    options = Options(
        full_covariance=full_covariance,
        error_state_covariance=error_state_covariance,
        gate=gate,
        robust=robust,
    )
    if not problem.model.states:
        estimate = _estimate(problem, options, _SixStates)
        if _digits_kept(problem, estimate):
            return estimate
    estimate = _estimate(problem, options, _ManyStates)
    lost = _digits_lost(problem, estimate)
    if lost is not None:
        raise InputError(
            f"the smoothed variances at {record.time[lost]:g} s have no digits left: the attitude of the start is known too well for the "
            "uncertainty of its bias; raise the smaller sigma"
        )
    return estimate


def _digits_kept(problem: Problem, estimate: Estimate) -> bool:
    """Return whether the smoothed variances of :mod:`strapdown.kernels.smoother_loop` have their digits.

    A backward step subtracts what the interval had added: the process noise, and at the start the uncertainty of the bias.
    """
    angle, rate = problem.variances
    dt = problem.record.intervals
    start = dt[0] ** 2 * np.diag(problem.initial.covariance)[3:6].max()
    # If the minimum over all rows exceeds the limit of the longest interval, as nearly always, the check takes a tenth of the time.
    # It is NaN if a variance or an attitude is: the Jacobian of a correction that is NaN enters the covariance.
    longest, smallest = dt.max(), estimate.variance.min()
    most = MIN_SMOOTHED * max(angle * longest + rate * longest**3 / 3.0 + start, rate * longest)
    if smallest > most:
        return True
    added = np.stack([_added_angle(problem), np.append(rate * dt, 0.0)])
    added[0, 0] += start
    least = np.minimum.reduceat(estimate.variance[:, :6], [0, 3], axis=1).T
    return bool(((least > MIN_SMOOTHED * added) & (least > 0.0)).all())


def _digits_lost(problem: Problem, estimate: Estimate) -> int | None:
    """Return the first edge at which the smoothed variances of :mod:`strapdown.kernels.smoother` have lost their digits, or None.

    A backward step subtracts the uncertainty of the bias of the start. What is left counts by the square of N, the share of the state in
    the prediction: its smoothed variance over the noise of the interval, and at most 1.
    """
    least, added = functools.reduce(np.minimum, estimate.variance[:, :3].T), _added_angle(problem)
    start = problem.record.intervals[0] ** 2 * np.diag(problem.initial.covariance)[3:6].max()
    N = np.minimum(1.0, np.divide(least, added, out=np.ones(len(least)), where=added > 0.0))
    kept = (least > MIN_SMOOTHED * start * N**2) & (estimate.variance > 0.0).all(axis=1)
    return None if kept.all() else int(np.argmin(kept))


def _added_angle(problem: Problem) -> Array:
    """Return the variance (edges,) that the noise of the interval after each edge adds to the attitude, rad²."""
    angle, rate = problem.variances
    dt = np.append(problem.record.intervals, 0.0)
    return np.asarray(angle * dt + rate * dt**3 / 3.0)


def _estimate(problem: Problem, options: Options, kind: type[_SixStates | _ManyStates]) -> Estimate:
    """Return the estimate at every edge of a record."""
    passed, outputs = _smoothed(problem, options, kind)
    estimate = passed.estimate
    return replace(
        kind(problem).estimate(outputs, options),
        innovations=estimate.innovations,
        skipped=estimate.skipped,
        events=estimate.events,
    )


def _smoothed(problem: Problem, options: Options, kind: type[_SixStates | _ManyStates]) -> tuple[Passed, list[Array]]:
    """Return the filter's result over a record, and the smoothed states at its edges."""
    time, last = problem.record.time, problem.record.time[-1]
    whole = passed = filtered_whole(problem, options)
    outputs = kind(problem).outputs(len(time), options)
    begin = time[0]

    def write(part: Problem, rows: Sequence[Array]) -> None:
        first, end = part.record.time[[0, -1]]
        edges = np.flatnonzero((time >= first) & ((time < end) | (time == last) & (end == last)))
        skip = int(first not in time)
        for out, row in zip(outputs, rows, strict=True):
            if len(out):
                out[edges] = row[skip : skip + len(edges)]

    while recoveries := [event for event in passed.estimate.events if event.kind == "recovery"]:
        event = min(recoveries, key=lambda event: event.end)
        until = _part(problem, begin, event.end, problem.initial)
        memory = filtered(until, replace(options, every=len(time))).end.gate
        assert memory is not None
        since = max(memory.counts[SINCE], begin)
        if since == begin and passed is not whole:  # another candidate than that with which this part starts
            since = event.end
        state = problem.initial
        for first, end in itertools.pairwise((begin, max(event.start, begin), since)):
            if end > first:
                part = _part(problem, first, end, state)
                of_part, rows = _smoothed(part, options, kind)
                state = of_part.end
                write(part, rows)
        if since == last:  # the filter's state there is left
            rows = kind(problem).outputs(1, options)
            kind(problem).go_back(whole.segments[-1:], np.zeros(1, np.int64), rows)
            for out, row in zip(outputs, rows, strict=True):
                out[-1:] = row
            return whole, outputs
        problem = _part(problem, since, last, _candidate(problem, options, state, memory, since), closed=True)
        begin, passed = since, filtered_whole(problem, options)
    rows = outputs if passed is whole else kind(problem).outputs(len(problem.record.time), options)
    kind(problem).go_back(passed.segments, segment_starts(problem, passed.segments), rows)
    if passed is not whole:
        write(problem, rows)
    return whole, outputs


def filtered_whole(problem: Problem, options: Options) -> Passed:
    """Return the filter's result over a record with all its predictions (:attr:`strapdown.estimation.forward.Passed.segments`)."""
    usual = most = most_segments(problem)
    options = replace(options, every=len(problem.record.time), full_covariance=False)
    while most <= MAX_CUT * usual:
        # One row more than expected shows whether more were needed.
        passed = filtered(problem, replace(options, segments=most + 1))
        if len(passed.segments) - 1 <= most:
            return passed
        most *= (
            4  # the number of sub-steps depends on the rotation without the bias, which is known only during the run
        )
    raise InputError(
        "the filter diverged: with its estimate of the bias the body makes many rotations in each gyro interval; check the record and the "
        "initial state with estimation.run first"
    )


def segment_starts(problem: Problem, segments: Array) -> np.ndarray:
    """Return the index of the segment that starts at each edge; the last row of segments is the end state."""
    time = problem.record.time
    first = np.arange(len(time))
    if len(segments) > len(time):  # some interval in several segments
        compiled(locate_edges)(read_only(time), problem.events.time, segments, len(segments) - 1, first)
    return first


def _part(problem: Problem, begin: float, end: float, initial: State, *, closed: bool = False) -> Problem:
    """Return the part of a record between two times, with the measurements from ``begin`` on and before ``end``.

    ``closed``: with those at the end too. Those with which a recovery ends belong to what comes after it, at the last edge too: in a part
    with them it would recur for ever.
    """
    record, model = problem.record, problem.model
    time = np.concatenate([[begin], record.time[(record.time > begin) & (record.time < end)], [end]])
    k = np.searchsorted(record.time, time[1:], side="left") - 1
    share = np.diff(time) / record.intervals[k]
    before = np.nextafter(end, np.inf) if closed else end

    def inside(at: Array) -> np.ndarray:
        return (at >= begin) & (at < before)

    series = tuple(vectors.taken(inside(vectors.time)) for vectors in record.vectors)
    temperature = None
    if model.structure.slopes:
        temperature = np.interp(time, record.time, forward.driving_temperature(problem))
    part = ImuRecord(
        time=time, increments=share[:, None] * record.increments[k], vectors=series, temperature=temperature
    )
    initial = replace(initial, unit_sigma=forward.unit_sigmas(record, model, initial.unit_sigma))
    shorter = forward.prepared(part, problem.process_noise, initial, problem.error_states)
    if not model.levers.any():
        return shorter
    events = problem.events.time
    motion = problem.motion or turning(record, events)
    return replace(shorter, motion=(motion[0][inside(events)], motion[1][inside(events)]))


def _candidate(problem: Problem, options: Options, state: State, memory: GateMemory, since: float) -> State:
    """Return a candidate at its start from the filter's state there and the gate's memory just before the candidate took over."""
    assert options.gate is not None
    counts = memory.counts.copy()
    values, P = forward.aged_states(problem.model, memory.values, memory.covariance, since - memory.start)
    sigma = restart_attitude(options.gate.restart_attitude_sigma, counts)
    covariance = np.diag(
        np.concatenate([np.full(3, sigma**2), counts[FIRST_BIAS + 3 : FIRST_BIAS + 6], np.zeros(len(P))])
    )
    covariance[6:, 6:] = P
    bias = counts[FIRST_BIAS : FIRST_BIAS + 3].copy()
    step_aside(counts)
    counts[PASSES] = WIDE_PASSES
    after = replace(memory, counts=counts, counters={}, candidate=None)
    return replace(state, bias=bias, values=values, covariance=covariance, gate=after)


@dataclass(frozen=True, eq=False)
class _SixStates:
    """Backward passes over attitude and bias."""

    problem: Problem

    def outputs(self, edges: int, options: Options) -> list[Array]:
        """Return arrays for the smoothed states."""
        shapes = (edges, 4), (edges, 3), (edges, 6), (edges if options.full_covariance else 0, 36)
        return [np.empty(shape) for shape in shapes]

    def estimate(self, outputs: Sequence[Array], options: Options) -> Estimate:
        """Return the smoothed states as an estimate."""
        attitude, bias, variance, covariance = outputs
        return Estimate(
            time=self.problem.record.time,
            attitude=attitude,
            bias=bias,
            variance=variance,
            covariance=covariance.reshape(-1, 6, 6) if options.full_covariance else None,
        )

    def go_back(self, segments: Array, starts: np.ndarray, outputs: Sequence[Array]) -> None:
        """Smooth from the filtered state at the last edge back to the first; ``starts``: index of the segment that starts at each edge."""
        if segments.shape[1] > 32:  # of a filter with a gate: the triangle of P by rows, not its blocks
            order = covariance_blocks(_places())
            segments = np.concatenate([segments[:, :11], segments[:, 11 + order]], axis=1)
        if len(segments) < smoother_loop.FEWEST_ROWS:
            short = smoother_loop.FEWEST_ROWS - len(segments)
            segments = np.concatenate([segments, np.tile(segments[-1], (short, 1))])
        compiled(smoother_loop.smooth_back)(
            segments.reshape(-1),
            starts,
            *self.problem.variances,
            np.empty(smoother_loop.WORK_SIZE),
            smoother_loop.Outputs(*outputs),
        )


def _places() -> np.ndarray:
    """Return the place of each element of P (6, 6) in its upper triangle by rows."""
    places = np.zeros((6, 6), np.intp)
    places[UPPER] = np.arange(21)
    return np.maximum(places, places.T)


@dataclass(frozen=True, eq=False)
class _ManyStates:
    """Backward passes over attitude, bias and error states."""

    problem: Problem

    def outputs(self, edges: int, options: Options) -> list[Array]:
        """Return arrays for the smoothed states."""
        n = self.problem.model.structure.n
        kept = n if options.error_state_covariance else 6
        whole = (edges if options.full_covariance else 0, kept, kept)
        shapes = (edges, n + 1), (edges, n), whole
        return [np.empty(shape) for shape in shapes]

    def estimate(self, outputs: Sequence[Array], options: Options) -> Estimate:
        """Return the smoothed states as an estimate."""
        x, variance, P = outputs
        return forward.estimate_of(self.problem, 1, x, variance, P if options.full_covariance else None)

    def go_back(self, segments: Array, starts: np.ndarray, outputs: Sequence[Array]) -> None:
        """Smooth from the filtered state at the last edge back to the first; ``starts``: index of the segment that starts at each edge."""
        # The same for all sensors.
        without = self.problem.model.structure._replace(sensors=())
        kernels = forward.instance_of(replace(self.problem.model, structure=without), smoother)
        model = forward.kernel_model(self.problem.model, self.problem.variances)
        n = without.n
        if segments.shape[1] == 32:  # of the filter of six states: the blocks of P, not its triangle by rows
            order = np.argsort(covariance_blocks(_places()))
            segments = np.concatenate([segments[:, :11], segments[:, 11 + order], np.zeros((len(segments), 7))], axis=1)
        states, matrices = np.zeros((4, n + 1)), forward.aligned_zeros(3, (n + smoother.ROWS) * kernels.W)
        noisy = np.array(kernels.NOISY, np.int64)
        others = (
            forward.aligned_zeros(n * kernels.NOISY_WIDTH + WIDTH)[:-WIDTH],
            forward.aligned_zeros((n + smoother.ROWS) * kernels.NOISY_WIDTH),
            forward.aligned_zeros((len(noisy) + smoother.ROWS) * kernels.NOISY_WIDTH),
            np.ones(len(noisy)),
            forward.aligned_zeros(3 * kernels.W),
            np.zeros(n + kernels.NOISY_WIDTH),
            np.zeros(chains.SET * max(len(model.last), 1)),
        )
        warming = forward.warming(self.problem)
        if without.slopes:
            warming = 0.5 * segments[:-1, 0] * np.repeat(warming, np.diff(starts))
        space = smoother.Workspace._make((*states, *matrices, *others, noisy, warming))
        steps_back = model._replace(  # noise of negative variance
            angle_variance=-model.angle_variance, rate_variance=-model.rate_variance, chains=model.chains * [1.0, -1.0]
        )
        models = smoother.Models(model, steps_back)
        compiled(kernels.smooth_back)(segments, starts, models, space, smoother.Outputs(*outputs))
