"""Smoother: equal to its fixed-side twin; consistent; never worse than the filter. Least squares: test_error_states_smoother.py."""

import dataclasses
import math
import tracemalloc

import filterpy.common
import filterpy.kalman
import mpmath
import numpy as np
import pytest
from measured import assert_inside, drawn_start, errors, in_body, recoveries, series_of, unit, waves

from strapdown import coning, consistency, estimation, kinematics, motion, quaternion, records
from strapdown.checks import InputError
from strapdown.estimation import forward, smoothing
from strapdown.estimation.gating import Gate
from strapdown.estimation.states import ProcessNoise, covariance_matrices
from strapdown.kernels import smoother_loop
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.records import Estimate, ImuRecord, Truth
from strapdown.vectors import VectorMeasurements, triad

DOWN, NORTH, STAR = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.6, 0.48, 0.64])


# ------------------------------------------------------------------------------------------------------------------ simulation


NOISE = ProcessNoise(angle_random_walk=2e-3, rate_random_walk=3e-4)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A body, a gyro and sensors, each (kind, reference, sigma, interval, phase) or with an array of times."""

    motion: motion.Motion
    sensors: tuple
    duration: float = 20.0
    rate: float = 50.0
    noise: ProcessNoise = NOISE
    attitude_sigma: float = 0.03
    bias_sigma: float = 3e-3
    integration: str | None = None


def exact(name, kind, time, reference, sigma, attitude=quaternion.IDENTITY) -> VectorMeasurements:
    """A sensor without errors that is modelled with some."""
    z = np.broadcast_to(in_body(attitude, reference), (len(time), 3))
    return series_of(name, kind, time, z, reference, sigma)


def measure(name, kind, reference, sigma, time, attitude, rng) -> VectorMeasurements:
    series = exact(name, kind, time, reference, sigma, attitude)
    z = series.vector_b + sigma * rng.standard_normal((len(time), 3))
    return dataclasses.replace(series, vector_b=z if kind == "vector" else unit(z))


def simulate(case: Case, rng: np.random.Generator, edges: np.ndarray | None = None) -> ImuRecord:
    edges = np.arange(round(case.duration * case.rate) + 1) / case.rate if edges is None else edges
    dt = np.diff(edges)[:, None]
    n = len(dt)
    sv, su = case.noise.angle_random_walk, case.noise.rate_random_walk
    bias = case.bias_sigma * rng.standard_normal(3) + np.vstack(
        [np.zeros(3), np.cumsum(su * np.sqrt(dt) * rng.standard_normal((n, 3)), axis=0)]
    )
    noise = np.sqrt(sv**2 * dt + su**2 * dt**3 / 12.0) * rng.standard_normal((n, 3))
    increments = case.motion.increments(edges) + 0.5 * dt * (bias[1:] + bias[:-1]) + noise
    series = []
    for i, (kind, reference, sigma, times) in enumerate(case.sensors):
        time = np.arange(times[1], edges[-1], times[0]) if isinstance(times, tuple) else np.asarray(times)
        series.append(measure(f"{kind} {i}", kind, reference, sigma, time, case.motion.attitude(time), rng))
    return ImuRecord(
        time=edges,
        increments=increments,
        vectors=tuple(series),
        truth=Truth(attitude=case.motion.attitude(edges), bias=bias),
    )


def simulated(case: Case, rng: np.random.Generator) -> tuple[ImuRecord, estimation.State]:
    record = simulate(case, rng)
    initial = drawn_start(record.truth, rng.standard_normal(6), case.attitude_sigma, case.bias_sigma)
    if case.integration:
        record = records.compress(record, coning.ALGORITHMS[case.integration])
    return record, initial


SWAY = waves(((0.5, 0.2, -0.3), 0.21), ((-0.2, 0.4, 0.3), 0.37))
TURN = motion.ConstantRate(rate=(0.3, -0.5, 0.8))
CASES = {
    "directions": Case(
        motion=SWAY, sensors=(("direction", DOWN, 0.02, (0.2, 0.2)), ("direction", NORTH, 0.04, (0.5, 0.5)))
    ),
    "one direction, turning": Case(motion=TURN, sensors=(("direction", STAR, 0.02, (0.1, 0.1)),)),
    "vectors": Case(
        motion=SWAY, sensors=(("vector", 9.81 * DOWN, 0.2, (0.2, 0.2)), ("vector", 5e-5 * STAR, 2e-6, (0.4, 0.1)))
    ),
    "heading": Case(motion=SWAY, sensors=(("direction", DOWN, 0.01, (0.2, 0.2)), ("heading", NORTH, 0.02, (0.3, 0.3)))),
    "asynchronous": Case(
        motion=SWAY,
        sensors=(
            ("direction", DOWN, 0.02, (0.1337, 0.071)),
            ("direction", STAR, 0.04, np.sort(np.random.default_rng(5).uniform(0.0, 20.0, 40))),
            ("heading", NORTH, 0.05, (1.01, 0.77)),
        ),
    ),
    "coning": Case(
        motion=motion.Coning(angle=math.radians(2.0), frequency=3.0),
        sensors=(("direction", DOWN, 0.02, (0.24, 0.24)), ("direction", NORTH, 0.02, (0.24, 0.24))),
        rate=200.0,
        integration="four-sample",
    ),
    "rest": Case(
        motion=motion.rest(), sensors=(("direction", DOWN, 0.02, (0.2, 0.2)), ("direction", NORTH, 0.05, (1.0, 1.0)))
    ),
}


def check_consistent(nees: np.ndarray, probability: float, degrees: int = 6) -> None:
    """The mean over runs (runs, epochs) lies inside the two-sided bounds of all epochs together."""
    mean = nees.mean(axis=0) / degrees
    verdict = consistency.Verdict(mean=mean, degrees=degrees, runs=len(nees), confidence_level=probability)
    assert verdict.consistent, (mean, verdict.simultaneous_bounds)


# ---------------------------------------------------------------------------------------------------------- slow plain reference


def transition(w: np.ndarray, dt: float, noise: ProcessNoise) -> tuple[np.ndarray, np.ndarray]:
    """Φ and Q of the body-side error by Van Loan's matrix exponential."""
    F = np.zeros((6, 6))
    F[:3, :3], F[:3, 3:] = -kinematics.skew(w), -np.eye(3)
    G = np.diag(np.repeat([noise.angle_random_walk, noise.rate_random_walk], 3))
    return filterpy.common.van_loan_discretization(F, G, dt)


