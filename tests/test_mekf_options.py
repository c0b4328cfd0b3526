"""Options of the filter: the step face and the compiled face agree on each of them, kind by kind, schedule by schedule."""

from dataclasses import replace

import in_steps
import numpy as np
import pytest

from strapdown import estimation, montecarlo, motion, quaternion
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise, initial_state
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario, simulate
from strapdown.vectors import Accelerometer, AttitudeSensor, Faults, VectorSensor

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
OUTLIERS = Faults(outlier_probability=0.1, outlier_scale=10.0)


def sensors(faults=OUTLIERS, rate=10.0):
    """One sensor a kind; a second direction and a heading, so that the attitude is known with each of them."""
    return {
        "direction": (
            VectorSensor(name="a", reference_f=np.array([1.0, 0.2, 0.0]), sigma=1e-3, rate=rate, faults=faults),
            VectorSensor(name="b", reference_f=np.array([0.0, 1.0, 1.0]), sigma=2e-3, rate=rate, faults=faults),
        ),
        "vector": (
            Accelerometer(name="force", sigma=0.05, rate=rate, kind="vector", faults=faults),
            VectorSensor(name="b", reference_f=np.array([0.0, 1.0, 1.0]), sigma=2e-3, rate=rate, faults=faults),
        ),
        "heading": (
            VectorSensor(
                name="north",
                reference_f=np.array([0.0, 1.0, -1.0]),
                sigma=5e-3,
                rate=rate,
                kind="heading",
                faults=faults,
            ),
            VectorSensor(name="a", reference_f=np.array([0.3, 0.1, 1.0]), sigma=1e-3, rate=rate, faults=faults),
        ),
        "attitude": (AttitudeSensor(name="tracker", sigma_across=1e-3, sigma_about=5e-3, rate=rate, faults=faults),),
    }


def scenario(sensor_set, duration=4.0, angle=0.3, frequency=0.3):
    return Scenario(
        motion=motion.Coning(angle=angle, frequency=frequency),
        gyro=GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias=np.array([1e-3, -2e-3, 5e-4])),
        sensors=sensor_set,
        rate=50.0,
        duration=duration,
    )


SCHEDULES = {
    "at one time": lambda sensor_set: sensor_set,
    "asynchronous": lambda sensor_set: tuple(
        replace(s, rate=s.rate * (1.0 + 0.37 * k), phase=0.0123 * (k + 1)) for k, s in enumerate(sensor_set)
    ),
}


def anisotropic(record, whole, run=0):
    """The record with noise of a full covariance, or per axis and changing from sample to sample, and the noise itself to match."""
    factor = np.linalg.cholesky([[1.0, 0.6, -0.3], [0.6, 2.0, 0.5], [-0.3, 0.5, 1.5]])
    draw = generator(11, run, "anisotropic")
    series = []
    for s in record.vectors:
        if s.kind == "heading":
            series.append(s)
            continue
        m = len(s.time)
        size = (s.sigma_axes[:, :1] if s.kind == "attitude" else s.sigma[:, None]) * 3.0
        axes = size * np.array([1.0, 2.0, 0.5]) * (1.0 + 0.5 * np.sin(np.arange(m)))[:, None]
        added = size[:, :, None] ** 2 * (factor @ factor.T) if whole else axes[:, :, None] ** 2 * np.eye(3)
        noise = np.einsum("kij,kj->ki", np.linalg.cholesky(added), draw.standard_normal((m, 3)))
        covariance = s.covariances + added
        fields = {"covariance": covariance} if whole else {"sigma_axes": np.sqrt(np.einsum("kii->ki", covariance))}
        if s.kind == "attitude":
            fields = {"sigma_axes": None, **fields}
            changed = replace(s, attitude=quaternion.multiply(s.attitude, quaternion.exp(noise)), **fields)
        else:
            value = s.vector_b + noise
            if s.kind == "direction":
                value /= np.linalg.norm(value, axis=1, keepdims=True)
            changed = replace(s, vector_b=value, sigma=0.0, **fields)
        series.append(changed)
    return replace(record, vectors=tuple(series))


