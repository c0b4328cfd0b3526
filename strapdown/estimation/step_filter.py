"""The filter in single steps, on filterpy, for inspection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, quaternion
from strapdown.checks import Array, InputError, array, finite, instance, non_negative, one_of
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.features import refuse
from strapdown.estimation.forward import kernel_model
from strapdown.estimation.schedule import schedule
from strapdown.estimation.states import ProcessNoise, State, check_arguments
from strapdown.estimation.temperature import need_none
from strapdown.kernels import filter, machine
from strapdown.kernels.measurement import has_heading
from strapdown.kernels.rotation import rotation_matrix
from strapdown.kernels.walk import step_within, turn_squared
from strapdown.records import LARGEST_TURN
from strapdown.vectors import VectorMeasurements


class Measurement(NamedTuple):
    """A measurement, as :func:`strapdown.kernels.filter.rows_and_axes` takes it."""

    kind: str
    z: tuple[float, ...]
    """The measured vector over ``length``, body axes."""
    frame: tuple[float, ...]
    """The triad of the reference by rows, or the measured quaternion and zeros."""
    noise: Array
    """Covariance of ``z``, body axes (3, 3); for a heading its variance on the diagonal."""
    length: float
    """Length of a vector's reference; else 1."""
    turning: tuple[float, ...] = (0.0,) * 9

    def has_direction(self, attitude: Array) -> bool:
        """Return whether the measurement has information: all except the heading of a vector that is vertical at this attitude."""
        return self.kind != "heading" or bool(has_heading(rotation_matrix(tuple(attitude.tolist())), self.z))


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """Multiplicative extended Kalman filter in single steps: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` as in filterpy.

    It is the filter of :mod:`strapdown.estimation`; motion model and rows are the kernels' functions, run as plain Python. ``x`` is the
    error state (δθ, δb, δc) (n,): zero before and after each update, because the correction goes into ``attitude``, ``bias`` and
    ``values``; ``x_post`` stores the last correction. Rows of ``y`` and ``S`` are in the unit of the measurement, or rad.

    Parameters
    ----------
    process_noise, initial, error_states : ProcessNoise, State, sequence of ErrorStates
        As for :class:`LiveFilter`.
    sensors : sequence of str, optional
        Names of the sensors; with error states no other name is accepted. Default: with error states, the sensors that they affect, if
        any; otherwise any name.
    time : float
        Time of the initial state, s.

    See Also
    --------
    LiveFilter : The same filter compiled, five hundred times faster, with a gate, robust weights and late measurements.

    Notes
    -----
    Attributes in addition to those of filterpy's class:

    - ``attitude`` q_fb (4,), ``bias`` of the gyro (3,), rad/s, body axes, and ``values`` of the error states (m,), in the order of their
      declarations, all at ``time``, s;
    - ``nis`` of the last measurement that was not skipped;
    - ``skipped``, by sensor: number of measurements without information: missing (NaN) ones and headings of a vertical vector;
    - ``repeated``: number of gyro samples without duration.

    Examples
    --------
    >>> steps = StepFilter(noise, start)  # doctest: +SKIP
    >>> steps.predict(record.increments[0], time=record.time[1])  # doctest: +SKIP
    >>> steps.update(record.vectors[0], 0)  # doctest: +SKIP
    """

    def __init__(
        self,
        process_noise: ProcessNoise,
        initial: State,
        error_states: Sequence[ErrorStates] = (),
        *,
        sensors: Sequence[str] = (),
        time: float = 0.0,
    ) -> None:
        check_arguments(process_noise=process_noise)
        self.error_states = modelling.as_blocks(error_states)
        state = modelling.begin(initial, self.error_states)
        need_none(self.error_states, "this filter")
        if isinstance(sensors, str):
            raise InputError(f"sensors is {sensors!r}; it must be a sequence of names, ({sensors!r},)")
        about = {sensor: block.name for block in self.error_states for sensor in block.effects}
        for sensor, block in about.items() if sensors else ():
            one_of(f"{block}: sensor", sensor, sensors)
        self.sensors = (tuple(sensors) or tuple(about)) if self.error_states else ()
        n = 6 + len(state.values)
        super().__init__(dim_x=n, dim_z=2)
        self.x, self.x_prior, self.x_post = np.zeros((3, n))
        self.y, self.z, self.K = np.zeros(2), np.zeros(2), np.zeros((n, 2))
        self.attitude, self.bias, self.values = state.attitude.copy(), state.bias.copy(), state.values.copy()
        self.P, self.process_noise = state.covariance.copy(), process_noise
        self.time = finite("time", time, unit="s")
        self.nis, self.repeated = 0.0, 0
        self.skipped: dict[str, int] = {}
        self._models: dict[tuple[str, str], modelling.Model] = {}
        self._motion = self._model("", "vector")

    def state(self) -> State:
        """Return the present state.

        Returns
        -------
        State
            Attitude, bias, error states and covariance at ``time``.
        """
        P = 0.5 * (self.P + self.P.T)
        return State(attitude=self.attitude, bias=self.bias, values=self.values, covariance=P)

    def predict(self, delta_theta: ArrayLike, dt: float | None = None, *, time: float | None = None) -> None:
        """Propagate over one gyro increment.

        Parameters
        ----------
        delta_theta : array_like (3,)
            Rate integrated over the step, rad, body axes.
        dt : float, optional
            Duration of the step, s. A step without duration is counted as ``repeated``.
        time : float, optional
            Alternative to ``dt``: end of the step, s.

        Raises
        ------
        InputError
            If neither or both are given, if the end lies before the filter's time, or if the increment is too large to be an angle.
        """
        increment = array("delta_theta", delta_theta, (3,))
        if np.max(np.abs(increment)) > LARGEST_TURN:
            raise InputError(
                f"delta_theta is {increment}, too large for the rotation between two samples; it is the rate times dt, rad: check the unit"
            )
        if (dt is None) == (time is None):
            raise InputError("give either dt, the duration of the step in s, or time, its end")
        step = finite("time", time, unit="s") - self.time if dt is None else non_negative("dt", dt, unit="s")  # type: ignore[arg-type]
        if step < 0.0:
            raise InputError(f"time is {time:.9g} s, before the filter's {self.time:.9g} s; give the samples in order")
        self.repeated += step == 0.0
        self._predict(increment, step)
        self.time = self.time + step if time is None else float(time)

    def _running(self) -> list[StepFilter]:
        """Return the filters that are propagated together."""
        return [self]

    def _predict(self, increment: Array, left: float) -> None:
        """Propagate in sub-steps, each as long as the series and the decay rates of the states allow."""
        while left > 0.0:
            squared = max(turn_squared(increment, left, state.bias) for state in self._running())
            longest = float(min(step_within(squared, left), self._motion.limit))
            part = increment * (longest / left)
            for state in self._running():
                state._sub_step(part, longest)
            increment, left = increment - part, left - longest if longest < left else 0.0

    def _sub_step(self, part: Array, dt: float) -> None:
        """Propagate over an increment at constant rate, with the kernels' functions."""
        kernels = machine.instance(filter, STRUCTURE=self._motion.structure)
        variances = self.process_noise.angle_random_walk**2, self.process_noise.rate_random_walk**2
        model = kernel_model(self._motion, variances)
        x, phi, n = np.concatenate([self.attitude, self.bias, self.values]), tuple(part.tolist()), len(self.x)
        coefficients = np.zeros(kernels.SET * max(len(model.last), 1))
        kernels.fill_coefficients(coefficients, dt, model)
        top, Q = np.zeros((3, kernels.W)), np.zeros((n, kernels.W))
        kernels.write_transition(x, phi, dt, model, coefficients, top.reshape(-1), 0.0)
        kernels.advance(x, Q.reshape(-1), phi, dt, model, coefficients, 0.0)
        self.F, self.Q = np.eye(n), Q[:, :n]
        self.F[:3] = top[:, :n]
        for states, g in kernels.STRUCTURE.chains:
            self.F[np.ix_(states, states)] = kernels.chain_matrix(coefficients, g, len(states))
        super().predict()
        self.values = x[7:]
        self.attitude = quaternion.normalize(x[:4])

    def update(self, series: VectorMeasurements, k: int = 0) -> bool:
        """Update with a sample of a series, whatever its time.

        filterpy's updates by an ``Hx`` would leave the correction in ``x``, outside ``attitude`` and ``bias``.

        Parameters
        ----------
        series : VectorMeasurements
            Measurements of a sensor.
        k : int, default 0
            Number of the sample.

        Returns
        -------
        bool
            Whether the measurement was used; false if it is missing, or the heading of a vertical vector.

        Raises
        ------
        InputError
            If the sensor is none of those named, or its noise is zero.
        """
        instance("series", series, VectorMeasurements, "give a series, as in the vectors of a record")
        if self.sensors:
            one_of("sensor", series.sensor, self.sensors)
        sample = series.taken([k])
        events = schedule((sample,), -np.inf, np.inf, anisotropic=True)
        if not len(events.time):
            return self._skip(series.sensor)
        C = np.zeros((3, 3))
        C[np.triu_indices(3)] = C.T[np.triu_indices(3)] = events.body_noise[0]
        z = (0.0, 0.0, 0.0) if series.kind == "attitude" else tuple(events.vector_b[0].tolist())
        length = float(np.linalg.norm(sample.references_f[0])) if series.kind == "vector" else 1.0
        return self._measure(Measurement(series.kind, z, tuple(events.triads[0].tolist()), C, length), series.sensor)

    predict_update = update

    def _skip(self, sensor: str) -> bool:
        self.skipped[sensor] = self.skipped.get(sensor, 0) + 1
        return False

    def _measure(self, measurement: Measurement, sensor: str) -> bool:
        """Update with a measurement."""
        if not measurement.has_direction(self.attitude):
            return self._skip(sensor)
        model, x = self._model(sensor, measurement.kind), np.concatenate([self.attitude, self.bias, self.values])
        kernels = machine.instance(filter, STRUCTURE=model.structure)
        rows, residual, axes, _, _ = kernels.rows_and_axes(0, x, measurement, model.numbers, 0.0)
        unit, T = measurement.length, np.array(axes)
        y, H, R = unit * np.array(residual), unit * np.array(rows, np.float64), unit**2 * T @ measurement.noise @ T.T
        self.dim_z = len(y)
        self.nis = float(y @ np.linalg.solve(H @ self.P @ H.T + R, y))
        correction = self._filterpy_update(y, H, R)
        G = np.eye(len(self.P))
        G[:3, :3] = kinematics.right_jacobian(correction[:3])
        self._move(correction, G @ self.P @ G.T)
        return True

    def _filterpy_update(self, residual: Array, H: Array, R: Array) -> Array:
        """Return the correction (n,) of filterpy's update; P is then the covariance about the corrected state."""
        super().update(residual, HJacobian=lambda x: H, Hx=lambda x: H @ x, R=R)
        correction, self.x = self.x, np.zeros(len(self.x))
        return np.asarray(correction)

    def _move(self, correction: Array, P: Array) -> None:
        """Add the correction to attitude, bias and error states; P is the covariance in the tangent space there."""
        before = self.attitude
        self.attitude = quaternion.normalize(quaternion.multiply(before, quaternion.exp(correction[:3])))
        self.bias, self.values = self.bias + correction[3:6], self.values + correction[6:]
        T = self._motion.turning_matrix(before, self.attitude)
        self.values, self.P = T[6:, 6:] @ self.values, T @ P @ T.T
        self.P_post = self.P.copy()

    def _model(self, sensor: str, kind: str) -> modelling.Model:
        """Return the error states as arrays, in the order of their declarations, with their effects on one sensor only."""
        if (sensor, kind) not in self._models:
            kinds = {name: "vector" for block in self.error_states for name in block.effects} | {sensor: kind}
            model = modelling.assemble(self.error_states, kinds, isotropic=False)
            refuse("a filter of single samples", record=model.of_record)
            here = model.structure.sensors[model.shape[list(kinds).index(sensor)]]
            self._models[sensor, kind] = replace(model, structure=model.structure._replace(sensors=(here,)))
        return self._models[sensor, kind]