def side(q: np.ndarray) -> np.ndarray:
    """The matrix that takes a body-side error state to the fixed-side one, q_true = exp(δ_f) ⊗ q."""
    T = np.eye(6)
    T[:3, :3] = quaternion.to_matrix(q)
    return T


def on_attitude(J: np.ndarray) -> np.ndarray:
    G = np.eye(6)
    G[:3, :3] = J
    return G


def fixed_side_smoother(record: ImuRecord, noise: ProcessNoise, initial: estimation.State) -> Estimate:
    """Filter and textbook smoother with the *fixed-side* error, by matrices.

    A correction there is a left product and its Jacobians are left ones. So it agrees with the body-side smoother only if both carry
    their covariances from one tangent space to the next, and rightly.
    """
    events = sorted(
        (
            (series.time[i], s, i)
            for s, series in enumerate(record.vectors)
            for i in np.flatnonzero(series.time <= record.time[-1])
        ),
        key=lambda event: event[:2],
    )
    stops = np.unique(np.concatenate([record.time, [event[0] for event in events]]))
    q, b, P = initial.attitude, initial.bias, side(initial.attitude) @ initial.covariance @ side(initial.attitude).T
    filtered, steps, at_edge = [], [], []
    for j, now in enumerate(stops):
        if j > 0:
            k = int(np.searchsorted(record.time, now, side="left")) - 1
            w = record.increments[k] / (record.time[k + 1] - record.time[k]) - b
            dt = now - stops[j - 1]
            after = quaternion.normalize(quaternion.multiply(q, quaternion.exp(w * dt)))
            F, Q = transition(w, dt, noise)
            F, Q = side(after) @ F @ side(q).T, side(after) @ Q @ side(after).T
            q, P = after, F @ P @ F.T + Q
            steps.append((q, b, P, F))
        while events and events[0][0] == now:
            _, s, i = events.pop(0)
            series = record.vectors[s]
            r = series.reference_f / np.linalg.norm(series.reference_f)
            sigma = series.sigma[i] / np.linalg.norm(series.reference_f)
            z = quaternion.rotate(q, series.vector_b[i])  # in the fixed frame
            H = np.zeros((1 if series.kind == "heading" else 2, 6))
            if series.kind == "heading":
                level = z[:2] @ z[:2]  # tilt shifts the heading of a vector that is not level
                H[0, :3] = -z[2] * z[0] / level, -z[2] * z[1] / level, 1.0
                y = np.array([math.atan2(z[0] * r[1] - z[1] * r[0], z[0] * r[0] + z[1] * r[1])])
            else:
                u, v, _ = triad(r)
                H[0, :3], H[1, :3] = -v, u
                y = np.array([u @ z, v @ z]) / np.linalg.norm(series.reference_f)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + sigma**2 * np.eye(len(H)))
            x = K @ y
            P = (np.eye(6) - K @ H) @ P @ (np.eye(6) - K @ H).T + sigma**2 * K @ K.T
            q, b = quaternion.multiply(quaternion.exp(x[:3]), q), b + x[3:]
            G = on_attitude(kinematics.right_jacobian(-x[:3]))
            P = G @ P @ G.T
        filtered.append((q, b, P))
        at_edge.append(now in record.time)
    rows = [filtered[-1]]
    for (q, b, P), (q_pred, b_pred, P_pred, F) in zip(filtered[-2::-1], steps[::-1], strict=True):
        q_next, b_next, P_next = rows[-1]
        a = quaternion.log(quaternion.multiply(q_next, quaternion.conjugate(q_pred)))
        G = np.linalg.inv(on_attitude(kinematics.right_jacobian(-a)))
        C = np.linalg.solve(P_pred, F @ P).T
        x = C @ np.concatenate([a, b_next - b_pred])
        after = P + C @ (G @ P_next @ G.T - P_pred) @ C.T
        G = on_attitude(kinematics.right_jacobian(-x[:3]))
        rows.append((quaternion.multiply(quaternion.exp(x[:3]), q), b + x[3:], G @ after @ G.T))
    kept = [row for row, edge in zip(rows[::-1], at_edge, strict=True) if edge]
    covariance = np.array([side(q).T @ P @ side(q) for q, _, P in kept])
    return Estimate(
        time=record.time,
        attitude=np.array([q for q, _, _ in kept]),
        bias=np.array([b for _, b, _ in kept]),
        variance=np.diagonal(covariance, axis1=1, axis2=2),
        covariance=covariance,
    )


