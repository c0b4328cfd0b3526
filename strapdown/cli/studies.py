"""The coning study."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from strapdown.checks import InputError, positive
from strapdown.cli.progress import progress_bar
from strapdown.cli.terminal import (
    FORMAT,
    TABLES,
    FigureFormat,
    command,
    console,
    counted,
    say,
    show,
    table,
    tables_folder,
    tables_written,
    verdict,
    writable,
    written,
)
from strapdown.files import usable_folder, write_json
from strapdown.units import DEGREE

if TYPE_CHECKING:
    from strapdown.coning import Algorithm
    from strapdown.montecarlo.coning_study import ConingParameters

MIN_SAMPLES_A_CYCLE = 0.1
"""Minimum number of gyro samples per cone cycle; with fewer, a step contains more than ten cycles and the results are meaningless."""


def _drift(value: float | None) -> str:
    if value is None:
        return "no formula"
    return f"{value:.4g}" if abs(value) > 1e-6 else "rounding"


def _show_own(own: tuple[Algorithm, ...]) -> None:
    """Print the orders and drift constants of the user's algorithms."""
    from strapdown.montecarlo.coning_study import own_summary

    if not own:
        return
    rows = table(
        "Your own algorithms: drift under small coning is −C β² ω (ωh)^n, derived from the coefficients",
        "algorithm",
        "samples",
        "order",
        "n",
        "C",
        "optimum n, C for the same increments",
    )
    rounded = []
    for one in own:
        row = own_summary(one)
        constant = one.drift_constant
        exact = f" = {constant}" if constant.denominator < _SHOWN_DENOMINATOR else ""
        rows.add_row(
            one.name,
            str(one.samples),
            str(one.order),
            str(one.drift_order),
            f"{float(constant):.4g}{exact}",
            f"{row['best_drift_order']}, {row['best_drift_constant']:.4g}",
        )
        if one.drift_order < row["best_drift_order"] and abs(constant) < _ROUNDED:
            rounded.append(
                f"Note: the drift of {one.name} is of order (ωh)^{one.drift_order} with a small constant, as with rounded coefficients. "
                "If they are rounded, give them as fractions or with all digits."
            )
    show(rows)
    say(*rounded)


_SHOWN_DENOMINATOR = 10**7
_ROUNDED = 1e-3
"""A drift constant below this, in an order that the optimum coefficients cancel, is probably due to rounded coefficients."""


@dataclass(frozen=True)
class _Scenario:
    """Motion and runs."""

    angle: float = typer.Option(0.7, help="Half-angle of the cone, degrees.")
    frequency: float = typer.Option(10.0, help="Coning frequency, Hz.")
    rate: float = typer.Option(100.0, help="Sample rate of the gyro, Hz.")
    duration: float = typer.Option(240.0, help="Duration of each run, s.")
    runs: int = typer.Option(100, help="Number of Monte Carlo runs.")
    seed: int = typer.Option(1, help="Seed; the same one gives the same runs.")

    def parameters(self, own: tuple[Algorithm, ...]) -> ConingParameters:
        """Return the parameters of the study, with ``own`` algorithms; raise an error if no algorithm can follow the motion."""
        from strapdown.montecarlo import coning_study

        if positive("--angle", self.angle, unit="degrees") >= 90.0:  # in the unit that it was given in
            raise InputError(f"--angle is {self.angle:g} degrees; the half-angle of a cone must be below 90 degrees")
        found = coning_study.ConingParameters(**{**vars(self), "angle": self.angle * DEGREE, "own": own})
        cycle = self.rate / self.frequency
        if cycle < MIN_SAMPLES_A_CYCLE:
            raise InputError(
                f"rate is {self.rate:g} Hz, {cycle:.3g} samples per cone cycle at {self.frequency:g} Hz, too few for any algorithm; "
                f"raise the rate to at least {MIN_SAMPLES_A_CYCLE:g} samples per cycle"
            )
        return found


