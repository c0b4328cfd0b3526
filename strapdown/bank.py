"""Unknown attitude, one vector at a time: a bank of hypotheses that becomes one filter.

A measured direction leaves one thing open: the turn about it. The attitudes that map the first direction on its reference are a circle;
hypotheses spread evenly over it, each a filter with the covariance that fills its part of the circle, cover every attitude whatever the
start. The innovations of the measurements that follow weigh them (multiple-model estimation: Magill 1965, IEEE Trans. Automatic Control
10); the improbable are dropped, and when those left lie on top of each other their mixture is matched by one Gaussian, which the plain
filter (:mod:`strapdown.mekf`) takes over.

Where nothing tells the hypotheses apart they stay apart, and :attr:`BankEstimate.reason` says why. A single filter from a wild start
would have settled on some attitude and been sure of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from strapdown import mekf, quaternion, records, vectors
from strapdown.checks import Array, InputError, array, count, positive
from strapdown.kernels import bank_loop, filter_loop, robust_step
from strapdown.kernels.machine import compiled
from strapdown.mekf import ProcessNoise, Schedule, State, covariance_matrices, pack
from strapdown.records import Estimate, Event, ImuRecord, Innovations
from strapdown.robustness import Gate, Monitor, Robust
from strapdown.units import DEGREE, DEGREE_PER_HOUR
from strapdown.vectors import VectorMeasurements

HYPOTHESES = 96
"""Hypotheses on the circle where nobody says: 3.75° apart. Fewer find the attitude as soon, but are some too sure of it:
``sims/unknown_start.py``."""
LEAST_WEIGHT = 1e-6
"""A hypothesis of less than this part of the heaviest one's weight is dropped."""
LARGEST_SHARE = 0.15
"""Hypotheses are one Gaussian when less than this part of its covariance lies between them."""
WARY = (10.0, 10.0, 5.0, 5.0, 3.0, 3.0, 2.0, 2.0)
"""Where outliers are reckoned with, the σ of the first directions is taken so many times as large: until a few agree nothing tells which of
them lie off, and one that is believed too early has all that follow refused."""
CONSTANT = 1.0 * DEGREE
"""References that turn by less than this over a record count as constant, rad."""