def assert_same(estimate: Estimate, other: Estimate, tolerance: float) -> None:
    """Difference of the states in units of their σ, and of the covariances scaled to correlations, within the tolerance."""
    error = consistency.errors(estimate.attitude, estimate.bias, other.attitude, other.bias)
    assert np.max(np.abs(error) / estimate.sigma) < tolerance
    scale = estimate.sigma[:, :, None] * estimate.sigma[:, None, :]
    assert np.max(np.abs(estimate.covariance - other.covariance) / scale) < tolerance


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in ("rest", "directions") else []) for name in CASES]
)
def test_equals_the_fixed_side_reference(name: str) -> None:
    # A wide prior and a wrong start, so that corrections are tenths of a radian and a missing Jacobian shows in the first digits.
    case = dataclasses.replace(CASES[name], duration=2.0, attitude_sigma=0.2, bias_sigma=0.02)
    record, initial = simulated(case, np.random.default_rng(11))
    smoothed = estimation.smooth(record, case.noise, initial, full_covariance=True)
    assert_same(smoothed, fixed_side_smoother(record, case.noise, initial), 1e-8)


# --------------------------------------------------------------------------------------------------------------------- consistency


@pytest.mark.parametrize(
    ("name", "runs"),
    [(name, 25) for name in ("one direction, turning", "vectors", "asynchronous", "coning")]
    + [pytest.param(name, 2000, marks=pytest.mark.slow) for name in CASES],
)
def test_consistent_and_better_than_the_filter(name: str, runs: int) -> None:
    case, rng = CASES[name], np.random.default_rng(2024)
    nees, squares = [], []
    for _ in range(runs):
        record, initial = simulated(case, rng)
        smoothed = estimation.smooth(record, case.noise, initial, full_covariance=True)
        filtered = estimation.run(record, case.noise, initial)
        epochs = np.linspace(0, len(record.time) - 1, 6).astype(int)
        e, P = errors(smoothed, record.truth), smoothed.covariance
        parts = (slice(0, 6), slice(0, 3), slice(3, 6))
        nees.append([consistency.nees(e[:, s], P[:, s, s])[epochs] for s in parts])
        squares.append([e**2 / filtered.variance, errors(filtered, record.truth) ** 2 / filtered.variance])
    for of_part, degrees in zip(np.swapaxes(nees, 0, 1), (6, 3, 3), strict=True):
        check_consistent(of_part, 0.999, degrees)
    smoothed_square, filtered_square = np.mean(squares, axis=(0, 2, 3))
    assert smoothed_square < 0.8 * filtered_square


# ----------------------------------------------------------------------------------------------------------- never worse, the ends


def test_last_state_is_the_filters_and_without_measurements_each_is() -> None:
    case = CASES["asynchronous"]
    record, initial = simulated(case, np.random.default_rng(7))
    smoothed = estimation.smooth(record, case.noise, initial, full_covariance=True)
    filtered = estimation.run(record, case.noise, initial, full_covariance=True)
    for name in ("attitude", "bias", "variance", "covariance"):
        np.testing.assert_array_equal(getattr(smoothed, name)[-1], getattr(filtered, name)[-1])
    np.testing.assert_array_equal(smoothed.time, filtered.time)
    assert smoothed.skipped == filtered.skipped
    for sensor, innovations in filtered.innovations.items():
        np.testing.assert_array_equal(smoothed.innovations[sensor].whitened, innovations.whitened)
        np.testing.assert_array_equal(smoothed.innovations[sensor].time, innovations.time)
    silent = dataclasses.replace(record, vectors=())
    smoothed = estimation.smooth(silent, case.noise, initial, full_covariance=True)
    assert_same(smoothed, estimation.run(silent, case.noise, initial, full_covariance=True), 1e-8)


