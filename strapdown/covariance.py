"""Covariance analysis: predicted errors of a filter on a scenario, with the contribution of each source, without a Monte Carlo.

One pass along the true trajectory. The filter's covariance defines its gains; the actual error, linearised about the truth, is propagated
through the same gains source by source (Maybeck 1979, section 6.8; Gelb 1974, section 7.2):

- white and coloured noise, and the initial error, each contribute a covariance. These add up. For a matched filter the sum is its own P,
  which linearised at the truth is also the posterior Cramér–Rao bound; for a mismatched one they differ, and the expected NEES shows it;
- errors that are the same in every run of the scenario (scale factor, hard iron, residual error of the gyro's integration) each contribute
  a mean error;
- errors outside the scenario may be *considered*: each with a standard deviation and a contribution (:class:`Consider`).

The filter is the one that runs over records (:mod:`strapdown.kernels.filter`), with any error states; reported are attitude and whole bias.
Gates, robust updates and other operations that depend on the data are not included, nor are states for a bias over temperature.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from strapdown import coning, gyro, kinematics, quaternion, scenarios, units, vectors
from strapdown.checks import Array, InputError, count, known_keys, non_negative
from strapdown.estimation import forward
from strapdown.estimation.forward import Problem
from strapdown.estimation.model import Model, assemble
from strapdown.estimation.schedule import Schedule
from strapdown.estimation.setup import (
    FilterSetup,
    initial_state,
    measured_motion,
    modelled_record,
    need_mekf,
    prepared,
    with_sigma,
)
from strapdown.gyro import GyroSpec, flicker
from strapdown.kernels import analysis
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.measurement import Measurements
from strapdown.kernels.walk import walk
from strapdown.randomness import generator
from strapdown.records import ImuRecord
from strapdown.results import ByValue, Column, Listed, Table
from strapdown.scenarios import Scenario
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements

__all__ = ["Analysis", "Consider", "analyse"]

AXES = ("x", "y", "z")

MIN_ERROR = 1e-12
"""Errors of a step or measurement below this are treated as rounding, rad."""
LARGEST_SIZE = 1e12
"""Maximum considered or initial error, in the units of :class:`Consider`; keeps its square in the range of doubles."""
LARGEST_LINEAR = 0.15
"""Errors of attitude or direction above this are reported as beyond linear, rad; their squares are above a tenth of them."""
MIN_NEES, MAX_NEES = 0.9, 1.1
"""Limits of the expected NEES per state of a consistent filter."""


def _size(name: str, value: float, *, unit: str = "") -> float:
    """Return the size of an error, checked to be zero or more and at most :data:`LARGEST_SIZE`."""
    size = non_negative(name, value, unit=unit)
    if size > LARGEST_SIZE:
        raise InputError(
            f"{name} is {size:g}{f' {unit}' if unit else ''}; no error is larger than {LARGEST_SIZE:g}: check its unit"
        )
    return size


@dataclass(frozen=True, kw_only=True, eq=False)
class Consider(ByValue):
    """Errors that neither the scenario nor the filter models: a standard deviation each, independent on every axis.

    Parameters
    ----------
    scale_factor : float, default 0.0
        σ of the gyro's three scale factors, dimensionless.
    misalignment : float, default 0.0
        σ of the six off-diagonal entries of the gyro's error matrix, rad.
    g_sensitivity : float, default 0.0
        σ of the nine entries of the gyro's g-sensitivity, rad/s per m/s².
    sensor_bias : mapping of str to float, default empty
        By sensor, σ of a constant error of each component, body axes, in the unit of the sensor's σ: T for a hard iron, rad for a
        direction.
    mounting : mapping of str to float, default empty
        By sensor, σ of the mounting rotation about each body axis, rad.
    time_offset : mapping of str to float, default empty
        By sensor, σ of the delay of its measurements after their stamps, s.
    """

    scale_factor: float = 0.0
    misalignment: float = 0.0
    g_sensitivity: float = 0.0
    sensor_bias: Mapping[str, float] = field(default_factory=dict)
    mounting: Mapping[str, float] = field(default_factory=dict)
    time_offset: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check every number."""
        _size("scale_factor", self.scale_factor)
        _size("misalignment", self.misalignment, unit="rad")
        _size("g_sensitivity", self.g_sensitivity, unit="rad/s per m/s²")
        for name in ("sensor_bias", "mounting", "time_offset"):
            values = getattr(self, name)
            if not isinstance(values, Mapping):
                raise InputError(f"{name} is {values!r}; give a number for each sensor by its name")
            checked = {str(sensor): _size(f"{name}[{sensor!r}]", value) for sensor, value in values.items()}
            object.__setattr__(self, name, checked)


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis(Listed):
    """Predicted errors of a filter: the error state e = (δθ, δb), rad in the body frame and rad/s.

    Parameters
    ----------
    time : ndarray (m,)
        Epochs, s.
    filter_covariance : ndarray (m, 6, 6)
        P reported by the filter: rad², rad²/s, (rad/s)².
    sources : tuple of str (s,)
        Names of the sources of random error.
    contributions : ndarray (m, s, 6, 6)
        Contribution of each source to the covariance of the actual error: rad², rad²/s, (rad/s)².
    fixed : tuple of str (f,)
        Names of the errors that are the same in every run.
    fixed_errors : ndarray (m, f, 6)
        Mean error due to each of them, rad and rad/s.
    considered : tuple of str (c,)
        Names of the considered errors.
    considered_errors : ndarray (m, c, 6)
        Error due to one standard deviation of each of them, rad and rad/s.
    expected_nis : mapping of str to float
        Mean NIS per degree of freedom over the whole time, by sensor; 1 for a consistent filter.
    left_out : tuple of str
        Errors of the scenario that the analysis does not include.
    beyond_linear : tuple of str
        Errors too large for an analysis linear about the truth, in words; use a Monte Carlo for them.
    """

    _drawn_by = "error_budget"

    time: Array
    filter_covariance: Array
    sources: tuple[str, ...]
    contributions: Array
    fixed: tuple[str, ...]
    fixed_errors: Array
    considered: tuple[str, ...]
    considered_errors: Array
    expected_nis: Mapping[str, float]
    left_out: tuple[str, ...]
    beyond_linear: tuple[str, ...]

    def listing(self) -> Table:
        """Return the error budget at the last epoch as a table, the largest attitude error first, with the expected NEES and NIS."""
        rms, sigma = self.rms[-1], self.filter_sigma[-1]
        unit, size = units.angle_unit([*rms[:3], *sigma[:3]])
        rate_name, rate = units.rate_unit([*rms[3:], *sigma[3:]])
        sources = sorted(self.budget(), key=lambda row: -row[2])
        for name, kind, six in (("actual error", "all", rms), ("the filter's own σ", "", sigma)):
            parts = np.sqrt(np.mean(six.reshape(2, 3) ** 2, axis=1))
            sources.append((name, kind, float(parts[0]), float(parts[1])))
        rows = [
            (name, kind, attitude / size, bias / rate, attitude / units.ARCSECOND, bias / units.DEGREE_PER_HOUR)
            for name, kind, attitude, bias in sources
        ]
        state, attitude, bias = self.expected_nees[-1]
        nis = ", ".join(f"{sensor} {value:.3g}" for sensor, value in self.expected_nis.items())
        notes = [
            "random: squares add. fixed: the same in every run, adds as an error. considered: 1σ of an error that neither the scenario nor "
            "the filter models.",
            f"Expected NEES per state: {state:.3g} (attitude {attitude:.3g}, bias {bias:.3g}); NIS: {nis or 'none'}.",
            self.words,
            *([f"Left out: {', '.join(self.left_out)}."] if self.left_out else []),
            *(f"Beyond linear: {one}; use a Monte Carlo (`strapdown montecarlo`)." for one in self.beyond_linear),
        ]
        columns = (
            Column("source", "source"),
            Column("kind", "kind"),
            Column(f"attitude, {unit}", digits=3),
            Column(f"bias, {rate_name}", digits=3),
            Column(None, "attitude_arcsec"),
            Column(None, "bias_deg_per_hour"),
        )
        title = f"Error budget per axis at {self.time[-1]:.6g} s, RMS"
        return Table(title, columns, rows, notes, left=2, name="budget")

    @property
    def words(self) -> str:
        """Whether the filter will be consistent at the last epoch."""
        _, attitude, bias = self.expected_nees[-1]
        largest = float(max(*self.rms[-1, :3], *self.filter_sigma[-1, :3]))
        if largest > LARGEST_LINEAR:
            return (
                f"With an attitude error of {largest / DEGREE:.3g}° the analysis, linear about the truth, cannot tell whether the filter "
                "will be consistent."
            )
        if (worst := max(attitude, bias)) > MAX_NEES:
            of = "bias" if bias > attitude else "attitude"
            return (
                f"For a unit with exactly the specified constant errors, the filter is optimistic in {of}: √NEES is {np.sqrt(worst):.3g}. "
                "Over units (a Monte Carlo draws them) it may be consistent."
            )
        if min(attitude, bias) < MIN_NEES:
            return "The filter will be pessimistic: its σ will be larger than its errors."
        return "The filter will be consistent."

    @property
    def covariance(self) -> Array:
        """Covariance of the actual error (m, 6, 6), including the considered errors."""
        return np.asarray(
            self.contributions.sum(axis=1) + np.einsum("mci,mcj->mij", self.considered_errors, self.considered_errors)
        )

    @property
    def mean_error(self) -> Array:
        """Mean of the actual error (m, 6)."""
        return np.asarray(self.fixed_errors.sum(axis=1))

    @property
    def second_moment(self) -> Array:
        """E[e eᵀ] of the actual error (m, 6, 6)."""
        mean = self.mean_error
        return np.asarray(self.covariance + mean[:, :, None] * mean[:, None, :])

    @property
    def rms(self) -> Array:
        """Root mean square of the actual error (m, 6): rad, rad/s."""
        return np.sqrt(np.diagonal(self.second_moment, axis1=1, axis2=2))

    @property
    def filter_sigma(self) -> Array:
        """The filter's σ (m, 6): rad, rad/s."""
        return np.sqrt(np.diagonal(self.filter_covariance, axis1=1, axis2=2))

    @property
    def expected_nees(self) -> Array:
        """Mean NEES per state (m, 3) of all six states, of the attitude, of the bias: tr(P⁻¹ E[e eᵀ])/n; 1 for a consistent filter."""
        M, P = self.second_moment, self.filter_covariance
        parts = (slice(0, 6), slice(0, 3), slice(3, 6))
        return np.stack(
            [
                np.trace(np.linalg.solve(P[:, part, part], M[:, part, part]), axis1=1, axis2=2)
                / M[0, part, part].shape[0]
                for part in parts
            ],
            axis=-1,
        )

    @property
    def cramer_rao(self) -> Array:
        """Posterior Cramér–Rao bound (m, 6, 6) of a matched filter's analysis: lower bound of the mean square error of any filter.

        The Riccati recursion along the true trajectory, for small errors (Tichavský, Muravchik & Nehorai, IEEE Trans. Signal Processing
        46(5), 1998). Fixed errors of the scenario (scale factor, hard iron) are treated as known, which can only lower the bound.

        Raises
        ------
        InputError
            If the filter's noise is not that of the scenario, or the scenario's is not white, or the filter has error states, so that the
            bound does not hold.
        """
        P = self.filter_covariance
        sigma = self.filter_sigma
        # If the filter's model of the noise is the true one, the contributions sum to P.
        off = np.abs(self.contributions.sum(axis=1) - P) / (sigma[:, :, None] * sigma[:, None, :])
        if off.max() > 1e-6:
            raise InputError(
                "the filter's noise is not that of the scenario, and the Cramér–Rao bound of attitude and bias assumes white noise and a "
                "random walk of the bias, the same on each axis; analyse a matched filter without error states, and a scenario without "
                "flicker, correlated noise and outliers"
            )
        return P

    def summary(self) -> dict[str, Any]:
        """Return the errors over time and by source as plain values for JSON.

        Returns
        -------
        dict
            Arrays over time as lists, with the unit in each key.
        """
        sizes = np.array([units.ARCSECOND] * 3 + [units.DEGREE_PER_HOUR] * 3)

        def parts(values: Array) -> dict[str, Any]:
            shown = values / sizes
            return {"attitude_arcsec": shown[..., :3].tolist(), "bias_deg_per_hour": shown[..., 3:].tolist()}

        def by_source(names: Sequence[str], values: Array) -> dict[str, Any]:
            return {name: parts(values[:, k]) for k, name in enumerate(names)}

        random = np.sqrt(np.maximum(np.diagonal(self.contributions, axis1=2, axis2=3), 0.0))
        nees = zip(("state", "attitude", "bias"), self.expected_nees.T.tolist(), strict=True)
        return {
            "time_s": self.time.tolist(),
            **{name: parts(getattr(self, name)) for name in ("rms", "filter_sigma", "mean_error")},
            "expected_nees_per_state": dict(nees),
            "expected_nis": dict(self.expected_nis),
            "random": by_source(self.sources, random),
            "fixed": by_source(self.fixed, self.fixed_errors),
            "considered": by_source(self.considered, self.considered_errors),
            "left_out": list(self.left_out),
            "beyond_linear": list(self.beyond_linear),
        }

    def budget(self, epoch: int = -1) -> list[tuple[str, str, float, float]]:
        """Return the error budget at an epoch, one row per source.

        Rows add as squares, except the fixed ones, which add as errors. The axes of a considered error share one row.

        Parameters
        ----------
        epoch : int, default -1
            Index of the epoch.

        Returns
        -------
        list of (str, str, float, float)
            Name, kind ("random", "fixed" or "considered"), RMS error of an attitude axis (rad) and of a bias axis (rad/s).
        """
        rows: dict[tuple[str, str], Array] = {}
        for name, block in zip(self.sources, self.contributions[epoch], strict=True):
            rows[name, "random"] = np.diag(block)
        for name, error in zip(self.fixed, self.fixed_errors[epoch], strict=True):
            rows[name, "fixed"] = error**2
        for name, error in zip(self.considered, self.considered_errors[epoch], strict=True):
            key = (name.partition(",")[0], "considered")
            rows[key] = rows.get(key, np.zeros(6)) + error**2
        return [
            (name, kind, float(np.sqrt(np.mean(squares[:3]))), float(np.sqrt(np.mean(squares[3:]))))
            for (name, kind), squares in rows.items()
        ]


