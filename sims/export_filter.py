"""The filter on the microcontroller is the one that was tuned in Python.

A filter is tuned on a simulated record of a hand-held unit, exported as C99, compiled, and run over the samples of another record, as is
the filter of :func:`strapdown.estimate`. The figure shows both errors with ±3σ and their difference, which is rounding in double
precision; single precision is for a microcontroller.

Run it: ``python sims/export_filter.py``. It needs a C compiler.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import strapdown as sd
from strapdown import consistency, plots, quaternion
from strapdown.checks import Array
from strapdown.records import Estimate, ImuRecord
from strapdown.units import DEGREE

SMALL = {"duration": 10.0}
"""Arguments of a quick test run."""
RATE = 100.0
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic")

LOOP = """
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "strapdown_filter.h"

/* Rows of doubles on stdin: sensor (-1: gyro), dt, value (3). On stdout, after each gyro row: attitude, bias, sigma. */
int main(void) {
    static double row[5];
    size_t count = 0, room = 1 << 16;
    double (*rows)[5] = malloc(room * sizeof *rows);
    while (fread(row, sizeof row, 1, stdin) == 1) {
        if (count == room) rows = realloc(rows, (room *= 2) * sizeof *rows);
        for (int i = 0; i < 5; i++) rows[count][i] = row[i];
        count++;
    }
    double (*out)[13] = malloc((count + 1) * sizeof *out), least = 1e9;
    size_t steps = 0;
    for (int repeat = 0; repeat < 5; repeat++) {
        strapdown_filter f;
        const strapdown_real start[4] = START;
        strapdown_init(&f, start);
        steps = 0;
        const clock_t begin = clock();
        for (size_t k = 0; k < count; k++) {
            const strapdown_real v[3] = {(strapdown_real)rows[k][2], (strapdown_real)rows[k][3], (strapdown_real)rows[k][4]};
            switch ((int)rows[k][0]) {
            CASES
            default:
                strapdown_predict(&f, v, (strapdown_real)rows[k][1]);
                steps++;
            }
            for (int i = 0; i < 4; i++) out[steps][i] = f.attitude[i];
            for (int i = 0; i < 3; i++) out[steps][4 + i] = f.bias[i];
            if (repeat == 0) {
                strapdown_real sigma[STRAPDOWN_STATES];
                strapdown_sigma(&f, sigma);
                for (int i = 0; i < 6; i++) out[steps][7 + i] = sigma[i];
            }
        }
        const double took = (double)(clock() - begin) / CLOCKS_PER_SEC / (double)steps;
        if (repeat && took < least) least = took;
    }
    fwrite(out[1], sizeof *out, steps, stdout);
    fprintf(stderr, "%.17g", least);
    free(rows);
    free(out);
    return 0;
}
"""


@dataclass(frozen=True, kw_only=True)
class Exported:
    """A run of the exported filter."""

    attitude: Array
    """q_fb after each gyro sample (n, 4)."""
    bias: Array
    sigma: Array
    """σ of attitude and bias (n, 6)."""
    seconds: float
    """Time of a gyro sample with its measurements, s."""
    text: int | None
    """Machine code, bytes; None without the tool ``size``."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Errors and differences."""

    difference: float
    """Largest angle between the attitudes in C, double precision, and in Python, rad."""
    difference_single: float
    """The same in single precision, in units of σ."""
    double: Exported
    single: Exported
    figure: Path | None


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


