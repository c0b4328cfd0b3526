"""Outliers in tuning: the mixture's likelihood against a plain filter of matrices, what it recovers, and the gate that follows."""

import dataclasses

import numpy as np
import pytest
import two_stars
from scipy.linalg import expm
from scipy.stats import chi2, norm
from two_stars import ANGLES, BELIEVED, FREE, KINDS, TRUTH, WRONG, differences

import strapdown as sd
from strapdown import scenarios, tuning, vectors
from strapdown.estimation import setup
from strapdown.estimation.gating import Gate
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise
from strapdown.tuning import innovations, outliers, result


def scenario(duration: float = 200.0, share: float = 0.05) -> scenarios.Scenario:
    return two_stars.scenario(duration, outliers=share)


def case(seed: int = 0, duration: float = 200.0, share: float = 0.05) -> tuning.Case:
    return two_stars.case(seed, duration, outliers=share)


# --------------------------------------------------------------------------------------------------- the likelihood


def plain_mixture(share, scale, filter_setup, increments, angles, dt=0.5, sigma=1e-6):
    """Minus the log likelihood, and the probability of each outlier, by a Kalman filter of (angles, biases, drifts) in matrices.

    σ may differ by axis. Transition and noise of a step come from the exponential of the continuous model (Van Loan 1978).
    """
    process_noise, states = filter_setup.process_noise, filter_setup.states
    white, walk = process_noise.angle_random_walk, process_noise.rate_random_walk
    eye, none = np.eye(3), np.zeros((3, 3))
    drift, time = (0.0, 1.0) if states is None else (states.gyro_drift_sigma[0], states.gyro_drift_time[0])
    A = np.block([[none, -eye, -eye], [none, none, none], [none, none, -eye / time]])
    density = np.diag(np.repeat([white**2, walk**2, 2.0 * drift**2 / time], 3))
    both = expm(dt * np.block([[-A, density], [np.zeros((9, 9)), A.T]]))
    F = both[9:, 9:].T
    Q = F @ both[:9, 9:]
    H = np.hstack([eye, none, none])
    parts = np.block([[eye, none, none], [none, eye, -eye], [none, none, eye]])  # the whole bias is that and the drift
    start = np.diag(np.repeat([filter_setup.attitude_sigma**2, filter_setup.bias_sigma**2, drift**2], 3))
    x, P, R = np.zeros(9), parts @ start @ parts.T, np.diag(np.broadcast_to(sigma, 3) ** 2.0)
    total, probabilities = 0.0, []
    for increment, angle in zip(increments, angles, strict=True):
        x = F @ x + np.concatenate([increment, np.zeros(6)])
        P = F @ P @ F.T + Q
        e, logs, means, covariances = angle - H @ x, [], [], []
        for factor, weight in ((1.0, 1.0 - share), (scale**2, share)):
            S = H @ P @ H.T + factor * R
            K = P @ H.T @ np.linalg.inv(S)
            logs.append(np.log(weight) - 0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(S)[1]))
            means.append(x + K @ e)
            covariances.append(P - K @ H @ P)
        log = np.logaddexp(*logs)
        w = np.exp(logs[1] - log)
        total -= log
        probabilities.append(w)
        x = (1.0 - w) * means[0] + w * means[1]
        P = sum(
            weight * (cov + np.outer(mean - x, mean - x))
            for weight, cov, mean in zip((1.0 - w, w), covariances, means, strict=True)
        )
    return total, np.array(probabilities)


def probabilities(objective: tuning.outliers.Likelihood, point: np.ndarray) -> np.ndarray:
    return objective.outliers(point)[0][1][:, 0]


def test_in_the_linear_case_it_is_the_filter_of_two_normals():
    (case, increments, angles), filter_setup = two_stars.angle_case(60, struck=0.2), ANGLES
    objective = tuning.contaminated_likelihood(
        [case], filter_setup, ["gyro.arw", "tracker.sigma"], share=0.1, scale=6.0
    )
    expected, struck = plain_mixture(0.1, 6.0, filter_setup, increments, angles)
    assert objective.minus_log(objective.start)[0] == pytest.approx(expected, rel=1e-7)
    np.testing.assert_allclose(probabilities(objective, objective.start), struck, rtol=1e-4, atol=1e-7)
    # Eight points at once are one after the other.
    points = objective.start + np.random.default_rng(1).uniform(-0.5, 0.5, (11, 4))
    alone = [float(objective.minus_log(point)[0]) for point in points]
    np.testing.assert_allclose(objective.minus_log(points), alone, rtol=1e-12)
    for point, value in zip(points, alone, strict=True):
        arw, sigma, share, scale = np.exp(point)
        other = dataclasses.replace(
            filter_setup, process_noise=ProcessNoise(angle_random_walk=arw, rate_random_walk=2e-7)
        )
        assert value == pytest.approx(plain_mixture(share, scale, other, increments, angles, sigma=sigma)[0], rel=1e-7)


