"""Covariance analysis: against the filter itself, a Lyapunov equation, experiments without noise, and Monte Carlo."""

import dataclasses
import json
import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov
from scipy.stats import chi2, norm

from strapdown import coning, consistency, covariance, montecarlo, motion, quaternion, vectors
from strapdown.checks import InputError
from strapdown.covariance import Consider
from strapdown.covariance.consider import considered as considered_errors
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.scenarios import Scenario, load_scenario, simulate
from strapdown.units import ARCSECOND, DEGREE
from strapdown.vectors import Faults

TUMBLE = motion.HarmonicRates(
    mean=(0.02, -0.03, 0.05), harmonics=(motion.Harmonic(amplitude=(0.1, 0.05, 0.0), frequency=0.05, phase=0.3),)
)
FIELD = np.array([2e-5, 0.0, -4e-5])
BELIEF = FilterSetup(
    process_noise=ProcessNoise(angle_random_walk=3e-5, rate_random_walk=1.5e-6), attitude_sigma=2e-3, bias_sigma=2e-5
)


def turning(t):
    """A field that turns."""
    return 4e-5 * np.stack([np.cos(0.01 * t), np.sin(0.01 * t), 0.5 * np.ones_like(t)], axis=-1)


def plain_sensors():
    return (
        vectors.VectorSensor(name="sun", reference_f=np.array([1.0, 0.0, 0.2]), sigma=2e-4, rate=1.0, phase=0.13),
        vectors.Magnetometer(name="mag", field_f=turning, sigma=1e-8, rate=2.0, phase=0.31),
        vectors.Magnetometer(name="compass", field_f=FIELD, sigma=1e-8, rate=1.0, kind="heading", phase=0.71),
        vectors.AttitudeSensor(name="tracker", sigma_across=1e-4, sigma_about=1e-3, rate=0.25),
    )


def everything(duration=120.0):
    """Every source of error that the analysis knows, all kinds of sensors."""
    sun, mag, compass, tracker = plain_sensors()
    gnss = vectors.HeadingPair(name="gnss", baseline_b=np.array([1.0, 0.2, 0.0]), sigma=1e-3, rate=1.0, phase=0.5)
    return Scenario(
        motion=TUMBLE,
        gyro=GyroSpec(
            angle_random_walk=np.array([1e-5, 3e-5, 6e-5]),
            rate_random_walk=np.array([2e-6, 0.5e-6, 1e-6]),
            markov_noise=3e-6,
            markov_correlation_time=20.0,
            bias_instability=5e-6,
            rate_ramp=np.array([1e-7, 0.0, 0.0]),
            asymmetry=np.array([1e-4, 0.0, 0.0]),
        ),
        sensors=(
            dataclasses.replace(tracker, rate=0.5, faults=Faults(outlier_probability=0.05, outlier_scale=4.0)),
            dataclasses.replace(
                sun, faults=Faults(correlated_sigma=3e-4, correlation_time=15.0, outages=((40.0, 60.0),))
            ),
            dataclasses.replace(mag, kind="vector", hard_iron=np.array([1e-8, 0.0, -5e-9])),
            dataclasses.replace(compass, faults=Faults(correlated_sigma=1e-8, correlation_time=5.0)),
            dataclasses.replace(gnss, faults=Faults(correlated_sigma=1e-3, correlation_time=5.0)),
        ),
        rate=10.0,
        duration=duration,
    )


def white(name, duration):
    """A built-in scenario whose gyro has white noise and a walking bias only: what a right filter is right about."""
    scenario = load_scenario(name)
    spec = GyroSpec(
        angle_random_walk=float(np.max(scenario.gyro.angle_random_walk)),
        rate_random_walk=max(float(np.max(scenario.gyro.rate_random_walk)), 1e-8),
        turn_on_bias_sigma=5e-5,
    )
    sensors = tuple(
        dataclasses.replace(sensor, hard_iron=np.zeros(3)) if hasattr(sensor, "hard_iron") else sensor
        for sensor in scenario.sensors
    )
    return dataclasses.replace(scenario, gyro=spec, gyro_preset="", sensors=sensors, duration=duration)


# -------------------------------------------------------------------------------------------------------------- exact relations


@pytest.mark.parametrize("name", ["spin", "tumbling-satellite", "magnetometer-only", "ship"])
def test_the_budget_of_a_matched_filter_adds_up_to_its_own_covariance(name):
    scenario = white(name, min(load_scenario(name).duration, 60.0))
    belief = setup.FilterSetup.for_scenario(scenario, states=False)
    analysis = covariance.analyse(scenario, belief, epochs=5)
    scale = analysis.filter_sigma[:, :, None] * analysis.filter_sigma[:, None, :]
    assert np.abs((analysis.covariance - analysis.filter_covariance) / scale).max() < 1e-11
    assert np.allclose(analysis.filter_covariance, np.swapaxes(analysis.filter_covariance, 1, 2))
    assert np.abs((analysis.contributions.sum(axis=1) - analysis.filter_covariance) / scale).max() < 1e-11
    for value in analysis.expected_nis.values():
        assert value == pytest.approx(1.0, abs=1e-4)
    assert analysis.words == "The filter will be consistent."
    names = {name for name, *_ in analysis.budget()}
    assert {"angle random walk", "initial attitude", "initial bias"} <= names
    for epoch in (2, -1):  # squares add up, as the mean over the axes of attitude and bias
        squares = np.array([row[2:] for row in analysis.budget(epoch) if row[1] == "random"]) ** 2
        whole = np.diag(analysis.covariance[epoch]).reshape(2, 3).mean(axis=1)
        assert np.allclose(squares.sum(axis=0), whole, rtol=1e-7, atol=1e-24)


