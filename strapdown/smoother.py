"""Smoother: attitude and gyro bias at each edge from the measurements before *and after* it.

A Rauch–Tung–Striebel smoother on the manifold (Rauch, Tung & Striebel 1965; Särkkä 2013, section 8.2), over the states that the filter
of :mod:`strapdown.mekf` passed through. The filter moves its attitude at each correction and carries its covariance along, so every
covariance has a tangent space of its own; the backward pass carries them from one to the next by the Jacobians of the rotation vector
(:mod:`strapdown.kernels.smoother_step`). To first order in the errors this is the least-squares estimate over the whole record.

Where a gate has recovered, the states before and after are two trajectories (:mod:`strapdown.augmented.joining`), each smoothed by itself:

- up to the first refusal of those that led to it by what was measured before it;
- from the start of the challenger that took over by what was measured from there on. That is as a rule the first refusal too: then the
  stretch in which the filter was lost is told right;
- what may lie between the two, if challengers failed, is the filter's own, and as wrong as the event says.

Nothing is learned across: not even the bias, which the challenger starts from as uncertain as :class:`strapdown.robustness.Gate` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from strapdown import mekf
from strapdown.augmented import joining, smoothing
from strapdown.checks import Array, non_negative
from strapdown.kernels import smoother_lag, smoother_loop
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf import ProcessNoise, State
from strapdown.mekf.memory import side_by_side
from strapdown.mekf.running import LostDigitsError
from strapdown.mekf.states import check_arguments
from strapdown.records import Estimate, Event, ImuRecord
from strapdown.robustness import Gate, Robust

MOST_GROUPS = 3600
"""Groups of segments of which the fixed-lag smoother keeps the gains, 5.7 kB each; where a lag takes more, it computes them anew."""


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> Estimate:
    """Return the fixed-interval smoother's estimate at every edge of a record.

    Parameters
    ----------
    record : ImuRecord
    process_noise : ProcessNoise
    initial : State
        State at the first edge before any measurement, as for :func:`strapdown.mekf.run`.
    full_covariance : bool
        Keep whole covariance matrices too.
    gate, robust : optional
        As for :func:`strapdown.mekf.run`: what the filter refused or weighed down, the smoother does not take up again.

    Returns
    -------
    Estimate
        Attitude, bias and variance are smoothed; those at the last edge are the filter's. Innovations and events are the filter's.
        Memory for the filter's states: 256 bytes a gyro interval and a measurement. A record with recoveries takes three times as long;
        one whose covariance would lose its digits, by measurements 1e-7 times as wide as what was known or by an outage, is smoothed
        on its square root as by :func:`strapdown.augmented.smooth`, which takes a dozen times as long.
    """
    return _smoothed(record, process_noise, initial, np.inf, full_covariance, gate, robust)


def run_fixed_lag(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    lag: float,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> Estimate:
    """Return the fixed-lag smoother's estimate: at each edge t, what the measurements up to the last edge at or before t + lag tell.

    Exact: equal to :func:`run` on the record cut there. Work grows with the number of gyro intervals in ``lag``: one backward step each
    for every edge, though the gains are computed once and eight edges are worked at once. ``lag`` in s; 0 is the filter, the
    length of the record or more is :func:`run`.
    """
    return _smoothed(record, process_noise, initial, non_negative("lag", lag, unit="s"), full_covariance, gate, robust)


def _smoothed(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State,
    lag: float,
    full_covariance: bool,
    gate: Gate | None,
    robust: Robust | None,
) -> Estimate:
    check_arguments(record=record, process_noise=process_noise, initial=initial, gate=gate, robust=robust)
    try:
        forward, event_time, segments = _filtered(record, process_noise, initial, gate, robust)
    except LostDigitsError:
        whole = smoothing.smoothed(record, process_noise, initial, (), lag, full_covariance, gate, robust)
        return Estimate(**{field.name: getattr(whole, field.name) for field in fields(Estimate)})
    edges, until = len(record.time), joining.last_seen(record.time, lag)
    shapes = (edges, 4), (edges, 3), (edges, 6), (edges if full_covariance else 0, 21)
    outputs = side_by_side(*((shape, float) for shape in shapes))
    recovered = joining.recoveries(forward.events)
    if not recovered:
        starts = _starts(record, event_time, segments)
        _go_back(process_noise, segments, starts, np.arange(edges), until, outputs)
    else:
        assert gate is not None
        breaks, again = _begun_again(record, process_noise, initial, recovered, event_time, segments, gate, robust)
        first = joining.starts(joining.stops(record.time, breaks), event_time, segments)
        for one in joining.trajectories(record.time, until, breaks, first, segments, again):
            places = len(one.starts)
            written = [np.empty((places if len(out) else 0, out.shape[1])) for out in outputs]
            for stretch in joining.climbing(one.last):
                _go_back(process_noise, one.segments, one.starts, one.edge[stretch], one.last[stretch], written)
            for out, found in zip(outputs, written, strict=True):
                if len(out):
                    out[one.row] = found[one.edge]
    attitude, bias, variance, blocks = outputs
    return Estimate(
        time=record.time,
        attitude=attitude,
        bias=bias,
        variance=variance,
        covariance=mekf.covariance_matrices(blocks) if full_covariance else None,
        innovations=forward.innovations,
        skipped=forward.skipped,
        events=forward.events,
    )


def _go_back(
    process_noise: ProcessNoise,
    segments: Array,
    starts: np.ndarray,
    edge: np.ndarray,
    last: np.ndarray,
    outputs: Sequence[Array],
) -> None:
    """Write the estimates at edges (m,) that each sees the segments up to an edge ``last`` (m,), which does not fall."""
    if len(segments) < smoother_loop.FEWEST_ROWS:
        segments = np.concatenate([segments, np.tile(segments[-1], (smoother_loop.FEWEST_ROWS - len(segments), 1))])
    rows = segments.reshape(-1)
    variances = process_noise.angle_random_walk**2, process_noise.rate_random_walk**2
    # All that see the same edge as the last of them does are told by one pass.
    lagged = int(np.searchsorted(last, last[-1]))
    if lagged:
        first, seen = edge[:lagged], last[:lagged]
        # Eight passes at a time, which share nearly all groups with the next eight.
        ahead = np.minimum(np.arange(lagged) + WIDTH - 1, lagged - 1)
        groups = int(np.max(starts[seen[ahead]] - starts[first])) // WIDTH + 2
        work = np.empty(smoother_lag.lag_work_size(min(groups, MOST_GROUPS)))
        compiled(smoother_lag.smooth_lagged)(rows, starts, first, seen, *variances, work, *outputs)
    compiled(smoother_loop.smooth_back)(
        rows,
        starts[: last[-1] + 1],
        edge[lagged],
        *variances,
        np.empty(smoother_loop.WORK_SIZE),
        *outputs,
    )


def _begun_again(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State,
    recovered: Sequence[Event],
    event_time: Array,
    segments: Array,
    gate: Gate,
    robust: Robust | None,
) -> tuple[list[joining.Break], list[joining.Again]]:
    """Return the breaks of a record, and what took over at each, from its start to the recovery."""
    breaks: list[joining.Break] = []
    again: list[joining.Again] = []
    begin, state = float(record.time[0]), initial
    for event in recovered:
        before = joining.part(record, begin, event.end)
        _, state = mekf.run_on(before, process_noise, state, every=len(before.time), gate=gate, robust=robust)
        begin = event.end
        one = joining.break_of(event, state.gate, float(record.time[0]))
        breaks.append(one)
        if state.gate is None or one.since == one.end:
            again.append(None)
            continue
        bias, variance, counts = joining.begun(gate, state.gate)
        stop = joining.stops(record.time, [one])
        lost = joining.starts(stop, event_time, segments)[np.searchsorted(stop, one.since)]
        memory = replace(state.gate, counts=counts)
        fresh = mekf.State(attitude=segments[lost, 4:8], bias=bias, covariance=np.diag(variance), gate=memory)
        stretch = joining.part(record, one.since, one.end)
        _, times, rows = _filtered(stretch, process_noise, fresh, replace(gate, recovery=None), robust)
        again.append((rows, joining.starts(stretch.time, times, rows)))
    return breaks, again


def _most_segments(record: ImuRecord, events: int) -> int:
    """Return the number of segments at most, but for turns of the bias: one an interval and an event, and the sub-steps of large turns."""
    most = len(record.increments) + events
    if 3.0 * max(np.max(record.increments), -np.min(record.increments)) ** 2 <= LARGEST_ANGLE**2:
        return most
    squared = np.einsum("ij,ij->i", record.increments, record.increments)
    large = squared[squared > LARGEST_ANGLE**2]
    return most + int(np.sum(np.floor(np.sqrt(large) / LARGEST_ANGLE) + 1.0))


def _filtered(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> tuple[Estimate, Array, Array]:
    """Run the filter and keep its segments; return its estimate, the times of its events, and the segments with the end state."""
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    forward, segments = joining.kept_whole(
        lambda segments: mekf.run_events(
            record,
            events,
            process_noise,
            initial,
            every=len(record.time),
            full_covariance=False,
            segments=segments,
            gate=gate,
            robust=robust,
        ),
        _most_segments(record, int(events.bounds[-1])),
        "mekf.run",
    )
    return forward, events.time, segments


def _starts(record: ImuRecord, event_time: Array, segments: Array) -> np.ndarray:
    """Return the number of the segment that starts at each edge."""
    if len(segments) == len(record.time):  # each interval in one segment
        return np.arange(len(record.time))
    return joining.starts(record.time, event_time, segments)