def test_large_turns_are_split_into_sub_steps() -> None:
    case = dataclasses.replace(
        CASES["directions"],
        motion=motion.ConstantRate(rate=(1.5, -2.0, 3.0)),
        rate=2.0,
        duration=10.0,
        sensors=(("direction", DOWN, 0.02, (0.7, 0.33)), ("direction", STAR, 0.03, (0.5, 0.5))),
    )
    record, initial = simulated(case, np.random.default_rng(12))
    assert np.all(np.linalg.norm(record.increments, axis=1) > 1.5)
    smoothed = estimation.smooth(record, case.noise, initial, full_covariance=True)
    assert_same(smoothed, fixed_side_smoother(record, case.noise, initial), 1e-9)


def test_a_start_half_way_round_is_survived() -> None:
    # Corrections beyond the range of the kernels' polynomials: no NaN, unit quaternions, right after the filter has converged.
    case = dataclasses.replace(CASES["directions"], attitude_sigma=1.5)
    record, _ = simulated(case, np.random.default_rng(21))
    for angle in (0.6, 1.5, 2.5, 3.1):
        turn = quaternion.exp(angle * np.array([0.48, 0.6, 0.64]))
        initial = estimation.initial_state(
            quaternion.multiply(record.truth.attitude[0], turn), attitude_sigma=1.5, bias_sigma=0.01
        )
        estimate = estimation.smooth(record, case.noise, initial, full_covariance=True)
        assert np.max(np.abs(np.linalg.norm(estimate.attitude, axis=1) - 1.0)) < 1e-12
        assert (
            np.linalg.eigvalsh(estimate.covariance / np.einsum("ki,kj->kij", estimate.sigma, estimate.sigma)).min()
            > 0.0
        )
        if angle < 2.0:
            late = record.time > 10.0
            assert np.all(np.abs(errors(estimate, record.truth)[late]) < 8.0 * estimate.sigma[late])


def filtered_segments(record, noise, initial):
    """Return the segment that starts at each edge, and the filter's segments with the end state."""
    problem = forward.prepared(record, noise, initial, ())
    segments = smoothing.filtered_whole(problem, forward.Options()).segments
    return smoothing.segment_starts(problem, segments), segments


def test_a_bias_that_turns_more_than_the_increments_say() -> None:
    """Steps are cut by the turn without the bias: a still gyro with a large bias takes more segments than its increments suggest."""
    rng = np.random.default_rng(5)
    time = np.arange(41.0)
    series = measure("a", "direction", DOWN, 0.02, time[1:], np.tile(quaternion.IDENTITY, (40, 1)), rng)
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-5)

    record = ImuRecord(time=time, increments=np.zeros((40, 3)), vectors=(series,))
    P = np.diag([1e-4] * 3 + [1e-12] * 3)
    for bias in (0.5, 3.0):
        start = estimation.State(attitude=quaternion.IDENTITY, bias=np.array([0.0, 0.0, bias]), covariance=P)
        smoothed = estimation.smooth(record, noise, start, full_covariance=True)
        known = fixed_side_smoother(record, noise, start)
        assert np.max(quaternion.angle_between(smoothed.attitude, known.attitude)) < 1e-9
        np.testing.assert_allclose(smoothed.bias, known.bias, rtol=0, atol=1e-10)
        np.testing.assert_allclose(smoothed.variance, known.variance, rtol=1e-8)
    with pytest.raises(InputError, match="many rotations in each gyro interval"):
        estimation.smooth(record, noise, dataclasses.replace(start, bias=np.array([0.0, 0.0, 1e4])))


# ------------------------------------------------------------------------------------------------- recoveries, and lost digits

GATE = Gate(recovery=5, restart_bias_sigma=3e-3)
WELL_SEEN = dataclasses.replace(
    CASES["directions"],
    duration=5.0,
    bias_sigma=3e-3,
    sensors=(("direction", DOWN, 0.01, (0.1, 0.04)), ("direction", NORTH, 0.01, (0.1, 0.09))),
)


def far_off(seed: int, sensors: tuple = WELL_SEEN.sensors) -> tuple[ImuRecord, estimation.State]:
    """A record, and a start off by an angle far beyond its σ."""
    rng = np.random.default_rng([6, seed])
    record, initial = simulated(dataclasses.replace(WELL_SEEN, sensors=sensors), rng)
    axis = quaternion.normalize(np.append(rng.standard_normal(3), 0.0))[:3]
    turn = quaternion.exp(rng.uniform(0.5, 3.1) * axis)
    return record, dataclasses.replace(initial, attitude=quaternion.multiply(record.truth.attitude[0], turn))


def with_a_turn(record: ImuRecord, edge: int, turn: np.ndarray) -> ImuRecord:
    """The record with a turn that the gyro did not see at an edge: after it the body's axes are others, q ⊗ turn."""
    back, when = quaternion.conjugate(turn), record.time[edge]

    def after(time: np.ndarray, before: np.ndarray, turned: np.ndarray) -> np.ndarray:
        return np.where((time >= when if time is record.time else time > when)[:, None], turned, before)

    vectors = tuple(
        dataclasses.replace(s, vector_b=after(s.time, s.vector_b, quaternion.rotate(back, s.vector_b)))
        for s in record.vectors
    )
    q, b = record.truth.attitude, record.truth.bias
    truth = Truth(
        attitude=after(record.time, q, quaternion.multiply(q, turn)),
        bias=after(record.time, b, quaternion.rotate(back, b)),
    )
    increments = record.increments.copy()
    increments[edge:] = quaternion.rotate(back, increments[edge:])
    return ImuRecord(time=record.time, increments=increments, vectors=vectors, truth=truth)


