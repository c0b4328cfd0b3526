"""Faulty samples of a recording: truncated samples, clipped samples, and gaps of the gyro, filled by interpolation or not.

If the samples of a gyro are multiples of a step, truncated toward zero, every rate is measured half a step too small, so that the bias at
rest differs from that in motion: half a step is added (:func:`truncation_step`).

A clipped gyro sample is a lower bound of the rate. The rate of a run of clipped samples is restored by a cubic between the samples before
and after (:func:`restored`). Its error is represented by a variance of the rotation about the clipped axis, which the filter adds to its
own, as it does for the rotation over a gap. A clipped sample of the accelerometer has a wrong direction and is left out.

A damaged sample is left out: a specific force beyond 16 g or a field far above the usual one, for a moment (:func:`damaged_samples`); that
of the gyro is replaced, if only one in a row is damaged (:func:`damaged_rates`). At rest and in the hand such a specific force turned the
attitude by up to 13°, a rate of 50 rad/s by up to 60°.

A slow sensor's samples can be repeated up to the rate of the gyro's: the repeated ones are late, and those of an accelerometer left out.

Where a recording was resampled, a gap of its sensors can be filled by a straight line or by the last sample, which is no measurement: the
rotation over it is as uncertain as over a gap, and the other sensors' samples there are left out (:func:`interpolated`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown.checks import Array, lengths, median
from strapdown.kernels import recording_samples as kernel
from strapdown.kernels.alignment import UNKNOWN_TURN
from strapdown.kernels.machine import compiled, read_only
from strapdown.records.recording import GAP, LARGEST_FORCE, SENSORS, Recording, corrected
from strapdown.units import DEGREE

SLOW_RATE = 0.03
"""Maximum rate, rad/s, of the samples from which the quantisation step of a gyro is determined."""
MAX_SLOW = 10_000
"""Maximum number of rows from which it is determined."""
MAX_CHANGE, MAX_ACCELERATION = 8.0, 500.0
"""Change of the rate, rad/s, from a sample to the next and back to which a unit can be shaken, and what is added to it for each second of
the interval. In 94 recordings of eight sets no rate changes by more than 7.1 rad/s from sample to sample."""
MIN_CLIPPED_RATE = 1.0
"""Minimum limit of a clipped gyro axis, rad/s; quantised samples at rest repeat their extreme too."""
MIN_CLIPPED_FORCE = 15.0
"""Minimum limit of a clipped accelerometer axis, m/s²."""
MIN_CLIPPED = 3
"""Minimum number of samples at the extreme, at least two of them consecutive, of a clipped axis."""
MAX_REPEATS = 0.1
"""Maximum share of the other samples equal to the one before; above it the sensor repeats samples, and clipping is not reported."""
HELD = 0.6, 0.99
"""Limits of the share of a slow vector sensor's samples, while the unit turns, that repeat the one before; a stuck one has more."""
MAX_HELD = 4.0
"""Maximum number of such repetitions in a row, relative to their mean."""
RESTORED_ERROR = 0.5
"""σ of the rotation beyond the limit over a clipped run, relative to that of the cubic."""
RESTORED_SPAN = 0.3
"""Assumed duration of the angular acceleration at the ends of a clipped run, s."""
SLOWEST_CROSSING = 64
"""Maximum number of samples before and after a zero crossing of the rate that is used for the histogram about zero."""
CROSSING_STEPS = 6
"""Minimum rate on either side of a zero crossing, in steps, so that noise at rest is excluded."""
BINS = 4
"""Number of bins on either side of the zero bin with which it is compared."""
TRUNCATED_ODDS = 100.0
"""Minimum likelihood ratio of truncation to rounding for samples to be treated as truncated."""
MIN_STRAIGHT = 10
"""Minimum number of successive gyro samples on one straight line to be treated as interpolated."""
STRAIGHT = 1e-4
"""Maximum second difference of such samples, relative to the median one of the recording."""
MIN_JUMP = 0.2
"""Minimum rate of held samples, and its change at their end, rad/s, to be treated as the last sample before a gap, repeated."""
LEAD = 0.05
"""Time before such a gap whose samples are left out too, s, so that no step of the filter has some from before an unknown rotation."""
LAGS, SHARES = 16, 64
"""Number of lags for which the mean square change of the rate is computed, and of the points of its integral."""
LONG_INTERVAL = 1.5
"""Ratio of an interval between stamps to the median interval above which its rotation is uncertain."""
MAX_SAMPLING_ERROR = 8e-3
"""Maximum random walk by the error of the trapezoidal rule, rad/√s, that is not reported. 94 recordings at 100 to 286 Hz have 6.7e-3 at
most; those of fast motion taken at 10 to 25 Hz have more, and up to forty times the error of the attitude."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Faults:
    """Faults of a recording."""

    recording: Recording
    """Recording with clipped and damaged gyro samples restored, and such samples of other sensors replaced by NaN."""
    turn_variance: Array
    """Variance (n − 1, 3) of the rotation about each body axis over each interval in addition to the gyro's noise, rad²; mostly 0."""
    words: tuple[str, ...]
    """Description of the faults."""


