"""Calibration of a unit by hand: whether its σ are true, and what it gives the next recording.

Each unit has errors of a consumer-grade IMU, drawn at random: gyro matrix 1 %, bias 0.5 °/s; accelerometer matrix 0.5 %, bias
0.15 m/s²; hard iron of a third of the field, soft iron 5 %; magnetometer 8 ms late. It is turned by hand with pauses of four seconds, and
moved with velocities of decimetres per second. Its calibration (:func:`strapdown.calibrate`) is compared with the truth: RMS error, σ,
and the share of errors within 1.96 σ, which is 95 % for a true σ. A second recording of the same unit is estimated without and with the
calibration.

Run ``python sims/calibration.py [--out FOLDER] [--units NUMBER]`` (some seconds a unit).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

import strapdown as sd
from strapdown import plots, quaternion
from strapdown.calibration import SensorErrors, UnitCalibration
from strapdown.checks import Array
from strapdown.motion import Harmonic, HarmonicRates
from strapdown.plots.style import BLUE, VERMILION
from strapdown.randomness import generator
from strapdown.recordings import Recording
from strapdown.results import Column, Table
from strapdown.units import DEGREE

RATE = 100.0
FIELD_F = np.array([0.0, 20.0, -43.0])
"""Field, µT, East-North-Up."""
DELAY = 0.008
"""Delay of the magnetometer, s."""
PERIOD, PAUSE = 20.0, 4.0
"""Time from one pause to the next, and duration of a pause, s."""
VELOCITY_SIGMA, VELOCITY_TIME = 0.25, 0.3
"""Velocity of the hand: σ of each component, m/s, and correlation time, s."""
GROUPS = {
    "gyro_bias": ("gyro bias, °/s", DEGREE),
    "gyro_matrix": ("gyro matrix, %", 0.01),
    "accelerometer_bias": ("accelerometer bias, m/s²", 1.0),
    "accelerometer_matrix": ("accelerometer matrix, %", 0.01),
    "hard_iron": ("hard iron, µT", 1.0),
    "magnetometer_matrix": ("magnetometer matrix, %", 0.01),
    "magnetometer_delay": ("magnetometer delay, ms", 1e-3),
}
"""Errors of the table and of the figure: name and unit."""
SMALL = {"units": 1, "duration": 40.0}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Results of the study."""

    errors: dict[str, Array]
    """Estimated minus true (units, entries) by name."""
    sigma: dict[str, Array]
    """Their σ."""
    attitude: Array
    """RMS attitude error of the second recording without and with the calibration, rad (units, 2)."""

    def coverage(self, name: str) -> float:
        """Return the share of errors within 1.96 σ."""
        return float(np.mean(np.abs(self.errors[name]) < 1.96 * self.sigma[name]))


def drawn_unit(seed: int) -> SensorErrors:
    """Return the errors of a unit.

    The accelerometer defines the body axes, so its matrix is symmetric; the strength of the field is not known to a calibration, so the
    trace of the magnetometer's matrix is zero.
    """
    random = generator(seed, 0, "unit")
    draw = lambda *shape: random.standard_normal(shape)  # noqa: E731
    matrix, soft_iron = draw(2, 3, 3)
    return SensorErrors(
        gyro_bias=0.5 * DEGREE * draw(3),
        gyro_matrix=0.01 * draw(3, 3),
        accelerometer_bias=0.15 * draw(3),
        accelerometer_matrix=0.0035 * (matrix + matrix.T) / np.sqrt(2.0),
        hard_iron=15.0 * draw(3),
        magnetometer_matrix=0.05 * (soft_iron - np.trace(soft_iron) / 3.0 * np.eye(3)),
        magnetometer_delay=DELAY,
    )


