"""How do attitude filters compare on the same records? The package's and peers: accuracy, consistency, time per sample.

*Simulated*: a hand-held unit at one place: a MEMS gyro, an accelerometer and a magnetometer at 50 Hz, with known white noise. Errors are
RMS over runs and over the second half of each, divided by the root of the posterior Cramér–Rao bound, the minimum for any estimator.
Filters with a noise model get the true noise and start from the truth with an error of 1° per axis; the others initialise themselves.

*Recorded*: hand-held units of the BROAD data set with an optical reference. Errors are over the movement.

All filters are tuned alike: each one with a gain uses the gain of minimum RMS error on other data, from the same powers of two times its
default. Simulated: on records of other seeds. Recorded: on the first half minute of movement of the *other* recordings; for ``strapdown
estimate`` the gain is that of the accelerometer (``velocity_sigma``). The rotation by right angles between a peer's frames and the
package's is found there too, and removed.

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
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import strapdown
from strapdown import ahrs, consistency, covariance, estimation, montecarlo, quaternion, scenarios, vectors
from strapdown.ahrs import HAND_HELD
from strapdown.checks import Array
from strapdown.consistency import alignment, reference_errors
from strapdown.estimation import State, setup
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.records.outputs import euler
from strapdown.units import DEGREE, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR

SMALL = {"runs": 2, "training": 1, "duration": 8.0}
"""Arguments of a quick test run."""

RATE = 50.0
FORCE_NOISE = 0.01 * 9.81 / np.sqrt(RATE)
"""White noise of the specific force, m/s²/√Hz."""
FIELD = np.array([0.0, 0.45, -0.89])
"""Direction of the magnetic field, North and down, fixed frame East-North-Up."""

Peer = Callable[[Array, Array, Array, float, float], Array]
"""Attitudes (n, 4) from gyro (n, 3), rad/s, accelerometer (n, 3), g, magnetometer (n, 3), interval, s, and gain over the default."""


def vqf_peer(gyro: Array, acc: Array, mag: Array, interval: float, gain: float) -> Array:
    """VQF (Laidig & Seel 2023), C++; the gain divides both time constants."""
    import vqf

    outputs = vqf.VQF(interval, tauAcc=3.0 / gain, tauMag=9.0 / gain).updateBatch(
        *(np.ascontiguousarray(x) for x in (gyro, 9.81 * acc, mag))
    )
    return np.asarray(outputs["quat9D"])


def imufusion_peer(gyro: Array, acc: Array, mag: Array, interval: float, gain: float) -> Array:
    """Fusion by x-io (Madgwick's revised filter), C."""
    import imufusion

    settings = imufusion.AhrsSettings()
    settings.sample_rate, settings.convention, settings.gain = 1.0 / interval, imufusion.CONVENTION_ENU, 0.5 * gain
    settings.gyroscope_range, settings.rejection_timeout = 2000.0, 5.0
    settings.acceleration_rejection = settings.magnetic_rejection = 10.0
    ahrs = imufusion.Ahrs()
    ahrs.set_settings(settings)
    result = np.empty((len(gyro), 4))
    for k, rate in enumerate(gyro / DEGREE):
        ahrs.update(rate, acc[k], mag[k])
        result[k] = ahrs.get_quaternion()
    return result


def madgwick_peer(gyro: Array, acc: Array, mag: Array, interval: float, gain: float) -> Array:
    """Madgwick's filter (2010) of the package ahrs, Python."""
    from ahrs.filters import Madgwick

    return np.asarray(Madgwick(gyr=gyro, acc=acc, mag=mag, frequency=1.0 / interval, gain=0.041 * gain).Q)


def smsfusion_peer(gyro: Array, acc: Array, mag: Array, interval: float, gain: float) -> Array:
    """AHRS of smsfusion (a multiplicative EKF), numba; the gain divides the σ of zero velocity, 10 m/s; σ of the heading 5°."""
    import smsfusion

    up = acc[0] / np.linalg.norm(acc[0])
    east = np.cross(mag[0], up)
    east /= np.linalg.norm(east)
    x0 = np.zeros(16)
    x0[6:10] = quaternion.from_matrix(np.stack([east, np.cross(up, east), up]))
    P0 = np.diag(np.repeat([1e-6, 1e-6, (2.0 * DEGREE) ** 2, (0.1 * DEGREE) ** 2], 3))
    ahrs = smsfusion.AHRS(
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
        ahrs.update(9.81 * acc[k], rate, head=yaw, head_var=heading, head_degrees=False, vel_var=velocity)
        result[k] = ahrs.quaternion()
        w = 0.5 * interval * (rate - ahrs.bias_gyro())
        q = quaternion.normalize(
            quaternion.multiply(result[k], np.array([1.0, *w]))
        )  # predicted attitude at the next sample
    return result


PEERS: dict[str, tuple[str, Peer]] = {
    "VQF 9D": ("vqf", vqf_peer),
    "imufusion": ("imufusion", imufusion_peer),
    "smsfusion": ("smsfusion", smsfusion_peer),
    "ahrs Madgwick": ("ahrs", madgwick_peer),
}
"""The package that each peer needs, and the function that runs it."""
GAINS = tuple(2.0**k for k in range(-4, 7))
RECORDED_GAINS = tuple(4.0**k for k in range(-2, 4))
SEARCHED = 20.0
"""Duration of the movement of a recording on which gains are searched, s."""
SLOW = {"smsfusion": 4, "ahrs Madgwick": 4}
"""Number of samples of a recording averaged into one, for filters run in Python sample by sample."""


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


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one filter over all runs."""

    name: str
    runs: int
    rms: float
    """RMS attitude error per axis, rad."""
    ratio: float
    """RMS error over the root of the bound."""
    anees: float
    """ANEES of the attitude at the end, per state; NaN without a covariance."""
    consistent: bool | None
    """Whether the ANEES is within its 99 % bounds; None without a covariance."""
    microseconds: float
    """Time per sample, µs."""
    gain: float
    """Gain over the default; NaN for filters without gains."""

    def summary(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        row = {"filter": self.name, "runs": self.runs, "rms_deg": self.rms / DEGREE, "rms_over_root_pcrb": self.ratio}
        return row | {
            "anees_attitude": None if np.isnan(self.anees) else self.anees,
            "consistent": self.consistent,
            "microseconds_a_sample": self.microseconds,
            "gain_over_default": None if np.isnan(self.gain) else self.gain,
        }


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Result of one filter over all recordings."""

    errors: Array
    """RMS over the movement (recordings, 3), rad: total, heading, inclination."""
    default: Array
    """The same with the default gain."""
    gains: Array
    """Gain over the default for each recording, found on the others."""
    microseconds: float
    """Time per sample, µs."""

    def summary(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "errors_deg": (self.errors / DEGREE).tolist(),
            "default_errors_deg": (self.default / DEGREE).tolist(),
            "gains_over_default": self.gains.tolist(),
            "microseconds_a_sample": self.microseconds,
        }


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study."""

    outcomes: tuple[Outcome, ...]
    bound: float
    """Root of the bound per axis over the second half of the runs, rad."""
    recorded: dict[str, Recorded]
    """Results on recordings by filter."""


def samples(record: ImuRecord) -> tuple[Array, Array, Array, float]:
    """Return gyro, accelerometer and magnetometer at the ends of the intervals, and the interval, as input of peers."""
    force, field = record.vectors
    return record.rates, force.vector_b, field.vector_b, 1.0 / RATE


def frame_of(attitude: Array, time: Array, truth: Array) -> alignment.Alignment:
    """Return the rotations by right angles between a peer's frames and the package's, from the second half of a record."""
    half = slice(len(time) // 2, None)
    series = alignment.Series(time[half], quaternion.normalize(attitude)[half])
    fitted = alignment.fit(series, alignment.Series(time[half], truth[half]), ("fixed", "body"), 0.0)
    snapped = {name: _snapped(getattr(fitted, name)) for name in ("fixed", "body")}
    return alignment.Alignment(**{**vars(fitted), **snapped})


def _snapped(rotation: Array) -> Array:
    """Return the rotation vector of the nearest of the 24 rotations by right angles."""
    R = quaternion.to_matrix(quaternion.exp(rotation))
    near = np.zeros((3, 3))
    for row in np.argsort(-np.abs(R).max(axis=1)):
        column = int(np.argmax(np.where(np.any(near != 0.0, axis=0), -1.0, np.abs(R[row]))))
        near[row, column] = np.sign(R[row, column])
    return np.asarray(quaternion.log(quaternion.from_matrix(near)))


def errors_of(attitude: Array, record: ImuRecord) -> Array:
    """Return the attitude errors over the second half (m, 3), rad, from attitudes at all edges or all except the first."""
    assert record.truth is not None
    truth = record.truth.attitude[-len(attitude) :]
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(attitude), truth))
    return np.asarray(error[len(error) // 2 :])


def starts(record: ImuRecord, plan: montecarlo.Plan, run: int) -> State:
    """Return the initial state of a Kalman filter."""
    return montecarlo.start(record, plan.setup, plan.seed, run)


def main(
    *,
    runs: int = 50,
    training: int = 4,
    duration: float = 60.0,
    seed: int = 1,
    files: Sequence[Path] = (),
    out: Path | str | None = None,
    progress: Callable[[str], None] | None = None,
) -> Result:
    """Run the study; JSON is written to ``out`` if it is given."""
    recorded = [strapdown.read(file) for file in files]  # fails first if a file cannot be read
    scene = scenario(duration)
    base = setup.FilterSetup.for_scenario(scene, states=False)
    plan = montecarlo.Plan(scenario=scene, setup=base, seed=seed, epochs=20)
    predicted = covariance.analyse(scene, base, epochs=20)
    bound = float(np.sqrt(np.mean(np.diagonal(predicted.cramer_rao, axis1=1, axis2=2)[10:, :3])))
    records = [scenarios.simulate(scene, seed, run) for run in range(runs)]
    squares, nees, spent = [], [], []
    estimation.run(records[0], base.process_noise, starts(records[0], plan, 0))  # compiles
    for run, record in enumerate(records):
        begun = clock.process_time()
        estimate = estimation.run(record, base.process_noise, starts(record, plan, run), full_covariance=True)
        spent.append(clock.process_time() - begun)
        error = errors_of(estimate.attitude, record)
        squares.append(np.mean(error**2))
        assert estimate.covariance is not None
        nees.append(float(consistency.nees(error[-1], estimate.covariance[-1, :3, :3])))
    low, high = consistency.mean_bounds(3, len(nees))
    samples_per_run = len(records[0].increments)
    outcomes = [_outcome("mekf", squares, spent, bound, samples_per_run, np.mean(nees) / 3.0, (low, high))]
    trained = [scenarios.simulate(scene, seed + 1000, run) for run in range(training)]
    for name, (package, peer) in PEERS.items():
        if importlib.util.find_spec(package) is None:
            continue
        assert trained[0].truth is not None
        frame = frame_of(peer(*samples(trained[0]), 1.0), trained[0].time[1:], trained[0].truth.attitude[1:])

        def attitude(
            record: ImuRecord, gain: float, peer: Peer = peer, frame: alignment.Alignment = frame
        ) -> tuple[Array, float]:
            begun = clock.process_time()
            q = peer(*samples(record), gain)
            return alignment.in_truth_frames(quaternion.normalize(q), frame), clock.process_time() - begun

        scores = [np.mean([np.mean(errors_of(attitude(r, gain)[0], r) ** 2) for r in trained]) for gain in GAINS]
        best = GAINS[int(np.argmin(scores))]
        results = [(attitude(record, best), record) for record in records]
        squares = [np.mean(errors_of(q, record) ** 2) for (q, _), record in results]
        spent = [seconds for (_, seconds), _ in results]
        outcomes.append(_outcome(name, squares, spent, bound, samples_per_run, np.nan, None, best))
    result = Result(
        outcomes=tuple(outcomes), bound=bound, recorded=on_recordings(recorded, progress) if recorded else {}
    )
    if out is not None:
        path = Path(out) / "filter_comparison.json"
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        content = {
            "version": strapdown.__version__,
            "date": datetime.date.today().isoformat(),
            "seed": seed,
            "duration_s": duration,
            "peers": {package: version(package) for package, _ in PEERS.values() if importlib.util.find_spec(package)},
            "root_pcrb_deg": bound / DEGREE,
            "outcomes": [outcome.summary() for outcome in result.outcomes],
            "recordings": [Path(file).stem for file in files] or before.get("recordings", []),
            "recorded": {name: outcome.summary() for name, outcome in result.recorded.items()}
            or before.get("recorded", {}),
        }
        Path(out).mkdir(parents=True, exist_ok=True)
        write_json(path, content)
    return result


# ---------------------------------------------------------------------------------------------------------------- recordings


def ours(recording: Recording, gain: float) -> tuple[Array, Array]:
    """Return the stamps and attitudes of ``strapdown estimate``."""
    parameters = replace(HAND_HELD, velocity_sigma=HAND_HELD.velocity_sigma / gain)
    result = ahrs.estimate(recording, parameters)
    return result.recording.time, result.estimate.attitude


def peer_on(peer: Peer, every: int) -> Callable[[Recording, float], tuple[Array, Array]]:
    """Return a peer as a function of a recording and a gain, on means of ``every`` samples."""

    def run(recording: Recording, gain: float) -> tuple[Array, Array]:
        assert recording.specific_force is not None
        assert recording.magnetic_field is not None
        n = len(recording.time) // every
        fed = (recording.rate, recording.specific_force / 9.81, recording.magnetic_field)
        means = (np.ascontiguousarray(x[: n * every].reshape(n, every, 3).mean(axis=1)) for x in fed)
        time = recording.time[every - 1 : n * every : every]
        return time, quaternion.normalize(peer(*means, float(np.median(np.diff(time))), gain))

    return run


def on_recordings(read: Sequence[Recording], progress: Callable[[str], None] | None = None) -> dict[str, Recorded]:
    """Return the errors of each filter on recordings with a reference, with its gain chosen on the others."""
    begun = [int(np.searchsorted(recording.time, ahrs.estimate(recording).recording.time[0])) for recording in read]
    whole = [
        recording.taken(slice(first, None)) for recording, first in zip(read, begun, strict=True)
    ]  # with the package's start
    short = [_until(recording, float(recording.time[np.argmax(recording.movement)]) + SEARCHED) for recording in whole]
    candidates: dict[str, Callable[[Recording, float], tuple[Array, Array]]] = {
        "strapdown estimate": ours,
    }
    candidates |= {
        name: peer_on(f, SLOW.get(name, 1)) for name, (package, f) in PEERS.items() if importlib.util.find_spec(package)
    }
    result = {}
    for name, run in candidates.items():
        frame = None
        if name in PEERS:
            time, q = run(short[0], 1.0)
            assert short[0].true_attitude is not None
            truth = short[0].true_attitude[np.searchsorted(short[0].time, time)]
            known = np.isfinite(truth).all(axis=1)
            frame = frame_of(q[known], time[known], truth[known])
        search = np.array(
            [[_errors(run, frame, recording, gain)[0][0] for gain in RECORDED_GAINS] for recording in short]
        )
        others = search.sum(axis=0) - search
        gains = np.array(RECORDED_GAINS)[np.argmin(others, axis=1)]
        scores = [_errors(run, frame, recording, gain) for recording, gain in zip(whole, gains, strict=True)]
        plain = [
            f if g == 1.0 else _errors(run, frame, recording, 1.0)
            for f, g, recording in zip(scores, gains, whole, strict=True)
        ]
        result[name] = Recorded(
            errors=np.array([error for error, _ in scores]),
            default=np.array([error for error, _ in plain]),
            gains=gains,
            microseconds=1e6 * float(np.median([spent for _, spent in scores])),
        )
        if progress is not None:
            mean = ", ".join(f"{x:.2f}" for x in result[name].errors.mean(axis=0) / DEGREE)
            progress(f"{name}: total, heading, inclination {mean}°, gains {sorted(set(gains.tolist()))}")
    return result


def _until(recording: Recording, end: float) -> Recording:
    return recording.taken(recording.time < end)


def _errors(
    run: Callable[[Recording, float], tuple[Array, Array]],
    frame: alignment.Alignment | None,
    recording: Recording,
    gain: float,
) -> tuple[list[float], float]:
    """Return the RMS errors over the movement, total, heading and inclination, rad, and the time per sample, s."""
    begun = clock.process_time()
    time, q = run(recording, gain)
    spent = clock.process_time() - begun
    attitude = q if frame is None else alignment.in_truth_frames(q, frame)
    rows = np.searchsorted(recording.time, time)
    assert recording.true_attitude is not None
    assert recording.movement is not None
    errors = reference_errors(attitude, recording.true_attitude[rows]).rms(recording.movement[rows])
    return [errors[part] for part in ("total", "heading", "inclination")], spent / len(time)


def _outcome(
    name: str,
    squares: Sequence[Any],
    spent: Sequence[float],
    bound: float,
    number: int,
    anees: Any,
    bounds: tuple[float, float] | None,
    gain: float = np.nan,
) -> Outcome:
    rms = float(np.sqrt(np.mean(squares)))
    return Outcome(
        name=name,
        runs=len(squares),
        rms=rms,
        ratio=rms / bound,
        anees=float(anees),
        consistent=None if bounds is None else bool(bounds[0] <= anees <= bounds[1]),
        microseconds=1e6 * float(np.median(spent)) / number,
        gain=gain,
    )


def table(result: Result) -> str:
    """Return the outcomes as a table in Markdown."""
    lines = [
        "| filter | runs | RMS, ° | RMS/√PCRB | ANEES attitude | consistent | µs per sample | gain over default |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for outcome in result.outcomes:
        judged = "no covariance" if outcome.consistent is None else "yes" if outcome.consistent else "NO"
        anees = "" if np.isnan(outcome.anees) else f"{outcome.anees:.3g}"
        gain = "" if np.isnan(outcome.gain) else f"{outcome.gain:g}"
        lines.append(
            f"| {outcome.name} | {outcome.runs} | {outcome.rms / DEGREE:.4f} | {outcome.ratio:.3f} | {anees} | {judged} | "
            f"{outcome.microseconds:.3g} | {gain} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, metavar="RECORDING", help="BROAD files")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/filter_comparison"))
    result = main(**vars(parser.parse_args()), progress=lambda line: print(line, file=sys.stderr))
    print(f"Root of the bound: {result.bound / DEGREE:.4f}° per axis.\n\n{table(result)}")