def find(recording: Recording) -> Faults:
    """Return the faults of a recording's samples, with the corrected recording."""
    bend = second_differences(recording.rate)
    measured, words = _measured(recording, bend)
    changes: dict[str, Any] = {}
    if measured is not recording.rate:
        changes["rate"], bend = measured, second_differences(measured)
    rate, variance, clipped = restored(recording.time, measured)
    if clipped.any():
        changes["rate"] = rate
        limits = ", ".join(
            f"{axis} at {np.rad2deg(np.abs(measured[clipped[:, k], k]).max()):.4g} °/s ({clipped[:, k].mean():.2%})"
            for k, axis in enumerate("xyz")
            if clipped[:, k].any()
        )
        words.append(
            f"The gyro was clipped: {limits} of the samples. The rate is restored from adjacent samples, and σ grows over each run"
        )
    for sensor, damaged in damaged_samples(recording).items():
        changes[SENSORS[sensor]] = np.where(damaged[:, None], np.nan, getattr(recording, SENSORS[sensor]))
        words.append(f"Damaged samples of the {sensor}, far too large: {np.count_nonzero(damaged)}, ignored")
    force = changes.get("specific_force", recording.specific_force)
    if force is not None and (saturated := clipped_samples(force, MIN_CLIPPED_FORCE)).any():
        lost = np.asarray(saturated.any(axis=1))
        changes["specific_force"] = np.where(lost[:, None], np.nan, force)
        words.append(f"The accelerometer was clipped in {np.sum(lost)} samples ({lost.mean():.2%}), which are ignored")
    for sensor, repeated in repeated_samples(recording).items():
        remedy = "those are late; record it without them"
        if sensor == "accelerometer" and force is not None:  # without them, the heading of a disturbed field was worse
            changes["specific_force"] = np.where(repeated[:, None], np.nan, changes.get("specific_force", force))
            remedy = "those are ignored"
        words.append(
            f"The {sensor} is slower than the gyro: {repeated.mean():.0%} of its samples repeat the one before; {remedy}"
        )
    steps = np.diff(recording.time)
    usual = recording.interval
    # The trapezoidal rule errs by T³/12 times the second derivative of the rate over an interval T.
    sampling = float(np.sqrt(usual * np.mean(bend**2)) / 12.0) if len(bend) else 0.0
    if sampling > MAX_SAMPLING_ERROR:
        words.append(
            f"The rate changes so fast that between samples at {1.0 / usual:.3g} Hz the rotation is uncertain by about "
            f"{sampling / DEGREE:.2g} °/√s: σ may be too small; sample the gyro faster"
        )
    filled = interpolated(measured, bend)
    if filled:
        durations = np.array([recording.time[last] - recording.time[first] for first, last in filled])
        turns = np.minimum(turn_variance_over(rate, durations, usual), UNKNOWN_TURN)
        changes["rate"] = rate = rate.copy()
        for (first, last), turn in zip(filled, turns, strict=True):
            rate[first : last + 1] = np.linspace(rate[first], rate[last], last - first + 1)  # held ones too
            variance[first] += turn
            variance[last - 1] += 0.5 * turn  # so that what is after the gap shows nothing of what is within
        lead = round(LEAD / usual)
        inside = np.concatenate([np.arange(max(first + 1 - lead, 0), last) for first, last in filled])
        for name in ("specific_force", "magnetic_field"):
            samples = changes.get(name, getattr(recording, name))
            if samples is not None:
                changes[name] = samples.copy()
                changes[name][inside] = np.nan
        words.append(
            f"Gaps filled by interpolation or repeated samples: {len(filled)}, up to {durations.max():.3g} s; samples there are ignored, "
            "and σ grows over each"
        )
    long = np.flatnonzero(steps > LONG_INTERVAL * usual)
    if len(long):
        variance[long] += turn_variance_over(rate, steps[long], usual)[:, None]
        words.append(
            f"Intervals between stamps longer than {LONG_INTERVAL:g} median ones: {len(long)}, the longest {steps.max():.3g} s after "
            f"{recording.time[np.argmax(steps)]:.3f} s; σ grows over each according to the change of the rate in that time"
        )
    return Faults(recording=corrected(recording, **changes), turn_variance=variance, words=tuple(words))


