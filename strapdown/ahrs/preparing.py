"""Input of the filter from a recording: increments, specific force and heading over the filter's steps, and the initial state."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from strapdown import estimation
from strapdown.ahrs import headings, starting
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.checks import Array
from strapdown.gyro.temperature import BiasOverTemperature
from strapdown.kernels import alignment, recording_steps
from strapdown.kernels import headings as kernel
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings import Recording, gyro_temperature, sensor_delays
from strapdown.records import ImuRecord
from strapdown.records.recording import sampled
from strapdown.units import STANDARD_GRAVITY
from strapdown.vectors import VectorMeasurements

GRAVITY = np.array([0.0, 0.0, STANDARD_GRAVITY])
"""Specific force at rest, m/s², fixed frame. An accelerometer's deviation from it is an error of its scale or bias."""


class Prepared(NamedTuple):
    """Input of the filter from a recording."""

    record: ImuRecord
    """Increments and vectors at the filter's steps."""
    initial: estimation.State
    edge: np.ndarray
    """Sample at which each step ends, preceded by the first sample (k + 1,)."""
    turned: Array
    """Attitude from the gyro only at every sample, identity at the first one (n, 4)."""
    turn_variance: Array
    """Variance of the rotation about each body axis over each step in addition to the gyro's noise, rad² (k, 3)."""
    skipped: dict[str, int]
    """Number of the gyro's samples without one of each other sensor."""
    interval: float
    """Usual interval of the samples, s."""
    steps: alignment.Steps
    """Samples of the steps for coarse alignments."""
    field: headings.Headings | None
    """What was found of the field; None without a magnetometer."""


def prepare(
    recording: Recording,
    parameters: AhrsParameters,
    field_delay: Array | float = 0.0,
    turn_variance: Array | None = None,
    *,
    causal: bool = True,
    turned: Array | None = None,
    at_rest: starting.Rests = starting.NO_REST,
) -> Prepared:
    """Return the record that the filter runs on, and its initial state.

    ``field_delay`` is that of the magnetometer relative to the gyro, s, one number or one per sample; each sample is rotated forward
    by the gyro. ``causal``: a heading's noise depends only on the samples up to it, and on ``turn_variance``, the variance of the rotation
    about each body axis over each sample interval in addition to the gyro's noise, rad² (n − 1, 3). ``turned`` (n, 4): attitude from the
    gyro only, if already computed. ``at_rest``: rests that show the gyro's bias.
    """
    if turned is None:
        turned = sensor_delays.gyro_attitude(recording)
    initial = starting.start(recording, turned, parameters)  # first, because it rejects a sensor without samples
    interval = recording.interval
    edge = edges(recording.time, parameters.step, interval)
    time = recording.time[edge]
    assert recording.specific_force is not None
    total, number = sums(recording.specific_force, turned, edge)
    force, turn = np.empty((2, len(edge) - 1, 3))
    compiled(recording_steps.end_steps)(read_only(turned), edge, total, number, force, turn)
    shown = number > 0
    added = np.zeros_like(turn) if turn_variance is None else over_steps(turn_variance, edge)
    vectors = [
        VectorMeasurements(
            sensor="accelerometer",
            kind="vector",
            time=time[1:][shown],
            vector_b=force[shown],
            reference_f=GRAVITY,
            sigma=parameters.specific_force_noise / np.sqrt(number[shown] * interval),
        )
    ]
    skipped = {"accelerometer": missing(recording.specific_force, number)}
    heading = None
    field, counted = np.empty((0, 3)), np.empty(0)
    if recording.magnetic_field is not None:
        variance = added.copy()
        variance[1:] += added[:-1]  # most of a step's samples may precede the uncertain rotation
        field, counted, middle = field_sums(recording, field_delay, turned, edge)
        bias = starting.bias_by_rests(at_rest, recording.time, edge, causal=causal)
        of_field = kernel.Steps(
            field, counted, counted * interval, middle, total, number, turned[edge[1:]], time[1:], variance, bias
        )
        skipped["magnetometer"] = missing(recording.magnetic_field, counted)
        headings_by = headings.online if causal else headings.smoothed
        heading = headings_by(of_field, float(time[0]), parameters, max(parameters.step, interval))
        vectors.append(heading.vectors)
    known = recording.temperature is not None and bool(np.isfinite(recording.temperature).all())
    temperature = recording.temperature[edge] if known and recording.temperature is not None else None
    record = ImuRecord(time=time, increments=turn, vectors=tuple(vectors), temperature=temperature)
    steps = alignment.Steps(total, number, field, counted, turned[edge[1:]])
    return Prepared(record, initial, edge, turned, added, skipped, interval, steps, heading)


def field_sums(
    recording: Recording, delay: Array | float, turned: Array, edge: np.ndarray
) -> tuple[Array, Array, Array]:
    """Return :func:`sums` of the field, whose samples have a delay, s, and the attitude by the gyro in the middle of each step (k, 4)."""
    frame = turned
    if np.any(delay):
        frame = np.empty_like(turned)
        over = sensor_delays.turn_over(recording, delay)
        compiled(recording_steps.turn_back)(read_only(turned), read_only(over), frame)
    assert recording.magnetic_field is not None
    return *sums(recording.magnetic_field, frame, edge), frame[(edge[:-1] + edge[1:] + 1) // 2]


def without_temperature(
    recording: Recording, parameters: AhrsParameters, warm: BiasOverTemperature, *, walks: bool
) -> tuple[Recording, AhrsParameters]:
    """Return a recording with the gyro's bias over temperature subtracted, and the parameters with the error of its slope.

    That error is an error state driven by the temperature; if the estimator has none (``walks``), a rate random walk covers it.
    """
    used = gyro_temperature.applied(recording, warm)
    if not walks:
        return used, replace(parameters, gyro_temperature_sigma=tuple(warm.slope_sigma.tolist()))
    walk = warm.walk(gyro_temperature.temperature_at_samples(used), used.time)
    return used, replace(parameters, rate_random_walk=float(np.hypot(parameters.rate_random_walk, walk)))


def edges(time: Array, step: float, interval: float) -> np.ndarray:
    """Return the samples at which steps end (k + 1,): the first, the last before each multiple of ``step``, s, and the last of all.

    A sample is known to be the last from the usual interval, s, after which the next one is expected.
    """
    bins = np.floor((time + interval - time[0]) / step + 1e-6)
    inner = np.flatnonzero(bins[1:] != bins[:-1]) + 1
    return np.concatenate([[0], inner[inner < len(time) - 1], [len(time) - 1]])


def over_steps(variance: Array, edge: np.ndarray) -> Array:
    """Return the sum over each step (k, 3) of a variance of each sample interval (n − 1, 3), which is mostly zero."""
    total = np.zeros((len(edge) - 1, 3))
    rows = np.unique(np.flatnonzero(variance) // 3)
    np.add.at(total, np.searchsorted(edge, rows, side="right") - 1, variance[rows])
    return total


def sums(samples: Array, frame: Array, edge: Array) -> tuple[Array, Array]:
    """Return the sum of each step's samples, rotated by ``frame`` (n, 4), as (k, 3), and their number."""
    total, number = np.empty((len(edge) - 1, 3)), np.empty(len(edge) - 1)
    compiled(recording_steps.average_samples)(read_only(samples), read_only(frame), edge, total, number)
    return total, number


def missing(samples: Array, number: Array) -> int:
    """Return the number of rows (n, 3) that are no samples, given the number of samples of each step; the first row is in no step."""
    return len(samples) - int(number.sum() + np.count_nonzero(sampled(samples[:1])))
