"""IMU records in self-describing HDF5 files.

Everything is stored exactly: increments, every vector series, the truth, the specification of the gyro, the scenario, seed, units,
conventions and version.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import gyro
from strapdown.checks import Array, InputError, count
from strapdown.files import reading, set_attributes
from strapdown.records import ImuRecord, Origin, Truth, put, result_file
from strapdown.vectors import KINDS, VectorMeasurements

KIND = "strapdown record"
"""The attribute ``kind`` of a record's file."""

FORMAT = 1
"""Version of the layout; a newer one is rejected by the reader."""
_SERIES = {
    "time": "s",
    "vector_b": "1 (kind vector: the unit of sigma)",
    "reference_f": "1 (kind vector: the unit of sigma)",
    "sigma": "rad (kind vector: the unit of the vector)",
    "attitude": "1",
    "sigma_axes": "rad (kind vector: the unit of the vector)",
    "covariance": "the square of sigma's",
    "arrival": "s",
}


def write_record(path: str | os.PathLike[str], record: ImuRecord) -> None:
    """Write a record to HDF5, with its origin; the file is created only when complete.

    A scenario with a Python function or a user-defined class cannot be written to a file and is left out.
    """
    with result_file(path, "record", {"format": FORMAT, **origin_attributes(record.origin)}) as file:
        put(file, "time", record.time, "s", "edges of the sample intervals, one more than there are increments")
        put(
            file,
            "increments",
            record.increments,
            "rad",
            "integral of the measured body rate over each interval, body axes",
        )
        for number, series in enumerate(record.vectors):
            group = file.create_group(f"vectors/{number}")
            degrees = KINDS[series.kind]
            set_attributes(group, {"sensor": series.sensor, "kind": series.kind, "degrees_of_freedom": degrees})
            for name, unit in _SERIES.items():
                value = getattr(series, name)
                if value is not None and not (series.kind == "attitude" and name in ("vector_b", "sigma")):
                    put(group, name, value, unit)
        if record.truth is not None:
            put(file, "truth/attitude", record.truth.attitude, "1", "q_fb at the edges")
            put(file, "truth/bias", record.truth.bias, "rad/s", "gyro bias at the edges, body axes")
            if record.truth.movement is not None:
                put(file, "truth/movement", record.truth.movement.astype(np.float64), "1", "1: the unit moves")
        if record.temperature is not None:
            put(file, "temperature", record.temperature, "degC", "of the gyro, at the edges")


def is_record(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is marked as written by :func:`write_record`; its content is not checked."""
    return reading.kind(path) == KIND


def read_record(path: str | os.PathLike[str]) -> ImuRecord:
    """Read the record of a file written by :func:`write_record`, with its origin.

    Measurements of NaN are missing. An increment must not be NaN, because the rotation over its interval would be unknown.
    """
    with reading.hdf5(path) as file:
        attributes = reading.attributes(file)
        kind = attributes.get("kind")
        if kind != KIND:
            raise InputError(
                f"{path} is {f'a {kind}' if kind else 'HDF5 of another program'}, not a {KIND}; give a file written by write_record"
            )
        if count("format", attributes["format"]) > FORMAT:
            raise InputError(
                f"{path} has layout {attributes['format']}, and this version reads up to {FORMAT}; update it"
            )
        group = file.get("vectors", {})
        series = tuple(_series(group[str(number)]) for number in range(len(group)))
        truth = None
        if "truth" in file:
            movement = _values(file, "truth/movement", "1") > 0.0 if "truth/movement" in file else None
            attitude, bias = _values(file, "truth/attitude", "1"), _values(file, "truth/bias", "rad/s")
            truth = Truth(attitude=attitude, bias=bias, movement=movement)
        return ImuRecord(
            time=_values(file, "time", "s"),
            increments=_values(file, "increments", "rad"),
            vectors=series,
            truth=truth,
            origin=origin_of(attributes, path, source=Path(path).name),
            temperature=_values(file, "temperature", "degC") if "temperature" in file else None,
        )


def origin_attributes(origin: Origin | None) -> dict[str, Any]:
    """Return the known fields of a record's origin as values for a file."""
    if origin is None:
        return {}
    scenario = None
    if origin.scenario is not None:
        from strapdown.scenarios import scenario_to_toml  # imported late, because it imports every motion

        with contextlib.suppress(InputError):
            scenario = scenario_to_toml(origin.scenario)
    spec = None if origin.gyro is None else json.dumps(gyro.to_table(origin.gyro))
    attributes = {
        "gyro": spec,
        "scenario": scenario,
        "seed": origin.seed,
        "run": origin.run,
        "source": origin.source or None,
        "epoch_ns": origin.epoch_ns or None,
    }
    return {name: value for name, value in attributes.items() if value is not None}


def origin_of(attributes: Mapping[str, Any], path: str | os.PathLike[str], *, source: str = "") -> Origin | None:
    """Return the origin in the attributes of a file, as from :func:`origin_attributes`; None if there is nothing of it.

    ``source`` is that of an origin whose attributes do not name one.
    """
    held = [name for name in ("seed", "run") if name in attributes]
    origin: dict[str, Any] = {name: count(name, attributes[name], minimum=0) for name in held}
    if "epoch_ns" in attributes:
        origin["epoch_ns"] = epoch_of(attributes)
    if "gyro" in attributes:
        origin["gyro"] = gyro.from_table(reading.from_json(str(attributes["gyro"]), f"{path}: gyro"), f"{path}: gyro")
    if origin or attributes.keys() & {"scenario", "source"}:
        origin["source"] = str(attributes.get("source", source))
    if "scenario" in attributes:
        from strapdown.scenarios import scenario_from_toml  # imported late, because it imports every motion

        if not isinstance(attributes["scenario"], str):
            raise InputError(f"{path}: scenario is {attributes['scenario']!r}; it must be TOML text")
        origin["scenario"] = scenario_from_toml(attributes["scenario"], f"{path}: scenario")
        origin.setdefault("gyro", origin["scenario"].gyro)
    return Origin(**origin) if origin else None


def epoch_of(attributes: Mapping[str, Any]) -> int:
    """Return the reading of the clock at time 0 in the attributes of a file, ns since 1970; 0: unknown."""
    return count("epoch_ns", attributes.get("epoch_ns", 0), minimum=-sys.maxsize)


def _values(group: Any, name: str, unit: str) -> Array:
    """Return an array of a file; its attribute ``unit``, if present, must be the expected one."""
    value = reading.numbers(group, name)
    own = reading.attributes(group[name]).get("unit", unit)
    if own != unit:
        raise InputError(f"{reading.place(group, name)} is in {own!r}, but must be in {unit!r}; convert it")
    return value


def _series(group: Any) -> VectorMeasurements:
    fields = {name: _values(group, name, unit) for name, unit in _SERIES.items() if name in group}
    attributes = reading.attributes(group)
    if attributes["kind"] != "attitude" and not fields.keys() & {"sigma", "sigma_axes", "covariance"}:
        raise InputError(
            f"{group.file.filename}: {group.name.lstrip('/')} ({attributes['sensor']}) has no sigma; give each measurement one"
        )
    return VectorMeasurements(sensor=attributes["sensor"], kind=attributes["kind"], **fields)
