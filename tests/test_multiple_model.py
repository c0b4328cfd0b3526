"""The bank of hypotheses: any start, one vector at a time; consistent once it is one; and no attitude where none can be known."""

import dataclasses

import numpy as np
import pytest
from measured import assert_inside, errors, in_body, resting, series_of, turn_to, unit
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from strapdown import consistency, estimation, quaternion, records, scenarios
from strapdown.estimation import forward, multiple_model
from strapdown.estimation.states import ProcessNoise
from strapdown.motion import ConstantRate
from strapdown.records import Estimate, ImuRecord
from strapdown.units import DEGREE, DEGREE_PER_HOUR
from strapdown.vectors import VectorMeasurements, wahba

QUIET = ProcessNoise(angle_random_walk=1e-7, rate_random_walk=1e-10)


def still(attitude, references, sigma, random, *, seconds=20, phases=None):
    """A body at rest, directions once a second, each sensor at its own phase."""
    time = np.arange(seconds + 1.0)
    vectors = []
    for k, reference in enumerate(references):
        r = np.asarray(reference) / np.linalg.norm(reference)
        at = time[:-1] + (0.0 if phases is None else phases[k])
        noisy = in_body(attitude, r) + sigma * random.standard_normal((len(at), 3))
        vectors.append(series_of(f"star {k}", "direction", at, unit(noisy), r, sigma))
    return ImuRecord(time=time, increments=np.zeros((seconds, 3)), vectors=tuple(vectors))


def orbit(run, *, duration=1500.0, seed=11, **changes):
    """One run of the magnetometer alone, its attitude turned at random, and a right filter's model of its gyro."""
    scenario = dataclasses.replace(scenarios.load_scenario("magnetometer-only"), duration=duration, **changes)
    random = np.random.default_rng([seed, run])
    q = quaternion.normalize(random.standard_normal(4))
    scenario = dataclasses.replace(scenario, motion=dataclasses.replace(scenario.motion, initial_attitude=q))
    gyro = scenario.gyro
    belief = ProcessNoise(angle_random_walk=gyro.angle_random_walk, rate_random_walk=gyro.rate_random_walk)
    return scenarios.simulate(scenario, seed, run), belief


def judged(bank, record):
    e = errors(bank.estimate, record.truth.taken(np.isin(record.time, bank.estimate.time)))
    return e, consistency.nees(e, bank.estimate.covariance)


def tracker(time, attitude, sigma):
    """Measured attitudes, one for all times or one each."""
    attitude = np.broadcast_to(attitude, (len(time), 4))
    return VectorMeasurements(
        sensor="tracker",
        kind="attitude",
        time=time,
        attitude=attitude,
        sigma_axes=np.broadcast_to(sigma, 3).astype(float),
    )


def goes_on(bank, row, record, process, **options):
    """The filter alone from a row of the bank on, over what the record holds after it."""
    estimate, edge = bank.estimate, int(np.searchsorted(record.time, bank.estimate.time[row]))
    start = estimation.State(
        attitude=estimate.attitude[row], bias=estimate.bias[row], covariance=estimate.covariance[row]
    )
    rest = records.cut(record, edge, len(record.time) - 1)
    rest = dataclasses.replace(rest, vectors=tuple(s.taken(s.time > record.time[edge]) for s in rest.vectors))
    return estimation.run(rest, process, start, full_covariance=True, **options)


# ------------------------------------------------------------------------------------------------------------------ the circle


def test_the_hypotheses_lie_evenly_on_the_circle_that_the_first_direction_leaves():
    """The tilt has the noise of the direction: an error n of the direction z shows as a rotation z × n."""
    record = still(np.array([0.5, 0.5, -0.5, 0.5]), [[0.3, -0.2, 0.9]], 1e-3, np.random.default_rng(1))
    C = np.array([[1.0, 0.2, 0.1], [0.2, 2.0, 0.4], [0.1, 0.4, 3.0]]) * 1e-6
    series = dataclasses.replace(record.vectors[0], sigma=np.zeros(20), covariance=C)
    initial = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=1e-4)
    events = forward.prepared(dataclasses.replace(record, vectors=(series,)), QUIET, initial, ()).events
    states = multiple_model.start(events, 0, initial, 24)
    z, r, q = series.vector_b[0], series.reference_f, np.array([state.attitude for state in states])
    assert np.allclose(quaternion.rotate(q, np.broadcast_to(z, (24, 3))), r, atol=1e-14)
    turn = turn_to(q, np.roll(q, -1, axis=0))
    assert np.allclose(np.abs(turn @ z), 2.0 * np.pi / 24, atol=1e-12)
    assert np.allclose(np.linalg.norm(turn, axis=1), 2.0 * np.pi / 24, atol=1e-12)
    P = states[3].covariance
    assert z @ P[:3, :3] @ z == pytest.approx((np.pi / 24) ** 2)
    for axis in np.eye(3):
        t = unit(np.cross(axis, z))
        arm = np.cross(t, z)
        assert t @ P[:3, :3] @ t == pytest.approx(arm @ C @ arm, rel=1e-9)
    assert np.allclose(P[3:, 3:], 1e-8 * np.eye(3))
    assert not P[:3, 3:].any()