# ------------------------------------------------------------------------------------------------------------- the trajectory


SHIFT = 1e-4
"""Shift of a measurement for the derivative of its residuals by the noise, relative to the reference. They are linear to 1e-8, those of
vectors without error."""


class _Path(NamedTuple):
    """The true trajectory, divided at every gyro edge and measurement, and the filter along it."""

    scenario: Scenario
    problem: Problem
    """The filter over the true rotations between the divisions, with measurements without noise."""
    attitude: Array
    """At the divisions (n + 1, 4)."""
    interval: np.ndarray
    """Gyro interval of each segment between them (n,)."""
    kept: np.ndarray
    """Gyro edges at the epochs."""
    own: tuple[VectorMeasurements, ...]
    """The measurements, without noise, with the σ of their sensors."""

    @property
    def stamps(self) -> Array:
        """Times of the divisions (n + 1,), s."""
        return self.problem.record.time

    @property
    def dt(self) -> Array:
        """Durations of the segments (n,), s."""
        return self.problem.record.intervals

    @property
    def phi(self) -> Array:
        """True rotation vectors over the segments (n, 3), rad."""
        return self.problem.record.increments

    @property
    def events(self) -> Schedule:
        """The measurements in order of time."""
        return self.problem.events

    @property
    def sensors(self) -> Sequence[Any]:
        """Sensors of the scenario."""
        return self.scenario.sensors

    def shifted(self, axis: int, shift: float) -> Schedule:
        """Return the measurements shifted along an axis of their noise: that of a heading pair is in fixed axes, in its reference."""
        events, along = self.events, shift * np.eye(3)[axis]
        values, triads = list(events.series_vector_b), events.triads.copy()
        for i, (kind, sensor) in enumerate(zip(events.kinds, self.sensors, strict=True)):
            first, moves = events.frames[i]
            rows = slice(first, first + (len(events.series_time[i]) if moves else 1))
            if kind == "attitude":
                triads[rows, :4] = quaternion.multiply(triads[rows, :4], quaternion.exp(along))
            elif isinstance(sensor, vectors.HeadingPair):
                triads[rows, 6:8] += along[:2]
            else:
                values[i] = values[i] + along
        return dataclasses.replace(events, series_vector_b=tuple(values), triads=triads)

    def of_events(self, of: Callable[[VectorMeasurements, Any], Array]) -> Array:
        """Return a number or vector of the measurements of each sensor (m, …) in order of time (events, …)."""
        events = self.events
        columns = [of(series, sensor) for series, sensor in zip(self.own, self.sensors, strict=True)]
        out = np.empty((len(events.time), *columns[0].shape[1:]) if columns else 0)
        for i, (series, column) in enumerate(zip(self.own, columns, strict=True)):
            mine = events.sensor == i
            out[mine] = column[np.searchsorted(series.time, events.time[mine])]
        return out


