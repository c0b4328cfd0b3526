"""The step face: the same filter on filterpy, for people who look inside."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, quaternion
from strapdown.checks import (
    Array,
    InputError,
    array,
    covariance,
    finite,
    non_negative,
    numbers,
    positive,
    unit_quaternions,
)
from strapdown.kernels import filter_loop, filter_step
from strapdown.kernels.robust_gate import WIDE_PASSES
from strapdown.kernels.robust_step import ACCEPTED, KNOWN, PASSED_OVER, REFUSED
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.mekf.judging import Judging, ToldEvents
from strapdown.mekf.states import ProcessNoise, State, check_arguments, covariance_matrices, restart_bias_variance
from strapdown.records import LARGEST_TURN
from strapdown.robustness import Gate, Linearised, Monitor, Robust, Rows, linearise, seen_from, tilt_unknown
from strapdown.vectors import need_level, need_unit, triad

CLOCK_SHARE = 1e-3
"""Rounding of a clock is no more than this share of the longest step."""

Measured = Callable[[Array], Rows]
"""A measurement as a function of the attitude it is linearised at."""


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """The same filter step by step, on filterpy: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` work as its users expect.

    ``x`` is the error state (δθ, δb) (6,): zero before and after each update, because the correction moves into ``attitude`` and
    ``bias``; ``x_post`` keeps the last correction. ``attitude`` (4,) is q_fb, ``bias`` (3,) in rad/s, ``time`` in s; ``nis`` is that of
    the last measurement not skipped and ``weight`` what it was taken in with. ``refused`` counts by sensor what the gate refused,
    ``skipped`` what was missing (NaN) or a heading of a vertical vector, ``late`` what came later than the look-back, ``repeated`` gyro
    samples without an interval; ``events`` tells of recoveries and lock-outs.

    Parameters
    ----------
    process_noise : ProcessNoise
    initial : State
        Of the end of a part of a record (:func:`strapdown.mekf.run_on`), it goes on with what the gate remembers; give its ``time``.
    gate : Gate, optional
    robust : Robust, optional
    monitor : Monitor, optional
        Tells in ``events`` when the running NIS leaves its bounds. What it needs of each measurement is kept, in memory.
    look_back : float
        s; a measurement may be given so long after its time. The filter goes back to that time, takes it in, and does again what followed:
        the result is that of the filter which had it in order. What it did in that span is kept, in memory. Measurements of one time are
        then taken in the order of ``sensors``, in whatever order they are given; without a look-back in that in which they are given.
    sensors : sequence of str, optional
        Names of the sensors in the order of the record's series. Others come after them, in the order in which they first appear.
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
        monitor: Monitor | None = None,
        look_back: float = 0.0,
        sensors: Sequence[str] = (),
        time: float = 0.0,
    ) -> None:
        check_arguments(process_noise=process_noise, initial=initial, gate=gate, robust=robust, monitor=monitor)
        names = sensor_names(sensors)
        super().__init__(dim_x=6, dim_z=2)
        self.process_noise = process_noise
        self.gate = gate
        self.robust = robust
        self.look_back = non_negative("look_back", look_back, unit="s")
        self.time = finite("time", time, unit="s")
        self.attitude: Array = initial.attitude.copy()
        self.bias: Array = initial.bias.copy()
        self.x, self.x_prior, self.x_post = np.zeros((3, 6))
        self.P = initial.covariance.copy()
        self.y, self.z, self.K = np.zeros(2), np.zeros(2), np.zeros((6, 2))
        self.nis = 0.0
        self.weight = 1.0
        self.late = 0
        self.repeated = 0
        self.refused: dict[str, int] = {}
        self._restart_bias_variance = restart_bias_variance(gate, initial)
        self._judging: Judging[StepFilter] = Judging(gate, initial.gate, monitor)
        self._passes = self._judging.passes
        if initial.gate is not None and self._judging.challenged:
            rival = initial.gate.challenger
            self._judging.challenger = self._rival(rival[:4], rival[4:7], covariance_matrices(rival[7:]))
        self._past = _Past()
        self._places = {name: place for place, name in enumerate(names)}
        self._missing: dict[str, int] = {}
        self._vertical: dict[str, int] = {}
        self._start = self.time
        self._time_rest = 0.0
        self._steps = 0
        self._longest = 0.0

    events = ToldEvents()

    @property
    def skipped(self) -> dict[str, int]:
        """Measurements that told nothing, by sensor: missing (NaN) ones and headings of a vertical vector."""
        names = dict.fromkeys((*self._missing, *self._vertical))
        return {name: self._missing.get(name, 0) + self._vertical.get(name, 0) for name in names}

    def predict(self, delta_theta: ArrayLike, dt: float | None = None, *, time: float | None = None) -> None:
        """Propagate over one gyro increment (3,), rad; a repeated sample (of no length) is counted and changes nothing.

        Give ``time``, when it ends, s, where there are stamps: the filter's clock is theirs then. By ``dt``, its length in s, the clock
        goes on by a compensated sum; a measurement's time is equal to it within the rounding of a plain one.
        """
        increment = array("delta_theta", delta_theta, (3,))
        if np.max(np.abs(increment)) > LARGEST_TURN:
            raise InputError(
                f"delta_theta is {increment}, and nothing turns so far between two samples; it is the rate times dt, rad: check the unit"
            )
        step, end = self._ending(dt, time)
        if step == 0.0:
            self.repeated += 1
            return
        self._longest = max(self._longest, step)
        self._remember(_Done(kept=self._kept(), end=end, dt=step, increment=increment))
        self._predict(increment, step, end)

    def _ending(self, dt: float | None, time: float | None) -> tuple[float, float]:
        """Return the length and the end of a step, s, and move the rest of the clock's sum."""
        if time is None:
            if dt is None:
                raise InputError("dt is None; give it, the length of the step in s, or time, when it ends")
            step = non_negative("dt", dt, unit="s")
            end, self._time_rest = _sum_and_rest(self.time, step + self._time_rest)
            self._steps += 1
            return step, end
        end = finite("time", time, unit="s")
        room = self._rounding(end)
        if end < self.time - room:
            raise InputError(f"time is {end:.9g} s, before the filter's {self.time:.9g} s; give the samples in order")
        step = max(end - self.time, 0.0)
        if dt is not None and abs(non_negative("dt", dt, unit="s") - step) > room + CLOCK_SHARE * step:
            raise InputError(
                f"dt is {dt:.9g} s, but from {self.time:.9g} s to time it is {step:.9g} s; leave out one of them"
            )
        self._steps, self._time_rest = 0, 0.0
        return step, end

    def _rounding(self, time: float) -> float:
        """Return how far a time may lie from the filter's clock and yet be meant for it, s: the rounding of as many sums as there were."""
        ulp = float(np.spacing(max(abs(time), abs(self.time), abs(self._start))))
        gathered = self._steps * ulp
        return 4.0 * ulp + (min(gathered, CLOCK_SHARE * self._longest) if self._longest else gathered)

    def _predict(self, increment: Array, step: float, end: float) -> None:
        parts = int(np.linalg.norm(increment) / LARGEST_ANGLE) + 1
        for _ in range(parts):
            phi = increment / parts - self.bias * (step / parts)
            self.F, self.Q = transition_and_noise(phi, step / parts, self.process_noise)
            super().predict()
            self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(phi)))
        self.time = end
        if self._judging.challenger is not None:
            self._judging.challenger._predict(increment, step, end)

    def update(self, *arguments: Any, **options: Any) -> None:
        """Refuse filterpy's own update by any ``Hx``: it would leave the correction in ``x``, outside ``attitude`` and ``bias``."""
        raise InputError(
            "update() by HJacobian and Hx knows no attitude, and would leave its correction in x; use update_direction, update_vector, "
            "update_heading or update_attitude"
        )

    def predict_update(self, *arguments: Any, **options: Any) -> None:
        """Refuse filterpy's own step, as :meth:`update` does."""
        raise InputError(
            "predict_update() would update by Hx, which knows no attitude; use predict, then update_direction or another"
        )

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
        it was taken in; NaN is a missing one, which is skipped.
        """
        z = array(_of(sensor, "vector_b"), vector_b, (3,), allow_nan=True)
        if np.isnan(z).any():
            return self._skip(sensor)
        need_unit(_of(sensor, "vector_b"), z)
        frame = triad(array(_of(sensor, "reference_f"), reference_f, (3,)))
        C = _body_covariance(sigma, covariance)
        return self._measure(partial(_direction_rows, z, frame, C), sensor, time)

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
        z = array(_of(sensor, "vector_b"), vector_b, (3,), allow_nan=True)
        if np.isnan(z).any():
            return self._skip(sensor)
        r = array(_of(sensor, "reference_f"), reference_f, (3,))
        C = _body_covariance(sigma, covariance)
        return self._measure(partial(_vector_rows, z, triad(r), float(np.linalg.norm(r)), C), sensor, time)

    def update_heading(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: float,
        *,
        sensor: str = "",
        time: float | None = None,
    ) -> bool:
        """Update with the heading of a measured unit vector's horizontal part: one degree of freedom, ``sigma`` rad.

        One that the estimate takes for vertical shows no heading and is skipped.
        """
        z = array(_of(sensor, "vector_b"), vector_b, (3,), allow_nan=True)
        if np.isnan(z).any():
            return self._skip(sensor)
        need_unit(_of(sensor, "vector_b"), z)
        reference = triad(array(_of(sensor, "reference_f"), reference_f, (3,)))[2]
        need_level(_of(sensor, "reference_f"), reference)
        variance = positive(_of(sensor, "sigma"), sigma, unit="rad") ** 2
        return self._measure(partial(_heading_rows, z, reference, variance), sensor, time, of_heading=True)

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
        given = array(_of(sensor, "attitude"), attitude, (4,), allow_nan=True)
        if np.isnan(given).any():
            return self._skip(sensor)
        measured = unit_quaternions(_of(sensor, "attitude"), given)
        C = _body_covariance(sigma, covariance)
        return self._measure(partial(_attitude_rows, measured, C), sensor, time)

    def _skip(self, sensor: str) -> bool:
        self._missing[sensor] = self._missing.get(sensor, 0) + 1
        return False

    def _measure(self, rows: Measured, sensor: str, time: float | None, of_heading: bool = False) -> bool:
        """Take in a measurement at its time and its sensor's place among those of that time, and do again what comes after it."""
        when = self.time if time is None else finite("time", time, unit="s")
        room = self._rounding(when)
        when = self.time if abs(when - self.time) <= room else when
        if when > self.time:
            raise InputError(f"time is {when:.9g} s, after the filter's {self.time:.9g} s; predict up to it first")
        place = self._places.setdefault(sensor, len(self._places))
        if when < self.time and (
            not self._past.done or when < max(self.time - self.look_back, self._past.done[0].kept["time"]) - room
        ):
            self.late += 1
            return False
        first = len(self._past.done)
        while first and self._comes_after(self._past.done[first - 1], when, place, room):
            first -= 1
        after, self._past.done = self._past.done[first:], self._past.done[:first]
        if not after:
            return self._take_now(rows, sensor, of_heading)
        self._restore(after[0].kept)
        head, tail = after[0].parted(when if when > self.time + room else self.time)
        if head is not None:
            self._again(head)
        accepted = self._take_now(rows, sensor, of_heading)
        for done in (tail, *after[1:]):
            self._again(done)
        return accepted

    def _comes_after(self, done: _Done, when: float, place: int, room: float) -> bool:
        """Return whether what was done comes after a measurement of that time and that place among the sensors."""
        if done.end > when + room:
            return True
        return done.rows is not None and done.end >= when - room and self._places[done.sensor] > place

    def _take_now(self, rows: Measured, sensor: str, of_heading: bool) -> bool:
        self._remember(_Done(kept=self._kept(), end=self.time, rows=rows, sensor=sensor, of_heading=of_heading))
        shown = not of_heading or bool(rows(self.attitude)[1].any())
        outcome = self._correct(rows, of_heading)
        if not shown:
            self._vertical[sensor] = self._vertical.get(sensor, 0) + 1
        elif outcome != ACCEPTED:
            self.refused[sensor] = self.refused.get(sensor, 0) + 1
        self._judging.judge(self, sensor, outcome, lambda rival: rival._correct(rows, of_heading))
        return outcome == ACCEPTED

    def _correct(self, rows: Measured, of_heading: bool) -> int:
        """Take in a measurement; return ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``."""
        if of_heading and not rows(self.attitude)[1].any():
            return PASSED_OVER  # that of a vertical vector
        threshold = np.inf if self.gate is None else float(self.gate.thresholds[len(rows(self.attitude)[0]) - 1])
        seen = linearise(rows, self.attitude, self.P, self._passes, threshold)
        self.nis = seen.nis
        self.dim_z = len(seen.residual)
        unknown = self._passes > 1 and of_heading and tilt_unknown(self.attitude, self.P)
        if unknown or not seen.acceptable(threshold):
            self.weight = 0.0
            show_refused(self, seen)
            return PASSED_OVER if unknown else REFUSED
        self.weight = 1.0 if self.robust is None else seen.weight(self.robust)
        self.attitude, self.P = seen.attitude, seen.covariance
        self.x = np.array([*seen.prior, 0.0, 0.0, 0.0])
        H = np.hstack([seen.H, np.zeros((self.dim_z, 3))])
        super().update(seen.residual, HJacobian=lambda x: H, Hx=lambda x: H @ x, R=seen.noise / self.weight)
        correction = self.x[:3]
        self._move(self.x)
        if self._passes > 1 and np.trace(self.P[:3, :3]) > KNOWN:
            self.P, _ = seen_from(quaternion.exp(correction), self.P)
        else:
            G = np.eye(6)
            G[:3, :3] = kinematics.right_jacobian(correction)
            self.P = G @ self.P @ G.T
        self.P_post = self.P.copy()
        self.x = np.zeros(6)
        return ACCEPTED

    def _move(self, correction: Array) -> None:
        self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(correction[:3])))
        self.bias = self.bias + correction[3:]

    def _restarted(self, attitude_sigma: float, bias_width: float) -> StepFilter:
        P = np.zeros((6, 6))
        P[:3, :3] = attitude_sigma**2 * np.eye(3)
        P[3:, 3:] = self.P[3:, 3:] + bias_width**2 * np.diag(self._restart_bias_variance)
        return self._rival(self.attitude, self.bias, P)

    def _rival(self, attitude: Array, bias: Array, P: Array) -> StepFilter:
        """Return a challenger in this state."""
        state = State(attitude=attitude, bias=bias, covariance=P)
        rival = StepFilter(self.process_noise, state, gate=self.gate, robust=self.robust, time=self.time)
        rival._passes = WIDE_PASSES
        return rival

    def _become(self, other: StepFilter) -> None:
        self.attitude, self.bias, self.P = other.attitude, other.bias, other.P

    def _remember(self, done: _Done) -> None:
        """Keep what is done for as long as a measurement may still come in before it."""
        if self.look_back == 0.0:
            return
        self._past.done.append(done)
        oldest = self.time - self.look_back - self._rounding(self.time)
        while self._past.done[0].end < oldest:
            del self._past.done[0]

    def _again(self, done: _Done) -> None:
        if done.rows is None:
            self._remember(_Done(kept=self._kept(), end=done.end, dt=done.dt, increment=done.increment))
            self._predict(done.increment, done.dt, done.end)
        else:
            self._take_now(done.rows, done.sensor, done.of_heading)

    def _kept(self) -> dict[str, Any]:
        """Return what must come back when the filter goes back to this moment; nothing where it never does."""
        if self.look_back == 0.0:
            return {}
        return {
            "time": self.time,
            "attitude": self.attitude,
            "bias": self.bias,
            "P": self.P.copy(),
            "refused": dict(self.refused),
            "_vertical": dict(self._vertical),
            "_passes": self._passes,
            "_judging": self._judging.copied(),
        }

    def _restore(self, kept: dict[str, Any]) -> None:
        for name, value in kept.items():
            setattr(self, name, value)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Done:
    """A prediction, or a measurement, that the step face took in, with what it was before."""

    kept: dict[str, Any]
    end: float
    """Time after it, s."""
    dt: float = 0.0
    increment: Array = field(default_factory=lambda: np.zeros(3))
    rows: Measured | None = None
    sensor: str = ""
    of_heading: bool = False

    def parted(self, time: float) -> tuple[_Done | None, _Done]:
        """Return a prediction as its parts before and after a time; whole, and None before it, where it begins then or is none."""
        begin = float(self.kept["time"])
        if self.rows is not None or time <= begin:
            return None, self
        share = (time - begin) / (self.end - begin)
        head = replace(self, end=time, dt=share * self.dt, increment=share * self.increment)
        return head, replace(self, dt=self.dt - head.dt, increment=self.increment - head.increment)


@dataclass
class _Past:
    """What the step face did and may have to do again: one object, for Saver makes an array of a list, and finds no shape."""

    done: list[_Done] = field(default_factory=list)


def _direction_rows(z: Array, frame: Array, C: Array, attitude: Array) -> Rows:
    u, v, r = frame @ quaternion.to_matrix(attitude)
    basis = np.stack([u, v])
    H = np.stack([-v, u])
    return basis @ z, H, basis @ C @ basis.T, *_arc(basis @ z, float(r @ z))


def _vector_rows(z: Array, frame: Array, length: float, C: Array, attitude: Array) -> Rows:
    basis = frame @ quaternion.to_matrix(attitude)
    H = np.stack([-length * basis[1], length * basis[0], np.zeros(3)])
    residual = basis @ z - np.array([0.0, 0.0, length])
    arc = _arc(residual[:2] / length, float(basis[2] @ z) / length)
    return residual, H, basis @ C @ basis.T, *arc


def _heading_rows(z: Array, reference: Array, variance: float, attitude: Array) -> Rows:
    R = quaternion.to_matrix(attitude)
    m = R @ z
    level = m[:2] @ m[:2]
    if level <= filter_step.VERTICAL:
        return np.zeros(1), np.zeros((1, 3)), np.array([[variance]]), 0.0, 1.0
    error = filter_loop.heading_error(tuple(R.ravel()), z, reference)
    H = (np.array([*(-m[2] * m[:2] / level), 1.0]) @ R)[None]
    return np.array([error]), H, np.array([[variance]]), 0.0, 1.0


def _attitude_rows(measured: Array, C: Array, attitude: Array) -> Rows:
    residual = quaternion.log(quaternion.multiply(quaternion.conjugate(attitude), measured))
    return residual, np.eye(3), C, 0.0, 1.0


def show_refused(filter: filterpy.kalman.ExtendedKalmanFilter, seen: Linearised) -> None:
    """Leave what filterpy shows of an update at that of a measurement that is not taken in: of its shape, without a gain."""
    filter.z, filter.y, filter.S = seen.residual, seen.innovation, seen.predicted + seen.noise
    filter.SI, filter.K = np.linalg.inv(filter.S), np.zeros((len(filter.x), len(filter.y)))
    filter._log_likelihood = filter._likelihood = filter._mahalanobis = None  # to be computed anew


def sensor_names(sensors: Sequence[str]) -> tuple[str, ...]:
    """Return names of sensors as a tuple; one by itself is refused."""
    if isinstance(sensors, str):
        raise InputError(f"sensors is {sensors!r}; it must be a sequence of names, ({sensors!r},)")
    return tuple(sensors)


def _of(sensor: str, name: str) -> str:
    """Return what a value is called in messages."""
    return f"{sensor}: {name}" if sensor else name


def _sum_and_rest(a: float, b: float) -> tuple[float, float]:
    """Return the sum and what it lacks by rounding (Knuth 1998, theorem 4.2.2B)."""
    total = a + b
    b_in_it = total - a
    return total, (a - (total - b_in_it)) + (b - b_in_it)


def _body_covariance(sigma: ArrayLike | None, covariance_b: ArrayLike | None) -> Array:
    """Return the covariance (3, 3) in body axes of one σ, one an axis, or itself."""
    if (sigma is None) == (covariance_b is None):
        raise InputError("give either sigma or covariance: the noise of the measurement")
    if sigma is None:
        return covariance("covariance", np.asarray(covariance_b), 3)
    given = numbers("sigma", sigma)
    if given.shape not in ((), (1,), (3,)):
        raise InputError(
            f"sigma has shape {given.shape}; give one number, three of the body axes, or a covariance (3, 3) as covariance"
        )
    spread = np.array([positive("sigma", float(value)) for value in np.broadcast_to(given, 3)])
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
