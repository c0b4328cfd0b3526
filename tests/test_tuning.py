"""Tuning: the likelihood and its derivatives against independent filters, the search, what is identified, what is held out."""

import dataclasses
import math
import pickle
import types

import mpmath
import numpy as np
import pytest
import scipy.signal
import two_stars
from measured import series_of
from scipy.optimize import brentq
from two_stars import (
    ANGLES,
    ARW,
    BELIEVED,
    FREE,
    KINDS,
    RRW,
    angle_case,
    case,
    differences,
    every_kind,
    minus_log,
    scenario,
)

import strapdown as sd
from strapdown import consistency, gyro, quaternion, scenarios, tuning
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import States
from strapdown.estimation.states import ProcessNoise
from strapdown.kernels import likelihood
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.series import LARGEST_ANGLE
from strapdown.records import ImuRecord
from strapdown.tuning import fitting, innovations, parameters
from strapdown.vectors import VectorMeasurements

SENSORS = ("sun.sigma", "up.sigma", "north.sigma", "tracker.sigma")
ALL = ("gyro.arw", "gyro.rrw", *SENSORS, "initial.attitude", "initial.bias")


def plain(record: ImuRecord, filter_setup: FilterSetup, attitude: np.ndarray, bias: np.ndarray) -> float:
    """Minus the log likelihood, without its constant, by one ordinary run of the filter."""
    return minus_log(setup.run(record, filter_setup, setup.initial_state(filter_setup, attitude, bias)))


# ------------------------------------------------------------------------------------------------------ likelihood


def test_every_lane_is_the_filter_itself():
    record = every_kind()
    start = tuning.record_case(record, KINDS, seed=3)
    # Where the initial σ are free they are the setup's, not the case's.
    wide = dataclasses.replace(start.initial, covariance=4.0 * start.initial.covariance)
    start = dataclasses.replace(start, initial=wide)
    objective = tuning.likelihood([start], KINDS, ALL)
    points = objective.start + np.random.default_rng(1).uniform(-1.5, 1.5, (11, len(ALL)))
    expected = [plain(record, objective.setup(point), start.initial.attitude, start.initial.bias) for point in points]
    np.testing.assert_allclose(objective.minus_log(points), expected, rtol=1e-10)


def test_a_common_scale_takes_a_start_whose_attitude_and_bias_are_correlated_as_a_whole():
    record = every_kind()
    initial = tuning.record_case(record, KINDS, seed=3).initial
    sigma = np.sqrt(np.diag(initial.covariance))
    correlated = (np.eye(6) + 0.9 * (np.eye(6, k=3) + np.eye(6, k=-3))) * np.outer(sigma, sigma)
    initial = dataclasses.replace(initial, covariance=correlated)
    objective = tuning.likelihood([tuning.Case(record=record, initial=initial)], KINDS, (parameters.SCALE,))
    points = objective.start + np.array([[-1.0], [0.0], [0.7]])
    for point, value in zip(points, objective.minus_log(points), strict=True):
        scaled = dataclasses.replace(initial, covariance=np.exp(2.0 * point) * correlated)
        expected = minus_log(setup.run(record, objective.setup(point), scaled))
        assert value == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("bias_sigma", [1e-2, 3.0, 60.0], ids=["right", "wild", "wilder"])
def test_a_start_that_makes_the_bias_wild_is_cut_into_sub_steps_as_by_the_filter(bias_sigma):
    """A bias of tens of rad/s turns the body, step by step, beyond the range of the polynomials, though its gyro hardly turns."""
    time = 0.3 * np.arange(21)
    stamps = np.concatenate([[0.1], time[2:]])
    # The first attitude is nearly half a turn off: where little is known of the bias, the bias is blamed.
    attitude = quaternion.exp(np.where(stamps == 0.1, 2.8, 0.0)[:, None] * np.array([0.6, 0.0, 0.8]))
    tracker = VectorMeasurements(
        sensor="tracker", kind="attitude", time=stamps, attitude=attitude, sigma_axes=np.full(3, 1e-2)
    )
    record = ImuRecord(time=time, increments=np.full((20, 3), 1e-3), vectors=(tracker,))
    filter_setup = FilterSetup(
        process_noise=ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-3),
        attitude_sigma=1e-2,
        bias_sigma=bias_sigma,
    )
    initial = setup.initial_state(filter_setup, np.array([1.0, 0.0, 0.0, 0.0]))
    wild = np.abs(setup.run(record, filter_setup, initial).bias).max()
    assert (wild * 0.3 > 10.0 * LARGEST_ANGLE) == (bias_sigma > 1.0)
    objective = tuning.likelihood(
        [tuning.Case(record=record, initial=initial)], filter_setup, ("gyro.arw", "tracker.sigma", "initial.bias")
    )
    points = objective.start + np.random.default_rng(1).uniform(-0.5, 0.5, (8, 3))
    expected = [plain(record, objective.setup(point), initial.attitude, initial.bias) for point in points]
    np.testing.assert_allclose(objective.minus_log(points), expected, rtol=1e-9)
    # Outliers no larger than the others are none.
    mixed = tuning.contaminated_likelihood([tuning.Case(record=record, initial=initial)], filter_setup, objective.names)
    none = np.column_stack([points, np.full(8, np.log(0.05)), np.zeros(8)])
    np.testing.assert_allclose(mixed.minus_log(none), expected, rtol=1e-9)


