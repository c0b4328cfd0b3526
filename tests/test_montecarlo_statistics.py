"""Plans, mergeable statistics, and the engine that merges them: definitions held against plain reference code."""

import functools
import itertools
import math
import threading
import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from measured import errors_at, turn_to
from spin_plan import PLAN, SCENARIO, SETUP, different

from strapdown import coning, consistency, estimation, montecarlo, scenarios
from strapdown.checks import InputError
from strapdown.estimation import setup as setups
from strapdown.montecarlo import engine, plan, scalar, statistics
from strapdown.montecarlo.coning_study import FilterOutcome
from strapdown.montecarlo.statistics import BINS, ERROR_EXPONENT, bin_edges, bin_of

planned = functools.partial(replace, PLAN)


# ------------------------------------------------------------------------------------------------------------ histogram


def test_bins_are_those_of_their_edges():
    edges = bin_edges()
    assert len(edges) == BINS + 1
    assert edges[0] == 2.0**ERROR_EXPONENT
    assert np.all(np.diff(edges) > 0.0)
    assert np.diff(edges).max() / edges[np.argmax(np.diff(edges))] <= 0.125
    random = np.random.default_rng(1)
    values = np.exp(random.uniform(np.log(edges[0]), np.log(edges[-1]), 5000))
    assert np.array_equal(bin_of(values), np.searchsorted(edges, values, side="right") - 1)
    assert np.array_equal(bin_of(edges[:-1]), np.arange(BINS))
    assert np.array_equal(bin_of(np.nextafter(edges[1:], 0.0)), np.arange(BINS))
    assert bin_of(1.0) == -8 * ERROR_EXPONENT
    assert bin_of(np.array([0.0, 5e-324, edges[-1], 1e300])).tolist() == [0, 0, BINS - 1, BINS - 1]


@pytest.mark.parametrize("probability", [0.01, 0.1, 0.5, 0.9, 0.99, 0.999])
def test_quantiles_are_those_of_the_sample(probability):
    random = np.random.default_rng(2)
    error = 1e-4 * np.abs(random.standard_normal(20000))
    histogram = np.tile(np.bincount(bin_of(error), minlength=BINS), (1, 6, 1))
    total = replace(scalar.run_chunk(PLAN, 0, 1), histogram=histogram)
    # Between the edges of the bin that holds it, and in the midst of the sample far closer.
    ratio = total.error_quantile(probability) / np.quantile(error, probability)
    assert np.all(np.abs(ratio - 1.0) < (0.03 if probability > 0.05 else 0.07))


def test_quantiles_at_the_ends():
    sums = scalar.run_chunk(PLAN, 0, 20)
    least, most = sums.error_quantile(0.0), sums.error_quantile(1.0)
    assert np.all(least <= most)
    assert np.all(most >= sums.rms_error)
    empty = replace(sums, histogram=np.zeros_like(sums.histogram))
    assert np.isnan(empty.error_quantile(0.5)).all()
    with pytest.raises(InputError, match="between 0 and 1"):
        sums.error_quantile(1.5)


# ------------------------------------------------------------------------------------------------------------ sums


