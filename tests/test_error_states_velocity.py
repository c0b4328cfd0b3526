"""The bounded velocity of an accelerometer on a moving hand, and states in chains: exact models, both faces, consistency, files."""

import dataclasses
import functools
import math
from decimal import Decimal, localcontext
from pathlib import Path

import in_steps
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from measured import UP, assert_inside, drawn_start, in_body, series_of, state_errors, unit, waves

from benchmarks import recordings as leaderboard
from sims import hand_held
from strapdown import ahrs, consistency, estimation, kinematics, quaternion, records, scenarios
from strapdown.consistency import reference_errors
from strapdown.estimation import error_states, forward, setup
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import stationary_covariance
from strapdown.estimation.observability import state_names
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise
from strapdown.estimation.step_filter import StepFilter
from strapdown.recordings import Recording, read
from strapdown.records import ImuRecord, Truth
from strapdown.units import DEGREE
from strapdown.vectors import Accelerometer

NOISE = ProcessNoise(angle_random_walk=2e-3, rate_random_walk=1e-4)
HAND = waves(((1.1, 0.3, -0.4), 0.21), ((-0.4, 0.9, 0.8), 0.37, 0.4))
POLES = {
    "velocity": {"velocity_time": 0.3, "acceleration_time": 0.1},
    "equal times": {"velocity_time": 0.2, "acceleration_time": 0.2},
    "times far apart": {"velocity_time": 30.0, "acceleration_time": 0.02},
    "position": {"velocity_time": 0.3, "acceleration_time": 0.1, "position_time": 1.0},
    "all equal": {"velocity_time": 0.3, "acceleration_time": 0.3, "position_time": 0.3},
}


def block_of(poles: str, velocity_sigma: float = 0.5, **more) -> error_states.BoundedVelocity:
    return error_states.BoundedVelocity(
        sensor="acc", velocity_sigma=velocity_sigma, **{"strength": 1.0, **POLES[poles], **more}
    )


def system(block: error_states.ErrorStates) -> tuple[np.ndarray, np.ndarray]:
    """Matrix of the block's states and diagonal of its driving noise, from what it declares."""
    n = block.size
    return np.diag(block.feed[: n - 1], 1) - np.diag(block.decay), np.asarray(block.density)


def outputs(block: error_states.BoundedVelocity) -> dict[str, np.ndarray]:
    """Rows that give position, velocity and acceleration of the first axis from its states: by differentiating them."""
    A, _ = system(block)
    n = block.size // 3
    A = A[:n, :n]
    rows = [np.eye(n)[0]]
    for _ in range(n - 1):
        rows.append(rows[-1] @ A)
    return dict(zip(("position", "velocity", "acceleration")[3 - n :], rows, strict=True))