def _exact(sensor: Any) -> Any:
    """Return the sensor without noise."""
    zero = {name: 0.0 for name in ("sigma", "sigma_across", "sigma_about") if hasattr(sensor, name)}
    faults = dataclasses.replace(sensor.faults, correlated_sigma=0.0, outlier_probability=0.0)
    return dataclasses.replace(sensor, **zero, faults=faults)


def _observed(scenario: Scenario) -> list[VectorMeasurements]:
    """Return the measurements of each sensor without noise, with the σ of the sensor."""
    start, end = scenario.edges[0], scenario.edges[-1]
    found = []
    for sensor in scenario.sensors:
        kinds = (
            vectors.VectorSensor,
            vectors.AttitudeSensor,
            vectors.Magnetometer,
            vectors.Accelerometer,
            vectors.HeadingPair,
            vectors.HorizonSensor,
        )
        if not isinstance(sensor, kinds):
            raise InputError(
                f"{sensor.name} is a {type(sensor).__name__}, whose noise the analysis does not support; remove it"
            )
        # The same seed for both, so that the same samples are lost.
        own, exact = (
            one.observe(scenario.motion, start, end, generator(scenario.seed, 0, sensor.name))
            for one in (sensor, _exact(sensor))
        )
        found.append(
            dataclasses.replace(own, vector_b=exact.vector_b, attitude=exact.attitude, reference_f=exact.reference_f)
        )
    return found


