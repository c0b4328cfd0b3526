"""What many tests are made of: bodies, references, measurements, recordings, records at rest, starts drawn from their own σ, errors."""

from dataclasses import fields, is_dataclass, replace

import numpy as np

from strapdown import consistency, estimation, motion, quaternion
from strapdown.estimation import error_states
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.vectors import VectorMeasurements

UP = np.array([0.0, 0.0, 9.81])
FIELD = np.array([0.0, 2e-5, -4e-5])
STAR = np.array([0.6, 0.64, 0.48])


def waves(*each, **more) -> motion.HarmonicRates:
    """Return a motion from amplitude, frequency and phase of each harmonic of its rate."""
    names = ("amplitude", "frequency", "phase")
    harmonics = [motion.Harmonic(**dict(zip(names, values, strict=False))) for values in each]
    return motion.HarmonicRates(harmonics=harmonics, **more)


SWAY = waves(((0.9, 0.4, -0.6), 0.21), ((-0.4, 0.8, 0.5), 0.37))
HAND = waves(((1.2, 0.2, -0.3), 0.21), ((-0.3, 1.1, 0.4), 0.37), ((0.3, -0.2, 1.3), 0.29, 1.0))
"""A hand that turns its unit about all three axes."""


def series_of(sensor, kind, time, vector_b, reference_f, sigma) -> VectorMeasurements:
    """Return a series of directions, headings or vectors."""
    return VectorMeasurements(
        sensor=sensor, kind=kind, time=time, vector_b=vector_b, reference_f=reference_f, sigma=sigma
    )


def sample(kind, value, reference_f, sigma, sensor="s") -> VectorMeasurements:
    """Return one measurement as a series."""
    return series_of(sensor, kind, [0.0], [value], reference_f, sigma)


def resting(*vectors, time=(0.0, 1.0)) -> ImuRecord:
    """Return the record of a body that does not turn."""
    return ImuRecord(time=time, increments=np.zeros((len(time) - 1, 3)), vectors=vectors)


def in_body(attitude, reference):
    """Return references of the fixed frame in body axes."""
    return quaternion.rotate(quaternion.conjugate(attitude), reference)