def test_every_sum_is_what_its_definition_says():
    """Against runs taken one by one through simulator and filter, added up in plain loops."""
    runs, first = 4, 6
    total = scalar.run_chunk(PLAN, first, runs)
    m = PLAN.epochs + 1
    error, product, covariance = np.zeros((m, 6)), np.zeros((m, 6, 6)), np.zeros((m, 6, 6))
    nees, logs = np.zeros((m, 3)), np.zeros((m, 3))
    coverage, histogram = np.zeros((m, 6, 3), int), np.zeros((m, 6, BINS), int)
    nis, degrees = np.zeros((2, PLAN.nis_bins)), np.zeros((2, PLAN.nis_bins), int)
    score, kept = {}, {}
    for run in range(first, first + runs):
        record = scenarios.simulate(SCENARIO, PLAN.seed, run)
        initial = montecarlo.start(record, SETUP, PLAN.seed, run)
        estimate = estimation.run(record, SETUP.process_noise, initial, full_covariance=True)
        peak = 0.0
        for k in range(m):
            step = k * 240 // PLAN.epochs
            q, b, P = estimate.attitude[step], estimate.bias[step], estimate.covariance[step]
            e = np.empty(6)
            e[:3] = turn_to(q, record.truth.attitude[step])
            e[3:] = record.truth.bias[step] - b
            error[k] += e
            product[k] += np.outer(e, e)
            covariance[k] += P
            for c, (a, z) in enumerate(((0, 6), (0, 3), (3, 6))):
                value = e[a:z] @ np.linalg.inv(P[a:z, a:z]) @ e[a:z]
                nees[k, c] += value
                logs[k, c] += math.log(value)
                peak = max(peak, value) if c == 0 else peak
            for i in range(6):
                histogram[k, i, np.searchsorted(bin_edges(), abs(e[i]), side="right") - 1] += 1
                for j in range(3):
                    coverage[k, i, j] += abs(e[i]) <= (j + 1) * math.sqrt(P[i, i])
            kept[run, k] = e, np.sqrt(np.diag(P))
        score[run] = peak
        for i, name in enumerate(PLAN.sensors):
            innovations = estimate.innovations[name]
            for t, value in zip(innovations.time, innovations.nis, strict=True):
                span = max(0, math.ceil(t / 2.4 * PLAN.nis_bins - 1e-9) - 1)  # one on an edge belongs to what it ends
                nis[i, span] += value
                degrees[i, span] += 2
    close = {"error_sum": error, "error_product_sum": product, "covariance_sum": covariance}
    for name, expected in close.items():
        scale = np.abs(expected).max(axis=0)
        assert np.all(np.abs(getattr(total, name) - expected) <= 1e-9 * scale), name
    assert np.allclose(total.nees_sum, nees, rtol=1e-8)
    assert np.allclose(total.log_nees_sum, logs, rtol=1e-8, atol=1e-8)
    assert np.array_equal(total.coverage, coverage)
    assert np.array_equal(total.histogram, histogram)
    assert np.allclose(total.sensor_nis_sum, nis, rtol=1e-10)
    assert np.array_equal(total.sensor_degrees, degrees)
    assert total.finite.tolist() == [runs] * m
    assert total.worst_run.tolist() == sorted(score, key=score.get, reverse=True)
    assert np.allclose(total.worst_score, sorted(score.values(), reverse=True), rtol=1e-8)
    assert total.example_run.tolist() == [6, 7]  # of runs 6 to 9 those below 8
    for x, run in enumerate((6, 7)):
        for k in range(m):
            e, sigma = kept[run, k]
            assert np.allclose(total.example_error[x, k], e, rtol=1e-9, atol=1e-13)
            assert np.allclose(total.example_sigma[x, k], sigma, rtol=1e-9)


def test_a_measurement_on_an_edge_belongs_to_the_span_that_it_ends():
    """The sun sensor measures at 1 s and 2 s; the spans end there."""
    two = planned(scenario=replace(SCENARIO, duration=2.0), epochs=4, nis_bins=2)
    assert two.nis_edges.tolist() == [0.0, 1.0, 2.0]
    assert scalar.run_chunk(two, 0, 1).sensor_degrees[0].tolist() == [2, 2]


def test_coverage_counts_errors_inside_one_two_three_sigma_their_ends_too():
    sums = scalar.Sums(PLAN, 1)
    P = np.tile(np.diag([1.0, 4.0, 0.25, 1.0, 1.0, 1.0]), (7, 1, 1))
    z = np.array([0.0, 0.999, 1.0, 1.001, -2.0, 2.999, 3.001])
    error = z[:, None] * np.sqrt(np.diagonal(P[0]))
    sums._add_errors(0, error, P)
    inside = np.array([[1, 1, 1], [1, 1, 1], [1, 1, 1], [0, 1, 1], [0, 1, 1], [0, 0, 1], [0, 0, 0]])
    assert np.array_equal(sums.sums.coverage, np.repeat(inside[:, None, :], 6, axis=1))


def test_merging_parts_is_the_whole():
    whole = scalar.run_chunk(PLAN, 0, 12)
    parts = [scalar.run_chunk(PLAN, first, runs) for first, runs in ((0, 5), (5, 1), (6, 6))]
    merged = functools.reduce(montecarlo.merge, parts)
    exact = ["runs", "finite", "coverage", "histogram", "sensor_degrees", "sensor_refused", "time", "sensors"]
    exact += ["worst_run", "worst_score", "example_run", "example_error", "example_sigma"]
    assert not different(whole, merged, exact)
    other = montecarlo.merge(parts[0], montecarlo.merge(parts[1], parts[2]))
    for name in ("error_sum", "error_product_sum", "covariance_sum", "nees_sum", "log_nees_sum", "sensor_nis_sum"):
        a = getattr(whole, name)
        assert np.allclose(a, getattr(merged, name), rtol=1e-12, atol=1e-12 * np.abs(a).max()), name
        assert np.allclose(a, getattr(other, name), rtol=1e-12, atol=1e-12 * np.abs(a).max()), name


