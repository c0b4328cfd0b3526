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
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import estimation, quaternion, records, vectors
from strapdown.checks import Array, InputError, array, count, fraction
from strapdown.estimation.forward import gaps, gate_options, in_order
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.schedule import Schedule, innovations_by_sensor, joined, schedule
from strapdown.estimation.states import (
    ProcessNoise,
    State,
    check_arguments,
    covariance_matrices,
    initial_state,
    pack,
)
from strapdown.kernels import gate_rules, measurement
from strapdown.kernels import hypotheses as hypotheses_kernel
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.walk import walk
from strapdown.records import Estimate, Event, ImuRecord
from strapdown.units import DEGREE, DEGREE_PER_HOUR
from strapdown.vectors import VectorMeasurements

__all__ = ["BankEstimate", "run"]

HYPOTHESES = 96
"""Default number of hypotheses on the circle: 3.75° apart. Fewer find the attitude as soon, but some have too small a covariance:
``sims/unknown_start.py``."""
MIN_WEIGHT = 1e-6
"""Minimum weight of a hypothesis, relative to the largest; below it the hypothesis is dropped."""
LARGEST_SHARE = 0.15
"""Maximum fraction of the mixture's covariance due to the distance of the hypotheses at which they are merged into one Gaussian."""
MAX_FIRST_OUTLIERS = 3
"""With a gate or robust updates: number of first directions that may all be outliers."""
DOUBT = 1e-3
"""Weight of a hypothesis that refuses a direction, relative to one that uses it, until the next direction decides: that of a measurement
at the threshold of a gate that refuses correct measurements with this probability."""
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
        them; with a gate or a robust update followed by those for each of the next directions.
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
    least_weight: float = MIN_WEIGHT,
    largest_share: float = LARGEST_SHARE,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> BankEstimate:
    """Estimate attitude and gyro bias from an unknown initial attitude.

    Measurements before the first direction (or vector, or attitude) are omitted and counted as skipped. Until the hypotheses are merged
    into one, a noise that differs by body axis (``sigma_axes``, ``covariance``) is replaced by its largest σ about every axis.

    With a gate or a robust update the first direction may be an outlier: further sets of hypotheses omit it and start from the second,
    third and fourth.

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
    least_weight : float
        Minimum weight of a hypothesis, relative to the largest; below it the hypothesis is dropped.
    largest_share : float
        Maximum fraction of the mixture's covariance due to the distance of the hypotheses at which they are merged into one.
    gate : Gate, optional
        Each hypothesis refuses improbable measurements; a refused one reduces its weight like a measurement at the threshold. When most of
        the hypotheses have refused ``recovery`` measurements in a row, they restart from the first of these, with three times the bias σ,
        and an event reports it. After the merger it is the gate of :func:`strapdown.estimation.run`.
    robust : Robust, optional
        Each hypothesis weights measurements by their residuals, and hypotheses are weighted by likelihoods with heavier tails. Without a
        gate the bank cannot recover if the first measurements are wrong.

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
    check_arguments(record=record, process_noise=process_noise, gate=gate, robust=robust)
    initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=bias_sigma, bias=bias)  # checks the arguments
    count("hypotheses", hypotheses, minimum=8)
    count("every", every)
    for name, value in (("least_weight", least_weight), ("largest_share", largest_share)):
        fraction(name, value)
    options = _Options(
        hypotheses,
        array("bias", bias, (3,)),
        np.broadcast_to(bias_sigma, 3).astype(np.float64),
        every,
        least_weight,
        largest_share,
        gate,
        robust,
    )
    found = _until_one(record, process_noise, options)
    if found.became_one >= record.time[-1]:
        return found
    rest, one = _from_where_one(record, found)
    if gate is not None and gate.restart_bias_sigma is None:
        # A restart has the bank's initial σ of the bias, not the smaller one of the merged estimate.
        gate = replace(gate, restart_bias_sigma=float(np.max(bias_sigma)))
    after = estimation.run(rest, process_noise, one, every=every, full_covariance=True, gate=gate, robust=robust)
    own = tuple(event for event in after.events if event.kind != "gap")  # gaps are already included
    return replace(found, estimate=joined([found.estimate, replace(after, events=own)]))


def _from_where_one(record: ImuRecord, found: BankEstimate) -> tuple[ImuRecord, State]:
    """Return the record from the time of the merger on, and the state there."""
    edge = int(np.searchsorted(record.time, found.became_one))
    rest = records.cut(record, edge, len(record.time) - 1)
    # The bank has processed the measurements at that edge, which `cut` assigns to the first part of a record.
    rest = replace(rest, vectors=tuple(series.taken(series.time > found.became_one) for series in rest.vectors))
    last = found.estimate
    assert last.covariance is not None
    return rest, State(attitude=last.attitude[-1], bias=last.bias[-1], covariance=last.covariance[-1])


class _Options(NamedTuple):
    """Options of :func:`run` until the hypotheses are merged."""

    hypotheses: int
    bias: Array
    bias_sigma: Array
    every: int
    min_weight: float
    max_share: float
    gate: Gate | None
    robust: Robust | None

    @property
    def outliers_possible(self) -> bool:
        """Whether the first directions may be outliers."""
        return self.gate is not None or self.robust is not None


class _Walked(NamedTuple):
    """Result of the bank from a given first direction on."""

    estimate: Estimate
    kept: np.ndarray
    """Edges of the record whose rows are stored; the estimate has the first of them."""
    angles: Array
    weights: Array
    weight: Array
    """Weights at the end."""
    at: int
    """Edge at which the hypotheses were merged, or ``NEVER`` or ``LOST``."""
    used: int
    """Number of events processed; if lost, index of the first of the refused ones."""


def _until_one(record: ImuRecord, process_noise: ProcessNoise, options: _Options) -> BankEstimate:
    """Return the bank's part of :func:`run`: until the hypotheses are merged, or to the end."""
    coarse = tuple(_isotropic(series) for series in record.vectors)
    events = schedule(coarse, record.time[0], record.time[-1])
    recovery = 0 if options.gate is None else options.gate.recovery or 0
    own_events = gaps(record)
    failed = 0
    directions = _directions(events, 0)
    if len(directions) == 0:
        raise InputError(
            "the record has no direction, vector or attitude within its time to start from; add one: a heading is not enough"
        )
    first = int(directions[0])
    while True:
        wide = gate_rules.WIDENING ** (failed % (gate_rules.WIDEST + 1)) * options.bias_sigma
        found = _walked(record, process_noise, events, first, options._replace(bias_sigma=wide), recovery)
        if found.at != hypotheses_kernel.LOST:
            break
        # Earlier measurements may be wrong: start from the circle of the first refused direction.
        again = _directions(events, found.used)
        if len(again) == 0 or events.time[again[0]] > record.time[:: options.every][-1]:
            recovery = 0  # too late for another start
            continue
        failed += 1
        own_events.append(
            Event(
                kind="recovery",
                start=float(events.time[found.used]),
                end=float(events.time[found.used + recovery - 1]),
                sensor=events.sensors[events.sensor[found.used]],
                value=float(recovery),
            )
        )
        first = int(again[0])
    skipped = {
        sensor: events.skipped[sensor] + int(np.sum(events.sensor[:first] == i))
        for i, sensor in enumerate(events.sensors)
    }
    estimate = replace(found.estimate, skipped=skipped, events=in_order(own_events))
    one = found.at >= 0
    return BankEstimate(
        estimate=estimate,
        edges=found.kept,
        angles=found.angles,
        weights=found.weights,
        became_one=float(record.time[found.at]) if one else np.inf,
        reason="" if one else _reason(record, events, found.weight, estimate),
    )


