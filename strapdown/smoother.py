"""Smoother: attitude and gyro bias at each edge from the measurements before *and after* it.

A Rauch–Tung–Striebel smoother on the manifold (Rauch, Tung & Striebel 1965; Särkkä 2013, section 8.2), over the states that the filter
of :mod:`strapdown.mekf` passed through. The filter moves its attitude at each correction and carries its covariance along, so every
covariance has a tangent space of its own; the backward pass carries them from one to the next by the Jacobians of the rotation vector
(:mod:`strapdown.kernels.smoother_step`). To first order in the errors this is the least-squares estimate over the whole record.
"""

from __future__ import annotations

import numpy as np

from strapdown import mekf
from strapdown.checks import Array, InputError, non_negative
from strapdown.kernels import smoother_lag, smoother_loop
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf import ProcessNoise, State
from strapdown.mekf.memory import side_by_side
from strapdown.records import Estimate, ImuRecord
from strapdown.robustness import Gate, Robust

STAMP_TOLERANCE = 1e-6
"""Of the mean gyro interval: an edge that lies beyond t + lag by no more is taken for one at t + lag."""

MOST_GROUPS = 3600
"""Groups of segments of which the fixed-lag smoother keeps the gains, 5.7 kB each; where a lag takes more, it computes them anew."""

MOST_CUT = 64
"""Times the segments that a record takes by its increments: a filter that takes more is lost."""


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

    Raises
    ------
    InputError
        If the filter had to recover: the states before and after it are not one trajectory. The message says where to cut the record.

    Returns
    -------
    Estimate
        Attitude, bias and variance are smoothed; those at the last edge are the filter's. The innovations are the filter's.
        Memory for the filter's states: 256 bytes a gyro interval and a measurement.
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
    initial: State,
    lag: float,
    full_covariance: bool,
    gate: Gate | None,
    robust: Robust | None,
) -> Estimate:
    forward, segments, starts = _filtered(record, process_noise, initial, gate, robust)
    edges = len(record.time)
    first, last = _passes(record.time, lag)
    shapes = (edges, 4), (edges, 3), (edges, 6), (edges if full_covariance else 0, 21)
    attitude, bias, variance, blocks = side_by_side(*((shape, float) for shape in shapes))
    variances = process_noise.angle_random_walk**2, process_noise.rate_random_walk**2
    rows = segments.reshape(-1)
    if len(first):
        # Eight passes at a time, which share nearly all groups with the next eight.
        ahead = np.minimum(np.arange(len(first)) + WIDTH - 1, len(first) - 1)
        groups = int(np.max(starts[last[ahead]] - starts[first])) // WIDTH + 2
        compiled(smoother_lag.smooth_lagged)(
            rows,
            starts,
            first,
            last,
            *variances,
            np.empty(smoother_lag.lag_work_size(min(groups, MOST_GROUPS))),
            attitude,
            bias,
            variance,
            blocks,
        )
    compiled(smoother_loop.smooth_back)(
        rows,
        starts,
        len(first),
        *variances,
        np.empty(smoother_loop.WORK_SIZE),
        attitude,
        bias,
        variance,
        blocks,
    )
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


def _passes(time: Array, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges that do not see the end of the record, and of each the last that it sees."""
    last = len(time) - 1
    slack = STAMP_TOLERANCE * (time[-1] - time[0]) / last
    if time[0] + lag + slack >= time[-1]:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    until = np.searchsorted(time, time + (lag + slack), side="right") - 1
    count = int(np.searchsorted(until, last))
    return np.arange(count), until[:count]


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
    initial: State,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> tuple[Estimate, Array, np.ndarray]:
    """Run the filter and keep its segments; return its estimate, the segments with the end state, and the segment of each edge."""
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    usual = most = _most_segments(record, int(events.bounds[-1]))
    while True:
        # One more than it should take, which tells whether it took more.
        forward, _, segments = mekf.run_events(
            record,
            events,
            process_noise,
            initial,
            every=len(record.time),
            full_covariance=False,
            segments=most + 1,
            gate=gate,
            robust=robust,
        )
        number = len(segments) - 1
        if number <= most:
            break
        # Steps are cut by the turn without the bias, which is known only when they are taken.
        most *= 4
        if most > MOST_CUT * usual:
            raise InputError(
                "the filter lost its way: by the bias that it found the body turns many times round in each gyro interval; "
                "look at the record and the start with mekf.run first"
            )
    for event in forward.events:
        if event.kind == "recovery":
            raise InputError(
                f"the filter lost its way and recovered at {event.end:.9g} s, where the trajectory breaks; smooth the parts before "
                f"and after {event.start:.9g} s on their own (strapdown.records.cut)"
            )
    if number == len(record.increments):  # each interval in one segment
        starts = np.arange(len(record.time))
    else:
        starts = np.empty(len(record.time), np.int64)
        compiled(smoother_loop.locate_edges)(record.time, events.time, segments, number, starts)
    if len(segments) < smoother_loop.FEWEST_ROWS:
        segments = np.concatenate([segments, np.tile(segments[-1], (smoother_loop.FEWEST_ROWS - len(segments), 1))])
    return forward, segments, starts
