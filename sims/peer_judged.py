"""Is somebody else's filter as good as it says? The aided INS of smsfusion (a multiplicative EKF of 4Subsea), judged over many runs.

The peer is put into a setup as a filter of one's own: a class with a method ``run``. It gets the same simulated records as any filter here
(gyro, accelerometer, and the heading of an attitude sensor), and beside them a velocity that is measured to 0.1 m/s, all noises told to it
as they are. ``strapdown.consistency.check_arrays`` finds from one run what its covariance is of, and the Monte Carlo gives the verdict:

- ``as told``: what it says of itself, all noises right;
- ``datasheet``: the same with the noise parameters that the package has for a sensor of this class, not those of the simulated one;
- ``read as fixed``: the same covariance taken for one about fixed axes, as ROS has it: the commonest mistake in judging a filter.

``pip install smsfusion``, then ``python sims/peer_judged.py`` (some minutes). Without it the script says so.
"""

from __future__ import annotations

import argparse
import importlib.util
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import consistency, montecarlo, quaternion, scenarios, setup, vectors
from strapdown.checks import Array
from strapdown.consistency import foreign
from strapdown.estimation import State
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.randomness import generator
from strapdown.records import Estimate, ImuRecord
from strapdown.records.outputs import euler
from strapdown.units import DEGREE, DEGREE_PER_ROOT_HOUR, STANDARD_GRAVITY

SMALL = {"runs": 3, "duration": 4.0}
"""Arguments of a run that only shows that the script works."""

INSTALLED = importlib.util.find_spec("smsfusion") is not None
RATE = 50.0
ACCELEROMETER = 2e-3
"""White noise of the specific force, m/s²/√Hz."""
BIAS, MEMORY = 60.0 * DEGREE / 3600.0, 200.0
"""σ, rad/s, and correlation time, s, of the gyro's bias: a Gauss–Markov process, as the peer models it."""
HEADING = 1.0 * DEGREE
VELOCITY = 0.1
"""σ of the velocity that aids the peer, m/s."""
GYRO = GyroSpec(
    angle_random_walk=0.5 * DEGREE_PER_ROOT_HOUR,
    markov_noise=BIAS * np.sqrt(2.0 / MEMORY),
    markov_correlation_time=MEMORY,
)


@dataclass(frozen=True)
class AidedIns:
    """smsfusion's AidedINS over a record. Its error state: position, velocity, attitude, gyro bias."""

    gyro: dict[str, float]
    """N, rad/s/√Hz; B, rad/s; tau_cb, s."""
    read_as: str = "body"
    """What its covariance is taken to be of."""
    name: str = "smsfusion"

    def run(self, record: ImuRecord, initial: State) -> Estimate:
        """Return its attitude and gyro bias at all edges but the last."""
        import smsfusion

        force, attitude = record.vectors
        P0 = 1e-6 * np.eye(12)
        P0[6:, 6:] = initial.covariance
        x0 = np.concatenate([np.zeros(6), initial.attitude, np.zeros(3), initial.bias])
        ins = smsfusion.AidedINS(
            RATE,
            x0_prior=x0,
            P0_prior=P0,
            err_acc={"N": ACCELEROMETER, "B": 1e-9, "tau_cb": 1e6},
            err_gyro=self.gyro,
            nav_frame="ENU",
            ignore_bias_acc=True,
            cold_start=False,
        )
        n = len(record.increments)
        # The velocity sensor of this run: its noise is drawn anew for each record, and is the same whenever the record is.
        noise = generator(int(record.increments.view(np.uint64).sum() % 2**32), 0, "velocity").standard_normal((n, 3))
        assert attitude.attitude is not None
        angles = euler(attitude.attitude).angles
        yaw, level = angles[:, 0], np.cos(angles[:, 1])
        heard = {round(t * RATE): k for k, t in enumerate(attitude.time)}
        felt = STANDARD_GRAVITY * np.concatenate([force.vector_b[:1], force.vector_b])  # the record holds directions
        rates = record.increments * RATE
        q, b, P = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 6, 6))
        for k in range(n):
            aid: dict[str, Any] = {}
            if k in heard:
                j = heard[k]
                aid = {"head": yaw[j], "head_var": (HEADING / level[j]) ** 2, "head_degrees": False}
                aid |= {"vel": VELOCITY * noise[k], "vel_var": np.full(3, VELOCITY**2)}
            ins.update(felt[k], rates[k], **aid)
            q[k], b[k], P[k] = ins.quaternion(), ins.bias_gyro(), ins.P[6:, 6:]
        return Estimate.from_arrays(record.time[:-1], q, foreign.read_as(self.read_as, P, q), bias=b)


