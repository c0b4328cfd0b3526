"""Attitude from an unknown start, one vector at a time: a bank of hypotheses that is reduced to one filter.

A measured direction leaves the rotation about it undetermined: the attitudes that map the first direction onto its reference form a circle.
Hypotheses spread evenly over it, each a filter whose covariance covers its part of the circle, together cover every possible attitude. They
are weighted by the innovations of the following measurements (multiple-model estimation: Magill 1965, IEEE Trans. Automatic Control 10);
improbable ones are dropped, and when the others agree, their mixture is replaced by one Gaussian with the same moments, with which the
plain filter (:mod:`strapdown.estimation`) continues.

If the measurements do not distinguish the hypotheses, several remain, and :attr:`BankEstimate.reason` gives the cause. A single filter from
an arbitrary start would have converged to some attitude with a small σ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from strapdown import estimation, quaternion, records, vectors
from strapdown.checks import Array, InputError, count
from strapdown.estimation import forward
from strapdown.estimation.forward import Problem
from strapdown.estimation.schedule import Schedule, innovations_by_sensor, joined
from strapdown.estimation.states import ProcessNoise, State, initial_state
from strapdown.kernels import hypotheses as kernel
from strapdown.kernels import measurement, structure
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.walk import walk
from strapdown.records import Estimate, ImuRecord
from strapdown.units import DEGREE, DEGREE_PER_HOUR

__all__ = ["BankEstimate", "run"]

HYPOTHESES = 96
"""Default number of hypotheses on the circle: 3.75° apart. Fewer find the attitude as soon, but some have too small a covariance:
``sims/unknown_start.py``."""
MIN_WEIGHT = 1e-6
"""Minimum weight of a hypothesis, relative to the largest; below it the hypothesis is dropped."""
MAX_SHARE = 0.15
"""Maximum fraction of the mixture's covariance due to the distance of the hypotheses at which they are merged into one Gaussian."""
CONSTANT = 1.0 * DEGREE
"""Maximum rotation of the references over a record at which they count as constant, rad."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BankEstimate:
    """Estimate of a bank of hypotheses, with the time at which they were merged into one.

    Parameters
    ----------
    estimate : Estimate
        Mean and covariance of the mixture at the stored edges from the first direction on; after the hypotheses were merged into one,
        those of the plain filter. Innovations are those of the hypothesis with the largest weight until then.
    edges : ndarray of int (m,)
        Indices of the record's edges for the rows of ``estimate``: their times are ``record.time[edges]``, s, and their true attitudes
        ``record.truth.attitude[edges]``.
    angles : ndarray (h,)
        Initial position of the hypotheses on their circle, rad: the rotation about the first reference relative to the first of
        them.
    weights : ndarray (k, h)
        Weights of the hypotheses at the first k rows, until they were merged into one.
    became_one : float
        Time at which the hypotheses were merged into one, s; infinite if several were left at the end.
    reason : str
        Why several were left, and what would help; empty if they were merged into one.
    """

    estimate: Estimate
    edges: np.ndarray
    angles: Array
    weights: Array
    became_one: float
    reason: str

    @property
    def converged(self) -> bool:
        """Whether the hypotheses were merged into one Gaussian."""
        return bool(np.isfinite(self.became_one))


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    *,
    hypotheses: int = HYPOTHESES,
    bias_sigma: ArrayLike = 20.0 * DEGREE_PER_HOUR,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    every: int = 1,
) -> BankEstimate:
    """Estimate attitude and gyro bias from an unknown initial attitude.

    Measurements before the first direction (or vector, or attitude) are omitted and counted as skipped. Outliers are not expected: among
    them the weights of the hypotheses become too certain.

    Parameters
    ----------
    record : ImuRecord
        Record with increments corrected for coning (:func:`strapdown.records.compress`) and at least one direction, vector or attitude.
    process_noise : ProcessNoise
        Angle random walk and rate random walk of the gyro, as the filter models them.
    hypotheses : int, default 96
        Number of initial attitudes on the circle about the first direction, at least 8. The computing time is proportional to it.
    bias_sigma : float or array_like (3,), default 20 °/h
        Standard deviation of the initial bias error, rad/s.
    bias : array_like (3,), default zero
        Initial bias, rad/s, body axes.
    every : int, default 1
        Store every n-th edge; hypotheses are merged into one only at stored edges.

    Returns
    -------
    BankEstimate
        Estimate from the first direction on, and the hypotheses with their weights.

    Raises
    ------
    InputError
        If the record has no direction, vector or attitude, or an argument is out of range.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 11.6 (multiple models).
    """
    initial = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=bias_sigma, bias=bias)
    count("hypotheses", hypotheses, minimum=8)
    problem = forward.prepared(record, process_noise, initial, ())
    merged = _until_merged(problem, hypotheses, count("every", every))
    if merged.became_one >= record.time[-1]:
        return merged
    rest, state = _from_where_merged(record, merged)
    after = estimation.run(rest, process_noise, state, every=every, full_covariance=True)
    # Gaps are already included.
    return replace(merged, estimate=joined([merged.estimate, replace(after, events=())]))


def _from_where_merged(record: ImuRecord, merged: BankEstimate) -> tuple[ImuRecord, State]:
    """Return the record from the time of the merger on, and the state there."""
    rest = records.cut(record, int(np.searchsorted(record.time, merged.became_one)), len(record.time) - 1)
    # The bank has processed the measurements at that edge, which `cut` assigns to the first part of a record.
    rest = replace(rest, vectors=tuple(series.taken(series.time > merged.became_one) for series in rest.vectors))
    last = merged.estimate
    assert last.covariance is not None
    return rest, State(attitude=last.attitude[-1], bias=last.bias[-1], covariance=last.covariance[-1])


def _until_merged(problem: Problem, hypotheses: int, every: int) -> BankEstimate:
    """Return the bank's part of :func:`run`: until the hypotheses are merged, or to the end."""
    record, events = problem.record, problem.events
    directions = np.flatnonzero(events.kind != measurement.HEADING)
    if len(directions) == 0:
        raise InputError(
            "the record has no direction, vector or attitude within its time to start from; add one: a heading is not enough"
        )
    first = int(directions[0])
    began = events.time[first]
    stored = record.time[::every]
    if began > stored[-1]:
        raise InputError(
            f"the first direction comes at {began:.6g} s, after the last stored edge; store more edges or give a longer record"
        )
    x, P, angles = start(problem, first, hypotheses)
    # The walk begins at the last stored edge before the first direction, with empty intervals until the direction.
    k = int(np.searchsorted(record.time, began, side="right")) - 1
    edge = k - k % every
    edges, increments = record.time[edge:].copy(), record.increments[edge:].copy()
    increments[k - edge] *= (edges[k - edge + 1] - began) / (edges[k - edge + 1] - edges[k - edge])
    first_row = int(edges[0] < began)
    np.maximum(edges, began, out=edges)
    rows, weight = (len(edges) - 1) // every + 1, np.empty(len(x))
    shapes = (rows, 7), (rows, 6, 6), (6, 6), (rows, len(x)), (len(events.time), 6)
    out = kernel.Outputs._make(np.empty(shape) for shape in shapes)
    body = kernel.Body(
        form=filter_form(problem, x, P),
        log_weight=np.zeros(len(x)),
        weight=weight,
        options=forward.gate_options(None, None),
        min_weight=MIN_WEIGHT,
        max_share=MAX_SHARE,
        first_row=first_row,
    )
    measured = forward.measurements_in_body_axes(events, first + 1)
    kernels = forward.instance_of(forward.ANY_SENSOR)
    rows, ended, used = compiled(walk, kernel, kernels)(
        read_only(edges), read_only(increments), measured, every, body, out
    )
    processed = np.zeros(len(events.time), bool)
    processed[events.row[first + 1 : first + 1 + used]] = True
    before = np.bincount(events.sensor[:first], minlength=len(events.sensors)).tolist()
    x, P, weights = (values[first_row:rows] for values in (out.x, out.P, out.weights))
    estimate = Estimate(
        time=record.time[edge::every][first_row:rows],
        attitude=x[:, :4],
        bias=x[:, 4:],
        variance=np.diagonal(P, axis1=1, axis2=2).copy(),
        covariance=P,
        innovations=innovations_by_sensor(events, out.innovation, None, processed),
        skipped={name: events.skipped[name] + number for name, number in zip(events.sensors, before, strict=True)},
        events=forward.in_order(forward.gaps(record)),
    )
    merged = ended == kernel.MERGED
    return BankEstimate(
        estimate=estimate,
        edges=np.arange(0, len(record.time), every)[stored >= began],
        angles=angles,
        weights=weights,
        became_one=float(estimate.time[-1]) if merged else np.inf,
        reason="" if merged else _reason(record, events, weight, estimate),
    )


