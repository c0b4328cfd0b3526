"""Vector sensors: body-frame measurements of vectors known in the fixed frame, ``q⁻¹ r q + v``, or of the attitude itself.

Every sensor has its own rate, phase and :class:`Faults` (latency, outages, outliers, correlated noise), and returns a series of
:class:`VectorMeasurements`. The series has the *nominal* noise only: outliers, correlation, hard iron and acceleration are not
disclosed to the filter.

Noise of a normalised vector
----------------------------
A direction is a noisy vector divided by its length. With noise σ per component, relative to the length, the variance across the
direction is σ²(1 − σ² − σ⁴ − …), exactly ``σ² [1 − √2 σ D(1/(√2 σ))]`` with Dawson's function D, and the mean of the measured
component along the direction is about 1 − σ². Filters assume σ² and 1. The NIS of a correct filter is therefore too small by a fraction
of about σ²: 0.25 % at σ = 0.05 rad, 1 % at 0.1 rad, 4.2 % at 0.2 rad, 10 % at 0.3 rad. If that matters (``σ`` above 0.1 rad), give the
whole vector (kind ``"vector"``), whose noise is the same in all components.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import (
    ROUNDING,
    Array,
    InputError,
    array,
    finite,
    increasing,
    instance,
    non_negative,
    numbers,
    one_of,
    positive,
    unit_quaternions,
)
from strapdown.kernels import gyro_errors
from strapdown.kernels.machine import compiled
from strapdown.results import ByValue
from strapdown.units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from strapdown.motion import Motion
    from strapdown.motion.orbit import CircularOrbit

Kind = Literal["direction", "heading", "vector", "attitude"]
KINDS: dict[str, int] = {"direction": 2, "heading": 1, "vector": 3, "attitude": 3}
"""Kinds of measurement and their degrees of freedom: direction, both components across it; heading, only the rotation of the vector's
horizontal part about the fixed z axis; vector, all three components; attitude, the whole rotation."""

GRAVITY_F = (0.0, 0.0, -STANDARD_GRAVITY)
"""Acceleration of gravity if the fixed z axis points up, m/s²."""

Attitude = Callable[[Array], Array]
VectorField = Callable[[Array], Array]
"""A fixed-frame vector as a function of time: (m,), s, to (m, 3)."""


class Sensor(Protocol):
    """A sensor of a scenario."""

    @property
    def name(self) -> str:
        """Name of the sensor and of its stream of random numbers."""

    def observe(self, motion: Any, start: float, end: float, generator: np.random.Generator) -> VectorMeasurements:
        """Return the measurements of a moving body.

        Parameters
        ----------
        motion : Motion or callable
            Motion of the body, or its attitude q_fb (..., 4) as a function of time, s; an accelerometer needs a motion.
        start, end : float
            Interval (start, end], s.
        generator : numpy.random.Generator
            Random stream of the sensor.

        Returns
        -------
        VectorMeasurements
            The series.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class VectorMeasurements:
    """A series of measurements of one sensor.

    A sample with a NaN in ``vector_b``, or in ``attitude``, is missing: filters skip and count it. Its other entries may be NaN too; they
    are then replaced (σ and covariance by the mean square of the others, the reference by another one, the arrival by the time), so that
    results computed over the series are not affected.

    Arrays of floats are kept without a copy: pass a copy if the buffer is written to afterwards.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    kind : {"direction", "heading", "vector", "attitude"}
        Kind of measurement; see :data:`KINDS`.
    time : ndarray (m,)
        Times of measurement, s, increasing.
    reference_f : ndarray (3,) or (m, 3), default (0, 0, 1)
        Reference in the fixed frame: a unit direction; for kind ``"vector"`` with its length. Not used for kind ``"attitude"``.
    vector_b : ndarray (m, 3), default empty
        Measured vectors, body frame, of unit length except for kind ``"vector"``. NaN for kind ``"attitude"``, which has none.
    sigma : float or ndarray (m,), default 0
        Standard deviation of the noise of each component: rad across a direction, the unit of a vector, rad about each body axis of an
        attitude. If ``sigma_axes`` or ``covariance`` is given, their root mean square.
    attitude : ndarray (m, 4), optional
        Measured q_fb for kind ``"attitude"``, with the error on the body side.
    sigma_axes : ndarray (3,) or (m, 3), optional
        Standard deviation along each body axis, in the unit of sigma. For a direction only the part across it is used. A series of
        kind ``"attitude"`` always has it.
    covariance : ndarray (3, 3) or (m, 3, 3), optional
        Covariance of the noise in body axes, the unit of sigma squared. For a direction only the part across it is used; not for a
        heading.
    arrival : ndarray (m,), optional
        Time of arrival of each sample, s, not before its time; None: without delay.
    """

    sensor: str
    kind: Kind
    time: Array
    reference_f: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    vector_b: Array = field(default_factory=lambda: np.empty((0, 3)))
    sigma: Array = field(default_factory=lambda: np.zeros(1))
    attitude: Array | None = None
    sigma_axes: Array | None = None
    covariance: Array | None = None
    arrival: Array | None = None

    def __post_init__(self) -> None:
        """Check every field."""
        instance("sensor", self.sensor, str, "give the series the name of its sensor")
        one_of(f"{self.sensor}: kind", self.kind, KINDS)
        time = increasing(f"{self.sensor}: time", self.time, minimum=0)
        m = len(time)
        store: dict[str, Any] = {"time": time}
        if self.kind == "attitude":
            if self.attitude is None:
                raise InputError(f"{self.sensor}: a series of kind 'attitude' needs attitude (m, 4)")
            name = f"{self.sensor}: attitude"
            given = array(name, self.attitude, (m, 4), allow_nan=True)
            missing = _missing(given)
            if missing.any():
                whole = unit_quaternions(name, np.where(missing[:, None], quaternion.IDENTITY, given))
                store["attitude"] = np.where(missing[:, None], given, whole)
            else:
                store["attitude"] = unit_quaternions(name, given)
            store["vector_b"] = np.full((m, 3), np.nan)
        else:
            if self.attitude is not None:
                raise InputError(f"{self.sensor}: attitude belongs to kind 'attitude', not {self.kind!r}")
            vector = array(f"{self.sensor}: vector_b", self.vector_b, (m, 3), allow_nan=True)
            if self.kind != "vector":
                need_unit(f"{self.sensor}: vector_b", vector)
            missing = _missing(vector)
            store["vector_b"] = vector
        store.update(self._noise(m, missing))
        store["reference_f"] = self._reference(m, missing)
        if self.arrival is not None:
            arrival = array(f"{self.sensor}: arrival", self.arrival, (m,), allow_nan=True)
            arrival = _of_known(f"{self.sensor}: arrival", arrival, missing, time)
            if np.any(arrival < time):
                k = int(np.argmax(arrival < time))
                raise InputError(f"{self.sensor}: arrival[{k}] is {arrival[k]:.9g} s, before its time {time[k]:.9g} s")
            store["arrival"] = arrival
        for name, value in store.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_headings(
        cls,
        sensor: str,
        time: ArrayLike,
        heading: ArrayLike,
        sigma: ArrayLike,
        *,
        axis_b: ArrayLike = (1.0, 0.0, 0.0),
    ) -> VectorMeasurements:
        """Return measured headings of a body axis, such as those of a two-antenna receiver or a gyrocompass.

        Parameters
        ----------
        sensor : str
            Name of the sensor.
        time : array_like (m,)
            Times of measurement, s, increasing.
        heading : array_like (m,)
            Angle of the horizontal part of the axis about fixed z, from fixed x, right-handed, rad: in north-east-down axes the compass
            heading, in east-north-up axes π/2 minus it. NaN: missing.
        sigma : float or array_like (m,)
            Standard deviation of the heading, rad.
        axis_b : array_like (3,), default (1.0, 0.0, 0.0)
            The axis, body frame.

        Returns
        -------
        VectorMeasurements
            A series of kind ``"heading"``: the axis is known in the body, and its direction in the fixed frame is measured.

        Examples
        --------
        >>> VectorMeasurements.from_headings("gnss", [0.0, 1.0], [0.0, 0.1], 0.01).kind
        'heading'
        """
        angle = array(f"{sensor}: heading", heading, ("m",), allow_nan=True)
        missing = np.isnan(angle)
        axis = np.where(missing[:, None], np.nan, _direction(f"{sensor}: axis_b", axis_b))
        known = np.where(missing, 0.0, angle)
        level = np.stack([np.cos(known), np.sin(known), np.zeros(len(known))], axis=1)
        return cls(sensor=sensor, kind="heading", time=time, vector_b=axis, reference_f=level, sigma=sigma)  # type: ignore[arg-type]

    def _noise(self, m: int, missing: np.ndarray) -> dict[str, Array]:
        """Return sigma (m,), and sigma_axes (m, 3) and covariance (m, 3, 3) if they are given."""
        found: dict[str, Array] = {}
        axes: Array | None = None
        if self.kind == "heading" and not (self.sigma_axes is None and self.covariance is None):
            raise InputError(f"{self.sensor}: a heading has one sigma; sigma_axes and covariance belong to other kinds")
        if self.sigma_axes is not None:
            given = self._repeated("sigma_axes", (m, 3), "one number per body axis (3,), or (m, 3)")
            axes = _of_known(f"{self.sensor}: sigma_axes", given, missing, _root_mean_square)
            if np.any(axes < 0.0):
                raise InputError(f"{self.sensor}: sigma_axes has a negative entry; give standard deviations")
            found["sigma_axes"] = axes
        known: Any = ~missing if missing.any() else slice(None)
        if self.covariance is not None:
            found["covariance"] = whole = _covariances(f"{self.sensor}: covariance", self.covariance, m, missing)
            diagonal = np.sqrt(np.einsum("kii->ki", whole))
            if axes is not None and not np.allclose(axes[known], diagonal[known], rtol=1e-12, atol=0.0):
                raise InputError(f"{self.sensor}: sigma_axes and covariance contradict each other; give one of them")
            axes = diagonal
            if self.kind == "attitude":
                found["sigma_axes"] = axes
        by_axis = "" if self.kind == "heading" else ", and one per body axis as sigma_axes"
        given = self._repeated("sigma", (m,), f"one number, or one per sample{by_axis}")
        given_sigma = np.any(numbers("sigma", self.sigma, allow_nan=True) != 0.0)  # for an empty series too
        if axes is None and self.kind == "attitude" and not given_sigma:
            raise InputError(
                f"{self.sensor}: a series of kind 'attitude' needs its noise: sigma (m,), sigma_axes (m, 3) or covariance (m, 3, 3)"
            )
        sigma = _of_known(f"{self.sensor}: sigma", given, missing, _root_mean_square)
        if np.any(sigma < 0.0):
            k = int(np.argmax(sigma < 0.0))
            raise InputError(f"{self.sensor}: sigma[{k}] is {sigma[k]:g}; it must not be negative")
        vanishing = (sigma > 0.0) & (sigma**2 < np.finfo(np.float64).tiny)
        if vanishing.any():
            k = int(np.argmax(vanishing))
            raise InputError(f"{self.sensor}: sigma[{k}] is {sigma[k]:g}, and its square underflows; check its unit")
        if axes is not None:
            mean = np.sqrt(np.mean(axes**2, axis=1))
            if (
                self.kind != "attitude"
                and given_sigma
                and not np.allclose(sigma[known], mean[known], rtol=1e-12, atol=0.0)
            ):
                raise InputError(
                    f"{self.sensor}: sigma contradicts sigma_axes or covariance; leave it out, it is their root mean square"
                )
            sigma = mean
        elif self.kind == "attitude":
            found["sigma_axes"] = np.repeat(sigma[:, None], 3, axis=1)
        found["sigma"] = sigma
        return found

    def _repeated(self, field: str, shape: tuple[int, ...], remedy: str) -> Array:
        """Return the numbers of a field for each sample, of this shape; those for one sample are repeated."""
        name = f"{self.sensor}: {field}"
        given = numbers(name, getattr(self, field), allow_nan=True)
        if given.shape not in ((), shape[1:], (1, *shape[1:]), shape):
            raise InputError(f"{name} has shape {given.shape} for {shape[0]} samples; give {remedy}")
        return array(name, np.broadcast_to(given, shape), shape, allow_nan=True)

    def _reference(self, m: int, missing: np.ndarray) -> Array:
        name = f"{self.sensor}: reference_f"
        reference = numbers(name, self.reference_f)
        if reference.ndim == 2:
            reference = _of_known(name, array(name, reference, (m, 3), allow_nan=True), missing, _first_or_level)
            if self.kind != "vector":
                length = np.linalg.norm(reference, axis=1, keepdims=True)
                if np.any(length == 0.0):
                    raise InputError(f"{name}[{int(np.argmin(length))}] is the zero vector, which has no direction")
                reference = np.where(np.abs(length - 1.0) <= ROUNDING, reference, reference / length)
        else:
            reference = array(name, reference, (3,)) if self.kind == "vector" else _direction(name, reference)
        if self.kind == "heading":
            need_level(name, reference)
        return reference

    @property
    def references_f(self) -> Array:
        """Reference of every sample (m, 3), fixed frame."""
        return np.broadcast_to(self.reference_f, (len(self.time), 3))

    def taken(self, which: Any) -> VectorMeasurements:
        """Return the samples that an index selects, with their noise, references and arrival times.

        Parameters
        ----------
        which : ndarray or slice
            Mask (m,), slice or array of indices.

        Returns
        -------
        VectorMeasurements
            The selected samples.
        """
        names = ("time", "sigma", "sigma_axes", "covariance", "attitude", "arrival")
        rows = {name: getattr(self, name) for name in names}
        changed = {name: value[which] for name, value in rows.items() if value is not None}
        if self.kind != "attitude":
            changed["vector_b"] = self.vector_b[which]
        if self.reference_f.ndim == 2:
            changed["reference_f"] = self.reference_f[which]
        return dataclasses.replace(self, **changed)

    def noise_scaled(self, factor: float) -> VectorMeasurements:
        """Return the same samples with all standard deviations multiplied by a factor.

        Parameters
        ----------
        factor : float
            Factor, ≥ 0.

        Returns
        -------
        VectorMeasurements
            The series with the scaled noise.
        """
        changed: dict[str, Any] = {"sigma": factor * self.sigma}
        if self.sigma_axes is not None:
            changed["sigma_axes"] = factor * self.sigma_axes
        if self.covariance is not None:
            changed["covariance"] = factor**2 * self.covariance
        return dataclasses.replace(self, **changed)

    @property
    def anisotropic(self) -> bool:
        """Whether the noise is not described by one sigma per sample; for an attitude, by one per axis."""
        return self.covariance is not None or (self.kind != "attitude" and self.sigma_axes is not None)

    @property
    def covariances(self) -> Array:
        """Covariance of the noise of every sample (m, 3, 3), body axes; for a heading a diagonal of its variance."""
        if self.covariance is not None:
            return self.covariance
        if self.sigma_axes is not None:
            return np.asarray(self.sigma_axes[:, :, None] ** 2 * np.eye(3))
        return np.asarray(self.sigma[:, None, None] ** 2 * np.eye(3))


