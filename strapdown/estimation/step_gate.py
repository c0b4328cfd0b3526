"""Gate, weights and iterated update of the step-by-step filter, in matrices over any number of states.

- :func:`linearize`: the measurement linearised at the estimate that its update leads to (iterated update), its NIS, and its robust weight.
- :class:`Supervision`: the gate's counters, the restart candidate that it runs beside the filter, and the NIS that a monitor judges.

Methods, thresholds and their reasons are those of the kernels: :mod:`strapdown.kernels.iterated_update` and
:mod:`strapdown.kernels.gate_rules`, whose counting runs here as plain Python.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar, overload

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array
from strapdown.estimation.forward import gate_events, remembered
from strapdown.estimation.gating import Gate, Monitor, Robust
from strapdown.estimation.model import turning_matrix
from strapdown.estimation.states import GateMemory
from strapdown.kernels import gate_rules, iterated_update
from strapdown.kernels.iterated_update import ONE_AXIS, RELINEARIZED, SETTLED, TURN_ASIDE, UNKNOWN, UNKNOWN_TILT
from strapdown.records import Event

# ------------------------------------------------------------------------------------------------------ one measurement, linearised


class Rows(NamedTuple):
    """A measurement at one state, ``residual = H δx + noise`` with d rows and n states."""

    residual: Array
    """(d,)."""
    H: Array
    """(d, n)."""
    noise: Array
    """Covariance of the noise (d, d)."""
    angle: float
    """Angle θ of a direction or vector from the predicted one, rad; 0 for other kinds."""
    arc: float
    """θ over the length of the residual's part across the predicted direction; of other kinds 1."""


MeasurementModel = Callable[[Array, Array], Rows]
"""A measurement as a function of the attitude q_fb (4,) and the other states (n − 3,) at which it is linearised."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearization:
    """A measurement and the prior, both in the tangent space of the state at which the update is linearised."""

    attitude: Array
    """q_fb (4,) of that state."""
    others: Array
    """Its gyro bias and optional error states (n − 3,)."""
    covariance: Array
    """The prior's P (n, n)."""
    prior: Array
    """The prior's mean less that state (n,), attitude in rad."""
    rows: Rows
    converged: bool = True
    """Whether the iteration came to rest."""

    @property
    def innovation(self) -> Array:
        """The residual less what the prior predicts (d,)."""
        return self.rows.residual - self.rows.H @ self.prior

    @property
    def predicted(self) -> Array:
        """H P Hᵀ (d, d)."""
        return np.asarray(self.rows.H @ self.covariance @ self.rows.H.T)

    @property
    def nis(self) -> float:
        """Normalised innovation squared."""
        return float(self.innovation @ np.linalg.solve(self.predicted + self.rows.noise, self.innovation))

    def acceptable(self, threshold: float) -> bool:
        """Return whether a gate of this threshold accepts it.

        A direction more than a right angle from the predicted one never is: the rows across that do not show which way it points.
        """
        behind = len(self.rows.residual) == 2 and self.rows.angle > 0.5 * math.pi and threshold < math.inf
        return self.converged and self.nis <= threshold and not behind

    def correction(self) -> tuple[Array, float]:
        """Return the correction (n,) of one update, and the size that has to fall below the tolerance.

        That is the attitude's part, rad, and what the optional states change in the rows made independent. The residual of a direction
        enters by its arc, not its chord, so that an update from afar neither creeps nor stops at the opposite direction.
        """
        residual, H, noise, _, arc = self.rows
        L = np.linalg.cholesky(noise)
        L = L / np.diag(L)
        stretch = np.array([arc, arc, 1.0])[: len(residual)]
        innovation = L @ (stretch * np.linalg.solve(L, residual)) - H @ self.prior
        step = self.prior + self.covariance @ H.T @ np.linalg.solve(self.predicted + noise, innovation)
        on_rows = np.linalg.solve(L, H[:, 6:] @ step[6:])
        return step, math.sqrt(step[:3] @ step[:3] + on_rows @ on_rows)

    def weight(self, robust: Robust) -> float:
        """Return the weight of the measurement in a robust update."""
        noise, innovation, predicted = self.rows.noise, self.innovation, self.predicted
        parameter, numerator = robust.parameters[len(innovation) - 1]
        w = 1.0
        for _ in range(robust.iterations):
            R = noise / w
            gain = R @ np.linalg.inv(predicted + R)
            r = gain @ innovation
            distance = float(r @ np.linalg.solve(noise, r))
            if robust.kind == "huber":
                w = 1.0 if distance <= parameter else math.sqrt(parameter / distance)
            else:
                spread = float(np.trace(np.linalg.solve(noise, R - gain @ R)))
                w = float(numerator / (parameter + distance + spread))
        return w


