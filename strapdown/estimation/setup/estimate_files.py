"""Estimates in self-describing HDF5 files, complete: with their filter, origin, truth and error states."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, InputError, are_finite, count, finite, increasing, one_of, unit_quaternions
from strapdown.estimation.setup.files import from_toml, to_toml
from strapdown.files import reading, set_attributes
from strapdown.recordings.recordfiles import origin_attributes, origin_of
from strapdown.records import ErrorStateEstimate, Estimate, Event, Innovations, Truth, put, result_file
from strapdown.records.estimate import EVENT_KINDS
from strapdown.records.result_files import above_zero, innovations, need_each, numbers, parts

KIND = "strapdown estimate"
"""The attribute ``kind`` of an estimate's file."""
LARGEST_BIAS = 1e6
"""Maximum gyro bias accepted, rad/s; an estimate beyond it comes from a filter that diverged or a damaged file."""
_VALUES = {
    "time": "s",
    "attitude": "1",
    "bias": "rad/s",
    "variance": "rad^2 (columns 0-2), (rad/s)^2 (columns 3-5)",
    "covariance": "rad^2, rad^2/s, (rad/s)^2",
    "whole_covariance": "of attitude, bias and error states, in their units",
}
_ORIGIN = ("gyro", "scenario", "seed", "run", "source", "epoch_ns")
_CONTEXT = ("kind", "version", "conventions", "filter", "fixed_frame", "motion", "smoothed", "remarks", *_ORIGIN)


def write_estimate(path: str | os.PathLike[str], estimate: Estimate) -> None:
    """Write an estimate with all its context to HDF5; the file is created only when complete.

    A scenario with a Python function or a user-defined class cannot be written to a file and is left out, as is the code of a user-defined
    filter.
    """
    clash = sorted(set(estimate.details) & set(_CONTEXT))
    if clash:
        raise InputError(f"details has {clash[0]!r}, which the file uses for itself; choose another name")
    truth = estimate.truth
    if truth is not None and len(truth.attitude) != len(estimate.time):
        raise InputError(
            f"truth has {len(truth.attitude)} rows and the estimate {len(estimate.time)}; give the truth at the estimate's times"
        )
    context = {name: getattr(estimate, name) for name in ("fixed_frame", "motion", "smoothed", "remarks")}
    attributes = {name: value for name, value in context.items() if value or name == "smoothed"}
    if estimate.setup is not None:
        attributes["filter"] = to_toml(estimate.setup)
    with result_file(
        path, "estimate", {**attributes, **origin_attributes(estimate.origin), **estimate.details}
    ) as file:
        size = 6 if estimate.has_bias else 3
        known = {"variance": np.s_[:, :size], "covariance": np.s_[:, :size, :size]}
        unknown = (*(() if estimate.has_bias else ("bias",)), *(() if estimate.has_covariance else known))
        for name, unit in _VALUES.items():
            value = getattr(estimate, name)
            if value is not None and name not in unknown:
                put(file, name, value[known.get(name, ...)], unit)
        if truth is not None:
            _put_truth(file, truth)
        for number, (sensor, innovations) in enumerate(estimate.innovations.items()):
            group = file.create_group(f"innovations/{number:06d}")
            # The sensor is not the group's name, because a slash in it would create a subgroup.
            set_attributes(group, {"sensor": sensor})
            _put_innovations(group, innovations)
        for number, (sensor, skipped) in enumerate(estimate.skipped.items()):
            set_attributes(file.create_group(f"skipped/{number:06d}"), {"sensor": sensor, "number": skipped})
        for number, event in enumerate(estimate.events):
            set_attributes(file.create_group(f"events/{number:06d}"), vars(event))
        for number, (name, block) in enumerate(estimate.error_states.items()):
            group = file.create_group(f"states/{number:06d}")
            set_attributes(group, {"name": name, "components": block.components, "units": block.units})
            put(group, "values", block.values, "those of the attribute units")
            put(group, "variance", block.variance, "the square of the values'")


def _put_innovations(group: Any, innovations: Innovations) -> None:
    put(group, "time", innovations.time, "s")
    put(group, "innovation", innovations.innovation, "rad, or the sensor's unit over the length of its reference")
    put(group, "variance", innovations.variance, "the square of the innovation's")
    if innovations.weight is not None:
        put(group, "weight", innovations.weight, "1", "0: rejected; 1: full weight")


def _put_truth(file: Any, truth: Truth) -> None:
    """Write the rows of a truth at which it is known."""
    known = truth.known
    if not known.all():
        put(file, "truth/row", np.flatnonzero(known).astype(np.float64), "1", "rows of the estimate with a truth")
    put(file, "truth/attitude", truth.attitude[known], "1")
    if truth.has_bias:
        put(file, "truth/bias", truth.bias, "rad/s")
    if truth.movement is not None:
        put(file, "truth/movement", truth.movement.astype(np.float64), "1", "1: the unit moves")