def test_a_lost_stretch_is_reported_by_what_was_measured_from_its_beginning_on() -> None:
    record, initial = far_off(1)
    filtered = estimation.run(record, NOISE, initial, gate=GATE, full_covariance=True)
    smoothed = estimation.smooth(record, NOISE, initial, gate=GATE, full_covariance=True)
    (event,) = recoveries(filtered)
    assert smoothed.events == filtered.events
    first, last = np.searchsorted(record.time, [event.start, event.end])
    assert last - first > 10
    assert np.min(np.max(np.abs(errors(filtered, record.truth) / filtered.sigma)[first:last], axis=1)) > 10.0
    assert np.max(np.abs(errors(smoothed, record.truth) / smoothed.sigma)[first:]) < 5.0
    # The end state is the filter's, and what came before the first refusal has not heard of what came after.
    for name in ("attitude", "bias", "covariance"):
        np.testing.assert_array_equal(getattr(smoothed, name)[-1], getattr(filtered, name)[-1])
        np.testing.assert_allclose(getattr(smoothed, name)[0], getattr(filtered, name)[0], rtol=1e-9, atol=1e-15)


def test_of_a_filter_that_is_lost_on_its_way_the_part_before_is_smoothed_too() -> None:
    """A turn in a gap of the gyro's: the sensors are refused from there on."""
    record, _ = far_off(2)
    initial = estimation.initial_state(record.truth.attitude[0], attitude_sigma=0.03, bias_sigma=3e-3)
    middle = 120
    record = with_a_turn(record, middle, quaternion.exp([0.0, 1.2, 0.7]))
    both = estimation.smooth(record, NOISE, initial, gate=GATE, full_covariance=True)
    (event,) = recoveries(both)
    first = int(np.searchsorted(record.time, event.start))
    assert middle <= first < middle + 8
    off = np.abs(errors(both, record.truth) / both.sigma)
    assert np.max(off[:middle]) < 5.0
    assert np.max(off[first:]) < 5.0
    # Before it: the smoother of the record that ends with the first refusal, whose measurement was not processed.
    known = estimation.smooth(records.cut(record, 0, first - 1), NOISE, initial, gate=GATE, full_covariance=True)
    before = {n: getattr(both, n)[:first] for n in ("attitude", "bias", "variance", "covariance")}
    assert_same(known, dataclasses.replace(both, **before), 1e-9)
    ahead = estimation.run(record, NOISE, initial, gate=GATE)
    assert np.all(both.sigma[20:middle] < ahead.sigma[20:middle])


def test_several_recoveries_and_a_record_in_parts() -> None:
    """The second part begins while the filter is lost: what took over then begins with the part at the earliest."""
    record, initial = far_off(1)
    twice = with_a_turn(record, 120, quaternion.exp([0.3, -1.0, 0.5]))
    whole = estimation.smooth(twice, NOISE, initial, gate=GATE, full_covariance=True)
    assert [event.kind for event in whole.events] == ["recovery", "recovery"]
    first, second = np.searchsorted(record.time, [event.start for event in whole.events])
    off = np.max(np.abs(errors(whole, twice.truth) / whole.sigma), axis=1)
    assert np.max(off[first:120]) < 5.0
    assert np.max(off[second:]) < 5.0
    middle = int(np.searchsorted(record.time, whole.events[0].end)) - 8
    _, state = estimation.run_part(records.cut(twice, 0, middle), NOISE, initial, gate=GATE)
    rest = records.cut(twice, middle, len(twice.time) - 1)
    part = estimation.smooth(rest, NOISE, state, gate=GATE, full_covariance=True)
    off = np.max(np.abs(errors(part, rest.truth) / part.sigma), axis=1)
    assert np.max(off[: 120 - middle]) < 5.0
    assert part.events == whole.events


def test_a_candidate_that_is_lost_from_its_start_is_left_behind() -> None:
    """Two sensors that measure at once, with outliers in the first second: a candidate refuses what is measured at its start."""
    sensors = tuple((kind, axis, sigma, (0.1, 0.04)) for kind, axis, sigma, _ in WELL_SEEN.sensors)
    for seed, recovery in ((47, 2), (82, 4), (87, 4)):
        record, initial = far_off(seed, sensors)
        rng = np.random.default_rng([1, seed])
        vectors = []
        for s in record.vectors:
            outliers = (rng.random(len(s.time)) < 0.15) & (s.time < 1.0)
            turned = quaternion.rotate(quaternion.exp(rng.standard_normal((len(s.time), 3))), s.vector_b)
            vectors.append(dataclasses.replace(s, vector_b=np.where(outliers[:, None], turned, s.vector_b)))
        record = dataclasses.replace(record, vectors=tuple(vectors))
        gate = dataclasses.replace(GATE, recovery=recovery)
        smoothed = estimation.smooth(record, NOISE, initial, gate=gate, full_covariance=True)
        (event,) = recoveries(smoothed)
        last = int(np.searchsorted(record.time, event.end))
        assert np.max(np.abs(errors(smoothed, record.truth) / smoothed.sigma)[last:]) < 5.0


