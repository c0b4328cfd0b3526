"""Figures. Each function takes results and an optional ``ax``, draws, and returns the axes; nothing here computes statistics.

Colours are those of Okabe and Ito, which every kind of colour vision can tell apart. :func:`new_figure` needs no display.

``style``
    Colours, themes (light, dark), sizes, saving.
``decimation``
    Long series reduced to the extremes of each pixel column.
``estimates``
    One estimate over time: attitude, bias, σ, errors.
``innovations``
    Innovations of one record: NIS, distribution, autocorrelation.
``statistics``
    Error statistics over many runs.
``sphere``
    The path of a body axis on the unit sphere, still or animated.
``coning``
    The coning study.
``allan``
    Allan deviations with their fit.
``budget``
    Predicted errors by source.
``tuning``
    Likelihood slices, and the statistics before and after.
"""

from strapdown.plots.allan import allan_axis, allan_overview
from strapdown.plots.budget import error_budget
from strapdown.plots.coning import coning_consistency, coning_errors, draw_coning_study, drift_by_algorithm
from strapdown.plots.decimation import decimated
from strapdown.plots.estimates import (
    error_overview,
    errors_in_envelope,
    estimate_overview,
    recording_errors,
    states_over_time,
)
from strapdown.plots.innovations import (
    error_distribution,
    innovation_autocorrelation,
    innovation_histogram,
    innovation_quantiles,
    nis_over_record,
)
from strapdown.plots.sphere import animate_body_axis, body_axis_on_sphere, sphere_figure
from strapdown.plots.statistics import covariance_ellipses, coverage_by_state, fan, nees_over_time, nis_over_time
from strapdown.plots.style import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    YELLOW,
    ink,
    new_figure,
    save,
    theme,
)

__all__ = [
    "BLUE",
    "GREEN",
    "ORANGE",
    "PURPLE",
    "SKY",
    "VERMILION",
    "YELLOW",
    "allan_axis",
    "allan_overview",
    "animate_body_axis",
    "body_axis_on_sphere",
    "coning_consistency",
    "coning_errors",
    "covariance_ellipses",
    "coverage_by_state",
    "decimated",
    "draw_coning_study",
    "drift_by_algorithm",
    "error_budget",
    "error_distribution",
    "error_overview",
    "errors_in_envelope",
    "estimate_overview",
    "fan",
    "ink",
    "innovation_autocorrelation",
    "innovation_histogram",
    "innovation_quantiles",
    "nees_over_time",
    "new_figure",
    "nis_over_record",
    "nis_over_time",
    "recording_errors",
    "save",
    "sphere_figure",
    "states_over_time",
    "theme",
]
