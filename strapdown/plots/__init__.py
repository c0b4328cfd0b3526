"""Figures. Each function takes results and an optional ``ax``, draws, and returns the axes; nothing here computes statistics.

Colours are those of Okabe and Ito, told apart by every kind of colour vision. :func:`new_figure` makes a figure that needs no display.

``style``
    Colours, sizes, saving.
``estimates``
    One estimate over time: attitude, bias, σ, errors.
``statistics``
    Error statistics over many runs and over one record.
``coning``
    The coning study.
``allan``
    Allan deviations with their fit.
"""

from strapdown.plots.allan import allan_axis, allan_overview
from strapdown.plots.coning import coning_consistency, coning_errors, draw_coning_study, drift_by_algorithm
from strapdown.plots.estimates import errors_in_envelope, estimate_overview, recording_errors
from strapdown.plots.statistics import nees_over_time, nis_over_time
from strapdown.plots.style import new_figure, save

__all__ = [
    "allan_axis",
    "allan_overview",
    "coning_consistency",
    "coning_errors",
    "draw_coning_study",
    "drift_by_algorithm",
    "errors_in_envelope",
    "estimate_overview",
    "nees_over_time",
    "new_figure",
    "nis_over_time",
    "recording_errors",
    "save",
]