def linearize(
    model: MeasurementModel, attitude: Array, others: Array, P: Array, chains: Array, passes: int, threshold: float
) -> Linearization:
    """Return a measurement linearised at the state that its update leads to (:mod:`strapdown.kernels.gate`).

    Parameters
    ----------
    model : callable
        The measurement's rows at a state.
    attitude, others, P : ndarray
        The prior: q_fb (4,), gyro bias and optional error states (n − 3,), covariance (n, n).
    chains : ndarray
        Of :class:`strapdown.estimation.model.Model`: which states turn with the attitude.
    passes : int
        Most linearisations; with one it is the plain extended Kalman filter.
    threshold : float
        The gate's. While the attitude is hardly known, a measurement that would be refused is linearised again from a third of a turn to
        either side about the least certain axis.
    """
    zero = np.zeros(len(P))
    seen = first = Linearization(
        attitude=attitude, others=others, covariance=P, prior=zero, rows=model(attitude, others)
    )
    if passes == 1:
        return first
    unknown = bool(np.trace(P[:3, :3]) >= UNKNOWN)
    tolerance = SETTLED if unknown else RELINEARIZED
    done, trials = 1, 0
    while True:
        step, size = seen.correction()
        start = seen
        converged = size < tolerance
        if converged or done >= passes:
            seen = seen if converged else replace(first, converged=False)
            if seen.acceptable(threshold) or trials == 2 or not unknown:
                return seen
            trials += 1
            done, start, step = 0, first, zero.copy()
            step[:3] = math.copysign(TURN_ASIDE, trials - 1.5) * least_certain_axis(P)
        now = quaternion.normalize(quaternion.multiply(start.attitude, quaternion.exp(step[:3])))
        now_others = turning_matrix(chains, len(P), start.attitude, now)[3:, 3:] @ (start.others + step[3:])
        moved, prior = prior_at(first, now, now_others, chains)
        seen = Linearization(
            attitude=now, others=now_others, covariance=moved, prior=prior, rows=model(now, now_others)
        )
        done += 1


def prior_at(prior: Linearization, attitude: Array, others: Array, chains: Array) -> tuple[Array, Array]:
    """Return the prior's covariance (n, n) in the tangent space of another state, and its mean less that state (n,)."""
    P, back = seen_from(quaternion.multiply(quaternion.conjugate(prior.attitude), attitude), prior.covariance)
    T = turning_matrix(chains, len(P), prior.attitude, attitude)
    return T @ P @ T.T, np.concatenate([back, T[3:, 3:] @ prior.others - others])


