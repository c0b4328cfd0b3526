"""Are the filters of other packages consistent? Three of them, run unmodified and judged over many runs.

Each is used in a setup as a user-defined filter: a class with a method ``run``. It gets the same simulated records as any filter here
(gyro, accelerometer, attitude sensor), and in addition velocity measurements with a σ of 0.1 m/s, and the true noise parameters:

- smsfusion (4Subsea), aided INS, a multiplicative EKF: velocity and heading;
- AttiPy (V. R. Solum), AHRS, a multiplicative EKF: velocity and heading;
- GTSAM (Georgia Tech), ``NavStateImuEKF``, on a manifold and without a gyro bias: velocity and attitude, the gyro without a bias.

In addition, cases with a fault that the verdict must detect:

- smsfusion with the package's noise parameters for a sensor of this class instead of those of the simulated one;
- its covariance, which is correct, read as one about fixed axes, as in ROS: the most common mistake in judging a filter;
- GTSAM's filter with a gyro that has a bias, which it does not model.

A further finding: smsfusion and AttiPy use the yaw's derivative with respect to the whole Gibbs vector of the attitude in place of that
with respect to a small rotation (:func:`heading_gradient`). It is too small by cos²(ψ/2): half at 90°, zero at 180°, so that σ about the
vertical is too large; with the correct one AttiPy's filter is consistent.

``pip install smsfusion attipy gtsam``, then ``python sims/peer_judged.py [--out docs/_data]`` (some minutes). It writes
``peer_judged.json``, which the page *Comparison* of the documentation prints. Peers that are not installed are skipped.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import strapdown
from strapdown import consistency, montecarlo, quaternion, scenarios, vectors
from strapdown.checks import Array
from strapdown.consistency import foreign
from strapdown.estimation import State, setup
from strapdown.files import write_json
from strapdown.gyro import GyroSpec
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.randomness import generator
from strapdown.records import Estimate, ImuRecord
from strapdown.records.outputs import euler
from strapdown.results import Column, Table
from strapdown.units import DEGREE, DEGREE_PER_ROOT_HOUR, STANDARD_GRAVITY

SMALL = {"runs": 3, "duration": 4.0}
"""Arguments of a quick test run."""

RATE = 50.0
ACCELEROMETER = 2e-3
"""White noise of the specific force, m/s²/√Hz."""
BIAS, MEMORY = 60.0 * DEGREE / 3600.0, 200.0
"""σ, rad/s, and correlation time, s, of the gyro's bias, a Gauss–Markov process as in the peer's model."""
HEADING = 1.0 * DEGREE
VELOCITY = 0.1
"""σ of the velocity measurements, m/s."""
GYRO = GyroSpec(
    angle_random_walk=0.5 * DEGREE_PER_ROOT_HOUR,
    markov_noise=BIAS * np.sqrt(2.0 / MEMORY),
    markov_correlation_time=MEMORY,
)


class Samples(NamedTuple):
    """Input of a peer: readings at the edges 0 … n − 1, and aiding measurements at some of them."""

    number: int
    rates: Array
    """Rates (n, 3), rad/s, over the interval after each edge."""
    force: Array
    """Specific force (n, 3), m/s²."""
    velocity: Array
    """Measured velocity (n, 3), m/s, of a unit at rest."""
    attitude: Array
    """Measurements of the attitude sensor (m, 4)."""
    aided: dict[int, int]
    """Row of the attitude sensor by edge; the velocity is measured there too."""


def samples(record: ImuRecord) -> Samples:
    """Return a record as the input of peers."""
    force, attitude = record.vectors
    assert attitude.attitude is not None
    n = len(record.increments)
    # The velocity sensor of this run: its noise depends only on the record.
    noise = generator(int(record.increments.view(np.uint64).sum() % 2**32), 0, "velocity").standard_normal((n, 3))
    felt = STANDARD_GRAVITY * np.concatenate([force.vector_b[:1], force.vector_b])  # the record contains directions
    aided = {round(t * RATE): k for k, t in enumerate(attitude.time)}
    return Samples(n, record.increments * RATE, felt[:n], VELOCITY * noise, attitude.attitude, aided)


@dataclass(frozen=True)
class AidedIns:
    """smsfusion's AidedINS, with the error states position, velocity, attitude, gyro bias."""

    gyro: dict[str, float]
    """N, rad/s/√Hz; B, rad/s; tau_cb, s."""
    read_as: str = "body"
    """Definition by which its covariance is read."""
    name: str = "smsfusion"

    def run(self, record: ImuRecord, initial: State) -> Estimate:
        """Return its attitude and gyro bias at all edges except the last."""
        import smsfusion

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
        data = samples(record)
        angles = euler(data.attitude).angles
        q, b, P = np.empty((data.number, 4)), np.empty((data.number, 3)), np.empty((data.number, 6, 6))
        for k in range(data.number):
            aid: dict[str, Any] = {}
            if (j := data.aided.get(k)) is not None:
                variance = (HEADING / np.cos(angles[j, 1])) ** 2
                aid = {"head": angles[j, 0], "head_var": variance, "head_degrees": False}
                aid |= {"vel": data.velocity[k], "vel_var": np.full(3, VELOCITY**2)}
            ins.update(data.force[k], data.rates[k], **aid)
            q[k], b[k], P[k] = ins.quaternion(), ins.bias_gyro(), ins.P[6:, 6:]
        return Estimate.from_arrays(record.time[:-1], q, foreign.read_as(self.read_as, P, q), bias=b)


