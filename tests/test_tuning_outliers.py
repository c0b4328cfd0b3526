"""Outliers in tuning: the mixture's likelihood against a plain filter of matrices, what it recovers, and the gate that follows."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import two_stars
from scipy.stats import chi2, norm
from two_stars import BELIEVED, FREE, TRUTH, WRONG

from strapdown import gyro, motion, quaternion, scenarios, tuning, vectors
from strapdown.checks import InputError
from strapdown.estimation import setup
from strapdown.estimation.gating import Gate
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise
from strapdown.recordings import recordfiles
from strapdown.records import ImuRecord
from strapdown.report import tunings
from strapdown.tuning import innovations, outliers
from strapdown.vectors import VectorMeasurements


def scenario(duration: float = 200.0, share: float = 0.05) -> scenarios.Scenario:
    return two_stars.scenario(duration, outliers=share)


def case(seed: int = 0, duration: float = 200.0, share: float = 0.05) -> tuning.Case:
    return two_stars.case(seed, duration, outliers=share)


# --------------------------------------------------------------------------------------------------- the likelihood


def angle_case(n: int = 60, seed: int = 4) -> tuple[tuning.Case, FilterSetup, np.ndarray, np.ndarray]:
    """A body at rest to within microradians, its whole attitude measured, some measurements far off: linear to 1e-6."""
    random = np.random.default_rng(seed)
    dt, sigma = 0.5, 1e-6
    increments = 3e-7 * random.standard_normal((n, 3))
    struck = np.where(random.random(n) < 0.2, 8.0, 1.0)[:, None]
    angles = np.cumsum(increments, axis=0) + sigma * struck * random.standard_normal((n, 3))
    series = VectorMeasurements(
        sensor="tracker",
        kind="attitude",
        time=dt * np.arange(1, n + 1),
        attitude=quaternion.exp(angles),
        sigma_axes=np.full(3, sigma),
    )
    record = ImuRecord(time=dt * np.arange(n + 1), increments=increments, vectors=(series,))
    chosen = FilterSetup(
        process_noise=ProcessNoise(angle_random_walk=8e-7, rate_random_walk=2e-7), attitude_sigma=2e-6, bias_sigma=1e-6
    )
    initial = setup.initial_state(chosen, np.array([1.0, 0.0, 0.0, 0.0]))
    return tuning.Case(record=record, initial=initial), chosen, increments, angles


def plain_mixture(share, scale, chosen, increments, angles, dt=0.5, sigma=1e-6):
    """Minus the log likelihood, and the probability of each outlier, by a Kalman filter of (angles, biases) in matrices."""
    white, walk = chosen.process_noise.angle_random_walk, chosen.process_noise.rate_random_walk
    eye = np.eye(3)
    F = np.block([[eye, -dt * eye], [0.0 * eye, eye]])
    Q = np.block(
        [
            [(white**2 * dt + walk**2 * dt**3 / 3.0) * eye, -(walk**2) * dt**2 / 2.0 * eye],
            [-(walk**2) * dt**2 / 2.0 * eye, walk**2 * dt * eye],
        ]
    )
    H = np.hstack([eye, 0.0 * eye])
    x, P = np.zeros(6), np.diag(np.repeat([chosen.attitude_sigma**2, chosen.bias_sigma**2], 3))
    total, probabilities = 0.0, []
    for increment, angle in zip(increments, angles, strict=True):
        x = F @ x + np.concatenate([increment, np.zeros(3)])
        P = F @ P @ F.T + Q
        e, logs, means, covariances = angle - H @ x, [], [], []
        for factor, weight in ((1.0, 1.0 - share), (scale**2, share)):
            S = H @ P @ H.T + factor * sigma**2 * eye
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


def test_in_the_linear_case_it_is_the_filter_of_two_normals():
    one, chosen, increments, angles = angle_case()
    objective = tuning.contaminated_likelihood([one], chosen, ["gyro.arw", "tracker.sigma"], share=0.1, scale=6.0)
    expected, probabilities = plain_mixture(0.1, 6.0, chosen, increments, angles)
    assert objective.minus_log(objective.start)[0] == pytest.approx(expected, rel=1e-7)
    np.testing.assert_allclose(objective.probabilities(objective.start)[0], probabilities, rtol=1e-4, atol=1e-7)
    # Eight points at once are one after the other.
    points = objective.start + np.random.default_rng(1).uniform(-0.5, 0.5, (11, 4))
    alone = [float(objective.minus_log(point)[0]) for point in points]
    np.testing.assert_allclose(objective.minus_log(points), alone, rtol=1e-12)
    for point, value in zip(points, alone, strict=True):
        arw, sigma, share, scale = np.exp(point)
        other = dataclasses.replace(chosen, process_noise=ProcessNoise(angle_random_walk=arw, rate_random_walk=2e-7))
        assert value == pytest.approx(plain_mixture(share, scale, other, increments, angles, sigma=sigma)[0], rel=1e-7)


def every_kind(seed: int = 0) -> tuning.Case:
    """A record that turns fast, with one series of each kind."""
    body = motion.ConstantRate(rate=np.array([0.4, -0.7, 1.1]))
    random = np.random.default_rng(seed)
    edges = np.cumsum(np.concatenate([[0.0], random.uniform(0.2, 0.6, 120)]))
    output = gyro.simulate(
        gyro.GyroSpec(angle_random_walk=1e-3, rate_random_walk=1e-4), body.increments(edges), edges, random
    )
    sensors = (
        vectors.VectorSensor(name="sun", reference_f=np.array([0.0, 0.6, 0.8]), sigma=1e-2, rate=1.3),
        vectors.Accelerometer(name="up", sigma=0.2, rate=1.0, kind="vector"),
        vectors.Magnetometer(name="north", field_f=np.array([2e-5, 1e-5, -3e-5]), sigma=1e-6, rate=0.7, kind="heading"),
        vectors.AttitudeSensor(name="tracker", sigma_across=5e-3, sigma_about=2e-2, rate=0.5),
    )
    series = tuple(sensor.observe(body, float(edges[0]), float(edges[-1]), random) for sensor in sensors)
    record = ImuRecord(time=edges, increments=output.increments, vectors=series)
    return tuning.Case(record=record, initial=setup.initial_state(KINDS, body.attitude(edges[0])))


KINDS = FilterSetup(
    process_noise=ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-4), attitude_sigma=0.3, bias_sigma=1e-2
)


def test_without_outliers_it_is_the_likelihood_of_all_kinds_of_measurement():
    one = every_kind()
    names = ("gyro.arw", "sun.sigma", "up.sigma", "north.sigma", "tracker.sigma")
    plain = tuning.likelihood([one], KINDS, names)
    objective = tuning.contaminated_likelihood([one], KINDS, names)
    point = plain.start + 0.2
    none = np.concatenate([point, np.log([1e-13, 10.0])])
    assert objective.minus_log(none)[0] == pytest.approx(plain.minus_log(point)[0], rel=1e-9)
    same = np.concatenate([point, np.log([0.3, 1.0])])  # outliers that are like the rest
    assert objective.minus_log(same)[0] == pytest.approx(plain.minus_log(point)[0], rel=1e-12)


@pytest.mark.parametrize("kind", range(4))
def test_of_one_measurement_it_is_the_sum_of_both_likelihoods(kind):
    whole = every_kind()
    series = whole.record.vectors[kind]
    one = dataclasses.replace(whole, record=dataclasses.replace(whole.record, vectors=(series.taken(slice(9, 10)),)))
    name = f"{series.sensor}.sigma"
    plain = tuning.likelihood([one], KINDS, [name])
    narrow, wide = -plain.minus_log(np.array([plain.start, plain.start + np.log(7.0)]))
    objective = tuning.contaminated_likelihood([one], KINDS, [name], share=0.2, scale=7.0)
    expected = np.logaddexp(np.log(0.8) + narrow, np.log(0.2) + wide)
    assert -objective.minus_log(objective.start)[0] == pytest.approx(expected, rel=1e-12)


def test_the_gradient_is_that_of_the_likelihood():
    one = every_kind()
    objective = tuning.contaminated_likelihood([one, one], KINDS, ("gyro.arw", "up.sigma", "tracker.sigma"), threads=2)
    point = objective.start + np.array([0.2, -0.3, 0.1, 0.5, -0.3])
    found = objective.derivatives(point)
    for j in range(5):
        step = 1e-3 * np.eye(5)[j]
        f = objective.minus_log(np.array([point + k * step for k in (-2, -1, 1, 2)]))
        expected = (f[0] - 8.0 * f[1] + 8.0 * f[2] - f[3]) / 12e-3
        size = max(float(found.information[j, j]), 1.0)
        assert found.score.sum(axis=0)[j] == pytest.approx(expected, abs=4.0 * innovations.STEP * size + 1e-6)
    assert found.value.sum() == pytest.approx(objective.minus_log(point)[0], rel=1e-13)
    np.testing.assert_allclose(found.information, found.information.T)
    assert np.linalg.eigvalsh(found.information).min() > 0.0


def test_the_information_is_the_scatter_of_the_score():
    """At the truth, over independent records: the collapse of the mixture to one normal costs little."""
    scores, information = [], []
    truth = np.log([*TRUTH, 0.05, 10.0])
    for seed in range(40):
        found = tuning.contaminated_likelihood([case(seed, 300.0)], BELIEVED, FREE).derivatives(truth)
        scores.append(found.score.sum(axis=0))
        information.append(found.information)
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
        found = tuning.fit(objective, starts=1)
        gates.append(tuning.tuned_gate(objective, found))
        errors.append(np.log([one.value for one in found.parameters] / truth))
        stated.append([one.standard_error for one in found.parameters])
        inside.append([one.lower <= x <= one.upper for one, x in zip(found.parameters, truth, strict=True)])
    return np.array(errors), np.array(stated), np.array(inside), gates


def right_gate(duration: float) -> float:
    """The gate's probability at the truth."""
    objective = tuning.contaminated_likelihood([case(0, duration)], BELIEVED, FREE)
    seen = outliers._seen(objective, np.log(TRUTH))
    return float(outliers._probability(seen, np.array([[0.05, 10.0]]))[0][0])


