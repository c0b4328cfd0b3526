"""Filter setups: the model of a right filter for a scenario, and their files."""

import dataclasses

import numpy as np
import pytest
from measured import series_of

import strapdown as sd
from strapdown import coning, estimation, montecarlo, quaternion, records, scenarios, units, vectors, workflows
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import FilterSetup
from strapdown.gyro import GyroSpec
from strapdown.records import ImuRecord, Origin
from strapdown.vectors import VectorMeasurements

SETUP = FilterSetup(
    process_noise=estimation.ProcessNoise(angle_random_walk=1.234567e-5, rate_random_walk=3.3e-8),
    attitude_sigma=0.0123,
    bias_sigma=4.5e-6,
    integration=coning.ALGORITHMS["four-sample"],
    measurement_sigma_factor=1.25,
    sigma={"star 1": 1.7e-4, "sun": 2e-3},
)


def scenario(**changes):
    base = scenarios.load_scenario("coning")
    return dataclasses.replace(base, **changes)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"sigma": {"star": (1.7e-4, 1.0 / 3.0e4, 2.1e-5), "sun": 2e-3}},
        {"gate": Gate()},
        {"gate": Gate(probability=0.99, recovery=None, restart_attitude_sigma=0.3, restart_bias_sigma=1e-5)},
        {"robust": Robust()},
        {"robust": Robust(kind="huber", probability=0.9, iterations=3), "gate": Gate(recovery=7)},
    ],
)
def test_a_setup_goes_through_its_file_to_the_last_bit(tmp_path, change):
    path = tmp_path / "filter.toml"
    whole = dataclasses.replace(SETUP, **change)
    path.write_text(setup.to_toml(whole), encoding="utf-8")
    assert setup.read_setup(path) == whole


def test_the_gate_of_a_setup_is_that_of_its_filter():
    record = scenarios.simulate(scenario(duration=10.0))
    first, *rest = record.vectors
    vector = first.vector_b.copy()
    vector[-3] = -vector[-3]
    record = dataclasses.replace(record, vectors=(dataclasses.replace(first, vector_b=vector), *rest))
    filter_setup = setup.FilterSetup.for_scenario(scenario(), states=False)
    start = setup.initial_state(filter_setup, record.truth.attitude[0], record.truth.bias[0])
    gated = dataclasses.replace(filter_setup, gate=Gate())
    assert setup.run(record, gated, start).refused[first.sensor] == 1
    assert setup.run(record, gated, start, gate=None).refused[first.sensor] == 0
    assert setup.run(record, filter_setup, start).refused[first.sensor] == 0


def test_a_sigma_beyond_half_a_turn_is_refused_of_angles_alone():
    wide = dataclasses.replace(SETUP, sigma={"star": (1e-4, 3.2, 1e-4)})
    for kind in ("direction", "heading", "attitude"):
        with pytest.raises(InputError, match=r"mine: sigma: star is 3\.2 rad, more than half a rotation"):
            setup.need_angles(wide, {"star": kind}, "mine")
    for kinds in ({"star": "vector"}, {}):
        setup.need_angles(wide, kinds, "mine")
    setup.need_angles(dataclasses.replace(SETUP, sigma={"star": 3.1}), {"star": "direction"}, "mine")


def test_a_file_without_the_table_says_what_writes_one(tmp_path):
    path = tmp_path / "gyro.toml"
    path.write_text("[gyro]\n")
    with pytest.raises(InputError, match=r"no table \[filter\]"):
        setup.read_setup(path)


def test_matched_takes_the_gyro_at_its_word():
    """A Gauss–Markov bias starts from its stationary spread."""
    spec = GyroSpec(angle_random_walk=2e-5, rate_random_walk=1e-8, turn_on_bias_sigma=3e-5)
    filter_setup = setup.FilterSetup.for_scenario(scenario(gyro=spec), states=False)
    assert filter_setup.process_noise == estimation.ProcessNoise(angle_random_walk=2e-5, rate_random_walk=1e-8)
    assert filter_setup.bias_sigma == pytest.approx(3e-5)
    spec = GyroSpec(angle_random_walk=2e-5, markov_noise=1e-6, markov_correlation_time=800.0)
    assert setup.FilterSetup.for_scenario(scenario(gyro=spec), states=False).bias_sigma == pytest.approx(
        1e-6 * np.sqrt(400.0)
    )


