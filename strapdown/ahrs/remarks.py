"""What a user of the estimate of a recording should know, in words: its start, its frame, the model of the motion, delays and faults."""

from __future__ import annotations

import numpy as np

from strapdown.ahrs.estimating import AhrsEstimate
from strapdown.recordings import Recording, gaps
from strapdown.recordings.sensor_faults import stuck_words
from strapdown.units import DEGREE


def fixed_frame(recording: Recording) -> str:
    """Return the fixed frame of the estimate of a recording."""
    if recording.magnetic_field is not None:
        return "East-North-Up, magnetic North"
    return "z up, heading arbitrary (no magnetometer)"


def remarks(result: AhrsEstimate, motion: str, odds: float) -> tuple[str, ...]:
    """Return the remarks on an estimate with a model of the motion, whose log-likelihood is larger by ``odds`` than the other's."""
    used, delays = result.recording, result.delays
    sentences = [
        f"{used.source}: {len(used.time)} samples over {used.time[-1] - used.time[0]:.1f} s, initialised in "
        f"{'the quiet second' if _rested(result) else 'its quietest second, which is not at rest,'} from {used.time[0]:.2f} s.",
        *used.remarks,
        f"Fixed frame: {fixed_frame(used)}.",
        _model(motion, odds, result),
        *delays.words,
        *(f"{one}." for one in result.faults.words),
        *stuck_words(used),
    ]
    if result.hard_iron.any():
        iron = ", ".join(f"{value:.3g}" for value in result.hard_iron)
        unit = used.magnetic_unit or "(unit of the magnetometer)"
        sentences.append(f"Hard iron of ({iron}) {unit}, body axes, at the end, is subtracted.")
    sentences += [f"{gap_words(gaps(used.time))}.", used.left_out_words]
    for sensor, number in result.estimate.skipped.items():
        if number:
            sentences.append(f"{number} of the gyro's samples have no sample of the {sensor} at the same time.")
    return tuple(sentence for sentence in sentences if sentence.strip("."))


def gap_words(found: list[tuple[float, float]]) -> str:
    """Return how many gaps between stamps there are, begin and length of each given, and the longest; empty without any."""
    if not found:
        return ""
    begin, length = max(found, key=lambda gap: gap[1])
    return f"Gaps between stamps: {len(found)}, the longest {length:.3g} s after {begin:.3f} s"


def _rested(result: AhrsEstimate) -> bool:
    """Return whether the gyro bias was estimated at the start, if the filter is initialised with it."""
    p = result.parameters
    return p.rest_bias_sigma == 0.0 or bool(result.initial.covariance[3, 3] <= (0.5 * p.bias_sigma) ** 2)


def _model(moved_by: str, odds: float, result: AhrsEstimate) -> str:
    """Return a description of the motion model and of the initial gyro bias."""
    if moved_by == "any":
        return "Motion: any, its acceleration modelled as white noise."
    bias, sigma = result.initial.bias / DEGREE, np.sqrt(result.initial.covariance[3, 3]) / DEGREE
    parameters = result.parameters
    shown = " (from the recording)" if parameters.velocity_from_record else ""
    likelier = (
        f" (log-likelihood larger by {odds:.0f} than for a {'hand' if moved_by == 'vehicle' else 'vehicle'})"
        if odds < np.inf
        else ""
    )
    words = (
        f"Motion: of a {moved_by}{likelier}, velocity σ {parameters.velocity_sigma:.2g} m/s{shown}, correlation time "
        f"{parameters.velocity_time:g} s. "
        f"Initial gyro bias: {', '.join(f'{value:.3g}' for value in bias)} °/s, σ {sigma:.2g} °/s"
    )
    if not _rested(result):
        return f"{words}: no second is quiet enough to estimate it, so the heading may drift at first."
    return f"{words}, from that second."