def _missing(value: Array) -> np.ndarray:
    """Return a mask (m,) of the rows with a NaN. The sum, which is NaN if any entry is, is the fastest check for none."""
    if np.isnan(np.sum(value)):
        return np.asarray(np.isnan(value).any(axis=1))
    return np.zeros(len(value), bool)


def _of_known(name: str, value: Array, missing: np.ndarray, stand_in: Array | Callable[[Array], ArrayLike]) -> Array:
    """Return a property of each sample (m, ...), NaN of a missing sample (m,) replaced by ``stand_in``."""
    if not np.isnan(np.sum(value)):
        return value
    lost = np.isnan(value.reshape(len(value), -1)).any(axis=1)
    if np.any(lost & ~missing):
        k = int(np.argmax(lost & ~missing))
        raise InputError(
            f"{name}[{k}] is nan at a measured value; give it, or mark the sample as missing by NaN in the value itself"
        )
    filled = value.copy()
    filled[lost] = stand_in(value[~lost]) if callable(stand_in) else stand_in[lost]
    return filled


def _root_mean_square(known: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(known**2, axis=0)) if len(known) else np.ones(known.shape[1:]))


def _mean_covariance(known: Array) -> Array:
    return np.asarray(np.mean(known, axis=0) if len(known) else np.eye(3))


