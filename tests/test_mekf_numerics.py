"""Numerical safety: positive definite over long runs and over ten decades of measurement noise; single precision characterised."""

import functools
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from measured import resting, series_of
from plain_kernels import plain
from scipy.spatial.transform import Rotation

from strapdown import estimation, kinematics, motion, quaternion, records
from strapdown.estimation.error_states import GyroScale
from strapdown.estimation.forward import CHECK_INTERVALS
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.schedule import schedule
from strapdown.estimation.states import ProcessNoise, covariance_matrices, initial_state, pack
from strapdown.estimation.step_filter import StepFilter
from strapdown.gyro import GyroSpec
from strapdown.kernels import covariance_form
from strapdown.kernels.gate_rules import CANDIDATE
from strapdown.kernels.measurement import SIGMA_ORIGIN, VALUE_ORIGIN
from strapdown.kernels.walk import walk
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import VectorMeasurements, VectorSensor

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)


def least_eigenvalue(P):
    """Least eigenvalue of matrices (..., 6, 6) scaled to a unit diagonal."""
    d = np.sqrt(np.einsum("...ii->...i", P))
    return np.linalg.eigvalsh(P / (d[..., :, None] * d[..., None, :]))[..., 0].min()


def sharp_record(sigma, steps=400):
    """A turning body that sees three directions in turn, exactly, with a modelled noise of ``sigma`` rad."""
    body = motion.ConstantRate(rate=(0.3, -0.5, 0.4))
    time = 0.02 * np.arange(steps + 1)
    series = []
    for k, r in enumerate(([1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.6, -0.8, 0.0])):
        at = time[1 + k :: 3]
        seen = quaternion.rotate(quaternion.conjugate(body.attitude(at)), np.array(r))
        series.append(series_of(f"s{k}", "direction", at, seen, r, sigma))
    return ImuRecord(time=time, increments=body.increments(time), vectors=tuple(series)), body.attitude(time)


OPTIONS = Gate(probability=1.0 - 1e-12)
DECADES = [(exponent, gate) for exponent in range(-9, 4) for gate in (None, OPTIONS)]
"""Of σ over the prior's."""
NAMES = [f"1e{exponent}-{'plain' if gate is None else 'options'}" for exponent, gate in DECADES]


@pytest.mark.parametrize(("exponent", "gate"), DECADES, ids=NAMES)
def test_positive_definite_over_twelve_decades_of_noise_over_the_prior(exponent, gate):
    """σ from 1e-9 to 1e3 of the prior's, both loops, at every step."""
    record, truth = sharp_record(10.0**exponent)
    start = initial_state(
        quaternion.multiply(truth[0], quaternion.exp([1e-9, 0, 0])), attitude_sigma=1.0, bias_sigma=0.1
    )
    result = estimation.run(record, NOISE, start, full_covariance=True, gate=gate)
    assert least_eigenvalue(result.covariance) > 0.0
    assert np.all(np.isfinite(result.attitude))
    assert np.max(quaternion.angle_between(result.attitude, truth)) < 1e-6


@pytest.mark.parametrize(("exponent", "gate"), DECADES, ids=NAMES)
def test_the_covariance_is_that_of_the_information_form(exponent, gate):
    """(I/σ₀² + Σ (I − r rᵀ)/σ²)⁻¹ of three directions at one time."""
    sigma = 10.0**exponent
    references = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.6, -0.8, 0.0]])
    series = tuple(series_of(f"s{k}", "direction", [0.0], [r], r, sigma) for k, r in enumerate(references))
    record = resting(*series)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=0.1)
    P = estimation.run(record, NOISE, start, full_covariance=True, gate=gate).covariance[0, :3, :3]
    information = np.eye(3) + sum(np.eye(3) - np.outer(r, r) for r in references) / sigma**2
    expected = np.linalg.inv(information)
    d = np.sqrt(np.diag(expected))
    assert np.abs((P - expected) / np.outer(d, d)).max() < 1e-9