def filter_form(problem: Problem, x: Array, P: Array) -> structure.Body:
    """Return hypotheses (h, 7) with covariances (h, 6, 6) as the states of a filter, and one more as the kernel's work space."""
    form = forward.filter_body(forward.with_any_sensor(problem), {})
    padded = np.zeros((len(x) + 1, 6, forward.instance_of(forward.ANY_SENSOR).WIDTH_OF_ROW))
    padded[:-1, :, :6] = P
    return form._replace(x=np.append(x, np.zeros((1, 7)), axis=0), P=padded.reshape(len(padded), -1))


def start(problem: Problem, event: int, hypotheses: int) -> tuple[Array, Array, Array]:
    """Return hypotheses from a direction: attitudes and biases (h, 7), covariances (h, 6, 6), and angles on the circle (h,), rad.

    Across the direction each has the measurement's covariance; about it, a standard deviation of half the spacing, for which the sum of the
    Gaussians is uniform over the circle to 1.5 %. A measured attitude gives a single hypothesis.
    """
    events, initial = problem.events, problem.initial
    z, frame = events.vector_b[event], events.triads[events.reference[event]]
    noise = np.zeros((3, 3))
    noise[np.triu_indices(3)] = events.body_noise[event]
    noise = np.triu(noise) + np.triu(noise, 1).T
    if events.kind[event] == measurement.ATTITUDE:
        attitudes, angles = frame[None, :4], np.zeros(1)
    else:
        z = z / np.linalg.norm(z)
        angles = 2.0 * np.pi * np.arange(hypotheses) / hypotheses
        # Any attitude that maps z onto the reference: the one that maps a triad about it to a triad about the reference.
        q = quaternion.from_matrix(frame.reshape(3, 3).T @ vectors.triad(z))
        attitudes = quaternion.multiply(q, quaternion.exp(angles[:, None] * z))
        cross = np.cross(np.eye(3), z)
        noise = cross @ noise @ cross.T + (np.pi / hypotheses) ** 2 * np.outer(z, z)
    P = np.zeros((len(angles), 6, 6))
    P[:, :3, :3], P[:, 3:, 3:] = noise, initial.covariance[3:, 3:]
    x = np.concatenate([attitudes, np.broadcast_to(initial.bias, (len(angles), 3))], axis=1)
    return x, P, angles


