"""A record as a list of steps that any filter of the family walks through, and what it made of them as an estimate.

All filters see the same schedule: gyro intervals are split exactly at the times of measurements, measurements at an edge are taken in
before the state at that edge is kept, and large turns are cut into parts of the same constant-rate model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown import mekf
from strapdown.checks import Array, count
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf import Schedule
from strapdown.mekf.states import check_arguments
from strapdown.records import Estimate, Event, ImuRecord


@dataclass(frozen=True, kw_only=True, eq=False)
class Steps:
    """Each step predicts over ``dt`` if that is greater than zero, then takes in an event if it has one, then keeps the state if asked."""

    dt: Array
    """s (k,)."""
    increment: Array
    """Integral of the measured rate over dt (k, 3), rad."""
    event: np.ndarray
    """Index of the measurement taken in, -1: none."""
    row: np.ndarray
    """Row of the estimate that the state goes to, -1: none."""
    time: Array
    """Times of the rows (m,), s."""
    gaps: tuple[Event, ...]
    """Gaps of the gyro."""


def check(record: object, process_noise: object, initial: object) -> None:
    """Refuse what a filter is given in place of the objects that it wants."""
    check_arguments(record=record, process_noise=process_noise, initial=initial)


def events_and_steps(record: ImuRecord, every: int) -> tuple[Schedule, Steps]:
    """Return the measurements of a record in their order, and the steps that take a filter through it.

    Parameters
    ----------
    record : ImuRecord
        Measurements of any kind and noise.
    every : int
        Keep the state at every ``every``-th edge, the first included.
    """
    count("every", every)
    edges = record.time
    events = mekf.schedule(record.vectors, edges[0], edges[-1], anisotropic=True)
    # Both are in order already; at one time the events come first.
    at_event = np.arange(len(events.time)) + np.searchsorted(edges, events.time, side="left")
    at_edge = np.arange(len(edges)) + np.searchsorted(events.time, edges, side="right")
    time = np.empty(len(at_event) + len(at_edge))
    time[at_event], time[at_edge] = events.time, edges
    event, row = np.full(len(time), -1), np.full(len(time), -1)
    event[at_event] = np.arange(len(at_event))
    row[at_edge[::every]] = np.arange(len(at_edge[::every]))
    interval = np.empty(len(time), np.int64)
    interval[at_event] = np.maximum(at_event - np.arange(len(at_event)) - 1, 0)
    interval[at_edge] = np.maximum(np.arange(len(edges)) - 1, 0)
    dt = np.diff(time, prepend=edges[0])
    increment = record.increments[interval] * (dt / np.diff(edges)[interval])[:, None]
    # Parts of a large turn end in steps that neither take in nor keep anything; the last part does.
    parts = (np.linalg.norm(increment, axis=1) / LARGEST_ANGLE).astype(np.int64) + 1
    whole = np.repeat(np.arange(len(dt)), parts)
    last = np.append(whole[1:] != whole[:-1], True)
    steps = Steps(
        dt=dt[whole] / parts[whole],
        increment=np.ascontiguousarray(increment[whole] / parts[whole, None]),
        event=np.where(last, event[whole], -1),
        row=np.where(last, row[whole], -1),
        time=edges[::every],
        gaps=tuple(mekf.gaps(edges)),
    )
    return events, steps


def estimate(events: Schedule, steps: Steps, states: Array, innovation: Array, full_covariance: bool) -> Estimate:
    """Return the estimate of packed states (m, 28), body side, and innovations (events, 6): e₁, s₁, e₂, s₂, e₃, s₃."""
    covariance = mekf.covariance_matrices(states[:, 7:])
    innovations = mekf.innovations_by_sensor(events, innovation)
    return Estimate(
        time=steps.time,
        attitude=states[:, :4],
        bias=states[:, 4:7],
        variance=np.diagonal(covariance, axis1=1, axis2=2).copy(),
        covariance=covariance if full_covariance else None,
        innovations=innovations,
        skipped=mekf.skipped_too(events, innovations),
        events=steps.gaps,
    )
