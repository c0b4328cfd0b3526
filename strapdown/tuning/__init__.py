"""Tuning a filter from data: maximum likelihood, an interval for each parameter, and validation on held-out data.

- ``procedure``: :func:`tune`: objective, search, residual checks and validation in one call.
- ``objective``: Base of the objectives: checks of the problem, setups at a point, sums over records and threads.
- ``innovations``: Likelihood of the innovations, with score and information; eight parameter sets per pass if the filter allows.
- ``errors``: Likelihood of the errors against a truth.
- ``outliers``: Likelihood of innovations with outliers, and the matching gate.
- ``fitting``: The search from several starts, intervals, identifiability.
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

from strapdown.tuning.errors import error_objective as error_objective
from strapdown.tuning.fitting import Slices as Slices
from strapdown.tuning.fitting import Tuning, fit
from strapdown.tuning.fitting import rescaled as rescaled
from strapdown.tuning.fitting import search as search
from strapdown.tuning.fitting import slices as slices
from strapdown.tuning.initialization import by_innovations as by_innovations
from strapdown.tuning.initialization import one_gyro as one_gyro
from strapdown.tuning.initialization import record_case, recording_case
from strapdown.tuning.initialization import recording_setup as recording_setup
from strapdown.tuning.innovations import likelihood
from strapdown.tuning.objective import Case
from strapdown.tuning.outliers import TunedGate as TunedGate
from strapdown.tuning.outliers import contaminated_likelihood as contaminated_likelihood
from strapdown.tuning.outliers import log_likelihood as log_likelihood
from strapdown.tuning.outliers import tuned_gate as tuned_gate
from strapdown.tuning.parameters import Prior, priors_from_gyro
from strapdown.tuning.parameters import default_names as default_names
from strapdown.tuning.parameters import unit_of as unit_of
from strapdown.tuning.parameters import values_of as values_of
from strapdown.tuning.parameters import with_values as with_values
from strapdown.tuning.procedure import GATED as GATED
from strapdown.tuning.procedure import tune
from strapdown.tuning.residual_checks import Unmodelled as Unmodelled
from strapdown.tuning.residual_checks import unmodelled as unmodelled
from strapdown.tuning.residual_checks import with_misfit_flag as with_misfit_flag
from strapdown.tuning.validation import Comparison as Comparison
from strapdown.tuning.validation import compare, split

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
    "tune",
]
