"""The filter step by step, on filterpy: for data that arrive as they are measured, and for looking inside.

:class:`StepFilter` is the filter of :mod:`strapdown.estimation`, on whole covariance matrices. Motion model and measurement rows are the
kernels' own functions, run as plain Python; gates, restarts and iterated updates are in :mod:`strapdown.estimation.step_gate`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
    one_of,
    positive,
    unit_quaternions,
)
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.forward import restart_states
from strapdown.estimation.gating import Gate, Monitor, Robust
from strapdown.estimation.schedule import KIND_CODES
from strapdown.estimation.states import ProcessNoise, State, check_arguments, restart_bias_variance
from strapdown.estimation.step_gate import Events, Linearization, Rows, Supervision, linearize, seen_from, tilt_unknown
from strapdown.kernels import chains, error_state_step
from strapdown.kernels.algebra import cross, dot
from strapdown.kernels.gate_rules import WIDE_PASSES
from strapdown.kernels.iterated_update import ACCEPTED, KNOWN, PASSED_OVER, REFUSED
from strapdown.kernels.measurement import has_heading
from strapdown.kernels.rotation import rotation_matrix
from strapdown.records import LARGEST_TURN
from strapdown.vectors import KINDS, need_level, need_unit, triad

CLOCK_SHARE = 1e-3
"""Largest rounding of a clock, as a share of the longest step."""
NO_LEVER = (0.0,) * 9
"""The matrix by which a lever arm enters a measurement: of none."""


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """Multiplicative extended Kalman filter, step by step: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` as in filterpy.

    ``x`` is the error state (δθ, δb, δc) (n,): zero before and after each update, because the correction goes into ``attitude``, ``bias``
    and ``values``; ``x_post`` keeps the last correction. Rows of ``y`` and ``S`` are in the unit of the measurement, or rad.

    Parameters
    ----------
    process_noise : ProcessNoise
        Noise of the gyro.
    initial : State
        Where the filter starts. The end state of :func:`strapdown.estimation.run_part` continues that run, its gate included; give its
        ``time``.
    error_states : sequence of ErrorStates, optional
        Optional error states of the gyro and the sensors.
    gate : Gate, optional
        Refuses outliers, and recovers from a wrong state.
    robust : Robust, optional
        Weighs each measurement by its distance from the estimate.
    monitor : Monitor, optional
        Reports in ``events`` when the running mean of the NIS leaves its bounds. Memory grows by a few numbers a measurement.
    look_back : float
        How late a measurement may be given, s. The filter then goes back to its time, processes it, and repeats what followed: the result
        is that of the filter that had it in order. Memory holds the states of that span. Measurements of one time are then processed in
        the order of ``sensors``, in whatever order they are given; without a look-back, in that in which they are given.
    sensors : sequence of str, optional
        Names of the sensors in the order of the record's series; others follow in the order of their first measurement. With error states
        no other name is accepted. Default: with error states the sensors that those are about, if any; else none.
    time : float
        Time of the initial state, s.

    Notes
    -----
    The filter holds, beside what filterpy's has:

    - ``attitude`` q_fb (4,), ``bias`` of the gyro (3,), rad/s, body axes, and ``values`` of the optional error states (m,), one block
      after the other, all at ``time``, s;
    - ``nis`` and ``weight`` of the last measurement that was not skipped; the weight is 0 if the gate refused it;
    - ``refused`` and ``skipped``, by sensor: how many measurements the gate refused, and how many were missing (NaN) or headings of a
      vertical vector;
    - ``late`` and ``repeated``: how many measurements came later than ``look_back``, and how many gyro samples had no duration;
    - ``events``: recoveries, lock-outs and divergence so far.

    Examples
    --------
    >>> live = StepFilter(noise, start, look_back=0.5)  # doctest: +SKIP
    >>> live.predict(delta_theta, time=10.02)  # doctest: +SKIP
    >>> live.update_direction(vector_b, reference_f, 1e-3, "star tracker", time=9.9)  # doctest: +SKIP
    """

    def __init__(
        self,
        process_noise: ProcessNoise,
        initial: State,
        error_states: Sequence[ErrorStates] = (),
        *,
        gate: Gate | None = None,
        robust: Robust | None = None,
        monitor: Monitor | None = None,
        look_back: float = 0.0,
        sensors: Sequence[str] = (),
        time: float = 0.0,
    ) -> None:
        check_arguments(process_noise=process_noise, gate=gate, robust=robust, monitor=monitor)
        self.error_states = modelling.as_blocks(error_states)
        state = modelling.begin(initial, self.error_states)
        names = _sensor_names(sensors)
        self.sensors = self._sensors_of_states(names)
        n = 6 + len(state.values)
        super().__init__(dim_x=n, dim_z=2)
        self.x, self.x_prior, self.x_post = np.zeros((3, n))
        self.y, self.z, self.K = np.zeros(2), np.zeros(2), np.zeros((n, 2))
        self.attitude: Array = state.attitude.copy()
        self.bias: Array = state.bias.copy()
        self.values: Array = state.values.copy()
        self.P = state.covariance.copy()
        self.process_noise = process_noise
        self.gate = gate
        self.robust = robust
        self.look_back = non_negative("look_back", look_back, unit="s")
        self.time = finite("time", time, unit="s")
        self.nis = 0.0
        self.weight = 1.0
        self.late = 0
        self.repeated = 0
        self.refused: dict[str, int] = {}
        self._missing: dict[str, int] = {}
        self._vertical: dict[str, int] = {}
        self._kinds: dict[str, str] = {}
        self._motion = self._model("", "vector")
        self._sensor_models: dict[str, modelling.Model] = {}
        self._thresholds = np.full(3, np.inf) if gate is None else gate.thresholds
        self._clock = _Clock(start=self.time)
        self._history = _History()
        self._order = {name: place for place, name in enumerate(names or self.sensors)}
        self._begin_gate(state, monitor)

    events = Events()

    def _sensors_of_states(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the only sensors that may be updated by; none: any may. Error states about other sensors are refused."""
        about = {sensor: block.name for block in self.error_states for sensor in block.effects}
        for sensor, block in about.items() if names else ():
            one_of(f"{block}: sensor", sensor, names)
        return (names or tuple(about)) if self.error_states else ()

    def _begin_gate(self, state: State, monitor: Monitor | None) -> None:
        """Set up gate and monitor; continue with the gate's memory and its restart candidate where the state has them."""
        gate, memory = self.gate, state.gate
        self._restart_bias_variance = restart_bias_variance(gate, state)
        self._supervision: Supervision[StepFilter] = Supervision(gate, memory, monitor)
        self._passes = self._supervision.passes
        values, P = restart_states(state, self.error_states)
        self._restart_prior = _Prior(time=self.time, values=values, covariance=P)
        if gate is None or memory is None:
            return
        if self.time < memory.start:
            raise InputError(
                f"time is {self.time:.9g} s, before the record of initial began, {memory.start:.9g} s; give the time of initial"
            )
        self._restart_prior = _Prior(time=memory.start, values=memory.values, covariance=memory.covariance)
        one = memory.candidate
        if one is not None and self._supervision.has_candidate:
            bias, values = one.others[:3], one.others[3:]
            self._supervision.candidate = self._candidate(
                State(attitude=one.attitude, bias=bias, values=values, covariance=one.covariance, factor=one.factor)
            )

    def _model(self, sensor: str, kind: str) -> modelling.Model:
        """Return the error states as arrays, in the filter's own order, with their effects on one sensor alone."""
        kinds = {name: "vector" for block in self.error_states for name in block.effects} | {sensor: kind}
        model = modelling.assemble(self.error_states, kinds)
        if model.levers.any() or model.varying:
            raise InputError(
                "lever arms, and effects on a strength that varies, need the whole record; use estimation.run for them"
            )
        back, here = np.argsort(model.order), [list(kinds).index(sensor)]
        return replace(
            model,
            order=np.arange(len(back)),
            decay=model.decay[back],
            density=model.density[back],
            chains=model.chains[back] if len(model.chains) else model.chains,
            gyro=model.gyro[back],
            gyro_use=model.gyro_use[back],
            sensors=model.sensors[here][:, back],
            sensor_use=model.sensor_use[here][:, back],
        )

    @property
    def skipped(self) -> dict[str, int]:
        """Measurements without information, by sensor: missing (NaN) ones and headings of a vertical vector."""
        names = dict.fromkeys((*self._missing, *self._vertical))
        return {name: self._missing.get(name, 0) + self._vertical.get(name, 0) for name in names}

    def state(self) -> State:
        """Return the present state.

        Returns
        -------
        State
            Attitude, bias, error states and covariance at ``time``, without what the gate remembers.
        """
        P = 0.5 * (self.P + self.P.T)
        return State(attitude=self.attitude, bias=self.bias, values=self.values, covariance=P)

    # -------------------------------------------------------------------------------------------------------------- prediction

    def predict(self, delta_theta: ArrayLike, dt: float | None = None, *, time: float | None = None) -> None:
        """Propagate over one gyro increment.

        Parameters
        ----------
        delta_theta : array_like (3,)
            The rate integrated over the step, rad, body axes.
        dt : float, optional
            Length of the step, s; the clock is then their compensated sum. A step of no length is counted as ``repeated``.
        time : float, optional
            End of the step, s, where samples have stamps; the clock is then theirs.

        Raises
        ------
        InputError
            If neither is given, if they contradict each other or the clock, or if the increment is too large to be an angle.
        """
        increment = array("delta_theta", delta_theta, (3,))
        if np.max(np.abs(increment)) > LARGEST_TURN:
            raise InputError(
                f"delta_theta is {increment}, and nothing turns so far between two samples; it is the rate times dt, rad: check the unit"
            )
        step, end = self._clock.step(self.time, dt, time)
        if step == 0.0:
            self.repeated += 1
            return
        self._remember(_Entry(before=self._snapshot(), end=end, dt=step, increment=increment))
        self._predict(increment, step, end)

    def _predict(self, increment: Array, step: float, end: float) -> None:
        """Propagate the filter, and a restart candidate beside it, in common sub-steps: as long as series and decaying states allow."""
        candidate = self._supervision.candidate
        running = [self] if candidate is None else [self, candidate]
        left, limit = step, self._motion.limit
        while left > 0.0:
            turns = [(increment - left * one.bias).tolist() for one in running]
            longest = float(min(error_state_step.longest_step(left, tuple(turn), limit) for turn in turns))
            part = increment * (longest / left)
            for one in running:
                one._sub_step(part, longest)
            increment, left = increment - part, left - longest if longest < left else 0.0
        for one in running:
            one.time = end

    def _sub_step(self, part: Array, dt: float) -> None:
        """Propagate over an increment at constant rate, by the kernels' own functions."""
        model, m, n = self._motion, len(self.values), len(self.x)
        q, phi, x = tuple(self.attitude.tolist()), tuple(part.tolist()), np.concatenate([self.bias, self.values])
        gyro, force = (model.gyro, model.gyro_use), tuple(model.force_f.tolist())
        top, factor = np.zeros((n, 4)), np.empty(m)
        attitude, _, rate, D = error_state_step.move(q, x, dt, phi, model.decay, *gyro, force, top, factor)
        # Rows 0 to n become Φᵀ, the rows after them N with Q = Nᵀ N.
        rows = np.zeros((n + model.noise_rows, n))
        rows[:n] = np.eye(n)
        error_state_step.carry(rows, n, 0, top, factor, m)
        white = self.process_noise.angle_random_walk**2, self.process_noise.rate_random_walk**2
        noise = np.zeros((n, 4))
        error_state_step.step_noise(noise, dt, rate, D, *white, model.decay, model.density, *gyro)
        row = error_state_step.fill_noise(rows, n, noise, n)
        links = np.empty((len(model.chains), chains.LINKS))
        chains.step_chains(rows, n, row, x, dt, model.decay, model.chains, links)
        self.F, self.Q = rows[:n].T.copy(), rows[n:].T @ rows[n:]
        super().predict()
        self.values = x[3:]
        self.attitude = quaternion.normalize(np.array(attitude))

    # ---------------------------------------------------------------------------------------------------------------- updates

    def update(self, *arguments: Any, **options: Any) -> None:
        """Refuse filterpy's own update by any ``Hx``: it would leave the correction in ``x``, outside ``attitude`` and ``bias``.

        Parameters
        ----------
        *arguments, **options
            Ignored.

        Raises
        ------
        InputError
            Always; use :meth:`update_direction`, :meth:`update_vector`, :meth:`update_heading` or :meth:`update_attitude`.
        """
        raise InputError(
            "update() by HJacobian and Hx knows no attitude, and would leave its correction in x; use update_direction, update_vector, "
            "update_heading or update_attitude"
        )

    def predict_update(self, *arguments: Any, **options: Any) -> None:
        """Refuse filterpy's own step, as :meth:`update` does.

        Parameters
        ----------
        *arguments, **options
            Ignored.

        Raises
        ------
        InputError
            Always.
        """
        raise InputError(
            "predict_update() would update by Hx, which knows no attitude; use predict, then update_direction or another"
        )

    def update_direction(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        sensor: str = "",
        *,
        covariance: ArrayLike | None = None,
        time: float | None = None,
    ) -> bool:
        """Update with a measured unit direction: two degrees of freedom.

        Parameters
        ----------
        vector_b : array_like (3,)
            The measured unit vector, body axes; NaN if it is missing.
        reference_f : array_like (3,)
            The known direction, fixed axes, of any length.
        sigma : array_like () or (3,), optional
            Standard deviation across the direction, rad; one, or one a body axis.
        sensor : str
            Its name, by which the gate counts.
        covariance : array_like (3, 3), optional
            Of the noise, body axes, in place of ``sigma``; the part across the direction counts.
        time : float, optional
            Time of validity, s; default: now.

        Returns
        -------
        bool
            Whether the measurement was used: not refused, missing or too late.
        """
        return self._update_by_vector("direction", vector_b, reference_f, (sigma, covariance), sensor, time)

    def update_vector(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        sensor: str = "",
        *,
        covariance: ArrayLike | None = None,
        time: float | None = None,
    ) -> bool:
        """Update with a measured vector: three degrees of freedom.

        Parameters
        ----------
        vector_b : array_like (3,)
            Measured vector in body axes, in the unit of ``reference_f``.
        reference_f : array_like (3,)
            The same vector in the fixed frame.
        sigma : float or array_like (3,), optional
            σ of each component, in that unit; or one a body axis.
        sensor : str, optional
            Name of the sensor, for gate and events.
        covariance : array_like (3, 3), optional
            Of the noise, instead of ``sigma``.
        time : float, optional
            Time of the measurement, s; a late one needs ``look_back``.

        Returns
        -------
        bool
            Whether it was used.

        Raises
        ------
        InputError
            If a shape is wrong, the noise is missing or not positive, or the time lies before ``look_back``.
        """
        return self._update_by_vector("vector", vector_b, reference_f, (sigma, covariance), sensor, time)

    def update_heading(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: float,
        sensor: str = "",
        *,
        time: float | None = None,
    ) -> bool:
        """Update with the heading of a measured unit vector's horizontal part: one degree of freedom.

        Parameters
        ----------
        vector_b : array_like (3,)
            Measured unit vector in body axes; one that is vertical at the estimate has no heading and is skipped.
        reference_f : array_like (3,)
            The same vector in the fixed frame, whose z axis is vertical.
        sigma : float
            σ of the heading, rad.
        sensor : str, optional
            Name of the sensor, for gate and events.
        time : float, optional
            Time of the measurement, s; a late one needs ``look_back``.

        Returns
        -------
        bool
            Whether it was used.

        Raises
        ------
        InputError
            If a shape is wrong, σ is not positive, or the time lies before ``look_back``.
        """
        return self._update_by_vector("heading", vector_b, reference_f, (sigma, None), sensor, time)

    def update_attitude(
        self,
        attitude: ArrayLike,
        sigma: ArrayLike | None = None,
        sensor: str = "",
        *,
        covariance: ArrayLike | None = None,
        time: float | None = None,
    ) -> bool:
        """Update with a measured attitude: three degrees of freedom.

        Parameters
        ----------
        attitude : array_like (4,)
            Measured q_fb.
        sigma : float or array_like (3,), optional
            σ about the body axes, rad.
        sensor : str, optional
            Name of the sensor, for gate and events.
        covariance : array_like (3, 3), optional
            Of the noise, rad², body axes, instead of ``sigma``.
        time : float, optional
            Time of the measurement, s; a late one needs ``look_back``.

        Returns
        -------
        bool
            Whether it was used.

        Raises
        ------
        InputError
            If a shape is wrong, the noise is missing or not positive, or the time lies before ``look_back``.
        """
        name = _label(sensor, "attitude")
        given = array(name, attitude, (4,), allow_nan=True)
        if np.isnan(given).any():
            return self._skip(sensor)
        frame = (*unit_quaternions(name, given).tolist(), 0.0, 0.0, 0.0, 0.0, 0.0)
        noise = _noise_covariance(sensor, sigma, covariance)
        return self._measure(_Measurement(kind="attitude", z=(0.0, 0.0, 0.0), frame=frame, noise=noise), sensor, time)

    def _update_by_vector(
        self,
        kind: str,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        noise: tuple[ArrayLike | None, ArrayLike | None],
        sensor: str,
        time: float | None,
    ) -> bool:
        name, reference = _label(sensor, "vector_b"), _label(sensor, "reference_f")
        z = array(name, vector_b, (3,), allow_nan=True)
        if np.isnan(z).any():
            return self._skip(sensor)
        if kind != "vector":
            need_unit(name, z)
        r = array(reference, reference_f, (3,))
        frame = triad(r)
        if kind == "heading":
            need_level(reference, frame[2])
            positive(_label(sensor, "sigma"), noise[0], unit="rad")  # type: ignore[arg-type]
        length = float(np.linalg.norm(r)) if kind == "vector" else 1.0
        C = _noise_covariance(sensor, *noise) / length**2
        frame_9 = tuple(frame.ravel().tolist())
        z_3 = tuple((z / length).tolist())
        return self._measure(_Measurement(kind=kind, z=z_3, frame=frame_9, length=length, noise=C), sensor, time)

    def _need_known(self, sensor: str) -> None:
        if self.sensors and sensor not in self.sensors:
            raise InputError(
                f"sensor is {sensor!r}, which is none of {', '.join(self.sensors)}; say which of them it is, or name all sensors to "
                "StepFilter(sensors=…)"
            )

    def _skip(self, sensor: str) -> bool:
        self._need_known(sensor)
        self._missing[sensor] = self._missing.get(sensor, 0) + 1
        return False

    def _measure(self, measurement: _Measurement, sensor: str, time: float | None) -> bool:
        """Process a measurement at its time and its sensor's place among those of that time, and repeat what comes after it."""
        self._need_known(sensor)
        if self.error_states and self._kinds.setdefault(sensor, measurement.kind) != measurement.kind:
            raise InputError(
                f"{sensor or 'the sensor'} gave kind {self._kinds[sensor]!r} before, now {measurement.kind!r}; name each sensor"
            )
        when = self.time if time is None else finite("time", time, unit="s")
        room = self._clock.rounding(self.time, when)
        when = self.time if abs(when - self.time) <= room else when
        if when > self.time:
            raise InputError(f"time is {when:.9g} s, after the filter's {self.time:.9g} s; predict up to it first")
        place = self._order.setdefault(sensor, len(self._order))
        past = self._history.entries
        if when < self.time and (not past or when < max(self.time - self.look_back, past[0].before["time"]) - room):
            self.late += 1
            return False
        first = len(past)
        while first and self._comes_after(past[first - 1], when, place, room):
            first -= 1
        after, self._history.entries = past[first:], past[:first]
        if not after:
            return self._process(measurement, sensor)
        self._restore(after[0].before)
        head, tail = after[0].split(when if when > self.time + room else self.time)
        if head is not None:
            self._repeat(head)
        accepted = self._process(measurement, sensor)
        for entry in (tail, *after[1:]):
            self._repeat(entry)
        return accepted

    def _comes_after(self, entry: _Entry, when: float, place: int, room: float) -> bool:
        """Return whether an entry of the history comes after a measurement of that time and that place among the sensors."""
        if entry.end > when + room:
            return True
        return entry.measurement is not None and entry.end >= when - room and self._order[entry.sensor] > place

    def _process(self, measurement: _Measurement, sensor: str) -> bool:
        """Update with a measurement of now; count the outcome for the gate."""
        self._remember(_Entry(before=self._snapshot(), end=self.time, measurement=measurement, sensor=sensor))
        has_direction = measurement.has_direction(self.attitude)
        outcome = self._correct(measurement, sensor)
        if not has_direction:
            self._vertical[sensor] = self._vertical.get(sensor, 0) + 1
        elif outcome != ACCEPTED:
            self.refused[sensor] = self.refused.get(sensor, 0) + 1
        self._supervision.judge(self, sensor, outcome, lambda candidate: candidate._correct(measurement, sensor))
        return outcome == ACCEPTED

    def _correct(self, measurement: _Measurement, sensor: str) -> int:
        """Update with a measurement; return ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``."""
        if not measurement.has_direction(self.attitude):
            return PASSED_OVER
        threshold = float(self._thresholds[KINDS[measurement.kind] - 1])
        others = np.concatenate([self.bias, self.values])
        rows = partial(self._rows, measurement, self._sensor_model(sensor, measurement.kind))
        seen = linearize(rows, self.attitude, others, self.P, self._motion.chains, self._passes, threshold)
        self.nis = seen.nis
        self.dim_z = len(seen.rows.residual)
        unknown = self._passes > 1 and measurement.kind == "heading" and tilt_unknown(self.attitude, self.P)
        if unknown or not seen.acceptable(threshold):
            self.weight = 0.0
            self._show_refused(seen, measurement.length)
            return PASSED_OVER if unknown else REFUSED
        self.weight = 1.0 if self.robust is None else seen.weight(self.robust)
        self._accept(seen, measurement.length)
        return ACCEPTED

    def _accept(self, seen: Linearization, unit: float) -> None:
        """Correct the state by filterpy's update, from the state at which a measurement is linearised; its rows are in this unit."""
        self.attitude, self.bias, self.values = seen.attitude, seen.others[:3], seen.others[3:]
        self.P, self.x = seen.covariance, seen.prior
        H, R = unit * seen.rows.H, seen.rows.noise * (unit**2 / self.weight)
        super().update(unit * seen.rows.residual, HJacobian=lambda x: H, Hx=lambda x: H @ x, R=R)
        correction, self.x = self.x, np.zeros(len(self.x))
        self._reset(correction, self.P, far=self._passes > 1 and bool(np.trace(self.P[:3, :3]) > KNOWN))
        self.P_post = self.P.copy()

    def _reset(self, correction: Array, P: Array, *, far: bool) -> None:
        """Correct the state, and move P to its tangent space; ``far`` where an attitude hardly known has turned by a large angle."""
        before, turn = self.attitude, quaternion.exp(correction[:3])
        self.attitude = quaternion.normalize(quaternion.multiply(before, turn))
        self.bias, self.values = self.bias + correction[3:6], self.values + correction[6:]
        if far:
            P, _ = seen_from(turn, P)
        else:
            G = np.eye(len(P))
            G[:3, :3] = kinematics.right_jacobian(correction[:3])
            P = G @ P @ G.T
        if len(self._motion.chains):
            T = modelling.turning_matrix(self._motion.chains, len(P), before, self.attitude)
            self.values, P = T[6:, 6:] @ self.values, T @ P @ T.T
        self.P = P

    def _show_refused(self, seen: Linearization, unit: float) -> None:
        """Set what filterpy shows of an update to that of a refused measurement: its residual and covariance, and no gain."""
        self.z, self.y = unit * seen.rows.residual, unit * seen.innovation
        self.S = unit**2 * (seen.predicted + seen.rows.noise)
        self.SI, self.K = np.linalg.inv(self.S), np.zeros((len(self.x), len(self.y)))
        self._log_likelihood = self._likelihood = self._mahalanobis = None  # to be computed anew

    def _sensor_model(self, sensor: str, kind: str) -> modelling.Model:
        if not self.error_states:
            return self._motion
        if sensor not in self._sensor_models:
            self._sensor_models[sensor] = self._model(sensor, kind)
        return self._sensor_models[sensor]

    def _rows(self, measurement: _Measurement, model: modelling.Model, attitude: Array, others: Array) -> Rows:
        """Return a measurement's rows at an attitude (4,) and (b, c) (3 + m,), by the kernels' own function."""
        H, y, basis = np.empty((3, 3 + len(others))), np.empty(3), np.empty((3, 3))
        q = tuple(attitude.tolist())
        given = KIND_CODES[measurement.kind], measurement.z, measurement.frame, measurement.length
        effects = 0, model.sensors, model.sensor_use, NO_LEVER
        d = error_state_step.fill_rows(q, rotation_matrix(q), others, *given, *effects, H, y, basis)
        angle, arc = measurement.arc(y, basis)
        return Rows(y[:d].copy(), H[:d].copy(), (basis @ measurement.noise @ basis.T)[:d, :d], angle, arc)

    # ------------------------------------------------------------------------------------------------------ restart candidates

    def _restarted(self, attitude_sigma: float, bias_width: float) -> StepFilter:
        """Return a restart candidate: optional states at their prior, attitude and bias independent of it and as uncertain as given."""
        prior, m = self._restart_prior, len(self.values)
        values, Pc = modelling.aged_prior(self.error_states, prior.values, prior.covariance, self.time - prior.time)
        P = np.zeros((6 + m, 6 + m))
        P[:3, :3] = attitude_sigma**2 * np.eye(3)
        P[3:6, 3:6] = self.P[3:6, 3:6] + bias_width**2 * np.diag(self._restart_bias_variance)
        P[6:, 6:] = Pc
        return self._candidate(State(attitude=self.attitude, bias=self.bias, values=values, covariance=P))

    def _candidate(self, state: State) -> StepFilter:
        """Return a restart candidate in this state."""
        candidate = StepFilter(
            self.process_noise, state, self.error_states, gate=self.gate, robust=self.robust, time=self.time
        )
        candidate._sensor_models = self._sensor_models
        candidate._passes = WIDE_PASSES
        return candidate

    def _become(self, other: StepFilter) -> None:
        """Take over the state of a restart candidate."""
        self.attitude, self.bias, self.values, self.P = other.attitude, other.bias, other.values, other.P

    # ---------------------------------------------------------------------------------------------------------------- history

    def _remember(self, entry: _Entry) -> None:
        """Keep an entry as long as a measurement may still come before it."""
        if self.look_back == 0.0:
            return
        self._history.entries.append(entry)
        oldest = self.time - self.look_back - self._clock.rounding(self.time, self.time)
        while self._history.entries[0].end < oldest:
            del self._history.entries[0]

    def _repeat(self, entry: _Entry) -> None:
        """Do again what an entry of the history did, from the present state."""
        if entry.measurement is None:
            self._remember(replace(entry, before=self._snapshot()))
            self._predict(entry.increment, entry.dt, entry.end)
        else:
            self._process(entry.measurement, entry.sensor)

    def _snapshot(self) -> dict[str, Any]:
        """Return what has to be restored when the filter goes back to this moment; nothing where it never does."""
        if self.look_back == 0.0:
            return {}
        return {
            "time": self.time,
            "attitude": self.attitude,
            "bias": self.bias,
            "values": self.values,
            "P": self.P.copy(),
            "refused": dict(self.refused),
            "_vertical": dict(self._vertical),
            "_passes": self._passes,
            "_supervision": self._supervision.copied(),
        }

    def _restore(self, snapshot: dict[str, Any]) -> None:
        for name, value in snapshot.items():
            setattr(self, name, value)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Measurement:
    """A measurement as the kernels take it (:func:`strapdown.kernels.error_state_step.fill_rows`)."""

    kind: str
    z: tuple[float, ...]
    """The measured vector over ``length``, body axes."""
    frame: tuple[float, ...]
    """The triad of the reference by rows, or the measured quaternion and zeros."""
    length: float = 1.0
    """Length of a vector's reference; else 1."""
    noise: Array
    """Covariance of ``z``, body axes (3, 3); of a heading the variance stands on the diagonal."""

    def has_direction(self, attitude: Array) -> bool:
        """Return whether it is anything but the heading of a vector that is vertical at this attitude."""
        if self.kind != "heading":
            return True
        return bool(has_heading(rotation_matrix(tuple(attitude.tolist())), self.z))

    def arc(self, y: Array, basis: Array) -> tuple[float, float]:
        """Return the angle θ between measured and predicted vector, rad, and θ over sin θ; 0 and 1 of other kinds."""
        if self.kind not in ("direction", "vector"):
            return 0.0, 1.0
        along = y[2] + 1.0
        if self.kind == "direction":
            predicted = cross(tuple(basis[0].tolist()), tuple(basis[1].tolist()))
            along = dot(predicted, self.z) / math.sqrt(dot(predicted, predicted))
        sine = math.hypot(y[0], y[1])
        angle = math.atan2(sine, along)
        return angle, 1.0 if sine < 1e-9 else angle / sine


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prior:
    """Prior of the optional error states, from which a restart candidate starts."""

    time: float
    values: Array
    covariance: Array


@dataclass(kw_only=True)
class _Clock:
    """The filter's clock: a compensated sum of steps, or the stamps of the samples."""

    start: float
    rest: float = 0.0
    """Rounding error of the sum of steps, s."""
    steps: int = 0
    """Steps since the last stamp."""
    longest: float = 0.0
    """Longest step, s."""

    def step(self, now: float, dt: float | None, time: float | None) -> tuple[float, float]:
        """Return the length and the end of a step from now, s, given its length, its end or both."""
        if time is None:
            if dt is None:
                raise InputError("dt is None; give it, the length of the step in s, or time, when it ends")
            step = non_negative("dt", dt, unit="s")
            end, self.rest = _sum_and_rest(now, step + self.rest)
            self.steps += 1
        else:
            end = finite("time", time, unit="s")
            step = self._length(now, dt, end)
            self.steps, self.rest = 0, 0.0
        self.longest = max(self.longest, step)
        return step, end

    def _length(self, now: float, dt: float | None, end: float) -> float:
        """Return the length of a step to a stamp, s."""
        room = self.rounding(now, end)
        if end < now - room:
            raise InputError(f"time is {end:.9g} s, before the filter's {now:.9g} s; give the samples in order")
        step = max(end - now, 0.0)
        if dt is not None and abs(non_negative("dt", dt, unit="s") - step) > room + CLOCK_SHARE * step:
            raise InputError(
                f"dt is {dt:.9g} s, but from {now:.9g} s to time it is {step:.9g} s; leave out one of them"
            )
        return step

    def rounding(self, now: float, time: float) -> float:
        """Return how far a time may lie from the clock and still mean now, s: the rounding of as many sums as there were."""
        ulp = float(np.spacing(max(abs(time), abs(now), abs(self.start))))
        gathered = self.steps * ulp
        return 4.0 * ulp + (min(gathered, CLOCK_SHARE * self.longest) if self.longest else gathered)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Entry:
    """A prediction or a measurement of the past, with the state before it."""

    before: dict[str, Any]
    end: float
    """Time after it, s."""
    dt: float = 0.0
    increment: Array = field(default_factory=lambda: np.zeros(3))
    measurement: _Measurement | None = None
    sensor: str = ""

    def split(self, time: float) -> tuple[_Entry | None, _Entry]:
        """Return a prediction as its parts before and after a time; None and itself where that is its begin, or where it is none."""
        begin = float(self.before["time"])
        if self.measurement is not None or time <= begin:
            return None, self
        share = (time - begin) / (self.end - begin)
        head = replace(self, end=time, dt=share * self.dt, increment=share * self.increment)
        return head, replace(self, dt=self.dt - head.dt, increment=self.increment - head.increment)


@dataclass
class _History:
    """Steps that the filter may have to repeat; one object, because filterpy's ``Saver`` makes an array of a list, and finds no shape."""

    entries: list[_Entry] = field(default_factory=list)


def _sensor_names(sensors: Sequence[str]) -> tuple[str, ...]:
    """Return names of sensors as a tuple; one by itself is refused."""
    if isinstance(sensors, str):
        raise InputError(f"sensors is {sensors!r}; it must be a sequence of names, ({sensors!r},)")
    return tuple(sensors)


def _label(sensor: str, name: str) -> str:
    """Return what a value is called in messages."""
    return f"{sensor}: {name}" if sensor else name


def _sum_and_rest(a: float, b: float) -> tuple[float, float]:
    """Return the sum and what it lacks by rounding (Knuth 1998, theorem 4.2.2B)."""
    total = a + b
    b_in_it = total - a
    return total, (a - (total - b_in_it)) + (b - b_in_it)


def _noise_covariance(sensor: str, sigma: ArrayLike | None, covariance_b: ArrayLike | None) -> Array:
    """Return the covariance (3, 3) in body axes of one σ, of one a body axis, or itself."""
    if (sigma is None) == (covariance_b is None):
        raise InputError("give either sigma or covariance: the noise of the measurement")
    if sigma is None:
        return covariance(_label(sensor, "covariance"), np.asarray(covariance_b), 3)
    name = _label(sensor, "sigma")
    given = numbers(name, sigma)
    if given.shape not in ((), (1,), (3,)):
        raise InputError(
            f"{name} has shape {given.shape}; give one number, three of the body axes, or a covariance (3, 3) as covariance"
        )
    spread = np.array([positive(name, float(value)) for value in np.broadcast_to(given, 3)])
    return np.diag(spread**2)
