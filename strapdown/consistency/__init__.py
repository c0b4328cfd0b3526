"""Consistency: does a filter's covariance agree with its errors? Statistics with known error rates, and a verdict.

- ``manifold``: The error of an estimate and its normalised square (NEES), for any subset of the states.
- ``bounds``: Exact two-sided bounds of averages over independent runs: ANEES and NIS, log-NEES, coverage.
- ``whiteness``: Tests of the innovations: white, normal, of mean zero, independent of those of other sensors.
- ``timeaverage``: Averages over the time of one run, whose errors are correlated, and their effective sample size.
- ``accuracy``: Errors against a truth or a reference, in one table; their convergence time.
- ``alignment``: Clocks and frames of an estimate and a truth.
- ``foreign``: The verdict on the estimate of another program: alignment of clocks and frames, definition of its covariance.
- ``judgement``: The verdict in words, with its evidence, at a stated probability of a false alarm. For independent runs see
  :meth:`strapdown.montecarlo.Statistics.judge`.
"""

from strapdown.consistency.accuracy import Accuracy, reference_errors
from strapdown.consistency.accuracy import ReferenceErrors as ReferenceErrors
from strapdown.consistency.accuracy import convergence_time as convergence_time
from strapdown.consistency.bounds import Verdict as Verdict
from strapdown.consistency.bounds import log_mean_bounds as log_mean_bounds
from strapdown.consistency.bounds import log_mean_p_value as log_mean_p_value
from strapdown.consistency.bounds import log_moments as log_moments
from strapdown.consistency.bounds import mean_bounds
from strapdown.consistency.bounds import mean_p_value as mean_p_value
from strapdown.consistency.foreign import Checked, check_attitudes
from strapdown.consistency.judgement import DETECTABLE as DETECTABLE
from strapdown.consistency.judgement import Finding, Judgement, judge
from strapdown.consistency.judgement import concluded as concluded
from strapdown.consistency.manifold import SUBSETS as SUBSETS
from strapdown.consistency.manifold import errors, nees
from strapdown.consistency.manifold import whitened as whitened
from strapdown.consistency.timeaverage import time_average as time_average
from strapdown.consistency.whiteness import Autocorrelation as Autocorrelation
from strapdown.consistency.whiteness import QuantilePairs as QuantilePairs
from strapdown.consistency.whiteness import anderson_darling as anderson_darling
from strapdown.consistency.whiteness import autocorrelation as autocorrelation
from strapdown.consistency.whiteness import cross_correlation_p_value as cross_correlation_p_value
from strapdown.consistency.whiteness import ljung_box as ljung_box
from strapdown.consistency.whiteness import mean_innovation_p_value as mean_innovation_p_value
from strapdown.consistency.whiteness import quantile_pairs as quantile_pairs

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
