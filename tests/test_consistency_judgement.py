"""The verdict: what it says, what it rests on, and its exit status."""

import functools
import json
import math
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from spin_plan import PLAN, SETUP

from strapdown import consistency, montecarlo
from strapdown.checks import InputError
from strapdown.consistency.judgement import Finding, holm
from strapdown.estimation import Gate, ProcessNoise
from strapdown.estimation.setup import FilterSetup, write_estimate
from strapdown.gyro import GyroSpec
from strapdown.montecarlo import verdicts
from strapdown.records import ErrorStateEstimate, Estimate, Innovations, Origin, Truth


def estimate(scale=1.0, samples=400, seed=0, *, bias_error=0.0, covariance=True, correlated=False):
    """An estimate whose innovations and errors are drawn as a right filter's, its innovations times a factor."""
    random = np.random.default_rng(seed)
    variance = np.array([1e-6] * 3 + [1e-10] * 3)
    epochs = 200
    truth = Truth(attitude=np.tile([1.0, 0.0, 0.0, 0.0], (epochs, 1)), bias=np.zeros((epochs, 3)))
    error = np.sqrt(variance) * random.standard_normal((epochs, 6))
    half = 0.5 * error[:, :3]
    attitude = np.concatenate([np.ones((epochs, 1)), -half], axis=1)
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    white = random.standard_normal((2, samples, 2))
    if correlated:
        white[1] = 0.8 * white[0] + 0.6 * white[1]
    time = np.arange(samples) * 0.5
    result = Estimate(
        time=np.arange(epochs) * 1.0,
        attitude=attitude,
        bias=-error[:, 3:] - bias_error * np.array([0.0, 0.0, 1e-5]),
        variance=np.tile(variance, (epochs, 1)),
        covariance=np.tile(np.diag(variance), (epochs, 1, 1)) if covariance else None,
        innovations={
            name: Innovations(time=time, innovation=scale * 1e-3 * white[k], variance=np.full((samples, 2), 1e-6))
            for k, name in enumerate(("star 1", "star 2"))
        },
    )
    return result, truth


def with_states(states):
    """The same of a filter with error states."""
    result, truth = estimate()
    block = ErrorStateEstimate(components=("x",), units=("1",), values=np.zeros((200, 1)), variance=np.ones((200, 1)))
    return replace(result, error_states=dict.fromkeys(states, block)), truth


def of_a_recording(result):
    """The same of a recording, whose σ are upper bounds."""
    return replace(result, motion="hand")


def test_a_right_filter_is_consistent():
    judgement = consistency.judge(*estimate())
    assert judgement.verdict == "consistent"
    assert judgement.required == 1.5
    assert pickle.loads(pickle.dumps(judgement)) == judgement  # also where a statistic has no bounds, NaN
    assert "a consistent filter fails with at most 1 %" in judgement.listing().notes[0]
    assert not any(finding.rejected for finding in judgement.findings)
    assert {finding.name for finding in judgement.findings} == {
        "NIS",
        "whiteness",
        "normality",
        "mean innovation",
        "cross-correlation",
        "NEES at the end",
        "time-averaged NEES",
    }
    assert judgement.headline.startswith(
        "consistent: attitude, bias and innovations; detectable error of σ: innovations of star 1 ×"
    )


@pytest.mark.parametrize(("scale", "leaning"), [(1.3, "optimistic"), (0.75, "pessimistic")])
def test_a_wrong_noise_is_named_with_its_direction(scale, leaning):
    judgement = consistency.judge(*estimate(scale))
    assert judgement.verdict == "not consistent"
    assert leaning in judgement.reason
    wrong = [finding for finding in judgement.findings if finding.rejected]
    assert [(finding.name, finding.of) for finding in wrong] == [("NIS", "star 1"), ("NIS", "star 2")]
    assert math.sqrt(wrong[0].value) == pytest.approx(scale, rel=0.05)
    assert "star 1" in judgement.words


def test_a_bias_error_shows_in_the_errors_alone():
    judgement = consistency.judge(*estimate(bias_error=10.0))
    rejected = {(finding.name, finding.of) for finding in judgement.findings if finding.rejected}
    assert ("NEES at the end", "bias") in rejected
    assert ("NEES at the end", "attitude") not in rejected
    assert not any(name == "NIS" for name, _ in rejected)
    blind = consistency.judge(estimate(bias_error=10.0)[0])
    assert blind.verdict == "cannot tell"
    assert "bias error that the initial state hides" in blind.limits[0]  # and it says what it cannot show