def test_twenty_epochs_without_the_first_are_judged():
    sums = scalar.run_chunk(PLAN, 0, 1)
    assert sums.judged_epochs.tolist() == [1, 2, 3, 4, 5, 6]
    assert replace(sums, time=np.arange(101.0)).judged_epochs.tolist() == list(range(5, 101, 5))


def test_worst_runs_are_the_largest_and_of_equal_ones_the_first():
    run, score = statistics.worst(np.arange(30), np.array([1.0, 7.0, 7.0] * 10))
    assert run.tolist() == [1, 2, 4, 5, 7, 8, 10, 11, 13, 14]
    assert score.tolist() == [7.0] * 10
    run, score = statistics.worst(np.array([9, 3]), np.array([np.inf, np.inf]))
    assert run.tolist() == [3, 9]


def with_score(total, factor, run, score):
    """Statistics in which all NEES are larger by a factor, and one run has a NEES at one epoch."""
    nees = factor * total.nees_sum
    nees[3] += [score, 0.5 * score, 0.5 * score]
    worst = statistics.worst(np.append(total.worst_run, run), np.append(factor * total.worst_score, score))
    return replace(total, nees_sum=nees, worst_run=worst[0], worst_score=worst[1])


def test_a_run_beyond_all_chance_is_named_in_the_verdict():
    """Its share of the mean of 48 runs, which alone was tested, is small at an epoch that is not among those tested."""
    total, six = (replace(scalar.run_chunk(PLAN, 0, runs), plan=PLAN) for runs in (48, 6))
    for few in (total, six):
        assert "beyond all chance" not in few.judge().reason
        judged = with_score(few, 1.0, 117, 214.0).judge(epochs=[1, 6])
        assert judged.verdict == "not consistent"
        assert f"run 117 (NEES 214) of seed {PLAN.seed} beyond all chance (p < 0.0001" in judged.reason
    assert not judged.findings[0].rejected
    assert (
        "run 117 (NEES 214), run 3 (NEES"
        in with_score(with_score(total, 1.0, 3, 190.0), 1.0, 117, 214.0).judge().reason
    )
    # Of a filter whose errors are three times its σ in every run, this is an ordinary one.
    optimistic = with_score(total, 9.0, 117, 214.0).judge()
    assert optimistic.verdict == "not consistent"
    assert "beyond all chance" not in optimistic.reason


def test_a_run_that_fails_is_counted_reported_and_left_out(monkeypatch):
    """One run of five turns to NaN half way: sums go on without it, the verdict does not."""
    original = setups.run

    def failing(record, setup, initial, **options):
        estimate = original(record, setup, initial, **options)
        if initial.attitude[0] == start[0]:
            estimate.attitude[3:] = np.nan
            estimate.covariance[5:] = -estimate.covariance[5:]
        return estimate

    record = scenarios.simulate(SCENARIO, PLAN.seed, 2)
    start = montecarlo.start(record, SETUP, PLAN.seed, 2).attitude
    good = montecarlo.merge(scalar.run_chunk(PLAN, 0, 2), scalar.run_chunk(PLAN, 3, 2))
    monkeypatch.setattr(setups, "run", failing)
    total = scalar.run_chunk(PLAN, 0, 5)
    assert total.finite.tolist() == [5, 5, 5, 4, 4, 4, 4]
    assert total.failed == 1
    assert np.isfinite(total.anees).all()
    assert np.allclose(total.nees_sum[3:], good.nees_sum[3:], rtol=1e-12)
    assert total.worst_run[0] == 2
    assert np.isinf(total.worst_score[0])
    verdict = total.verdict(np.arange(7))
    assert np.isinf(verdict.mean[3:]).all()
    assert not verdict.consistent
    summary = montecarlo.summary(total)
    assert summary["failed_runs"] == 1
    assert not summary["consistent"]
    assert summary["worst_runs"][0] == {"run": 2, "largest_nees": None}
    early = montecarlo.summary(total, judgement=total.judge(epochs=[1, 2]))  # before it failed
    assert not any(finding["rejected"] for finding in early["judgement"]["findings"])
    assert not early["consistent"]