def _measured(recording: Recording, bend: Array) -> tuple[Array, list[str]]:
    """Return the gyro's rates (n, 3) with damaged samples replaced and truncation reversed, and the description of both.

    ``bend``: :func:`second_differences` of the rates as recorded.
    """
    rate, words = recording.rate, []
    damaged = damaged_rates(rate, bend, recording.interval)
    if len(damaged):
        rate = rate.copy()
        rate[damaged] = 0.5 * (rate[damaged - 1] + rate[damaged + 1])
        words.append(f"Damaged samples of the gyro: {len(damaged)}, replaced by the means of those beside them")
    step = truncation_step(rate)
    if step is not None:
        # Less to those within a step of zero, which are interpolated.
        rate = rate + 0.5 * np.clip(rate, -step, step)
        words.append(
            f"The gyro's samples are multiples of {step / DEGREE:.3g} °/s truncated toward zero: half a step is added to each"
        )
    return rate, words


def damaged_rates(rate: Array, bend: Array, interval: float) -> np.ndarray:
    """Return the samples (m,) among rates (n, 3) at an interval, s, that are far from both beside them, which agree.

    ``bend``: their :func:`second_differences`.
    """
    least = MAX_CHANGE + MAX_ACCELERATION * interval
    rows = 1 + np.flatnonzero(bend > least)  # hardly any
    before, after = rate[rows - 1], rate[rows + 1]
    change = np.minimum(lengths(rate[rows] - before), lengths(rate[rows] - after))
    return rows[(change > least) & (change > 2.0 * lengths(after - before))]


def damaged_samples(recording: Recording) -> dict[str, np.ndarray]:
    """Return masks (n,) of damaged samples by sensor: :func:`strapdown.kernels.recording_samples.is_damaged`.

    A sensor that has none is left out, and one that has little else, whose unit is wrong: that the tests of the conventions report.
    """
    damaged = np.zeros((2, len(recording.time)), bool)
    force, field = (np.empty((0, 3)) if x is None else x for x in (recording.specific_force, recording.magnetic_field))
    burst = np.full(2, recording.time[0] - kernel.AGAIN)
    arrays, share = map(read_only, (recording.time, force, field)), recording.interval / kernel.USUAL_TIME
    compiled(kernel.find_damaged)(*arrays, share, LARGEST_FORCE, np.zeros(1), burst, damaged)
    by_sensor = zip(("accelerometer", "magnetometer"), damaged, strict=True)
    return {sensor: mask for sensor, mask in by_sensor if 0.0 < np.mean(mask) < 0.5}


def repeated_samples(recording: Recording) -> dict[str, np.ndarray]:
    """Return masks (n,) of the samples by which a slow accelerometer or magnetometer repeats the one before while the unit turns."""
    turns, masks = lengths(recording.rate[1:]) > ROTATES, {}
    usual = max(int(np.count_nonzero(turns)), 1)
    for sensor in ("accelerometer", "magnetometer"):
        samples = getattr(recording, SENSORS[sensor])
        same = np.zeros(0, bool) if samples is None else turns & (samples[1:, 0] == samples[:-1, 0])
        if np.count_nonzero(same) > HELD[0] * usual:  # hardly ever: saves the comparison of the other axes
            same &= np.all(samples[1:, 1:] == samples[:-1, 1:], axis=1)
            share = np.count_nonzero(same) / usual
            new = np.flatnonzero(~same[turns])  # of a sensor without noise, there are none for long
            if HELD[0] < share < HELD[1] and np.diff(new, prepend=-1, append=usual).max() < MAX_HELD / (1.0 - share):
                masks[sensor] = np.append(False, same)
    return masks


