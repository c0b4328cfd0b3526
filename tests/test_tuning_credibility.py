"""Tuning by credibility: Neyman's statistic against its definition, what it recovers, what outliers do to it, its own intervals."""

from __future__ import annotations

import dataclasses
import json
import math
import types

import numpy as np
import pytest
from scipy.special import eval_sh_legendre
from scipy.stats import chi2, norm
from two_stars import BELIEVED, FREE, TRUTH, WRONG, case, scenario

from strapdown import consistency, scenarios, setup, tuning
from strapdown.checks import InputError
from strapdown.estimation.states import ProcessNoise
from strapdown.recordings import recordfiles
from strapdown.records import ImuRecord
from strapdown.setup import FilterSetup
from strapdown.tuning import credibility, fitting
from strapdown.tuning.credibility import ORDER, Sample, components_of, distance
from strapdown.vectors import VectorMeasurements


def wrong() -> FilterSetup:
    return tuning.with_values(BELIEVED, WRONG)


def white_noise(noise: np.ndarray) -> tuple[tuning.Case, FilterSetup]:
    """A direction seen by a body whose attitude is as good as known: innovations are the noise itself, two a time."""
    n = len(noise)
    seen = np.column_stack([noise, np.sqrt(1.0 - np.sum(noise**2, axis=1))])
    series = VectorMeasurements(
        sensor="star",
        kind="direction",
        time=np.arange(1.0, n + 1.0),
        vector_b=seen,
        reference_f=np.array([0.0, 0.0, 1.0]),
        sigma=np.full(n, 2e-3),
    )
    record = ImuRecord(time=np.arange(n + 1.0), increments=np.zeros((n, 3)), vectors=(series,))
    sure = FilterSetup(
        process_noise=ProcessNoise(angle_random_walk=1e-9, rate_random_walk=0.0), attitude_sigma=1e-9, bias_sigma=1e-12
    )
    return tuning.Case(record=record, initial=setup.initial_state(sure, np.array([1.0, 0.0, 0.0, 0.0]))), sure


# --------------------------------------------------------------------------------------------------- the statistic


def test_the_components_are_legendres_and_orthonormal():
    nodes, weights = np.polynomial.legendre.leggauss(20)
    u, w = 0.5 * (nodes + 1.0), 0.5 * weights
    values, slopes = components_of(u, ORDER)
    np.testing.assert_allclose((values * w[:, None]).T @ values, np.eye(ORDER), atol=1e-13)
    np.testing.assert_allclose(w @ values, 0.0, atol=1e-13)
    for k in range(1, ORDER + 1):
        np.testing.assert_allclose(values[:, k - 1], np.sqrt(2.0 * k + 1.0) * eval_sh_legendre(k, u), atol=1e-13)
    h = 1e-6
    np.testing.assert_allclose(
        slopes, (components_of(u + h, ORDER)[0] - components_of(u - h, ORDER)[0]) / (2.0 * h), atol=1e-7
    )


def a_sample(degrees: int, n: int, factor: float, length: int = 1, seed: int = 0) -> Sample:
    random = np.random.default_rng(seed)
    squares = factor**2 * random.chisquare(degrees, n)
    return Sample(
        name="star",
        length=length,
        degrees=degrees,
        squares=squares,
        slope=np.column_stack([-2.0 * squares, random.standard_normal(n)]),
        part=np.zeros(n, int),
    )


@pytest.mark.parametrize("degrees", [1, 2, 3, 6])
@pytest.mark.parametrize("length", [1, 4])
def test_the_distance_is_half_of_neymans_statistic(degrees, length):
    sample = a_sample(degrees, 300, 1.1, length)
    u = chi2.cdf(sample.squares, degrees)
    order = range(1, ORDER + 1 if length == 1 else 2)
    expected = sum(np.sum(np.sqrt(2.0 * k + 1.0) * eval_sh_legendre(k, u)) ** 2 / 300.0 for k in order)
    assert 2.0 * distance(sample).value == pytest.approx(expected, rel=1e-10)


def test_of_right_squares_it_is_chi_square():
    found = [2.0 * distance(a_sample(2, 200, 1.0, seed=seed)).value for seed in range(600)]
    assert np.mean(found) == pytest.approx(ORDER, abs=4.0 * np.sqrt(2.0 * ORDER / 600))
    assert np.var(found) == pytest.approx(2.0 * ORDER, rel=0.35)