def test_measurements_that_a_gate_refuses_are_counted_apart(monkeypatch):
    original = setups.run

    def gated(record, setup, initial, **options):
        estimate = original(record, setup, initial, **options)
        star = estimate.innovations["star"]
        weight = np.ones(len(star.time))
        weight[0] = 0.0
        return replace(estimate, innovations={**estimate.innovations, "star": replace(star, weight=weight)})

    plain = scalar.run_chunk(PLAN, 0, 3)
    monkeypatch.setattr(setups, "run", gated)
    total = scalar.run_chunk(PLAN, 0, 3)
    # One star a run, at 2 s: the fifth span.
    assert plain.sensor_degrees[1].tolist() == [0, 0, 0, 0, 6]
    assert total.sensor_degrees[1].tolist() == [0, 0, 0, 0, 0]
    assert total.sensor_refused.tolist() == [[0, 0, 0, 0, 0], [0, 0, 0, 0, 3]]
    assert total.sensor_nis_sum[1].sum() == 0.0
    assert np.array_equal(total.sensor_nis_sum[0], plain.sensor_nis_sum[0])


def test_the_nis_of_a_gated_filter_is_that_without_its_gate(monkeypatch):
    original = setups.run
    monkeypatch.setattr(
        setups, "run", lambda record, setup, *rest, **options: original(record, SETUP, *rest, **options)
    )
    gate = estimation.Gate(probability=0.9999999)
    plain, total = (
        scalar.run_chunk(replace(PLAN, setup=replace(SETUP, gate=gate)), 0, 3).sensor_nis_sum for gate in (None, gate)
    )
    np.testing.assert_allclose(total, plain, rtol=1e-3)
    narrow = scalar.run_chunk(replace(PLAN, setup=replace(SETUP, gate=estimation.Gate(probability=0.99))), 0, 3)
    assert np.all(narrow.sensor_nis_sum[plain > 0.0] > plain[plain > 0.0])


def test_bounds_are_those_that_decide():
    """The level is shared by the ten tests of the verdict, none of which rejects, and within each by its two epochs."""
    sums, epochs = scalar.run_chunk(PLAN, 0, 3), np.array([2, 4])
    judgement = sums.judge(epochs=epochs, confidence_level=0.95)
    assert montecarlo.summary(sums, judgement=judgement)["judgement"] == judgement.summary()
    bounds = {(finding.name, finding.of): (finding.low, finding.high) for finding in judgement.findings}
    anees = sums.anees[epochs, 2]
    worst = sums.time[epochs[np.abs(np.log(anees)).argmax()]]
    (at,) = (finding.at for finding in judgement.findings if (finding.name, finding.of) == ("ANEES", "bias"))
    assert at == f"mean {anees.mean():.4g}, worst at {worst:g} s"
    assert len(judgement.findings) == 10
    assert not any(finding.rejected for finding in judgement.findings)
    single = 0.05 / 10.0
    low, high = scipy.stats.chi2.ppf([0.25 * single, 1.0 - 0.25 * single], 9) / 9.0
    assert np.allclose(bounds["ANEES", "bias"], [low, high], rtol=1e-12)
    low, high = scipy.stats.chi2.ppf([0.5 * single, 1.0 - 0.5 * single], 6) / 6.0
    assert np.allclose(bounds["NIS", sums.sensors[1]], [low, high], rtol=1e-12)
    low, high = scipy.stats.chi2.ppf([0.5 * single, 1.0 - 0.5 * single], sums.sensor_degrees.sum())
    assert np.allclose(sums.nis_bounds(1.0 - single), np.array([low, high]) / sums.sensor_degrees.sum(), rtol=1e-12)