def _length(series: VectorMeasurements) -> Array:
    """Return the length (m,) by which the measurements of a series are divided: that of the reference of whole vectors."""
    return np.linalg.norm(series.references_f, axis=1) if series.kind == "vector" else np.ones(len(series.time))


def _unit(series: VectorMeasurements, sensor: Any) -> Array:
    """Return a unit of the sensor along the axes of the noise of each measurement (m,)."""
    sigma = 0.0 if series.attitude is not None else sensor.sigma
    one = np.ones(len(series.time))
    return np.divide(series.sigma / _length(series), sigma, out=one, where=sigma > 0.0)


def _noise(series: VectorMeasurements, sensor: Any) -> Array:
    """Return the covariance of the white noise of each measurement (m, 6) along its axes, with that of outliers."""
    faults = sensor.faults
    more = 1.0 - faults.outlier_probability + faults.outlier_probability * faults.outlier_scale**2
    whole = series.covariances * (more / _length(series) ** 2)[:, None, None]
    return np.asarray(whole[:, *np.triu_indices(3)])


def _path(scenario: Scenario, setup: FilterSetup, epochs: int) -> _Path:
    """Return the trajectory of a scenario with the filter of a setup along it."""
    need_mekf(setup, "the covariance analysis")
    samples = setup.integration.samples
    steps = (len(scenario.edges) - 1) // samples
    if steps < count("epochs", epochs):
        raise InputError(f"{steps} filter steps are fewer than {epochs} epochs; use fewer epochs, or a longer scenario")
    edges = scenario.edges[: steps * samples + 1]  # like the filter, without an incomplete last step
    own = _observed(scenario)
    times = np.concatenate([np.empty(0), *(series.time for series in own)])
    stamps = np.union1d(edges, times[(times >= edges[0]) & (times <= edges[-1])])
    attitude = scenario.motion.attitude(stamps)
    phi = quaternion.log(quaternion.multiply(quaternion.conjugate(attitude[:-1]), attitude[1:]))
    record = with_sigma(ImuRecord(time=stamps, increments=phi, vectors=tuple(own)), setup)
    for series in record.vectors:
        if not np.all(series.sigma > 0.0):
            raise InputError(
                f"{series.sensor}: sigma is 0; a filter needs a noise greater than zero: give the sensor one, or [filter.sigma]"
            )
    states = setup.states
    if states is not None and np.any(states.gyro_temperature_sigma):
        states = dataclasses.replace(states, gyro_temperature_sigma=0.0)
    chosen = dataclasses.replace(setup, states=states)
    problem = prepared(record, chosen, initial_state(setup, attitude[0]))
    problem = dataclasses.replace(problem, model=_model(problem))
    if problem.model.levers.any():
        # The angular acceleration is that of a run: how much it is smoothed depends on the gyro's noise.
        motion = measured_motion(modelled_record(scenarios.simulate(scenario), chosen), chosen)
        problem = dataclasses.replace(problem, motion=motion)
    every = steps // epochs * samples
    return _Path(
        scenario=scenario,
        problem=problem,
        own=tuple(own),
        attitude=attitude,
        interval=np.clip(np.searchsorted(edges, stamps[:-1], side="right") - 1, 0, len(edges) - 2),
        kept=np.arange(0, steps * samples + 1, every),
    )


