"""The filter with optional states step by step, on filterpy: for people who look inside, and for blocks told by functions."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import filterpy.kalman
import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, mekf, quaternion
from strapdown.augmented import filtering
from strapdown.augmented import model as modelling
from strapdown.augmented.blocks import Block, GeneralBlock, Interval, View
from strapdown.augmented.filtering import AugmentedEstimate
from strapdown.augmented.model import AugmentedGateMemory, AugmentedState
from strapdown.checks import (
    Array,
    InputError,
    array,
    covariance,
    one_of,
    positive,
    unit_quaternions,
)
from strapdown.kernels import (
    augmented_chain,
    augmented_loop,
    augmented_robust,
    augmented_step,
    filter_loop,
    robust_step,
)
from strapdown.kernels.robust_gate import WIDE_PASSES
from strapdown.kernels.robust_step import ACCEPTED, PASSED_OVER, REFUSED
from strapdown.mekf import ProcessNoise
from strapdown.mekf.judging import Judging
from strapdown.mekf.scheduling import skipped_too
from strapdown.mekf.states import check_arguments, restart_bias_variance
from strapdown.mekf.stepping import Measured, sensor_names, show_refused
from strapdown.records import ImuRecord
from strapdown.robustness import Gate, Linearised, Monitor, Robust, Rows, seen_from, tilt_unknown
from strapdown.vectors import KINDS, need_level, need_unit, triad

KIND_CODES = {
    "direction": filter_loop.DIRECTION,
    "vector": filter_loop.VECTOR,
    "heading": filter_loop.HEADING,
    "attitude": filter_loop.ATTITUDE,
}
TURNED = (filter_loop.DIRECTION, filter_loop.VECTOR)
"""Kinds whose angle from what is predicted the kernels measure."""


class StepFilter(mekf.StepFilter):
    """The same filter with a whole covariance: ``P``, ``F``, ``Q``, ``R``, ``y``, ``S``, ``K``, ``Saver`` work as filterpy's users expect.

    ``x`` is the error state (δθ, δb, δc) (n,): zero before and after each update; ``x_post`` keeps the last correction. ``attitude`` (4,)
    is q_fb, ``bias`` (3,) in rad/s, ``values`` (m,) those of the blocks one after the other, ``time`` in s. All else, late measurements
    and what is counted too, is as in :class:`strapdown.mekf.StepFilter`.

    Parameters
    ----------
    process_noise : ProcessNoise
    initial : mekf.State or AugmentedState
        Of the end of a part of a record (:func:`strapdown.augmented.run_on`), it goes on with what the gate remembers; give its ``time``.
    blocks : sequence of blocks
    gate : Gate, optional
    robust : Robust, optional
    monitor : Monitor, optional
        Tells in ``events`` when the running NIS leaves its bounds. What it needs of each measurement is kept, in memory.
    look_back : float
        s; a measurement may be given so long after its time (:class:`strapdown.mekf.StepFilter`).
    sensors : sequence of str, optional
        Names of all sensors, in the order of the record's series. Default: those that linear blocks are about; where these are about none,
        any name will do.
    time : float
        Time of the initial state, s.
    """

    def __init__(
        self,
        process_noise: ProcessNoise,
        initial: mekf.State | AugmentedState,
        blocks: Sequence[Block] = (),
        *,
        gate: Gate | None = None,
        robust: Robust | None = None,
        monitor: Monitor | None = None,
        look_back: float = 0.0,
        sensors: Sequence[str] = (),
        time: float = 0.0,
    ) -> None:
        check_arguments(process_noise=process_noise, gate=gate, robust=robust, monitor=monitor)
        blocks = modelling.as_blocks(blocks)
        state = modelling.begin(initial, blocks)
        names = sensor_names(sensors)
        about = {sensor: block.name for block in blocks for sensor in getattr(block, "effects", {})}
        for sensor, block in about.items() if names else ():
            one_of(f"{block}: sensor", sensor, names)
        size = 6 + len(state.values)
        self.sensors = names or tuple(about)
        super().__init__(
            process_noise,
            mekf.State(attitude=state.attitude, bias=state.bias, covariance=np.eye(6)),
            gate=gate,
            robust=robust,
            look_back=look_back,
            sensors=self.sensors,
            time=time,
        )
        filterpy.kalman.ExtendedKalmanFilter.__init__(self, dim_x=size, dim_z=2)
        self.blocks = blocks
        self.kinds: dict[str, str] = {}
        self.values: Array = state.values.copy()
        self.x, self.x_prior, self.x_post = np.zeros((3, size))
        self.P = state.covariance.copy()
        self.y, self.z, self.K = np.zeros(2), np.zeros(2), np.zeros((size, 2))
        self.rate = np.zeros(3)
        bounds = np.cumsum([0, *(block.size for block in self.blocks)])
        self._parts = [slice(a, b) for a, b in itertools.pairwise(bounds)]
        self._models: dict[str, modelling.Model] = {}
        # What the blocks of a challenger know, carried along.
        self._prior = _Gaussian(*filtering.restart_states(state, self.blocks))
        self._restart_bias_variance = restart_bias_variance(gate, state)
        self._expected = _Gaussian(self.y, np.eye(2))
        memory = None if modelling.general(self.blocks) else state.gate
        self._judging: _Judging = _Judging(gate, memory, monitor)  # type: ignore[assignment]
        self._passes = self._judging.passes
        if gate is not None and memory is not None:
            self._go_on(memory)

    def _go_on(self, memory: AugmentedGateMemory) -> None:
        """Take over what the blocks of a challenger knew at the start of a record, and the challenger."""
        if self.time < memory.start:
            raise InputError(
                f"time is {self.time:.9g} s, before the record of initial began, {memory.start:.9g} s; give the time of initial"
            )
        since = Interval(time=memory.start, dt=self.time - memory.start, attitude=self.attitude, rate=self.rate)
        self._prior = self._carried(_Gaussian(memory.values, memory.covariance), since)
        if self._judging.challenged:
            order = modelling.assemble(self.blocks, dict.fromkeys(self.sensors, "vector")).whole_order
            back, size = np.argsort(order), len(order)
            attitude, x, F = np.split(memory.challenger, [4, 4 + size - 3])
            root = F.reshape(size, size)[:, back]
            others = np.concatenate([np.zeros(3), x])[back][3:]
            self._judging.challenger = self._challenger(
                AugmentedState(
                    attitude=attitude, bias=others[:3], values=others[3:], covariance=root.T @ root, factor=root
                )
            )

    def _predict(self, increment: Array, step: float, end: float) -> None:
        model, left = self._model(""), step
        rival = self._judging.challenger
        running = [self] if rival is None else [self, rival]
        while left > 0.0:
            x = np.array([one.bias for one in running])
            longest = float(augmented_loop.longest_common_step(left, tuple(increment), x, len(x), model.limit))
            part = increment * (longest / left)
            for one in running:
                one._step(part, longest, model)
            increment, left = increment - part, left - longest if longest < left else 0.0
        for one in running:
            one.time = end

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
                told, rows = _told(block, "gyro", block.gyro(self.values[where], interval), interval.time)
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
        row = augmented_step.fill_noise(
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
        links = np.empty((len(model.chains), augmented_chain.LINKS))
        augmented_chain.link_chains(decay, model.chains, dt, links)
        augmented_chain.feed_states(x, 3, links)
        augmented_chain.carry_chains(columns, 0, 6 + m, links)
        augmented_chain.fill_chain_noise(N, row, 6 + m, model.chains, links)
        self.F, self.Q = columns.T.copy(), N.T @ N
        self.values = x[3 : 3 + m]
        if self.gate is not None and self.gate.recovery:
            self._prior = self._carried(self._prior, interval)
        for block, where in zip(self.blocks, self._parts, strict=True):
            if isinstance(block, GeneralBlock):
                own = slice(6 + where.start, 6 + where.stop)
                after = _told(block, "propagate", block.propagate(self.values[where], interval), interval.time)
                self.values[where], self.F[own, own], self.F[own, :3], self.Q[own, own] = after
        filterpy.kalman.ExtendedKalmanFilter.predict(self)
        self.attitude = quaternion.normalize(np.array(attitude))
        self.rate = np.array(rate)
        self.time += dt

    def _carried(self, prior: _Gaussian, interval: Interval) -> _Gaussian:
        """Return what the blocks' prior is after an interval."""
        values, P = prior.mean, prior.covariance
        Phi, Q, moved = np.zeros_like(P), np.zeros_like(P), np.empty(len(values))
        for block, where in zip(self.blocks, self._parts, strict=True):
            own = where, where
            if isinstance(block, GeneralBlock):
                after = _told(block, "propagate", block.propagate(values[where], interval), interval.time)
                moved[where], Phi[own], _, Q[own] = after
            else:
                Phi[own], Q[own] = block.transition(interval.dt), block.process_noise(interval.dt)
                moved[where] = Phi[own] @ values[where]
        return _Gaussian(moved, Phi @ P @ Phi.T + Q)

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
        """Update with a measured unit direction (3,) of a known one (3,): two degrees of freedom.

        ``sigma``, here and below: of each component, of each body axis (3,), or a covariance in body axes (3, 3), the square of the unit,
        which ``covariance`` may tell as well. ``time`` is that of validity, s, if it is not now. Returns whether it was taken in.
        """
        return self._vector("direction", vector_b, reference_f, (sigma, covariance), sensor, time)

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
        """Update with a measured vector (3,) of a known one (3,), in their unit: three degrees of freedom."""
        return self._vector("vector", vector_b, reference_f, (sigma, covariance), sensor, time)

    def update_heading(
        self,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        sigma: float,
        sensor: str = "",
        *,
        time: float | None = None,
    ) -> bool:
        """Update with the heading of a measured vector's horizontal part: one degree of freedom, ``sigma`` rad."""
        return self._vector("heading", vector_b, reference_f, (sigma, None), sensor, time)

    def update_attitude(
        self,
        attitude: ArrayLike,
        sigma: ArrayLike | None = None,
        sensor: str = "",
        *,
        covariance: ArrayLike | None = None,
        time: float | None = None,
    ) -> bool:
        """Update with a measured attitude q_fb (4,): three degrees of freedom."""
        given = array("attitude", attitude, (4,), allow_nan=True)
        if np.isnan(given).any():
            return self._skip(sensor)
        measured = unit_quaternions("attitude", given)
        frame = (*measured, 0.0, 0.0, 0.0, 0.0, 0.0)
        noise = _covariance(sigma, covariance)
        return self._give(_Measured(kind="attitude", z=(0.0, 0.0, 0.0), frame=frame, noise=noise, sensor=sensor), time)

    def _vector(
        self,
        kind: str,
        vector_b: ArrayLike,
        reference_f: ArrayLike,
        noise: tuple[ArrayLike | None, ArrayLike | None],
        sensor: str,
        time: float | None,
    ) -> bool:
        z = array("vector_b", vector_b, (3,), allow_nan=True)
        if np.isnan(z).any():
            return self._skip(sensor)
        if kind != "vector":
            need_unit("vector_b", z)
        r = array("reference_f", reference_f, (3,))
        frame = triad(r)
        if kind == "heading":
            need_level("reference_f", frame[2])
            positive("sigma", noise[0], unit="rad")  # type: ignore[arg-type]
        length = float(np.linalg.norm(r)) if kind == "vector" else 1.0
        return self._give(
            _Measured(
                kind=kind,
                z=tuple(z / length),
                frame=tuple(frame.ravel()),
                length=length,
                noise=_covariance(*noise) / length**2,
                sensor=sensor,
                reference=r,
            ),
            time,
        )

    def _need_known(self, sensor: str) -> None:
        if self.sensors and sensor not in self.sensors:
            raise InputError(
                f"sensor is {sensor!r}, which is none of {', '.join(self.sensors)}; say which of them it is, or name all sensors to "
                "StepFilter(sensors=…)"
            )

    def _skip(self, sensor: str) -> bool:
        self._need_known(sensor)
        return super()._skip(sensor)

    def _give(self, measured: _Measured, time: float | None) -> bool:
        """Take in a measurement at its time (:meth:`strapdown.mekf.StepFilter._measure`)."""
        sensor = measured.sensor
        self._need_known(sensor)
        if self.kinds.setdefault(sensor, measured.kind) != measured.kind:
            raise InputError(
                f"{sensor or 'the sensor'} gave kind {self.kinds[sensor]!r} before, now {measured.kind!r}; name each sensor"
            )
        return self._measure(measured, sensor, time, measured.kind == "heading")

    def _kept(self) -> dict[str, Any]:
        kept = super()._kept()
        return {**kept, "values": self.values, "rate": self.rate, "_prior": self._prior} if kept else {}

    def _rows(self, measured: _Measured, attitude: Array, others: Array) -> Rows:
        """Return a measurement as seen from an attitude and (b, c) (3 + m,)."""
        model, m = self._model(measured.sensor), len(self.values)
        values = others[3:]
        sensors, use = np.zeros((1, m + 1, 15)), np.zeros((1, m + 1), np.int64)
        sensors[:, :m], use[:, :m] = model.sensors, model.sensor_use
        for block, where in zip(self.blocks, self._parts, strict=True):
            if isinstance(block, GeneralBlock) and measured.reference is not None:
                expected = quaternion.rotate(quaternion.conjugate(attitude), measured.reference)
                view = View(
                    sensor=measured.sensor, time=self.time, attitude=attitude, rate=self.rate, expected_b=expected
                )
                effect = block.measured(values[where], view)
                if effect is not None:
                    if measured.kind == "heading":
                        raise InputError(
                            f"{block.name}: {measured.sensor} is of kind 'heading', on which it has no effect; leave it out"
                        )
                    told, rows = _told(block, "measured", effect, self.time, measured.sensor)
                    sensors[0, where, :3] = rows
                    use[0, where] = augmented_step.OFFSET
                    sensors[0, m, :3] += told - values[where] @ rows
                    use[0, m] = augmented_step.OFFSET
        H, y, basis = np.empty((3, 7 + m)), np.empty(3), np.empty((3, 3))
        R = tuple(quaternion.to_matrix(attitude).ravel())
        code = KIND_CODES[measured.kind]
        z, x = measured.z, np.append(others, 1.0)
        count = augmented_step.fill_rows(
            tuple(attitude), R, x, code, z, measured.frame, measured.length, 0, sensors, use, (0.0,) * 9, H, y, basis
        )
        far, along = augmented_robust.seen_from_afar(code, z, count, y, basis)
        angle = math.atan2(float(np.hypot(y[0], y[1])), along) if code in TURNED else 0.0
        noise = (basis @ measured.noise @ basis.T)[:count, :count]
        return y[:count].copy(), H[:count, : 6 + m].copy(), noise, angle, far

    def _linearised(self, measured: _Measured, others: Array, threshold: float) -> Linearised:
        """Return a measurement seen from the state that its update leads to: :func:`strapdown.robustness.linearise`, all states along."""
        A = self.P[:3, :3]
        unknown = np.trace(A) >= robust_step.UNKNOWN
        tolerance = robust_step.SETTLED if unknown else robust_step.RELINEARIZED
        now, now_others, P, prior = self.attitude, others, self.P, np.zeros(len(self.P))
        done, trials, first = 1, 0, None
        while True:
            residual, H, noise, angle, far = self._rows(measured, now, now_others)
            seen = Linearised(attitude=now, covariance=P, prior=prior, residual=residual, H=H, noise=noise, angle=angle)
            if self._passes == 1:
                return seen
            first = first or seen
            # The arc replaces the chord in the rows made independent, the first two of them.
            lower = np.linalg.cholesky(noise)
            lower = lower / np.diag(lower)
            stretch = np.array([far, far, 1.0])[: len(residual)]
            from_afar = lower @ (stretch * np.linalg.solve(lower, residual)) - H @ prior
            step = prior + P @ H.T @ np.linalg.solve(seen.predicted + noise, from_afar)
            on_rows = np.linalg.solve(lower, H[:, 6:] @ step[6:])
            converged = bool(step[:3] @ step[:3] + on_rows @ on_rows < tolerance**2)
            if converged or done >= self._passes:
                seen = seen if converged else dataclasses.replace(first, converged=False)
                if seen.acceptable(threshold) or trials == 2 or not unknown:
                    return seen
                trials += 1
                done, now, now_others, step = 0, self.attitude, others, np.zeros(len(P))
                axis = np.array(robust_step.least_certain_axis(tuple(A[np.triu_indices(3)])))
                step[:3] = math.copysign(robust_step.TURN_ASIDE, trials - 1.5) * axis
            last, now = now, quaternion.normalize(quaternion.multiply(now, quaternion.exp(step[:3])))
            now_others = self._turning(last, now)[3:, 3:] @ (now_others + step[3:])
            P, back = seen_from(quaternion.multiply(quaternion.conjugate(self.attitude), now), self.P)
            T = self._turning(self.attitude, now)
            P = T @ P @ T.T
            prior = np.concatenate([back, T[3:, 3:] @ others - now_others])
            done += 1

    def _correct(self, rows: Measured, of_heading: bool) -> int:
        """Take in a measurement; return ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``."""
        assert isinstance(rows, _Measured)
        if not rows.shown(self.attitude):
            self.weight = 0.0
            self._expected = _Gaussian(np.array([np.nan]), np.eye(1))
            return PASSED_OVER
        return self._take(rows)

    def _take(self, measured: _Measured) -> int:
        others = np.concatenate([self.bias, self.values])
        threshold = np.inf if self.gate is None else float(self.gate.thresholds[KINDS[measured.kind] - 1])
        before = self.attitude
        seen = self._linearised(measured, others, threshold)
        self.nis = seen.nis
        self.dim_z = len(seen.residual)
        self._expected = _Gaussian(seen.innovation, seen.predicted + seen.noise)
        unknown = self._passes > 1 and measured.kind == "heading" and tilt_unknown(self.attitude, self.P)
        if unknown or not seen.acceptable(threshold):
            self.weight = 0.0
            show_refused(self, seen)
            return PASSED_OVER if unknown else REFUSED
        self.weight = 1.0 if self.robust is None else seen.weight(self.robust)
        self.attitude, self.P, self.x = seen.attitude, seen.covariance, seen.prior.copy()
        self.values = self._turning(before)[6:, 6:] @ self.values
        H, before = seen.H, self.attitude
        filterpy.kalman.ExtendedKalmanFilter.update(
            self, seen.residual, HJacobian=lambda x: H, Hx=lambda x: H @ x, R=seen.noise / self.weight
        )
        correction = self.x[:3]
        self._move(self.x - np.concatenate([np.zeros(3), seen.prior[3:]]))
        if self._passes > 1 and np.trace(self.P[:3, :3]) > robust_step.KNOWN:
            self.P, _ = seen_from(quaternion.exp(correction), self.P)
        else:
            G = np.eye(len(self.x))
            G[:3, :3] = kinematics.right_jacobian(correction)
            self.P = G @ self.P @ G.T
        G = self._turning(before)
        self.P = G @ self.P @ G.T
        self.P_post = self.P.copy()
        self.x = np.zeros(len(self.x))
        return ACCEPTED

    def _move(self, correction: Array) -> None:
        before = self.attitude
        self.attitude = quaternion.normalize(quaternion.multiply(before, quaternion.exp(correction[:3])))
        self.bias, self.values = self.bias + correction[3:6], self.values + correction[6:]
        self.values = self._turning(before)[6:, 6:] @ self.values

    def _turning(self, before: Array, after: Array | None = None) -> Array:
        """Return what a correction of the attitude, to the present one, makes of the states (n, n): it turns those that are carried."""
        after = self.attitude if after is None else after
        return modelling.turning_matrix(self._model("").chains, len(self.x), before, after)

    def _restarted(self, attitude_sigma: float, bias_width: float) -> StepFilter:
        P = np.zeros_like(self.P)
        P[:3, :3] = attitude_sigma**2 * np.eye(3)
        P[3:6, 3:6] = self.P[3:6, 3:6] + bias_width**2 * np.diag(self._restart_bias_variance)
        P[6:, 6:] = self._prior.covariance
        return self._challenger(
            AugmentedState(attitude=self.attitude, bias=self.bias, values=self._prior.mean, covariance=P)
        )

    def _challenger(self, state: AugmentedState) -> StepFilter:
        """Return a challenger in this state."""
        rival = StepFilter(self.process_noise, state, self.blocks, gate=self.gate, robust=self.robust, time=self.time)
        rival.rate = self.rate
        rival.kinds, rival._models = self.kinds, self._models
        rival._passes = WIDE_PASSES
        return rival

    def _become(self, other: mekf.StepFilter) -> None:
        for name in ("attitude", "bias", "values", "P", "rate"):
            setattr(self, name, getattr(other, name))

    def state(self) -> AugmentedState:
        """Return the present state."""
        P = 0.5 * (self.P + self.P.T)
        return AugmentedState(attitude=self.attitude, bias=self.bias, values=self.values, covariance=P)


