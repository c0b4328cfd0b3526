"""The filter of N error states as data: its structure, known while its kernels are compiled, and the arrays on which they work.

A number of the model is an *entry*: 0 or 1, which cost nothing at run time, or a place in the array ``numbers`` of the filter, as a tuple
of one index. :func:`strapdown.estimation.model.assemble` makes a structure from the declarations of error states.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

SHORT_FORM, SHORT_FORM_SINGLE = 1000.0, 100.0
"""Maximum ratio of an innovation's variance to the measurement's for the short form ``P − Σ g gᵀ`` of an update, which loses as many digits
as the ratio has; and that in single precision."""
MAX_PRECISION, MAX_PRECISION_SINGLE = 5e13, 2.0**23
"""Maximum such ratio of all: a covariance in double precision then keeps three digits; and that in single precision."""


class GyroState(NamedTuple):
    """An error state c that enters the gyro, which measures ``(I + Σ c T) w + b + Σ c e + Σ c G R_fbᵀ f + n``."""

    state: int
    offset: tuple[Any, ...]
    """e (3)."""
    decay: int
    """Set of coefficients of a state with an offset e that decays or is driven; −1: constant."""
    scale: tuple[Any, ...]
    """T (9)."""
    force: tuple[Any, ...]
    """G (9)."""


class SensorState(NamedTuple):
    """An error state c that enters a sensor, which measures ``(I + Σ c U) R_fbᵀ (r + Σ c d) + Σ c a + v``."""

    state: int
    offset: tuple[Any, ...]
    """a (3), body axes."""
    lever: bool
    """Whether the offset is W a instead, ``W = [ẇ] + [w]²``: the acceleration at lever arm a."""
    fixed: tuple[Any, ...]
    """d (3), fixed axes."""
    carried: bool
    """Whether d rotates with corrections of the estimated attitude, so that the derivative by the attitude omits it."""
    scale: tuple[Any, ...]
    """U (9)."""


class Sensor(NamedTuple):
    """Sensors of one kind, with the same states."""

    kind: int
    """Code of :mod:`strapdown.kernels.measurement`."""
    isotropic: bool
    """Whether one σ gives the noise, or three variances that of an attitude; otherwise it is a covariance in body axes."""
    states: tuple[SensorState, ...]


class Structure(NamedTuple):
    """Structure of a filter with n error states: attitude (3), gyro bias (3), and those declared, in their order."""

    n: int
    gyro: tuple[GyroState, ...]
    chains: tuple[tuple[tuple[int, ...], int], ...]
    """States that decay or are driven, in chains of one to three, each with its set of coefficients."""
    vectors: tuple[tuple[int, int, int], ...]
    """States (x, y, z) that form a vector that is carried with the estimated attitude."""
    sensors: tuple[Sensor, ...]
    slopes: int = 0
    """First of the three slopes of the gyro bias over temperature; 0: none."""


SIX_STATES = Structure(6, (), (), (), ())
"""Attitude and gyro bias."""


# ----------------------------------------------------------------------------------------------------------------- known at run time


class Model(NamedTuple):
    """Numbers of the model; of runs that differ in them, flat arrays whose last axis is that of the runs."""

    angle_variance: float
    """σ_v², rad²/s."""
    rate_variance: float
    """σ_u², rad²/s³."""
    numbers: np.ndarray
    """Values of the entries of the structure."""
    decay: np.ndarray
    """λ of each error state (m,), 1/s."""
    chains: np.ndarray
    """Coupling of each state to the next, and PSD of its driving noise (m, 2)."""
    last: np.ndarray
    """Last error state of the chain of each set of coefficients (sets,)."""
    limit: float
    """Longest step, s, for states that decay."""
    force_f: tuple[float, float, float]
    """Specific force of the body at rest, fixed axes, m/s²."""


class Measured(NamedTuple):
    """A measurement."""

    z: tuple[Any, ...]
    """Measured vector over ``length`` (3), or the three variances of an attitude."""
    frame: tuple[Any, ...]
    """Right-handed frame about the reference by rows (9); of an attitude the measured quaternion first."""
    noise: tuple[Any, ...]
    """Covariance in body axes (6); only the first number, a variance, if it is isotropic."""
    length: float
    """Divisor of the effects of error states."""
    turning: tuple[Any, ...]
    """Measured rate, angular acceleration, and the latter's variances per axis (9), for lever arms."""