@dataclass(frozen=True, kw_only=True)
class BankEstimate:
    """What the bank made of a record."""

    estimate: Estimate
    """The Gaussian of the mixture's mean and covariance (whole) at the kept edges from the first direction on; once the hypotheses are
    one, the plain filter's. Innovations are those of the heaviest hypothesis until then."""
    edges: np.ndarray
    """Which edges of the record the rows of ``estimate`` belong to (m,): its truth there is ``record.truth.attitude[edges]``."""
    angles: Array
    """Where the hypotheses started on the circle (h,), rad: the turn about the first reference from the first of them."""
    weights: Array
    """Weights of the hypotheses (k, h) at the first k rows, until they became one."""
    became_one: float
    """Time at which the hypotheses became one, s; infinite if they did not."""
    reason: str
    """Why they did not, and what would help; empty if they did."""

    @property
    def converged(self) -> bool:
        """Whether one Gaussian stands for all that is known of the attitude."""
        return bool(np.isfinite(self.became_one))

    @property
    def left(self) -> int:
        """Hypotheses left at the end of the bank's part."""
        return int(np.sum(self.weights[-1] > 0.0))


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    *,
    hypotheses: int = HYPOTHESES,
    bias_sigma: ArrayLike = 20.0 * DEGREE_PER_HOUR,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    every: int = 1,
    least_weight: float = LEAST_WEIGHT,
    largest_share: float = LARGEST_SHARE,
    gate: Gate | None = None,
    robust: Robust | None = None,
    monitor: Monitor | None = None,
) -> BankEstimate:
    """Estimate attitude and gyro bias from an unknown start.

    Measurements before the first direction (or vector, or attitude) are left out and counted as skipped. Until the hypotheses are one, a
    noise that differs by body axis (``sigma_axes``, ``covariance``) is taken for its largest σ about every axis; then it is what it is.

    Parameters
    ----------
    record : ImuRecord
        Increments corrected for coning (:func:`strapdown.records.compress`), measurements of any kind, at least one of them a direction.
    process_noise : ProcessNoise
    hypotheses : int
        Attitudes on the circle, 8 or more. More of them cost time in proportion and are each closer to linear.
    bias_sigma : float or (3,)
        Standard deviation of the initial bias error, rad/s.
    bias : (3,)
        Initial bias, rad/s.
    every : int
        Keep every ``every``-th edge; the hypotheses can become one at kept edges.
    least_weight : float
        Hypotheses of less than this part of the heaviest one's weight are dropped.
    largest_share : float
        The hypotheses are one when less than this part of the covariance lies between them.
    gate : Gate, optional
        Each hypothesis refuses what no right filter would see; what it refuses counts against it as if it lay at the threshold. When
        most of them have refused ``recovery`` measurements in a row, the bank starts anew from the first of these, and an event says so.
        Once the hypotheses are one, it is the gate of :func:`strapdown.mekf.run`.
    robust : Robust, optional
        Each hypothesis weighs measurements by how far they lie off, and hypotheses are weighed by likelihoods with heavier tails. Alone it
        cannot recover where the first measurements mislead it: give a gate too.
    monitor : Monitor, optional
        Report when the running NIS leaves its bounds, once the hypotheses are one.

    With a gate or a robust update the first directions, which nothing can vouch for yet, are given ``WARY`` times their σ: the estimate is
    too modest until there have been so many.

    Raises
    ------
    InputError
        If the record has no direction at all, or an argument makes no sense.
    """
    count("hypotheses", hypotheses, least=8)
    count("every", every)
    for name, value in (("least_weight", least_weight), ("largest_share", largest_share)):
        if not 0.0 < value < 1.0:
            raise InputError(f"{name} is {value:g}; it must lie between 0 and 1")
    coarse = tuple(_isotropic(series) for series in record.vectors)
    events = mekf.schedule(coarse, record.time[0], record.time[-1])
    doubted = gate is not None or robust is not None
    recovery = None if gate is None else gate.recovery
    told = mekf.gaps(record.time)
    first = _first_direction(events)
    while True:
        vector_b, variance = _wary(events, first) if doubted else (events.vector_b, events.variance)
        sigma_factor = WARY[0] if doubted else 1.0
        states, angles = start(
            record, events, first, hypotheses, bias=bias, bias_sigma=bias_sigma, sigma_factor=sigma_factor
        )
        began = float(events.time[first])
        kept = np.arange(0, len(record.time), every)
        kept = kept[record.time[kept] >= began]
        if len(kept) == 0:
            raise InputError(
                f"the first direction comes at {began:.6g} s, after the last kept edge; keep more edges or give a longer record"
            )
        number = len(states)
        attitude, estimated_bias = np.empty((len(kept), 4)), np.empty((len(kept), 3))
        blocks, weights = np.empty((len(kept), 21)), np.empty((len(kept), number))
        innovation, share = np.empty((len(events.time), 6)), np.empty(len(events.time))
        rows, at, used = compiled(bank_loop.run_bank)(
            record.time,
            np.ascontiguousarray(record.increments),
            process_noise.angle_random_walk**2,
            process_noise.rate_random_walk**2,
            events.time,
            events.kind,
            vector_b,
            variance,
            events.reference,
            events.triads,
            states,
            np.zeros(number),
            began,
            first + 1,
            every,
            least_weight,
            largest_share,
            np.empty(number),
            np.empty(12),
            np.empty(28),
            attitude,
            estimated_bias,
            blocks,
            weights,
            innovation,
            np.full(3, np.inf) if gate is None else gate.thresholds,
            0 if robust is None else {"huber": robust_step.HUBER, "student": robust_step.STUDENT}[robust.kind],
            np.ones((3, 2)) if robust is None else robust.parameters,
            0 if robust is None else robust.iterations,
            recovery or 0,
            share,
        )
        if at != bank_loop.LOST:
            break
        assert recovery is not None
        # What came before is not to be believed: the circle is that of the first refused direction.
        again = used + np.flatnonzero(events.kind[used:] != filter_loop.HEADING)[:1]
        if len(again) == 0 or events.time[again[0]] > record.time[::every][-1]:
            recovery = None  # too late for another start
            continue
        told.append(
            Event(
                kind="recovery",
                start=float(events.time[used]),
                end=float(events.time[used + recovery - 1]),
                sensor=events.sensors[events.sensor[used]],
                value=float(recovery),
            )
        )
        first = int(again[0])
    P = covariance_matrices(blocks[:rows])
    taken = np.arange(first + 1, used)
    skipped = {
        sensor: events.skipped[sensor] + int(np.sum(events.sensor[:first] == i))
        for i, sensor in enumerate(events.sensors)
    }
    estimate = Estimate(
        time=record.time[kept[:rows]],
        attitude=attitude[:rows],
        bias=estimated_bias[:rows],
        variance=np.ascontiguousarray(np.diagonal(P, axis1=1, axis2=2)),
        covariance=P,
        innovations=_innovations(events, taken, innovation, share if doubted else None),
        skipped=skipped,
        events=tuple(sorted(told, key=lambda event: event.start)),
    )
    if 0 <= at < len(record.time) - 1:
        one = State(attitude=attitude[rows - 1], bias=estimated_bias[rows - 1], covariance=P[-1])
        rest = records.cut(record, at, len(record.time) - 1)
        # The bank has taken in what was measured at the first edge, which a cut leaves with a record's first part.
        rest = replace(rest, vectors=tuple(series.taken(series.time > record.time[at]) for series in rest.vectors))
        if gate is not None and gate.restart_bias_sigma is None:
            # A restart is from as little as this one was, not from what the bank has learnt.
            gate = replace(gate, restart_bias_sigma=float(np.max(bias_sigma)))
        after = mekf.run(
            rest, process_noise, one, every=every, full_covariance=True, gate=gate, robust=robust, monitor=monitor
        )
        estimate = _joined(estimate, after)
    return BankEstimate(
        estimate=estimate,
        edges=kept,
        angles=angles,
        weights=weights[:rows],
        became_one=float(record.time[at]) if at >= 0 else np.inf,
        reason="" if at >= 0 else _reason(record, events, weights[rows - 1], P[-1], attitude[rows - 1]),
    )