@pytest.mark.parametrize(("degrees", "factor"), [(1, 1.2), (2, 0.7), (3, 1.0), (2, 40.0)])
def test_its_gradient_is_that_of_its_value(degrees, factor):
    sample = a_sample(degrees, 200, factor)
    found = distance(sample)
    h = 1e-6
    for j in range(2):
        up, down = (
            distance(dataclasses.replace(sample, squares=np.abs(sample.squares + s * h * sample.slope[:, j]))).value
            for s in (1.0, -1.0)
        )
        assert found.score[j] == pytest.approx((up - down) / (2.0 * h), rel=1e-5, abs=1e-5)
    assert np.linalg.eigvalsh(found.information).min() >= -1e-12


def test_from_forty_times_too_large_it_knows_the_way_back():
    """Every transform is 1 there, to the last bit; without the term that leads back the gradient is nothing."""
    far = distance(a_sample(2, 300, 40.0))
    assert far.score[0] < -100.0  # −2 x: a larger σ makes squares smaller
    near = a_sample(2, 300, 1.0)
    inside = distance(near)
    u = chi2.cdf(near.squares, 2)
    expected = sum(np.sum(np.sqrt(2.0 * k + 1.0) * eval_sh_legendre(k, u)) ** 2 / 300.0 for k in range(1, ORDER + 1))
    assert 2.0 * inside.value == pytest.approx(expected, rel=1e-12)  # and nothing of that term is left


# --------------------------------------------------------------------------------------------------- of noise alone


def test_the_size_of_white_noise_with_the_error_that_is_told():
    """1.3 times that of the likelihood: the error of ln σ over many records, and what the sandwich says of it."""
    random = np.random.default_rng(3)
    errors, told = [], []
    for _ in range(25):
        one, sure = white_noise(1e-3 * random.standard_normal((400, 2)))
        objective = tuning.credibility_objective([one], sure, ["star.sigma"])
        found = tuning.fit(objective, starts=1, intervals=False)["star.sigma"]
        errors.append(np.log(found.value / 1e-3))
        told.append(found.standard_error)
    bound = 1.0 / np.sqrt(2.0 * 800)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert bound * 0.95 < rms < 1.75 * bound
    assert np.median(told) == pytest.approx(rms, rel=0.3)
    assert abs(np.mean(errors)) < 3.5 * rms / np.sqrt(25)


def test_one_square_moves_it_by_no_more_than_is_told():
    noise = 1e-3 * np.random.default_rng(1).standard_normal((400, 2))
    struck = noise.copy()
    struck[200] = 0.1  # 100 σ
    (clean, sure), (spoilt, _) = white_noise(noise), white_noise(struck)
    moved = {}
    for name, build in (("credibility", tuning.credibility_objective), ("likelihood", tuning.likelihood)):
        points = [
            tuning.fit(build([one], sure, ["star.sigma"]), starts=1, intervals=False).point for one in (clean, spoilt)
        ]
        moved[name] = float(points[1][0] - points[0][0])
    assert moved["likelihood"] > 1.0
    assert 0.0 < moved["credibility"] < 3.0 * 1.75 / 400  # one measurement, and the blocks that hold it


# ------------------------------------------------------------------------------------------------------ of records