def seen_from(q: Array, covariance: Array) -> tuple[Array, Array]:
    """Return a prior's P (n, n) at the attitude that lies the turn q from its mean, and where the mean lies seen from there (3,), rad.

    The method is that of :func:`strapdown.kernels.iterated_update.seen_from`, which gives the reasons.
    """
    A = covariance[:3, :3]
    axis = least_certain_axis(covariance)
    largest = float(axis @ A @ axis)
    turn, tilt = 0.0, quaternion.log(q)
    if largest > ONE_AXIS * (np.trace(A) - largest):
        turn = 2.0 * math.atan2(float(axis @ q[1:]), float(q[0]))
        tilt = quaternion.log(quaternion.multiply(quaternion.exp(-turn * axis), q))
        turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
    else:
        axis = np.zeros(3)
    halfway = quaternion.to_matrix(quaternion.exp(-0.5 * tilt))
    whole = halfway @ halfway @ axis
    G = np.eye(len(covariance))
    G[:3, :3] = halfway + np.outer(whole - halfway @ axis, axis)
    return G @ covariance @ G.T, -turn * whole - tilt


def least_certain_axis(covariance: Array) -> Array:
    """Return the unit vector (3,) along which the attitude variance of P (n, n) is largest."""
    return np.array(iterated_update.least_certain_axis(tuple(covariance[:3, :3][np.triu_indices(3)].tolist())))


def tilt_unknown(attitude: Array, covariance: Array) -> bool:
    """Return whether the tilt is so uncertain that a heading gives no information."""
    R = quaternion.to_matrix(attitude)[:2]
    return float(np.trace(R @ covariance[:3, :3] @ R.T)) > UNKNOWN_TILT


# -------------------------------------------------------------------------------------------------------------- gate and monitor


class Supervised(Protocol):
    """A step-by-step filter as a gate and a monitor see it."""

    time: float
    attitude: Array
    bias: Array
    P: Array
    nis: float
    """NIS of the last measurement."""
    dim_z: int
    """Its degrees of freedom."""
    _passes: int
    """Most linearisations of an update."""

    def _restarted(self, attitude_sigma: float, bias_width: float) -> Self:
        """Return a restart candidate with this σ of the attitude, rad, and ``bias_width`` times what the gate adds to that of the bias."""

    def _reset(self, correction: Array, P: Array, *, far: bool) -> None:
        """Correct the state, and move P to its tangent space."""

    def _become(self, other: Self) -> None:
        """Take over the state of another filter."""


class Events:
    """Descriptor of a filter's ``events``: recoveries, lock-outs and divergence so far, in order of time.

    Not a property: filterpy's ``Saver`` makes an array of every property, for which a growing tuple has no shape.
    """

    @overload
    def __get__(self, filter: None, owner: type) -> Self: ...

    @overload
    def __get__(self, filter: object, owner: type) -> tuple[Event, ...]: ...

    def __get__(self, filter: Any, owner: type) -> Self | tuple[Event, ...]:
        """Return those of a filter."""
        return self if filter is None else filter._supervision.events  # type: ignore[no-any-return]


Filter = TypeVar("Filter", bound=Supervised)


