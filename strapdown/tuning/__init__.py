"""Tuning a filter from data: maximum likelihood, an interval for each parameter, and validation on held-out data.

:func:`strapdown.tune` does all steps in one call.

- ``objective``: Base of the objectives: checks of the problem, setups at a point, sums over records and threads.
- ``innovations``: Likelihood of the innovations, with score and information; eight parameter sets per pass if the filter allows.
- ``errors``: Likelihood of the errors against a truth.
- ``outliers``: Likelihood of innovations with outliers, and the matching gate.
- ``fitting``: The search from several starts, intervals, identifiability.
- ``result``: The result of a tuning, with its verdict.
- ``parameters``: Names, fields in a filter setup and units of the parameters; priors.
- ``initialization``: Initial state of the filter on a record.
- ``residual_checks``: Errors that the tuned filter does not model, such as a scale factor absorbed by the gyro's noise.
- ``diagnosis``: Causes of an inconsistent filter: hypotheses ranked by likelihood.
- ``validation``: Held-out data, and the filter before and after tuning on them.

>>> objective = tuning.likelihood([tuning.record_case(record, chosen)], chosen, ["gyro.arw", "star.sigma"])  # doctest: +SKIP
>>> result = tuning.fit(objective)  # doctest: +SKIP
>>> result["gyro.arw"].value, result.setup  # doctest: +SKIP

The likelihood is valid for a filter that is correct except for its parameters, so that its innovations are white. Disturbances that last
over many samples violate this, and the maximum-likelihood filter may then follow them (:attr:`strapdown.tuning.Tuning.misfit`). For these
tune only ``filter.scale``, which scales the σ and leaves the estimates unchanged, or tune against a truth. Outliers need a model
(:func:`contaminated_likelihood`), and an error without a state appears as noise of the gyro (:func:`unmodelled` tests for it).
"""

from strapdown.tuning.errors import error_objective
from strapdown.tuning.fitting import fit, search
from strapdown.tuning.initialization import by_innovations, one_gyro, record_case, recording_case
from strapdown.tuning.innovations import Likelihood, likelihood
from strapdown.tuning.objective import Case
from strapdown.tuning.outliers import GATED, TunedGate, contaminated_likelihood, log_likelihood, tuned_gate
from strapdown.tuning.parameters import Prior, default_names, priors_from_gyro, unit_of, values_of, with_values
from strapdown.tuning.residual_checks import Unmodelled, examined, unmodelled
from strapdown.tuning.result import Slices, Tuning, slices
from strapdown.tuning.validation import Comparison, compare, split

__all__ = [
    "Case",
    "Prior",
    "Tuning",
    "compare",
    "fit",
    "likelihood",
    "priors_from_gyro",
    "record_case",
    "recording_case",
    "split",
]
