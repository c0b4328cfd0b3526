"""The filter on the microcontroller is the one that was tuned in Python.

A filter is tuned on a simulated record of a hand-held unit, exported as C99, compiled, and run over the samples of another record, as is
the filter of :func:`strapdown.estimate`. The figure shows both errors with ±3σ and their difference, which is rounding in double
precision; single precision is for a microcontroller. ``benchmarks/export.py`` measures size and time.

Run it: ``python sims/export_filter.py``. It needs a C compiler.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import strapdown as sd
from strapdown import plots, quaternion
from strapdown.checks import Array
from strapdown.records import Estimate, ImuRecord
from strapdown.units import DEGREE

SMALL = {"duration": 10.0}
"""Arguments of a quick test run."""
RATE = 100.0
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic")

LOOP = """
#include <stdio.h>
#include "strapdown_filter.h"

/* Rows of doubles on stdin: sensor (-1: gyro), dt, value (3). On stdout, before each further gyro row and at the end: attitude, sigma. */
static void put(const strapdown_filter *f) {
    strapdown_real sigma[STRAPDOWN_STATES];
    double out[10];
    strapdown_sigma(f, sigma);
    for (int i = 0; i < 4; i++) out[i] = f->attitude[i];
    for (int i = 0; i < 6; i++) out[4 + i] = sigma[i];
    fwrite(out, sizeof out, 1, stdout);
}
int main(void) {
    double row[5];
    int steps = 0;
    strapdown_filter f;
    const strapdown_real start[4] = START;
    strapdown_init(&f, start);
    while (fread(row, sizeof row, 1, stdin) == 1) {
        const strapdown_real v[3] = {(strapdown_real)row[2], (strapdown_real)row[3], (strapdown_real)row[4]};
        switch ((int)row[0]) {
        CASES
        default:
            if (steps++) put(&f);
            strapdown_predict(&f, v, (strapdown_real)row[1]);
        }
    }
    put(&f);
    return 0;
}
"""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Errors and differences."""

    difference: float
    """Largest angle between the attitudes in C, double precision, and in Python, rad."""
    difference_single: float
    """The same in single precision, in units of σ."""
    attitudes: dict[str, Array]
    """q_fb of the filters in C after each gyro sample and its measurements (n, 4), by precision."""
    sigma: Array
    """σ of attitude and bias (n, 6), in double precision."""


def simulated(duration: float, seed: int, run: int) -> ImuRecord:
    """Return a record of a hand-held unit with accelerometer and magnetometer."""
    motion = sd.motion.SpinCone(angle=0.4, precession_rate=2.0, spin_rate=-1.5)
    noise = sd.GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias_sigma=5e-3)
    up = sd.VectorSensor(name="accelerometer", reference_f=[0.0, 0.0, 1.0], sigma=0.02, rate=RATE)
    north = sd.VectorSensor(name="magnetometer", kind="heading", reference_f=[0.0, 1.0, -2.0], sigma=0.03, rate=RATE)
    scenario = sd.Scenario(motion=motion, gyro=noise, sensors=(up, north), rate=RATE, duration=duration)
    return sd.simulate(scenario, seed=seed, run=run)


def rows_of(record: ImuRecord) -> Array:
    """Return the samples in order of time: sensor (−1: gyro), dt, value (3)."""
    rates = record.increments / record.intervals[:, None]
    parts = [(record.time[1:], -1, np.column_stack([record.intervals, rates]))]
    for i, series in enumerate(record.vectors):
        parts.append((series.time, i, np.column_stack([np.zeros(len(series.time)), series.vector_b])))
    time = np.concatenate([t for t, _, _ in parts])
    sensor = np.concatenate([np.full(len(t), i) for t, i, _ in parts])
    values = np.concatenate([v for _, _, v in parts])
    order = np.lexsort((sensor, np.round(time * 1e6)))
    return np.column_stack([sensor, values])[order]