def test_flicker_raises_both_noises():
    spec = GyroSpec(angle_random_walk=2e-5, bias_instability=5.0 * units.DEGREE_PER_HOUR)
    noise = setup.FilterSetup.for_scenario(scenario(gyro=spec), states=False).process_noise
    assert noise.angle_random_walk > 2e-5
    assert noise.rate_random_walk > 0.0
    blind = setup.FilterSetup.for_scenario(scenario(gyro=spec, sensors=()), states=False).process_noise
    assert blind.rate_random_walk < noise.rate_random_walk  # bounded over the whole record


def test_beside_states_the_rate_random_walk_is_that_of_the_worst_axis_alone():
    """A Gauss–Markov drift of finite correlation time is a state; of infinite time it is a random walk more, σ² added."""
    walks = {"angle_random_walk": 2e-5, "rate_random_walk": (1e-8, 3e-8, 2e-8), "markov_noise": 4e-8}
    for time, sigma in ((800.0, 3e-8), (np.inf, 5e-8)):
        spec = GyroSpec(**walks, markov_correlation_time=time)
        noise = setup.FilterSetup.for_scenario(scenario(gyro=spec), states=True).process_noise
        assert noise.rate_random_walk == pytest.approx(sigma, rel=1e-12)
        assert noise.angle_random_walk == pytest.approx(2e-5, rel=1e-12)


def test_measurement_density_counts_what_each_kind_measures():
    record = scenarios.simulate(scenario())
    sigma = record.vectors[0].sigma[0]
    number = sum(len(series.time) for series in record.vectors)
    expected = (record.time[-1] - record.time[0]) * sigma**2 / (number * 2.0 / 3.0)
    assert setup.matching.measurement_density(record) == pytest.approx(expected)
    assert setup.matching.measurement_density(dataclasses.replace(record, vectors=())) == np.inf
    x, time = np.array([1.0, 0.0, 0.0]), np.arange(1.0, 5.0)
    compass = series_of("a", "heading", time, np.tile(x, (4, 1)), x, 0.1)
    field = series_of("b", "vector", time, np.tile(2.0 * x, (4, 1)), 2.0 * x, 0.2)
    whole = np.tile(quaternion.IDENTITY, (4, 1))
    tracker = VectorMeasurements(sensor="c", kind="attitude", time=time, attitude=whole, sigma_axes=[0.1, 0.2, 0.4])
    for series, information in ((compass, 100.0), (field, 200.0), (tracker, 100.0 + 25.0 + 6.25)):
        single = ImuRecord(time=np.array([0.0, 8.0]), increments=np.zeros((1, 3)), vectors=(series,))
        assert setup.matching.measurement_density(single) == pytest.approx(8.0 / (4.0 * information / 3.0))
        ideal = {"sigma_axes": np.zeros(3)} if series.attitude is not None else {"sigma": np.zeros(4)}
        no_noise = dataclasses.replace(single, vectors=(dataclasses.replace(series, **ideal),))
        assert setup.matching.measurement_density(no_noise) == np.inf  # without a warning


def test_modelled_record_replaces_sigmas_by_name_and_keeps_ratios():
    record = scenarios.simulate(scenario())
    first, *rest = record.vectors
    uneven = dataclasses.replace(first, sigma=np.linspace(1.0, 2.0, len(first.time)) * 1e-3)
    record = dataclasses.replace(record, vectors=(uneven, *rest))
    filter_setup = dataclasses.replace(SETUP, sigma={first.sensor: 5e-4}, measurement_sigma_factor=1.0)
    taken = setup.modelled_record(record, filter_setup).vectors
    assert np.sqrt(np.mean(taken[0].sigma ** 2)) == pytest.approx(5e-4)
    np.testing.assert_allclose(taken[0].sigma / taken[0].sigma[0], uneven.sigma / uneven.sigma[0])
    assert taken[1] is rest[0]
    of_axes = np.array([1e-4, 2e-4, 3e-4])
    by_axis = dataclasses.replace(filter_setup, sigma={first.sensor: tuple(of_axes)}, measurement_sigma_factor=2.0)
    level = uneven.sigma / np.sqrt(np.mean(uneven.sigma**2))
    axes = setup.modelled_record(record, by_axis).vectors[0].sigma_axes
    np.testing.assert_allclose(axes, 2.0 * level[:, None] * of_axes)
    with pytest.raises(InputError, match="star 1"):
        setup.modelled_record(record, dataclasses.replace(filter_setup, sigma={"star one": 1e-3}))


