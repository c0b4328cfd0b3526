"""How much better is the attitude of a unit in the hand for knowing how a hand moves? On BROAD files or simulated.

An accelerometer shows the vertical and whatever the hand does. The same recordings go through one filter with several beliefs of the hand's
acceleration, one set of numbers for all recordings:

- white, as large and as lasting as makes the filter robust: ``ahrs.MOTIONS["any"]``;
- the same, which starts from the gyro bias that the quiet second shows, as all further ones do;
- coloured, first order (:class:`strapdown.error_states.GaussMarkov`), which lasts and so passes for tilt;
- the derivative of a bounded velocity (:class:`strapdown.error_states.BoundedVelocity`);
- hand held: that, with scale factors and misalignments of the gyro as states: :data:`strapdown.ahrs.HAND_HELD`, what
  ``strapdown estimate`` believes if not told otherwise.

Beside them the smoother of the last, and VQF and offline VQF where the package ``vqf`` is installed.

Samples come after what they show, each sensor's by its own delay. :func:`gyro_latency` finds that of the gyro beside the reference, without
any filter: about 4.1 ms in each of eleven trials of BROAD. Of a fast body that is degrees, for every filter alike, unless it is told
(``--latency``). (VQF takes the rate of an interval from the sample at its end, the trapezoid rule from both ends: VQF lags half a sample
less.) How late the magnetometer is beside the gyro, 11 ms, a recording shows by itself (:func:`strapdown.ahrs.magnetometer_latency`), and
the beliefs here take it into account; VQF takes the samples as they are.

Without recordings the unit is simulated: at rest for two seconds, then turned and moved about on smooth paths that are not the filter's own
model. Told is the RMS error against the reference over the movement, total, heading and inclination, as the BROAD benchmark has it.

Run ``python sims/hand_held.py [--latency MS] [--out FOLDER] [RECORDING...]``, recordings being files of the BROAD data set.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from strapdown import ahrs, estimation, plots, quaternion, recordings
from strapdown.ahrs import HAND_HELD
from strapdown.checks import Array, InputError
from strapdown.consistency import reference_errors
from strapdown.estimation.error_states import GaussMarkov
from strapdown.files import write_json
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.plots import style
from strapdown.randomness import generator
from strapdown.recordings import Recording
from strapdown.units import DEGREE

WHITE = ahrs.MOTIONS["any"]
QUIET = replace(WHITE, rest_bias_sigma=HAND_HELD.rest_bias_sigma)
BOUNDED = replace(HAND_HELD, gyro_scale_sigma=0.0)
COLOURED = GaussMarkov(
    sensor="accelerometer", noise_sigma=2.9, correlation_time=0.1, frame="fixed", unit="m/s²", name="acceleration"
)
"""Acceleration of the same σ and of the same spectrum at high frequency as that of the bounded velocity."""
PARTS = ("total", "heading", "inclination")
COLOURS = {
    "white": style.SKY,
    "white, bias of the quiet second": style.BLUE,
    "coloured": style.PURPLE,
    "bounded velocity": style.VERMILION,
    "hand held": style.ORANGE,
    "hand held, smoother": style.YELLOW,
    "VQF": style.GREEN,
    "offline VQF": "0.5",
}
RATE = 200.0
"""Of the simulated unit, Hz."""

SMALL = {"runs": 2, "duration": 12.0}
"""Arguments of a run that only shows that the script works."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """RMS errors over the movement."""

    recordings: tuple[str, ...]
    filters: tuple[str, ...]
    latencies: Array
    """Of the gyro beside the reference (recordings,), s."""
    errors: Array
    """(recordings, filters, 3): total, heading, inclination, rad."""
    figures: tuple[Path, ...]

    def mean(self, name: str) -> Array:
        """Return the mean over the recordings of one filter (3,), rad."""
        return np.asarray(self.errors[:, self.filters.index(name)].mean(axis=0))


def swelling(t: Array, w: float, phase: Array) -> tuple[Array, Array]:
    """Return a sine that swells from nothing, ``sin(ωt + φ) (1 − exp(−t³/2))``, and its second derivative."""
    fading = np.exp(-0.5 * t**3)
    swell, growth, bend = 1.0 - fading, 1.5 * t**2 * fading, (3.0 * t - 2.25 * t**4) * fading
    sine, cosine = np.sin(w * t + phase), np.cos(w * t + phase)
    return sine * swell, (bend - w**2 * swell) * sine + 2.0 * w * growth * cosine


def simulated(seed: int, run: int, duration: float) -> Recording:
    """Return two seconds of rest, then a unit turned by some rad/s and moved by decimetres, as a consumer-grade unit gives it."""
    random = generator(seed, run, "hand")
    time = np.arange(round((2.0 + duration) * RATE) + 1) / RATE
    turns = HarmonicRates(
        harmonics=tuple(
            Harmonic(amplitude=1.2 * random.standard_normal(3), frequency=f, phase=random.uniform(0.0, 2.0 * np.pi))
            for f in (0.23, 0.41, 0.67)
        )
    )
    # Time since the movement began, as it is for a body that starts smoothly.
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
    """Return the recording as the filter takes it, and the attitude by the belief that the acceleration is coloured."""
    plain = ahrs.estimate(recording, replace(BOUNDED, velocity_sigma=0.0), latency=latency)
    used = plain.recording
    quiet = ahrs.quiet_span(used)
    found = estimation.run(
        ahrs.imu_record(used, quiet, BOUNDED), BOUNDED.setup.process_noise, plain.initial, (COLOURED,)
    )
    return used, found.attitude


def estimates(recording: Recording, latency: float) -> dict[str, tuple[Recording, Array]]:
    """Return the attitudes of every filter, each beside the part of the recording that it is of."""
    found = {}
    for name, parameters in (
        ("white", WHITE),
        ("white, bias of the quiet second", QUIET),
        ("bounded velocity", BOUNDED),
        ("hand held", HAND_HELD),
        ("hand held, smoother", HAND_HELD),
    ):
        result = ahrs.estimate(recording, parameters, latency=latency, smooth="smoother" in name)
        found[name] = (result.recording, result.estimate.attitude)
    found["coloured"] = coloured(recording, latency)
    begin = int(np.searchsorted(recording.time, found["white"][0].time[0]))
    used = ahrs.aligned(recording, latency).since(begin)
    found |= {name: (used, q) for name, q in peers(used).items()}
    return {name: found[name] for name in COLOURS if name in found}


def gyro_latency(recording: Recording) -> tuple[float, float]:
    """Return how long after the reference attitude's the gyro's samples show a rate, s, and the gyro's error left, RMS, rad/s.

    The turn of the reference over four samples, beside that of the gyro over as long an interval shifted by what is sought, scale,
    misalignment and bias fitted; no filter has part in it.
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

    found = minimize_scalar(left, bounds=(-0.03, 0.03), method="bounded", options={"xatol": 1e-5})
    return float(found.x), float(found.fun)