@pytest.mark.parametrize("which", [[(2, 1), (2, 0)], [(0, 2, 2), (0, 0, 0), (2, 0, 1)]])
def test_a_recovery_with_the_measurements_at_the_last_edge(which) -> None:
    """Sensors that contradict each other: the candidate that takes over is not the first, or refuses what is measured at its start."""
    turns = quaternion.exp(np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.7, 0.0]]))
    time = np.arange(float(len(which[0])))
    series = tuple(
        VectorMeasurements(sensor=f"s{i}", kind="attitude", time=time, attitude=turns[list(own)], sigma=0.01)
        for i, own in enumerate(which)
    )
    record = ImuRecord(time=time, increments=np.zeros((len(time) - 1, 3)), vectors=series)
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=0.01, bias_sigma=1e-3)
    smoothed, filtered = (
        through(record, NOISE, initial, gate=Gate(recovery=2)) for through in (estimation.smooth, estimation.run)
    )
    assert recoveries(smoothed)[-1].end == time[-1]
    assert np.all(np.isfinite(smoothed.variance))
    np.testing.assert_allclose(smoothed.attitude[-1], filtered.attitude[-1], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(smoothed.variance[-1], filtered.variance[-1], rtol=1e-9)


def test_memory_does_not_grow_with_the_number_of_recoveries() -> None:
    record, initial = simulated(dataclasses.replace(WELL_SEEN, duration=120.0), np.random.default_rng(1))
    peaks = []
    for edges in (range(600, 700, 600), range(1200, 5700, 600)):  # one turn, and eight more
        for edge in edges:
            record = with_a_turn(record, edge, quaternion.exp([0.0, 1.2, 0.7]))
        tracemalloc.start()
        assert len(recoveries(estimation.smooth(record, NOISE, initial, gate=GATE))) == edges[-1] // 600
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]


def nees_of_recoveries(runs: int) -> np.ndarray:
    """In the middle of the lost stretch, at the recovery, and later (runs, 3)."""
    nees = []
    for run in range(runs):
        record, initial = far_off(100 + run)
        both = estimation.smooth(record, NOISE, initial, gate=GATE, full_covariance=True)
        (event,) = recoveries(both)
        first, last = np.searchsorted(record.time, [event.start, event.end])
        rows = [(first + last) // 2, last, 200]
        nees.append(consistency.nees(errors(both, record.truth)[rows], both.covariance[rows]))
    return np.array(nees)


@pytest.mark.parametrize("runs", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_lost_stretches_are_consistent(runs: int) -> None:
    assert_inside(nees_of_recoveries(runs).mean(axis=0) / 6.0, 6, runs, 0.999)


def test_a_measurement_far_more_precise_than_the_start_keeps_its_digits_or_is_refused() -> None:
    """Directions to a microradian, at a start known to a radian: each σ against information summed in 60 digits. A nanoradian is refused.

    The body rests and nothing drives it to speak of, so what is known of any edge is one constant state seen over and over.
    """
    sharp, first = 1e-6, (1.0, 0.1)
    time = np.arange(13) * 0.25
    references = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.6, -0.8, 0.0]])
    series = tuple(exact(f"s{k}", "direction", time[1 + k :: 3], r, sharp) for k, r in enumerate(references))
    record = ImuRecord(time=time, increments=np.zeros((12, 3)), vectors=series)
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=first[0], bias_sigma=first[1])
    noise = ProcessNoise(angle_random_walk=1e-18, rate_random_walk=0.0)
    both = estimation.smooth(record, noise, initial, full_covariance=True)
    finer = dataclasses.replace(
        record, vectors=tuple(dataclasses.replace(direction, sigma=1e-3 * direction.sigma) for direction in series)
    )
    with pytest.raises(InputError, match="times as precise as the state"):
        estimation.smooth(finer, noise, initial)
    with mpmath.workdps(60):
        information = mpmath.diag([1 / mpmath.mpf(first[0]) ** 2] * 3 + [1 / mpmath.mpf(first[1]) ** 2] * 3)
        for k, r in enumerate(references):
            unit = mpmath.matrix(r.tolist()) / mpmath.norm(mpmath.matrix(r.tolist()))
            across = mpmath.eye(3) - unit * unit.T  # uᵀu + vᵀv of the two rows across a direction
            for t in time[1 + k :: 3]:
                F = mpmath.zeros(3, 6)
                for i in range(3):
                    F[i, i], F[i, i + 3] = 1, -mpmath.mpf(float(t))
                information += F.T * across * F / mpmath.mpf(sharp) ** 2
        start = information**-1
        for k in (0, 6, 12):
            F = mpmath.eye(6)
            for i in range(3):
                F[i, i + 3] = -mpmath.mpf(float(time[k]))
            P = F * start * F.T
            sigma = [float(mpmath.sqrt(P[i, i])) for i in range(6)]
            np.testing.assert_allclose(both.sigma[k], sigma, rtol=1e-6)
            np.testing.assert_allclose(
                both.covariance[k] / np.outer(sigma, sigma),
                [[float(P[i, j] / mpmath.sqrt(P[i, i] * P[j, j])) for j in range(6)] for i in range(6)],
                rtol=0,
                atol=1e-6,
            )
    assert both.innovations["s0"].nis.max() < 1e-6
    ahead = estimation.run(record, noise, initial, full_covariance=True)
    np.testing.assert_allclose(both.sigma[-1], ahead.sigma[-1], rtol=1e-6)