def start(
    record: ImuRecord,
    events: Schedule,
    first: int,
    hypotheses: int,
    *,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    bias_sigma: ArrayLike,
    sigma_factor: float = 1.0,
) -> tuple[Array, Array]:
    """Return the hypotheses (h, 28), packed, that event ``first``, a direction, leaves open, and their angles on the circle (h,), rad.

    Across the direction each has the measurement's covariance, its σ times ``sigma_factor``. About it each has a standard deviation of
    half the spacing: of Gaussians spread so, the sum is uniform over the circle to 1.5 %. A measured attitude leaves a single hypothesis.
    """
    spread = np.broadcast_to(bias_sigma, 3).astype(np.float64)
    for k, value in enumerate(spread):
        positive(f"bias_sigma[{k}]", value, unit="rad/s")
    P = np.zeros((6, 6))
    P[3:, 3:] = np.diag(spread**2)
    given = array("bias", bias, (3,))
    frame = events.triads[events.reference[first]]
    if events.kind[first] == filter_loop.ATTITUDE:
        P[:3, :3] = np.diag(sigma_factor**2 * events.vector_b[first])
        return pack(frame[:4], given, P)[None, :].copy(), np.zeros(1)
    z = events.vector_b[first] / np.linalg.norm(events.vector_b[first])
    # Any attitude that maps z on the reference: the one that takes a triad about it to a triad about the reference.
    q = quaternion.from_matrix(frame.reshape(3, 3).T @ vectors.triad(z))
    angles = 2.0 * np.pi * np.arange(hypotheses) / hypotheses
    variance = sigma_factor**2 * events.variance[first]
    P[:3, :3] = variance * (np.eye(3) - np.outer(z, z)) + (np.pi / hypotheses) ** 2 * np.outer(z, z)
    circle = quaternion.multiply(q, quaternion.exp(angles[:, None] * z))
    return np.array([pack(attitude, given, P) for attitude in circle]), angles


def _first_direction(events: Schedule) -> int:
    """Return the first event that is more than a heading."""
    more = np.flatnonzero(events.kind != filter_loop.HEADING)
    if len(more) == 0:
        raise InputError(
            "the record has no direction, vector or attitude to start from inside its time; a bank needs one, a heading alone is not enough"
        )
    return int(more[0])