class _Judging(Judging[StepFilter]):
    """Judging with what a challenger carries."""

    def _widen(self, rival: StepFilter) -> None:
        before = rival.attitude
        super()._widen(rival)
        T = rival._turning(before)  # of what the rival carries, too
        rival.P = T @ rival.P @ T.T


@dataclass(frozen=True, eq=False)
class _Gaussian:
    """A vector and its covariance, as one object, for of a pair ``Saver`` makes an array, and finds no shape."""

    mean: Array
    covariance: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class _Measured:
    """A measurement as the kernels take it."""

    kind: str
    z: tuple[float, ...]
    frame: tuple[float, ...]
    length: float = 1.0
    noise: Array
    sensor: str
    reference: Array | None = None

    def shown(self, attitude: Array) -> bool:
        """Return whether it is not the heading of a vector that is vertical, seen from an attitude."""
        R = tuple(quaternion.to_matrix(attitude).ravel())
        return self.kind != "heading" or bool(robust_step.has_heading(R, self.z))

    def __call__(self, attitude: Array) -> Rows:
        """Return rows that tell whether it shows anything at all, which is what the plain filter asks of it."""
        return np.zeros(1), np.full((1, 1), float(self.shown(attitude))), np.eye(1), 0.0, 1.0


def _covariance(sigma: ArrayLike | None, whole: ArrayLike | None) -> Array:
    """Return the covariance (3, 3) of a noise told by one sigma, one an axis, or itself as either."""
    if (sigma is None) == (whole is None):
        raise InputError("give either sigma or covariance: the noise of the measurement")
    if sigma is None:
        return covariance("covariance", np.asarray(whole), 3)
    if np.ndim(sigma) == 2:
        return covariance("sigma", array("sigma", sigma, (3, 3)), 3)
    if np.shape(sigma) not in ((), (3,)):
        raise InputError(f"sigma has shape {np.shape(sigma)}; give one number, one an axis (3,) or a covariance (3, 3)")
    return np.diag([positive("sigma", value) ** 2 for value in np.broadcast_to(sigma, 3)])


