"""Process noise and state of the filter, initial states, and the packing of a state for the kernels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import (
    Array,
    InputError,
    are_finite,
    array,
    by_axis,
    covariance,
    half_turn,
    instance,
    non_negative,
    positive,
    unit_quaternions,
)
from strapdown.estimation.gating import Gate, Robust
from strapdown.kernels.measurement import heading_row
from strapdown.records import ImuRecord
from strapdown.results import ByValue
from strapdown.vectors import wahba

LARGEST_NOISE = 1e9
"""Noise of a gyro, SI, above which the value is taken to be a mistake."""


@dataclass(frozen=True, kw_only=True)
class ProcessNoise:
    """White noise of the gyro and random walk of its bias, as the filter models them.

    The noise of the attitude over an interval is that of a continuous rate, σ_v² dt I. A gyro gives increments, and the noise of an
    increment φ + ν enters the attitude by the right Jacobian of SO(3), as σ_v² dt J_r(φ) J_r(φ)ᵀ: σ_v² dt about the axis of rotation and
    2(1 − cos x)/x² of it across, x = |φ|. So the filter's variance across the axis is too large by a fraction of about x²/12: 1 % for a
    rotation of 0.35 rad per sample, 9 % for 1 rad, 41 % for 2 rad. It is never too small. For faster rotations, sample the gyro faster.

    Parameters
    ----------
    angle_random_walk : float
        Angle random walk σ_v, rad/√s; greater than zero.
    rate_random_walk : float
        Rate random walk σ_u of the bias, rad/s/√s; 0: the bias is constant.
    """

    angle_random_walk: float
    rate_random_walk: float

    def __post_init__(self) -> None:
        """Check both."""
        for name, unit, check in (
            ("angle_random_walk", "rad/√s", positive),
            ("rate_random_walk", "rad/s/√s", non_negative),
        ):
            if check(name, getattr(self, name), unit=unit) > LARGEST_NOISE:
                raise InputError(f"{name} is {getattr(self, name):g} {unit}, more than any gyro has; check the unit")


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """Restart candidate that runs in parallel with a gated filter."""

    x: Array
    """q_fb, gyro bias and error states (n + 1,)."""
    covariance: Array
    """P (n, n)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GateMemory:
    """State of a gate at the end of a part of a record, from which the next part continues."""

    restart_bias_variance: Array
    """Default increase of the bias variance of the first candidate (3,), (rad/s)²."""
    candidate: Candidate | None = None
    counts: Array
    """Whether there is a candidate, its counts, and how much the next one's σ is increased, as in :mod:`strapdown.kernels.gate_rules`."""
    counters: Mapping[str, Array]
    """Counts of refusals of each sensor, likewise."""
    start: float = 0.0
    """Start time of the first part of the record, s."""
    values: Array = field(default_factory=lambda: np.empty(0))
    """Error states of a candidate at that time (m,)."""
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))
    """Covariance of those (m, m)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class State(ByValue):
    """Attitude, bias and error states of a filter, and the covariance of their errors.

    Parameters
    ----------
    attitude : ndarray (4,)
        Attitude q_fb, scalar first.
    bias : ndarray (3,)
        Gyro bias, rad/s, body axes.
    covariance : ndarray (6 + m, 6 + m)
        P of the errors (δθ, δb, δc), with δθ in the body frame: rad², rad²/s, (rad/s)², …
    values : ndarray (m,), default empty
        Error states c, in the order of their declarations.
    gate : GateMemory, optional
        State of a gate at the end of a part of a record.
    unit_sigma : mapping of str to float, default empty
        For each sensor with ``varying`` effects, the σ, rad, that fixes the magnitude to which their values are relative. Default: the
        root mean square of the sensor's σ in the record.
    """

    attitude: Array
    bias: Array
    covariance: Array
    values: Array = field(default_factory=lambda: np.empty(0))
    gate: GateMemory | None = None
    unit_sigma: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes, the norm of the attitude and positive definiteness."""
        object.__setattr__(self, "attitude", unit_quaternions("attitude", array("attitude", self.attitude, (4,))))
        object.__setattr__(self, "bias", array("bias", self.bias, (3,)))
        values = array("values", self.values, ("m",))
        object.__setattr__(self, "values", values)
        units = {name: positive(f"unit_sigma[{name!r}]", sigma) for name, sigma in self.unit_sigma.items()}
        object.__setattr__(self, "unit_sigma", units)
        size = 6 + len(values)
        object.__setattr__(self, "covariance", covariance("covariance", self.covariance, size))