def _walked(
    record: ImuRecord, process_noise: ProcessNoise, events: Schedule, first: int, options: _Options, recovery: int
) -> _Walked:
    """Run the bank with the hypotheses of the first direction and, if it may be an outlier, of the next ones."""
    later = _directions(events, first + 1)[: MAX_FIRST_OUTLIERS if options.outliers_possible else 0]
    sets = [
        start(record, events, int(one), options.hypotheses, bias=options.bias, bias_sigma=options.bias_sigma)
        for one in (first, *later)
    ]
    states, angles = (np.concatenate(parts) for parts in zip(*sets, strict=True))
    number = np.cumsum([len(of_set) for of_set, _ in sets])
    began = float(events.time[first])
    kept = np.arange(0, len(record.time), options.every)
    kept = kept[record.time[kept] >= began]
    if len(kept) == 0:
        raise InputError(
            f"the first direction comes at {began:.6g} s, after the last stored edge; store more edges or give a longer record"
        )
    weight = np.empty(len(states))
    out = hypotheses_kernel.Outputs(
        attitude=np.empty((len(kept), 4)),
        bias=np.empty((len(kept), 3)),
        covariance=np.empty((len(kept), 21)),
        weights=np.empty((len(kept), len(states))),
        innovation=np.empty((len(events.time), 6)),
        share=np.empty(len(events.time)),
    )
    edges, increments, first_edge = _from_time(record, began)
    body = hypotheses_kernel.Body(
        angle_variance=process_noise.angle_random_walk**2,
        rate_variance=process_noise.rate_random_walk**2,
        states=states,
        log_weight=np.where(np.arange(len(states)) < number[0], 0.0, -np.inf),
        weight=weight,
        later=later - (first + 1),
        sets=number,
        charge=-2.0 * np.log(DOUBT),
        options=gate_options(options.gate, options.robust)._replace(recovery=recovery),
        min_weight=options.min_weight,
        max_share=options.max_share,
        first_edge=first_edge,
        on_edge=bool(edges[0] == record.time[first_edge]),
        every=options.every,
        room=np.empty(40),
    )
    rows, at, used = compiled(walk, hypotheses_kernel)(
        edges, increments, _after(events.measurements, first + 1), 1, body, out
    )
    used += first + 1
    processed = np.zeros(len(events.time), bool)
    processed[events.row[first + 1 : used + recovery if at == hypotheses_kernel.LOST else used]] = True
    P = covariance_matrices(out.covariance[:rows])
    estimate = Estimate(
        time=record.time[kept[:rows]],
        attitude=out.attitude[:rows],
        bias=out.bias[:rows],
        variance=np.ascontiguousarray(np.diagonal(P, axis1=1, axis2=2)),
        covariance=P,
        innovations=innovations_by_sensor(
            events, out.innovation, out.share if options.outliers_possible else None, processed
        ),
    )
    return _Walked(estimate, kept, angles, out.weights[:rows], weight, at, used)


