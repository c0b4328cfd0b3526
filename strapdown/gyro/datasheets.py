"""Gyro specifications in the units of data sheets, and presets from public data sheets.

Units are given as text and checked: ``from_datasheet(arw="0.15 deg/sqrt(h)", bias_instability="0.5 deg/h")``. A quantity of another
dimension is an error. A noise density in °/s/√Hz is the same quantity as an angle random walk: 1 °/s/√Hz = 60 °/√h.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import InputError, known_keys
from strapdown.files import reading
from strapdown.gyro.model import GyroSpec, from_table

__all__ = ["PRESETS", "from_datasheet"]

_QUANTITIES = {
    "arw": ("angle_random_walk", "rad / second ** 0.5", "deg/sqrt(h) or deg/s/sqrt(Hz)"),
    "bias_instability": ("bias_instability", "rad / second", "deg/h"),
    "rrw": ("rate_random_walk", "rad / second ** 1.5", "deg/h/sqrt(h)"),
    "rate_ramp": ("rate_ramp", "rad / second ** 2", "deg/h/h"),
    "quantization": ("quantization", "rad", "arcsec"),
    "angle_resolution": ("quantization", "rad", "arcsec"),
    "rate_resolution": ("rate_resolution", "rad / second", "deg/s"),
    "turn_on_bias": ("turn_on_bias_sigma", "rad / second", "deg/h"),
    "markov_noise": ("markov_noise", "rad / second ** 1.5", "deg/h/sqrt(h)"),
    "markov_correlation_time": ("markov_correlation_time", "second", "s"),
    "scale_factor": ("scale_factor", "dimensionless", "ppm"),
    "asymmetry": ("asymmetry", "dimensionless", "ppm"),
    "misalignment": ("misalignment", "rad", "mrad"),
    "g_sensitivity": ("g_sensitivity", "rad / second / (meter / second ** 2)", "deg/h/g"),
    "bandwidth": ("bandwidth", "1 / second", "Hz"),
    "range": ("range", "rad / second", "deg/s"),
}
"""Name in the data sheet: field of the specification, its unit, and an example."""


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def parse(name: str, text: str, wanted: str, example: str) -> float:
    """Return a quantity given as text, in the unit ``wanted``; raise an error for another dimension."""
    registry = _registry()
    if not isinstance(text, str):
        raise InputError(f"{name} is {text!r}; give it as text with its unit, such as {example}")
    number = re.match(r"\s*[±<≤]?\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)", text)
    unit_text = text[number.end() :] if number else text
    plain = re.sub(r"(?:√|\brt)\(?(\w+)\)?", r"sqrt(\1)", unit_text.replace("°", " deg").replace("″", " arcsec"))
    symbols = {
        r"\bg\b": "standard_gravity",
        r"\bhr?\b": "hour",
        r"\bHz\b": "(1/second)",
        r"\b(m?)dps\b": r"\1deg/second",
    }
    for symbol, unit in symbols.items():
        plain = re.sub(symbol, unit, plain)
    plain = re.sub(r"sqrt\(((?:[^()]|\([^()]*\))*)\)", r"((\1) ** 0.5)", plain)
    try:
        if not number:
            raise ValueError("it does not begin with a number")
        unit = registry.Quantity(f"1{plain}" if plain.strip()[:1] in ("", "/") else plain)
        # pint drops characters that it does not know: 1,5 would be 15, 0,34 nothing, and 0.3 – 0.5 their product.
        if unit.magnitude != 1.0:
            raise ValueError("it has more than a number and its unit, or no decimal point")
        quantity = float(number[1]) * unit
        units = quantity.to_root_units().units
    except Exception as error:  # pint raises any of Python's exceptions for a text that is no expression
        raise InputError(
            f"{name} is {text!r}, which is not a quantity with a unit ({error}); write a number with its unit, such as {example}"
        ) from None
    needed = registry.Quantity(1.0, wanted).to_root_units().units
    # The radian has no dimension, so without "deg" a number would be read as radians: compare units, not only dimensions.
    if units != needed:
        have = "no unit" if units == registry.dimensionless else f"in {units}"
        raise InputError(f"{name} is {text!r} ({have}); give a quantity in {needed}, such as {example}")
    return float(quantity.to(wanted).magnitude)


def from_datasheet(**quantities: str) -> GyroSpec:
    """Return the specification of a gyro from the figures of its data sheet, given as text with units.

    Parameters
    ----------
    **quantities : str
        ``arw`` (or noise density), ``bias_instability`` (B as below), ``rrw``, ``rate_ramp``, ``quantization`` (Q) or
        ``angle_resolution`` (step, Q√12), ``rate_resolution``, ``turn_on_bias`` (1 σ), ``markov_noise``,
        ``markov_correlation_time``, ``scale_factor`` and ``asymmetry`` (for all axes), ``misalignment`` (for all entries),
        ``g_sensitivity`` (along each axis), ``bandwidth``, ``range``.

    Returns
    -------
    GyroSpec
        The specification, SI.

    Notes
    -----
    IEEE Std 952 defines B by the PSD B²/(2π f), whose Allan deviation is flat at √(2 ln 2/π) B = 0.664 B. Most data sheets give this
    coefficient as "bias instability" or the minimum of the Allan deviation as "in-run bias stability", and few specify which. The figure
    is used as B.

    Examples
    --------
    >>> [f"{from_datasheet(arw=arw).angle_random_walk:.6g}" for arw in ("60 deg/sqrt(h)", "1 deg/s/sqrt(Hz)")]
    ['0.0174533', '0.0174533']
    """
    known_keys("from_datasheet", quantities, _QUANTITIES)
    if "quantization" in quantities and "angle_resolution" in quantities:
        raise InputError("quantization and angle_resolution are the same quantity; give one of them")
    values: dict[str, Any] = {}
    for name, text in quantities.items():
        field, wanted, example = _QUANTITIES[name]
        number = parse(name, text, wanted, example)
        shapes = {"misalignment": 1.0 - np.eye(3), "g_sensitivity": np.eye(3)}
        values[field] = number / np.sqrt(12.0) if name == "angle_resolution" else number * shapes.get(name, 1.0)
    return GyroSpec(**values)


@dataclass(frozen=True, eq=False)
class Preset:
    """A commercial gyro, specified by its public data sheet."""

    name: str
    title: str
    """Manufacturer, type and range."""
    grade: str
    """Kind of gyro, such as "consumer MEMS"."""
    document: str
    """Data sheet of the stated figures."""
    checked: str
    """How the stated figures were verified."""
    rate: float
    """Typical sample rate, Hz."""
    stated: Mapping[str, Any]
    """Figures of the data sheet, with the units in the keys."""
    assumed: Mapping[str, Any]
    """Figures that the data sheet does not give in this form; typical values for the grade."""

    @property
    def spec(self) -> GyroSpec:
        """The specification."""
        return from_table({**self.assumed, **self.stated})


PRESETS = {
    name: Preset(name=name, **table) for name, table in reading.toml(Path(__file__).with_name("presets.toml")).items()
}
"""Presets by name, from consumer MEMS to navigation grade."""
