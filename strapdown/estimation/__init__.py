"""Attitude, gyro bias and error states from gyro increments and vector measurements.

The process model is equation (17), ``q̇ = ½ q ⊗ (w_meas − b)``; the error state is ``(δθ, δb, δc)`` with ``q_true = q ⊗ exp(δθ)`` and
``δb = b_true − b``. Transition and process noise are exact at constant rate; after each correction the covariance is transformed to the new
tangent space.

- ``states``: Process noise, state, initial states.
- ``error_states``: Declarations of states in addition to attitude and gyro bias; ``model`` converts them to arrays.
- ``gating``: Gate and robust weights.
- ``schedule``: Measurements in order of time.
- ``forward``: The filter over whole records.
- ``smoothing``: The smoothers.
- ``observability``: Information of a record about each state.
- ``features``: What filters of single samples and exported ones have not, with the remedy.
- ``live``: The compiled filter for data in real time.
- ``step_filter``: The filter in single steps, on filterpy.
- ``multiple_model``: Unknown initial attitude, by multiple-model estimation.
- ``filters``: Filters of your own, and their comparison.
- ``setup``: The setup of a filter, matched to a scenario or read from a file, and the filter of a setup over a record.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from strapdown.estimation.forward import Span as Span
from strapdown.estimation.forward import gaps as gaps
from strapdown.estimation.forward import run
from strapdown.estimation.forward import run_part as run_part
from strapdown.estimation.forward import run_spans as run_spans
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.live import LiveFilter
from strapdown.estimation.model import with_error_states as with_error_states
from strapdown.estimation.observability import Observability, observability
from strapdown.estimation.smoothing import smooth
from strapdown.estimation.states import ProcessNoise, State, first_state, initial_state

__all__ = [
    "Gate",
    "LiveFilter",
    "Observability",
    "ProcessNoise",
    "Robust",
    "State",
    "StepFilter",
    "first_state",
    "initial_state",
    "observability",
    "run",
    "smooth",
]

if TYPE_CHECKING:
    from strapdown.estimation import filters as filters
    from strapdown.estimation import multiple_model as multiple_model
    from strapdown.estimation import setup as setup
    from strapdown.estimation.step_filter import StepFilter


def __getattr__(name: str) -> Any:
    if name == "StepFilter":  # filterpy loads when it is needed
        from strapdown.estimation.step_filter import StepFilter

        return StepFilter
    if name in ("filters", "multiple_model", "setup"):
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