OPTIONS = {
    "plain": ({}, None),
    "gate": ({"gate": Gate()}, None),
    "Huber": ({"robust": Robust(kind="huber")}, None),
    "Student": ({"robust": Robust(kind="student")}, None),
    "gate, Student": (
        {"gate": Gate(probability=0.9999), "robust": Robust(kind="student", degrees_of_freedom=3.0)},
        None,
    ),
    "per axis": ({}, False),
    "covariance": ({}, True),
    "covariance, gate, Huber": ({"gate": Gate(), "robust": Robust(kind="huber")}, True),
}


def near(record, error=(5e-3, -5e-3, 4e-3), sigma=1e-2):
    attitude = quaternion.multiply(record.truth.attitude[0], quaternion.exp(error))
    return initial_state(attitude, attitude_sigma=sigma, bias_sigma=3e-3)


def alternating():
    """Return each option with each kind, and each of them with one of the two schedules: so they meet in pairs."""
    return [
        (option, kind, list(SCHEDULES)[(i + j) % 2])
        for i, option in enumerate(OPTIONS)
        for j, kind in enumerate(sensors())
    ]


def quick(option, kind):
    """Return whether it is in the default run, in which all gates and weights share one kernel: that of noise by one σ.

    A gate of headings: tests/test_robustness.py; with noise by axis: tests/test_multiple_model.py.
    """
    options, whole = OPTIONS[option]
    return not options or (whole is None and kind != "heading")


@pytest.mark.parametrize(
    ("option", "kind", "schedule"),
    [pytest.param(*case, marks=[] if quick(*case[:2]) else pytest.mark.slow) for case in alternating()],
)
def test_both_faces_are_one_filter(option, kind, schedule):
    options, whole = OPTIONS[option]
    record = simulate(scenario(SCHEDULES[schedule](sensors()[kind]), duration=1.2), 3)
    if whole is not None:
        record = anisotropic(record, whole)
    result = estimation.run(record, NOISE, near(record), full_covariance=True, **options)
    in_steps.assert_alike(result, in_steps.run(record, NOISE, near(record), **options), 1e-10)
    if "gate" in options:
        assert sum(result.refused.values()) > 0  # the outliers


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("kind", sensors())
def test_the_plain_filter_is_consistent_over_thousands_of_runs_and_not_with_sigma_a_tenth_off(kind, schedule):
    """ANEES of attitude, bias and both; 99 % over the whole grid. With noise by axis: tests/test_filters.py."""
    verdicts = {}
    off = 1.1 if ("plain", kind, schedule) in alternating() else 1.0 / 1.1
    for factor in (1.0, off):
        belief = FilterSetup(process_noise=NOISE, attitude_sigma=1e-2, bias_sigma=1e-3, measurement_sigma_factor=factor)
        scene = scenario(SCHEDULES[schedule](sensors(Faults())[kind]))
        plan = montecarlo.Plan(scenario=scene, setup=belief, seed=21, epochs=4)
        statistics = montecarlo.run_plan(plan, runs=4000)
        assert statistics.failed == 0
        for subset in ("state", "attitude", "bias"):
            verdicts[factor, subset] = statistics.verdict(np.arange(1, 5), subset, 1.0 - 0.01 / 32)
        low, high = statistics.nis_bounds(1.0 - 0.01 / 32)
        assert (low < statistics.mean_nis < high) == (factor == 1.0)
    for (factor, subset), verdict in verdicts.items():
        assert verdict.consistent == (factor == 1.0), (factor, subset, verdict.mean, verdict.simultaneous_bounds)


