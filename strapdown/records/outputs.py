"""An estimate in usual forms: Euler angles with σ, heading from North, North-East-Down, free acceleration, tables.

The fixed frame of an estimate is East-North-Up (z up with an arbitrary heading without a magnetometer), and ``q_fb`` takes body
vectors to it. Rotation matrices and SciPy rotations are :func:`strapdown.quaternion.to_matrix` and
:func:`strapdown.quaternion.to_rotation`.

Covariances are those of the body-side error, ``q_true = q_est ⊗ exp(δθ)``. An estimate that kept variances alone has no
correlations between axes; σ of angles is then that of a diagonal covariance (``full_covariance=True`` keeps the whole).
"""

from __future__ import annotations

import itertools
import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, one_of, unit_quaternions
from strapdown.kinematics import skew
from strapdown.records.recording import Recording
from strapdown.units import DEGREE, DEGREE_PER_HOUR, STANDARD_GRAVITY

if TYPE_CHECKING:
    from strapdown.records.record import Estimate

__all__ = [
    "Angles",
    "euler",
    "heading",
    "table",
]

FRAMES = ("ENU", "NED")
NED_OF_ENU = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
"""Turns East-North-Up to North-East-Down and back: half a turn about the horizontal line to the north-east."""
NAMES = {"Z": "yaw", "Y": "pitch", "X": "roll"}
"""Names of the angles of a sequence of three different axes."""


class Angles(NamedTuple):
    """Angles with their standard deviations.

    Parameters
    ----------
    angles : ndarray (n, 3) or (n,)
        Angles, rad.
    sigma : ndarray, optional
        Standard deviations in the same shape, rad; None without a covariance, infinite in gimbal lock.
    """

    angles: Array
    sigma: Array | None


def attitude_covariance(estimate: Estimate) -> Array:
    """Return the covariance (m, 3, 3) of an estimate's attitude error, rad², body axes; diagonal where only variances were kept."""
    if estimate.covariance is not None:
        return np.asarray(estimate.covariance[:, :3, :3])
    result = np.zeros((len(estimate.time), 3, 3))
    result[:, [0, 1, 2], [0, 1, 2]] = estimate.variance[:, :3]
    return result


