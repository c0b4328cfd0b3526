"""What the tuned filter leaves unexplained: a scale factor that the gyro's noise stands for, gyros of two kinds in one tuning."""

import dataclasses
import functools
import json

import numpy as np
import pytest
from scipy.stats import chi2
from two_stars import stars

from strapdown import motion, scenarios, tuning, vectors
from strapdown.estimation import setup
from strapdown.estimation.gating import Gate
from strapdown.gyro import GyroSpec
from strapdown.recordings import recordfiles
from strapdown.records import Origin
from strapdown.report import tunings
from strapdown.tuning import residual_checks
from strapdown.tuning.diagnosis import hypotheses

SPEC = GyroSpec(angle_random_walk=3e-5, rate_random_walk=2e-7, turn_on_bias_sigma=1e-5)


def scenario(scale_factor: float = 0.0, duration: float = 900.0) -> scenarios.Scenario:
    """A body that rocks slowly: its rate changes sign every 100 s."""
    return scenarios.Scenario(
        motion=motion.SpinRock(rock_angle=0.3, rock_frequency=0.005, spin_rate=0.02),
        gyro=dataclasses.replace(SPEC, scale_factor=np.full(3, scale_factor)),
        sensors=stars(1e-4, 2e-4),
        rate=10.0,
        duration=duration,
    )


@functools.cache
def tuned(seed: int, scale_factor: float = 0.0) -> tuple[tuning.Case, tuning.Tuning]:
    star_scenario = scenario(scale_factor)
    filter_setup = setup.FilterSetup.for_scenario(star_scenario, states=False)
    case = tuning.record_case(scenarios.simulate(star_scenario, seed), filter_setup, name=f"record {seed}", seed=seed)
    names = tuning.default_names([case.record])
    return case, tuning.fit(tuning.likelihood([case], filter_setup, names), starts=1)


def test_a_scale_factor_that_the_walk_of_the_bias_stands_for_is_found_with_its_size():
    doubted = 0
    for seed in (1, 2):
        case, result = tuned(seed, 1e-3)
        bare = dataclasses.replace(case, record=dataclasses.replace(case.record, truth=None))
        examined = tuning.examined([bare], result)
        (unmodelled,) = examined.unmodelled
        assert unmodelled.moves_with_the_rate
        size = unmodelled.scale_factor
        assert np.all(np.abs(size.estimate - 1e-3) < 4.0 * size.standard_error)
        assert np.all(size.standard_error[:2] < 4e-4)
        assert any("scale factor of the gyro" in words for words in unmodelled.words)
        said = dataclasses.replace(examined, remarks=unmodelled.remarks).words
        assert [words.count("does not model the gyro's scale factor of 1000 ppm") for words in said].count(1) == 1
        notes = {parameter.name: parameter.note for parameter in examined.parameters}
        doubted += "in doubt" in notes["gyro.rrw"]
        assert not any("in doubt" in note for name, note in notes.items() if name != "gyro.rrw")
        assert json.dumps(unmodelled.summary())
        assert size.finding.p_value == pytest.approx(chi2.sf(size.gain, 3), rel=1e-9)
    assert doubted >= 1  # where the walk is called identified it is put in doubt
    # A cause that explains more goes first.
    cause = dataclasses.replace(size, name="hard iron", of="star 1", gain=size.gain + 1.0)
    assert not dataclasses.replace(unmodelled, causes=(cause,)).moves_with_the_rate
    assert dataclasses.replace(unmodelled, causes=(dataclasses.replace(cause, gain=1.0),)).moves_with_the_rate


def test_of_right_filters_hardly_one_is_suspected():
    suspected, gains = 0, []
    for seed in range(10, 13):
        case, result = tuned(seed)
        examined = tuning.examined([case], result)
        (unmodelled,) = examined.unmodelled
        suspected += unmodelled.suspected
        gains.append(unmodelled.scale_factor.gain)
        if not unmodelled.suspected:
            assert unmodelled.words == ()
            assert examined.parameters == result.parameters
    assert suspected <= 1
    assert np.mean(gains) < 6.0  # χ² of three degrees of freedom