def test_in_the_linear_case_with_a_drift_and_noise_by_axis_likewise():
    (case, increments, angles), plain = two_stars.angle_case(60, struck=0.2), ANGLES
    axes = np.array([1e-6, 2e-6, 5e-7])
    filter_setup = dataclasses.replace(
        plain, states=States(gyro_drift_sigma=(8e-7,), gyro_drift_time=(3.0,)), sigma={"tracker": tuple(axes)}
    )
    names = ("gyro.arw", "gyro.drift_sigma", "gyro.drift_time", "tracker.sigma")
    objective = tuning.contaminated_likelihood([case], filter_setup, names, share=0.1, scale=6.0)
    points = objective.start + np.random.default_rng(1).uniform(-0.5, 0.5, (5, 6))
    for point, value in zip(points, objective.minus_log(points), strict=True):
        arw, drift, time, sigma, share, scale = np.exp(point)
        other = dataclasses.replace(
            plain,
            process_noise=ProcessNoise(angle_random_walk=arw, rate_random_walk=2e-7),
            states=States(gyro_drift_sigma=(drift,), gyro_drift_time=(time,)),
        )
        by_axis = axes * sigma / np.sqrt(np.mean(axes**2))
        expected, struck = plain_mixture(share, scale, other, increments, angles, sigma=by_axis)
        assert value == pytest.approx(expected, rel=1e-7)
        np.testing.assert_allclose(probabilities(objective, point), struck, rtol=1e-4, atol=1e-7)


def every_kind() -> tuning.Case:
    """A record that turns fast, with one series of each kind."""
    record = two_stars.every_kind(gaps=False)
    return tuning.Case(record=record, initial=setup.initial_state(KINDS, record.truth.attitude[0]))


STATES = States(gyro_scale_sigma=1e-2, gyro_drift_sigma=(1e-3,), gyro_drift_time=(5.0,))
"""Six of them."""
CHAINS = States(sensors={"up": SensorStates(velocity_sigma=0.1, velocity_time=3.0, acceleration_time=0.5)})
"""Two an axis, one of which drives the other."""


@pytest.mark.parametrize(
    "states",
    [None, *(pytest.param(states, marks=pytest.mark.slow) for states in (STATES, CHAINS))],
    ids=["plain", "states", "chains"],
)
def test_without_outliers_it_is_the_likelihood_of_all_kinds_of_measurement(states):
    case, filter_setup = every_kind(), dataclasses.replace(KINDS, states=states)
    names = ("gyro.arw", "sun.sigma", "up.sigma", "north.sigma", "tracker.sigma")
    plain = tuning.likelihood([case], filter_setup, names)
    objective = tuning.contaminated_likelihood([case], filter_setup, names)
    point = plain.start + 0.2
    none = np.concatenate([point, np.log([1e-13, 10.0])])
    assert objective.minus_log(none)[0] == pytest.approx(plain.minus_log(point)[0], rel=1e-9)
    same = np.concatenate([point, np.log([0.3, 1.0])])  # outliers that are like the rest
    assert objective.minus_log(same)[0] == pytest.approx(plain.minus_log(point)[0], rel=1e-12)


@pytest.mark.parametrize(
    ("kind", "states"),
    [
        # With states each kind takes 4 s to compile.
        pytest.param(kind, states, id=f"{kind}-{name}", marks=pytest.mark.slow if states else [])
        for kind in range(4)
        for name, states in (("plain", None), ("states", STATES))
    ],
)
def test_of_one_measurement_it_is_the_sum_of_both_likelihoods(kind, states):
    whole, filter_setup = every_kind(), dataclasses.replace(KINDS, states=states)
    series = whole.record.vectors[kind]
    # The others have no samples: the filter is that of every kind.
    vectors = tuple(each.taken(slice(9, 10) if each is series else slice(0)) for each in whole.record.vectors)
    case = dataclasses.replace(whole, record=dataclasses.replace(whole.record, vectors=vectors))
    name = f"{series.sensor}.sigma"
    if series.kind != "heading" and states is not None:
        filter_setup = dataclasses.replace(filter_setup, sigma={series.sensor: (2e-2, 1e-2, 4e-2)})
    plain = tuning.likelihood([case], filter_setup, [name])
    narrow, wide = -plain.minus_log(np.array([plain.start, plain.start + np.log(7.0)]))
    objective = tuning.contaminated_likelihood([case], filter_setup, [name], share=0.2, scale=7.0)
    expected = np.logaddexp(np.log(0.8) + narrow, np.log(0.2) + wide)
    assert -objective.minus_log(objective.start)[0] == pytest.approx(expected, rel=1e-12)


