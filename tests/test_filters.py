"""The package's filter, and the filters of ``sims/filter_family.py``: formulas, pairs that must agree, truth and χ²."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from filterpy.common import van_loan_discretization
from measured import drawn_start, errors, in_body, resting, series_of, turn_to
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from sims import filter_family as comparison
from strapdown import consistency, estimation, kinematics, motion, quaternion
from strapdown.consistency import Verdict
from strapdown.estimation import filters
from strapdown.records import ImuRecord, Truth
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements

BODY = motion.HarmonicRates(
    mean=(0.05, -0.1, 0.3), harmonics=(motion.Harmonic(amplitude=(0.2, 0.1, 0.0), frequency=0.1, phase=0.3),)
)
REFERENCES = {
    "direction": np.array([1.0, 0.2, 0.5]) / np.sqrt(1.29),
    "vector": np.array([2.0, 1.0, -3.0]),
    "heading": np.array([1.0, 0.3, 0.0]) / np.sqrt(1.09),
    "attitude": np.ones(1),
}
FORMS = ("scalar", "each sample", "axes", "axes of each sample", "covariance", "covariance of each sample")
"""Ways to give a measurement's noise."""
ONE_SIGMA = ("scalar", "each sample")
CASES = [(kind, form) for kind in REFERENCES for form in FORMS if kind != "heading" or form in ONE_SIGMA]
"""Every kind of measurement with every form of noise that it has."""
SIMPLE_CASES = [(kind, form) for kind in ("direction", "attitude") for form in ("scalar", "covariance of each sample")]
SHARPEST = [(kind, "each sample" if kind == "heading" else "covariance of each sample") for kind in REFERENCES]
"""Each kind with the form of noise that needs most of the code."""
UNEVEN = np.array([1.5, 0.4, 0.8])
TILTED = np.array([[1.0, 0.0, 0.0], [0.3, 0.5, 0.0], [-0.4, 0.2, 0.8]])


def noise_of(rng, form, sigma, number):
    """Return the noise given to a series of this form, and roots L (number, 3, 3) of its covariances L Lᵀ; sizes about ``sigma``."""
    sizes = sigma * (rng.uniform(0.3, 2.0, number) if "each sample" in form else np.ones(number))
    shape = np.eye(3) if form in ONE_SIGMA else TILTED if form.startswith("covariance") else np.diag(UNEVEN)
    roots = sizes[:, None, None] * shape
    name, form_noise = {
        "s": ("sigma", sizes),
        "e": ("sigma", sizes),
        "a": ("sigma_axes", sizes[:, None] * UNEVEN),
        "c": ("covariance", roots @ np.swapaxes(roots, 1, 2)),
    }[form[0]]
    return {name: form_noise if "each sample" in form else form_noise[0]}, roots


def simulated(
    rng,
    *,
    intervals=200,
    dt=0.1,
    kinds=("direction", "vector", "heading"),
    noise=(1e-4, 1e-6),
    bias=0.0,
    sigma=0.01,
    measurements=25,
    jitter=0.5,
    body=BODY,
    form="scalar",
    together=False,
):
    """A record with truth: irregular gyro intervals, measurements at random times, white noises of the given sizes.

    ``form`` says how the noise of the measurements is given (of a heading the nearest that it has); ``together`` puts all kinds at the same
    times.
    """
    edges = np.concatenate([[0.0], np.cumsum(dt * rng.uniform(1.0 - jitter, 1.0 + jitter, intervals))])
    d = np.diff(edges)[:, None]
    walk = noise[1] * np.sqrt(d) * rng.standard_normal((intervals, 3))
    biases = np.full(3, bias) + np.concatenate([np.zeros((1, 3)), np.cumsum(walk, axis=0)])
    white = np.sqrt(noise[0] ** 2 * d + noise[1] ** 2 * d**3 / 12.0) * rng.standard_normal((intervals, 3))
    increments = body.increments(edges) + 0.5 * d * (biases[1:] + biases[:-1]) + white
    series = []
    time = np.empty(0)
    for kind in kinds:
        if not (together and len(time)):
            time = np.sort(rng.uniform(edges[0], edges[-1], measurements))
        r = REFERENCES[kind]
        scale = float(np.linalg.norm(r))
        mine = form if kind != "heading" or form in ONE_SIGMA else "each sample" if "each sample" in form else "scalar"
        form_noise, roots = noise_of(rng, mine, sigma * scale, measurements)
        error = (roots @ rng.standard_normal((measurements, 3, 1)))[..., 0]
        true = Rotation.from_quat(body.attitude(time), scalar_first=True)
        if kind == "attitude":
            measured = (true * Rotation.from_rotvec(error)).as_quat(scalar_first=True)
            series.append(VectorMeasurements(sensor=kind, kind=kind, time=time, attitude=measured, **form_noise))
            continue
        if kind == "heading":  # about the vertical, of the level part
            level = Rotation.from_rotvec(error[:, 2:] * np.array([0.0, 0.0, 1.0]))
            z = true.inv().apply(level.apply(r + np.array([0.0, 0.0, 0.4])))
        else:
            z = true.inv().apply(r) + error
        if kind != "vector":
            z /= np.linalg.norm(z, axis=1, keepdims=True)
        series.append(VectorMeasurements(sensor=kind, kind=kind, time=time, vector_b=z, reference_f=r, **form_noise))
    truth = Truth(attitude=body.attitude(edges), bias=biases)
    return ImuRecord(time=edges, increments=increments, vectors=tuple(series), truth=truth)