def heading_gradient(attitude: Array) -> Array:
    """Return the derivative (3,) of the yaw angle with respect to a small rotation in body axes: (0, sin φ, cos φ)/cos θ."""
    _, pitch, roll = euler(attitude[None]).angles[0]
    return np.array([0.0, np.sin(roll), np.cos(roll)]) / np.cos(pitch)


@dataclass(frozen=True)
class AttiPy:
    """AttiPy's AHRS, with the error states attitude, gyro bias, velocity."""

    gyro: dict[str, float]
    """N, rad/s/√Hz; B, rad/s; tau_cb, s."""
    mended: bool = False
    """Whether to use :func:`heading_gradient` instead of its own derivative."""
    name: str = "attipy"

    def run(self, record: ImuRecord, initial: State) -> Estimate:
        """Return its attitude and gyro bias at all edges except the last."""
        import attipy

        data = samples(record)
        P0 = 1e-6 * np.eye(9)
        P0[:6, :6] = initial.covariance
        ahrs = attipy.AHRS(
            RATE,
            q_nb=initial.attitude,
            bg_b=initial.bias,
            w_b=data.rates[0] - initial.bias,
            P=P0,
            g=STANDARD_GRAVITY,
            nav_frame="ENU",
            acc_noise_density=ACCELEROMETER,
            gyro_noise_density=self.gyro["N"],
            gyro_bias_stability=self.gyro["B"],
            bias_corr_time=self.gyro["tau_cb"],
        )
        if self.mended:
            own = ahrs._dhdx[3]

            def row(q: Array) -> Array:
                own[:3] = heading_gradient(q)
                return own

            ahrs._dhdx_yaw = row
        ahrs._dx = np.zeros(9)  # version 0.0.7 shares it among all objects, and runs are in several threads
        angles = euler(data.attitude).angles
        q, b, P = np.empty((data.number, 4)), np.empty((data.number, 3)), np.empty((data.number, 6, 6))
        q[0], b[0], P[0] = initial.attitude, initial.bias, initial.covariance
        for k in range(1, data.number):  # a call propagates to this edge by the last reading, and stores this one
            aid: dict[str, Any] = {"v_n": None}
            if (j := data.aided.get(k)) is not None:
                aid = {"v_n": data.velocity[k], "v_var": np.full(3, VELOCITY**2)}
                aid |= {"yaw": angles[j, 0], "yaw_var": (HEADING / np.cos(angles[j, 1])) ** 2}
            ahrs.update(data.force[k], data.rates[k], **aid)
            q[k], b[k], P[k] = ahrs.q_nb, ahrs.bg_b, ahrs.P[:6, :6]
        return Estimate.from_arrays(record.time[:-1], q, P, bias=b)