def in_c(setup: sd.FilterSetup, record: ImuRecord, start: Array, folder: Path, precision: str) -> Exported:
    """Export the filter, compile it, and run it over a record."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise SystemExit("there is no C compiler: install one, for example gcc")
    sd.export(setup, record, folder=folder, precision=precision)  # type: ignore[arg-type]
    names = [series.sensor for series in record.vectors]
    cases = "\n".join(f"case {i}: strapdown_update_{name}(&f, v); break;" for i, name in enumerate(names))
    text = LOOP.replace("CASES", cases).replace("START", "{" + ", ".join(f"{x!r}" for x in start.tolist()) + "}")
    (folder / "run.c").write_text(text, encoding="utf-8")
    subprocess.run([compiler, *FLAGS, "run.c", "strapdown_filter.c", "-o", "run", "-lm"], cwd=folder, check=True)
    done = subprocess.run([folder / "run"], input=rows_of(record).tobytes(), capture_output=True, check=True)
    out = np.frombuffer(done.stdout).reshape(-1, 13)
    return Exported(
        attitude=out[:, :4],
        bias=out[:, 4:7],
        sigma=out[:, 7:],
        seconds=float(done.stderr),
        text=code_size(folder, compiler),
    )


def code_size(folder: Path, compiler: str) -> int | None:
    """Return the bytes of machine code, optimised for size."""
    if shutil.which("size") is None:
        return None
    subprocess.run([compiler, "-std=c99", "-Os", "-c", "strapdown_filter.c", "-o", "small.o"], cwd=folder, check=True)
    rows = subprocess.run(["size", "small.o"], cwd=folder, check=True, capture_output=True, text=True)
    return int(rows.stdout.splitlines()[1].split()[0])


def draw(record: ImuRecord, estimate: Estimate, double: Exported, single: Exported, place: Path) -> Path:
    """Draw both errors and their difference."""
    assert record.truth is not None
    errors = consistency.errors(
        estimate.attitude[1:], estimate.bias[1:], record.truth.attitude[1:], record.truth.bias[1:]
    )
    in_code = consistency.errors(double.attitude, double.bias, record.truth.attitude[1:], record.truth.bias[1:])
    figure, (top, bottom) = plots.new_figure(2, 1, sharex=True)
    time, unit = record.time[1:], DEGREE
    top.fill_between(time, -3.0 * double.sigma[:, 2] / unit, 3.0 * double.sigma[:, 2] / unit, color="0.85", label="±3σ")
    top.plot(time, errors[:, 2] / unit, label="Python")
    top.plot(time, in_code[:, 2] / unit, "--", label="C, double")
    bound = 4.5 * double.sigma[len(time) // 20 :, 2].max() / unit
    top.set(ylabel="attitude error z, °", ylim=(-bound, bound))
    top.legend(ncols=3)
    for run, label in ((double, "double"), (single, "single")):
        angle = quaternion.angle_between(estimate.attitude[1:], run.attitude) / unit
        bottom.plot(time, np.maximum(angle, 1e-17), label=f"C, {label}")
    bottom.set(xlabel="time, s", ylabel="difference from Python, °", yscale="log")
    bottom.legend(ncols=2, loc="center right")
    return plots.save(figure, place)


def main(*, duration: float = 60.0, seed: int = 1, out: str | os.PathLike[str] | None = None) -> Result:
    """Tune, export, compile and compare. Source code and figure are written to ``out``, or to a temporary folder."""
    import tempfile

    training, record = simulated(duration, seed, 0), simulated(duration, seed, 1)
    guess = sd.FilterSetup(
        process_noise=sd.ProcessNoise(angle_random_walk=3e-4, rate_random_walk=3e-5),
        attitude_sigma=0.2,
        bias_sigma=5e-3,
    )
    setup = sd.tune(
        training, setup=guess, free=["gyro.arw", "accelerometer.sigma", "magnetometer.sigma"], starts=1, seed=seed
    ).setup
    setup = replace(setup, gate=sd.Gate(recovery=None))
    assert record.truth is not None
    start = quaternion.multiply(record.truth.attitude[0], quaternion.exp([0.1, -0.1, 0.2]))
    initial = sd.initial_state(start, attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma)
    estimate = sd.estimation.setup.run(record, setup, initial)
    with tempfile.TemporaryDirectory() as scratch:
        runs = {}
        for precision in ("double", "single"):
            folder = Path(scratch if out is None else out) / precision
            folder.mkdir(parents=True, exist_ok=True)
            runs[precision] = in_c(setup, record, start, folder, precision)
    double, single = runs["double"], runs["single"]
    apart = quaternion.angle_between(estimate.attitude[1:], double.attitude)
    apart_single = quaternion.angle_between(estimate.attitude[1:], single.attitude)
    figure = None if out is None else draw(record, estimate, double, single, Path(out) / "export_filter.png")
    return Result(
        difference=float(apart.max()),
        difference_single=float((apart_single / np.linalg.norm(double.sigma[:, :3], axis=1)).max()),
        double=double,
        single=single,
        figure=figure,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/export_filter"))
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--seed", type=int, default=1)
    result = main(**vars(parser.parse_args()))
    print(
        f"largest difference of the attitude: double {result.difference:.1e} rad, single {result.difference_single:.1e} σ"
    )
    for name, run in (("double", result.double), ("single", result.single)):
        print(f"{name}: {1e9 * run.seconds:.0f} ns per sample with its measurements, {run.text} bytes of machine code")