def test_the_axes_of_a_considered_error_are_one_row_of_the_budget():
    scenario = white("spin", 20.0)
    errors = np.arange(1.0, 25.0).reshape(1, 4, 6)
    analysis = dataclasses.replace(
        covariance.analyse(scenario, setup.FilterSetup.for_scenario(scenario, states=False), epochs=1),
        fixed=("start",),
        fixed_errors=np.repeat(errors[:, :1], 2, axis=0),
        considered=("mounting, x", "mounting, y", "delay"),
        considered_errors=np.repeat(errors[:, 1:], 2, axis=0),
    )
    rows = {(name, kind): np.square(rms) for name, kind, *rms in analysis.budget() if kind != "random"}
    squares = np.square(errors[0]).reshape(4, 2, 3).mean(axis=2)
    assert list(rows) == [("start", "fixed"), ("mounting", "considered"), ("delay", "considered")]
    assert np.allclose(list(rows.values()), [squares[0], squares[1] + squares[2], squares[3]], rtol=1e-12)


def quiet(scenario, sigma):
    """The scenario without noise, and a filter that models some."""
    sensors = []
    for sensor in scenario.sensors:
        small = {name: 1e-12 for name in ("sigma", "sigma_across", "sigma_about") if hasattr(sensor, name)}
        if hasattr(sensor, "field_f"):
            small["sigma"] = 1e-19
        sensors.append(dataclasses.replace(sensor, **small))
    return dataclasses.replace(scenario, sensors=tuple(sensors)), dataclasses.replace(BELIEF, sigma=sigma)


def run_quiet(record, belief, every):
    initial = setup.initial_state(belief, record.truth.attitude[0], record.truth.bias[0])
    estimate = setup.run(record, belief, initial, every=every, full_covariance=True)
    truth = setup.modelled_record(record, belief).truth
    return estimate, consistency.errors(estimate.attitude, estimate.bias, truth.attitude[::every], truth.bias[::every])


SIGMA = {"sun": 3e-4, "mag": 5e-4, "compass": 1e-3, "tracker": 1e-3}


def still_scenario(**gyro):
    return Scenario(motion=TUMBLE, gyro=GyroSpec(**gyro), sensors=plain_sensors(), rate=10.0, duration=60.0)