# ------------------------------------------------------------------------------------------------------------------- errors


_FIXED_PARTS = {
    "scale factor": ("scale_factor",),
    "asymmetry": ("asymmetry",),
    "misalignment": ("misalignment",),
    "g-sensitivity": ("g_sensitivity",),
    "bandwidth": ("bandwidth", "damping"),
    "range": ("range",),
}
"""Errors of a gyro that are the same in every run, by name, and their fields in the specification."""


def _fixed_rates(scenario: Scenario) -> dict[str, Array]:
    """Return the errors of the measured rate that are the same in every run, by name, in each gyro interval (n, 3), rad/s."""
    spec, edges, motion = scenario.gyro, scenario.edges, scenario.motion
    true = motion.increments(edges)
    dt = np.diff(edges)[:, None]
    rates: dict[str, Array] = {}
    for part, fields in _FIXED_PARTS.items():
        kept = {name: getattr(spec, name) for name in fields}
        if all(np.all(np.isinf(value)) or not np.any(value) for name, value in kept.items() if name != "damping"):
            continue
        force = None
        if part == "g-sensitivity":
            force = vectors.specific_force(motion, 0.5 * (edges[1:] + edges[:-1]), gravity_f=scenario.gravity_f)
        random = generator(scenario.seed, 0, "gyro")
        output = gyro.simulate(GyroSpec(**kept), true, edges, random, specific_force=force)
        error = (output.increments - true) / dt
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


def _left_out(scenario: Scenario, setup: FilterSetup) -> tuple[str, ...]:
    spec = scenario.gyro
    names = (
        "quantization",
        "rate_resolution",
        "sampling_jitter",
        "timestamp_error",
        "timestamp_offset",
        "drop_probability",
    )
    found = [f"gyro {name.replace('_', ' ')}" for name in names if np.any(np.asarray(getattr(spec, name)) > 0.0)]
    if spec.temperature is not None:
        found.append("gyro bias over temperature")
    if setup.states is not None and np.any(setup.states.gyro_temperature_sigma):
        found.append("states for the gyro bias over temperature")
    found += [name for name in ("gate", "robust") if getattr(setup, name, None) is not None]
    return tuple(found)


def _beyond_linear(
    attitude_sigma: float, columns: list[_Column], sizes: Sequence[float], consider: Consider
) -> list[str]:
    """Return the errors that are too large for the analysis, in words; ``sizes``: the largest error of a sensor by column, rad."""
    found = []
    if attitude_sigma > LARGEST_LINEAR:
        found.append(f"initial attitude, 1σ {attitude_sigma / DEGREE:.3g}°")
    if consider.scale_factor > LARGEST_LINEAR:
        found.append(f"scale factor, 1σ {100.0 * consider.scale_factor:.3g} %")
    if consider.misalignment > LARGEST_LINEAR:
        found.append(f"misalignment, 1σ {consider.misalignment / DEGREE:.3g}°")
    largest: dict[str, float] = {}
    for column, size in zip(columns, sizes, strict=True):
        name = column.name.partition(",")[0]  # the largest over the axes of a considered error
        largest[name] = max(largest.get(name, 0.0), size)
    return found + [f"{name}, up to {size / DEGREE:.3g}°" for name, size in largest.items() if size > LARGEST_LINEAR]


def _axes(value: Any) -> Array:
    return np.broadcast_to(np.asarray(value, np.float64), 3).copy()


def _diagonal(attitude_sigma: float, bias_sigma: float) -> Array:
    """Return a diagonal covariance of attitude and bias (6, 6)."""
    return np.diag([attitude_sigma**2] * 3 + [bias_sigma**2] * 3)


