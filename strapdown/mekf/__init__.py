"""Multiplicative extended Kalman filter: attitude and gyro bias from gyro increments and vector measurements.

The process model is equation (17), ``q̇ = ½ q ⊗ (w_meas − b)``; the error state is ``(δθ, δb)`` with ``q_true = q ⊗ exp(δθ)`` and
``δb = b_true − b``. Transition and process noise are exact at constant rate; after each correction the covariance is carried to the new
tangent space. Two faces, held equal by a test: :func:`run`, compiled, for whole records, and :class:`StepFilter`, on filterpy, for
people who look inside.

``states``
    Process noise, state, where the filter starts.
``scheduling``
    Measurements in order of time.
``running``
    The compiled face.
``stepping``
    The step face.
"""

from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from strapdown.mekf.stepping import StepFilter, transition_and_noise

__all__ = [
    "FIRST_SETS",
    "GAP_FACTOR",
    "ONCE",
    "VERTICAL",
    "ProcessNoise",
    "Schedule",
    "State",
    "StepFilter",
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
    "transition_and_noise",
]


def __getattr__(name: str) -> Any:
    """Load the step-by-step filter only when it is asked for: filterpy's import takes longer than a recording's estimate."""
    if name in ("StepFilter", "transition_and_noise"):
        from strapdown.mekf import stepping

        return getattr(stepping, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
