"""What a user of the estimate of a recording should know, in words: its start, its frame, the model of the motion, delays and faults."""

from __future__ import annotations

import numpy as np

from strapdown.ahrs.estimating import AhrsEstimate
from strapdown.checks import Hint, lengths
from strapdown.recordings import Recording
from strapdown.units import DEGREE

MAX_BIAS = 4.0
"""Gyro bias without a rest, relative to σ of its axes at the start, above which the start was too certain."""
MAX_DEPARTURE = 3.0 * DEGREE
"""Difference of the gyro's bias from its last measurement at rest, rad/s, above which the model of the motion is wrong; 94 recordings have
1.7 °/s at most, smoothed 2.6 °/s."""

MAGNETIC_NORTH = "East-North-Up, magnetic North"
"""Fixed frame of an estimate with a magnetometer."""


def fixed_frame(recording: Recording) -> str:
    """Return the fixed frame of the estimate of a recording."""
    if recording.magnetic_field is not None:
        return MAGNETIC_NORTH
    return "z up, heading arbitrary (no magnetometer)"


def remarks(result: AhrsEstimate, motion: str) -> tuple[str, ...]:
    """Return the remarks on an estimate with the model of a motion."""
    used, delays = result.recording, result.delays
    sentences = [
        f"{used.source}: {len(used.time)} samples over {used.time[-1] - used.time[0]:.1f} s.",
        *used.remarks,
        f"Fixed frame: {fixed_frame(used)}.",
        _model(motion, result),
        *delays.words,
        *(f"{fault}." for fault in result.faults.words),
    ]
    if result.hard_iron.any():
        iron = ", ".join(f"{value:.3g}" for value in result.hard_iron)
        unit = used.magnetic_unit or "(unit of the magnetometer)"
        sentences.append(f"Hard iron of ({iron}) {unit}, body axes, is estimated at the end.")
    sentences.append(used.left_out_words)
    for sensor, number in result.estimate.skipped.items():
        if number:
            sentences.append(f"{number} of the gyro's samples have no sample of the {sensor} at the same time.")
    return tuple(filter(None, sentences))


def _model(moved_by: str, result: AhrsEstimate) -> str:
    """Return a description of the motion model and of the spans at rest."""
    parameters = result.parameters
    words = (
        f"Motion: of a {moved_by}, velocity σ {parameters.velocity_sigma:.2g} m/s, correlation time "
        f"{parameters.velocity_time:g} s."
    )
    if parameters.velocity_sigma == 0.0:
        words = "Motion: any, its acceleration modelled as white noise."
    if parameters.rest_bias_sigma == 0.0:
        return words
    number, time = len(result.rests.last), result.recording.time
    if number == 0:
        bias = float(np.linalg.norm(result.estimate.bias[-1]))
        known = parameters.bias_sigma / DEGREE
        beyond = (
            f" Its estimate at the end, {bias / DEGREE:.2g} deg/s, is beyond what the model expects at the start (σ {known:.2g} deg/s per "
            "axis): until it was known, errors may exceed their σ. Begin with a second at rest, or give a calibration."
        )
        return (
            f"{words} No second is quiet enough to measure the gyro's bias, so the heading may drift at first."
            f"{beyond if bias > MAX_BIAS * parameters.bias_sigma else ''}"
        )
    at = ", ".join(f"{time[last]:.2f}" for last in result.rests.last[:4]) + (", …" if number > 4 else "")
    second = max(1, round(1.0 / result.recording.interval))
    rows = np.arange(result.rests.last[0] + second, len(time), second)
    measured = result.rests.rate[np.searchsorted(result.rests.last, rows) - 1]
    departure = float(lengths(result.estimate.bias[rows] - measured).max(initial=0.0))
    beyond = (
        f" In between it is estimated to differ by up to {departure / DEGREE:.2g} deg/s, as no gyro's does: this motion does not suit, and "
        "errors may exceed their σ."
    )
    if moved_by != "vehicle":
        beyond += f" Acceleration that lasts for seconds is that of a vehicle ({Hint('motion', 'vehicle')})."
    return (
        f"{words} The gyro's bias is measured at rest, in {number} span{'s' if number > 1 else ''} of a second, ending at {at} s."
        f"{beyond if departure > MAX_DEPARTURE else ''}"
    )