Change = Callable[[Array, Array], None]
"""A change in place of attitude, bias and error states (7 + m,) and of their covariance."""


def changed(state: State, change: Change) -> State:
    """Return a state after a change."""
    x, P = np.concatenate([state.attitude, state.bias, state.values]), np.array(state.covariance)
    change(x, P)
    return replace(state, attitude=x[:4], bias=x[4:7], values=x[7:], covariance=P)


def initial_state(
    attitude: ArrayLike, *, attitude_sigma: ArrayLike, bias_sigma: ArrayLike, bias: ArrayLike = (0.0, 0.0, 0.0)
) -> State:
    """Return a state with independent errors.

    Parameters
    ----------
    attitude : array_like (4,)
        q_fb.
    attitude_sigma : float or array_like (3,)
        σ of the attitude error, rad, per body axis.
    bias_sigma : float or array_like (3,)
        σ of the bias error, rad/s, per body axis.
    bias : array_like (3,), default zero
        Gyro bias, rad/s, body axes.

    Returns
    -------
    State
        Attitude and bias with a diagonal covariance.

    Raises
    ------
    InputError
        If a σ is not positive, that of the attitude exceeds π, a shape is wrong, or the quaternion is not of unit length.

    Examples
    --------
    >>> import strapdown as sd
    >>> start = sd.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=0.1, bias_sigma=1e-4)
    >>> start.covariance.diagonal().round(10).tolist()
    [0.01, 0.01, 0.01, 1e-08, 1e-08, 1e-08]
    """
    sigma = np.concatenate([by_axis("attitude_sigma", attitude_sigma), by_axis("bias_sigma", bias_sigma)])
    half_turn("attitude_sigma", sigma[:3])
    return State(
        attitude=array("attitude", attitude, (4,)), bias=array("bias", bias, (3,)), covariance=np.diag(sigma**2)
    )


def first_bias_variance(initial: State) -> Array:
    """Return the bias variance (3,) of the initial state of the first part of a record."""
    return np.diag(initial.covariance)[3:6].copy() if initial.gate is None else initial.gate.restart_bias_variance


def restart_bias_variance(gate: Gate | None, initial: State) -> Array:
    """Return the increase of the bias variance of a gate's first candidate (3,), (rad/s)², in a filter that continues from ``initial``."""
    if gate is None:
        return np.zeros(3)
    if gate.restart_bias_sigma is None:
        return first_bias_variance(initial)
    return np.full(3, gate.restart_bias_sigma**2)


ARGUMENTS: dict[str, tuple[type, str]] = {
    "record": (ImuRecord, "make it with records.ImuRecord, or read one by recordfiles.read_record"),
    "process_noise": (ProcessNoise, "give estimation.ProcessNoise(angle_random_walk=…, …)"),
    "initial": (State, "make it with estimation.initial_state, or from a record by estimation.first_state"),
    "gate": (Gate, "give estimation.Gate(probability=0.999), or None"),
    "robust": (Robust, "give estimation.Robust(kind='huber'), or None"),
}
"""Arguments of filters by name: class, and how to obtain one."""


def check_arguments(**arguments: object) -> None:
    """Raise an error for arguments, given by name, of a wrong class; only a gate and robust updates may be None."""
    for name, value in arguments.items():
        if value is not None or name not in ("gate", "robust"):
            instance(name, value, *ARGUMENTS[name])


FIRST_SETS = 10
"""Number of sets of first measurements that are tried in turn for an initial attitude, in case one holds an outlier."""
VERTICAL = math.radians(1.0)
"""Largest angle between the fixed z axis and a reference that is treated as the vertical, rad."""
PRIOR_INFLATION = 10.0
"""Factor on σ of an initial attitude from measurements, because the filter processes the same measurements again."""