def test_five_in_a_hundred_ten_times_as_wide_are_found_from_wrong_parameters():
    errors, stated, inside, gates = recovered(3, 1200.0)
    assert np.all(np.abs(errors) < 3.5 * stated)
    assert np.all(stated < [0.05, 0.2, 0.05, 0.03, 0.15, 0.1])
    assert inside.mean() >= 0.8
    right = right_gate(1200.0)
    for found in gates:
        assert found.lower < found.probability < found.upper
        assert np.log((1.0 - found.probability) / (1.0 - right)) == pytest.approx(0.0, abs=0.5)
        assert 11.0 < found.thresholds["star 1"] < 16.0


@pytest.mark.slow
def test_five_in_a_hundred_over_60_records():
    errors, stated, inside, gates = recovered(60, 1200.0)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert np.all(rms < 1.25 * np.median(stated, axis=0)), (rms, np.median(stated, axis=0))
    assert np.all(inside.mean(axis=0) >= 0.85), inside.mean(axis=0)
    right = right_gate(1200.0)
    assert np.mean([found.lower <= right <= found.upper for found in gates]) >= 0.85


def test_where_there_is_none_there_is_no_gate():
    wrong = tuning.with_values(BELIEVED, WRONG)
    objective = tuning.contaminated_likelihood([case(1, 600.0, 0.0)], wrong, FREE)
    found = tuning.fit(objective, starts=1)
    assert not found["outliers.share"].identified
    assert found["outliers.share"].upper < 0.03
    gate = tuning.tuned_gate(objective, found)
    assert gate.gate is None
    assert np.isnan(gate.probability)
    # What is tuned beside it is what it is without.
    plain = tuning.fit(tuning.likelihood([case(1, 600.0, 0.0)], wrong, FREE), starts=1)
    for name in ("gyro.arw", "star 1.sigma", "star 2.sigma"):
        assert abs(np.log(found[name].value / plain[name].value)) < 1.5 * plain[name].standard_error


