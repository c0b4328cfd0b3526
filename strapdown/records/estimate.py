"""The estimate of a filter, its parts, and its columns as a table."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import quaternion
from strapdown.checks import (
    Array,
    InputError,
    are_finite,
    array,
    increasing,
    instance,
    numbers,
    one_of,
    symmetric,
    unit_quaternions,
)
from strapdown.files import library
from strapdown.records import outputs
from strapdown.records.record import Origin, Truth
from strapdown.records.recording import whole_ns
from strapdown.results import ByValue, Column, Listed, Table, figure
from strapdown.units import DEGREE, DEGREE_PER_HOUR, error_state_name, error_state_unit

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@dataclass(frozen=True, kw_only=True, eq=False)
class Innovations(ByValue):
    """Innovations of one sensor, in the order of its measurements.

    Parameters
    ----------
    time : ndarray (m,)
        Times of the measurements used, s.
    innovation : ndarray (m, dof)
        Decorrelated innovations: each is reduced by its prediction from those before it in the row. Unit: rad, or the sensor's unit over
        the length of its reference.
    variance : ndarray (m, dof)
        Variances of the innovations predicted by the filter, the square of their unit.
    weight : ndarray (m,), optional
        Weight of each measurement in the update: 1 full, 0 rejected by a gate, in between for a robust update; None: all 1.
    """

    time: Array
    innovation: Array
    variance: Array
    weight: Array | None = None

    @property
    def used(self) -> np.ndarray:
        """Mask (m,) of the measurements that were not rejected."""
        return np.ones(len(self.time), bool) if self.weight is None else np.asarray(self.weight > 0.0)

    @property
    def refused(self) -> int:
        """Number of measurements rejected."""
        return int(np.sum(~self.used))

    @property
    def whitened(self) -> Array:
        """Innovations divided by their standard deviations (m, dof): independent standard normal if the filter is consistent."""
        return np.asarray(self.innovation / np.sqrt(self.variance))

    @property
    def nis(self) -> Array:
        """Normalised innovation squared (m,), χ² with dof degrees of freedom if the filter is consistent."""
        return np.asarray(np.sum(self.innovation**2 / self.variance, axis=1))


SINGLE_ROUNDING = 1e-6
"""Asymmetry of a covariance, in units of σᵢσⱼ, that a filter in single precision may have."""

EVENT_KINDS = ("recovery", "lock-out", "gap")
"""Kinds of :class:`Event`."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """An event in a run that a user of the estimate must know.

    Parameters
    ----------
    kind : {"recovery", "lock-out", "gap"}
        Kind of event, in this order: a filter that rejected good measurements was restarted; a gate rejected a sensor more often than it
        accepted it; gyro samples were missing for much longer than the sample interval.
    start : float
        Time of its beginning, s.
    end : float
        Time of its end, s: the recovery, the last rejection, the next gyro sample.
    sensor : str, default ""
        Sensor concerned, if any.
    value : float, default 0.0
        Recovery: number of consecutive rejections. Lock-out: number of rejections. Gap: its duration over the median sample interval.
    """

    kind: str
    start: float
    end: float
    sensor: str = ""
    value: float = 0.0

    def __str__(self) -> str:
        """Describe the event in one line."""
        if self.kind == "recovery":
            return (
                f"Recovered at {self.end:.6g} s: {self.value:.0f} measurements of {self.sensor} in a row were rejected and agreed with "
                f"each other from {self.start:.6g} s on; the estimate in between is wrong."
            )
        if self.kind == "lock-out":
            return (
                f"Locked out from {self.start:.6g} s to {self.end:.6g} s: {self.value:.0f} measurements of {self.sensor} were rejected, "
                "more than were accepted, and no restart agreed with them: the sensor, its sigma or the filter is wrong there."
            )
        return f"Gap of {self.end - self.start:.3g} s after {self.start:.6g} s: the rotation across it is assumed to be at constant rate."


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorStateEstimate(ByValue):
    """Estimate of one group of error states (:mod:`strapdown.estimation.error_states`) at the stored edges.

    Parameters
    ----------
    components : tuple of str
        Name of each component.
    units : tuple of str
        Unit of each component.
    values : ndarray (m, size)
        Estimates in ``units``.
    variance : ndarray (m, size)
        Variances, the square of the units.
    """

    components: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    variance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations (m, size)."""
        return np.sqrt(self.variance)

    def summary(self) -> dict[str, Any]:
        """Return the estimate at the end and its σ at both ends as plain values for JSON.

        Returns
        -------
        dict
            ``components``, ``units``, and by component ``values``, ``sigma`` and ``first_sigma``.
        """
        ends = {"values": self.values[-1], "sigma": self.sigma[-1], "first_sigma": self.sigma[0]}
        names = {"components": list(self.components), "units": list(self.units)}
        return names | {name: value.tolist() for name, value in ends.items()}