BELIEF = estimation.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)


def started(record, rng, *, attitude_sigma, bias_sigma):
    return drawn_start(record.truth, rng.standard_normal(6), attitude_sigma, bias_sigma)


def body_rows_midway(rows, r_b, z):
    """H (n, 3) of the equivariant filter, body side: ``z − r_b = ½ (z + r_b) × δθ``, of what lies across r_b."""
    across = np.eye(3) - np.outer(r_b, r_b)
    return rows @ across @ kinematics.skew(0.5 * (z + r_b))


# -------------------------------------------------------------------------------------------- the two-frames group and others


def test_invariant_filters_never_see_what_one_reference_hides():
    """A turn about the only reference cannot be observed; the variance about it must only grow. The MEKF's reset leaks into it."""
    rng = np.random.default_rng(3)
    record = simulated(rng, kinds=("direction",), sigma=0.02, intervals=90, measurements=30)
    r = REFERENCES["direction"]
    initial = estimation.initial_state(
        quaternion.multiply(quaternion.exp([0.0, 0.9, 0.0]), record.truth.attitude[0]),
        attitude_sigma=1.0,
        bias_sigma=1e-6,
    )
    about = {}
    for name in ("mekf", *comparison.EXTENDED):
        estimate = comparison.own_filter(name, record, BELIEF, initial).run(record, initial)
        r_b = in_body(estimate.attitude, r)
        about[name] = np.einsum("ki,kij,kj->k", r_b, estimate.covariance[:, :3, :3], r_b)
    for name in ("right-invariant", "two-frame"):
        assert np.all(np.diff(about[name]) > -1e-9)
        assert about[name][-1] >= 1.0 - 1e-9
    assert about["mekf"][-1] < 0.99


# ------------------------------------------------------------------------------------------------------------- agreement


def test_the_unscented_filter_tends_to_the_mekf_for_small_errors():
    """Of the others a slow reference says more."""
    rng = np.random.default_rng(11)
    record = simulated(
        rng, intervals=60, measurements=10, kinds=("direction", "attitude"), sigma=1e-5, noise=(1e-6, 1e-9)
    )
    noise = estimation.ProcessNoise(angle_random_walk=1e-6, rate_random_walk=1e-9)
    initial = started(record, rng, attitude_sigma=1e-4, bias_sigma=1e-5)
    reference = estimation.run(record, noise, initial, full_covariance=True)
    estimate = comparison.Unscented(noise).run(record, initial)
    sigma = reference.sigma.max(axis=0)
    assert quaternion.angle_between(estimate.attitude, reference.attitude).max() < 1e-7
    assert np.abs((estimate.bias - reference.bias) / sigma[3:]).max() < 2e-3
    assert np.abs((estimate.covariance - reference.covariance) / np.outer(sigma, sigma)).max() < 2e-3


def test_every_and_variance_give_the_same_as_the_whole():
    rng = np.random.default_rng(13)
    record = simulated(rng, intervals=31, measurements=6)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    whole = estimation.run(record, BELIEF, initial, full_covariance=True)
    some = estimation.run(record, BELIEF, initial, every=7)
    np.testing.assert_array_equal(some.time, record.time[::7])
    np.testing.assert_array_equal(some.attitude, whole.attitude[::7])
    np.testing.assert_array_equal(some.variance, whole.variance[::7])
    assert some.covariance is None
    np.testing.assert_array_equal(whole.variance, np.diagonal(whole.covariance, axis1=1, axis2=2))
    for kind, dof in (("direction", 2), ("vector", 3), ("heading", 1)):
        assert whole.innovations[kind].whitened.shape == (6, dof)


# ------------------------------------------------------------------------------------- every kind of measurement and noise


def unit_vector_basis(v):
    return np.linalg.svd(v[None])[2][1:]


def derivative(function, size, h=1e-5):
    """Jacobian at zero of a function of (..., size), by central differences."""
    forward, back = function(h * np.eye(size)), function(-h * np.eye(size))
    return (forward - back).T / (2.0 * h)


