"""The IMU record: gyro increments and vector measurements, with their truth if it is known.

All times are *edges*: the n + 1 times that bound the n sample intervals. A gyro sample is the rotation increment over its interval;
attitude, bias and covariance are values at the edges. This avoids any ambiguity between the start and the end of an interval.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from strapdown import coning
from strapdown.checks import Array, InputError, are_finite, array, increasing, instance, unit_quaternions
from strapdown.results import ByValue, Listed, Table
from strapdown.vectors import VectorMeasurements

if TYPE_CHECKING:
    from strapdown.gyro import GyroSpec

LARGEST_TURN = 1e6
"""Maximum rotation in one sample interval, rad; a filter could not divide a larger one into steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth(ByValue):
    """True attitude and bias, known from a simulation or a reference system.

    Parameters
    ----------
    attitude : ndarray (n + 1, 4)
        True q_fb at the edges. NaN where a reference system has no attitude.
    bias : ndarray (n + 1, 3), optional
        True gyro bias at the edges, rad/s. Default: NaN, not known, as from a reference system.
    movement : ndarray (n + 1,) of bool, optional
        Whether the unit moved, in the judgement of the reference's source; None: not stated.
    """

    attitude: Array
    bias: Array = None  # type: ignore[assignment]
    movement: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Fill in a bias that is not known."""
        if self.bias is None:
            object.__setattr__(self, "bias", np.full((len(self.attitude), 3), np.nan))

    @property
    def known(self) -> np.ndarray:
        """Whether each attitude is known (n + 1,)."""
        return are_finite(self.attitude)

    @property
    def has_bias(self) -> bool:
        """Whether the gyro bias is known."""
        return bool(np.isfinite(self.bias).any())

    def taken(self, rows: Any) -> Truth:
        """Return the truth at some of its rows.

        Parameters
        ----------
        rows : slice, ndarray of int or of bool
            Rows, by index, slice or mask.

        Returns
        -------
        Truth
            Truth at these rows.
        """
        movement = None if self.movement is None else self.movement[rows]
        return Truth(attitude=self.attitude[rows], bias=self.bias[rows], movement=movement)


@dataclass(frozen=True, kw_only=True, eq=False)
class Origin(ByValue):
    """Origin of a record or a result; fields that are not known are None.

    Parameters
    ----------
    gyro : GyroSpec, optional
        Specification of the gyro.
    scenario : strapdown.scenarios.Scenario, optional
        Scenario.
    seed : int, optional
        Seed of the random streams.
    run : int, optional
        Run number of the random streams.
    source : str, default ""
        File or recording that it was read from; empty for a record in memory.
    epoch_ns : int, default 0
        Reading of the recording's clock at time 0, ns since 1970; 0: unknown.
    """

    gyro: GyroSpec | None = None
    scenario: Any = None
    seed: int | None = None
    run: int | None = None
    source: str = field(default="", compare=False)
    epoch_ns: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class ImuRecord(ByValue, Listed):
    """Gyro increments and vector measurements over one run.

    Arrays of floats are kept without a copy, to save memory: pass a copy if the buffer is written to afterwards.

    Parameters
    ----------
    time : ndarray (n + 1,)
        Edges of the sample intervals, s, strictly increasing.
    increments : ndarray (n, 3)
        Integrals of the measured body rate over each interval, rad.
    vectors : tuple of VectorMeasurements, default empty
        Vector measurements, one series per sensor, each with its own times.
    truth : Truth, optional
        True attitude and bias, if known.
    origin : Origin, optional
        Scenario and random streams of a simulated record, so that a filter can be matched to them; None for measured data.
    temperature : ndarray (n + 1,), optional
        Temperature of the gyro at the edges, °C, if known.
    """

    time: Array
    increments: Array
    vectors: tuple[VectorMeasurements, ...] = ()
    truth: Truth | None = None
    origin: Origin | None = None
    temperature: Array | None = None

    def __post_init__(self) -> None:
        time = increasing("time", self.time, minimum=2)
        if self.temperature is not None:
            object.__setattr__(self, "temperature", array("temperature", self.temperature, (len(time),)))
        increments = array("increments", self.increments, (len(time) - 1, 3))
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "increments", increments)
        if self.largest_increment > LARGEST_TURN:
            row, axis = (int(i) for i in np.unravel_index(np.argmax(np.abs(increments)), increments.shape))
            raise InputError(
                f"increments[{row}, {axis}] is {increments[row, axis]:g} rad in {time[row + 1] - time[row]:g} s, more than "
                f"{LARGEST_TURN:g} rad between two samples; check the unit, or remove it"
            )
        if isinstance(self.vectors, VectorMeasurements):
            raise InputError(f"vectors is the single series {self.vectors.sensor}; give a tuple of series, (series,)")
        instance("vectors", self.vectors, Iterable, "give a tuple of series, empty for none")
        object.__setattr__(self, "vectors", tuple(self.vectors))
        for k, series in enumerate(self.vectors):
            instance(f"vectors[{k}]", series, VectorMeasurements, "give a vectors.VectorMeasurements for each")
        names = [series.sensor for series in self.vectors]
        if len(set(names)) < len(names):
            raise InputError(f"vectors has two series of the same name among {names}; give each sensor its own name")
        if self.truth is not None:
            attitude = array("truth.attitude", self.truth.attitude, (len(time), 4))
            moving = self.truth.movement
            if moving is not None and np.shape(moving) != time.shape:
                raise InputError(
                    f"truth.movement has shape {np.shape(moving)}, wanted {time.shape}; give it at each edge"
                )
            truth = dataclasses.replace(
                self.truth,
                attitude=unit_quaternions("truth.attitude", attitude),
                bias=array("truth.bias", self.truth.bias, (len(time), 3)),
            )
            object.__setattr__(self, "truth", truth)

    def listing(self) -> Table:
        """Return gyro and sensors with their numbers of samples, and the origin of the record, as a table."""
        span, count_ = self.time[-1] - self.time[0], len(self.increments)
        rows = [("gyro", "increments", count_, count_ / span)]
        rows += [(series.sensor, series.kind, len(series.time), len(series.time) / span) for series in self.vectors]
        notes = [f"Truth: {'attitude and gyro bias' if self.truth is not None else 'not known'}."]
        if self.origin is not None and self.origin.scenario is not None:
            scenario = self.origin.scenario
            notes.append(f"Simulated: {scenario.name or 'a scenario'}, seed {self.origin.seed}, run {self.origin.run}.")
            notes += [f"warning: {words}" for words in (scenario.saturation, scenario.late_motion) if words]
        for series in self.vectors:
            sigma = series.sigma if series.sigma_axes is None else series.sigma_axes
            if series.covariance is None and np.any(sigma == 0.0):
                notes.append(
                    f"warning: {series.sensor}: its sigma is zero, which a filter cannot use; add noise in the scenario, or give the "
                    "filter another sigma in [filter.sigma]"
                )
        return Table(f"Record over {span:.6g} s", ("sensor", "measures", "samples", "Hz"), rows, notes, left=2)

    @functools.cached_property
    def intervals(self) -> Array:
        """Duration of each sample interval (n,), s; read-only."""
        intervals = np.diff(self.time)
        intervals.flags.writeable = False
        return intervals

    @functools.cached_property
    def largest_increment(self) -> float:
        """Largest magnitude of a component of the increments, rad."""
        return float(max(self.increments.max(), -self.increments.min()))

    @property
    def rates(self) -> Array:
        """Mean body rate over each interval (n, 3), rad/s."""
        return np.asarray(self.increments / self.intervals[:, None])


def compress(record: ImuRecord, algorithm: str | coning.Algorithm) -> ImuRecord:
    """Return the record at the rate of an N-sample coning algorithm, which combines N increments into one rotation vector.

    Parameters
    ----------
    record : ImuRecord
        Record.
    algorithm : str or Algorithm
        Coning algorithm: a name in :data:`strapdown.coning.ALGORITHMS` or an algorithm.

    Returns
    -------
    ImuRecord
        Record of n // N intervals; remaining intervals at the end are dropped.

    Notes
    -----
    The rotation vector is the increment of the longer interval: with the coning correction, a filter may treat it as a rotation at
    constant rate. For unequal sample intervals the correction is computed for their durations; across a gap there is no correction
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
    """Return the part of the record between two edges, with the measurements in (t_first, t_last], from edge 0 also those at that edge."""
    if not 0 <= first < last < len(record.time):
        raise InputError(
            f"cut from edge {first} to {last} with edges 0 to {len(record.time) - 1}; choose 0 ≤ first < last"
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
        truth=None if truth is None else truth.taken(edges),
        temperature=None if temperature is None else temperature[edges],
    )