def unmodelled(scenario, states=None):
    filter_setup = dataclasses.replace(setup.FilterSetup.for_scenario(scenario, states=False), states=states)
    return setup.unmodelled_errors(Origin(gyro=scenario.gyro, scenario=scenario), filter_setup)


def test_what_the_filter_does_not_model_is_reported_in_words():
    clean = scenarios.load_scenario("two-stars")
    assert unmodelled(clean) == ()
    orbit = scenarios.load_scenario("low-orbit")
    words = " and ".join(unmodelled(orbit))
    for part in ("misalignment", "flicker of 2 °/h", "hard iron of the magnetometer"):
        assert part in words
    held = scenarios.load_scenario("hand-held")
    words = " and ".join(unmodelled(held))
    for part in ("quantisation", "lever arm", "correlated noise of the magnetometer"):
        assert part in words
    some = setup.FilterSetup.for_scenario(held, states=True).states.select(("gyro.drift", "accelerometer.lever"))
    words = " and ".join(unmodelled(held, some))
    assert "correlated noise of the magnetometer" in words
    assert "lever arm" not in words
    assert "flicker" not in words
    lossy = dataclasses.replace(clean, gyro=dataclasses.replace(clean.gyro, drop_probability=0.05), gyro_preset="")
    assert unmodelled(lossy) == ("the gyro's lost samples, 5 % of all",)


def test_a_gyro_with_unequal_axes_makes_its_filter_pessimistic_and_that_is_said():
    """The covariance analysis has the errors of each axis: those about the quieter ones are below the filter's σ, by less than stated."""
    scenario = dataclasses.replace(scenarios.load_scenario("two-stars"), duration=100.0)
    arw = float(np.max(scenario.gyro.angle_random_walk))
    unequal = dataclasses.replace(scenario.gyro, angle_random_walk=(0.25 * arw, 0.25 * arw, arw))
    other = dataclasses.replace(scenario, gyro=unequal, gyro_preset="")
    plan = sd.workflows.plan(other)
    (words,) = plan.unmodelled
    assert "(angle random walk ×4; σ about the quieter ones are too large" in words
    analysis = sd.covariance_analysis(other, plan.setup, epochs=5)
    ratio = np.sqrt(np.diagonal(analysis.filter_covariance[-1])) / analysis.rms[-1]
    assert np.all(ratio[[0, 1]] > 1.1)
    assert np.all(ratio[[0, 1]] < 4.0)
    assert ratio[2] == pytest.approx(1.0, abs=0.01)
    result = sd.estimate(sd.simulate(other))
    assert words in sd.check(result).unmodelled
    assert f"The filter does not model {words}." in result.remarks
    assert words in sd.monte_carlo(other, runs=8).judge().unmodelled
    assert analysis.unmodelled == (words,)

    assert sd.workflows.plan(scenario).unmodelled == ()
    quieter = dataclasses.replace(
        plan.setup, process_noise=sd.ProcessNoise(angle_random_walk=0.5 * arw, rate_random_walk=0.0)
    )
    assert sd.workflows.plan(other, setup=quieter).unmodelled == ()
    none = dataclasses.replace(unequal, bias_instability=(0.0, 0.0, 1e-6))
    words = sd.workflows.plan(dataclasses.replace(other, gyro=none)).unmodelled[-1]
    assert "angle random walk ×4, bias instability of some axes only; σ about the quieter ones are too large)" in words


@pytest.mark.parametrize(
    ("error", "words"),
    [
        ({"rate_ramp": 20.0 * units.DEGREE_PER_HOUR / 3600.0}, "the gyro's rate ramp of 20 °/h²"),
        ({"bandwidth": 40.0}, "the lag of the gyro's bandwidth of 40 Hz"),
        ({"timestamp_offset": -0.05}, "the gyro's time stamps, late by -0.05 s"),
        ({"timestamp_error": 0.002}, "the gyro's irregular sampling or time stamps"),
        ({"sampling_jitter": 0.002}, "the gyro's irregular sampling or time stamps"),
    ],
)
def test_errors_of_the_gyro_that_no_state_covers_are_named(error, words):
    gyro = GyroSpec(angle_random_walk=1e-5, **error)
    assert unmodelled(dataclasses.replace(scenarios.load_scenario("two-stars"), gyro=gyro, gyro_preset="")) == (words,)