def flight(duration: float) -> scenarios.Scenario:
    """Return a unit that rocks about all its axes at one place, heading measured five times a second."""
    return scenarios.Scenario(
        motion=HarmonicRates(
            mean=(0.0, 0.0, 0.1),
            harmonics=(
                Harmonic(amplitude=(0.3, 0.1, 0.0), frequency=0.2),
                Harmonic(amplitude=(0.0, 0.3, 0.1), frequency=0.13, phase=1.0),
            ),
        ),
        gyro=GYRO,
        sensors=(
            vectors.Accelerometer(
                name="accelerometer", sigma=ACCELEROMETER * np.sqrt(RATE) / STANDARD_GRAVITY, rate=RATE
            ),
            vectors.AttitudeSensor(name="heading", sigma_across=HEADING, sigma_about=HEADING, rate=5.0),
        ),
        rate=RATE,
        duration=duration,
    )


@dataclass(frozen=True, kw_only=True)
class Result:
    """What the peer says of itself against what is true."""

    installed: bool
    verdicts: dict[str, str] = field(default_factory=dict)
    statistics: dict[str, montecarlo.Statistics] = field(default_factory=dict)
    frame_probability: dict[str, float] = field(default_factory=dict)
    """Of each reading of its covariance, found from one run."""


def main(*, runs: int = 200, duration: float = 60.0, seed: int = 1, out: Path | str | None = None) -> Result:
    """Judge the peer; verdicts are written to ``out`` if it is given."""
    if not INSTALLED:
        return Result(installed=False)
    told = {"N": float(GYRO.angle_random_walk), "B": BIAS, "tau_cb": MEMORY}
    from smsfusion import constants

    peers = {
        "as told": AidedIns(told),
        "datasheet": AidedIns(dict(constants.ERR_GYRO_MOTION2), name="smsfusion-datasheet"),
        "read as fixed": AidedIns(told, read_as="fixed", name="smsfusion-fixed"),
    }
    scene = flight(duration)
    base = replace(setup.matched(scene), attitude_sigma=1.0 * DEGREE, bias_sigma=BIAS)
    setups = [replace(base, estimator=one) for one in peers.values()]
    found = montecarlo.run(scene, setups, runs=runs, seed=seed, epochs=10)
    judgements = {name: consistency.judge_runs(one) for name, one in zip(peers, found, strict=True)}
    probability = _frames(montecarlo.Plan(scenario=scene, setup=setups[0], seed=seed, epochs=10), min(runs, 20))
    if out is not None:
        Path(out).mkdir(parents=True, exist_ok=True)
        content = {"error_frame_probability": probability, **{name: one.summary() for name, one in judgements.items()}}
        write_json(Path(out) / "peer_judged.json", content)
    return Result(
        installed=True,
        verdicts={name: one.words for name, one in judgements.items()},
        statistics=dict(zip(peers, found, strict=True)),
        frame_probability=probability,
    )


def _frames(plan: montecarlo.Plan, runs: int) -> dict[str, float]:
    """Return the probability of each reading of the covariance, by the errors at the ends of some runs, which are independent."""
    errors: list[Array] = []
    covariances: list[Array] = []
    attitudes: list[Array] = []
    for run in range(runs):
        again = montecarlo.replay(plan, run)
        truth, estimate = again.record.truth, again.estimate
        assert truth is not None
        assert estimate.covariance is not None
        rows = slice(len(estimate.time) // 2, None, 250)
        turn = quaternion.multiply(quaternion.conjugate(estimate.attitude), truth.attitude[: len(estimate.time)])
        errors.append(quaternion.log(turn)[rows])
        covariances.append(estimate.covariance[rows, :3, :3])
        attitudes.append(estimate.attitude[rows])
    P, q = np.concatenate(covariances), np.concatenate(attitudes)
    readings = {name: foreign.read_as(name, P, q) for name in foreign.ERROR_FRAMES}
    return foreign.frame_probabilities(np.concatenate(errors), readings)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/peer_judged"))
    arguments = parser.parse_args()
    result = main(runs=arguments.runs, seed=arguments.seed, out=arguments.out)
    if not result.installed:
        print("smsfusion is not installed: pip install smsfusion")
    for name, words in result.verdicts.items():
        print(f"\n{name}: {words}")
    if result.installed:
        said = ", ".join(f"{name} {100.0 * p:.3g} %" for name, p in result.frame_probability.items())
        print(f"\nIts covariance is of the attitude error read as: {said}.")
