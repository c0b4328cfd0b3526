"""How do attitude filters compare on the same records? The package's and peers: accuracy, consistency, time per sample.

*Simulated*: a hand-held unit at one place: a MEMS gyro, an accelerometer and a magnetometer at 50 Hz, with known white noise. Errors are
RMS over runs and over the second half of each, divided by the root of the posterior Cramér–Rao bound, the minimum for any estimator.
Filters with a noise model get the true noise and start from the truth with an error of 1° per axis; the others initialise themselves.

*Recorded*: hand-held units of the BROAD data set with an optical reference. Errors are over the movement.

All filters are tuned alike: each one with a gain uses the gain of minimum RMS error on other data, from the same powers of two times its
default. Simulated: on records of other seeds. Recorded: on the first 20 s of movement of the *other* recordings; for ``strapdown estimate``
the gain is that of the accelerometer (``velocity_sigma``).

``pip install vqf imufusion ahrs smsfusion``, then ``python sims/filter_comparison.py [--out docs/_data] [RECORDING...]`` (some minutes),
where the recordings are files of the BROAD data set. It writes ``filter_comparison.json``, which the page *Comparison* of the documentation
prints. Without recordings that part of an existing file is kept. Peers that are not installed are skipped. With conflicting sensors, a
large initial error or disturbances the order is different: see ``filter_family.py`` and ``hand_held.py``.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import strapdown
from benchmarks import recordings as leaderboard
from strapdown import ahrs, consistency, covariance, estimation, montecarlo, quaternion, scenarios, vectors
from strapdown.ahrs import HAND_HELD
from strapdown.checks import Array
from strapdown.consistency import reference_errors
from strapdown.estimation import setup
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.records.outputs import euler
from strapdown.results import Column, Table
from strapdown.units import DEGREE, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR

SMALL = {"runs": 2, "training": 1, "duration": 8.0}
"""Arguments of a quick test run."""

RATE = 50.0
FORCE_NOISE = 0.01 * 9.81 / np.sqrt(RATE)
"""White noise of the specific force, m/s²/√Hz."""
FIELD = np.array([0.0, 0.45, -0.89])
"""Direction of the magnetic field, North and down, fixed frame East-North-Up."""


def smsfusion(recording: Recording, *, gain: float = 1.0) -> tuple[Array, None]:
    """AHRS of smsfusion (a multiplicative EKF), numba; the gain divides the σ of zero velocity, 10 m/s; σ of the heading 5°."""
    import smsfusion

    interval, (gyro, force, mag) = leaderboard.samples(recording)
    up = force[0] / np.linalg.norm(force[0])
    east = np.cross(mag[0], up)
    east /= np.linalg.norm(east)
    x0 = np.zeros(16)
    x0[6:10] = quaternion.from_matrix(np.stack([east, np.cross(up, east), up]))
    P0 = np.diag(np.repeat([1e-6, 1e-6, (2.0 * DEGREE) ** 2, (0.1 * DEGREE) ** 2], 3))
    filter_ = smsfusion.AHRS(
        1.0 / interval,
        x0_prior=x0,
        P0_prior=P0,
        err_acc={"N": FORCE_NOISE, "B": 1e-9, "tau_cb": 1e6},
        nav_frame="ENU",
        cold_start=False,
        ignore_bias_acc=True,
    )
    velocity, heading = np.full(3, (10.0 / gain) ** 2), (5.0 * DEGREE) ** 2
    result = np.empty((len(gyro), 4))
    q = x0[6:10]
    for k, rate in enumerate(np.roll(gyro, -1, axis=0)):  # an update precedes the propagation by the rate
        field = quaternion.rotate(q, mag[k])
        yaw = euler(q[None]).angles[0, 0] + np.arctan2(field[0], field[1])  # the field's horizontal part points North
        filter_.update(force[k], rate, head=yaw, head_var=heading, head_degrees=False, vel_var=velocity)
        result[k] = filter_.quaternion()
        w = 0.5 * interval * (rate - filter_.bias_gyro())
        q = quaternion.normalize(quaternion.multiply(result[k], np.array([1.0, *w])))  # predicted, at the next sample
    return result, None


PEERS: dict[str, tuple[str, Callable[..., tuple[Array, None]]]] = {
    "VQF 9D": ("vqf", leaderboard.vqf),
    "imufusion": ("imufusion", leaderboard.imufusion),
    "smsfusion": ("smsfusion", smsfusion),
    "ahrs Madgwick": ("ahrs", leaderboard.madgwick),
}
"""The package that each peer needs, and the function that runs it on a recording with a gain over its default."""
OURS = "strapdown estimate"
GAINS = tuple(2.0**k for k in range(-4, 7))
RECORDED_GAINS = tuple(4.0**k for k in range(-2, 4))
SEARCHED = 20.0
"""Duration of the movement of a recording on which gains are searched, s."""
SLOW = {"smsfusion": 4, "ahrs Madgwick": 4}
"""Number of samples of a recording averaged into one, for filters run in Python sample by sample."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study, as in its JSON."""

    bound: float
    """Root of the bound per axis over the second half of the runs, rad."""
    outcomes: list[dict[str, Any]]
    """A row for each filter, of the simulated records."""
    recorded: dict[str, dict[str, Any]]
    """Errors (total, heading, inclination), gains and times on recordings by filter."""


