"""Attitude in real time: samples from a socket at 1 kHz, filtered and drawn as they arrive.

A thread simulates an inertial unit: it sends each sample of a simulated hand motion as a datagram to the loopback interface when it is due,
the magnetometer's at 100 Hz with 20 ms of delay. The main thread reads the socket and filters by :class:`strapdown.LiveFilter`, whose
look-back processes delayed samples at their time, and draws: with ``--show`` ten times a second in a window, else once at the end.

Run it: ``python sims/live.py --show --duration 30``.
"""

from __future__ import annotations

import argparse
import os
import socket
import struct
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import strapdown as sd
from strapdown import plots, quaternion
from strapdown.checks import Array
from strapdown.estimation import LiveFilter
from strapdown.plots import style
from strapdown.records import ImuRecord
from strapdown.units import DEGREE

RATE = 1000.0
LATENCY = 0.02
"""Delay of the magnetometer, s."""
SAMPLE = struct.Struct("<Bd3d")
"""Sensor, time of the sample in s, and its three components; those of the gyro are the mean rate since the last sample."""
GYRO, ACCELEROMETER, MAGNETOMETER, END = range(4)
NAMES = {ACCELEROMETER: "accelerometer", MAGNETOMETER: "magnetometer"}
DRAWN = 0.1
"""Interval between drawings, s."""

SMALL = {"duration": 1.0}
"""Arguments of a quick test run."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Estimates and timing of the stream."""

    time: Array
    """Times of the estimates (n,), s."""
    error: Array
    """Angle between estimated and true attitude (n,), rad."""
    sigma: Array
    """Root of the trace of the attitude's covariance (n,), rad."""
    update: float
    """Median time of an update, s."""
    behind: float
    """99th percentile of the time from when a gyro sample is due to its estimate, s."""
    late: int
    """Number of measurements delayed beyond the look-back."""


def simulated(duration: float, seed: int) -> ImuRecord:
    """Return a record of a hand-held unit."""
    motion = sd.motion.SpinCone(angle=0.4, precession_rate=2.0, spin_rate=-1.5)
    noise = sd.GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias_sigma=5e-3)
    up = sd.VectorSensor(name="accelerometer", reference_f=[0.0, 0.0, 1.0], sigma=0.02, rate=RATE)
    field = sd.VectorSensor(name="magnetometer", reference_f=[0.0, 1.0, -2.0], sigma=0.02, rate=RATE / 10.0)
    return sd.simulate(
        sd.Scenario(motion=motion, gyro=noise, sensors=(up, field), rate=RATE, duration=duration), seed=seed
    )


def datagrams(record: ImuRecord) -> list[tuple[float, bytes]]:
    """Return the samples of a record, each with the time at which it is to be sent, s."""
    rates = record.rates
    due = [(t, GYRO, t, value) for t, value in zip(record.time[1:].tolist(), rates.tolist(), strict=True)]
    for sensor, series in zip(NAMES, record.vectors, strict=True):
        delay = LATENCY if sensor == MAGNETOMETER else 0.0
        pairs = zip(series.time.tolist(), series.vector_b.tolist(), strict=True)
        due += [(t + delay, sensor, t, value) for t, value in pairs]
    return [(at, SAMPLE.pack(sensor, t, *value)) for at, sensor, t, value in sorted(due)]


def send(due: list[tuple[float, bytes]], address: tuple[str, int], begin: float) -> None:
    """Send each sample when it is due; ``begin`` is the start by :func:`time.perf_counter`."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for at, sample in due:
            wait = begin + at - time.perf_counter()
            if wait > 0.0:
                time.sleep(wait)
            out.sendto(sample, address)
        out.sendto(SAMPLE.pack(END, 0.0, 0.0, 0.0, 0.0), address)


def axes_of(show: bool) -> Any:
    """Return axes in a window, or in a figure that is saved."""
    if not show:
        return plots.new_figure()[1]
    import matplotlib.pyplot as plt

    _, axes = plt.subplots()
    plt.show(block=False)
    return axes


def draw(axes: Any, rows: Array) -> None:
    """Draw rows of time, error and σ."""
    axes.clear()
    axes.plot(rows[:, 0], rows[:, 1] / DEGREE, color=style.VERMILION, label="error, total angle")
    axes.plot(rows[:, 0], rows[:, 2] / DEGREE, color=style.BLUE, label="σ, root sum square of the three axes")
    axes.set(xlabel="time, s", ylabel="attitude, °", yscale="log")
    axes.grid(visible=True, alpha=0.25)
    axes.legend()


def receive(inlet: socket.socket, live: LiveFilter, truth: Array, begin: float, window: Any) -> Any:
    """Filter the stream until its end; return time, error and σ (n, 3), and the durations of updates and samples."""
    rows, took, behind, drawn = [], [], [], 0.0
    while True:
        sensor, t, *value = SAMPLE.unpack(inlet.recv(SAMPLE.size))
        if sensor == END:
            return np.array(rows), took, behind
        start = time.perf_counter()
        if sensor == GYRO:
            live.update(t, value)
        else:
            live.update(t, **{NAMES[sensor]: value})
        end = time.perf_counter()
        took.append(end - start)
        if sensor != GYRO:
            continue
        behind.append(end - begin - t)
        if t >= drawn:
            drawn = t + (DRAWN if window else DRAWN / 20.0)
            error = quaternion.angle_between(truth[round(t * RATE)], live.attitude)
            rows.append((t, float(error), float(np.sqrt(np.trace(live.covariance[:3, :3])))))
            if window:
                draw(window, np.array(rows[-100:]))
                window.figure.canvas.draw_idle()
                window.figure.canvas.flush_events()


def main(
    *, duration: float = 10.0, show: bool = False, seed: int = 1, out: str | os.PathLike[str] | None = None
) -> Result:
    """Send and filter a stream of ``duration`` seconds. The figure is written to ``out`` if it is given."""
    record = simulated(duration, seed)
    assert record.truth is not None
    truth = record.truth.attitude
    start = quaternion.multiply(truth[0], quaternion.exp([0.1, -0.1, 0.2]))
    initial = sd.initial_state(start, attitude_sigma=0.2, bias_sigma=5e-3)
    noise = sd.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
    live = LiveFilter(noise, initial, sensors=record.vectors, look_back=10.0 * LATENCY)
    axes, due = axes_of(show), datagrams(record)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inlet:
        inlet.bind(("127.0.0.1", 0))
        inlet.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        inlet.settimeout(5.0)
        begin = time.perf_counter() + 0.1
        threading.Thread(target=send, args=(due, inlet.getsockname(), begin), daemon=True).start()
        rows, took, behind = receive(inlet, live, truth, begin, axes if show else None)
    if out is not None:
        draw(axes, rows)
        plots.save(axes.figure, Path(out) / "live.png")
    return Result(
        time=rows[:, 0],
        error=rows[:, 1],
        sigma=rows[:, 2],
        update=float(np.median(took)),
        behind=float(np.quantile(behind, 0.99)),
        late=live.late,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/live"))
    parser.add_argument("--duration", type=float, default=10.0, help="s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="draw in a window while it runs")
    result = main(**vars(parser.parse_args()))
    print(
        f"{1e6 * result.update:.1f} µs per update, {1e3 * result.behind:.2f} ms behind at most (99 %), {result.late} too late; "
        f"at the end error {result.error[-1] / DEGREE:.2f}°, σ {result.sigma[-1] / DEGREE:.2f}°"
    )
