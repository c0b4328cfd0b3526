"""Series of measurements of one sensor: values, references and noise, checked; right-handed unit vectors about a reference."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks, quaternion
from strapdown.checks import ROUNDING, Array, InputError, array, increasing, instance, numbers, one_of, unit_quaternions
from strapdown.results import ByValue

Kind = Literal["direction", "heading", "vector", "attitude"]
KINDS: dict[str, int] = {"direction": 2, "heading": 1, "vector": 3, "attitude": 3}
"""Kinds of measurement and their degrees of freedom: direction, both components across it; heading, only the rotation of the vector's
horizontal part about the fixed z axis; vector, all three components; attitude, the whole rotation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VectorMeasurements(ByValue):
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
        instance("sensor", self.sensor, str, "give the series the name of its sensor")
        one_of(f"{self.sensor}: kind", self.kind, KINDS)
        time = increasing(f"{self.sensor}: time", self.time, minimum=0)
        m = len(time)
        store: dict[str, Any] = {"time": time}
        if self.kind == "attitude":
            if self.attitude is None:
                raise InputError(f"{self.sensor}: a series of kind 'attitude' needs attitude (m, 4)")
            name = f"{self.sensor}: attitude"
            quaternions = array(name, self.attitude, (m, 4), allow_nan=True)
            missing = _missing(quaternions)
            whole = unit_quaternions(name, np.where(missing[:, None], quaternion.IDENTITY, quaternions))
            store["attitude"] = np.where(missing[:, None], quaternions, whole)
            store["vector_b"] = np.full((m, 3), np.nan)
        else:
            if self.attitude is not None:
                raise InputError(f"{self.sensor}: attitude belongs to kind 'attitude', not {self.kind!r}")
            vector = array(f"{self.sensor}: vector_b", self.vector_b, (m, 3), allow_nan=True)
            if self.kind != "vector":
                _need_unit(f"{self.sensor}: vector_b", vector)
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
        cls, sensor: str, time: ArrayLike, heading: ArrayLike, sigma: ArrayLike, *, axis_b: ArrayLike = (1.0, 0.0, 0.0)
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
        axis = np.where(missing[:, None], np.nan, direction(f"{sensor}: axis_b", axis_b))
        known = np.where(missing, 0.0, angle)
        level = np.stack([np.cos(known), np.sin(known), np.zeros(len(known))], axis=1)
        return cls(sensor=sensor, kind="heading", time=time, vector_b=axis, reference_f=level, sigma=sigma)  # type: ignore[arg-type]

    def _noise(self, m: int, missing: np.ndarray) -> dict[str, Array]:
        """Return sigma (m,), and sigma_axes (m, 3) and covariance (m, 3, 3) if they are given."""
        name, attitude = self.sensor, self.kind == "attitude"
        if self.kind == "heading" and not (self.sigma_axes is None and self.covariance is None):
            raise InputError(f"{name}: a heading has one sigma; sigma_axes and covariance belong to other kinds")
        sigma = self._sigma(m, missing)
        has_sigma = np.any(numbers("sigma", self.sigma, allow_nan=True) != 0.0)  # for an empty series too
        columns: dict[str, Array] = {}
        axes: Array | None = None

        def agrees(value: Array, other: Array) -> bool:
            return np.allclose(value[~missing], other[~missing], rtol=1e-12, atol=0.0)

        if self.sigma_axes is not None:
            own = self._repeated("sigma_axes", (m, 3), "one number per body axis (3,), or (m, 3)")
            columns["sigma_axes"] = axes = _of_known(f"{name}: sigma_axes", own, missing, _root_mean_square)
            if np.any(axes < 0.0):
                raise InputError(f"{name}: sigma_axes has a negative entry; give standard deviations")
        if self.covariance is not None:
            columns["covariance"] = whole = _covariances(f"{name}: covariance", self.covariance, m, missing)
            diagonal = np.sqrt(np.einsum("kii->ki", whole))
            if axes is not None and not agrees(axes, diagonal):
                raise InputError(f"{name}: sigma_axes and covariance contradict each other; give one of them")
            axes = diagonal
            if attitude:
                columns["sigma_axes"] = axes
        if axes is not None:
            # That of equal axes is theirs to the last bit, so that a series read from a file equals the one written.
            mean = np.where(np.ptp(axes, axis=1) == 0.0, axes[:, 0], np.sqrt(np.mean(axes**2, axis=1)))
            if not attitude and has_sigma and not agrees(sigma, mean):
                raise InputError(
                    f"{name}: sigma contradicts sigma_axes or covariance; leave it out, it is their root mean square"
                )
            return columns | {"sigma": mean}
        if attitude and not has_sigma:
            raise InputError(
                f"{name}: a series of kind 'attitude' needs its noise: sigma (m,), sigma_axes (m, 3) or covariance (m, 3, 3)"
            )
        return {"sigma": sigma} | ({"sigma_axes": np.repeat(sigma[:, None], 3, axis=1)} if attitude else {})

    def _sigma(self, m: int, missing: np.ndarray) -> Array:
        """Return sigma (m,), checked."""
        by_axis = "" if self.kind == "heading" else ", and one per body axis as sigma_axes"
        own = self._repeated("sigma", (m,), f"one number, or one per sample{by_axis}")
        sigma = _of_known(f"{self.sensor}: sigma", own, missing, _root_mean_square)
        if np.any(sigma < 0.0):
            k = int(np.argmax(sigma < 0.0))
            raise InputError(f"{self.sensor}: sigma[{k}] is {sigma[k]:g}; it must not be negative")
        vanishing = (sigma > 0.0) & (sigma**2 < np.finfo(np.float64).tiny)
        if vanishing.any():
            k = int(np.argmax(vanishing))
            raise InputError(f"{self.sensor}: sigma[{k}] is {sigma[k]:g}, and its square underflows; check its unit")
        return sigma

    def _repeated(self, field: str, shape: tuple[int, ...], remedy: str) -> Array:
        """Return the numbers of a field for each sample, of this shape; those for one sample are repeated."""
        name = f"{self.sensor}: {field}"
        own = numbers(name, getattr(self, field), allow_nan=True)
        if own.shape not in ((), shape[1:], (1, *shape[1:]), shape):
            raise InputError(f"{name} has shape {own.shape} for {shape[0]} samples; give {remedy}")
        return array(name, np.broadcast_to(own, shape), shape, allow_nan=True)

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
            reference = array(name, reference, (3,)) if self.kind == "vector" else direction(name, reference)
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
    own = numbers(name, value)
    if own.shape == (3, 3):
        sample = array(name, own, (3, 3))[None]
        whole = np.broadcast_to(sample, (m, 3, 3))
    else:
        sample = whole = _of_known(name, array(name, own, (m, 3, 3), allow_nan=True), missing, _mean_covariance)
    least = np.linalg.eigvalsh(checks.symmetric(name, sample))[:, 0] if len(sample) else np.zeros(0)
    if np.any(least < -1e-12 * np.trace(sample, axis1=1, axis2=2)):
        k = int(np.argmin(least))
        raise InputError(
            f"{name}[{k}] has the eigenvalue {least[k]:.3g}; a covariance must have no negative eigenvalue"
        )
    return whole