def test_a_lane_that_no_sub_steps_mend_cuts_no_step_of_the_others():
    x = np.zeros((2, 7 * WIDTH))
    filters = types.SimpleNamespace(x=x, model=types.SimpleNamespace(limit=math.inf))
    body = types.SimpleNamespace(filters=filters, room=np.empty(likelihood.ROOM))
    theta, b = (0.1, 0.2, 0.0), x[0, 4 * WIDTH :].reshape(3, WIDTH)

    def longest(part=theta):
        return likelihood.longest_step((0, 0), part, 0.5, body)

    assert longest() == 0.5
    # Of one lane increment and bias turn by half the range each, and by a little more.
    along = 0.5 * LARGEST_ANGLE * np.array([0.6, 0.0, 0.8])
    b[:, 3] = -along / 0.5
    assert longest(tuple(along * (1.0 - 1e-9))) == 0.5
    assert longest(tuple(along * (1.0 + 1e-9))) == pytest.approx(0.5 * (1.0 - 0.5e-9), rel=1e-12)
    assert longest(tuple(3.0 * along)) == pytest.approx(0.25, rel=1e-12)
    b[:, 3] *= 3.0
    assert longest(tuple(along)) == pytest.approx(0.25, rel=1e-12)
    # The bias turns the fourth lane by 2 rad; two others are lost.
    b[:, 3], b[1, 3], b[1, 5], b[1, 6] = 0.0, 4.0, 1e9, np.nan
    assert longest() == pytest.approx(0.5 * LARGEST_ANGLE / np.hypot(0.1, 0.2 - 2.0))
    b[1, 3] = 0.0
    assert longest() == 0.5


def test_several_records_add_up_on_any_number_of_threads():
    cases = [case(seed) for seed in range(3)]
    alone = [tuning.likelihood([simulated_case], BELIEVED, FREE) for simulated_case in cases]
    together = tuning.likelihood(cases, BELIEVED, FREE, threads=2)
    point = together.start + 0.1
    assert together.minus_log(point)[0] == pytest.approx(
        sum(objective.minus_log(point)[0] for objective in alone), rel=1e-13
    )
    sums = [objective.derivatives(point) for objective in alone]
    derivatives = together.derivatives(point)
    # The last bit of the point is another, and differences make much of it.
    np.testing.assert_allclose(derivatives.score.sum(axis=0), sum(part.score.sum(axis=0) for part in sums), rtol=1e-5)
    np.testing.assert_allclose(derivatives.information, sum(part.information for part in sums), rtol=1e-5, atol=1e-5)


def linear_likelihood(white, walk, sigma, first, drift, increments, angles, dt=0.5):
    """Minus the log likelihood of a plain Kalman filter of (angle, bias), one axis after the other, in any arithmetic."""
    total = 0
    for axis in range(3):
        angle, bias = 0, 0
        p11, p12, p22 = first**2, 0 * first, drift**2
        for k in range(len(increments)):
            angle = angle + float(increments[k, axis]) - dt * bias
            p11, p12, p22 = (
                p11 - 2 * dt * p12 + dt**2 * p22 + white**2 * dt + walk**2 * dt**3 / 3,
                p12 - dt * p22 - walk**2 * dt**2 / 2,
                p22 + walk**2 * dt,
            )
            e, s = float(angles[k, axis]) - angle, p11 + sigma**2
            total = total + (mpmath.log(s) + e * e / s) / 2
            gain, drive = p11 / s, p12 / s
            angle, bias = angle + gain * e, bias + drive * e
            p11, p12, p22 = p11 - gain * p11, p12 - gain * p12, p22 - drive * p12
    return total


def test_in_the_linear_case_it_is_the_kalman_filter_with_its_derivatives_to_many_digits():
    linear_case, increments, angles = angle_case(40)
    names = ("gyro.arw", "gyro.rrw", "tracker.sigma", "initial.attitude", "initial.bias")
    objective = tuning.likelihood([linear_case], ANGLES, names)
    derivatives = objective.derivatives(objective.start)
    with mpmath.workdps(40):
        values = [mpmath.mpf(float(x)) for x in objective.start]

        def exact(*logs):
            return linear_likelihood(*(mpmath.exp(x) for x in logs), increments, angles)

        assert derivatives.value.sum() == pytest.approx(float(exact(*values)), rel=1e-8)
        for j in range(len(names)):
            order = tuple(1 if k == j else 0 for k in range(len(names)))
            # The difference is wrong by half a step of the curvature, which is of the size of the information.
            expected = float(mpmath.diff(exact, tuple(values), order))
            assert derivatives.score.sum(axis=0)[j] == pytest.approx(
                expected, abs=2.0 * innovations.STEP * max(derivatives.information[j, j], abs(expected), 1.0)
            )


