"""How do attitude filters compare on the same records? Ours and peers: accuracy against the bound, consistency, time a sample.

A hand-held unit at one place: a MEMS gyro, an accelerometer and a magnetometer at 50 Hz, all noises white and known. Errors are root mean
squares over runs and the second half of each, divided by what no estimator can beat: the posterior Cramér–Rao bound, which for a gyro read
as an input and small errors is the Riccati recursion along the true trajectory (``covariance.analyse``).

Nothing is tuned for ours that is not tuned alike for peers. Filters with a noise model (the Kalman filters) get the true noises; filters
with gains (VQF, imufusion, ahrs) get the gains that are best by RMS error on records of other seeds, by a search over powers of two; the
start is the truth off by 1° an axis, or the filter's own. Their fixed frames are compared by their attitudes on those records, and what
differs by a multiple of a right angle is taken out.

``pip install vqf imufusion ahrs``, then ``python sims/filter_comparison.py`` (some minutes): it writes ``filter_comparison.json`` and
``filter_comparison.md``, a table. Peers that are not installed are left out. Where several sensors disagree, from a large start and with
disturbances the order is another: ``filter_family.py`` and ``hand_held.py`` look there.
"""

from __future__ import annotations

import argparse
import importlib.util
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import consistency, covariance, montecarlo, quaternion, scenarios, setup, vectors
from strapdown.checks import Array
from strapdown.consistency import foreign
from strapdown.estimation import State, filters
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.records import ImuRecord
from strapdown.units import DEGREE, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR

SMALL = {"runs": 2, "unscented_runs": 1, "training": 1, "duration": 8.0, "own": ("mekf", "usque", "mahony")}
"""Arguments of a run that only shows that the script works."""

RATE = 50.0
FIELD = np.array([0.0, 0.45, -0.89])
"""Magnetic North and down, fixed frame East-North-Up."""
OWN = ("mekf", "right-invariant", "equivariant", "geometric", "usque", "mahony")

Peer = Callable[[Array, Array, Array, float], Array]
"""Attitudes (n, 4) of gyro (n, 3), rad/s, accelerometer and magnetometer (n, 3) and a gain."""


def vqf_peer(gyro: Array, acc: Array, mag: Array, gain: float) -> Array:
    """VQF (Laidig & Seel 2023), C++; the gain shortens both time constants."""
    import vqf

    found = vqf.VQF(1.0 / RATE, tauAcc=3.0 / gain, tauMag=9.0 / gain).updateBatch(
        *(np.ascontiguousarray(x) for x in (gyro, 9.81 * acc, mag))
    )
    return np.asarray(found["quat9D"])


def imufusion_peer(gyro: Array, acc: Array, mag: Array, gain: float) -> Array:
    """Fusion by x-io (Madgwick's revised filter), C."""
    import imufusion

    settings = imufusion.AhrsSettings()
    settings.sample_rate, settings.convention, settings.gain = RATE, imufusion.CONVENTION_ENU, 0.5 * gain
    ahrs = imufusion.Ahrs()
    ahrs.set_settings(settings)
    result = np.empty((len(gyro), 4))
    for k, rate in enumerate(gyro / DEGREE):
        ahrs.update(rate, acc[k], mag[k])
        result[k] = ahrs.get_quaternion()
    return result


def madgwick_peer(gyro: Array, acc: Array, mag: Array, gain: float) -> Array:
    """Madgwick's filter (2010) of ahrs, Python."""
    from ahrs.filters import Madgwick

    return np.asarray(Madgwick(gyr=gyro, acc=acc, mag=mag, frequency=RATE, gain=0.1 * gain).Q)


PEERS: dict[str, tuple[str, Peer]] = {
    "VQF 9D": ("vqf", vqf_peer),
    "imufusion": ("imufusion", imufusion_peer),
    "ahrs Madgwick": ("ahrs", madgwick_peer),
}
"""The package that each needs, and how it is run."""
GAINS = tuple(2.0**k for k in range(-5, 4))


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
    """One filter on all runs."""

    name: str
    runs: int
    rms: float
    """Of the attitude error, an axis, rad."""
    ratio: float
    """RMS over the root of the bound."""
    anees: float
    """Of the attitude at the end, per state; NaN without a covariance."""
    consistent: bool | None
    """Whether ANEES lies within its 99 % bounds; None without a covariance."""
    microseconds: float
    """A sample."""
    gain: float
    """Of a filter with gains, over its default; NaN of others."""

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
class Result:
    """What the study found."""

    outcomes: tuple[Outcome, ...]
    bound: float
    """Root of the bound, an axis, rad: of the second half of the runs."""


def samples(record: ImuRecord) -> tuple[Array, Array, Array]:
    """Return gyro, accelerometer and magnetometer at the ends of the intervals, as peers take them."""
    force, field = record.vectors
    return record.rates, force.vector_b, field.vector_b


