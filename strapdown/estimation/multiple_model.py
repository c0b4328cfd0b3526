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

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from strapdown import estimation, kinematics, quaternion, records, vectors
from strapdown.checks import Array, InputError, count
from strapdown.estimation import forward
from strapdown.estimation.forward import Problem
from strapdown.estimation.schedule import Schedule, joined, selected
from strapdown.estimation.states import ProcessNoise, State, initial_state
from strapdown.kernels import measurement
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
BLOCK = 256
"""Number of gyro intervals that each hypothesis runs over before improbable ones are dropped."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BankEstimate:
    """Estimate of a bank of hypotheses, with the time at which they were merged into one.

    Parameters
    ----------
    estimate : Estimate
        Mean and covariance of the mixture at the stored edges from the first direction on; after the hypotheses were merged into one,
        those of the plain filter. Innovations until then are those of the hypothesis with the largest weight.
    weights : ndarray (k, h)
        Weights of the hypotheses at the first k rows, until they were merged into one.
    became_one : float
        Time at which the hypotheses were merged into one, s; infinite if several were left at the end.
    reason : str
        Why several were left, and what would help; empty if they were merged into one.
    """

    estimate: Estimate
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
        Standard deviation of the initial bias about zero, rad/s.
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
    initial = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=bias_sigma)
    count("hypotheses", hypotheses, minimum=8)
    count("every", every)
    events = forward.prepared(record, process_noise, initial, ()).events
    stored = record.time[::every]
    first = _first_direction(events, min(stored[-1], np.nextafter(record.time[-1], 0.0)))
    began = events.time[first]
    states, rest = start(events, first, initial, hypotheses), _after(record, began, int(events.sensor[first]))
    stored = stored[stored >= began]
    log_weight, merged = np.zeros(len(states)), False
    estimates: list[Estimate] = []
    weights: list[Array] = []
    # Each block ends at a stored edge, at which improbable hypotheses are dropped.
    ends = np.searchsorted(rest.time, stored[:: max(BLOCK // every, 1)])
    for begin, end in pairwise(np.unique([0, *ends, len(rest.increments)]).tolist()):
        part = records.cut(rest, begin, end)
        estimate, weight, merged = _advance(part, process_noise, stored, states, log_weight)
        weights.append(weight[len(estimates) > 0 :])  # the first row is the last of the block before
        estimates.append(estimate)
        if merged:
            break
    skipped = dict(events.skipped)
    for sensor in events.sensor[:first]:
        skipped[events.sensors[sensor]] += 1
    bank = replace(joined(estimates), skipped=skipped, events=forward.in_order(forward.gaps(record)))
    whole, now = bank, float(bank.time[-1])
    if merged and now < record.time[-1]:
        assert bank.covariance is not None
        state = State(attitude=bank.attitude[-1], bias=bank.bias[-1], covariance=bank.covariance[-1])
        part = _after(rest, now, len(rest.vectors))
        after = estimation.run(part, process_noise, state, every=every, full_covariance=True)
        whole = joined([bank, replace(after, events=())])  # gaps are already included
    return BankEstimate(
        estimate=whole,
        weights=np.concatenate(weights),
        became_one=now if merged else np.inf,
        reason="" if merged else _reason(events, int(np.sum(log_weight > -np.inf)), bank),
    )


def _first_direction(events: Schedule, last: float) -> int:
    """Return the first measurement that is not a heading, at a time up to ``last``."""
    directions = np.flatnonzero(events.kind != measurement.HEADING)
    if len(directions) == 0:
        raise InputError(
            "the record has no direction, vector or attitude within its time to start from; add one: a heading is not enough"
        )
    began = events.time[directions[0]]
    if began > last:
        raise InputError(
            f"the first direction comes at {began:.6g} s, after the last stored edge; store more edges or give a longer record"
        )
    return int(directions[0])


def start(events: Schedule, event: int, initial: State, hypotheses: int) -> list[State]:
    """Return hypotheses from a direction, with the bias of an initial state.

    Across the direction each has the measurement's covariance; about it, a standard deviation of half the spacing, for which the sum of the
    Gaussians is uniform over the circle to 1.5 %. A measured attitude gives a single hypothesis.
    """
    z, frame = events.vector_b[event], events.triads[events.reference[event]]
    noise = events.body_noise[event][[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    if events.kind[event] == measurement.ATTITUDE:
        attitudes = frame[None, :4]
    else:
        z = z / np.linalg.norm(z)
        # Any attitude that maps z onto the reference: the one that maps a triad about it to a triad about the reference.
        q = quaternion.from_matrix(frame.reshape(3, 3).T @ vectors.triad(z))
        angles = 2.0 * np.pi * np.arange(hypotheses) / hypotheses
        attitudes = quaternion.multiply(q, quaternion.exp(np.outer(angles, z)))
        cross = np.cross(np.eye(3), z)
        noise = cross @ noise @ cross.T + (np.pi / hypotheses) ** 2 * np.outer(z, z)
    P = initial.covariance.copy()
    P[:3, :3] = noise
    return [State(attitude=q, bias=initial.bias, covariance=P) for q in attitudes]


def _after(record: ImuRecord, began: float, sensor: int) -> ImuRecord:
    """Return the record from a time on, without the measurements before it and those of sensors up to this one at it."""
    k = int(np.searchsorted(record.time, began, side="right"))
    increments = record.increments[k - 1 :].copy()
    increments[0] *= (record.time[k] - began) / (record.time[k] - record.time[k - 1])
    series = tuple(s.taken((s.time > began) | (s.time == began) & (i > sensor)) for i, s in enumerate(record.vectors))
    return ImuRecord(time=np.append(began, record.time[k:]), increments=increments, vectors=series)


def _advance(
    part: ImuRecord, process_noise: ProcessNoise, stored: Array, states: list[State], log_weight: Array
) -> tuple[Estimate, Array, bool]:
    """Return the mixture at the stored edges of a part of the record, its weights (rows, h), and whether the last row is of a merger.

    ``states`` and ``log_weight`` become those at the end; −∞ is the weight of a dropped hypothesis.
    """
    problem, options = forward.prepared(part, process_noise, states[0], ()), forward.Options(full_covariance=True)
    possible = np.flatnonzero(log_weight > -np.inf)
    passed = {i: forward.filtered(replace(problem, initial=states[i]), options) for i in possible}
    rows = np.flatnonzero(np.isin(part.time, stored))
    time, log_weights = part.time[rows], np.full((len(states), len(rows)), -np.inf)
    for i, each in passed.items():
        log_weights[i] = log_weight[i] + log_likelihood(problem, each.estimate, time)
        states[i] = each.end
    weights = np.exp(log_weights - np.max(log_weights, axis=0))
    weights[weights < MIN_WEIGHT] = 0.0
    weights /= np.sum(weights, axis=0)
    attitude, bias, P, between = mixture([each.estimate for each in passed.values()], rows, weights[possible])
    agreed = np.flatnonzero(np.maximum(share(P, between, slice(0, 3)), share(P, between, slice(3, 6))) < MAX_SHARE)
    end = int(agreed[0]) if len(agreed) else len(rows) - 1
    log_weight[:] = np.where(weights[:, end] > 0.0, log_weights[:, end], -np.inf)
    leader, kept = passed[np.argmax(weights[:, end])].estimate, slice(end + 1)
    estimate = Estimate.from_arrays(time[kept], attitude[kept], P[kept], bias=bias[kept])
    innovations = {sensor: selected(i, i.time <= time[end]) for sensor, i in leader.innovations.items()}
    return replace(estimate, innovations=innovations), weights.T[kept], len(agreed) > 0


def log_likelihood(problem: Problem, estimate: Estimate, time: Array) -> Array:
    """Return the logarithm of the density of all innovations of a hypothesis up to each time, but for a constant."""
    total = np.zeros(len(time))
    for kind, innovations in zip(problem.events.kinds, estimate.innovations.values(), strict=True):
        rows = slice(0, 2 if kind == "vector" else 3)  # a vector's length has no information about the attitude
        e, s = innovations.innovation[:, rows], innovations.variance[:, rows]
        each = -0.5 * np.sum(e * e / s + np.log(s), axis=1)
        total += np.append(0.0, np.cumsum(each))[np.searchsorted(innovations.time, time, side="right")]
    # A reversed direction has the innovation of the right one.
    wrong = 2.0 * math.log(MIN_WEIGHT) * reversed_directions(problem, estimate.attitude)
    total += np.append(0.0, np.cumsum(wrong))[np.searchsorted(problem.events.time, time, side="right")]
    return total


def reversed_directions(problem: Problem, attitude: Array) -> np.ndarray:
    """Return which measurements (events,) are directions more than 90° from their references at attitudes (n, 4) of the edges."""
    events, record = problem.events, problem.record
    k = np.maximum(np.searchsorted(record.time, events.time), 1)
    # The attitude at the edge after the measurement, turned back.
    back = record.increments[k - 1] * ((events.time - record.time[k]) / record.intervals[k - 1])[:, None]
    z = quaternion.rotate(quaternion.multiply(attitude[k], quaternion.exp(back)), events.vector_b)
    directed = (events.kind == measurement.DIRECTION) | (events.kind == measurement.VECTOR)
    return np.asarray(directed & (np.sum(z * events.triads[events.reference, 6:], axis=1) < 0.0))


def mixture(bank: list[Estimate], rows: np.ndarray, weights: Array) -> tuple[Array, Array, Array, Array]:
    """Return the moments of a mixture at rows of its members' estimates: mean attitude and bias, P and its part between the members.

    The mean attitude q̄, Σ w Log(q̄⁻¹ ⊗ q_i) = 0, is that nearest to the hypothesis of the largest weight. Relative to the mean a member is
    at d_i = Log(q̄⁻¹ ⊗ q_i), b_i − b̄; its covariance is transformed by G_i = J_r⁻¹(d_i): ``P = Σ w_i (G_i P_i G_iᵀ + d_i d_iᵀ)``.
    """
    attitudes, biases = (np.array([getattr(each, name)[rows] for each in bank]) for name in ("attitude", "bias"))
    mean = attitudes[np.argmax(weights, axis=0), np.arange(len(rows))]
    for _ in range(20):
        away = quaternion.rotation_between(mean, attitudes)
        shift = np.einsum("hr,hri->ri", weights, away)
        mean = quaternion.normalize(quaternion.multiply(mean, quaternion.exp(shift)))
        if np.abs(shift).max() < 1e-12:
            break
    mean_bias = np.einsum("hr,hri->ri", weights, biases)
    d = np.concatenate([away, biases - mean_bias], axis=-1)
    between = np.einsum("hr,hri,hrj->rij", weights, d, d)
    P = np.array([np.asarray(each.covariance)[rows] for each in bank])
    G = np.linalg.inv(kinematics.right_jacobian(away))
    P[..., :3, :] = G @ P[..., :3, :]
    P[..., :, :3] = P[..., :, :3] @ np.swapaxes(G, -1, -2)
    return mean, mean_bias, np.einsum("hr,hrij->rij", weights, P) + between, between


def share(P: Array, between: Array, block: slice) -> Array:
    """Return tr(P⁻¹ S) of a block of three states (rows,): the fraction of P due to differences, summed over the axes."""
    return np.asarray(np.trace(np.linalg.solve(P[:, block, block], between[:, block, block]), axis1=1, axis2=2))


def _reason(events: Schedule, left: int, estimate: Estimate) -> str:
    """Return why the hypotheses were not merged, as text for the user."""
    assert estimate.covariance is not None
    values, axes = np.linalg.eigh(estimate.covariance[-1, :3, :3])
    axis = quaternion.rotate(estimate.attitude[-1], axes[:, -1])
    references: Array = np.asarray(events.triads)[events.reference[events.kind != measurement.ATTITUDE]][:, 6:]
    turned = np.arcsin(min(np.max(np.linalg.norm(np.cross(references, references[0]), axis=1)), 1.0))
    if turned < CONSTANT:
        cause = "all references lie along one line of the fixed frame, and the rotation about it cannot be observed, however the body moves"
        remedy = "add a sensor of another direction, or record until the reference has rotated"
    else:
        cause = f"the references differ by up to {turned / DEGREE:.3g}°, which has not separated the hypotheses yet"
        remedy = "record longer, or add a sensor of another direction"
    return (
        f"{left} hypotheses are still possible at {estimate.time[-1]:.6g} s; the rotation about the fixed axis "
        f"({axis[0]:+.2f}, {axis[1]:+.2f}, {axis[2]:+.2f}) is known to 1σ {np.sqrt(values[-1]) / DEGREE:.3g}°: {cause}; {remedy}"
    )