def reference_variances(record, noise, prior):
    """Variances (m, 6) of a body that does not turn and whose errors are zero, by the covariance's recursion in 60 digits."""
    mp = mpmath.mp
    with mpmath.workdps(60):
        P = mp.diag([mp.mpf(float(x)) ** 2 for x in prior])
        v, u = mp.mpf(noise.angle_random_walk) ** 2, mp.mpf(noise.rate_random_walk) ** 2
        rows = []
        for k, now in enumerate(record.time):
            if k:
                dt = mp.mpf(float(now)) - mp.mpf(float(record.time[k - 1]))
                step = mp.eye(6)
                Q = mp.zeros(6, 6)
                for i in range(3):
                    step[i, 3 + i] = -dt
                    Q[i, i] = v * dt + u * dt**3 / 3
                    Q[i, 3 + i] = Q[3 + i, i] = -u * dt**2 / 2
                    Q[3 + i, 3 + i] = u * dt
                P = step * P * step.T + Q
            for series in record.vectors:
                for at in np.flatnonzero(series.time == now):
                    r = mp.matrix([mp.mpf(float(x)) for x in series.references_f[at]])
                    H = mp.zeros(3, 6)
                    for i, j, m in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                        H[i, j], H[j, i] = -r[m], r[m]
                    across = mp.qr(mp.matrix([[r[0], 1, 0], [r[1], 0, 1], [r[2], 1, 1]]))[0][:, 1:]
                    H = across.T * H  # two directions across r: along it nothing is measured
                    S = H * P * H.T + mp.mpf(float(series.sigma[at])) ** 2 * mp.eye(2)
                    P = P - P * H.T * mp.inverse(S) * H * P
                    P = (P + P.T) / 2
            rows.append([float(P[i, i]) for i in range(6)])
        return np.array(rows)


def by_covariance(series):
    """The same measurements with their noise given as a covariance."""
    return VectorMeasurements(
        sensor=series.sensor,
        kind=series.kind,
        time=series.time,
        vector_b=series.vector_b,
        reference_f=series.references_f,
        covariance=series.sigma[:, None, None] ** 2 * np.eye(3),
    )


@functools.cache
def sparse_record(sensors, sigma, noise):
    """Random directions, one or three at a time, the process noise, and the variances in 60 digits."""
    generator = np.random.default_rng(7)
    time = np.concatenate([0.1 * np.arange(31), [1000.0, 1000.1]])  # an outage after which attitude and bias are one
    series = []
    for k in range(sensors):
        r = generator.standard_normal(3)
        r /= np.linalg.norm(r)
        at = time[[0, 10, 20, 32]] if k == 0 else time[[0, 10]]
        series.append(series_of(f"s{k}", "direction", at, np.tile(r, (len(at), 1)), r, sigma))
    record = resting(*series, time=time)
    process = ProcessNoise(angle_random_walk=noise[0], rate_random_walk=noise[1])
    return record, process, reference_variances(record, process, [1.0] * 3 + [0.1] * 3)


@pytest.mark.parametrize("noise", [(1e-12, 0.0), (1e-12, 1e-14), (1e-4, 1e-5)], ids=["no drift", "little", "usual"])
@pytest.mark.parametrize("sigma", [1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("sensors", [1, 3])
@pytest.mark.parametrize("options", ["none", "gate", "huber", "covariance"])
def test_no_digit_is_lost_where_the_covariance_holds_none(options, sensors, sigma, noise):
    """Against 60 digits: after one of the directions σ about it is still the prior's, 1e9 times more."""
    record, process, expected = sparse_record(sensors, sigma, noise)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=0.1)
    chosen = {"gate": {"gate": OPTIONS}, "huber": {"robust": Robust(kind="huber")}}.get(options, {})
    if options == "covariance":
        record = replace(record, vectors=tuple(by_covariance(s) for s in record.vectors))
    estimate = estimation.run(record, process, start, full_covariance=True, **chosen)
    assert np.max(np.abs(estimate.variance / expected - 1.0)) < 1e-6
    assert least_eigenvalue(estimate.covariance) > 0.0
    thinned = estimation.run(record, process, start, every=7, **chosen)
    assert np.max(np.abs(thinned.variance / expected[::7] - 1.0)) < 1e-6


def test_an_outage_that_makes_attitude_and_bias_one_leaves_the_covariance_definite():
    """After 1e7 s the attitude's error is the bias's, to 1e-18 of its variance; a measurement then determines both."""
    time = np.concatenate([[0.0, 1.0], 1e7 + np.arange(3.0)])
    series = tuple(
        series_of(name, "direction", time[[0, 3]], np.tile(r, (2, 1)), r, 1e-3)
        for name, r in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 0.6, 0.8]))
    )
    process = ProcessNoise(angle_random_walk=1e-12, rate_random_walk=0.0)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=0.1)
    for end in (3, 5):  # before and after the measurements end the outage
        mine = tuple(s.taken(np.flatnonzero(s.time <= time[end - 1])) for s in series)
        record = ImuRecord(time=time[:end], increments=np.zeros((end - 1, 3)), vectors=mine)
        expected = reference_variances(record, process, [1.0] * 3 + [0.1] * 3)
        for gate in (None, OPTIONS):
            estimate = estimation.run(record, process, start, full_covariance=True, gate=gate)
            assert least_eigenvalue(estimate.covariance) > 0.0
            assert np.max(np.abs(estimate.variance / expected - 1.0)) < 1e-6