class _Random:
    """Sources of random error, as the kernel takes them."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.angle: list[Array] = []
        self.rate: list[Array] = []
        self.initial: list[Array] = []
        """Covariance of attitude and bias at the first edge (6, 6)."""
        self.rates: list[tuple[int, Array, Array, Array, Array]] = []
        """Source, amplitude (3,), gains, poles and X g of each coloured bias."""
        self.noises: list[tuple[int, int, float, float]] = []
        """Source, sensor, σ and correlation time of the noise of sensors; zero of white noise."""

    def add(self, name: str, *, angle: Any = 0.0, rate: Any = 0.0, initial: Array | None = None) -> int:
        """Add a source: white densities of angle and bias, or an initial covariance; return its index."""
        self.names.append(name)
        self.angle.append(_axes(angle))
        self.rate.append(_axes(rate))
        self.initial.append(np.zeros((6, 6)) if initial is None else initial)
        return len(self.names) - 1

    def add_gyro(self, spec: GyroSpec, sample_interval: float, samples: int) -> None:
        """Add the noise terms of a gyro."""
        markov, tau = _axes(spec.markov_noise), spec.markov_correlation_time
        walk = _axes(spec.rate_random_walk) ** 2 + (0.0 if np.isfinite(tau) else markov**2)
        if np.any(_axes(spec.angle_random_walk) > 0.0):
            self.add("angle random walk", angle=_axes(spec.angle_random_walk) ** 2)
        if np.any(walk > 0.0):
            self.add("rate random walk", rate=walk)
        instability = _axes(spec.bias_instability)
        if np.any(instability > 0.0):
            shaping = flicker.shaping(samples)
            self._add_rate("flicker", instability, shaping.gains, shaping.poles, shaping.covariance @ shaping.gains)
        if np.isfinite(tau) and np.any(markov > 0.0):
            pole = np.array([np.exp(-sample_interval / tau)])
            self._add_rate("Gauss–Markov bias", markov * np.sqrt(0.5 * tau), np.ones(1), pole, np.ones(1))

    def _add_rate(self, name: str, amplitude: Array, gains: Array, poles: Array, power: Array) -> None:
        source = self.add(name, initial=np.diag([0.0, 0.0, 0.0, *(amplitude**2 * (gains @ power))]))
        self.rates.append((source, amplitude, gains, poles, power))

    def add_sensor(self, number: int, sensor: Any) -> None:
        """Add the noise terms of a sensor."""
        self.noises.append((self.add(sensor.name), number, 0.0, 0.0))
        faults = sensor.faults
        if faults.correlated_sigma > 0.0:
            source = self.add(f"{sensor.name}, correlated")
            self.noises.append((source, number, faults.correlated_sigma, faults.correlation_time))

    def coloured_rates(self, n: int) -> analysis.Rates:
        """Return the coloured biases for the kernel, for n states.

        The filter's initial bias differs by its prior from the *whole* true bias, so its initial bias error contains −f.
        """
        number, most = len(self.rates), max([1, *(len(gains) for _, _, gains, _, _ in self.rates)])
        table = np.zeros((3, number, most))
        amplitudes, cross = np.zeros((number, 3)), np.zeros((number, 3, most, n))
        for c, (_, amplitude, gains, poles, power) in enumerate(self.rates):
            m = len(gains)
            table[:, c, :m] = gains, poles, power
            amplitudes[c] = amplitude
            for a in range(3):
                cross[c, a, :m, 3 + a] = -(amplitude[a] ** 2) * power
        sources = np.array([source for source, *_ in self.rates], np.int64)
        return analysis.Rates(amplitudes, table[0], table[1], table[2], cross, sources)

    def sensor_noises(self, n: int, start: float) -> analysis.Noises:
        """Return the noises of sensors for the kernel, for n states."""
        table, number = np.array(self.noises).reshape(-1, 4), len(self.noises)
        return analysis.Noises(
            sensor=table[:, 1].astype(np.int64),
            sigma=table[:, 2].copy(),
            time=table[:, 3].copy(),
            cross=np.zeros((number, 3, n)),
            source=table[:, 0].astype(np.int64),
            last=np.full(number, start),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Column:
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


def _fixed_columns(scenario: Scenario, setup: FilterSetup, path: _Path) -> list[_Column]:
    """Return the errors that are the same in every run."""
    columns = [_Column(name=name, rate=value[path.interval]) for name, value in _fixed_rates(scenario).items()]
    integration = _integration_rate(scenario, setup, path.stamps, path.attitude, path.phi)
    if np.abs(integration * path.dt[:, None]).max() > MIN_ERROR:
        columns.append(_Column(name=f"integration ({setup.integration.name})", rate=integration))
    if np.any(_axes(scenario.gyro.rate_ramp) != 0.0):
        columns.append(_Column(name="rate ramp", ramp=_axes(scenario.gyro.rate_ramp)))
    return columns + [_Column(name=f"{sensor.name} (fixed)", sensor=i) for i, sensor in enumerate(scenario.sensors)]


def _considered_columns(scenario: Scenario, consider: Consider, path: _Path) -> list[_Column]:
    """Return the considered errors at one standard deviation, one column per independent parameter."""
    unit, axes = np.eye(3), range(3)
    turn_rate = path.phi / path.dt[:, None]
    force = turn_rate
    if consider.g_sensitivity > 0.0:
        middle = 0.5 * (path.stamps[1:] + path.stamps[:-1])
        force = vectors.specific_force(scenario.motion, middle, gravity_f=scenario.gravity_f)
    across = [(i, j) for i in axes for j in axes if i != j]
    entries = (
        *(("scale factor", consider.scale_factor, turn_rate, f"{AXES[i]}", i, i) for i in axes),
        *(("misalignment", consider.misalignment, turn_rate, f"{AXES[i]} of {AXES[j]}", i, j) for i, j in across),
        *(
            ("g-sensitivity", consider.g_sensitivity, force, f"{AXES[i]} of {AXES[j]}", i, j)
            for i in axes
            for j in axes
        ),
    )
    columns = [
        _Column(name=f"{what}, {where}", rate=sigma * driver[:, [j]] * unit[i])
        for what, sigma, driver, where, i, j in entries
        if sigma > 0.0
    ]
    names = [sensor.name for sensor in scenario.sensors]

    def at(name: str) -> Array:
        """Return 1 for the measurements of a sensor (events, 1)."""
        return np.asarray((path.events.sensor == names.index(name))[:, None], np.float64)

    for name, size in consider.sensor_bias.items():
        columns += [_Column(name=f"{name} bias, {AXES[i]}", offset=size * at(name) * unit[i]) for i in axes]
    for name, size in consider.mounting.items():
        columns += [_Column(name=f"{name} mounting, {AXES[i]}", turn=size * at(name) * unit[i]) for i in axes]
    for name, size in consider.time_offset.items():
        late = size * at(name)
        turn = late * scenario.motion.body_rate(path.events.time)
        moving = path.of_events(lambda series, sensor: _moving(series, sensor, scenario))
        columns.append(_Column(name=f"{name} time offset", turn=turn, offset=late * moving))
    return columns


def _moving(series: VectorMeasurements, sensor: Any, scenario: Scenario) -> Array:
    """Return the rate of the reference's direction in the unit of the sensor, body axes (m, 3), 1/s; zero of a heading."""
    if series.reference_f.ndim < 2 or len(series.time) < 2 or series.kind not in ("direction", "vector"):
        return np.zeros((len(series.time), 3))
    direction = series.reference_f / np.linalg.norm(series.reference_f, axis=1, keepdims=True)
    rate = np.gradient(direction, series.time, axis=0)
    back = quaternion.conjugate(scenario.motion.attitude(series.time))
    return np.asarray(quaternion.rotate(back, rate) / _unit(series, sensor)[:, None])


