"""Optional states: the plain filter without them, one filter on both faces, exact models, sharp measurements, foreign blocks, bad input."""

import dataclasses
import json
import math

import filterpy.common
import in_steps
import mpmath
import numpy as np
import pytest
from measured import (
    EVERY_KIND,
    FIELD,
    HAND,
    SWAY,
    UP,
    beside_silent,
    correlation,
    every_kind,
    in_body,
    record_of,
    resting,
    series_of,
    state_errors,
    turn_to,
    unit,
)
from plain_kernels import called

from strapdown import estimation, kinematics, motion, quaternion, records
from strapdown.estimation import error_states, forward
from strapdown.estimation.gating import Gate
from strapdown.estimation.observability import state_names, without_errors
from strapdown.estimation.states import ProcessNoise, changed
from strapdown.estimation.step_filter import StepFilter
from strapdown.kernels import filter as filter_kernels
from strapdown.kernels import layout, machine, six_states, smoother, structure, update
from strapdown.kernels import rows as row_kernels
from strapdown.kernels.walk import walk
from strapdown.records import ImuRecord
from strapdown.vectors import triad

NOISE = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-4)


def start(body_motion=SWAY, error=(0.02, -0.01, 0.015)) -> estimation.State:
    attitude = quaternion.multiply(body_motion.attitude(np.array(0.0)), quaternion.exp(error))
    return estimation.initial_state(attitude, attitude_sigma=0.03, bias_sigma=3e-3)


@dataclasses.dataclass(frozen=True)
class ReferenceError(error_states.ErrorStates):
    """A block that the package does not have: the field's direction is off in fixed axes, the same for two sensors."""

    name: str = "field"
    components: tuple[str, ...] = ("east", "up")
    units: tuple[str, ...] = ("T", "T")

    @property
    def sigma(self):
        return np.array([2e-6, 3e-6])

    @property
    def density(self):
        return np.array([1e-14, 0.0])

    @property
    def effects(self):
        return {
            "mag": error_states.Effect(offset_f=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])),
            "compass": error_states.Effect(offset_f=1e4 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])),
        }


OPTIONS: dict[str, tuple[error_states.ErrorStates, ...]] = {
    "none": (),
    "gyro scale": (error_states.GyroScale(scale_sigma=0.02, misalignment_sigma=0.01),),
    "symmetric gyro scale": (error_states.GyroScale(scale_sigma=0.02, misalignment_sigma=0.01, symmetric=True),),
    "gyro drift": (error_states.GyroGaussMarkov(bias_sigma=np.array([3e-3, 4e-3, 5e-3]), correlation_time=1.5),),
    "hard iron": (error_states.VectorBias(sensor="mag", bias_sigma=5e-6, unit="T"),),
    "hard iron that walks": (error_states.VectorBias(sensor="mag", bias_sigma=5e-6, rate_random_walk=1e-7, unit="T"),),
    "bias of a direction": (error_states.VectorBias(sensor="force", bias_sigma=0.05),),
    "bias and mounting of a heading": (
        error_states.VectorBias(sensor="compass", bias_sigma=0.05),
        error_states.SensorMounting(sensor="compass", mounting_sigma=0.05),
    ),
    "acceleration in body axes": (error_states.GaussMarkov(sensor="force", noise_sigma=0.1, correlation_time=0.7),),
    "acceleration in fixed axes": (
        error_states.GaussMarkov(sensor="force", noise_sigma=0.1, correlation_time=0.2, frame="fixed"),
    ),
    "two frames": (
        error_states.GaussMarkov(sensor="mag", noise_sigma=4e-6, correlation_time=0.7, frame="fixed", unit="T"),
        error_states.SensorMounting(sensor="mag", mounting_sigma=0.05),
    ),
    "a carried offset of a heading": (
        error_states.GaussMarkov(sensor="compass", noise_sigma=0.1, correlation_time=0.7, frame="fixed"),
        error_states.SensorMounting(sensor="compass", mounting_sigma=0.05),
    ),
    "a foreign block": (ReferenceError(),),
    "mounting of whole attitudes": (error_states.VectorBias(sensor="tracker", bias_sigma=0.05),),
    "mounting of a direction": (
        error_states.SensorMounting(sensor="force", mounting_sigma=np.array([0.05, 0.03, 0.02])),
    ),
    "all": EVERY_KIND,
}


# ------------------------------------------------------------------------------------------------------------------------ two faces


SPUN = motion.ConstantRate(rate=(40.0, -30.0, 35.0))
"""1.2 rad a sample: sub-steps."""


QUICK = ("none", "all")
"""Options whose filters are compiled in the default run; each takes seconds."""