def second_differences(rate: Array) -> Array:
    """Return the largest second difference of rates (n, 3) about any axis at each sample between two (n − 2,)."""
    bend = np.empty(max(len(rate) - 2, 0))
    compiled(kernel.bends)(read_only(rate), bend)
    return bend


def interpolated(rate: Array, bend: Array) -> list[tuple[int, int]]:
    """Return first and last sample of each run of at least :data:`MIN_STRAIGHT` rates (n, 3) on a straight line that noise never draws.

    Held samples of a gyro at rest or that turns steadily are on a level line; they fill a gap only if a fast rate jumps at their end, and
    not if most fast samples repeat the one before, as of a slow sensor. ``bend``: their :func:`second_differences`.
    """
    most = bend.max(initial=0.0)
    if most == 0.0 or not _runs(bend <= STRAIGHT * most):  # saves the median of nearly every recording
        return []
    usual = median(bend[bend > 0.0])
    runs = _runs(bend <= STRAIGHT * usual)
    filled, held = [], []
    for first, last in runs:
        change, jump = (np.max(np.abs(rate[row] - rate[last])) for row in (first, min(last + 1, len(rate) - 1)))
        if change > usual:
            filled.append((first, last))
        elif jump > MIN_JUMP and np.max(np.abs(rate[last])) > MIN_JUMP:
            held.append((first, min(last + 1, len(rate) - 1)))  # the rotation to the next sample is unknown too
    if not held:
        return filled
    repeated = np.all(rate[1:] == rate[:-1], axis=1)[np.abs(rate[1:]).max(axis=1) > MIN_JUMP]
    return filled if np.mean(repeated) > 0.5 else sorted(filled + held)


