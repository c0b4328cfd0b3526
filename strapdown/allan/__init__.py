"""Noise of a sensor at rest: Allan deviation, fit of noise coefficients, and noise parameters for other programs.

- ``deviation``: :func:`allan_deviation` with confidence intervals.
- ``noise_fit``: :func:`fit_noise` by maximum likelihood, on the ``spectrum`` of the cosine transform.
- ``misfit``: Whether a record has other errors than the fitted noise.
- ``power_laws``: The power law of the noise, and degrees of freedom under it.
- ``temperature``: Bias as a polynomial in temperature.
- ``parameters``: Noise parameters of a six-axis unit in the formats of Kalibr, PX4 and MATLAB.
"""

from __future__ import annotations

from strapdown.allan import parameters, temperature
from strapdown.allan.deviation import TERMS, AllanDeviation, allan_deviation, flicker_variance, model_deviation
from strapdown.allan.noise_fit import UNITS, NoiseFit, curves_by_axis, fit_noise, to_gyro_parameters, upper_bounds
from strapdown.allan.power_laws import NOISE_TYPES, equivalent_degrees_of_freedom

__all__ = ["AllanDeviation", "NoiseFit", "allan_deviation", "fit_noise", "to_gyro_parameters"]
