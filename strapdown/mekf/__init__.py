"""Multiplicative extended Kalman filter: attitude and gyro bias from gyro increments and vector measurements.

The process model is equation (17), ``q̇ = ½ q ⊗ (w_meas − b)``; the error state is ``(δθ, δb)`` with ``q_true = q ⊗ exp(δθ)`` and
``δb = b_true − b``. Transition and process noise are exact at constant rate; after each correction the covariance is carried to the new
tangent space. :func:`run` filters whole records, compiled; :class:`strapdown.stepfilter.StepFilter` is the same filter step by step.

``states``
    Process noise, state, where the filter starts.
``scheduling``
    Measurements in order of time.
``running``
    The filter over a record.
"""

from strapdown.mekf.running import GAP_FACTOR, gaps, run, run_events, run_on
from strapdown.mekf.scheduling import Schedule, innovations_by_sensor, schedule, skipped_too
from strapdown.mekf.states import (
    FIRST_SETS,
    ONCE,
    VERTICAL,
    ProcessNoise,
    State,
    covariance_matrices,
    first_state,
    initial_state,
    pack,
)

__all__ = [
    "FIRST_SETS",
    "GAP_FACTOR",
    "ONCE",
    "VERTICAL",
    "ProcessNoise",
    "Schedule",
    "State",
    "covariance_matrices",
    "first_state",
    "gaps",
    "initial_state",
    "innovations_by_sensor",
    "pack",
    "run",
    "run_events",
    "run_on",
    "schedule",
    "skipped_too",
]
