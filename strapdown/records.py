"""The IMU record, the estimate, and their files.

Everything is told by *edges*: the n + 1 times that bound the n sample intervals. A gyro sample is the rotation increment over its
interval; attitude, bias and covariance are values at the edges. So nobody need ask which end of an interval a stamp means.
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
from strapdown import coning, outputs, quaternion, reading
from strapdown.checks import Array, InputError, array, count, finite, increasing, instance, one_of, unit_quaternions
from strapdown.files import set_attributes, whole_hdf5, written_beside
from strapdown.vectors import VectorMeasurements

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

CONVENTIONS = (
    "quaternions Hamilton, scalar first, body to fixed frame: v_f = q v_b q^-1; error state (dtheta, db): "
    "q_true = q exp(dtheta), db = b_true - b; SI units and radians"
)

LARGEST_BIAS = 1e6
"""rad/s: no gyro has such a bias; an estimate that tells of one is of a filter that was lost, or damaged."""


LARGEST_TURN = 1e6
"""rad: nothing turns so far in one sample interval, nor does a filter cut such a turn into steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What only a simulation, or a reference system, knows."""

    attitude: Array
    """True q_fb at the edges (n + 1, 4)."""
    bias: Array
    """True gyro bias at the edges (n + 1, 3), rad/s."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImuRecord:
    """Gyro increments and vector measurements over one run.

    Arrays of floats are taken as they are and not copied, for a long record fills much of the memory: whoever goes on writing to a buffer
    gives a copy of it.
    """

    time: Array
    """Edges of the sample intervals (n + 1,), s, strictly increasing."""
    increments: Array
    """Integrals of the measured body rate over each interval (n, 3), rad."""
    vectors: tuple[VectorMeasurements, ...] = ()
    """Vector measurements, each with its own times."""
    truth: Truth | None = None

    def __post_init__(self) -> None:
        """Check shapes, order and finiteness."""
        time = increasing("time", self.time, least=2)
        increments = array("increments", self.increments, (len(time) - 1, 3))
        for index in (np.argmax(increments), np.argmin(increments)):
            row, axis = (int(i) for i in np.unravel_index(index, increments.shape))
            if abs(increments[row, axis]) > LARGEST_TURN:
                raise InputError(
                    f"increments[{row}, {axis}] is {increments[row, axis]:g} rad in {time[row + 1] - time[row]:g} s, and nothing turns so "
                    "far between two samples; check the unit, or remove it"
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

    @property
    def rates(self) -> Array:
        """Averaged body rate over each interval (n, 3), rad/s."""
        return np.asarray(self.increments / np.diff(self.time)[:, None])


def compress(record: ImuRecord, algorithm: str | coning.Algorithm) -> ImuRecord:
    """Return the record at the rate of an N-sample coning algorithm: each N increments become one rotation vector.

    The rotation vector stands for the increment of the longer interval: with commutation corrected, a filter may take it for a turn
    at constant rate. Where sample intervals differ in length the correction is that of their lengths, and across a gap there is none
    (:func:`strapdown.coning.rotation_vectors`). Intervals left over at the end are dropped.
    """
    table = coning.named(algorithm)
    n = table.samples
    kept = len(record.increments) // n * n
    if kept == 0:
        raise InputError(f"record has {len(record.increments)} intervals; {table.name} needs at least {n}")
    every = slice(0, kept + 1, n)
    truth = (
        None if record.truth is None else Truth(attitude=record.truth.attitude[every], bias=record.truth.bias[every])
    )
    return dataclasses.replace(
        record,
        time=record.time[every],
        increments=coning.rotation_vectors(record.increments[:kept], table, edges=record.time[: kept + 1]),
        truth=truth,
    )


def cut(record: ImuRecord, first: int, last: int) -> ImuRecord:
    """Return the part of the record from edge ``first`` to edge ``last``; measurements in (t_first, t_last] go along.

    Measurements exactly at the first edge of the whole record belong to its first part.
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
    edges = slice(first, last + 1)
    truth = (
        None if record.truth is None else Truth(attitude=record.truth.attitude[edges], bias=record.truth.bias[edges])
    )
    return ImuRecord(
        time=record.time[edges], increments=record.increments[first:last], vectors=tuple(vectors), truth=truth
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Innovations:
    """Innovations of one sensor, in the order of its measurements."""

    time: Array
    """Times of the measurements used (m,), s."""
    innovation: Array
    """Independent innovations (m, dof): each less what the ones before it in its row predict; rad, or the sensor's unit over the length
    of its reference."""
    variance: Array
    """What the filter takes their variances for (m, dof)."""
    weight: Array | None = None
    """Weight that each measurement was taken in with (m,): 1 whole, 0 refused by a gate, between them a robust update's; None: all 1."""

    @property
    def used(self) -> np.ndarray:
        """Which measurements were not refused (m,)."""
        return np.ones(len(self.time), bool) if self.weight is None else np.asarray(self.weight > 0.0)

    @property
    def refused(self) -> int:
        """How many measurements were refused."""
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
    """Something in a run that whoever uses the estimate must hear of."""

    kind: str
    """One of :data:`EVENT_KINDS`: a filter that refused good measurements started anew; hypotheses stood in for it while a turn was
    open; a gate refused a sensor more often than it took it in; the running NIS left its bounds; the gyro was silent for much longer
    than its interval."""
    start: float
    """When it began, s."""
    end: float
    """When it was over, s: the filter's recovery, the hypotheses becoming one, the last refusal, the return of the NIS (or the end of the
    record), the next gyro sample."""
    sensor: str = ""
    """Sensor concerned, if it is one."""
    value: float = 0.0
    """Of a recovery the refusals in a row, of hypotheses the number left (0 if they became one), of a lock-out the refusals, of a
    divergence the greatest mean NIS per degree of freedom, of a gap its length over the usual interval."""

    def __str__(self) -> str:
        """Say it in one line."""
        if self.kind == "recovery":
            return (
                f"Recovered at {self.end:.6g} s: {self.value:.0f} measurements of {self.sensor} in a row were refused and agreed with each "
                f"other from {self.start:.6g} s on; what the filter said in between is wrong."
            )
        if self.kind == "hypotheses":
            end = f"{self.value:.0f} of them were left at the end of the record" if self.value else "then they were one"
            return (
                f"From {self.start:.6g} s to {self.end:.6g} s hypotheses stood in for the filter, because {self.sensor} left a turn open: "
                f"{end}."
            )
        if self.kind == "lock-out":
            return (
                f"Locked out from {self.start:.6g} s to {self.end:.6g} s: {self.value:.0f} measurements of {self.sensor} were refused, "
                "more than were taken in, and no restart could follow them: the sensor, its sigma or the filter is wrong there."
            )
        if self.kind == "divergence":
            return (
                f"The mean NIS left its bounds from {self.start:.6g} s to {self.end:.6g} s, up to {self.value:.3g} per degree of freedom: "
                "the model does not hold there."
            )
        return f"Gap of {self.end - self.start:.3g} s after {self.start:.6g} s: the turn across it is taken for one at constant rate."


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorStateEstimate:
    """Estimate of one declaration of error states (:mod:`strapdown.estimation.error_states`) at the kept edges."""

    components: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    """(m, size), in ``units``."""
    variance: Array
    """(m, size), the square of the units."""

    @property
    def sigma(self) -> Array:
        """Standard deviations (m, size)."""
        return np.sqrt(self.variance)


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """What a filter made of a record, at the kept edges."""

    time: Array
    """Times (m,), s."""
    attitude: Array
    """q_fb (m, 4)."""
    bias: Array
    """Gyro bias (m, 3), rad/s, body axes."""
    variance: Array
    """Diagonal of P (m, 6): attitude error rad², bias error (rad/s)²."""
    covariance: Array | None = None
    """Whole P (m, 6, 6), if it was asked for."""
    innovations: Mapping[str, Innovations] = field(default_factory=dict)
    """Innovations by sensor."""
    skipped: Mapping[str, int] = field(default_factory=dict)
    """Measurements not used, by sensor: missing (NaN) ones and those outside the record's time."""
    events: tuple[Event, ...] = ()
    """What must be heard of the run, in order of time."""
    error_states: Mapping[str, ErrorStateEstimate] = field(default_factory=dict)
    """Error states by name, in the order given (c, below)."""
    whole_covariance: Array | None = None
    """P (m, n, n) of (δθ, δb, δc) of a filter with error states, if it was asked for; ``covariance`` is its part (m, 6, 6)."""
    whole_bias: Array | None = None
    """Gyro bias and all that error states add to it, ``b + Σ c e`` (m, 3), rad/s, if it was asked for."""
    whole_bias_variance: Array | None = None
    """Diagonal of the covariance of attitude and whole bias (m, 6)."""
    whole_bias_covariance: Array | None = None
    """That covariance (m, 6, 6)."""

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
        """Return the estimate that arrays of any filter make.

        Parameters
        ----------
        time : array_like (m,)
            s, strictly increasing.
        attitude : array_like (m, 4)
            q_fb, scalar first.
        covariance : array_like (m, 3, 3) or (m, 6, 6)
            Of δθ, rad², with ``q_true = q_est ⊗ exp(δθ)`` (body axes), or of (δθ, δb), δb = b_true − b_est, rad/s. NaN where the filter
            has none.
        bias : array_like (m, 3), optional
            Gyro bias, rad/s, body axes. Without one it is NaN, as is its covariance: only the attitude is judged.
        innovations : mapping, optional
            :class:`Innovations` by sensor; without them there is no NIS.

        Examples
        --------
        >>> import numpy as np
        >>> Estimate.from_arrays([0.0, 1.0], [[1, 0, 0, 0]] * 2, [1e-4 * np.eye(3)] * 2).sigma[0, :3]
        array([0.01, 0.01, 0.01])
        """
        stamps = increasing("time", time)
        m = len(stamps)
        q = array("attitude", attitude, (m, 4), allow_nan=True)
        told = np.isfinite(q).all(axis=1)
        unit_quaternions("attitude", q[told])
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
        """Return the error (m, n) of all states: Log(q_est⁻¹ ⊗ q_true), then true less estimated.

        ``true_values`` holds for each declaration of error states an array (size,) or (m, size), of what is carried in the axes of the
        estimated attitude (:attr:`strapdown.estimation.error_states.Effect.carried`).
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
        """Measurements refused by a gate, by sensor."""
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
        """Return Euler angles (m, 3) and their σ, rad (:func:`strapdown.outputs.euler`)."""
        return outputs.euler(self.attitude, sequence, outputs.attitude_covariance(self))

    def heading(self, axis: str = "x") -> outputs.Angles:
        """Return the heading (m,) of a body axis from North towards East, and its σ, rad (:func:`strapdown.outputs.heading`)."""
        return outputs.heading(self.attitude, outputs.attitude_covariance(self), axis=axis)

    def to_dataframe(self, **options: Any) -> Any:
        """Return the estimate as a pandas ``DataFrame`` (:func:`strapdown.outputs.to_dataframe`)."""
        return outputs.to_dataframe(self, **options)


_ESTIMATE_UNITS = {
    "time": "s",
    "attitude": "1",
    "bias": "rad/s",
    "variance": "rad^2 (columns 0-2), (rad/s)^2 (columns 3-5)",
    "covariance": "rad^2, rad^2/s, (rad/s)^2",
}


@contextlib.contextmanager
def result_file(path: str | os.PathLike[str], kind: str, attributes: Mapping[str, Any] | None) -> Iterator[Any]:
    """Yield an HDF5 file that says what it is; it appears whole or not at all."""
    with written_beside(path) as temporary, whole_hdf5(temporary) as file:
        own = {"kind": f"strapdown {kind}", "version": strapdown.__version__, "conventions": CONVENTIONS}
        set_attributes(file, {**own, **(attributes or {})})
        yield file


def put(group: Any, name: str, value: Array, unit: str, meaning: str = "") -> None:
    """Write an array with its unit, and what it means where the name does not say, as attributes; compressed unless it is small."""
    large = value.size > 256
    dataset = group.create_dataset(
        name, data=value, **({"compression": "gzip", "compression_opts": 1, "shuffle": True} if large else {})
    )
    set_attributes(dataset, {"unit": unit, "meaning": meaning} if meaning else {"unit": unit})


def write_estimate(
    path: str | os.PathLike[str],
    estimate: Estimate,
    attributes: Mapping[str, Any] | None = None,
    *,
    truth: Truth | None = None,
) -> None:
    """Write an estimate to HDF5, units and conventions as attributes; the file appears whole or not at all.

    Optional states go along, values and variances (:func:`read_states`); what a whole covariance tells of them does not.
    ``truth`` is that at the times of the estimate, where a simulation knows it, so that the file can be judged by itself.
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
                put(group, "weight", innovations.weight, "1", "0: refused; 1: taken in whole")
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
    """Yield an estimate's HDF5 file, read only; what is wrong with it is told in one line."""
    with reading.hdf5(path) as file:
        if reading.attributes(file).get("kind") != "strapdown estimate":
            raise InputError(
                f"{path} is not a strapdown estimate; pass the estimate.h5 that `strapdown estimate` writes"
            )
        yield file


def _numbers(group: Any, name: str, shape: tuple[int | str, ...]) -> Array:
    """Return an array of a file as :func:`strapdown.checks.array` lets it pass."""
    return array(_place(group, name), reading.numbers(group, name), shape)


def _place(group: Any, name: str) -> str:
    return f"{group.file.filename}: {f'{group.name}/{name}'.lstrip('/')}"


def _above_zero(place: str, variance: Array) -> Array:
    """Return variances, none of them zero or less."""
    if np.any(variance <= 0.0):
        index = tuple(int(i) for i in np.argwhere(variance <= 0.0)[0])
        raise InputError(
            f"{place}{list(index)} is {variance[index]:g}, and a variance is greater than zero; the file is damaged, or a sensor had no "
            "noise: give each a sigma above zero and make the estimate again"
        )
    return variance


def _biases(group: Any, name: str, rows: int) -> Array:
    """Return gyro biases (rows, 3) that a gyro may have."""
    value = _numbers(group, name, (rows, 3))
    if np.any(np.abs(value) > LARGEST_BIAS):
        index = tuple(int(i) for i in np.argwhere(np.abs(value) > LARGEST_BIAS)[0])
        raise InputError(
            f"{_place(group, name)}{list(index)} is {value[index]:g} rad/s, the bias of no gyro; the file is damaged or its filter was "
            "lost: make the estimate again, and look at its start and the gyro's unit"
        )
    return value


def _attitudes(group: Any, name: str, rows: int) -> Array:
    """Return attitudes (rows, 4) as they stand, of norm one."""
    value = _numbers(group, name, (rows, 4))
    unit_quaternions(_place(group, name), value)
    return value


def read_truth(path: str | os.PathLike[str]) -> Truth | None:
    """Read the truth that :func:`write_estimate` was given, at the times of the estimate; None if it was given none.

    Raises
    ------
    InputError
        As :func:`read_estimate` does.
    """
    with _estimate_file(path) as file:
        if "truth" not in file:
            return None
        rows = len(_numbers(file, "time", ("n",)))
        bias = _biases(file, "truth/bias", rows) if "truth/bias" in file else np.full((rows, 3), np.nan)
        return Truth(attitude=_attitudes(file, "truth/attitude", rows), bias=bias)


def read_estimate(path: str | os.PathLike[str]) -> Estimate:
    """Read an estimate written by :func:`write_estimate`.

    Raises
    ------
    InputError
        If the file is missing, truncated, no HDF5 or another kind of file, or holds what no filter estimates: shapes that do not fit each
        other, times that go back, quaternions of another norm than one, variances of zero or less, biases above ``LARGEST_BIAS``.
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
        sensors = {told["sensor"]: (told, part) for told, part in _parts(file, "innovations")}
        return Estimate(
            time=time,
            attitude=attitude,
            bias=_biases(file, "bias", rows) if size == 6 else np.full((rows, 3), np.nan),
            variance=np.pad(variance, ((0, 0), (0, 6 - size)), constant_values=np.nan),
            covariance=covariance,
            innovations={sensor: _innovations(part) for sensor, (_, part) in sensors.items()},
            skipped={sensor: count("skipped", told["skipped"], least=0) for sensor, (told, _) in sensors.items()},
            events=tuple(
                Event(
                    kind=one_of("kind of an event", told["kind"], EVENT_KINDS),
                    sensor=str(told["sensor"]),
                    **{name: finite(f"{name} of an event", told[name]) for name in ("start", "end", "value")},
                )
                for told, _ in _parts(file, "events")
            ),
        )


def read_states(path: str | os.PathLike[str]) -> dict[str, ErrorStateEstimate]:
    """Read the optional states of an estimate written by :func:`write_estimate`, by name; none of a filter without.

    Raises
    ------
    InputError
        As :func:`read_estimate`.
    """
    with _estimate_file(path) as file:
        rows = len(_numbers(file, "time", ("n",)))
        found = {}
        for told, part in _parts(file, "states"):
            values = _numbers(part, "values", (rows, len(told["components"])))
            if len(told["units"]) != len(told["components"]):
                raise InputError(
                    f"{_place(part, 'units')} are not as many as components; the file is damaged, make it again"
                )
            found[str(told["name"])] = ErrorStateEstimate(
                components=tuple(str(one) for one in told["components"]),
                units=tuple(str(one) for one in told["units"]),
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
    """Read what a result file of any kind says of its making: its kind, version, conventions, and all that the writer gave.

    Raises
    ------
    InputError
        If the file is missing, no HDF5, or not of this package.
    """
    with reading.hdf5(path) as file:
        attributes = reading.attributes(file)
    if not str(attributes.get("kind", "")).startswith("strapdown "):
        raise InputError(f"{path} is no result of strapdown; pass a file that one of its commands has written")
    return attributes