def euler(attitude: ArrayLike, sequence: str = "ZYX", covariance: ArrayLike | None = None) -> Angles:
    """Return Euler angles of attitudes, and their standard deviations.

    Parameters
    ----------
    attitude : array_like (n, 4)
        Unit quaternions q_fb.
    sequence : str, default "ZYX"
        Axes of the three rotations in SciPy's notation: capitals about the rotating body axes (``"ZYX"``: yaw, pitch, roll), small
        letters about the fixed ones. Neighbours must differ.
    covariance : array_like (n, 3, 3), optional
        Covariance of the body-side attitude error, rad².

    Returns
    -------
    Angles
        ``angles`` (n, 3) in the order of the sequence, rad. To first order ``δθ = E δφ``, the columns of E being the axes of the
        three rotations in the body frame, so that ``σ²`` is the diagonal of ``E⁻¹ P E⁻ᵀ``.

    Examples
    --------
    >>> euler([[1.0, 0.0, 0.0, 0.0]]).angles.tolist()
    [[0.0, 0.0, 0.0]]
    """
    q = unit_quaternions("attitude", array("attitude", attitude, ("n", 4)))
    axes = [*sequence.upper()]
    repeated = any(a == b for a, b in itertools.pairwise(axes))
    if len(axes) != 3 or set(axes) - set("XYZ") or sequence not in (sequence.upper(), sequence.lower()) or repeated:
        raise InputError(
            f"sequence is {sequence!r}; give three axes such as ZYX (body) or xyz (fixed), neighbours different"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gimbal lock: σ says it
        angles = np.asarray(quaternion.to_rotation(q).as_euler(sequence), np.float64)
    if covariance is None:
        return Angles(angles, None)
    P = array("covariance", covariance, (len(q), 3, 3))
    intrinsic = sequence == sequence.upper()
    E = _turn_axes(angles, sequence)
    regular = np.abs(np.linalg.det(E)) > 1e-9
    variance = np.full((len(q), 3), np.inf)
    inverse = np.linalg.inv(E[regular])
    variance[regular] = np.einsum("nij,njk,nik->ni", inverse, P[regular], inverse)
    sigma = np.sqrt(variance)
    return Angles(angles, sigma if intrinsic else sigma[:, ::-1])


def euler_axes(attitude: ArrayLike, sequence: str = "ZYX") -> Array:
    """Return E (n, 3, 3) of ``δθ = E δφ``: its columns are the axes of the three turns of an intrinsic sequence, in the body frame."""
    return _turn_axes(euler(attitude, sequence).angles, sequence)


def _turn_axes(angles: Array, sequence: str) -> Array:
    axes = [*sequence.upper()]
    order = (
        [0, 1, 2] if sequence == sequence.upper() else [2, 1, 0]
    )  # turns about fixed axes are those about body axes, the last first
    directions = np.eye(3)[["XYZ".index(axes[k]) for k in order]]
    half = 0.5 * angles[:, order]
    turns = [
        np.concatenate([np.cos(half[:, k : k + 1]), np.sin(half[:, k : k + 1]) * directions[k]], axis=1)
        for k in range(3)
    ]
    E = np.empty((len(angles), 3, 3))
    E[:, :, 2] = directions[2]
    E[:, :, 1] = quaternion.rotate(quaternion.conjugate(turns[2]), directions[1])
    E[:, :, 0] = quaternion.rotate(quaternion.conjugate(quaternion.multiply(turns[1], turns[2])), directions[0])
    return E


def heading(attitude: ArrayLike, covariance: ArrayLike | None = None, *, axis: str = "x") -> Angles:
    """Return the heading of a body axis, its angle from North towards East, and its standard deviation.

    Parameters
    ----------
    attitude : array_like (n, 4)
        Unit quaternions q_fb, fixed frame East-North-Up. North is that of the estimate: magnetic with a magnetometer, arbitrary
        without.
    covariance : array_like (n, 3, 3), optional
        Covariance of the body-side attitude error, rad².
    axis : {"x", "y", "z", "-x", "-y", "-z"}, default "x"
        Body axis that points forward.

    Returns
    -------
    Angles
        Heading (n,), rad in [0, 2π); σ is infinite where the axis points up or down.

    Examples
    --------
    >>> heading([[1.0, 0.0, 0.0, 0.0]]).angles.round(6).tolist()  # x points East
    [1.570796]
    """
    q = unit_quaternions("attitude", array("attitude", attitude, ("n", 4)))
    one_of("axis", axis, ("x", "y", "z", "-x", "-y", "-z"))
    forward = np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)
    R = quaternion.to_matrix(q)
    v = R @ forward
    angle = np.mod(np.arctan2(v[:, 0], v[:, 1]), 2.0 * np.pi)
    if covariance is None:
        return Angles(angle, None)
    P = array("covariance", covariance, (len(q), 3, 3))
    change = -R @ skew(forward)  # d(R f)/dδθ
    level = v[:, 0] ** 2 + v[:, 1] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        row = (v[:, 1, None] * change[:, 0] - v[:, 0, None] * change[:, 1]) / level[:, None]
        sigma = np.sqrt(np.einsum("ni,nij,nj->n", row, P, row))
    return Angles(angle, np.where(level > 1e-18, sigma, np.inf))


def to_ned(attitude: ArrayLike) -> Array:
    """Return attitudes q_fb (n, 4) relative to East-North-Up as relative to North-East-Down, or back: half a turn either way."""
    return quaternion.multiply(NED_OF_ENU, array("attitude", attitude, (..., 4)))


def free_acceleration(attitude: Array, specific_force: Array) -> Array:
    """Return the acceleration without gravity (n, 3), ``R f − g up``, m/s², fixed axes; ``specific_force`` (n, 3) may be NaN."""
    felt = np.einsum("nij,nj->ni", quaternion.to_matrix(attitude), specific_force)
    return np.asarray(felt - np.array([0.0, 0.0, STANDARD_GRAVITY]))