def in_c(setup: sd.FilterSetup, record: ImuRecord, start: Array, folder: Path, precision: str) -> tuple[Array, Array]:
    """Export the filter, compile it, and run it over a record; return its attitudes (n, 4) and σ (n, 6)."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise SystemExit("there is no C compiler: install one, for example gcc")
    folder.mkdir(parents=True, exist_ok=True)
    sd.export(setup, record, folder=folder, precision=precision)  # type: ignore[arg-type]
    names = [series.sensor for series in record.vectors]
    cases = "\n".join(f"case {i}: strapdown_update_{name}(&f, v); break;" for i, name in enumerate(names))
    text = LOOP.replace("CASES", cases).replace("START", "{" + ", ".join(f"{x!r}" for x in start.tolist()) + "}")
    (folder / "run.c").write_text(text, encoding="utf-8")
    subprocess.run([compiler, *FLAGS, "run.c", "strapdown_filter.c", "-o", "run", "-lm"], cwd=folder, check=True)
    done = subprocess.run([folder / "run"], input=rows_of(record).tobytes(), capture_output=True, check=True)
    return tuple(np.hsplit(np.frombuffer(done.stdout).reshape(-1, 10), [4]))  # type: ignore[return-value]


def draw(record: ImuRecord, estimate: Estimate, result: Result, place: Path) -> Path:
    """Draw both errors and their difference."""
    assert record.truth is not None
    figure, (top, bottom) = plots.new_figure(2, 1, sharex=True)
    time, sigma = record.time[1:], result.sigma[:, 2] / DEGREE
    top.fill_between(time, -3.0 * sigma, 3.0 * sigma, color="0.85", label="±3σ")
    looks = (("Python", "-", estimate.attitude[1:]), ("C, double", "--", result.attitudes["double"]))
    for label, line, attitude in looks:
        error = quaternion.rotation_between(attitude, record.truth.attitude[1:])
        top.plot(time, error[:, 2] / DEGREE, line, label=label)
    bound = 4.5 * sigma[len(time) // 20 :].max()
    top.set(ylabel="attitude error z, °", ylim=(-bound, bound))
    top.legend(ncols=3)
    for precision, attitude in result.attitudes.items():
        angle = quaternion.angle_between(estimate.attitude[1:], attitude) / DEGREE
        bottom.plot(time, np.maximum(angle, 1e-17), label=f"C, {precision}")
    bottom.set(xlabel="time, s", ylabel="difference from Python, °", yscale="log")
    bottom.legend(ncols=2, loc="center right")
    return plots.save(figure, place)


def main(*, duration: float = 60.0, seed: int = 1, out: str | os.PathLike[str] | None = None) -> Result:
    """Tune, export, compile and compare. Source code and figure are written to ``out``, or to a temporary folder."""
    training, record = simulated(duration, seed, 0), simulated(duration, seed, 1)
    guess = sd.FilterSetup(
        process_noise=sd.ProcessNoise(angle_random_walk=3e-4, rate_random_walk=3e-5),
        attitude_sigma=0.2,
        bias_sigma=5e-3,
    )
    free = ["gyro.arw", "accelerometer.sigma", "magnetometer.sigma"]
    setup = replace(sd.tune(training, setup=guess, free=free, starts=1, seed=seed).setup, gate=sd.Gate(recovery=None))
    assert record.truth is not None
    start = quaternion.multiply(record.truth.attitude[0], quaternion.exp([0.1, -0.1, 0.2]))
    initial = sd.initial_state(start, attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma)
    estimate = sd.estimation.setup.run(record, setup, initial)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch if out is None else out)
        outputs = {name: in_c(setup, record, start, folder / name, name) for name in ("double", "single")}
    attitudes, sigma = {name: attitude for name, (attitude, _) in outputs.items()}, outputs["double"][1]
    apart = {name: quaternion.angle_between(estimate.attitude[1:], q) for name, q in attitudes.items()}
    result = Result(
        difference=float(apart["double"].max()),
        difference_single=float((apart["single"] / np.linalg.norm(sigma[:, :3], axis=1)).max()),
        attitudes=attitudes,
        sigma=sigma,
    )
    if out is not None:
        draw(record, estimate, result, Path(out) / "export_filter.png")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/export_filter"))
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--seed", type=int, default=1)
    result = main(**vars(parser.parse_args()))
    print(f"largest difference: double {result.difference:.1e} rad, single {result.difference_single:.1e} σ")
