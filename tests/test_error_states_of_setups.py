"""Optional states of a filter setup: their files, the blocks they become, gates and robust weights, the whole bias; refusals."""

import dataclasses

import numpy as np
import pytest
from gated_steps import GatedStepFilter
from measured import (
    FIELD,
    beside_silent,
    drawn_start,
    every_kind,
    in_body,
    record_of,
    resting,
    series_of,
    turn_to,
    unit,
)
from measured import HAND as SWAY

from strapdown import estimation, kinematics, motion, quaternion, scenarios, vectors
from strapdown.estimation import angular_acceleration, error_states, forward, setup
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.model import assemble
from strapdown.estimation.setup import FilterSetup, matching
from strapdown.estimation.setup import states as optional
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise
from strapdown.gyro import GyroSpec
from strapdown.kernels import rows as row_kernels
from strapdown.kernels import structure
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario

NOISE = ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-5)
WHOLE = States(
    gyro_scale_sigma=(1e-3, 0.0, 1.23456789e-4),
    gyro_misalignment_sigma=((0.0, 1e-3, 0.0), (0.0, 0.0, 2e-3), (1.7e-4, 0.0, 0.0)),
    gyro_force_sigma=4.9e-7,
    gyro_cross_force_sigma=((0.0, 1e-7, 0.0), (0.0, 0.0, 0.0), (0.0, 3.3e-7, 0.0)),
    gyro_drift_sigma=(1e-6, 2.2e-6),
    gyro_drift_time=(60.0, 6.1),
    gyro_fast_bias_sigma=3.3e-7,
    gravity_f=(0.0, 0.1, -9.8),
    sensors={
        "mag": SensorStates(mounting_sigma=(1e-3, 2e-3, 2.5e-3), bias_sigma=(1e-3, 2e-3, 3.14e-3), varying=True),
        "acc": SensorStates(
            correlated_sigma=0.05, correlation_time=0.7, frame="fixed", lever_arm_sigma=(0.0, 0.1, 0.3)
        ),
    },
)


def simulated(seed=3, duration=20.0, kind="vector", outlier_probability=0.0, **gyro) -> ImuRecord:
    scenario = Scenario(
        motion=SWAY,
        gyro=GyroSpec(angle_random_walk=1e-3, rate_random_walk=1e-5, **gyro),
        sensors=(
            vectors.Magnetometer(
                name="mag",
                field_f=FIELD,
                sigma=5e-7,
                rate=10.0,
                kind=kind,
                hard_iron=np.array([2e-6, -3e-6, 1e-6]),
                faults=vectors.Faults(outlier_probability=outlier_probability, outlier_scale=15.0),
            ),
            vectors.Accelerometer(name="acc", sigma=0.05, rate=25.0, phase=0.013, kind=kind),
        ),
        rate=50.0,
        duration=duration,
    )
    return scenarios.simulate(scenario, seed)


def begun(record, attitude_sigma=0.02, bias_sigma=3e-3, seed=1) -> estimation.State:
    draw = np.random.default_rng(seed).standard_normal(6)
    return drawn_start(record.truth, draw, attitude_sigma, bias_sigma)


# ------------------------------------------------------------------------------------------------------------------------ files


def test_states_go_through_their_file_to_the_last_bit(tmp_path):
    whole = FilterSetup(process_noise=NOISE, bias_sigma=1e-5, states=WHOLE, sigma={"mag": 1e-6})
    path = tmp_path / "filter.toml"
    path.write_text(setup.to_toml(whole), encoding="utf-8")
    assert setup.read_setup(path) == whole
    text = path.read_text()
    for key in ("gyro_scale_sigma_ppm", "gyro_drift_time_s", "lever_arm_sigma_m", "[filter.states.sensors.mag]"):
        assert key in text
    rng = np.random.default_rng(4)
    for _ in range(50):
        states = States(
            gyro_scale_sigma=tuple(10.0 ** rng.uniform(-6, -2, 3)),
            gyro_drift_sigma=10.0 ** rng.uniform(-8, -3, 2),
            gyro_drift_time=10.0 ** rng.uniform(0, 4, 2),
            gyro_force_sigma=10.0 ** rng.uniform(-9, -5),
        )
        assert optional.from_table(optional.to_table(states)) == states
    matched = setup.FilterSetup.for_scenario(scenarios.load_scenario("hand-held"), states=True)
    assert setup.from_toml(setup.to_toml(matched)) == matched


