"""Attitude filters on sets of recordings with a reference: ``python benchmarks/recordings.py [--json FILE | --time] FOLDER...``.

A folder is a set: files that :func:`strapdown.read` reads with their reference. A filter is one function of a recording (:data:`FILTERS`);
peers that are not installed are left out. The error is RMS over the movement, one constant heading offset of each recording removed, so
that declination and the reference's own heading do not count; of the total rotation, its heading and its inclination. Figures of a set are
means over its recordings:

- *coverage*: share of the movement in which the filter's own 95 % region contains the error: total, heading, inclination;
- *NEES* per degree of freedom, median over the recordings;
- *rows*: share of the samples that have an attitude, of the recording with the least;
- µs of processor time per sample.

With ``--common-offset`` the heading offset is one of each set, the median of those of its recordings, so that the constant error of a
heading counts, which the filter's σ includes: for sets with one reference frame.

With ``--time`` only the time is measured: the least of several runs on each recording, the filters in turn, and relative to VQF.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import strapdown as sd
from benchmarks import timing
from strapdown import quaternion
from strapdown.checks import Array
from strapdown.files import write_json
from strapdown.recordings import Recording
from strapdown.records import Estimate, Truth

Filter = Callable[[Recording], tuple[Array, Array | None]]
"""Attitude (n, 4), body to a frame with z up, and, if the filter has it, covariance (n, 3, 3) of the error in body axes, rad²."""
PARTS = ("total", "heading", "inclination")


def ours(recording: Recording, *, smooth: bool = False) -> tuple[Array, Array]:
    """Return the estimate of this package at the stamps of the recording."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        estimate = (sd.smooth if smooth else sd.estimate)(recording, full_covariance=True)
    assert estimate.covariance is not None
    return estimate.attitude, estimate.covariance[:, :3, :3]


def samples(recording: Recording) -> tuple[float, list[Array]]:
    """Return the interval, s, and the samples of the sensors."""
    sensors = (recording.rate, recording.specific_force, recording.magnetic_field)
    return recording.interval, [np.ascontiguousarray(x) for x in sensors if x is not None]


def vqf(recording: Recording, *, offline: bool = False, gain: float = 1.0) -> tuple[Array, None]:
    """Return the attitude of VQF, with a magnetometer 9D, or of offline VQF; the gain divides the time constants of VQF."""
    from vqf import VQF, offlineVQF

    interval, sensors = samples(recording)
    name = "quat9D" if len(sensors) == 3 else "quat6D"
    if not offline:
        return np.asarray(VQF(interval, tauAcc=3.0 / gain, tauMag=9.0 / gain).updateBatch(*sensors)[name]), None
    return np.asarray(offlineVQF(*sensors, *([None] * (3 - len(sensors))), interval)[name]), None


def imufusion(recording: Recording, *, gain: float = 1.0) -> tuple[Array, None]:
    """Return the attitude of imufusion with the settings of its documentation, the gain a multiple of theirs."""
    from imufusion import CONVENTION_ENU, Ahrs, AhrsSettings

    interval, (rate, force, *field) = samples(recording)
    settings = AhrsSettings()
    settings.sample_rate, settings.convention, settings.gain = 1.0 / interval, CONVENTION_ENU, 0.5 * gain
    settings.gyroscope_range, settings.rejection_timeout = 2000.0, 5.0
    settings.acceleration_rejection = settings.magnetic_rejection = 10.0
    ahrs = Ahrs()
    ahrs.set_settings(settings)
    attitude = np.empty((len(rate), 4))
    update = ahrs.update if field else ahrs.update_no_magnetometer
    for k, each in enumerate(zip(np.degrees(rate), force / 9.81, *field, strict=True)):
        update(*each)
        attitude[k] = ahrs.get_quaternion()
    return attitude, None


def madgwick(recording: Recording, *, gain: float = 1.0) -> tuple[Array, None]:
    """Return the attitude of Madgwick's filter (package ``ahrs``), East-North-Up; the gain is a multiple of its default."""
    from ahrs.filters import Madgwick

    interval, sensors = samples(recording)
    named = dict(zip(("gyr", "acc", "mag"), sensors, strict=False))
    default = 0.041 if "mag" in named else 0.033
    quarter = quaternion.exp([0.0, 0.0, 0.5 * np.pi])  # its own x axis points North
    return quaternion.multiply(quarter, Madgwick(**named, Dt=interval, gain=gain * default).Q), None


