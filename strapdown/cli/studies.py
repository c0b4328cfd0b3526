"""The coning study."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

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
    show,
    tables_folder,
    tables_written,
    written,
)
from strapdown.files import usable_folder, writable, write_json
from strapdown.units import DEGREE

if TYPE_CHECKING:
    from strapdown.coning import Algorithm
    from strapdown.montecarlo.coning_study import ConingParameters

MIN_SAMPLES_A_CYCLE = 0.1
"""Minimum number of gyro samples per cone cycle; with fewer, a step contains more than ten cycles and the results are meaningless."""


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
    if own:
        show(coning_study.own_table(own))
    with progress_bar("Monte Carlo runs", motion.runs) as advance:
        study = coning_study.run(parameters, progress=advance)
    summary = study.summary()
    write_json(out / "coning.json", summary)
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
    for table in coning_study.tables(summary):
        show(table)
    paths = plots.draw_coning_study(study, out, form)
    written(out / "coning.json", *paths, *tables_written(tables, *coning_study.tables(summary)))
