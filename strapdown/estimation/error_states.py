"""Declarations of error states: components, dynamics, and effects on the gyro and the sensors.

:class:`ErrorStates` describes them by arrays, which are all that the compiled filter needs. A new kind is a subclass that overrides
those properties in which it differs from "no effect".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from itertools import accumulate
from typing import Any, Literal

import numpy as np

from strapdown.checks import Array, InputError, array, non_negative, one_of, positive
from strapdown.results import ByValue
from strapdown.units import STANDARD_GRAVITY
from strapdown.vectors import GRAVITY_F

__all__ = [
    "BoundedVelocity",
    "ErrorStates",
    "GaussMarkov",
    "GyroForce",
    "GyroGaussMarkov",
    "GyroScale",
    "GyroTemperature",
    "LeverArm",
    "SensorMounting",
    "VectorBias",
]

AXES = ("x", "y", "z")
ENTRIES = tuple(a if a == b else f"{a}{b}" for a in AXES for b in AXES)
"""Names of the entries of a matrix, row by row: x, xy, xz, yx, y, …"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """Effect of error states c on one sensor, which then measures ``(I + Σ c U) R_fbᵀ (r + Σ c d) + Σ c a``.

    a and d are in the unit of the sensor's references (1 for directions and headings). For a sensor of whole attitudes ``Σ c a`` is the
    rotation vector from the body's axes to the sensor's, rad, and the only effect allowed.
    """

    offset_b: Array | None = None
    """a of each state (size, 3), body axes."""
    offset_f: Array | None = None
    """d of each state (size, 3), fixed axes."""
    scale: Array | None = None
    """U of each state (size, 3, 3)."""
    lever: Array | None = None
    """a′ of each state (size, 3), body axes, instead of a: ``a = ([ẇ] + [w]²) a′``, the acceleration of a point of the body at a′ from the
    centre of rotation, divided by the magnitude of the measured vector. For directions and whole vectors only."""
    varying: bool = False
    """For a direction or heading: whether a and d are constant in the sensor's own unit while the magnitude of the measured field changes,
    as the earth's field does along an orbit. The sensor's σ, its noise divided by that magnitude, gives the change; c is then relative to
    the magnitude at the root mean square σ."""
    carried: bool = False
    """Whether d is defined relative to the estimated attitude and rotates with its corrections: right for isotropic noise. A common
    rotation of attitude and noise changes neither the measurements nor the noise model, so states in fixed axes would add information
    about the attitude that the measurements do not contain (Huang, Mourikis & Roumeliotis 2010, on linearisations that break a symmetry).
    Each correction of the attitude rotates the states and their covariance. This requires equal states for the axes x, y and z, in this
    order: ``offset_f`` is ``kron(I, a)`` of a column a. States and covariance are reported in the axes of the estimated attitude, without
    its uncertainty."""


class ErrorStates(ByValue):
    """Error states that enter linearly, with dynamics that are independent or in chains: ``ċₖ = −λₖ cₖ + gₖ cₖ₊₁ + √qₖ wₖ``.

    Transition and noise are exact over any dt. A chain has at most three states, none of which enters the gyro, and shapes the noise of
    its last state by any real poles. A subclass overrides the properties that it needs; the default of all others is "no effect".
    """

    name: str
    """Name, unique among the error states of a filter."""
    components: tuple[str, ...]
    """Name of each state."""
    units: tuple[str, ...]
    """Unit of each state."""
    sigma: Array
    """Initial standard deviation of each state (size,), greater than zero; all states are initially zero."""

    def __eq__(self, other: object) -> bool:
        """Compare all fields of a dataclass; any other declaration equals itself only."""
        return self is other or (is_dataclass(self) and super().__eq__(other))

    def __hash__(self) -> int:
        """Return a hash that equal declarations share."""
        return hash((type(self), self.name))

    def _set(self, **values: Any) -> None:
        """Set attributes of a frozen declaration."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.components)

    @property
    def covariance(self) -> Array:
        """Initial covariance of the states (size, size). Default: independent states."""
        return np.diag(np.asarray(self.sigma) ** 2)

    @property
    def decay(self) -> Array:
        """λ of each state (size,), 1/s; 0: constant or random walk."""
        return np.zeros(self.size)

    @property
    def density(self) -> Array:
        """PSD q of each state's driving noise (size,), unit²/s."""
        return np.zeros(self.size)

    @property
    def feed(self) -> Array:
        """Coupling g of each state to the next (size,), 1/s times the ratio of their units; 0: none."""
        return np.zeros(self.size)

    @property
    def gyro_offset(self) -> Array:
        """Vectors e of the states (size, 3): the gyro measures ``(I + Σ c T) w_b + b + Σ c e + n``."""
        return np.zeros((self.size, 3))

    @property
    def gyro_scale(self) -> Array:
        """Matrices T of the states (size, 3, 3)."""
        return np.zeros((self.size, 3, 3))

    @property
    def gyro_force(self) -> Array:
        """Matrices G of the states (size, 3, 3): ``Σ c G R_fbᵀ f`` is added to the measured rate, f being :attr:`force_f`."""
        return np.zeros((self.size, 3, 3))

    @property
    def force_f(self) -> Array:
        """Specific force of a body at rest (3,), m/s², fixed axes; zero: not used."""
        return np.zeros(3)

    @property
    def effects(self) -> Mapping[str, Effect]:
        """Effect on each sensor, by its name."""
        return {}