def setup_of(states, **more) -> FilterSetup:
    return FilterSetup(process_noise=NOISE, attitude_sigma=0.02, bias_sigma=3e-3, states=states, **more)


def run(record, filter_setup, **options):
    return setup.run(record, filter_setup, begun(record), **options)


# ---------------------------------------------------------------------------------------------- without states: the plain filter


def test_a_gate_keeps_outliers_from_the_states():
    record = simulated(outlier_probability=0.05, duration=60.0)
    states = States(sensors={"mag": SensorStates(bias_sigma=3e-6)})
    gated, robust = (
        run(record, setup_of(states, **options)) for options in ({"gate": Gate(recovery=None)}, {"robust": Robust()})
    )
    true = np.array([2e-6, -3e-6, 1e-6])
    struck = len(record.vectors[0].time) * 0.05
    assert 0.5 * struck < gated.refused["mag"] < 1.6 * struck
    assert gated.refused["acc"] < 10
    for estimate in (gated, robust):
        bias = estimate.error_states["mag bias"]
        assert np.linalg.norm(bias.values[-1] - true) < 4.0 * np.linalg.norm(bias.sigma[-1])
        used = estimate.innovations["mag"]
        nis = used.nis[used.weight > 0.5].mean() / 3.0
        assert 0.85 < nis < 1.1


def test_the_gate_of_a_vector_lets_pass_as_many_as_it_says():
    record = simulated(duration=120.0, seed=8)
    states = States(sensors={"mag": SensorStates(bias_sigma=3e-6)})
    estimate = run(record, setup_of(states, gate=Gate(probability=0.9, recovery=None)))
    for innovations in estimate.innovations.values():
        assert abs(innovations.refused / len(innovations.time) - 0.1) < 4.0 * np.sqrt(0.09 / len(innovations.time))


# -------------------------------------------------------------------------------------------------------------------- the whole bias


DRIFTING = States(
    gyro_scale_sigma=1e-3,
    gyro_misalignment_sigma=1e-3,
    gyro_drift_sigma=(2e-3,),
    gyro_drift_time=(8.0,),
    gyro_fast_bias_sigma=1e-4,
    sensors={"mag": SensorStates(bias_sigma=3e-6), "force": SensorStates(correlated_sigma=0.01, correlation_time=0.7)},
)
"""In the structure of :data:`measured.EVERY_KIND`."""