def test_single_squares_and_blocks_are_those_of_the_filters_innovations():
    one = case(2)
    objective = tuning.credibility_objective([one], BELIEVED, FREE)
    estimate = setup.run(one.record, BELIEVED, one.initial)
    samples = {(found.name, found.length): found for found in objective.samples(objective.start[None])}
    for name in ("star 1", "star 2"):
        white = estimate.innovations[name].whitened
        for length in (1, 4, 16):
            blocks = white[: len(white) // length * length].reshape(-1, length, 2).sum(axis=1)
            expected = np.sum(blocks**2, axis=1) / length
            np.testing.assert_allclose(samples[name, length].squares, expected, rtol=1e-9)
            assert samples[name, length].degrees == 2
    assert max(length for _, length in samples) == 16  # of 200 measurements twelve blocks of 16


def test_what_is_held_out_does_not_count():
    one = case(2)
    (train,), _ = tuning.split([one], 0.5)
    objective = tuning.credibility_objective([train], BELIEVED, FREE)
    (single, *_) = objective.samples(objective.start[None])
    assert len(single.squares) == 100
    whole = tuning.credibility_objective([one, train], BELIEVED, FREE, threads=2)
    (single, *_) = whole.samples(whole.start[None])
    assert len(single.squares) == 300
    assert np.bincount(single.part).tolist() == [10] * 20 + [5] * 20


@pytest.mark.parametrize("truth", [False, True])
def test_the_gradient_on_records_is_that_of_the_value(truth):
    objective = tuning.credibility_objective([case(1), case(2)], BELIEVED, FREE, truth=truth)
    point = objective.start + np.array([0.3, 0.5, -0.2, 0.1])
    found = objective.derivatives(point)
    for j in range(4):
        step = 1e-4 * np.eye(4)[j]
        up, down = objective.minus_log(np.array([point + step, point - step]))
        size = max(float(found.information[j, j]), 1.0)
        assert found.score.sum(axis=0)[j] == pytest.approx((up - down) / 2e-4, abs=1e-3 * size)
    assert found.value.sum() == pytest.approx(objective.minus_log(point)[0], rel=1e-12)
    curvature = objective.curvature(point)
    np.testing.assert_allclose(curvature, curvature.T)


def test_more_parameters_than_one_pass_has_lanes_for():
    record = scenarios.simulate(
        dataclasses.replace(
            scenario(),
            sensors=tuple(
                dataclasses.replace(scenario().sensors[0], name=f"star {k}", reference_f=np.eye(3)[k % 3])
                for k in range(7)
            ),
        ),
        1,
    )
    one = tuning.record_case(record, BELIEVED, seed=1)
    names = tuning.default_names([record])
    assert len(names) == 9
    whole = tuning.credibility_objective([one], BELIEVED, names)
    few = tuning.credibility_objective([one], BELIEVED, names[7:])
    many, some = whole.derivatives(whole.start), few.derivatives(few.start)
    np.testing.assert_allclose(many.score.sum(axis=0)[7:], some.score.sum(axis=0), atol=1e-4)
    np.testing.assert_allclose(many.information[7:, 7:], some.information, rtol=1e-4, atol=1e-4)


def test_nees_is_that_of_the_errors():
    one = case(1)
    objective = tuning.credibility_objective([one], BELIEVED, ["filter.scale"], truth=True)
    assert objective.errors is not None
    epochs = objective.errors.epochs[0]
    estimate = setup.run(one.record, BELIEVED, one.initial, full_covariance=True)
    truth = one.record.truth
    assert truth is not None
    assert estimate.covariance is not None
    error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude, truth.bias)[epochs]
    samples = {sample.name: sample for sample in objective.samples(objective.start[None])}
    assert {name: sample.degrees for name, sample in samples.items()} == {"state": 6, "attitude": 3, "bias": 3}
    for name, states in consistency.SUBSETS.items():
        expected = consistency.nees(error, estimate.covariance[epochs], states)
        np.testing.assert_allclose(samples[name].squares, expected, rtol=1e-6)