# ------------------------------------------------------------------------------------------------------------------ analysis


def analyse(
    scenario: Scenario | str | os.PathLike[str],
    setup: FilterSetup | None = None,
    *,
    consider: Consider | None = None,
    initial_attitude_sigma: float | None = None,
    initial_bias_sigma: float | None = None,
    epochs: int = 100,
) -> Analysis:
    """Predict the errors of a filter on a scenario, in one pass without noise samples.

    Parameters
    ----------
    scenario : Scenario, str or path
        See :func:`strapdown.scenarios.simulate`.
    setup : FilterSetup, optional
        Filter to analyse, with its error states. Default: matched to the scenario
        (:meth:`strapdown.estimation.setup.FilterSetup.for_scenario`).
    consider : Consider, optional
        Errors in addition to those of the scenario.
    initial_attitude_sigma, initial_bias_sigma : float, optional
        Actual standard deviations of the initial errors, each axis, rad and rad/s. Default: those of the setup.
    epochs : int, default 100
        Number of intervals between the epochs of the result; they end at filter steps, as in :func:`strapdown.montecarlo.run`.

    Returns
    -------
    Analysis
        Covariance reported by the filter, and that of the actual error by source, at every epoch.

    Raises
    ------
    InputError
        If a considered sensor is not in the scenario, a considered time offset exceeds the scenario's duration, or a sensor has a
        user-defined class or no noise.

    References
    ----------
    A. Gelb (ed.), Applied Optimal Estimation, 1974, chapter 7 (suboptimal filters and sensitivity analysis).

    Examples
    --------
    >>> import strapdown as sd
    >>> found = sd.covariance_analysis("two-stars")  # doctest: +SKIP
    >>> print(found)  # doctest: +SKIP
    """
    scenario = scenarios.as_scenario(scenario)
    setup = FilterSetup.for_scenario(scenario) if setup is None else setup
    consider = Consider() if consider is None else consider
    _check_considered(scenario, consider)
    edges = scenario.edges
    attitude_sigma = setup.attitude_sigma if initial_attitude_sigma is None else initial_attitude_sigma
    bias_sigma = setup.bias_sigma if initial_bias_sigma is None else initial_bias_sigma
    _size("initial_attitude_sigma", attitude_sigma, unit="rad")
    _size("initial_bias_sigma", bias_sigma, unit="rad/s")
    path = _path(scenario, setup, epochs)
    random = _Random()
    random.add("initial attitude", initial=_diagonal(attitude_sigma, 0.0))
    random.add("initial bias", initial=_diagonal(0.0, bias_sigma))
    random.add_gyro(scenario.gyro, float(edges[1] - edges[0]), len(edges) - 1)
    for i, sensor in enumerate(scenario.sensors):
        random.add_sensor(i, sensor)
    fixed = _fixed_columns(scenario, setup, path)
    columns = [*fixed, *_considered_columns(scenario, consider, path)]
    out = _propagated(scenario, path, random, columns, len(fixed))
    sizes = _sizes(path, columns, out.residual)
    real = [k for k, column in enumerate(fixed) if column.sensor < 0 or sizes[k] > MIN_ERROR]
    fast = np.zeros((len(out.P), 6, 6))
    if setup.states is not None:
        fast[:] = np.diag([0.0] * 3 + [setup.states.gyro_fast_bias_sigma**2] * 3)
        fast[0] *= -1.0  # the initial bias contains this part, so its error does not
    found = Analysis(
        time=edges[path.kept],
        filter_covariance=out.P[:, 0] + fast,
        sources=tuple(random.names),
        contributions=out.P[:, 1:],
        fixed=tuple(fixed[k].name for k in real),
        fixed_errors=out.columns[:, real],
        considered=tuple(column.name for column in columns[len(fixed) :]),
        considered_errors=out.columns[:, len(fixed) :],
        expected_nis={
            sensor.name: float(total / rows)
            for sensor, (total, rows) in zip(scenario.sensors, out.nis, strict=True)
            if rows > 0.0
        },
        left_out=_left_out(scenario, setup),
        beyond_linear=(),
    )
    beyond = _beyond_linear(attitude_sigma, columns, sizes, consider)
    errors = found.rms[:, :3].max(axis=1)
    epoch = int(np.argmax(errors))
    if errors[epoch] > LARGEST_LINEAR:
        beyond.append(f"the attitude error itself, {errors[epoch] / DEGREE:.3g}° at {found.time[epoch]:.6g} s")
    return dataclasses.replace(found, beyond_linear=tuple(beyond))