def test_the_whole_bias_is_that_of_all_states():
    """In the filter, the parts of which are those of the declarations, and in the smoother; at its last edge that is the filter."""
    record = record_of(SWAY, anisotropic=True)
    attitude = quaternion.multiply(SWAY.attitude(np.array(0.0)), quaternion.exp([0.01, -0.02, 0.015]))
    initial = estimation.initial_state(attitude, attitude_sigma=0.02, bias_sigma=3e-3)
    reported = setup.run(record, setup_of(DRIFTING), initial, full_covariance=True)
    blocks = DRIFTING.blocks({series.sensor: series.kind for series in record.vectors})
    begin = setup.running.state_of_whole_bias(initial, blocks, 1e-4)
    whole = estimation.run(record, NOISE, begin, blocks, full_covariance=True)
    sum_of = np.eye(6, 24)
    sum_of[3:, 15:18] = np.eye(3)  # after the nine entries of the gyro's error matrix
    fast = 1e-8 * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    expected = sum_of @ whole.whole_covariance @ sum_of.T + fast
    expected[0] = initial.covariance
    np.testing.assert_allclose(reported.covariance, expected, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(reported.variance, np.einsum("kii->ki", expected), rtol=1e-11)
    drift = whole.error_states["gyro drift 8 s"].values
    np.testing.assert_allclose(reported.bias, whole.bias + drift, rtol=0, atol=1e-15)
    smoothed = setup.smooth(record, setup_of(DRIFTING), initial, full_covariance=True)
    np.testing.assert_allclose(smoothed.bias[-1], reported.bias[-1], rtol=1e-9)
    np.testing.assert_allclose(smoothed.covariance[-1], reported.covariance[-1], rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(smoothed.variance, np.einsum("kii->ki", smoothed.covariance), rtol=1e-12)
    middle = len(record.time) // 2
    assert np.all(smoothed.variance[middle] < reported.variance[middle])
    diagonals = setup.smooth(record, setup_of(DRIFTING), initial)
    assert diagonals.covariance is None
    assert diagonals.whole_covariance is None
    np.testing.assert_array_equal(diagonals.variance, smoothed.variance)


def test_the_initial_bias_is_the_sum_of_all_parts():
    """Of two drifts, and of a part too fast for a state that does not last."""
    states = States(gyro_drift_sigma=(2e-3, 1e-3), gyro_drift_time=(8.0, 1.5))
    initial = estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=0.02, bias_sigma=3e-3)
    P = setup.running.state_of_whole_bias(initial, states.blocks({}), 1e-4).covariance
    sum_of = np.eye(6, 12)
    sum_of[3:, 6:9] = sum_of[3:, 9:12] = np.eye(3)
    fast = 1e-8 * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(sum_of @ P @ sum_of.T, initial.covariance + fast, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(P[6:, 6:], np.diag(np.repeat([2e-3, 1e-3], 3) ** 2), rtol=1e-12, atol=1e-20)
    assert P[3, 6] == pytest.approx(-4e-6)


# ------------------------------------------------------------------------------------------------------------- the gyro and force


def test_force_is_what_the_simulated_gyro_feels():
    """Exact increments and a perfect model: with the true G the filter stays on the truth, with its negative it does not."""
    G = np.array([[1e-3, 5e-4, 0.0], [0.0, -1.5e-3, 0.0], [0.0, 1e-3, 5e-4]])
    edges = np.arange(201) / 100.0
    force = vectors.specific_force(SWAY, 0.5 * (edges[1:] + edges[:-1]))
    increments = SWAY.increments(edges) + (force @ G.T) / 100.0
    block = error_states.GyroForce(along_sigma=1e-3, across_sigma=1e-3)
    plain = estimation.initial_state(SWAY.attitude(np.array(0.0)), attitude_sigma=1e-6, bias_sigma=1e-9)
    start = estimation.with_error_states(plain, (block,))
    for sign, least, most in ((1.0, 0.0, 2e-4), (-1.0, 5e-3, 1.0)):
        face = GatedStepFilter(NOISE, dataclasses.replace(start, values=sign * G.ravel()), (block,))
        for increment in increments:
            face.predict(increment, 0.01)
        assert least <= quaternion.angle_between(face.attitude, SWAY.attitude(edges[-1])) < most


def test_force_s_transition_is_the_derivative():
    rng = np.random.default_rng(2)
    block = error_states.GyroForce(along_sigma=1e-3, across_sigma=1e-3)
    initial = estimation.initial_state(
        quaternion.normalize(rng.standard_normal(4)), attitude_sigma=0.1, bias_sigma=0.01
    )
    values = 1e-3 * rng.standard_normal(9)

    def moved(values):
        state = dataclasses.replace(estimation.with_error_states(initial, (block,)), values=values)
        face = GatedStepFilter(NOISE, state, (block,))
        face.predict(np.array([0.02, -0.03, 0.01]), 0.05)
        return face

    face = moved(values)
    for k in range(9):
        ahead, back = (moved(values + sign * 1e-5 * np.eye(9)[k]) for sign in (1.0, -1.0))
        numeric = turn_to(back.attitude, ahead.attitude) / 2e-5
        np.testing.assert_allclose(face.F[:3, 6 + k], numeric, rtol=0, atol=1e-5 * np.max(np.abs(numeric)) + 1e-9)


# ------------------------------------------------------------------------------------------------------------------- sensors


MANY = motion.HarmonicRates(
    harmonics=tuple(
        motion.Harmonic(amplitude=(0.3 / f, 0.15 / f, -0.21 / f), frequency=f, phase=0.7 * f)
        for f in (0.7, 1.3, 2.1, 3.4, 4.4, 5.9, 7.7)
    )
)
"""So many frequencies that no window's loss is the same for all."""


@pytest.mark.parametrize("body", [SWAY, MANY], ids=["sway", "many"])
@pytest.mark.parametrize("white", [1e-5, 1e-4, 1e-3])
def test_rate_and_angular_acceleration_are_those_of_the_motion(body, white):
    """Within the variance of the acceleration: the gyro's noise, alone or beside what the motion bends."""
    edges, time = 0.005 * np.arange(20001), np.arange(1.0, 99.0, 0.0413)
    noise = np.random.default_rng(1).standard_normal((20000, 3))
    record = ImuRecord(time=edges, increments=body.increments(edges) + white * np.sqrt(0.005) * noise)
    turning, variance = angular_acceleration.turning(record, time)
    assert np.max(np.abs(turning[:, :3] - body.body_rate(time))) < 6.0 * white / np.sqrt(0.005) + 1e-4
    assert 0.85 < np.mean((turning[:, 3:] - body.body_angular_acceleration(time)) ** 2 / variance) < 1.08


def test_the_noise_of_an_angular_acceleration_turns_with_the_arm():
    """``n × r`` of noise n with a variance about each axis, over the length that the sensor's vector is divided by."""
    arm, variance, length = np.array([0.2, -0.1, 0.3]), np.array([1.0, 3.0, 7.0]), 2.0
    model = assemble((error_states.LeverArm(sensor="acc", arm_sigma=0.3, strength=1.0),), {"acc": "vector"})
    x, upper = np.concatenate([np.zeros(7), arm]), np.triu_indices(3)
    C = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 3.0]])
    measured = structure.Measured((), (), (), length, (0.0,) * 6 + tuple(variance))
    kernels = forward.instance_of(model, row_kernels)
    noise = kernels.arm_noise(0, x, measured, tuple(C[upper]), model.numbers, 0.0)
    r = kinematics.skew(arm / length)
    np.testing.assert_allclose(noise, (C + r @ np.diag(variance) @ r.T)[upper], rtol=1e-14)


