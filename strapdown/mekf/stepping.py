"""The step face: the same filter on filterpy, for people who look inside."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, quaternion
from strapdown.checks import Array, InputError, array, covariance, finite, non_negative, positive, unit_quaternions
from strapdown.kernels import filter_loop, filter_step
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf.states import ProcessNoise, State, covariance_matrices
from strapdown.records import Event
from strapdown.robustness import WIDE_PASSES, Gate, Robust, Rows, linearise, tilt_unknown
from strapdown.vectors import triad

Measured = Callable[[Array], Rows]
"""A measurement as a function of the attitude it is linearised at."""


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """The same filter step by step, on filterpy: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` work as its users expect.

    ``x`` is the error state (δθ, δb) (6,): zero before and after each update, because the correction moves into ``attitude`` and
    ``bias``; ``x_post`` keeps the last correction. ``attitude`` (4,) is q_fb, ``bias`` (3,) in rad/s, ``time`` in s, ``nis`` that of the
    last measurement and ``weight`` that it was taken in with. ``refused`` counts by sensor what the gate refused, ``late`` what came later
    than the look-back, ``repeated`` gyro samples without an interval; ``events`` tells of recoveries.

    Parameters
    ----------
    process_noise : ProcessNoise
    initial : State
    gate : Gate, optional
    robust : Robust, optional
    look_back : float
        s; a measurement may be given so long after its time. The filter goes back to that time, takes it in, and does again what followed:
        the result is that of the filter which had it in order. What it did in that span is kept, in memory.
    time : float
        Time of the initial state, s.
    """

    def __init__(
        self,
        process_noise: ProcessNoise,
        initial: State,
        *,
        gate: Gate | None = None,
        robust: Robust | None = None,
        look_back: float = 0.0,
        time: float = 0.0,
    ) -> None:
        super().__init__(dim_x=6, dim_z=2)
        self.process_noise = process_noise
        self.gate = gate
        self.robust = robust
        self.look_back = non_negative("look_back", look_back, unit="s")
        self.time = finite("time", time, unit="s")
        self.attitude: Array = initial.attitude.copy()
        self.bias: Array = initial.bias.copy()
        self.x = np.zeros(6)
        self.P = initial.covariance.copy()
        self.y = np.zeros(2)
        self.nis = 0.0
        self.weight = 1.0
        self.late = 0
        self.repeated = 0
        self.refused: dict[str, int] = {}
        self.events: tuple[Event, ...] = ()
        self._initial_covariance = initial.covariance
        self._passes = 1
        self._in_a_row: dict[str, int] = {}
        self._challenger: _Challenger | None = None
        self._done: list[_Done] = []

    def predict(self, delta_theta: ArrayLike, dt: float) -> None:
        """Propagate over one gyro increment (3,), rad, of dt seconds; a repeated sample (dt = 0) is counted and changes nothing."""
        increment = array("delta_theta", delta_theta, (3,))
        step = non_negative("dt", dt, unit="s")
        if step == 0.0:
            self.repeated += 1
            return
        self._remember(_Done(kept=self._kept(), dt=step, increment=increment))
        self._predict(increment, step)

    def _predict(self, increment: Array, step: float) -> None:
        parts = int(np.linalg.norm(increment) / LARGEST_ANGLE) + 1
        for _ in range(parts):
            phi = increment / parts - self.bias * (step / parts)
            self.F, self.Q = transition_and_noise(phi, step / parts, self.process_noise)
            super().predict()
            self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(phi)))
        self.time += step
        if self._challenger is not None:
            self._challenger.filter._predict(increment, step)

    def update_direction(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with a measured unit direction (3,) of a known one (3,): two degrees of freedom.

        The noise is ``sigma``, rad across it, or one each body axis (3,), or ``covariance`` (3, 3) in body axes, of which the part across
        the direction counts. ``sensor`` names what the gate counts by; ``time`` is that of validity, s, if it is not now. Returns whether
        it was taken in.
        """
        z = array("vector_b", vector_b, (3,))
        frame = triad(array("reference_f", reference_f, (3,)))
        C = _body_covariance(sigma, covariance)

        def rows(attitude: Array) -> Rows:
            u, v, r = frame @ quaternion.to_matrix(attitude)
            basis = np.stack([u, v])
            H = np.stack([-v, u])
            return basis @ z, H, basis @ C @ basis.T, *_arc(basis @ z, float(r @ z))

        return self._measure(rows, sensor, time)

    def update_vector(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with a measured vector (3,) of a known one (3,), noise in their unit: three degrees of freedom. Else as a direction."""
        r = array("reference_f", reference_f, (3,))
        z = array("vector_b", vector_b, (3,))
        frame = triad(r)
        length = float(np.linalg.norm(r))
        C = _body_covariance(sigma, covariance)

        def rows(attitude: Array) -> Rows:
            basis = frame @ quaternion.to_matrix(attitude)
            H = np.stack([-length * basis[1], length * basis[0], np.zeros(3)])
            residual = basis @ z - np.array([0.0, 0.0, length])
            arc = _arc(residual[:2] / length, float(basis[2] @ z) / length)
            return residual, H, basis @ C @ basis.T, *arc

        return self._measure(rows, sensor, time)

    def update_heading(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: float,
        *,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with the heading of a measured vector's horizontal part: one degree of freedom, ``sigma`` rad."""
        z = array("vector_b", vector_b, (3,))
        reference = array("reference_f", reference_f, (3,))
        variance = positive("sigma", sigma, unit="rad") ** 2

        def rows(attitude: Array) -> Rows:
            R = quaternion.to_matrix(attitude)
            m = R @ z
            error = filter_loop.heading_error(tuple(R.ravel()), z, reference)
            H = (np.array([*(-m[2] * m[:2] / (m[:2] @ m[:2])), 1.0]) @ R)[None]
            return np.array([error]), H, np.array([[variance]]), 0.0, 1.0

        return self._measure(rows, sensor, time, of_heading=True)

    def update_attitude(
        self,
        attitude: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with a measured attitude q_fb (4,): three degrees of freedom, noise in rad about the body axes. Else as a direction."""
        measured = unit_quaternions("attitude", array("attitude", attitude, (4,)))
        C = _body_covariance(sigma, covariance)

        def rows(estimate: Array) -> Rows:
            residual = quaternion.log(quaternion.multiply(quaternion.conjugate(estimate), measured))
            return residual, np.eye(3), C, 0.0, 1.0

        return self._measure(rows, sensor, time)

    def _measure(self, rows: Measured, sensor: str, time: float | None, of_heading: bool = False) -> bool:
        """Take in a measurement now, or at its time and what followed after it."""
        when = self.time if time is None else finite("time", time, unit="s")
        if when > self.time:
            raise InputError(f"time is {when:.9g} s, after the filter's {self.time:.9g} s; predict up to it first")
        if when == self.time:
            return self._take_now(rows, sensor, of_heading)
        if when < self.time - self.look_back or not self._done or when < self._done[0].kept["time"]:
            self.late += 1
            return False
        first = next(k for k, done in enumerate(self._done) if done.end > when)
        after, self._done = self._done[first:], self._done[:first]
        self._restore(after[0].kept)
        split, after = after[0], after[1:]
        head = when - self.time
        if head > 0.0:
            self._again(_Done(kept=self._kept(), dt=head, increment=split.increment * (head / split.dt)))
        accepted = self._take_now(rows, sensor, of_heading)
        rest = split.dt - head
        self._again(_Done(kept=self._kept(), dt=rest, increment=split.increment * (rest / split.dt)))
        for done in after:
            self._again(done)
        return accepted

    def _take_now(self, rows: Measured, sensor: str, of_heading: bool) -> bool:
        self._remember(_Done(kept=self._kept(), rows=rows, sensor=sensor, of_heading=of_heading))
        accepted = self._correct(rows, of_heading)
        if not accepted:
            self.refused[sensor] = self.refused.get(sensor, 0) + 1
        if self.gate is not None:
            self._oversee(rows, sensor, accepted, of_heading)
        return bool(accepted)

    def _correct(self, rows: Measured, of_heading: bool) -> bool | None:
        """Take in a measurement; return whether it was, None where it was passed over."""
        threshold = np.inf if self.gate is None else float(self.gate.thresholds[len(rows(self.attitude)[0]) - 1])
        seen = linearise(rows, self.attitude, self.P, self._passes, threshold)
        self.nis = seen.nis
        self.dim_z = len(seen.residual)
        unknown = self._passes > 1 and of_heading and tilt_unknown(self.attitude, self.P)
        if unknown or not seen.acceptable(threshold):
            self.weight = 0.0
            self.y, self.S = seen.innovation, seen.predicted + seen.noise
            return None if unknown else False
        self.weight = 1.0 if self.robust is None else seen.weight(self.robust)
        self.attitude, self.P = seen.attitude, seen.covariance
        self.x = np.array([*seen.prior, 0.0, 0.0, 0.0])
        H = np.hstack([seen.H, np.zeros((self.dim_z, 3))])
        super().update(seen.residual, HJacobian=lambda x: H, Hx=lambda x: H @ x, R=seen.noise / self.weight)
        correction = self.x[:3]
        self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(correction)))
        self.bias = self.bias + self.x[3:]
        G = np.eye(6)
        G[:3, :3] = kinematics.right_jacobian(correction)
        self.P = G @ self.P @ G.T
        self.P_post = self.P.copy()
        self.x = np.zeros(6)
        return True

    def _oversee(self, rows: Measured, sensor: str, accepted: bool | None, of_heading: bool) -> None:
        """Count refusals, and start, drop or follow a challenger (:class:`strapdown.robustness.Gate`)."""
        gate = self.gate
        assert gate is not None
        in_a_row = self._in_a_row.get(sensor, 0)
        if accepted is not None:
            self._in_a_row[sensor] = 0 if accepted else in_a_row + 1
        if not gate.recovery:
            return
        if accepted is False and self._challenger is None:
            self._challenger = _Challenger(filter=self._restarted(gate), since=self.time)
        rival = self._challenger
        if rival is None:
            return
        agreed = rival.filter._correct(rows, of_heading)
        if agreed is False:
            rival.misses += 1
        elif agreed and self._in_a_row.get(sensor, 0) > 0:
            rival.hits += 1
        if rival.misses > rival.hits or not any(self._in_a_row.values()):
            self._challenger = None
        elif self._in_a_row.get(sensor, 0) >= gate.recovery and rival.hits >= gate.recovery:
            number = self._in_a_row[sensor]
            told = Event(kind="recovery", start=rival.since, end=self.time, sensor=sensor, value=float(number))
            self.events = (*self.events, told)
            self.attitude, self.bias, self.P = rival.filter.attitude, rival.filter.bias, rival.filter.P
            self._passes = WIDE_PASSES
            self._in_a_row = {}
            self._challenger = None

    def _restarted(self, gate: Gate) -> StepFilter:
        P = np.zeros((6, 6))
        P[:3, :3] = gate.restart_attitude_sigma**2 * np.eye(3)
        P[3:, 3:] = self.P[3:, 3:] + np.diag(gate.restart_bias_variance(self._initial_covariance))
        state = State(attitude=self.attitude, bias=self.bias, covariance=P)
        rival = StepFilter(self.process_noise, state, gate=gate, robust=self.robust, time=self.time)
        rival._passes = WIDE_PASSES
        return rival

    def _remember(self, done: _Done) -> None:
        """Keep what is done for as long as a measurement may still come in before it."""
        if self.look_back == 0.0:
            return
        self._done.append(done)
        while self._done[0].end < self.time - self.look_back:
            del self._done[0]

    def _again(self, done: _Done) -> None:
        if done.rows is None:
            self._remember(_Done(kept=self._kept(), dt=done.dt, increment=done.increment))
            self._predict(done.increment, done.dt)
        else:
            self._take_now(done.rows, done.sensor, done.of_heading)

    def _kept(self) -> dict[str, Any]:
        """Return what must come back when the filter goes back to this moment; nothing where it never does."""
        if self.look_back == 0.0:
            return {}
        rival = self._challenger
        return {
            "time": self.time,
            "attitude": self.attitude,
            "bias": self.bias,
            "P": self.P.copy(),
            "refused": dict(self.refused),
            "events": self.events,
            "_passes": self._passes,
            "_in_a_row": dict(self._in_a_row),
            "_challenger": None if rival is None else copy.deepcopy(rival),
        }

    def _restore(self, kept: dict[str, Any]) -> None:
        for name, value in kept.items():
            setattr(self, name, value)


@dataclass(frozen=True, kw_only=True)
class _Done:
    """A prediction, or a measurement, that the step face took in, with what it was before."""

    kept: dict[str, Any]
    dt: float = 0.0
    increment: Array = field(default_factory=lambda: np.zeros(3))
    rows: Measured | None = None
    sensor: str = ""
    of_heading: bool = False

    @property
    def end(self) -> float:
        """Time after it, s."""
        return float(self.kept["time"]) + self.dt


@dataclass(kw_only=True)
class _Challenger:
    """A filter beside the filter, and how it did."""

    filter: StepFilter
    since: float
    hits: int = 0
    misses: int = 0


def _body_covariance(sigma: ArrayLike | None, covariance_b: ArrayLike | None) -> Array:
    """Return the covariance (3, 3) in body axes of one σ, one an axis, or itself."""
    if (sigma is None) == (covariance_b is None):
        raise InputError("give either sigma or covariance: the noise of the measurement")
    if sigma is None:
        return covariance("covariance", np.asarray(covariance_b), 3)
    spread = np.array([positive("sigma", value) for value in np.broadcast_to(np.asarray(sigma, np.float64), 3)])
    return np.diag(spread**2)


def _arc(across: Array, along: float) -> tuple[float, float]:
    """Return the angle between a measured and a predicted direction, rad, and that over the length of the part across."""
    sine = float(np.linalg.norm(across))
    angle = math.atan2(sine, along)
    return angle, 1.0 if sine < 1e-9 else angle / sine


def transition_and_noise(phi: ArrayLike, dt: float, process_noise: ProcessNoise) -> tuple[Array, Array]:
    """Return Φ and Q (6, 6) of the error state over a turn φ = ω dt (3,) at constant rate, |φ| ≤ 1/3 rad.

    The kernels' own formulas (:mod:`strapdown.kernels.filter_step`), as matrices.
    """
    turn = tuple(float(component) for component in array("phi", phi, (3,)))
    phi11, phi12 = filter_step.transition(turn, dt)
    q11, q12, q22 = filter_step.process_noise(
        turn, dt, process_noise.angle_random_walk**2, process_noise.rate_random_walk**2
    )
    F = np.eye(6)
    F[:3, :3] = np.reshape(phi11, (3, 3))
    F[:3, 3:] = np.reshape(phi12, (3, 3))
    return F, covariance_matrices(np.array([*q11, *q12, q22, 0.0, 0.0, q22, 0.0, q22]))
