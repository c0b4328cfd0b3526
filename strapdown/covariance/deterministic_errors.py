"""Errors that are the same in every run, and considered errors: a rate of the gyro, or a turn or offset of a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from strapdown import coning, gyro, kinematics, quaternion, vectors
from strapdown.checks import Array
from strapdown.covariance.consider import Consider
from strapdown.covariance.random_errors import by_axis
from strapdown.covariance.trajectory import Trajectory, unit_of
from strapdown.estimation.setup import FilterSetup
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator
from strapdown.scenarios import Scenario
from strapdown.vectors import VectorMeasurements

AXES = ("x", "y", "z")

MIN_ERROR = 1e-12
"""Errors of a step or measurement below this are treated as rounding, rad."""
_FIXED_PARTS = {
    "scale factor": ("scale_factor",),
    "asymmetry": ("asymmetry",),
    "misalignment": ("misalignment",),
    "g-sensitivity": ("g_sensitivity",),
    "bandwidth": ("bandwidth", "damping"),
    "range": ("range",),
}
"""Errors of a gyro that are the same in every run, by name, and their fields in the specification."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DeterministicError:
    """A deterministic error of the gyro or of a sensor."""

    name: str
    rate: Array | None = None
    """Error of the rate in each segment (n, 3), rad/s."""
    ramp: Array = field(default_factory=lambda: np.zeros(3))
    """Ramp of the bias (3,), rad/s²."""
    turn: Array | None = None
    """Rotation of a sensor at each measurement (events, 3), rad."""
    offset: Array | None = None
    """Error in the unit of a sensor along the axes of its noise at each measurement (events, 3)."""
    sensor: int = -1
    """Sensor whose own errors the column is."""

    @property
    def drawn(self) -> bool:
        """Whether a Monte Carlo of a filter with states for them draws the errors in each run (:func:`strapdown.scenarios.drawn`)."""
        return self.sensor >= 0 or self.name in ("gyro scale factor", "gyro misalignment", "gyro g-sensitivity")


def fixed_errors(scenario: Scenario, setup: FilterSetup, path: Trajectory) -> list[DeterministicError]:
    """Return the errors that are the same in every run."""
    columns = [
        DeterministicError(name=name, rate=value[path.interval]) for name, value in _fixed_rates(scenario).items()
    ]
    integration = _integration_rate(scenario, setup, path.stamps, path.attitude, path.phi)
    if np.abs(integration * path.dt[:, None]).max() > MIN_ERROR:
        columns.append(DeterministicError(name=f"integration ({setup.integration.name})", rate=integration))
    if np.any(by_axis(scenario.gyro.rate_ramp) != 0.0):
        columns.append(DeterministicError(name="rate ramp", ramp=by_axis(scenario.gyro.rate_ramp)))
    return columns + [
        DeterministicError(name=f"{sensor.name} (fixed)", sensor=i) for i, sensor in enumerate(scenario.sensors)
    ]


def _fixed_rates(scenario: Scenario) -> dict[str, Array]:
    """Return the errors of the measured rate that are the same in every run, by name, in each gyro interval (n, 3), rad/s."""
    spec, edges, motion = scenario.gyro, scenario.edges, scenario.motion
    true = motion.increments(edges)
    dt = np.diff(edges)[:, None]
    clipped = {name: getattr(spec, name) for name in gyro.BEFORE_RANGE}
    rates: dict[str, Array] = {}
    for part, fields in _FIXED_PARTS.items():
        kept = {name: getattr(spec, name) for name in fields}
        if all(np.all(np.isinf(value)) or not np.any(value) for name, value in kept.items() if name != "damping"):
            continue
        force = None
        if part == "g-sensitivity":
            force = vectors.specific_force(motion, 0.5 * (edges[1:] + edges[:-1]), gravity_f=scenario.gravity_f)
        before = clipped if part == "range" else {}
        outputs = [
            gyro.simulate(GyroSpec(**known), true, edges, generator(scenario.seed, 0, "gyro"), specific_force=force)
            for known in (before | kept, before)
        ]
        error = (outputs[0].increments - outputs[1].increments) / dt
        if np.abs(error).max() > 0.0:
            rates[f"gyro {part}"] = error
    return rates


