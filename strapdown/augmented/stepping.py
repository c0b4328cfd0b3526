"""The filter with optional states step by step, on filterpy: for people who look inside, and for blocks told by functions."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, mekf, quaternion
from strapdown.augmented import filtering
from strapdown.augmented import model as modelling
from strapdown.augmented.blocks import Block, GeneralBlock, Interval, View
from strapdown.augmented.filtering import AugmentedEstimate
from strapdown.augmented.model import AugmentedState
from strapdown.checks import Array, InputError, array, covariance, positive, unit_quaternions
from strapdown.kernels import augmented_step, filter_loop
from strapdown.mekf import ProcessNoise
from strapdown.records import ImuRecord
from strapdown.vectors import triad

KIND_CODES = {
    "direction": filter_loop.DIRECTION,
    "vector": filter_loop.VECTOR,
    "heading": filter_loop.HEADING,
    "attitude": filter_loop.ATTITUDE,
}


class StepFilter(filterpy.kalman.ExtendedKalmanFilter):  # type: ignore[misc]
    """The same filter with a whole covariance: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K``, ``Saver`` work as filterpy's users expect.

    ``x`` is the error state (δθ, δb, δc) (n,): zero before and after each update; ``x_post`` keeps the last correction. ``attitude`` (4,)
    is q_fb, ``bias`` (3,) in rad/s, ``values`` (m,) those of the blocks one after the other. ``time`` counts from 0 unless set.
    """

    def __init__(
        self, process_noise: ProcessNoise, initial: mekf.State | AugmentedState, blocks: Sequence[Block] = ()
    ) -> None:
        state = modelling.begin(initial, tuple(blocks))
        size = 6 + len(state.values)
        super().__init__(dim_x=size, dim_z=2)
        self.process_noise = process_noise
        self.blocks = tuple(blocks)
        self.kinds: dict[str, str] = {}
        self.attitude: Array = state.attitude.copy()
        self.bias: Array = state.bias.copy()
        self.values: Array = state.values.copy()
        self.x = np.zeros(size)
        self.P = state.covariance.copy()
        self.y = np.zeros(2)
        self.time = 0.0
        self.rate = np.zeros(3)
        bounds = np.cumsum([0, *(block.size for block in self.blocks)])
        self._parts = [slice(a, b) for a, b in itertools.pairwise(bounds)]
        self._models: dict[str, modelling.Model] = {}

    def predict(self, delta_theta: ArrayLike, dt: float) -> None:
        """Propagate over one gyro increment (3,), rad, of dt seconds."""
        increment = array("delta_theta", delta_theta, (3,))
        left = positive("dt", dt, unit="s")
        model = self._model("")
        longest = augmented_step.longest_step(left, tuple(increment), model.limit)
        whole = left
        while left > 0.0:
            step = min(longest, left)
            self._step(increment * (step / whole), step, model)
            left = left - step if left > longest else 0.0

    def _model(self, sensor: str) -> modelling.Model:
        """Return the linear blocks as arrays, seen from one sensor."""
        if sensor not in self._models:
            kinds = {name: "vector" for block in self.blocks for name in getattr(block, "effects", {})}
            kinds[sensor] = self.kinds.get(sensor, "vector")
            model = modelling.assemble(self.blocks, kinds)
            here = [list(kinds).index(sensor)]
            if model.levers.any() or model.varying:
                raise InputError(
                    "lever arms, and effects on a strength that varies, run compiled only; use augmented.run with linear blocks"
                )
            self._models[sensor] = _outside_order(model, here)
        return self._models[sensor]

    def _step(self, part: Array, dt: float, model: modelling.Model) -> None:
        noise, m = self.process_noise, len(self.values)
        interval = Interval(time=self.time, dt=dt, attitude=self.attitude, rate=part / dt - self.bias)
        # A block told by functions enters as columns about its present value, and one state more that is 1 and holds that value.
        gyro, use = np.zeros((m + 1, 12)), np.zeros(m + 1, np.int64)
        gyro[:m], use[:m] = model.gyro, model.gyro_use
        for block, where in zip(self.blocks, self._parts, strict=True):
            if isinstance(block, GeneralBlock):
                told, rows = block.gyro(self.values[where], interval)
                gyro[where, :3] = rows
                use[where] = augmented_step.OFFSET * np.any(np.asarray(rows) != 0.0, axis=1)
                gyro[m, :3] += told - self.values[where] @ rows
        use[m] = augmented_step.OFFSET
        x = np.array([*self.bias, *self.values, 1.0])
        coupling, factor = np.empty((m + 1, 3)), np.empty(m + 1)
        decay, density = np.append(model.decay, 0.0), np.append(model.density, 0.0)
        attitude, phi11, phi12, rate, D = augmented_step.move(
            tuple(self.attitude), x, dt, tuple(part), decay, gyro, use, tuple(model.force_f), coupling, factor
        )
        columns = np.eye(6 + m)
        augmented_step.carry(columns, 0, 6 + m, phi11, phi12, coupling[:m], factor[:m], use[:m], m)
        N = np.zeros((6 + 3 * m, 6 + m))
        augmented_step.fill_noise(
            N,
            0,
            6 + m,
            dt,
            rate,
            D,
            noise.angle_random_walk**2,
            noise.rate_random_walk**2,
            decay[:m],
            density[:m],
            gyro[:m],
            use[:m],
        )
        self.F, self.Q = columns.T.copy(), N.T @ N
        self.values = x[3 : 3 + m]
        for block, where in zip(self.blocks, self._parts, strict=True):
            if isinstance(block, GeneralBlock):
                own = slice(6 + where.start, 6 + where.stop)
                self.values[where], transition, from_attitude, driven = block.propagate(self.values[where], interval)
                self.F[own, own], self.F[own, :3], self.Q[own, own] = transition, from_attitude, driven
        super().predict()
        self.attitude = quaternion.normalize(np.array(attitude))
        self.rate = np.array(rate)
        self.time += dt

    def update_direction(self, vector_b: ArrayLike, reference_f: ArrayLike, sigma: ArrayLike, sensor: str = "") -> None:
        """Update with a measured unit direction (3,) of a known one (3,): two degrees of freedom.

        ``sigma``, here and below: of each component, of each body axis (3,), or a covariance in body axes (3, 3), the square of the unit.
        """
        self._update("direction", vector_b, reference_f, sigma, sensor)

    def update_vector(self, vector_b: ArrayLike, reference_f: ArrayLike, sigma: ArrayLike, sensor: str = "") -> None:
        """Update with a measured vector (3,) of a known one (3,), in their unit: three degrees of freedom."""
        self._update("vector", vector_b, reference_f, sigma, sensor)

    def update_heading(self, vector_b: ArrayLike, reference_f: ArrayLike, sigma: float, sensor: str = "") -> None:
        """Update with the heading of a measured vector's horizontal part: one degree of freedom, ``sigma`` rad."""
        self._update("heading", vector_b, reference_f, positive("sigma", sigma, unit="rad"), sensor)

    def update_attitude(self, attitude: ArrayLike, sigma: ArrayLike, sensor: str = "") -> None:
        """Update with a measured attitude q_fb (4,): three degrees of freedom."""
        measured = unit_quaternions("attitude", array("attitude", attitude, (4,)))
        frame = (*measured, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._rows("attitude", (0.0, 0.0, 0.0), frame, 1.0, _covariance(sigma), sensor, None)

    def _update(self, kind: str, vector_b: ArrayLike, reference_f: ArrayLike, sigma: ArrayLike, sensor: str) -> None:
        z, r = array("vector_b", vector_b, (3,)), array("reference_f", reference_f, (3,))
        length = float(np.linalg.norm(r)) if kind == "vector" else 1.0
        noise = _covariance(sigma) / length**2
        self._rows(kind, tuple(z / length), tuple(triad(r).ravel()), length, noise, sensor, r)

    def _rows(
        self,
        kind: str,
        z: tuple[float, ...],
        frame: tuple[float, ...],
        length: float,
        noise: Array,
        sensor: str,
        reference: Array | None,
    ) -> None:
        if self.kinds.setdefault(sensor, kind) != kind:
            raise InputError(
                f"{sensor or 'the sensor'} gave kind {self.kinds[sensor]!r} before, now {kind!r}; name each sensor"
            )
        model, m = self._model(sensor), len(self.values)
        sensors, use = np.zeros((1, m + 1, 15)), np.zeros((1, m + 1), np.int64)
        sensors[:, :m], use[:, :m] = model.sensors, model.sensor_use
        for block, where in zip(self.blocks, self._parts, strict=True):
            if isinstance(block, GeneralBlock) and reference is not None:
                expected = quaternion.rotate(quaternion.conjugate(self.attitude), reference)
                view = View(sensor=sensor, time=self.time, attitude=self.attitude, rate=self.rate, expected_b=expected)
                effect = block.measured(self.values[where], view)
                if effect is not None:
                    if kind == "heading":
                        raise InputError(
                            f"{block.name}: {sensor} is of kind 'heading', on which it has no effect; leave it out"
                        )
                    told, rows = effect
                    sensors[0, where, :3] = rows
                    use[0, where] = augmented_step.OFFSET
                    sensors[0, m, :3] += told - self.values[where] @ rows
                    use[0, m] = augmented_step.OFFSET
        H, y, basis = np.empty((3, 7 + m)), np.empty(3), np.empty((3, 3))
        x = np.array([*self.bias, *self.values, 1.0])
        R = tuple(quaternion.to_matrix(self.attitude).ravel())
        code = KIND_CODES[kind]
        count = augmented_step.fill_rows(
            tuple(self.attitude), R, x, code, z, frame, length, 0, sensors, use, (0.0,) * 9, H, y, basis
        )
        self._correct(y[:count].copy(), H[:count, : 6 + m].copy(), (basis @ noise @ basis.T)[:count, :count])

    def _correct(self, residual: Array, H: Array, noise: Array) -> None:
        self.dim_z = len(residual)
        zero = np.zeros(len(residual))
        super().update(residual, HJacobian=lambda x: H, Hx=lambda x: zero, R=noise)
        correction = self.x[:3]
        self.attitude = quaternion.normalize(quaternion.multiply(self.attitude, quaternion.exp(correction)))
        self.bias = self.bias + self.x[3:6]
        self.values = self.values + self.x[6:]
        G = np.eye(len(self.x))
        G[:3, :3] = kinematics.right_jacobian(correction)
        self.P = G @ self.P @ G.T
        self.P_post = self.P.copy()
        self.x = np.zeros(len(self.x))

    def state(self) -> AugmentedState:
        """Return the present state."""
        P = 0.5 * (self.P + self.P.T)
        return AugmentedState(attitude=self.attitude, bias=self.bias, values=self.values, covariance=P)


def _covariance(sigma: ArrayLike) -> Array:
    """Return the covariance (3, 3) of a noise told by one sigma, one an axis, or itself."""
    if np.ndim(sigma) == 2:
        return covariance("sigma", array("sigma", sigma, (3, 3)), 3)
    return np.diag([positive("sigma", value) ** 2 for value in np.broadcast_to(sigma, 3)])


def run_on(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: AugmentedState,
    blocks: tuple[Block, ...],
    *,
    every: int = 1,
    full_covariance: bool = False,
) -> tuple[AugmentedEstimate, AugmentedState]:
    """Run a record through :class:`StepFilter`: what :func:`strapdown.augmented.run` does with general blocks."""
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    face = StepFilter(process_noise, initial, blocks)
    face.time = float(record.time[0])
    face.kinds = dict(zip(events.sensors, events.kinds, strict=True))
    modelling.assemble(blocks, face.kinds)  # refuses effects on sensors that are not there
    size = 6 + len(initial.values)
    innovation = np.empty((len(events.time), 6))
    rows, e, now = [], 0, record.time[0]
    for k in range(-1, len(record.increments)):
        end = record.time[k + 1]
        whole, start = end - record.time[max(k, 0)], now
        while e < len(events.time) and events.time[e] <= end:
            if events.time[e] > now:
                face.predict(record.increments[k] * ((events.time[e] - now) / whole), events.time[e] - now)
                now = events.time[e]
            _take(face, record, events, e, innovation[e])
            e += 1
        if end > now:
            face.predict(
                record.increments[k] * ((end - now) / whole) if now > start else record.increments[k], end - now
            )
            now = end
        if (k + 1) % every == 0:
            rows.append((face.attitude, face.bias, face.values, face.P.copy()))
    attitude, bias, values, P = (np.array([row[i] for row in rows]) for i in range(4))
    plain = modelling.assemble(blocks, face.kinds)
    outside = dataclasses.replace(plain, order=np.arange(size - 6))
    x = np.concatenate([bias, values], axis=1)
    estimate = filtering.packed(
        outside,
        blocks,
        record.time,
        every,
        attitude,
        x,
        np.einsum("kii->ki", P),
        P if full_covariance else None,
        mekf.innovations_by_sensor(events, innovation),
        events.skipped,
    )
    return estimate, face.state()


def _take(face: StepFilter, record: ImuRecord, events: mekf.Schedule, e: int, innovation: Array) -> None:
    """Update with one event, and write its innovations made independent as the compiled filter's are."""
    series = record.vectors[events.sensor[e]]
    j = int(np.searchsorted(series.time, events.time[e]))
    if series.attitude is not None:
        face.update_attitude(series.attitude[j], series.covariances[j], series.sensor)
    elif series.kind == "heading":
        face.update_heading(series.vector_b[j], series.references_f[j], series.sigma[j], series.sensor)
    else:
        update = face.update_direction if series.kind == "direction" else face.update_vector
        update(series.vector_b[j], series.references_f[j], series.covariances[j], series.sensor)
    L = np.linalg.cholesky(face.S)
    diagonal = np.diag(L)
    n = len(face.y)
    innovation[0 : 2 * n : 2] = np.linalg.solve(L / diagonal, face.y)
    innovation[1 : 2 * n : 2] = diagonal**2


def _outside_order(model: modelling.Model, sensors: list[int]) -> modelling.Model:
    """Return the model in the order of outside, with some of its sensors only."""
    back = np.argsort(model.order)
    return dataclasses.replace(
        model,
        order=np.arange(len(back)),
        decay=model.decay[back],
        density=model.density[back],
        gyro=model.gyro[back],
        gyro_use=model.gyro_use[back],
        sensors=model.sensors[sensors][:, back],
        sensor_use=model.sensor_use[sensors][:, back],
    )