def test_an_error_that_hardly_moves_is_not_averaged_over_the_run_and_that_is_reported():
    """A bias error that drifts by a tenth of its σ over the run is one sample, not 200."""
    result, truth = estimate()
    slow = 1e-5 * (0.6 + 0.1 * np.linspace(0.0, 1.0, 200))[:, None] * np.array([1.0, -1.0, 1.0])
    judgement = consistency.judge(replace(result, bias=-slow), truth)
    assert "bias not testable from this run: its error changes too slowly, effective number" in judgement.reason
    averaged = {finding.of for finding in judgement.findings if finding.name == "time-averaged NEES"}
    assert "bias" not in averaged
    assert "attitude" in averaged


def test_epochs_without_a_reference_do_not_count():
    result, truth = estimate()
    known = np.arange(200) % 3 > 0
    rows = {name: getattr(result, name)[known] for name in ("time", "attitude", "bias", "variance", "covariance")}
    part = consistency.judge(replace(result, **rows), Truth(attitude=truth.attitude[known], bias=truth.bias[known]))
    gaps = consistency.judge(result, replace(truth, attitude=np.where(known[:, None], truth.attitude, np.nan)))
    assert gaps.findings == part.findings
    assert {"NEES at the end", "time-averaged NEES"} <= {finding.name for finding in gaps.findings}


@pytest.mark.parametrize(
    ("states", "averaged"),
    [
        ((), {"attitude", "bias", "state"}),
        (("gyro.drift",), {"attitude"}),
        (("gyro scale",), {"attitude"}),
        (("star 1.correlated",), set()),
    ],
)
def test_what_error_states_reach_is_not_averaged_over_one_run(states, averaged):
    """Their part of the errors may last longer than the run, which does not show it."""
    judgement = consistency.judge(*with_states(states))
    assert {finding.of for finding in judgement.findings if finding.name == "time-averaged NEES"} <= averaged
    assert ("attitude" in averaged) == any(
        f.name == "time-averaged NEES" and f.of == "attitude" for f in judgement.findings
    )
    assert ("with further error states is not known" in judgement.reason) == bool(states)


def test_sensors_that_share_an_error_are_reported():
    judgement = consistency.judge(estimate(correlated=True)[0])
    assert [(f.name, f.of) for f in judgement.findings if f.rejected] == [("cross-correlation", "star 1, star 2")]
    assert f"1 of {len(judgement.findings)} tests contradicts it" in judgement.headline
    few = estimate(samples=consistency.judgement.MIN_SAMPLES - 1, correlated=True)[0]
    assert "cross-correlation" not in {f.name for f in consistency.judge(few).findings}


def test_too_little_cannot_tell():
    nothing = replace(estimate()[0], innovations={})
    assert consistency.judge(nothing).verdict == "cannot tell"
    variances = consistency.judge(*estimate(covariance=False))
    reason = "cannot tell: innovations consistent; attitude and bias not testable from this run: no full covariances"
    assert variances.headline.startswith(reason)
    few = consistency.judge(estimate(samples=8)[0])
    assert few.verdict == "cannot tell"
    assert "innovations not testable from this run: only an error of σ of ×" in few.reason
    assert consistency.judge(estimate(scale=20.0, samples=8)[0]).verdict == "not consistent"  # gross needs few


def test_refused_measurements_are_left_out():
    result, _ = estimate()
    weight = np.ones(400)
    weight[::20] = 0.0
    struck = replace(result.innovations["star 1"], weight=weight)
    struck.innovation[::20] *= 30.0
    judgement = consistency.judge(replace(result, innovations={"star 1": struck}))
    assert not any(finding.rejected for finding in judgement.findings)
    assert judgement.limits[0] == "20 of 400 measurements of star 1 rejected by the gate"


def test_a_gate_makes_a_right_filter_neither_pessimistic_nor_its_innovations_odd():
    """A gate removes the largest of its innovations: their mean square is smaller, and they are not normal."""
    result, _ = estimate(samples=4000)
    gate = Gate(probability=0.95)
    gated = {
        name: replace(series, weight=np.where(series.nis > gate.thresholds[1], 0.0, 1.0))
        for name, series in result.innovations.items()
    }
    result, rejected = replace(result, innovations=gated), []
    for filter_setup in (None, replace(SETUP, gate=gate)):
        findings = consistency.judge(replace(result, setup=filter_setup)).findings
        rejected.append({finding.name for finding in findings if finding.rejected})
    assert rejected == [{"NIS", "normality"}, set()]


def test_a_truth_at_other_times_and_a_level_of_zero_are_refused():
    result, truth = estimate()
    with pytest.raises(InputError, match="confidence_level is 0"):
        consistency.judge(result, truth, confidence_level=0.0)
    with pytest.raises(InputError, match="own times"):
        consistency.judge(result, Truth(attitude=truth.attitude[:5], bias=truth.bias[:5]))


