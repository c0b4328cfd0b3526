"""Rotations of the body, on which a gyro's scale factor, misalignment and mounting act, with its bias and noise removed."""

from __future__ import annotations

import numpy as np

from strapdown import estimation
from strapdown.checks import Array
from strapdown.estimation.states import ProcessNoise
from strapdown.records import ImuRecord

PLAUSIBLE = 0.01
"""Prior standard deviation of a scale factor, or of a misalignment, rad."""
UNLIKELY = 0.01
"""Probability that noise is detected as motion for a body at rest."""


def turns(record: ImuRecord, noise: ProcessNoise, initial: estimation.State) -> Array:
    """Return the rotation of the body in each gyro interval (n, 3), rad, as far as it exceeds the gyro's noise.

    The increments themselves are unsuitable: subtracting a fraction of them reduces the gyro's noise too, so the noise would explain
    itself, more so the longer the record. So the rate, with the filter's bias subtracted, keeps only the components of its cosine transform
    above the filter's angle random walk: of m values with standard deviation s the largest is below ``s √(2 ln(m/p))`` except with
    probability p (the universal threshold of Donoho & Johnstone 1994, Biometrika 81).
    """
    from scipy.fft import dct, idct

    estimate = estimation.run(record, noise, initial)
    dt = record.intervals[:, None]
    free = record.increments / dt - 0.5 * (estimate.bias[1:] + estimate.bias[:-1])
    # Unlike Fourier's, it does not require equal ends of the record; being orthonormal, it keeps noise white.
    parts = dct(free, axis=0, norm="ortho")
    variance = noise.angle_random_walk**2 / float(np.mean(dt))
    parts[parts**2 < 2.0 * variance * np.log(parts.size / UNLIKELY)] = 0.0
    return np.asarray(idct(parts, axis=0, norm="ortho") * dt)
