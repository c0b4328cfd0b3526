"""How should a filter model flicker, which no random walk represents? Three filters on the gyros of the presets, at rest.

For each preset and run, a record at the gyro's natural rate with vector measurements once a second is processed by

``own``
    the MEKF with only the gyro's angle and rate random walk, without flicker;
``matched``
    the MEKF with :func:`strapdown.gyro.matched_process_noise`;
``augmented``
    a linear Kalman filter per axis, with the sixteen states of :class:`strapdown.gyro.flicker.Shaping` besides attitude and drift.

``control`` is the MEKF of ``own`` on the same gyro without flicker. Reported are the NEES of the attitude over its three degrees of
freedom, averaged over runs and late epochs (1 if the covariance is right), the standard error of that mean, and the RMS error.

Run ``python sims/flicker_in_filter.py [--out FOLDER]`` (some minutes).

Results for the presets, each at its natural rate with vector measurements once a second: mean NEES of the attitude over its three degrees
of freedom (40 runs of 600 s; standard errors 0.012 to 0.049, 0.073 for the mpu-9250 with its flicker ignored; the columns share their
random numbers):
===========  ===============  =========  =======  =========
preset       without flicker  ignored    matched  augmented
===========  ===============  =========  =======  =========
mpu-9250     0.973            1.611      1.003    0.994
bmi088       1.043            1.117      1.047    1.044
adis16470    0.999            1.380      1.001    1.001
adis16467-1  1.013            1.361      1.040    1.037
stim300      1.003            1.025      1.007    1.005
hg4930       1.057            1.210      1.045    1.044
dsp-1760     1.020            1.074      1.020    1.018
hg9900       1.003            1.009      1.007    1.009
===========  ===============  =========  =======  =========
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import t

from strapdown import consistency, estimation, gyro, motion, plots, quaternion
from strapdown.gyro import datasheets, flicker
from strapdown.plots import style
from strapdown.randomness import generator
from strapdown.scenarios import Scenario, simulate
from strapdown.units import ARCSECOND
from strapdown.vectors import VectorSensor

FILTERS = ("control", "own", "matched", "augmented")

SIGMA = {
    "consumer MEMS": 3600.0,
    "industrial MEMS": 360.0,
    "tactical MEMS": 60.0,
    "fibre-optic": 10.0,
    "navigation, ring laser": 2.0,
}
"""σ of the vector measurements by grade of the gyro, arcsec."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result for one preset, by filter: mean NEES over 3, its standard error, and RMS attitude error (rad)."""

    preset: str
    anees: dict[str, float]
    scatter: dict[str, float]
    rms: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results for all presets."""

    outcomes: tuple[Outcome, ...]
    runs: int
    duration: float


SMALL = {"presets": ("stim300",), "runs": 2, "duration": 60.0, "rate": 50.0}
"""Arguments of a quick test run."""


def main(*, presets=tuple(datasheets.PRESETS), runs=40, duration=600.0, seed=1, rate=None, out=None):
    """Test the filters on each preset; a ``rate`` (Hz) below the natural one makes it faster.

    Returns
    -------
    Result
    """
    outcomes = tuple(judge(datasheets.PRESETS[name], runs, duration, seed, rate) for name in presets)
    result = Result(outcomes=outcomes, runs=runs, duration=duration)
    if out is not None:
        draw(result, Path(out) / "flicker.png")
    return result


def judge(preset, runs, duration, seed, rate=None):
    """Return the outcome of one preset."""
    sigma = SIGMA[preset.grade] * ARCSECOND
    # No deterministic errors: only the noise matters. The three directions give each axis two measurements per second.
    names = ("angle_random_walk", "rate_random_walk", "bias_instability", "turn_on_bias_sigma")
    spec = gyro.GyroSpec(**{name: getattr(preset.spec, name) for name in names})
    density = 0.5 * sigma**2
    noises = {"own": gyro.process_noise(dataclasses.replace(spec, bias_instability=0.0))}
    noises["control"] = noises["own"]
    noises["matched"] = gyro.matched_process_noise(spec, density)
    scenario = Scenario(
        motion=motion.rest(),
        gyro=spec,
        sensors=tuple(
            VectorSensor(name=f"direction {i}", reference_f=row, sigma=sigma, rate=1.0)
            for i, row in enumerate(np.eye(3))
        ),
        rate=preset.rate if rate is None else rate,
        duration=duration,
    )
    without = dataclasses.replace(scenario, gyro=dataclasses.replace(spec, bias_instability=0.0))
    samples = len(scenario.edges) - 1
    every = round(scenario.rate)
    shaping = flicker.shaping(samples)
    start = 10.0 * sigma
    bias_sigma = float(np.hypot(spec.turn_on_bias_sigma, spec.bias_instability * np.sqrt(shaping.variance)))
    collected = {name: [] for name in FILTERS}
    for run in range(runs):
        offset = start * generator(seed, run, "start").standard_normal(3)
        for name in FILTERS[:-1]:
            record = simulate(without if name == "control" else scenario, seed, run)
            q0 = quaternion.exp(-offset)
            initial = estimation.initial_state(q0, attitude_sigma=start, bias_sigma=bias_sigma)
            noise = estimation.ProcessNoise(**noises[name])
            estimate = estimation.run(record, noise, initial, every=every, full_covariance=True)
            truth = record.truth
            error = consistency.errors(estimate.attitude, estimate.bias, truth.attitude[::every], truth.bias[::every])[
                :, :3
            ]
            collected[name].append((consistency.nees(error, estimate.covariance[:, :3, :3]), np.sum(error**2, axis=1)))
        angle = np.concatenate([np.zeros((1, 3)), np.cumsum(record.increments, axis=0)])[::every]
        looks = np.array([_look(record.vectors, axis) for axis in range(3)]).T
        error, variance = augmented(angle, looks, spec, shaping, every, 1.0 / scenario.rate, density, start)
        collected["augmented"].append((np.sum(error**2 / variance[:, None], axis=1), np.sum(error**2, axis=1)))
    late = slice(len(estimate.time) // 3, None)
    nees = {name: np.array([pair[0][late].mean() / 3.0 for pair in pairs]) for name, pairs in collected.items()}
    squares = {name: np.mean([pair[1][late].mean() for pair in pairs]) for name, pairs in collected.items()}
    return Outcome(
        preset=preset.name,
        anees={name: float(values.mean()) for name, values in nees.items()},
        scatter={name: float(values.std(ddof=1) / np.sqrt(runs)) for name, values in nees.items()},
        rms={name: float(np.sqrt(value)) for name, value in squares.items()},
    )


def _look(vectors, axis):
    """Return the angle about one axis, to first order, measured by the two directions across it at rest in the fixed frame."""
    second, third = (axis + 1) % 3, (axis + 2) % 3
    # A small rotation δ about ``axis`` changes the body components: e_second moves by −δ along e_third, e_third by +δ along e_second.
    return 0.5 * (vectors[third].vector_b[:, second] - vectors[second].vector_b[:, third])


def augmented(angle, looks, spec, shaping, every, dt, variance, start):
    """Return errors (m + 1, 3) and variance (m + 1,) of Kalman filters with flicker states, one per axis at rest, all three at once.

    States: error angle, drift (turn-on bias and random walk), flicker states. ``angle`` (m + 1, 3) is the integrated gyro output, ``looks``
    (m, 3) the measured angles, both of axes whose true angle is 0.
    """
    n = 2 + len(shaping.gains)
    # One sample: the angle error grows by the drift and the flicker of the interval.
    F, Q = np.eye(n), np.zeros((n, n))
    F[2:, 2:] = np.diag(shaping.poles)
    F[0, 1] = dt
    drive = np.concatenate([[spec.bias_instability * shaping.gains.sum() * dt, 0.0], np.ones(n - 2)])
    F[0, 2:] = spec.bias_instability * dt * shaping.gains * shaping.poles
    Q += np.outer(drive, drive)
    Q[0, 0] += spec.angle_random_walk**2 * dt + spec.rate_random_walk**2 * dt**3 / 3.0
    Q[0, 1] += 0.5 * spec.rate_random_walk**2 * dt**2
    Q[1, 0] = Q[0, 1]
    Q[1, 1] += spec.rate_random_walk**2 * dt
    whole, total = np.eye(n), np.zeros((n, n))
    for _ in range(every):
        total = F @ total @ F.T + Q
        whole = F @ whole
    P = np.zeros((n, n))
    P[0, 0], P[1, 1] = start**2, spec.turn_on_bias_sigma**2
    P[2:, 2:] = shaping.covariance
    x = np.zeros((n, 3))
    H = np.eye(n)[0]
    errors, variances = [x[0].copy()], [P[0, 0]]
    for gained, look in zip(angle[1:], looks, strict=True):
        x, P = whole @ x, whole @ P @ whole.T + total
        # The gyro's integrated angle minus the true one (zero, at rest) is the error angle, which ``look`` measures.
        gain = P @ H / (P[0, 0] + variance)
        x = x + np.outer(gain, (gained - look) - x[0])
        P = P - np.outer(gain, H @ P)
        P = 0.5 * (P + P.T)
        errors.append(x[0] - gained)
        variances.append(P[0, 0])
    return np.array(errors), np.array(variances)


def draw(result, path):
    """Draw the mean NEES of each filter by preset, and write the figure."""
    figure, ax = plots.new_figure(size=(9.0, 4.5))
    place = np.arange(len(result.outcomes))
    student = t.ppf(0.995, result.runs - 1)
    words = {"control": "control: a gyro without flicker", "own": "own: flicker not modelled"}
    for number, name in enumerate(FILTERS):
        value, scatter = np.array([(outcome.anees[name], outcome.scatter[name]) for outcome in result.outcomes]).T
        look = {"fmt": "o", "ms": 5, "capsize": 3, "color": style.CYCLE[number], "label": words.get(name, name)}
        ax.errorbar(place + 0.15 * (number - 1.5), value, student * scatter, **look)
    ax.axhline(1.0, color="k", lw=0.8)
    ax.set_xlim(-0.5, len(place) - 0.5)
    ax.set_xticks(place, [outcome.preset for outcome in result.outcomes])
    ax.set_ylabel("mean NEES of the attitude / 3 (1: consistent)")
    ax.set_title(f"{result.runs} runs of {result.duration:g} s; bars: 99 %")
    style.legend_below(figure, [ax], ncols=len(FILTERS))
    return plots.save(figure, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/flicker"))
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    for outcome in main(**vars(parser.parse_args())).outcomes:
        ratios = ", ".join(
            f"{name} {outcome.anees[name]:.3f} ± {outcome.scatter[name]:.3f} ({outcome.rms[name] / ARCSECOND:.3g}″)"
            for name in FILTERS
        )
        print(f"{outcome.preset:12s} {ratios}")