@pytest.mark.parametrize(
    ("p_values", "rejected"),
    [((0.02, 0.01, 0.04), [True, True, True]), ((0.03, 0.01, 0.04), [False, True, False])],
)
def test_holm_steps_down(p_values, rejected):
    """0.01 ≤ 0.05/3, then 0.02 ≤ 0.05/2 and 0.03 > 0.05/2, then 0.04 ≤ 0.05."""
    assert holm(p_values, 0.05) == rejected


def test_a_sigma_wrong_by_the_power_stated_is_found():
    """At the stated factor, too small or too large, the verdict is "not consistent" in 97 % of runs or more, and mostly not at a third of
    its logarithm."""
    right = consistency.judge(*estimate())
    power = {part.of: part.detectable_error for part in right.parts}
    assert set(power) == {"innovations of star 1", "innovations of star 2", "attitude", "bias"}
    factor = power["innovations of star 1"]
    for scale in (factor, 1.0 / factor):
        verdicts = [consistency.judge(estimate(scale, seed=seed)[0]).verdict for seed in range(40)]
        assert verdicts.count("not consistent") >= 39
    near = [consistency.judge(estimate(factor**0.33, seed=seed)[0]).verdict for seed in range(40)]
    assert near.count("not consistent") < 30


def test_a_state_that_nothing_tests_is_named():
    result, truth = with_states(["gyro.scale"])
    blind = consistency.judge(result)
    assert blind.headline.startswith(
        "cannot tell: innovations consistent; attitude and bias not testable from this run: the truth is not known; detectable error of σ: "
    )
    assert all(math.isinf(part.detectable_error) for part in blind.parts if not part.of.startswith("innovations"))
    assert any("the σ of gyro.scale is not tested: the truth is not known" in limit for limit in blind.limits)
    spec = GyroSpec(angle_random_walk=1e-5, asymmetry=(9e-6, 0.0, 0.0))
    noise = ProcessNoise(angle_random_walk=1e-5, rate_random_walk=0.0)
    setup = FilterSetup(process_noise=noise, bias_sigma=1e-3)
    judgement = consistency.judge(replace(result, origin=Origin(gyro=spec), setup=setup), truth)
    assert judgement.reason.endswith("the filter does not model the gyro's asymmetry of 9 ppm")
    plain = json.loads(json.dumps(blind.summary(), allow_nan=False))["parts"]
    assert plain[-1] == {"of": "bias", "detectable_error": None, "why": "the truth is not known"}


def test_upper_bounds_are_contradicted_by_what_exceeds_them_alone():
    """The noise of a recording's filter covers disturbances that last: innovations a tenth as large, and correlated."""
    for scale, status in ((0.1, "cannot tell"), (1.0, "cannot tell"), (1.2, "not consistent")):
        judged = consistency.judge(of_a_recording(estimate(scale, correlated=True)[0]))
        assert judged.verdict == status
        assert {finding.name for finding in judged.findings} == {"NIS"}
    judged = consistency.judge(of_a_recording(estimate(0.1)[0]))
    assert "innovations within σ; attitude and bias not testable from this run: the truth is not known" in judged.reason
    assert "RMS over σ: innovations of star 1 0.1" in judged.reason
    small, truth = estimate(0.1)
    small = consistency.judge(of_a_recording(small), truth)
    assert small.verdict == "consistent"
    total = math.sqrt(np.mean((2.0 * np.arccos(estimate()[0].attitude[:, 0])) ** 2) / 3e-6)
    assert f"RMS over σ: total {total:.2g}, heading" in small.reason
    assert all(finding.low <= finding.value <= finding.high for finding in small.findings)  # as it passes
    large, truth = estimate(0.1, bias_error=10.0)
    assert consistency.judge(of_a_recording(large), truth).verdict == "not consistent"


@pytest.mark.parametrize("samples", [200, 20, 1])
def test_resolution_is_the_factor_that_bounds_leave(samples):
    finding = Finding(name="NIS", of="star", value=1.0, p_value=0.5, samples=samples, degrees=2)
    low, high = consistency.mean_bounds(2, samples, 0.99)
    judged = consistency.concluded([finding], [], 0.99, parts={"innovations of star": ""})
    assert judged.parts[0].detectable_error == pytest.approx(math.sqrt(high / low))
    assert judged.verdict == ("consistent" if samples == 200 else "cannot tell")
    unseen = f"innovations not testable from this run: only an error of σ of ×{math.sqrt(high / low):.3g}"
    assert judged.reason.startswith("innovations; detectable error" if samples == 200 else unseen)
    asked = consistency.concluded([finding], [], 0.99, parts={"innovations of star": ""}, required=1.1)
    assert asked.verdict == "cannot tell"


# ------------------------------------------------------------------------------------------------------------ independent runs


@functools.cache
def statistics_of(runs=200, **changes):
    return montecarlo.run_plan(replace(PLAN, setup=replace(SETUP, **changes), seed=3), runs=runs)