def first_state(
    record: ImuRecord,
    process_noise: ProcessNoise,
    *,
    bias_sigma: float,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    inflation: float = PRIOR_INFLATION,
) -> State:
    """Return a state at the first edge from the first measurements: a measured attitude, or two or more directions (Wahba's problem).

    Each measurement is rotated back to the first edge by the gyro; its noise is increased by that of the gyro and of the bias. If a
    measured attitude is an outlier, nothing contradicts it, and the filter accepts it too, even with a gate: its error is many σ until
    later measurements have corrected it. Against this, give the initial attitude.

    Parameters
    ----------
    record : ImuRecord
        Record with measurements of an attitude, or of two directions that are not parallel.
    process_noise : ProcessNoise
        Angle random walk and rate random walk of the gyro, as the filter models them.
    bias_sigma : float
        Standard deviation of the bias error, rad/s, per axis.
    bias : array_like (3,), default zero
        Gyro bias, rad/s, body axes.
    inflation : float, default 10
        Factor on the σ of the attitude, because the filter processes the same measurements again.

    Returns
    -------
    State
        Attitude and bias with the covariance of their errors at the first edge.

    Raises
    ------
    InputError
        If the measurements do not determine the attitude: fewer than two directions, or all parallel.
    InconsistentError
        If directions contradict each other (:mod:`strapdown.vectors.wahba`).

    References
    ----------
    F. L. Markley, J. L. Crassidis, Fundamentals of Spacecraft Attitude Determination and Control, 2014, chapter 5.
    """
    positive("bias_sigma", bias_sigma, unit="rad/s")
    b = array("bias", bias, (3,))
    problem = InputError("the record holds no measurement that gives an attitude")
    for k in range(FIRST_SETS):
        try:
            attitude, P = _attitude_of_set(record, process_noise, b, bias_sigma, k)
        except InputError as error:
            problem = problem if k else error
            continue
        whole = np.zeros((6, 6))
        whole[:3, :3] = inflation**2 * P
        whole[3:, 3:] = bias_sigma**2 * np.eye(3)
        return State(attitude=attitude, bias=b, covariance=whole)
    raise type(problem)(f"the first measurements do not give the attitude: {problem}; give the initial attitude")


def _attitude_of_set(
    record: ImuRecord, process_noise: ProcessNoise, bias: Array, bias_sigma: float, k: int
) -> tuple[Array, Array]:
    """Return attitude and covariance at the first edge from the k-th usable measurement of each sensor.

    The error of the gyro up to the first of these measurements is common to all, and is added at the end; that from there on is a rotation
    of the later ones.
    """
    body, fixed, sigmas, headings, used = [], [], [], [], []
    for series in record.vectors:
        content = series.vector_b if series.attitude is None else series.attitude
        inside = (series.time >= record.time[0]) & (series.time <= record.time[-1]) & are_finite(content)
        if np.sum(inside) > k:
            used.append(series.taken(np.flatnonzero(inside)[k : k + 1]))

    def turn_variance(time: float) -> float:
        span = time - record.time[0]
        return float(process_noise.angle_random_walk**2 * span + (bias_sigma * span) ** 2)

    common = turn_variance(min((vectors.time[0] for vectors in used), default=record.time[0]))
    for vectors in used:
        turn = _turn_until(record, bias, float(vectors.time[0]))
        grown = turn_variance(vectors.time[0])
        if vectors.attitude is not None:
            attitude = quaternion.multiply(vectors.attitude[0], quaternion.conjugate(turn))
            R = quaternion.to_matrix(turn)
            return attitude, R @ vectors.covariances[0] @ R.T + grown * np.eye(3)
        reference = vectors.references_f[0]
        length = float(np.linalg.norm(reference))
        body.append(quaternion.rotate(turn, vectors.vector_b[0] / np.linalg.norm(vectors.vector_b[0])))
        fixed.append(reference / length)
        scale = length if vectors.kind == "vector" else 1.0
        if vectors.kind == "heading":
            headings.append((body.pop(), fixed.pop(), float(vectors.sigma[0]), grown - common))
        else:
            sigmas.append(float(np.hypot(vectors.sigma[0] / scale, np.sqrt(grown - common))))
    if len(body) == 1 and headings and abs(fixed[0][2]) > np.cos(VERTICAL):
        attitude, P = _from_vertical(body[0], fixed[0], sigmas[0], *headings[0])
        return attitude, P + common * np.eye(3)
    if len(body) < 2:
        raise InputError(
            f"two directions are needed, or the vertical and a heading; the record has {len(body)} of directions "
            f"and {len(headings)} of headings"
        )
    solution = wahba.solve(np.array(body), np.array(fixed), np.array(sigmas))
    return solution.attitude, solution.covariance + common * np.eye(3)