GRADIENTS = {
    "plain": (None, ("gyro.arw", "up.sigma", "tracker.sigma")),
    "two passes": (None, ("gyro.arw", "up.sigma", "tracker.sigma", "sun.sigma", "north.sigma", "gyro.rrw")),
    "states": (STATES, ("gyro.scale_sigma", "gyro.drift_time", "tracker.sigma")),
}


@pytest.mark.parametrize(
    ("states", "names"),
    [pytest.param(*each, id=name, marks=pytest.mark.slow if each[0] else []) for name, each in GRADIENTS.items()],
)
def test_the_gradient_is_that_of_the_likelihood(states, names):
    case, filter_setup = every_kind(), dataclasses.replace(KINDS, states=states)
    objective = tuning.contaminated_likelihood([case, case], filter_setup, names, threads=2)
    p = len(objective.start)
    point = objective.start + np.resize([0.2, -0.3, 0.1, 0.5, -0.3], p)
    derivatives = objective.derivatives(point)
    expected = differences(lambda x: objective.minus_log(x)[0], point)
    most = 4.0 * innovations.STEP * np.maximum(np.diag(derivatives.information), 1.0) + 1e-6
    np.testing.assert_array_less(np.abs(derivatives.score.sum(axis=0) - expected), most)
    assert derivatives.value.sum() == pytest.approx(objective.minus_log(point)[0], rel=1e-13)
    np.testing.assert_allclose(derivatives.information, derivatives.information.T)
    assert np.linalg.eigvalsh(derivatives.information).min() > 0.0


def correlated(duration: float) -> scenarios.Scenario:
    """Stars whose noise is in part correlated, with outliers."""
    faults = vectors.Faults(outlier_probability=0.05, outlier_scale=10.0, correlated_sigma=2e-4, correlation_time=20.0)
    plain = two_stars.scenario(duration)
    return dataclasses.replace(
        plain, sensors=tuple(dataclasses.replace(sensor, faults=faults) for sensor in plain.sensors)
    )


@pytest.mark.parametrize("states", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["plain", "states"])
def test_the_information_is_the_scatter_of_the_score(states):
    """At the truth, over independent records: the collapse of the mixture to one normal costs little."""
    filter_setup, free, star_scenario = BELIEVED, FREE, scenario(300.0)
    if states:
        star_scenario = correlated(300.0)
        filter_setup = dataclasses.replace(FilterSetup.for_scenario(star_scenario, states=True), attitude_sigma=1e-3)
        free = ("star 1.sigma", "star 2.sigma", "star 1.correlated_sigma")
    scores, information = [], []
    for seed in range(40):
        case = tuning.record_case(scenarios.simulate(star_scenario, seed), filter_setup, seed=seed)
        objective = tuning.contaminated_likelihood([case], filter_setup, free, share=0.05, scale=10.0)
        derivatives = objective.derivatives(objective.start)
        scores.append(derivatives.score.sum(axis=0))
        information.append(derivatives.information)
    F, J = np.diag(np.mean(information, axis=0)), np.var(np.array(scores), axis=0)
    np.testing.assert_allclose(J / F, 1.0, atol=0.6)
    assert np.all(np.abs(np.mean(scores, axis=0)) < 3.5 * np.sqrt(F / len(scores)))


# ------------------------------------------------------------------------------------------------------ what it finds


def recovered(seeds: int, duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuning.TunedGate]]:
    """Return errors of ln θ (seeds, 6), standard errors, whether the intervals hold the truth, and the gates."""
    truth = np.array([*TRUTH, 0.05, 10.0])
    wrong = tuning.with_values(BELIEVED, WRONG)
    errors, stated, inside, gates = [], [], [], []
    for seed in range(seeds):
        objective = tuning.contaminated_likelihood([case(seed, duration)], wrong, FREE)
        fit = tuning.fit(objective, starts=1)
        gates.append(tuning.tuned_gate(fit))
        errors.append(np.log([parameter.value for parameter in fit.parameters] / truth))
        stated.append([parameter.standard_error for parameter in fit.parameters])
        inside.append(
            [parameter.lower <= x <= parameter.upper for parameter, x in zip(fit.parameters, truth, strict=True)]
        )
    return np.array(errors), np.array(stated), np.array(inside), gates


