"""Covariance analysis: predicted errors of a filter on a scenario, with the contribution of each source, without a Monte Carlo.

One pass along the true trajectory. The filter's covariance defines its gains; the actual error, linearised about the truth, is propagated
through the same gains source by source (Maybeck 1979, section 6.8; Gelb 1974, section 7.2):

- white and coloured noise, and the initial error, each contribute a covariance. These add up. For a matched filter the sum is its own P,
  which linearised at the truth is also the posterior Cramér–Rao bound; for a mismatched one they differ, and the expected NEES shows it;
- errors that are the same in every run of the scenario (scale factor, hard iron, residual error of the gyro's integration) each contribute
  a mean error;
- errors outside the scenario may be *considered*: each with a standard deviation and a contribution (:class:`Consider`).

Gates, robust updates and other operations that depend on the data are not included.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from strapdown import coning, gyro, kinematics, quaternion, scenarios, units, vectors
from strapdown.checks import Array, InputError, count, known_keys, non_negative
from strapdown.estimation.setup import FilterSetup, modelled_record, need_mekf
from strapdown.estimation.states import covariance_matrices
from strapdown.gyro import GyroSpec, flicker
from strapdown.kernels import covariance_loop
from strapdown.kernels.machine import compiled
from strapdown.randomness import generator
from strapdown.records import ImuRecord
from strapdown.results import ByValue, Column, Listed, Table
from strapdown.scenarios import Scenario
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements

__all__ = [
    "Analysis",
    "Consider",
    "analyse",
]

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
            return f"The filter will be optimistic in {of}: its errors will be {np.sqrt(worst):.3g} times its σ."
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
            If the filter's noise is not that of the scenario, or the scenario's is not white, so that the bound does not hold.
        """
        P = self.filter_covariance
        sigma = self.filter_sigma
        # If the filter's model of the noise is the true one, the contributions sum to P.
        off = np.abs(self.contributions.sum(axis=1) - P) / (sigma[:, :, None] * sigma[:, None, :])
        if off.max() > 1e-6:
            raise InputError(
                "the filter's noise is not that of the scenario, and the Cramér–Rao bound of attitude and bias assumes white noise and a "
                "random walk of the bias, the same on each axis; analyse a matched filter, without flicker, correlated noise and outliers"
            )
        return P

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


class _Rows(NamedTuple):
    """Scalar rows of measurements."""

    time: Array
    h: Array
    """Measurement matrix of each row for the attitude error (r, 3)."""
    noise: Array
    """Derivative of each row with respect to the sensor's noise, in the unit of its σ (r, 3)."""
    filter_variance: Array
    variance: Array
    error: Array
    """Innovation at the truth without noise (r,), due to the sensor's fixed errors."""
    moving: Array
    """Change of the row per second of delay, due to the motion of the reference (r,)."""

    @staticmethod
    def of(time: Array, h: Array, noise: Array, *numbers: Array | float) -> _Rows:
        """Return the k rows of each measurement (m, k, 3) in sequence, with the numbers broadcast over them."""
        each = (np.broadcast_to(one, h.shape[:2]).ravel() for one in numbers)
        return _Rows(np.repeat(time, h.shape[1]), h.reshape(-1, 3), noise.reshape(-1, 3), *each)


def _exact(sensor: Any) -> Any:
    """Return the sensor without noise."""
    zero = {name: 0.0 for name in ("sigma", "sigma_across", "sigma_about") if hasattr(sensor, name)}
    faults = dataclasses.replace(sensor.faults, correlated_sigma=0.0, outlier_probability=0.0)
    return dataclasses.replace(sensor, **zero, faults=faults)