def frame_of(peer: Peer, record: ImuRecord, gain: float) -> foreign.Alignment:
    """Return what a peer's frames differ by from ours, in right angles."""
    assert record.truth is not None
    half = slice(len(record.increments) // 2, None)
    series = foreign._Series(record.time[1:][half], quaternion.normalize(peer(*samples(record), gain))[half])
    truth = foreign._Series(record.time[1:][half], record.truth.attitude[1:][half])
    found = foreign.fit(series, truth, ("fixed", "body"), 0.0)
    snapped = {name: _snapped(getattr(found, name)) for name in ("fixed", "body")}
    return foreign.Alignment(**{**vars(found), **snapped})


def _snapped(rotation: Array) -> Array:
    """Return the rotation vector of the nearest of the 24 turns by right angles."""
    R = quaternion.to_matrix(quaternion.exp(rotation))
    near = np.zeros((3, 3))
    for row in np.argsort(-np.abs(R).max(axis=1)):
        column = int(np.argmax(np.where(np.any(near != 0.0, axis=0), -1.0, np.abs(R[row]))))
        near[row, column] = np.sign(R[row, column])
    return np.asarray(quaternion.log(quaternion.from_matrix(near)))


def errors_of(attitude: Array, record: ImuRecord) -> Array:
    """Return the attitude errors (m, 3), rad, of the second half, of attitudes at all edges or all but the first."""
    assert record.truth is not None
    truth = record.truth.attitude[-len(attitude) :]
    error = quaternion.log(quaternion.multiply(quaternion.conjugate(attitude), truth))
    return np.asarray(error[len(error) // 2 :])


def starts(record: ImuRecord, plan: montecarlo.Plan, run: int) -> State:
    """Return where a Kalman filter starts."""
    return montecarlo.start(record, plan.setup, plan.seed, run)


def main(
    *,
    runs: int = 50,
    unscented_runs: int = 10,
    training: int = 4,
    duration: float = 60.0,
    seed: int = 1,
    own: Sequence[str] = OWN,
    out: Path | str | None = None,
) -> Result:
    """Run the study; JSON and the table are written to ``out`` if it is given."""
    scene = scenario(duration)
    base = setup.matched(scene)
    plan = montecarlo.Plan(scenario=scene, setup=base, seed=seed, epochs=20)
    predicted = covariance.analyse(scene, base, epochs=20)
    bound = float(np.sqrt(np.mean(np.diagonal(predicted.covariance, axis1=1, axis2=2)[10:, :3])))
    records = [scenarios.simulate(scene, seed, run) for run in range(runs)]
    outcomes = []
    for name in own:
        squares, nees, spent = [], [], []
        filters.run(name, records[0], base.process_noise, starts(records[0], plan, 0))  # compiles
        for run, record in enumerate(records[: unscented_runs if name == "usque" else runs]):
            begun = clock.perf_counter()
            estimate = filters.run(name, record, base.process_noise, starts(record, plan, run), full_covariance=True)
            spent.append(clock.perf_counter() - begun)
            error = errors_of(estimate.attitude, record)
            squares.append(np.mean(error**2))
            assert estimate.covariance is not None
            nees.append(float(consistency.nees(error[-1], estimate.covariance[-1, :3, :3])))
        low, high = consistency.mean_bounds(3, len(nees))
        outcomes.append(
            _outcome(name, squares, spent, bound, len(records[0].increments), np.mean(nees) / 3.0, (low, high))
        )
    trained = [scenarios.simulate(scene, seed + 1000, run) for run in range(training)]
    for name, (package, peer) in PEERS.items():
        if importlib.util.find_spec(package) is None:
            continue
        frame = frame_of(peer, trained[0], 1.0)

        def attitude(
            record: ImuRecord, gain: float, peer: Peer = peer, frame: foreign.Alignment = frame
        ) -> tuple[Array, float]:
            begun = clock.perf_counter()
            q = peer(*samples(record), gain)
            return foreign.replace_attitude(quaternion.normalize(q), frame), clock.perf_counter() - begun

        scores = [np.mean([np.mean(errors_of(attitude(r, gain)[0], r) ** 2) for r in trained]) for gain in GAINS]
        best = GAINS[int(np.argmin(scores))]
        found = [(attitude(record, best), record) for record in records]
        squares = [np.mean(errors_of(q, record) ** 2) for (q, _), record in found]
        spent = [seconds for (_, seconds), _ in found]
        outcomes.append(_outcome(name, squares, spent, bound, len(records[0].increments), np.nan, None, best))
    result = Result(outcomes=tuple(outcomes), bound=bound)
    if out is not None:
        Path(out).mkdir(parents=True, exist_ok=True)
        content = {"seed": seed, "duration_s": duration, "root_pcrb_deg": bound / DEGREE}
        write_json(
            Path(out) / "filter_comparison.json", content | {"outcomes": [one.summary() for one in result.outcomes]}
        )
        (Path(out) / "filter_comparison.md").write_text(table(result) + "\n", encoding="utf-8")
    return result


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
        "| filter | runs | RMS, ° | RMS/√PCRB | ANEES attitude | consistent | µs a sample | gain over default |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in result.outcomes:
        judged = "no covariance" if one.consistent is None else "yes" if one.consistent else "NO"
        anees = "" if np.isnan(one.anees) else f"{one.anees:.3g}"
        gain = "" if np.isnan(one.gain) else f"{one.gain:g}"
        lines.append(
            f"| {one.name} | {one.runs} | {one.rms / DEGREE:.4f} | {one.ratio:.3f} | {anees} | {judged} | "
            f"{one.microseconds:.3g} | {gain} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--unscented-runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/filter_comparison"))
    arguments = parser.parse_args()
    found = main(runs=arguments.runs, unscented_runs=arguments.unscented_runs, seed=arguments.seed, out=arguments.out)
    print(f"Root of the bound: {found.bound / DEGREE:.4f}° an axis.\n\n{table(found)}")