def _first_or_level(known: Array) -> Array:
    return np.asarray(known[0] if len(known) else (1.0, 0.0, 0.0))


def _covariances(name: str, value: ArrayLike, m: int, missing: np.ndarray) -> Array:
    """Return covariances (m, 3, 3), checked to be symmetric without negative eigenvalues; a single one is repeated."""
    given = numbers(name, value)
    if given.shape == (3, 3):
        one = array(name, given, (3, 3))[None]
        whole = np.broadcast_to(one, (m, 3, 3))
    else:
        one = whole = _of_known(name, array(name, given, (m, 3, 3), allow_nan=True), missing, _mean_covariance)
    size = np.einsum("kii->k", np.abs(one))[:, None, None]
    lopsided = np.any(np.abs(one - np.swapaxes(one, 1, 2)) > 1e-12 * size, axis=(1, 2))
    if lopsided.any():
        raise InputError(f"{name}[{int(np.argmax(lopsided))}] is not symmetric; use ½(C + Cᵀ)")
    least = np.linalg.eigvalsh(one)[:, 0] if len(one) else np.zeros(0)
    if np.any(least < -1e-12 * size.ravel()):
        k = int(np.argmin(least))
        raise InputError(
            f"{name}[{k}] has the eigenvalue {least[k]:.3g}; a covariance must have no negative eigenvalue"
        )
    return whole