def _runs(straight: np.ndarray) -> list[tuple[int, int]]:
    """Return first and last sample of each long run of samples that are on a line with both beside them (n − 2,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], straight, [False]]))).reshape(-1, 2)
    return [(first, stop + 1) for first, stop in edges.tolist() if stop + 2 - first >= MIN_STRAIGHT]


def truncation_step(rate: Array) -> float | None:
    """Return the step, rad/s, of a gyro whose samples (n, 3) are multiples of it truncated toward zero; None for any other gyro.

    The bin about zero is then twice as wide as the others. Only samples in the middle of zero crossings are counted, where all rates are
    equally probable; at rest they are not.
    """
    step = _quantisation(rate)
    if step is None:
        return None
    crossing = np.zeros(rate.shape, bool)
    above, below = rate > CROSSING_STEPS * step, rate < -CROSSING_STEPS * step
    reach = 2
    while reach <= SLOWEST_CROSSING and 2 * reach < len(rate):
        before, after = slice(-2 * reach), slice(2 * reach, None)
        crossing[reach:-reach] |= (above[before] & below[after]) | (below[before] & above[after])
        reach *= 2
    bins = np.abs(rate[crossing]) / step
    number = np.bincount(np.rint(bins[bins < BINS + 0.5]).astype(int), minlength=1)
    zero, others = int(number[0]), int(np.sum(number[1:]))
    # Of 2 B + 1 bins the middle one has a share of 1 / (2 B + 1), or if it is twice as wide, of 2 / (2 B + 2).
    truncated, rounded = 1.0 / (BINS + 1), 1.0 / (2 * BINS + 1)
    odds = zero * np.log(truncated / rounded) + others * np.log((1.0 - truncated) / (1.0 - rounded))
    return step if odds > np.log(TRUNCATED_ODDS) else None


def _quantisation(rate: Array) -> float | None:
    """Return the step of which nearly all small rates among (n, 3) are multiples, including zero; None if there is none."""
    sizes = np.abs(rate[:: 1 + len(rate) // MAX_SLOW])
    slow = np.rint(1e7 * sizes[sizes < SLOW_RATE])
    if np.count_nonzero(slow == 0.0) < 3:
        return None
    slow, number = np.unique(slow, return_counts=True)
    slow /= 1e7
    frequent = slow[number >= 3]
    if len(frequent) < BINS or frequent[0] != 0.0:
        return None
    multiple = slow / np.median(np.diff(frequent))
    on = np.abs(multiple - np.rint(multiple)) < 0.02
    if np.sum(number[on]) < 0.8 * np.sum(number) or len(frequent) > 0.1 * np.sum(number):
        return None
    return float(np.sum((slow * number)[on]) / np.sum((np.rint(multiple) * number)[on]))


def clipped_samples(samples: Array, least: float) -> np.ndarray:
    """Return a mask of the samples (n, 3) at the limit of their sensor: those that repeat the extreme of their axis, beyond ``least``."""
    clipped = np.zeros(samples.shape, bool)
    ends = np.empty((3, 2, 2))
    compiled(kernel.extremes)(read_only(samples), ends)
    reached = (ends[:, :, 1] >= MIN_CLIPPED) & (np.abs(ends[:, :, 0]) >= least)
    for k in np.flatnonzero(reached.any(axis=1)):
        axis = samples[:, k].copy()
        extremes, repeated = [axis == end for end in ends[k, :, 0]], reached[k]
        same = np.append(False, axis[1:] == axis[:-1])
        # A quantised sensor repeats samples at rest; one that repeats them in motion too does not show by them that it is clipped.
        between = ~(extremes[0] | extremes[1]) & (np.abs(axis) > least)
        if not between.any() or np.mean(same[between]) > MAX_REPEATS:
            continue
        for at, candidate in zip(extremes, repeated, strict=True):
            if candidate and np.any(at & same):
                clipped[:, k] |= at
    return clipped


def restored(time: Array, rate: Array) -> tuple[Array, Array, np.ndarray]:
    """Return rates (n, 3) with clipped runs restored, the variance of the rotation over each interval (n − 1, 3), and the mask of clipping.

    A run is replaced by the cubic with the values and slopes at its ends, but not below the limit. The rotation beyond the limit over a
    run has a relative σ of :data:`RESTORED_ERROR`; its variance is distributed equally over the intervals of the run.
    """
    clipped = clipped_samples(rate, MIN_CLIPPED_RATE)
    variance = np.zeros((len(time) - 1, 3))
    if not clipped.any():
        return rate, variance, clipped
    result = rate.copy()
    for k in np.flatnonzero(clipped.any(axis=0)):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], clipped[:, k].astype(int), [0]])))
        for first, stop in edges.reshape(-1, 2):
            limit = rate[first, k]
            if first < 2 or stop + 1 >= len(time):
                variance[max(first - 1, 0) : stop, k] += (RESTORED_ERROR * limit * (time[1] - time[0])) ** 2
                continue
            t0, t1 = time[first - 1], time[stop]
            u = (time[first:stop] - t0) / (t1 - t0)
            start, end = rate[first - 1, k], rate[stop, k]
            span = min(t1 - t0, RESTORED_SPAN)
            rise = (start - rate[first - 2, k]) / (t0 - time[first - 2]) * span
            fall = (rate[stop + 1, k] - end) / (time[stop + 1] - t1) * span
            cubic = start + u * (
                rise + u * (3.0 * (end - start) - 2.0 * rise - fall + u * (2.0 * (start - end) + rise + fall))
            )
            beyond = np.maximum(np.sign(limit) * (cubic - limit), 0.0)
            result[first:stop, k] = limit + np.sign(limit) * beyond
            turn = float(np.sum(beyond)) * (t1 - t0) / (stop - first + 1)
            variance[first - 1 : stop, k] += (RESTORED_ERROR * turn) ** 2 / (stop - first + 1)
    return result, variance, clipped


def turn_variance_over(rate: Array, length: Array, usual: float) -> Array:
    """Return the variance (m,), rad² per axis, of rotations by the mean of the rates at the ends of intervals of duration T, s (m,).

    With D(τ) the mean square change of the rate over τ, if that is the same everywhere, it is ``∫₀ᵀ τ D(τ) dτ − T² D(T)/4``: T² D(T)/12
    for a random walk, T² D(T)/4 for rates that have nothing in common, zero for a ramp.
    """
    longest = max(1, min(round(length.max() / usual), len(rate) - 1))
    lags = np.unique(np.geomspace(1.0, longest, LAGS).round().astype(int))
    change = [np.mean((rate[lag:] - rate[:-lag]) ** 2) for lag in lags.tolist()]
    time, square = np.append(0.0, usual * lags), np.append(0.0, change)
    share = (np.arange(SHARES) + 0.5) / SHARES
    inner = np.interp(np.multiply.outer(length, share), time, square) @ share / SHARES
    return np.asarray(length**2 * np.maximum(inner - 0.25 * np.interp(length, time, square), 0.0))


MAX_CLIPPED = 0.05
"""Maximum share of clipped samples that is no warning."""


def clipped_words(recording: Recording) -> list[str]:
    """Return a warning for gyro and accelerometer if many of its samples are clipped."""
    sensors = ("gyro", recording.rate, MIN_CLIPPED_RATE), ("accelerometer", recording.specific_force, MIN_CLIPPED_FORCE)
    words = []
    for sensor, samples, least in sensors:
        clipped = np.empty((0, 3), bool) if samples is None else clipped_samples(samples, least)
        if np.count_nonzero(clipped) <= MAX_CLIPPED * len(clipped):  # saves the slower reduction by rows
            continue
        if (share := np.mean(clipped.any(axis=1))) > MAX_CLIPPED:
            words.append(
                f"the {sensor} is clipped in {share:.0%} of its samples: the motion exceeds its range; record with a larger one"
            )
    return words


MIN_BURSTS = 0.015
"""Minimum share of long intervals between stamps that come in bursts; of a recording with gaps it is smaller."""


def burst_words(recording: Recording) -> list[str]:
    """Return a warning if most of the time is in long intervals between bursts of samples, as of packets stamped at their arrival."""
    steps = np.diff(recording.time)
    long = steps > GAP * recording.interval
    lasts = steps.sum()
    if np.mean(long) < MIN_BURSTS or np.sum(steps[long]) < 0.5 * lasts:
        return []
    return [
        f"the samples come in bursts, {np.count_nonzero(long)} long intervals between stamps take {np.sum(steps[long]) / lasts:.0%} of the "
        "time: stamps of packets that arrived, not of samples; the attitude is wrong unless the samples are spaced evenly"
    ]


STUCK_TIME = 2.0
"""Minimum time of equal samples to be reported while the unit moves, s."""
STUCK_SAMPLES = 50
"""Minimum number of them."""
ROTATES = 0.2
"""RMS rate, rad/s, about the other axes of the gyro, or that turns a vector, above which a unit moves."""
ACCELERATES = 1.0
"""Standard deviation of the specific force above which a unit moves, m/s²."""


def stuck_words(recording: Recording) -> list[str]:
    """Return a warning for each axis of the gyro and each vector stuck throughout, or for seconds in which other samples show motion."""
    time, rate, warnings, runs = recording.time, recording.rate, [], np.empty((3, 2), np.int64)

    def stuck(first: int, last: int) -> str:
        """Return when the samples of a run were equal; empty if it is short."""
        if last - first + 1 < STUCK_SAMPLES or time[last] - time[first] < STUCK_TIME:
            return ""
        return "throughout" if last - first == len(time) - 1 else f"from {time[first]:.6g} to {time[last]:.6g} s"

    compiled(kernel.longest_runs)(read_only(rate), runs)
    for axis, (first, last) in enumerate(runs.tolist()):
        if not (when := stuck(first, last)):
            continue
        span = slice(first, last + 1)
        moves = _rms(np.delete(rate[span], axis, axis=1)) > ROTATES
        if recording.specific_force is not None and np.isfinite(force := recording.specific_force[span]).any():
            moves |= float(np.sqrt(np.sum(np.nanvar(force, axis=0)))) > ACCELERATES
        if moves or when == "throughout":
            warnings.append(
                f"the gyro is stuck about {'xyz'[axis]}: {rate[first, axis] / DEGREE:.4g} °/s {when}; the attitude is not tracked then; "
                "check the sensor"
            )
    for sensor in ("accelerometer", "magnetometer"):
        if (samples := getattr(recording, SENSORS[sensor])) is None:
            continue
        few = samples[:: STUCK_SAMPLES // 2]
        if not np.all(few[1:] == few[:-1], axis=1).any():  # two of these are in any long run
            continue
        compiled(kernel.longest_runs)(read_only(samples), runs)
        first, last = int(runs[:, 0].max()), int(runs[:, 1].min())
        turn = np.cross(rate[first : last + 1], samples[first])  # a rotation about a vector does not change it
        if (when := stuck(first, last)) and _rms(turn) > ROTATES * _rms(samples[first]):
            warnings.append(f"the {sensor} is stuck at one value {when}, while the gyro turns it; check the sensor")
    return warnings


def _rms(vectors: Array) -> float:
    """Return the root mean square magnitude of vectors (..., k)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))
