"""Figures. Each function has results and an optional ``ax`` as arguments, and returns the axes; statistics are computed elsewhere.

Colours are those of Okabe and Ito, distinguishable with colour vision deficiency. :func:`new_figure` needs no display.

- ``style``: Colours, themes (light, dark), sizes, saving.
- ``decimation``: Reduction of long series to the extremes of each pixel column.
- ``estimates``: One estimate over time: attitude, bias, σ, errors.
- ``innovations``: Innovations of one record: NIS, distribution, autocorrelation.
- ``statistics``: Error statistics over many runs.
- ``coning``: The coning study.
- ``allan``: Allan deviations with fits.
- ``budget``: Predicted errors by source.
- ``tuning``: Likelihood slices, and statistics before and after tuning.
"""

from strapdown.checks import InputError

try:
    import matplotlib as _matplotlib  # noqa: F401
except ValueError as error:
    raise InputError(
        f"matplotlib cannot be loaded ({error}); correct the environment variable MPLBACKEND, or its configuration file"
    ) from error

from strapdown.plots.allan import allan_overview
from strapdown.plots.budget import error_budget
from strapdown.plots.coning import coning_consistency as coning_consistency
from strapdown.plots.coning import coning_errors as coning_errors
from strapdown.plots.coning import draw_coning_study as draw_coning_study
from strapdown.plots.coning import drift_by_algorithm as drift_by_algorithm
from strapdown.plots.decimation import decimated as decimated
from strapdown.plots.estimates import error_overview
from strapdown.plots.estimates import errors_in_envelope as errors_in_envelope
from strapdown.plots.estimates import estimate_overview as estimate_overview
from strapdown.plots.estimates import recording_errors as recording_errors
from strapdown.plots.estimates import states_over_time as states_over_time
from strapdown.plots.innovations import error_distribution as error_distribution
from strapdown.plots.innovations import innovation_autocorrelation as innovation_autocorrelation
from strapdown.plots.innovations import innovation_histogram as innovation_histogram
from strapdown.plots.innovations import innovation_quantiles as innovation_quantiles
from strapdown.plots.innovations import nis_over_record as nis_over_record
from strapdown.plots.statistics import covariance_ellipses as covariance_ellipses
from strapdown.plots.statistics import coverage_by_state as coverage_by_state
from strapdown.plots.statistics import fan as fan
from strapdown.plots.statistics import nees_over_time, nis_over_time
from strapdown.plots.statistics import runs_overview as runs_overview
from strapdown.plots.style import BLUE as BLUE
from strapdown.plots.style import GREEN as GREEN
from strapdown.plots.style import ORANGE as ORANGE
from strapdown.plots.style import PURPLE as PURPLE
from strapdown.plots.style import SKY as SKY
from strapdown.plots.style import VERMILION as VERMILION
from strapdown.plots.style import YELLOW as YELLOW
from strapdown.plots.style import ink as ink
from strapdown.plots.style import new_figure, save
from strapdown.plots.style import theme as theme

__all__ = [
    "allan_overview",
    "error_budget",
    "error_overview",
    "nees_over_time",
    "new_figure",
    "nis_over_time",
    "save",
]