UNIT_TOLERANCE = 1e-6
"""Maximum deviation of the length of a measured direction from 1, by rounding."""
MIN_LEVEL = 1e-3
"""Minimum horizontal part of a unit reference of a heading."""


def need_unit(name: str, vector: Array) -> None:
    """Reject measured vectors (..., 3) that are not of unit length, except missing ones (NaN)."""
    norm = np.linalg.norm(vector, axis=-1)
    bad = np.abs(norm - 1.0) > UNIT_TOLERANCE
    if np.any(bad):
        k = int(np.argmax(bad))
        place = f"{name}[{k}]" if bad.ndim else name
        raise InputError(
            f"{place} has length {np.ravel(norm)[k]:.6g}; divide each vector by its length (missing ones are NaN)"
        )


def need_level(name: str, reference: Array) -> None:
    """Reject vertical unit references (..., 3) of a heading."""
    level = np.hypot(reference[..., 0], reference[..., 1])
    if np.any(level < MIN_LEVEL):
        place = f"{name}[{int(np.argmax(level < MIN_LEVEL))}]" if level.ndim else name
        raise InputError(f"{place} is vertical and shows no heading; give one with a horizontal part")


def _direction(name: str, value: ArrayLike) -> Array:
    vector = array(name, value, (3,))
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise InputError(f"{name} is the zero vector, which has no direction")
    # A vector of unit length to within rounding is unchanged, so that one read from a file is bitwise equal to the one written.
    return vector if abs(length - 1.0) <= ROUNDING else np.asarray(vector / length)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


_NO_DIRECTION = "reference_f is the zero vector, which has no direction"


def triad(reference_f: ArrayLike) -> Array:
    """Return unit vectors (u, v, r) as rows (..., 3, 3), right-handed (u × v = r), r along ``reference_f`` (..., 3)."""
    given = array("reference_f", reference_f, (..., 3))
    if given.ndim == 1:
        return _one_triad(*given.tolist())
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    if np.any(length == 0.0):
        raise InputError(_NO_DIRECTION)
    r = given / length
    u = np.cross(np.eye(3)[np.argmin(np.abs(r), axis=-1)], r)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    return np.stack([u, np.cross(r, u), r], axis=-2)


def _one_triad(x: float, y: float, z: float) -> Array:
    """Return :func:`triad` of one vector, bitwise the same, 20 times faster than NumPy."""
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        raise InputError(_NO_DIRECTION)
    if length == math.inf:
        raise InputError(f"reference_f is [{x:g}, {y:g}, {z:g}], too long to have a direction in double precision")
    r = x / length, y / length, z / length
    least = min(range(3), key=lambda i: abs(r[i]))
    u = _cross_product([float(i == least) for i in range(3)], r)
    size = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    u = u[0] / size, u[1] / size, u[2] / size
    return np.array([u, _cross_product(r, u), r])


