"""Recordings of devices, read from and written to many formats, with clear errors for faulty files.

A recording has point samples of rate, specific force and magnetic field of a device, on one time axis. :func:`strapdown.read` and
:func:`strapdown.write` read and write it, and :mod:`strapdown.ahrs` estimates attitude from it.

Own HDF5 files have a digest and Parquet checksums, which are verified: a changed bit is noticed. In CSV, TUM, ULog and bags one changed bit
of a sample is another sample.

- ``formats``: The table of formats, :data:`FORMATS`: reading by content, writing by file extension.
- ``body_axes``: Axes and signs that differ from the package's: :func:`with_axes`.
- ``columns``, ``delimited``, ``dataframes``: Tables: roles of columns; CSV and TSV; Parquet, pandas and xarray.
- ``ros``: ROS bags.
- ``ulog``: Flight logs of PX4.
- ``telemetry``: Logs of cameras, flight controllers and phones.
- ``trajectories``: Folders of EuRoC and TUM-VI, TUM trajectories as references.
- ``broad``: BROAD HDF5.
- ``samples``: One sensor at rest, for the identification of its noise.
"""

from __future__ import annotations

# Names imported "as" themselves and not listed in __all__ are for use within the package only.
from strapdown.recordings.attitudes import Attitudes
from strapdown.recordings.body_axes import axes_matrix, with_axes
from strapdown.recordings.dataframes import from_table
from strapdown.recordings.formats import FORMATS, estimate_format, format_of, from_record, read, write, writers
from strapdown.recordings.recordfiles import is_record
from strapdown.recordings.samples import GyroSamples, read_samples, samples_of
from strapdown.recordings.trajectories import read_tum, with_reference
from strapdown.records.recording import FORCE_UNITS, RATE_UNITS, TIME_UNITS, Recording, gaps, increments

__all__ = ["FORMATS", "Attitudes", "GyroSamples", "Recording"]