def _from_vertical(
    up_b: Array, up_f: Array, up_sigma: float, direction: Array, reference: Array, sigma: float, turned: float
) -> tuple[Array, Array]:
    """Return attitude and covariance from the vertical and a heading, whose ``direction`` is measured in body axes.

    ``turned``: variance of the rotation about each axis between their times, rad².
    """
    # Together with the vertical, a heading is a direction: the horizontal part of its vector.
    level = direction - up_b * (direction @ up_b)
    horizontal = reference - up_f * (reference @ up_f)
    attitude = wahba.solve(np.array([up_b, level]), np.array([up_f, horizontal]), np.array([up_sigma, sigma])).attitude
    # A tilt changes the heading too, by the tangent of the dip, but the heading has no information about the tilt.
    R = quaternion.to_matrix(attitude)
    row = np.array(heading_row(tuple(R.ravel()), tuple(direction)))
    if not row.any():
        raise InputError("the vector that should give the heading is vertical")
    tilt = np.eye(3) - np.outer(R[2], R[2])
    variance = sigma**2 + turned * (row @ row)
    return attitude, np.linalg.inv(tilt / up_sigma**2 + np.outer(row, row) / variance)


def _turn_until(record: ImuRecord, bias: Array, time: float) -> Array:
    """Return the rotation q from the first edge to a time, from the gyro."""
    k = int(np.searchsorted(record.time, time, side="right")) - 1
    dt = np.diff(record.time[: k + 2])
    steps = record.increments[: k + 1] - bias * dt[:, None]
    if k < len(record.increments):
        # Of the last interval only the part before the time counts.
        steps[k] *= (time - record.time[k]) / dt[k]
    turns = quaternion.exp(steps)
    while len(turns) > 1:  # pairs of neighbours
        odd = turns[len(turns) // 2 * 2 :]
        turns = np.concatenate([quaternion.multiply(turns[0 : len(turns) - len(odd) : 2], turns[1::2]), odd])
    return quaternion.normalize(turns[0])


# Blocks of P in the kernels: rows and columns of A = P_θθ (upper), B = P_θb, C = P_bb (upper).
_UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
_ROWS = np.array([*_UPPER[0], *np.repeat(range(3), 3), *(3 + np.array(_UPPER[0]))])
_COLUMNS = np.array([*_UPPER[1], *(3 + np.tile(range(3), 3)), *(3 + np.array(_UPPER[1]))])


def pack(attitude: Array, bias: Array, covariance: Array) -> Array:
    """Return a state packed as the kernels' 28 numbers: q, b, and P in blocks."""
    return np.concatenate([attitude, bias, covariance_blocks(covariance)])


def covariance_blocks(covariance: Array) -> Array:
    """Return the kernels' 21 numbers (..., 21) of matrices P (..., 6, 6)."""
    return np.asarray(covariance[..., _ROWS, _COLUMNS])


def covariance_matrices(blocks: Array) -> Array:
    """Return the matrices P (..., 6, 6) of the kernels' 21 numbers (..., 21)."""
    P = np.empty((*blocks.shape[:-1], 6, 6))
    P[..., _ROWS, _COLUMNS] = blocks
    P[..., _COLUMNS, _ROWS] = blocks
    return P