def recovered(
    seeds: int, duration: float, outliers: float = 0.0, intervals: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors of ln θ (seeds, 4), those of the likelihood, and whether the intervals hold the truth."""
    errors, likely, inside = [], [], []
    for seed in range(seeds):
        one = case(seed, duration=duration, outliers=outliers)
        found = tuning.fit(tuning.credibility_objective([one], wrong(), FREE), starts=1, intervals=intervals)
        assert found.composite
        errors.append(np.log([p.value for p in found.parameters] / TRUTH))
        inside.append([p.lower <= true <= p.upper for p, true in zip(found.parameters, TRUTH, strict=True)])
        other = tuning.fit(tuning.likelihood([one], wrong(), FREE), starts=1, intervals=False)
        likely.append(np.log([p.value for p in other.parameters] / TRUTH))
    return np.array(errors), np.array(likely), np.array(inside)


def test_it_recovers_the_truth_and_its_intervals_cover():
    errors, likely, inside = recovered(3, 1200.0)
    rms, other = np.sqrt(np.mean(errors**2, axis=0)), np.sqrt(np.mean(likely**2, axis=0))
    assert np.all(rms < [0.15, 0.6, 0.12, 0.05])
    assert np.all(rms > 0.8 * other)  # no better than the likelihood where that is right
    assert inside.mean() >= 0.8


@pytest.mark.slow
def test_it_recovers_the_truth_and_its_intervals_cover_over_100_records():
    errors, likely, inside = recovered(100, 1200.0)
    rms, other = np.sqrt(np.mean(errors**2, axis=0)), np.sqrt(np.mean(likely**2, axis=0))
    assert np.all(rms < 3.0 * other), (rms, other)
    assert rms[3] < 1.5 * other[3]
    assert np.all(np.abs(errors.mean(axis=0)) < 0.4 * rms)
    assert np.all((inside.mean(axis=0) >= 0.88) & (inside.mean(axis=0) <= 1.0)), inside.mean(axis=0)


def test_one_outlier_in_a_hundred_misleads_it_less_than_the_likelihood():
    errors, likely, _ = recovered(2, 1200.0, outliers=0.01, intervals=False)
    assert np.all(likely[:, 2:].mean(axis=0) > 0.25)  # σ of the stars 30 % too large and more
    assert np.all(errors[:, 2:].mean(axis=0) < 0.5 * likely[:, 2:].mean(axis=0))


def test_starts_from_thirty_times_wrong_find_the_same_filter():
    one = case(4, duration=1200.0)
    found = tuning.fit(tuning.credibility_objective([one], wrong(), FREE), starts=4, intervals=False, factor=30.0)
    assert found.agreeing >= 3


def test_nees_finds_the_scale_of_a_filter_that_is_too_sure():
    """Every σ a third of the right one: the estimates are right, and their covariance nine times too small."""
    third = tuning.with_values(BELIEVED, {"filter.scale": 1.0 / 3.0})
    cases = []
    for seed in range(3):
        one = case(seed, duration=600.0)
        cases.append(
            dataclasses.replace(one, initial=dataclasses.replace(one.initial, covariance=one.initial.covariance / 9.0))
        )
    found = tuning.fit(tuning.credibility_objective(cases, third, ["filter.scale"], truth=True), starts=2)[
        "filter.scale"
    ]
    assert abs(np.log(found.value / 3.0)) < 4.0 * found.standard_error
    assert found.standard_error < 0.1
    assert found.identified


def test_its_standard_error_is_not_that_of_the_likelihoods_information():
    """Disturbances that last ten samples make a record worth a tenth; the information knows nothing of it, the scatter does."""
    random = np.random.default_rng(2)
    noise = np.repeat(1e-3 * random.standard_normal((200, 2)), 10, axis=0)
    one, sure = white_noise(noise)
    found = tuning.fit(tuning.credibility_objective([one], sure, ["star.sigma"]), starts=1)["star.sigma"]
    information = 1.0 / np.sqrt(2.0 * noise.size)
    assert found.standard_error > 2.0 * information


def test_the_standard_error_is_the_sandwich_of_the_actual_curvature():
    objective = tuning.credibility_objective([case(3, duration=600.0)], BELIEVED, FREE)
    found = tuning.fit(objective, starts=1, intervals=False)
    best = np.log([one.most_likely for one in found.parameters])
    parts = objective.derivatives(best).score
    scatter = 20.0 * np.cov(parts.T, bias=False)
    inverse = np.linalg.inv(objective.curvature(best))
    expected = np.sqrt(np.diag(inverse @ scatter @ inverse))
    np.testing.assert_allclose([one.standard_error for one in found.parameters], expected, rtol=1e-3)


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="fewer than 10 measurements of one sensor"):
        tuning.credibility_objective([case(duration=8.0)], BELIEVED, FREE)
    blind = dataclasses.replace(case(), record=dataclasses.replace(case().record, truth=None))
    with pytest.raises(InputError, match="has no truth"):
        tuning.credibility_objective([blind], BELIEVED, FREE, truth=True)
    with pytest.raises(InputError, match="did you mean"):
        tuning.credibility_objective([case()], BELIEVED, ["gyro.awr"])


# -------------------------------------------------------------------------------------------------- the command line


@pytest.mark.parametrize("truth", [False, True])
def test_tune_by_credibility(run, tmp_path, truth):
    path, out = tmp_path / "sat.h5", tmp_path / "tuned.toml"
    recordfiles.write_record(path, scenarios.simulate(scenario(400.0), 1), gyro_spec=scenario().gyro)
    start = tmp_path / "wrong.toml"
    start.write_text(setup.to_toml(wrong()), encoding="utf-8")
    more = ("--truth", "--free", "star 1.sigma") if truth else ("--holdout", 0.3)
    status, said, complaint = run("tune", path, "--filter", start, "--credibility", *more, "--starts", 2, "-o", out)
    assert status == 0, complaint
    assert "half Neyman's statistic" in said
    content = json.loads(out.with_suffix(".json").read_text())
    assert content["objective"]["name"] == ("credibility of the errors" if truth else "credibility")
    if not truth:
        assert setup.read_setup(out).sigma["star 2"] == pytest.approx(2e-4, rel=0.3)
        assert content["held_out"]["after"]["nis_per_degree"] == pytest.approx(1.0, abs=0.25)
        nees = content["held_out"]["after"]["nees_per_state"]
        assert set(nees) == {"attitude", "bias"}


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--credibility", "--rmse"), "give one of them"),
        (("--credibility", "--spacing", "1"), "leave it away"),
    ],
)
def test_mistakes_are_told_in_one_line(run, tmp_path, arguments, complaint):
    path = tmp_path / "sat.h5"
    recordfiles.write_record(path, scenarios.simulate(scenario(60.0), 1), gyro_spec=scenario().gyro)
    status, _, said = run("tune", path, *arguments, "-o", tmp_path / "f.toml")
    assert status == 2
    assert complaint in said.replace("\n", " ")


def test_the_constants_are_what_the_docstring_tells():
    """93 % and 96 % of efficiency, 2.8 and 1.75 of influence: of the best estimating function of ln σ in these components."""
    for degrees, efficiency, influence in ((1, 0.93, 2.8), (2, 0.96, 1.75)):
        nodes, weights = np.polynomial.legendre.leggauss(200)
        u, w = 0.5 * (nodes + 1.0), 0.5 * weights
        x = chi2.ppf(u, degrees)
        slopes = (w * (x - degrees)) @ components_of(u, ORDER)[0]
        information = float(slopes @ slopes)
        assert information / float(w @ (x - degrees) ** 2) == pytest.approx(efficiency, abs=0.01)
        at_the_end = components_of(np.ones(1), ORDER)[0] @ slopes
        assert float(at_the_end[0]) / information == pytest.approx(influence, abs=0.05)
    assert norm.cdf(40.0) == 1.0  # what the transform is at forty σ, and why FAR is needed
    assert credibility.FAR == 1.0


def test_the_sandwich_takes_the_scatter_of_the_parts_about_their_mean_without_bias():
    """Of n parts of a score with covariance C the sum has n C, and C is the scatter over n − 1."""
    scores = np.array([[1.0, 0.0], [-1.0, 2.0], [3.0, 4.0]])
    information = np.diag([4.0, 0.25])
    local = types.SimpleNamespace(information=information, derivatives=types.SimpleNamespace(score=scores))
    plain, robust = fitting.covariances(local)
    inverse = np.diag([0.25, 4.0])
    np.testing.assert_allclose(plain, inverse, rtol=1e-12)
    np.testing.assert_allclose(robust, inverse @ (3.0 * np.cov(scores.T, ddof=1)) @ inverse, rtol=1e-12)


@pytest.mark.parametrize("mode", [0.3, 0.8, 1.2])
def test_a_sigma_that_may_be_zero_has_a_one_sided_bound_and_the_mean_of_its_likelihood(monkeypatch, mode):
    """Of a profile that is a parabola in σ with its least at ``mode``: the bound is at mode + 1.645, the mean that of a cut normal."""

    def at(objective, point, priors, *, fixed, steps):
        sigma = np.exp(point[0])
        return types.SimpleNamespace(
            point=np.array(point), local=types.SimpleNamespace(value=0.5 * (sigma - mode) ** 2)
        )

    monkeypatch.setattr(fitting, "search", at)
    objective = types.SimpleNamespace(names=("star.sigma",), start=np.array([0.0]))
    best = types.SimpleNamespace(point=np.array([np.log(mode)]), local=types.SimpleNamespace(value=0.0))
    found = fitting._profiled(objective, best, 0, {}, 1.0, 1.0)
    assert not found.identified
    assert found.lower == 0.0
    assert found.upper == pytest.approx(mode + 1.6448536269514722, rel=0.006)
    ratio = np.exp(-0.5 * mode**2) / math.sqrt(2.0 * np.pi) / (0.5 * math.erfc(-mode / math.sqrt(2.0)))
    # A sum over 17 points in place of the integral is low by up to 7 %; over a range that ends at the bound by 12 to 20 %.
    assert found.mean == pytest.approx(mode + ratio, rel=0.08)
