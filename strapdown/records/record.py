"""The IMU record, the estimate, and their files.

All times are *edges*: the n + 1 times that bound the n sample intervals. A gyro sample is the rotation increment over its interval;
attitude, bias and covariance are values at the edges. So it is never ambiguous which end of an interval a stamp means.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

import strapdown
from strapdown import coning, quaternion
from strapdown.checks import Array, InputError, array, count, finite, increasing, instance, one_of, unit_quaternions
from strapdown.files import reading, set_attributes, whole_hdf5, written_beside
from strapdown.records import outputs
from strapdown.results import Listed, Listing, figure
from strapdown.units import DEGREE, DEGREE_PER_HOUR
from strapdown.vectors import VectorMeasurements

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from strapdown.gyro import GyroSpec

CONVENTIONS = (
    "quaternions Hamilton, scalar first, body to fixed frame: v_f = q v_b q^-1; error state (dtheta, db): "
    "q_true = q exp(dtheta), db = b_true - b; SI units and radians"
)

LARGEST_BIAS = 1e6
"""Largest credible gyro bias, rad/s; an estimate beyond it comes from a filter that diverged or a damaged file."""


LARGEST_TURN = 1e6
"""Largest rotation in one sample interval, rad; a filter could not divide a larger one into steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """True attitude and bias, known from a simulation or a reference system.

    Parameters
    ----------
    attitude : ndarray (n + 1, 4)
        True q_fb at the edges.
    bias : ndarray (n + 1, 3)
        True gyro bias at the edges, rad/s.
    """

    attitude: Array
    bias: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Origin:
    """How a record was simulated, as far as it is known.

    Parameters
    ----------
    gyro : GyroSpec, optional
        Specification of the gyro.
    scenario : strapdown.scenarios.Scenario, optional
        Scenario.
    seed : int, optional
        Seed of the random streams.
    run : int, optional
        Run of the random streams.
    """

    gyro: GyroSpec | None = None
    scenario: Any = None
    seed: int | None = None
    run: int | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class ImuRecord(Listed):
    """Gyro increments and vector measurements over one run.

    Arrays of floats are kept without a copy, for a long record fills much of the memory: pass a copy of a buffer that is written to
    afterwards.

    Parameters
    ----------
    time : ndarray (n + 1,)
        Edges of the sample intervals, s, strictly increasing.
    increments : ndarray (n, 3)
        Integrals of the measured body rate over each interval, rad.
    vectors : tuple of VectorMeasurements, default empty
        Vector measurements, one series per sensor, each with its own times.
    truth : Truth, optional
        True attitude and bias, where known.
    origin : Origin, optional
        How it was simulated, so that a filter can be matched to the scenario; None for measured data.
    temperature : ndarray (n + 1,), optional
        Temperature of the gyro at the edges, °C, where known.
    """

    time: Array
    increments: Array
    vectors: tuple[VectorMeasurements, ...] = ()
    truth: Truth | None = None
    origin: Origin | None = None
    temperature: Array | None = None

    def __post_init__(self) -> None:
        """Check shapes, order and finiteness."""
        time = increasing("time", self.time, least=2)
        if self.temperature is not None:
            object.__setattr__(self, "temperature", array("temperature", self.temperature, (len(time),)))
        increments = array("increments", self.increments, (len(time) - 1, 3))
        for index in (np.argmax(increments), np.argmin(increments)):
            row, axis = (int(i) for i in np.unravel_index(index, increments.shape))
            if abs(increments[row, axis]) > LARGEST_TURN:
                raise InputError(
                    f"increments[{row}, {axis}] is {increments[row, axis]:g} rad in {time[row + 1] - time[row]:g} s, more than "
                    f"{LARGEST_TURN:g} rad between two samples; check the unit, or remove it"
                )
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "increments", increments)
        if isinstance(self.vectors, VectorMeasurements):
            raise InputError(f"vectors is the series {self.vectors.sensor} by itself; give a tuple of them, (series,)")
        instance("vectors", self.vectors, Iterable, "give a tuple of series, empty for none")
        object.__setattr__(self, "vectors", tuple(self.vectors))
        for k, series in enumerate(self.vectors):
            instance(f"vectors[{k}]", series, VectorMeasurements, "give vectors.VectorMeasurements, a series each")
        names = [series.sensor for series in self.vectors]
        if len(set(names)) < len(names):
            raise InputError(f"vectors holds two series of one name among {names}; give each sensor its own")
        if self.truth is not None:
            truth = Truth(
                attitude=unit_quaternions(
                    "truth.attitude", array("truth.attitude", self.truth.attitude, (len(time), 4))
                ),
                bias=array("truth.bias", self.truth.bias, (len(time), 3)),
            )
            object.__setattr__(self, "truth", truth)

    def listing(self) -> Listing:
        """Return gyro and sensors with their samples, and where the record comes from, as a table."""
        span, count_ = self.time[-1] - self.time[0], len(self.increments)
        rows = [("gyro", "increments", str(count_), f"{count_ / span:.4g}")]
        rows += [(one.sensor, one.kind, str(len(one.time)), f"{len(one.time) / span:.4g}") for one in self.vectors]
        notes = [f"Truth: {'attitude and gyro bias' if self.truth is not None else 'not known'}."]
        if self.origin is not None and self.origin.scenario is not None:
            name = self.origin.scenario.name or "a scenario"
            notes.append(f"Simulated: {name}, seed {self.origin.seed}, run {self.origin.run}.")
        return Listing(f"Record over {span:.6g} s", ("sensor", "measures", "samples", "Hz"), rows, notes, left=2)

    @property
    def rates(self) -> Array:
        """Averaged body rate over each interval (n, 3), rad/s."""
        return np.asarray(self.increments / np.diff(self.time)[:, None])