def _reason(record: ImuRecord, events: Schedule, weight: Array, estimate: Estimate) -> str:
    """Return why the hypotheses were not merged, as text for the user."""
    assert estimate.covariance is not None
    values, axes = np.linalg.eigh(estimate.covariance[-1, :3, :3])
    axis = quaternion.rotate(estimate.attitude[-1], axes[:, -1])
    measured = (
        f"{int(np.sum(weight > 0.0))} hypotheses are still possible after {record.time[-1] - record.time[0]:.6g} s; "
        f"the rotation about the fixed axis ({axis[0]:+.2f}, {axis[1]:+.2f}, {axis[2]:+.2f}) is known to 1σ "
        f"{np.sqrt(values[-1]) / DEGREE:.3g}°"
    )
    references: Array = np.asarray(events.triads)[events.reference[events.kind != measurement.ATTITUDE]][:, 6:]
    apart = float(np.max(np.linalg.norm(np.cross(references, references[0]), axis=1)))
    turned = float(np.arcsin(min(apart, 1.0)))
    if turned < CONSTANT:
        return (
            f"{measured}: all references lie along one line of the fixed frame, and the rotation about it cannot be observed, however the "
            "body moves; add a sensor of another direction, or record until the reference has rotated"
        )
    return (
        f"{measured}: the references differ by up to {turned / DEGREE:.3g}°, which has not separated the hypotheses yet; record longer, or "
        "add a sensor of another direction"
    )