UNIT_TOLERANCE = 1e-6
"""Maximum deviation of the length of a measured direction from 1, by rounding."""
MIN_LEVEL = 1e-3
"""Minimum horizontal part of a unit reference of a heading."""


def _need_unit(name: str, vector: Array) -> None:
    """Reject measured vectors (m, 3) that are not of unit length, except missing ones (NaN)."""
    norm = np.linalg.norm(vector, axis=1)
    bad = np.abs(norm - 1.0) > UNIT_TOLERANCE
    if np.any(bad):
        k = int(np.argmax(bad))
        raise InputError(
            f"{name}[{k}] has length {norm[k]:.6g}; divide each vector by its length (missing ones are NaN)"
        )


def need_level(name: str, reference: Array) -> None:
    """Reject vertical unit references (..., 3) of a heading."""
    level = np.hypot(reference[..., 0], reference[..., 1])
    if np.any(level < MIN_LEVEL):
        place = f"{name}[{int(np.argmax(level < MIN_LEVEL))}]" if level.ndim else name
        raise InputError(f"{place} is vertical and shows no heading; give one with a horizontal part")


def direction(name: str, value: ArrayLike) -> Array:
    """Return a direction (3,) as a unit vector; the zero vector is refused."""
    vector = array(name, value, (3,))
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise InputError(f"{name} is the zero vector, which has no direction")
    # A vector of unit length to within rounding is unchanged, so that one read from a file is bitwise equal to the one written.
    return vector if abs(length - 1.0) <= ROUNDING else np.asarray(vector / length)


def triad(reference_f: ArrayLike) -> Array:
    """Return unit vectors (u, v, r) as rows (..., 3, 3), right-handed (u × v = r), r along ``reference_f`` (..., 3)."""
    reference = array("reference_f", reference_f, (..., 3))
    if reference.ndim == 1:
        return _one_triad(*reference.tolist())
    length = np.linalg.norm(reference, axis=-1, keepdims=True)
    if np.any(length == 0.0):
        raise InputError("reference_f is the zero vector, which has no direction")
    r = reference / length
    u = np.cross(np.eye(3)[np.argmin(np.abs(r), axis=-1)], r)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    return np.stack([u, np.cross(r, u), r], axis=-2)


def _one_triad(x: float, y: float, z: float) -> Array:
    """Return :func:`triad` of one vector, bitwise the same, 20 times faster than NumPy."""
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        raise InputError("reference_f is the zero vector, which has no direction")
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
