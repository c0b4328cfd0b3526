"""Smoothers: attitude, gyro bias and error states at each edge from the measurements before *and after* it.

A Rauch–Tung–Striebel smoother on the manifold (Rauch, Tung & Striebel 1965; Särkkä 2013, section 8.2) over the stored states of the
filter. Each correction of the attitude moves the filter's tangent space and its covariance; the backward pass carries covariances from
one tangent space to the next by the Jacobians of the rotation vector (:mod:`strapdown.kernels.smoother`, for six states
:mod:`strapdown.kernels.smoother_loop`). To first order in the errors this is the least-squares estimate over the whole record.

After a recovery of a gate, the states before and after are two trajectories (:mod:`strapdown.estimation.recovery_segments`), smoothed
separately:

- up to the first of the refusals that led to the recovery, from the measurements before it;
- from the start of the candidate that took over, from the measurements after it. That start usually is the first refusal, so that the
  interval in which the filter was wrong is estimated correctly;
- any interval between the two, if candidates failed, is the filter's estimate, which is wrong there, as the event reports.

No information crosses a recovery, not even about the bias, for which the candidate has the σ given by :class:`strapdown.estimation.Gate`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.estimation import forward, recovery_segments
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.forward import Options, Problem
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.recovery_segments import Break, Rerun
from strapdown.estimation.states import (
    GateMemory,
    ProcessNoise,
    State,
    covariance_blocks,
    covariance_matrices,
)
from strapdown.kernels import smoother, smoother_loop, structure
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled
from strapdown.records import Estimate, Event, ImuRecord

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
        Smoothed attitude, bias, error states and variances; at the last edge those of the filter. Innovations and events are the
        filter's. After a recovery of a gate, if there is a lever arm among the error states, the second trajectory begins at the
        recovery, and the rows from the first refusal to there are the filter's.

    Notes
    -----
    Memory for the filter's states: 256 bytes per gyro interval and per measurement; with error states 8 (n (n + 1)/2 + n + 5), for n states
    in total.
    """
    problem = forward.prepared(record, process_noise, initial, error_states)
    options = Options(
        every=len(record.time),
        full_covariance=full_covariance,
        error_state_covariance=error_state_covariance,
        gate=gate,
        robust=robust,
    )
    if not problem.model.states:
        estimate = _Smoother(problem, options, _SixStates(problem)).smoothed()
        if _digits_kept(problem, estimate):
            return estimate
    estimate = _Smoother(problem, options, _ManyStates(problem)).smoothed()
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


@dataclass(frozen=True, eq=False)
class _Smoother:
    """A record and the form of the covariance for smoothing it."""

    problem: Problem
    options: Options
    form: _SixStates | _ManyStates

    def smoothed(self) -> Estimate:
        """Return the estimate at every edge."""
        record = self.problem.record
        estimate, segments = recovery_segments.filtered_whole(self.problem, self.options)
        event_time = self.problem.events.time
        recovered = recovery_segments.recoveries(estimate.events)
        edges = len(record.time)
        outputs = self.form.outputs(edges, self.options)
        starts = np.arange(edges)
        if len(segments) > edges:  # some interval in several segments
            starts = recovery_segments.starts(record.time, event_time, segments)
        if recovered:
            self._across_recoveries(*self._reruns(recovered, event_time, segments), segments, outputs)
        else:
            self.form.go_back(segments, starts, 0, outputs)
        return replace(
            self.form.estimate(outputs, self.options),
            innovations=estimate.innovations,
            skipped=estimate.skipped,
            events=estimate.events,
        )

    def _across_recoveries(
        self, breaks: Sequence[Break], reruns: Sequence[Rerun], segments: Array, outputs: Sequence[Array]
    ) -> None:
        """Smooth each trajectory of a record, and write its rows."""
        time = self.problem.record.time
        stop = recovery_segments.stops(time, breaks)
        first = recovery_segments.starts(stop, self.problem.events.time, segments)
        for part in recovery_segments.trajectories(time, breaks, first, segments, reruns):
            written = [np.empty((len(first) if len(out) else 0, *out.shape[1:])) for out in outputs]
            smoothed = part.edge <= part.last
            if smoothed.any():
                self.form.go_back(part.segments, part.starts[: part.last + 1], part.edge[0], written)
            for edge in part.edge[~smoothed]:  # the filter's own
                self.form.go_back(part.segments, part.starts[: edge + 1], edge, written)
            for out, there in zip(outputs, written, strict=True):
                if len(out):
                    out[part.row] = there[part.edge]

    def _reruns(
        self, recovered: Sequence[Event], event_time: Array, segments: Array
    ) -> tuple[list[Break], list[Rerun]]:
        """Return the breaks of a record, and for each the candidate that took over, from its start to the recovery.

        With a lever arm, whose accelerations at the end of a part differ from those of the whole, a trajectory begins with the recovery.
        """
        record, gate = self.problem.record, self.options.gate
        assert gate is not None
        state = self.problem.initial
        breaks: list[Break] = []
        reruns: list[Rerun] = []
        begin = float(record.time[0])
        for event in recovered:
            memory: GateMemory | None = None
            if not self.problem.model.levers.any():
                state = self._part(recovery_segments.part(record, begin, event.end), state, self.options).end
                memory = state.gate
                begin = event.end
            gap = recovery_segments.break_of(event, memory, float(record.time[0]))
            breaks.append(gap)
            if memory is None or gap.since == gap.end:
                reruns.append(None)
                continue
            bias, variance, counts = recovery_segments.restarted(gate, memory)
            age = gap.since - memory.start
            values, P = forward.aged_states(self.problem.model, memory.values, memory.covariance, age)
            stop = recovery_segments.stops(record.time, [gap])
            lost = recovery_segments.starts(stop, event_time, segments)[np.searchsorted(stop, gap.since)]
            whole = np.diag(np.concatenate([variance, np.zeros(len(values))]))
            whole[6:, 6:] = P
            fresh = State(
                attitude=segments[lost, 4:8],
                bias=bias,
                values=values,
                covariance=whole,
                gate=replace(memory, counts=counts),
                unit_sigma=state.unit_sigma,
            )
            span = recovery_segments.part(record, gap.since, gap.end)
            problem = forward.prepared(span, self.problem.process_noise, fresh, self.problem.error_states)
            again = replace(self.options, every=len(span.time), gate=replace(gate, recovery=None))
            _, rows = recovery_segments.filtered_whole(problem, again)
            reruns.append((rows, recovery_segments.starts(span.time, problem.events.time, rows)))
        return breaks, reruns

    def _part(self, part: ImuRecord, state: State, options: Options) -> forward.Passed:
        """Return the filter's pass over a part of the record."""
        problem = forward.prepared(part, self.problem.process_noise, state, self.problem.error_states)
        return forward.filtered(problem, replace(options, every=len(part.time), full_covariance=False))