def _rows(
    sensor: Any, exact: VectorMeasurements, own: VectorMeasurements, held: VectorMeasurements, motion: Any
) -> _Rows:
    """Return the rows of a series: ``exact`` without noise, ``own`` with the sensor's σ, ``held`` with that of the filter."""
    time = exact.time
    m = len(time)
    attitude = np.asarray(motion.attitude(time)).reshape(m, 4)
    faults = sensor.faults
    more = 1.0 - faults.outlier_probability + faults.outlier_probability * faults.outlier_scale**2
    if own.attitude is not None:
        if own.covariance is not None:
            raise InputError(
                f"{own.sensor}: noise correlated between body axes is not supported; point the boresight of the sensor along one"
            )
        assert own.sigma_axes is not None
        assert held.sigma_axes is not None
        assert exact.attitude is not None
        h = noise = np.broadcast_to(np.eye(3), (m, 3, 3))
        variance, filter_variance = own.sigma_axes**2, held.sigma_axes**2
        error = quaternion.log(quaternion.multiply(quaternion.conjugate(attitude), exact.attitude)).reshape(m, 3)
        return _Rows.of(time, h, noise, filter_variance, variance * more, error, 0.0)
    R = quaternion.to_matrix(attitude)
    reference = np.array(exact.references_f)
    length = np.linalg.norm(reference, axis=1) if own.kind == "vector" else np.ones(m)
    sigma, filter_sigma = own.sigma / length, held.sigma / length
    scale = np.divide(sigma, sensor.sigma, out=np.zeros(m), where=sensor.sigma > 0.0)
    if own.kind == "heading":
        z_f = np.einsum("mij,mj->mi", R, exact.vector_b)
        level = np.hypot(z_f[:, 0], z_f[:, 1])
        tilt = -z_f[:, 2] / level**2
        h = np.einsum("mij,mi->mj", R, np.stack([tilt * z_f[:, 0], tilt * z_f[:, 1], np.ones(m)], axis=1))[:, None]
        across = np.stack([z_f[:, 1], -z_f[:, 0], np.zeros(m)], axis=1) / level[:, None]
        # The noise of a heading pair is that of its baseline, in the fixed frame.
        own_axes = -across if isinstance(sensor, vectors.HeadingPair) else np.einsum("mij,mi->mj", R, across)
        noise = own_axes[:, None]
        cosine = z_f[:, 0] * reference[:, 0] + z_f[:, 1] * reference[:, 1]
        error = np.arctan2(z_f[:, 0] * reference[:, 1] - z_f[:, 1] * reference[:, 0], cosine)[:, None]
        noise = noise * scale[:, None, None]
        return _Rows.of(time, h, noise, filter_sigma[:, None] ** 2, sigma[:, None] ** 2 * more, error, 0.0)
    frame = np.broadcast_to(vectors.triad(reference), (m, 3, 3))
    basis = frame @ R
    h = np.stack([-basis[:, 1], basis[:, 0]], axis=1)
    z = exact.vector_b / length[:, None]
    error = np.einsum("mij,mj->mi", basis[:, :2], z)
    moving: Array | float = 0.0
    if m > 1 and exact.reference_f.ndim == 2:
        unit = reference / np.linalg.norm(reference, axis=1, keepdims=True)
        moving = np.einsum("mij,mj->mi", frame[:, :2], np.gradient(unit, time, axis=0))
    noise = basis[:, :2] * scale[:, None, None]
    return _Rows.of(time, h, noise, filter_sigma[:, None] ** 2, sigma[:, None] ** 2 * more, error, moving)


def _all_rows(scenario: Scenario, setup: FilterSetup) -> list[_Rows]:
    start, end = scenario.edges[0], scenario.edges[-1]
    exact: list[VectorMeasurements] = []
    own: list[VectorMeasurements] = []
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
        # The same seed for each, so that the same samples are lost.
        for one, found in ((sensor, own), (_exact(sensor), exact)):
            found.append(one.observe(scenario.motion, start, end, generator(scenario.seed, 0, sensor.name)))
    step = dataclasses.replace(setup, integration=coning.ALGORITHMS["one-sample"])
    record = ImuRecord(time=np.array([start, end]), increments=np.zeros((1, 3)), vectors=tuple(own))
    held = modelled_record(record, step).vectors
    for series in held:
        if series.anisotropic:
            raise InputError(
                f"{series.sensor}: the analysis takes one sigma for a {series.kind}, not one per axis; give one number in [filter.sigma]"
            )
        if not np.all(series.sigma > 0.0):
            raise InputError(
                f"{series.sensor}: sigma is 0; a filter needs a noise greater than zero: give the sensor one, or [filter.sigma]"
            )
    return [_rows(s, e, o, b, scenario.motion) for s, e, o, b in zip(scenario.sensors, exact, own, held, strict=True)]


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
    need_mekf(setup, "the covariance analysis")
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
    found += [name for name in ("gate", "robust", "states") if getattr(setup, name, None) is not None]
    return tuple(found)