def _integration_rate(scenario: Scenario, setup: FilterSetup, stamps: Array, attitude: Array, phi: Array) -> Array:
    """Return the rate error (segments, 3), rad/s, of treating each step of the integration algorithm as a rotation at constant rate.

    It contains the algorithm's residual coning error, and the error of a measurement inside a step, at a fraction of the step's rotation.
    Inside a step the error ``e(t) = Log(exp(−share φ) ⊗ q_true(t))`` from its start is exact; the result is the rate that generates it.
    """
    n = setup.integration.samples
    edges = scenario.edges
    steps = (len(edges) - 1) // n
    turns = coning.rotation_vectors(scenario.motion.increments(edges[: steps * n + 1]), setup.integration)
    begins = edges[: steps * n + 1 : n]
    step = np.clip(np.searchsorted(begins, stamps[1:], side="left") - 1, 0, steps - 1)  # of each segment's end
    first = np.searchsorted(stamps, begins[:-1])[step]
    length = np.diff(begins)[step]
    share = (stamps[1:] - begins[step]) / length
    true = quaternion.multiply(quaternion.conjugate(attitude[first]), attitude[1:])
    error = quaternion.log(quaternion.multiply(quaternion.exp(-share[:, None] * turns[step]), true))
    before = np.concatenate([np.zeros((1, 3)), error[:-1]])
    before[stamps[:-1] <= begins[step]] = 0.0
    carried = quaternion.rotate(quaternion.exp(-phi), before)
    driven = np.linalg.solve(kinematics.right_jacobian(phi), (error - carried)[:, :, None])[:, :, 0]
    return np.asarray(-driven / np.diff(stamps)[:, None])


def considered_errors(scenario: Scenario, consider: Consider, path: Trajectory) -> list[DeterministicError]:
    """Return the considered errors at one standard deviation, one column per independent parameter."""
    unit, axes = np.eye(3), range(3)
    turn_rate = path.phi / path.dt[:, None]
    force = turn_rate
    if consider.g_sensitivity > 0.0:
        middle = 0.5 * (path.stamps[1:] + path.stamps[:-1])
        force = vectors.specific_force(scenario.motion, middle, gravity_f=scenario.gravity_f)
    pairs = [(i, j) for i in axes for j in axes]
    columns = []
    for what, sigma, driver, entries in (
        ("scale factor", consider.scale_factor, turn_rate, [(i, i) for i in axes]),
        ("misalignment", consider.misalignment, turn_rate, [(i, j) for i, j in pairs if i != j]),
        ("g-sensitivity", consider.g_sensitivity, force, pairs),
    ):
        for i, j in entries if sigma > 0.0 else ():
            where = AXES[i] if what == "scale factor" else f"{AXES[i]} of {AXES[j]}"
            columns.append(DeterministicError(name=f"{what}, {where}", rate=sigma * driver[:, [j]] * unit[i]))
    names = [sensor.name for sensor in scenario.sensors]

    def at(name: str) -> Array:
        """Return 1 for the measurements of a sensor (events, 1)."""
        return np.asarray((path.events.sensor == names.index(name))[:, None], np.float64)

    for name, size in consider.sensor_bias.items():
        columns += [DeterministicError(name=f"{name} bias, {AXES[i]}", offset=size * at(name) * unit[i]) for i in axes]
    for name, size in consider.mounting.items():
        columns += [
            DeterministicError(name=f"{name} mounting, {AXES[i]}", turn=size * at(name) * unit[i]) for i in axes
        ]
    for name, size in consider.time_offset.items():
        late = size * at(name)
        turn = late * scenario.motion.body_rate(path.events.time)
        moving = path.of_events(lambda series, sensor: _moving(series, sensor, scenario))
        columns.append(DeterministicError(name=f"{name} time offset", turn=turn, offset=late * moving))
    return columns


def _moving(series: VectorMeasurements, sensor: Any, scenario: Scenario) -> Array:
    """Return the rate of the reference's direction in the unit of the sensor, body axes (m, 3), 1/s; zero of a heading."""
    if series.reference_f.ndim < 2 or len(series.time) < 2 or series.kind not in ("direction", "vector"):
        return np.zeros((len(series.time), 3))
    direction = series.reference_f / np.linalg.norm(series.reference_f, axis=1, keepdims=True)
    rate = np.gradient(direction, series.time, axis=0)
    back = quaternion.conjugate(scenario.motion.attitude(series.time))
    return np.asarray(quaternion.rotate(back, rate) / unit_of(series, sensor)[:, None])


def sizes_of(path: Trajectory, columns: Sequence[DeterministicError], residual: Array) -> list[float]:
    """Return the largest error of a measurement by each column, rad; 0 for errors of the gyro."""
    unit = path.of_events(unit_of)
    sizes = []
    for column in columns:
        size = 0.0
        if column.sensor >= 0:
            size = float(np.abs(residual[path.events.sensor == column.sensor]).max(initial=0.0))
        for error in (column.turn, None if column.offset is None else column.offset * unit[:, None]):
            size = max(size, 0.0 if error is None else float(np.abs(error).max(initial=0.0)))
        sizes.append(size)
    return sizes