@pytest.mark.parametrize("kind", ["vector", "direction"])
def test_an_accelerometer_at_an_arm_feels_the_turning_body(kind):
    """``g + ẇ × r + w × (w × r)`` at rate w and angular acceleration ẇ leave no residual; the rows of the arm are its derivative."""
    arm, bias, rate, turning = np.random.default_rng(1).standard_normal((4, 3))
    q, up = quaternion.exp([0.3, -0.4, 1.2]), np.array([0.0, 0.0, 9.81])
    strength = 1.0 if kind == "vector" else 9.81
    model = assemble((error_states.LeverArm(sensor="acc", arm_sigma=0.3, strength=strength),), {"acc": kind})
    kernels, length = forward.instance_of(model, row_kernels), 9.81 if kind == "vector" else 1.0

    def felt(r):
        return in_body(q, up) + np.cross(turning, r) + np.cross(rate, np.cross(rate, r))

    def residual(measured, r):
        z = measured / 9.81 if kind == "vector" else unit(measured)
        measured = structure.Measured(
            tuple(z), tuple(vectors.triad(up).ravel()), (1.0,), length, (*rate + bias, *turning, 0.0, 0.0, 0.0)
        )
        rows, y, *_ = kernels.rows_and_axes(0, np.concatenate([q, bias, r]), measured, model.numbers, 0.0)
        return np.array(rows, np.float64), np.array(y)

    rows, zero = residual(felt(arm), arm)
    np.testing.assert_allclose(zero, 0.0, atol=1e-14)
    for k, h in enumerate(1e-5 * np.eye(3)):
        ahead, back = (residual(felt(arm + sign * h), arm)[1] for sign in (1.0, -1.0))
        np.testing.assert_allclose(rows[:, 6 + k], (ahead - back) / 2e-5, rtol=0, atol=1e-8)


def test_hard_iron_in_a_field_that_changes_is_found_in_its_own_unit():
    """Its share of a direction changes with the field's strength: with that model the filter is consistent, and without it not."""
    scenario = dataclasses.replace(scenarios.load_scenario("low-orbit"), duration=4000.0)
    iron = np.array([2e-6, -1.5e-6, 1e-6])
    sensors = tuple(dataclasses.replace(s, hard_iron=iron) if s.name == "magnetometer" else s for s in scenario.sensors)
    noise = {
        name: getattr(scenario.gyro, name) for name in ("angle_random_walk", "rate_random_walk", "turn_on_bias_sigma")
    }
    scenario = dataclasses.replace(scenario, sensors=sensors, gyro=GyroSpec(**noise), gyro_preset="")
    filter_setup = setup.FilterSetup.for_scenario(scenario, states=True)
    own = filter_setup.states.sensors["magnetometer"]
    assert own.varying
    record = scenarios.simulate(scenario, 5)
    series = record.vectors[1]
    field = 1e-7 / series.sigma
    assert np.ptp(field) > 5e-6
    assert np.asarray(own.bias_sigma) == pytest.approx(np.abs(iron) * np.sqrt(np.mean(field**-2.0)))
    firm = dataclasses.replace(
        filter_setup,
        states=dataclasses.replace(
            filter_setup.states, sensors={"magnetometer": dataclasses.replace(own, varying=False)}
        ),
    )
    right, wrong = (setup.run(record, which, begun(record, 0.01, 1e-3)) for which in (filter_setup, firm))
    nis = [estimate.innovations["magnetometer"].nis[300:].mean() / 2.0 for estimate in (right, wrong)]
    assert abs(nis[0] - 1.0) < 0.08
    assert nis[1] > 1.3
    error = right.error_states["magnetometer bias"].values[-1] / np.sqrt(np.mean(field**-2.0)) - iron
    assert np.all(np.abs(error) < 1e-7)


