"""The body's turns, on which a gyro's scale factor, misalignment and mounting act, without the gyro's bias and hardly with its noise."""

from __future__ import annotations

import numpy as np

from strapdown import estimation
from strapdown.checks import Array
from strapdown.estimation.states import ProcessNoise
from strapdown.records import ImuRecord

PLAUSIBLE = 0.01
"""Standard deviation of a scale factor, or a misalignment in rad, before the data are seen."""
UNLIKELY = 0.01
"""Probability that anything is taken for motion where the body rests."""


def turns(record: ImuRecord, noise: ProcessNoise, initial: estimation.State) -> Array:
    """Return by how much the body turned in each gyro interval (n, 3), rad, as far as that stands out of the gyro's noise.

    The increments themselves would not do. A filter that is given back a share of the gyro's noise has less of it, so the noise would
    explain itself, the better the longer the record. So the rate, freed of the filter's bias, keeps those parts of its cosine transform
    that the filter's angle random walk does not reach: of m numbers of standard deviation s the largest is below ``s √(2 ln(m/p))`` but
    for a probability of p (the universal threshold of Donoho & Johnstone 1994, Biometrika 81).
    """
    from scipy.fft import dct, idct

    estimate = estimation.run(record, noise, initial)
    dt = np.diff(record.time)[:, None]
    free = record.increments / dt - 0.5 * (estimate.bias[1:] + estimate.bias[:-1])
    # Unlike Fourier's, the ends of the record need not meet; orthonormal, it leaves white noise as it is.
    parts = dct(free, axis=0, norm="ortho")
    variance = noise.angle_random_walk**2 / float(np.mean(dt))
    parts[parts**2 < 2.0 * variance * np.log(parts.size / UNLIKELY)] = 0.0
    return np.asarray(idct(parts, axis=0, norm="ortho") * dt)