def times(matrix, v):
    """Return matrices (..., 3, 3) times vectors (..., 3)."""
    return (matrix @ v[..., None])[..., 0]


def inverse_matrix(q):
    return quaternion.to_matrix(quaternion.conjugate(q))


class SlowFilter:
    """A filter of the family from nothing but what it calls the error: ``moved`` and ``error_of``; all Jacobians are numeric.

    ``moved(q, b, xi)`` is the state that lies the error xi (6,) from (q, b), ``error_of(q, b, q1, b1)`` the error of (q1, b1) near by. With
    ``resets`` the covariance is carried to the error about the corrected state, else it stays.
    """

    def __init__(self, name, initial):
        self.name = name
        self.resets = name == "mekf"
        self.q, self.b = initial.attitude, initial.bias
        back = derivative(lambda e: self.error_of(*self.body_moved(e)), 6)
        self.P = back @ initial.covariance @ back.T

    def moved(self, q, b, xi):
        a, c = xi[..., :3], xi[..., 3:]
        turn = quaternion.exp(a)
        if self.name == "mekf":
            return quaternion.multiply(q, turn), b + c
        if self.name == "geometric":
            return quaternion.multiply(q, turn), times(inverse_matrix(turn), b) + c
        if self.name in ("two-frame", "equivariant"):
            c = times(inverse_matrix(q) @ kinematics.right_jacobian(a), c)
        return quaternion.multiply(turn, q), b + c

    def error_of(self, q1, b1):
        body_side = self.name in ("mekf", "geometric")
        pair = (quaternion.conjugate(self.q), q1) if body_side else (q1, quaternion.conjugate(self.q))
        a = quaternion.log(quaternion.multiply(*pair))
        c = b1 - self.b
        if self.name == "geometric":
            c = b1 - times(quaternion.to_matrix(quaternion.exp(-a)), self.b)
        if self.name in ("two-frame", "equivariant"):
            c = times(np.linalg.inv(kinematics.right_jacobian(a)) @ quaternion.to_matrix(self.q), c)
        return np.concatenate([a, c], axis=-1)

    def body_moved(self, e):
        return quaternion.multiply(self.q, quaternion.exp(e[..., :3])), self.b + e[..., 3:]

    def predict(self, increment, dt, noise):
        start, rate = (self.q, self.b), increment / dt

        def flown(state, span):
            return quaternion.multiply(state[0], quaternion.exp((rate - state[1]) * span)), state[1]

        self.q, self.b = flown(start, dt)
        transition = derivative(lambda xi: self.error_of(*flown(self.moved(*start, xi), dt)), 6)
        Q = np.zeros((6, 6))
        density = np.diag([noise.angle_random_walk**2] * 3 + [noise.rate_random_walk**2] * 3)
        for node, weight in zip(*np.polynomial.legendre.leggauss(5), strict=True):
            t = 0.5 * dt * (node + 1.0)
            q, b = flown(start, t)

            def pushed(e, q=q, b=b, t=t):
                return self.error_of(
                    *flown((quaternion.multiply(q, quaternion.exp(e[..., :3])), b + e[..., 3:]), dt - t)
                )

            J = derivative(pushed, 6)
            Q += 0.5 * dt * weight * J @ density @ J.T
        self.P = transition @ self.P @ transition.T + Q

    def update(self, series, k):
        q, b = self.q, self.b
        kind, R = series.kind, quaternion.to_matrix(self.q)
        N = series.covariances[k]
        r = series.references_f[k]
        if kind == "attitude":
            m = series.attitude[k]
            y = turn_to(q, m)
            H = -derivative(lambda xi: turn_to(self.moved(q, b, xi)[0], q), 6)
        elif kind == "heading":
            z = series.vector_b[k]

            def heading(state):
                x = quaternion.rotate(state[0], z)
                return np.arctan2(x[..., 1:2], x[..., :1])

            y = np.arctan2(r[1], r[0]) - heading((q, b))
            y = (y + np.pi) % (2.0 * np.pi) - np.pi
            H = derivative(lambda xi: heading(self.moved(q, b, xi)), 6)
            N = N[:1, :1]
        else:
            z, size = series.vector_b[k], np.linalg.norm(r)
            rows = unit_vector_basis(R.T @ r / size) if kind == "direction" else np.eye(3)
            y = rows @ (z - R.T @ r) / size
            H = derivative(lambda xi: times(rows @ inverse_matrix(self.moved(q, b, xi)[0]), r) / size, 6)
            N = rows @ N @ rows.T / size**2
            if self.name == "equivariant":
                H = equivariant_rows(rows, R, z / size, r / size)
        S = H @ self.P @ H.T + N
        K = self.P @ H.T @ np.linalg.inv(S)
        xi = K @ y
        self.P = (np.eye(6) - K @ H) @ self.P @ (np.eye(6) - K @ H).T + K @ N @ K.T
        self.q, self.b = self.moved(q, b, xi)
        if self.resets:
            G = derivative(lambda e: self.error_of(*self.moved(q, b, xi + e)), 6)
            self.P = G @ self.P @ G.T
        return float(y @ np.linalg.solve(S, y))

    def body_covariance(self):
        def off(xi):
            q, b = self.moved(self.q, self.b, xi)
            return np.concatenate([turn_to(self.q, q), b - self.b], axis=-1)

        G = derivative(off, 6)
        return G @ self.P @ G.T


