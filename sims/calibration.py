"""Calibration of a MEMS unit in the field, by rotating it by hand for two minutes: accuracy and consistency.

A consumer-grade gyro with 1 % scale factors, 10 mrad misalignments and 0.5 °/s of bias; a magnetometer with 4 µT of residual hard iron; an
accelerometer with 0.1 m/s² of bias, held in a hand that accelerates by 0.2 m/s². The unit is rotated about all axes. One filter
(:mod:`strapdown.estimation`, 24 states) estimates attitude, gyro bias, the nine entries of the gyro's scale matrix, hard iron,
accelerometer bias and the acceleration of the hand. It is initialised from the first samples, whose heading the hard iron puts in error by
0.2 rad; therefore it is started again from the smoother's estimate of the initial state (:func:`strapdown.estimation.relinearized_start`).
The result without this is reported too.

Reported for each state: its σ before and after, and its RMS error; the NEES over all runs; and the errors of the plain filter on the same
records. The figure shows the errors of one run with the filter's ±3σ.

Run ``python sims/calibration.py [--out FOLDER]`` (a minute).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import coning, consistency, estimation, gyro, plots, quaternion, records
from strapdown.checks import Array
from strapdown.estimation import error_states
from strapdown.estimation.states import ProcessNoise
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.plots.style import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, legend_below
from strapdown.randomness import generator
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario, simulate
from strapdown.units import DEGREE, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR
from strapdown.vectors import Accelerometer, Magnetometer, wahba

FIELD = np.array([0.0, 20e-6, -43e-6])
"""Magnetic field, T, East-North-Up."""
UP = np.array([0.0, 0.0, 9.80665])
BIAS = 0.5 * DEGREE
SWAY_SIGMA, SWAY_TIME = 0.2, 0.3
"""Acceleration of the hand: standard deviation of each component, m/s², and correlation time, s."""
SCALE = error_states.GyroScale(scale_sigma=0.01, misalignment_sigma=0.01)
IRON = error_states.VectorBias(sensor="magnetometer", bias_sigma=4e-6, unit="T", name="hard iron")
FORCE = error_states.VectorBias(sensor="accelerometer", bias_sigma=0.1, unit="m/s²", name="accelerometer bias")
SWAY = error_states.GaussMarkov(
    sensor="accelerometer",
    noise_sigma=SWAY_SIGMA,
    correlation_time=SWAY_TIME,
    frame="fixed",
    unit="m/s²",
    name="acceleration",
)
BLOCKS = (SCALE, IRON, FORCE, SWAY)

SMALL = {"runs": 2, "duration": 10.0}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study."""

    states: tuple[str, ...]
    units: tuple[str, ...]
    prior_sigma: Array
    """Initial σ of each state, in ``units`` (n,)."""
    time: Array
    """Epochs (m,), s."""
    errors: Array
    """True minus estimated (runs, m, n), in ``units``."""
    sigma: Array
    """σ of the first run (m, n)."""
    final_sigma: Array
    """σ at the end, RMS over the runs (n,)."""
    nees: Array
    """NEES of all states at the end, per degree of freedom (runs,)."""
    nees_of_first_start: Array
    """The same without the second start (runs,)."""
    plain_errors: Array
    """Attitude error of the filter without error states (runs, m), rad."""
    rank: int
    """Number of observable directions of the first record."""
    figures: tuple[Path, ...] = ()

    @property
    def anees(self) -> float:
        """Mean NEES at the end per degree of freedom."""
        return float(np.mean(self.nees))

    @property
    def bounds(self) -> tuple[float, float]:
        """Two-sided 99 % bounds of the mean NEES."""
        return consistency.mean_bounds(len(self.states), len(self.nees))


def hand(random: np.random.Generator) -> HarmonicRates:
    """Return slow rotations about all axes, with rates of about 1.5 rad/s."""
    return HarmonicRates(
        harmonics=tuple(
            Harmonic(
                amplitude=tuple(random.normal(0.0, 0.7, 3)),
                frequency=float(random.uniform(0.05, 0.5)),
                phase=float(random.uniform(0.0, 2.0 * np.pi)),
            )
            for _ in range(6)
        )
    )