@pytest.mark.parametrize("free", [ALL, ("filter.scale",)], ids=["eight", "scale"])
def test_the_gradient_is_that_of_the_likelihood(free):
    start = tuning.record_case(every_kind(), KINDS, seed=3)
    objective = tuning.likelihood([start], KINDS, free)
    point = objective.start + 0.2
    derivatives = objective.derivatives(point)
    expected = differences(lambda x: objective.minus_log(x)[0], point)
    np.testing.assert_allclose(
        derivatives.score.sum(axis=0),
        expected,
        atol=2.0 * innovations.STEP * np.abs(derivatives.information).max() + 1e-6,
    )
    assert derivatives.value.sum() == pytest.approx(objective.minus_log(point)[0], rel=1e-13)
    assert np.linalg.eigvalsh(derivatives.information).min() >= -1e-9
    np.testing.assert_allclose(derivatives.information, derivatives.information.T)


def test_pairs_of_parameters_from_several_passes_are_those_of_one():
    start = tuning.record_case(every_kind(), KINDS, seed=3)
    whole = tuning.likelihood([start], KINDS, ALL)
    few = tuning.likelihood([start], KINDS, ALL[2:6])
    many = whole.derivatives(whole.start)
    expected = few.derivatives(few.start)
    np.testing.assert_allclose(many.information[2:6, 2:6], expected.information, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(many.score[:, 2:6], expected.score, atol=1e-6)


def test_the_information_is_the_scatter_of_the_score():
    """At the truth E g gᵀ = F, over independent records, and over the parts of a record, whose gradients are uncorrelated."""
    scores, information, outer = [], [], []
    for seed in range(120):
        objective = tuning.likelihood([case(seed, duration=100.0)], BELIEVED, FREE)
        derivatives = objective.derivatives(objective.start)
        scores.append(derivatives.score.sum(axis=0))
        information.append(derivatives.information)
        outer.append(derivatives.score.T @ derivatives.score)
    F, J = np.mean(information, axis=0), np.cov(np.array(scores).T)
    size = np.sqrt(np.outer(np.diag(F), np.diag(F)))
    np.testing.assert_allclose(J / size, F / size, atol=0.45)
    np.testing.assert_allclose(np.diag(J), np.diag(F), rtol=0.45)
    np.testing.assert_allclose(np.diag(np.mean(outer, axis=0)), np.diag(F), rtol=0.12)
    assert np.all(np.abs(np.mean(scores, axis=0)) < 3.5 * np.sqrt(np.diag(F) / len(scores)))


def test_a_common_scale_leaves_the_estimates_and_multiplies_the_variances():
    start = tuning.record_case(every_kind(), KINDS, seed=3)
    objective = tuning.likelihood([start], KINDS, ["filter.scale"])
    doubled = objective.setup(np.log([2.0]))
    estimate = setup.run(start.record, KINDS, start.initial)
    scaled = setup.run(start.record, doubled, setup.initial_state(doubled, start.initial.attitude, start.initial.bias))
    np.testing.assert_allclose(scaled.attitude, estimate.attitude, atol=1e-9)
    np.testing.assert_allclose(scaled.variance, 4.0 * estimate.variance, rtol=1e-6)
    squares = sum(float(innovation.nis.sum()) for innovation in estimate.innovations.values())
    number = sum(innovation.innovation.size for innovation in estimate.innovations.values())
    # Closed form of the best scale: the root of the mean of e²/s.
    best = tuning.fit(objective, starts=3)["filter.scale"]
    assert best.most_likely == pytest.approx(np.sqrt(squares / number), rel=1e-5)


def test_thinned_measurements_weigh_as_much_as_all():
    series = every_kind().vectors[0]
    thin = tuning.objective.thinned(series, 3.0)
    assert np.all(np.diff(thin.time) >= 3.0 - 1e-5)
    usable = np.isfinite(series.vector_b).all(axis=1)
    assert np.sum(thin.sigma**-2.0) == pytest.approx(np.sum(series.sigma[usable] ** -2.0))
    assert np.isfinite(thin.vector_b).all()
    assert tuning.objective.thinned(thin, 0.1) is thin
    # The likelihood of a record is that of its thinned series, at less than a second too.
    time = 0.1 * np.arange(1, 100)
    star = series_of("star", "direction", time, np.tile([1.0, 0.0, 0.0], (99, 1)), [1.0, 0, 0], 1e-3)
    record = ImuRecord(time=0.1 * np.arange(101), increments=np.zeros((100, 3)), vectors=(star,))
    sparse = dataclasses.replace(record, vectors=(tuning.objective.thinned(star, 0.5),))
    assert len(sparse.vectors[0].time) == 20
    initial = setup.initial_state(BELIEVED, np.array([1.0, 0.0, 0.0, 0.0]))
    of = lambda record, spacing: tuning.likelihood(  # noqa: E731
        [tuning.Case(record=record, initial=initial)], BELIEVED, ("gyro.arw",), spacing=spacing
    )
    at = of(record, 0.5).start
    assert of(record, 0.5).minus_log(at) == pytest.approx(of(sparse, 0.0).minus_log(at), rel=1e-12)


def test_thinning_finds_the_sigma_that_disturbances_which_last_ask_for():
    """Each error lasts ten samples: independent once in ten, so the right σ of every sample is √10 times that of one."""
    star_scenario = scenario(duration=600.0, rate=2.0)
    record = scenarios.simulate(star_scenario, 5)
    random = np.random.default_rng(5)
    time = np.arange(1, 1200) * 0.5
    body = star_scenario.motion.attitude(time)
    series = []
    for name, reference in (("star 1", [1.0, 0.0, 0.0]), ("star 2", [0.0, 1.0, 0.0])):
        error = np.repeat(1e-3 * random.standard_normal((120, 3)), 10, axis=0)[: len(time)]
        measured = quaternion.rotate(quaternion.conjugate(body), np.array(reference)) + error
        series.append(
            series_of(
                name,
                "direction",
                time,
                measured / np.linalg.norm(measured, axis=1, keepdims=True),
                np.array(reference),
                1e-3,
            )
        )
    record = dataclasses.replace(record, vectors=tuple(series))
    start = tuning.record_case(record, BELIEVED, seed=1)
    sparse = tuning.fit(tuning.likelihood([start], BELIEVED, ["star 1.sigma", "star 2.sigma"], spacing=5.0), starts=1)
    for parameter in sparse.parameters:
        assert parameter.value == pytest.approx(1e-3 * np.sqrt(10.0), rel=0.2)
        assert parameter.lower < 1e-3 * np.sqrt(10.0) < parameter.upper
    blind = tuning.fit(tuning.likelihood([start], BELIEVED, ["gyro.arw", "star 1.sigma", "star 2.sigma"]), starts=2)
    assert blind.misfit
    assert not sparse.misfit


# ------------------------------------------------------------------------------------------------------ the search


@pytest.mark.parametrize("wrong", [30.0, 1.0 / 30.0])
def test_from_thirty_times_wrong_all_starts_find_one_optimum(wrong):
    simulated_case = case(duration=600.0)
    values = tuning.values_of(BELIEVED, FREE, [simulated_case.record])
    off = tuning.with_values(BELIEVED, {name: wrong * value for name, value in values.items()})
    fit = tuning.fit(tuning.likelihood([simulated_case], off, FREE), starts=8, intervals=False, threads=2)
    assert fit.agreeing == 8
    assert np.ptp(fit.optima, axis=0).max() < 1e-2
    for parameter in fit.parameters:
        assert abs(np.log(parameter.value / values[parameter.name])) < 4.0 * parameter.standard_error
        assert parameter.start == pytest.approx(wrong * values[parameter.name])
    assert fit.after < fit.before


def white_noise(n: int, seed: int = 3) -> tuple[tuning.Case, np.ndarray]:
    """A direction seen n times by a body whose attitude is as good as known: innovations are the noise itself, two a time."""
    random = np.random.default_rng(seed)
    noise = 1e-3 * random.standard_normal((n, 2))
    directions = np.column_stack([noise, np.sqrt(1.0 - np.sum(noise**2, axis=1))])
    series = series_of("star", "direction", np.arange(1.0, n + 1.0), directions, [0.0, 0.0, 1.0], 2e-3)
    record = ImuRecord(time=np.arange(n + 1.0), increments=np.zeros((n, 3)), vectors=(series,))
    return tuning.Case(record=record, initial=setup.initial_state(SURE, np.array([1.0, 0.0, 0.0, 0.0]))), noise


SURE = FilterSetup(
    process_noise=ProcessNoise(angle_random_walk=1e-9, rate_random_walk=0.0), attitude_sigma=1e-9, bias_sigma=1e-12
)


@pytest.mark.parametrize("n", [6, 4000])
def test_white_noise_has_the_closed_form_answer(n):
    """σ̂² is the mean square; 2 Δℓ = m (r − 1 − ln r), r = σ̂²/σ², m squares; F of ln σ is 2 m."""
    noise_case, noise = white_noise(n)
    parameter = tuning.fit(tuning.likelihood([noise_case], SURE, ["star.sigma"]), starts=2)["star.sigma"]
    m, best = noise.size, np.sqrt(np.mean(noise**2))
    assert parameter.most_likely == pytest.approx(best, rel=1e-4)
    assert parameter.standard_error == pytest.approx(1.0 / np.sqrt(2.0 * m), rel=1e-3)

    def fallen(log_ratio):
        r = np.exp(-2.0 * log_ratio)
        return m * (r - 1.0 - np.log(r)) - 3.841459

    ends = [best * np.exp(brentq(fallen, *bracket)) for bracket in ((-3.0, 0.0), (0.0, 3.0))]
    # Well known, the parabola's ends stand for those of the profile.
    np.testing.assert_allclose([parameter.lower, parameter.upper], ends, rtol=0.003 if n == 6 else 0.002)
    assert parameter.identified


def test_what_a_record_cannot_tell_has_a_bound_and_no_confident_value():
    """A bias that is constant: σ_u has no value, only a bound, and the filter gets a moderate one below it."""
    bounds = []
    for seed in range(4):
        objective = tuning.likelihood([case(seed, walk=0.0, duration=300.0)], BELIEVED, FREE)
        fit = tuning.fit(objective, starts=2)
        parameter = fit["gyro.rrw"]
        if not parameter.identified:
            bounds.append(parameter.upper)
            assert parameter.lower == 0.0
            assert 0.2 * parameter.upper < parameter.value < parameter.upper
            assert parameter.note == "not identified"
            # The others are the most likely ones beside the value that is used, not beside zero.
            slope, size = objective.derivatives(fit.point).score.sum(axis=0), 1.0 / np.sqrt(np.diag(fit.covariance))
            assert np.all(np.abs(slope[[0, 2, 3]]) < 0.02 * size[[0, 2, 3]])
            assert fit.setup.process_noise.rate_random_walk == pytest.approx(parameter.value)
        assert fit["gyro.arw"].identified
    assert len(bounds) >= 2
    assert max(bounds) < 20.0 * RRW


def test_the_sandwich_takes_the_scatter_about_the_mean_and_no_information_is_no_certainty():
    """Of n parts of a score with covariance C the sum has n C, and C is the scatter over n − 1."""
    scores = np.array([[1.0, 0.0], [-1.0, 2.0], [3.0, 4.0]])
    plain, robust = fitting.covariances(np.diag([4.0, 0.25]), scores)
    inverse = np.diag([0.25, 4.0])
    np.testing.assert_allclose(plain, inverse, rtol=1e-12)
    np.testing.assert_allclose(robust, inverse @ (3.0 * np.cov(scores.T, ddof=1)) @ inverse, rtol=1e-12)
    none = np.diag([4.0, 0.0, 1e-14])
    inverse, sandwich = fitting.covariances(none, np.random.default_rng(0).standard_normal((20, 3)))
    assert inverse[0, 0] == pytest.approx(0.25)
    assert np.all(np.diag(inverse)[1:] > 1e9)
    assert np.all(np.diag(sandwich)[1:] > 1e9)


def test_correlated_parts_add_up_as_an_autoregressive_process():
    """Of AR(1) with ρ = 0.5 a sum has three times the variance of independent parts; negative correlation is not used."""
    noise = np.random.default_rng(0).standard_normal((400_000, 2))
    parts = scipy.signal.lfilter([1.0], [1.0, -0.5], noise, axis=0)
    parts[:, 1] = np.diff(noise[:, 1], prepend=0.0)
    np.testing.assert_allclose(fitting.correlation_factor(parts), [3.0, 1.0], rtol=0.02)
    assert np.all(np.isfinite(fitting.correlation_factor(np.zeros((20, 2)))))


def test_priors_hold_what_the_data_leave_open_and_yield_where_they_speak():
    simulated_case = case(3, walk=0.0, duration=300.0)
    objective = tuning.likelihood([simulated_case], BELIEVED, FREE)
    prior = {"gyro.rrw": tuning.Prior(value=1e-7, factor=3.0), "gyro.arw": tuning.Prior(value=2.0 * ARW, factor=3.0)}
    fit = tuning.fit(objective, priors=prior, starts=2)
    assert fit["gyro.rrw"].most_likely == pytest.approx(1e-7, rel=0.3)
    assert fit["gyro.rrw"].lower > 0.0
    assert "prior" in fit["gyro.rrw"].note
    assert fit["gyro.arw"].value == pytest.approx(tuning.fit(objective, starts=1)["gyro.arw"].value, rel=0.03)
    # The closed form of two parabolas: a very narrow prior is the answer.
    narrow = {"gyro.arw": tuning.Prior(value=2.0 * ARW, factor=1.0001)}
    assert tuning.fit(objective, priors=narrow, starts=1)["gyro.arw"].value == pytest.approx(2.0 * ARW, rel=1e-3)


@pytest.mark.parametrize("factor", [100.0, 0.003])
def test_a_prior_of_another_gyro_is_named_and_nothing_else_blamed(factor):
    record = scenarios.simulate(dataclasses.replace(scenarios.load_scenario("two-stars"), duration=120.0), seed=2)
    own = record.origin.gyro
    other = gyro.GyroSpec(
        angle_random_walk=factor * own.angle_random_walk, rate_random_walk=factor * own.rate_random_walk
    )
    tuned = sd.tune(record, priors=other, starts=1, threads=1)
    assert "gyro.arw" in tuned.contradicted
    arw = tuned["gyro.arw"]
    assert arw.note == "in doubt: the data contradict its prior"
    values = f"gyro.arw ({factor * 0.15:.3g} against {arw.value / arw.unit.factor:.3g} °/√h)"
    answer, reason, _ = tuned.verdict
    assert answer == "not consistent"
    assert "the data contradict the prior of" in reason
    assert values in reason
    said = " ".join([reason, *tuned.listing().notes, *tuned.words])
    assert "disturbances" not in said
    assert "error without a state" not in said
    assert tuned.summary()["contradicted_priors"] == list(tuned.contradicted)
    same = sd.tune(record, priors=own, starts=1, threads=1)
    assert same.contradicted == ()
    assert same.verdict[0] == "consistent"


def test_a_prior_and_data_are_compared_by_the_uncertainty_of_both():
    """False alarms: 2.7 in 1000 where prior and data are right, whichever of the two is the more precise."""
    random = np.random.default_rng(1)
    for spread, error in ((1.0, 0.1), (0.1, 1.0), (0.5, 0.5)):
        prior = tuning.Prior(value=2.0, factor=math.exp(spread))
        data = math.log(2.0) + spread * random.standard_normal(100_000) + error * random.standard_normal(100_000)
        variance = 1.0 / (spread**-2 + error**-2)
        both = variance * (math.log(2.0) / spread**2 + data / error**2)
        alarms = np.mean([fitting._contradicts(value, math.sqrt(variance), prior) for value in both])
        assert alarms == pytest.approx(0.0027, abs=0.0006)
    assert not fitting._contradicts(math.log(2.0) + 1e-9, prior.spread, prior)


def test_priors_from_a_specification_match_its_noise():
    spec = gyro.GyroSpec(angle_random_walk=2e-5, rate_random_walk=1e-8)
    record = scenarios.simulate(scenario())
    priors = tuning.priors_from_gyro(spec, record, factor=2.0)
    assert priors == {
        "gyro.arw": tuning.Prior(value=2e-5, factor=2.0),
        "gyro.rrw": tuning.Prior(value=1e-8, factor=2.0),
    }
    assert set(tuning.priors_from_gyro(gyro.GyroSpec(angle_random_walk=2e-5), record)) == {"gyro.arw"}
    flicker = dataclasses.replace(spec, bias_instability=2e-5)
    assert tuning.priors_from_gyro(flicker, record)["gyro.rrw"].value > 1e-8


def test_the_tuned_setup_is_what_it_says_and_goes_through_its_file(tmp_path):
    simulated_case = case()
    off = tuning.with_values(BELIEVED, {"gyro.arw": 3.0 * ARW})
    objective = tuning.likelihood([simulated_case], off, ["gyro.arw", "star 2.sigma", "initial.bias"])
    heard = []
    fit = tuning.fit(objective, starts=1, progress=heard.append)
    assert heard == ["searches: 0 of 1", "searches: 1 of 1", *(f"intervals: {k} of 3" for k in range(4))]
    assert str(pickle.loads(pickle.dumps(fit))) == str(fit)
    assert fit.setup.process_noise.angle_random_walk == pytest.approx(fit["gyro.arw"].value)
    assert fit.setup.process_noise.rate_random_walk == RRW
    assert fit.setup.sigma == {"star 2": pytest.approx(fit["star 2.sigma"].value)}
    assert fit.setup.bias_sigma == pytest.approx(fit["initial.bias"].value)
    path = tmp_path / "filter.toml"
    path.write_text(setup.to_toml(fit.setup), encoding="utf-8")
    assert setup.read_setup(path) == fit.setup
    # The filter of the file is the filter that was judged.
    assert plain(
        simulated_case.record, fit.setup, simulated_case.initial.attitude, simulated_case.initial.bias
    ) == pytest.approx(fit.after, abs=0.02)


def test_searches_that_have_not_begun_end_with_an_interruption(monkeypatch):
    searches, search = [], fitting.search
    monkeypatch.setattr(fitting, "search", lambda *job: searches.append(job) or search(*job))

    def interrupt(words):
        if words == "searches: 1 of 40":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tuning.fit(tuning.likelihood([case()], BELIEVED, ["gyro.arw"]), starts=40, progress=interrupt)
    assert len(searches) < 20


def test_a_search_keeps_the_initial_attitude_within_half_a_turn():
    objective = tuning.likelihood([case()], BELIEVED, ["initial.attitude"])
    assert objective.setup(np.log([10.0])).attitude_sigma == np.pi


def test_a_factor_on_every_sigma_of_the_setup_is_kept_apart():
    factor = dataclasses.replace(BELIEVED, measurement_sigma_factor=3.0)
    simulated_case = case()
    assert tuning.values_of(factor, ["star 1.sigma"], [simulated_case.record])["star 1.sigma"] == pytest.approx(3e-4)
    a, b = (
        tuning.fit(tuning.likelihood([simulated_case], start, FREE), starts=1, intervals=False)
        for start in (factor, BELIEVED)
    )
    assert a["star 1.sigma"].value == pytest.approx(b["star 1.sigma"].value, rel=1e-3)
    assert a.setup.sigma["star 1"] * 3.0 == pytest.approx(a["star 1.sigma"].value)


# ------------------------------------------------------------------------------------------- against a truth, held out


def test_the_gradient_against_a_truth_is_that_of_its_value():
    objective = tuning.error_objective([case(1), case(2)], BELIEVED, FREE)
    point = objective.start + np.array([0.3, 0.5, -0.2, 0.1])
    derivatives = objective.derivatives(point)
    expected = differences(lambda x: objective.minus_log(x)[0], point)
    np.testing.assert_allclose(
        derivatives.score.sum(axis=0),
        expected,
        atol=3.0 * innovations.STEP * np.abs(derivatives.information).max() + 1e-5,
    )


AS_IT_RUNS = {
    "plain": BELIEVED,
    "gate": dataclasses.replace(BELIEVED, gate=Gate(probability=0.99)),
    "Huber": dataclasses.replace(BELIEVED, robust=Robust(kind="huber")),
    "states": dataclasses.replace(BELIEVED, states=States(gyro_scale_sigma=(0.0, 0.0, 1e-3))),
}


@pytest.mark.parametrize("filter_setup", AS_IT_RUNS.values(), ids=AS_IT_RUNS)
def test_the_likelihood_of_the_errors_is_that_of_a_normal_vector(filter_setup):
    """Of the filter as it runs: with its gate, its weights and its error states."""
    from scipy.stats import multivariate_normal

    simulated_case = case(1, outliers=0.05)
    objective = tuning.error_objective([simulated_case], filter_setup, FREE)
    epochs = objective.references[0].epochs
    estimate = setup.run(simulated_case.record, filter_setup, simulated_case.initial, full_covariance=True)
    truth = simulated_case.record.truth
    error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)[epochs]
    expected = -sum(
        multivariate_normal(np.zeros(6), P, allow_singular=True).logpdf(e)
        for e, P in zip(error, estimate.covariance[epochs], strict=True)
    )
    constant = 0.5 * 6 * len(epochs) * np.log(2.0 * np.pi)
    assert objective.derivatives(objective.start).value.sum() + constant == pytest.approx(expected, rel=1e-6)


