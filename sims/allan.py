"""What noises does a gyro at rest have? Simulate a record, draw its Allan deviation, fit the coefficients, compare with the truth.

Run ``python sims/allan.py [FIGURE]``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from strapdown import allan, files, units
from strapdown.randomness import generator

TRUTH = {
    "quantization": 0.35 * units.ARCSECOND,
    "angle_random_walk": 0.1 * units.DEGREE_PER_ROOT_HOUR,
    "bias_instability": 3.0 * units.DEGREE_PER_HOUR,
    "rate_random_walk": 60.0 * units.DEGREE_PER_HOUR_PER_ROOT_HOUR,
    "rate_ramp": 0.0,
}
"""A fibre-optic or good MEMS gyro, SI."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """A record's Allan deviation, its robust twin, the fit, and the curves of fit and truth to draw."""

    truth: dict[str, float]
    deviation: allan.AllanDeviation
    robust: allan.AllanDeviation
    fit: allan.NoiseFit
    fitted_curves: dict[str, np.ndarray]
    true_curve: np.ndarray


def simulate_rest(parameters, samples, dt, stream):
    """Return averaged-rate samples (samples,), rad/s, of a gyro at rest with the given SI coefficients.

    Flicker: spectral lines B²/(2π f) up to Nyquist, of a period 16 times the record. Quantisation: a rounded angle, differenced.
    """
    frequency = np.fft.rfftfreq(16 * samples)
    lines = stream.standard_normal(len(frequency)) + 1j * stream.standard_normal(len(frequency))
    lines[1:] *= np.sqrt(8.0 * samples / (2.0 * np.pi * frequency[1:]))
    lines[0] = 0.0
    rate = parameters["bias_instability"] * np.fft.irfft(lines, 16 * samples)[:samples]
    rate += parameters["angle_random_walk"] / np.sqrt(dt) * stream.standard_normal(samples)
    edge = np.concatenate([[0.0], np.cumsum(stream.standard_normal(samples))])
    walk = 0.5 * (edge[1:] + edge[:-1]) + stream.standard_normal(samples) / np.sqrt(12.0)
    rate += parameters["rate_random_walk"] * np.sqrt(dt) * walk
    rate += parameters["rate_ramp"] * dt * np.arange(samples)
    step = parameters["quantization"] * np.sqrt(12.0)
    if step > 0.0:
        angle = np.concatenate([[0.0], np.cumsum(rate * dt)])
        rate = np.diff(np.round(angle / step) * step) / dt
    return rate


def main(samples=1 << 19, sample_interval=0.01, seed=1, truth=None, figure=None):
    """Simulate, judge and (with ``figure``, a path) draw one record.

    Returns
    -------
    Result
    """
    truth = dict(TRUTH if truth is None else truth)
    rate = simulate_rest(truth, samples, sample_interval, generator(seed, 0, "gyro"))
    deviation = allan.allan_deviation(rate, sample_interval)
    fit = allan.fit_noise(rate, sample_interval)
    result = Result(
        truth=truth,
        deviation=deviation,
        robust=allan.allan_deviation(rate, sample_interval, estimator="robust"),
        fit=fit,
        fitted_curves=allan.model_deviation(allan.to_gyro_parameters(fit), deviation.taus, sample_interval),
        true_curve=allan.model_deviation(truth, deviation.taus, sample_interval)["total"],
    )
    if figure is not None:
        from matplotlib.figure import Figure

        page = Figure(figsize=(8.0, 5.5), layout="constrained")
        axes = draw_allan(result.deviation, result.fit, result.fitted_curves, ax=page.subplots())
        axes.loglog(result.deviation.taus, result.true_curve / units.DEGREE_PER_HOUR, "k:", lw=1.2, label="truth")
        axes.legend(fontsize=8, loc="upper center")
        with files.written_beside(figure) as path:
            page.savefig(path, dpi=140)
    return result


def draw_allan(deviation, fit=None, curves=None, *, axis=0, ax=None):
    """Draw one axis of an Allan deviation with its confidence band and the fitted terms; return the matplotlib axes.

    Parameters
    ----------
    deviation : allan.AllanDeviation
    fit : allan.NoiseFit, optional
        Its values and intervals go to the legend.
    curves : mapping, optional
        Of :func:`strapdown.allan.model_deviation` at the same taus, for that axis.
    axis : int
    ax : matplotlib axes, optional
    """
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.subplots()[1]
    scale = units.DEGREE_PER_HOUR
    band = (deviation.lower[axis] / scale, deviation.upper[axis] / scale)
    ax.fill_between(deviation.taus, *band, color="C0", alpha=0.2, lw=0.0, label=f"{100 * deviation.level:.0f} % band")
    ax.loglog(
        deviation.taus,
        deviation.deviation[axis] / scale,
        "C0o-",
        ms=3,
        lw=1.0,
        label=f"{deviation.estimator} Allan deviation",
    )
    if curves is not None:
        ax.loglog(deviation.taus, curves["total"] / scale, "C3-", lw=1.5, label="fit")
    rows = [] if fit is None else [row for row in allan.table(fit) if row["axis"] == axis]
    for number, row in enumerate(rows):
        name = str(row["term"]).replace("_", " ")
        if not row["supported"]:
            ax.plot([], [], " ", label=f"{name}: not supported, {row['symbol']} < {row['upper']:.3g} {row['unit']}")
        elif curves is not None:
            text = f"{name} {row['symbol']} = {row['estimate']:.3g} ({row['lower']:.3g} … {row['upper']:.3g}) {row['unit']}"
            ax.loglog(deviation.taus, curves[row["term"]] / scale, "--", color=f"C{number + 4}", lw=1.0, label=text)
    low, high = deviation.deviation[axis].min() / scale, deviation.deviation[axis].max() / scale
    ax.set_ylim(0.2 * low, 3.0 * high)
    ax.set_xlabel("averaging time τ (s)")
    ax.set_ylabel("Allan deviation (°/h)")
    ax.grid(visible=True, which="both", lw=0.3)
    ax.legend(fontsize=8, loc="upper center")
    return ax


if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "allan.png")
    outcome = main(figure=where)
    for row in allan.table(outcome.fit):
        true = outcome.truth[str(row["term"])] / allan.UNITS[str(row["term"])][1]
        value = (
            f"{row['estimate']:.4g} [{row['lower']:.4g}, {row['upper']:.4g}]"
            if row["supported"]
            else f"< {row['upper']:.4g}"
        )
        print(f"{row['term']:20s} {value:32s} {row['unit']:8s} truth {true:.4g}")
    print(f"probability of the misfit {outcome.fit.misfit_probability[0]:.2g}; figure: {where}")
