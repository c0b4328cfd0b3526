"""The filter in single steps, on filterpy, for inspection.

:class:`StepFilter` is the filter of :mod:`strapdown.estimation` with whole covariance matrices. Motion model and measurement rows are the
kernels' functions, run as plain Python.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, quaternion
from strapdown.checks import (
    Array,
    InputError,
    array,
    by_axis,
    covariance,
    finite,
    non_negative,
    one_of,
    positive,
    unit_quaternions,
)
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.forward import kernel_model
from strapdown.estimation.states import ProcessNoise, State, check_arguments
from strapdown.estimation.temperature import need_none
from strapdown.kernels import filter, machine, structure
from strapdown.kernels.measurement import has_heading
from strapdown.kernels.rotation import rotation_matrix
from strapdown.kernels.walk import step_within, turn_squared
from strapdown.records import LARGEST_TURN
from strapdown.vectors import need_level, need_unit, triad


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """Multiplicative extended Kalman filter in single steps: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` as in filterpy.

    ``x`` is the error state (δθ, δb, δc) (n,): zero before and after each update, because the correction goes into ``attitude``, ``bias``
    and ``values``; ``x_post`` stores the last correction. Rows of ``y`` and ``S`` are in the unit of the measurement, or rad.

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
    - ``skipped``, by sensor: number of measurements that were missing (NaN) or headings of a vertical vector;
    - ``repeated``: number of gyro samples without duration.

    Examples
    --------
    >>> steps = StepFilter(noise, start)  # doctest: +SKIP
    >>> steps.predict(delta_theta, time=10.02)  # doctest: +SKIP
    >>> steps.update_direction(vector_b, reference_f, 1e-3, "star tracker")  # doctest: +SKIP
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
        if isinstance(sensors, str):
            raise InputError(f"sensors is {sensors!r}; it must be a sequence of names, ({sensors!r},)")
        self.sensors = self._sensors_of_states(tuple(sensors))
        n = 6 + len(state.values)
        super().__init__(dim_x=n, dim_z=2)
        self.x, self.x_prior, self.x_post = np.zeros((3, n))
        self.y, self.z, self.K = np.zeros(2), np.zeros(2), np.zeros((n, 2))
        self.attitude: Array = state.attitude.copy()
        self.bias: Array = state.bias.copy()
        self.values: Array = state.values.copy()
        self.P = state.covariance.copy()
        self.process_noise = process_noise
        self.time = finite("time", time, unit="s")
        self.nis = 0.0
        self.repeated = 0
        self._missing: dict[str, int] = {}
        self._vertical: dict[str, int] = {}
        self._kinds: dict[str, str] = {}
        self._motion = self._model("", "vector")
        self._sensor_models: dict[tuple[str, str], modelling.Model] = {}

    def _sensors_of_states(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the only sensors accepted in updates; empty: any. Error states of other sensors are refused."""
        about = {sensor: block.name for block in self.error_states for sensor in block.effects}
        for sensor, block in about.items() if names else ():
            one_of(f"{block}: sensor", sensor, names)
        return (names or tuple(about)) if self.error_states else ()

    def _model(self, sensor: str, kind: str) -> modelling.Model:
        """Return the error states as arrays, in the order of their declarations, with their effects on one sensor only."""
        need_none(self.error_states, "this filter")
        kinds = {name: "vector" for block in self.error_states for name in block.effects} | {sensor: kind}
        model = modelling.assemble(self.error_states, kinds, isotropic=False)
        if model.levers.any() or model.varying:
            raise InputError(
                "lever arms, and effects relative to a varying field magnitude, need the whole record; use estimation.run for them"
            )
        here = model.structure.sensors[model.shape[list(kinds).index(sensor)]]
        return replace(model, structure=model.structure._replace(sensors=(here,)))

    @property
    def skipped(self) -> dict[str, int]:
        """Number of measurements without information, by sensor: missing (NaN) ones and headings of a vertical vector."""
        names = dict.fromkeys((*self._missing, *self._vertical))
        return {name: self._missing.get(name, 0) + self._vertical.get(name, 0) for name in names}

    def state(self) -> State:
        """Return the present state.

        Returns
        -------
        State
            Attitude, bias, error states and covariance at ``time``.
        """
        P = 0.5 * (self.P + self.P.T)
        return State(attitude=self.attitude, bias=self.bias, values=self.values, covariance=P)

    # -------------------------------------------------------------------------------------------------------------- prediction

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
        if dt is not None and time is None:
            step = non_negative("dt", dt, unit="s")
            end = self.time + step
        elif time is not None and dt is None:
            end = finite("time", time, unit="s")
            step = end - self.time
        else:
            raise InputError("give either dt, the duration of the step in s, or time, its end")
        if step < 0.0:
            raise InputError(f"time is {end:.9g} s, before the filter's {self.time:.9g} s; give the samples in order")
        if step == 0.0:
            self.repeated += 1
            return
        self._predict(increment, step, end)

    def _predict(self, increment: Array, step: float, end: float) -> None:
        """Propagate in sub-steps, each as long as the series and the decay rates of the states allow."""
        left = step
        while left > 0.0:
            squared = turn_squared(increment, left, self.bias)
            longest = float(min(step_within(squared, left), self._motion.limit))
            part = increment * (longest / left)
            self._sub_step(part, longest)
            increment, left = increment - part, left - longest if longest < left else 0.0
        self.time = end

    def _sub_step(self, part: Array, dt: float) -> None:
        """Propagate over an increment at constant rate, with the kernels' functions."""
        kernels, model = machine.instance(filter, STRUCTURE=self._motion.structure), self._numbers()
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

    def _numbers(self) -> structure.Model:
        """Return the numbers of the model as the kernels' arguments."""
        variances = self.process_noise.angle_random_walk**2, self.process_noise.rate_random_walk**2
        return kernel_model(self._motion, variances)

    # ---------------------------------------------------------------------------------------------------------------- updates

    def update(self, *arguments: Any, **options: Any) -> None:
        """Raise an error: filterpy's updates by an ``Hx`` would leave the correction in ``x``, outside ``attitude`` and ``bias``.

        Parameters
        ----------
        *arguments, **options
            Ignored.
        """
        raise InputError(
            "an update by HJacobian and Hx would leave its correction in x, not in the attitude; use update_direction, update_vector, "
            "update_heading or update_attitude"
        )

    predict_update = update

    def update_direction(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        sensor: str = "",
        *,
        covariance: ArrayLike | None = None,
    ) -> bool:
        """Update with a measured unit direction: two degrees of freedom.

        Parameters
        ----------
        vector_b : array_like (3,)
            Measured unit vector, body axes; NaN if it is missing.
        reference_f : array_like (3,)
            Reference direction, fixed axes, of any length.
        sigma : array_like () or (3,), optional
            Standard deviation across the direction, rad; one, or one per body axis.
        sensor : str
            Name of the sensor.
        covariance : array_like (3, 3), optional
            Covariance of the noise, body axes, instead of ``sigma``; only the part across the direction is used.

        Returns
        -------
        bool
            Whether the measurement was used; false if it is missing.

        Raises
        ------
        InputError
            If a shape is wrong, or the noise is missing or not positive.
        """
        return self._update_by_vector("direction", vector_b, reference_f, (sigma, covariance), sensor)

    def update_vector(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: ArrayLike | None = None,
        sensor: str = "",
        *,
        covariance: ArrayLike | None = None,
    ) -> bool:
        """Update with a measured vector: three degrees of freedom.

        Parameters
        ----------
        vector_b : array_like (3,)
            Measured vector in body axes, in the unit of ``reference_f``.
        reference_f : array_like (3,)
            The same vector in the fixed frame.
        sigma, sensor, covariance : optional
            As for :meth:`update_direction`, but of each component, in that unit.

        Returns
        -------
        bool
            As for :meth:`update_direction`.
        """
        return self._update_by_vector("vector", vector_b, reference_f, (sigma, covariance), sensor)

    def update_heading(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: float,
        sensor: str = "",
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
            Name of the sensor.

        Returns
        -------
        bool
            Whether the measurement was used; false if it is missing or vertical.
        """
        return self._update_by_vector("heading", vector_b, reference_f, (sigma, None), sensor)

    def update_attitude(
        self,
        attitude: ArrayLike,
        sigma: ArrayLike | None = None,
        sensor: str = "",
        *,
        covariance: ArrayLike | None = None,
    ) -> bool:
        """Update with a measured attitude: three degrees of freedom.

        Parameters
        ----------
        attitude : array_like (4,)
            Measured q_fb.
        sigma, sensor, covariance : optional
            As for :meth:`update_direction`, but about all body axes.

        Returns
        -------
        bool
            As for :meth:`update_direction`.
        """
        name = _label(sensor, "attitude")
        given = array(name, attitude, (4,), allow_nan=True)
        if np.isnan(given).any():
            return self._skip(sensor)
        frame = (*unit_quaternions(name, given).tolist(), 0.0, 0.0, 0.0, 0.0, 0.0)
        noise = _noise_covariance(sensor, sigma, covariance)
        return self._measure(_Measurement(kind="attitude", z=(0.0, 0.0, 0.0), frame=frame, noise=noise), sensor)

    def _update_by_vector(
        self,
        kind: str,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        noise: tuple[ArrayLike | None, ArrayLike | None],
        sensor: str,
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
        return self._measure(_Measurement(kind=kind, z=z_3, frame=frame_9, length=length, noise=C), sensor)

    def _need_known(self, sensor: str) -> None:
        if self.sensors and sensor not in self.sensors:
            raise InputError(
                f"sensor is {sensor!r}, which is none of {', '.join(self.sensors)}; give one of these names, or name all sensors in "
                "StepFilter(sensors=…)"
            )

    def _skip(self, sensor: str) -> bool:
        self._need_known(sensor)
        self._missing[sensor] = self._missing.get(sensor, 0) + 1
        return False

    def _measure(self, measurement: _Measurement, sensor: str) -> bool:
        """Update with a measurement."""
        self._need_known(sensor)
        if self.error_states and self._kinds.setdefault(sensor, measurement.kind) != measurement.kind:
            raise InputError(
                f"{sensor or 'the sensor'} gave kind {self._kinds[sensor]!r} before, now {measurement.kind!r}; name each sensor"
            )
        if not measurement.has_direction(self.attitude):
            self._vertical[sensor] = self._vertical.get(sensor, 0) + 1
            return False
        residual, H, noise = self._rows(measurement, sensor)
        self.dim_z = len(residual)
        self.nis = float(residual @ np.linalg.solve(H @ self.P @ H.T + noise, residual))
        unit = measurement.length
        correction = self._filterpy_update(unit * residual, unit * H, unit**2 * noise)
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
        self.values, P = T[6:, 6:] @ self.values, T @ P @ T.T
        self.P = P
        self.P_post = P.copy()

    def _sensor_model(self, sensor: str, kind: str) -> modelling.Model:
        key = (sensor if self.error_states else "", kind)
        if key not in self._sensor_models:
            self._sensor_models[key] = self._model(*key)
        return self._sensor_models[key]

    def _rows(self, measurement: _Measurement, sensor: str) -> tuple[Array, Array, Array]:
        """Return residual (d,), H (d, n) and noise (d, d) of a measurement, from the kernels' function."""
        model, x = self._sensor_model(sensor, measurement.kind), np.concatenate([self.attitude, self.bias, self.values])
        kernels = machine.instance(filter, STRUCTURE=model.structure)
        measured = structure.Measured(measurement.z, measurement.frame, (), measurement.length, (0.0,) * 9)
        rows, y, axes, _, _ = kernels.rows_and_axes(0, x, measured, model.numbers, 0.0)
        T = np.array(axes)
        return np.array(y), np.array(rows, np.float64), (T @ measurement.noise @ T.T)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Measurement:
    """A measurement as the arguments of :func:`strapdown.kernels.filter.rows_and_axes`."""

    kind: str
    z: tuple[float, ...]
    """The measured vector over ``length``, body axes."""
    frame: tuple[float, ...]
    """The triad of the reference by rows, or the measured quaternion and zeros."""
    length: float = 1.0
    """Length of a vector's reference; else 1."""
    noise: Array
    """Covariance of ``z``, body axes (3, 3); for a heading its variance on the diagonal."""

    def has_direction(self, attitude: Array) -> bool:
        """Return whether the measurement has information: all except the heading of a vector that is vertical at this attitude."""
        if self.kind != "heading":
            return True
        return bool(has_heading(rotation_matrix(tuple(attitude.tolist())), self.z))


def _label(sensor: str, name: str) -> str:
    """Return the name of a value for messages."""
    return f"{sensor}: {name}" if sensor else name


def _noise_covariance(sensor: str, sigma: ArrayLike | None, covariance_b: ArrayLike | None) -> Array:
    """Return the covariance (3, 3) in body axes from one σ, three σ, or itself."""
    if (sigma is None) == (covariance_b is None):
        raise InputError("give either sigma or covariance: the noise of the measurement")
    if sigma is None:
        return covariance(_label(sensor, "covariance"), np.asarray(covariance_b), 3)
    return np.diag(by_axis(_label(sensor, "sigma"), sigma, ", or a matrix as covariance") ** 2)