def test_the_information_on_a_common_scale_is_twice_the_number_of_errors():
    """All σ times s: P ∝ s² and the same errors, so ½ tr((2 P⁻¹ P)²) = 2 n at every epoch."""
    objective = tuning.error_objective([case(1), case(2)], BELIEVED, ["filter.scale"])
    number = 6 * sum(len(reference.epochs) for reference in objective.references)
    assert objective.derivatives(objective.start).information == pytest.approx(2.0 * number, rel=1e-3)


def test_with_its_gate_a_filter_is_tuned_to_the_noise_of_what_passes():
    """Outliers of ten σ, one in twenty: a filter that uses them all is right with a larger σ, one that refuses them with the sensor's."""
    cases = [case(seed, outliers=0.05) for seed in range(2)]
    values = {}
    for name in ("plain", "gate"):
        objective = tuning.error_objective(cases, AS_IT_RUNS[name], ["star 1.sigma", "star 2.sigma"])
        fit = tuning.fit(objective, starts=1, intervals=False)
        values[name] = [
            parameter.value / sigma for parameter, sigma in zip(fit.parameters, two_stars.SIGMAS, strict=True)
        ]
    assert min(values["plain"]) > 1.4
    np.testing.assert_allclose(values["gate"], 1.0, rtol=0.35)