class Body(NamedTuple):
    """State, model and work space. Row 0 of the states is the filter, row 1 the restart candidate of a gate."""

    model: Model
    x: np.ndarray
    """q, b and c (2, N + 1)."""
    P: np.ndarray
    """(2, numbers of P in its layout)"""
    coefficients: np.ndarray
    """Sets of coefficients of the step ``dt`` (sets × 16)."""
    dt: np.ndarray
    """(1,), s"""
    work: np.ndarray
    """Lines of rows, gains and other vectors of the size of the state."""
    shape: np.ndarray
    """Index in :attr:`Structure.sensors` of each sensor."""
    length: np.ndarray
    """Divisor of the effects of error states on each measurement, in order of time (events,)."""
    turning: np.ndarray
    """Rate, angular acceleration and its variances at each measurement (events, 9); (0, 9) without lever arms."""
    offsets: np.ndarray
    """Effect e of each error state on the gyro as an offset (m, 3), for the whole bias."""
    factors: np.ndarray = np.empty(0)
    """Factor on σ about each body axis of each sensor (sensors × 3 × runs), of runs that differ in noise."""
    warming: np.ndarray = np.empty(0)
    """Change of temperature over time in each gyro interval (n,), K/s; empty without slopes of the bias."""
    warming_now: np.ndarray = np.empty(0)
    """That in the present interval (1,)."""
    root: np.ndarray = np.empty(0)
    """Lines r of a root of P, ``P = Σ r rᵀ`` (N²), of one run."""


class Outputs(NamedTuple):
    """Output arrays: a row for each stored edge; innovations by measurement."""

    x: np.ndarray
    """q, b and c (rows, N + 1)."""
    variance: np.ndarray
    """(rows, N)"""
    covariance: np.ndarray
    """Covariance of the first m states (rows, m, m), or (0, m, m)."""
    whole_variance: np.ndarray
    """Variances of attitude and whole gyro bias (rows, 6), or (0, 6)."""
    whole_covariance: np.ndarray
    """(rows, 6, 6), or (0, 6, 6)."""
    innovation: np.ndarray
    """e₁, s₁, e₂, s₂, e₃, s₃ (events, 4 or 6)."""
    segments: np.ndarray
    """Each prediction, for a smoother: dt, increment (3), x, upper triangle of P by rows."""


class Progress(NamedTuple):
    """State of the walk: all else is in arrays."""

    segments: int
    """Number of predictions stored."""
    lost: bool
    """Whether a measurement was too precise for double precision."""


class Effects(NamedTuple):
    """Effects of the states on a sensor: of each state on the offset, and their sums."""

    offsets: tuple[Any, ...]
    """Offset in body axes by each state."""
    fixed_each: tuple[Any, ...]
    scales: tuple[Any, ...]
    offset: tuple[Any, ...]
    """Sum of the offsets in body axes."""
    fixed: tuple[Any, ...]
    carried: tuple[Any, ...]
    """Sums of the constant and of the carried offsets in fixed axes."""
    M: tuple[Any, ...]
    """Σ c U"""


class Gains(NamedTuple):
    """A measurement at a state, with up to three rows h of independent noise that are processed one after the other."""

    gain: tuple[Any, ...]
    """g of each row: P h, given the rows before it, over the root of its innovation's variance."""
    step: tuple[Any, ...]
    """Correction of the state, in chunks (:mod:`strapdown.kernels.layout`)."""
    errors: tuple[Any, ...]
    """Innovations, and their variances."""
    variances: tuple[Any, ...]
    reported: tuple[Any, ...]
    """Innovations, NaN for the heading of a vertical vector."""
    precise: Any
    """Whether a row is too precise for the short form of the update."""
    shares: tuple[Any, ...]
    """Entries (10, 20, 21) of L in ``H P Hᵀ + R = L D Lᵀ``."""
    noise: tuple[Any, ...]
    """Variances of the rows, R, and their residuals."""
    residuals: tuple[Any, ...]
    angle: tuple[Any, ...]
    """Squared sine and cosine of the angle between the measured and the predicted vector."""
    valid: Any
    """Whether it has information: not the heading of a vertical vector."""
    nis: Any
