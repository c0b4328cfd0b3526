"""Figures. Each function has results and an optional ``ax`` as arguments, and returns the axes; statistics are computed elsewhere.

Colours are those of Okabe and Ito, distinguishable with colour vision deficiency. :func:`new_figure` needs no display.

- ``style``: Colours, sizes, saving.
- ``decimation``: Reduction of long series to the extremes of each pixel column.
- ``estimates``: One estimate over time: attitude, bias, σ, errors.
- ``statistics``: Error statistics over many runs.
- ``coning``: The coning study.
- ``allan``: Allan deviations with fits.
- ``budget``: Predicted errors by source.
- ``tuning``: Likelihood slices.
"""

from strapdown.checks import InputError

try:
    import matplotlib as _matplotlib
except ValueError as error:
    raise InputError(
        f"matplotlib cannot be loaded ({error}); correct the environment variable MPLBACKEND, or its configuration file"
    ) from error

from strapdown.plots.allan import allan_overview
from strapdown.plots.budget import error_budget
from strapdown.plots.coning import coning_consistency, coning_errors, draw_coning_study, drift_by_algorithm
from strapdown.plots.decimation import decimated
from strapdown.plots.estimates import (
    draw_estimate,
    error_overview,
    errors_in_envelope,
    estimate_overview,
    recording_errors,
    states_over_time,
)
from strapdown.plots.statistics import nees_over_time, nis_over_time, runs_overview
from strapdown.plots.style import new_figure, save, save_as
from strapdown.plots.tuning import likelihood_slices

__all__ = ["allan_overview", "error_budget", "error_overview", "nees_over_time", "new_figure", "nis_over_time", "save"]