def test_against_a_truth_wrong_parameters_come_back():
    cases = [case(seed) for seed in range(4)]
    off = tuning.with_values(BELIEVED, {"gyro.arw": 10.0 * ARW, "star 1.sigma": 3e-5})
    fit = tuning.fit(tuning.error_objective(cases, off, ["gyro.arw", "star 1.sigma"]), starts=1, intervals=False)
    for name, true in (("gyro.arw", ARW), ("star 1.sigma", 1e-4)):
        assert abs(np.log(fit[name].value / true)) < max(4.0 * fit[name].standard_error, 0.2)
        assert fit[name].standard_error < 0.4
    compared = tuning.compare([case(seed) for seed in range(10, 14)], off, fit.setup)
    assert abs(compared.after.anees - 1.0) < 0.35
    assert compared.after.attitude_rms < compared.before.attitude_rms


def test_a_reference_attitude_beside_the_record_serves_as_truth():
    simulated_case = case(1)
    truth = simulated_case.record.truth
    reference = truth.attitude.copy()
    reference[:50] = np.nan
    bare = dataclasses.replace(
        simulated_case,
        record=dataclasses.replace(simulated_case.record, truth=None),
        true_attitude=reference,
        judged=truth.attitude[:, 0] < 2.0,
    )
    objective = tuning.error_objective([bare], BELIEVED, FREE)
    assert objective.references[0].epochs.min() >= 50
    assert np.isfinite(objective.derivatives(objective.start).value).all()
    judged = np.arange(len(reference)) >= 600
    held = tuning.compare([dataclasses.replace(bare, judged=judged)], BELIEVED, BELIEVED).after
    estimate = setup.run(
        simulated_case.record,
        BELIEVED,
        setup.initial_state(BELIEVED, simulated_case.initial.attitude, simulated_case.initial.bias),
    )
    expected = quaternion.angle_between(estimate.attitude, truth.attitude)[judged]
    assert held.attitude_rms == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-6)
    assert np.isnan(held.anees)
    assert 0.0 < held.attitude_rms < 1e-3
    with pytest.raises(InputError, match="has no truth"):
        tuning.error_objective([dataclasses.replace(bare, true_attitude=None)], BELIEVED, FREE)