def compress(record: ImuRecord, algorithm: str | coning.Algorithm) -> ImuRecord:
    """Return the record at the rate of an N-sample coning algorithm: each N increments become one rotation vector.

    Parameters
    ----------
    record : ImuRecord
        Record.
    algorithm : str or Algorithm
        Coning algorithm, a name in :data:`strapdown.coning.ALGORITHMS` or an algorithm.

    Returns
    -------
    ImuRecord
        Record of n // N intervals; intervals left over at the end are dropped.

    Raises
    ------
    InputError
        If the record has fewer than N intervals.

    Notes
    -----
    The rotation vector is the increment of the longer interval: with commutation corrected, a filter may treat it as a rotation at
    constant rate. Where sample intervals differ in length the correction is that of their lengths, and across a gap there is none
    (:func:`strapdown.coning.rotation_vectors`).
    """
    table = coning.named(algorithm)
    n = table.samples
    kept = len(record.increments) // n * n
    if kept == 0:
        raise InputError(f"record has {len(record.increments)} intervals; {table.name} needs at least {n}")
    increments = coning.rotation_vectors(record.increments[:kept], table, edges=record.time[: kept + 1])
    return _at_edges(record, slice(0, kept + 1, n), increments, record.vectors)


def cut(record: ImuRecord, first: int, last: int) -> ImuRecord:
    """Return the part of the record between two edges, with the measurements in (t_first, t_last].

    Parameters
    ----------
    record : ImuRecord
        Record of n intervals.
    first, last : int
        Indices of the edges, 0 ≤ first < last ≤ n.

    Returns
    -------
    ImuRecord
        The part. Measurements at the very first edge of the whole record belong to its first part.
    """
    if not 0 <= first < last < len(record.time):
        raise InputError(
            f"cut from edge {first} to {last} of a record with edges 0 to {len(record.time) - 1}; choose 0 ≤ first < last"
        )
    t0, t1 = record.time[first], record.time[last]
    vectors = []
    for series in record.vectors:
        inside = (series.time > t0) & (series.time <= t1)
        if first == 0:
            inside |= series.time == t0
        vectors.append(series.taken(inside))
    return _at_edges(record, slice(first, last + 1), record.increments[first:last], vectors)


