"""How much better is the attitude of a unit in the hand for knowing that a hand's velocity is bounded? On BROAD files or simulated.

An accelerometer shows the vertical and whatever the hand does. The same recordings go through one filter with three beliefs of the hand's
acceleration, one set of numbers for all recordings:

- white, as large and as lasting as makes the filter robust: :class:`strapdown.ahrs.AhrsParameters` as they are;
- coloured, first order (:class:`strapdown.augmented.GaussMarkov`), which lasts and so passes for tilt;
- the derivative of a bounded velocity (:class:`strapdown.augmented.BoundedVelocity`): half a metre a second that lasts 0.3 s, pushes of
  0.1 s, so 2.9 m/s².

All but the first start from the gyro bias of the quiet second at the start, which "white, bias of the quiet second" has too, so that the
beliefs can be compared. Beside them the smoother, and VQF and offline VQF where the package ``vqf`` is installed.

Without recordings the unit is simulated: at rest for two seconds, then turned and moved about on smooth paths that are not the filter's own
model. Told is the RMS error against the reference over the movement, total, heading and inclination, as the BROAD benchmark has it.

Run ``python sims/hand_held.py [--out FOLDER] [RECORDING...]``, recordings being files of the BROAD data set.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from strapdown import ahrs, augmented, mekf, plots, quaternion, recordings
from strapdown.ahrs import AhrsParameters
from strapdown.augmented import BoundedVelocity, GaussMarkov
from strapdown.checks import Array, InputError
from strapdown.consistency import reference_errors
from strapdown.files import write_json
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.plots import style
from strapdown.randomness import generator
from strapdown.recordings import Recording
from strapdown.units import DEGREE

WHITE = AhrsParameters()
QUIET = replace(WHITE, bias_sigma=0.05 * DEGREE)
"""The same, where the mean rate of the quiet second is the bias: so well it is known, with what flickers and what a hand still turns."""
MOVED = replace(QUIET, specific_force_sigma=1.0)
"""What is left of the accelerometer beside a modelled hand: vibration, its own errors where it is shaken."""
COLOURED = GaussMarkov(
    sensor="accelerometer", noise_sigma=2.9, correlation_time=0.1, frame="fixed", unit="m/s²", name="acceleration"
)
BOUNDED = BoundedVelocity(
    sensor="accelerometer", velocity_sigma=0.5, velocity_time=0.3, acceleration_time=0.1, strength=1.0
)
PARTS = ("total", "heading", "inclination")
COLOURS = {
    "white": style.SKY,
    "white, bias of the quiet second": style.BLUE,
    "coloured": style.PURPLE,
    "bounded velocity": style.VERMILION,
    "bounded velocity, smoother": style.ORANGE,
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
    errors: Array
    """(recordings, filters, 3): total, heading, inclination, rad."""
    figures: tuple[Path, ...]

    def mean(self, name: str) -> Array:
        """Return the mean over the recordings of one filter (3,), rad."""
        return np.asarray(self.errors[:, self.filters.index(name)].mean(axis=0))


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
    paths = np.zeros((len(time), 3))
    swell = 1.0 - np.exp(-0.5 * since**3)
    for f in (0.3, 0.7, 1.1, 1.9):
        size = 0.25 / (2.0 * np.pi * f) * random.standard_normal(3)
        paths += size * np.sin(2.0 * np.pi * f * since[:, None] + random.uniform(0.0, 2.0 * np.pi, 3))
    paths *= swell[:, None]
    acceleration = np.zeros_like(paths)
    acceleration[1:-1] = np.diff(paths, 2, axis=0) * RATE**2
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


def start(used: Recording, quiet: slice, parameters: AhrsParameters) -> mekf.State:
    """Return the state at the quiet second, its mean rate taken for the bias."""
    state = ahrs.start(used, quiet, parameters)
    return mekf.initial_state(
        state.attitude,
        bias=used.rate[quiet].mean(axis=0),
        attitude_sigma=parameters.attitude_sigma,
        bias_sigma=parameters.bias_sigma,
    )


def estimate(
    recording: Recording, parameters: AhrsParameters, *blocks: augmented.Block, smooth: bool = False
) -> tuple[Recording, Array]:
    """Return the recording from its first quiet second on, and the attitude by these beliefs."""
    span = ahrs.quiet_span(recording)
    used, quiet = recording.since(span.start), slice(0, span.stop - span.start)
    noise = mekf.ProcessNoise(
        angle_random_walk=parameters.angle_random_walk, rate_random_walk=parameters.rate_random_walk
    )
    face = augmented.smooth if smooth else augmented.run
    found = face(ahrs.imu_record(used, quiet, parameters), noise, start(used, quiet, parameters), blocks)
    return used, found.attitude


def estimates(recording: Recording) -> dict[str, tuple[Recording, Array]]:
    """Return the attitudes of every filter, each beside the part of the recording that it is of."""
    plain = ahrs.estimate(recording, WHITE)
    found = {
        "white": (plain.recording, plain.estimate.attitude),
        "white, bias of the quiet second": estimate(recording, QUIET),
        "coloured": estimate(recording, MOVED, COLOURED),
        "bounded velocity": estimate(recording, MOVED, BOUNDED),
        "bounded velocity, smoother": estimate(recording, MOVED, BOUNDED, smooth=True),
    }
    return {**found, **{name: (plain.recording, q) for name, q in peers(plain.recording).items()}}


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
    return "\n".join(lines)


def main(
    files: Sequence[str | os.PathLike[str]] = (),
    *,
    runs: int = 12,
    duration: float = 60.0,
    seed: int = 1,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Result:
    """Compare the beliefs on recordings with a reference, or on ``runs`` simulated ones of ``duration`` s.

    Figure, table and JSON are written to ``out`` if it is given; ``progress`` is told what is done.
    """
    sources = len(files) or runs
    names, errors, filters = [], [], ()
    for k in range(sources):
        recording = recordings.read(files[k]) if files else simulated(seed, k, duration)
        if recording.true_attitude is None:
            raise InputError(f"{recording.source} has no reference attitude to compare with; give BROAD files")
        found = estimates(recording)
        names.append(Path(recording.source).stem)
        filters = tuple(found)
        rows = [reference_errors(q, used.true_attitude).rms(used.movement) for used, q in found.values()]  # type: ignore[arg-type]
        errors.append([[row[part] for part in PARTS] for row in rows])
        if progress is not None:
            progress(f"{k + 1} of {sources}: {recording.source}")
    result = Result(recordings=tuple(names), filters=filters, errors=np.array(errors), figures=())
    if out is None:
        return result
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    result = replace(result, figures=(draw(result, folder / "hand_held.png"),))
    (folder / "hand_held.txt").write_text(table(result) + "\n", encoding="utf-8")
    told = {
        "recordings": list(result.recordings),
        "parameters": asdict(MOVED),
        "velocity": {
            name: getattr(BOUNDED, name)
            for name in ("velocity_sigma", "velocity_time", "acceleration_time", "acceleration_sigma")
        },
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
    parser.add_argument("--out", type=Path, default=Path("results/hand_held"))
    print(table(main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))))