def test_a_split_by_time_tunes_on_the_beginning_and_judges_the_end():
    simulated_case = case(1, duration=300.0)
    (train,), (test,) = tuning.split([simulated_case], 0.25)
    assert train.last == pytest.approx(225.0)
    assert test.first > train.last
    whole, early, late = (tuning.likelihood([part], BELIEVED, FREE) for part in (simulated_case, train, test))
    point = whole.start + 0.3
    assert early.minus_log(point)[0] + late.minus_log(point)[0] == pytest.approx(whole.minus_log(point)[0], rel=1e-12)
    off = tuning.with_values(BELIEVED, {"gyro.arw": 10.0 * ARW, "star 2.sigma": 1e-3})
    fit = tuning.fit(tuning.likelihood([train], off, FREE), starts=1)
    compared = tuning.compare([test], off, fit.setup)
    assert compared.better
    low, high = compared.after.nis_bounds
    assert low < compared.after.nis < high
    assert not low < compared.before.nis < high
    # The mean log likelihood is that of the very innovations held out.
    number = sum(2 * int(np.sum(series.time > train.last)) for series in simulated_case.record.vectors)
    expected = -tuning.likelihood([test], fit.setup, FREE).minus_log(fit.point)[0] / number - 0.5 * np.log(2 * np.pi)
    assert compared.after.log_likelihood == pytest.approx(expected, rel=1e-9)
    verdict = compared.after.judgements[0].verdict
    assert verdict in ("consistent", "cannot tell")
    before, after = (line for line in str(compared).splitlines() if line.startswith(("before", "after")))
    assert before.split()[0] == "before"
    assert (after.split()[:2], after.endswith(verdict)) == (["after", f"{compared.after.log_likelihood:.4f}"], True)
    assert f"{np.degrees(compared.after.attitude_rms):.3g}"[:4] in after