@dataclass(frozen=True)
class Gtsam:
    """GTSAM's NavStateImuEKF, with the error states attitude, position, velocity, all in body axes."""

    angle_random_walk: float
    """Angle random walk of the gyro, rad/√s."""
    name: str = "gtsam"

    def run(self, record: ImuRecord, initial: State) -> Estimate:
        """Return its attitude at all edges except the last."""
        import gtsam

        data = samples(record)
        noise = gtsam.PreintegrationParams.MakeSharedU(STANDARD_GRAVITY)
        noise.setGyroscopeCovariance(self.angle_random_walk**2 * np.eye(3))
        noise.setAccelerometerCovariance(ACCELEROMETER**2 * np.eye(3))
        noise.setIntegrationCovariance(1e-12 * np.eye(3))
        P0 = 1e-6 * np.eye(9)
        P0[:3, :3] = initial.covariance[:3, :3]
        start = gtsam.NavState(gtsam.Rot3(quaternion.to_matrix(initial.attitude)), np.zeros(3), np.zeros(3))
        ekf = gtsam.NavStateImuEKF(start, P0, noise)
        q, P = np.empty((data.number, 4)), np.empty((data.number, 3, 3))
        q[0], P[0] = initial.attitude, initial.covariance[:3, :3]
        eye, zero = np.eye(3), np.zeros((3, 3))
        for k in range(1, data.number):
            ekf.predict(data.rates[k - 1], data.force[k - 1 : k + 1].mean(axis=0), 1.0 / RATE)
            if (j := data.aided.get(k)) is not None:
                R = ekf.state().attitude().matrix()
                H = np.hstack([zero, zero, R])
                ekf.updateWithVector(ekf.state().velocity(), H, data.velocity[k], VELOCITY**2 * eye)
                now = quaternion.from_matrix(ekf.state().attitude().matrix())
                turn = quaternion.rotation_between(now, data.attitude[j])
                ekf.updateWithVector(np.zeros(3), np.hstack([eye, zero, zero]), turn, HEADING**2 * eye)
            q[k], P[k] = quaternion.from_matrix(ekf.state().attitude().matrix()), ekf.covariance()[:3, :3]
        return Estimate.from_arrays(record.time[:-1], q, P)


def flight(duration: float, gyro: GyroSpec = GYRO) -> scenarios.Scenario:
    """Return a unit that rocks about all its axes at one place, with attitude measurements at 5 Hz."""
    return scenarios.Scenario(
        motion=HarmonicRates(
            mean=(0.0, 0.0, 0.1),
            harmonics=(
                Harmonic(amplitude=(0.3, 0.1, 0.0), frequency=0.2),
                Harmonic(amplitude=(0.0, 0.3, 0.1), frequency=0.13, phase=1.0),
            ),
        ),
        gyro=gyro,
        sensors=(
            vectors.Accelerometer(
                name="accelerometer", sigma=ACCELEROMETER * np.sqrt(RATE) / STANDARD_GRAVITY, rate=RATE
            ),
            vectors.AttitudeSensor(name="heading", sigma_across=HEADING, sigma_about=HEADING, rate=5.0),
        ),
        rate=RATE,
        duration=duration,
    )


def cases(duration: float) -> dict[str, tuple[str, scenarios.Scenario, Any]]:
    """Return the cases by name: required package, scenario, filter."""
    datasheet_noise = {"N": float(GYRO.angle_random_walk), "B": BIAS, "tau_cb": MEMORY}
    noise = float(GYRO.angle_random_walk)
    scene, steady = flight(duration), flight(duration, GyroSpec(angle_random_walk=noise))
    mended = AttiPy(datasheet_noise, mended=True, name="attipy-mended")
    fixed = AidedIns(datasheet_noise, read_as="fixed", name="smsfusion-fixed")
    by_name: dict[str, tuple[str, scenarios.Scenario, Any]] = {
        "smsfusion": ("smsfusion", scene, AidedIns(datasheet_noise)),
        "AttiPy": ("attipy", scene, AttiPy(datasheet_noise)),
        "AttiPy, heading's derivative mended": ("attipy", scene, mended),
        "GTSAM": ("gtsam", steady, Gtsam(noise)),
        "smsfusion, covariance read as fixed": ("smsfusion", scene, fixed),
        "GTSAM, gyro with a bias": ("gtsam", scene, Gtsam(noise, name="gtsam-bias")),
    }
    if importlib.util.find_spec("smsfusion") is not None:
        from smsfusion import constants

        datasheet = AidedIns(dict(constants.ERR_GYRO_MOTION2), name="smsfusion-datasheet")
        by_name["smsfusion, noises of another sensor"] = ("smsfusion", scene, datasheet)
    return {name: case for name, case in by_name.items() if importlib.util.find_spec(case[0]) is not None}


