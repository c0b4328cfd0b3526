"""Self-describing HDF5 files of results: what all of them have in common."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

import strapdown
from strapdown.checks import Array, InputError
from strapdown.files import atomic_write, reading, set_attributes, whole_hdf5

CONVENTIONS = (
    "quaternions Hamilton, scalar first, body to fixed frame: v_f = q v_b q^-1; error state (dtheta, db): "
    "q_true = q exp(dtheta), db = b_true - b; SI units and radians"
)

CHUNK_ROWS = 4096
"""Maximum number of rows of a compressed chunk."""


@contextlib.contextmanager
def result_file(path: str | os.PathLike[str], kind: str, attributes: Mapping[str, Any] | None) -> Iterator[Any]:
    """Yield an HDF5 file with its kind, version and conventions as attributes; it is created only when complete."""
    with atomic_write(path) as temporary, whole_hdf5(temporary) as file:
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