def _sizes(path: _Path, columns: Sequence[_Column], residual: Array) -> list[float]:
    """Return the largest error of a measurement by each column, rad; 0 for errors of the gyro."""
    unit = path.of_events(_unit)
    sizes = []
    for column in columns:
        size = 0.0
        if column.sensor >= 0:
            size = float(np.abs(residual[path.events.sensor == column.sensor]).max(initial=0.0))
        for error in (column.turn, None if column.offset is None else column.offset * unit[:, None]):
            size = max(size, 0.0 if error is None else float(np.abs(error).max(initial=0.0)))
        sizes.append(size)
    return sizes


def _check_considered(scenario: Scenario, consider: Consider) -> None:
    """Raise if the scenario cannot have a considered error."""
    names = [sensor.name for sensor in scenario.sensors]
    for part in ("sensor_bias", "mounting", "time_offset"):
        known_keys(f"consider: {part}", getattr(consider, part), names)
    for name in consider.sensor_bias:
        if isinstance(scenario.sensors[names.index(name)], vectors.HeadingPair):
            raise InputError(f"consider: sensor_bias of {name}: a heading pair has none; consider its mounting")
    for name, offset in consider.time_offset.items():
        if offset >= scenario.duration:
            raise InputError(
                f"consider: time_offset of {name} is {offset:g} s, and the scenario lasts {scenario.duration:g} s; "
                "give an offset shorter than the scenario, in seconds"
            )


def _propagated(
    scenario: Scenario, path: _Path, random: _Random, columns: list[_Column], fixed: int
) -> analysis.Outputs:
    """Propagate the covariance of each random source and each deterministic error through the filter's gains."""
    problem, events, kept = path.problem, path.events, len(path.kept)
    kernels = forward.instance_of(problem.model)
    n, W, sources = kernels.N, kernels.W, len(random.names)
    body = forward.filter_body(problem, forward.unit_sigmas(problem.record, problem.model, {}))
    contributions = np.zeros((sources, n, W))
    contributions[:, :6, :6] = random.initial
    # Their arrays must outlive the kernel, which reads them by their addresses.
    shifted = [path.shifted(axis, shift) for axis, shift in itertools.product(range(3), (SHIFT, -SHIFT))]
    out = analysis.Outputs(
        stations=np.searchsorted(path.stamps, scenario.edges[path.kept]),
        P=np.empty((kept, 1 + sources, 6, 6)),
        columns=np.empty((kept, len(columns), 6)),
        residual=np.zeros((len(events.time), 3)),
        nis=np.zeros((len(scenario.sensors), 2)),
    )
    compiled(walk, analysis, kernels)(
        *problem.gyro,
        _measurements(events),
        1,
        analysis.Body(
            filter=body,
            quiet=body.model._replace(angle_variance=0.0, rate_variance=0.0, chains=body.model.chains * [1.0, 0.0]),
            coefficients=np.zeros_like(body.coefficients),
            sources=analysis.Sources(np.array(random.angle), np.array(random.rate), contributions.reshape(sources, -1)),
            rates=random.coloured_rates(n),
            noises=random.sensor_noises(n, path.stamps[0]),
            columns=_for_kernel(path, columns, fixed, n),
            truth=path.attitude,
            begins_sample=np.concatenate([[False], np.diff(path.interval) > 0, [False]]),
            shifted=tuple(map(_measurements, shifted)),
            shift=SHIFT,
            noise=path.of_events(_noise).reshape(-1, 6),
            unit=path.of_events(_unit),
            x=np.zeros(n + 1),
            top=np.zeros(3 * W),
            weights=np.zeros((2, 3, 3)),
            product=np.zeros(n),
            error=np.zeros(n),
        ),
        out,
    )
    return out


def _for_kernel(path: _Path, columns: Sequence[_Column], fixed: int, n: int) -> analysis.Columns:
    """Return the deterministic errors for the kernel, for n states."""
    with_rate = [k for k, column in enumerate(columns) if column.rate is not None]
    place = np.full(len(columns), -1)
    place[with_rate] = np.arange(len(with_rate))
    rate = np.zeros((len(path.dt), len(with_rate), 3))
    turn, offset = np.zeros((2, len(path.events.time), len(columns), 3))
    for k, column in enumerate(columns):
        if column.rate is not None:
            rate[:, place[k]] = column.rate
        if column.turn is not None:
            turn[:, k] = column.turn
        if column.offset is not None:
            offset[:, k] = column.offset
    return analysis.Columns(
        rate=rate,
        place=place,
        ramp=np.array([column.ramp for column in columns]).reshape(-1, 3),
        turn=turn,
        offset=offset,
        sensor=np.array([column.sensor for column in columns], np.int64),
        fixed=fixed,
        value=np.zeros((len(columns), n)),
    )


def _model(problem: Problem) -> Model:
    """Return the model of a filter with a covariance for each measurement."""
    kinds = dict(zip(problem.events.sensors, problem.events.kinds, strict=True))
    return assemble(problem.error_states, kinds, isotropic=False)


def _measurements(events: Schedule) -> Measurements:
    """Return measurements as the kernels' argument, with a covariance for each."""
    noise = np.empty((len(events.time), 6))
    noise[events.row] = events.body_noise
    return events.measurements._replace(noise=read_only(noise))