@pytest.mark.parametrize("integration", ["one-sample", "two-sample"])
def test_the_filters_covariance_is_that_of_the_filter(integration):
    scenario, belief = quiet(still_scenario(), SIGMA)
    belief = dataclasses.replace(belief, integration=coning.ALGORITHMS[integration])
    record = simulate(scenario)
    estimate, _ = run_quiet(record, belief, every=30)
    analysis = covariance.analyse(scenario, belief, epochs=600 // belief.integration.samples // 30)
    assert np.array_equal(analysis.time, estimate.time)
    scale = estimate.sigma[:, :, None] * estimate.sigma[:, None, :]
    # steps of two samples, for one
    assert np.abs((analysis.filter_covariance - estimate.covariance) / scale).max() < 1e-3


def test_a_coloured_bias_that_never_changes_is_nothing_but_initial_bias():
    """The filter starts from the whole true bias less its own prior error, so a drift that stands still leaves no error at all."""
    sigma, tau = 1e-4, 1e18
    scenario = still_scenario(markov_noise=sigma * np.sqrt(2.0 / tau), markov_correlation_time=tau)
    analysis = covariance.analyse(scenario, BELIEF, epochs=10)
    block = analysis.contributions[:, analysis.sources.index("Gauss–Markov bias")]
    reach = np.concatenate([np.full(3, sigma * 60.0), np.full(3, sigma)])
    assert np.abs(block / np.outer(reach, reach)).max() < 1e-12


def test_a_coloured_bias_at_an_edge_is_the_mean_of_both_intervals():
    """Without sensors the error is a sum over the rates f of the intervals: −h Σ (f_k − f₀) and (f_{n−1} + f_n)/2 − f₀."""
    h, tau, white, steps = 10.0, 15.0, 1e-7, 6
    spec = GyroSpec(markov_noise=white, markov_correlation_time=tau)
    scenario = Scenario(motion=motion.rest(), gyro=spec, sensors=(), rate=1.0 / h, duration=steps * h)
    analysis = covariance.analyse(scenario, BELIEF, epochs=steps)
    block = analysis.contributions[:, analysis.sources.index("Gauss–Markov bias")]
    k = np.arange(steps + 1)
    C = 0.5 * tau * white**2 * np.exp(-h / tau * np.abs(k[:, None] - k))
    for n, of_edge in zip(np.round(analysis.time / h).astype(int), block, strict=True):
        rows = np.zeros((2, steps + 1))
        rows[0, :n] -= h
        rows[0, 0] += n * h
        rows[1, [max(n - 1, 0), n]] += 0.5
        rows[1, 0] -= 1.0
        if n == 0:
            rows[1] = 0.0
        np.testing.assert_allclose(of_edge[::3, ::3], rows @ C @ rows.T, rtol=1e-9, atol=1e-24)


def test_markov_noise_without_a_correlation_time_is_a_rate_random_walk():
    scenarios_ = (still_scenario(rate_random_walk=3e-7, markov_noise=4e-7), still_scenario(rate_random_walk=5e-7))
    mixed, other = (covariance.analyse(scenario, BELIEF, epochs=5).contributions for scenario in scenarios_)
    np.testing.assert_allclose(mixed, other, rtol=1e-12)


def test_measurements_in_an_incomplete_last_step_are_not_processed():
    """20 steps of four samples, two more samples with a measurement: as with 80 samples alone."""
    scenario = dataclasses.replace(still_scenario(angle_random_walk=1e-5), duration=8.0)
    star = dataclasses.replace(scenario.sensors[0], rate=5.0, phase=0.0)
    belief = dataclasses.replace(BELIEF, integration=coning.ALGORITHMS["four-sample"])
    whole, longer = (
        covariance.analyse(dataclasses.replace(scenario, sensors=(star,), duration=duration), belief, epochs=5)
        for duration in (8.0, 8.2)
    )
    assert longer.expected_nis == whole.expected_nis
    np.testing.assert_array_equal(longer.rms, whole.rms)


def test_correlated_noise_runs_from_white_to_a_constant():
    scenario, size = still_scenario(), 3e-4
    for tau in (1e-6, 1e18):
        faults = Faults(correlated_sigma=size, correlation_time=tau)
        sensors = (dataclasses.replace(scenario.sensors[0], faults=faults), *scenario.sensors[1:])
        analysis = covariance.analyse(
            dataclasses.replace(scenario, sensors=sensors),
            BELIEF,
            consider=Consider(sensor_bias={"sun": size}),
            epochs=5,
        )
        coloured = analysis.contributions[:, analysis.sources.index("sun, correlated")]
        white_noise = analysis.contributions[:, analysis.sources.index("sun")] * (size / scenario.sensors[0].sigma) ** 2
        constant = np.einsum("mci,mcj->mij", analysis.considered_errors, analysis.considered_errors)
        assert np.allclose(coloured, white_noise if tau < 1.0 else constant, rtol=1e-6, atol=1e-24)


@pytest.mark.parametrize("tau", [0.5, 5.0])
def test_correlated_noise_of_two_measurements_lies_between_white_and_constant(tau):
    """Errors w₁ n₁ + w₂ n₂ a second apart: with ρ = exp(−1/τ) a share ρ of the difference of both extremes."""
    scenario, size = dataclasses.replace(still_scenario(), duration=2.0), 3e-4

    def covariance_of(time):
        faults = Faults(correlated_sigma=size, correlation_time=time)
        sensors = (dataclasses.replace(scenario.sensors[0], faults=faults), *scenario.sensors[1:])
        analysis = covariance.analyse(dataclasses.replace(scenario, sensors=sensors), BELIEF, epochs=5)
        return analysis.contributions[-1, analysis.sources.index("sun, correlated")]

    white_noise, constant = covariance_of(1e-6), covariance_of(1e18)
    expected = white_noise + math.exp(-1.0 / tau) * (constant - white_noise)
    np.testing.assert_allclose(covariance_of(tau), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_correlated_noise_of_a_heading_pair_is_that_of_its_line_in_fixed_axes():
    """Noise that never changes: what a line a little longer to the East, and one to the North, make of a filter on a body that turns."""
    pair = vectors.HeadingPair(name="gnss", baseline_b=np.array([1.0, 0.2, 0.0]), sigma=1e-12, rate=1.0, phase=0.5)
    scenario = dataclasses.replace(still_scenario(), sensors=(*plain_sensors(), pair))
    scenario, belief = quiet(scenario, {**SIGMA, "gnss": 1e-4})
    record, size = simulate(scenario), 1e-5
    *others, series = record.vectors
    level = np.linalg.norm(quaternion.rotate(TUMBLE.attitude(series.time), pair.baseline_b)[:, :2], axis=1)
    errors = []
    for offset in np.eye(3):
        line = level[:, None] * series.reference_f + size * offset * [1.0, 1.0, 0.0]
        moved = dataclasses.replace(series, reference_f=line / np.linalg.norm(line, axis=1, keepdims=True))
        errors.append(run_quiet(dataclasses.replace(record, vectors=(*others, moved)), belief, every=60)[1])
    errors = np.array(errors[:2]) - errors[2]
    faults = Faults(correlated_sigma=size, correlation_time=1e18)
    noisy = dataclasses.replace(scenario, sensors=(*scenario.sensors[:-1], dataclasses.replace(pair, faults=faults)))
    analysis = covariance.analyse(noisy, belief, epochs=10)
    coloured = analysis.contributions[:, analysis.sources.index("gnss, correlated")]
    sigma = np.sqrt(np.einsum("mii->mi", coloured))[1:]
    ratio = (np.einsum("cmi,cmj->mij", errors, errors) - coloured)[1:] / (sigma[:, :, None] * sigma[:, None, :])
    assert np.abs(ratio).max() < 2e-3


def test_a_wrong_gain_obeys_the_lyapunov_equation():
    """At rest with an attitude once a step everything is constant: P by the Riccati equation, the actual covariance by Lyapunov's."""
    dt, true_sigma, held_sigma = 1.0, 3e-4, 1e-3
    true, held = (2e-5, 3e-7), (6e-5, 1e-7)
    scenario = Scenario(
        motion=motion.rest(),
        gyro=GyroSpec(angle_random_walk=true[0], rate_random_walk=true[1]),
        sensors=(
            vectors.AttitudeSensor(name="tracker", sigma_across=true_sigma, sigma_about=true_sigma, rate=1.0 / dt),
        ),
        rate=1.0 / dt,
        duration=6000.0,
    )
    belief = FilterSetup(
        process_noise=ProcessNoise(angle_random_walk=held[0], rate_random_walk=held[1]),
        attitude_sigma=1e-3,
        bias_sigma=1e-5,
        sigma={"tracker": held_sigma},
    )
    analysis = covariance.analyse(scenario, belief, epochs=10)
    F, H = np.array([[1.0, -dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])

    def noise(v, u):
        return np.array([[v**2 * dt + u**2 * dt**3 / 3, -(u**2) * dt**2 / 2], [-(u**2) * dt**2 / 2, u**2 * dt]])

    prior = solve_discrete_are(F.T, H.T, noise(*held), [[held_sigma**2]])
    gain = prior @ H.T / (prior[0, 0] + held_sigma**2)
    keep = np.eye(2) - gain @ H
    actual = solve_discrete_lyapunov(keep @ F, keep @ noise(*true) @ keep.T + gain @ gain.T * true_sigma**2)
    for axis in range(3):
        pick = np.ix_([axis, 3 + axis], [axis, 3 + axis])
        assert np.allclose(analysis.filter_covariance[-1][pick], keep @ prior, rtol=1e-7)
        assert np.allclose(analysis.covariance[-1][pick], actual, rtol=1e-7)
    ratio = np.trace(np.linalg.solve(keep @ prior, actual)) / 2.0
    assert np.allclose(analysis.expected_nees[-1, 0], ratio)
    assert analysis.expected_nis["tracker"] == pytest.approx(
        (H @ (F @ actual @ F.T + noise(*true)) @ H.T + true_sigma**2)[0, 0] / (prior[0, 0] + held_sigma**2), rel=0.01
    )


# ----------------------------------------------------------------------------------------------------- errors without noise


def rotated(record, name, epsilon):
    """The record of a sensor that is turned on the body by a rotation vector: it measures an attitude q exp(ε)."""
    turn = quaternion.exp(np.asarray(epsilon))
    series = []
    for measurements in record.vectors:
        changed = measurements
        if measurements.sensor == name and measurements.attitude is not None:
            changed = dataclasses.replace(measurements, attitude=quaternion.multiply(measurements.attitude, turn))
        elif measurements.sensor == name:
            changed = dataclasses.replace(
                measurements, vector_b=quaternion.rotate(quaternion.conjugate(turn), measurements.vector_b)
            )
        series.append(changed)
    return dataclasses.replace(record, vectors=tuple(series))


def late(scenario, name, seconds):
    """The record of a sensor that measures later than its stamps say."""
    shifted = tuple(
        dataclasses.replace(sensor, phase=sensor.phase + seconds) if sensor.name == name else sensor
        for sensor in scenario.sensors
    )
    record, exact = simulate(dataclasses.replace(scenario, sensors=shifted)), simulate(scenario)
    series = []
    for measurements, own in zip(record.vectors, exact.vectors, strict=True):
        here = slice(len(measurements.time))
        reference = own.reference_f[here] if measurements.reference_f.ndim == 2 else measurements.reference_f
        series.append(dataclasses.replace(measurements, time=own.time[here], reference_f=reference))
    return dataclasses.replace(record, vectors=tuple(series))


def considered(name, size):
    """Cases: what is considered, which axis of it, and the record in which it is so."""
    base, belief = quiet(still_scenario(), SIGMA)
    if name.startswith(("scale factor", "misalignment", "g-sensitivity")):
        of_gyro = name.partition(",")[0].replace(" ", "_").replace("-", "_")
        place = {"scale_factor": 1, "misalignment": (0, 2), "g_sensitivity": (2, 1)}[of_gyro]
        error = np.zeros(3 if of_gyro == "scale_factor" else (3, 3))
        error[place] = size
        record = simulate(quiet(still_scenario(**{of_gyro: error}), SIGMA)[0])
        return base, belief, Consider(**{of_gyro: size}), record
    sensor, what = name.split(" ", 1)
    if what == "bias, x":
        iron = tuple(
            dataclasses.replace(item, hard_iron=np.array([size, 0.0, 0.0])) if item.name == sensor else item
            for item in base.sensors
        )
        # The unit of the consideration is that of the sensor's own σ, which the quiet one has too.
        return base, belief, Consider(sensor_bias={sensor: size}), simulate(dataclasses.replace(base, sensors=iron))
    if what == "mounting, y":
        return base, belief, Consider(mounting={sensor: size}), rotated(simulate(base), sensor, [0.0, size, 0.0])
    assert what == "time offset"
    return base, belief, Consider(time_offset={sensor: size}), late(base, sensor, size)


CASES = {
    **dict.fromkeys(("scale factor, y", "misalignment, x of z"), 1e-4),
    **dict.fromkeys((f"{sensor} mounting, y" for sensor in ("sun", "compass", "tracker")), 1e-4),
    **dict.fromkeys(("mag bias, x", "compass bias, x"), 1e-8),
    **dict.fromkeys((f"{sensor} time offset" for sensor in ("sun", "mag", "compass")), 1e-3),
    "g-sensitivity, z of y": 1e-7,
}


@pytest.mark.parametrize("name", CASES)
def test_a_considered_error_makes_what_it_makes(name):
    base, belief, consider, record = considered(name, CASES[name])
    _, error = run_quiet(record, belief, every=60)
    analysis = covariance.analyse(base, belief, consider=consider, epochs=10)
    predicted = analysis.considered_errors[:, analysis.considered.index(name)]
    scale = np.concatenate([np.full(3, np.abs(predicted[:, :3]).max()), np.full(3, np.abs(predicted[:, 3:]).max())])
    assert np.abs((error - analysis.mean_error - predicted)[1:] / scale).max() < 0.02
    assert np.allclose(analysis.covariance - analysis.contributions.sum(axis=1), np.einsum(
        "mci,mcj->mij", analysis.considered_errors, analysis.considered_errors), atol=1e-22)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "gyro"),
    [
        ("gyro scale factor", {"scale_factor": np.array([1e-4, -2e-4, 3e-4])}),
        ("gyro asymmetry", {"asymmetry": np.array([3e-4, 0.0, 0.0])}),
        ("gyro bandwidth", {"bandwidth": 2.0}),
        ("rate ramp", {"rate_ramp": np.array([1e-7, 0.0, -1e-7])}),
    ],
)
def test_an_error_of_the_scenario_makes_what_it_makes(name, gyro):
    scenario, belief = quiet(still_scenario(**gyro), SIGMA)
    _, error = run_quiet(simulate(scenario), belief, every=60)
    analysis = covariance.analyse(scenario, belief, epochs=10)
    assert name in analysis.fixed
    scale = np.concatenate([np.full(3, np.abs(error[:, :3]).max()), np.full(3, np.abs(error[:, 3:]).max())])
    assert np.abs((error - analysis.mean_error) / scale).max() < 0.02


def test_coning_shows_as_the_bias_that_the_formula_gives():
    angle, frequency, rate = 0.7 * DEGREE, 10.0, 100.0
    scenario = Scenario(
        motion=motion.Coning(angle=angle, frequency=frequency),
        gyro=GyroSpec(angle_random_walk=2e-5, rate_random_walk=1e-8),
        sensors=tuple(
            vectors.VectorSensor(name=f"star {k}", reference_f=np.eye(3)[k], sigma=1e-4, rate=1.0) for k in range(2)
        ),
        rate=rate,
        duration=400.0,
    )
    for name in ("one-sample", "two-sample"):
        algorithm = coning.ALGORITHMS[name]
        belief = dataclasses.replace(
            setup.FilterSetup.for_scenario(scenario, states=False), integration=algorithm, bias_sigma=1e-3
        )
        analysis = covariance.analyse(scenario, belief, epochs=4)
        # A hundred cycles: the body is back where it was.
        increments = scenario.motion.increments(np.arange(1001) / rate)
        turned = np.array([1.0, 0.0, 0.0, 0.0])
        for turn in quaternion.exp(coning.rotation_vectors(increments, algorithm)):
            turned = quaternion.multiply(turned, turn)
        drift = quaternion.log(turned)[2] / 10.0
        assert analysis.fixed == (f"integration ({name})",)
        assert analysis.mean_error[-1, 5] == pytest.approx(-drift, rel=0.005)  # the filter takes the drift for bias


# ------------------------------------------------------------------------------------------------------------- Monte Carlo


def monte_carlo(scenario, belief, runs, epochs, seed=3):
    """Errors, NEES and NIS per degree of freedom of independent runs: (runs, epochs + 1, 6), (runs, epochs + 1), (runs,) by sensor."""
    steps = (len(scenario.edges) - 1) // belief.integration.samples
    every = steps // epochs
    errors, nees, nis = [], [], {}
    for run in range(runs):
        record = simulate(scenario, seed, run)
        used = setup.modelled_record(record, belief)
        start = montecarlo.start(record, belief, seed, run)
        estimate = setup.run_modelled(used, belief, start, every=every, full_covariance=True)
        e = consistency.errors(estimate.attitude, estimate.bias, used.truth.attitude[::every], used.truth.bias[::every])
        errors.append(e)
        nees.append(consistency.nees(e, estimate.covariance))
        for name, innovations in estimate.innovations.items():
            nis.setdefault(name, []).append(innovations.nis.mean() / innovations.innovation.shape[1])
    return np.array(errors), np.array(nees), {name: np.array(values) for name, values in nis.items()}


def check_monte_carlo(scenario, belief, *, runs, epochs, probability=0.99):
    analysis = covariance.analyse(scenario, belief, epochs=epochs)
    errors, nees, nis = monte_carlo(scenario, belief, runs, epochs)
    for name, values in nis.items():
        limit = norm.ppf(0.5 + 0.5 * probability ** (1.0 / len(nis))) * values.std() / np.sqrt(runs)
        assert abs(values.mean() - analysis.expected_nis[name]) < limit + 0.002, name
    number = len(analysis.time) - 1
    C, mean, P = analysis.covariance, analysis.mean_error, analysis.filter_covariance
    each = 1.0 - (1.0 - probability) / number
    low, high = consistency.mean_bounds(6, runs, each)
    for k in range(1, number + 1):
        away = errors[:, k] - mean[k]
        ratio = consistency.nees(away, np.broadcast_to(C[k], (runs, 6, 6))).mean() / 6.0
        assert low < ratio < high, f"actual covariance at {analysis.time[k]} s: {ratio:.3f}, {low:.3f} to {high:.3f}"
        average = away.mean(axis=0)
        assert runs * average @ np.linalg.solve(C[k], average) < chi2.ppf(each, 6)
        # NEES with the filter's own P is a quadratic form of a known Gaussian.
        shape = np.linalg.solve(P[k], C[k])
        shift = np.linalg.solve(P[k], mean[k])
        deviation = np.sqrt((2.0 * np.trace(shape @ shape) + 4.0 * shift @ C[k] @ shift) / runs) / 6.0
        limit = norm.ppf(0.5 + 0.5 * each) * deviation
        assert abs(nees[:, k].mean() / 6.0 - analysis.expected_nees[k, 0]) < limit
    return analysis


def test_every_source_together_agrees_with_monte_carlo():
    check_monte_carlo(everything(), BELIEF, runs=150, epochs=6)


SLANTED = vectors.AttitudeSensor(
    name="tracker", sigma_across=1e-4, sigma_about=1e-3, rate=0.5, boresight=(0.7071, 0.0, 0.7071)
)


@pytest.mark.parametrize(
    "sigma", [{}, {"tracker": (2e-4, 1e-4, 6e-4), "mag": (1e-8, 2e-8, 3e-8)}], ids=["matched", "one σ an axis"]
)
def test_noise_correlated_between_body_axes_agrees_with_monte_carlo(sigma):
    """A tracker whose boresight is no body axis, and a filter that models other σ about the axes of the body."""
    mag = vectors.Magnetometer(name="mag", field_f=FIELD, sigma=1e-8, rate=1.0, kind="vector", phase=0.31)
    gyro = GyroSpec(angle_random_walk=3e-5, rate_random_walk=1.5e-6)
    scenario = Scenario(motion=TUMBLE, gyro=gyro, sensors=(SLANTED, mag), rate=10.0, duration=60.0)
    analysis = check_monte_carlo(scenario, dataclasses.replace(BELIEF, sigma=sigma), runs=80, epochs=4)
    if not sigma:
        scale = analysis.filter_sigma[:, :, None] * analysis.filter_sigma[:, None, :]
        assert np.abs((analysis.covariance - analysis.filter_covariance) / scale).max() < 1e-11
        assert analysis.expected_nis == pytest.approx({"tracker": 1.0, "mag": 1.0}, abs=1e-3)
    else:
        assert analysis.expected_nees[-1, 1] > 2.0  # the σ about its boresight is 1e-3


def with_states():
    """Hard iron and drift, and a filter with states for them and for the mounting of the compass."""
    compass = vectors.Magnetometer(
        name="compass", field_f=FIELD, sigma=3e-8, rate=2.0, kind="heading", hard_iron=[2e-7, -3e-7, 1e-7]
    )
    force = vectors.Accelerometer(name="force", sigma=3e-3, rate=2.0)
    gyro = GyroSpec(angle_random_walk=1e-5, markov_noise=4e-6, markov_correlation_time=20.0, turn_on_bias_sigma=2e-5)
    scenario = Scenario(motion=TUMBLE, gyro=gyro, sensors=(force, compass), rate=10.0, duration=60.0)
    matched = dataclasses.replace(FilterSetup.for_scenario(scenario), attitude_sigma=2e-3)
    assert set(matched.states.names) == {"gyro.drift", "compass.bias"}
    mounted = dataclasses.replace(matched.states.sensors["compass"], mounting_sigma=1e-5)
    return scenario, dataclasses.replace(
        matched, states=dataclasses.replace(matched.states, sensors={"compass": mounted})
    )


def test_a_filter_with_error_states_agrees_with_monte_carlo():
    scenario, belief = with_states()
    analysis = check_monte_carlo(scenario, belief, runs=100, epochs=4)
    plain = covariance.analyse(scenario, dataclasses.replace(belief, states=None), epochs=4)
    assert analysis.rms[-1, :3].max() < 0.7 * plain.rms[-1, :3].max()  # what the states are for


def test_the_default_filter_has_the_states_that_the_scenario_calls_for(monkeypatch):
    class Reached(Exception):  # noqa: N818
        pass

    def reached(scenario, belief, epochs):
        raise Reached(belief)

    monkeypatch.setattr(covariance.analysing, "trajectory_of", reached)
    with pytest.raises(Reached) as stopped:
        covariance.analyse("spin")
    assert stopped.value.args[0] == FilterSetup.for_scenario(load_scenario("spin"))
    assert stopped.value.args[0].states is not None


def test_states_without_their_errors_are_a_filter_that_is_too_unsure():
    """The filter's covariance is that of the filter on a record without noise; of the errors it models, the scenario has none."""
    scenario, belief = with_states()
    force, compass = scenario.sensors
    exact = dataclasses.replace(
        scenario,
        gyro=dataclasses.replace(scenario.gyro, markov_noise=0.0),
        sensors=(force, dataclasses.replace(compass, hard_iron=np.zeros(3))),
    )
    analysis = covariance.analyse(exact, belief, epochs=4)
    silent, _ = quiet(dataclasses.replace(exact, gyro=GyroSpec()), {})
    of_sensors = {"force": 3e-3 / 9.80665, "compass": 3e-8 / np.linalg.norm(FIELD[:2])}
    estimate, _ = run_quiet(simulate(silent), dataclasses.replace(belief, sigma=of_sensors), every=150)
    scale = estimate.sigma[:, :, None] * estimate.sigma[:, None, :]
    assert np.abs((analysis.filter_covariance - estimate.covariance) / scale).max() < 1e-6
    assert np.all(analysis.expected_nees[1:, 0] < 0.9)
    assert analysis.words.startswith("The filter will be pessimistic")
    warm = dataclasses.replace(belief, states=dataclasses.replace(belief.states, gyro_temperature_sigma=1e-5))
    without = covariance.analyse(exact, warm, epochs=4)
    assert without.left_out == ("states for the gyro bias over temperature",)
    np.testing.assert_array_equal(without.filter_covariance, analysis.filter_covariance)


# ------------------------------------------------------------------------------------------------------------------- the rim


def test_initial_errors_may_differ_from_the_filters_model():
    scenario = white("spin", 30.0)
    belief = setup.FilterSetup.for_scenario(scenario, states=False)
    right = covariance.analyse(scenario, belief, epochs=3)
    wrong = covariance.analyse(
        scenario, belief, epochs=3, initial_attitude_sigma=2.0 * belief.attitude_sigma, initial_bias_sigma=0.0
    )
    attitude, bias = right.sources.index("initial attitude"), right.sources.index("initial bias")
    assert np.allclose(wrong.contributions[:, attitude], 4.0 * right.contributions[:, attitude])
    assert np.all(wrong.contributions[:, bias] == 0.0)
    assert np.array_equal(wrong.filter_covariance, right.filter_covariance)


def test_what_is_left_out_or_beyond_linear_is_reported():
    scenario = dataclasses.replace(load_scenario("hand-held"), duration=4.0)
    analysis = covariance.analyse(scenario, setup.FilterSetup.for_scenario(scenario, states=False), epochs=2)
    assert analysis.left_out == ("the gyro's quantisation",)
    early = dataclasses.replace(scenario.gyro, timestamp_offset=-0.01)
    early = dataclasses.replace(scenario, gyro=early, gyro_preset="")
    early = covariance.analyse(early, setup.FilterSetup.for_scenario(early, states=False), epochs=2)
    assert early.left_out == ("the gyro's quantisation", words := "the gyro's time stamps, late by -0.01 s")
    assert words in early.unmodelled
    notes = " ".join(early.listing().notes)
    assert f"Neither the filter nor this analysis includes the gyro's quantisation, {words}." in notes
    assert [notes.count(error) for error in early.unmodelled] == [1] * len(early.unmodelled)
    steady = white("two-stars", 4.0)
    lossy = dataclasses.replace(steady, gyro=dataclasses.replace(steady.gyro, drop_probability=0.05))
    for scene, words in ((steady, "The"), (lossy, "But for what is left out, the")):
        assert covariance.analyse(scene, epochs=2).words == f"{words} filter will be consistent."
    assert any("accelerometer" in text for text in analysis.beyond_linear)
    wide = covariance.analyse(
        white("spin", 10.0),
        setup.FilterSetup.for_scenario(white("spin", 10.0), attitude_sigma=0.5, states=False),
        epochs=2,
    )
    assert wide.beyond_linear == ("the attitude error itself, 28.6° at 0 s",)
    assert covariance.analyse(white("spin", 10.0), epochs=2).beyond_linear == ()


def test_saturation_by_a_bias_is_that_of_a_lower_limit():
    """A rate r with a bias b is clipped by r + b − L at the limit L, as without the bias at L − b."""
    spin = motion.ConstantRate(rate=(0.0, 0.0, 0.5))
    scene = dataclasses.replace(white("two-stars", 10.0), motion=spin)
    rows, belief = [], FilterSetup.for_scenario(scene)
    for bias, limit in ((0.02, 0.51), (0.0, 0.49)):
        errors = {"range": limit, "turn_on_bias": (0.0, 0.0, bias)}
        clipped = dataclasses.replace(scene, gyro=dataclasses.replace(scene.gyro, **errors))
        analysis = covariance.analyse(clipped, belief, epochs=2)
        assert analysis.left_out == ()
        rows.append(analysis.fixed_errors[:, analysis.fixed.index("gyro range")])
    np.testing.assert_allclose(rows[0], rows[1], rtol=1e-9, atol=1e-15)
    assert np.abs(rows[0]).max() > 1e-3


def test_a_lever_arm_is_analysed_whatever_the_errors_of_the_time_stamps():
    """They are left out, so the result is that without them; with an early clock the record ended before its last measurements."""
    scenario = dataclasses.replace(load_scenario("hand-held"), duration=4.0)
    belief = setup.FilterSetup.for_scenario(scenario)
    early = dataclasses.replace(scenario.gyro, timestamp_offset=-0.01, drop_probability=0.1)
    early = covariance.analyse(dataclasses.replace(scenario, gyro=early, gyro_preset=""), belief, epochs=2)
    np.testing.assert_array_equal(early.rms, covariance.analyse(scenario, belief, epochs=2).rms)
    assert "the gyro's lost samples, 10 % of all" in early.left_out


def test_what_is_considered_too_large_is_reported():
    scenario = white("spin", 10.0)
    for considered, word in (
        (Consider(mounting={"star": 0.2}), "star mounting, up to"),
        (Consider(time_offset={"star": 5.0}), "star time offset, up to"),
    ):
        assert any(word in text for text in covariance.analyse(scenario, consider=considered, epochs=2).beyond_linear)
    small = Consider(scale_factor=1e-4, misalignment=1e-4, mounting={"star": 1e-4}, time_offset={"star": 1e-4})
    assert covariance.analyse(scenario, consider=small, epochs=2).beyond_linear == ()


def test_an_attitude_error_beyond_linear_is_reported_with_its_time():
    """A gyro alone: the initial bias turns the attitude away in proportion to time."""
    scenario = dataclasses.replace(load_scenario("rest"), duration=100.0)
    belief = dataclasses.replace(
        setup.FilterSetup.for_scenario(scenario, attitude_sigma=1e-3, states=False), bias_sigma=1e-2
    )
    analysis = covariance.analyse(scenario, belief, epochs=4)
    assert analysis.beyond_linear == (
        f"the attitude error itself, {analysis.rms[-1, :3].max() / DEGREE:.3g}° at 100 s",
    )
    assert analysis.rms[-1, 0] == pytest.approx(1.0, rel=0.01)
    assert "linear about the truth, cannot tell whether the filter will be consistent" in analysis.words
    short = covariance.analyse(dataclasses.replace(scenario, duration=10.0), belief, epochs=4)
    assert short.beyond_linear == ()


class Own:
    """A sensor of a user."""

    name = "own"

    def observe(self, *_):
        raise AssertionError


PERFECT = vectors.VectorSensor(name="sun", reference_f=np.eye(3)[0], sigma=0.0, rate=1.0)


@pytest.mark.parametrize(
    ("considered", "options", "sensors", "message"),
    [
        ({"mounting": {"stars": 1e-3}}, {}, (), "did you mean 'star'"),
        ({"time_offset": {"star": 10.0}}, {}, (), r"time_offset of star is 10 s, and the scenario lasts 10 s"),
        ({"scale_factor": -1.0}, {}, (), "scale_factor is -1"),
        ({"time_offset": 0.1}, {}, (), "time_offset is 0.1"),
        ({"sensor_bias": {"gnss": 1.0}}, {}, everything().sensors, "a heading pair has none"),
        ({}, {"epochs": 100_000}, (), "epochs"),
        ({}, {}, (PERFECT,), "sun: sigma"),
        ({}, {}, (Own(),), "own is a Own"),
    ],
)
def test_what_makes_no_sense_is_refused(considered, options, sensors, message):
    scenario = white("spin", 10.0)
    scenario = dataclasses.replace(scenario, sensors=sensors or scenario.sensors)
    with pytest.raises(InputError, match=message):
        covariance.analyse(scenario, BELIEF, consider=Consider(**considered), **options)


def test_dead_reckoning_is_that_of_each_axis_by_itself():
    """Without sensors and at rest: white noise and random walk over one step a second or one in ten, and both initial errors."""
    arw, rrw, t = np.array([1e-5, 3e-5, 6e-5]), np.array([2e-6, 0.5e-6, 1e-6]), 100.0
    spec = GyroSpec(angle_random_walk=arw, rate_random_walk=rrw)
    for rate in (0.1, 1.0):
        scenario = Scenario(motion=motion.rest(), gyro=spec, sensors=(), rate=rate, duration=t)
        C = covariance.analyse(scenario, BELIEF, epochs=1).covariance[-1]
        attitude, bias = BELIEF.attitude_sigma**2, BELIEF.bias_sigma**2
        expected = np.diag([*(attitude + bias * t**2 + arw**2 * t + rrw**2 * t**3 / 3.0), *(bias + rrw**2 * t)])
        expected[[0, 1, 2], [3, 4, 5]] = expected[[3, 4, 5], [0, 1, 2]] = -0.5 * rrw**2 * t**2 - bias * t
        np.testing.assert_allclose(C, expected, rtol=1e-9, atol=1e-24)


# ------------------------------------------------------------------------------------------------------- the command line


def test_the_initial_bias_contains_the_part_too_fast_for_a_state():
    scenario, belief = with_states()
    states = dataclasses.replace(belief.states, gyro_fast_bias_sigma=0.5 * belief.bias_sigma)
    belief = dataclasses.replace(belief, states=states)
    analysis = covariance.analyse(scenario, belief, epochs=2)
    np.testing.assert_allclose(analysis.filter_sigma[0, 3:], belief.bias_sigma, rtol=1e-9)


def test_innovations_that_will_contradict_the_filter_are_named():
    """From an initial error of five times its σ the filter recovers, and a Monte Carlo rejects its innovations (NIS 2.27)."""
    analysis = covariance.analyse("cubesat", initial_attitude_sigma=5.0 * DEGREE, epochs=5)
    np.testing.assert_allclose(analysis.expected_nees[-1], 1.0, atol=0.01)
    assert (
        analysis.words == "The errors at the end will agree with σ, but not the innovations: NIS of star tracker 2.31."
    )


def test_errors_that_contradict_the_filter_only_before_the_end_are_named():
    """A gyro of one sample a second in a tumble of 4 °/s: a Monte Carlo of 4000 runs has an ANEES of the bias of 1.40 at 390 s."""
    slow = dataclasses.replace(load_scenario("cubesat"), rate=1.0)
    analysis = covariance.analyse(slow, epochs=20)
    k = int(np.argmax(analysis.expected_nees[:, 2]))
    assert analysis.expected_nees[k, 2] == pytest.approx(1.40, abs=0.03)
    root, time = np.sqrt(analysis.expected_nees[k, 2]), analysis.time[k]
    assert analysis.words == (
        f"The filter will be optimistic in bias: √NEES is {root:.3g} at {time:g} s, though not at the end."
    )
    certain = covariance.analyse("cubesat", initial_attitude_sigma=0.0, initial_bias_sigma=0.0, epochs=5)
    assert certain.words.startswith("The filter will be pessimistic at 0 s, though not at the end: ")


def test_only_an_error_that_is_drawn_in_every_run_is_said_to_average_out():
    scenario, belief = with_states()
    analysis = covariance.analyse(scenario, belief, epochs=2)
    large = 3.0 * analysis.filter_sigma[:, None, :]
    fixed = dataclasses.replace(analysis, fixed=("scale",), fixed_errors=large, drawn=("scale",))
    assert fixed.words.startswith("For a unit with exactly the specified constant errors, the filter is optimistic")
    considered = dataclasses.replace(fixed, considered=("mounting",), considered_errors=large)
    for other in (considered, dataclasses.replace(fixed, drawn=())):
        assert other.words.startswith("The filter will be optimistic in ")
    slow = dataclasses.replace(scenario, gyro=dataclasses.replace(scenario.gyro, bandwidth=20.0))
    analysis = covariance.analyse(slow, belief, epochs=2)
    assert set(analysis.fixed) - set(analysis.drawn) == {"gyro bandwidth"}
    assert analysis.drawn == ("compass (fixed)",)


def test_the_command_prints_a_budget_and_writes_it(succeeds, tmp_path):
    options = ("--epochs", 10, "--consider", "misalignment=0.1", "--consider", "star.delay=2")
    matched = setup.FilterSetup.for_scenario(load_scenario("spin"), states=False)
    (tmp_path / "filter.toml").write_text(setup.to_toml(matched), encoding="utf-8")
    assert succeeds("covariance", "spin", "--filter", "filter.toml", "--out", "by-file", *options)
    by_file = (tmp_path / "by-file" / "covariance.json").read_text(encoding="utf-8")
    said = succeeds("covariance", "spin", "--no-states", *options)
    assert "The filter does not model the gyro's scale factor" in said
    for word in ("angle random walk", "gyro scale factor", "misalignment", "star time offset", "the filter's own σ"):
        assert word in said
    saved = json.loads((tmp_path / "covariance-results" / "covariance.json").read_text(encoding="utf-8"))
    assert saved == json.loads(by_file)
    assert len(saved["time_s"]) == 11
    direct = covariance.analyse(
        load_scenario("spin"), matched, consider=Consider(misalignment=1e-4, time_offset={"star": 2e-3}), epochs=10
    )
    assert np.allclose(np.array(saved["rms"]["attitude_arcsec"]) * ARCSECOND, direct.rms[:, :3])
    assert np.allclose(np.array(saved["rms"]["bias_deg_per_hour"]) * DEGREE / 3600.0, direct.rms[:, 3:])
    assert np.allclose(saved["expected_nees_per_state"]["bias"], direct.expected_nees[:, 2])
    assert f"The filter will be optimistic in bias: √NEES is {np.sqrt(direct.expected_nees[-1, 2]):.3g}." in " ".join(
        said.split()
    )
    assert (tmp_path / "covariance-results" / "budget.png").read_bytes().startswith(b"\x89PNG")


def test_considered_errors_are_in_the_units_of_a_data_sheet():
    gyro = {"scale_factor": 3.0, "misalignment": 2.0, "g_sensitivity": 7.0}
    star = {"star.bias": 4.0, "star.mounting": 5.0, "star.delay": 6.0}
    (consider,) = considered_errors(gyro | star, load_scenario("spin").sensors).values()
    assert consider.scale_factor == pytest.approx(3e-6)
    assert consider.misalignment == pytest.approx(2e-3)
    assert consider.g_sensitivity == pytest.approx(7.0 * np.pi / 180.0 / 3600.0 / 9.80665, rel=1e-12)  # rad/s per m/s²
    assert consider.sensor_bias == {"star": pytest.approx(4.0 * ARCSECOND)}
    assert consider.mounting == {"star": pytest.approx(5.0 * ARCSECOND)}
    assert consider.time_offset == {"star": pytest.approx(6e-3)}
    errors = {"magnetometer.bias": 100.0, "initial.attitude": 2.0, "initial.bias": 30.0}
    options = considered_errors(errors, load_scenario("low-orbit").sensors)
    assert options.pop("consider").sensor_bias == {"magnetometer": pytest.approx(100e-9)}
    initial = {"initial_attitude_sigma": 2.0 * DEGREE, "initial_bias_sigma": 30.0 * DEGREE / 3600.0}
    assert options == pytest.approx(initial)
