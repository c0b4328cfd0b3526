"""How accurate is the attitude of a hand-held unit with faults, and is its σ right? On BROAD files or simulated, online and smoothed.

The recordings are processed by ``strapdown estimate``'s filter and smoother, as recorded and modified: a clipped gyro, dropouts, lost rows,
repeated stamps, no magnetometer, no rest at the start, hard iron. Measure and regions are those of ``benchmarks/recordings.py``, which
compares the filter with others: RMS error over the movement, one constant heading offset removed, and the share of the movement in which
the filter's own 95 % region contains the error. Without a magnetometer only the inclination is defined.

The gyro's samples are some milliseconds later than the reference (:func:`gyro_latency`, 4.1 ms in BROAD), which is not observable from a
recording without one.

Without recordings the unit is simulated: at rest for two seconds, then rotated and moved on smooth paths that differ from the filter's
model. Run ``python sims/hand_held.py [--out FOLDER] [RECORDING...]``; the recordings are files of the BROAD data set.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import strapdown
from benchmarks import recordings as leaderboard
from strapdown import quaternion, recordings
from strapdown.checks import Array, InputError
from strapdown.files import write_json
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.randomness import generator
from strapdown.recordings import Recording
from strapdown.records.recording import with_gyro
from strapdown.results import Column, Table
from strapdown.units import DEGREE

RATE = 200.0
"""Sample rate of the simulated unit, Hz."""

SMALL = {"runs": 2, "duration": 12.0}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Scores of the filter and of the smoother."""

    recordings: tuple[str, ...]
    scores: dict[str, dict[str, leaderboard.Score]]
    """Means over the recordings by modification, "online" and "smoothed"."""
    latencies: Array
    """Delay of the gyro relative to the reference (recordings,), s."""


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


def gyro_latency(recording: Recording) -> float:
    """Return the delay of the gyro's samples after the reference attitude, s.

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
    turn = quaternion.rotation_between(q[centre - reach], q[centre + reach])
    wanted = turn / (time[centre + reach] - time[centre - reach])[:, None]
    whole = CubicSpline(time, np.vstack([np.zeros(3), np.cumsum(recordings.increments(recording), axis=0)]))

    def left(shift: float) -> float:
        after, before = time[centre + reach], time[centre - reach]
        rate = (whole(after + shift) - whole(before + shift)) / (after - before)[:, None]
        model = np.column_stack([rate, np.ones(len(rate))])
        error = wanted - model @ np.linalg.lstsq(model, wanted, rcond=None)[0]
        return float(np.sqrt(np.median(np.sum(error**2, axis=1))))

    return float(minimize_scalar(left, bounds=(-0.03, 0.03), method="bounded", options={"xatol": 1e-5}).x)


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
        "a gyro axis clipped at 60 %": replace(recording, rate=clipped),
        "three dropouts of 0.3 s": recording.taken(kept),
        "a fifth of the rows lost": recording.taken(random.random(n) > 0.2),
        "no magnetometer": replace(recording, magnetic_field=None),
        "no rest": recording.taken(np.arange(n)[begin : moving[-1]]),
        "4 % of hard iron": ironed,
        "repeated stamps": _stamped_again(recording, np.unique(random.integers(1, n, n // 300))),
    }


def _stamped_again(recording: Recording, rows: np.ndarray) -> Recording:
    """Return the recording as read from a file in which these rows repeat the stamps of the rows before."""
    time = recording.time.copy()
    time[rows] = recording.time[rows - 1]
    names = ("specific_force", "magnetic_field", "true_attitude", "movement")
    columns = {name: getattr(recording, name) for name in names}
    return with_gyro(source=recording.source, time=time, rate=recording.rate, **columns)


def main(
    files: Sequence[str | os.PathLike[str]] = (),
    *,
    runs: int = 12,
    duration: float = 60.0,
    seed: int = 1,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> Result:
    """Score filter and smoother on recordings with a reference, or on ``runs`` simulated ones of ``duration`` s.

    Table and JSON are written to ``out`` if it is given; ``progress`` is called with a line for each recording.
    """
    units = [strapdown.read(file) for file in files] or [simulated(seed, k, duration) for k in range(runs)]
    scores: dict[str, dict[str, list[leaderboard.Score]]] = {}
    for k, unit in enumerate(units):
        if unit.true_attitude is None:
            raise InputError(f"{unit.source} has no reference attitude to compare with; give BROAD files")
        for name, recording in {"as recorded": unit, **modified(unit)}.items():
            for mode in ("online", "smoothed"):
                score = leaderboard.score(recording, partial(leaderboard.ours, smooth=mode == "smoothed"))
                scores.setdefault(name, {}).setdefault(mode, []).append(score)
        progress(f"{k + 1} of {len(units)}: {unit.source}")
    result = Result(
        recordings=tuple(Path(unit.source).stem for unit in units),
        scores={name: {mode: leaderboard.mean(each) for mode, each in by.items()} for name, by in scores.items()},
        latencies=np.array([gyro_latency(unit) for unit in units]),
    )
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "hand_held.txt").write_text(table(result).text + "\n", encoding="utf-8")
        write_json(folder / "hand_held.json", {**asdict(result), "latencies": result.latencies.tolist()})
    return result


def table(result: Result) -> Table:
    """Return errors and coverages as a table."""
    rows = []
    for name, by_mode in result.scores.items():
        cells: list[float | str] = []
        for score in by_mode.values():
            assert score.error_deg is not None
            assert score.coverage is not None
            total, held = ("", "") if name == "no magnetometer" else (score.error_deg[0], score.coverage[0])
            cells += [total, score.error_deg[2], held, score.coverage[2]]
        rows.append((name, *cells))
    columns = [
        Column(f"{mode} {part}", digits=3)
        for mode in ("online", "smoothed")
        for part in ("total, °", "inclination, °", "total, in region", "inclination, in region")
    ]
    late = 1e3 * result.latencies
    note = f"Gyro after the reference: {late.min():.2f} to {late.max():.2f} ms, mean {late.mean():.2f} ms."
    return Table(f"RMS error over the movement, {len(result.recordings)} recordings", ["", *columns], rows, [note])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", metavar="RECORDING", help="BROAD files; none: simulated recordings")
    parser.add_argument("--runs", type=int, default=12, help="number of simulated recordings")
    parser.add_argument("--duration", type=float, default=60.0, help="duration of a simulated recording, s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/hand_held"))
    print(table(main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))).text)