def matrices(name: str, value: ArrayLike, m: int) -> Array:
    """Return covariances (m, 3, 3) or (m, 6, 6) of attitude or attitude and bias; NaN at times without an estimate."""
    P = numbers(name, value, allow_nan=True)
    if P.shape not in ((m, 3, 3), (m, 6, 6)):
        raise InputError(f"{name} has shape {P.shape}, wanted ({m}, 3, 3) or ({m}, 6, 6), a matrix for each time")
    negative = np.argwhere(np.diagonal(P, axis1=1, axis2=2) < 0.0)
    if len(negative):
        k, i = negative[0]
        raise InputError(
            f"{name}[{k}, {i}, {i}] is {P[k, i, i]:g}, but a variance is not negative; give the covariance"
        )
    return symmetric(name, array(name, P, P.shape, allow_nan=True), SINGLE_ROUNDING)


def _checked(sensor: str, innovations: Innovations) -> Innovations:
    """Return innovations of another filter with their arrays checked."""
    instance(f"innovations of {sensor}", innovations, Innovations, "give strapdown.records.Innovations")
    time = array(f"{sensor}: time", innovations.time, ("m",))
    return replace(
        innovations,
        time=time,
        innovation=array(f"{sensor}: innovation", innovations.innovation, (len(time), "dof")),
        variance=array(f"{sensor}: variance", innovations.variance, (len(time), "dof")),
        weight=None if innovations.weight is None else array(f"{sensor}: weight", innovations.weight, (len(time),)),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate(ByValue, Listed):
    """Attitude and gyro bias with their covariance, at the stored epochs of a filter run.

    Parameters
    ----------
    time : ndarray (m,)
        Times of the stored edges, s.
    attitude : ndarray (m, 4)
        Unit quaternions q_fb.
    bias : ndarray (m, 3)
        Gyro bias, rad/s, body axes. NaN if it is not estimated.
    variance : ndarray (m, 6)
        Diagonal of P: attitude error, rad², body axes; bias error, (rad/s)². NaN if it is not known.
    covariance : ndarray (m, 6, 6), optional
        Full P of (δθ, δb), if requested. NaN if it is not known.
    innovations : mapping of str to Innovations, default empty
        Innovations by sensor.
    skipped : mapping of str to int, default empty
        Number of measurements not used, by sensor: missing (NaN) ones and those outside the record's time.
    events : tuple of Event, default empty
        Events of the run that a user of the estimate must know, in order of time.
    error_states : mapping of str to ErrorStateEstimate, default empty
        Error states c by name, in the order given.
    whole_covariance : ndarray (m, n, n), optional
        P of (δθ, δb, δc) of a filter with error states, if requested; ``covariance`` is its part (m, 6, 6).
    setup : strapdown.estimation.setup.FilterSetup, optional
        The filter.
    origin : Origin, optional
        Scenario and random streams of the record, or the file it was read from.
    truth : Truth, optional
        Truth at ``time``, or a reference, NaN where it is not known.
    fixed_frame : str, default ""
        Fixed frame of the attitude in words, if it is not that of the record's references.
    motion : str, default ""
        For a recording: model of its motion (:data:`strapdown.ahrs.MOTIONS`). Its noise covers disturbances that last over many samples,
        so that σ are upper bounds.
    smoothed : bool, default False
        Whether each epoch is estimated from all measurements, before and after it.
    remarks : tuple of str, default empty
        What a user of the estimate should know, one sentence each: how the filter was started, choices of the reader.
    details : mapping of str to number or str, default empty
        Further particulars for the reader of a file, such as parameters of the unit's model.
    """

    _drawn_by = "estimate_overview"

    time: Array
    attitude: Array
    bias: Array
    variance: Array
    covariance: Array | None = None
    innovations: Mapping[str, Innovations] = field(default_factory=dict)
    skipped: Mapping[str, int] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    error_states: Mapping[str, ErrorStateEstimate] = field(default_factory=dict)
    whole_covariance: Array | None = None
    setup: Any = None
    origin: Origin | None = None
    truth: Truth | None = None
    fixed_frame: str = ""
    motion: str = ""
    smoothed: bool = False
    remarks: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def extent(self) -> str:
        """Numbers of epochs and measurements, and what its errors can be known from, in words."""
        measurements = sum(len(innovations.time) for innovations in self.innovations.values())
        truth = "without truth"
        if self.truth is not None:
            truth = "with its truth" if self.truth.has_bias else "with a reference attitude"
        span = self.time[-1] - self.time[0]
        return f"{len(self.time)} epochs over {span:.6g} s, {measurements} measurements, {truth}"

    def listing(self) -> Table:
        """Return σ at the start and at the end, the estimate at the end, and the innovations, as a table."""
        rows: list[tuple[Any, ...]] = []
        for k in range(6 if self.has_bias else 3):
            name, unit, size = ("attitude", "°", DEGREE) if k < 3 else ("gyro bias", "°/h", DEGREE_PER_HOUR)
            value = "" if k < 3 else self.bias[-1, k - 3] / size
            rows.append((f"{name} {'xyz'[k % 3]}", unit, value, *self.sigma[[-1, 0], k] / size))
        for name, states in self.error_states.items():
            for k, (component, unit) in enumerate(zip(states.components, states.units, strict=True)):
                label, (word, size) = error_state_name(name, component, unit), state_unit(self, name, unit)
                rows.append((label, word, states.values[-1, k] / size, *states.sigma[[-1, 0], k] / size))
        notes = [f"Attitude at the end, q_fb (w, x, y, z): {', '.join(f'{q:.6f}' for q in self.attitude[-1])}"]
        if "East-North-Up" in self.fixed_frame:
            P = None if self.covariance is None else self.covariance[-1:, :3, :3]
            angles = outputs.heading(self.attitude[-1:], P)
            sigma = "" if angles.sigma is None else f", σ {angles.sigma[0] / DEGREE:.3g}°"
            tilt = float(np.arccos(np.clip(quaternion.to_matrix(self.attitude[-1])[2, 2], -1.0, 1.0)))
            notes.append(
                f"Heading of the body x axis at the end: {angles.angles[0] / DEGREE:.2f}°{sigma}; of the z axis from the vertical: "
                f"{tilt / DEGREE:.2f}°"
            )
        for sensor, innovations in self.innovations.items():
            used = innovations.used
            nis = "none used"
            if used.any():
                mean = np.mean(innovations.nis[used]) / innovations.innovation.shape[1]
                nis = f"mean NIS per degree of freedom {figure(mean, 3)}"
            gate = f", {innovations.refused} rejected by the gate" if innovations.refused else ""
            unused = f", {number} more missing or outside the record" if (number := self.skipped.get(sensor)) else ""
            notes.append(f"{sensor}: {len(innovations.time)} measurements{gate}{unused}, {nis}")
        return Table(
            f"Estimate at {len(self.time)} epochs over {self.time[-1] - self.time[0]:.6g} s",
            ("state", "unit", "at the end", Column("σ", digits=3), Column("σ at the start", digits=3)),
            rows,
            [*notes, *map(str, self.events)],
            left=2,
        )

    @classmethod
    def from_arrays(
        cls,
        time: ArrayLike,
        attitude: ArrayLike,
        covariance: ArrayLike | None = None,
        *,
        bias: ArrayLike | None = None,
        innovations: Mapping[str, Innovations] | None = None,
    ) -> Estimate:
        """Return an estimate from the arrays of any filter.

        Parameters
        ----------
        time : array_like (m,)
            Times, s, strictly increasing.
        attitude : array_like (m, 4)
            Unit quaternions q_fb, scalar first. NaN at times without an estimate.
        covariance : array_like (m, 3, 3) or (m, 6, 6), optional
            Covariance of δθ, rad², with ``q_true = q_est ⊗ exp(δθ)`` (body axes), or of (δθ, δb), δb = b_true − b_est, rad/s. NaN at
            times without an estimate. If not given, the errors can be reported (:func:`strapdown.accuracy`) but not judged.
        bias : array_like (m, 3), optional
            Gyro bias, rad/s, body axes. If not given, bias and its covariance are NaN, and only the attitude is judged.
        innovations : mapping of str to Innovations, optional
            Innovations by sensor; without them there is no NIS.

        Returns
        -------
        Estimate
            The estimate.

        Examples
        --------
        >>> import numpy as np
        >>> Estimate.from_arrays([0.0, 1.0], [[1, 0, 0, 0]] * 2, [1e-4 * np.eye(3)] * 2).sigma[0, :3]
        array([0.01, 0.01, 0.01])
        """
        stamps = increasing("time", time)
        m = len(stamps)
        q = array("attitude", attitude, (m, 4), allow_nan=True)
        known = are_finite(q)
        unit_quaternions("attitude", q[known])
        P = np.full((m, 3, 3), np.nan) if covariance is None else matrices("covariance", covariance, m)
        if bias is not None and P.shape[1] == 3:
            raise InputError("bias is given, but covariance is of the attitude only; give that of (δθ, δb), (m, 6, 6)")
        whole = np.full((m, 6, 6), np.nan)
        size = 3 if bias is None else 6
        whole[:, :size, :size] = P[:, :size, :size]
        return cls(
            time=stamps,
            attitude=q,
            bias=np.full((m, 3), np.nan) if bias is None else array("bias", bias, (m, 3), allow_nan=True),
            variance=np.diagonal(whole, axis1=1, axis2=2).copy(),
            covariance=whole,
            innovations={name: _checked(name, series) for name, series in (innovations or {}).items()},
        )

    @property
    def known(self) -> np.ndarray:
        """Mask (m,) of the times with an estimate: a filter of another program may give NaN before its first fix or after a failure."""
        numbers = np.isfinite(np.concatenate([self.attitude, self.bias, self.variance], axis=1))
        estimated = numbers.any(axis=0)
        estimated[:4] = True
        return np.asarray(numbers[:, estimated].all(axis=1))

    def taken(self, rows: Any) -> Estimate:
        """Return the estimate at some of its times, with all its innovations.

        Parameters
        ----------
        rows : slice, ndarray of int or of bool
            Rows, by index, slice or mask.

        Returns
        -------
        Estimate
            Estimate at these times, with its truth there.
        """
        names = ("time", "attitude", "bias", "variance", "covariance", "whole_covariance")
        parts = {name: value[rows] for name in names if (value := getattr(self, name)) is not None}
        states = {
            name: replace(block, values=block.values[rows], variance=block.variance[rows])
            for name, block in self.error_states.items()
        }
        return replace(self, **parts, error_states=states, truth=None if self.truth is None else self.truth.taken(rows))

    @property
    def has_bias(self) -> bool:
        """Whether a gyro bias is estimated."""
        return bool(np.isfinite(self.bias).any())

    @property
    def has_covariance(self) -> bool:
        """Whether σ of the attitude is known."""
        return bool(np.isfinite(self.variance[:, :3]).any())

    @property
    def refused(self) -> dict[str, int]:
        """Number of measurements rejected by a gate, by sensor."""
        return {sensor: innovations.refused for sensor, innovations in self.innovations.items()}

    @property
    def sigma(self) -> Array:
        """Standard deviations (m, 6): rad, rad/s."""
        return np.sqrt(self.variance)

    @property
    def attitude_covariance(self) -> Array | None:
        """Covariance (m, 3, 3) of the attitude error, rad², body axes; diagonal if only variances were stored; None if not known."""
        if not self.has_covariance:
            return None
        if self.covariance is not None:
            return np.asarray(self.covariance[:, :3, :3])
        return np.asarray(self.variance[:, :3, None] * np.eye(3))

    @property
    def rotation(self) -> Rotation:
        """Attitudes as a ``scipy.spatial.transform.Rotation`` that transforms body vectors to the fixed frame."""
        return quaternion.to_rotation(self.attitude)

    def euler(self, sequence: str = "ZYX") -> outputs.Angles:
        """Return Euler angles and their standard deviations, as :func:`strapdown.records.outputs.euler`.

        Parameters
        ----------
        sequence : str, default "ZYX"
            Axes of the three rotations.

        Returns
        -------
        Angles
            Angles (m, 3) and their σ, rad.
        """
        return outputs.euler(self.attitude, sequence, self.attitude_covariance)

    @property
    def epoch_ns(self) -> int:
        """Reading of the recording's clock at time 0, ns since 1970; 0: unknown."""
        return 0 if self.origin is None else self.origin.epoch_ns

    def table(self, *, sequence: str = "ZYX", frame: str = "ENU") -> dict[str, NDArray[np.generic]]:
        """Return the estimate as columns, with the unit in each name.

        Parameters
        ----------
        sequence : str, default "ZYX"
            Sequence of the Euler angles, as in :meth:`euler`.
        frame : {"ENU", "NED"}, default "ENU"
            Fixed frame of quaternion and angles; body axes are unchanged.

        Returns
        -------
        dict of str to ndarray (m,)
            ``time_s`` (or ``time_ns`` for a clock that counts from 1970), ``qw qx qy qz``, the angles and their σ in degrees,
            ``heading_deg`` of the body x axis from North towards East, bias and σ in °/h. If full covariances were stored,
            ``cov_body_xx_rad2`` … of the body-side error, with ``b`` before an axis for the bias. At the end, the same in each row:
            ``smoothed`` and ``sigma_upper_bound``, 1 or 0, and a column of ones whose name has the fixed frame, such as
            ``fixed_frame_east_north_up_magnetic_north``.
        """
        one_of("frame", frame, outputs.FRAMES)
        P = self.attitude_covariance
        q = self.attitude if frame == "ENU" else outputs.to_ned(self.attitude)
        columns: dict[str, NDArray[np.generic]] = {"time_s": self.time}
        if self.epoch_ns:
            columns = {"time_ns": whole_ns(self.time) + self.epoch_ns}
        columns |= {f"q{name}": q[:, k] for k, name in enumerate("wxyz")}
        angles = outputs.euler(q, sequence, P)
        axes = sequence.upper()
        for k, axis in enumerate(axes):
            name = _NAMES[axis] if len(set(axes)) == 3 else f"angle_{k + 1}_{axis.lower()}"
            columns[f"{name}_deg"] = angles.angles[:, k] / DEGREE
            if angles.sigma is not None:
                columns[f"{name}_sigma_deg"] = angles.sigma[:, k] / DEGREE
        north = outputs.heading(self.attitude, P)
        columns["heading_deg"] = north.angles / DEGREE
        if north.sigma is not None:
            columns["heading_sigma_deg"] = north.sigma / DEGREE
        sigma = self.sigma
        for k, axis in enumerate("xyz" if self.has_bias else ""):
            columns[f"bias_{axis}_deg_per_h"] = self.bias[:, k] / DEGREE_PER_HOUR
            columns[f"bias_{axis}_sigma_deg_per_h"] = sigma[:, 3 + k] / DEGREE_PER_HOUR
        if self.covariance is not None and P is not None:
            size = 6 if np.isfinite(self.covariance[:, 3:, 3:]).any() else 3
            for i, j in itertools.combinations_with_replacement(range(size), 2):
                unit = ("rad2", "rad2_per_s", "rad2_per_s2")[(i > 2) + (j > 2)]
                columns[f"cov_body_{STATES[i]}{STATES[j]}_{unit}"] = self.covariance[:, i, j]
        context = {"smoothed": self.smoothed, "sigma_upper_bound": bool(self.motion)} if self.has_covariance else {}
        if words := frame_words(self.fixed_frame, frame):
            context[f"fixed_frame_{re.sub('[^a-z]+', '_', words.partition(' (')[0].lower())}"] = True
        return columns | {name: np.full(len(q), value, np.int8) for name, value in context.items()}

    def to_dataframe(self, **options: Any) -> Any:
        """Return the estimate as a pandas ``DataFrame`` with the columns of :meth:`table`.

        Parameters
        ----------
        **options : dict
            Options of :meth:`table`.

        Returns
        -------
        pandas.DataFrame
            One row per time.
        """
        return library("pandas", "a DataFrame").DataFrame(self.table(**options))


_NAMES = {"Z": "yaw", "Y": "pitch", "X": "roll"}
"""Names of the angles of a sequence of three different axes."""
STATES = ("x", "y", "z", "bx", "by", "bz")
"""Names of the components of the error state."""


def frame_words(fixed_frame: str, frame: str) -> str:
    """Return the axes and the North of exported attitudes from those of the estimate's frame; empty: those of the record's references."""
    if frame == "ENU":
        return fixed_frame
    return fixed_frame.replace("East-North-Up", "North-East-Down").replace("z up", "z down") or "North-East-Down"


def state_unit(estimate: Estimate, name: str, unit: str) -> tuple[str, float]:
    """Return the printed unit of an error state, and its factor to SI; that of a direction or a heading is relative to its vector."""
    across = [f"{sensor} " for sensor, series in estimate.innovations.items() if series.innovation.shape[1] < 3]
    if unit == "1" and name.startswith(tuple(across)):
        return "% of the vector", 0.01
    return error_state_unit(name, unit)