def _cross_product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Errors of a sensor beyond its white noise. The default is none.

    Parameters
    ----------
    latency : float, default 0.0
        Delay from the time of a sample to its arrival, s.
    outages : sequence of (float, float), default empty
        Windows (from, to) without samples, s: eclipse, blinding, a lost fix.
    outlier_probability : float, default 0.0
        Probability that a sample is an outlier, independently of the others.
    outlier_scale : float, default 10.0
        Ratio of the noise of an outlier to that of other samples (contaminated normal, Tukey 1960).
    correlated_sigma : float, default 0.0
        Standard deviation of an additional first-order Gauss–Markov noise of each component, in the unit of sigma.
    correlation_time : float, default 100.0
        Correlation time of that noise, s.
    drop_probability : float, default 0.0
        Probability that a sample is lost, independently of the others.
    duty_period : float, default 0.0
        Period of a duty cycle, s, counted from time 0; 0: the sensor is always on.
    duty_share : float, default 1.0
        Fraction of each period, from its beginning, in which the sensor is on.
    """

    latency: float = 0.0
    outages: Sequence[tuple[float, float]] = ()
    outlier_probability: float = 0.0
    outlier_scale: float = 10.0
    correlated_sigma: float = 0.0
    correlation_time: float = 100.0
    drop_probability: float = 0.0
    duty_period: float = 0.0
    duty_share: float = 1.0

    def __post_init__(self) -> None:
        """Check every field."""
        non_negative("latency", self.latency, unit="s")
        windows = tuple(
            (finite("outages: from", a, unit="s"), finite("outages: to", b, unit="s")) for a, b in self.outages
        )
        for a, b in windows:
            if b < a:
                raise InputError(f"outages has a window from {a:g} s to {b:g} s; give (from, to) with from ≤ to")
        object.__setattr__(self, "outages", windows)
        for name in ("outlier_probability", "drop_probability", "duty_share"):
            if non_negative(name, getattr(self, name)) > 1.0:
                raise InputError(f"{name} is {getattr(self, name):g}; it must not be above 1")
        positive("outlier_scale", self.outlier_scale)
        non_negative("correlated_sigma", self.correlated_sigma)
        positive("correlation_time", self.correlation_time, unit="s")
        non_negative("duty_period", self.duty_period, unit="s")

    def _noise(self, time: Array, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return white noise (m, 3) of unit σ including outliers, and the correlated noise (m, 3), in the unit of ``correlated_sigma``."""
        # Drawn first, so that it is the same with and without correlated noise or outliers.
        white = generator.standard_normal((len(time), 3))
        if self.outlier_probability > 0.0:
            struck = generator.random(len(time)) < self.outlier_probability
            white[struck] *= self.outlier_scale
        correlated = np.zeros_like(white)
        if self.correlated_sigma > 0.0 and len(time):
            drive = self.correlated_sigma * generator.standard_normal(white.shape)
            decay = np.exp(-np.diff(time) / self.correlation_time)
            correlated[0] = drive[0]
            compiled(gyro_errors.gauss_markov)(decay, np.sqrt(1.0 - decay**2)[:, None] * drive[1:], correlated)
        return white, correlated

    def _heard(self, series: VectorMeasurements, generator: np.random.Generator) -> VectorMeasurements:
        """Return the series without the samples in outages, off duty or lost, with arrival times if there is a latency.

        Lost samples are drawn from a child of the generator, so they do not depend on the noise.
        """
        arrival = series.time + self.latency if self.latency > 0.0 else None
        series = dataclasses.replace(series, arrival=arrival)
        lost = np.zeros(len(series.time), bool)
        for a, b in self.outages:
            lost |= (series.time >= a) & (series.time <= b)
        if self.duty_period > 0.0:
            # The tolerance keeps a sample that differs from a switching time by rounding.
            lost |= np.mod(series.time / self.duty_period + 1e-9, 1.0) > self.duty_share + 2e-9
        if self.drop_probability > 0.0:
            lost |= generator.spawn(1)[0].random(len(lost)) < self.drop_probability
        return series.taken(~lost) if lost.any() else series


def sample_times(rate: float, phase: float, start: float, end: float) -> Array:
    """Return the measurement times in (start, end], s: the first after ``phase``, or after one interval if that is 0."""
    first, skipped = (start + phase, 0) if phase > 0.0 else (start, 1)
    # The tolerance of a millionth of an interval keeps the last sample if end differs from it by rounding.
    number = int(np.floor((finite("end", end) - first) * rate + 1e-6)) + 1 - skipped
    # Computed as integers divided by the rate, as the gyro's edges are: if the rates are multiples, the times are bitwise equal, and a
    # filter needs no step of the size of a rounding error.
    return np.minimum(first + np.arange(skipped, max(number, 0) + skipped) / rate, end)


def _check_sampling(name: str, sigma: float, unit: str, rate: float, phase: float) -> None:
    non_negative(f"{name}: sigma", sigma, unit=unit)
    positive(f"{name}: rate", rate, unit="Hz")
    non_negative(f"{name}: phase", phase, unit="s")


def _attitude(motion: Any, time: Array) -> Array:
    """Return q_fb of a motion, which may be given as a function of time."""
    return np.asarray(motion(time) if callable(motion) else motion.attitude(time))


def _body(motion: Any, time: Array, vector_f: Array) -> Array:
    """Return R_fbᵀ v_f."""
    return quaternion.rotate(quaternion.conjugate(_attitude(motion, time)), vector_f)


