"""Covariance analysis: predicted errors of a filter on a scenario, with the contribution of each source, without a Monte Carlo.

One pass along the true trajectory. The filter's covariance defines its gains; the actual error, linearised about the truth, is propagated
through the same gains source by source (Maybeck 1979, section 6.8; Gelb 1974, section 7.2):

- white and coloured noise, and the initial error, each contribute a covariance. These add up. For a matched filter the sum is its own P,
  which linearised at the truth is also the posterior Cramér–Rao bound; for a mismatched one they differ, and the expected NEES shows it;
- errors that are the same in every run of the scenario (scale factor, hard iron, residual error of the gyro's integration) each contribute
  a mean error;
- errors outside the scenario may be *considered*: each with a standard deviation and a contribution (:class:`Consider`).

The filter is the one that runs over records (:mod:`strapdown.kernels.filter`), with any error states; reported are attitude and whole bias.
Gates, robust updates and other operations that depend on the data are not included, nor are states for a bias over temperature.

- ``consider``: :class:`Consider`.
- ``trajectory``: The true trajectory, with the filter and the measurements along it.
- ``random_errors``, ``deterministic_errors``: Sources of error.
- ``analysing``: :func:`analyse`.
- ``result``: :class:`Analysis`.
"""

from strapdown.covariance.analysing import analyse
from strapdown.covariance.consider import Consider
from strapdown.covariance.result import Analysis

__all__ = ["Analysis", "Consider", "analyse"]