@pytest.mark.parametrize(
    ("option", "body"),
    [
        *(pytest.param(option, SWAY, marks=[] if option in QUICK else pytest.mark.slow) for option in OPTIONS),
        ("none", SPUN),
        ("all", SPUN),
    ],
)
def test_both_faces_are_one_filter(option, body):
    record, blocks = record_of(body, duration=1.0, anisotropic=option == "all"), OPTIONS[option]
    initial = start(body)
    whole = estimation.run(record, NOISE, initial, blocks, full_covariance=True)
    step = in_steps.run(record, NOISE, estimation.with_error_states(initial, blocks), blocks)
    assert in_steps.apart(whole, step) < 1e-10
    for name, innovations in whole.innovations.items():
        np.testing.assert_allclose(step.whitened[name], innovations.whitened, rtol=0, atol=1e-8)


def test_covariances_of_attitude_and_bias_alone_are_the_same():
    record, blocks = record_of(duration=2.0, anisotropic=True), OPTIONS["all"]
    data = (record, NOISE, start(), blocks)
    for whole, alone in (
        (estimation.run(*data, full_covariance=True), forward.run_spans(*data, [forward.Span(len(record.increments))])),
        (
            estimation.smooth(*data, full_covariance=True),
            estimation.smooth(*data, full_covariance=True, error_state_covariance=False),
        ),
    ):
        assert whole.whole_covariance is not None
        assert alone.whole_covariance is None
        np.testing.assert_array_equal(alone.covariance, whole.covariance)
        np.testing.assert_array_equal(alone.variance, whole.variance)


# -------------------------------------------------------------------------------------------------------------------- exact models


def face_at(blocks: tuple[error_states.ErrorStates, ...], values=None, body_motion=SWAY) -> StepFilter:
    """The step-by-step face at an attitude with a bias, its blocks at random values."""
    state = estimation.with_error_states(start(body_motion), blocks)
    if values is None:
        values = np.sqrt(np.diag(state.covariance)[6:]) * np.random.default_rng(4).standard_normal(len(state.values))
    return StepFilter(NOISE, dataclasses.replace(state, values=values, bias=np.array([2e-3, -1e-3, 4e-3])), blocks)


GYRO_OPTIONS = {
    "gyro scale": (*OPTIONS["gyro scale"], *OPTIONS["hard iron that walks"]),
    "symmetric gyro scale": OPTIONS["symmetric gyro scale"],
    "gyro drift": OPTIONS["gyro drift"],
    "all": OPTIONS["all"],
}


@pytest.mark.parametrize("option", GYRO_OPTIONS)
def test_the_turn_is_what_the_gyro_model_says(option):
    """Turn by (I + M)⁻¹ of what the gyro measures less bias and drift, the drift averaged over the step."""
    blocks = GYRO_OPTIONS[option]
    face = face_at(blocks)
    part, dt = np.array([0.1, -0.2, 0.15]), 0.05
    M, drift, first = np.zeros((3, 3)), np.zeros(3), 0
    for block in blocks:
        values = face.values[first : first + block.size]
        first += block.size
        if isinstance(block, error_states.GyroScale):
            if block.symmetric:
                M[np.triu_indices(3)] = M.T[np.triu_indices(3)] = values
            else:
                M = values.reshape(3, 3)
        if isinstance(block, error_states.GyroGaussMarkov):
            tau = block.correlation_time
            drift = values * tau * (1.0 - math.exp(-dt / tau))
    turn = np.linalg.solve(np.eye(3) + M, part - face.bias * dt - drift)
    expected = quaternion.multiply(face.attitude, quaternion.exp(turn))
    face.predict(part, dt)
    assert quaternion.angle_between(face.attitude, expected) < 1e-15


@pytest.mark.parametrize("option", GYRO_OPTIONS)
def test_the_transition_is_the_derivative_of_the_turn(option):
    """Φ at random values of all states, scale factors and all, against differences of the propagation itself."""
    blocks = GYRO_OPTIONS[option]
    part, dt = np.array([0.1, -0.2, 0.15]), 0.05
    face = face_at(blocks)
    n = len(face.x)
    before = estimation.State(attitude=face.attitude, bias=face.bias, values=face.values, covariance=face.P)
    sigma = np.sqrt(np.diag(face.P))
    face.predict(part, dt)

    def after(column: int, step: float) -> np.ndarray:
        error = np.zeros(n)
        error[column] = step
        moved = estimation.State(
            attitude=quaternion.multiply(before.attitude, quaternion.exp(error[:3])),
            bias=before.bias + error[3:6],
            values=before.values + error[6:],
            covariance=before.covariance,
        )
        other = StepFilter(NOISE, moved, blocks)
        other.predict(part, dt)
        turn = turn_to(face.attitude, other.attitude)
        return np.concatenate([turn, other.bias - face.bias, other.values - face.values])

    h = 1e-3 * sigma
    numeric = np.stack([(after(k, h[k]) - after(k, -h[k])) / (2.0 * h[k]) for k in range(n)], axis=-1)
    # The turn takes a drift by its mean over the step; Φ knows that it decays meanwhile.
    drifts = [k for k, name in enumerate(state_names(blocks)[0]) if name.startswith("gyro drift")]
    tolerance = np.full(n, 1e-11)
    tolerance[drifts] = 2e-7
    assert np.all(np.abs((face.F - numeric) * sigma) < tolerance)


