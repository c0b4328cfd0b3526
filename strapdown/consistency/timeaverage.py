"""Averages over the time of one run. Errors at different epochs are correlated, so the effective number of samples is smaller.

The error of a consistent filter is a Gauss–Markov process: ``e_{k+1} = (I − K H) Φ e_k + noise``. Whitened by the filter's own covariance
it is a vector autoregression of first order, z_{k+1} = A z_k + …, of covariance I, and the correlation of |z_k|² with |z_{k+τ}|² is
‖A^τ‖²/n. This gives the variance of the average, and the number of independent samples with the same variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import InputError, array
from strapdown.consistency.manifold import whitened

MIN_EFFECTIVE = 5.0
"""Minimum effective samples: with fewer, the correlation time cannot be estimated from the run."""
MIN_ROWS = 40
"""Minimum number of rows of a thinned series."""

POWERS = 256
"""Number of powers of the matrix computed at once."""
MAX_EPOCHS = 4000


@dataclass(frozen=True, kw_only=True)
class TimeAverage:
    """NEES averaged over the epochs of one run, per degree of freedom."""

    mean: float
    """1 for a consistent filter."""
    effective: float
    """Number of independent epochs with the same information."""

    @property
    def reliable(self) -> bool:
        """Whether the run is long compared with the correlation time of its errors; if not, the p-value is not valid."""
        return self.effective >= MIN_EFFECTIVE

    @property
    def certainty(self) -> float:
        """Degrees of freedom with which the number of effective samples is known from the run itself.

        Half of them: on series of known correlation, false alarms are then at the nominal rate or below.
        """
        return 0.5 * self.effective


def time_average(error: ArrayLike, covariance: ArrayLike, states: tuple[int, ...] | None = None) -> TimeAverage:
    """Return the NEES averaged over the evenly spaced epochs of one run, with its number of effective samples.

    Error (epochs, n) and covariance (epochs, n, n); ``states`` is the subset judged. The correlation is estimated from all states, because
    a subset is no Markov process.
    """
    e = array("error", error, ("epochs", "n"))
    P = array("covariance", covariance, (len(e), e.shape[1], e.shape[1]))
    n = e.shape[1]
    subset = list(range(n)) if states is None else list(states)
    if len(e) < 2 * n + 2:
        raise InputError(f"{len(e)} epochs are too few for a time average of {n} states; keep more of the run")
    stride = -(-len(e) // MAX_EPOCHS)
    order = [*subset, *(k for k in range(n) if k not in subset)]
    white = whitened(e[::stride][:, order], P[::stride][:, order][:, :, order])
    mine = white[:, : len(subset)]
    return TimeAverage(
        mean=float(np.mean(np.sum(mine * mine, axis=1)) / len(subset)),
        effective=_effective(white, len(subset)),
    )


def _effective(white: np.ndarray, first: int) -> float:
    """Return the effective samples: the fewest by the autoregression over several intervals and by the autocorrelation of the squares.

    A sum of a fast and a slow error is no Markov process, as the six states of a filter with further error states are not: from one epoch
    to the next the fast part hides the correlation of the slow. A thinned series of white appearance says nothing.
    """
    sizes = [effective_samples(white, first), squares_effective(white[:, :first])]
    stride, rows = 2, max(MIN_ROWS, 8 * (white.shape[1] + 1))
    while len(white) // stride >= rows:
        part = white[::stride]
        slow = effective_samples(part, first)
        if slow < 0.5 * len(part):
            sizes.append(slow)
        stride *= 2
    return min(sizes)


def squares_effective(white: ArrayLike) -> float:
    """Return the number of independent samples with the same variance of the mean of |z|², by the autocorrelation of |z|² (m, n).

    The sum over the lags ends where that of two neighbours is negative, and its terms do not increase (Geyer 1992, initial monotone
    sequence). The mean of the series is subtracted, because a wrong σ would count as correlation if the nominal one, n, were; that
    reduces each autocovariance by the variance of the mean, which is added again.
    """
    z = array("white", white, ("m", "n"))
    m = len(z)
    x = np.sum(z * z, axis=1)
    x = x - x.mean()
    length = 2 ** int(np.ceil(np.log2(2 * m)))
    power = np.abs(np.fft.rfft(x, length)) ** 2
    correlation = np.fft.irfft(power, length)[:m]
    correlation = correlation / max(correlation[0], 1e-300)
    pairs = correlation[0 : m - 1 : 2] + correlation[1:m:2]
    ends = np.flatnonzero(pairs <= 0.0)
    number = int(ends[0]) if len(ends) else len(pairs)
    total = 2.0 * float(np.sum(np.minimum.accumulate(pairs[:number]))) - 1.0
    return float(max(1.0, m / max(total, 1.0) * max(1.0 - 4.0 * number / m, 0.05)))


def effective_samples(white: ArrayLike, first: int | None = None, *, of_mean: bool = False) -> float:
    """Return the number of independent samples with the same variance of the mean of |z|² of the first components of the series (m, n).

    ``m/(1 + 2 Σ_τ (1 − τ/m) ‖(A^τ)_first‖²/first)``, A by least squares; ``of_mean``: of the mean of z, with the trace of A^τ in place of
    the squared norm. It is at most m: a negative sum, of errors that alternate, is not counted, which leaves σ too large.
    """
    z = array("white", white, ("m", "n"))
    m, n = z.shape
    k = n if first is None else first
    # The normal equations by einsum: BLAS and LAPACK would wake threads for the long sums, at many times the cost of the sums.
    gram, lagged = np.einsum("ki,kj->ij", z[:-1], z[:-1]), np.einsum("ki,kj->ij", z[:-1], z[1:])
    A = np.linalg.lstsq(gram, lagged, rcond=None)[0].T
    # Least squares underestimates the autoregression of a series of known mean by a fraction 2/m (Kendall 1954).
    A = A * (1.0 + 2.0 / m)
    powers, lags = A[None], np.arange(1, POWERS + 1)
    while len(powers) < POWERS:
        powers = np.concatenate([powers, powers @ powers[-1]])
    last, total = powers[-1], 0.0
    while lags[0] < m:
        share = np.minimum(np.sum(powers[:, :k, :k] ** 2, axis=(1, 2)) / k, 1.0)
        small = np.flatnonzero(share < 1e-6)
        if of_mean:
            share = np.minimum(np.trace(powers[:, :k, :k], axis1=1, axis2=2) / k, 1.0)
        end = small[0] + 1 if len(small) else POWERS
        total += float(np.sum((1.0 - lags / m).clip(0.0)[:end] * share[:end]))
        if len(small):
            break
        powers, lags = powers @ last, lags + POWERS
    return float(max(1.0, m / (1.0 + 2.0 * max(total, 0.0))))
