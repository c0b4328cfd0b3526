"""Self-describing HDF5 files of results: what all of them have in common."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

import strapdown
from strapdown.checks import Array, InputError, array
from strapdown.files import atomic_write, reading, set_attributes, whole_hdf5
from strapdown.records.estimate import Innovations

CONVENTIONS = (
    "quaternions Hamilton, scalar first, body to fixed frame: v_f = q v_b q^-1; error state (dtheta, db): "
    "q_true = q exp(dtheta), db = b_true - b; SI units and radians"
)

CHUNK_ROWS = 4096
"""Maximum number of rows of a compressed chunk."""


@contextlib.contextmanager
def result_file(
    path: str | os.PathLike[str], kind: str, attributes: Mapping[str, Any] | None, *, durable: bool = False
) -> Iterator[Any]:
    """Yield an HDF5 file with its kind, version and conventions as attributes; written by :func:`strapdown.files.atomic_write`."""
    with atomic_write(path, durable=durable) as temporary, whole_hdf5(temporary) as file:
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


def read_attributes(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the attributes of a result file of any kind: its kind, version, conventions, and those of the writer."""
    with reading.hdf5(path) as file:
        attributes = reading.attributes(file)
    if not str(attributes.get("kind", "")).startswith("strapdown "):
        raise InputError(f"{path} is not a result of strapdown; pass a file written by one of its commands")
    return attributes


def numbers(group: Any, name: str, shape: tuple[int | str, ...], *, allow_nan: bool = False) -> Array:
    """Return an array of a file, checked by :func:`strapdown.checks.array`."""
    return array(reading.place(group, name), reading.numbers(group, name), shape, allow_nan=allow_nan)


def need_each(place: str, value: Array, good: Any, remedy: str) -> Array:
    """Return values, checked entry by entry; the error names the first that is not good."""
    if not np.all(good):
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        raise InputError(f"{place}{list(index)} is {value[index]:g}{remedy}")
    return value


def above_zero(place: str, variance: Array) -> Array:
    """Return variances, checked to be positive; NaN is not known."""
    remedy = (
        ", and a variance must be greater than zero; the file is damaged, or a sensor had no noise: give each a sigma above zero and "
        "repeat the estimate"
    )
    return need_each(place, variance, ~(variance <= 0.0), remedy)


def parts(file: Any, name: str) -> list[tuple[dict[str, Any], Any]]:
    """Return the subgroups of a group, each with its attributes; empty if there is no such group."""
    return [(reading.attributes(part), part) for part in file[name].values()] if name in file else []


def innovations(file: Any) -> dict[str, Innovations]:
    """Return the innovations of an estimate's file by sensor."""
    return {str(own["sensor"]): _innovations(part) for own, part in parts(file, "innovations")}


def _innovations(part: Any) -> Innovations:
    number = len(numbers(part, "time", ("m",)))
    innovation = numbers(part, "innovation", (number, "degrees of freedom"))
    return Innovations(
        time=numbers(part, "time", (number,)),
        innovation=innovation,
        variance=above_zero(reading.place(part, "variance"), numbers(part, "variance", innovation.shape)),
        weight=numbers(part, "weight", (number,)) if "weight" in part else None,
    )