def read_estimate(path: str | os.PathLike[str]) -> Estimate:
    """Read an estimate written by :func:`write_estimate`, with all its context.

    Rejected are shapes that do not fit each other, decreasing times, quaternions that are not of unit norm, variances of zero or less, and
    biases above 1e6 rad/s.
    """
    with reading.hdf5(path) as file:
        attributes = reading.attributes(file)
        if attributes.get("kind") != KIND:
            raise InputError(f"{path} is not a strapdown estimate; give the estimate.h5 of `strapdown estimate`")
        time = increasing(reading.place(file, "time"), numbers(file, "time", ("n",)))
        rows = len(time)
        attitude = _attitudes(file, "attitude", rows)
        known = are_finite(attitude)
        variance, covariance = _variances(file, known)
        return Estimate(
            time=time,
            attitude=attitude,
            bias=_biases(file, "bias", known) if "bias" in file else np.full((rows, 3), np.nan),
            variance=variance,
            covariance=covariance,
            whole_covariance=_at_known(file, "whole_covariance", (rows, "n", "n"), known)
            if "whole_covariance" in file
            else None,
            innovations=innovations(file),
            skipped={str(of["sensor"]): count("skipped", of["number"], minimum=0) for of, _ in parts(file, "skipped")},
            events=tuple(
                Event(
                    kind=one_of("kind of an event", own["kind"], EVENT_KINDS),
                    sensor=str(own["sensor"]),
                    **{name: finite(f"{name} of an event", own[name]) for name in ("start", "end", "value")},
                )
                for own, _ in parts(file, "events")
            ),
            error_states={str(own["name"]): _states(own, part, rows) for own, part in parts(file, "states")},
            truth=_truth(file, rows) if "truth" in file else None,
            setup=from_toml(str(attributes["filter"]), f"{path}: filter") if "filter" in attributes else None,
            origin=origin_of(attributes, path),
            fixed_frame=str(attributes.get("fixed_frame", "")),
            motion=str(attributes.get("motion", "")),
            smoothed=bool(attributes.get("smoothed", False)),
            remarks=tuple(map(str, attributes.get("remarks", ()))),
            details={name: value for name, value in attributes.items() if name not in _CONTEXT},
        )


def _at_known(group: Any, name: str, shape: tuple[int | str, ...], known: np.ndarray) -> Array:
    """Return an array of a file that is finite at the rows that are known."""
    value = numbers(group, name, shape, allow_nan=True)
    unknown = ~known.reshape(-1, *[1] * (value.ndim - 1))
    remedy = ", although the row has an attitude; the file is damaged, repeat the estimate"
    return need_each(reading.place(group, name), value, np.isfinite(value) | unknown, remedy)


def _variances(file: Any, known: np.ndarray) -> tuple[Array, Array | None]:
    """Return variance (rows, 6) and covariance (rows, 6, 6) of attitude and bias, NaN where there is none, without a covariance None."""
    rows, size = len(known), 6 if "bias" in file else 3  # an estimate of another program may have none
    without = (0, 6 - size)
    if not ("variance" in file or "covariance" in file):  # of an integrated attitude
        return np.full((rows, 6), np.nan), np.broadcast_to(np.nan, (rows, 6, 6))
    variance = above_zero(reading.place(file, "variance"), _at_known(file, "variance", (rows, size), known))
    variance = np.pad(variance, ((0, 0), without), constant_values=np.nan)
    if "covariance" not in file:
        return variance, None
    covariance = _at_known(file, "covariance", (rows, size, size), known)
    above_zero(f"{reading.place(file, 'covariance')}, diagonal", np.diagonal(covariance, axis1=1, axis2=2))
    return variance, np.pad(covariance, ((0, 0), without, without), constant_values=np.nan)


def _biases(group: Any, name: str, known: np.ndarray) -> Array:
    """Return gyro biases (rows, 3), finite at the rows that are known, checked not to exceed :data:`LARGEST_BIAS`."""
    value = _at_known(group, name, (len(known), 3), known)
    remedy = (
        " rad/s, more than any gyro has; the file is damaged or its filter diverged: repeat the estimate, and check its initial state and "
        "the gyro's unit"
    )
    return need_each(reading.place(group, name), value, ~(np.abs(value) > LARGEST_BIAS), remedy)


def _attitudes(group: Any, name: str, rows: int) -> Array:
    """Return attitudes (rows, 4) unchanged, checked to be of unit norm, or NaN where not known."""
    value = numbers(group, name, (rows, 4), allow_nan=True)
    unknown = np.isnan(value).all(axis=1, keepdims=True)
    unit_quaternions(reading.place(group, name), np.where(unknown, quaternion.IDENTITY, value))
    return value


def _truth(file: Any, rows: int) -> Truth:
    """Return the truth at the rows of an estimate, NaN where there is none."""
    row = np.arange(rows)
    if "truth/row" in file:
        row = numbers(file, "truth/row", ("m",)).astype(np.intp)
        if np.any(np.diff(row, prepend=-1) <= 0) or np.any(row >= rows):
            place = reading.place(file, "truth/row")
            raise InputError(f"{place} are not increasing rows of the estimate; the file is damaged")
    attitude = np.full((rows, 4), np.nan)
    attitude[row] = _attitudes(file, "truth/attitude", len(row))
    bias = _biases(file, "truth/bias", np.zeros(rows, bool)) if "truth/bias" in file else np.full((rows, 3), np.nan)
    movement = numbers(file, "truth/movement", (rows,)) > 0.0 if "truth/movement" in file else None
    return Truth(attitude=attitude, bias=bias, movement=movement)


def _states(attributes: dict[str, Any], part: Any, rows: int) -> ErrorStateEstimate:
    """Return the estimate of one group of error states."""
    values = numbers(part, "values", (rows, len(attributes["components"])))
    if len(attributes["units"]) != len(attributes["components"]):
        raise InputError(f"{reading.place(part, 'units')} and components differ in number; the file is damaged")
    return ErrorStateEstimate(
        components=tuple(map(str, attributes["components"])),
        units=tuple(map(str, attributes["units"])),
        values=values,
        variance=above_zero(reading.place(part, "variance"), numbers(part, "variance", values.shape)),
    )
