"""A record as a list of steps that any filter of the family walks through, and what it made of them as an estimate.

All filters see the same schedule: gyro intervals are split exactly at the times of measurements, measurements at an edge are taken in
before the state at that edge is kept, and large turns are cut into parts of the same constant-rate model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown import mekf
from strapdown.checks import Array, InputError, count
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf import Schedule
from strapdown.records import Estimate, Event, ImuRecord

_UPPER = np.triu_indices(3)

MEASUREMENTS = ("direction", "vector", "heading")
"""Kinds of measurement that every filter of the family takes."""


@dataclass(frozen=True, kw_only=True)
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


def events_and_steps(record: ImuRecord, every: int) -> tuple[Schedule, Steps]:
    """Return the measurements of a record in their order, and the steps that take a filter through it.

    Parameters
    ----------
    record : ImuRecord
        Measurements of the kinds :data:`MEASUREMENTS`.
    every : int
        Keep the state at every ``every``-th edge, the first included.
    """
    count("every", every)
    for series in record.vectors:
        if series.kind not in MEASUREMENTS:
            raise InputError(
                f"{series.sensor}: the family's filters take {', '.join(MEASUREMENTS)}, not {series.kind!r}; use mekf.run"
            )
        if series.anisotropic:
            raise InputError(
                f"{series.sensor}: the family's filters take one sigma a sample, not sigma_axes or covariance; give sigma alone, or use "
                "mekf.run"
            )
    edges = record.time
    events = mekf.schedule(record.vectors, edges[0], edges[-1])
    time = np.concatenate([events.time, edges])
    is_edge = np.repeat([0, 1], [len(events.time), len(edges)])
    order = np.lexsort((is_edge, time))  # at one time the events come first
    index = np.concatenate([np.arange(len(events.time)), np.arange(len(edges))])[order]
    is_edge = is_edge[order].astype(bool)
    time = time[order]
    dt = np.diff(time, prepend=edges[0])
    interval = np.clip(np.searchsorted(edges, time, side="left") - 1, 0, None)
    increment = record.increments[interval] * (dt / np.diff(edges)[interval])[:, None]
    event = np.where(is_edge, -1, index)
    row = np.where(is_edge & (index % every == 0), index // every, -1)
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
    return Estimate(
        time=steps.time,
        attitude=states[:, :4],
        bias=states[:, 4:7],
        variance=np.diagonal(covariance, axis1=1, axis2=2).copy(),
        covariance=covariance if full_covariance else None,
        innovations=mekf.innovations_by_sensor(events, innovation),
        skipped=events.skipped,
        events=steps.gaps,
    )