def test_right_runs_are_consistent_and_wrong_ones_are_reported():
    good = statistics_of().judge()
    assert good.verdict == "consistent"
    assert {f.name for f in good.findings} == {"ANEES", "log-NEES", "mean error", "coverage", "NIS"}
    assert {f.of for f in good.findings if f.name == "NIS"} == {"sun sensor", "star"}
    assert good.words == good.headline  # what a passing statistic would mean is not said
    sure = statistics_of(measurement_sigma_factor=0.8).judge()
    assert sure.verdict == "not consistent"
    assert "optimistic" in sure.reason
    assert sure.words.split("\n  - ")[1:] == [f.means for f in sure.findings if f.rejected and f.means]
    names = {f.name for f in sure.findings if f.rejected}
    assert {"ANEES", "log-NEES", "NIS", "coverage"} <= names
    assert "mean error" not in names
    modest = statistics_of(measurement_sigma_factor=1.3).judge()
    assert "pessimistic" in modest.reason


def test_the_coverage_of_the_worst_epoch_and_state_stands_for_all():
    """99 of 100 errors of one state within 1 σ at one epoch, all others the expected number: binomial, times the number of tests."""
    few = statistics_of(runs=100)
    usual = np.array([68, 95, 100])
    counts = np.tile(usual, (7, 6, 1))
    counts[6, 4, 0] = 82
    judged = replace(few, coverage=counts).judge(epochs=np.array([3, 6]))
    (coverage,) = (finding for finding in judged.findings if finding.name == "coverage")
    least = 2.0 * scipy.stats.binom.sf(81, 100, math.erf(math.sqrt(0.5)))
    assert (coverage.of, coverage.value) == ("bias y", 0.82)
    assert coverage.p_value == pytest.approx(36 * least, rel=1e-9)
    assert "82 % of the bias y errors lie within 1 σ" in coverage.means
    assert coverage.at == f"within 1σ, worst at {few.time[6]:g} s"


def test_few_runs_cannot_tell():
    single = statistics_of(runs=1)
    assert "not testable from 1 run:" in single.judge().reason
    assert [t.title for t in verdicts.tables(verdicts.summary(single)) if "1 runs" in t.title] == []
    few = statistics_of(runs=2)
    starved = replace(few, sensor_degrees=0 * few.sensor_degrees)
    assert starved.judge().verdict == "cannot tell"


def test_runs_that_failed_are_not_consistent():
    good = statistics_of()
    finite = good.finite.copy()
    finite[-1] -= 1
    judged = replace(good, finite=finite).judge()
    assert judged.verdict == "not consistent"
    assert "1 of 200 runs failed" in judged.words
    assert "optimistic" not in judged.words
    assert judged.reason.startswith("the filter failed")


def test_bounds_are_those_that_decide():
    """NIS from right to wrong: the value leaves the printed bounds where Holm's procedure rejects it, not at 1 % of it alone."""
    decided = []
    for scale in np.linspace(1.0, 1.12, 13):
        judgement = consistency.judge(*estimate(scale, seed=4))
        decided += [
            (finding.low <= finding.value <= finding.high, finding.rejected, finding.p_value)
            for finding in judgement.findings
            if finding.is_ratio
        ]
    assert all(inside is not rejected for inside, rejected, _ in decided)
    assert any(inside and p < 0.01 for inside, _, p in decided)  # alone it would have been rejected
    for factor in (1.0, 0.97, 0.8):
        judgement = statistics_of(measurement_sigma_factor=factor).judge()
        bounded = [finding for finding in judgement.findings if math.isfinite(finding.low)]
        assert {finding.name for finding in bounded} == {"ANEES", "log-NEES", "NIS"}
        assert all((finding.low <= finding.value <= finding.high) is not finding.rejected for finding in bounded)
        assert all(
            re.fullmatch(r"(mean [\d.]+, )?worst at [\d.]+ s", finding.at)
            for finding in bounded
            if finding.name != "NIS"
        )


# ---------------------------------------------------------------------------------------------------------------- the command


def test_check_refuses_what_it_cannot_judge(run, refusal, tmp_path):
    status, said, wrong = run("check", "absent.h5")
    assert (status, said) == (2, "")
    assert wrong == "error: absent.h5 does not exist; check the path\n"
    (tmp_path / "text.h5").write_text("no HDF5")
    assert "cannot be read as HDF5" in run("check", "text.h5")[2]
    (tmp_path / "unit.csv").write_text("time,gx\n0,1\n")
    write_estimate(tmp_path / "estimate.h5", estimate()[0])
    for command in (("report", "unit.csv"), ("check", "estimate.h5", "--record", "unit.csv")):
        assert (
            "a recording (for `strapdown estimate`) or a table of attitudes (for `strapdown check`)" in run(*command)[2]
        )
    assert "--filter goes with --record" in run("check", "text.h5", "--filter", "f.toml")[2]