def test_measurements_with_a_sigma_for_each_axis_are_not_examined():
    case, result = tuned(10)
    star, *others = case.record.vectors
    record = dataclasses.replace(
        case.record, vectors=(dataclasses.replace(star, sigma=0.0, sigma_axes=[1e-4, 2e-4, 2e-4]), *others)
    )
    assert tuning.examined([dataclasses.replace(case, record=record)], result) is result


def test_the_turns_are_those_of_the_body_without_its_bias():
    case, result = tuned(4)
    initial = setup.initial_state(result.setup, case.initial.attitude, case.initial.bias)
    turns = hypotheses.turns(case.record, result.setup.process_noise, initial)
    exact = scenario().motion.increments(case.record.time)
    late = slice(2000, -100)
    assert np.std(turns[late] - exact[late], axis=0).max() < 0.15 * np.std(exact, axis=0).max()
    # Of the noise hardly anything is left.
    assert np.std((turns - exact)[late]) < 0.3 * np.std((case.record.increments - exact)[late])


def test_the_turns_leave_out_a_large_bias():
    biased = dataclasses.replace(scenario(), gyro=dataclasses.replace(SPEC, turn_on_bias=np.full(3, 1e-2)))
    filter_setup = dataclasses.replace(setup.FilterSetup.for_scenario(biased, states=False), bias_sigma=1e-2)
    case = tuning.record_case(scenarios.simulate(biased, 1), filter_setup, seed=1)
    turns = hypotheses.turns(case.record, filter_setup.process_noise, case.initial)
    excess = (turns - biased.motion.increments(case.record.time))[2000:-100] * 10.0
    assert np.abs(excess.mean(axis=0)).max() < 2e-4


STILL = {
    "motion": motion.ConstantRate(rate=np.zeros(3)),
    "gyro": dataclasses.replace(SPEC, angle_random_walk=1e-4, rate_random_walk=2e-5),
}
LONG = {
    "motion": motion.ConstantRate(rate=np.radians([0.02, -0.05, 0.1])),
    "gyro": GyroSpec(angle_random_walk=4e-5, rate_random_walk=8e-7),
    "sensors": stars(2e-3, 2e-3),
    "rate": 4.0,
    "duration": 30000.0,
}


@pytest.mark.parametrize(("changes", "seeds"), [(STILL, range(3)), (LONG, (1,))], ids=["at rest", "a long time"])
def test_noise_explains_nothing(changes, seeds):
    """All that the rate of a body at rest shows is the gyro's noise, and taking off all of it would help; no scale factor is so large.

    Of eight hours even what is left of it in an average over a few samples would seem a scale factor of several percent.
    """
    changed = dataclasses.replace(scenario(), **changes)
    filter_setup = setup.FilterSetup.for_scenario(changed, states=False)
    for seed in seeds:
        case = tuning.record_case(scenarios.simulate(changed, seed), filter_setup, seed=seed)
        scale_factor = residual_checks.scale_factor(case.record, filter_setup.process_noise, case.initial)
        assert scale_factor.finding.p_value > 0.05
        assert np.abs(scale_factor.estimate).max() < 5.0 * hypotheses.PLAUSIBLE
        assert changes is STILL or np.all(np.abs(scale_factor.estimate) < 3.0 * scale_factor.standard_error)


def test_a_walk_that_was_left_too_large_is_no_scale_factor():
    case, result = tuned(4)
    large = tuning.with_values(result.setup, {"gyro.rrw": 2e-6})
    scale_factor = residual_checks.scale_factor(case.record, large.process_noise, case.initial)
    assert scale_factor.finding.p_value > 0.05


