"""Samples of one sensor at equal intervals, for the identification of its noise."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from strapdown.checks import Array, Hint, InputError, array, one_of, positive
from strapdown.files import reading
from strapdown.recordings import formats, recordfiles
from strapdown.recordings.broad import sample_interval
from strapdown.recordings.columns import UNITS
from strapdown.recordings.gyro_temperature import temperature_at_samples
from strapdown.records import ImuRecord
from strapdown.records.recording import GAP, SENSORS, Recording, field_in


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroSamples:
    """Samples of a gyro or another sensor at equal intervals, for noise identification.

    Parameters
    ----------
    values : ndarray (n, axes)
        Samples, SI (rad/s, m/s², T), or increments of a gyro, rad. Missing samples are NaN.
    sample_interval : float
        Sample interval, s.
    kind : {"rate", "increments"}
        Kind of the values.
    temperature : ndarray (n,), optional
        Temperature, °C, if it was recorded.
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
) -> GyroSamples:
    """Read one sensor of a recording of any format, the gyro of a simulated record, or a NPY array (n,) or (n, 3).

    ``rate``, Hz, is only for an array, whose unit is ``units[sensor]``; other options as for :func:`strapdown.read`. Samples with gaps are
    placed on a grid, and missing ones are NaN.
    """
    file, unit_of_sensor = Path(path), dict(units or {})
    one_of("sensor", sensor, SENSORS)
    npy = file.suffix.lower() == ".npy"
    simulated = not npy and recordfiles.is_record(file)
    for name, value in (("units", units), ("columns", columns), ("topic", topic)):
        if value and (simulated or (npy and name != "units")):
            what = "a record, which declares its own layout" if simulated else "one array"
            raise InputError(f"{file.name} is {what}; leave {Hint(name, value)} out")
    if npy:
        samples = _read_array(file, sensor, rate, unit_of_sensor)
    elif rate is not None:
        raise InputError(f"{file.name} states its own rate; drop the option rate")
    elif simulated:
        samples = samples_of(recordfiles.read_record(file), sensor, source=file.name)
    else:
        recording = formats.read(file, units=unit_of_sensor, columns=columns, topic=topic)
        samples = samples_of(recording, sensor)
    if samples.values.shape[1] not in (1, 3):
        raise InputError(
            f"{file.name} has {samples.values.shape[1]} columns; give one for each of the three axes, or for one axis"
        )
    hertz, largest = 1.0 / samples.sample_interval, float(np.nanmax(np.abs(samples.values), initial=0.0))
    if not (1.0 / LARGEST <= hertz <= LARGEST and largest <= LARGEST):
        raise InputError(f"{file.name}: no {sensor} has {hertz:g} Hz and {largest:g}, SI; check its rate and its unit")
    return samples


LARGEST = 1e12
"""Maximum sample, SI, and sample rate, Hz: far beyond any sensor, and far below overflow of squares in a fit."""


def samples_of(content: Recording | ImuRecord, sensor: str = "gyro", *, source: str = "record") -> GyroSamples:
    """Return the samples of one sensor of a recording or a simulated record, as :func:`read_samples` does for a file."""
    one_of("sensor", sensor, SENSORS)
    if isinstance(content, Recording):
        return _of_recording(content, sensor)
    if sensor == "gyro":
        interval = sample_interval(source, content.time[1:])
        T = None if content.temperature is None else content.temperature[1:]
        return GyroSamples(values=content.increments, sample_interval=interval, kind="increments", temperature=T)
    kinds = {series.sensor: series.kind for series in content.vectors}
    if kinds.get(sensor, "vector") != "vector":
        raise InputError(
            f'{source}: the {sensor} of the record measures a {kinds[sensor]}; simulate it with kind = "vector"'
        )
    return _of_recording(formats.from_record(content, source), sensor)


def _read_array(file: Path, sensor: str, rate: float | None, unit_of_sensor: Mapping[str, str]) -> GyroSamples:
    values = reading.npy(file)
    if rate is None or sensor not in unit_of_sensor:
        names = " or ".join(UNITS[sensor])
        raise InputError(f"{file.name} is an array without rate and unit; give its rate in Hz and its unit ({names})")
    factor = UNITS[sensor][one_of(f"{file.name}: unit of the {sensor}", unit_of_sensor[sensor], UNITS[sensor])]
    axes = array(file.name, np.reshape(values, (-1, 1)) if np.ndim(values) == 1 else values, ("n", "axes"))
    return GyroSamples(values=axes * factor, sample_interval=1.0 / positive("rate", rate, unit="Hz"), kind="rate")


def _of_recording(recording: Recording, sensor: str) -> GyroSamples:
    """Return one sensor's samples, SI; for a sensor of lower rate, only the stamps where it has samples."""
    values = getattr(recording, SENSORS[sensor])
    if values is None:
        raise InputError(f"{recording.source} has no {sensor}; choose another sensor or file")
    if sensor == "magnetometer":
        values = field_in("T", recording)
    known = np.asarray(~np.isnan(values).any(axis=1))
    time, samples = recording.time[known], values[known]
    temperature = None if recording.temperature is None else temperature_at_samples(recording)[known]
    remarks = recording.remarks
    try:
        interval = sample_interval(recording.source, time)
    except InputError:
        interval, place, words = _grid(recording.source, time)
        remarks += words
        filled = np.full((place[-1] + 1, 3), np.nan)
        filled[place] = samples
        samples = filled
        if temperature is not None:
            temperature = np.interp(np.arange(place[-1] + 1), place, temperature)
    return GyroSamples(values=samples, sample_interval=interval, kind="rate", temperature=temperature, remarks=remarks)


JITTER = 0.25
"""Maximum deviation of stamps from the grid, in intervals, for each sample to be placed at its nearest grid point."""


def _grid(source: str, time: Array) -> tuple[float, np.ndarray, tuple[str, ...]]:
    """Return the interval of the grid of the stamps, s, the grid index of each, and remarks.

    If all stamps are near the grid, every lost sample is found. If stamps are irregular, as from a busy computer, only gaps are found, and
    the samples between gaps are assumed to be equally spaced.
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
            f"Intervals of {source} deviate by up to {1e3 * float(np.abs(steps[~gap] - interval).max()):.3g} ms from the mean: between "
            f"gaps the samples are assumed to be equally spaced, {1.0 / interval:.6g} Hz.",
        )
    place = np.concatenate([[0], np.cumsum(whole)]).astype(np.int64)
    missing = int(place[-1] + 1 - len(place))
    if missing:
        words += (f"{missing} samples are missing in {int(np.sum(whole > 1.0))} gaps.",)
    return interval, place, words