@pytest.mark.parametrize("gate", [Gate(), Gate(probability=0.99, recovery=4)], ids=["usual", "eager"])
def test_a_gate_recovers_in_the_square_root_and_in_parts(gate):
    """A lost start and directions 1e-7 as wide as a restart: the filter with no optional states itself, and parts to rounding.

    Cut while sensors are refused, while a candidate runs, and after the recovery.
    """
    record, truth = sharp_record(1e-7, steps=60)
    off = quaternion.multiply(truth[0], quaternion.exp([0.4, -0.2, 0.1]))
    start = initial_state(off, attitude_sigma=1e-3, bias_sigma=0.01)
    estimate = estimation.run(record, NOISE, start, gate=gate, full_covariance=True)
    assert [event.kind for event in estimate.events] == ["recovery"]
    assert quaternion.angle_between(estimate.attitude[-1], truth[-1]) < 1e-9
    assert least_eigenvalue(estimate.covariance) > 0.0
    other = estimation.run(record, NOISE, start, gate=gate)
    assert np.array_equal(estimate.attitude, other.attitude)
    assert estimate.events == other.events
    challenged = []
    for cut in (3, 5, 8, 12, 40):
        first, state = estimation.run_part(records.cut(record, 0, cut), NOISE, start, gate=gate)
        challenged.append(state.gate.counts[CANDIDATE])
        rest, end = estimation.run_part(records.cut(record, cut, 60), NOISE, state, gate=gate, full_covariance=True)
        assert np.max(quaternion.angle_between(rest.attitude, estimate.attitude[cut:])) < 1e-13
        assert np.allclose(rest.variance[1:], estimate.variance[cut + 1 :], rtol=1e-6, atol=0.0)
        assert [event.kind for event in (*first.events, *rest.events)] == ["recovery"]
        assert np.array_equal(end.covariance, rest.covariance[-1])
    assert any(challenged)


def test_factors_are_carried_through_large_corrections():
    """A start a third of a radian off and sharp directions: the covariance's reset is that of the step face."""
    record, truth = sharp_record(1e-5, steps=6)
    off = quaternion.multiply(truth[0], quaternion.exp([0.3, -0.2, 0.1]))
    start = initial_state(off, attitude_sigma=0.5, bias_sigma=0.01)
    estimate = estimation.run(record, NOISE, start)
    f = StepFilter(NOISE, start)
    for k, now in enumerate(record.time[1:]):
        f.predict(record.increments[k], now - record.time[k])
        for s in record.vectors:
            for at in np.flatnonzero(s.time == now):
                f.update_direction(s.vector_b[at], s.references_f[at], float(s.sigma[at]))
        assert np.max(quaternion.angle_between(f.attitude, estimate.attitude[k + 1])) < 1e-9
        assert np.allclose(np.diag(f.P), estimate.variance[k + 1], rtol=1e-5)


@pytest.mark.parametrize(
    "states", [(), (GyroScale(scale_sigma=1e-3, misalignment_sigma=1e-3),)], ids=["covariance", "factor"]
)
@pytest.mark.parametrize("angle", [0.3, 0.6, 0.95, 1.5])
def test_a_large_correction_is_exact(states, angle):
    """P = σ²I and one measured attitude of variance r: the correction is φ σ²/(σ² + r), and P becomes σ² r/(σ² + r) J Jᵀ."""
    sigma, r, axis = 0.5, 1e-3, np.array([0.6, 0.48, 0.64])
    measured = VectorMeasurements(
        sensor="tracker",
        kind="attitude",
        time=[0.0],
        attitude=[Rotation.from_rotvec(angle * axis).as_quat(scalar_first=True)],
        sigma=np.sqrt(r),
    )
    record = ImuRecord(time=[0.0, 0.01], increments=np.zeros((1, 3)), vectors=(measured,))
    start = initial_state(quaternion.IDENTITY, attitude_sigma=sigma, bias_sigma=1e-6)
    found = estimation.run(record, NOISE, start, states, full_covariance=True)
    share = sigma**2 / (sigma**2 + r)
    theta = mpmath.mpf(share * angle)
    K = kinematics.skew(axis)
    J = np.eye(3) - float((1 - mpmath.cos(theta)) / theta) * K + float(1 - mpmath.sin(theta) / theta) * K @ K
    want = Rotation.from_rotvec(share * angle * axis).as_quat(scalar_first=True)
    np.testing.assert_allclose(found.attitude[0], want, rtol=0, atol=1e-15)
    np.testing.assert_allclose(found.covariance[0, :3, :3], r * share * J @ J.T, rtol=0, atol=3e-15 * r)


