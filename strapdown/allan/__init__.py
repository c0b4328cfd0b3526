"""Noise of a sensor at rest: Allan deviation, fit of noise coefficients, and noise parameters for other programs.

- ``deviation``: :func:`allan_deviation` with confidence intervals.
- ``noise_fit``: :func:`fit_noise` by maximum likelihood, on the ``spectrum`` of the cosine transform.
- ``gaps``: Allan deviation of a record with gaps.
- ``power_laws``: The power law of the noise, and degrees of freedom under it.
- ``temperature``: Bias as a polynomial in temperature.
- ``parameters``: Noise parameters of a six-axis unit in the formats of Kalibr, PX4 and MATLAB.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from strapdown.allan.deviation import TERMS as TERMS
from strapdown.allan.deviation import AllanDeviation as AllanDeviation
from strapdown.allan.deviation import allan_deviation as allan_deviation
from strapdown.allan.deviation import flicker_variance as flicker_variance
from strapdown.allan.deviation import model_deviation as model_deviation
from strapdown.allan.noise_fit import UNITS as UNITS
from strapdown.allan.noise_fit import NoiseFit as NoiseFit
from strapdown.allan.noise_fit import curves_by_axis as curves_by_axis
from strapdown.allan.noise_fit import expected_errors as expected_errors
from strapdown.allan.noise_fit import fit_noise as fit_noise
from strapdown.allan.noise_fit import table as table
from strapdown.allan.noise_fit import to_gyro_parameters as to_gyro_parameters
from strapdown.allan.noise_fit import upper_bounds as upper_bounds
from strapdown.allan.power_laws import NOISE_TYPES as NOISE_TYPES
from strapdown.allan.power_laws import equivalent_degrees_of_freedom as equivalent_degrees_of_freedom

__all__ = [
    "AllanDeviation",
    "NoiseFit",
    "allan_deviation",
    "fit_noise",
    "to_gyro_parameters",
]


def __getattr__(name: str) -> Any:
    """Load a submodule on first use (PEP 562)."""
    if name in ("gaps", "parameters", "temperature"):
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