# ----------------------------------------------------------------------------------------------------------------- the mixture


@pytest.mark.parametrize("decades", [0.0, 3.0, 6.0])
def test_the_share_of_differences_is_a_trace(decades):
    random = np.random.default_rng(3)
    axes = Rotation.random(20, rng=random).as_matrix()
    T = axes @ np.diag(10.0 ** np.array([0.0, -decades, -decades])) ** 2 @ np.swapaxes(axes, 1, 2)
    z = random.standard_normal((20, 3))
    d = (np.linalg.cholesky(T) @ z[..., None])[..., 0]
    shares = multiple_model.share(T, np.einsum("ki,kj->kij", d, d), slice(3))
    np.testing.assert_allclose(shares, np.sum(z * z, axis=1), rtol=10.0 ** (2.0 * decades - 14.0) + 1e-10)


def test_moments_are_those_of_draws_from_the_mixture():
    random = np.random.default_rng(5)
    centre = quaternion.normalize(random.standard_normal(4))
    q = quaternion.multiply(centre, quaternion.exp(0.4 * random.standard_normal((5, 3))))
    bias, weights = 1e-5 * random.standard_normal((5, 3)), random.random(5)
    root = np.diag([1e-2] * 3 + [1e-5] * 3) @ random.standard_normal((5, 6, 6))
    weights /= weights.sum()
    P = root @ np.swapaxes(root, 1, 2)
    members = [Estimate.from_arrays([0.0], [q[i]], [P[i]], bias=[bias[i]]) for i in range(5)]
    (mean,), (mean_bias,), total, between = multiple_model.mixture(members, np.array([0]), weights[:, None])
    number = 200_000
    which = random.choice(5, number, p=weights)
    drawn = np.einsum("nij,nj->ni", np.linalg.cholesky(P)[which], random.standard_normal((number, 6)))
    attitude = quaternion.multiply(q[which], quaternion.exp(drawn[:, :3]))
    e = consistency.errors(mean, mean_bias, attitude, bias[which] + drawn[:, 3:])
    sigma = np.sqrt(np.diag(total[0]))
    assert np.abs(e.mean(axis=0) / sigma).max() < 4.0 / np.sqrt(number) + 1e-3  # the mean attitude's own second order
    assert np.abs((e.T @ e / number - total[0]) / np.outer(sigma, sigma)).max() < 0.01
    inside = np.einsum("n,nij->ij", weights, P)
    assert np.abs((total - between - inside) / np.outer(sigma, sigma)).max() < 0.02
    alone = multiple_model.mixture([members[0]] * 4, np.array([0]), np.full((4, 1), 0.25))
    for moment, wanted in zip(alone, (q[0], bias[0], P[0], np.zeros((6, 6))), strict=True):
        np.testing.assert_allclose(moment[0], wanted, rtol=1e-12, atol=1e-16)


def test_likelihoods_are_the_densities_of_the_measurement():
    """Of one attitude, one surer than the other: what counts is N(e; 0, S), its height and not its exponent alone."""
    record = still(np.array([1.0, 0.0, 0.0, 0.0]), [[0.0, 0.0, 1.0]], 1e-3, np.random.default_rng(10), seconds=1)
    z, densities, likelihoods = record.vectors[0].vector_b[0], [], []
    for s in (1e-3, 5e-3):
        P = np.diag([s**2, (2.0 * s) ** 2, s**2, 1e-12, 1e-12, 1e-12])
        state = estimation.State(attitude=[1.0, 0.0, 0.0, 0.0], bias=np.zeros(3), covariance=P)
        problem = forward.prepared(record, QUIET, state, ())
        estimate = forward.filtered(problem, forward.Options()).estimate
        likelihoods += [np.exp(multiple_model.log_likelihood(problem, estimate, record.time))]
        densities += [multivariate_normal.pdf(z[:2], cov=np.diag([P[1, 1], P[0, 0]]) + 1e-6 * np.eye(2))]
    for likelihood in np.transpose(likelihoods):
        assert np.allclose(likelihood / np.sum(likelihood), np.array(densities) / np.sum(densities), rtol=1e-4)