def test_a_stretch_in_factors_is_the_filter_itself():
    """One sharp direction in a record of many: up to the stretch bit for bit as without it, after it as the step face to its rounding."""
    record, _ = sharp_record(1e-2, steps=CHECK_INTERVALS + 500)
    at_step = CHECK_INTERVALS + 200
    middle = float(record.time[at_step])
    body = motion.ConstantRate(rate=(0.3, -0.5, 0.4))
    seen = quaternion.rotate(quaternion.conjugate(body.attitude(middle)), np.array([0.0, 0.0, 1.0]))
    sharp = series_of("sharp", "direction", [middle], [seen], [0.0, 0.0, 1.0], 1e-9)
    whole = replace(record, vectors=(*record.vectors, sharp))
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=0.1, bias_sigma=0.01)
    without, estimate = estimation.run(record, NOISE, start), estimation.run(whole, NOISE, start, full_covariance=True)
    assert np.array_equal(estimate.attitude[: CHECK_INTERVALS + 1], without.attitude[: CHECK_INTERVALS + 1])
    assert np.allclose(estimate.attitude[:at_step], without.attitude[:at_step], rtol=0.0, atol=1e-14)
    assert np.allclose(estimate.variance[:at_step], without.variance[:at_step], rtol=1e-11, atol=0.0)
    spread = np.linalg.eigvalsh(estimate.covariance[at_step, :3, :3])
    assert spread[0] < 1e-6 * spread[2]
    f = StepFilter(NOISE, start)
    series = {k: s for s in whole.vectors for k in [(s.sensor, float(t)) for t in s.time]}
    for k, now in enumerate(record.time):
        if k:
            f.predict(record.increments[k - 1], now - record.time[k - 1])
        for s in whole.vectors:
            if (s.sensor, float(now)) in series:
                at = int(np.searchsorted(s.time, now))
                f.update_direction(s.vector_b[at], s.references_f[at], float(s.sigma[at]))
        if k in (at_step - 1, at_step + 20, at_step + 300):
            assert np.max(quaternion.angle_between(f.attitude, estimate.attitude[k])) < 1e-9
            assert np.allclose(np.diag(f.P), estimate.variance[k], rtol=1e-4)