def test_the_mean_error_is_students_t_of_the_worst_epoch_and_state():
    """And ln NEES that of the worst epoch; both times the number of tests."""
    sums, epochs = scalar.run_chunk(PLAN, 0, 8), np.array([2, 4])
    error = sums.example_error + 3.0 * sums.rms_error * (np.arange(6) == 5)
    moved = {"error_sum": error.sum(axis=0), "error_product_sum": np.einsum("rmi,rmj->mij", error, error)}
    logs = sums.log_nees_sum + 2.4 * np.arange(7)[:, None]
    findings = {
        finding.name: finding for finding in replace(sums, **moved, log_nees_sum=logs).judge(epochs=epochs).findings
    }
    student = scipy.stats.ttest_1samp(error[:, epochs], 0.0)
    assert (findings["mean error"].of, findings["mean error"].value) == (
        "bias z",
        pytest.approx(student.statistic.max()),
    )
    assert findings["mean error"].p_value == pytest.approx(12.0 * student.pvalue.min())
    worst = epochs[student.statistic.argmax() // 6]
    assert findings["mean error"].at == f"worst at {sums.time[worst]:g} s"
    anees = sums.nees_sum[epochs, 2]
    each = [2.0 * min(scipy.stats.chi2.cdf(value, 24), scipy.stats.chi2.sf(value, 24)) for value in anees]
    assert findings["ANEES"].p_value == pytest.approx(min(1.0, 2.0 * min(each)))
    p = consistency.log_mean_p_value(float(logs[4, 2]) / 8.0, 3, 8)
    assert findings["log-NEES"].p_value == pytest.approx(2.0 * p)  # the last subset is the bias


def test_an_anees_is_outside_its_bounds_where_holm_is_sharper_than_bonferroni():
    """With nine of ten tests rejected the last has the whole level: an ANEES that Bonferroni passes is rejected, and shown outside."""
    sums = scalar.run_chunk(PLAN, 0, 3)
    epochs = np.array([4])
    low = (
        scipy.stats.chi2.ppf(0.5 * 0.05 / 4.0, 9) / 9.0
    )  # between the bounds of one of five tests and those of one of few
    nees = sums.nees_sum.copy()
    nees[4] = 18.0 * 50.0, 9.0 * 0.9 * low, 9.0 * 50.0
    odd = replace(sums, nees_sum=nees, sensor_nis_sum=50.0 * sums.sensor_nis_sum, log_nees_sum=sums.log_nees_sum + 30.0)
    judgement = odd.judge(epochs=epochs, confidence_level=0.95)
    anees = {finding.of: finding for finding in judgement.findings if finding.name == "ANEES"}
    assert anees["attitude"].rejected
    for finding in anees.values():
        assert (finding.low <= finding.value <= finding.high) is not finding.rejected


def test_the_summary_has_the_last_epoch_each_sensor_and_the_bound(monkeypatch):
    monkeypatch.setattr(statistics.Statistics, "judged_epochs", np.array([2, 4]))
    sums = scalar.run_chunk(PLAN, 0, 8)
    refused, coverage = np.arange(10).reshape(2, 5), np.zeros((7, 6, 3), int)
    coverage[4], coverage[2, :3, 1] = 8, 8
    bound = np.tile(np.diag([4.0, 1.0, 1.0, 1.0, 1.0, 1.0]), (7, 1, 1))
    summary = montecarlo.summary(replace(sums, sensor_refused=refused, coverage=coverage), bound=bound)
    assert list(summary["refused"].values()) == [10, 35]
    assert summary["coverage"]["attitude"] == [0.5, 1.0, 0.5]
    assert summary["coverage"]["bias"] == [0.5, 0.5, 0.5]
    assert summary["anees"]["bias"] == pytest.approx(sums.anees[[2, 4], 2].mean())
    median = sums.error_quantile(0.5)[-1] * 648000.0 / np.pi
    np.testing.assert_allclose(summary["last_epoch"]["attitude_error_quantile_0.5_arcsec"], median[:3])
    over = summary["rms_over_root_cramer_rao_bound"]
    rms = np.sqrt(np.mean(sums.rms_error[[2, 4]] ** 2, axis=0))
    np.testing.assert_allclose([*over["attitude"], *over["bias"]], rms / [2.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    ends = np.sqrt(scipy.stats.chi2.ppf([0.005, 0.995], 8) / 8.0)
    np.testing.assert_allclose(over["bounds_of_an_efficient_filter"], ends)


def test_the_numbers_of_the_coning_study_are_means_over_the_judged_epochs(monkeypatch):
    sums, epochs = scalar.run_chunk(PLAN, 0, 8), np.array([2, 4, 6])
    monkeypatch.setattr(statistics.Statistics, "judged_epochs", epochs)
    summary = FilterOutcome(integration="a", statistics=sums).summary()
    error, P = sums.example_error[:, epochs], sums.covariance_sum[epochs] / 8.0
    turn = np.pi / 648000.0  # an arcsecond, and a degree per hour
    for name, part in (("attitude_{}_arcsec", slice(3)), ("bias_{}_deg_per_hour", slice(3, 6))):
        assert summary[name.format("rms")] * turn == pytest.approx(np.sqrt(np.mean(error[:, :, part] ** 2)))
        sigma = np.sqrt(np.mean(np.diagonal(P, axis1=1, axis2=2)[:, part]))
        assert summary[name.format("sigma")] * turn == pytest.approx(sigma)
    np.testing.assert_allclose(np.multiply(summary["bias_mean_deg_per_hour"], turn), error[:, :, 3:].mean(axis=(0, 1)))
    totals = {"anees": (6 * 8, sums.nees_sum[epochs, 0]), "anees_bias": (3 * 8, sums.nees_sum[epochs, 2])}
    totals |= {"nis": (sums.sensor_degrees.sum(), sums.sensor_nis_sum.sum())}
    for name, (degrees, total) in totals.items():
        assert summary[name] == pytest.approx(np.mean(total) / degrees)
        ends = scipy.stats.chi2.ppf([0.005, 0.995], degrees) / degrees
        np.testing.assert_allclose(summary[f"{name}_bounds"], ends)


# ------------------------------------------------------------------------------------------------------------ plans


DISPERSED = montecarlo.Dispersions(
    attitude_sigma=0.01,
    attitude_error=np.array([0.1, 0.0, -0.2]),
    scale_factor_sigma=1e-4,
    misalignment_sigma=2e-4,
    turn_on_bias_sigma=1e-5,
)


def test_a_plan_goes_through_its_table_and_back():
    plans = (PLAN, planned(dispersions=DISPERSED, seed=9), planned(setup=replace(SETUP, sigma={"star": 1e-3})))
    for original in (*plans, planned(individuals=True)):
        again = plan.from_table(original.to_table())
        assert again.to_table() == original.to_table()
        assert again.digest == original.digest
        assert again.individuals == original.individuals
        assert not different(scalar.run_chunk(original, 0, 2), scalar.run_chunk(again, 0, 2))


def test_every_part_of_a_plan_counts_in_its_digest():
    others = [
        planned(seed=5),
        planned(epochs=3),
        planned(nis_bins=4),
        planned(dispersions=DISPERSED),
        planned(setup=replace(SETUP, bias_sigma=2.0 * SETUP.bias_sigma)),
        planned(scenario=replace(SCENARIO, duration=4.8)),
    ]
    digests = {variant.digest for variant in (PLAN, *others)}
    assert len(digests) == len(others) + 1
    assert planned().digest == PLAN.digest


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: planned(epochs=7), "multiple of 7"),
        (lambda: planned(epochs=0), "epochs is 0"),
        (lambda: planned(seed=-1), "seed is -1"),
        (lambda: montecarlo.run_plan(PLAN, runs=0), "runs is 0"),
        (lambda: montecarlo.run_plan(PLAN, runs=1.5), "runs is 1.5"),
        (lambda: montecarlo.run_plan(PLAN, runs=1, chunk=0), "chunk is 0"),
        (lambda: montecarlo.run_plan(PLAN, runs=1, threads=0), "threads is 0"),
        (lambda: montecarlo.run_plan(PLAN, runs=1, machine="lane"), "did you mean 'lanes'"),
        (lambda: montecarlo.Dispersions(scale_factor_sigma=-1.0), "scale_factor_sigma is -1"),
        (lambda: montecarlo.Dispersions(attitude_sigma=10.0), "attitude_sigma is 10 rad"),
        (lambda: montecarlo.read_dispersions("none.toml"), "does not exist"),
        (
            lambda: montecarlo.merge(scalar.run_chunk(PLAN, 0, 1), scalar.run_chunk(planned(epochs=3), 0, 1)),
            "different time",
        ),
    ],
)
def test_what_is_wrong_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_dispersions_of_a_file(tmp_path):
    path = tmp_path / "d.toml"
    path.write_text("[dispersion]\n")
    with pytest.raises(InputError, match=r"no table \[dispersions\]"):
        montecarlo.read_dispersions(path)
    path.write_text("[dispersions]\nscale_factor_sigma_pm = 3\n")
    with pytest.raises(InputError, match="scale_factor_sigma_ppm"):
        montecarlo.read_dispersions(path)
    path.write_text("[dispersions]\nscale_factor_sigma_ppm = 300.0\nattitude_error_deg = [0.0, 0.0, 20.0]\n")
    dispersions = montecarlo.read_dispersions(path)
    assert dispersions.scale_factor_sigma == pytest.approx(3e-4, rel=1e-15)
    assert dispersions.attitude_error[2] == pytest.approx(math.radians(20.0))