def equivariant_rows(rows, R, z, r):
    """H (n, 6) of a direction in (δφ, β): ``R z − r = −δφ × ½ (R z + r)`` to third order, ``rows`` in body axes."""
    return np.hstack([body_rows_midway(rows, R.T @ r, z) @ R.T, np.zeros((len(rows), 3))])


@pytest.mark.parametrize("form", ["scalar", "covariance of each sample"])
def test_a_missing_sample_is_as_if_it_were_not_there(form):
    """All kinds at the same times, edges among them, over uneven intervals and a gap: what is NaN is skipped and counted."""
    rng = np.random.default_rng(45)
    record = simulated(rng, intervals=20, kinds=tuple(REFERENCES), measurements=6, form=form, together=True)
    times = record.vectors[0].time.copy()
    times[2] = record.time[np.searchsorted(record.time, times[2])]
    late = np.where(np.arange(21) > 12, 5.0, 0.0)
    record = dataclasses.replace(
        record,
        time=record.time + late,
        vectors=tuple(
            dataclasses.replace(s, time=times + np.where(times > record.time[12], 5.0, 0.0)) for s in record.vectors
        ),
    )
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    lost, fewer = [], []
    for k, series in enumerate(record.vectors):
        content = "attitude" if series.kind == "attitude" else "vector_b"
        value = getattr(series, content).copy()
        value[[k, 5], k % 3] = np.nan
        lost.append(dataclasses.replace(series, **{content: value}))
        fewer.append(series.taken(np.delete(np.arange(6), [k, 5])))
    missing, removed = (
        estimation.run(dataclasses.replace(record, vectors=tuple(vectors)), BELIEF, initial, full_covariance=True)
        for vectors in (lost, fewer)
    )
    assert missing.skipped == dict.fromkeys(REFERENCES, 2)
    assert removed.skipped == dict.fromkeys(REFERENCES, 0)
    (gap,) = missing.events
    assert (gap.kind, gap.start, gap.end) == ("gap", record.time[12], record.time[13])
    assert gap == estimation.run(record, BELIEF, initial).events[0]
    for part in ("attitude", "bias", "covariance"):
        np.testing.assert_array_equal(getattr(missing, part), getattr(removed, part))
    for sensor, innovations in missing.innovations.items():
        assert len(innovations.time) == 4
        np.testing.assert_array_equal(innovations.whitened, removed.innovations[sensor].whitened)
    assert_sound(missing)


@pytest.mark.parametrize(
    ("name", "kind", "form"),
    [("package", *case) for case in CASES]
    + [(n, *case) for n in ("mekf", *comparison.EXTENDED) for case in SIMPLE_CASES],
)
def test_extended_filters_equal_a_slow_reference(name, kind, form):
    """Several steps from far off, corrections of a third of a radian, gyro intervals of half a radian."""
    rng = np.random.default_rng([41, list(REFERENCES).index(kind)])
    record = simulated(rng, intervals=3, dt=1.0, kinds=(kind, "direction") if kind != "direction" else (kind,),
                       measurements=2, form=form, sigma=0.05, noise=(0.05, 0.03))  # fmt: skip
    # The noise of the own filters, half before and half after a step, is exact but for the random walk.
    noise = estimation.ProcessNoise(angle_random_walk=0.05, rate_random_walk=0.03 if name == "package" else 1e-7)
    M = rng.standard_normal((6, 6)) * np.array([0.25] * 3 + [0.05] * 3)[:, None]
    initial = estimation.State(
        attitude=quaternion.multiply(record.truth.attitude[0], quaternion.exp([0.3, -0.2, 0.25])),
        bias=np.array([0.2, -0.1, 0.15]),
        covariance=M @ M.T,
    )
    slow = SlowFilter("mekf" if name == "package" else name, initial)
    events = sorted((t, i, k) for i, s in enumerate(record.vectors) for k, t in enumerate(s.time))
    now, nis, rows = record.time[0], {s.sensor: [] for s in record.vectors}, [(slow.q, slow.b, slow.body_covariance())]
    for begin, end, increment in zip(record.time, record.time[1:], record.increments, strict=False):
        for t, i, k in [e for e in events if begin < e[0] <= end] + [(end, -1, -1)]:
            slow.predict(increment * (t - now) / (end - begin), t - now, noise)
            now = t
            if i >= 0:
                nis[record.vectors[i].sensor].append(slow.update(record.vectors[i], k))
        rows.append((slow.q, slow.b, slow.body_covariance()))
    if name == "package":
        estimate = estimation.run(record, noise, initial, full_covariance=True)
        for sensor, values in nis.items():
            np.testing.assert_allclose(estimate.innovations[sensor].nis, values, rtol=1e-7)
    else:
        estimate = comparison.own_filter(name, record, noise, initial).run(record, initial)
    for k, (q, b, P) in enumerate(rows):
        assert quaternion.angle_between(estimate.attitude[k], q) < 1e-9
        np.testing.assert_allclose(estimate.bias[k], b, rtol=0.0, atol=1e-9)
        sigma = np.sqrt(np.diag(P))
        np.testing.assert_allclose(
            estimate.covariance[k] / np.outer(sigma, sigma), P / np.outer(sigma, sigma), rtol=0.0, atol=1e-8
        )


