"""Samples of one sensor at even intervals, for the identification of its noise."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from strapdown.checks import Array, InputError, array, one_of, positive
from strapdown.files import reading
from strapdown.recordings import formats, recordfiles
from strapdown.recordings.broad import sample_interval
from strapdown.recordings.columns import SENSORS, UNITS
from strapdown.recordings.gyro_temperature import temperature_at_samples
from strapdown.records import ImuRecord
from strapdown.records.recording import GAP, Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroSamples:
    """Samples of a gyro, or of another sensor, at even intervals, for noise identification.

    Parameters
    ----------
    values : ndarray (n, axes)
        Samples, SI (rad/s, m/s², T), or increments of a gyro, rad. NaN where a sample is missing, if gaps were allowed.
    sample_interval : float
        Sample interval, s.
    kind : {"rate", "increments"}
        Kind of the values.
    temperature : ndarray (n,), optional
        Temperature, °C, where it was recorded.
    remarks : tuple of str, default empty
        Choices and omissions of the reader.
    """

    values: Array
    sample_interval: float
    kind: str
    temperature: Array | None = None
    remarks: tuple[str, ...] = field(default=())


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
    """Read one sensor of a recording of any format, the gyro of a simulated record, or a NPY array (n,) or (n, 3).

    Parameters
    ----------
    path : path-like
        File.
    sensor : {"gyro", "accelerometer", "magnetometer"}, default "gyro"
        Sensor.
    rate : float, optional
        Sample rate of a bare array, Hz.
    units : mapping of str to str, optional
        Units as in :func:`strapdown.recordings.read`; of a bare array by the name of the sensor.
    columns : mapping of str to str, optional
        For tables: names of columns by role, perhaps with a unit, ``{"time": "timestamp [us]", "gx": "gyro_x[dps]"}``; the others
        are found by their names.
    topic : str, default ""
        For bags and flight logs: topic of the inertial unit, where there are several.
    gaps : bool, default False
        Whether gaps are allowed: samples then lie on a grid of the usual interval, and missing ones are NaN.

    Returns
    -------
    GyroSamples
        Samples at even intervals.

    Raises
    ------
    InputError
        If the sensor is missing, its unit is unknown, or its samples lie at uneven intervals.
    """
    file = Path(path)
    one_of("sensor", sensor, SENSORS)
    given = dict(units or {})
    if file.suffix.lower() == ".npy":
        reading.existing_file(file)
        with reading.from_file(file):
            return _read_array(file, sensor, rate, given)
    if rate is not None:
        raise InputError(f"{file.name} states its own rate; drop the option rate")
    if not file.is_dir() and file.exists() and recordfiles.is_record(file):
        if given:
            raise InputError(
                f"{file.name} is a record, whose layout defines its units; drop the option for {', '.join(given)}"
            )
        return samples_of(recordfiles.read_record(file), sensor, gaps=gaps, source=file.name)
    recording = formats.read(file, units=given, gyro_alone=sensor == "gyro", columns=columns, topic=topic)
    return samples_of(recording, sensor, gaps=gaps)


def samples_of(
    content: Recording | ImuRecord, sensor: str = "gyro", *, gaps: bool = False, source: str = "record"
) -> GyroSamples:
    """Return the samples of one sensor of a recording or a simulated record, as :func:`read_samples` for its file."""
    one_of("sensor", sensor, SENSORS)
    if isinstance(content, Recording):
        return _of_recording(content, sensor, gaps)
    if sensor == "gyro":
        interval = sample_interval(Recording(source=source, time=content.time[1:], rate=content.increments))
        temperature = None if content.temperature is None else content.temperature[1:]
        return GyroSamples(
            values=content.increments, sample_interval=interval, kind="increments", temperature=temperature
        )
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
    temperature = None if recording.temperature is None else temperature_at_samples(recording)[known]
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
    """Return the interval of the grid that the stamps lie on, s, the place of each, and remarks.

    Stamps near the grid reveal every lost sample. Stamps with larger delays, as from a busy computer, reveal only gaps: between gaps the
    samples are assumed to be even.
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
            f"the samples are assumed to be even, {1.0 / interval:.6g} Hz.",
        )
    place = np.concatenate([[0], np.cumsum(whole)]).astype(np.int64)
    missing = int(place[-1] + 1 - len(place))
    if missing:
        words += (f"{missing} samples are missing in {int(np.sum(whole > 1.0))} gaps.",)
    return interval, place, words
