"""Is the filter's own covariance to be believed? Statistics that say so with known error rates, and a verdict.

``manifold``
    The error of an estimate, in the body or the fixed frame, and its normalised square (NEES), for any subset of the states.
``bounds``
    Exact two-sided bounds of averages over independent runs: ANEES and NIS, log-NEES, coverage.
``ensemble``
    All statistics of independent errors at one epoch: ANEES, log-NEES, non-credibility index, inclination, σ-coverage.
``whiteness``
    What innovations should be: white, normal, of mean zero, independent of other sensors'.
``timeaverage``
    Averages over the time of one run, whose errors are correlated: the effective sample size.
``accuracy``
    How large errors are: against a reference, against the Cramér–Rao bound, when they have settled, how they are distributed.
``foreign``
    The verdict on an estimate from elsewhere: clocks, frames and the reading of its covariance.
``judgement``, ``runs``
    The verdict in words, with its evidence, at one stated probability of a false alarm: on one run, and on independent ones.
"""

from strapdown.consistency.accuracy import (
    Distribution,
    Efficiency,
    ReferenceErrors,
    convergence_time,
    distribution,
    efficiency,
    reference_errors,
)
from strapdown.consistency.bounds import (
    Coverage,
    Verdict,
    coverage,
    log_mean_bounds,
    log_mean_p_value,
    log_moments,
    mean_bounds,
    mean_p_value,
)
from strapdown.consistency.ensemble import Credibility, credibility
from strapdown.consistency.foreign import Checked, check_arrays
from strapdown.consistency.judgement import Finding, Judgement, concluded, judge
from strapdown.consistency.manifold import SUBSETS, errors, fixed_frame, nees, whitened
from strapdown.consistency.runs import judge_runs
from strapdown.consistency.timeaverage import TimeAverage, time_average
from strapdown.consistency.whiteness import (
    Autocorrelation,
    QuantilePairs,
    anderson_darling,
    autocorrelation,
    cross_correlation_p_value,
    ljung_box,
    mean_innovation_p_value,
    quantile_pairs,
)

__all__ = [
    "SUBSETS",
    "Autocorrelation",
    "Checked",
    "Coverage",
    "Credibility",
    "Distribution",
    "Efficiency",
    "Finding",
    "Judgement",
    "QuantilePairs",
    "ReferenceErrors",
    "TimeAverage",
    "Verdict",
    "anderson_darling",
    "autocorrelation",
    "check_arrays",
    "concluded",
    "convergence_time",
    "coverage",
    "credibility",
    "cross_correlation_p_value",
    "distribution",
    "efficiency",
    "errors",
    "fixed_frame",
    "judge",
    "judge_runs",
    "ljung_box",
    "log_mean_bounds",
    "log_mean_p_value",
    "log_moments",
    "mean_bounds",
    "mean_innovation_p_value",
    "mean_p_value",
    "nees",
    "quantile_pairs",
    "reference_errors",
    "time_average",
    "whitened",
]