@pytest.mark.parametrize("turn", [1e-6, 1e-3, 0.05, 0.3])
@pytest.mark.parametrize("option", [*GYRO_OPTIONS, "acceleration in body axes"])
def test_transition_and_noise_are_those_of_van_loan(option, turn):
    blocks = {**OPTIONS, **GYRO_OPTIONS}[option]
    m, dt = sum(block.size for block in blocks), 0.02
    face = face_at(blocks, np.zeros(m))
    w = np.array([0.6, -0.64, 0.48]) * turn / dt
    face.predict((w + face.bias) * dt, dt)
    A, G = np.zeros((6 + m, 6 + m)), np.zeros((6 + m, 6 + m))
    A[:3, :3], A[:3, 3:6] = -kinematics.skew(w), -np.eye(3)
    G[:6, :6] = np.diag(np.repeat([NOISE.angle_random_walk, NOISE.rate_random_walk], 3))
    first = 6
    for block in blocks:
        own = slice(first, first + block.size)
        A[own, own], G[own, own] = np.diag(-block.decay), np.diag(np.sqrt(block.density))
        A[:3, own] = -(block.gyro_offset + block.gyro_scale @ w).T
        first += block.size
    F, Q = filterpy.common.van_loan_discretization(A, G, dt)
    sigma = np.sqrt(np.maximum(np.diag(Q), 1e-20))
    state = np.sqrt(np.diag(face.P))
    np.testing.assert_allclose(face.F * state, F * state, rtol=0, atol=1e-13)
    # Three nodes for the noise of a state in the gyro: exact to the sixth order of the turn.
    tolerance = 1e-10 + (1e-3 * turn**4 if option in ("gyro drift", "all") else 0.0)
    assert np.max(np.abs(correlation(face.Q - Q, sigma))) < tolerance


def test_the_noise_of_the_bias_reaches_the_attitude_by_the_scale_factors():
    """At scale factors of a tenth, which the rate (I + M)⁻¹ (w_measured − b) shows: Van Loan's covariance of attitude and bias."""
    M, dt, w = 0.1 * np.random.default_rng(3).standard_normal((3, 3)), 0.02, np.array([0.3, -0.32, 0.24])
    face = face_at(GYRO_OPTIONS["gyro scale"], np.concatenate([M.ravel(), np.zeros(3)]))
    face.predict(((np.eye(3) + M) @ w + face.bias) * dt, dt)
    A, G = np.zeros((6, 6)), np.zeros((6, 6))
    A[:3, :3], A[:3, 3:] = -kinematics.skew(w), -np.linalg.inv(np.eye(3) + M)
    G[3:, 3:] = NOISE.rate_random_walk * np.eye(3)
    _, Q = filterpy.common.van_loan_discretization(A, G, dt)
    np.testing.assert_allclose(face.Q[:3, 3:6], Q[:3, 3:], rtol=1e-6, atol=1e-9 * abs(Q[0, 3]))


def measured(kind: str, sensor: str, q, values: dict, reference, estimated):
    """What an ideal sensor with these effects gives: a model of its own. What is carried is known relative to the estimated attitude."""
    offset = values.get((sensor, "offset_b"), np.zeros(3))
    fixed = values.get((sensor, "offset_f"), np.zeros(3))
    S = np.eye(3) + values.get((sensor, "scale"), np.zeros((3, 3)))
    if kind == "attitude":
        return quaternion.multiply(q, quaternion.exp(offset))
    carried = values.get((sensor, "carried"), np.zeros(3))
    field_b = quaternion.rotate(quaternion.conjugate(q), reference + fixed)
    vector = S @ (field_b + quaternion.rotate(quaternion.conjugate(estimated), carried)) + offset
    return vector / np.linalg.norm(vector) if kind == "direction" else vector


SENSORS = {
    "mag": ("vector", FIELD),
    "force": ("direction", UP / 9.81),
    "compass": ("heading", np.array([0.6, 0.64, 0.48])),
    "tracker": ("attitude", None),
}