@pytest.mark.parametrize(
    ("kind", "whole"),
    [
        pytest.param("direction", True, marks=pytest.mark.slow),
        ("vector", None),
        pytest.param("vector", True, marks=pytest.mark.slow),
        ("heading", None),
        ("attitude", None),
        pytest.param("attitude", True, marks=pytest.mark.slow),
    ],
)
def test_both_faces_recover_alike(kind, whole):
    record = simulate(scenario(sensors(Faults())[kind], duration=4.0), 5)
    if whole:
        record = anisotropic(record, whole)
    lost = near(record, error=(1.5, -0.9, 2.0))
    options = {"gate": Gate(recovery=5), "robust": Robust()}
    result = estimation.run(record, NOISE, lost, full_covariance=True, **options)
    in_steps.assert_alike(
        result, in_steps.run(record, NOISE, lost, **options), 1e-9
    )  # a diffuse prior leaves fewer digits
    assert [event.kind for event in result.events] == ["recovery"]


@pytest.mark.parametrize("case", ["step", "one direction", "too little noise", "faulty"])
def test_both_faces_restart_and_report_lock_outs_alike(case):
    """Failed candidates, widened ones, a turn that is not known, lock-outs that a recovery ends and that it does not."""
    sensor_set = sensors(Faults())["direction"]
    if case == "one direction":
        sensor_set = sensor_set[:1]
    elif case == "faulty":
        sensor_set = (*sensor_set, VectorSensor(name="c", reference_f=np.array([0.3, -1.0, 1.0]), sigma=1e-3, rate=7.0))
    record = simulate(scenario(sensor_set, duration=4.0), 5)
    start, options = near(record, (1e-4, -2e-4, 1e-4), sigma=1e-3), {"gate": Gate(recovery=5), "robust": None}
    if case == "step":
        later = (np.arange(len(record.increments)) >= 60)[:, None]
        step = 0.02 * later * np.array([0.3, -0.3, 0.2])
        record = replace(record, increments=record.increments + step)
    elif case == "one direction":
        start = near(record, (1.5, -0.9, 2.0))
    elif case == "too little noise":
        record = replace(record, vectors=tuple(s.noise_scaled(0.04) for s in record.vectors))
    else:
        c = record.vectors[-1]
        turned = replace(c, vector_b=quaternion.rotate(quaternion.exp([0.2, 0.2, -0.2]), c.vector_b))
        record = replace(record, vectors=(*record.vectors[:-1], turned))
    result = estimation.run(record, NOISE, start, full_covariance=True, **options)
    # Beside a turn of 104° a milliradian has fewer digits.
    step = in_steps.run(record, NOISE, start, **options)
    in_steps.assert_alike(result, step, 1e-7 if case == "one direction" else 1e-8)
    kinds = {"step": {"recovery", "lock-out"}, "one direction": {"recovery"}}
    assert {event.kind for event in result.events} == kinds.get(case, {"lock-out"})


def test_a_gap_of_the_gyro_is_reported_and_grows_the_covariance_as_the_closed_form_says():
    dt, T = 0.02, 40.0
    edges = np.concatenate([dt * np.arange(51), 1.0 + T + dt * np.arange(50)])
    record = ImuRecord(time=edges, increments=np.zeros((100, 3)))
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-3, bias_sigma=1e-4)
    estimate = estimation.run(record, NOISE, start, full_covariance=True)
    (event,) = estimate.events
    assert (event.kind, event.start, event.end) == ("gap", 1.0, 1.0 + T)
    assert event.value == pytest.approx(T / dt)
    assert "40 s after 1 s" in str(event)
    after = estimate.covariance[51]
    v, u, time = NOISE.angle_random_walk**2, NOISE.rate_random_walk**2, 1.0 + T
    assert after[0, 0] == pytest.approx(1e-6 + 1e-8 * time**2 + v * time + u * time**3 / 3.0, rel=1e-10)
    assert after[3, 3] == pytest.approx(1e-8 + u * time, rel=1e-10)