TOLD: dict[str, tuple[tuple[str, tuple[str | int, ...]], ...]] = {
    "propagate": (
        ("values", ("size",)),
        ("Φ", ("size", "size")),
        ("∂values/∂δθ", ("size", 3)),
        ("Q", ("size", "size")),
    ),
    "gyro": (("what is added", (3,)), ("its derivatives", ("size", 3))),
    "measured": (("what is added", (3,)), ("its derivatives", ("size", 3))),
}
"""What each function of a general block returns."""


def _told(block: GeneralBlock, function: str, told: object, time: float, sensor: str = "") -> list[Array]:
    """Return what a function of a block returned as arrays; anything but numbers of the right shapes is refused."""
    of = f" of {sensor}" if sensor else ""
    place, wanted = f"{block.name}: {function}{of} at {time:.9g} s", TOLD[function]
    if not isinstance(told, tuple | list) or len(told) != len(wanted):
        raise InputError(f"{place} returned {told!r:.60}; return {', '.join(name for name, _ in wanted)} as a tuple")
    return [
        array(f"{place}: {name}", value, tuple(block.size if n == "size" else n for n in shape))
        for (name, shape), value in zip(wanted, told, strict=True)
    ]


def run_on(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: AugmentedState,
    blocks: tuple[Block, ...],
    *,
    every: int = 1,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
    face: StepFilter | None = None,
) -> tuple[AugmentedEstimate, AugmentedState]:
    """Run a record through :class:`StepFilter`: what :func:`strapdown.augmented.run` does with general blocks.

    ``face`` is the filter itself, where the caller has made it.
    """
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    begin = float(record.time[0])
    if face is None:
        face = StepFilter(process_noise, initial, blocks, gate=gate, robust=robust, time=begin)
    face.time, face.sensors = begin, events.sensors
    face.kinds = dict(zip(events.sensors, events.kinds, strict=True))
    modelling.assemble(blocks, face.kinds)  # refuses effects on sensors that are not there
    size = 6 + len(initial.values)
    innovation, weight = np.empty((len(events.time), 6)), np.empty(len(events.time))
    rows, e, now = [], 0, record.time[0]
    for k in range(-1, len(record.increments)):
        end = record.time[k + 1]
        whole, start = end - record.time[max(k, 0)], now
        while e < len(events.time) and events.time[e] <= end:
            if events.time[e] > now:
                face.predict(record.increments[k] * ((events.time[e] - now) / whole), events.time[e] - now)
                now = events.time[e]
            _take(face, record, events, e, innovation[e])
            weight[e] = face.weight
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
    innovations = mekf.innovations_by_sensor(events, innovation, None if gate is None and robust is None else weight)
    estimate = filtering.packed(
        outside,
        blocks,
        record.time,
        every,
        attitude,
        x,
        np.einsum("kii->ki", P),
        P if full_covariance else None,
        innovations,
        skipped_too(events, innovations),
        face.events,
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
    y, S = face._expected.mean, face._expected.covariance  # under the nominal noise, whatever the weight
    L = np.linalg.cholesky(S)
    diagonal = np.diag(L)
    n = len(y)
    innovation[0 : 2 * n : 2] = np.linalg.solve(L / diagonal, y)
    innovation[1 : 2 * n : 2] = diagonal**2


def _outside_order(model: modelling.Model, sensors: list[int]) -> modelling.Model:
    """Return the model in the order of outside, with some of its sensors only."""
    back = np.argsort(model.order)
    return dataclasses.replace(
        model,
        order=np.arange(len(back)),
        decay=model.decay[back],
        density=model.density[back],
        chains=model.chains[back] if len(model.chains) else model.chains,
        gyro=model.gyro[back],
        gyro_use=model.gyro_use[back],
        sensors=model.sensors[sensors][:, back],
        sensor_use=model.sensor_use[sensors][:, back],
    )