# ------------------------------------------------------------------------------------------------- USQUE and complementary


@pytest.mark.parametrize(
    ("sv", "su", "sigma", "dt"), [(1e-4, 1e-6, 1e-2, 1.0), (1e-3, 1e-3, 1e-3, 0.5), (1e-6, 1e-9, 1e-5, 10.0)]
)
def test_gains_are_those_of_the_riccati_equation(sv, su, sigma, dt):
    F, H = np.array([[1.0, -dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    q12 = -(su**2) * dt**2 / 2.0
    Q = np.array([[sv**2 * dt + su**2 * dt**3 / 3.0, q12], [q12, su**2 * dt]])
    scale = np.diag([1.0 / sigma, dt / sigma])  # digits: angles in sigmas, biases in sigmas an interval
    S = np.linalg.inv(scale)
    P = solve_discrete_are((scale @ F @ S).T, (H @ S / sigma).T, scale @ Q @ scale.T, np.eye(1))
    P = S @ P @ S.T
    gain = P @ H.T / (P[0, 0] + sigma**2)
    time = np.arange(1.0, 101.0) * dt
    r = REFERENCES["direction"]
    record = resting(series_of("sun", "direction", time, np.tile(r, (100, 1)), r, sigma), time=(0.0, time[-1]))
    noise = estimation.ProcessNoise(angle_random_walk=sv, rate_random_walk=su)
    start = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-12, bias_sigma=1e-15)
    np.testing.assert_allclose(comparison.steady_gains(record, noise, start)["sun"], gain[:, 0], rtol=1e-8)


@pytest.mark.parametrize("kind", ["direction", "attitude"])
def test_complementary_filter_follows_the_paper_in_the_limit(kind):
    """Small steps, extrapolated to none, against ``R̂̇ = R̂ [Ω − b̂ + k_P ω]``, ``b̂̇ = −k_I ω``, integrated by SciPy.

    Of one vector, equations (32), ω is z × R̂ᵀ r; of a measured attitude, the passive filter, vex(P_a(R̂ᵀ R_y)).
    """
    r, true, gyro = np.array([0.0, 0.6, 0.8]), quaternion.exp([0.1, 0.2, 0.3]), np.array([0.02, -0.01, 0.03])
    kp, ki, duration = 1.0, 0.3, 4.0
    z = in_body(true, r)
    start = quaternion.multiply(true, quaternion.exp([1.0, -0.8, 0.5] if kind == "direction" else [1.5, -1.0, 0.8]))

    def slope(t, y):
        q = quaternion.normalize(y[:4])
        omega = np.cross(z, in_body(q, r))
        if kind == "attitude":
            error = quaternion.to_matrix(q).T @ quaternion.to_matrix(true)
            skew = 0.5 * (error - error.T)
            omega = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        return np.concatenate([kinematics.body_quaternion_derivative(y[:4], gyro - y[4:] + kp * omega), -ki * omega])

    def end(n):
        dt = duration / n
        time = np.arange(n + 1) * dt
        series = series_of("sun", "direction", time[1:], np.tile(z, (n, 1)), r, 0.01)
        if kind == "attitude":
            axes = [0.01, 0.02, 0.05]
            series = VectorMeasurements(
                sensor="tracker", kind=kind, time=time[1:], attitude=np.tile(true, (n, 1)), sigma_axes=axes
            )
        record = ImuRecord(time=time, increments=np.tile(gyro * dt, (n, 1)), vectors=(series,))
        gains = {series.sensor: np.array([kp * dt, -ki * dt])}
        initial = estimation.initial_state(start, attitude_sigma=1.0, bias_sigma=0.1)
        estimate = comparison.Mahony("mahony", BELIEF, gains).run(record, initial)
        return estimate.attitude[-1], estimate.bias[-1]

    wanted = solve_ivp(slope, (0.0, duration), np.concatenate([start, np.zeros(3)]), rtol=1e-7, atol=1e-9).y[:, -1]
    (half, half_bias), (whole, whole_bias) = end(100), end(200)
    limit = quaternion.multiply(whole, quaternion.multiply(quaternion.conjugate(half), whole))
    assert quaternion.angle_between(limit, quaternion.normalize(wanted[:4])) < 5e-5
    np.testing.assert_allclose(2.0 * whole_bias - half_bias, wanted[4:], atol=5e-5)


# ----------------------------------------------------------------------------------------------------------------- truth


@cache
def drawn(kind, form, runs):
    """Records of one kind of measurement and noise, each with a start drawn from its own prior."""
    records = []
    for run in range(runs):
        rng = np.random.default_rng([44, CASES.index((kind, form)), run])
        record = simulated(
            rng,
            intervals=12,
            dt=0.5,
            kinds=(kind,),
            measurements=8,
            sigma=0.2 * DEGREE,
            form=form,
            bias=1e-3,
            body=motion.ConstantRate(rate=(0.05, -0.1, 0.3)),  # so that splitting an interval at a measurement is exact
        )
        records.append((record, started(record, rng, attitude_sigma=0.5 * DEGREE, bias_sigma=5e-4)))
    return records


def anees(name, kind, form, runs, factor):
    """ANEES of all six states halfway and at the end, the measurements modelled ``factor`` times as noisy as they are."""
    nees = []
    for record, initial in drawn(kind, form, runs):
        modelled = dataclasses.replace(record, vectors=tuple(series.noise_scaled(factor) for series in record.vectors))
        estimate = comparison.estimated(name, modelled, BELIEF, initial)
        nees.append(consistency.nees(errors(estimate, record.truth)[[6, 12]], estimate.covariance[[6, 12]]) / 6.0)
    return Verdict(mean=np.mean(nees, axis=0), degrees=6, runs=runs, confidence_level=0.999)


EVERY_CASE = [("mekf", *case) for case in CASES] + [(n, *case) for n in comparison.NAMES[1:] for case in SIMPLE_CASES]
SHARP_CASES = [("mekf", *case) for case in SHARPEST] + [("mahony", *case) for case in SIMPLE_CASES]


@pytest.mark.parametrize(("name", "kind", "form"), SHARP_CASES)
def test_consistent_for_every_kind(name, kind, form):
    """ANEES inside its two-sided bounds (99.9 % each); above them when the noise is modelled at a third of what it is."""
    right, doubted = (anees(name, kind, form, 25, factor) for factor in (1.0, 1.0 / 3.0))
    assert right.consistent
    assert not doubted.consistent
    assert np.max(doubted.mean) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind", "form"), EVERY_CASE)
def test_consistent_for_every_kind_and_noise_in_many_runs(name, kind, form):
    """The same over more runs; noise that is modelled too large shows too, below the bounds."""
    runs = 400 if name == "mekf" else 100
    assert anees(name, kind, form, runs, 1.0).consistent
    low = anees(name, kind, form, runs, 0.5)
    assert not low.consistent
    assert np.max(low.mean) > 1.0
    if name == "mekf":  # the others would take too many runs
        high = anees(name, kind, form, runs, 3.0)
        assert not high.consistent
        assert np.min(high.mean) < 1.0


@pytest.mark.parametrize(
    "name", ["mekf", *(pytest.param(name, marks=pytest.mark.slow) for name in (*comparison.EXTENDED, "usque"))]
)
@pytest.mark.parametrize(("degrees", "left"), [(60.0, 0.5), (120.0, 3.0)])
def test_converges_from_large_errors(name, degrees, left):
    rng = np.random.default_rng(20)
    kinds = ("direction", "vector" if name == "mekf" else "attitude")
    record = simulated(rng, intervals=600, kinds=kinds, measurements=150, bias=1e-3)
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    initial = estimation.initial_state(
        quaternion.multiply(record.truth.attitude[0], quaternion.exp(degrees * DEGREE * axis)),
        attitude_sigma=60.0 * DEGREE,
        bias_sigma=2e-3,
    )
    estimate = comparison.estimated(name, record, BELIEF, initial)
    error = quaternion.angle_between(estimate.attitude, record.truth.attitude) / DEGREE
    np.testing.assert_allclose(error[0], degrees, rtol=1e-9)
    assert error[-1] < left


# ------------------------------------------------------------------------------------------------------------- wild starts


@pytest.mark.parametrize("angle", [1e-6, 0.2, 0.5, 2.0, np.pi, 9.0])
def test_propagation_over_any_turn_is_that_of_its_linear_system(angle):
    """Φ and Q of one long interval against Van Loan's discretisation of δθ̇ = −[ω] δθ − δb, q against SciPy's rotations.

    Beyond a third of a radian in sub-steps; where the gyro is at rest and the bias turns the body, too.
    """
    rng = np.random.default_rng(31)
    dt, phi = 0.7, angle * np.array([0.6, -0.64, 0.48])
    M = rng.standard_normal((6, 6))
    F = np.zeros((6, 6))
    F[:3, :3], F[:3, 3:] = -kinematics.skew(phi / dt), -np.eye(3)
    transition, Q = van_loan_discretization(F, np.diag([0.7] * 3 + [0.9] * 3), dt)
    noise = estimation.ProcessNoise(angle_random_walk=0.7, rate_random_walk=0.9)
    for b in (rng.standard_normal(3), -phi / dt):
        initial = estimation.State(attitude=quaternion.exp(rng.standard_normal(3)), bias=b, covariance=M @ M.T)
        record = ImuRecord(time=[0.0, dt], increments=[phi + b * dt], vectors=())
        estimate = estimation.run(record, noise, initial, full_covariance=True)
        np.testing.assert_allclose(
            estimate.covariance[1], transition @ (M @ M.T) @ transition.T + Q, rtol=0.0, atol=1e-11
        )
        turned = Rotation.from_quat(initial.attitude, scalar_first=True) * Rotation.from_rotvec(phi)
        assert (Rotation.from_quat(estimate.attitude[1], scalar_first=True).inv() * turned).magnitude() < 1e-12
        np.testing.assert_array_equal(estimate.bias[1], b)


def test_the_largest_correction_is_where_the_geometric_bias_begins_to_grow():
    theta = comparison.LARGEST_CORRECTION
    assert brentq(lambda x: x - 2.0 * np.sin(x), 1.0, 3.0, xtol=1e-15) == pytest.approx(theta, abs=1e-14)
    b = np.array([0.0, 1.0, 0.0])
    for angle, grows in ((0.5, False), (theta - 1e-6, False), (theta + 1e-6, True), (3.0, True)):
        a = np.array([angle, 0.0, 0.0])
        size = np.linalg.norm(expm(-kinematics.skew(a)) @ b - np.cross(b, a))
        assert (size > 1.0) == grows
    q, moved, _ = comparison.corrected(
        "geometric", np.array([1.0, 0.0, 0.0, 0.0]), b, np.array([3.0, 0.0, 0.0, 0.0, 0.0, 6.0])
    )
    np.testing.assert_allclose(q, quaternion.exp([theta, 0.0, 0.0]), atol=1e-14)
    a = np.array([theta, 0.0, 0.0])
    np.testing.assert_allclose(
        moved, expm(-kinematics.skew(a)) @ b - np.cross(b, a) + [0.0, 0.0, 2.0 * theta], atol=1e-12
    )


def begun_off(record, axis, angle, rng):
    """A start turned by an angle, with a covariance of any size."""
    return estimation.initial_state(
        quaternion.multiply(record.truth.attitude[0], quaternion.exp(angle * axis / np.linalg.norm(axis))),
        attitude_sigma=min(10.0 ** rng.uniform(-3.0, 1.0), np.pi),
        bias_sigma=10.0 ** rng.uniform(-6.0, 0.0),
    )


def wild(seed, intervals, kinds=None):
    """A record and a start from anywhere: errors up to 180°, covariances from far too small to far too large, good and bad sensors."""
    rng = np.random.default_rng([32, seed])
    kinds = (
        kinds or (("direction",), ("direction", "vector"), ("direction", "vector", "heading"), ("heading",))[seed % 4]
    )
    record = simulated(
        rng,
        intervals=intervals,
        kinds=kinds,
        measurements=intervals // 2,
        dt=10.0 ** rng.uniform(-1.0, 1.0),
        sigma=10.0 ** rng.uniform(-5.0, -1.0),
    )
    axis = rng.standard_normal(3)
    return record, begun_off(record, axis, np.pi - 10.0 ** rng.uniform(-8.0, 0.4), rng)


def assert_sound(estimate):
    """Unit quaternions, finite biases, covariances finite and positive definite."""
    np.testing.assert_allclose(np.linalg.norm(estimate.attitude, axis=1), 1.0, rtol=0.0, atol=1e-12)
    assert np.isfinite(estimate.bias).all()
    sigma = np.sqrt(estimate.variance)
    assert np.isfinite(sigma).all()
    assert np.linalg.eigvalsh(estimate.covariance / (sigma[:, :, None] * sigma[:, None, :])).min() > -1e-9


@pytest.mark.parametrize("many", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["few", "thousands"])
def test_the_filter_stays_finite_from_any_start(many):
    for seed in range(100, 3000) if many else range(16):
        record, initial = wild(seed, 2000 if many else 300)
        assert_sound(estimation.run(record, BELIEF, initial, full_covariance=True))


@pytest.mark.parametrize(
    ("kind", "form"),
    [
        pytest.param(*case, marks=pytest.mark.slow if case[1] == "axes" and case[0] != "attitude" else [])
        for case in CASES
    ],
)
def test_the_filter_stays_finite_whatever_it_measures(kind, form):
    rng = np.random.default_rng([48, CASES.index((kind, form))])
    for together in (False, True):
        record = simulated(
            rng,
            intervals=60,
            kinds=(kind, "direction" if kind == "attitude" else "attitude") if together else (kind,),
            form=form,
            measurements=30,
            dt=10.0 ** rng.uniform(-1.0, 1.0),
            sigma=10.0 ** rng.uniform(-5.0, -1.0),
            together=together,
        )
        initial = begun_off(record, rng.standard_normal(3), 3.1, rng)
        assert_sound(estimation.run(record, BELIEF, initial, full_covariance=True))


def test_a_heading_seen_straight_up_says_nothing():
    """The start takes the measured vector to the vertical exactly: it has no heading, and the filter waits for the next."""
    series = series_of("compass", "heading", [0.5], [[0.0, 0.0, 1.0]], [1.0, 0.0, 0.0], 0.1)
    record = resting(series)
    initial = estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=1.0, bias_sigma=0.1)
    estimate = estimation.run(record, BELIEF, initial, full_covariance=True)
    assert_sound(estimate)
    assert (estimate.skipped, len(estimate.innovations["compass"].time)) == ({"compass": 1}, 0)
    np.testing.assert_allclose(estimate.attitude[-1], initial.attitude, atol=1e-15)
    assert np.all(np.diff(estimate.variance[:, :3], axis=0) >= 0.0)


def test_comparing_all_is_one_line_with_a_table():
    rng = np.random.default_rng(47)
    record = simulated(rng, intervals=40, kinds=("direction", "attitude"), measurements=20)
    initial = started(record, rng, attitude_sigma=0.1, bias_sigma=1e-3)
    mine = comparison.own_filter("mahony", record, BELIEF, initial)
    compared = filters.compare(record, BELIEF, initial, filters=["mekf", mine], every=2)
    assert list(compared.estimates) == ["mekf", "mahony"]
    own = mine.run(record, initial)
    late = compared.estimates["mekf"].time >= 0.5 * record.time[-1]
    for name, estimate in compared.estimates.items():
        wanted = own.attitude[::2] if name == "mahony" else estimation.run(record, BELIEF, initial, every=2).attitude
        np.testing.assert_array_equal(estimate.attitude, wanted)
        error = errors(estimate, record.truth, 2)[late]
        row = compared.summary()[name]
        np.testing.assert_allclose(row["attitude_error"] ** 2, np.mean(error[:, :3] ** 2), rtol=1e-10)
        np.testing.assert_allclose(row["bias_error"] ** 2, np.mean(error[:, 3:] ** 2), rtol=1e-10)
        np.testing.assert_allclose(row["attitude_sigma"] ** 2, np.mean(estimate.variance[late, :3]), rtol=1e-12)
        np.testing.assert_allclose(row["bias_sigma"] ** 2, np.mean(estimate.variance[late, 3:]), rtol=1e-12)
    estimate, row = compared.estimates["mekf"], compared.summary()["mekf"]
    parts = [i.whitened[i.time >= estimate.time[late][0]].ravel() for i in estimate.innovations.values()]
    np.testing.assert_allclose(row["nis"], np.mean(np.concatenate(parts) ** 2), rtol=1e-12)
    assert row["degrees"] == len(np.concatenate(parts))
    assert f"{compared.summary()['mekf']['attitude_error'] / DEGREE:.4g}" in str(compared)
    # Without truth it reports differences from the first filter.
    blind = filters.compare(dataclasses.replace(record, truth=None), BELIEF, initial, filters=[mine, "mekf"])
    assert "from mahony" in str(blind)
    assert 0.0 < blind.summary()["mekf"]["attitude_error"] < 0.1
    silent = filters.compare(dataclasses.replace(record, vectors=()), BELIEF, initial, filters="mekf")
    assert np.isnan(silent.summary()["mekf"]["nis"])