def test_whole_epochs_cut_into_whole_steps():
    four = replace(SETUP, integration=coning.ALGORITHMS["four-sample"])
    assert montecarlo.whole_epochs(SCENARIO, SETUP) == 80
    assert montecarlo.whole_epochs(SCENARIO, four) == 60
    longer = replace(SCENARIO, duration=2.41)
    with pytest.raises(InputError, match=r"epochs of whole four-sample steps; .* a multiple of 4,"):
        planned(scenario=longer, setup=four, epochs=montecarlo.whole_epochs(longer, four))


def test_gyro_dispersions_have_their_sigma_and_their_place():
    gyros = [plan.dispersed(SCENARIO.gyro, DISPERSED, 3, run) for run in range(500)]
    off = ~np.eye(3, dtype=bool)
    draws = {
        1e-4: np.array([g.scale_factor - SCENARIO.gyro.scale_factor for g in gyros]),
        2e-4: np.array([(g.misalignment - SCENARIO.gyro.misalignment)[off] for g in gyros]),
        1e-5: np.array([g.turn_on_bias for g in gyros]),
    }
    together = np.concatenate([values / sigma for sigma, values in draws.items()], axis=1)
    assert np.abs(together.mean(axis=0)).max() < 4.0 / np.sqrt(500)
    assert np.abs(together.var(axis=0) - 1.0).max() < 4.0 * np.sqrt(2.0 / 500)
    correlation = np.corrcoef(together.T) - np.eye(12)
    assert np.abs(correlation).max() < 4.5 / np.sqrt(500)
    assert all(np.all(np.diag(g.misalignment) == 0.0) for g in gyros)
    assert plan.dispersed(SCENARIO.gyro, montecarlo.Dispersions(), 3, 1) is SCENARIO.gyro