def _beyond_linear(attitude_sigma: float, columns: list[_Column], consider: Consider) -> list[str]:
    """Return the errors that are too large for the analysis, in words."""
    found = []
    if attitude_sigma > LARGEST_LINEAR:
        found.append(f"initial attitude, 1σ {attitude_sigma / DEGREE:.3g}°")
    if consider.scale_factor > LARGEST_LINEAR:
        found.append(f"scale factor, 1σ {100.0 * consider.scale_factor:.3g} %")
    if consider.misalignment > LARGEST_LINEAR:
        found.append(f"misalignment, 1σ {consider.misalignment / DEGREE:.3g}°")
    largest: dict[str, float] = {}
    for column in columns:
        if column.rows is not None:
            name = column.name.partition(",")[0]  # the largest over the axes of a considered error
            largest[name] = max(largest.get(name, 0.0), float(np.abs(column.rows).max(initial=0.0)))
    return found + [f"{name}, up to {size / DEGREE:.3g}°" for name, size in largest.items() if size > LARGEST_LINEAR]


def _axes(value: Any) -> Array:
    return np.broadcast_to(np.asarray(value, np.float64), 3).copy()


def _diagonal(attitude_sigma: float, bias_sigma: float) -> Array:
    """Return the 21 numbers of a diagonal covariance."""
    block = np.zeros(21)
    block[[0, 3, 5]] = attitude_sigma**2
    block[[15, 18, 20]] = bias_sigma**2
    return block


class _Path(NamedTuple):
    """The trajectory divided at every gyro edge and measurement, and the rows of all sensors in order of time."""

    stamps: Array
    """Times of the divisions (n + 1,), s."""
    attitude: Array
    dt: Array
    """Durations of the segments (n,), s."""
    phi: Array
    """True rotation vectors over the segments (n, 3), rad."""
    interval: np.ndarray
    """Gyro interval of each segment (n,)."""
    rows: _Rows
    sensor: np.ndarray
    """Index of the sensor of each row."""
    kept: np.ndarray
    """Gyro edges at the epochs."""