FILTERS: dict[str, tuple[str, Filter]] = {
    "estimate": ("strapdown", ours),
    "estimate --smooth": ("strapdown", lambda recording: ours(recording, smooth=True)),
    "VQF": ("vqf", vqf),
    "offline VQF": ("vqf", lambda recording: vqf(recording, offline=True)),
    "imufusion": ("imufusion", imufusion),
    "Madgwick": ("ahrs", madgwick),
}
"""The package that each filter needs, and its function."""


@dataclass(frozen=True)
class Score:
    """Score of a filter on a recording, or on a set of them."""

    error_deg: tuple[float, float, float] | None
    """RMS of the total, the heading and the inclination; None if no row is judged."""
    coverage: tuple[float, float, float] | None
    nees: float | None
    rows: float
    us: float
    offset_deg: float | None = None
    """Heading offset that was removed."""


def score(recording: Recording, run: Filter) -> Score:
    """Return the score of a filter on a recording, with its mean heading offset removed."""
    return score_of(recording, *timed(recording, run))


def timed(recording: Recording, run: Filter) -> tuple[Array, Array | None, float]:
    """Return attitude and covariance of a filter on a recording, and its time per sample, µs."""
    begin = time.process_time()
    attitude, covariance = run(recording)
    return attitude, covariance, 1e6 * (time.process_time() - begin) / len(recording.time)


def score_of(
    recording: Recording, attitude: Array, covariance: Array | None, us: float, offset: float | None = None
) -> Score:
    """Return the score of attitudes of a recording, over the movement where reference and attitude are known.

    ``offset``: of the heading, rad, to be removed; its own mean by default.
    """
    known = np.isfinite(attitude).all(axis=1)
    rows = float(np.mean(known))
    assert recording.true_attitude is not None
    judged = known & np.isfinite(recording.true_attitude).all(axis=1)
    if recording.movement is not None:
        judged &= recording.movement
    if not judged.any():
        return Score(None, None, None, rows, us)
    q, reference = attitude[judged], recording.true_attitude[judged]
    d = quaternion.multiply(q, quaternion.conjugate(reference))
    if offset is None:
        offset = float(np.angle(np.mean(np.exp(2j * np.arctan2(d[:, 3], d[:, 0])))))
    P = np.full((len(q), 3, 3), np.nan) if covariance is None else covariance[judged]
    turned = quaternion.multiply(quaternion.exp([0.0, 0.0, -offset]), q)
    estimate = Estimate.from_arrays(recording.time[judged], turned, P)
    sizes = sd.accuracy(estimate, Truth(attitude=reference)).given["all samples"]
    error_deg = tuple(np.degrees([size.rms for size in sizes.values()]).tolist())
    own = (None, None)
    if covariance is not None:
        own = tuple(size.coverage for size in sizes.values()), sizes["total"].rms_over_sigma ** 2
    return Score(error_deg, *own, rows, us, math.degrees(offset))


def read(folder: Path) -> list[Recording]:
    """Return the recordings of a folder."""
    files = [
        sd.read(path) for path in sorted(folder.iterdir()) if path.suffix in (".hdf5", ".h5", ".csv", ".bag", ".mcap")
    ]
    return [
        recording for recording in files if isinstance(recording, Recording) and recording.true_attitude is not None
    ]


def mean(scores: Sequence[Score]) -> Score:
    """Return the score of a set."""
    judged = [score for score in scores if score.error_deg is not None]
    with_region = [score for score in judged if score.coverage is not None]

    def over(name: str, those: Sequence[Score]) -> tuple[float, float, float] | None:
        return tuple(np.mean([getattr(score, name) for score in those], axis=0).tolist()) if those else None

    return Score(
        over("error_deg", judged),
        over("coverage", with_region),
        float(np.median([score.nees for score in with_region])) if with_region else None,
        min(score.rows for score in scores),
        float(np.mean([score.us for score in scores])),
    )


