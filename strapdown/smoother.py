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
from strapdown.kernels import smoother_loop
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf import ProcessNoise, State
from strapdown.records import Estimate, ImuRecord
from strapdown.robustness import Gate, Robust

STAMP_TOLERANCE = 1e-6
"""Of the mean gyro interval: an edge that lies beyond t + lag by no more is taken for one at t + lag."""

MOST_GROUPS = 4096
"""Groups of segments of which the fixed-lag smoother keeps the gains, 5 kB each; where a lag takes more, it computes them anew."""


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
    for every edge, though the gains are computed once. ``lag`` in s; 0 is the filter, the length of the record or more is :func:`run`.
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
    slack = STAMP_TOLERANCE * (record.time[-1] - record.time[0]) / (edges - 1)
    until = np.searchsorted(record.time, record.time + (lag + slack), side="right") - 1
    # One pass for each edge that does not see the end of the record, then one for all that do.
    whole = int(np.searchsorted(until, edges - 1))
    attitude, bias, variance = np.empty((edges, 4)), np.empty((edges, 3)), np.empty((edges, 6))
    blocks = np.empty((edges if full_covariance else 0, 21))
    first, last = np.arange(whole + 1), until[: whole + 1]
    # One pass needs three groups at a time; of several, each shares nearly all with the next.
    groups = 3 if whole == 0 else int(np.max(starts[last] - starts[first])) // WIDTH + 3
    compiled(smoother_loop.smooth_back)(
        segments.reshape(-1),
        starts,
        first,
        last,
        process_noise.angle_random_walk**2,
        process_noise.rate_random_walk**2,
        np.empty(smoother_loop.work_size(min(groups, MOST_GROUPS))),
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


def _most_segments(record: ImuRecord, events: int) -> int:
    """Return a bound of the number of segments: one an interval and an event, and the sub-steps of large turns."""
    squared = np.einsum("ij,ij->i", record.increments, record.increments)
    large = squared[squared > LARGEST_ANGLE**2]
    return len(record.increments) + events + int(np.sum(np.floor(np.sqrt(large) / LARGEST_ANGLE) + 1.0))


def _filtered(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> tuple[Estimate, Array, np.ndarray]:
    """Run the filter and keep its segments; return its estimate, the segments with the end state, and the segment of each edge."""
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    forward, _, segments = mekf.run_events(
        record,
        events,
        process_noise,
        initial,
        every=len(record.time),
        full_covariance=False,
        segments=_most_segments(record, len(events.time)),
        gate=gate,
        robust=robust,
    )
    for event in forward.events:
        if event.kind == "recovery":
            raise InputError(
                f"the filter lost its way and recovered at {event.end:.9g} s, where the trajectory breaks; smooth the parts before "
                f"and after {event.start:.9g} s on their own (strapdown.records.cut)"
            )
    starts = np.empty(len(record.time), np.int64)
    compiled(smoother_loop.locate_edges)(record.time, events.time, segments, len(segments) - 1, starts)
    if len(segments) < smoother_loop.FEWEST_ROWS:
        segments = np.concatenate([segments, np.tile(segments[-1], (smoother_loop.FEWEST_ROWS - len(segments), 1))])
    return forward, segments, starts
