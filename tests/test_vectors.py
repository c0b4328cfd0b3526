"""Vector sensors against the definition of what each measures, their noise and faults, and the series they give."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from strapdown import estimation, motion, quaternion, records, scenarios, vectors
from strapdown.checks import InputError
from strapdown.gyro import GyroSpec
from strapdown.motion import orbit
from strapdown.randomness import generator
from strapdown.vectors import Accelerometer, AttitudeSensor, Faults, HeadingPair, Magnetometer, VectorSensor, triad
from strapdown.vectors.sensor import sample_times

CONE = motion.Coning(angle=0.3, frequency=0.7)
FIELD = np.array([2e-5, 1e-5, -4e-5])


def rotation(body, time):
    """Return the rotation from body to fixed frame by SciPy."""
    return Rotation.from_quat(np.roll(body.attitude(time), -1, axis=-1))


def rotation_angles(q):
    """Return the rotation vector of a quaternion by SciPy."""
    return Rotation.from_quat(np.roll(q, -1)).as_rotvec()


def observe(sensor, body=CONE, end=50.0, seed=1):
    return sensor.observe(body, 0.0, end, generator(seed, 0, sensor.name))


EVERY = [
    VectorSensor(name="star", reference_f=[1.0, 2.0, 3.0], sigma=1e-3, rate=4.0),
    VectorSensor(name="level", reference_f=[1.0, 2.0, 0.0], sigma=1e-3, rate=4.0, kind="heading"),
    AttitudeSensor(name="tracker", sigma_across=1e-4, sigma_about=1e-3, rate=4.0),
    Magnetometer(name="magnetometer", field_f=FIELD, sigma=1e-7, rate=4.0),
    Magnetometer(name="compass", field_f=FIELD, sigma=1e-7, rate=4.0, kind="heading"),
    Magnetometer(name="whole field", field_f=FIELD, sigma=1e-7, rate=4.0, kind="vector"),
    Magnetometer(name="orbiting", field_f=orbit.CircularOrbit().magnetic_field, sigma=1e-7, rate=4.0),
    Accelerometer(name="vertical", sigma=0.01, rate=4.0),
    Accelerometer(name="whole force", sigma=0.01, rate=4.0, kind="vector"),
    HeadingPair(name="antennas", baseline_b=[2.0, 0.0, 0.0], sigma=0.01, rate=4.0),
    vectors.HorizonSensor(name="horizon", orbit=orbit.CircularOrbit(), sigma=1e-3, rate=4.0),
]


@pytest.mark.parametrize("sensor", EVERY, ids=lambda sensor: sensor.name)
def test_without_noise_a_sensor_measures_its_reference_in_body_axes(sensor):
    quiet = {"sigma_across": 0.0, "sigma_about": 0.0} if isinstance(sensor, AttitudeSensor) else {"sigma": 0.0}
    series = observe(dataclasses.replace(sensor, **quiet))
    assert len(series.time) == 200
    turn = rotation(CONE, series.time)
    if series.kind == "attitude":
        assert np.max(quaternion.angle_between(series.attitude, CONE.attitude(series.time))) < 1e-7
    elif sensor.name == "antennas":
        reference, wanted = series.references_f, turn.apply(series.vector_b) * [1.0, 1.0, 0.0]
        np.testing.assert_allclose(reference, wanted / np.linalg.norm(wanted, axis=1, keepdims=True), atol=1e-12)
    else:
        scale = np.linalg.norm(series.references_f, axis=1, keepdims=True)
        np.testing.assert_allclose(turn.apply(series.vector_b) / scale, series.references_f / scale, atol=1e-12)


@pytest.mark.parametrize("sensor", EVERY, ids=lambda sensor: sensor.name)
def test_noise_has_the_sigma_that_the_series_states(sensor):
    """Beside it noise so quick that it is white, of twice the σ, in the same unit."""
    size = 2.0 * getattr(sensor, "sigma", 1e-4)
    quick = dataclasses.replace(sensor, faults=Faults(correlated_sigma=size, correlation_time=1e-6))
    series = observe(quick, body=motion.rest(), end=2000.0)
    n, ratio = len(series.time), 2.0 * np.ones(3)
    if series.kind == "attitude":
        score, ratio = quaternion.log(series.attitude) / series.sigma_axes, size / sensor.sigma_axes
    elif series.kind == "vector":
        score = (series.vector_b - series.references_f) / series.sigma[:, None]
    elif series.kind == "heading":
        a, b = series.vector_b, series.references_f
        turn = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
        score = (turn / series.sigma)[:, None]
    else:
        rows = [triad(r)[:2] @ z for r, z in zip(series.references_f, series.vector_b, strict=True)]
        score = np.array(rows) / series.sigma[:, None]
    assert score.shape[1] == vectors.KINDS[series.kind]
    for column, variance in zip(score.T, 1.0 + ratio**2, strict=False):
        assert abs(column.mean()) < 4.5 * math.sqrt(variance / n)
        assert abs(column.var() / variance - 1.0) < 4.5 * math.sqrt(2.0 / n) + 1e-3
    correlation = np.atleast_2d(np.corrcoef(score.T)) - np.eye(score.shape[1])
    assert np.max(np.abs(correlation)) < 4.5 / math.sqrt(n)


@pytest.mark.parametrize("sensor", EVERY, ids=lambda sensor: sensor.name)
def test_outages_and_latency_change_no_other_sample(sensor):
    whole = observe(sensor)
    faults = Faults(latency=0.3, outages=[(10.0, 20.0), (30.0, 30.1)])
    part = observe(dataclasses.replace(sensor, faults=faults))
    kept = ~(((whole.time >= 10.0) & (whole.time <= 20.0)) | (np.abs(whole.time - 30.0) < 0.01))
    assert np.array_equal(part.time, whole.time[kept])
    for name in ("vector_b", "sigma", "attitude", "sigma_axes", "references_f"):
        if getattr(whole, name) is not None:
            np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[kept])
    np.testing.assert_allclose(part.arrival, part.time + 0.3)
    assert whole.arrival is None


def test_rates_and_phases():
    sensor = VectorSensor(name="s", reference_f=[1.0, 0.0, 0.0], sigma=0.0, rate=4.0)
    np.testing.assert_allclose(sample_times(4.0, 0.0, 10.0, 11.0), [10.25, 10.5, 10.75, 11.0])
    np.testing.assert_allclose(sample_times(4.0, 0.1, 10.0, 11.0), [10.1, 10.35, 10.6, 10.85])
    assert len(sample_times(4.0, 0.0, 0.0, 0.2)) == 0
    assert len(observe(sensor, end=0.2).time) == 0
    assert len(sample_times(3.0, 0.0, 0.0, 1e4)) == 30_000


def test_outliers_are_a_contaminated_normal():
    sensor = Magnetometer(name="m", field_f=FIELD, sigma=1e-7, rate=10.0, kind="vector")
    clean = observe(sensor, motion.rest(), 5000.0)
    struck = observe(
        dataclasses.replace(sensor, faults=Faults(outlier_probability=0.1, outlier_scale=20.0)), motion.rest(), 5000.0
    )
    noise, before = struck.vector_b - FIELD, clean.vector_b - FIELD
    outliers = np.any(np.abs(noise - before) > 1e-12, axis=1)
    assert np.mean(outliers) == pytest.approx(0.1, abs=4.5 * math.sqrt(0.09 / 50_000))
    np.testing.assert_allclose(noise[outliers], 20.0 * before[outliers], rtol=1e-6)
    assert np.var(noise) / 1e-14 == pytest.approx(0.9 + 0.1 * 400.0, rel=0.05)


def test_correlated_noise_is_a_stationary_first_order_process():
    faults = Faults(correlated_sigma=3e-7, correlation_time=5.0)
    series = [
        Magnetometer(name="m", field_f=FIELD, sigma=0.0, rate=1.0, kind="vector", faults=faults).observe(
            motion.rest(), 0.0, 20.0, generator(1, run, "m")
        )
        for run in range(300)
    ]
    noise = np.array([s.vector_b - FIELD for s in series]).transpose(1, 0, 2).reshape(20, -1)
    assert np.all(np.abs(np.mean(noise**2, axis=1) / 9e-14 - 1.0) < 5.0 * math.sqrt(2.0 / 900))
    for lag in (1, 5, 10):
        assert np.mean(noise[0] * noise[lag]) / 9e-14 == pytest.approx(math.exp(-lag / 5.0), abs=5.0 / math.sqrt(900))


def test_hard_and_soft_iron():
    soft, hard = np.array([[0.1, 0.02, 0.0], [0.0, -0.05, 0.03], [0.01, 0.0, 0.2]]), np.array([1e-6, -2e-6, 3e-6])
    sensor = Magnetometer(name="m", field_f=FIELD, sigma=0.0, rate=4.0, kind="vector", hard_iron=hard, soft_iron=soft)
    series = observe(sensor)
    true = rotation(CONE, series.time).inv().apply(FIELD)
    np.testing.assert_allclose(series.vector_b, true @ (np.eye(3) + soft).T + hard, rtol=1e-10)


@pytest.mark.parametrize(
    "body",
    [
        CONE,
        motion.SpinCone(precession_rate=2.0, spin_rate=1.0, angle=0.4),
        motion.TorqueFree(inertia=[1.0, 2.0, 3.0], initial_rate=[0.3, 2.0, 0.1]),
    ],
    ids=lambda body: type(body).__name__,
)
def test_specific_force_at_a_lever_arm_is_the_second_derivative_of_the_position(body):
    arm, time, step = np.array([0.4, -0.2, 0.7]), np.linspace(0.5, 7.0, 40), 1e-3
    pushed = lambda t: np.stack([np.sin(t), 0.0 * t, t], axis=-1)  # noqa: E731

    def place(t):
        return rotation(body, t).apply(arm)

    # Fourth-order central difference of the place of the arm's end, in the fixed frame.
    weights = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12.0
    moved = sum(w * place(time + k * step) for w, k in zip(weights, range(-2, 3), strict=True)) / step**2
    wanted = rotation(body, time).inv().apply(moved + pushed(time) - np.array(vectors.GRAVITY_F))
    got = vectors.specific_force(body, time, lever_arm_b=arm, acceleration_f=pushed)
    np.testing.assert_allclose(got, wanted, atol=2e-8)
    at_rest = rotation(body, time).inv().apply(-np.array(vectors.GRAVITY_F))
    np.testing.assert_allclose(vectors.specific_force(body, time), at_rest, atol=1e-12)  # of the centre of rotation


def test_an_accelerometer_off_the_centre_errs_by_the_acceleration():
    spin = motion.ConstantRate(rate=[0.0, 0.0, 2.0])
    sensor = Accelerometer(name="a", sigma=0.0, rate=5.0, lever_arm_b=[0.5, 0.0, 0.0])
    series = observe(sensor, spin)
    tilt = math.atan2(4.0 * 0.5, 9.80665)  # centripetal over gravity
    angle = np.arccos(series.vector_b @ [0.0, 0.0, 1.0])
    np.testing.assert_allclose(angle, tilt, rtol=1e-9)
    assert np.all(series.vector_b[:, 0] < 0.0)
    biased = observe(Accelerometer(name="a", sigma=0.0, rate=5.0, bias=[0.1, 0.0, 0.0], kind="vector"), motion.rest())
    np.testing.assert_allclose(biased.vector_b, np.tile([0.1, 0.0, 9.80665], (250, 1)), atol=1e-12)


def test_an_attitude_sensor_is_coarse_about_its_boresight():
    series = observe(AttitudeSensor(name="t", sigma_across=1e-4, sigma_about=2e-3, rate=10.0, boresight="x"), end=500.0)
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(CONE.attitude(series.time)), series.attitude))
    np.testing.assert_allclose(error.std(axis=0), [2e-3, 1e-4, 1e-4], rtol=0.06)


# ------------------------------------------------------------------------------------------------------------------ the series


def test_taken_takes_all_that_belongs_to_a_sample():
    faults = Faults(latency=0.1)
    for sensor in (EVERY[0], EVERY[2], EVERY[6], EVERY[9]):
        series = observe(dataclasses.replace(sensor, faults=faults))
        which = np.arange(200) % 3 == 0
        part = series.taken(which)
        for name in ("time", "vector_b", "sigma", "attitude", "sigma_axes", "arrival", "references_f"):
            if getattr(series, name) is not None:
                np.testing.assert_array_equal(getattr(part, name), getattr(series, name)[which])
        assert len(series.taken(slice(5, 9)).time) == 4


GOOD = {
    "sensor": "s",
    "kind": "direction",
    "time": [0.0, 1.0, 2.0, 3.0, 4.0],
    "vector_b": np.vstack([np.eye(3), np.eye(3)[:2]]),
    "reference_f": [1.0, 0.0, 0.0],
    "sigma": 0.1,
}
ATTITUDES = {
    **GOOD,
    "kind": "attitude",
    "vector_b": np.empty((0, 3)),
    "attitude": np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "directoin"}, "did you mean 'direction'"),
        ({"time": [0.0, 2.0, 1.0, 3.0, 4.0]}, "goes back"),
        ({"vector_b": np.ones((5, 3))}, r"vector_b\[0\] has length"),
        ({"vector_b": np.eye(3)[:2]}, "shape"),
        ({"sigma": [1.0, -1.0, 1.0, 1.0, 1.0]}, r"sigma\[1\]"),
        ({"reference_f": [0.0, 0.0, 0.0]}, "zero vector"),
        ({"reference_f": np.eye(5)[:, [0, 2, 3]] + np.eye(5)[:, [4, 4, 4]]}, r"reference_f\[1\] is the zero"),
        ({"reference_f": np.ones((2, 3))}, "shape"),
        ({"kind": "heading", "reference_f": [0.0, 0.0, 1.0]}, "vertical"),
        ({"arrival": [0.0, 0.5, 3.0, 4.0, 5.0]}, r"arrival\[1\]"),
        ({"kind": "attitude"}, "needs attitude"),
        ({"sigma_axes": [1.0, 1.0, 1.0]}, "contradicts sigma_axes"),
        ({"sigma": [1e-3, 1e-300, 1e-3, 1e-3, 1e-3]}, r"s: sigma\[1\] is 1e-300, and its square underflows"),
        ({"sensor": None}, "sensor is None"),
        ({"sigma": [0.1, 0.1]}, r"s: sigma has shape \(2,\) for 5 samples; give one number, or one per sample"),
        ({"sigma": [0.1, 0.1, 0.2]}, r"s: sigma has shape \(3,\) .* as sigma_axes"),
        ({"sigma": 0.1 * np.ones((5, 3))}, r"s: sigma has shape \(5, 3\)"),
        ({"sigma": "0.1"}, "s: sigma is not an array of numbers"),
        ({"sigma": 0.0, "sigma_axes": [0.1, 0.1]}, r"s: sigma_axes has shape \(2,\) .* one number per body axis"),
        ({"sigma": 0.0, "covariance": np.eye(2)}, r"s: covariance has shape \(2, 2\)"),
        ({"sigma": 0.0, "covariance": np.eye(3) + 0.5 * np.eye(3, k=1)}, "not symmetric"),
        ({"sigma": 0.0, "covariance": np.diag([1.0, 1.0, -1.0])}, "eigenvalue"),
        ({"sigma": 0.0, "covariance": np.eye(3), "sigma_axes": [1.0, 1.0, 2.0]}, "contradict"),
        ({"sigma": 3.0, "covariance": np.eye(3)}, "contradicts"),
        ({"sigma": 0.0, "covariance": np.eye(3), "kind": "heading"}, "one sigma"),
        ({"time": 0.5}, r"s: time has shape \(\)"),
        ({"time": None}, "s: time"),
        ({**ATTITUDES, "sigma": 0.0}, r"needs its noise: sigma \(m,\), sigma_axes \(m, 3\) or covariance \(m, 3, 3\)"),
        ({**ATTITUDES, "attitude": 2.0 * ATTITUDES["attitude"]}, r"s: attitude\[0\] has norm 2"),
        ({"sigma": np.nan}, r"s: sigma\[0\] is nan at a measured value; give it, or mark the sample as missing"),
        ({"sigma": [0.1, 0.1, 0.1, np.nan, 0.1]}, r"s: sigma\[3\] is nan at a measured value"),
        ({"sigma": [0.1, 0.1, 0.1, np.inf, 0.1]}, r"s: sigma\[3\] is inf"),
        ({"sigma": 0.0, "sigma_axes": np.diag([1.0] * 5)[:, :3] * np.nan}, r"s: sigma_axes\[0\] is nan"),
        ({"sigma": 0.0, "covariance": np.full((5, 3, 3), np.nan)}, r"s: covariance\[0\] is nan at"),
        ({"sigma": 0.0, "covariance": np.full((3, 3), np.nan)}, r"s: covariance\[0, 0\] is nan"),
        ({"reference_f": np.vstack([np.eye(3), np.full((2, 3), np.nan)])}, r"s: reference_f\[3\] is nan at"),
        ({"arrival": [0.0, 1.0, np.nan, 3.0, 4.0]}, r"s: arrival\[2\] is nan at"),
    ],
)
def test_what_does_not_fit_the_samples_is_named(change, message):
    vectors.VectorMeasurements(**GOOD)
    with pytest.raises(InputError, match=message):
        vectors.VectorMeasurements(**{**GOOD, **change})


def test_one_sigma_of_an_attitude_is_that_about_each_axis():
    constant = vectors.VectorMeasurements(**{**ATTITUDES, "sigma": 0.01})
    np.testing.assert_array_equal(constant.sigma_axes, np.full((5, 3), 0.01))
    np.testing.assert_array_equal(constant.sigma, np.full(5, 0.01))
    each = 0.01 * np.arange(1.0, 6.0)
    varying = vectors.VectorMeasurements(**{**ATTITUDES, "sigma": each})
    np.testing.assert_array_equal(varying.covariances, each[:, None, None] ** 2 * np.eye(3))
    again = vectors.VectorMeasurements(**ATTITUDES, sigma_axes=varying.sigma_axes)  # as it is read from a file
    np.testing.assert_array_equal(again.sigma, each)
    np.testing.assert_allclose(varying.noise_scaled(3.0).sigma_axes[:, 1], 3.0 * each, rtol=1e-15)
    whole = vectors.VectorMeasurements(**{**ATTITUDES, "sigma": 0.0, "covariance": np.diag([1e-4, 4e-4, 9e-4])})
    np.testing.assert_allclose(whole.noise_scaled(3.0).covariance, 9.0 * whole.covariance, rtol=1e-15)
    empty = {"time": [], "attitude": np.empty((0, 4))}
    assert vectors.VectorMeasurements(**{**ATTITUDES, **empty}).sigma_axes.shape == (0, 3)


def missing(kind, *, also):
    """A series of five samples of which two are missing, and what belongs to these too."""
    gone, value = np.array([False, True, False, False, True]), GOOD["vector_b"].copy()
    holes = np.where(gone, np.nan, 1.0)
    fields = {**(ATTITUDES if kind == "attitude" else GOOD), "kind": kind}
    if kind == "attitude":
        fields["attitude"] = ATTITUDES["attitude"] * np.stack([np.ones(5), holes, np.ones(5), np.ones(5)], axis=1)
    else:
        value[:, 2] *= holes
        fields["vector_b"] = value
    noise = 0.1 * np.arange(1.0, 6.0)
    fields["sigma"] = noise
    if also in ("sigma", "everything") or kind == "heading":
        fields["sigma"] = noise * (holes if also else 1.0)
    if also in ("sigma_axes", "covariance") and kind != "heading":
        axes = noise[:, None] * [1.0, 2.0, 3.0]
        axes[gone, 1] = np.nan
        fields["sigma"] = np.zeros(5)
        fields[also] = axes if also == "sigma_axes" else axes[:, :, None] ** 2 * np.eye(3)
    if also == "everything":
        fields["reference_f"] = np.array([[0.6, 0.8, 0.0]] * 5) * holes[:, None]
        fields["arrival"] = fields["time"] + 0.1 * holes
    return gone, fields


@pytest.mark.parametrize("also", ["", "sigma", "sigma_axes", "covariance", "everything"])
@pytest.mark.parametrize("kind", vectors.KINDS)
def test_what_belongs_to_a_missing_sample_may_be_missing_too(kind, also):
    gone, fields = missing(kind, also=also)
    series = vectors.VectorMeasurements(**fields)
    content = series.attitude if kind == "attitude" else series.vector_b
    np.testing.assert_array_equal(np.isnan(content).any(axis=1), gone)
    known = series.taken(~gone)
    assert np.isfinite(series.sigma).all()
    assert np.isfinite(series.covariances).all()
    assert np.isfinite(series.references_f).all()
    # The stand-ins are those of which the mean square is that of the others, so that nothing computed of it moves.
    if also:
        np.testing.assert_allclose(np.mean(series.sigma**2), np.mean(known.sigma**2), rtol=1e-14)
        np.testing.assert_allclose(series.covariances.mean(axis=0), known.covariances.mean(axis=0), rtol=1e-14)
    for name in ("time", "sigma", "references_f"):
        np.testing.assert_array_equal(getattr(series, name)[~gone], getattr(known, name))
    if also == "everything":
        np.testing.assert_array_equal(series.arrival[gone], series.time[gone])
    # Made again from what it has become it stays so.
    again = dataclasses.replace(series)
    np.testing.assert_array_equal(again.sigma, series.sigma)


def test_the_reference_of_a_missing_sample_is_that_of_the_only_one_there_is():
    reference, vector = np.array([[np.nan] * 3, [0.6, 0.8, 0.0]]), np.array([[np.nan] * 3, [0.0, 0.0, 1.0]])
    series = vectors.VectorMeasurements(**{**GOOD, "time": [0.0, 1.0], "reference_f": reference, "vector_b": vector})
    np.testing.assert_array_equal(series.references_f, [[0.6, 0.8, 0.0]] * 2)


@pytest.mark.parametrize("kind", vectors.KINDS)
def test_a_series_may_be_missing_altogether(kind):
    missing = np.full((5, 3), np.nan)
    fields = {**GOOD, "vector_b": missing, "kind": kind, "sigma": missing[:, 0], "reference_f": missing}
    if kind == "attitude":
        fields = {**fields, "vector_b": np.empty((0, 3)), "attitude": np.full((5, 4), np.nan)}
    series = vectors.VectorMeasurements(**fields)
    assert np.isfinite(series.sigma).all()
    assert np.isfinite(series.references_f).all()


STAR = {"name": "star", "reference_f": [1.0, 0.0, 0.0], "sigma": 0.1, "rate": 1.0}
TRACKER = {"name": "tracker", "sigma_across": 1e-4, "sigma_about": 1e-3, "rate": 1.0}
COMPASS = {"name": "compass", "sigma": 1e-7, "rate": 1.0}
headings = vectors.VectorMeasurements.from_headings
REFUSED = (
    (VectorSensor, STAR | {"sigma": -1.0}, "star: sigma is -1 rad"),
    (VectorSensor, STAR | {"sigma": 20.0}, r"star: sigma is 20 rad.*is it in degrees"),
    (AttitudeSensor, TRACKER | {"sigma_about": 60.0}, r"tracker: sigma_about is 60 rad.*is it in degrees"),
    (VectorSensor, STAR | {"reference_f": [0.0, 0.0, 0.0]}, "star: reference_f is the zero vector"),
    (VectorSensor, STAR | {"kind": "attitude"}, "star: kind 'attitude' is not known"),
    *((functools.partial(dataclasses.replace, sensor), {"rate": 0.0}, f"{sensor.name}: rate is 0 Hz") for sensor in EVERY),
    *((AttitudeSensor, TRACKER | {"boresight": b}, "tracker: boresight") for b in ("w", (0.0, 0.0, 0.0), (1.0, 0.0), [2.0] * 4)),
    (Magnetometer, COMPASS | {"field_f": [0.0] * 3}, "compass: field_f is zero, which has no direction"),
    (Magnetometer, COMPASS | {"field_f": [0.0, 0.0, 5e-5], "kind": "heading"}, "compass: horizontal part of field_f is zero"),
    (HeadingPair, COMPASS | {"baseline_b": [[2.0, 0.0, 0.0]]}, r"compass: baseline_b has shape \(1, 3\), wanted \(3,\)"),
    (Faults, {"outages": [(2.0, 1.0)]}, "outages has a window from 2 s to 1 s"),
    (Faults, {"outlier_probability": 1.5}, "outlier_probability is 1.5"),
    (Faults, {"correlation_time": 0.0}, "correlation_time is 0 s"),
    (Faults, {"latency": -1.0}, "latency is -1 s"),
    (headings, {"sensor": "gnss", "time": [1.0], "heading": [0.3], "sigma": 0.1, "axis_b": [0.0] * 3}, "gnss: axis_b"),
    (headings, {"sensor": "gnss", "time": [1.0, 2.0], "heading": [0.3, np.inf], "sigma": 0.1}, "gnss: heading"),
    (headings, {"sensor": "gnss", "time": [1.0, 2.0], "heading": [0.3], "sigma": 0.1}, "gnss: vector_b has shape"),
    *((triad, {"reference_f": np.zeros(shape)}, "zero vector, which has no direction") for shape in (3, (2, 3))),
)  # fmt: skip


@pytest.mark.parametrize(
    ("make", "arguments", "words"), REFUSED, ids=lambda value: value if isinstance(value, str) else ""
)
def test_what_is_no_sensor_is_refused(make, arguments, words):
    with pytest.raises(InputError, match=words):
        make(**arguments)


def test_triads_are_right_handed():
    for reference in np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(1).normal(size=(50, 3))]):
        rows = triad(reference)
        np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(rows) == pytest.approx(1.0)
        np.testing.assert_allclose(rows[2], reference / np.linalg.norm(reference), atol=1e-15)


# ------------------------------------------------------------------------------------------------------------------- the orbit


def test_the_orbit_obeys_newton():
    path, time, step = orbit.CircularOrbit(inclination=1.2, phase=0.5), np.linspace(0.0, 6000.0, 50), 1.0
    pull = (path.position(time + step) - 2.0 * path.position(time) + path.position(time - step)) / step**2
    r = path.position(time)
    np.testing.assert_allclose(pull, -orbit.EARTH_GRAVITATION * r / path.radius**3, atol=1e-5)
    assert np.degrees(np.arccos(np.cross(r[0], r[1])[2] / np.linalg.norm(np.cross(r[0], r[1])))) == pytest.approx(
        np.degrees(1.2)
    )
    assert 5600.0 < 2.0 * np.pi / path.rate < 5700.0


def test_the_dipole_has_no_divergence_and_no_curl_and_points_north_at_the_equator():
    rng, h = np.random.default_rng(2), 100.0
    for r in rng.normal(size=(10, 3)) * 4e6 + np.array([5e6, 0.0, 0.0]):
        jacobian = np.stack(
            [(orbit.dipole_field(r + e) - orbit.dipole_field(r - e)) / (2.0 * h) for e in h * np.eye(3)], axis=1
        )
        scale = np.max(np.abs(jacobian))
        assert abs(np.trace(jacobian)) < 1e-6 * scale
        np.testing.assert_allclose(jacobian, jacobian.T, atol=1e-6 * scale)
    np.testing.assert_allclose(orbit.dipole_field([orbit.EARTH_RADIUS, 0.0, 0.0]), [0.0, 0.0, 2.98e-5], atol=1e-12)
    np.testing.assert_allclose(orbit.dipole_field([0.0, 0.0, orbit.EARTH_RADIUS]), [0.0, 0.0, -5.96e-5], atol=1e-12)


def test_a_measured_heading_corrects_the_angle_about_the_vertical_alone():
    """Of a level body at rest, the update is that of one scalar; the third sample is missing."""
    prior, sigma = 0.05, 0.02
    heading = np.array([0.2802, 0.2803, np.nan])
    series = vectors.VectorMeasurements.from_headings("gnss", [1.0, 2.0, 3.0], heading, sigma, axis_b=[0.0, 2.0, 0.0])
    record = records.ImuRecord(time=np.arange(5.0), increments=np.zeros((4, 3)), vectors=(series,))
    noise = estimation.ProcessNoise(angle_random_walk=1e-12, rate_random_walk=0.0)
    yaw = 0.28 - np.pi / 2  # of body x; y is π/2 ahead
    start = estimation.initial_state(quaternion.exp(np.array([0.0, 0.0, yaw])), attitude_sigma=prior, bias_sigma=1e-12)
    estimate = estimation.run(record, noise, start)
    information = 1.0 / prior**2 + 2.0 / sigma**2
    expected = 0.28 + (2e-4 + 3e-4) / sigma**2 / information
    np.testing.assert_allclose(rotation_angles(estimate.attitude[-1]), [0.0, 0.0, expected - np.pi / 2], atol=1e-9)
    np.testing.assert_allclose(estimate.variance[-1, :3], [prior**2, prior**2, 1.0 / information], rtol=1e-6)
    assert estimate.skipped == {"gnss": 1}


def test_masked_measurements_are_missing_ones():
    vector = np.ma.masked_array(np.eye(3), mask=[[0, 0, 0], [1, 1, 1], [0, 0, 0]])
    sigma = np.ma.masked_array([1e-3, 7.0, 1e-3], mask=[0, 1, 0])
    series = vectors.VectorMeasurements(**{**GOOD, "time": [0.0, 1.0, 2.0], "vector_b": vector, "sigma": sigma})
    np.testing.assert_array_equal(np.isnan(series.vector_b).all(axis=1), [False, True, False])
    np.testing.assert_allclose(series.sigma, 1e-3)


@pytest.mark.parametrize("boresight", [(0.6, 0.0, 0.8), (3.0, 0.0, 4.0)])
def test_a_tracker_looks_where_it_is_mounted(boresight):
    """Its noise is that of a tracker along z, turned by the mounting: covariance by rotation matrices, and that of the samples."""
    tracker = AttitudeSensor(name="t", sigma_across=1e-4, sigma_about=1e-3, rate=100.0, boresight=boresight)
    R = Rotation.from_euler("y", np.arctan2(0.6, 0.8)).as_matrix()
    expected = R @ np.diag([1e-8, 1e-8, 1e-6]) @ R.T
    np.testing.assert_allclose(tracker.covariance, expected, atol=1e-20)
    series = tracker.observe(lambda t: np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)), 0.0, 200.0, np.random.default_rng(1))
    assert series.covariance is not None
    np.testing.assert_allclose(series.covariance[0], expected, atol=1e-20)
    error = Rotation.from_quat(np.roll(series.attitude, -1, axis=1)).as_rotvec()
    np.testing.assert_allclose(error.T @ error / len(error), expected, atol=0.04e-6)


def test_a_boresight_from_a_file_is_that_of_the_sensor_to_the_bit():
    """A vector of unit length is not divided by its length again, which changes the last bit of (0, 1, 1)/√2."""
    tracker = AttitudeSensor(name="t", sigma_across=1e-4, sigma_about=1e-3, rate=1.0, boresight=(0.0, 1.0, 1.0))
    assert dataclasses.replace(tracker).boresight == tracker.boresight


@pytest.mark.parametrize(("boresight", "axis"), [("-x", "x"), ((0.0, -2.0, 0.0), "y")])
def test_a_boresight_along_a_body_axis_is_that_axis(boresight, axis):
    tracker = AttitudeSensor(name="t", sigma_across=1e-4, sigma_about=1e-3, rate=1.0, boresight=boresight)
    assert tracker.boresight == axis
    assert tracker.covariance is None


def variance_across(sigma):
    """Variance of a component across the direction, by the mixture of χ² that the squares are: ∫ t² exp(−(1 − t²)/(2σ²)) dt over [0, 1]."""
    return quad(lambda t: t * t * math.exp(-(1.0 - t * t) / (2.0 * sigma**2)), 0.0, 1.0, epsabs=0.0, epsrel=1e-12)[0]


def observed(kind, sigma, samples):
    """A body at rest, its attitude known but for 1e-6 rad, sees the field: mean NIS per degree of freedom."""
    field = vectors.Magnetometer(
        name="field", field_f=np.array([3.0, 0.0, 4.0]), sigma=5.0 * sigma, rate=10.0, kind=kind
    )
    scenario = scenarios.Scenario(
        motion=motion.ConstantRate(rate=(0.0, 0.0, 0.0)),
        gyro=GyroSpec(),
        sensors=(field,),
        rate=10.0,
        duration=samples / 10.0,
    )
    record = scenarios.simulate(scenario, seed=11)
    start = estimation.initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-6, bias_sigma=1e-12)
    noise = estimation.ProcessNoise(angle_random_walk=1e-9, rate_random_walk=0.0)
    innovation = estimation.run(record, noise, start, every=samples).innovations["field"]
    return float(np.mean(innovation.nis)) / innovation.innovation.shape[1], innovation.innovation.size


@pytest.mark.parametrize("sigma", [0.05, 0.2])
def test_the_nis_of_directions_is_too_small_by_that_share_and_that_of_whole_vectors_right(sigma):
    for kind, expected in (("direction", variance_across(sigma) / sigma**2), ("vector", 1.0)):
        mean, degrees = observed(kind, sigma, 40_000)
        assert mean == pytest.approx(expected, abs=4.0 * math.sqrt(2.0 / degrees))


def test_triads_of_several_vectors_are_those_of_each_whatever_its_length():
    several = np.random.default_rng(3).standard_normal((20, 3)) * np.geomspace(1e-3, 1e3, 20)[:, None]
    np.testing.assert_allclose(triad(several), np.stack([triad(vector) for vector in several]), atol=1e-14)