class _Sampled:
    """A sensor with its own rate and faults; :meth:`_measured` of the class returns its measurements."""

    name: str
    rate: float
    phase: float
    faults: Faults

    def observe(self, motion: Any, start: float, end: float, generator: np.random.Generator) -> VectorMeasurements:
        """Return noisy measurements over (start, end] of a motion, or of an attitude q_fb given as a function of time."""
        time = sample_times(self.rate, self.phase, start, end)
        white, correlated = self.faults._noise(time, generator)
        measured = self._measured(motion, time, white, correlated)
        return self.faults._heard(VectorMeasurements(sensor=self.name, time=time, **measured), generator)

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        """Return the fields of the series of measurements, from white noise of unit σ and correlated noise (m, 3)."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True, eq=False)
class VectorSensor(_Sampled, ByValue):
    """A sensor of one known direction: a star, the sun, a beacon.

    Parameters
    ----------
    name : str
        Name of the sensor and of its stream of random numbers.
    reference_f : ndarray (3,)
        Direction measured, fixed frame; it is normalised.
    sigma : float
        Noise of each component of the unit direction before it is normalised, rad; above 0.1 rad see the module's notes.
    rate : float
        Measurements per second, Hz.
    phase : float, default 0.0
        Time of the first measurement after the start, s; 0: one interval after it.
    kind : {"direction", "heading"}, default "direction"
        ``"direction"``, or ``"heading"`` (only the rotation about the fixed z axis).
    faults : Faults, default no faults
        Errors beyond the white noise.

    Examples
    --------
    >>> star = VectorSensor(name="star 1", reference_f=[3.0, 0.0, 4.0], sigma=20.0 * np.pi / 648000.0, rate=1.0)
    >>> print(star.reference_f)
    [0.6 0.  0.8]
    """

    name: str
    reference_f: Array
    sigma: float
    rate: float
    phase: float = 0.0
    kind: Kind = "direction"
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        """Check every field."""
        object.__setattr__(self, "reference_f", _direction(f"{self.name}: reference_f", self.reference_f))
        _check_sampling(self.name, self.sigma, "rad", self.rate, self.phase)
        one_of(f"{self.name}: kind", self.kind, ("direction", "heading"))

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        noisy = _body(motion, time, self.reference_f) + self.sigma * white + correlated
        # The noise of a heading is that across the direction divided by its horizontal part.
        level = float(np.hypot(self.reference_f[0], self.reference_f[1])) if self.kind == "heading" else 1.0
        return {
            "kind": self.kind,
            "vector_b": _unit(noisy),
            "reference_f": self.reference_f,
            "sigma": np.full(len(time), self.sigma / level),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class HorizonSensor(_Sampled, ByValue):
    """An earth-horizon sensor on an orbit: the direction of the earth's centre, which moves in the fixed frame.

    Parameters
    ----------
    name : str
        As for :class:`VectorSensor`.
    orbit : CircularOrbit
        Orbit of the body, in the fixed frame.
    sigma : float
        Noise of each component of the unit direction, rad.
    rate, phase, faults : float, float, Faults
        As for :class:`VectorSensor`.
    """

    name: str
    orbit: CircularOrbit
    sigma: float
    rate: float
    phase: float = 0.0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        """Check every field."""
        from strapdown.motion.orbit import CircularOrbit  # imports all motions, which recordings do not need

        _check_sampling(self.name, self.sigma, "rad", self.rate, self.phase)
        instance(f"{self.name}: orbit", self.orbit, CircularOrbit, "give an orbit.CircularOrbit")

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        down_f = -_unit(self.orbit.position(time).reshape(-1, 3))
        return {
            "kind": "direction",
            "vector_b": _unit(_body(motion, time, down_f) + self.sigma * white + correlated),
            "reference_f": down_f,
            "sigma": np.full(len(time), self.sigma),
        }


Boresight = str | tuple[float, ...] | tuple[tuple[float, ...], ...]


def _boresight(name: str, value: Any) -> str | tuple[float, ...]:
    """Return a boresight as "x", "y" or "z" if it is along that axis, in either direction, otherwise as a unit vector."""
    if isinstance(value, str):
        return one_of(name, value.removeprefix("-"), ("x", "y", "z"))
    given = np.asarray(numbers(name, value))
    if given.shape == (4,):
        (q,) = unit_quaternions(name, given[None])
        b = quaternion.rotate(q, np.array([0.0, 0.0, 1.0]))
    elif given.shape == (3, 3):
        if not np.allclose(given @ given.T, np.eye(3), atol=1e-6) or np.linalg.det(given) < 0.0:
            raise InputError(f"{name} is no rotation matrix: its rows must be orthogonal unit vectors, right-handed")
        b = given[:, 2]
    elif given.shape == (3,):
        b = given
    else:
        raise InputError(
            f"{name} has shape {given.shape}; give x, y or z, a direction (3,), or the mounting as a quaternion (4,) or matrix (3, 3)"
        )
    length = float(np.linalg.norm(b))
    if not np.isfinite(length) or length == 0.0:
        raise InputError(f"{name} is {value!r}, not a direction; give x, y or z, or three numbers not all zero")
    b = b / length
    k = int(np.argmax(np.abs(b)))
    return "xyz"[k] if abs(b[k]) > 1.0 - 1e-12 else tuple(b.tolist())


@dataclass(frozen=True, kw_only=True)
class AttitudeSensor(_Sampled):
    """A star tracker that measures the attitude as a quaternion; less precise about its boresight than across it.

    Parameters
    ----------
    name : str
        As for :class:`VectorSensor`.
    sigma_across : float
        Noise about the two axes across the boresight, rad.
    sigma_about : float
        Noise about the boresight, rad.
    rate : float
        Measurements per second, Hz.
    boresight : {"x", "y", "z"} or array_like (3,), (4,) or (3, 3), default "z"
        Boresight: a body axis, a direction in body axes (3,), or the mounting, sensor to body, as a quaternion (4,), scalar first,
        or a rotation matrix (3, 3), whose z axis is the boresight. Stored as an axis or a unit vector.
    phase, faults : float, Faults
        As for :class:`VectorSensor`.
    """

    name: str
    sigma_across: float
    sigma_about: float
    rate: float
    boresight: Boresight = "z"
    phase: float = 0.0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        """Check every field."""
        _check_sampling(self.name, self.sigma_across, "rad", self.rate, self.phase)
        non_negative(f"{self.name}: sigma_about", self.sigma_about, unit="rad")
        object.__setattr__(self, "boresight", _boresight(f"{self.name}: boresight", self.boresight))

    @property
    def covariance(self) -> Array | None:
        """Covariance of the noise in body axes (3, 3), rad²; None if the boresight is a body axis."""
        if isinstance(self.boresight, str):
            return None
        b = np.asarray(self.boresight)
        return np.asarray(
            self.sigma_across**2 * (np.eye(3) - np.outer(b, b)) + self.sigma_about**2 * np.outer(b, b), np.float64
        )

    @property
    def sigma_axes(self) -> Array:
        """Noise about each body axis (3,), rad."""
        if isinstance(self.boresight, str):
            return np.where(np.arange(3) == "xyz".index(self.boresight), self.sigma_about, self.sigma_across)
        assert self.covariance is not None
        return np.sqrt(np.diag(self.covariance))

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        noise = self.sigma_axes * white
        if not isinstance(self.boresight, str):
            b = np.asarray(self.boresight)
            noise = self.sigma_across * white + (self.sigma_about - self.sigma_across) * (white @ b)[:, None] * b
        error = quaternion.exp(noise + correlated)
        whole = self.covariance
        return {
            "kind": "attitude",
            "attitude": quaternion.multiply(_attitude(motion, time), error).reshape(-1, 4),
            "sigma_axes": self.sigma_axes if whole is None else None,
            "covariance": whole,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Magnetometer(_Sampled, ByValue):
    """A magnetometer in a known field: ``m_b = (I + S) R_fbᵀ B_f + h + v``, S soft iron, h hard iron (the residual of the calibration).

    Parameters
    ----------
    name : str
        As for :class:`VectorSensor`.
    field_f : ndarray (3,) or callable
        Magnetic field, T, fixed frame; or a function of time (m,), s, that returns it (m, 3).
    sigma : float
        Noise of each component, T.
    rate : float
        Measurements per second, Hz.
    hard_iron : ndarray (3,), default zeros
        Hard iron h: field of magnetised parts that move with the body, T, body axes.
    soft_iron : ndarray (3, 3), default zeros
        Soft iron S: effect of parts magnetised by the external field, dimensionless.
    kind : {"direction", "heading", "vector"}, default "direction"
        ``"direction"``, ``"heading"`` (about the fixed z axis) or ``"vector"`` (the whole field, T).
    phase, faults : float, Faults
        As for :class:`VectorSensor`.
    """

    name: str
    field_f: Array | VectorField
    sigma: float
    rate: float
    hard_iron: Array = field(default_factory=lambda: np.zeros(3))
    soft_iron: Array = field(default_factory=lambda: np.zeros((3, 3)))
    kind: Kind = "direction"
    phase: float = 0.0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        """Check every field."""
        _check_sampling(self.name, self.sigma, "T", self.rate, self.phase)
        one_of(f"{self.name}: kind", self.kind, ("direction", "heading", "vector"))
        if not callable(self.field_f):
            object.__setattr__(self, "field_f", array(f"{self.name}: field_f", self.field_f, (3,)))
            seen = self.field_f[:2] if self.kind == "heading" else self.field_f
            if not np.any(seen):
                part = "horizontal part of field_f" if self.kind == "heading" else "field_f"
                raise InputError(
                    f"{self.name}: {part} is zero, which has no direction; give the field at the location of the body"
                )
        object.__setattr__(self, "hard_iron", array(f"{self.name}: hard_iron", self.hard_iron, (3,)))
        object.__setattr__(self, "soft_iron", array(f"{self.name}: soft_iron", self.soft_iron, (3, 3)))

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        true_f = self.field_f
        if callable(true_f):
            true_f = array(f"{self.name}: field_f", true_f(time), (len(time), 3))
        exact = _body(motion, time, true_f) @ (np.eye(3) + self.soft_iron).T + self.hard_iron
        measured = exact + self.sigma * white + correlated
        strength = np.broadcast_to(np.linalg.norm(true_f, axis=-1), time.shape)
        level = np.broadcast_to(np.hypot(true_f[..., 0], true_f[..., 1]), time.shape)
        scale = {"vector": np.ones(len(time)), "direction": strength, "heading": level}[self.kind]
        return {
            "kind": self.kind,
            "vector_b": measured if self.kind == "vector" else _unit(measured),
            "reference_f": true_f,
            "sigma": self.sigma / scale,
        }


def specific_force(
    motion: Motion,
    time: ArrayLike,
    *,
    lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
    acceleration_f: VectorField | None = None,
    gravity_f: ArrayLike = GRAVITY_F,
) -> Array:
    """Return the specific force at a point of the body: the output of an ideal accelerometer there.

    Parameters
    ----------
    motion : Motion
        Motion of the body.
    time : array_like (...)
        Times, s.
    lever_arm_b : array_like (3,), default zeros
        Position r of the point, m, body axes, from the point that moves with ``acceleration_f``.
    acceleration_f : callable, optional
        Acceleration a_f, m/s², fixed frame: a function of time (m,), s, that returns (m, 3). Default: zero.
    gravity_f : array_like (3,), default (0, 0, −9.80665)
        Acceleration of gravity g_f, m/s², fixed frame.

    Returns
    -------
    ndarray (..., 3)
        ``f_b = R_fbᵀ (a_f − g_f) + ẇ_b × r + w_b × (w_b × r)``, m/s², body axes.

    Examples
    --------
    >>> from strapdown.motion import rest
    >>> specific_force(rest(), 0.0).tolist()
    [0.0, 0.0, 9.80665]
    """
    t = np.asarray(time, np.float64)
    arm = array("lever_arm_b", lever_arm_b, (3,))
    rate = motion.body_rate(t)
    pull = np.broadcast_to(-array("gravity_f", gravity_f, (3,)), (*t.shape, 3))
    if acceleration_f is not None:
        pull = pull + acceleration_f(t)
    turning = np.cross(motion.body_angular_acceleration(t), arm) + np.cross(rate, np.cross(rate, arm))
    return np.asarray(_body(motion, t, pull) + turning)


@dataclass(frozen=True, kw_only=True, eq=False)
class Accelerometer(_Sampled, ByValue):
    """An accelerometer used as a sensor of the vertical: correct at rest, otherwise in error by the acceleration of the body.

    Parameters
    ----------
    name : str
        As for :class:`VectorSensor`.
    sigma : float
        Noise of each component, m/s².
    rate : float
        Measurements per second, Hz.
    lever_arm_b : ndarray (3,), default zeros
        Position on the body, m, from the point that moves with ``acceleration_f``.
    bias : ndarray (3,), default zeros
        Bias, m/s², body axes.
    acceleration_f : callable, optional
        Acceleration of that point, m/s², fixed frame: a function of time (m,), s, that returns (m, 3); None: zero.
    gravity_f : ndarray (3,), default (0, 0, −9.80665)
        Acceleration of gravity, m/s², fixed frame.
    kind : {"direction", "vector"}, default "direction"
        ``"direction"`` (of the vertical) or ``"vector"`` (the specific force, m/s²).
    phase, faults : float, Faults
        As for :class:`VectorSensor`.
    """

    name: str
    sigma: float
    rate: float
    lever_arm_b: Array = field(default_factory=lambda: np.zeros(3))
    bias: Array = field(default_factory=lambda: np.zeros(3))
    acceleration_f: VectorField | None = None
    gravity_f: Array = field(default_factory=lambda: np.array(GRAVITY_F))
    kind: Kind = "direction"
    phase: float = 0.0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        """Check every field."""
        _check_sampling(self.name, self.sigma, "m/s²", self.rate, self.phase)
        one_of(f"{self.name}: kind", self.kind, ("direction", "vector"))
        for name in ("lever_arm_b", "bias", "gravity_f"):
            object.__setattr__(self, name, array(f"{self.name}: {name}", getattr(self, name), (3,)))
        _direction(f"{self.name}: gravity_f", self.gravity_f)

    def _measured(self, motion: Motion, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        exact = specific_force(
            motion, time, lever_arm_b=self.lever_arm_b, acceleration_f=self.acceleration_f, gravity_f=self.gravity_f
        )
        measured = exact + self.bias + self.sigma * white + correlated
        whole = self.kind == "vector"
        return {
            "kind": self.kind,
            "vector_b": measured if whole else _unit(measured),
            "reference_f": -self.gravity_f,
            "sigma": np.full(len(time), self.sigma / (1.0 if whole else float(np.linalg.norm(self.gravity_f)))),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadingPair(_Sampled, ByValue):
    """Two GNSS antennas on the body: the heading of the line between them.

    The line is known in the body and measured in the fixed frame, so ``vector_b`` is exact and ``reference_f`` (m, 3) has the noise.

    Parameters
    ----------
    name : str
        As for :class:`VectorSensor`.
    baseline_b : ndarray (3,)
        Vector from the first antenna to the second, m, body axes.
    sigma : float
        Noise of each component of the relative position, m; that of the heading is this divided by the baseline's horizontal length.
    rate, phase, faults : float, float, Faults
        As for :class:`VectorSensor`.
    """

    name: str
    baseline_b: Array
    sigma: float
    rate: float
    phase: float = 0.0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        """Check every field."""
        _check_sampling(self.name, self.sigma, "m", self.rate, self.phase)
        object.__setattr__(self, "baseline_b", array(f"{self.name}: baseline_b", self.baseline_b, (3,)))
        _direction(f"{self.name}: baseline_b", self.baseline_b)

    def _measured(self, motion: Any, time: Array, white: Array, correlated: Array) -> dict[str, Any]:
        line_f = quaternion.rotate(_attitude(motion, time), self.baseline_b).reshape(-1, 3)
        level = np.hypot(line_f[:, 0], line_f[:, 1])
        measured = (line_f + self.sigma * white + correlated) * np.array([1.0, 1.0, 0.0])
        return {
            "kind": "heading",
            "vector_b": np.tile(_unit(self.baseline_b), (len(time), 1)),
            "reference_f": measured,
            "sigma": self.sigma / level,
        }