def effects_of(blocks: tuple[error_states.ErrorStates, ...], values: np.ndarray) -> dict:
    effects: dict = {}
    first = 0
    for block in blocks:
        own = values[first : first + block.size]
        first += block.size
        for sensor, effect in block.effects.items():
            for name in ("offset_b", "offset_f", "scale"):
                rows = getattr(effect, name)
                if rows is not None:
                    key = (sensor, "carried" if name == "offset_f" and effect.carried else name)
                    effects[key] = effects.get(key, 0.0) + np.tensordot(own, rows, axes=1)
    return effects


@pytest.mark.parametrize("transverse", [False, True])
@pytest.mark.parametrize("option", [name for name in OPTIONS if name not in ("none", "gyro scale", "gyro drift")])
def test_rows_are_the_derivative_of_what_sensors_give(option, transverse):
    """H of each kind, at random values of the states, against differences of an independent model of the sensor.

    Of whole vectors along fixed axes and, as the gate needs them, transverse to the reference and along it.
    """
    blocks = OPTIONS[option]
    named = {sensor for block in blocks for sensor in block.effects}
    face = face_at(blocks)
    n, sigma = len(face.x), np.sqrt(np.diag(face.P))
    values = effects_of(blocks, face.values)
    for sensor in named:
        kind, reference = SENSORS[sensor]

        def residual(q, effects, sensor=sensor, kind=kind, reference=reference):
            z = measured(kind, sensor, q, effects, reference, face.attitude)
            return rows_at(face, sensor, kind, reference, z, transverse)

        rows, zero = residual(face.attitude, values)
        np.testing.assert_allclose(zero, 0.0, atol=1e-14)
        numeric = np.empty_like(rows)
        for k in range(n):
            sides = []
            for h in (1e-4 * sigma[k], -1e-4 * sigma[k]):
                error = np.zeros(n)
                error[k] = h
                q = quaternion.multiply(face.attitude, quaternion.exp(error[:3]))
                sides.append(residual(q, effects_of(blocks, face.values + error[6:]))[1])
            numeric[:, k] = (sides[0] - sides[1]) / (2e-4 * sigma[k])
        np.testing.assert_allclose(rows * sigma, numeric * sigma, rtol=0, atol=1e-8 * np.max(np.abs(rows * sigma)))
        assert np.any(rows[:, 6:] != 0.0)


def rows_at(face, sensor, kind, reference, z, transverse):
    """Return H and y that the kernel makes of a measurement at the face's estimate."""
    model = face._model(sensor, kind)
    kernels = machine.instance(row_kernels, STRUCTURE=model.structure)
    length = np.linalg.norm(reference) if kind == "vector" else 1.0
    attitude = kind == "attitude"
    frame = (*z, 0.0, 0.0, 0.0, 0.0, 0.0) if attitude else tuple(triad(reference).ravel())
    measurement = structure.Measured((0.0,) * 3 if attitude else tuple(z / length), frame, (), length, (0.0,) * 9)
    x = np.concatenate([face.attitude, face.bias, face.values])
    rows, y, *_ = kernels.rows_and_axes(0, x, measurement, model.numbers, 0.0, transverse)
    return np.array(rows, np.float64), np.array(y)


# -------------------------------------------------------------------------------------------------------------- sharp, diffuse, long


@pytest.mark.parametrize(("sharpness", "bound"), [(1e-6, 1e-6), (1e-3, 1e-7), (1.0, 1e-7), (1e3, 1e-7)])
def test_an_update_keeps_its_digits_however_sharp_the_measurement(sharpness, bound):
    """Predictions and rows of random directions in nine states over nine decades, against 60 digits."""
    rng = np.random.default_rng(7)
    sizes, kernels = (
        machine.instance(module, STRUCTURE=structure.SIX_STATES._replace(n=9)) for module in (layout, update)
    )
    n, W, LINE, ROWS = sizes.N, sizes.W, sizes.LINE, sizes.ROWS
    prior = np.geomspace(1e-5, 1e5, n)[rng.permutation(n)]
    P, work = np.zeros((n, W)), np.zeros((sizes.LINES, LINE))
    P[:, :n] = np.diag(prior**2)
    clear_step, take_row = called(kernels.clear_step), called(kernels.take_row)
    with mpmath.workdps(60):
        exact_P = mpmath.matrix(P[:, :n])
        for _ in range(6):
            phi = np.eye(n)
            phi[:3] += 0.1 * rng.standard_normal((3, n)) * prior[:3, None] / prior
            noise = np.zeros((6, n))
            noise[:, :6] = 1e-3 * rng.standard_normal((6, 6)) * prior[:6]
            P[:, :n] = phi @ P[:, :n] @ phi.T + noise.T @ noise
            P[:, :n] = 0.5 * (P[:, :n] + P[:, :n].T)
            exact_P = mpmath.matrix(phi) * exact_P * mpmath.matrix(phi).T
            exact_P += mpmath.matrix(noise).T * mpmath.matrix(noise)
            for rows in (1, 2, 3):
                y = rng.standard_normal(3)
                clear_step(work.reshape(-1), 0.0)
                x = mpmath.zeros(n, 1)
                for r in range(rows):
                    h = rng.standard_normal(n) / prior
                    work[ROWS + r, :n] = h
                    e, s = take_row(P.reshape(-1), work.reshape(-1), ROWS + r, y[r], sharpness**2, 0.0)
                    h = mpmath.matrix(h[None])
                    exact = (h * exact_P * h.T)[0] + mpmath.mpf(sharpness) ** 2
                    assert abs(s / exact - 1) < bound
                    assert abs(e - y[r] + (h * x)[0]) < bound * mpmath.sqrt(exact)
                    K = exact_P * h.T / exact
                    x = x + K * (y[r] - (h * x)[0])
                    exact_P = exact_P - K * (h * exact_P)
                step = work[sizes.STEP]
                assert max(abs(step[i] - x[i]) / mpmath.sqrt(exact_P[i, i]) for i in range(n)) < bound
        expected = np.array(exact_P.tolist(), np.float64)
    sigma = np.sqrt(np.diag(expected))
    assert np.array_equal(P[:, :n], P[:, :n].T)
    assert np.max(np.abs(correlation(P[:, :n] - expected, sigma))) < bound