# ------------------------------------------------------------------------------------------------------------------------ kernels


@pytest.mark.parametrize("intervals", [1, 2, 3, 7, 8, 9, 16, 17])
def test_any_number_of_segments(intervals: int) -> None:
    # Segments are taken in groups of eight, the last of which may be smaller.
    case = dataclasses.replace(CASES["directions"], attitude_sigma=0.2, bias_sigma=0.02, duration=1.0)
    case = dataclasses.replace(
        case, sensors=(("direction", DOWN, 0.02, (0.06, 0.02)), ("direction", STAR, 0.04, (0.11, 0.07)))
    )
    record, initial = simulated(case, np.random.default_rng(intervals))
    record = records.cut(record, 0, intervals)
    smoothed = estimation.smooth(record, case.noise, initial, full_covariance=True)
    assert_same(smoothed, fixed_side_smoother(record, case.noise, initial), 1e-8)


@pytest.mark.parametrize("angle", [0.3, 0.4, 0.6])
def test_corrections_beyond_the_series(angle: float) -> None:
    # So large that the smoothed state lies outside of the range of the polynomials about the filtered one: both forms in one record.
    case = dataclasses.replace(CASES["directions"], attitude_sigma=0.3, bias_sigma=0.02, duration=1.0)
    record, _ = simulated(case, np.random.default_rng(5))
    turn = quaternion.exp(angle * np.array([0.48, 0.6, 0.64]))
    initial = estimation.initial_state(
        quaternion.multiply(record.truth.attitude[0], turn), attitude_sigma=0.3, bias_sigma=0.02
    )
    smoothed = estimation.smooth(record, case.noise, initial, full_covariance=True)
    filtered = estimation.run(record, case.noise, initial)
    moved = quaternion.log(quaternion.multiply(quaternion.conjugate(filtered.attitude), smoothed.attitude))
    assert (np.linalg.norm(moved, axis=1).max() > LARGEST_ANGLE) == (angle > 0.35)
    assert_same(smoothed, fixed_side_smoother(record, case.noise, initial), 1e-8)


def test_edges_are_found_exactly() -> None:
    # Events on edges, a rounding error beside them, and between; turns that need sub-steps.
    rng = np.random.default_rng(17)
    time = np.cumsum(rng.uniform(0.05, 0.15, 60))
    beside = np.concatenate(
        [time[3:9], np.nextafter(time[10:15], 0.0), np.nextafter(time[20:25], 99.0), rng.uniform(1.0, 5.0, 30)]
    )
    stamps = np.unique(beside)
    series = measure("a", "direction", DOWN, 0.02, stamps, np.tile(quaternion.IDENTITY, (len(stamps), 1)), rng)
    record = ImuRecord(time=time, increments=rng.uniform(-1.0, 1.0, (59, 3)), vectors=(series,))
    noise = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-5)
    initial = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=0.1, bias_sigma=0.01)
    starts, segments = filtered_segments(record, noise, initial)
    filtered = estimation.run(record, noise, initial, full_covariance=True)
    np.testing.assert_array_equal(segments[starts, 4:8], filtered.attitude)
    np.testing.assert_array_equal(covariance_matrices(segments[starts, 11:]), filtered.covariance)
    for _ in range(
        300
    ):  # where a time is less than half the next, their difference is rounded, and the sum need not be the next
        edges = np.cumsum(10.0 ** rng.uniform(-4.0, 0.0, 30))
        events = np.sort(np.exp(rng.uniform(*np.log(edges[[0, -1]]), 10)))
        at = np.sort(np.concatenate([edges, events]))
        indices = np.empty(len(edges), np.int64)
        smoother_loop.locate_edges(edges, events, np.diff(at)[:, None], len(at) - 1, indices)
        np.testing.assert_array_equal(indices, np.searchsorted(at, edges))


# ----------------------------------------------------------------------------------------------------------- sigmas of any magnitude


