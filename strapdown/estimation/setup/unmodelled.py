"""What is specified of gyro and sensors beside white noise and random walks, and what of it a filter does not model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from strapdown import units, vectors
from strapdown.checks import Hint
from strapdown.estimation.filters import MEKF
from strapdown.gyro import GyroSpec
from strapdown.records import Origin
from strapdown.results import figure

if TYPE_CHECKING:
    from strapdown.estimation.setup.filter_setup import FilterSetup

REJECTION = "gate or robust weights"
DIFFERENT_AXES = 1.2
"""Ratio of the noises of two axes of a gyro above which it is reported that a filter has only one for all axes."""
_NOISES = {
    "angle_random_walk": "angle random walk",
    "rate_random_walk": "rate random walk",
    "bias_instability": "bias instability",
    "markov_noise": "first-order noise",
}


class SpecifiedError(NamedTuple):
    """A specified error of gyro or sensor beside white noise and random walks."""

    of: str
    """"gyro", or the sensor."""
    name: str
    """Name that, with ``of``, a cause of the same error has (:class:`strapdown.tuning.diagnosis.Cause`)."""
    words: str
    """Description with its size."""
    model: str = ""
    """What models it in a filter: the name of an error state, or :data:`REJECTION`; empty if nothing does."""
    analysed: bool = True
    """Whether a covariance analysis includes it."""


def unmodelled(origin: Origin | None, filter_setup: FilterSetup | None) -> list[SpecifiedError]:
    """Return the errors that an origin specifies and a filter does not model; none if nothing is specified.

    If there are any, σ of the filter are too small; if the axes of the gyro differ, those about the quieter axes are too large.
    """
    if origin is None or origin.gyro is None or filter_setup is None:
        return []
    known = () if filter_setup.states is None else filter_setup.states.names
    modelled = {*known, *([REJECTION] if filter_setup.rejects else [])}
    missing = [error for error in specified_errors(origin) if error.model not in modelled]
    return missing + _unequal_axes(origin.gyro, filter_setup)


def unmodelled_errors(origin: Origin | None, filter_setup: FilterSetup | None) -> tuple[str, ...]:
    """Return the errors of :func:`unmodelled` as texts with their size.

    Examples
    --------
    >>> from strapdown import GyroSpec, ProcessNoise
    >>> from strapdown.estimation import setup
    >>> from strapdown.records import Origin
    >>> noise = ProcessNoise(angle_random_walk=1e-5, rate_random_walk=0.0)
    >>> origin = Origin(gyro=GyroSpec(angle_random_walk=1e-5, scale_factor=(1e-4, 0.0, 0.0)))
    >>> setup.unmodelled_errors(origin, setup.FilterSetup(process_noise=noise, bias_sigma=1e-6))
    ("the gyro's scale factor of 100 ppm",)
    """
    return tuple(error.words for error in unmodelled(origin, filter_setup))


def unmodelled_words(origin: Origin | None, filter_setup: FilterSetup) -> list[str]:
    """Return a sentence on the errors of :func:`unmodelled_errors`, with the remedy; none if there are no errors."""
    missing = unmodelled_errors(origin, filter_setup)
    parts = [f"The filter does not model {', '.join(missing)}", remedy(origin, filter_setup)]
    return [f"{'; '.join(filter(None, parts))}."] if missing else []


def remedy(origin: Origin | None, filter_setup: FilterSetup) -> str:
    """Return how a filter can be given states for what is specified; empty if it has some, or if there are none for it."""
    if origin is None or filter_setup.estimator != MEKF or filter_setup.states is not None:
        return ""
    adds = any(error.model not in ("", REJECTION) for error in specified_errors(origin))
    return f"{Hint('states', True)} adds states for most of these errors" if adds else ""


def specified(origin: Origin) -> tuple[Sequence[Any], Sequence[float]]:
    """Return the sensors with their specified errors, and gravity in the fixed frame, if known."""
    scenario = origin.scenario
    return ((), vectors.GRAVITY_F) if scenario is None else (scenario.sensors, scenario.gravity_f)


def specified_errors(origin: Origin) -> list[SpecifiedError]:
    """Return the specified errors of gyro and sensors; none if the gyro is not specified."""
    if origin.gyro is None:
        return []
    sensors, gravity_f = specified(origin)
    saturation, curve = (
        ("", 0.0) if origin.scenario is None else (origin.scenario.saturation, origin.scenario.temperature_curve)
    )
    bent = f"the curve of the gyro's bias over temperature, up to {figure(curve / units.DEGREE_PER_HOUR, 3)} °/h from a line"
    terms = [
        *_of_gyro(origin.gyro, gravity_f),
        (bool(saturation), SpecifiedError("gyro", "saturation", saturation)),
        (curve, SpecifiedError("gyro", "curve over temperature", bent, analysed=False)),
    ]
    for sensor in sensors:
        terms += _of_sensor(sensor)
    return [error for size, error in terms if np.any(size)]


def _of_gyro(spec: GyroSpec, gravity_f: Sequence[float]) -> list[tuple[Any, SpecifiedError]]:
    """Return the errors that a gyro may have, with their sizes."""
    scale, asymmetry, misalignment, flicker, ramp = (
        float(np.max(np.abs(getattr(spec, name))))
        for name in ("scale_factor", "asymmetry", "misalignment", "bias_instability", "rate_ramp")
    )
    drift = f" of {figure(flicker / units.DEGREE_PER_HOUR, 3)} °/h, covered in the attitude but not in the bias"
    terms: list[tuple[Any, str, str, str, bool]] = [
        (scale, "scale factor", f" of {figure(scale / 1e-6, 3)} ppm", "gyro.scale", True),
        (asymmetry, "asymmetry", f" of {figure(asymmetry / 1e-6, 3)} ppm", "", True),
        (misalignment, "misalignment", f" of {figure(misalignment / 1e-3, 3)} mrad", "gyro.misalignment", True),
        (flicker, "flicker", drift, "gyro.drift", True),
        (np.any(gravity_f) * spec.g_sensitivity, "sensitivity to acceleration", "", "gyro.force", True),
        (spec.temperature is not None, "bias over temperature", "", "gyro.temperature", False),
        (np.max(spec.quantization) + np.max(spec.rate_resolution), "quantisation", "", "", False),
        (ramp, "rate ramp", f" of {figure(ramp * 3600.0 / units.DEGREE_PER_HOUR, 3)} °/h²", "", True),
        (spec.timestamp_error + spec.sampling_jitter, "irregular sampling or time stamps", "", "", False),
        (spec.drop_probability, "lost samples", f", {100.0 * spec.drop_probability:.3g} % of all", "", False),
    ]
    late = f"the gyro's time stamps, late by {spec.timestamp_offset:.3g} s"
    lag = f"the lag of the gyro's bandwidth of {spec.bandwidth:.3g} Hz"
    return [
        *(
            (size, SpecifiedError("gyro", name, f"the gyro's {name}{details}", model, analysed))
            for size, name, details, model, analysed in terms
        ),
        (np.isfinite(spec.bandwidth), SpecifiedError("gyro", "bandwidth", lag)),
        (spec.timestamp_offset, SpecifiedError("gyro", "time offset", late, analysed=False)),
    ]


def _of_sensor(sensor: Any) -> list[tuple[Any, SpecifiedError]]:
    """Return the errors that a sensor may have, with their sizes."""
    name, faults = sensor.name, getattr(sensor, "faults", vectors.Faults())
    accelerated = getattr(sensor, "acceleration_f", None) is not None
    terms = (
        (getattr(sensor, "hard_iron", 0.0), "hard iron", f"the hard iron of the {name}", f"{name}.bias"),
        (getattr(sensor, "soft_iron", 0.0), "soft iron", f"the soft iron of the {name}", ""),
        (getattr(sensor, "bias", 0.0), "body-fixed bias", f"the bias of the {name}", f"{name}.bias"),
        (
            getattr(sensor, "lever_arm_b", 0.0),
            "lever arm",
            f"the accelerations of the {name} at its lever arm",
            f"{name}.lever",
        ),
        (accelerated, "acceleration", f"the acceleration of the point where the {name} is mounted", f"{name}.velocity"),
        (faults.correlated_sigma, "correlated noise", f"the correlated noise of the {name}", f"{name}.correlated"),
        (faults.outlier_probability, "outliers", f"the outliers of the {name} (a gate rejects them)", REJECTION),
    )
    return [(size, SpecifiedError(name, error, words, model)) for size, error, words, model in terms]


def _unequal_axes(spec: GyroSpec, filter_setup: FilterSetup) -> list[SpecifiedError]:
    """Return an error, or none: how pessimistic a filter with the noise of a gyro's noisiest axis is about the others."""
    assumed = vars(filter_setup.process_noise).items()
    if filter_setup.estimator != MEKF or any(value < 0.99 * np.max(getattr(spec, name)) for name, value in assumed):
        return []  # a filter of one's own, or with the noise of a quieter axis
    differ = []
    for name, words in _NOISES.items():
        values = np.broadcast_to(getattr(spec, name), 3)
        if values.max() > DIFFERENT_AXES * values.min():
            differ.append(
                f"{words} ×{values.max() / values.min():.3g}" if values.min() > 0.0 else f"{words} of some axes only"
            )
    bound = ", by at most these factors" if all("×" in text for text in differ) else ""
    words = f"the difference of the gyro's axes ({', '.join(differ)}; σ about the quieter ones are too large{bound})"
    return [SpecifiedError("gyro", "difference of axes", words)] if differ else []