def right_gate(duration: float) -> float:
    """The gate's probability at the truth."""
    objective = tuning.contaminated_likelihood([case(0, duration)], BELIEVED, FREE)
    noise = outliers._noise_by_sensor(objective, np.log(TRUTH))
    return float(outliers._probability(noise, np.array([[0.05, 10.0]]))[0][0])


def test_five_in_a_hundred_ten_times_as_wide_are_found_from_wrong_parameters():
    errors, stated, inside, gates = recovered(3, 1200.0)
    assert np.all(np.abs(errors) < 3.5 * stated)
    assert np.all(stated < [0.05, 0.2, 0.05, 0.03, 0.15, 0.1])
    assert inside.mean() >= 0.8
    right = right_gate(1200.0)
    for gate in gates:
        assert gate.lower < gate.probability < gate.upper
        assert np.log((1.0 - gate.probability) / (1.0 - right)) == pytest.approx(0.0, abs=0.5)
        assert 11.0 < gate.thresholds["star 1"] < 16.0


def test_the_gate_is_described_by_the_share_that_it_refuses():
    """Of 1e-5: the share that it accepts would be printed as 100 %."""
    share = result.Estimated(
        name="outliers.share", unit="", start=0.02, value=0.01, most_likely=0.01, lower=0.008, upper=0.012, standard_error=0.1,
        identified=True, note="",
    )  # fmt: skip
    described = outliers.TunedGate(
        gate=Gate(probability=1.0 - 1e-5), probability=1.0 - 1e-5, lower=1.0 - 4e-5, upper=1.0 - 2e-6, thresholds={"st": 25.0},
        share=share,
    )  # fmt: skip
    assert described.words.endswith("The gate rejects 0.001 % of valid measurements (95 %: 0.0002 to 0.004).")


@pytest.mark.slow
def test_five_in_a_hundred_over_60_records():
    errors, stated, inside, gates = recovered(60, 1200.0)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert np.all(rms < 1.25 * np.median(stated, axis=0)), (rms, np.median(stated, axis=0))
    assert np.all(inside.mean(axis=0) >= 0.85), inside.mean(axis=0)
    right = right_gate(1200.0)
    assert np.mean([gate.lower <= right <= gate.upper for gate in gates]) >= 0.85


@pytest.mark.slow
def test_outliers_are_found_beside_correlated_noise_that_has_states():
    scenario = correlated(600.0)
    filter_setup = dataclasses.replace(FilterSetup.for_scenario(scenario, states=True), attitude_sigma=1e-3)
    truth = {"star 1.sigma": 1e-4, "star 2.sigma": 2e-4}
    wrong = tuning.with_values(filter_setup, {name: 2.0 * value for name, value in truth.items()})
    case = tuning.record_case(scenarios.simulate(scenario, 4), filter_setup, seed=4)
    tuned = sd.tune(case, setup=wrong, free=tuple(truth), starts=1, threads=1, gate=True)
    gate = tuned.gate
    for parameter, right in zip(tuned.parameters, [*truth.values(), 0.05, 10.0], strict=True):
        assert parameter.lower <= right <= parameter.upper, parameter
        assert parameter.standard_error < 0.2
    assert gate is not None
    assert gate.lower < gate.probability < gate.upper
    assert tuned.setup.gate == gate.gate


def test_outliers_that_the_tuned_gate_rejects_are_not_said_to_be_unmodelled():
    record = scenarios.simulate(scenario(100.0), 1)
    for gate in (True, False):
        tuned = sd.tune(record, free=["star 1.sigma"], starts=1, threads=1, gate=gate)
        assert ("the outliers of the star 1" not in " ".join(tuned.words)) == gate == (tuned.setup.gate is not None)


def test_where_there_is_none_there_is_no_gate():
    wrong = tuning.with_values(BELIEVED, WRONG)
    objective = tuning.contaminated_likelihood([case(1, 600.0, 0.0)], wrong, FREE)
    fit = tuning.fit(objective, starts=1)
    assert not fit["outliers.share"].identified
    assert fit["outliers.share"].upper < 0.03
    gate = tuning.tuned_gate(fit)
    assert gate.gate is None
    assert np.isnan(gate.probability)
    # What is tuned beside it is what it is without.
    plain = tuning.fit(tuning.likelihood([case(1, 600.0, 0.0)], wrong, FREE), starts=1)
    for name in ("gyro.arw", "star 1.sigma", "star 2.sigma"):
        assert abs(np.log(fit[name].value / plain[name].value)) < 1.5 * plain[name].standard_error