def table(
    estimate: Estimate, *, recording: Recording | None = None, sequence: str = "ZYX", frame: str = "ENU"
) -> dict[str, NDArray[np.generic]]:
    """Return an estimate as columns, the unit in each name.

    Parameters
    ----------
    estimate : Estimate
        Estimate.
    recording : Recording, optional
        Recording that the estimate was made from: adds its clock, its rate without the bias, and its acceleration without gravity.
    sequence : str, default "ZYX"
        Sequence of the Euler angles, as in :func:`euler`.
    frame : {"ENU", "NED"}, default "ENU"
        Fixed frame of quaternion, angles and acceleration; body axes stay as they are.

    Returns
    -------
    dict of str to ndarray (m,)
        ``time_s`` (or ``time_ns`` of a clock that counts from 1970), ``qw qx qy qz``, the angles and their σ in degrees,
        ``heading_deg`` of the body x axis from North towards East, bias and σ in °/h, ``rate_*_rad_per_s``,
        ``free_acceleration_*_m_per_s2``. Where whole covariances were kept, ``cov_body_xx_rad2`` … of the body-side error,
        ``b`` before an axis for the bias.

    Raises
    ------
    InputError
        If a time of the estimate is not a stamp of the recording.
    """
    one_of("frame", frame, FRAMES)
    P = attitude_covariance(estimate)
    q = estimate.attitude if frame == "ENU" else to_ned(estimate.attitude)
    found: dict[str, NDArray[np.generic]] = _clock(estimate, recording)
    found |= {f"q{name}": q[:, k] for k, name in enumerate("wxyz")}
    angles = euler(q, sequence, P)
    assert angles.sigma is not None
    for k, name in enumerate(_angle_names(sequence)):
        found[f"{name}_deg"] = angles.angles[:, k] / DEGREE
        found[f"{name}_sigma_deg"] = angles.sigma[:, k] / DEGREE
    north = heading(estimate.attitude, P)
    assert north.sigma is not None
    found |= {"heading_deg": north.angles / DEGREE, "heading_sigma_deg": north.sigma / DEGREE}
    sigma = estimate.sigma
    for k, axis in enumerate("xyz"):
        found[f"bias_{axis}_deg_per_h"] = estimate.bias[:, k] / DEGREE_PER_HOUR
        found[f"bias_{axis}_sigma_deg_per_h"] = sigma[:, 3 + k] / DEGREE_PER_HOUR
    if estimate.covariance is not None:
        size = 6 if np.isfinite(estimate.covariance[:, 3:, 3:]).any() else 3
        for i, j in itertools.combinations_with_replacement(range(size), 2):
            unit = ("rad2", "rad2_per_s", "rad2_per_s2")[(i > 2) + (j > 2)]
            found[f"cov_body_{_STATES[i]}{_STATES[j]}_{unit}"] = estimate.covariance[:, i, j]
    if recording is not None:
        rows = rows_of(estimate, recording)
        rate = recording.rate[rows] - estimate.bias
        found |= {f"rate_{axis}_rad_per_s": rate[:, k] for k, axis in enumerate("xyz")}
        if recording.specific_force is not None:
            free = free_acceleration(estimate.attitude, recording.specific_force[rows])
            free = free if frame == "ENU" else free[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
            found |= {f"free_acceleration_{axis}_m_per_s2": free[:, k] for k, axis in enumerate("xyz")}
    return found


_STATES = ("x", "y", "z", "bx", "by", "bz")


def _angle_names(sequence: str) -> list[str]:
    axes = sequence.upper()
    return (
        [NAMES[axis] for axis in axes]
        if len(set(axes)) == 3
        else [f"angle_{k + 1}_{axis.lower()}" for k, axis in enumerate(axes)]
    )


def rows_of(estimate: Estimate, recording: Recording) -> NDArray[np.int64]:
    """Return the row of the recording of each time of an estimate, all of which are its stamps."""
    rows = np.clip(np.searchsorted(recording.time, estimate.time - 1e-7), 0, len(recording.time) - 1)
    off = np.abs(recording.time[rows] - estimate.time)
    if off.max() > 1e-6:
        k = int(np.argmax(off))
        raise InputError(
            f"{recording.source} has no stamp {estimate.time[k]:.6g} s, which the estimate has; give the recording that it was made from"
        )
    return np.asarray(rows)


def _clock(estimate: Estimate, recording: Recording | None) -> dict[str, NDArray[np.generic]]:
    if recording is None or not recording.epoch_ns:
        return {"time_s": estimate.time}
    return {"time_ns": np.rint(estimate.time * 1e9).astype(np.int64) + recording.epoch_ns}


def to_dataframe(estimate: Estimate, **options: Any) -> Any:
    """Return an estimate as a pandas ``DataFrame`` of the columns of :func:`table`, one row a time; options as there."""
    try:
        import pandas
    except ImportError:
        raise InputError("a DataFrame needs pandas; pip install 'strapdown[formats]'") from None
    return pandas.DataFrame(table(estimate, **options))
