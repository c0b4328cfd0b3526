"""How accurate is the attitude of a hand-held unit, and is its σ right? On BROAD files or simulated, compared with other filters.

The same recordings are processed by ``strapdown estimate``'s filter and smoother (:data:`strapdown.ahrs.HAND_HELD`, and ``any`` motion),
VQF 9D, offline VQF, imufusion and Madgwick's filter (package ``ahrs``), each with one set of parameters for all; packages that are not
installed are skipped. The error is that of the BROAD benchmark: RMS over the movement, of the total rotation, heading and inclination.

As recorded, the gyro's samples are some milliseconds later than the reference (:func:`gyro_latency`, 4.1 ms in BROAD), which is not
observable from a recording without one; *compensated*, every filter's samples are shifted by ``--latency``.

- *coverage*: fraction of the movement in which the 95 % regions of our σ contain the error: of all angles, heading, inclination.
- *NIS*: normalised innovation squared per degree of freedom, accelerometer and magnetometer. That of the magnetometer is far below 1: its
  disturbance, with a correlation time of seconds, infinite at rest, is modelled as white noise of the level of its low frequencies.
- *left out*: the error on each recording with the parameters (:data:`CANDIDATES`) that are best on all the others.
- *modified*: error, σ and coverage on recordings with a clipped gyro, dropouts, uneven or repeated stamps, no magnetometer, no rest at the
  start, and with hard iron that is estimated or not.

Without recordings the unit is simulated: at rest for two seconds, then rotated and moved on smooth paths that differ from the filter's
model. Run ``python sims/hand_held.py [--latency MS] [--out FOLDER] [RECORDING...]``; the recordings are files of the BROAD data set.
"""

from __future__ import annotations

import argparse
import os
import sys
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

import strapdown
from strapdown import ahrs, estimation, plots, quaternion, recordings
from strapdown.ahrs import HAND_HELD, AhrsEstimate, AhrsParameters
from strapdown.checks import Array, InputError
from strapdown.consistency import reference_errors
from strapdown.estimation.error_states import GaussMarkov
from strapdown.files import write_json
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.plots import style
from strapdown.randomness import generator
from strapdown.recordings import Recording, sensor_delays
from strapdown.records.recording import with_gyro
from strapdown.units import DEGREE

QUIET = replace(AhrsParameters(), rest_bias_sigma=HAND_HELD.rest_bias_sigma)
BOUNDED = replace(
    HAND_HELD, gyro_scale_sigma=0.0, hard_iron_sigma=0.0, accelerometer_bias_sigma=0.0, velocity_sigma=1.0
)
COLOURED = GaussMarkov(
    sensor="accelerometer", noise_sigma=5.8, correlation_time=0.1, frame="fixed", unit="m/s²", name="acceleration"
)
"""Acceleration with the σ and the high-frequency spectrum of that of the bounded velocity."""
CANDIDATES = {
    "as released": HAND_HELD,
    "half the velocity": replace(HAND_HELD, velocity_sigma=0.5 * HAND_HELD.velocity_sigma),
    "twice the velocity": replace(HAND_HELD, velocity_sigma=2.0 * HAND_HELD.velocity_sigma),
    "half the field's noise": replace(HAND_HELD, field_disturbance=0.5 * HAND_HELD.field_disturbance),
    "twice the field's noise": replace(HAND_HELD, field_disturbance=2.0 * HAND_HELD.field_disturbance),
    "half the weight of its deviation": replace(HAND_HELD, field_deviation=2.0 * HAND_HELD.field_deviation),
    "no deviation of the field": replace(HAND_HELD, field_deviation=1e3),
}
"""Parameter sets for leave-one-out."""
PARTS = ("total", "heading", "inclination")
COLOURS = {
    "strapdown": style.VERMILION,
    "strapdown, smoother": style.ORANGE,
    "strapdown, any motion": style.SKY,
    "VQF": style.GREEN,
    "offline VQF": style.BLUE,
    "imufusion": style.PURPLE,
    "Madgwick": "0.5",
}
RATE = 200.0
"""Sample rate of the simulated unit, Hz."""