@pytest.mark.parametrize(("parts", "steps"), [(1, 100_000), pytest.param(500, 2_000_000, marks=pytest.mark.slow)])
def test_positive_definite_and_steady_over_a_long_run(parts, steps):
    """1e5 steps, or 1e9 (five minutes): the covariance repeats itself period by period to rounding, and the quaternion keeps its norm."""
    body = motion.ConstantRate(rate=(0.0, 0.0, 2.0 * np.pi / 10.0))
    time = 0.1 * np.arange(steps + 1)
    series = tuple(
        series_of(
            name,
            "direction",
            time[1:],
            quaternion.rotate(quaternion.conjugate(body.attitude(time[1:])), np.array(r)),
            r,
            1e-4,
        )
        for name, r in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 0.6, 0.8]))
    )
    record = ImuRecord(time=time, increments=body.increments(time), vectors=series)
    state = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-3)
    seen = []
    for _ in range(parts):
        whole, state = estimation.run_part(record, NOISE, state, every=steps // 10, full_covariance=True)
        seen.append(whole.covariance[1:])
        assert abs(np.linalg.norm(state.attitude) - 1.0) < 1e-14
    P = np.concatenate(seen)  # whole turns apart
    assert least_eigenvalue(P) > 1e-3
    d = np.sqrt(np.diag(P[0]))
    assert np.abs((P - P[0]) / np.outer(d, d)).max() < 1e-9
    # The last corrections are rounding.
    assert np.max(quaternion.angle_between(whole.attitude, body.attitude(time[:: steps // 10]))) < 1e-9


def run_plain(record, start, dtype):
    """Run the kernel's source in plain Python, with every number of one type."""
    events = schedule(record.vectors, record.time[0], record.time[-1])
    n = len(record.increments)

    def of(value):
        return np.asarray(value, dtype)

    outputs = [np.empty((n + 1, width), dtype) for width in (4, 3, 6, 21)]
    out = covariance_form.Outputs(*outputs, np.empty((len(events.row), 6), dtype), np.empty((0, 32), dtype))
    body = covariance_form.Body(
        states=np.stack([of(pack(start.attitude, start.bias, start.covariance)), np.empty(28, dtype)]),
        angle_variance=dtype(NOISE.angle_random_walk**2),
        rate_variance=dtype(NOISE.rate_random_walk**2),
        sharpness=np.inf,  # the run goes on where digits are lost
        least_share=-np.inf,
        check=n + 1,
        good=np.zeros(2, np.int64),
        work=np.empty((7, 6), dtype),
    )
    measured = events.measurements
    columns = measured.series.copy()
    columns[:, VALUE_ORIGIN] = columns[:, SIGMA_ORIGIN] = 0  # one sensor after the other, as they stand here
    measured = measured._replace(
        time=of(measured.time),
        value=of(np.concatenate(events.series_vector_b)).reshape(-1),
        sigma=of(np.concatenate(events.series_sigma)),
        series=columns,
        triads=of(measured.triads),
    )
    plain(walk, covariance_form)(of(record.time), of(record.increments), measured, 1, body, out)
    return outputs


def test_single_precision_is_good_to_a_hundredth_of_a_sigma():
    """The same source in float32, against float64: a MEMS filter over 4 s, stars to 1e-3 rad and a start to 0.1 rad.

    Found: attitude off by 4.5e-7 rad at most, a thousandth of its σ; bias by 0.4 % of its σ; σ by 3e-5; P positive definite throughout.
    With measurements to 1e-6 rad, whose variance is lost in the rounding of P, σ is wrong by more than a tenth. Times should stay double:
    in single a stamp may change sides with an edge.
    """
    sensors = tuple(
        VectorSensor(name=name, reference_f=np.array(r), sigma=1e-3, rate=5.0)
        for name, r in (("a", [1.0, 0.2, 0.0]), ("b", [0.0, 1.0, 1.0]))
    )
    spec = GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias=np.array([1e-3, -2e-3, 5e-4]))
    record = simulate(
        Scenario(motion=motion.Coning(angle=0.3, frequency=0.3), gyro=spec, sensors=sensors, rate=25.0, duration=4.0), 1
    )
    at_edges = tuple(replace(s, time=record.time[np.searchsorted(record.time, s.time - 1e-9)]) for s in record.vectors)
    record = replace(record, vectors=at_edges)
    start = initial_state(record.truth.attitude[0], attitude_sigma=0.1, bias_sigma=3e-3)
    q, b, variance, blocks = run_plain(record, start, np.float32)
    q64, b64, variance64, _ = run_plain(record, start, np.float64)
    assert q.dtype == np.float32
    whole = estimation.run(record, NOISE, start)
    assert np.abs(q64 - whole.attitude).max() < 1e-13  # the plain source and the compiled one
    sigma = np.sqrt(variance64)
    off = quaternion.angle_between(quaternion.normalize(q.astype(np.float64)), q64)
    assert off.max() < 2e-6
    assert np.max(off / np.linalg.norm(sigma[:, :3], axis=1)) < 0.01
    assert np.max(np.abs(b - b64) / sigma[:, 3:]) < 0.02
    assert np.max(np.abs(np.sqrt(variance) / sigma - 1.0)) < 2e-4
    assert least_eigenvalue(covariance_matrices(blocks.astype(np.float64))) > 0.0
    sharp = replace(record, vectors=tuple(replace(s, sigma=np.full(len(s.time), 1e-6)) for s in record.vectors))
    _, _, broken, _ = run_plain(sharp, start, np.float32)
    _, _, right, _ = run_plain(sharp, start, np.float64)
    at = np.searchsorted(record.time, sharp.vectors[0].time)
    assert np.max(np.abs(broken[at, :3] / right[at, :3] - 1.0)) > 0.1


def test_the_smoother_takes_what_has_no_digits_left_on_its_square_root():
    """Directions to a nanoradian at a start known to a radian, and little noise: the smoother's own covariance would be rounding alone."""
    record, truth = sharp_record(1e-9, steps=30)
    process = ProcessNoise(angle_random_walk=1e-12, rate_random_walk=1e-14)
    start = initial_state(truth[0], attitude_sigma=1.0, bias_sigma=0.1)
    whole = estimation.smooth(record, process, start, full_covariance=True)
    assert np.max(quaternion.angle_between(whole.attitude, truth)) < 1e-8
    assert np.all(whole.variance > 0.0)
    usual, truth = sharp_record(1e-6, steps=30)  # an arc second or better from a start as bad is smoothed as ever
    smoothed = estimation.smooth(usual, NOISE, start)
    assert np.max(quaternion.angle_between(smoothed.attitude, truth)) < 1e-6