def starts(runs, hypotheses, **options):
    outcomes = []
    for run in range(runs):
        record, belief = orbit(run, **options)
        bank = multiple_model.run(record, belief, hypotheses=hypotheses, every=10)
        outcomes.append((bank, *judged(bank, record)))
    return outcomes


def check_starts(outcomes, epochs):
    runs = len(outcomes)
    time = outcomes[0][0].estimate.time
    settled = np.array([bank.became_one for bank, _, _ in outcomes])
    assert np.median(settled) < 500.0
    assert np.mean(np.isfinite(settled)) > 0.9
    assert all(bank.converged == (not bank.reason) for bank, _, _ in outcomes)
    last = np.array([np.linalg.norm(e[-1, :3]) for _, e, _ in outcomes])
    assert last.max() < 1.0 * DEGREE
    for seconds in epochs:
        k = int(np.searchsorted(time, seconds))
        mean = np.mean([nees[k] for _, _, nees in outcomes]) / 6.0
        low, high = consistency.mean_bounds(6, runs, 1.0 - 0.01 / len(epochs))
        assert low < mean < high, f"{mean:.3f} at {seconds} s, bounds {low:.3f} to {high:.3f}"
    total, number = 0.0, 0
    for bank, _, _ in outcomes:  # until they are one, the innovations are those of one hypothesis of many
        innovations = bank.estimate.innovations["magnetometer"]
        after = innovations.time > bank.became_one
        total, number = total + innovations.nis[after].sum(), number + innovations.innovation[after].size
    assert_inside(total / number, 1, number)


def test_from_starts_anywhere_it_finds_the_attitude_and_is_consistent():
    check_starts(starts(10, multiple_model.HYPOTHESES), (60.0, 200.0, 400.0, 800.0, 1490.0))


@pytest.mark.slow
def test_from_a_thousand_starts_over_an_orbit_and_a_half():
    outcomes = starts(1000, multiple_model.HYPOTHESES, duration=9000.0)
    check_starts(outcomes, (60.0, 200.0, 400.0, 800.0, 1500.0, 3000.0, 6000.0, 8990.0))
    hours = []
    for bank, e, _ in outcomes:
        above = np.flatnonzero(np.linalg.norm(e[:, :3], axis=1) > 1.0 * DEGREE)
        hours.append(bank.estimate.time[above[-1] + 1] / 3600.0)
    assert np.quantile(hours, 0.99) < 0.2  # what the study found a bank of 24 to take


def test_before_it_is_one_its_gaussian_is_no_narrower_than_the_mixture():
    record, belief = orbit(2, duration=300.0)
    bank = multiple_model.run(record, belief)
    P = bank.estimate.covariance
    assert np.sqrt(np.linalg.eigvalsh(P[0, :3, :3])[-1]) == pytest.approx(np.pi / np.sqrt(3.0), rel=0.03)  # uniform
    assert np.allclose(bank.weights[0], 1.0 / multiple_model.HYPOTHESES)
    assert np.allclose(bank.weights.sum(axis=1), 1.0)