def linear_sigma(dt, measured, arw, rrw, attitude_sigma, bias_sigma, sigma):
    """σ of angle and bias about one axis at rest at each edge, in 70 digits: Kalman filter and Rauch–Tung–Striebel smoother."""
    with mpmath.workdps(70):
        dt, arw, rrw, sigma = (mpmath.mpf(float(x)) for x in (dt, arw, rrw, sigma))
        F = mpmath.matrix([[1, -dt], [0, 1]])
        Q = mpmath.matrix(
            [[arw**2 * dt + rrw**2 * dt**3 / 3, -(rrw**2) * dt**2 / 2], [-(rrw**2) * dt**2 / 2, rrw**2 * dt]]
        )
        P = mpmath.diag([mpmath.mpf(attitude_sigma) ** 2, mpmath.mpf(bias_sigma) ** 2])
        filtered = []
        for k, is_measured in enumerate(measured):
            P = F * P * F.T + Q if k else P
            P = P - P[:, 0] * P[0, :] / (P[0, 0] + sigma**2) if is_measured else P
            filtered.append(P)
        smoothed = [P]
        for before in reversed(filtered[:-1]):
            ahead = F * before * F.T + Q
            G = before * F.T * ahead**-1
            P = before + G * (P - ahead) * G.T
            smoothed.append(P)
        return np.array([[float(mpmath.sqrt(P[i, i])) for i in range(2)] for P in reversed(smoothed)])


def test_sigmas_of_any_magnitude_are_smoothed_right() -> None:
    """Noise, start and measurements over up to 22 decades; the body rests and is measured alike about each axis."""
    rng = np.random.default_rng(11)
    far, refused = 0, 0
    for _ in range(100):
        (dt, arw, rrw, sigma), n = 10.0 ** rng.uniform([-3, -18, -18, -12], [0, 0, 0, 0]), int(rng.integers(2, 7))
        attitude_sigma, bias_sigma = 10.0 ** rng.uniform([-14, -22], [0, 0.5])
        time, measured = np.arange(n + 1) * dt, rng.random(n + 1) < 0.5
        at = time[measured]
        # Each shows two of three axes.
        series = tuple(exact(str(k), "vector", at, axis, np.sqrt(2.0) * sigma) for k, axis in enumerate(np.eye(3)))
        record = ImuRecord(time=time, increments=np.zeros((n, 3)), vectors=series if len(at) else ())
        noise = ProcessNoise(angle_random_walk=arw, rate_random_walk=rrw)
        start = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=attitude_sigma, bias_sigma=bias_sigma)
        try:
            smoothed = estimation.smooth(record, noise, start)
        except InputError as error:
            assert "no digits left" in str(error)  # noqa: PT017
            too_precise = max(attitude_sigma, bias_sigma * time[-1], arw, rrw) > 1e6 * sigma
            assert too_precise or attitude_sigma < 3e-6 * dt * bias_sigma
            refused += 1
            continue
        right = linear_sigma(dt, measured, arw, rrw, attitude_sigma, bias_sigma, sigma)
        np.testing.assert_allclose(smoothed.sigma, np.repeat(right, 3, axis=1), rtol=1e-3)
        assert np.isfinite(smoothed.attitude).all()
        far += right[:, 0].max() > 1e6 * right[:, 0].min()
    assert far > 10
    assert refused < 15


def test_an_attitude_known_far_better_than_the_noise_of_a_step_stays() -> None:
    """Known to 1e-9 rad, noise of 1e-3, then a milliradian measured: the first attitude moves by 1e-12 of it, the last by nearly all."""
    turn = quaternion.exp([0.0, 0.0, 1e-3])
    time = np.array([0.0, 1.0])
    series = tuple(
        dataclasses.replace(vector, vector_b=quaternion.rotate(quaternion.conjugate(turn), vector.vector_b))
        for vector in (exact(str(k), "vector", time[1:], axis, 1e-6) for k, axis in enumerate(np.eye(3)))
    )
    record = ImuRecord(time=time, increments=np.zeros((1, 3)), vectors=series)
    start = estimation.initial_state(quaternion.IDENTITY, attitude_sigma=1e-9, bias_sigma=1e-9)
    smoothed = estimation.smooth(record, ProcessNoise(angle_random_walk=1e-3, rate_random_walk=0.0), start)
    off = 2.0 * smoothed.attitude[:, 3]
    assert abs(off[0]) < 1e-14
    assert off[1] == pytest.approx(1e-3, rel=1e-5)


def test_a_filter_that_diverges_is_an_error() -> None:
    """From a start off by a radian under measurements to a picoradian."""
    time, rate = np.arange(41) * 1e-3, np.array([0.1, -0.2, 0.3])
    at = time[3::4]
    series = exact("field", "vector", at, DOWN, 1e-12, quaternion.exp(at[:, None] * rate))
    record = ImuRecord(time=time, increments=np.tile(1e-3 * rate, (40, 1)), vectors=(series,))
    off = quaternion.exp(0.6 * np.random.default_rng(21).standard_normal(3))
    initial = estimation.initial_state(off, attitude_sigma=1.7, bias_sigma=0.04)
    noise = ProcessNoise(angle_random_walk=1e-16, rate_random_walk=1e-15)
    with pytest.raises(InputError, match="times as precise as the state"):  # before it diverges
        estimation.smooth(record, noise, initial)
