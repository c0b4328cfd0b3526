"""Bias of a gyro over temperature, subtracted from a recording with temperatures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from strapdown.checks import Array, InputError
from strapdown.gyro.temperature import BiasOverTemperature
from strapdown.records.recording import Recording


def temperature_at_samples(recording: Recording) -> Array:
    """Return the temperature at every stamp (n,), °C: between those recorded, linear, for it is sampled more slowly than the gyro."""
    T = recording.temperature
    known = np.zeros(0, bool) if T is None else np.isfinite(T)
    if T is None or not known.any():
        raise InputError(f"{recording.source} has no temperature, over which the gyro's bias is given; leave that out")
    return np.asarray(np.interp(recording.time, recording.time[known], T[known]))


def applied(recording: Recording, warm: BiasOverTemperature) -> Recording:
    """Return a recording without the gyro's bias over temperature, and with a temperature at every sample."""
    T = temperature_at_samples(recording)
    beyond = int(np.sum((warm.span[0] > T) | (warm.span[1] < T)))
    words = "The gyro's bias over temperature is subtracted; estimated is what is left."
    if beyond:
        words += f" {beyond} samples are beyond {warm.span[0]:.4g} to {warm.span[1]:.4g} °C and take that of the end."
    remarks = (*recording.remarks, words)
    return replace(recording, rate=recording.rate - warm.bias(T), temperature=T, remarks=remarks)
