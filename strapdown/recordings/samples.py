"""Samples of one sensor at even intervals, for the identification of its noise."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from strapdown import reading, recordfiles
from strapdown.checks import Array, InputError, array, one_of, positive
from strapdown.recordings import formats
from strapdown.recordings.broad import EVEN, sample_interval
from strapdown.recordings.columns import SENSORS, UNITS
from strapdown.recordings.recording import GAP, RATE_UNITS, Recording
from strapdown.records import ImuRecord


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroSamples:
    """Samples of a gyro, or of another sensor, at even intervals, for noise identification."""

    values: Array
    """Samples (n, axes), SI: rad/s, m/s², T; of a gyro perhaps increments, rad. NaN where a sample is missing, if gaps were allowed."""
    sample_interval: float
    """s"""
    kind: str
    """"rate" (samples) or "increments"."""
    temperature: Array | None = None
    """Temperature (n,), °C, where it was recorded."""
    remarks: tuple[str, ...] = field(default=())
    """What the reader chose or left out."""


def read_gyro(
    path: str | os.PathLike[str],
    *,
    rate: float | None = None,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    topic: str = "",
) -> GyroSamples:
    """Read the gyro of a recording of any format, a simulated record, or a NPY array (n,) or (n, 3) of rates.

    An array tells neither its rate nor its unit: give ``rate`` in Hz and ``units={"gyro": ...}``. Samples must lie at even intervals.
    """
    return read_samples(path, "gyro", rate=rate, units=units, columns=columns, topic=topic)


def read_samples(
    path: str | os.PathLike[str],
    sensor: str = "gyro",
    *,
    rate: float | None = None,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    topic: str = "",
    gaps: bool = False,
) -> GyroSamples:
    """Read one sensor of a recording of any format, a simulated record's gyro, or a NPY array (n,) or (n, 3).

    Parameters
    ----------
    path : path
    sensor : {"gyro", "accelerometer", "magnetometer"}
    rate : float, optional
        Samples a second, Hz, of a bare array.
    units, columns, topic
        As :func:`strapdown.recordings.read` takes them; ``units`` tells the unit of a bare array too.
    gaps : bool
        Allow gaps: samples lie on a grid of the usual interval then, and missing ones are NaN.

    Raises
    ------
    InputError
        If the sensor is not there, its unit is unknown, or its samples lie at uneven intervals.
    """
    file = Path(path)
    one_of("sensor", sensor, SENSORS)
    given = dict(units or {})
    if file.suffix.lower() == ".npy":
        reading.existing_file(file)
        with reading.from_file(file):
            return _read_array(file, sensor, rate, given)
    if rate is not None:
        raise InputError(f"{file.name} tells its own rate; drop the option rate")
    if not file.is_dir() and file.exists() and recordfiles.is_record(file):
        if given:
            raise InputError(
                f"{file.name} is a record, whose layout says its units; drop the option for {', '.join(given)}"
            )
        return samples_of(recordfiles.read_record(file), sensor, gaps=gaps, source=file.name)
    recording = formats.read(file, units=given, gyro_alone=sensor == "gyro", columns=columns, topic=topic)
    return samples_of(recording, sensor, gaps=gaps)


def samples_of(
    content: Recording | ImuRecord, sensor: str = "gyro", *, gaps: bool = False, source: str = "record"
) -> GyroSamples:
    """Return one sensor's samples of a recording or a simulated record, as :func:`read_samples` reads them from its file.

    Parameters
    ----------
    content : Recording or ImuRecord
    sensor : {"gyro", "accelerometer", "magnetometer"}
    gaps : bool, default False
        Allow gaps: missing samples are rows of NaN then.
    source : str
        What errors call a record; a recording has a name of its own.

    Returns
    -------
    GyroSamples

    Raises
    ------
    InputError
        If the sensor is not there, its unit is unknown, or its samples lie at uneven intervals.
    """
    one_of("sensor", sensor, SENSORS)
    if isinstance(content, Recording):
        return _of_recording(content, sensor, gaps)
    if sensor == "gyro":
        interval = sample_interval(Recording(source=source, time=content.time[1:], rate=content.increments))
        return GyroSamples(values=content.increments, sample_interval=interval, kind="increments")
    return _of_recording(formats.from_record(content, source), sensor, gaps)


def _read_array(file: Path, sensor: str, rate: float | None, given: Mapping[str, str]) -> GyroSamples:
    names = " or ".join(list(UNITS[sensor])[:2]) if sensor == "gyro" else " or ".join(UNITS[sensor])
    if rate is None or sensor not in given:
        raise InputError(f"{file.name} is a bare array; give its rate in Hz and its unit ({names})")
    values = reading.npy(file)
    factor = UNITS[sensor][one_of(f"{file.name}: unit of the {sensor}", given[sensor], UNITS[sensor])]
    axes = array(file.name, np.reshape(values, (-1, 1)) if np.ndim(values) == 1 else values, ("n", "axes"))
    return GyroSamples(values=axes * factor, sample_interval=1.0 / positive("rate", rate, unit="Hz"), kind="rate")


def _of_recording(recording: Recording, sensor: str, gaps: bool) -> GyroSamples:
    """Return one sensor's samples, SI; a slower sensor's at its own stamps."""
    values = {
        "gyro": recording.rate,
        "accelerometer": recording.specific_force,
        "magnetometer": recording.magnetic_field,
    }[sensor]
    if values is None:
        raise InputError(f"{recording.source} has no {sensor}; choose another sensor or file")
    factor = 1.0
    if sensor == "magnetometer":
        if not recording.magnetic_unit:
            raise InputError(
                f"{recording.source} does not say the unit of its magnetometer; declare it in the header or by option "
                f"({' or '.join(UNITS['magnetometer'])})"
            )
        factor = UNITS["magnetometer"][recording.magnetic_unit]
    known = np.asarray(~np.isnan(values).any(axis=1))
    time, samples = recording.time[known], values[known] * factor
    temperature = None if recording.temperature is None else recording.temperature[known]
    remarks = recording.remarks
    own = Recording(source=recording.source, time=time, rate=np.zeros((len(time), 3)))
    try:
        interval = sample_interval(own)
    except InputError:
        if not gaps:
            raise
        interval, place, words = _grid(recording.source, time)
        remarks += words
        filled = np.full((place[-1] + 1, 3), np.nan)
        filled[place] = samples
        samples = filled
        if temperature is not None:
            temperature = np.interp(np.arange(place[-1] + 1), place, temperature)
    return GyroSamples(values=samples, sample_interval=interval, kind="rate", temperature=temperature, remarks=remarks)


JITTER = 0.25
"""Largest distance of a stamp from the grid, in intervals, at which a sample is still that of its place."""


def _grid(source: str, time: Array) -> tuple[float, np.ndarray, tuple[str, ...]]:
    """Return the interval of the grid that the stamps lie on, s, the place of each, and what is to be said.

    Stamps near the grid tell every lost sample. Those that are late by more, as of a computer that was busy, tell only gaps: within a
    stretch between gaps the samples are taken to be even.
    """
    steps = np.diff(time)
    usual = float(np.median(steps))
    interval = float(np.mean(steps[np.abs(steps - usual) < 0.5 * usual]))
    whole = np.rint(steps / interval)
    off = np.abs(steps - whole * interval)
    words: tuple[str, ...] = ()
    if off.max() > JITTER * interval or whole.min() < 1.0:
        gap = steps > GAP * usual
        interval = float(np.mean(steps[~gap]))
        whole = np.where(gap, np.rint(steps / interval), 1.0)
        words = (
            f"Intervals of {source} stray by up to {1e3 * float(np.abs(steps[~gap] - interval).max()):.3g} ms from the mean: between gaps "
            f"the samples are taken for even, {1.0 / interval:.6g} Hz.",
        )
    place = np.concatenate([[0], np.cumsum(whole)]).astype(np.int64)
    missing = int(place[-1] + 1 - len(place))
    if missing:
        words += (f"{missing} samples are missing in {int(np.sum(whole > 1.0))} gaps.",)
    return interval, place, words


__all__ = ["EVEN", "JITTER", "RATE_UNITS", "GyroSamples", "read_gyro", "read_samples", "samples_of"]