SMALL = {"runs": 2, "duration": 12.0}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """Result of one filter on one recording."""

    errors: tuple[float, ...]
    """RMS error over the movement: total, heading, inclination, rad."""
    time: float
    """Processor time per sample, s."""
    coverage: tuple[float, ...] | None = None
    """Fraction of the movement in which the 95 % regions contain the error: all angles, heading, inclination."""
    sigma: float = np.nan
    """RMS of σ, the root of the trace over the three angles, rad."""
    nis: tuple[float, ...] = ()
    """Mean NIS per degree of freedom: accelerometer, magnetometer."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Scores of all filters."""

    recordings: tuple[str, ...]
    scores: dict[str, dict[str, list[Score]]]
    """By treatment ("as recorded", "compensated") and filter, one per recording."""
    left_out: dict[str, Array]
    """Total error on each recording with parameters chosen on the others, online and smoothed, rad."""
    modified: dict[str, list[Score]]
    """By modification, online, one per recording."""
    latencies: Array
    """Delay of the gyro relative to the reference (recordings,), s."""
    figures: tuple[Path, ...]

    def mean(self, name: str, treatment: str = "as recorded") -> Array:
        """Return the mean errors of one filter over the recordings (3,), rad."""
        return np.asarray(np.mean([score.errors for score in self.scores[treatment][name]], axis=0))


def swelling(t: Array, w: float, phase: Array) -> tuple[Array, Array]:
    """Return a sine that grows from zero, ``sin(ωt + φ) (1 − exp(−t³/2))``, and its second derivative."""
    fading = np.exp(-0.5 * t**3)
    swell, growth, bend = 1.0 - fading, 1.5 * t**2 * fading, (3.0 * t - 2.25 * t**4) * fading
    sine, cosine = np.sin(w * t + phase), np.cos(w * t + phase)
    return sine * swell, (bend - w**2 * swell) * sine + 2.0 * w * growth * cosine


def simulated(seed: int, run: int, duration: float) -> Recording:
    """Return a recording of a consumer-grade unit: two seconds of rest, then rotation at some rad/s and movement by decimetres."""
    random = generator(seed, run, "hand")
    time = np.arange(round((2.0 + duration) * RATE) + 1) / RATE
    turns = HarmonicRates(
        harmonics=tuple(
            Harmonic(amplitude=1.2 * random.standard_normal(3), frequency=f, phase=random.uniform(0.0, 2.0 * np.pi))
            for f in (0.23, 0.41, 0.67)
        )
    )
    # Time since the start of the movement, for a body that starts smoothly.
    since = np.maximum(time - 2.0, 0.0)
    along, speed = since - np.tanh(since), np.tanh(since) ** 2
    attitude = turns.attitude(along)
    rate = turns.body_rate(along) * speed[:, None]
    acceleration = np.zeros((len(time), 3))
    for f in (0.3, 0.7, 1.1, 1.9):
        size = 0.25 / (2.0 * np.pi * f) * random.standard_normal(3)
        acceleration += size * swelling(since[:, None], 2.0 * np.pi * f, random.uniform(0.0, 2.0 * np.pi, 3))[1]
    inverse = quaternion.conjugate(attitude)
    force = quaternion.rotate(inverse, acceleration + np.array([0.0, 0.0, 9.81]))
    field = quaternion.rotate(inverse, np.array([0.0, 20.0, -43.0]))
    white = random.standard_normal((3, len(time), 3))
    scale = np.eye(3) + 3e-3 * random.standard_normal((3, 3))
    return Recording(
        source=f"simulated {run + 1}",
        time=time,
        rate=rate @ scale.T + 0.3 * DEGREE * random.standard_normal(3) + 0.1 * DEGREE * white[0],
        specific_force=force + 0.05 * random.standard_normal(3) + 0.05 * white[1],
        magnetic_field=field + 0.5 * random.standard_normal(3) + 0.3 * white[2],
        true_attitude=attitude,
        movement=time > 2.0,
    )