def simulated(seed: int, run: int, duration: float) -> tuple[ImuRecord, dict[str, Array], Array]:
    """Return a record of a unit drawn from the specification, its true calibration, and the acceleration at the edges (n, 3)."""
    random = generator(seed, run, "unit")
    M = SCALE.sigma.reshape(3, 3) * random.standard_normal((3, 3))
    truth = {SCALE.name: M.ravel(), IRON.name: IRON.sigma * random.standard_normal(3)}
    truth[FORCE.name] = FORCE.sigma * random.standard_normal(3)
    grid = np.arange(round(duration * 100.0) + 1) / 100.0
    sway = SWAY_SIGMA * random.standard_normal((len(grid), 3))
    decay = np.exp(-0.01 / SWAY_TIME)
    for k in range(1, len(grid)):
        sway[k] = decay * sway[k - 1] + np.sqrt(1.0 - decay**2) * sway[k]
    scenario = Scenario(
        motion=hand(random),
        gyro=gyro.GyroSpec(
            angle_random_walk=0.3 * DEGREE_PER_ROOT_HOUR,
            rate_random_walk=30.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR,
            turn_on_bias=BIAS * random.standard_normal(3),
            scale_factor=np.diag(M).copy(),
            misalignment=M - np.diag(np.diag(M)),
        ),
        sensors=(
            Magnetometer(
                name="magnetometer", field_f=FIELD, sigma=5e-7, rate=50.0, kind="vector", hard_iron=truth[IRON.name]
            ),
            Accelerometer(
                name="accelerometer",
                sigma=0.05,
                rate=100.0,
                kind="vector",
                bias=truth[FORCE.name],
                acceleration_f=lambda t: np.stack([np.interp(t, grid, sway[:, i]) for i in range(3)], axis=-1),
            ),
        ),
        rate=200.0,
        duration=duration,
    )
    # The axis of rotation changes: without coning compensation the increments would drift by as much as the bias.
    record = records.compress(simulate(scenario, seed, run), coning.ALGORITHMS["two-sample"])
    return record, truth, sway


def start(record: ImuRecord) -> estimation.State:
    """Return the attitude from the first samples, with its uncertainty due to hard iron and acceleration."""
    series = {s.sensor: s for s in record.vectors}
    up, field = (series[name].vector_b[0] for name in ("accelerometer", "magnetometer"))
    attitude = wahba.from_vertical_and_heading(up, field)
    tilt = np.hypot(SWAY_SIGMA, FORCE.sigma[0]) / UP[2]
    heading = np.hypot(IRON.sigma[0], np.abs(FIELD[2]) * tilt) / FIELD[1]
    # The uncertainty of the heading is about the vertical, here in body axes.
    vertical = up / np.linalg.norm(up)
    P = np.zeros((6, 6))
    P[:3, :3] = tilt**2 * np.eye(3) + (heading**2 - tilt**2) * np.outer(vertical, vertical)
    P[3:, 3:] = BIAS**2 * np.eye(3)
    return estimation.State(attitude=attitude, bias=np.zeros(3), covariance=P)


def main(*, runs: int = 20, duration: float = 120.0, seed: int = 1, out: Path | None = None) -> Result:
    """Calibrate ``runs`` units, each rotated for ``duration`` s; figure and table are written to ``out`` if it is given."""
    noise = ProcessNoise(
        angle_random_walk=0.3 * DEGREE_PER_ROOT_HOUR, rate_random_walk=30.0 * DEGREE_PER_HOUR_PER_ROOT_HOUR
    )
    every = 10
    errors, nees, first_nees, plain, final, sigma, rank, time = [], [], [], [], [], None, 0, np.empty(0)
    for run in range(runs):
        record, truth, sway = simulated(seed, run, duration)
        assert record.truth is not None
        initial = start(record)
        attitude, bias = record.truth.attitude[::every], record.truth.bias[::every]
        reference = {**truth, SWAY.name: sway[::every]}
        first = estimation.run(record, noise, initial, BLOCKS, every=every, full_covariance=True)
        anew = estimation.relinearized_start(record, noise, initial, BLOCKS)
        estimate = estimation.run(record, noise, anew, BLOCKS, every=every, full_covariance=True)
        assert estimate.whole_covariance is not None
        for one, kept in ((first, first_nees), (estimate, nees)):
            error = one.errors(attitude, bias, reference)
            kept.append(consistency.nees(error[-1], one.whole_covariance[-1]) / error.shape[1])
        errors.append(error)
        spread = np.sqrt(np.einsum("kii->ki", estimate.whole_covariance))
        final.append(spread[-1])
        plain.append(quaternion.angle_between(without_blocks(record, noise, initial, every), attitude))
        if run == 0:
            sigma, time = spread, estimate.time
            shown = estimation.observability(record, noise, initial, BLOCKS)
            rank, states, units, prior = shown.rank, shown.states, shown.units, shown.prior_sigma
    assert sigma is not None
    result = Result(
        states=states,
        units=units,
        prior_sigma=prior,
        time=time,
        errors=np.array(errors),
        sigma=sigma,
        final_sigma=np.sqrt(np.mean(np.square(final), axis=0)),
        nees=np.array(nees),
        nees_of_first_start=np.array(first_nees),
        plain_errors=np.array(plain),
        rank=rank,
    )
    if out is None:
        return result
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / "calibration.txt").write_text(table(result) + "\n", encoding="utf-8")
    draw(result, out / "calibration.png")
    return result


