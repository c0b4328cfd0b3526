"""Samples of recordings gathered into intervals, and what they become with assumed sensor errors.

Over an interval the gyro gives the rotation, and the samples of the other sensors, rotated into the body axes at its start, one mean each.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from strapdown.checks import Array, InputError
from strapdown.kinematics import right_jacobian, skew
from strapdown.recordings import Recording, sensor_faults
from strapdown.records.recording import GAP, sampled

INTERVAL = 0.25
"""Length of an interval, s."""
SHORTEST = 2.0
"""Shortest part of a recording between gaps that is used, s."""
DIFFERENCE_ORDER = 3
"""Order of the differences of samples whose median gives the white noise."""


class Sensor(NamedTuple):
    """Samples of a vector sensor in the intervals."""

    samples: Array
    """Samples (k, n, 3), 0 where there is none."""
    known: Array
    """1 where there is a sample, else 0 (k, n)."""
    noise: float
    """σ of the white noise of a sample, each component."""

    @property
    def number(self) -> Array:
        """Number of samples in each interval (k,)."""
        return np.asarray(self.known.sum(axis=1))


class Intervals(NamedTuple):
    """Samples of all recordings in intervals; the attitude is estimated at the nodes between them, n of k in all."""

    step: Array
    """Time between samples, s, 0 beyond the end of the interval (k, m)."""
    angle: Array
    """Integral of the measured rate over each of them, rad (k, m, 3)."""
    rate: Array
    """Measured rate at the end of each, rad/s (k, m, 3)."""
    force: Sensor
    field: Sensor | None
    gyro_noise: float
    """White noise of the gyro, rad/√s, each axis."""
    node: np.ndarray
    """Node at the start of each interval; the next node is at its end (k,)."""
    node_rate: Array
    """Measured rate at the nodes, rad/s (n, 3)."""

    @property
    def length(self) -> Array:
        """Length of each interval, s (k,)."""
        return np.asarray(self.step.sum(axis=1))

    @property
    def first(self) -> np.ndarray:
        """Node at the start of each part without gaps."""
        return np.setdiff1d(self.node, self.node + 1)


def gathered(recordings: Sequence[Recording]) -> Intervals:
    """Return the intervals of recordings; parts between gaps are separate, and those shorter than :data:`SHORTEST` are left out."""
    parts = [part for recording in recordings for part in _parts(sensor_faults.find(recording).recording)]
    if not parts:
        raise InputError(f"{recordings[0].source} has no part of {SHORTEST:g} s without gaps, and none is used")
    interval = float(np.median(np.concatenate([np.diff(part.time) for part in parts])))
    edges = [_edges(part.time) for part in parts]
    width = max(int(np.diff(edge).max()) for edge in edges)
    index = [edge[:-1, None] + 1 + np.arange(width) for edge in edges]
    inside = [np.arange(width) < np.diff(edge)[:, None] for edge in edges]
    index = [np.minimum(i, len(part.time) - 1) for i, part in zip(index, parts, strict=True)]
    step, angle, rate = [], [], []
    for part, i, within in zip(parts, index, inside, strict=True):
        step.append(np.where(within, (part.time[i] - part.time[i - 1]), 0.0))
        angle.append(0.5 * (part.rate[i] + part.rate[i - 1]) * step[-1][:, :, None])
        rate.append(part.rate[i])

    def sensor(name: str) -> Sensor:
        arrays = [np.nan_to_num(getattr(part, name)) for part in parts]
        known = [sampled(a)[i] & within for a, i, within in zip(arrays, index, inside, strict=True)]
        samples = [a[i] * k[:, :, None] for a, i, k in zip(arrays, index, known, strict=True)]
        noise = [white_noise(a[sampled(a)]) for a in arrays]
        return Sensor(np.concatenate(samples), np.concatenate(known).astype(np.float64), float(np.median(noise)))

    begin = np.cumsum([0, *(len(edge) for edge in edges)])[:-1]
    return Intervals(
        step=np.concatenate(step),
        angle=np.concatenate(angle),
        rate=np.concatenate(rate),
        force=sensor("specific_force"),
        field=None if any(part.magnetic_field is None for part in parts) else sensor("magnetic_field"),
        gyro_noise=float(np.median([white_noise(part.rate) for part in parts]) * np.sqrt(interval)),
        node=np.concatenate([b + np.arange(len(edge) - 1) for b, edge in zip(begin, edges, strict=True)]),
        node_rate=np.concatenate([part.rate[edge] for part, edge in zip(parts, edges, strict=True)]),
    )


def _parts(recording: Recording) -> list[Recording]:
    """Return the parts of a recording between its gaps that are long enough."""
    if recording.specific_force is None:
        raise InputError(f"{recording.source} has no accelerometer; a calibration needs it: add columns ax, ay, az")
    steps = np.diff(recording.time)
    bounds = [0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1), len(recording.time)]
    parts = [recording.taken(slice(a, b)) for a, b in itertools.pairwise(bounds) if b - a > 2]
    return [part for part in parts if part.time[-1] - part.time[0] >= SHORTEST and part.specific_force is not None]


def _edges(time: Array) -> np.ndarray:
    """Return the samples at which intervals begin and end."""
    bins = np.floor((time - time[0]) / INTERVAL + 1e-6)
    inner = np.flatnonzero(bins[1:] != bins[:-1])
    return np.concatenate([[0], inner[inner > 0], [len(time) - 1]])


def white_noise(samples: Array) -> float:
    """Return σ of the white noise of samples (n, 3), each component, from the median of their differences.

    The third differences of a motion sampled fast enough are small; those of white noise have 20 times its variance. The median of the
    square of a standard normal number is 0.455.
    """
    if len(samples) <= DIFFERENCE_ORDER:
        return 0.0
    return float(np.sqrt(np.median(np.diff(samples, DIFFERENCE_ORDER, axis=0) ** 2) / (20.0 * 0.455)))


class Errors(NamedTuple):
    """Errors of the sensors that the samples are corrected by, as in :class:`strapdown.calibration.SensorErrors`."""

    gyro_matrix: Array
    accelerometer_bias: Array
    accelerometer_matrix: Array
    accelerometer_delay: float
    hard_iron: Array
    magnetometer_matrix: Array
    magnetometer_delay: float


class Mean(NamedTuple):
    """Mean of a sensor's corrected samples in the body axes at the start of each interval (k, 3), and its derivatives."""

    value: Array
    by_turn: Array
    """By gyro bias and matrix (k, 3, 12)."""
    by_own: Array
    """By the sensor's bias, matrix and delay (k, 3, 13)."""