@pytest.mark.parametrize(
    ("option", "gate"), [("all", None), ("none", None), ("none", Gate())], ids=["states", "registers", "gate"]
)
def test_a_run_in_spans_is_that_of_its_parts_to_the_bit(option, gate):
    """Each part from the end of the one before, changed; a common edge has the row before the change.

    At both edges there are measurements.
    """
    record, blocks = record_of(anisotropic=option == "all"), OPTIONS[option]
    options = {"gate": gate, "full_covariance": True}

    def wider(x, P):
        x[4:7] += 1e-4
        P *= 2.0

    n = len(record.increments)
    spans = [forward.Span(24, wider), forward.Span(55), forward.Span(n, wider)]
    whole = forward.run_spans(record, NOISE, start(), blocks, spans, gate=gate)
    state, first, parts = start(), 0, []
    for last, change in spans:
        part, end = estimation.run_part(records.cut(record, first, last), NOISE, state, blocks, **options)
        state, first = changed(end, change) if change else end, last
        parts.append(part)
    for name in ("attitude", "bias", "variance", "covariance"):
        joined = np.concatenate([getattr(part, name)[k > 0 :] for k, part in enumerate(parts)])
        assert np.array_equal(joined, getattr(whole, name)), name
    for sensor, innovations in whole.innovations.items():
        joined = np.concatenate([part.innovations[sensor].innovation for part in parts])
        assert np.array_equal(joined, innovations.innovation), sensor


def test_effects_in_the_sensors_own_unit_keep_it_from_part_to_part():
    """A field four times as strong in the first half: the second part goes on in the first's unit, as the whole in that unit to the bit."""
    record = record_of(anisotropic=True)
    half = len(record.increments) // 2
    (force,) = (series for series in record.vectors if series.sensor == "force")
    sigma = np.where(force.time < record.time[half], 0.25, 1.0) * force.sigma
    weak = dataclasses.replace(force, sigma=sigma)
    record = dataclasses.replace(record, vectors=tuple(weak if s is force else s for s in record.vectors))

    def blocks(noise_sigma):
        return every_kind(force_disturbance={"noise_sigma": noise_sigma, "varying": True})

    def part(first, last, initial, noise_sigma=0.02):
        return estimation.run_part(records.cut(record, first, last), NOISE, initial, blocks(noise_sigma))

    n = len(record.increments)
    before, middle = part(0, half, start())
    assert middle.unit_sigma == pytest.approx({"force": float(sigma[0])}, rel=1e-12)
    after, last = part(half, n, middle)
    assert last.unit_sigma == middle.unit_sigma
    begin = dataclasses.replace(estimation.with_error_states(start(), blocks(0.02)), unit_sigma=middle.unit_sigma)
    whole, end = part(0, n, begin)
    for name in ("attitude", "bias", "variance"):
        joined = np.concatenate([getattr(before, name)[:-1], getattr(after, name)])
        assert np.array_equal(joined, getattr(whole, name)), name
    assert np.array_equal(last.values, end.values)
    assert np.array_equal(last.covariance, end.covariance)
    # Told nothing, the whole has its own unit, the root mean square; its prior is made for that, and the rest is the same filter.
    _, own = part(0, n, start())
    mean = float(np.sqrt(np.mean(sigma**2)))
    assert own.unit_sigma == pytest.approx({"force": mean}, rel=1e-12)
    ratio = mean / middle.unit_sigma["force"]
    begin = estimation.with_error_states(start(), blocks(0.02 / ratio))
    _, same = part(0, n, dataclasses.replace(begin, unit_sigma=middle.unit_sigma), 0.02 / ratio)
    np.testing.assert_allclose(same.values[-3:] * ratio, own.values[-3:], rtol=1e-9, atol=1e-14)