def test_random_starts_stay_where_outliers_are_outliers():
    objective = tuning.contaminated_likelihood([case(2, 600.0)], tuning.with_values(BELIEVED, WRONG), FREE)
    found = tuning.fit(objective, starts=4, intervals=False, factor=30.0)
    assert found.agreeing == 4
    low, high = np.log(outliers.SHARES)
    assert np.all((found.starts[:, -2] >= low) & (found.starts[:, -2] <= high))


def test_at_the_threshold_an_outlier_is_as_likely_as_none():
    """Where the state is known: the densities of both, times how frequent they are, are equal there."""
    for degrees, share, scale in ((1, 0.05, 10.0), (2, 0.01, 5.0), (3, 0.2, 3.0)):
        seen = {"star": outliers._Seen(degrees=degrees, number=100, noise=1.0)}
        (probability,), thresholds = outliers._probability(seen, np.array([[share, scale]]))
        e = np.zeros(degrees)
        e[0] = np.sqrt(thresholds["star"][0])
        inside = np.log(1.0 - share) + np.sum(norm.logpdf(e))
        outside = np.log(share) + np.sum(norm.logpdf(e, scale=scale))
        assert inside == pytest.approx(outside, rel=1e-12)
        assert probability == pytest.approx(chi2.cdf(thresholds["star"][0], degrees), rel=1e-12)


def test_the_share_of_its_own_noise_in_an_innovation_is_that_of_the_filter():
    one = every_kind()
    objective = tuning.contaminated_likelihood([one], KINDS, ("gyro.arw", "tracker.sigma"))
    seen = outliers._seen(objective, objective.base.start)
    estimate = setup.run(one.record, KINDS, one.initial)
    for series in one.record.vectors:
        own = series.sigma_axes if series.sigma_axes is not None else series.sigma[:, None]
        if series.kind == "vector":
            own = own / np.linalg.norm(series.references_f, axis=1)[:, None]
        rows = 3 if series.kind == "attitude" else 1 if series.kind == "heading" else 2
        share = np.mean(own**2 / estimate.innovations[series.sensor].variance[:, :rows])
        if series.kind != "heading":  # whose noise comes over the level part of its reference
            assert seen[series.sensor].noise == pytest.approx(share, rel=1e-6)
        assert 0.0 < seen[series.sensor].noise < 1.0
        assert seen[series.sensor].number == len(estimate.innovations[series.sensor].time)