def print_times(folders: Sequence[Path], names: Sequence[str]) -> None:
    """Print the time of each filter on each recording."""
    for folder in folders:
        for recording in read(folder):
            works = {name: (partial(FILTERS[name][1], recording), len(recording.time)) for name in names}
            print(f"{folder.name}, {Path(recording.source).stem}, {len(recording.time)} samples")
            print(timing.table(timing.least(works), "VQF" if "VQF" in names else names[0]).text, flush=True)


def table(result: dict[str, Any]) -> str:
    """Return scores as a table in Markdown: error of the total and, of this package, coverage of its region."""
    columns = [("estimate", "error_deg"), ("estimate", "coverage"), ("VQF", "error_deg"), ("imufusion", "error_deg")]
    columns += [("Madgwick", "error_deg"), ("estimate --smooth", "error_deg"), ("estimate --smooth", "coverage")]
    columns += [("offline VQF", "error_deg")]
    head = ["set, recordings", *(f"`{name}`" if "estimate" in name else name for name, _ in columns)]
    head = [
        words if what != "coverage" else "95 % region"
        for words, (_, what) in zip(head, [("", ""), *columns], strict=True)
    ]
    rows = [head, ["---"] * len(head)]
    for where, number in result["sets"].items():
        values = [(result["filters"].get(name, {}).get(where, {}).get(what), what) for name, what in columns]
        cells = ["" if v is None else f"{v[0]:.2f}" if what == "coverage" else f"{v[0]:.3g}" for v, what in values]
        rows.append([f"{where}, {number}", *cells])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def scores_of(recordings: Sequence[Recording], run: Filter, *, common_offset: bool) -> list[Score]:
    """Return the scores of a filter on the recordings of a set, with a heading offset of each or of all."""
    runs = [timed(recording, run) for recording in recordings]
    own = [score_of(recording, *result) for recording, result in zip(recordings, runs, strict=True)]
    if not common_offset:
        return own
    unit = np.exp(1j * np.radians([each.offset_deg for each in own if each.offset_deg is not None]))
    common = math.atan2(np.median(unit.imag), np.median(unit.real))
    return [score_of(recording, *result, common) for recording, result in zip(recordings, runs, strict=True)]


def main(
    folders: Sequence[Path],
    names: Sequence[str],
    known: dict[str, Any] | None = None,
    *,
    common_offset: bool = False,
) -> dict[str, Any]:
    """Return the scores of filters on sets, added to those known, and print each as soon as it is known."""
    result: dict[str, Any] = {"metric": " ".join(__doc__.split("\n\n")[1].split()), "sets": {}, "filters": {}}
    result.update({key: dict(value) for key, value in (known or {}).items() if key in ("sets", "filters")})
    for folder in folders:
        recordings = read(folder)
        result["sets"][folder.name] = len(recordings)
        for name in names:
            whole = mean(scores_of(recordings, FILTERS[name][1], common_offset=common_offset))
            result["filters"].setdefault(name, {})[folder.name] = asdict(whole)
            words = [f"{folder.name} ({len(recordings)})".ljust(14), name.ljust(18)]
            for values in (whole.error_deg, whole.coverage):
                words.append(("" if values is None else "/".join(f"{x:.2f}" for x in values)).rjust(18))
            words.append("    " if whole.nees is None else f"{whole.nees:4.2f}")
            print(*words, f"{whole.rows:.3f} {whole.us:6.2f}", flush=True)
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--filters", nargs="+", choices=FILTERS, default=list(FILTERS))
    parser.add_argument("--json", type=Path, help="file of the results; those of other sets and filters in it are kept")
    parser.add_argument("--common-offset", action="store_true", help="remove one heading offset of each set")
    parser.add_argument("--time", action="store_true", help="measure only the time")
    arguments = parser.parse_args()
    installed = [name for name in arguments.filters if importlib.util.find_spec(FILTERS[name][0])]
    if arguments.time:
        print_times(arguments.folders, installed)
        raise SystemExit
    print(f"{'set':14s} {'filter':18s} {'error, deg':>18s} {'coverage':>18s} NEES  rows     µs")
    held = json.loads(arguments.json.read_text()) if arguments.json and arguments.json.exists() else None
    scores = main(arguments.folders, installed, held, common_offset=arguments.common_offset)
    print(table(scores))
    if arguments.json:
        write_json(arguments.json, scores)