def coloured(recording: Recording, latency: float) -> tuple[Recording, Array]:
    """Return the recording at the filter's steps, and the attitude with the acceleration modelled as first-order coloured noise."""
    plain = ahrs.estimate(recording, replace(BOUNDED, velocity_sigma=0.0, specific_force_noise=0.06), latency=latency)
    estimate = estimation.run(plain.record, BOUNDED.setup.process_noise, plain.initial, (COLOURED,))
    used = plain.recording
    rows = np.searchsorted(used.time, plain.record.time)
    return used.taken(rows), estimate.attitude


def gyro_latency(recording: Recording) -> tuple[float, float]:
    """Return the delay of the gyro's samples after the reference attitude, s, and the RMS of the remaining rate difference, rad/s.

    The rate of the reference over four samples is compared with that of the gyro, shifted by the delay, with scale, misalignment and bias
    fitted. No filter is involved.
    """
    assert recording.true_attitude is not None
    time, reach = recording.time, 2
    known = np.isfinite(recording.true_attitude).all(axis=1)
    centre = np.flatnonzero(known[2 * reach :] & known[: -2 * reach]) + reach
    if recording.movement is not None:
        centre = centre[recording.movement[centre]]
    centre = centre[(centre > 10) & (centre < len(time) - 10)]
    q = recording.true_attitude
    turn = quaternion.log(quaternion.multiply(quaternion.conjugate(q[centre - reach]), q[centre + reach]))
    wanted = turn / (time[centre + reach] - time[centre - reach])[:, None]
    whole = CubicSpline(time, np.vstack([np.zeros(3), np.cumsum(recordings.increments(recording), axis=0)]))

    def left(shift: float) -> float:
        after, before = time[centre + reach], time[centre - reach]
        rate = (whole(after + shift) - whole(before + shift)) / (after - before)[:, None]
        model = np.column_stack([rate, np.ones(len(rate))])
        error = wanted - model @ np.linalg.lstsq(model, wanted, rcond=None)[0]
        return float(np.sqrt(np.median(np.sum(error**2, axis=1))))

    optimum = minimize_scalar(left, bounds=(-0.03, 0.03), method="bounded", options={"xatol": 1e-5})
    return float(optimum.x), float(optimum.fun)


def shifted(recording: Recording, latency: float) -> Recording:
    """Return the recording with all samples advanced by ``latency``, s, by interpolation; the last ones are held."""
    moved = {}
    for name in ("rate", "specific_force", "magnetic_field"):
        columns = getattr(recording, name).T
        moved[name] = np.stack(
            [np.interp(recording.time + latency, recording.time, column) for column in columns], axis=1
        )
    return replace(recording, **moved)