def _at_edges(record: ImuRecord, edges: slice, increments: Array, vectors: Iterable[VectorMeasurements]) -> ImuRecord:
    """Return the record at some of its edges, with the increments between them."""
    truth, temperature = record.truth, record.temperature
    return dataclasses.replace(
        record,
        time=record.time[edges],
        increments=increments,
        vectors=tuple(vectors),
        truth=None if truth is None else Truth(attitude=truth.attitude[edges], bias=truth.bias[edges]),
        temperature=None if temperature is None else temperature[edges],
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Innovations:
    """Innovations of one sensor, in the order of its measurements.

    Parameters
    ----------
    time : ndarray (m,)
        Times of the measurements used, s.
    innovation : ndarray (m, dof)
        Independent innovations, each less its prediction from those before it in the row; rad, or the sensor's unit over the length
        of its reference.
    variance : ndarray (m, dof)
        Variances of the innovations that the filter predicts, the square of their unit.
    weight : ndarray (m,), optional
        Weight of each measurement in the update: 1 whole, 0 rejected by a gate, between them a robust update; None: all 1.
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
        """Innovations over their own standard deviations (m, dof): independent standard normals if the filter is right."""
        return np.asarray(self.innovation / np.sqrt(self.variance))

    @property
    def nis(self) -> Array:
        """Normalised innovation squared (m,), χ² with as many degrees of freedom as columns if the filter is right."""
        return np.asarray(np.sum(self.innovation**2 / self.variance, axis=1))


EVENT_KINDS = ("recovery", "hypotheses", "lock-out", "divergence", "gap")
"""Kinds of :class:`Event`."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """An event in a run that a user of the estimate must know.

    Parameters
    ----------
    kind : {"recovery", "hypotheses", "lock-out", "divergence", "gap"}
        What happened: a filter that rejected good measurements was restarted; a bank of hypotheses replaced it while a turn was
        ambiguous; a gate rejected a sensor more often than it accepted it; the running NIS left its bounds; the gyro was silent for
        much longer than its sample interval.
    start : float
        Time of its beginning, s.
    end : float
        Time of its end, s: the recovery, the decision between the hypotheses, the last rejection, the return of the NIS (or the end
        of the record), the next gyro sample.
    sensor : str, default ""
        Sensor concerned, if there is one.
    value : float, default 0.0
        Of a recovery the rejections in a row; of hypotheses the number left (0: decided); of a lock-out the rejections; of a
        divergence the largest mean NIS per degree of freedom; of a gap its length over the usual interval.
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
        if self.kind == "hypotheses":
            end = (
                f"{self.value:.0f} of them were left at the end of the record" if self.value else "then one was chosen"
            )
            return (
                f"From {self.start:.6g} s to {self.end:.6g} s hypotheses replaced the filter, because {self.sensor} left a rotation "
                f"ambiguous: {end}."
            )
        if self.kind == "lock-out":
            return (
                f"Locked out from {self.start:.6g} s to {self.end:.6g} s: {self.value:.0f} measurements of {self.sensor} were rejected, "
                "more than were accepted, and no restart agreed with them: the sensor, its sigma or the filter is wrong there."
            )
        if self.kind == "divergence":
            return (
                f"The mean NIS left its bounds from {self.start:.6g} s to {self.end:.6g} s, up to {self.value:.3g} per degree of freedom: "
                "the model does not hold there."
            )
        return f"Gap of {self.end - self.start:.3g} s after {self.start:.6g} s: the rotation across it is assumed to be at constant rate."


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorStateEstimate:
    """Estimate of one declaration of error states (:mod:`strapdown.estimation.error_states`) at the kept edges.

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate(Listed):
    """Attitude and gyro bias with their covariance, at the stored epochs of a filter's run.

    Parameters
    ----------
    time : ndarray (m,)
        Times of the stored edges, s.
    attitude : ndarray (m, 4)
        Unit quaternions q_fb.
    bias : ndarray (m, 3)
        Gyro bias, rad/s, body axes.
    variance : ndarray (m, 6)
        Diagonal of P: attitude error, rad², body axes; bias error, (rad/s)².
    covariance : ndarray (m, 6, 6), optional
        Whole P of (δθ, δb), if asked for.
    innovations : mapping of str to Innovations, default empty
        Innovations by sensor.
    skipped : mapping of str to int, default empty
        Measurements not used, by sensor: missing (NaN) ones and those outside the record's time.
    events : tuple of Event, default empty
        Events of the run that a user of the estimate must know, in order of time.
    error_states : mapping of str to ErrorStateEstimate, default empty
        Error states c by name, in the order given.
    whole_covariance : ndarray (m, n, n), optional
        P of (δθ, δb, δc) of a filter with error states, if asked for; ``covariance`` is its part (m, 6, 6).
    whole_bias : ndarray (m, 3), optional
        Gyro bias with all that error states add to it, ``b + Σ c e``, rad/s, if asked for.
    whole_bias_variance : ndarray (m, 6), optional
        Diagonal of the covariance of attitude and whole bias.
    whole_bias_covariance : ndarray (m, 6, 6), optional
        Covariance of attitude and whole bias.
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
    whole_bias: Array | None = None
    whole_bias_variance: Array | None = None
    whole_bias_covariance: Array | None = None

    def listing(self) -> Listing:
        """Return σ at the start and at the end, the estimate at the end, and the innovations, as a table."""
        rows: list[tuple[str, ...]] = []
        for k in range(6):
            name, unit, size = ("attitude", "°", DEGREE) if k < 3 else ("gyro bias", "°/h", DEGREE_PER_HOUR)
            value = "" if k < 3 else figure(self.bias[-1, k - 3] / size)
            first, last = (figure(self.sigma[row, k] / size, 3) for row in (0, -1))
            rows.append((f"{name} {'xyz'[k % 3]}", unit, value, last, first))
        for name, states in self.error_states.items():
            for k, (component, unit) in enumerate(zip(states.components, states.units, strict=True)):
                ends = (figure(states.sigma[row, k], 3) for row in (-1, 0))
                label = f"{name} {component.removeprefix(name.split()[-1]).strip()}".strip()
                rows.append((label, unit, figure(states.values[-1, k]), *ends))
        notes = [f"Attitude at the end, q_fb (w, x, y, z): {', '.join(f'{q:.6f}' for q in self.attitude[-1])}"]
        for sensor, one in self.innovations.items():
            if np.any(one.used):
                nis = np.mean(one.nis[one.used]) / one.innovation.shape[1]
                gate = f", {one.refused} refused by the gate" if one.refused else ""
                notes.append(
                    f"{sensor}: {len(one.time)} measurements{gate}, mean NIS per degree of freedom {figure(nis, 3)}"
                )
        return Listing(
            f"Estimate at {len(self.time)} epochs over {self.time[-1] - self.time[0]:.6g} s",
            ("state", "unit", "at the end", "σ", "σ at the start"),
            rows,
            [*notes, *map(str, self.events)],
            left=2,
        )

    @classmethod
    def from_arrays(
        cls,
        time: ArrayLike,
        attitude: ArrayLike,
        covariance: ArrayLike,
        *,
        bias: ArrayLike | None = None,
        innovations: Mapping[str, Innovations] | None = None,
    ) -> Estimate:
        """Return an estimate made of the arrays of any filter.

        Parameters
        ----------
        time : array_like (m,)
            Times, s, strictly increasing.
        attitude : array_like (m, 4)
            Unit quaternions q_fb, scalar first. NaN where the filter has none.
        covariance : array_like (m, 3, 3) or (m, 6, 6)
            Covariance of δθ, rad², with ``q_true = q_est ⊗ exp(δθ)`` (body axes), or of (δθ, δb), δb = b_true − b_est, rad/s. NaN where
            the filter has none.
        bias : array_like (m, 3), optional
            Gyro bias, rad/s, body axes. Without one it is NaN, as is its covariance: only the attitude is judged.
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
        known = np.isfinite(q).all(axis=1)
        unit_quaternions("attitude", q[known])
        P = np.asarray(covariance, np.float64)
        if P.shape not in ((m, 3, 3), (m, 6, 6)):
            raise InputError(
                f"covariance has shape {P.shape}, wanted ({m}, 3, 3) or ({m}, 6, 6), a matrix for each time"
            )
        if bias is not None and P.shape[1] == 3:
            raise InputError("bias is given, but covariance is of the attitude alone; give that of (δθ, δb), (m, 6, 6)")
        whole = np.full((m, 6, 6), np.nan)
        size = 3 if bias is None else 6
        whole[:, :size, :size] = P[:, :size, :size]
        return cls(
            time=stamps,
            attitude=q,
            bias=np.full((m, 3), np.nan) if bias is None else array("bias", bias, (m, 3), allow_nan=True),
            variance=np.diagonal(whole, axis1=1, axis2=2).copy(),
            covariance=whole,
            innovations=dict(innovations or {}),
        )

    @property
    def has_bias(self) -> bool:
        """Whether a gyro bias is estimated at all."""
        return bool(np.isfinite(self.bias).any())

    def errors(
        self, true_attitude: ArrayLike, true_bias: ArrayLike, true_values: Mapping[str, ArrayLike] | None = None
    ) -> Array:
        """Return the error of all states: Log(q_est⁻¹ ⊗ q_true), then true less estimated.

        Parameters
        ----------
        true_attitude : array_like (m, 4)
            True q_fb at the times of the estimate.
        true_bias : array_like (m, 3)
            True gyro bias, rad/s, body axes.
        true_values : mapping of str to array_like (size,) or (m, size), optional
            True error states by name, in the axes of the estimated attitude where they are carried so
            (:attr:`strapdown.estimation.error_states.Effect.carried`). Required for a filter with error states.

        Returns
        -------
        ndarray (m, n)
            δθ, rad, body axes; δb, rad/s; error states in their units.
        """
        given = dict(true_values or {})
        if set(given) != set(self.error_states):
            raise InputError(
                f"true_values has {sorted(given)}, and the error states are {sorted(self.error_states)}; give each of them"
            )
        turn = quaternion.log(quaternion.multiply(quaternion.conjugate(self.attitude), true_attitude))
        parts = [turn, np.asarray(true_bias) - self.bias]
        parts += [np.asarray(given[name]) - states.values for name, states in self.error_states.items()]
        return np.concatenate(parts, axis=-1)

    @property
    def refused(self) -> dict[str, int]:
        """Number of measurements rejected by a gate, by sensor."""
        return {sensor: innovations.refused for sensor, innovations in self.innovations.items()}

    @property
    def sigma(self) -> Array:
        """Standard deviations (m, 6): rad, rad/s."""
        return np.sqrt(self.variance)

    @property
    def matrix(self) -> Array:
        """Rotation matrices R_fb (m, 3, 3)."""
        return quaternion.to_matrix(self.attitude)

    @property
    def rotation(self) -> Rotation:
        """Attitudes as a ``scipy.spatial.transform.Rotation`` that takes body vectors to the fixed frame."""
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
        return outputs.euler(self.attitude, sequence, outputs.attitude_covariance(self))

    def heading(self, axis: str = "x") -> outputs.Angles:
        """Return the heading of a body axis, as :func:`strapdown.records.outputs.heading`.

        Parameters
        ----------
        axis : {"x", "y", "z", "-x", "-y", "-z"}, default "x"
            Body axis that points forward.

        Returns
        -------
        Angles
            Heading (m,) from North towards East and its σ, rad.
        """
        return outputs.heading(self.attitude, outputs.attitude_covariance(self), axis=axis)

    def to_dataframe(self, **options: Any) -> Any:
        """Return the estimate as a pandas ``DataFrame``, as :func:`strapdown.records.outputs.to_dataframe`.

        Parameters
        ----------
        **options : dict
            Options of :func:`strapdown.records.outputs.table`.

        Returns
        -------
        pandas.DataFrame
            One row per time.
        """
        return outputs.to_dataframe(self, **options)


_ESTIMATE_UNITS = {
    "time": "s",
    "attitude": "1",
    "bias": "rad/s",
    "variance": "rad^2 (columns 0-2), (rad/s)^2 (columns 3-5)",
    "covariance": "rad^2, rad^2/s, (rad/s)^2",
}


CHUNK_ROWS = 4096
"""Rows of a compressed chunk."""


@contextlib.contextmanager
def result_file(path: str | os.PathLike[str], kind: str, attributes: Mapping[str, Any] | None) -> Iterator[Any]:
    """Yield an HDF5 file with its kind, version and conventions as attributes; it appears whole or not at all."""
    with written_beside(path) as temporary, whole_hdf5(temporary) as file:
        own = {"kind": f"strapdown {kind}", "version": strapdown.__version__, "conventions": CONVENTIONS}
        set_attributes(file, {**own, **(attributes or {})})
        yield file


def put(group: Any, name: str, value: Array, unit: str, meaning: str = "") -> None:
    """Write an array with its unit, and its meaning where the name does not state it, as attributes; compressed unless it is small.

    Nor are attitudes and covariances: they are most of a file, and compressing them would take a fifth of a warm `strapdown estimate`,
    attitudes to save a quarter, covariances a third. Chunks are whole rows: rows that repeat shrink to half of what columns do.
    """
    options: dict[str, Any] = {}
    if value.size > 256 and value.ndim < 3 and not name.endswith("attitude"):
        chunks = (min(CHUNK_ROWS, len(value)), *value.shape[1:])
        options = {"chunks": chunks, "compression": "gzip", "compression_opts": 1, "shuffle": True}
    dataset = group.create_dataset(name, data=value, **options)
    set_attributes(dataset, {"unit": unit, "meaning": meaning} if meaning else {"unit": unit})


def write_estimate(
    path: str | os.PathLike[str],
    estimate: Estimate,
    attributes: Mapping[str, Any] | None = None,
    *,
    truth: Truth | None = None,
    reference: Array | None = None,
) -> None:
    """Write an estimate, and the truth at its times if given, to HDF5; the file appears whole or not at all.

    ``reference`` are attitudes (m, 4) of a reference system instead, NaN where it has none.

    Values and variances of error states are written (:func:`read_states`); a whole covariance is not.
    """
    if truth is not None and len(truth.attitude) != len(estimate.time):
        raise InputError(
            f"truth has {len(truth.attitude)} rows and the estimate {len(estimate.time)}; take the truth at the estimate's times"
        )
    with result_file(path, "estimate", attributes) as file:
        size = 6 if estimate.has_bias else 3
        for name, unit in _ESTIMATE_UNITS.items():
            value = getattr(estimate, name)
            if name in ("variance", "covariance") and value is not None:
                value = value[:, :size] if name == "variance" else value[:, :size, :size]
            if value is not None and (name != "bias" or estimate.has_bias):
                put(file, name, value, unit)
        if truth is not None:
            put(file, "truth/attitude", truth.attitude, "1")
            if np.isfinite(truth.bias).all():
                put(file, "truth/bias", truth.bias, "rad/s")
        if reference is not None:
            known = np.isfinite(reference).all(axis=1)
            put(file, "reference/row", np.flatnonzero(known).astype(np.float64), "1", "row of the estimate")
            put(file, "reference/attitude", quaternion.normalize(reference[known]), "1")
        for number, (sensor, innovations) in enumerate(estimate.innovations.items()):
            group = file.create_group(f"innovations/{number}")
            # The sensor is not the group's name: a slash in it would part groups.
            set_attributes(group, {"sensor": sensor, "skipped": estimate.skipped.get(sensor, 0)})
            put(group, "time", innovations.time, "s")
            put(
                group,
                "innovation",
                innovations.innovation,
                "rad, or the sensor's unit over the length of its reference",
            )
            put(group, "variance", innovations.variance, "the square of the innovation's")
            if innovations.weight is not None:
                put(group, "weight", innovations.weight, "1", "0: rejected; 1: full weight")
        for number, event in enumerate(estimate.events):
            set_attributes(file.create_group(f"events/{number:06d}"), vars(event))
        for number, (name, block) in enumerate(estimate.error_states.items()):
            group = file.create_group(f"states/{number}")
            set_attributes(group, {"name": name, "components": block.components, "units": block.units})
            put(group, "values", block.values, "those of the attribute units")
            put(group, "variance", block.variance, "the square of the values'")


def write_attitude(
    path: str | os.PathLike[str], time: Array, attitude: Array, attributes: Mapping[str, Any] | None = None
) -> None:
    """Write times (n,), s, and attitudes q_fb (n, 4) to HDF5; the file appears whole or not at all."""
    with result_file(path, "attitude", attributes) as file:
        put(file, "time", time, "s")
        put(file, "attitude", attitude, "1")


@contextlib.contextmanager
def _estimate_file(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Yield an estimate's HDF5 file, read only; errors are InputErrors that name it."""
    with reading.hdf5(path) as file:
        if reading.attributes(file).get("kind") != "strapdown estimate":
            raise InputError(
                f"{path} is not a strapdown estimate; pass the estimate.h5 that `strapdown estimate` writes"
            )
        yield file


def _numbers(group: Any, name: str, shape: tuple[int | str, ...]) -> Array:
    """Return an array of a file checked by :func:`strapdown.checks.array`."""
    return array(_place(group, name), reading.numbers(group, name), shape)


def _place(group: Any, name: str) -> str:
    return f"{group.file.filename}: {f'{group.name}/{name}'.lstrip('/')}"


def _above_zero(place: str, variance: Array) -> Array:
    """Return variances, none of them zero or less."""
    if np.any(variance <= 0.0):
        index = tuple(int(i) for i in np.argwhere(variance <= 0.0)[0])
        raise InputError(
            f"{place}{list(index)} is {variance[index]:g}, and a variance must be greater than zero; the file is damaged, or a sensor had "
            "no noise: give each a sigma above zero and make the estimate again"
        )
    return variance


def _biases(group: Any, name: str, rows: int) -> Array:
    """Return gyro biases (rows, 3), none beyond :data:`LARGEST_BIAS`."""
    value = _numbers(group, name, (rows, 3))
    if np.any(np.abs(value) > LARGEST_BIAS):
        index = tuple(int(i) for i in np.argwhere(np.abs(value) > LARGEST_BIAS)[0])
        raise InputError(
            f"{_place(group, name)}{list(index)} is {value[index]:g} rad/s, more than any gyro has; the file is damaged or its filter "
            "diverged: make the estimate again, and check its start and the gyro's unit"
        )
    return value


def _attitudes(group: Any, name: str, rows: int) -> Array:
    """Return attitudes (rows, 4) as they stand, of norm one."""
    value = _numbers(group, name, (rows, 4))
    unit_quaternions(_place(group, name), value)
    return value


def read_truth(path: str | os.PathLike[str]) -> Truth | None:
    """Read the truth of a file written by :func:`write_estimate`, at the times of the estimate; None if the file has none."""
    with _estimate_file(path) as file:
        if "truth" not in file:
            return None
        rows = len(_numbers(file, "time", ("n",)))
        bias = _biases(file, "truth/bias", rows) if "truth/bias" in file else np.full((rows, 3), np.nan)
        return Truth(attitude=_attitudes(file, "truth/attitude", rows), bias=bias)


def read_reference(path: str | os.PathLike[str]) -> Truth | None:
    """Read the reference of a file written by :func:`write_estimate` as a truth, NaN where it has none; None if the file has none."""
    with _estimate_file(path) as file:
        if "reference" not in file:
            return None
        size = len(_numbers(file, "time", ("n",)))
        row = _numbers(file, "reference/row", ("m",)).astype(np.intp)
        if np.any(np.diff(row, prepend=-1) <= 0) or np.any(row >= size):
            raise InputError(
                f"{_place(file, 'reference/row')} are not increasing rows of the estimate; the file is damaged"
            )
        attitude = np.full((size, 4), np.nan)
        attitude[row] = _attitudes(file, "reference/attitude", len(row))
        return Truth(attitude=attitude, bias=np.full((size, 3), np.nan))


def read_estimate(path: str | os.PathLike[str]) -> Estimate:
    """Read an estimate written by :func:`write_estimate`, without its error states (:func:`read_states`).

    What no filter estimates is refused: shapes that do not fit each other, decreasing times, quaternions that are not of unit norm,
    variances of zero or less, biases above 1e6 rad/s.
    """
    with _estimate_file(path) as file:
        time = increasing(_place(file, "time"), _numbers(file, "time", ("n",)))
        rows = len(time)
        attitude = _attitudes(file, "attitude", rows)
        size = 6 if "bias" in file else 3  # an estimate from elsewhere may have none
        covariance = _numbers(file, "covariance", (rows, size, size)) if "covariance" in file else None
        if covariance is not None:
            _above_zero(f"{_place(file, 'covariance')}, diagonal", np.diagonal(covariance, axis1=1, axis2=2))
            covariance = np.pad(covariance, ((0, 0), (0, 6 - size), (0, 6 - size)), constant_values=np.nan)
        variance = _above_zero(_place(file, "variance"), _numbers(file, "variance", (rows, size)))
        sensors = {attributes["sensor"]: (attributes, part) for attributes, part in _parts(file, "innovations")}
        return Estimate(
            time=time,
            attitude=attitude,
            bias=_biases(file, "bias", rows) if size == 6 else np.full((rows, 3), np.nan),
            variance=np.pad(variance, ((0, 0), (0, 6 - size)), constant_values=np.nan),
            covariance=covariance,
            innovations={sensor: _innovations(part) for sensor, (_, part) in sensors.items()},
            skipped={
                sensor: count("skipped", attributes["skipped"], least=0) for sensor, (attributes, _) in sensors.items()
            },
            events=tuple(
                Event(
                    kind=one_of("kind of an event", attributes["kind"], EVENT_KINDS),
                    sensor=str(attributes["sensor"]),
                    **{name: finite(f"{name} of an event", attributes[name]) for name in ("start", "end", "value")},
                )
                for attributes, _ in _parts(file, "events")
            ),
        )


def read_states(path: str | os.PathLike[str]) -> dict[str, ErrorStateEstimate]:
    """Read the error states, by name, of an estimate written by :func:`write_estimate`."""
    with _estimate_file(path) as file:
        rows = len(_numbers(file, "time", ("n",)))
        found = {}
        for attributes, part in _parts(file, "states"):
            values = _numbers(part, "values", (rows, len(attributes["components"])))
            if len(attributes["units"]) != len(attributes["components"]):
                raise InputError(
                    f"{_place(part, 'units')} are not as many as the components; the file is damaged, make it again"
                )
            found[str(attributes["name"])] = ErrorStateEstimate(
                components=tuple(str(one) for one in attributes["components"]),
                units=tuple(str(one) for one in attributes["units"]),
                values=values,
                variance=_above_zero(_place(part, "variance"), _numbers(part, "variance", values.shape)),
            )
        return found


def _parts(file: Any, name: str) -> list[tuple[dict[str, Any], Any]]:
    """Return the groups below a group, each with its attributes; none where it is not there."""
    return [(reading.attributes(part), part) for part in file[name].values()] if name in file else []


def _innovations(part: Any) -> Innovations:
    """Return the innovations of one sensor's group."""
    number = len(_numbers(part, "time", ("m",)))
    innovation = _numbers(part, "innovation", (number, "degrees of freedom"))
    return Innovations(
        time=_numbers(part, "time", (number,)),
        innovation=innovation,
        variance=_above_zero(_place(part, "variance"), _numbers(part, "variance", innovation.shape)),
        weight=_numbers(part, "weight", (number,)) if "weight" in part else None,
    )


def read_attributes(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the attributes of a result file of any kind: its kind, version, conventions, and those of the writer."""
    with reading.hdf5(path) as file:
        attributes = reading.attributes(file)
    if not str(attributes.get("kind", "")).startswith("strapdown "):
        raise InputError(f"{path} is not a result of strapdown; pass a file written by one of its commands")
    return attributes