def _isotropic(series: VectorMeasurements) -> VectorMeasurements:
    """Return the series with one σ a sample, the largest about any axis, if it has more than one."""
    if not series.anisotropic:
        return series
    largest = np.sqrt(np.linalg.eigvalsh(series.covariances)[..., -1])
    if series.attitude is not None:
        axes = np.repeat(largest[:, None], 3, axis=1)
        return replace(series, sigma=largest, sigma_axes=axes, covariance=None)
    return replace(series, sigma=largest, sigma_axes=None, covariance=None)


def _wary(events: Schedule, first: int) -> tuple[Array, Array]:
    """Return values and variances of the events with those of the first directions, from event ``first`` on, made larger by ``WARY``."""
    value, variance = np.array(events.vector_b), np.array(events.variance)
    places = first + np.flatnonzero(events.kind[first:] != filter_loop.HEADING)[: len(WARY)]
    for place, factor in zip(places.tolist(), WARY, strict=False):
        variance[place] *= factor**2
        if events.kind[place] == filter_loop.ATTITUDE:  # whose value is its three variances
            value[place] *= factor**2
    return value, variance


def _innovations(events: Schedule, taken: np.ndarray, rows: Array, weight: Array | None) -> dict[str, Innovations]:
    """Return the innovations e₁, s₁, e₂, s₂, … of the events taken, by sensor, as many as each has degrees of freedom."""
    result = {}
    for i, (sensor, kind) in enumerate(zip(events.sensors, events.kinds, strict=True)):
        mine = taken[events.sensor[taken] == i]
        filled = rows[mine, : 2 * vectors.KINDS[kind]]
        result[sensor] = Innovations(
            time=events.time[mine],
            innovation=filled[:, 0::2],
            variance=filled[:, 1::2],
            weight=None if weight is None else weight[mine],
        )
    return result


def _joined(first: Estimate, last: Estimate) -> Estimate:
    """Return both parts as one; the first row of the second is the last of the first."""
    assert first.covariance is not None
    assert last.covariance is not None
    innovations = {}
    for sensor, one in first.innovations.items():
        other = last.innovations[sensor]
        innovations[sensor] = Innovations(
            time=np.concatenate([one.time, other.time]),
            innovation=np.concatenate([one.innovation, other.innovation]),
            variance=np.concatenate([one.variance, other.variance]),
            weight=None if one.weight is None or other.weight is None else np.concatenate([one.weight, other.weight]),
        )
    return Estimate(
        time=np.concatenate([first.time, last.time[1:]]),
        attitude=np.concatenate([first.attitude, last.attitude[1:]]),
        bias=np.concatenate([first.bias, last.bias[1:]]),
        variance=np.concatenate([first.variance, last.variance[1:]]),
        covariance=np.concatenate([first.covariance, last.covariance[1:]]),
        innovations=innovations,
        skipped=first.skipped,
        events=tuple(
            sorted(
                [*first.events, *(event for event in last.events if event.kind != "gap")], key=lambda event: event.start
            )
        ),
    )


def _reason(record: ImuRecord, events: Schedule, weight: Array, P: Array, attitude: Array) -> str:
    """Return why the hypotheses did not become one, in words."""
    values, axes = np.linalg.eigh(P[:3, :3])
    axis = quaternion.rotate(attitude, axes[:, -1])
    told = (
        f"{int(np.sum(weight > 0.0))} hypotheses are still possible after {record.time[-1] - record.time[0]:.6g} s; "
        f"the turn about the fixed axis ({axis[0]:+.2f}, {axis[1]:+.2f}, {axis[2]:+.2f}) is known to 1σ "
        f"{np.sqrt(values[-1]) / DEGREE:.3g}°"
    )
    references: Array = np.asarray(events.triads)[events.reference[events.kind != filter_loop.ATTITUDE]][:, 6:]
    apart = float(np.max(np.linalg.norm(np.cross(references, references[0]), axis=1)))
    turned = float(np.arcsin(min(apart, 1.0)))
    if turned < CONSTANT:
        return (
            f"{told}: all references lie along one line of the fixed frame, and the turn about it cannot be observed, however the body "
            "moves; add a sensor of another direction, or record until the reference has turned"
        )
    return (
        f"{told}: the references lie up to {turned / DEGREE:.3g}° apart, which has not told the hypotheses apart yet; record longer, or "
        "add a sensor of another direction"
    )