def exactly(A: np.ndarray, q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise with sixty digits: by their series over a short step, which is doubled until it is dt."""
    doublings = 12 + max(0, math.ceil(math.log2(np.abs(A).sum(axis=1).max() * dt)))
    exact = np.vectorize(Decimal, otypes=[object])
    with localcontext(prec=60):
        step = Decimal(dt) / 2**doublings
        A, noise, term = exact(A) * step, exact(np.diag(q)) * step, exact(np.eye(len(A)))
        phi, Q = term, noise
        for k in range(1, 16):
            term, noise = A @ term / k, A @ noise / (k + 1)
            noise = noise + noise.T
            phi, Q = phi + term, Q + noise
        for _ in range(doublings):
            phi, Q = phi @ phi, phi @ Q @ phi.T + Q
        return phi.astype(float), Q.astype(float)


def aged(block, dt, values=0.0, covariance=0.0):
    """Values and covariance after a time without measurements."""
    n = block.size
    model = modelling.assemble((block,), {"acc": "vector"})
    return forward.aged_states(model, np.full(n, values), np.full((n, n), covariance), dt)


# ---------------------------------------------------------------------------------------------------------- transition and noise


@pytest.mark.parametrize("dt", [1e-5, 0.017, 2.0])
@pytest.mark.parametrize("poles", POLES)
def test_transition_and_noise_are_those_of_van_loan(poles, dt):
    block = block_of(poles)
    A, q = system(block)
    phi, Q = exactly(A, q, dt)
    n = block.size
    values = np.transpose([aged(block, dt, column)[0] for column in np.eye(n)])
    np.testing.assert_allclose(values, phi, rtol=1e-12, atol=0)
    np.testing.assert_allclose(values, scipy.linalg.expm(A * dt), rtol=0, atol=1e-13)
    sigma = np.sqrt(np.where(np.diag(Q) > 0.0, np.diag(Q), 1.0))
    assert np.max(np.abs(aged(block, dt)[1] - Q) / np.outer(sigma, sigma)) < 1e-10


@dataclasses.dataclass(frozen=True)
class Ramp(error_states.ErrorStates):
    """A block that the package does not have: a slope that never changes feeds an offset that walks besides; a bias; a chain with feeds;
    two chains that differ by the feed alone.
    """

    name: str = "ramp"
    components: tuple[str, ...] = ("offset", "slope", "bias", "far", "middle", "near", "one", "its", "other", "its own")
    units: tuple[str, ...] = ("m/s²", "m/s³", "m/s²", *("1",) * 7)
    sigma = np.array([0.3, 0.02, 0.1, 0.3, 0.2, 0.5, 0.1, 0.1, 0.1, 0.1])
    decay = np.array([0.0, 0.0, 0.0, 2.0, 0.0, 5.0, 1.0, 3.0, 1.0, 3.0])
    density = np.array([1e-4, 0.0, 0.0, 2e-3, 5e-3, 0.1, 0.0, 0.1, 0.0, 0.1])
    feed = np.array([1.0, 0.0, 0.0, -1.5, 0.7, 0.0, 2.0, 0.0, -0.5, 0.0])

    @property
    def effects(self):
        rows = np.zeros((10, 3))
        rows[[0, 2, 3, 4], [0, 1, 2, 0]] = 1.0, 1.0, 0.4, -0.3
        return {"acc": error_states.Effect(offset_b=rows)}


BLOCKS = {
    **{poles: (block_of(poles),) for poles in POLES},
    "ramp": (Ramp(),),
    "among others": (
        error_states.GyroScale(scale_sigma=0.01, misalignment_sigma=0.01),
        error_states.GyroGaussMarkov(bias_sigma=2e-3, correlation_time=3.0),
        block_of("velocity"),
        error_states.VectorBias(sensor="acc", bias_sigma=0.1),
    ),
}


@pytest.mark.parametrize(
    ("option", "dt"),
    [
        *((option, 0.15) for option in BLOCKS),
        *((option, dt) for option in ("times far apart", "position") for dt in (1e-4, 0.01)),
    ],
)
def test_a_step_of_the_filter_is_that_of_the_whole_system(option, dt):
    """Attitude, bias and all blocks at once, over several of the kernel's own steps where dt is long."""
    blocks = BLOCKS[option]
    m = sum(block.size for block in blocks)
    turn = np.array([0.3, -0.5, 0.2])
    face = StepFilter(NOISE, estimation.with_error_states(start(), blocks), blocks)
    face.bias = np.zeros(3)
    before = face.P.copy()
    face.predict(turn * dt, dt)
    A, G = np.zeros((6 + m, 6 + m)), np.zeros(6 + m)
    A[:3, :3] = -kinematics.skew(turn)
    A[:3, 3:6] = -np.eye(3)
    G[:6] = np.repeat([NOISE.angle_random_walk**2, NOISE.rate_random_walk**2], 3)
    first = 6
    for block in blocks:
        own = slice(first, first + block.size)
        A[own, own], G[own] = system(block)
        A[:3, own] = -(block.gyro_offset + block.gyro_scale @ turn).T
        first += block.size
    phi, Q = exactly(A, G, dt)
    wanted = phi @ before @ phi.T + Q
    sigma = np.sqrt(np.diag(wanted))
    assert np.max(np.abs(face.P - wanted) / np.outer(sigma, sigma)) < 1e-9


@pytest.mark.parametrize("poles", POLES)
def test_the_start_is_stationary(poles):
    block = block_of(poles)
    A, q = system(block)
    P = block.covariance
    np.testing.assert_allclose(P, stationary_covariance(block.decay, block.density, block.feed), rtol=1e-15)
    np.testing.assert_allclose(P, scipy.linalg.solve_continuous_lyapunov(A, -np.diag(q)), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(block.sigma**2, np.diag(P), rtol=1e-14)
    for dt in (0.01, 0.4):
        np.testing.assert_allclose(aged(block, dt, covariance=P)[1], P, rtol=1e-10, atol=1e-15)
    state = estimation.with_error_states(
        start(), (error_states.GyroScale(scale_sigma=0.01, misalignment_sigma=0.01), block)
    )
    np.testing.assert_array_equal(state.covariance[15:, 15:], P)


@pytest.mark.parametrize("poles", POLES)
def test_sigmas_are_those_of_the_spectrum_which_vanishes_at_zero(poles):
    """Against the quadrature of ``|C (jω − A)⁻¹ B|² q``, and its slope towards zero: ω² of a, ω⁴ with a bounded position."""
    block = block_of(poles)
    n = block.size // 3
    A, q = (each[:n] for each in system(block))

    def spectrum(w: float, row: np.ndarray) -> float:
        transfer = row @ np.linalg.solve(1j * w * np.eye(n) - A[:, :n], np.eye(n)[-1])
        return float(q[n - 1] * abs(transfer) ** 2)

    rows = outputs(block)
    v, a, p = 1.0 / block.velocity_time, 1.0 / block.acceleration_time, 0.0
    if n == 3:
        p = 1.0 / block.position_time
    of_acceleration = block.velocity_sigma * np.sqrt(p * v + (p + v) * a)
    for name, sigma in (("velocity", block.velocity_sigma), ("acceleration", of_acceleration)):
        variance = (
            2.0
            * scipy.integrate.quad(
                lambda u, row=rows[name]: spectrum(np.exp(u), row) * np.exp(u), -25.0, 25.0, limit=500
            )[0]
        )
        assert np.sqrt(variance / (2.0 * np.pi)) == pytest.approx(sigma, rel=1e-7)
        assert np.sqrt(rows[name] @ block.covariance[:n, :n] @ rows[name]) == pytest.approx(sigma, rel=1e-12)
    slope = np.log(spectrum(2e-5, rows["acceleration"]) / spectrum(1e-5, rows["acceleration"])) / np.log(2.0)
    assert slope == pytest.approx(2.0 * (n - 1), abs=1e-3)
    np.testing.assert_allclose(block.effects["acc"].offset_f, np.kron(np.eye(3), rows["acceleration"][:, None]))


def test_names_units_and_strength():
    block = error_states.BoundedVelocity(sensor="acc", velocity_time=0.3, velocity_sigma=0.5, acceleration_time=0.1)
    assert block.name == "acc velocity"
    assert block.components[:2] == ("velocity x", "drive x")
    assert state_names([block])[0][6:8] == ("acc velocity x", "acc velocity drive x")
    assert block.units == ("m/s", "m/s²") * 3
    whole = dataclasses.replace(block, strength=1.0)
    np.testing.assert_allclose(9.80665 * block.effects["acc"].offset_f, whole.effects["acc"].offset_f, rtol=1e-14)
    three = dataclasses.replace(block_of("position"), name="")
    assert three.components[:3] == ("position x", "velocity drive x", "drive x")
    assert three.units == ("m", "m/s", "m/s²") * 3


# ------------------------------------------------------------------------------------------------------------------ both faces


def start(error=(0.02, -0.01, 0.015)) -> estimation.State:
    attitude = quaternion.multiply(HAND.attitude(np.array(0.0)), quaternion.exp(error))
    return estimation.initial_state(attitude, attitude_sigma=0.03, bias_sigma=3e-3)


def acceleration_path(block: error_states.BoundedVelocity, time: np.ndarray, rng: np.random.Generator) -> dict:
    """States (m, size) of the block at times, by SciPy's exponential, from the stationary start; and the acceleration (m, 3)."""
    A, q = system(block)
    P = scipy.linalg.solve_continuous_lyapunov(A, -np.diag(q))
    c = np.linalg.cholesky(P) @ rng.standard_normal(block.size)
    path = [c]
    roots: dict[float, tuple] = {}
    for dt in np.round(np.diff(time), 12):
        if dt not in roots:
            phi = scipy.linalg.expm(A * dt)
            value, vector = np.linalg.eigh(P - phi @ P @ phi.T)
            roots[dt] = phi, vector * np.sqrt(np.maximum(value, 0.0))
        phi, root = roots[dt]
        c = phi @ c + root @ rng.standard_normal(block.size)
        path.append(c)
    states = np.array(path)
    row = outputs(block)["acceleration"]
    return {"states": states, "acceleration": states.reshape(len(time), 3, -1) @ row}


def record_of(
    block: error_states.BoundedVelocity,
    seed: int = 1,
    *,
    duration: float = 4.0,
    rate: float = 100.0,
    kind: str = "vector",
    sigma: float = 0.05,
    phase: float = 0.0,
) -> tuple[ImuRecord, dict]:
    """A body that turns and is moved about as the block says, an accelerometer half as often as the gyro, and a field."""
    rng = np.random.default_rng(seed)
    edges = np.arange(round(duration * rate) + 1) / rate
    dt = np.diff(edges)[:, None]
    walk = np.concatenate([np.zeros((1, 3)), np.cumsum(np.sqrt(dt) * rng.standard_normal((len(dt), 3)), axis=0)])
    bias = 3e-3 * rng.standard_normal(3) + NOISE.rate_random_walk * walk
    increments = HAND.increments(edges) + 0.5 * (bias[1:] + bias[:-1]) * dt
    increments += NOISE.angle_random_walk * np.sqrt(dt) * rng.standard_normal((len(dt), 3))
    time = edges[2:-1:2] + phase
    # The path at the accelerometer's times and, between, at the edges, where errors are judged.
    every = np.union1d(np.round(edges, 9), np.round(time, 9))
    path = acceleration_path(block, every, rng)
    felt = path["acceleration"][np.searchsorted(every, np.round(time, 9))] + UP
    force = in_body(HAND.attitude(time), felt) + sigma * rng.standard_normal((len(time), 3))
    north = np.array([0.0, 1.0, 0.0])
    field = in_body(HAND.attitude(edges[5::10]), north)
    field = field + 0.05 * rng.standard_normal(field.shape)
    if kind == "vector":
        acc = series_of("acc", kind, time, force, UP, sigma)
    else:
        acc = series_of("acc", kind, time, unit(force), UP, sigma / 9.81)
    series = acc, series_of("mag", "vector", edges[5::10], field, north, 0.05)
    truth = {"attitude": HAND.attitude(edges), "bias": bias}
    truth["states"] = path["states"][np.searchsorted(every, np.round(edges, 9))]
    return ImuRecord(time=edges, increments=increments, vectors=series), truth


QUICK = ("velocity", "equal times", "times far apart")
"""Options of one structure, that of most tests here. Each of the rest is compiled for itself, the largest in 15 s."""


@pytest.mark.parametrize(
    ("option", "kind"),
    [
        pytest.param(option, kind, marks=[] if option in QUICK else pytest.mark.slow)
        for option, kind in (
            *((option, "vector") for option in BLOCKS),
            ("position", "direction"),
            ("among others", "direction"),
        )
    ],
)
def test_both_faces_agree(option, kind):
    """At times of their own too, so that every step has another length; from 20° off, whose corrections turn what is carried."""
    strength = 1.0 if kind == "vector" else 9.81
    blocks = tuple(
        dataclasses.replace(b, strength=strength) if isinstance(b, error_states.BoundedVelocity) else b
        for b in BLOCKS[option]
    )
    record, _ = record_of(block_of("velocity", 0.02), duration=0.5, kind=kind, phase=0.0037)
    state = estimation.with_error_states(start((0.2, -0.25, 0.1)), blocks)
    draw = np.random.default_rng(5).standard_normal(len(state.values))
    values = 0.1 * np.sqrt(np.diag(state.covariance)[6:]) * draw
    P = state.covariance + np.diag([0.1] * 3 + [0.0] * (len(values) + 3))
    state = dataclasses.replace(state, values=values, covariance=P)
    fast = estimation.run(record, NOISE, state, blocks, full_covariance=True)
    slow = in_steps.run(record, NOISE, state, blocks)
    assert in_steps.apart(fast, slow) < 1e-9
    for name, innovations in fast.innovations.items():
        np.testing.assert_allclose(slow.whitened[name], innovations.whitened, rtol=1e-7, atol=1e-9)


# ------------------------------------------------------------------------------------------------------------------------- gaps


def test_a_gap_of_many_correlation_times_forgets_the_velocity():
    block = block_of("velocity")
    record, _ = record_of(block)
    time = np.where(np.arange(len(record.time)) > 100, record.time + 60.0, record.time)
    later = tuple(
        dataclasses.replace(s, time=np.where(s.time > 1.0, s.time + 60.0, s.time)).taken(np.abs(s.time - 1.005) > 0.02)
        for s in record.vectors
    )
    record = ImuRecord(time=time, increments=record.increments, vectors=later)
    ahead = estimation.run(record, NOISE, start(), (block,))
    both = estimation.smooth(record, NOISE, start(), (block,))
    np.testing.assert_allclose(ahead.error_states[block.name].sigma[101], block.sigma, rtol=1e-9)
    assert np.all(np.abs(ahead.error_states[block.name].values[101]) < 1e-9)
    assert np.all(np.isfinite(both.variance))
    assert np.all(both.sigma <= ahead.sigma * (1.0 + 1e-3))


# ------------------------------------------------------------------------------------------------------------------ consistency


@functools.cache
def judged(
    poles: str, number: int, duration: float, smoothed: bool = False, speed: float = 0.5
) -> dict[str, np.ndarray]:
    """NEES over its degrees, at five epochs of the second half, of many records of the block's own making (runs, 5), by part."""
    block = block_of(poles, speed)
    parts = {"attitude": slice(0, 3), "bias": slice(3, 6), "block": slice(6, None), "all": slice(None)}
    statistics: dict[str, list] = {name: [] for name in parts}
    for seed in range(number):
        record, truth = record_of(block, seed, duration=duration)
        known = Truth(attitude=truth["attitude"], bias=truth["bias"])
        initial = drawn_start(known, np.random.default_rng(1000 + seed).standard_normal(6), 0.03, 3e-3)
        face = estimation.smooth if smoothed else estimation.run
        estimate = face(record, NOISE, initial, (block,), full_covariance=True)
        epochs = (np.linspace(0.5, 0.97, 5) * (len(record.time) - 1)).astype(int)
        states = _as_estimated(truth["states"], truth["attitude"], estimate.attitude)
        e = state_errors(estimate, truth["attitude"], truth["bias"], {block.name: states})[epochs]
        P = estimate.whole_covariance[epochs]
        for name, part in parts.items():
            statistics[name].append(consistency.nees(e[:, part], P[:, part, part]) / e[:, part].shape[1])
    return {name: np.array(values) for name, values in statistics.items()}


def _as_estimated(states: np.ndarray, true_attitude: np.ndarray, attitude: np.ndarray) -> np.ndarray:
    """The states of the three axes in the fixed frame as the estimated attitude has it, relative to which they are known."""
    turn = quaternion.multiply(attitude, quaternion.conjugate(true_attitude))
    vectors = np.swapaxes(states.reshape(len(states), 3, -1), 1, 2)
    return np.swapaxes(quaternion.rotate(turn[:, None], vectors), 1, 2).reshape(len(states), -1)


@pytest.mark.parametrize(
    ("poles", "smoothed"),
    [("velocity", False), ("velocity", True), pytest.param("position", False, marks=pytest.mark.slow)],
)
def test_the_filter_is_consistent_on_what_it_models(poles, smoothed):
    """Five epochs and four parts: bounds of 99.9 % each, so that all twenty hold in 98 of 100 tries."""
    statistics = judged(poles, 24, 6.0, smoothed)
    size = block_of(poles).size
    for part, degrees in (("attitude", 3), ("bias", 3), ("block", size), ("all", 6 + size)):
        low, high = consistency.mean_bounds(degrees, 24, 0.999)
        anees = statistics[part].mean(axis=0)
        assert np.all((low < anees) & (anees < high)), (part, anees, low, high)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("poles", "smoothed"), [("velocity", False), ("velocity", True), ("position", False), ("position", True)]
)
def test_consistency_over_many_runs(poles, smoothed):
    """At the last of the epochs, of a slower hand; sixteen verdicts, bounds of 99.9 % each.

    At half a metre a second the errors are large enough for what is of second order to show: ANEES is 1.02 to 1.05.
    """
    statistics = judged(poles, 400, 6.0, smoothed, speed=0.1)
    size = block_of(poles).size
    for part, degrees in (("attitude", 3), ("bias", 3), ("block", size), ("all", 6 + size)):
        assert_inside(statistics[part][:, -1].mean(), degrees, 400, 0.999)


# ------------------------------------------------------------------------------------------------------------------ setups and files

TOLD = SensorStates(velocity_time=0.3, velocity_sigma=0.5, acceleration_time=0.1)


@pytest.mark.parametrize(
    "sensor_states",
    [
        TOLD,
        dataclasses.replace(TOLD, acceleration_time=0.123456789, position_time=1.0, bias_sigma=0.2),
    ],
)
def test_a_setup_holds_it_to_the_last_bit(sensor_states):
    filter_setup = setup.FilterSetup(
        process_noise=NOISE, bias_sigma=1e-3, states=States(sensors={"acc": sensor_states})
    )
    text = setup.to_toml(filter_setup)
    assert setup.from_toml(text) == filter_setup
    assert "velocity_time_s = 0.3" in text
    assert "acc.velocity" in filter_setup.states.names
    kept = filter_setup.states.select(("acc.velocity",))
    assert kept.sensors["acc"] == dataclasses.replace(sensor_states, bias_sigma=0.0)
    if sensor_states.bias_sigma:
        bias = filter_setup.states.select(("acc.bias",)).sensors["acc"]
        assert bias == SensorStates(bias_sigma=sensor_states.bias_sigma)


def test_a_setup_has_the_block_for_either_kind_of_accelerometer():
    states = States(sensors={"acc": TOLD}, gravity_f=(0.0, 0.0, -9.7))
    (whole,), (direction,) = (states.blocks({"acc": kind}) for kind in ("vector", "direction"))
    assert (whole.strength, direction.strength) == (1.0, 9.7)
    assert whole.velocity_sigma == 0.5


def test_what_no_state_covers_is_reported():
    moved = Accelerometer(name="acc", sigma=0.05, rate=25.0, acceleration_f=lambda t: np.zeros((*np.shape(t), 3)))
    held = dataclasses.replace(moved, acceleration_f=None)
    words = "the acceleration of the point where the acc is mounted"
    plain = setup.FilterSetup(process_noise=NOISE, bias_sigma=3e-3)
    told = dataclasses.replace(plain, states=States(sensors={"acc": TOLD}))
    for sensor, belief, said in ((moved, plain, True), (moved, told, False), (held, plain, False)):
        scenario = dataclasses.replace(scenarios.load_scenario("two-stars"), sensors=(sensor,))
        origin = records.Origin(gyro=scenario.gyro, scenario=scenario)
        assert (words in setup.unmodelled_errors(origin, belief)) == said


# ------------------------------------------------------------------------------------------------------------------ in the hand


def errors_of(used: Recording, attitude: np.ndarray) -> dict[str, float]:
    """RMS errors over the movement, degrees."""
    errors = reference_errors(attitude, used.true_attitude)._asdict()
    return {part: np.sqrt(np.nanmean(error[used.movement] ** 2)) / DEGREE for part, error in errors.items()}


def errors_by(recording: Recording, parameters: ahrs.AhrsParameters, **options) -> dict[str, float]:
    """The same of the filter of these beliefs."""
    result = ahrs.estimate(recording, parameters, **options)
    return errors_of(result.recording, result.estimate.attitude)


def test_the_simulated_hand_moves_as_its_accelerometer_says():
    """The acceleration is the second derivative of a path that begins at rest; where it rests, the sensor feels the vertical alone."""
    t, h, phase = np.linspace(0.01, 6.0, 500)[:, None], 1e-4, np.array([0.3, 2.0, 4.4])
    (before, _), (here, acceleration), (after, _) = (hand_held.swelling(t + step, 6.9, phase) for step in (-h, 0.0, h))
    np.testing.assert_allclose(acceleration, (after - 2.0 * here + before) / h**2, atol=2e-5)
    assert np.abs(hand_held.swelling(np.array([0.0]), 6.9, phase)).max() == 0.0
    recording = hand_held.simulated(1, 0, 10.0)
    fixed = quaternion.rotate(recording.true_attitude, recording.specific_force) - np.array([0.0, 0.0, 9.81])
    assert np.abs(fixed[recording.time < 1.9].mean(axis=0)).max() < 0.2
    assert 0.3 < np.sqrt(np.mean(fixed[recording.time > 4.0] ** 2)) < 3.0


def test_the_latency_of_a_gyro_beside_a_reference():
    """The reference moved by 4 ms; no filter has part in it."""
    recording = hand_held.simulated(1, 0, 20.0)
    assert hand_held.gyro_latency(recording) == pytest.approx(0.0, abs=1e-4)
    rates = [np.interp(recording.time + 0.004, recording.time, rate) for rate in recording.rate.T]
    early = dataclasses.replace(recording, rate=np.stack(rates, axis=1))
    assert hand_held.gyro_latency(early) == pytest.approx(-0.004, abs=2e-4)


def errors_over(broad: Path, parameters: ahrs.AhrsParameters, **options) -> np.ndarray:
    """Total error and inclination (n, 2) of each BROAD trial, degrees."""
    errors = (errors_by(read(file), parameters, **options) for file in sorted(broad.glob("*.hdf5")))
    return np.array([[trial["total"], trial["inclination"]] for trial in errors])


@pytest.mark.slow
def test_broad_trials_by_bounded_velocity(broad):
    """One set of numbers for all, held against VQF on the same trials (2.6°); at rest the field of trial 27 is 4.6° off."""
    errors = errors_over(broad, ahrs.HAND_HELD, latency=4.1e-3)
    assert 1.0 < errors[:, 0].mean() < 2.0  # the heading's offset included, which VQF's 2.6° have too
    assert np.sort(errors[:, 0])[:-1].mean() < 1.6
    assert np.sort(errors[:, 0])[-2] < 3.5
    assert errors[:, 0].max() < 6.5  # trial 27, whose hard iron shows in its motion alone
    assert errors[:, 1].mean() < 0.48
    late = [hand_held.gyro_latency(read(file)) for file in sorted(broad.glob("*.hdf5"))[::3]]
    np.testing.assert_allclose(late, 4.15e-3, atol=1.5e-4)


def test_a_broad_trial_by_bounded_velocity(broad):
    recording = read(sorted(broad.glob("*.hdf5"))[1])
    np.testing.assert_allclose(hand_held.gyro_latency(recording), 4.15e-3, atol=1.5e-4)
    errors = errors_by(recording, ahrs.HAND_HELD, latency=4.1e-3)
    assert errors["total"] < 0.9
    assert errors["inclination"] < 0.35


@pytest.mark.slow
@pytest.mark.parametrize(("smooth", "bound"), [(False, 0.8), (True, 0.7)])
def test_broad_trials_beside_vqf(broad, smooth, bound):
    """The bounds at which the model still counts as one for all sets: it was chosen on them, and was better on BROAD alone before."""
    pytest.importorskip("vqf")
    recordings = [read(file) for file in sorted(broad.glob("*.hdf5"))]
    filters = (functools.partial(leaderboard.ours, smooth=smooth), functools.partial(leaderboard.vqf, offline=smooth))
    own, peer = ([leaderboard.score(each, run).error_deg[0] for each in recordings] for run in filters)
    assert 0.4 < np.mean(own) / np.mean(peer) < bound
