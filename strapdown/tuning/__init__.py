"""Tuning a filter from data: maximum likelihood, how sure one may be of each parameter, and proof on data held out.

``innovations``
    Of the filter's innovations, with score and information, eight sets of parameters a pass.
``errors``
    Of the errors against a truth.
``credibility``
    Of whether the filter may be believed: the whole distribution of NIS, or NEES, and whiteness.
``outliers``
    Of innovations some of which are outliers, and the gate that suits them.
``fitting``
    The search from several starts, intervals, what is identified and what is not.
``parameters``
    Names, values in a filter setup, priors.
``starting``
    Where the filter starts on a record.
``planning``
    The Cramér–Rao bound before there is a record.
``suspicion``
    What the tuned filter leaves unexplained, such as a scale factor that the gyro's noise stands for.
``own``
    Parameters of a filter of one's own, by the same objectives.
``holding``
    What is held out, and the filter before and after on it.

>>> objective = tuning.likelihood([tuning.record_case(record, chosen)], chosen, ["gyro.arw", "star.sigma"])  # doctest: +SKIP
>>> result = tuning.fit(objective)  # doctest: +SKIP
>>> result["gyro.arw"].value, result.setup  # doctest: +SKIP

The likelihood is right for a filter that is right but for its parameters: it gives white innovations. Disturbances that last over many
samples break it, and the most likely filter may then follow them (:attr:`strapdown.tuning.Tuning.misfit` says so). On such records tune
``filter.scale`` alone, which leaves the estimates as they are and sets their σ, or against a truth. Outliers want a model of their own
(:func:`contaminated_likelihood`), and an error without a state looks like noise of the gyro (:func:`unmodelled` tells).
"""

from strapdown.tuning.credibility import CredibilityObjective, credibility_objective
from strapdown.tuning.errors import ErrorObjective, error_objective
from strapdown.tuning.fitting import Estimated, Slices, Tuning, fit, rescaled, search, slices
from strapdown.tuning.holding import Comparison, NeesCourse, Performance, compare, performance, split
from strapdown.tuning.innovations import Case, Derivatives, Likelihood, likelihood, thinned
from strapdown.tuning.outliers import (
    ContaminatedLikelihood,
    TunedGate,
    contaminated_likelihood,
    log_likelihood,
    tuned_gate,
)
from strapdown.tuning.own import OwnTuning, fit_own
from strapdown.tuning.parameters import (
    Prior,
    axis_names,
    axis_of,
    default_names,
    known_names,
    priors_from_gyro,
    unit_of,
    values_of,
    with_values,
)
from strapdown.tuning.planning import Plan, plan, simulated_again
from strapdown.tuning.starting import one_gyro, record_case, recording_case, recording_setup
from strapdown.tuning.suspicion import ScaleFactor, Unmodelled, doubted, unmodelled

__all__ = [
    "Case",
    "Comparison",
    "ContaminatedLikelihood",
    "CredibilityObjective",
    "Derivatives",
    "ErrorObjective",
    "Estimated",
    "Likelihood",
    "NeesCourse",
    "OwnTuning",
    "Performance",
    "Plan",
    "Prior",
    "ScaleFactor",
    "Slices",
    "TunedGate",
    "Tuning",
    "Unmodelled",
    "axis_names",
    "axis_of",
    "compare",
    "contaminated_likelihood",
    "credibility_objective",
    "default_names",
    "doubted",
    "error_objective",
    "fit",
    "fit_own",
    "known_names",
    "likelihood",
    "log_likelihood",
    "one_gyro",
    "performance",
    "plan",
    "priors_from_gyro",
    "record_case",
    "recording_case",
    "recording_setup",
    "rescaled",
    "search",
    "simulated_again",
    "slices",
    "split",
    "thinned",
    "tuned_gate",
    "unit_of",
    "unmodelled",
    "values_of",
    "with_values",
]