def unit(v):
    """Return vectors (..., 3) over their length."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def record_of(body=SWAY, duration=4.0, rate=50.0, seed=1, anisotropic=False) -> ImuRecord:
    """Return a record with every kind of measurement, at times of their own."""
    rng = np.random.default_rng(seed)
    edges = np.arange(round(duration * rate) + 1) / rate
    dt = np.diff(edges)[:, None]
    increments = body.increments(edges) + 1e-3 * np.sqrt(dt) * rng.standard_normal((len(dt), 3))

    def seen_at(interval, phase, reference, sigma):
        t = np.arange(phase, duration, interval)
        return t, in_body(body.attitude(t), reference) + sigma * rng.standard_normal((len(t), 3))

    t, mag = seen_at(0.11, 0.013, FIELD, 5e-7)
    mag = series_of("mag", "vector", t, mag + np.array([3e-6, -2e-6, 1e-6]), FIELD, 5e-7)
    if anisotropic:
        whole = 2.5e-13 * np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.2], [0.0, 0.2, 0.7]])
        mag = replace(mag, sigma=0.0, covariance=whole)
    t, force = seen_at(0.07, 0.05, UP, 0.05)
    force = series_of("force", "direction", t, unit(force), UP, 5e-3)
    t, star = seen_at(0.31, 0.17, STAR, 2e-2)
    compass = series_of("compass", "heading", t, unit(star), STAR, 3e-2)
    t, axes = np.arange(0.2, duration, 0.43), np.array([2e-3, 3e-3, 9e-3])
    attitude = quaternion.multiply(body.attitude(t), quaternion.exp(axes * rng.standard_normal((len(t), 3))))
    tracker = VectorMeasurements(sensor="tracker", kind="attitude", time=t, attitude=attitude, sigma_axes=axes)
    t = np.arange(0.11, duration, 0.23)
    moving = np.stack([np.cos(t), np.sin(t), 0.5 + 0.1 * t], axis=-1)
    beacon = series_of("beacon", "vector", t, in_body(body.attitude(t), moving), moving, 0.02)
    return ImuRecord(time=edges, increments=increments, vectors=(mag, force, compass, tracker, beacon))


EVERY_KIND = (
    error_states.GyroScale(scale_sigma=0.02, misalignment_sigma=0.01),
    error_states.GyroGaussMarkov(bias_sigma=3e-3, correlation_time=20.0),
    error_states.VectorBias(sensor="mag", bias_sigma=5e-6, unit="T"),
    error_states.GaussMarkov(sensor="force", noise_sigma=0.1, correlation_time=0.7),
)
"""States of every kind for :func:`record_of` with ``anisotropic``: the largest filter of the default run, compiled once."""
NEGLIGIBLE = {
    "gyro scale": {"scale_sigma": 1e-8, "misalignment_sigma": 1e-8},
    "gyro drift": {"bias_sigma": 1e-9},
    "mag bias": {"bias_sigma": 1e-12},
    "force disturbance": {"noise_sigma": 1e-8},
}


def every_kind(held=False, **changes) -> tuple[error_states.ErrorStates, ...]:
    """Return the states of every kind with changes by block; ``held``: all others at zero by a negligible σ. The kernels are the same."""
    blocks = {block.name: block for block in EVERY_KIND}
    for name, block in blocks.items():
        change = changes.get(name.replace(" ", "_"), NEGLIGIBLE[name] if held else {})
        blocks[name] = replace(block, **change)
    return tuple(blocks.values())


def beside_silent(*series) -> tuple[VectorMeasurements, ...]:
    """Return series and, without measurements, the others of :func:`record_of`, for the kernels of :data:`EVERY_KIND`."""
    names = [measurements.sensor for measurements in series]
    others = record_of(duration=0.5, anisotropic=True).vectors
    return (*series, *(other.taken(slice(0)) for other in others if other.sensor not in names))


def turn_to(q, other):
    """Return the rotation vector, body axes of q, from an attitude q to another."""
    return quaternion.log(quaternion.multiply(quaternion.conjugate(q), other))


def drawn_start(truth, draw, attitude_sigma, bias_sigma) -> estimation.State:
    """Return the state whose errors are ``draw`` (6,) times its σ."""
    attitude, bias = truth.attitude[0], truth.bias[0]
    return estimation.initial_state(
        quaternion.multiply(attitude, quaternion.exp(-attitude_sigma * draw[:3])),
        attitude_sigma=attitude_sigma,
        bias_sigma=bias_sigma,
        bias=bias - bias_sigma * draw[3:],
    )


def errors(estimate, truth, every=1):
    """Return the errors of attitude and bias (m, 6) of an estimate that holds each so-many-th edge."""
    return consistency.errors(estimate.attitude, estimate.bias, truth.attitude[::every], truth.bias[::every])


def errors_at(estimate, truth, rows):
    """Return the errors at rows of an estimate that holds every edge."""
    return consistency.errors(estimate.attitude[rows], estimate.bias[rows], truth.attitude[rows], truth.bias[rows])


def recoveries(estimate):
    """Return the recoveries among the events of an estimate."""
    return [event for event in estimate.events if event.kind == "recovery"]


def differing(a, b):
    """Return the fields in which two records differ in any bit, their origins apart."""
    if is_dataclass(a) and type(a) is type(b):
        pairs = [(field.name, getattr(a, field.name), getattr(b, field.name)) for field in fields(a)]
    elif isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        pairs = list(zip(map(str, range(len(a))), a, b, strict=True))
    elif isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return [] if np.array_equal(a, b, equal_nan=True) else [""]
    else:
        return [] if a == b else [""]
    return [f"{name} {part}" for name, x, y in pairs if name != "origin" for part in differing(x, y)]


def correlation(P, sigma):
    """Return a covariance, or a difference of two, over the product of the σ of its states."""
    return P / (sigma[..., :, None] * sigma[..., None, :])


def assert_inside(mean, degrees, samples, probability=0.99) -> None:
    """Assert that means of NEES or NIS over their degrees of freedom lie inside their two-sided bounds."""
    low, high = consistency.mean_bounds(degrees, samples, probability)
    assert np.all((low < mean) & (mean < high)), (mean, low, high)


def walk(n=60, epoch=1_700_000_000_123_456_789, single=False) -> Recording:
    """Return a recording of all there is, its numbers of single precision and stamps of whole µs if wanted."""
    random = np.random.default_rng(2)
    to = (lambda x: x.astype(np.float32).astype(np.float64)) if single else (lambda x: x)
    field, force, rate = to(random.standard_normal((3, n, 3)))
    field[1::2], force[5] = np.nan, np.nan
    return Recording(
        source="walk",
        time=np.cumsum(random.integers(4_000, 6_000, n)) * 1000 / 1e9,
        rate=rate,
        specific_force=force,
        magnetic_field=field,
        magnetic_unit="G",
        temperature=random.standard_normal(n),
        true_attitude=quaternion.exp(np.cumsum(0.02 * random.standard_normal((n, 3)), axis=0)),
        movement=random.random(n) > 0.5,
        epoch_ns=epoch // 1000 * 1000 if single else epoch,
    )


def rates(time, path) -> np.ndarray:
    """Return the body rate of a path by fourth-order differences of SciPy's rotations."""
    h = 1e-3
    here = path(time)

    def turned(step):
        return (here.inv() * path(time + step)).as_rotvec()

    return (8.0 * (turned(h) - turned(-h)) - (turned(2 * h) - turned(-2 * h))) / (12.0 * h)


def by_sensors(source, time, attitude, rate, *, acceleration=0.0, field=(0.0, 20.0, -43.0), iron=0.0, noise, seed=9):
    """Return a recording by sensors with white noise of σ ``noise`` each: gyro, accelerometer, magnetometer with ``iron`` in body axes."""
    white = np.random.default_rng(seed).standard_normal((3, len(time), 3))
    gyro, force, compass = (sigma * draw for sigma, draw in zip(noise, white, strict=True))
    return Recording(
        source=source,
        time=time,
        rate=rate + gyro,
        specific_force=attitude.inv().apply(acceleration + np.array([0.0, 0.0, 9.81])) + force,
        magnetic_field=attitude.inv().apply(field) + iron + compass,
        true_attitude=np.roll(attitude.as_quat(), 1, axis=-1),
    )


def state_errors(estimate, true_attitude, true_bias, true_values=None) -> np.ndarray:
    """Return the errors (m, n) of all states of an estimate: Log(q_est⁻¹ ⊗ q_true), then true less estimated."""
    turn = quaternion.log(quaternion.multiply(quaternion.conjugate(estimate.attitude), true_attitude))
    true_values = true_values or {}
    assert set(true_values) == set(estimate.error_states)
    states = [true_values[name] - block.values for name, block in estimate.error_states.items()]
    return np.concatenate([turn, true_bias - estimate.bias, *states], axis=-1)