class Prediction(NamedTuple):
    """Rotation over each interval (k, 3, 3), its derivative by gyro bias and matrix (k, 3, 12) at its end, and the means."""

    turn: Array
    turn_by: Array
    force: Mean
    field: Mean | None


def predicted(intervals: Intervals, errors: Errors, bias: Array) -> Prediction:
    """Return rotations and means with the errors removed; ``bias`` (k, 3) is that of the gyro in each interval, rad/s."""
    count, width = intervals.step.shape
    inverse: Array = np.linalg.inv(np.eye(3) + errors.gyro_matrix).astype(np.float64)
    turn, by = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3, 12))
    sums = [_Sum(intervals.force, errors.accelerometer_bias, errors.accelerometer_matrix, errors.accelerometer_delay)]
    if intervals.field is not None:
        sums.append(_Sum(intervals.field, errors.hard_iron, errors.magnetometer_matrix, errors.magnetometer_delay))
    for j in range(width):
        step = intervals.step[:, j, None]
        angle = (intervals.angle[:, j] - bias * step) @ inverse.T
        change = _by_gyro(inverse, angle, step)
        small = Rotation.from_rotvec(angle).as_matrix()
        by = np.swapaxes(small, 1, 2) @ by + right_jacobian(angle) @ change
        turn = turn @ small
        rate = (intervals.rate[:, j] - bias) @ inverse.T
        for part in sums:
            part.add(j, turn, by, rate, _by_gyro(inverse, rate, np.ones((count, 1))))
    return Prediction(turn, by, sums[0].mean, sums[1].mean if len(sums) == 2 else None)


def _by_gyro(inverse: Array, turned: Array, length: Array) -> Array:
    """Return the derivative (k, 3, 12) of corrected rotations over a time (k, 1), ``turned`` (k, 3), by gyro bias and matrix."""
    matrix = inverse[None, :, :, None] * turned[:, None, None, :]
    return -np.concatenate([length[:, :, None] * inverse, matrix.reshape(-1, 3, 9)], axis=2)


class _Sum:
    """Sum of the corrected samples of a sensor over the intervals, rotated to their starts."""

    def __init__(self, sensor: Sensor, bias: Array, matrix: Array, delay: float) -> None:
        self.sensor, self.bias, self.delay = sensor, bias, delay
        self.inverse = np.linalg.inv(np.eye(3) + matrix)
        count = len(sensor.samples)
        self.value, self.by_turn, self.by_own = (np.zeros((count, 3, *more)) for more in ((), (12,), (13,)))

    def add(self, j: int, turn: Array, by: Array, rate: Array, rate_by: Array) -> None:
        """Add sample ``j`` of every interval: rotation to it (k, 3, 3), rate there, and their derivatives by the errors of the gyro."""
        known = self.sensor.known[:, j, None]
        sample = known * ((self.sensor.samples[:, j] - self.bias) @ self.inverse.T)
        # A sample that is late by τ was taken when the unit had turned by less: C(t − τ) = C(t) exp(−w τ).
        late = Rotation.from_rotvec(-self.delay * rate).as_matrix()
        to_start = turn @ late
        linear = known[:, :, None] * (to_start @ self.inverse)
        self.value += np.einsum("kij,kj->ki", to_start, sample)
        self.by_turn -= (
            to_start
            @ skew(sample)
            @ (np.swapaxes(late, 1, 2) @ by - self.delay * right_jacobian(-self.delay * rate) @ rate_by)
        )
        self.by_own[:, :, :3] -= linear
        self.by_own[:, :, 3:12] -= (linear[:, :, :, None] * sample[:, None, None, :]).reshape(-1, 3, 9)
        self.by_own[:, :, 12] -= np.einsum("kij,kj->ki", to_start, np.cross(rate, sample))

    @property
    def mean(self) -> Mean:
        number = np.maximum(self.sensor.number, 1.0)
        return Mean(self.value / number[:, None], *(d / number[:, None, None] for d in (self.by_turn, self.by_own)))