def test_states_are_advised_to_the_filter_that_can_have_them():
    spin = scenarios.load_scenario("spin")
    origin, plain = Origin(gyro=spin.gyro, scenario=spin), setup.FilterSetup.for_scenario(spin, states=False)
    own = dataclasses.replace(plain, estimator=lambda record, initial: None)
    for belief, advised in ((plain, True), (own, False)):
        (words,) = setup.unmodelled_words(origin, belief)
        assert ("`states=True` adds states" in words) == advised
    assert setup.unmodelled_words(origin, setup.FilterSetup.for_scenario(spin)) == []


@pytest.mark.parametrize("name", ["mine.py:textbook", "folder.x/mine.py"])
def test_a_python_file_is_no_setup(name):
    with pytest.raises(InputError, match=f"{name} is a filter of your own, .* give a TOML file"):
        setup.read_setup(name)


def test_outliers_are_reported_unless_the_filter_has_a_gate_or_robust_weights():
    tracker = vectors.AttitudeSensor(
        name="tracker", sigma_across=1e-4, sigma_about=4e-4, rate=1.0, faults=vectors.Faults(outlier_probability=0.1)
    )
    faulty = scenario(gyro=GyroSpec(angle_random_walk=2e-5), sensors=(tracker,), duration=20.0)
    record = scenarios.simulate(faulty, 1)
    plain = setup.FilterSetup.for_scenario(faulty)
    for change, outliers in (
        ({}, ("the outliers of the tracker (a gate rejects them)",)),
        ({"gate": Gate(probability=0.999)}, ()),
        ({"robust": Robust()}, ()),
    ):
        changed = dataclasses.replace(plain, **change)
        assert setup.unmodelled_errors(record.origin, changed) == outliers
        plan = montecarlo.Plan(scenario=faulty, setup=changed, epochs=20)
        assert plan.unmodelled == outliers
        estimate = sd.estimate(record, **change)
        assert ("outliers" in " ".join(estimate.remarks)) == bool(outliers)
        runs = montecarlo.campaign.Campaign(plan=plan, machine="scalar", chunk=1, runs=1, statistics=None)
        said = " ".join([*estimate.remarks, *montecarlo.campaign.words(runs, sd.check(estimate))])
        assert "states=True" not in said  # which has none for outliers
        assert "anees" not in runs.summary()  # no run is finished


@pytest.mark.parametrize("smooth", [False, True])
def test_a_record_is_modelled_once_also_if_the_filter_starts_late(smooth, monkeypatch):
    """Initial state and filter have the same increments and σ: an algorithm with samples before its step uses those before the start, and a
    varying σ is scaled by its mean over the whole record."""
    record = scenarios.simulate(scenarios.load_scenario("magnetometer-only"), 3)
    filter_setup = dataclasses.replace(
        FilterSetup.for_record(record, states=False),
        integration=coning.ALGORITHMS["matched-4-11"],
        sigma={"magnetometer": 0.02},
    )
    modelled = setup.modelled_record(record, filter_setup)
    calls = []
    monkeypatch.setattr(
        setup.running, "compress", lambda *arguments: calls.append(arguments) or records.compress(*arguments)
    )
    result = workflows.estimating.run(record, setup=filter_setup, smooth=smooth)
    assert len(calls) == 1
    first = len(modelled.increments) - len(result.record.increments)
    assert first > 0
    rest = records.cut(modelled, first, len(modelled.increments))
    work = estimation.smooth if smooth else estimation.run
    same = work(rest, filter_setup.process_noise, result.initial, full_covariance=True)
    np.testing.assert_array_equal(result.estimate.attitude, same.attitude)
    np.testing.assert_array_equal(result.estimate.covariance, same.covariance)
    np.testing.assert_array_equal(result.record.increments, rest.increments)


def test_what_cannot_be_smoothed_is_refused(monkeypatch):
    brief = scenario(duration=10.0)
    record = scenarios.simulate(brief, 3)
    filter_setup = setup.FilterSetup.for_scenario(brief, states=False)
    start = setup.initial_state(filter_setup, record.truth.attitude[0])
    monkeypatch.setattr(setup.running, "MAX_MEMORY", 1e5)
    with pytest.raises(InputError, match=r"with 6 states needs .* GB, more than 0.0001; cut the record"):
        setup.smooth(record, filter_setup, start)