def stationary_covariance(decay: Array, density: Array, feed: Array) -> Array:
    """Return the stationary covariance (n, n) of chains of states, ``A P + P Aᵀ + diag(q) = 0``, solved from the last state backwards."""
    n = len(decay)
    P = np.zeros((n + 1, n + 1))
    link = np.append(feed[:-1], 0.0)
    for i in range(n - 1, -1, -1):
        for j in range(n - 1, i - 1, -1):
            drive = link[i] * P[i + 1, j] + link[j] * P[i, j + 1] + (density[i] if i == j else 0.0)
            P[i, j] = P[j, i] = drive / (decay[i] + decay[j]) if drive != 0.0 else 0.0
    return P[:n, :n]


def _spread(name: str, value: float | Array, unit: str, size: int = 3) -> Array:
    spread = np.broadcast_to(np.asarray(value, np.float64), (size,)).copy() if np.ndim(value) < 2 else value
    return np.array(
        [positive(f"{name}[{k}]", sigma, unit=unit) for k, sigma in enumerate(array(name, spread, (size,)))]
    )


def _matrix(
    name: str, diagonal: float | Array, off_diagonal: float | Array, fields: tuple[str, str]
) -> tuple[tuple[str, ...], Array]:
    """Return names and σ of those entries of a matrix (3, 3) that are states: not zero, of which there must be one."""
    axes = array(f"{name}: {fields[0]}", np.broadcast_to(np.asarray(diagonal, np.float64), (3,)), (3,))
    across = array(f"{name}: {fields[1]}", np.broadcast_to(np.asarray(off_diagonal, np.float64), (3, 3)), (3, 3))
    if np.ndim(off_diagonal) == 2 and np.any(np.diag(across) != 0.0):
        raise InputError(f"{name}: {fields[1]} has entries on its diagonal; give those as {fields[0]}")
    whole = np.where(np.eye(3, dtype=bool), axes, across).ravel()
    if np.any(whole < 0.0):
        k = int(np.argmax(whole < 0.0))
        raise InputError(f"{name}: the sigma of {ENTRIES[k]} is {whole[k]:g}; it must not be negative")
    nonzero = np.flatnonzero(whole)
    if not len(nonzero):
        raise InputError(f"{name}: {fields[0]} and {fields[1]} are both 0; give one of them, or drop these states")
    return tuple(ENTRIES[k] for k in nonzero), whole[nonzero]