def test_what_the_gate_refuses_is_left_out():
    faults = vectors.Faults(outlier_probability=0.05)
    faulty = dataclasses.replace(
        scenario(), sensors=tuple(dataclasses.replace(sensor, faults=faults) for sensor in scenario().sensors)
    )
    filter_setup = dataclasses.replace(
        setup.FilterSetup.for_scenario(faulty, states=False), gate=Gate(probability=0.999)
    )
    suspected = 0
    for seed in range(2):
        case = tuning.record_case(scenarios.simulate(faulty, seed), filter_setup, seed=seed)
        unmodelled = tuning.unmodelled(case, filter_setup)
        assert not {finding.name for finding in unmodelled.judgement.findings} & {"NIS", "normality"}
        suspected += unmodelled.suspected
    assert suspected <= 1  # of two
    estimate = setup.run(case.record, filter_setup, case.initial)
    left = residual_checks.accepted(case.record, estimate)
    for series, before in zip(left.vectors, case.record.vectors, strict=True):
        assert len(series.time) == len(before.time) - estimate.innovations[series.sensor].refused
        assert 0.02 < estimate.innovations[series.sensor].refused / len(before.time) < 0.06


def test_what_is_held_out_is_left_out():
    case, _ = tuned(1)
    (train,), _ = tuning.split([case], 0.4)
    assert residual_checks.record_for_tuning(train).time[-1] == pytest.approx(540.0)
    assert residual_checks.record_for_tuning(case) is case.record


def test_a_hard_iron_is_named_where_the_innovations_are_not_white():
    scenario = scenarios.load_scenario("low-orbit")
    filter_setup = setup.FilterSetup.for_scenario(scenario, states=False)
    case = tuning.record_case(
        scenarios.simulate(dataclasses.replace(scenario, duration=1200.0), 5), filter_setup, seed=5
    )
    unmodelled = tuning.unmodelled(case, filter_setup)
    assert unmodelled.causes
    assert unmodelled.causes[0].name == "hard iron"
    assert not unmodelled.moves_with_the_rate
    assert any(words.startswith("Known, as specified: magnetometer has a hard iron") for words in unmodelled.words)
    silent = dataclasses.replace(case, record=dataclasses.replace(case.record, origin=None))
    unmodelled = tuning.unmodelled(silent, filter_setup)
    assert any("Most likely cause: magnetometer has a hard iron" in words for words in unmodelled.words)


def test_the_command_reports_it_and_refuses_two_kinds(succeeds, refusal, tmp_path):
    first, second, out = tmp_path / "a.h5", tmp_path / "b.h5", tmp_path / "tuned.toml"
    scaled = scenario(1e-3)
    recordfiles.write_record(first, scenarios.simulate(scaled, 2))
    said = succeeds("tune", first, "--no-states", "--starts", 1, "-o", out)
    assert "scale factor of the gyro" in said
    assert "in doubt" in said
    (finding,) = json.loads(out.with_suffix(".json").read_text())["unmodelled"]
    assert finding["moves_with_the_rate"]
    np.testing.assert_allclose(finding["scale_factor"]["value"][:2], 1e-3, atol=1e-3)
    page, _ = tunings.report(out.with_suffix(".json"))
    assert "A scale factor of the gyro" in page
    other = dataclasses.replace(scaled.gyro, angle_random_walk=6e-5)
    brief = dataclasses.replace(scaled, gyro=other, duration=60.0)
    record = dataclasses.replace(scenarios.simulate(brief, 1), origin=Origin(gyro=other))
    recordfiles.write_record(second, record)
    complaint = refusal("tune", first, second, "-o", tmp_path / "none.toml")
    assert "recorded with another gyro" in complaint.replace("\n", " ")
    assert not (tmp_path / "none.toml").exists()
    # Where the gyro is given and only a sensor is free, it does no harm.
    options = ("--filter", out, "--free", "star 1.sigma", "--starts", 1, "-o", tmp_path / "sensor.toml")
    succeeds("tune", first, second, *options)
