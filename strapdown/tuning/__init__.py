"""Tuning a filter from data: maximum likelihood, an interval for each parameter, and validation on held-out data.

- ``procedure``: :func:`tune`: objective, search and what follows it in one call.
- ``objective``: What every objective is: a problem checked, setups of points, sums over records and threads.
- ``innovations``: Of the filter's innovations, with score and information, eight sets of parameters a pass where the filter allows it.
- ``errors``: Of the errors against a truth.
- ``outliers``: Of innovations some of which are outliers, and the gate that suits them.
- ``fitting``: The search from several starts, intervals, what is identified and what is not.
- ``parameters``: One table of names, places in a filter setup and units; priors.
- ``initialization``: Where the filter starts on a record.
- ``planning``: The Cramér–Rao bound before there is a record.
- ``residual_checks``: What the tuned filter leaves unexplained, such as a scale factor that the gyro's noise stands for.
- ``diagnosis``: Why a filter is inconsistent: the hypothesis under which the record is the likeliest.
- ``own``: Parameters of a filter of one's own, by the same objectives.
- ``validation``: What is held out, and the filter before and after on it.

>>> objective = tuning.likelihood([tuning.record_case(record, chosen)], chosen, ["gyro.arw", "star.sigma"])  # doctest: +SKIP
>>> result = tuning.fit(objective)  # doctest: +SKIP
>>> result["gyro.arw"].value, result.setup  # doctest: +SKIP

The likelihood is right for a filter that is right but for its parameters: it gives white innovations. Disturbances that last over many
samples break it, and the most likely filter may then follow them (:attr:`strapdown.tuning.Tuning.misfit` says so). On such records tune
``filter.scale`` alone, which leaves the estimates as they are and sets their σ, or against a truth. Outliers need a model of their own
(:func:`contaminated_likelihood`), and an error without a state looks like noise of the gyro (:func:`unmodelled` looks for it).
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
from strapdown.tuning.objective import thinned as thinned
from strapdown.tuning.outliers import TunedGate as TunedGate
from strapdown.tuning.outliers import contaminated_likelihood as contaminated_likelihood
from strapdown.tuning.outliers import log_likelihood as log_likelihood
from strapdown.tuning.outliers import tuned_gate as tuned_gate
from strapdown.tuning.own import OwnTuning, fit_own
from strapdown.tuning.parameters import Prior, priors_from_gyro
from strapdown.tuning.parameters import axis_names as axis_names
from strapdown.tuning.parameters import axis_of as axis_of
from strapdown.tuning.parameters import default_names as default_names
from strapdown.tuning.parameters import known_names as known_names
from strapdown.tuning.parameters import unit_of as unit_of
from strapdown.tuning.parameters import values_of as values_of
from strapdown.tuning.parameters import with_values as with_values
from strapdown.tuning.planning import Plan as Plan
from strapdown.tuning.planning import plan
from strapdown.tuning.procedure import GATED as GATED
from strapdown.tuning.procedure import tune
from strapdown.tuning.residual_checks import Unmodelled as Unmodelled
from strapdown.tuning.residual_checks import doubted as doubted
from strapdown.tuning.residual_checks import unmodelled as unmodelled
from strapdown.tuning.validation import Comparison as Comparison
from strapdown.tuning.validation import Performance as Performance
from strapdown.tuning.validation import compare, split

__all__ = [
    "Case",
    "OwnTuning",
    "Prior",
    "Tuning",
    "compare",
    "fit",
    "fit_own",
    "likelihood",
    "plan",
    "priors_from_gyro",
    "record_case",
    "recording_case",
    "split",
    "tune",
]