def installed() -> dict[str, str]:
    """Return the packages of the installed peers, by peer."""
    return {name: package for name, (package, _) in PEERS.items() if importlib.util.find_spec(package)}


def scenario(duration: float) -> scenarios.Scenario:
    """Return the hand-held unit."""
    return scenarios.Scenario(
        motion=HarmonicRates(
            mean=(0.0, 0.0, 0.0),
            harmonics=(
                Harmonic(amplitude=(1.0, 0.3, 0.0), frequency=0.4),
                Harmonic(amplitude=(0.0, 0.8, 0.5), frequency=0.27, phase=1.2),
            ),
        ),
        gyro=GyroSpec(
            angle_random_walk=0.3 * DEGREE_PER_ROOT_HOUR, rate_random_walk=20.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR
        ),
        sensors=(
            vectors.VectorSensor(name="accelerometer", reference_f=np.array([0.0, 0.0, 1.0]), sigma=0.01, rate=RATE),
            vectors.VectorSensor(name="magnetometer", reference_f=FIELD, sigma=0.02, rate=RATE),
        ),
        rate=RATE,
        duration=duration,
    )


def as_recording(record: ImuRecord) -> Recording:
    """Return a simulated record as the input of peers: samples at the ends of the intervals."""
    force, field = record.vectors
    assert record.truth is not None
    return Recording(
        source="simulated",
        time=record.time[1:],
        rate=record.rates,
        specific_force=9.81 * force.vector_b,
        magnetic_field=field.vector_b,
        true_attitude=record.truth.attitude[1:],
    )


def run_peer(name: str, recording: Recording, gain: float) -> tuple[Array, float]:
    """Return the attitude of a peer at the samples of a recording, and its processor time per sample, s."""
    begin = time.process_time()
    attitude, _ = PEERS[name][1](recording, gain=gain)
    return quaternion.normalize(attitude), (time.process_time() - begin) / len(attitude)