class Supervision(Generic[Filter]):
    """A gate and a monitor beside a step-by-step filter: counters, restart candidate and the events reported so far."""

    def __init__(self, gate: Gate | None, memory: GateMemory | None, monitor: Monitor | None = None) -> None:
        self.gate = gate
        self.monitor = monitor
        self.nis_history: list[tuple[float, float, int]] = []
        """Time, NIS and degrees of freedom of each measurement."""
        self.sensors: tuple[str, ...] = () if memory is None else tuple(memory.counters)
        self.memory, self.counters = remembered(gate, memory, self.sensors)
        self.candidate: Filter | None = None
        self.recoveries, self.lock_outs = np.empty((0, 4)), np.empty((0, 4))

    @property
    def has_candidate(self) -> bool:
        """Whether a restart candidate is running; one of an earlier part of a record the filter has to restore itself."""
        return bool(self.memory[gate_rules.CANDIDATE])

    @property
    def passes(self) -> int:
        """Most linearisations of an update of the filter: more than one after a recovery."""
        return int(self.memory[gate_rules.PASSES])

    @property
    def events(self) -> tuple[Event, ...]:
        """Recoveries, lock-outs and divergence so far, in order of time."""
        found = gate_events(self.recoveries, self.lock_outs, self.sensors)
        if self.monitor is not None and self.nis_history:
            time, nis, degrees = (np.array(column) for column in zip(*self.nis_history, strict=True))
            found += self.monitor.watch(time, nis, degrees)
        return tuple(sorted(found, key=lambda event: event.start))

    def judge(self, filter: Filter, sensor: str, outcome: int, update: Callable[[Filter], int]) -> None:
        """Count the outcome of a measurement for a filter; ``update`` gives the same measurement to the restart candidate."""
        if self.monitor is not None and outcome != iterated_update.PASSED_OVER:
            self._record_nis(filter, outcome)
        if self.gate is None:
            return
        s, recovery, limit = self._row_of(sensor), self.gate.recovery or 0, self.gate.lock_out_limit
        memory, counters, room = self.memory, self.counters, np.vstack([self.lock_outs, np.empty((1, 4))])
        number, restart = gate_rules.judge_filter(
            outcome, filter.time, s, recovery, limit, counters, memory, room, len(self.lock_outs)
        )
        self.lock_outs = room[:number]
        if restart:
            self._start_candidate(filter, self.gate)
        if self.candidate is None:
            return
        self._judge_candidate(self.candidate, s, update(self.candidate))
        if self.candidate is not None and gate_rules.takes_over(s, recovery, counters, memory):
            row = np.empty(4)
            gate_rules.recover(filter.time, s, limit, counters, memory, row, self.lock_outs)
            self.recoveries = np.vstack([self.recoveries, row])
            filter._become(self.candidate)
            filter._passes = self.passes
            self.candidate = None

    def _row_of(self, sensor: str) -> int:
        """Return a sensor's row of the counters."""
        if sensor not in self.sensors:
            self.sensors = (*self.sensors, sensor)
            self.counters = np.vstack([self.counters, remembered(None, None, (sensor,))[1]])
        return self.sensors.index(sensor)

    def _record_nis(self, filter: Filter, outcome: int) -> None:
        """Keep the NIS of the last measurement for the monitor; of a refused one the gate's threshold."""
        degrees, nis = filter.dim_z, filter.nis
        if self.gate is not None and outcome != iterated_update.ACCEPTED:
            nis = float(self.gate.thresholds[degrees - 1])
        self.nis_history.append((filter.time, nis, degrees))

    def _start_candidate(self, filter: Filter, gate: Gate) -> None:
        sigma = gate_rules.restart_attitude(gate.restart_attitude_sigma, self.memory)
        self.candidate = filter._restarted(sigma, gate_rules.restart_width(self.memory))
        gate_rules.reset_candidate(self.memory, filter.time, self.candidate.bias, np.diag(self.candidate.P)[3:6])

    def _judge_candidate(self, candidate: Filter, sensor: int, outcome: int) -> None:
        """Count the outcome of a measurement for the restart candidate, and drop or widen it."""
        verdict = gate_rules.judge_candidate(
            outcome, candidate.nis, candidate.dim_z, sensor, self.counters, self.memory, candidate.bias
        )
        if verdict == gate_rules.DROPPED:
            self.candidate = None
        elif verdict == gate_rules.TOO_NARROW:
            self._widen(candidate)

    def _widen(self, candidate: Filter) -> None:
        """Make the candidate what it would be if its bias had started with a larger σ, where that start holds it back."""
        P = candidate.P.copy()
        if not gate_rules.may_widen(np.diag(P)[3:6], self.memory):
            return
        correction = np.zeros(len(P))
        for i in range(3):
            gain = gate_rules.start_undone(i, P[3 + i, 3 + i], self.memory) * P[:, 3 + i]
            moved = candidate.bias[i] + correction[3 + i]
            correction += gain * (self.memory[gate_rules.FIRST_BIAS + i] - moved)
            P -= np.outer(gain, P[3 + i])
        candidate._reset(correction, P, far=True)
        gate_rules.count_widening(self.memory)