def test_random_starts_stay_where_outliers_are_outliers():
    objective = tuning.contaminated_likelihood([case(2, 600.0)], tuning.with_values(BELIEVED, WRONG), FREE)
    fit = tuning.fit(objective, starts=4, intervals=False)
    assert fit.agreeing == 4
    low, high = np.log(outliers.SHARES)
    assert np.all((fit.starts[:, -2] >= low) & (fit.starts[:, -2] <= high))


def test_at_the_threshold_an_outlier_is_as_likely_as_none():
    """Where the state is known: the densities of both, times how frequent they are, are equal there."""
    for degrees, share, scale in ((1, 0.05, 10.0), (2, 0.01, 5.0), (3, 0.2, 3.0)):
        noise = {"star": outliers._SensorNoise(degrees=degrees, number=100, noise=1.0)}
        (probability,), thresholds = outliers._probability(noise, np.array([[share, scale]]))
        e = np.zeros(degrees)
        e[0] = np.sqrt(thresholds["star"][0])
        inside = np.log(1.0 - share) + np.sum(norm.logpdf(e))
        outside = np.log(share) + np.sum(norm.logpdf(e, scale=scale))
        assert inside == pytest.approx(outside, rel=1e-12)
        assert probability == pytest.approx(chi2.cdf(thresholds["star"][0], degrees), rel=1e-12)


def test_the_share_of_its_own_noise_in_an_innovation_is_that_of_the_filter():
    case = every_kind()
    objective = tuning.contaminated_likelihood([case], KINDS, ("gyro.arw", "tracker.sigma"))
    noise = outliers._noise_by_sensor(objective, objective.start[:-2])
    estimate = setup.run(case.record, KINDS, case.initial)
    for series in case.record.vectors:
        own = series.sigma_axes if series.sigma_axes is not None else series.sigma[:, None]
        if series.kind == "vector":
            own = own / np.linalg.norm(series.references_f, axis=1)[:, None]
        share = np.mean(own**2 / estimate.innovations[series.sensor].variance)
        if series.kind != "heading":  # whose noise comes over the level part of its reference
            assert noise[series.sensor].noise == pytest.approx(share, rel=1e-6)
        assert 0.0 < noise[series.sensor].noise < 1.0
        assert noise[series.sensor].number == len(estimate.innovations[series.sensor].time)


def test_the_gate_makes_the_filter_credible_on_data_held_out():
    (train,), test = tuning.split([case(1, 900.0)], 0.4)
    wrong = tuning.with_values(BELIEVED, WRONG)
    objective = tuning.contaminated_likelihood([train], wrong, FREE)
    fit = tuning.fit(objective, starts=1)
    gate = tuning.tuned_gate(fit).gate
    assert gate is not None
    after = dataclasses.replace(fit.setup, gate=gate)
    compared = tuning.compare(test, wrong, after)
    assert compared.after.nis == pytest.approx(1.0, abs=0.12)
    assert compared.after.anees == pytest.approx(1.0, abs=0.5)
    assert compared.before.anees > 2.0
    assert compared.after.attitude_rms < compared.before.attitude_rms
    # Without outliers in the model σ answers for them.
    plain = tuning.fit(tuning.likelihood([train], wrong, FREE), starts=1)
    assert plain["star 2.sigma"].value > 1.6 * fit["star 2.sigma"].value
    # The likelihood of what is held out, of the mixture, is more than that of the best single normal.
    likely = tuning.log_likelihood(test, dataclasses.replace(fit, setup=after))
    assert likely > tuning.compare(test, wrong, plain.setup).after.log_likelihood + 0.05


def test_a_gate_of_the_setup_keeps_what_else_it_says_and_so_many_outliers_are_none():
    filter_setup = dataclasses.replace(BELIEVED, gate=Gate(probability=0.9, recovery=None))
    objective = tuning.contaminated_likelihood([case(1, 300.0)], filter_setup, FREE[2:])
    fit = tuning.fit(objective, starts=1, intervals=False)
    known = {"identified": True}  # which intervals would say
    fit = dataclasses.replace(fit, parameters=tuple(dataclasses.replace(p, **known) for p in fit.parameters))
    gate = tuning.tuned_gate(fit)
    assert gate.gate is not None
    assert gate.gate.recovery is None
    assert gate.gate.probability == gate.probability != 0.9
    many = tuple(dataclasses.replace(p, value=0.39) if p.name == "outliers.share" else p for p in fit.parameters)
    assert tuning.tuned_gate(dataclasses.replace(fit, parameters=many)).gate is None