def test_a_direction_that_its_states_make_longer_has_the_less_noise():
    """Of a sensor that normalises its vector, noise across it is over the length of what it really sees."""
    x = np.array([1.0, 0.0, 0.0])
    record = resting(*beside_silent(series_of("force", "direction", [0.0], [x], x, 1e-3)))
    start = estimation.initial_state([1.0, 0, 0, 0], attitude_sigma=1e-9, bias_sigma=1e-9)
    start = estimation.with_error_states(start, every_kind(held=True))
    for along in (0.0, 1.0, 3.0):
        state = dataclasses.replace(start, values=np.append(np.zeros(15), along * x))
        innovations = estimation.run(record, NOISE, state, every_kind(held=True)).innovations["force"]
        np.testing.assert_allclose(innovations.variance, 1e-6 / (1.0 + along) ** 2, rtol=1e-6)


def test_the_strength_of_a_heading_s_field_leaves_its_level_part_out():
    level = np.array([0.3, 0.6, 0.9])
    reference = np.stack([level, np.zeros(3), -np.sqrt(1.0 - level**2)], axis=1)
    field = np.array([2.0, 5.0, 3.0])
    series = series_of("m", "heading", np.arange(3.0), reference, reference, 0.1 / (field * level))
    np.testing.assert_allclose(forward.strength(series) / field, forward.strength(series)[0] / field[0], rtol=1e-12)


# ------------------------------------------------------------------------------------------------------------------ what is matched


def test_drifts_a_decade_apart_are_flicker():
    """Their spectrum is 1/f to a few hundredths between the slowest and the quickest, and what is quicker is the rest."""
    times = 1000.0 / matching.DECADE ** np.arange(6)
    each = np.sqrt(np.log(matching.DECADE) / np.pi)
    w = np.geomspace(3.0 / times[0], 0.3 / times[-1], 300)
    held = np.sum(2.0 * each**2 * times / (1.0 + (w[:, None] * times) ** 2), axis=1)
    np.testing.assert_allclose(held * w, 1.0, atol=0.12)
    assert np.mean(held * w) == pytest.approx(1.0, abs=0.03)


def test_the_drifts_that_measurements_follow_are_states_and_the_rest_is_white():
    """Down to 0.3 of the filter's own time, here by flicker alone, ``r ω³ = B²/2``; a drift that is quicker has the PSD 2σ²τ."""
    instability, follows = 1e-4, 12.0
    spec = GyroSpec(angle_random_walk=1e-12, bias_instability=instability)
    record = ImuRecord(time=5e-4 * np.arange(20001), increments=np.zeros((20000, 3)))
    states, white = matching.matched(spec, record, (), np.zeros(3), 0.5 * instability**2 / follows**3)
    assert states.gyro_drift_time == pytest.approx((10.0, 1.0, 0.1))  # the next would be 0.01 s, and 0.3/12 is 0.025
    each = instability * np.sqrt(np.log(10.0) / np.pi)
    assert states.gyro_drift_sigma == pytest.approx((each,) * 3)
    assert white == pytest.approx(sum(2.0 * each**2 * 10.0**-k for k in range(2, 40)))