def _after(measurements: measurement.Measurements, first: int) -> measurement.Measurements:
    """Return the measurements from number ``first`` on, in order of time."""
    time, place, sensor = (getattr(measurements, name)[first:] for name in ("time", "place", "sensor"))
    return measurements._replace(time=time, place=place, sensor=sensor)


def _from_time(record: ImuRecord, time: float) -> tuple[Array, Array, int]:
    """Return edges and increments from a time on, and the index of the last edge at or before it."""
    k = int(np.searchsorted(record.time, time, side="right")) - 1
    edges, increments = record.time[k:].copy(), np.ascontiguousarray(record.increments[k:])
    if time > edges[0]:
        increments = increments.copy()
        increments[0] *= (edges[1] - time) / (edges[1] - edges[0])
        edges[0] = time
    return read_only(edges), read_only(increments), k


def start(
    record: ImuRecord,
    events: Schedule,
    first: int,
    hypotheses: int,
    *,
    bias: Array,
    bias_sigma: Array,
) -> tuple[Array, Array]:
    """Return the hypotheses (h, 28), packed, for event ``first``, a direction, and their angles on the circle (h,), rad.

    Across the direction each has the measurement's covariance; about it, a standard deviation of half the spacing, for which the sum of the
    Gaussians is uniform over the circle to 1.5 %. A measured attitude gives a single hypothesis.
    """
    P = np.zeros((6, 6))
    P[3:, 3:] = np.diag(bias_sigma**2)
    frame = events.triads[events.reference[first]]
    if events.kind[first] == measurement.ATTITUDE:
        P[:3, :3] = np.diag(events.vector_b[first])
        return pack(frame[:4], bias, P)[None, :].copy(), np.zeros(1)
    z = events.vector_b[first] / np.linalg.norm(events.vector_b[first])
    # Any attitude that maps z onto the reference: the one that maps a triad about it to a triad about the reference.
    q = quaternion.from_matrix(frame.reshape(3, 3).T @ vectors.triad(z))
    angles = 2.0 * np.pi * np.arange(hypotheses) / hypotheses
    P[:3, :3] = events.variance[first] * (np.eye(3) - np.outer(z, z)) + (np.pi / hypotheses) ** 2 * np.outer(z, z)
    circle = quaternion.multiply(q, quaternion.exp(angles[:, None] * z))
    return np.array([pack(attitude, bias, P) for attitude in circle]), angles


def _directions(events: Schedule, first: int) -> np.ndarray:
    """Return the events from number ``first`` on that are not headings."""
    return np.asarray(first + np.flatnonzero(events.kind[first:] != measurement.HEADING))


def _isotropic(series: VectorMeasurements) -> VectorMeasurements:
    """Return the series with one σ per sample, the largest of any axis if it is anisotropic."""
    if not series.anisotropic:
        return series
    largest = np.sqrt(np.linalg.eigvalsh(series.covariances)[..., -1])
    if series.attitude is not None:
        axes = np.repeat(largest[:, None], 3, axis=1)
        return replace(series, sigma=largest, sigma_axes=axes, covariance=None)
    return replace(series, sigma=largest, sigma_axes=None, covariance=None)


def _reason(record: ImuRecord, events: Schedule, weight: Array, estimate: Estimate) -> str:
    """Return why the hypotheses were not merged, as text for the user."""
    assert estimate.covariance is not None
    values, axes = np.linalg.eigh(estimate.covariance[-1, :3, :3])
    axis = quaternion.rotate(estimate.attitude[-1], axes[:, -1])
    seen = (
        f"{int(np.sum(weight > 0.0))} hypotheses are still possible after {record.time[-1] - record.time[0]:.6g} s; "
        f"the rotation about the fixed axis ({axis[0]:+.2f}, {axis[1]:+.2f}, {axis[2]:+.2f}) is known to 1σ "
        f"{np.sqrt(values[-1]) / DEGREE:.3g}°"
    )
    references: Array = np.asarray(events.triads)[events.reference[events.kind != measurement.ATTITUDE]][:, 6:]
    apart = float(np.max(np.linalg.norm(np.cross(references, references[0]), axis=1)))
    turned = float(np.arcsin(min(apart, 1.0)))
    if turned < CONSTANT:
        return (
            f"{seen}: all references lie along one line of the fixed frame, and the rotation about it cannot be observed, however the body "
            "moves; add a sensor of another direction, or record until the reference has rotated"
        )
    return (
        f"{seen}: the references differ by up to {turned / DEGREE:.3g}°, which has not separated the hypotheses yet; record longer, or "
        "add a sensor of another direction"
    )