def simulated(unit: SensorErrors, seed: int, run: int, duration: float, *, pauses: bool = True) -> Recording:
    """Return a recording of a unit that is turned and moved by hand, at rest every :data:`PERIOD` seconds, or only at the start."""
    random = generator(seed, run, "hand")
    n = round(duration * RATE) + 1
    time = np.arange(n) / RATE
    at_rest = np.mod(time, PERIOD) < PAUSE if pauses else time < PAUSE
    speed = uniform_filter1d(uniform_filter1d((~at_rest).astype(float), 51), 51)
    along = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) / RATE
    turns = HarmonicRates(
        harmonics=tuple(
            Harmonic(amplitude=0.8 * random.standard_normal(3), frequency=f, phase=random.uniform(0.0, 2.0 * np.pi))
            for f in (0.07, 0.13, 0.23, 0.31, 0.47)
        )
    )
    decay = np.exp(-1.0 / (RATE * VELOCITY_TIME))
    drive = VELOCITY_SIGMA * np.sqrt(1.0 - decay**2) * random.standard_normal((n, 3))
    velocity = speed[:, None] * uniform_filter1d(lfilter([1.0], [1.0, -decay], drive, axis=0), 11, axis=0)
    start = quaternion.normalize(random.standard_normal(4))
    attitude = quaternion.multiply(start, turns.attitude(along))
    rate = turns.body_rate(along) * speed[:, None]
    inverse = quaternion.conjugate(attitude)
    force = quaternion.rotate(inverse, np.gradient(velocity, 1.0 / RATE, axis=0) + np.array([0.0, 0.0, 9.80665]))
    field = quaternion.rotate(inverse, FIELD_F)
    late = np.stack([np.interp(time - unit.magnetometer_delay, time, axis) for axis in field.T], axis=1)
    white = random.standard_normal((3, n, 3))
    measured = lambda true, matrix, bias: true @ (np.eye(3) + matrix).T + bias  # noqa: E731
    return Recording(
        source=f"simulated {seed}, {run}",
        time=time,
        rate=measured(rate, unit.gyro_matrix, unit.gyro_bias) + 0.1 * DEGREE * white[0],
        specific_force=measured(force, unit.accelerometer_matrix, unit.accelerometer_bias) + 0.03 * white[1],
        magnetic_field=measured(late, unit.magnetometer_matrix, unit.hard_iron) + 0.3 * white[2],
        magnetic_unit="uT",
        true_attitude=attitude,
        movement=time > PAUSE,
    )


def attitude_error(recording: Recording, calibration: UnitCalibration | None) -> float:
    """Return the RMS error of the total attitude, rad."""
    estimate = sd.estimate(recording, calibration=calibration, latency=0.0)
    return sd.accuracy(estimate).given["movement"]["total"].rms


def main(*, units: int = 20, duration: float = 120.0, seed: int = 1, out: Path | None = None) -> Result:
    """Calibrate ``units`` units, each turned for ``duration`` s; figure and table are written to ``out`` if it is given."""
    errors: dict[str, list[Array]] = {name: [] for name in GROUPS}
    sigma: dict[str, list[Array]] = {name: [] for name in GROUPS}
    attitude = []
    for k in range(units):
        unit = drawn_unit(seed + k)
        calibrated = sd.calibrate(simulated(unit, seed + k, 0, duration))
        for name in GROUPS:
            true, value, own = (np.ravel(getattr(source, name)) for source in (unit, calibrated, calibrated.sigma))
            errors[name].append(value - true)
            sigma[name].append(own)
        second = simulated(unit, seed + k, 1, 40.0, pauses=False)
        attitude.append([attitude_error(second, calibration) for calibration in (None, calibrated)])
    result = Result(
        errors={name: np.array(rows) for name, rows in errors.items()},
        sigma={name: np.array(rows) for name, rows in sigma.items()},
        attitude=np.array(attitude),
    )
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "calibration.txt").write_text(table(result).text + "\n", encoding="utf-8")
        draw(result, out / "calibration.png")
    return result


def draw(result: Result, path: Path) -> Path:
    """Draw each error with its ±1.96 σ and write the figure."""
    figure, grid = plots.new_figure(2, 3, size=(10.0, 6.0))
    for ax, name in zip(grid.flat, GROUPS, strict=False):
        words, unit = GROUPS[name]
        error, bound = (x.ravel() / unit for x in (result.errors[name], 1.96 * result.sigma[name]))
        place = np.arange(len(error))
        inside = np.abs(error) < bound
        for kept, colour in ((inside, BLUE), (~inside, VERMILION)):
            ax.errorbar(place[kept], error[kept], bound[kept], fmt=".", color=colour, markersize=4, linewidth=0.6)
        ax.axhline(0.0, color="black", linewidth=0.7)
        ax.set(title=f"{words}:\n{100 * np.mean(inside):.0f} % contain the truth", xticks=[])
    for ax in grid[1]:
        ax.set_xlabel("entries of all units")
    for ax in grid[:, 0]:
        ax.set_ylabel("error with 95 % interval")
    return plots.save(figure, path)


def table(result: Result) -> Table:
    """Return errors, σ and coverage as a table."""
    rms = lambda x: np.sqrt(np.mean(x**2))  # noqa: E731
    rows = [
        (words, rms(result.errors[name]) / unit, rms(result.sigma[name]) / unit, result.coverage(name))
        for name, (words, unit) in GROUPS.items()
    ]
    columns = ["error", Column("RMS error", digits=3), Column("σ (RMS)", digits=3), Column("within 1.96 σ", digits=3)]
    before, after = (rms(column) / DEGREE for column in result.attitude.T)
    note = f"Attitude of a second recording, RMS: {before:.2f}° without the calibration, {after:.2f}° with it."
    return Table(f"Calibration of {len(result.attitude)} units", columns, rows, [note])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/calibration"))
    parser.add_argument("--units", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    print(table(main(**vars(parser.parse_args()))).text)
