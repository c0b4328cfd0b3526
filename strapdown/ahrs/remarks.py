"""What a user of the estimate of a recording should know, in words: its start, its frame, the model of the motion, delays and faults."""

from __future__ import annotations

import warnings

import numpy as np

from strapdown.ahrs.estimating import AhrsEstimate
from strapdown.calibration.calibrating import implausible
from strapdown.checks import Hint, lengths
from strapdown.recordings import Recording
from strapdown.units import DEGREE

MAX_BIAS = 4.0
"""Gyro bias without a rest, relative to σ of its axes at the start, above which the start was too certain."""
MAX_DEPARTURE = 3.0 * DEGREE
"""Difference of the gyro's bias from its last measurement at rest, rad/s, above which the model of the motion is wrong; 94 recordings have
1.7 °/s at most, smoothed 2.6 °/s."""

MAX_DENSITY = 20.0
"""Spectral density of the accelerometer's innovations at low frequency, relative to white ones, above which the model of the motion is
wrong; 88 recordings with a magnetometer have 14 at most, simulated cars, bicycles and aircraft as a hand's 28 to 1600. Without a
magnetometer a large bias of the gyro does the same."""

MAX_SWELL = 3.0
"""The same of the smoother at the frequencies of waves (:func:`strapdown.ahrs.regions.swell_density`): 88 recordings have 1.8 at most,
simulated ships in waves as a hand's 4.5 to 11. The filter's σ holds on these."""

MAGNETIC_NORTH = "East-North-Up, magnetic North"
"""Fixed frame of an estimate with a magnetometer."""


class MotionWarning(UserWarning):
    """The model of the motion does not suit a recording."""


def warn(result: AhrsEstimate, motion: str) -> None:
    """Warn the caller of the calling function if the model of a motion does not suit the recording."""
    if words := misfit(result, motion):
        warnings.warn(f"{result.recording.source}: {words}", MotionWarning, stacklevel=3)


def misfit(result: AhrsEstimate, motion: str) -> str:
    """Return why the model of a motion does not suit the recording; empty: nothing shows that."""
    swell = 0.0 if motion == "any" else result.swell_density  # any motion may be that of waves
    if result.recording.magnetic_field is not None and (result.force_density > MAX_DENSITY or swell > MAX_SWELL):
        shown = "its acceleration lasts longer than modelled"
    elif (departure := _departure(result)) > MAX_DEPARTURE:
        shown = f"between rests the gyro's bias is estimated to change by up to {departure / DEGREE:.2g} deg/s, as no gyro's does"
    else:
        return ""
    words = f"The motion model ({motion}) does not suit: {shown}. Errors may exceed their σ."
    if motion != "vehicle":
        words += f" Acceleration that lasts for seconds is that of a vehicle ({Hint('motion', 'vehicle')})."
    if motion != "vessel":
        words += f" On waves it is that of a vessel ({Hint('motion', 'vessel')})."
    return words


def _departure(result: AhrsEstimate) -> float:
    """Return the largest difference of the gyro's bias from its last measurement at rest, rad/s."""
    rests, time = result.rests, result.recording.time
    if len(rests.last) == 0:
        return 0.0
    second = max(1, round(1.0 / result.recording.interval))
    rows = np.arange(rests.last[0] + second, len(time), second)
    measured = rests.rate[np.searchsorted(rests.last, rows) - 1]
    return float(lengths(result.estimate.bias[rows] - measured).max(initial=0.0))


def fixed_frame(recording: Recording) -> str:
    """Return the fixed frame of the estimate of a recording."""
    if recording.magnetic_field is not None:
        return MAGNETIC_NORTH
    return "z up, heading arbitrary (no magnetometer)"


def remarks(result: AhrsEstimate, motion: str) -> tuple[str, ...]:
    """Return the remarks on an estimate with the model of a motion."""
    used, delays = result.recording, result.delays
    doubtful = "" if result.applied is None else implausible(result.applied)
    sentences = [
        f"{used.source}: {len(used.time)} samples over {used.time[-1] - used.time[0]:.1f} s.",
        *used.remarks,
        f"Fixed frame: {fixed_frame(used)}.",
        _model(motion, result),
        misfit(result, motion),
        doubtful and f"Doubtful calibration: {doubtful}. Calibrate the unit again, or leave the calibration out.",
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
            f"{beyond if bias > MAX_BIAS * parameters.bias_sigma and not result.estimate.smoothed else ''}"
        )
    at = ", ".join(f"{time[last]:.2f}" for last in result.rests.last[:4]) + (", …" if number > 4 else "")
    return f"{words} The gyro's bias is measured at rest, in {number} span{'s' if number > 1 else ''} of a second, ending at {at} s."
