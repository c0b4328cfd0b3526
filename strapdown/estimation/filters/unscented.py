"""USQUE, the unscented quaternion estimator (Crassidis & Markley 2003), on the sigma points of filterpy.

The attitude error of each sigma point is three generalised Rodrigues parameters p about the central quaternion, body side,
``q_true = q ⊗ δq(p)``, scaled so that p is the rotation vector for small errors. There are two differences from the paper. The process
noise is the exact one of :mod:`strapdown.estimation`, added after the propagation (in the paper half of a trapezoid before and half after).
A direction enters with all three components (Shuster's method: the variance along it is the mean of the two variances across it), and its
innovation is reported in its two degrees of freedom. A measured attitude enters as its three parameters about the central quaternion,
linear in the state, so that sigma points with a large spread cause no discontinuity at π.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError
from strapdown.estimation.filters import extended
from strapdown.estimation.schedule import Schedule
from strapdown.estimation.states import ProcessNoise, State, covariance_matrices, pack
from strapdown.kernels.filter_step import process_noise as process_noise_of
from strapdown.kernels.measurement import ATTITUDE, DIRECTION, HEADING, has_heading, heading_error
from strapdown.kernels.rotation import quaternion_multiply
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.records import Estimate, ImuRecord

_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_A = 1.0
_F = 2.0 * (_A + 1.0)
_WHOLE = [0, 1, 2, 1, 3, 4, 2, 4, 5]
"""Indices of the entries of a symmetric matrix in its upper triangle."""


def rodrigues_to_quaternion(p: ArrayLike) -> Array:
    """Return δq (..., 4) of generalised Rodrigues parameters p (..., 3), a = 1, f = 4 (Crassidis & Markley 2003)."""
    vector = np.asarray(p, np.float64)
    squared = np.sum(vector * vector, axis=-1, keepdims=True)
    w = (-_A * squared + _F * np.sqrt(_F**2 + (1.0 - _A**2) * squared)) / (_F**2 + squared)
    return np.concatenate([w, (_A + w) / _F * vector], axis=-1)


def quaternion_to_rodrigues(q: ArrayLike) -> Array:
    """Return p (..., 3) of unit quaternions (..., 4): f ρ / (a + w) = f tan(θ/4) n, of the shorter rotation."""
    dq = np.asarray(q, np.float64)
    dq = np.where(dq[..., :1] < 0.0, -dq, dq)
    return np.asarray(_F * dq[..., 1:] / (_A + dq[..., :1]))


def run(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    *,
    every: int = 1,
    full_covariance: bool = False,
    points: Any = None,
) -> Estimate:
    """Run the filter over a whole record, in NumPy: some tenths of a millisecond per step.

    ``points`` are filterpy's sigma points for 6 states; default: Julier's with κ = 1, the paper's λ, all weights positive. Other options as
    for :func:`strapdown.estimation.filters.run`.
    """
    from filterpy.kalman import JulierSigmaPoints  # with SciPy's statistics, half a second that few uses need

    points = JulierSigmaPoints(6, kappa=1.0) if points is None else points
    if getattr(points, "n", None) != 6:
        what = f"are of {points.n} states" if hasattr(points, "n") else f"is {points!r}"
        raise InputError(
            f"points {what}; give filterpy's sigma points for 6 states, three of attitude and three of bias"
        )
    events = extended.checked_schedule(record, process_noise, initial, every)
    steps = in_steps(record, events, every)
    q, b, P = initial.attitude, initial.bias, initial.covariance
    states, innovation = np.empty((len(steps.time), 28)), np.zeros((len(events.time), 6))
    noise = events.body_noise[:, _WHOLE].reshape(-1, 3, 3)
    rows = zip(steps.dt, steps.increment, steps.event, steps.row, strict=True)
    for dt, increment, event, row in rows:
        if dt > 0.0:
            q, b, P = _predict(points, q, b, P, increment, dt, process_noise)
        if event >= 0:
            place = events.row[event]
            q, b, P, innovation[place] = _update(points, q, b, P, events, event, noise[event])
        if row >= 0:
            states[row] = pack(q, b, P)
    return extended.estimate(record, events, every, states, innovation, full_covariance)


class Steps(NamedTuple):
    """Steps: each predicts over ``dt`` if ``dt > 0``, then updates with an event if there is one, then stores the state if requested."""

    dt: Array
    """Duration, s (k,)."""
    increment: Array
    """Integral of the measured rate over dt (k, 3), rad."""
    event: np.ndarray
    """Index of the measurement, −1: none."""
    row: np.ndarray
    """Row of the estimate in which the state is stored, −1: none."""
    time: Array
    """Times of the rows (m,), s."""


def in_steps(record: ImuRecord, events: Schedule, every: int) -> Steps:
    """Return the steps of a filter over a record."""
    edges = record.time
    # Both are sorted; at equal times the events come first.
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
    # Parts of a large rotation end in steps without measurement or stored row; the last part has both.
    parts = (np.linalg.norm(increment, axis=1) / LARGEST_ANGLE).astype(np.int64) + 1
    whole = np.repeat(np.arange(len(dt)), parts)
    last = np.append(whole[1:] != whole[:-1], True)
    return Steps(
        dt=dt[whole] / parts[whole],
        increment=np.ascontiguousarray(increment[whole] / parts[whole, None]),
        event=np.where(last, event[whole], -1),
        row=np.where(last, row[whole], -1),
        time=edges[::every],
    )


def _product(p: Array, q: Array) -> Array:
    """Return p ⊗ q of arrays of quaternions, without the checks of :func:`strapdown.quaternion.multiply`, which would double the time."""
    return np.array(quaternion_multiply(p.T, q.T)).T


def _spread(points: Any, q: Array, b: Array, P: Array) -> tuple[Array, Array]:
    """Return the sigma points (13, 6) of (p, b) about p = 0, and their quaternions (13, 4)."""
    sigma = points.sigma_points(np.concatenate([np.zeros(3), b]), P)
    return sigma, _product(q, rodrigues_to_quaternion(sigma[:, :3]))


def _predict(
    points: Any, q: Array, b: Array, P: Array, increment: Array, dt: float, process_noise: ProcessNoise
) -> tuple[Array, Array, Array]:
    """Propagate each sigma point by equation (17) with its bias."""
    from filterpy.kalman import unscented_transform

    sigma, attitudes = _spread(points, q, b, P)
    attitudes = _product(attitudes, quaternion.exp(increment - dt * sigma[:, 3:]))
    sigma[:, :3] = quaternion_to_rodrigues(_product(attitudes[0] * _CONJUGATE, attitudes))
    noise = _process_noise(increment - dt * b, dt, process_noise)
    mean, covariance = unscented_transform(sigma, points.Wm, points.Wc, noise)
    return _moved(attitudes[0], mean), mean[3:], 0.5 * (covariance + covariance.T)


def _process_noise(phi: Array, dt: float, process_noise: ProcessNoise) -> Array:
    """Return Q (6, 6) over a rotation φ (3,) of any size."""
    q11, q12, q22 = process_noise_of(
        tuple(phi.tolist()), dt, process_noise.angle_random_walk**2, process_noise.rate_random_walk**2
    )
    return covariance_matrices(np.array([*q11, *q12, q22, 0.0, 0.0, q22, 0.0, q22]))


def _moved(q: Array, mean: Array) -> Array:
    return quaternion.normalize(_product(q, rodrigues_to_quaternion(mean[:3])))


def _update(
    points: Any, q: Array, b: Array, P: Array, events: Schedule, event: int, noise: Array
) -> tuple[Array, Array, Array, Array]:
    """Update with one measurement of covariance ``noise`` (3, 3), body axes; return the decorrelated innovations and variances too.

    A heading whose vector is vertical at the central quaternion is skipped, and its innovation is NaN.
    """
    from filterpy.kalman import unscented_transform

    kind, z = events.kind[event], events.vector_b[event]
    frame = events.triads[events.reference[event]]
    triad = frame.reshape(3, 3)
    record = np.zeros(6)
    record[1::2] = 1.0
    if kind == HEADING and not has_heading(quaternion.to_matrix(q).ravel(), z):
        record[0] = np.nan
        return q, b, P, record
    sigma, attitudes = _spread(points, q, b, P)
    if kind == HEADING:
        residuals = np.array([heading_error(R.ravel(), z, triad[2]) for R in quaternion.to_matrix(attitudes)])[:, None]
        # Angles near the central one, so that the discontinuity at π does not separate the points by 2π.
        residuals = residuals[0] + (residuals - residuals[0] + np.pi) % (2.0 * np.pi) - np.pi
        degrees, noise = 1, noise[:1, :1]
    elif kind == ATTITUDE:
        residuals = quaternion_to_rodrigues(_product(q * _CONJUGATE, frame[:4])) - sigma[:, :3]
        degrees = 3
    else:
        # Components along the predicted triad: the first two are across the direction, the third is along it.
        basis = quaternion.rotate(quaternion.conjugate(q), triad)
        residuals = (z - quaternion.rotate(quaternion.conjugate(attitudes), triad[2])) @ basis.T
        degrees, noise = 3, basis @ noise @ basis.T
        if kind == DIRECTION:
            degrees = 2
            noise[2, :2] = noise[:2, 2] = 0.0
            noise[2, 2] = 0.5 * (noise[0, 0] + noise[1, 1])
    mean, S = unscented_transform(residuals, points.Wm, points.Wc, noise)
    prior = np.concatenate([np.zeros(3), b])
    cross = -(points.Wc[:, None] * (sigma - prior)).T @ (residuals - mean)
    gain = np.linalg.solve(S, cross.T).T
    state = prior + gain @ mean
    covariance = P - gain @ S @ gain.T
    factor = np.linalg.cholesky(S)
    pivots = np.diag(factor)
    independent = pivots * np.linalg.solve(factor, mean)
    record[0 : 2 * degrees : 2], record[1 : 2 * degrees : 2] = independent[:degrees], pivots[:degrees] ** 2
    return _moved(q, state), state[3:], 0.5 * (covariance + covariance.T), record