def peers(used: Recording) -> dict[str, Array]:
    """Return what VQF makes of a recording whose samples are all there; nothing without the package."""
    try:
        import vqf
    except ImportError:
        return {}
    if used.magnetic_field is None or used.specific_force is None:
        return {}
    interval = float(np.median(np.diff(used.time)))
    samples = [np.ascontiguousarray(each) for each in (used.rate, used.specific_force, used.magnetic_field)]
    return {
        "VQF": vqf.VQF(interval).updateBatch(*samples)["quat9D"],
        "offline VQF": vqf.offlineVQF(*samples, interval)["quat9D"],
    }


def draw(result: Result, path: Path) -> Path:
    """Draw the errors of every recording by filter, and their means, and write the figure."""
    figure, axes = plots.new_figure(1, 2, size=(13.0, 5.6))
    places = np.arange(len(result.recordings) + 1)
    for axis, part in zip(axes, (2, 0), strict=True):
        values = result.errors[:, :, part] / DEGREE
        for k, name in enumerate(result.filters):
            shift = 0.1 * (k - 0.5 * (len(result.filters) - 1))
            each = np.append(values[:, k], values[:, k].mean())
            marker = "D" if "VQF" in name else "o"
            axis.plot(places + shift, each, marker, markersize=5.0, color=COLOURS[name], label=name)
        axis.set(yscale="log", ylabel="RMS error over the movement, °", title=PARTS[part].capitalize())
        ticks = [
            t
            for t in (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0)
            if values.min() / 1.5 < t < 1.5 * values.max()
        ]
        axis.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axis.set_yticks([], minor=True)
        axis.set_xticks(places, [*_heads(result), "mean"])
        axis.set_xlabel("recording")
        axis.axvspan(places[-1] - 0.5, places[-1] + 0.5, color="0.93", zorder=0)
        for place in places[:-2]:
            axis.axvline(place + 0.5, color="0.85", linewidth=0.6, zorder=0)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return plots.save(figure, path)