# ------------------------------------------------------------------------------------------------------------------------- smoother


def carried_by(blocks: tuple[error_states.ErrorStates, ...], q, other) -> np.ndarray:
    """What a turn of the attitude makes of the states (…, n, n): of those of coloured noise in fixed axes a turned vector."""
    turn = quaternion.multiply(other, quaternion.conjugate(q))
    size = 6 + sum(block.size for block in blocks)
    T = np.broadcast_to(np.eye(size), (*turn.shape[:-1], size, size)).copy()
    first = 6
    for block in blocks:
        own = slice(first, first + block.size)
        if getattr(block, "frame", "body") == "fixed":
            T[..., own, own] = quaternion.to_matrix(turn)
        first += block.size
    return T


def reference_smoother(record, initial, blocks):
    """The textbook smoother on whole matrices, over what the step-by-step face passed through."""
    face = StepFilter(NOISE, initial, blocks, sensors=[s.sensor for s in record.vectors])
    series = {(t, i): (s, j) for i, s in enumerate(record.vectors) for j, t in enumerate(s.time)}
    stops = np.unique(np.concatenate([record.time, [t for t, _ in series]]))
    filtered, steps, at_edge = [], [], []
    for j, now in enumerate(stops):
        if j > 0:
            k = int(np.searchsorted(record.time, now)) - 1
            dt = now - stops[j - 1]
            face.predict(record.increments[k] * (dt / (record.time[k + 1] - record.time[k])), dt)
            steps.append((face.attitude, face.bias, face.values.copy(), face.P.copy(), face.F.copy()))
        for t, i in sorted(series):
            if t == now:
                s, row = series[t, i]
                face.update(s, row)
        filtered.append((face.attitude, face.bias, face.values.copy(), face.P.copy()))
        at_edge.append(now in record.time)
    rows = [filtered[-1]]
    for (q, b, c, P), (q_minus, b_minus, c_minus, P_minus, F) in zip(filtered[-2::-1], steps[::-1], strict=True):
        q_next, b_next, c_next, P_next = rows[-1]
        a = turn_to(q_minus, q_next)
        # From the tangent space at the later attitude to that at the predicted one, and what goes along with the attitude.
        J = carried_by(blocks, q_next, q_minus)
        J[:3, :3] = np.linalg.inv(kinematics.right_jacobian(a))
        c_next = J[6:, 6:] @ c_next
        scale = np.sqrt(np.diag(P_minus))
        C = np.linalg.solve(correlation(P_minus, scale), (F @ P) / scale[:, None]).T / scale
        x = C @ np.concatenate([a, b_next - b_minus, c_next - c_minus])
        after = P + C @ (J @ P_next @ J.T - P_minus) @ C.T
        turned = quaternion.multiply(q, quaternion.exp(x[:3]))
        J = carried_by(blocks, q, turned)
        J[:3, :3] = kinematics.right_jacobian(x[:3])
        rows.append((turned, b + x[3:6], J[6:, 6:] @ (c + x[6:]), J @ after @ J.T))
    kept = [row for row, edge in zip(rows[::-1], at_edge, strict=True) if edge]
    return [np.array(column) for column in zip(*kept, strict=True)]


@pytest.mark.parametrize(
    "option",
    [
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("gyro drift", "two frames", "mounting of whole attitudes")
        ),
        "all",
    ],
)
def test_the_smoother_is_the_textbook_one(option):
    record, blocks = record_of(duration=1.5, rate=25.0, anisotropic=option == "all"), OPTIONS[option]
    # A wrong start, so that corrections are tenths of a radian and a missing Jacobian shows.
    initial = start(error=(0.2, -0.1, 0.15))
    initial = dataclasses.replace(initial, covariance=np.diag([0.04] * 3 + [1e-5] * 3))
    estimate = estimation.smooth(record, NOISE, initial, blocks, full_covariance=True)
    q, b, c, P = reference_smoother(record, initial, blocks)
    sigma = np.sqrt(np.einsum("kii->ki", estimate.whole_covariance))
    values = dict(
        zip(estimate.error_states, np.split(c, np.cumsum([block.size for block in blocks])[:-1], axis=1), strict=True)
    )
    assert np.max(np.abs(state_errors(estimate, q, b, values)) / sigma) < 1e-8
    assert np.max(np.abs(correlation(estimate.whole_covariance - P, sigma))) < 1e-8