def test_the_gate_makes_the_filter_credible_on_data_held_out():
    (train,), test = tuning.split([case(1, 900.0)], 0.4)
    wrong = tuning.with_values(BELIEVED, WRONG)
    objective = tuning.contaminated_likelihood([train], wrong, FREE)
    found = tuning.fit(objective, starts=1)
    gate = tuning.tuned_gate(objective, found).gate
    assert gate is not None
    after = dataclasses.replace(found.setup, gate=gate)
    compared = tuning.compare(test, wrong, after)
    assert compared.after.nis == pytest.approx(1.0, abs=0.12)
    assert compared.after.anees == pytest.approx(1.0, abs=0.5)
    assert compared.before.anees > 2.0
    assert compared.after.attitude_rms < compared.before.attitude_rms
    # Without outliers in the model σ answers for them.
    plain = tuning.fit(tuning.likelihood([train], wrong, FREE), starts=1)
    assert plain["star 2.sigma"].value > 1.6 * found["star 2.sigma"].value
    # The likelihood of what is held out, of the mixture, is more than that of the best single normal.
    likely = tuning.log_likelihood(test, objective, dataclasses.replace(found, setup=after))
    assert likely > tuning.compare(test, wrong, plain.setup).after.log_likelihood + 0.05


def test_so_many_outliers_are_none():
    objective = tuning.contaminated_likelihood([case(1)], BELIEVED, FREE)
    found = tuning.fit(objective, starts=1, intervals=False)
    many = tuple(
        dataclasses.replace(one, value=0.39, identified=True) if one.name == "outliers.share" else one
        for one in found.parameters
    )
    assert tuning.tuned_gate(objective, dataclasses.replace(found, parameters=many)).gate is None


def test_a_gate_of_the_setup_keeps_what_else_it_says():
    given = dataclasses.replace(BELIEVED, gate=Gate(probability=0.9, recovery=None))
    objective = tuning.contaminated_likelihood([case(1, 300.0)], given, FREE[2:])
    found = tuning.tuned_gate(objective, tuning.fit(objective, starts=1))
    assert found.gate is not None
    assert found.gate.recovery is None
    assert found.gate.probability == found.probability != 0.9


def test_bad_input_is_refused():
    with pytest.raises(InputError, match=r"share of the outliers is 0.6; it must lie between 0.0001 and 0.4"):
        tuning.contaminated_likelihood([case()], BELIEVED, FREE, share=0.6)
    with pytest.raises(InputError, match="scale of the outliers is 1"):
        tuning.contaminated_likelihood([case()], BELIEVED, FREE, scale=1.0)
    with pytest.raises(InputError, match="6 parameters are free; beside outliers at most 5"):
        tuning.contaminated_likelihood([case()], BELIEVED, (*FREE, "initial.attitude", "initial.bias"))


# -------------------------------------------------------------------------------------------------- the command line


def test_tune_with_a_gate_writes_it_into_the_filter(run, tmp_path):
    path, out = tmp_path / "sat.h5", tmp_path / "tuned.toml"
    recordfiles.write_record(path, scenarios.simulate(scenario(300.0), 1))
    options = ("--free", "gate.probability,star 1.sigma,star 2.sigma", "--holdout", 0.3, "--starts", 1)
    status, said, complaint = run("tune", path, *options, "-o", out)
    assert status == 0, complaint
    assert "outliers.share" in said
    assert "is more likely an outlier than noise" in said
    content = json.loads(out.with_suffix(".json").read_text())
    found = setup.read_setup(out)
    assert found.gate is not None
    assert found.gate.probability == pytest.approx(content["gate"]["probability"])
    assert content["gate"]["lower"] < content["gate"]["probability"] < content["gate"]["upper"]
    assert set(content["gate"]["thresholds"]) == {"star 1", "star 2"}
    page, _ = tunings.report(out.with_suffix(".json"), 0.99)
    assert "a measurement with a NIS above" in page
    one = case(1, 300.0)
    estimate = setup.run(one.record, found, one.initial)
    assert all(innovation.refused > 5 for innovation in estimate.innovations.values())


@pytest.mark.parametrize("other", ["--truth", "--rmse"])
def test_a_gate_needs_all_innovations(run, tmp_path, other):
    path = tmp_path / "sat.h5"
    recordfiles.write_record(path, scenarios.simulate(scenario(60.0), 1))
    status, _, complaint = run("tune", path, "--gate", other, "-o", tmp_path / "f.toml")
    assert status == 2
    assert "likelihood of all innovations" in complaint.replace("\n", " ")
