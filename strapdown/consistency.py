"""Is the filter's own covariance to be believed? NEES, NIS and their two-sided χ² bounds, from independent runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, count


def errors(attitude: ArrayLike, bias: ArrayLike, true_attitude: ArrayLike, true_bias: ArrayLike) -> Array:
    """Return the error state e = (Log(q_est⁻¹ ⊗ q_true), b_true − b_est) (..., 6): rad in the body frame, rad/s."""
    estimate = quaternion.multiply(quaternion.conjugate(attitude), true_attitude)
    return np.concatenate([quaternion.log(estimate), np.asarray(true_bias) - np.asarray(bias)], axis=-1)


def nees(error: ArrayLike, covariance: ArrayLike) -> Array:
    """Return the normalised estimation error squared eᵀ P⁻¹ e (...,), χ² with as many degrees of freedom as states.

    ``error`` (..., n), ``covariance`` (..., n, n); slice both for a subset of the states (the marginal covariance is the slice).
    """
    e = array("error", error, (..., "n"))
    P = array("covariance", covariance, (..., e.shape[-1], e.shape[-1]))
    try:
        factor = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        least = np.linalg.eigvalsh(P)[..., 0]
        place = [int(i) for i in np.unravel_index(np.argmin(least), least.shape)]
        raise InputError(
            f"covariance{place or ''} is not positive definite (least eigenvalue {least.min():.3g})"
        ) from None
    white = np.linalg.solve(factor, e[..., None])[..., 0]
    return np.asarray(np.sum(white * white, axis=-1))


def mean_bounds(degrees: int, samples: int, probability: float = 0.99) -> tuple[float, float]:
    """Return two-sided bounds of the mean of ``samples`` independent χ² values of ``degrees`` degrees of freedom, *per degree*.

    ``samples · degrees · mean`` is χ² with ``samples · degrees`` degrees of freedom (Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2);
    a right filter's mean is 1.
    """
    from scipy.stats import chi2

    count("degrees", degrees)
    count("samples", samples)
    if not 0.0 < probability < 1.0:
        raise InputError(f"probability is {probability}; it must lie between 0 and 1")
    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], degrees * samples) / (samples * degrees)
    return float(low), float(high)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The mean over independent runs of a χ² statistic, per degree of freedom, at several epochs, against its two-sided bounds."""

    mean: Array
    """Mean over the runs at each epoch, per degree of freedom (epochs,); 1 for a right filter."""
    degrees: int
    runs: int
    probability: float
    """Probability that one epoch of a right filter lies inside the bounds."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Two-sided bounds of the mean at one epoch."""
        return mean_bounds(self.degrees, self.runs, self.probability)

    @property
    def simultaneous_bounds(self) -> tuple[float, float]:
        """Two-sided bounds that all epochs of a right filter keep together with at least ``probability`` (Bonferroni).

        Errors at different epochs of one run are correlated, a bias error above all, so the number of epochs outside :attr:`bounds` is
        not binomial; this holds however they depend on each other.
        """
        return mean_bounds(self.degrees, self.runs, 1.0 - (1.0 - self.probability) / len(self.mean))

    @property
    def outside(self) -> int:
        """Number of epochs outside the simultaneous bounds."""
        low, high = self.simultaneous_bounds
        return int(np.sum(~((self.mean >= low) & (self.mean <= high))))  # NaN is outside

    @property
    def consistent(self) -> bool:
        """Whether every epoch lies inside the simultaneous bounds."""
        return self.outside == 0


@dataclass(frozen=True, kw_only=True)
class ReferenceErrors:
    """Errors of an estimated attitude against a reference, as the BROAD benchmark tells them, rad; NaN where there is no reference."""

    total: Array
    """Angle of the whole rotation between both (n,)."""
    heading: Array
    """Its part about the vertical (n,)."""
    inclination: Array
    """What is left: the angle between the vertical of both (n,)."""

    def rms(self, movement: np.ndarray | None = None) -> dict[str, float]:
        """Return the RMS of each error, rad, over the samples with a reference, and only those of the ``movement`` mask if given."""
        judged = np.isfinite(self.total) if movement is None else np.isfinite(self.total) & movement
        if not judged.any():
            raise InputError(
                "no sample to judge has a valid reference attitude; check the movement mask and the reference"
            )
        return {
            name: float(np.sqrt(np.mean(getattr(self, name)[judged] ** 2)))
            for name in ("total", "heading", "inclination")
        }


def reference_errors(attitude: ArrayLike, reference: ArrayLike) -> ReferenceErrors:
    """Return the errors of q_fb (n, 4) against a reference (n, 4) whose fixed frame has its z axis vertical.

    With ``d = q_est ⊗ q_ref⁻¹`` in the fixed frame: total 2 acos |d_w|, heading 2 atan |d_z / d_w|, inclination
    2 acos √(d_w² + d_z²) (Laidig, Caruso, Cereatti & Seel 2021, section 4.1), in forms that keep digits when errors are small. Rows of
    NaN in the reference give NaN.
    """
    q = array("attitude", attitude, ("n", 4))
    r = array("reference", reference, (len(q), 4), allow_nan=True)
    known = np.isfinite(r).all(axis=1)
    zero = known & (np.linalg.norm(r, axis=1) == 0.0)
    if zero.any():
        raise InputError(f"reference[{int(np.argmax(zero))}] is the zero quaternion; mark missing rows as NaN")
    d = quaternion.multiply(q[known], quaternion.conjugate(quaternion.normalize(r[known])))
    w, x, y, z = np.moveaxis(d, -1, 0)
    results = np.full((3, len(q)), np.nan)
    results[0, known] = 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))
    results[1, known] = 2.0 * np.arctan2(np.abs(z), np.abs(w))
    results[2, known] = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
    return ReferenceErrors(total=results[0], heading=results[1], inclination=results[2])