def modified(recording: Recording, seed: int = 1) -> dict[str, Recording]:
    """Return the recording with several faults of the sensors and the data."""
    random = generator(seed, 0, "modified")
    n = len(recording.time)
    limit = 0.6 * np.abs(recording.rate[:, 0]).max()
    clipped = recording.rate.copy()
    clipped[:, 0] = np.clip(clipped[:, 0], -limit, limit)
    kept = np.ones(n, bool)
    for begin in (0.4, 0.55, 0.7):
        kept[round(begin * n) : round(begin * n) + round(0.3 / recording.interval)] = False
    moving = np.flatnonzero(recording.movement) if recording.movement is not None else np.arange(n)
    begin = moving[0] + round(5.0 / recording.interval)
    field = recording.magnetic_field
    ironed = recording
    if field is not None:
        iron = random.standard_normal(3)
        iron *= 0.04 * np.nanmedian(np.linalg.norm(field, axis=1)) / np.linalg.norm(iron)
        ironed = replace(recording, magnetic_field=field + iron)
    return {
        f"clipped at {limit / DEGREE:.0f} °/s": replace(recording, rate=clipped),
        "three dropouts of 0.3 s": recording.taken(kept),
        "a fifth of the rows lost": recording.taken(random.random(n) > 0.2),
        "no magnetometer": replace(recording, magnetic_field=None),
        "no rest": recording.taken(np.arange(n)[begin : moving[-1]]),
        "4 % of hard iron": ironed,
        "4 % of hard iron, no states for it": ironed,
        "repeated stamps": _stamped_again(recording, np.unique(random.integers(1, n, n // 300))),
    }


def _stamped_again(recording: Recording, rows: np.ndarray) -> Recording:
    """Return the recording as read from a file in which these rows repeat the stamps of the rows before."""
    time = recording.time.copy()
    time[rows] = recording.time[rows - 1]
    names = ("specific_force", "magnetic_field", "true_attitude", "movement")
    columns = {name: getattr(recording, name) for name in names}
    return with_gyro(source=recording.source, time=time, rate=recording.rate, **columns)


def scored(result: AhrsEstimate, taken: float) -> Score:
    """Return errors, coverage and NIS of one of our estimates, which has full covariances."""
    used, estimate = result.recording, result.estimate
    assert used.true_attitude is not None
    assert estimate.covariance is not None
    judged = np.isfinite(used.true_attitude).all(axis=1)
    if used.movement is not None:
        judged &= used.movement
    R = quaternion.to_matrix(estimate.attitude[judged])
    reference = quaternion.normalize(used.true_attitude[judged])
    error = quaternion.log(quaternion.multiply(reference, quaternion.conjugate(estimate.attitude[judged])))
    P = R @ estimate.covariance[judged][:, :3, :3] @ R.transpose(0, 2, 1)  # fixed axes, as the error

    def held(part: slice) -> float:
        e, own = error[:, part], P[:, part, part]
        square = np.einsum("ki,ki->k", e, np.linalg.solve(own, e[..., None])[..., 0])
        return float(np.mean(square <= chi2.ppf(0.95, e.shape[1])))

    errors = reference_errors(estimate.attitude, used.true_attitude).rms(used.movement)
    if used.magnetic_field is None:  # with an arbitrary heading only the inclination is defined
        errors = {**errors, "total": np.nan, "heading": np.nan}
    return Score(
        errors=tuple(errors[part] for part in PARTS),
        time=taken / len(used.time),
        coverage=(held(slice(0, 3)), held(slice(2, 3)), held(slice(0, 2))),
        sigma=float(np.sqrt(np.mean(np.trace(P, axis1=1, axis2=2)))),
        nis=tuple(
            float(np.mean(innovations.nis)) / innovations.innovation.shape[1]
            for innovations in estimate.innovations.values()
        ),
    )


def ours(
    recording: Recording, latency: float | None, parameters: AhrsParameters | None = None, smooth: bool = False
) -> tuple[AhrsEstimate, Score]:
    """Return our estimate and its score."""
    begin = clock.process_time()
    result = ahrs.estimate(recording, parameters, latency=latency, smooth=smooth, full_covariance=True)
    return result, scored(result, clock.process_time() - begin)


def peers(used: Recording) -> dict[str, tuple[Array, float]]:
    """Return attitudes and processor time, s, of the installed peers on a recording without missing samples."""
    if used.magnetic_field is None or used.specific_force is None:
        return {}
    interval = used.interval
    samples = [np.ascontiguousarray(each) for each in (used.rate, used.specific_force, used.magnetic_field)]
    results: dict[str, tuple[Array, float]] = {}

    def timed(name: str, call: Callable[[], Array]) -> None:
        begin = clock.process_time()
        results[name] = (call(), clock.process_time() - begin)

    try:
        import vqf
    except ImportError:
        pass
    else:
        timed("VQF", lambda: vqf.VQF(interval).updateBatch(*samples)["quat9D"])
        timed("offline VQF", lambda: vqf.offlineVQF(*samples, interval)["quat9D"])
    try:
        import imufusion
    except ImportError:
        pass
    else:
        timed("imufusion", lambda: _imufusion(imufusion, samples, interval))
    try:
        from ahrs.filters import Madgwick
    except ImportError:
        pass
    else:
        # Its x axis points North: rotated by 90° from East-North-Up.
        quarter = quaternion.exp([0.0, 0.0, 0.5 * np.pi])
        begun = ahrs.start(used, sensor_delays.gyro_attitude(used), HAND_HELD).attitude
        begun = quaternion.multiply(quaternion.conjugate(quarter), begun)
        timed("Madgwick", lambda: quaternion.multiply(quarter, Madgwick(*samples, Dt=interval, q0=begun).Q))
    return results


def _imufusion(imufusion, samples: Sequence[Array], interval: float) -> Array:  # type: ignore[no-untyped-def]
    """Run imufusion sample by sample, East-North-Up, with the settings of its documentation."""
    filter_, settings = imufusion.Ahrs(), imufusion.AhrsSettings()
    settings.convention = imufusion.CONVENTION_ENU
    settings.gain, settings.gyroscope_range = 0.5, 2000.0
    settings.acceleration_rejection = settings.magnetic_rejection = 10.0
    settings.rejection_timeout, settings.sample_rate = 5.0, 1.0 / interval
    filter_.set_settings(settings)
    rate, force, field = samples[0] / DEGREE, samples[1] / 9.80665, samples[2]
    attitude = np.empty((len(rate), 4))
    for k in range(len(rate)):
        filter_.update(rate[k], force[k], field[k])
        attitude[k] = np.ravel(filter_.get_quaternion())
    return attitude


def compared(recording: Recording, latency: float | None) -> tuple[dict[str, Score], list[AhrsEstimate]]:
    """Return the scores of every filter on a recording, and our estimates; ``latency`` in s; None: as recorded."""
    results, scores = [], {}
    for name, options in (
        ("strapdown", {}),
        ("strapdown, smoother", {"smooth": True}),
        ("strapdown, any motion", {"parameters": AhrsParameters()}),
    ):
        result, scores[name] = ours(recording, latency, **options)
        results.append(result)
    # All filters start at the same time as ours.
    begin = int(np.searchsorted(recording.time, results[0].recording.time[0]))
    used = (recording if latency is None else shifted(recording, latency)).taken(slice(begin, None))
    for name, (attitude, taken) in peers(used).items():
        errors = reference_errors(attitude, used.true_attitude).rms(used.movement)  # type: ignore[arg-type]
        scores[name] = Score(errors=tuple(errors[part] for part in PARTS), time=taken / len(used.time))
    return {name: scores[name] for name in COLOURS if name in scores}, results


def leave_one_out(read: Sequence[Recording], latency: float, smooth: bool) -> Array:
    """Return the total error on each recording with the candidate of minimum mean error on the others (recordings,), rad."""
    errors = np.empty((len(read), len(CANDIDATES)))
    for k, recording in enumerate(read):
        for c, candidate in enumerate(CANDIDATES.values()):
            errors[k, c] = ours(recording, latency, candidate, smooth)[1].errors[0]
    others = errors.sum(axis=0) - errors
    return np.asarray(errors[np.arange(len(read)), np.argmin(others, axis=1)])


def draw(result: Result, path: Path) -> Path:
    """Draw the errors of every recording by filter, and their means, and write the figure."""
    treatment = list(result.scores)[-1]
    scores = result.scores[treatment]
    figure, axes = plots.new_figure(1, 2, size=(10.5, 5.2), sharey=True)
    places = np.arange(len(result.recordings) + 1)
    for axis, part in zip(axes, (2, 0), strict=True):
        for k, (name, each) in enumerate(scores.items()):
            values = np.array([score.errors[part] for score in each]) / DEGREE
            shift = 0.1 * (k - 0.5 * (len(scores) - 1))
            marker = "o" if name.startswith("strapdown") else "D"
            axis.plot(
                places + shift,
                np.append(values, values.mean()),
                marker,
                markersize=4.0,
                color=COLOURS[name],
                label=name,
            )
        axis.set(
            yscale="log", ylabel="RMS error over the movement, °", title=f"{PARTS[part].capitalize()}, {treatment}"
        )
        axis.set_xticks(places, [*_heads(result.recordings), "mean"])
        axis.set_xlabel("recording")
        axis.axvspan(places[-1] - 0.5, places[-1] + 0.5, color="0.93", zorder=0)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return plots.save(figure, path)


def draw_worst(results: Sequence[AhrsEstimate], path: Path) -> Path:
    """Draw heading and inclination errors over time with ±2σ for the given recordings, and write the figure."""
    figure, axes = plots.new_figure(2, len(results), size=(5.2 * len(results), 6.0))
    for column, result in zip(np.reshape(axes, (2, len(results))).T, results, strict=True):
        used, estimate = result.recording, result.estimate
        assert used.true_attitude is not None
        assert estimate.covariance is not None
        R = quaternion.to_matrix(estimate.attitude)
        P = R @ estimate.covariance[:, :3, :3] @ R.transpose(0, 2, 1)
        errors = reference_errors(estimate.attitude, used.true_attitude)
        sigma = {"heading": np.sqrt(P[:, 2, 2]), "inclination": np.sqrt(P[:, 0, 0] + P[:, 1, 1])}
        for axis, part in zip(column, sigma, strict=True):
            axis.fill_between(used.time, 0.0, 2.0 * sigma[part] / DEGREE, color="0.85", label="2σ (95 %) of the filter")
            axis.plot(used.time, getattr(errors, part) / DEGREE, linewidth=0.7, color=style.VERMILION, label="error")
            axis.set(ylabel=f"{part} error, °", xlabel="time, s", title=used.source)
    style.legend_below(figure, [axes.flat[0]])
    return plots.save(figure, path)


def _plain(score: Score) -> dict[str, object]:
    """Return a score for JSON, where NaN, the error of an arbitrary heading, is null."""
    plain = asdict(score)
    plain["errors"] = [None if np.isnan(error) else error for error in score.errors]
    return {**plain, "sigma": None if np.isnan(score.sigma) else score.sigma}


def _heads(names: Sequence[str]) -> list[str]:
    """Return short names: the number of the BROAD trial or of the simulated recording."""
    return [name[:2] if name[:2].isdigit() else name.split()[-1][:8] for name in names]


def table(result: Result) -> str:
    """Return the figures as text."""
    width = 2 + max(
        len(name) for name in (*COLOURS, *result.modified, *(f"left out, {part}" for part in result.left_out))
    )
    lines = []
    for treatment, scores in result.scores.items():
        lines.append(f"RMS error over the movement, °, {treatment}".upper())
        lines.append(
            f"{'':{width}s}{'total':>7s}{'head.':>7s}{'incl.':>7s}{'worst':>7s}{'us':>7s}   coverage total/head./incl. (worst)  NIS acc/mag"
        )
        for name, each in scores.items():
            mean = np.mean([score.errors for score in each], axis=0) / DEGREE
            worst, time = (
                max(score.errors[0] for score in each) / DEGREE,
                1e6 * np.median([score.time for score in each]),
            )
            line = f"{name:{width}s}{mean[0]:7.2f}{mean[1]:7.2f}{mean[2]:7.2f}{worst:7.2f}{time:7.2f}"
            if each[0].coverage is not None:
                cover = np.array([score.coverage for score in each])
                nis = np.exp(np.mean([np.log(score.nis) for score in each], axis=0))
                line += f"   {'/'.join(f'{c:.2f}' for c in cover.mean(axis=0))} ({cover[:, 0].min():.2f})"
                line += f"{'':18s}{'/'.join(f'{ratio:.2g}' for ratio in nis)}"
            lines.append(line)
        lines += ["", f"{'Total':{width}s}" + "".join(f"{head:>7s}" for head in _heads(result.recordings))]
        for name, each in scores.items():
            lines.append(f"{name:{width}s}" + "".join(f"{score.errors[0] / DEGREE:7.2f}" for score in each))
        lines.append("")
    for name, errors in result.left_out.items():
        each = "".join(f"{error / DEGREE:7.2f}" for error in errors)
        lines.append(f"{f'left out, {name}':{width}s}{each}   mean {errors.mean() / DEGREE:.2f}")
    lines += ["", f"{'MODIFIED, ONLINE':{width}s}{'total':>7s}{'incl.':>7s}{'sigma':>7s}   coverage total/head./incl."]
    for name, each in result.modified.items():
        mean = np.sqrt(np.mean(np.square([score.errors for score in each]), axis=0)) / DEGREE
        sigma, cover = (
            np.sqrt(np.mean([score.sigma**2 for score in each])),
            np.mean([score.coverage for score in each], axis=0),
        )
        lines.append(
            f"{name:{width}s}{mean[0]:7.2f}{mean[2]:7.2f}{sigma / DEGREE:7.2f}   {'/'.join(f'{c:.2f}' for c in cover)}"
        )
    late = 1e3 * result.latencies
    lines += ["", f"{'gyro delay, ms':{width}s}{''.join(f'{delay:7.2f}' for delay in late)}   mean {late.mean():.2f}"]
    return "\n".join(lines)


def main(
    files: Sequence[str | os.PathLike[str]] = (),
    *,
    runs: int = 12,
    duration: float = 60.0,
    seed: int = 1,
    latency: float = 4.1,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Result:
    """Compare the filters on recordings with a reference, or on ``runs`` simulated ones of ``duration`` s.

    ``latency`` in ms is the delay that *compensated* removes; that of simulated recordings is 0. Table, JSON and figures are written to
    ``out`` if it is given; ``progress`` is called with a line for each recording.
    """
    read = [strapdown.read(file) for file in files] or [simulated(seed, k, duration) for k in range(runs)]
    for recording in read:
        if recording.true_attitude is None:
            raise InputError(f"{recording.source} has no reference attitude to compare with; give BROAD files")
    late = 1e-3 * latency if files else 0.0
    scores: dict[str, dict[str, list[Score]]] = {"as recorded": {}, "compensated": {}}
    changed: dict[str, list[Score]] = {}
    online: list[AhrsEstimate] = []
    for k, recording in enumerate(read):
        for treatment, each in scores.items():
            by_filter, estimates = compared(recording, None if treatment == "as recorded" else late)
            for name, score in by_filter.items():
                each.setdefault(name, []).append(score)
        online.append(estimates[0])
        for name, other in modified(recording).items():
            parameters = replace(HAND_HELD, hard_iron_sigma=0.0) if "no states" in name else None
            changed.setdefault(name.split(" at ")[0], []).append(ours(other, late, parameters)[1])
        if progress is not None:
            progress(f"{k + 1} of {len(read)}: {recording.source}")
    result = Result(
        recordings=tuple(Path(recording.source).stem for recording in read),
        scores=scores,
        left_out={name: leave_one_out(read, late, name == "smoothed") for name in ("online", "smoothed")},
        modified=changed,
        latencies=np.array([gyro_latency(recording)[0] for recording in read]),
        figures=(),
    )
    if out is None:
        return result
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    worst = np.argsort([-score.errors[0] for score in scores["compensated"]["strapdown"]])[:2]
    figures = (
        draw(result, folder / "hand_held.png"),
        draw_worst([online[k] for k in worst], folder / "hand_held_worst.png"),
    )
    (folder / "hand_held.txt").write_text(table(result) + "\n", encoding="utf-8")
    content = {
        "recordings": list(result.recordings),
        "parameters": asdict(HAND_HELD),
        "latency_ms": 1e3 * late,
        "gyro_latency_ms": (1e3 * result.latencies).tolist(),
        "scores": {
            treatment: {name: [_plain(score) for score in each] for name, each in some.items()}
            for treatment, some in {**scores, "modified": changed}.items()
        },
        "left_out_total_rad": {name: errors.tolist() for name, errors in result.left_out.items()},
    }
    write_json(folder / "hand_held.json", content)
    return replace(result, figures=figures)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", metavar="RECORDING", help="BROAD files; none: simulated recordings")
    parser.add_argument("--runs", type=int, default=12, help="number of simulated recordings")
    parser.add_argument("--duration", type=float, default=60.0, help="duration of a simulated recording, s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--latency", type=float, default=4.1, help="delay of the gyro and the accelerometer, ms")
    parser.add_argument("--out", type=Path, default=Path("results/hand_held"))
    print(table(main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))))