@pytest.mark.parametrize("rate", [np.zeros(3), np.array([0.02, -0.01, 0.03])])
def test_a_constant_reference_leaves_the_turn_about_it_open_and_it_says_so(rate):
    scenario = scenarios.load_scenario("magnetometer-only")
    field = np.array([2e-5, 0.0, 2e-5])
    sensor = dataclasses.replace(scenario.sensors[0], field_f=field, rate=1.0)
    scenario = dataclasses.replace(scenario, sensors=(sensor,), motion=ConstantRate(rate=rate), duration=600.0)
    record = scenarios.simulate(scenario, 4)
    bank = multiple_model.run(record, ProcessNoise(angle_random_walk=1e-5, rate_random_walk=1e-8), hypotheses=24)
    assert not bank.converged
    assert np.sum(bank.weights[-1] > 0.0) == 24
    assert bank.became_one == np.inf
    assert "cannot be observed" in bank.reason
    assert "(+0.71, -0.00, +0.71)" in bank.reason or "(+0.71, +0.00, +0.71)" in bank.reason
    assert np.allclose(bank.weights[-1], 1.0 / 24, atol=1e-6)
    widest = np.sqrt(np.linalg.eigvalsh(bank.estimate.covariance[:, :3, :3])[:, -1])
    # Nothing is learnt that cannot be known, but for the second order of the tilt.
    assert np.all(widest >= widest[0] * (1.0 - 1e-3))
    e, _ = judged(bank, record)
    across = quaternion.rotate(record.truth.attitude[-1], e[-1, :3])
    assert np.linalg.norm(np.cross(across, field / np.linalg.norm(field))) < 0.02  # all but the turn is known


def test_a_reference_that_turned_too_little_is_reported():
    record, belief = orbit(5, duration=60.0)
    bank = multiple_model.run(record, belief, hypotheses=48)
    assert not bank.converged
    assert "record longer" in bank.reason


@pytest.mark.parametrize("phases", [(0.0, 0.0, 0.0), (0.0, 0.3, 0.7)])
def test_with_full_geometry_it_agrees_with_wahba(phases):
    random = np.random.default_rng(9)
    references = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.3], [0.2, -0.4, 1.0]])
    sigma = 0.2 * DEGREE
    for _ in range(4):
        q = quaternion.normalize(random.standard_normal(4))
        record = still(q, references, sigma, random, seconds=2, phases=phases)
        bank = multiple_model.run(record, QUIET, bias_sigma=1e-9)
        row = 0 if phases[1] == 0.0 else 1  # the first edge after all three have measured once
        used = [series.vector_b[0] for series in record.vectors]
        r = references
        if row == 1:  # the first sensor measures at that edge again
            used, r = [*used, record.vectors[0].vector_b[1]], np.concatenate([references, references[:1]])
        solution = wahba.solve(np.array(used), r, sigma)
        apart = turn_to(solution.attitude, bank.estimate.attitude[row])
        root = np.linalg.cholesky(solution.covariance)
        assert np.linalg.norm(np.linalg.solve(root, apart)) < 0.05
        assert np.allclose(bank.estimate.covariance[row, :3, :3], solution.covariance, rtol=0.05, atol=0.05 * sigma**2)
        assert bank.converged


# ---------------------------------------------------------------------------------------------------------------- from one to the next


def test_it_goes_on_as_the_filter_once_it_is_one():
    record, belief = orbit(3)
    bank = multiple_model.run(record, belief, every=10)
    assert bank.converged
    k = int(np.searchsorted(bank.estimate.time, bank.became_one))
    assert bank.estimate.time[k] == bank.became_one
    assert len(bank.weights) == k + 1
    assert bank.estimate.time[-1] == record.time[-1]
    single = goes_on(bank, k, record, belief, every=10)
    assert np.array_equal(single.attitude, bank.estimate.attitude[k:])
    # The first measurement made the hypotheses.
    assert np.array_equal(bank.estimate.innovations["magnetometer"].time, record.vectors[0].time[1:])


# --------------------------------------------------------------------------------------------------------------------- the rim


def test_whole_vectors_count_by_their_direction():
    record, belief = orbit(6, duration=600.0)
    series = record.vectors[0]
    field = scenarios.load_scenario("magnetometer-only").sensors[0].field_f(series.time)
    length = np.linalg.norm(field, axis=1)
    whole = dataclasses.replace(
        series,
        kind="vector",
        vector_b=series.vector_b * length[:, None],
        reference_f=field,
        sigma=series.sigma * length,
    )
    a, b = (
        multiple_model.run(dataclasses.replace(record, vectors=(series,)), belief, every=10, hypotheses=24)
        for series in (series, whole)
    )
    assert quaternion.angle_between(a.estimate.attitude, b.estimate.attitude).max() < 1e-7
    assert b.estimate.innovations["magnetometer"].innovation.shape[1] == 3
    assert np.allclose(b.estimate.innovations["magnetometer"].innovation[-20:, 2], 0.0, atol=1e-4)