# ------------------------------------------------------------------------------------------------------ where it starts


def test_the_first_measurements_show_where_it_starts():
    """For every kind of them: tests/test_cli_estimate.py."""
    record = scenarios.simulate(scenario(), 1)
    begin = tuning.record_case(dataclasses.replace(record, truth=None), BELIEVED).initial
    assert quaternion.angle_between(begin.attitude, record.truth.attitude[0]) < 2e-3
    blind = dataclasses.replace(record, vectors=record.vectors[:1], truth=None)
    with pytest.raises(InputError, match="the first measurements do not give the attitude"):
        tuning.record_case(blind, BELIEVED)


def test_the_nees_is_that_of_the_states_whose_truth_is_known():
    simulated_case = case(1, duration=300.0)
    truth = simulated_case.record.truth
    nees = tuning.compare([simulated_case], BELIEVED, BELIEVED).after.nees
    estimate = setup.run(simulated_case.record, BELIEVED, simulated_case.initial, full_covariance=True)
    error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)
    for name, states in consistency.SUBSETS.items():
        expected = np.mean(consistency.nees(error, estimate.covariance, states)) / len(states)
        assert nees[name] == pytest.approx(expected, rel=1e-6)
    bare = dataclasses.replace(simulated_case, record=dataclasses.replace(simulated_case.record, truth=None))
    assert tuning.compare([bare], BELIEVED, BELIEVED).after.nees == {}
    beside = tuning.compare([dataclasses.replace(bare, true_attitude=truth.attitude)], BELIEVED, BELIEVED)
    assert beside.after.nees == {"attitude": pytest.approx(nees["attitude"], rel=1e-9)}
    other = case(2, duration=300.0)  # as long: the mean is that of both
    alone, both = (tuning.compare(cases, BELIEVED, BELIEVED).after.nees for cases in ([other], [simulated_case, other]))
    assert both == pytest.approx({name: 0.5 * (nees[name] + alone[name]) for name in nees})
    assert "(attitude)" in str(beside)


