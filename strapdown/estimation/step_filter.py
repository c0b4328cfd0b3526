"""The filter in single steps, on filterpy, for inspection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, quaternion
from strapdown.checks import Array, InputError, array, count, instance, one_of, positive
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import ErrorStates, temperature_slopes
from strapdown.estimation.features import refuse
from strapdown.estimation.forward import kernel_model
from strapdown.estimation.schedule import schedule
from strapdown.estimation.states import ProcessNoise, State, check_arguments
from strapdown.kernels import machine
from strapdown.kernels import model as model_kernels
from strapdown.kernels import rows as row_kernels
from strapdown.kernels.measurement import has_heading
from strapdown.kernels.rotation import rotation_matrix
from strapdown.kernels.walk import step_within, turn_squared
from strapdown.records import LARGEST_TURN
from strapdown.vectors import VectorMeasurements


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """Multiplicative extended Kalman filter in single steps: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K`` and ``Saver`` as in filterpy.

    It is the filter of :mod:`strapdown.estimation`; motion model and rows are the kernels' functions, run as plain Python. ``x`` is the
    error state (δθ, δb, δc) (n,): zero before and after each update, because the correction goes into ``attitude``, ``bias`` and
    ``values``; ``x_post`` stores the last correction. Rows of ``y``, ``R`` and ``S`` are in the unit of the measurement, or rad.

    Parameters
    ----------
    process_noise, initial, error_states : ProcessNoise, State, sequence of ErrorStates
        As for :class:`LiveFilter`.
    sensors : sequence of str, optional
        Names of the sensors; with error states no other name is accepted. Default: with error states, the sensors that they affect, if
        any; otherwise any name.

    See Also
    --------
    LiveFilter : The same filter compiled, five hundred times faster, with a gate, robust weights and late measurements.

    Notes
    -----
    Attributes in addition to those of filterpy's class:

    - ``attitude`` q_fb (4,), ``bias`` of the gyro (3,), rad/s, body axes, and ``values`` of the error states (m,), in the order of their
      declarations;
    - ``nis`` of the last measurement that was not skipped;
    - ``skipped``, by sensor: number of measurements without information: missing (NaN) ones and headings of a vertical vector.

    Examples
    --------
    >>> steps = StepFilter(noise, start)  # doctest: +SKIP
    >>> steps.predict(record.increments[0], record.intervals[0])  # doctest: +SKIP
    >>> steps.update(record.vectors[0], 0)  # doctest: +SKIP
    """

    def __init__(
        self,
        process_noise: ProcessNoise,
        initial: State,
        error_states: Sequence[ErrorStates] = (),
        *,
        sensors: Sequence[str] = (),
    ) -> None:
        check_arguments(process_noise=process_noise)
        self.error_states = modelling.as_blocks(error_states)
        state = modelling.begin(initial, self.error_states)
        refuse("this filter", temperature=temperature_slopes(self.error_states) is not None)
        if isinstance(sensors, str):
            raise InputError(f"sensors is {sensors!r}; it must be a sequence of names, ({sensors!r},)")
        affected = [sensor for block in self.error_states for sensor in block.effects]
        self.sensors = tuple(sensors or affected) if self.error_states else ()
        n = 6 + len(state.values)
        super().__init__(dim_x=n, dim_z=2)
        self.x, self.x_prior, self.x_post = np.zeros((3, n))
        self.y, self.z, self.K = np.zeros(2), np.zeros(2), np.zeros((n, 2))
        self.attitude, self.bias, self.values = state.attitude.copy(), state.bias.copy(), state.values.copy()
        self.P, self.process_noise = state.covariance.copy(), process_noise
        self.nis, self.skipped = 0.0, dict[str, int]()
        self._models: dict[tuple[str, str], modelling.Model] = {}
        self._motion = self._model("", "vector")

    def predict(self, delta_theta: ArrayLike, dt: float) -> None:
        """Propagate over one gyro increment; ``F`` and ``Q`` are then those of the last of its sub-steps.

        Parameters
        ----------
        delta_theta : array_like (3,)
            Rate integrated over the step, rad, body axes.
        dt : float
            Duration of the step, s.

        Raises
        ------
        InputError
            If the duration is not positive, or the increment is too large to be an angle.
        """
        left, dt = array("delta_theta", delta_theta, (3,)), positive("dt", dt, unit="s")
        if np.max(np.abs(left)) > LARGEST_TURN:
            raise InputError(
                f"delta_theta is {left}, too large for the rotation between two samples; it is the rate times dt, rad: check the unit"
            )
        while dt > 0.0:  # sub-steps as long as the series and the decay rates of the states allow
            longest = float(min(step_within(turn_squared(left, dt, self.bias), dt), self._motion.limit))
            part = left * (longest / dt)
            self._sub_step(part, longest)
            left, dt = left - part, dt - longest if longest < dt else 0.0

    def _sub_step(self, part: Array, dt: float) -> None:
        """Propagate over an increment at constant rate, with the kernels' functions."""
        kernels = machine.instance(model_kernels, STRUCTURE=self._motion.structure)
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
            If the sensor is none of those named, the series has no sample k, or its noise is zero.
        """
        instance("series", series, VectorMeasurements, "give a series, as in the vectors of a record")
        if self.sensors:
            one_of("sensor", series.sensor, self.sensors)
        if count("k", k, minimum=0) >= len(series.time):
            raise InputError(
                f"k is {k}, but the series of {series.sensor} has {len(series.time)} samples, counted from 0"
            )
        sample = series.taken([k])
        events = schedule((sample,), -np.inf, np.inf)
        z = tuple(events.vector_b[0].tolist()) if len(events.time) and series.kind != "attitude" else (0.0, 0.0, 0.0)
        vertical = series.kind == "heading" and not has_heading(rotation_matrix(tuple(self.attitude.tolist())), z)
        if not len(events.time) or vertical:
            self.skipped[series.sensor] = self.skipped.get(series.sensor, 0) + 1
            return False
        noise = np.zeros((3, 3))
        noise[np.triu_indices(3)] = noise.T[np.triu_indices(3)] = events.body_noise[0]
        # As `rows_and_axes` of the kernels takes it: over the length of a whole vector's reference.
        length = float(np.linalg.norm(sample.references_f[0])) if series.kind == "vector" else 1.0
        frame, still = tuple(events.triads[0].tolist()), (0.0,) * 9
        measurement = SimpleNamespace(kind=series.kind, z=z, frame=frame, noise=noise, length=length, turning=still)
        return self._measure(measurement, series.sensor)

    predict_update = update

    def _measure(self, measurement: SimpleNamespace, sensor: str) -> bool:
        """Update with a measurement."""
        model, x = self._model(sensor, measurement.kind), np.concatenate([self.attitude, self.bias, self.values])
        kernels = machine.instance(row_kernels, STRUCTURE=model.structure)
        rows, residual, axes, _, _ = kernels.rows_and_axes(0, x, measurement, model.numbers, 0.0)
        unit, T = measurement.length, np.array(axes)
        y, H, R = unit * np.array(residual), unit * np.array(rows, np.float64), unit**2 * T @ measurement.noise @ T.T
        self.dim_z = len(y)
        self.nis = float(y @ np.linalg.solve(H @ self.P @ H.T + R, y))
        self._correct(y, H, R)
        return True

    def _correct(self, residual: Array, H: Array, R: Array) -> None:
        """Correct attitude, bias and error states by filterpy's update; P is then the covariance in the tangent space there."""
        self.R = R
        super().update(residual, HJacobian=lambda x: H, Hx=lambda x: H @ x)
        correction, self.x = self.x, np.zeros(len(self.x))
        before = self.attitude
        self.attitude = quaternion.normalize(quaternion.multiply(before, quaternion.exp(correction[:3])))
        T = self._motion.turning_matrix(before, self.attitude)
        self.bias, self.values = self.bias + correction[3:6], T[6:, 6:] @ (self.values + correction[6:])
        G = np.eye(len(self.P))
        G[:3, :3] = kinematics.right_jacobian(correction[:3])
        self.P = T @ G @ self.P @ (T @ G).T
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