# ------------------------------------------------------------------------------------------------------------------- observability


def plain_record(body_motion, duration=20.0):
    """A record of a field with hard iron and of the vertical."""
    edges = np.arange(round(duration * 50.0) + 1) / 50.0
    rng = np.random.default_rng(8)
    time, attitude = edges[1::5], body_motion.attitude(edges[1::5])
    mag = in_body(attitude, FIELD) + np.array([4e-6, -6e-6, 2e-6]) + 5e-7 * rng.standard_normal((len(time), 3))
    mag = series_of("mag", "vector", time, mag, FIELD, 5e-7)
    mag = dataclasses.replace(mag, sigma=0.0, covariance=2.5e-13 * np.eye(3))
    force = unit(in_body(attitude, UP) + 0.05 * rng.standard_normal((len(time), 3)))
    force = series_of("force", "direction", time, force, UP, 0.05 / 9.81)
    increments = body_motion.increments(edges) + 1e-3 * np.sqrt(0.02) * rng.standard_normal((len(edges) - 1, 3))
    return ImuRecord(time=edges, increments=increments, vectors=beside_silent(mag, force))


IRON = every_kind(held=True, mag_bias={"bias_sigma": 1e-5})
IRON_STATES = [0, 1, 2, 3, 4, 5, 18, 19, 20]


def test_hard_iron_needs_a_turn():
    """Still, the field's horizontal part and the heading are one; turned about, all is observable."""
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=0.3, bias_sigma=5e-3)
    still = estimation.observability(plain_record(motion.rest()), NOISE, initial, error_states=IRON)
    assert still.rank == 8
    assert still.singular_values[8] < 0.5
    # Heading and what is east in the body: a heading δψ moves the field of 20 µT by 20 µT δψ.
    expected = np.zeros(24)
    expected[[2, 18]] = np.array([1.0 / 0.3, -2e-5 / 1e-5]) / np.hypot(1.0 / 0.3, 2e-5 / 1e-5)
    assert abs(still.directions[8] @ expected) > 0.99
    weakest = str(still).splitlines()[-1]
    assert "attitude z" in weakest
    assert "mag bias x" in weakest
    turned = estimation.observability(plain_record(HAND), NOISE, initial, IRON)
    assert turned.rank == 9
    assert np.all(turned.unobserved[IRON_STATES] < 1e-3)
    assert np.all(turned.start_sigma[18:21] < 0.1 * turned.prior_sigma[18:21])
    assert "9 of 24 directions" in str(turned)


def test_a_gyro_scale_needs_a_turn_about_each_axis():
    blocks = every_kind(held=True, gyro_scale={"scale_sigma": 0.02, "misalignment_sigma": 0.02})
    ranks = {}
    for name, body in (
        ("still", motion.rest()),
        ("about z", motion.HarmonicRates(harmonics=(motion.Harmonic(amplitude=(0.0, 0.0, 1.5), frequency=0.2),))),
        ("about all", HAND),
    ):
        observability = estimation.observability(plain_record(body), NOISE, start(), blocks)
        ranks[name] = observability.rank
        if name == "about z":
            names = [observability.states[k] for k in np.flatnonzero(observability.unobserved < 0.5)]
            assert names[6:] == ["gyro misalignment xz", "gyro misalignment yz", "gyro scale z"]
    assert ranks == {"still": 6, "about z": 9, "about all": 15}


@pytest.mark.parametrize("off", [0.0, 0.4])
def test_singular_values_are_those_of_the_stacked_rows(off):
    """Without process noise the information is a plain sum of squares: rows of a direction over σ, in prior σ, whatever its bias is."""
    r, bias = np.array([0.0, 0.0, 1.0]), np.array([off, 0.0, 0.0])
    record = resting(*beside_silent(series_of("force", "direction", [0.0], [unit(r + bias)], r, 0.01)))
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=[0.2, 0.1, 0.3], bias_sigma=1e-3)
    blocks = every_kind(held=True, force_disturbance={"noise_sigma": 0.05, "correlation_time": 1e9})
    initial = estimation.with_error_states(initial, blocks)
    initial = dataclasses.replace(initial, values=np.append(np.zeros(15), bias))
    observability = estimation.observability(record, NOISE, initial, blocks)
    # Across z, the measured (x, y) is (−δθ_y + c_x, δθ_x + c_y).
    rows = np.array([[0.0, -0.1, 0.05, 0.0], [0.2, 0.0, 0.0, 0.05]]) / 0.01
    np.testing.assert_allclose(observability.singular_values[:2], np.linalg.svd(rows, compute_uv=False), rtol=1e-9)
    np.testing.assert_allclose(observability.singular_values[2:], 0.0, atol=1e-6)
    assert observability.rank == 2