def late_errors(attitude: Array, truth: Array) -> Array:
    """Return the attitude errors over the second half (m, 3), rad."""
    error = quaternion.rotation_between(attitude, truth)
    return np.asarray(error[len(error) // 2 :])


def on_simulated(runs: int, training: int, duration: float, seed: int) -> tuple[float, list[dict[str, Any]]]:
    """Return the root of the bound, rad, and the rows of the filters on simulated records."""
    scene = scenario(duration)
    base = setup.FilterSetup.for_scenario(scene, states=False)
    plan = montecarlo.Plan(scenario=scene, setup=base, seed=seed, epochs=20)
    cramer_rao = covariance.analyse(scene, base, epochs=20).cramer_rao
    bound = float(np.sqrt(np.mean(np.diagonal(cramer_rao, axis1=1, axis2=2)[10:, :3])))
    records = [scenarios.simulate(scene, seed, run) for run in range(runs)]

    def row(name: str, squares: Sequence[Any], spent: Sequence[float], **more: Any) -> dict[str, Any]:
        rms = float(np.sqrt(np.mean(squares)))
        cells = {"filter": name, "runs": runs, "rms_deg": rms / DEGREE, "rms_over_root_pcrb": rms / bound}
        cells |= {"anees_attitude": None, "consistent": None, "gain_over_default": None}
        return cells | {"microseconds_a_sample": 1e6 * float(np.median(spent))} | more

    squares, nees, spent = [], [], []
    for run in (0, *range(runs)):  # the first compiles
        record = records[run]
        initial = montecarlo.start(record, plan.setup, plan.seed, run)
        begin = time.process_time()
        estimate = estimation.run(record, base.process_noise, initial, full_covariance=True)
        spent.append((time.process_time() - begin) / len(record.increments))
        assert record.truth is not None
        assert estimate.covariance is not None
        error = late_errors(estimate.attitude, record.truth.attitude)
        squares.append(np.mean(error**2))
        nees.append(float(consistency.nees(error[-1], estimate.covariance[-1, :3, :3])) / 3.0)
    low, high = consistency.mean_bounds(3, runs)
    anees = float(np.mean(nees[1:]))
    rows = [row("mekf", squares[1:], spent[1:], anees_attitude=anees, consistent=bool(low <= anees <= high))]
    trained = [as_recording(scenarios.simulate(scene, seed + 1000, run)) for run in range(training)]
    tested = [as_recording(record) for record in records]

    def square(attitude: Array, recording: Recording) -> float:
        assert recording.true_attitude is not None
        return float(np.mean(late_errors(attitude, recording.true_attitude) ** 2))

    for name in installed():
        scores = [np.mean([square(run_peer(name, each, gain)[0], each) for each in trained]) for gain in GAINS]
        best = GAINS[int(np.argmin(scores))]
        outputs = [run_peer(name, each, best) for each in tested]
        squares = [square(attitude, each) for (attitude, _), each in zip(outputs, tested, strict=True)]
        rows.append(row(name, squares, [seconds for _, seconds in outputs], gain_over_default=best))
    return bound, rows


def averaged(recording: Recording, every: int) -> Recording:
    """Return a recording of the means of ``every`` samples."""
    n = len(recording.time) // every
    means = {
        name: getattr(recording, name)[: n * every].reshape(n, every, 3).mean(axis=1)
        for name in ("rate", "specific_force", "magnetic_field")
    }
    return replace(recording.taken(slice(every - 1, n * every, every)), **means)


def scored(name: str, recording: Recording, gain: float) -> tuple[list[float], float]:
    """Return the RMS errors over the movement, total, heading and inclination, rad, and the time per sample, s."""
    if name == OURS:
        begin = time.process_time()
        result = ahrs.estimate(recording, replace(HAND_HELD, velocity_sigma=HAND_HELD.velocity_sigma / gain))
        used, attitude = result.recording, result.estimate.attitude
        seconds = (time.process_time() - begin) / len(attitude)
    else:
        used = averaged(recording, SLOW.get(name, 1))
        attitude, seconds = run_peer(name, used, gain)
    assert used.true_attitude is not None
    errors = reference_errors(attitude, used.true_attitude).rms(used.movement)
    return [errors[part] for part in leaderboard.PARTS], seconds


def on_recordings(recordings: Sequence[Recording], progress: Callable[[str], None]) -> dict[str, dict[str, Any]]:
    """Return the errors of each filter on recordings with a reference, with its gain chosen on the others."""
    begins = [int(np.searchsorted(each.time, ahrs.estimate(each).recording.time[0])) for each in recordings]
    # All filters start at the same time as the package's.
    whole = [each.taken(slice(first, None)) for each, first in zip(recordings, begins, strict=True)]
    short = [each.taken(each.time < each.time[np.argmax(each.movement)] + SEARCHED) for each in whole]
    result = {}
    for name in (OURS, *installed()):
        search = np.array([[scored(name, each, gain)[0][0] for gain in RECORDED_GAINS] for each in short])
        others = search.sum(axis=0) - search
        gains = np.array(RECORDED_GAINS)[np.argmin(others, axis=1)]
        tuned = [scored(name, each, gain) for each, gain in zip(whole, gains, strict=True)]
        default = [scored(name, each, 1.0) for each in whole]
        result[name] = {
            "errors_deg": [[error / DEGREE for error in errors] for errors, _ in tuned],
            "default_errors_deg": [[error / DEGREE for error in errors] for errors, _ in default],
            "gains_over_default": gains.tolist(),
            "microseconds_a_sample": 1e6 * float(np.median([seconds for _, seconds in tuned])),
        }
        mean = ", ".join(f"{x:.2f}" for x in np.mean(result[name]["errors_deg"], axis=0))
        progress(f"{name}: total, heading, inclination {mean}°, gains {sorted(set(gains.tolist()))}")
    return result


def main(
    *,
    runs: int = 50,
    training: int = 4,
    duration: float = 60.0,
    seed: int = 1,
    files: Sequence[Path] = (),
    out: Path | str | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> Result:
    """Run the study; JSON is written to ``out`` if it is given."""
    recordings = [strapdown.read(file) for file in files]  # fails first if a file cannot be read
    bound, outcomes = on_simulated(runs, training, duration, seed)
    recorded = on_recordings(recordings, progress) if recordings else {}
    if out is not None:
        path = Path(out) / "filter_comparison.json"
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        content = {
            "version": strapdown.__version__,
            "date": datetime.date.today().isoformat(),
            "seed": seed,
            "duration_s": duration,
            "peers": {package: version(package) for package in installed().values()},
            "root_pcrb_deg": bound / DEGREE,
            "outcomes": outcomes,
            "recordings": [Path(file).stem for file in files] or before.get("recordings", []),
            "recorded": recorded or before.get("recorded", {}),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, content)
    return Result(bound=bound, outcomes=outcomes, recorded=recorded)


def table(result: Result) -> Table:
    """Return the outcomes on simulated records as a table."""
    columns = {"filter": "filter", "runs": "runs", "rms_deg": "RMS, °", "rms_over_root_pcrb": "RMS/√PCRB"}
    columns |= {"anees_attitude": "ANEES attitude", "consistent": "consistent", "gain_over_default": "gain"}
    columns |= {"microseconds_a_sample": "time per sample, µs"}
    title = f"Root of the bound: {result.bound / DEGREE:.4f}° per axis"
    return Table(title, list(map(Column, columns.values())), [[row[key] for key in columns] for row in result.outcomes])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, metavar="RECORDING", help="BROAD files")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/filter_comparison"))
    print(table(main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))).text)