def test_a_dispersed_gyro_is_the_one_that_is_simulated():
    only = montecarlo.Dispersions(scale_factor_sigma=1e-3)
    record = scalar.record_of(planned(dispersions=only), 5)
    plain = scenarios.simulate(SCENARIO, PLAN.seed, 5)
    spec = plan.dispersed(SCENARIO.gyro, only, PLAN.seed, 5)
    turned = (record.increments - plain.increments).sum(axis=0) / np.deg2rad(60.0 * 2.4)
    assert turned[2] == pytest.approx(spec.scale_factor[2] - SCENARIO.gyro.scale_factor[2], rel=1e-6)
    origin = montecarlo.replay(planned(dispersions=only), 5, machine="scalar").record.origin
    assert origin.gyro == origin.scenario.gyro == spec


def test_initial_errors_are_as_dispersed():
    """e at the start is the fixed part plus σ times the draw, to first order of the angle."""
    dispersions = montecarlo.Dispersions(
        attitude_sigma=0.0, bias_sigma=1e-3, attitude_error=np.array([0.3, -0.2, 0.1]), bias_error=np.full(3, 5e-3)
    )
    total = scalar.run_chunk(planned(dispersions=dispersions), 0, 2)
    assert np.allclose(total.mean_error[0, :3], dispersions.attitude_error, atol=1e-12)
    record = scenarios.simulate(SCENARIO, PLAN.seed, 0)
    starts = [montecarlo.start(record, SETUP, PLAN.seed, run, dispersions) for run in range(200)]
    error = record.truth.bias[0] - np.array([start.bias for start in starts])
    assert np.all(np.abs(error.mean(axis=0) - 5e-3) < 4.0 * 1e-3 / np.sqrt(200))
    assert np.all(np.abs(error.var(axis=0) / 1e-6 - 1.0) < 4.5 * np.sqrt(2.0 / 200))


# ------------------------------------------------------------------------------------------------------------ engine

COUNTED = ["runs", "finite", "coverage", "histogram", "sensor_degrees", "worst_run", "worst_score", "example_error"]


@pytest.mark.parametrize(
    ("machine", "others"),
    [
        ("scalar", [(8, 2), (8, 5), (7, 2)]),
        ("lanes", [(1, 2), (7, 1), (8, 2), (1000, 2)]),
    ],
)
def test_runs_are_the_same_to_the_bit_in_chunks_of_any_size_on_any_number_of_threads(machine, others):
    """Every run counts, and the worst and the first ones in all their bits; in chunks of the same size all sums too."""
    reference = montecarlo.run_plan(PLAN, runs=36, chunk=8, threads=1, machine=machine)
    for chunk, threads in others:
        other = montecarlo.run_plan(PLAN, runs=36, chunk=chunk, threads=threads, machine=machine)
        assert not different(reference, other, COUNTED if chunk != 8 else None)
        for name in ("error_sum", "error_product_sum", "covariance_sum", "nees_sum", "log_nees_sum", "sensor_nis_sum"):
            total = getattr(reference, name)
            np.testing.assert_allclose(getattr(other, name), total, rtol=1e-11, atol=1e-13 * np.abs(total).max())