@command
def coning(
    motion: _Scenario,
    out: Path = typer.Option(Path("coning-results"), help="Folder for coning.json and the figures."),
    algorithm: list[Path] | None = typer.Option(
        None,
        help="TOML file of your own algorithms, coefficients in the order of textbooks; compared with those of the package. May be given "
        "several times.",
    ),
    form: FigureFormat = FORMAT,
    tables: Path | None = TABLES,
) -> None:
    """Study coning: the drift of each integration algorithm, and its effect on a filter."""
    from strapdown import plots
    from strapdown.coning import read_algorithms
    from strapdown.montecarlo import coning_study

    own = tuple(one for path in algorithm or () for one in read_algorithms(path))
    parameters = motion.parameters(own)
    usable_folder("out", out)
    names = ("drift", "errors", "consistency", *(["algorithms"] if own else []))
    tables_folder(tables)
    writable("out", out / "coning.json", *(out / f"{name}.{form}" for name in names))
    _show_own(own)
    with progress_bar("Monte Carlo runs", motion.runs) as advance:
        study = coning_study.run(parameters, progress=advance)
    summary = study.summary()
    write_json(out / "coning.json", summary)
    _print_study(motion, summary)
    paths = plots.draw_coning_study(study, out, form)
    written(out / "coning.json", *paths, *tables_written(tables, "coning", summary))


def _print_study(motion: _Scenario, summary: dict[str, Any]) -> None:
    scenario = summary["scenario"]
    console.print(
        f"Coning of {motion.angle:g}° at {motion.frequency:g} Hz, gyro sampled at {motion.rate:g} Hz "
        f"({motion.rate / motion.frequency:.3g} samples per cycle); "
        f"{counted(motion.runs, 'run')} of {scenario['duration_s']:g} s, seed {motion.seed}.\n"
    )
    if scenario["duration_s"] != motion.duration:
        console.print(
            f"The duration of the runs is {scenario['duration_s']:g} s, not {motion.duration:g}, an integer number of epochs and steps.\n"
        )
    drift = table(
        "Drift of the integration, °/h about the cone's axis", "algorithm", "samples", "measured", "predicted"
    )
    for row in summary["integration"]:
        drift.add_row(
            row["algorithm"],
            str(row["samples"]),
            *(_drift(row[key]) for key in ("drift_deg_per_hour", "predicted_deg_per_hour")),
        )
    show(drift)
    verdicts = table(
        "The same filter with each algorithm: RMS error / σ of the filter",
        "integration",
        "attitude\narcsec",
        "bias\n°/h",
        "mean z\n°/h",
        "ANEES\nattitude",
        "ANEES\nbias",
        "NIS\n",
        "verdict\n",
    )
    for row in summary["filter"]:
        verdicts.add_row(
            row["integration"],
            f"{row['attitude_rms_arcsec']:.2f}/{row['attitude_sigma_arcsec']:.2f}",
            f"{row['bias_rms_deg_per_hour']:.3g}/{row['bias_sigma_deg_per_hour']:.2g}",
            f"{row['bias_mean_deg_per_hour'][2]:+.3g}",
            f"{row['anees_attitude']:.3f}",
            f"{row['anees_bias']:.3f}" if row["anees_bias"] < 100.0 else f"{row['anees_bias']:.1e}",
            f"{row['nis']:.4f}",
            verdict(row["consistent"]),
        )
    show(verdicts)
    low, high = summary["filter"][0]["anees_bias_bounds"]
    nis_low, nis_high = summary["filter"][0]["nis_bounds"]
    console.print(
        f"ANEES and NIS are per degree of freedom: 1 for a consistent filter. 99 % bounds: ANEES of attitude and of bias "
        f"{low:.3f} to {high:.3f} at one epoch, NIS {nis_low:.4f} to {nis_high:.4f}.\n"
    )