@dataclass(frozen=True, eq=False)
class _SixStates:
    """Backward passes over attitude and bias."""

    problem: Problem

    def outputs(self, edges: int, options: Options) -> list[Array]:
        """Return arrays for the smoothed states."""
        shapes = (edges, 4), (edges, 3), (edges, 6), (edges if options.full_covariance else 0, 21)
        return [np.empty(shape) for shape in shapes]

    def estimate(self, outputs: Sequence[Array], options: Options) -> Estimate:
        """Return the smoothed states as an estimate."""
        attitude, bias, variance, blocks = outputs
        return Estimate(
            time=self.problem.record.time,
            attitude=attitude,
            bias=bias,
            variance=variance,
            covariance=covariance_matrices(blocks) if options.full_covariance else None,
        )

    def go_back(self, segments: Array, starts: np.ndarray, first: int, outputs: Sequence[Array]) -> None:
        """Smooth from the filtered state at the last stop back to stop ``first``, and write all rows between.

        ``starts``: index of the segment that starts at each stop.
        """
        if segments.shape[1] > 32:  # of a filter with a gate: the triangle of P by rows, not its blocks
            order = covariance_blocks(_places())
            segments = np.concatenate([segments[:, :11], segments[:, 11 + order]], axis=1)
        if len(segments) < smoother_loop.FEWEST_ROWS:
            short = smoother_loop.FEWEST_ROWS - len(segments)
            segments = np.concatenate([segments, np.tile(segments[-1], (short, 1))])
        compiled(smoother_loop.smooth_back)(
            segments.reshape(-1),
            starts,
            first,
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

    def go_back(self, segments: Array, starts: np.ndarray, first: int, outputs: Sequence[Array]) -> None:
        """Smooth from the filtered state at the last stop back to stop ``first``, and write all rows between.

        ``starts``: index of the segment that starts at each stop.
        """
        # The same for all sensors.
        without = self.problem.model.structure._replace(sensors=())
        kernels = forward.instance_of(replace(self.problem.model, structure=without))
        model = forward.kernel_model(self.problem.model, self.problem.variances)
        n = kernels.N
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
            np.zeros(kernels.SET * max(len(model.last), 1)),
        )
        space = smoother.Workspace._make((*states, *matrices, *others, noisy))
        models = smoother.Models(model, _with_negative_noise(model))
        compiled(smoother.smooth_back, kernels)(segments, starts, first, models, space, smoother.Outputs(*outputs))


def _with_negative_noise(model: structure.Model) -> structure.Model:
    """Return a model whose process noise has the negative variances, for steps back in time."""
    return model._replace(
        angle_variance=-model.angle_variance, rate_variance=-model.rate_variance, chains=model.chains * [1.0, -1.0]
    )