def _pairs(name: str, sigma: dict[str, float]) -> tuple[tuple[str, ...], Array]:
    """Return names and σ of the states of a symmetric matrix: its diagonal, and each pair of equal entries, such as xy=yx."""
    pairs = {}
    for entry, value in sigma.items():
        opposite = entry[::-1]
        other = sigma.get(opposite, 0.0)
        if other != value:
            raise InputError(
                f"{name}: misalignment_sigma of {entry} is {value:g}, of {opposite} {other:g}; give equal ones, or leave symmetric out"
            )
        pairs[entry if entry == opposite else "=".join(sorted((entry, opposite)))] = value
    return tuple(pairs), np.array(list(pairs.values()))


def _units_of_entries(names: Sequence[str]) -> Array:
    """Return for each named entry the matrix (3, 3) that is 1 there and 0 elsewhere."""
    return np.asarray(np.eye(9)[[ENTRIES.index(name) for name in names]].reshape(-1, 3, 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroScale(ErrorStates):
    """Scale factors and misalignments of the gyro: the entries of M in ``w_meas = (I + M) w_b + b + n``, constant.

    Entries whose σ is 0 are treated as exact and are no states.

    Parameters
    ----------
    scale_sigma : float or ndarray (3,)
        Standard deviation of each scale factor, dimensionless.
    misalignment_sigma : float or ndarray (3, 3)
        Standard deviation of each misalignment, rad, by entry of M; zeros on the diagonal.
    symmetric : bool, default False
        Whether M is symmetric: a pair of equal misalignments is one state. The other part of M is a rotation of the gyro relative to
        the body axes, which is zero if these are defined by the gyro.
    name : str, default "gyro scale"
        Name of these error states.
    """

    scale_sigma: float | Array
    misalignment_sigma: float | Array
    symmetric: bool = False
    name: str = "gyro scale"

    def __post_init__(self) -> None:
        """Check both; the states are the entries of M, row by row; xy is the sensitivity of axis x to the rate about y."""
        fields = ("scale_sigma", "misalignment_sigma")
        components, sigma = _matrix(self.name, self.scale_sigma, self.misalignment_sigma, fields)
        if not isinstance(self.symmetric, bool):
            raise InputError(f"{self.name}: symmetric is {self.symmetric!r}; it must be true or false")
        if self.symmetric:
            components, sigma = _pairs(self.name, dict(zip(components, sigma, strict=True)))
        self._set(
            components=components,
            units=tuple("1" if component in AXES else "rad" for component in components),
            sigma=sigma,
        )

    @property
    def gyro_scale(self) -> Array:
        """One entry of M per state, or two that are equal."""
        return np.array([_units_of_entries(component.split("=")).sum(axis=0) for component in self.components])


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroForce(ErrorStates):
    """Sensitivity of the gyro to specific force: the entries of G in ``w_meas = w_b + b + G f_b + n``, constant.

    The specific force is that of a body without acceleration, ``f_b = −R_fbᵀ g_f``. Entries whose σ is 0 are no states.

    Parameters
    ----------
    along_sigma : float or ndarray (3,)
        Standard deviation of each diagonal entry of G, rad/s per m/s².
    across_sigma : float or ndarray (3, 3), default zeros
        Standard deviation of each off-diagonal entry of G, rad/s per m/s²; zeros on the diagonal.
    gravity_f : ndarray (3,), default strapdown.vectors.GRAVITY_F
        Acceleration of gravity in the fixed frame, m/s².
    name : str, default "gyro force"
        Name of these error states.
    """

    along_sigma: float | Array
    across_sigma: float | Array = field(default_factory=lambda: np.zeros((3, 3)))
    gravity_f: Array = field(default_factory=lambda: np.array(GRAVITY_F))
    name: str = "gyro force"

    def __post_init__(self) -> None:
        """Check all; the states are the entries of G, row by row; xy is the bias about x per force along y."""
        fields = ("along_sigma", "across_sigma")
        components, sigma = _matrix(self.name, self.along_sigma, self.across_sigma, fields)
        gravity = array(f"{self.name}: gravity_f", self.gravity_f, (3,))
        self._set(components=components, units=("rad s/m",) * len(components), sigma=sigma, gravity_f=gravity)
        if not np.any(self.gravity_f):
            raise InputError(
                f"{self.name}: gravity_f is zero, and the specific force in free fall is zero; leave these error states out"
            )

    @property
    def gyro_force(self) -> Array:
        """One entry of G per state."""
        return _units_of_entries(self.components)

    @property
    def force_f(self) -> Array:
        """The reaction to gravity."""
        return -np.asarray(self.gravity_f)


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroTemperature(ErrorStates):
    """Slopes c of the gyro's bias over temperature, constant, driven by the record's temperature: ``ḃ = c Ṫ + n_u``.

    The filter's bias b is the whole bias, at the temperature of its time. Beyond the span, the temperature does not drive it.

    Parameters
    ----------
    slope_sigma : float or ndarray (3,)
        Standard deviation of the slope about each body axis, rad/s/K.
    span : (float, float), default (-inf, inf)
        Lowest and highest temperature, °C.
    name : str, default "gyro temperature"
        Name of these error states.
    """

    slope_sigma: float | Array
    span: tuple[float, float] = (-np.inf, np.inf)
    name: str = "gyro temperature"

    def __post_init__(self) -> None:
        """Check the standard deviation and the span."""
        sigma = _spread(f"{self.name}: slope_sigma", self.slope_sigma, "rad/s/K")
        if not self.span[0] < self.span[1]:
            raise InputError(f"{self.name}: span is {self.span}; its second temperature must be above the first")
        self._set(components=AXES, units=("rad/s/K",) * 3, sigma=sigma)


class _FirstOrder(ErrorStates):
    """Stationary first-order Gauss–Markov states with one correlation time."""

    correlation_time: float

    @property
    def decay(self) -> Array:
        """1/τ."""
        return np.full(3, 1.0 / self.correlation_time)

    @property
    def density(self) -> Array:
        """2σ²/τ."""
        return 2.0 * self.sigma**2 / self.correlation_time


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroGaussMarkov(_FirstOrder):
    """Gyro drift in addition to the bias: first-order Gauss–Markov. Several with different times together approximate flicker.

    Parameters
    ----------
    bias_sigma : float or ndarray (3,)
        Stationary standard deviation of the drift, rad/s, by body axis.
    correlation_time : float
        Correlation time of the drift, s.
    name : str, default "gyro drift"
        Name of these error states.
    """

    bias_sigma: float | Array
    correlation_time: float
    name: str = "gyro drift"
    components = AXES
    units = ("rad/s",) * 3

    def __post_init__(self) -> None:
        """Check all."""
        sigma = _spread(f"{self.name}: bias_sigma", self.bias_sigma, "rad/s")
        self._set(bias_sigma=sigma, sigma=sigma)
        positive(f"{self.name}: correlation_time", self.correlation_time, unit="s")

    @property
    def gyro_offset(self) -> Array:
        """One axis per state."""
        return np.eye(3)


@dataclass(frozen=True, kw_only=True, eq=False)
class VectorBias(ErrorStates):
    """A constant bias of a vector sensor in body axes: hard iron, accelerometer bias.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    bias_sigma : float or ndarray (3,)
        Initial standard deviation of the bias, by body axis, in the unit of the sensor's reference (1 for directions and headings).
    rate_random_walk : float, default 0.0
        Random walk of each component, in the unit of ``bias_sigma`` per √s (not rad/s/√s, as for a gyro).
    varying : bool, default False
        Whether the bias is constant while the magnitude of the measured field changes: see :attr:`Effect.varying`.
    unit : str, default "1"
        SI unit of the bias, for tables and messages.
    name : str, default "<sensor> bias"
        Name of these error states.
    """

    sensor: str
    bias_sigma: float | Array
    rate_random_walk: float = 0.0
    varying: bool = False
    unit: str = "1"
    name: str = ""
    components = AXES

    def __post_init__(self) -> None:
        """Check all."""
        self._set(name=self.name or f"{self.sensor} bias", units=(self.unit,) * 3)
        sigma = _spread(f"{self.name}: bias_sigma", self.bias_sigma, self.unit)
        self._set(bias_sigma=sigma, sigma=sigma)
        non_negative(f"{self.name}: rate_random_walk", self.rate_random_walk)

    @property
    def density(self) -> Array:
        """The square of the random walk."""
        return np.full(3, self.rate_random_walk**2)

    @property
    def effects(self) -> Mapping[str, Effect]:
        """One axis per state."""
        return {self.sensor: Effect(offset_b=np.eye(3), varying=self.varying)}


@dataclass(frozen=True, kw_only=True, eq=False)
class LeverArm(ErrorStates):
    """Position r of an accelerometer relative to the point that does not accelerate: ``f_b = −R_fbᵀ g + ([ẇ] + [w]²) r``, constant.

    Rate and angular acceleration come from the gyro (:func:`strapdown.estimation.angular_acceleration.turning`), whose noise adds to that
    of the sensor. Components whose σ is 0 are no states.

    Parameters
    ----------
    sensor : str
        Name of the accelerometer.
    arm_sigma : float or ndarray (3,)
        Standard deviation of each component of r, m, body axes.
    strength : float, default 9.80665
        Specific force by which the sensor's vector is divided, m/s²: 1 if it gives whole vectors in m/s².
    name : str, default "<sensor> lever arm"
        Name of these error states.
    """

    sensor: str
    arm_sigma: float | Array
    strength: float = STANDARD_GRAVITY
    name: str = ""

    def __post_init__(self) -> None:
        """Check all."""
        self._set(name=self.name or f"{self.sensor} lever arm")
        positive(f"{self.name}: strength", self.strength, unit="m/s²")
        spread = array(f"{self.name}: arm_sigma", np.broadcast_to(np.asarray(self.arm_sigma, np.float64), (3,)), (3,))
        for k, arm_sigma in enumerate(spread):
            non_negative(f"{self.name}: arm_sigma[{k}]", arm_sigma, unit="m")
        if not spread.any():
            raise InputError(f"{self.name}: arm_sigma is 0; give a value above zero, or leave these error states out")
        used = np.flatnonzero(spread)
        components = tuple(AXES[k] for k in used)
        self._set(arm_sigma=spread.copy(), components=components, units=("m",) * len(used), sigma=spread[used])

    @property
    def effects(self) -> Mapping[str, Effect]:
        """One axis per state."""
        used = np.flatnonzero(self.arm_sigma)
        return {self.sensor: Effect(lever=np.eye(3)[used] / self.strength)}


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorMounting(ErrorStates):
    """Mounting of a vector sensor: the small constant rotation θ from the body's axes to the sensor's, ``m = (I − [θ]×) R_fbᵀ r``.

    It is the C of attitude–bias–calibration filters. A common rotation of all sensors is not observable: declare no mounting for one of
    them; that sensor defines the body's axes. For a sensor of whole attitudes the mounting is a :class:`VectorBias`.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    mounting_sigma : float or ndarray (3,)
        Initial standard deviation of θ, rad, by body axis.
    name : str, default "<sensor> mounting"
        Name of these error states.

    Examples
    --------
    >>> mounting = SensorMounting(sensor="star", mounting_sigma=3e-3)
    >>> mounting.size, mounting.units
    (3, ('rad', 'rad', 'rad'))
    """

    sensor: str
    mounting_sigma: float | Array
    name: str = ""
    components = AXES
    units = ("rad",) * 3

    def __post_init__(self) -> None:
        """Check the deviation."""
        self._set(name=self.name or f"{self.sensor} mounting")
        sigma = _spread(f"{self.name}: mounting_sigma", self.mounting_sigma, "rad")
        self._set(mounting_sigma=sigma, sigma=sigma)

    @property
    def effects(self) -> Mapping[str, Effect]:
        """One axis per state."""
        axes = np.eye(3)
        return {self.sensor: Effect(scale=np.cross(axes[:, None], axes))}


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussMarkov(_FirstOrder):
    """First-order coloured noise of a vector sensor, stationary; for example the acceleration of a moving hand on an accelerometer.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    noise_sigma : float or ndarray (3,)
        Stationary standard deviation of each component, in the unit of the sensor's reference.
    correlation_time : float
        Correlation time, s.
    frame : {"body", "fixed"}, default "body"
        Axes in which the noise is correlated: an acceleration keeps its direction in the fixed frame while the body rotates. In
        ``"fixed"`` σ must be the same for all axes.
    varying : bool, default False
        Whether σ is constant while the magnitude of the measured field changes: see :attr:`Effect.varying`.
    unit : str, default "1"
        SI unit of the measured quantity.
    name : str, default "<sensor> disturbance"
        Name of these error states.
    """

    sensor: str
    noise_sigma: float | Array
    correlation_time: float
    frame: Literal["body", "fixed"] = "body"
    varying: bool = False
    unit: str = "1"
    name: str = ""
    components = AXES

    def __post_init__(self) -> None:
        """Check all."""
        self._set(name=self.name or f"{self.sensor} disturbance", units=(self.unit,) * 3)
        sigma = _spread(f"{self.name}: noise_sigma", self.noise_sigma, self.unit)
        self._set(noise_sigma=sigma, sigma=sigma)
        positive(f"{self.name}: correlation_time", self.correlation_time, unit="s")
        one_of(f"{self.name}: frame", self.frame, ("body", "fixed"))
        if self.frame == "fixed" and len(set(self.sigma)) > 1:
            raise InputError(f"{self.name}: noise_sigma differs by axis; in fixed axes give one for all")

    @property
    def effects(self) -> Mapping[str, Effect]:
        """One axis per state."""
        axes = np.eye(3)
        if self.frame == "body":
            return {self.sensor: Effect(offset_b=axes, varying=self.varying)}
        return {self.sensor: Effect(offset_f=axes, carried=True, varying=self.varying)}


@dataclass(frozen=True, kw_only=True, eq=False)
class BoundedVelocity(ErrorStates):
    """Acceleration of a moving hand in the accelerometer's measurement: stationary, with bounded velocity, in fixed axes.

    ``f_b = R_fbᵀ (a_f − g_f)`` with ``a = v̇``: on each axis ``v̇ = −v/τ_v + u``, ``u̇ = −u/τ_a + w``. The spectrum of a is that of
    first-order coloured noise at high frequency and vanishes at zero, as for every body that stays near one place; a constant part of the
    noise would appear as tilt. With ``position_time`` the position is bounded too: ``ṗ = −p/τ_p + s``, ``ṡ = −s/τ_v + u``, ``v = ṗ``.

    The noise is isotropic. The σ of the acceleration is ``σ_v √(λ_p λ_v + (λ_p + λ_v) λ_a)`` with λ = 1/τ (λ_p = 0 without a bounded
    position).

    Parameters
    ----------
    sensor : str
        Name of the accelerometer.
    velocity_time : float
        Time constant τ_v of the velocity, s.
    velocity_sigma : float
        Stationary σ of each component of v, m/s, fixed axes.
    acceleration_time : float
        Time constant τ_a of the acceleration, s.
    position_time : float, default 0.0
        Time constant τ_p of the position, s; 0: the position is not bounded and is no state.
    strength : float, default 9.80665
        Specific force by which the sensor's vector is divided, m/s²: 1 if it gives whole vectors in m/s².
    name : str, default "<sensor> velocity"
        Name of these error states.
    """

    sensor: str
    velocity_time: float
    velocity_sigma: float
    acceleration_time: float
    position_time: float = 0.0
    strength: float = STANDARD_GRAVITY
    name: str = ""

    def __post_init__(self) -> None:
        """Check all."""
        self._set(name=self.name or f"{self.sensor} velocity")
        for field_name, unit in (
            ("velocity_time", "s"),
            ("velocity_sigma", "m/s"),
            ("acceleration_time", "s"),
            ("strength", "m/s²"),
        ):
            positive(f"{self.name}: {field_name}", getattr(self, field_name), unit=unit)
        non_negative(f"{self.name}: position_time", self.position_time, unit="s")

    @property
    def _rates(self) -> Array:
        """1/τ of the states of one axis."""
        times = (self.position_time, self.velocity_time, self.acceleration_time)
        return 1.0 / np.array(times[0 if self.position_time > 0.0 else 1 :])

    @property
    def components(self) -> tuple[str, ...]:  # type: ignore[override]
        """For each axis velocity v and drive u; with a bounded position p, s and u, with velocity ``s − p/τ_p``."""
        words = ("position", "velocity drive", "drive") if self.position_time > 0.0 else ("velocity", "drive")
        return tuple(f"{word} {axis}" for axis in AXES for word in words)

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        """Unit of each state."""
        return ("m", "m/s", "m/s²")[3 - len(self._rates) :] * 3

    @property
    def covariance(self) -> Array:
        """Stationary covariance."""
        return stationary_covariance(self.decay, self.density, self.feed)

    @property
    def sigma(self) -> Array:  # type: ignore[override]
        """Stationary standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def decay(self) -> Array:
        """1/τ."""
        return np.tile(self._rates, 3)

    @property
    def density(self) -> Array:
        """``2 σ_v² (d₁ d₂ − d₀)`` of each drive, with dᵢ the coefficients of ``∏ (s + 1/τ) = s³ + d₂ s² + d₁ s + d₀``."""
        _, d2, d1, d0 = np.append(np.poly(-self._rates), np.zeros(3 - len(self._rates)))
        spectral = np.zeros(len(self._rates))
        spectral[-1] = 2.0 * self.velocity_sigma**2 * (d1 * d2 - d0)
        return np.tile(spectral, 3)

    @property
    def feed(self) -> Array:
        """1 between the states of one axis."""
        return np.tile(np.append(np.ones(len(self._rates) - 1), 0.0), 3)

    @property
    def effects(self) -> Mapping[str, Effect]:
        """The acceleration, from the states of each axis."""
        rates = self._rates
        a = np.array([-rates[0], 1.0])
        if len(rates) == 3:
            a = np.array([rates[0] ** 2, -rates[0] - rates[1], 1.0])
        return {self.sensor: Effect(offset_f=np.kron(np.eye(3), a[:, None]) / self.strength, carried=True)}


def spans(blocks: Sequence[ErrorStates]) -> list[tuple[ErrorStates, slice]]:
    """Return each declaration with the place of its states among those of all."""
    ends = list(accumulate(len(block.components) for block in blocks))
    return [(block, slice(end - len(block.components), end)) for block, end in zip(blocks, ends, strict=True)]


def temperature_slopes(blocks: Sequence[ErrorStates]) -> slice | None:
    """Return the place of the slopes of the gyro bias over temperature among the error states; None if there are none."""
    return next((place for block, place in spans(blocks) if isinstance(block, GyroTemperature)), None)


def check(blocks: tuple[ErrorStates, ...]) -> None:
    """Refuse objects that are no declarations of error states, and names used twice."""
    names: list[str] = []
    for block in blocks:
        if not isinstance(block, ErrorStates):
            raise InputError(f"{block!r} declares no error states; subclass ErrorStates")
        if block.name in names:
            raise InputError(f"two declarations of error states are named {block.name!r}; give each a different name")
        names.append(block.name)
        if len(block.units) != block.size:
            raise InputError(f"{block.name}: {len(block.units)} units for {block.size} components; give one each")
        _spread(f"{block.name}: sigma", block.sigma, "", block.size)
