"""Recordings from the bench and the field: any format in, any format out, with clear words where a file is not what it should be.

A recording holds point samples of rate, specific force and magnetic field as a device gave them, on one time axis. What a filter makes
of it is in :mod:`strapdown.ahrs`.

``formats``
    The table of formats, :func:`read` by content, :func:`write` by ending.
``recording``
    :class:`Recording` and its units.
``body_axes``
    Axes and signs that are not the package's: :func:`with_axes`.
``columns``, ``delimited``, ``dataframes``
    Tables: which column is what; CSV and TSV; Parquet, pandas and xarray.
``ros``
    ROS bags.
``ulog``
    Flight logs of PX4.
``telemetry``
    Logs of cameras, flight controllers and phones.
``trajectories``
    Folders of EuRoC and TUM-VI, TUM trajectories as references.
``broad``
    BROAD HDF5.
``estimates``
    An estimate in files of all these kinds.
``samples``
    One sensor at rest, for the identification of its noise.
"""

from __future__ import annotations

from strapdown.recordings.body_axes import SENSORS, axes_matrix, with_axes
from strapdown.recordings.broad import EVEN, read_broad, write_broad
from strapdown.recordings.columns import SHORT_STAMPS, parse_mapping
from strapdown.recordings.dataframes import from_table
from strapdown.recordings.delimited import read_csv, write_csv
from strapdown.recordings.formats import (
    FORMATS,
    Format,
    estimate_format,
    format_of,
    from_record,
    is_estimate,
    is_record,
    not_held,
    read,
    write,
    writers,
)
from strapdown.recordings.recording import (
    FORCE_UNITS,
    GAP,
    MAGNETIC_UNITS,
    RATE_UNITS,
    TIME_UNITS,
    Recording,
    gaps,
    increments,
)
from strapdown.recordings.samples import GyroSamples, read_gyro, read_samples
from strapdown.recordings.trajectories import read_euroc, read_tum, with_reference

__all__ = [
    "EVEN",
    "FORCE_UNITS",
    "FORMATS",
    "GAP",
    "MAGNETIC_UNITS",
    "RATE_UNITS",
    "SENSORS",
    "SHORT_STAMPS",
    "TIME_UNITS",
    "Format",
    "GyroSamples",
    "Recording",
    "axes_matrix",
    "estimate_format",
    "format_of",
    "from_record",
    "from_table",
    "gaps",
    "increments",
    "is_estimate",
    "is_record",
    "not_held",
    "parse_mapping",
    "read",
    "read_broad",
    "read_csv",
    "read_euroc",
    "read_gyro",
    "read_samples",
    "read_tum",
    "with_axes",
    "with_reference",
    "write",
    "write_broad",
    "write_csv",
    "writers",
]
