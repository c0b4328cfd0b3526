"""Consistency: does a filter's covariance agree with its errors? Statistics with known error rates, and a verdict.

- ``manifold``: The error of an estimate and its normalised square (NEES), for any subset of the states.
- ``bounds``: Exact two-sided bounds of averages over independent runs: ANEES and NIS, log-NEES, coverage.
- ``whiteness``: Tests of the innovations: white, normal, of mean zero, independent of those of other sensors.
- ``timeaverage``: Averages over the time of one run, whose errors are correlated, and their effective sample size.
- ``accuracy``: Errors against a truth or a reference, in one table.
- ``alignment``: Clocks and frames of an estimate and a truth.
- ``foreign``: The verdict on the estimate of another program: alignment of clocks and frames, definition of its covariance.
- ``judgement``: The verdict in words, with its evidence, at a stated probability of a false alarm. For independent runs see
  :meth:`strapdown.montecarlo.Statistics.judge`.
"""

from strapdown.consistency.accuracy import Accuracy, ReferenceErrors, reference_errors
from strapdown.consistency.bounds import (
    Verdict,
    log_mean_bounds,
    log_mean_p_value,
    log_moments,
    mean_bounds,
    mean_p_value,
)
from strapdown.consistency.foreign import Checked, check_attitudes
from strapdown.consistency.judgement import DETECTABLE, Finding, Judgement, concluded, judge
from strapdown.consistency.manifold import SUBSETS, errors, nees, whitened
from strapdown.consistency.timeaverage import time_average
from strapdown.consistency.whiteness import (
    Autocorrelation,
    anderson_darling,
    autocorrelation,
    cross_correlation_p_value,
    ljung_box,
    mean_innovation_p_value,
)

__all__ = [
    "Accuracy",
    "Checked",
    "Finding",
    "Judgement",
    "check_attitudes",
    "errors",
    "judge",
    "mean_bounds",
    "nees",
    "reference_errors",
]
