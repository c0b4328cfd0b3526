"""Does a simulated gyro have the specified noise? One preset, its spectrum by noise term, and its bias over time.

Run ``python sims/simulate_imu.py [--out FOLDER]``.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import gyro, plots, units
from strapdown.gyro import datasheets
from strapdown.plots import style
from strapdown.randomness import generator

PARTS = {
    "angle random walk": "angle_random_walk",
    "flicker": "bias_instability",
    "rate random walk": "rate_random_walk",
}


@dataclass(frozen=True, kw_only=True)
class Result:
    """A record at rest: spectra by noise term and in total, the theoretical ones, and the bias over time."""

    preset: str
    frequency: np.ndarray
    """Centres of the bands (m,), Hz."""
    spectra: dict[str, np.ndarray]
    """Two-sided PSD of the mean rate by part and ``"whole"``, (rad/s)²/Hz, averaged over axes and bands."""
    theory: dict[str, np.ndarray]
    worst: dict[str, float]
    """Largest deviation from theory, in standard deviations of the estimate."""
    time: np.ndarray
    bias: np.ndarray
    """Bias of the three axes minus the turn-on bias, rad/s."""


SMALL = {"samples": 1 << 14}
"""Arguments of a quick test run."""


def main(*, preset="stim300", samples=1 << 20, rate=100.0, seed=1, out=None):
    """Simulate a preset at rest and compare spectra; figures are written to the folder ``out``.

    Returns
    -------
    Result
    """
    whole = dataclasses.replace(datasheets.PRESETS[preset].spec, g_sensitivity=np.zeros((3, 3)), turn_on_bias_sigma=0.0)
    edges = np.arange(samples + 1) / rate
    outputs = {}
    for name, fields in {**{part: (field,) for part, field in PARTS.items()}, "whole": tuple(PARTS.values())}.items():
        spec = gyro.GyroSpec(**{field: getattr(whole, field) for field in fields})
        outputs[name] = gyro.simulate(spec, np.zeros((samples, 3)), edges, generator(seed, 0, "gyro"))
    frequency, counts, spectra = None, None, {}
    for name, output in outputs.items():
        frequency, counts, spectra[name] = spectrum(output.rates, rate)
    lines = np.fft.rfftfreq(samples, 1.0 / rate)[1:]
    x = np.pi * lines / rate
    theory = {
        "angle random walk": np.full_like(x, whole.angle_random_walk**2),
        "flicker": whole.bias_instability**2 / (2.0 * np.pi * lines),
        # Of means over the sample interval, with aliasing: σ_u² dt² (2 + cos 2x)/(12 sin² x).
        "rate random walk": whole.rate_random_walk**2 / rate**2 * (2.0 + np.cos(2.0 * x)) / (12.0 * np.sin(x) ** 2),
    }
    theory = {name: in_bands(np.concatenate([[0.0], values]))[2] for name, values in theory.items()}
    theory["whole"] = sum(theory.values())
    worst = {name: float(np.max(np.abs(spectra[name] / theory[name] - 1.0) * np.sqrt(counts))) for name in theory}
    thin = slice(None, None, max(1, samples // 4000))
    result = Result(
        preset=preset,
        frequency=frequency,
        spectra=spectra,
        theory=theory,
        worst=worst,
        time=edges[thin],
        bias=outputs["whole"].bias[thin],
    )
    if out is not None:
        page, axes = plots.new_figure(1, 2, size=(11.0, 4.5))
        draw_spectra(result, ax=axes[0])
        draw_bias(result, ax=axes[1])
        plots.save(page, Path(out) / "simulate_imu.png")
    return result


def spectrum(rates, rate):
    """Return bands, the number of independent values in each, and the PSD averaged over axes and bands, with a half-sine window.

    The half sine leaks as f⁻⁴, as needed for a spectrum of f⁻²; of three neighbouring lines two count as independent.
    """
    n = len(rates)
    window = np.sin(np.pi * (np.arange(n) + 0.5) / n)[:, None]
    power = np.mean(np.abs(np.fft.rfft(rates * window, axis=0)) ** 2, axis=1) / (np.sum(window**2) * rate)
    middle, counts, values = in_bands(power)
    return middle * rate / n, 2.0 * counts, values


def in_bands(lines):
    """Return centre (in lines), number of lines and mean of logarithmic bands of the lines of a spectrum."""
    edges = np.unique(np.geomspace(4, len(lines) - 1, 60).astype(int))
    counts = np.diff(edges)
    values = np.array([lines[a:b].mean() for a, b in itertools.pairwise(edges)])
    return np.sqrt(edges[:-1] * np.maximum(edges[1:] - 1.0, edges[:-1])), counts, values


def draw_spectra(result, *, ax):
    """Draw the spectra with the theoretical ones; return the axes."""
    scale = units.DEGREE_PER_HOUR**2
    for number, (name, values) in enumerate(result.spectra.items()):
        rings = {"ms": 6, "mfc": "none"} if name == "whole" else {"ms": 3}  # around the points of the dominant term
        colour = style.CYCLE[number]
        ax.loglog(result.frequency, values / scale, "o", color=colour, label=f"{name}, simulated", **rings)
        ax.loglog(result.frequency, result.theory[name] / scale, "-", color=colour, lw=1.0)
    ax.set_xlabel("frequency, Hz")
    ax.set_ylabel("two-sided PSD, (°/h)²/Hz")
    ax.set_title(f"{result.preset} at rest (lines: theory)")
    ax.legend(frameon=False)
    return ax


def draw_bias(result, *, ax):
    """Draw the drifting bias of the three axes, each in a separate band; return the axes."""
    bias = result.bias / units.DEGREE_PER_HOUR
    band = 2.2 * np.abs(bias).max()
    for number, (axis, values) in enumerate(zip("xyz", bias.T, strict=True)):
        ax.axhline(-number * band, color="0.5", lw=0.6)
        ax.plot(result.time, values - number * band, color=style.CYCLE[number], lw=0.7, label=axis)
    ax.set_xlabel("time, s")
    step = float(f"{0.5 * np.abs(bias).max():.0e}")
    marks = [(k * step - number * band, f"{k * step:g}") for number in range(3) for k in (-1, 0, 1)]
    ax.set_yticks(*zip(*marks, strict=True))  # each axis about its own zero
    ax.set_ylabel("bias minus turn-on bias, °/h")
    ax.set_ylim(-2.6 * band, 0.6 * band)
    style.legend_above(ax)
    return ax


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/simulate_imu"))
    parser.add_argument("--preset", default="stim300", help="name of a gyro's datasheet")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    outcome = main(**vars(arguments))
    for part, score in outcome.worst.items():
        print(f"{part:18s} largest deviation from theory {score:.2f} standard deviations")
    print(f"figure: {arguments.out}")