# ------------------------------------------------------------------------------------------------------ intervals


@pytest.mark.parametrize("mode", [0.01, 0.3, 0.8, 1.2])
def test_a_sigma_that_may_be_zero_has_a_one_sided_bound_and_the_mean_of_its_likelihood(monkeypatch, mode):
    """Of a profile that is a parabola in σ with its least at ``mode``: the bound is at mode + 1.645, the mean that of a cut normal."""

    def at(objective, point, *, fixed, steps):
        sigma = np.exp(point[0])
        return types.SimpleNamespace(
            point=np.array(point), local=types.SimpleNamespace(value=0.5 * (sigma - mode) ** 2)
        )

    monkeypatch.setattr(fitting, "search", at)
    objective = types.SimpleNamespace(names=("star.sigma",), start=np.array([0.0]), priors={})
    best = types.SimpleNamespace(point=np.array([np.log(mode)]), local=types.SimpleNamespace(value=0.0))
    interval = fitting._profiled(objective, best, 0, fitting._Errors(None, np.ones(1), np.ones(1), False))
    assert not interval.identified
    assert interval.lower == 0.0
    assert interval.upper == pytest.approx(mode + 1.6448536269514722, rel=0.006)
    ratio = np.exp(-0.5 * mode**2) / math.sqrt(2.0 * np.pi) / (0.5 * math.erfc(-mode / math.sqrt(2.0)))
    # Over a range that ends at the bound it is low by 12 to 20 %.
    assert interval.mean == pytest.approx(mode + ratio, rel=0.006)


@pytest.mark.parametrize(
    ("lower", "upper", "error", "note"),
    [
        (0.0, 2.0, 0.01, "identified, but poorly"),
        (1.0, 4.1, 0.01, "identified, but poorly"),
        (1.0, 3.9, 0.01, "identified"),
        (1.0, 3.9, 1.0, "identified roughly"),
    ],
)
def test_a_parameter_known_within_a_factor_of_four_is_identified(lower, upper, error, note):
    interval = fitting._Interval(lower, upper, 1.0, identified=True)
    objective = types.SimpleNamespace(names=("star.sigma",), priors={})
    errors = fitting._Errors(None, np.array([error]), np.ones(1), misfit=False)
    assert fitting._note(objective, None, 0, interval, errors) == note