def without_blocks(record: ImuRecord, noise: ProcessNoise, initial: estimation.State, every: int) -> Array:
    """Return the attitudes of the plain filter, which models all errors without a state as white noise of equal spectral density."""
    spread = {
        "accelerometer": np.sqrt(0.05**2 + FORCE.sigma[0] ** 2 * 120.0 + 2.0 * SWAY_SIGMA**2 * SWAY_TIME * 100.0),
        "magnetometer": IRON.sigma[0] * np.sqrt(50.0),
    }
    series = tuple(s.noise_scaled(spread[s.sensor] / s.sigma[0]) for s in record.vectors)
    modelled = ImuRecord(time=record.time, increments=record.increments, vectors=series)
    wider = ProcessNoise(angle_random_walk=0.015, rate_random_walk=noise.rate_random_walk)
    return estimation.run(modelled, wider, initial, every=every).attitude


PANELS = (
    ("attitude", slice(0, 3), 1.0 / DEGREE, "attitude, °"),
    ("gyro bias", slice(3, 6), 1.0 / DEGREE, "gyro bias, °/s"),
    ("scale factors", [6, 10, 14], 100.0, "gyro scale factors, %"),
    ("misalignments", [7, 8, 9, 11, 12, 13], 1e3, "gyro misalignments, mrad"),
    ("hard iron", slice(15, 18), 1e6, "hard iron, µT"),
    ("accelerometer bias", slice(18, 21), 1.0, "accelerometer bias, m/s²"),
)
"""Name, states, factor and axis label of each panel."""


def draw(result: Result, path: Path) -> Path:
    """Draw the errors of one run with ±3σ and write the figure."""
    figure, grid = plots.new_figure(2, 3, size=(12.0, 6.2), sharex=True)
    for ax, (_, states, factor, label) in zip(grid.flat, PANELS, strict=True):
        error, sigma = factor * result.errors[0][:, states], factor * result.sigma[:, states]
        envelope = 3.0 * sigma.max(axis=1)
        ax.fill_between(
            result.time, -envelope, envelope, color=SKY, alpha=0.3, linewidth=0, label="±3σ (99.7 %), the largest"
        )
        colours = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, "black")
        names = ("x", "y", "z") if error.shape[1] == 3 else ("xy", "xz", "yx", "yz", "zx", "zy")
        for k, name in enumerate(names):
            ax.plot(result.time, error[:, k], color=colours[k], linewidth=0.9, label=name)
        settled = result.time >= 0.08 * result.time[-1]
        limit = (1.6 if len(names) == 3 else 2.4) * max(envelope[settled].max(), np.abs(error[settled]).max())
        ax.set(title=label, ylim=(-limit, limit))
        ax.axhline(0.0, color="black", linewidth=0.5)
    for ax in grid[1]:
        ax.set_xlabel("time, s")
    for ax in grid[:, 0]:
        ax.set_ylabel("true minus estimated")
    legend_below(figure, [grid[0, 2], grid[1, 0]], ncols=10)
    return plots.save(figure, path)


def table(result: Result) -> str:
    """Return the figures as text."""
    runs, epochs = result.plain_errors.shape
    late = slice(epochs // 2, None)
    low, high = result.bounds
    whole = np.linalg.norm(result.errors[:, late, :3], axis=2)
    lines = [
        f"{runs} units, {result.time[-1]:g} s each; {result.rank} of {len(result.states)} directions observed",
        f"NEES of all states at the end, per degree of freedom: {result.anees:.3f} (99 % bounds {low:.3f} to {high:.3f}); "
        f"from the first start {np.mean(result.nees_of_first_start):.3g}",
        f"attitude error over the second half, RMS: {np.sqrt(np.mean(whole**2)) / DEGREE:.2f}°, "
        f"without the error states {np.sqrt(np.mean(result.plain_errors[:, late] ** 2)) / DEGREE:.2f}°",
        "",
        f"{'state':28s} {'before':>10s} {'after, σ':>10s} {'RMS error':>10s}",
    ]
    rms = np.sqrt(np.mean(result.errors[:, -1] ** 2, axis=0))
    lines += [
        f"{f'{name}, {unit}':28s} {before:10.3g} {after:10.3g} {error:10.3g}"
        for name, unit, before, after, error in zip(
            result.states, result.units, result.prior_sigma, result.final_sigma, rms, strict=True
        )
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/calibration"))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()))))