@dataclass(frozen=True, kw_only=True)
class Result:
    """The peers' verdicts and statistics."""

    judgements: dict[str, consistency.Judgement]
    statistics: dict[str, montecarlo.Statistics]
    frame_probability: dict[str, float] = field(default_factory=dict)
    """Probability of each definition of smsfusion's covariance, from its errors."""


def main(*, runs: int = 200, duration: float = 40.0, seed: int = 1, out: Path | str | None = None) -> Result:
    """Judge the peers; JSON is written to ``out`` if it is given."""
    peers = cases(duration)
    statistics, plans = {}, {}
    for name, (_, scene, estimator) in peers.items():
        filter_setup = replace(
            setup.FilterSetup.for_scenario(scene, states=False),
            attitude_sigma=1.0 * DEGREE,
            bias_sigma=BIAS,
            estimator=estimator,
        )
        plans[name] = montecarlo.Plan(scenario=scene, setup=filter_setup, seed=seed, epochs=10)
        statistics[name] = montecarlo.run_plan(plans[name], runs=runs)
    result = Result(
        judgements={name: result.judge() for name, result in statistics.items()},
        statistics=statistics,
        frame_probability=_frames(plans["smsfusion"], min(runs, 20)) if "smsfusion" in plans else {},
    )
    if out is not None:
        content = {
            "version": strapdown.__version__,
            "date": datetime.date.today().isoformat(),
            "runs": runs,
            "seed": seed,
            "duration_s": duration,
            "peers": {package: version(package) for package in sorted({package for package, _, _ in peers.values()})},
            "error_frame_probability": result.frame_probability,
            "cases": {
                name: {**rows(statistics[name]), **judgement.summary()} for name, judgement in result.judgements.items()
            },
        }
        Path(out).mkdir(parents=True, exist_ok=True)
        write_json(Path(out) / "peer_judged.json", content)
    return result


def rows(statistics: montecarlo.Statistics) -> dict[str, Any]:
    """Return a peer's σ and its RMS errors over the judged epochs."""
    judged = statistics.judged_epochs
    size = 6 if statistics.has_bias else 3
    rms = np.sqrt(np.mean(statistics.rms_error[judged] ** 2, axis=0))[:size]
    sigma = np.sqrt(np.mean(statistics.sigma[judged] ** 2, axis=0))[:size]
    verdicts = {name: statistics.verdict(judged, name) for name in statistics.subsets}
    return {
        "anees": {name: float(verdict.mean.mean()) for name, verdict in verdicts.items()},
        "bounds": {name: list(verdict.bounds) for name, verdict in verdicts.items()},
        "rms_si": rms.tolist(),
        "sigma_si": sigma.tolist(),
    }


def table(result: Result) -> Table:
    """Return the peers' σ and their RMS errors as a table."""
    lines = []
    for name, statistics in result.statistics.items():
        row = rows(statistics)
        ratio = np.array(row["rms_si"]) / np.array(row["sigma_si"])
        ratios = [", ".join(f"{x:.3g}" for x in part) for part in (ratio[:3], ratio[3:])]
        anees = [row["anees"].get(part) for part in ("state", "attitude", "bias")]
        lines.append((name, *anees, *ratios, result.judgements[name].verdict))
    columns = [Column(f"ANEES {part}", digits=3) for part in ("state", "attitude", "bias")]
    axes = ("RMS/σ attitude x y z", "RMS/σ bias x y z")
    return Table("Filters of other packages", ["filter", *columns, *axes, "verdict"], lines)


def _frames(plan: montecarlo.Plan, runs: int) -> dict[str, float]:
    """Return the probability of each definition of the covariance, from the independent errors at the ends of some runs."""
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
    result = main(**vars(parser.parse_args()))
    print(table(result).text if result.statistics else "No peer is installed: pip install smsfusion attipy gtsam")
    for name, judgement in result.judgements.items():
        print(f"\n{name}: {judgement.words}")
    if result.frame_probability:
        words = ", ".join(f"{name} {100.0 * p:.3g} %" for name, p in result.frame_probability.items())
        print(f"\nDefinition of the attitude error in smsfusion's covariance: {words}.")