def test_what_a_specification_gives_is_matched_entry_by_entry():
    scenario = scenarios.load_scenario("spin")
    filter_setup = setup.FilterSetup.for_scenario(scenario, states=True)
    assert filter_setup.states == States(gyro_scale_sigma=tuple(scenario.gyro.scale_factor))
    assert filter_setup.states.gyro_scale_sigma[2] == pytest.approx(1e-4)
    assert filter_setup.process_noise == setup.FilterSetup.for_scenario(scenario, states=False).process_noise
    markov = GyroSpec(angle_random_walk=1e-5, markov_noise=1e-6, markov_correlation_time=50.0)
    changed = setup.FilterSetup.for_scenario(dataclasses.replace(scenario, gyro=markov), states=True)
    assert changed.states.gyro_drift_time == (50.0,)
    assert changed.states.gyro_drift_sigma[0] == pytest.approx(1e-6 * 5.0)
    assert changed.process_noise.rate_random_walk == 0.0
    field, iron = np.array([2e-5, 0.0, -4e-5]), np.array([1e-6, 2e-6, 3e-6])
    compass = vectors.Magnetometer(name="compass", field_f=field, sigma=1e-7, rate=1.0, kind="heading", hard_iron=iron)
    changed = setup.FilterSetup.for_scenario(dataclasses.replace(scenario, sensors=(compass,)), states=True)
    assert changed.states.sensors["compass"].bias_sigma == pytest.approx(tuple(iron / np.linalg.norm(field)))
    falling = setup.FilterSetup.for_scenario(scenarios.load_scenario("tumbling-satellite"), states=True)
    assert "gyro.force" not in falling.states.names


def test_a_motion_that_commutes_badly_gets_a_better_integration():
    assert (
        setup.FilterSetup.for_scenario(scenarios.load_scenario("coning"), states=True).integration.name
        == setup.matching.ACCURATE_ALGORITHM
    )
    assert setup.FilterSetup.for_scenario(scenarios.load_scenario("spin"), states=True).integration.name == "one-sample"


def test_individuals_are_drawn_with_the_reported_errors_for_sigma():
    scenario = scenarios.load_scenario("low-orbit")
    drawn = [scenarios.drawn(scenario, 7, k) for k in range(300)]
    irons = np.array([individual.sensors[1].hard_iron for individual in drawn])
    np.testing.assert_allclose(np.std(irons, axis=0), np.abs(scenario.sensors[1].hard_iron), rtol=0.15)
    matrices = np.array([individual.gyro.misalignment for individual in drawn])
    assert np.all(np.diagonal(matrices, axis1=1, axis2=2) == 0.0)
    np.testing.assert_allclose(np.std(matrices, axis=0), scenario.gyro.misalignment, rtol=0.2)
    again = scenarios.drawn(scenario, 7, 0)
    assert np.array_equal(again.sensors[1].hard_iron, irons[0])


def test_chosen_states_are_those_named():
    part = WHOLE.select(("gyro.drift", "acc.lever"))
    assert part.names == ("gyro.drift", "acc.lever")
    assert part.gyro_fast_bias_sigma == WHOLE.gyro_fast_bias_sigma
    assert WHOLE.select(WHOLE.names) == WHOLE
    scale, force, *_ = WHOLE.blocks({"mag": "vector", "acc": "direction"})
    assert dict(zip(scale.components, scale.sigma, strict=True)) == {
        "x": 1e-3, "xy": 1e-3, "yz": 2e-3, "zx": 1.7e-4, "z": 1.23456789e-4,
    }  # fmt: skip
    assert dict(zip(force.components, force.sigma, strict=True)) == {
        "x": 4.9e-7, "xy": 1e-7, "y": 4.9e-7, "zy": 3.3e-7, "z": 4.9e-7,
    }  # fmt: skip
    assert WHOLE.names == (
        "gyro.scale", "gyro.misalignment", "gyro.force", "gyro.drift", "mag.mounting", "mag.bias", "acc.lever", "acc.correlated",
    )  # fmt: skip


def test_the_acceleration_of_a_vibration_is_not_reported_too_small():
    """Noise has a window of 37 samples taken, of which 0.9 % of a vibration of 8 Hz is lost: a lever arm would make up for it."""
    scenario = scenarios.load_scenario("hand-held")
    gains = []
    for seed in range(3):
        record = scenarios.simulate(scenario, seed)
        time = record.vectors[0].time
        exact = np.concatenate(
            [scenario.motion.body_rate(time), scenario.motion.body_angular_acceleration(time)], axis=1
        )
        turning, _ = angular_acceleration.turning(record, time)
        gains.append(np.sum(turning * exact, axis=0) / np.sum(exact**2, axis=0))
    np.testing.assert_allclose(np.mean(gains, axis=0), 1.0, rtol=0.0, atol=1e-3)
