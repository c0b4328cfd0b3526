"""The step-by-step filter with gate, recovery and robust weights in matrices: the reference for those of the compiled filter.

Methods, thresholds and their reasons are those of the kernels; the counters of :mod:`strapdown.kernels.gate_rules` run here as Python.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import filterpy.kalman
import numpy as np

from strapdown import kinematics, quaternion
from strapdown.checks import Array
from strapdown.estimation import model as modelling
from strapdown.estimation.forward import (
    aged_states,
    gate_events,
    in_order,
    initial_counts,
    last_lock_outs,
    restart_states,
)
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import State, check_arguments, restart_bias_variance
from strapdown.estimation.step_filter import StepFilter
from strapdown.kernels import gate_rules, iterated_update, machine
from strapdown.kernels import rows as row_kernels
from strapdown.kernels.gate_rules import WIDE_PASSES
from strapdown.kernels.iterated_update import (
    ACCEPTED,
    KNOWN,
    MIN_CORRECTION_UNKNOWN,
    ONE_AXIS,
    PASSED_OVER,
    REFUSED,
    RELINEARIZED,
    TURN_ASIDE,
    UNKNOWN,
    UNKNOWN_TILT,
)
from strapdown.kernels.measurement import has_heading
from strapdown.kernels.rotation import rotation_matrix
from strapdown.records import Event
from strapdown.vectors import KINDS


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
    """θ divided by the magnitude of the transverse residual; 1 for other kinds."""


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
    """P of the prior (n, n)."""
    prior: Array
    """Mean of the prior minus that state (n,), attitude in rad."""
    rows: Rows
    converged: bool = True
    """Whether the iteration converged."""

    @property
    def innovation(self) -> Array:
        """The residual minus its prediction from the prior (d,)."""
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
        """Return whether a gate accepts it: never a direction more than 90° off, whose rows do not show its sense."""
        behind = len(self.rows.residual) == 2 and self.rows.angle > 0.5 * math.pi and threshold < math.inf
        return self.converged and self.nis <= threshold and not behind

    def correction(self, robust: Robust | None) -> tuple[Array, float]:
        """Return the correction (n,), by arcs of directions, and its size: attitude, rad; optional states by their effect on the rows."""
        residual, H, noise, _, arc = self.rows
        L = np.linalg.cholesky(noise)
        L = L / np.diag(L)
        stretch = np.array([arc, arc, 1.0])[: len(residual)]
        weight = 1.0 if robust is None else self.weight(robust)
        innovation = L @ (stretch * np.linalg.solve(L, residual)) - H @ self.prior
        step = self.prior + self.covariance @ H.T @ np.linalg.solve(self.predicted + noise / weight, innovation)
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
    model: MeasurementModel,
    attitude: Array,
    others: Array,
    P: Array,
    turning: Callable[[Array, Array], Array],
    passes: int,
    threshold: float,
    robust: Robust | None = None,
) -> Linearization:
    """Return a measurement linearised at the state after its update, from 120° to either side too while the attitude is unknown."""
    zero = np.zeros(len(P))
    linearization = first = Linearization(
        attitude=attitude, others=others, covariance=P, prior=zero, rows=model(attitude, others)
    )
    if passes == 1:
        return first
    unknown = bool(np.trace(P[:3, :3]) >= UNKNOWN)
    tolerance = MIN_CORRECTION_UNKNOWN if unknown else RELINEARIZED
    done, trials = 1, 0
    while True:
        step, size = linearization.correction(robust)
        start = linearization
        converged = size < tolerance
        if converged or done >= passes:
            linearization = linearization if converged else replace(first, converged=False)
            if linearization.acceptable(threshold) or trials == 2 or not unknown:
                return linearization
            trials += 1
            done, start, step = 0, first, zero.copy()
            step[:3] = math.copysign(TURN_ASIDE, trials - 1.5) * least_certain_axis(P)
        now = quaternion.normalize(quaternion.multiply(start.attitude, quaternion.exp(step[:3])))
        now_others = turning(start.attitude, now)[3:, 3:] @ (start.others + step[3:])
        moved, prior = prior_at(first, now, now_others, turning)
        linearization = Linearization(
            attitude=now, others=now_others, covariance=moved, prior=prior, rows=model(now, now_others)
        )
        done += 1


def prior_at(
    prior: Linearization, attitude: Array, others: Array, turning: Callable[[Array, Array], Array]
) -> tuple[Array, Array]:
    """Return the covariance of the prior (n, n) in the tangent space of another state, and its mean minus that state (n,)."""
    P, back = seen_from(quaternion.multiply(quaternion.conjugate(prior.attitude), attitude), prior.covariance)
    T = turning(prior.attitude, attitude)
    return T @ P @ T.T, np.concatenate([back, T[3:, 3:] @ prior.others - others])


def seen_from(q: Array, covariance: Array) -> tuple[Array, Array]:
    """Return P of a prior (n, n) at the attitude rotated by q from its mean, and the rotation vector back to the mean (3,), rad."""
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


class Supervision:
    """The gate of a step-by-step filter: counters, restart candidate and the events reported up to now."""

    def __init__(self, gate: Gate | None) -> None:
        self.gate, self.sensors = gate, ()
        self.memory, self.counters = initial_counts(gate, None, ())
        self.candidate: GatedStepFilter | None = None
        self.reported = np.empty((0, 5))

    @property
    def events(self) -> tuple[Event, ...]:
        """Recoveries and lock-outs up to now, in order of time."""
        events = gate_events(self.reported, self.sensors)
        return in_order([*events, *last_lock_outs(self.counters, self.sensors)])

    def judge(self, filter: Any, sensor: str, outcome: int, update: Callable[[Any], int]) -> None:
        """Count the outcome of a measurement for a filter; ``update`` updates the restart candidate with it."""
        if self.gate is None:
            return
        s, recovery, limit = self._row_of(sensor), self.gate.recovery or 0, self.gate.lock_out_limit
        memory, counters = self.memory, self.counters
        events, number = np.vstack([self.reported, np.empty((2 + len(self.sensors), 5))]), len(self.reported)
        number, restart = gate_rules.judge_filter(
            outcome, filter.time, s, recovery, limit, counters, memory, events, number
        )
        if restart:
            self._start_candidate(filter, self.gate)
        if self.candidate is not None:
            self._judge_candidate(self.candidate, s, update(self.candidate))
        if self.candidate is not None and gate_rules.takes_over(s, recovery, counters, memory):
            number = gate_rules.recover(filter.time, s, limit, counters, memory, events, number)
            filter._become(self.candidate)
            filter._passes = int(memory[gate_rules.PASSES])
            self.candidate = None
        self.reported = events[:number]

    def _row_of(self, sensor: str) -> int:
        """Return the row of a sensor in the counters."""
        if sensor not in self.sensors:
            self.sensors = (*self.sensors, sensor)
            self.counters = np.vstack([self.counters, initial_counts(None, None, (sensor,))[1]])
        return self.sensors.index(sensor)

    def _start_candidate(self, filter: Any, gate: Gate) -> None:
        sigma = gate_rules.restart_attitude(gate.restart_attitude_sigma, self.memory)
        self.candidate = filter._restarted(sigma, gate_rules.restart_width(self.memory))
        gate_rules.reset_candidate(self.memory, filter.time, self.candidate.bias, np.diag(self.candidate.P)[3:6])

    def _judge_candidate(self, candidate: Any, sensor: int, outcome: int) -> None:
        """Count the outcome of a measurement for the restart candidate, and drop or widen it."""
        verdict = gate_rules.judge_candidate(
            outcome, candidate.nis, candidate.dim_z, sensor, self.counters, self.memory, candidate.bias
        )
        if verdict == gate_rules.DROPPED:
            self.candidate = None
        elif verdict == gate_rules.TOO_NARROW:
            self._widen(candidate)

    def _widen(self, candidate: Any) -> None:
        """Change the candidate to what it would be with a larger initial σ of its bias, if the initial σ limits it."""
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


class GatedStepFilter(StepFilter):
    """:class:`strapdown.StepFilter` with a gate and robust weights; ``weight`` is that of the last measurement."""

    def __init__(self, process_noise, initial, error_states=(), *, gate=None, robust=None, time=0.0, **options):
        check_arguments(gate=gate, robust=robust)
        super().__init__(process_noise, initial, error_states, **options)
        self.time = time
        self.gate, self.robust = gate, robust
        self.weight = 1.0
        self.refused: dict[str, int] = {}
        self._thresholds = np.full(3, np.inf) if gate is None else gate.thresholds
        state = modelling.begin(initial, self.error_states)
        self._restart_bias_variance = restart_bias_variance(gate, state)
        self._supervision, self._passes = Supervision(gate), 1
        self._restart_prior = self.time, *restart_states(state, self.error_states)

    @property
    def events(self) -> tuple[Event, ...]:
        """Recoveries and lock-outs up to now, in order of time."""
        return self._supervision.events

    def predict(self, delta_theta, dt):
        """Propagate over one gyro increment, the restart candidate too."""
        if self._supervision.candidate is not None:
            self._supervision.candidate.predict(delta_theta, dt)
        super().predict(delta_theta, dt)
        self.time += dt

    def _measure(self, measurement, sensor):
        """Update with a measurement; count the outcome for the gate."""
        outcome = self._judged(measurement, sensor)
        if outcome != ACCEPTED:
            self.refused[sensor] = self.refused.get(sensor, 0) + 1
        self._supervision.judge(self, sensor, outcome, lambda candidate: candidate._judged(measurement, sensor))
        return outcome == ACCEPTED

    def _judged(self, measurement: Any, sensor: str) -> int:
        """Update with a measurement; return ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``."""
        R = rotation_matrix(tuple(self.attitude.tolist()))
        if measurement.kind == "heading" and not has_heading(R, measurement.z):
            return PASSED_OVER
        threshold = float(self._thresholds[KINDS[measurement.kind] - 1])
        others = np.concatenate([self.bias, self.values])
        rows = partial(self._rows_at, measurement, self._model(sensor, measurement.kind))
        turning = self._motion.turning_matrix
        linearization = linearize(rows, self.attitude, others, self.P, turning, self._passes, threshold, self.robust)
        self.nis = linearization.nis
        self.dim_z = len(linearization.rows.residual)
        unknown = self._passes > 1 and measurement.kind == "heading" and tilt_unknown(self.attitude, self.P)
        if unknown or not linearization.acceptable(threshold):
            self.weight = 0.0
            self._show_refused(linearization, measurement.length)
            return PASSED_OVER if unknown else REFUSED
        self.weight = 1.0 if self.robust is None else linearization.weight(self.robust)
        self._accept(linearization, measurement.length)
        return ACCEPTED

    def _accept(self, linearization: Linearization, unit: float) -> None:
        """Correct the state at which a measurement is linearised by filterpy's update; the rows are multiplied by ``unit``."""
        self.attitude = linearization.attitude
        self.bias, self.values = linearization.others[:3], linearization.others[3:]
        self.P, self.x = linearization.covariance, linearization.prior
        H, R = unit * linearization.rows.H, linearization.rows.noise * (unit**2 / self.weight)
        filterpy.kalman.ExtendedKalmanFilter.update(
            self, unit * linearization.rows.residual, HJacobian=lambda x: H, Hx=lambda x: H @ x, R=R
        )
        correction, self.x = self.x, np.zeros(len(self.x))
        self._reset(correction, self.P, far=self._passes > 1 and bool(np.trace(self.P[:3, :3]) > KNOWN))
        self.P_post = self.P.copy()

    def _reset(self, correction: Array, P: Array, *, far: bool) -> None:
        """Correct the state and transform P to its tangent space; ``far``: a large rotation of a nearly unknown attitude."""
        before, turn = self.attitude, quaternion.exp(correction[:3])
        self.attitude = quaternion.normalize(quaternion.multiply(before, turn))
        self.bias, self.values = self.bias + correction[3:6], self.values + correction[6:]
        if far:
            P, _ = seen_from(turn, P)
        else:
            G = np.eye(len(P))
            G[:3, :3] = kinematics.right_jacobian(correction[:3])
            P = G @ P @ G.T
        T = self._motion.turning_matrix(before, self.attitude)
        self.values, P = T[6:, 6:] @ self.values, T @ P @ T.T
        self.P = P

    def _show_refused(self, linearization: Linearization, unit: float) -> None:
        """Set residual and covariance of a refused measurement."""
        self.z, self.y = unit * linearization.rows.residual, unit * linearization.innovation
        self.S = unit**2 * (linearization.predicted + linearization.rows.noise)

    def _rows_at(self, measurement: Any, model: Any, attitude: Array, others: Array) -> Rows:
        """Return a measurement's rows at an attitude (4,) and (b, c) (3 + m,), by the function of the kernels."""
        kernels = machine.instance(row_kernels, STRUCTURE=model.structure)
        x, iterated = np.concatenate([attitude, others]), self._passes > 1
        H, y, axes, (squared, along), _ = kernels.rows_and_axes(0, x, measurement, model.numbers, 0.0, iterated)
        y, basis, sine = np.array(y), np.array(axes), math.sqrt(squared)
        angle = math.atan2(sine, along)
        arc = 1.0 if sine < 1e-9 else angle / sine
        return Rows(y, np.array(H, np.float64), basis @ measurement.noise @ basis.T, angle, arc)

    def _restarted(self, attitude_sigma: float, bias_width: float) -> GatedStepFilter:
        """Return a restart candidate: optional states at their prior, attitude and bias independent of them, with the given uncertainty."""
        (time, *prior), m = self._restart_prior, len(self.values)
        values, Pc = aged_states(self._motion, *prior, self.time - time)
        P = np.zeros((6 + m, 6 + m))
        P[:3, :3] = attitude_sigma**2 * np.eye(3)
        P[3:6, 3:6] = self.P[3:6, 3:6] + bias_width**2 * np.diag(self._restart_bias_variance)
        P[6:, 6:] = Pc
        return self._candidate(State(attitude=self.attitude, bias=self.bias, values=values, covariance=P))

    def _candidate(self, state: State) -> GatedStepFilter:
        """Return a restart candidate in this state."""
        candidate = GatedStepFilter(
            self.process_noise, state, self.error_states, gate=self.gate, robust=self.robust, time=self.time
        )
        candidate._models = self._models
        candidate._passes = WIDE_PASSES
        return candidate

    def _become(self, other: GatedStepFilter) -> None:
        """Take over the state of a restart candidate."""
        self.attitude, self.bias, self.values, self.P = other.attitude, other.bias, other.values, other.P
