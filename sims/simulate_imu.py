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
from scipy.signal import periodogram

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
    spectra = {}
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
        draw(result, Path(out) / "simulate_imu.png")
    return result


def spectrum(rates, rate):
    """Return bands, the number of independent values in each, and the PSD averaged over axes and bands, with a half-sine window.

    The half sine leaks as f⁻⁴, as needed for a spectrum of f⁻²; of three neighbouring lines two count as independent.
    """
    _, power = periodogram(rates, rate, window="cosine", detrend=False, axis=0)
    middle, counts, values = in_bands(0.5 * power.mean(axis=1))  # two-sided
    return middle * rate / len(rates), 2.0 * counts, values


def in_bands(lines):
    """Return centre (in lines), number of lines and mean of logarithmic bands of the lines of a spectrum."""
    edges = np.unique(np.geomspace(4, len(lines) - 1, 60).astype(int))
    counts = np.diff(edges)
    values = np.array([lines[a:b].mean() for a, b in itertools.pairwise(edges)])
    return np.sqrt(edges[:-1] * np.maximum(edges[1:] - 1.0, edges[:-1])), counts, values


def draw(result, path):
    """Draw the spectra with the theoretical ones, and the drifting bias of the three axes, and write the figure."""
    figure, (left, right) = plots.new_figure(1, 2, size=(11.0, 4.5))
    scale = units.DEGREE_PER_HOUR**2
    for colour, (name, values) in zip(style.CYCLE, result.spectra.items(), strict=False):
        rings = {"ms": 6, "mfc": "none"} if name == "whole" else {"ms": 3}  # around the points of the dominant term
        left.loglog(result.frequency, values / scale, "o", color=colour, label=f"{name}, simulated", **rings)
        left.loglog(result.frequency, result.theory[name] / scale, "-", color=colour, lw=1.0)
    left.set(
        xlabel="frequency, Hz", ylabel="two-sided PSD, (°/h)²/Hz", title=f"{result.preset} at rest (lines: theory)"
    )
    left.legend(frameon=False)
    bias = result.bias / units.DEGREE_PER_HOUR
    apart = np.ceil(2.0 * np.abs(bias).max())
    for number, axis in enumerate("xyz"):
        right.plot(result.time, bias[:, number] - number * apart, lw=0.7, label=axis)
    right.set(xlabel="time, s", ylabel=f"bias minus turn-on bias, axes {apart:g} °/h apart, °/h")
    style.legend_above(right)
    return plots.save(figure, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/simulate_imu"))
    parser.add_argument("--preset", choices=datasheets.PRESETS, default="stim300", help="gyro")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    outcome = main(**vars(arguments))
    for part, score in outcome.worst.items():
        print(f"{part:18s} largest deviation from theory {score:.2f} standard deviations")
    print(f"figure: {arguments.out}")
