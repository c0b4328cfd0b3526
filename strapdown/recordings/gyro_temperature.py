"""Subtraction of a gyro's bias over temperature from a recording with temperatures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.gyro.temperature import BiasOverTemperature
from strapdown.records.recording import Recording


def temperature_at_samples(recording: Recording) -> Array:
    """Return the temperature at every stamp (n,), °C, by linear interpolation, because its sample rate is below that of the gyro."""
    T = recording.temperature
    known = np.zeros(0, bool) if T is None else np.isfinite(T)
    if T is None or not known.any():
        raise InputError(f"{recording.source} has no temperature; leave out the gyro's bias over temperature")
    return np.asarray(np.interp(recording.time, recording.time[known], T[known]))


def applied(recording: Recording, warm: BiasOverTemperature) -> Recording:
    """Return a recording with the gyro's bias over temperature subtracted and a temperature at every sample, within the span of the fit."""
    T = temperature_at_samples(recording)
    beyond = int(np.sum((warm.span[0] > T) | (warm.span[1] < T)))
    words = "The gyro's bias over temperature is subtracted; the estimated bias is the remainder."
    if beyond:
        words += f" {beyond} samples are beyond {warm.span[0]:.4g} to {warm.span[1]:.4g} °C; for them the bias at the limit is used."
    remarks = (*recording.remarks, words)
    return replace(recording, rate=recording.rate - warm.bias(T), temperature=np.clip(T, *warm.span), remarks=remarks)