def test_a_measured_attitude_needs_no_bank_and_counts_once():
    time, q, sigma = np.arange(11.0), quaternion.exp(np.array([0.3, 0.2, -0.5])), np.array([1e-4, 1e-4, 1e-3])
    star = series_of("star", "direction", [0.0], [in_body(q, [0.0, 0.6, 0.8])], [0.0, 0.6, 0.8], 1e-3)
    record = resting(tracker(time, q, sigma), star, time=time)
    bank = multiple_model.run(record, QUIET, bias_sigma=1e-4)
    assert bank.became_one == 0.0
    assert quaternion.angle_between(bank.estimate.attitude, q).max() < 1e-12
    np.testing.assert_array_equal(bank.estimate.innovations["tracker"].time, time[1:])
    start = estimation.State(attitude=q, bias=np.zeros(3), covariance=np.diag([*sigma**2, *[1e-8] * 3]))
    rest = dataclasses.replace(record, vectors=(record.vectors[0].taken(time > 0.0), star))
    single = estimation.run(rest, QUIET, start, full_covariance=True)
    np.testing.assert_allclose(bank.estimate.covariance, single.covariance, rtol=1e-12, atol=1e-20)


def test_it_starts_at_the_first_direction_and_counts_what_came_before():
    record, belief = orbit(7, duration=600.0)
    series = record.vectors[0]
    gap = dataclasses.replace(
        series, vector_b=np.where(np.arange(len(series.time))[:, None] < 3, np.nan, series.vector_b)
    )
    compass = series_of("compass", "heading", [5.0, 17.0], np.tile([1.0, 0.0, 0.0], (2, 1)), [1.0, 0.0, 0.0], 9.0)
    bank = multiple_model.run(dataclasses.replace(record, vectors=(gap, compass)), belief, every=7)
    assert bank.estimate.skipped == {"magnetometer": 3, "compass": 2}
    assert bank.estimate.time[0] == 42.0  # the first kept edge not before 40 s
    assert np.array_equal(bank.estimate.time, record.time[42::7])
    e, _ = judged(bank, record)
    assert np.linalg.norm(e[-1, :3]) < 5.0 * DEGREE


def test_one_direction_between_edges_starts_there():
    q = quaternion.exp(np.array([0.1, 0.7, -0.3]))
    rate = np.array([0.2, 0.1, -0.3])
    time = np.arange(9.0)
    at = np.array([0.4, 1.7, 2.3, 3.6, 4.1])
    references = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [0.0, 0.6, 0.8]])
    attitude = quaternion.multiply(q, quaternion.exp(at[:, None] * rate))
    measured = quaternion.rotate(quaternion.conjugate(attitude), references)
    star = series_of("star", "direction", at, measured, references, 1e-4)
    record = ImuRecord(time=time, increments=np.tile(rate, (8, 1)), vectors=(star,))
    bank = multiple_model.run(record, QUIET, bias_sigma=1e-8)
    assert bank.estimate.time[0] == 1.0
    truth = quaternion.multiply(q, quaternion.exp(bank.estimate.time[:, None] * rate))
    assert quaternion.angle_between(bank.estimate.attitude, truth)[1:].max() < 1e-4


@pytest.mark.parametrize("duration", [60.0, 1500.0], ids=["many", "one"])
def test_gaps_of_the_gyro_are_reported_whether_hypotheses_were_many_or_one(duration):
    record, belief = orbit(3, duration=duration)
    edges = len(record.time)
    early, late = edges // 3, edges - edges // 6
    later = np.where(np.arange(edges) > early, 8.0, 0.0) + np.where(np.arange(edges) > late, 9.0, 0.0)
    gaps = dataclasses.replace(record, time=record.time + later)
    bank = multiple_model.run(gaps, belief, every=5, hypotheses=48)
    assert bank.converged == (duration > 60.0)
    assert bank.estimate.events == tuple(estimation.gaps(gaps))
    assert [(event.start, event.end) for event in bank.estimate.events] == [
        (gaps.time[k], gaps.time[k + 1]) for k in (early, late)
    ]
    assert multiple_model.run(record, belief, every=5, hypotheses=48).estimate.events == ()


def test_the_bias_is_found_from_twenty_degrees_an_hour():
    record, belief = orbit(9, duration=9000.0)
    bank = multiple_model.run(record, belief, every=100, hypotheses=48)
    e, _ = judged(bank, record)
    assert np.abs(record.truth.bias[0]).max() > 5.0 * DEGREE_PER_HOUR
    assert np.abs(e[-1, 3:]).max() < 0.1 * DEGREE_PER_HOUR