def test_a_heading_shows_the_tilt_by_the_dip_that_was_measured():
    """Of m = (0.6, 0, 0.8) a turn φ shifts the heading by φ_z − (m_z/m_x) φ_x, though its reference is given level."""
    compass = series_of("compass", "heading", [0.0], [[0.6, 0.0, 0.8]], [1.0, 0.0, 0.0], 0.01)
    record = resting(compass)
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=[0.2, 0.1, 0.3], bias_sigma=1e-3)
    observability = estimation.observability(record, NOISE, initial)
    np.testing.assert_allclose(
        observability.singular_values[:2], [np.hypot(0.3, 0.2 / 0.75) / 0.01, 0.0], rtol=1e-9, atol=1e-6
    )


def test_directions_are_independent_errors_that_make_up_the_covariance():
    """Also with a correlated prior: scaled to 1/√(1 + s²) of it, they add up to the covariance that is left."""
    correlated = start().covariance * np.outer([3.0, 1.0, 2.0, 1.0, 1.0, 5.0], [3.0, 1.0, 2.0, 1.0, 1.0, 5.0])
    correlated[0, 1] = correlated[1, 0] = 0.6 * np.sqrt(correlated[0, 0] * correlated[1, 1])
    initial = dataclasses.replace(start(), bias=np.array([0.03, -0.02, 0.04]), covariance=correlated)
    record = plain_record(motion.rest())
    observability = estimation.observability(record, NOISE, initial, IRON)
    where = estimation.smooth(record, NOISE, initial, IRON)
    begin = dataclasses.replace(initial, attitude=where.attitude[0], bias=np.zeros(3))
    exact = without_errors(record, where.attitude)
    P = estimation.smooth(exact, NOISE, begin, IRON, full_covariance=True).whole_covariance[0]
    size = observability.prior_sigma
    prior = estimation.with_error_states(initial, IRON).covariance / np.outer(size, size)
    of_prior = np.einsum("ki,ij,kj->k", observability.directions, np.linalg.inv(prior), observability.directions)
    share = 1.0 / (of_prior * (1.0 + observability.singular_values**2))
    left = observability.directions * np.sqrt(share)[:, None] * size
    apart = np.outer(observability.start_sigma, observability.start_sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(P)), observability.start_sigma, rtol=1e-9)
    np.testing.assert_allclose(left.T @ left / apart, P / apart, atol=1e-6)
    written = json.loads(json.dumps(observability.summary()))
    assert (written["rank"], written["units"][18]) == (observability.rank, "T")
    assert written["directions"][8][18] == observability.directions[8, 18]


def test_observability_takes_every_kind_of_measurement():
    observability = estimation.observability(record_of(anisotropic=True), NOISE, start(), OPTIONS["all"])
    assert len(observability.states) == len(observability.units) == len(observability.singular_values) == 24
    assert np.all(observability.start_sigma <= observability.prior_sigma * (1.0 + 1e-9))


# ----------------------------------------------------------------------------------------------------------------------- bad input


def _laid_out_otherwise(record):
    """Return the same record with times that may be written to and come with gaps, and one σ for all measurements of a sensor."""
    series = (dataclasses.replace(measurements, sigma=float(measurements.sigma[0])) for measurements in record.vectors)
    return dataclasses.replace(record, time=np.repeat(record.time, 2)[::2], vectors=tuple(series))


def test_the_kernels_are_compiled_once_for_a_structure():
    """The kernels see arrays of one layout: neither that of the record nor the numbers of the declarations compiles them again."""
    wide = every_kind(mag_bias={"bias_sigma": 9e-6})
    for blocks, others in (((), ()), (OPTIONS["all"], wide)):
        record = record_of(duration=0.5, anisotropic=bool(blocks))
        model = forward.prepared(record, NOISE, start(), blocks).model
        assert model.structure == forward.prepared(record, NOISE, start(), others).model.structure
        estimation.smooth(record, NOISE, start(), blocks)
        kernels = forward.instance_of(model, filter_kernels) if blocks else six_states
        dispatchers = [machine.compiled(walk, kernels)]
        if blocks:
            without = model.structure._replace(sensors=())  # of the smoother
            dispatchers.append(machine.compiled(machine.instance(smoother, STRUCTURE=without).smooth_back))
        compiled = [list(dispatcher.signatures) for dispatcher in dispatchers]
        estimation.smooth(_laid_out_otherwise(record), NOISE, start(), others)
        assert [dispatcher.signatures for dispatcher in dispatchers] == compiled
        assert all(compiled)