def _heads(result: Result) -> list[str]:
    """Return short names: the number of a trial of BROAD, or of a simulated recording."""
    return [name[:2] if name[:2].isdigit() else name.split()[-1][:8] for name in result.recordings]


def table(result: Result) -> str:
    """Return the figures as text: total and inclination by recording, and the means."""
    width = max(len(name) for name in result.filters)
    lines = [f"{'RMS error, °':{width}s}  {' '.join(f'{head:>6s}' for head in _heads(result))} {'mean':>7s}"]
    for part in (0, 1, 2):
        lines.append(f"{PARTS[part]}:")
        for k, name in enumerate(result.filters):
            each = result.errors[:, k, part] / DEGREE
            lines.append(f"{name:{width}s}  {' '.join(f'{value:6.2f}' for value in each)} {each.mean():7.2f}")
    late = 1e3 * result.latencies
    lines.append(f"{'latency of the gyro, ms':{width}s}  {' '.join(f'{one:6.2f}' for one in late)} {late.mean():7.2f}")
    return "\n".join(lines)


def main(
    files: Sequence[str | os.PathLike[str]] = (),
    *,
    runs: int = 12,
    duration: float = 60.0,
    seed: int = 1,
    latency: float = 0.0,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Result:
    """Compare the beliefs on recordings with a reference, or on ``runs`` simulated ones of ``duration`` s; ``latency`` in ms.

    Figure, table and JSON are written to ``out`` if it is given; ``progress`` is told what is done.
    """
    sources = len(files) or runs
    names, errors, latencies, filters = [], [], [], ()
    for k in range(sources):
        recording = recordings.read(files[k]) if files else simulated(seed, k, duration)
        if recording.true_attitude is None:
            raise InputError(f"{recording.source} has no reference attitude to compare with; give BROAD files")
        found = estimates(recording, 1e-3 * latency)
        latencies.append(gyro_latency(recording)[0])
        names.append(Path(recording.source).stem)
        filters = tuple(found)
        rows = [reference_errors(q, used.true_attitude).rms(used.movement) for used, q in found.values()]  # type: ignore[arg-type]
        errors.append([[row[part] for part in PARTS] for row in rows])
        if progress is not None:
            progress(f"{k + 1} of {sources}: {recording.source}")
    result = Result(
        recordings=tuple(names), filters=filters, latencies=np.array(latencies), errors=np.array(errors), figures=()
    )
    if out is None:
        return result
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    result = replace(result, figures=(draw(result, folder / "hand_held.png"),))
    (folder / "hand_held.txt").write_text(table(result) + "\n", encoding="utf-8")
    told = {
        "recordings": list(result.recordings),
        "parameters": asdict(HAND_HELD),
        "latency_ms": latency,
        "gyro_latency_ms": (1e3 * result.latencies).tolist(),
        "rms_error_deg": {
            name: {part: (result.errors[:, k, p] / DEGREE).tolist() for p, part in enumerate(PARTS)}
            for k, name in enumerate(result.filters)
        },
    }
    write_json(folder / "hand_held.json", told)
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", metavar="RECORDING", help="BROAD files; none: simulated recordings")
    parser.add_argument("--runs", type=int, default=12, help="simulated recordings")
    parser.add_argument("--duration", type=float, default=60.0, help="of a simulated recording, s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--latency", type=float, default=0.0, help="of the gyro and the accelerometer, ms")
    parser.add_argument("--out", type=Path, default=Path("results/hand_held"))
    print(table(main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))))