def test_several_filters_see_the_same_sensors():
    """Each as if it were alone, on machines of its own and simulated once for all."""
    setups_ = (SETUP, replace(SETUP, measurement_sigma_factor=2.0))
    options = {"runs": 12, "seed": 4, "epochs": 6, "nis_bins": 5}
    together = montecarlo.run(SCENARIO, setups_, **options)
    for filter_setup, sums in zip(setups_, together, strict=True):
        assert not different(sums, montecarlo.run_plan(planned(setup=filter_setup), runs=12, machine="scalar"))


def test_memory_does_not_grow_with_the_runs():
    """By less per chunk than a tenth of what keeping its statistics would take."""

    def peak(runs):
        tracemalloc.start()
        montecarlo.run_plan(PLAN, runs=runs, chunk=2, threads=1, machine="scalar")
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(4)
    # How many of the four chunks ahead are finished at one time depends on the threads; over 80 chunks they do not matter.
    assert (peak(172) - peak(12)) / 80 < 0.1 * scalar.run_chunk(PLAN, 0, 2).histogram.nbytes


def test_chunks_are_not_listed_and_the_last_may_be_short():
    assert list(itertools.islice(engine.chunks_of(10**12, 10, first=10), 2)) == [(10, 10), (20, 10)]
    assert list(engine.chunks_of(21, 8)) == [(0, 8), (8, 8), (16, 5)]


def test_no_chunk_is_submitted_far_ahead_of_the_first_unmerged_one():
    submitted = []
    merged = engine.in_order(engine.chunks_of(200, 1), lambda first, _: submitted.append(first) or first, 3)
    for k, first in enumerate(merged):
        assert first == k
        assert submitted == list(range(min(200, k + 3 * engine.AHEAD)))


def test_chunks_that_finish_out_of_order_are_merged_in_order():
    sums = montecarlo.run_plan(PLAN, runs=30, chunk=5, threads=1, machine="scalar")
    last = threading.Event()

    def last_first(first_run, runs):
        result = engine.compute((PLAN,), "scalar", first_run, runs)
        last.set() if first_run == 25 else last.wait(60.0)
        return result

    threads = threading.active_count()
    parts = [part for (part,) in engine.in_threads(6)(last_first, engine.chunks_of(30, 5))]
    time.sleep(0.1)
    assert threading.active_count() <= threads
    assert not different(sums, functools.reduce(montecarlo.merge, parts))


def test_an_error_in_a_thread_comes_out_and_ends_the_others():
    calls = []

    def work(first, runs):
        calls.append(first)
        if first == 20:
            raise InputError("no such thing")
        time.sleep(0.01)
        return ()

    with pytest.raises(InputError, match="no such thing"):
        list(engine.in_threads(2)(work, engine.chunks_of(10000, 10)))
    begun = len(calls)
    time.sleep(0.1)
    assert len(calls) == begun < 20


def test_nobody_waits_for_a_running_chunk_when_stopped():
    begun = threading.Event()

    def work(first, runs):
        begun.set()
        if first:
            time.sleep(30.0)
        return ()

    stopped = time.monotonic()
    finished = engine.in_threads(2)(work, engine.chunks_of(100, 10))
    next(finished)
    finished.close()
    assert time.monotonic() - stopped < 5.0


def test_the_machine_is_chosen_by_the_plan_and_reported():
    rough = planned(scenario=replace(SCENARIO, gyro=replace(SCENARIO.gyro, quantization=1e-6)))
    choice = montecarlo.choose(rough)
    assert choice.machine == "scalar"
    assert "quantization" in str(choice)
    assert montecarlo.choose(PLAN, "scalar").machine == "scalar"
    with pytest.raises(InputError, match=r"lanes .*quantization"):
        montecarlo.choose(rough, "lanes")


# ------------------------------------------------------------------------------------------------------------ replay


def test_lost_samples_and_jitter_go_through_too():
    """Epochs stay at their times, whatever samples were lost before them."""
    spec = replace(SCENARIO.gyro, drop_probability=0.2, sampling_jitter=1e-4)
    lossy = planned(scenario=replace(SCENARIO, gyro=spec))
    total = scalar.run_chunk(lossy, 0, 5)
    assert total.finite.tolist() == [5] * 7
    again = montecarlo.replay(lossy, 3, machine="scalar")
    assert len(again.record.increments) < 240
    rows = np.searchsorted(again.estimate.time, lossy.time + 1e-6, side="right") - 1
    assert np.array_equal(errors_at(again.estimate, again.record.truth, rows), total.example_error[3])