def _path(scenario: Scenario, setup: FilterSetup, epochs: int) -> _Path:
    steps = (len(scenario.edges) - 1) // setup.integration.samples
    if steps < count("epochs", epochs):
        raise InputError(f"{steps} filter steps are fewer than {epochs} epochs; use fewer epochs, or a longer scenario")
    edges = scenario.edges[: steps * setup.integration.samples + 1]  # like the filter, without an incomplete last step
    parts = _all_rows(scenario, setup)
    none = _Rows(np.empty(0), *np.empty((2, 0, 3)), *np.empty((4, 0)))
    joined = [np.concatenate(part) for part in zip(none, *parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")[: np.sum(joined[0] <= edges[-1])]
    rows = _Rows(*(np.ascontiguousarray(part[order]) for part in joined))
    stamps = np.union1d(edges, rows.time)
    attitude = scenario.motion.attitude(stamps)
    every = steps // epochs * setup.integration.samples
    return _Path(
        stamps=stamps,
        attitude=attitude,
        dt=np.diff(stamps),
        phi=quaternion.log(quaternion.multiply(quaternion.conjugate(attitude[:-1]), attitude[1:])),
        interval=np.clip(np.searchsorted(edges, stamps[:-1], side="right") - 1, 0, len(edges) - 2),
        rows=rows,
        sensor=np.repeat(np.arange(len(parts)), [len(part.time) for part in parts])[order],
        kept=np.arange(0, steps * setup.integration.samples + 1, every),
    )


class _Random:
    """Sources of random error, as the kernel takes them; the filter's model is the first."""

    def __init__(self, setup: FilterSetup) -> None:
        noise = setup.process_noise
        self.names = ["filter"]
        self.angle = [np.full(3, noise.angle_random_walk**2)]
        self.rate = [np.full(3, noise.rate_random_walk**2)]
        self.sensor = [-2]
        self.blocks = [_diagonal(setup.attitude_sigma, setup.bias_sigma)]
        self.shapes: list[tuple[int, Array, Array, Array, Array]] = []
        """Source, amplitude (3,), gains, poles and X g of each coloured bias."""
        self.coloured: list[tuple[int, int, float, float]] = []
        """Source, sensor, σ and correlation time of each coloured noise."""

    def add(self, name: str, *, angle: Any = 0.0, rate: Any = 0.0, sensor: int = -1, block: Array | None = None) -> int:
        """Add a source: white densities of angle and bias, or the noise of a sensor, or an initial covariance."""
        self.names.append(name)
        self.angle.append(_axes(angle))
        self.rate.append(_axes(rate))
        self.sensor.append(sensor)
        self.blocks.append(np.zeros(21) if block is None else block)
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
            projected = shaping.covariance @ shaping.gains
            self.shapes.append((self.add("flicker"), instability, shaping.gains, shaping.poles, projected))
        if np.isfinite(tau) and np.any(markov > 0.0):
            pole = np.array([np.exp(-sample_interval / tau)])
            self.shapes.append(
                (self.add("Gauss–Markov bias"), markov * np.sqrt(0.5 * tau), np.ones(1), pole, np.ones(1))
            )

    def add_sensor(self, number: int, sensor: Any) -> None:
        """Add the noise terms of a sensor."""
        self.add(sensor.name, sensor=number)
        faults = sensor.faults
        if faults.correlated_sigma > 0.0:
            source = self.add(f"{sensor.name}, correlated")
            self.coloured.append((source, number, faults.correlated_sigma, faults.correlation_time))

    def shaping(self) -> covariance_loop.Shapes:
        """Return the coloured biases for the kernel, and give their sources the initial covariance.

        The filter's initial bias differs by its prior from the *whole* true bias, so its initial bias error contains −f.
        """
        number, most = len(self.shapes), max([1, *(len(gains) for _, _, gains, _, _ in self.shapes)])
        table = np.zeros((3, number, most))
        amplitudes, cross = np.zeros((number, 3)), np.zeros((number, 6, 3, most))
        for c, (source, amplitude, gains, poles, projected) in enumerate(self.shapes):
            n = len(gains)
            table[:, c, :n] = gains, poles, projected
            amplitudes[c] = amplitude
            for a in range(3):
                cross[c, 3 + a, a, :n] = -(amplitude[a] ** 2) * projected
            self.blocks[source][[15, 18, 20]] = amplitude**2 * (gains @ projected)
        sources = np.array([source for source, *_ in self.shapes], np.int64)
        return covariance_loop.Shapes(amplitudes, table[0], table[1], table[2], cross, sources)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Column:
    """A deterministic error: a rate error in each segment (n, 3), an error in each row (r,), a rate ramp (3,)."""

    name: str
    rate: Array | None = None
    rows: Array | None = None
    ramp: Array = field(default_factory=lambda: np.zeros(3))


def _fixed_columns(scenario: Scenario, setup: FilterSetup, path: _Path) -> list[_Column]:
    """Return the errors that are the same in every run."""
    columns = [_Column(name=name, rate=value[path.interval]) for name, value in _fixed_rates(scenario).items()]
    integration = _integration_rate(scenario, setup, path.stamps, path.attitude, path.phi)
    if np.abs(integration * path.dt[:, None]).max() > MIN_ERROR:
        columns.append(_Column(name=f"integration ({setup.integration.name})", rate=integration))
    if np.any(_axes(scenario.gyro.rate_ramp) != 0.0):
        columns.append(_Column(name="rate ramp", ramp=_axes(scenario.gyro.rate_ramp)))
    for i, sensor in enumerate(scenario.sensors):
        mine = np.where(path.sensor == i, path.rows.error, 0.0)
        if np.abs(mine).max(initial=0.0) > MIN_ERROR:
            columns.append(_Column(name=f"{sensor.name} (fixed)", rows=mine))
    return columns


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
    names, rows = [sensor.name for sensor in scenario.sensors], path.rows

    def of_sensor(name: str, what: str, error: Array) -> _Column:
        return _Column(name=f"{name} {what}", rows=np.where(path.sensor == names.index(name), error, 0.0))

    for what, of_axis, sizes in (("bias", rows.noise, consider.sensor_bias), ("mounting", rows.h, consider.mounting)):
        for name, size in sizes.items():
            columns += [of_sensor(name, f"{what}, {AXES[i]}", size * of_axis[:, i]) for i in axes]
    for name, size in consider.time_offset.items():
        late = np.einsum("ri,ri->r", rows.h, scenario.motion.body_rate(rows.time)) + rows.moving
        columns.append(of_sensor(name, "time offset", size * late))
    return columns


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
        Filter to analyse. Default: matched to the scenario (:meth:`strapdown.estimation.setup.FilterSetup.for_scenario`).
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
    scenario = scenarios.chosen(scenario)
    setup = FilterSetup.for_scenario(scenario, states=False) if setup is None else setup
    consider = Consider() if consider is None else consider
    _check_considered(scenario, consider)
    edges = scenario.edges
    attitude_sigma = setup.attitude_sigma if initial_attitude_sigma is None else initial_attitude_sigma
    bias_sigma = setup.bias_sigma if initial_bias_sigma is None else initial_bias_sigma
    _size("initial_attitude_sigma", attitude_sigma, unit="rad")
    _size("initial_bias_sigma", bias_sigma, unit="rad/s")
    path = _path(scenario, setup, epochs)
    random = _Random(setup)
    random.add("initial attitude", block=_diagonal(attitude_sigma, 0.0))
    random.add("initial bias", block=_diagonal(0.0, bias_sigma))
    random.add_gyro(scenario.gyro, float(edges[1] - edges[0]), len(edges) - 1)
    for i, sensor in enumerate(scenario.sensors):
        random.add_sensor(i, sensor)
    fixed = _fixed_columns(scenario, setup, path)
    columns = [*fixed, *_considered_columns(scenario, consider, path)]
    out = _propagated(path, edges, random, columns, len(fixed), len(scenario.sensors))
    whole = covariance_matrices(out.blocks)
    found = Analysis(
        time=edges[path.kept],
        filter_covariance=whole[:, 0],
        sources=tuple(random.names[1:]),
        contributions=whole[:, 1:],
        fixed=tuple(column.name for column in fixed),
        fixed_errors=out.columns[:, : len(fixed)],
        considered=tuple(column.name for column in columns[len(fixed) :]),
        considered_errors=out.columns[:, len(fixed) :],
        expected_nis={
            sensor.name: float(total / seen)
            for sensor, (total, seen) in zip(scenario.sensors, out.nis, strict=True)
            if seen > 0.0
        },
        left_out=_left_out(scenario, setup),
        beyond_linear=(),
    )
    beyond = _beyond_linear(attitude_sigma, columns, consider)
    errors = found.rms[:, :3].max(axis=1)
    epoch = int(np.argmax(errors))
    if errors[epoch] > LARGEST_LINEAR:
        beyond.append(f"the attitude error itself, {errors[epoch] / DEGREE:.3g}° at {found.time[epoch]:.6g} s")
    return dataclasses.replace(found, beyond_linear=tuple(beyond))


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
    path: _Path, edges: Array, random: _Random, columns: list[_Column], fixed: int, sensors: int
) -> covariance_loop.Outputs:
    """Propagate the covariance of each random source and each deterministic error through the filter's gains."""
    rows, coloured = path.rows, random.coloured
    with_rate = [k for k, column in enumerate(columns) if column.rate is not None]
    place = np.full(len(columns), -1)
    place[with_rate] = np.arange(len(with_rate))
    column_rate = np.zeros((len(path.dt), len(with_rate), 3))
    row_error = np.zeros((len(rows.time), len(columns)))
    for k, column in enumerate(columns):
        if column.rate is not None:
            column_rate[:, place[k]] = column.rate
        if column.rows is not None:
            row_error[:, k] = column.rows

    stations = np.searchsorted(path.stamps, edges[path.kept])
    shapes = random.shaping()  # must precede reading of the blocks
    new_sample = np.concatenate([[False], np.diff(path.interval) > 0])
    row_bounds = np.append(np.searchsorted(rows.time, path.stamps, side="left"), len(rows.time))
    out = covariance_loop.Outputs(
        stations=stations,
        blocks=np.empty((len(stations), len(random.names), 21)),
        columns=np.empty((len(stations), len(columns), 6)),
        nis=np.zeros((sensors, 2)),
    )
    compiled(covariance_loop.run_covariance)(
        covariance_loop.Path(path.dt, np.ascontiguousarray(path.phi), new_sample, row_bounds),
        covariance_loop.Rows(
            rows.h, rows.noise, rows.filter_variance, rows.variance, path.sensor, rows.time, row_error
        ),
        covariance_loop.White(*(np.array(of) for of in (random.angle, random.rate, random.sensor, random.blocks))),
        shapes,
        covariance_loop.Coloured(
            sensor=np.array([number for _, number, _, _ in coloured], np.int64),
            sigma=np.array([sigma for _, _, sigma, _ in coloured], np.float64),
            time=np.array([tau for *_, tau in coloured], np.float64),
            cross=np.zeros((len(coloured), 6, 3)),
            source=np.array([source for source, *_ in coloured], np.int64),
            seen=np.full(len(coloured), path.stamps[0]),
        ),
        covariance_loop.Columns(
            rate=column_rate,
            place=place,
            ramp=np.array([column.ramp for column in columns]).reshape(-1, 3),
            fixed=fixed,
            value=np.zeros((len(columns), 6)),
        ),
        out,
    )
    return out
