"""Estimates in self-describing HDF5 files, and the functions common to all result files of this package."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

import strapdown
from strapdown import quaternion
from strapdown.checks import Array, InputError, array, count, finite, increasing, one_of, unit_quaternions
from strapdown.files import reading, set_attributes, whole_hdf5, written_beside
from strapdown.records.estimate import EVENT_KINDS, ErrorStateEstimate, Estimate, Event, Innovations
from strapdown.records.record import Truth

CONVENTIONS = (
    "quaternions Hamilton, scalar first, body to fixed frame: v_f = q v_b q^-1; error state (dtheta, db): "
    "q_true = q exp(dtheta), db = b_true - b; SI units and radians"
)

LARGEST_BIAS = 1e6
"""Maximum gyro bias accepted, rad/s; an estimate beyond it comes from a filter that diverged or a damaged file."""
_ESTIMATE_UNITS = {
    "time": "s",
    "attitude": "1",
    "bias": "rad/s",
    "variance": "rad^2 (columns 0-2), (rad/s)^2 (columns 3-5)",
    "covariance": "rad^2, rad^2/s, (rad/s)^2",
}


CHUNK_ROWS = 4096
"""Maximum number of rows of a compressed chunk."""


@contextlib.contextmanager
def result_file(path: str | os.PathLike[str], kind: str, attributes: Mapping[str, Any] | None) -> Iterator[Any]:
    """Yield an HDF5 file with its kind, version and conventions as attributes; it is created only when complete."""
    with written_beside(path) as temporary, whole_hdf5(temporary) as file:
        own = {"kind": f"strapdown {kind}", "version": strapdown.__version__, "conventions": CONVENTIONS}
        set_attributes(file, {**own, **(attributes or {})})
        yield file


def put(group: Any, name: str, value: Array, unit: str, meaning: str = "") -> None:
    """Write an array with its unit, and its meaning if the name does not state it, as attributes; compressed unless it is small.

    Attitudes and covariances are not compressed either: they are most of a file, and compression would take a fifth of the time of a warm
    `strapdown estimate` to save a quarter of the attitudes and a third of the covariances. Chunks are whole rows: repeated rows then need
    half of the space of chunks by column.
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
    """Write an estimate, and the truth at its times if given, to HDF5; the file is created only when complete.

    ``reference`` are attitudes (m, 4) of a reference system instead, NaN if missing. Values and variances of error states are written
    (:func:`read_states`); their covariance matrix is not.
    """
    if truth is not None and len(truth.attitude) != len(estimate.time):
        raise InputError(
            f"truth has {len(truth.attitude)} rows and the estimate {len(estimate.time)}; give the truth at the estimate's times"
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
            # The sensor is not the group's name, because a slash in it would create a subgroup.
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
    """Write times (n,), s, and attitudes q_fb (n, 4) to HDF5; the file is created only when complete."""
    with result_file(path, "attitude", attributes) as file:
        put(file, "time", time, "s")
        put(file, "attitude", attitude, "1")


@contextlib.contextmanager
def _estimate_file(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Yield the HDF5 file of an estimate, read-only; errors are InputErrors that name it."""
    with reading.hdf5(path) as file:
        if reading.attributes(file).get("kind") != "strapdown estimate":
            raise InputError(
                f"{path} is not a strapdown estimate; pass the estimate.h5 that `strapdown estimate` writes"
            )
        yield file


def _numbers(group: Any, name: str, shape: tuple[int | str, ...]) -> Array:
    """Return an array of a file, checked by :func:`strapdown.checks.array`."""
    return array(_place(group, name), reading.numbers(group, name), shape)


def _place(group: Any, name: str) -> str:
    return f"{group.file.filename}: {f'{group.name}/{name}'.lstrip('/')}"


def _above_zero(place: str, variance: Array) -> Array:
    """Return variances, checked to be positive."""
    if np.any(variance <= 0.0):
        index = tuple(int(i) for i in np.argwhere(variance <= 0.0)[0])
        raise InputError(
            f"{place}{list(index)} is {variance[index]:g}, and a variance must be greater than zero; the file is damaged, or a sensor had "
            "no noise: give each a sigma above zero and repeat the estimate"
        )
    return variance


def _biases(group: Any, name: str, rows: int) -> Array:
    """Return gyro biases (rows, 3), checked not to exceed :data:`LARGEST_BIAS`."""
    value = _numbers(group, name, (rows, 3))
    if np.any(np.abs(value) > LARGEST_BIAS):
        index = tuple(int(i) for i in np.argwhere(np.abs(value) > LARGEST_BIAS)[0])
        raise InputError(
            f"{_place(group, name)}{list(index)} is {value[index]:g} rad/s, more than any gyro has; the file is damaged or its filter "
            "diverged: repeat the estimate, and check its initial state and the gyro's unit"
        )
    return value


def _attitudes(group: Any, name: str, rows: int) -> Array:
    """Return attitudes (rows, 4) unchanged, checked to be of unit norm."""
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
    """Read the reference of a file written by :func:`write_estimate` as a truth, NaN where missing; None if the file has none."""
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

    Rejected are shapes that do not fit each other, decreasing times, quaternions that are not of unit norm, variances of zero or less, and
    biases above 1e6 rad/s.
    """
    with _estimate_file(path) as file:
        time = increasing(_place(file, "time"), _numbers(file, "time", ("n",)))
        rows = len(time)
        attitude = _attitudes(file, "attitude", rows)
        size = 6 if "bias" in file else 3  # an estimate of another program may have none
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
                sensor: count("skipped", attributes["skipped"], minimum=0)
                for sensor, (attributes, _) in sensors.items()
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
                    f"{_place(part, 'units')} and components differ in number; the file is damaged, make it again"
                )
            found[str(attributes["name"])] = ErrorStateEstimate(
                components=tuple(str(one) for one in attributes["components"]),
                units=tuple(str(one) for one in attributes["units"]),
                values=values,
                variance=_above_zero(_place(part, "variance"), _numbers(part, "variance", values.shape)),
            )
        return found


def _parts(file: Any, name: str) -> list[tuple[dict[str, Any], Any]]:
    """Return the subgroups of a group, each with its attributes; empty if there is no such group."""
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
