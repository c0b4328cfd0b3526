"""Tuning a filter from data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError
from strapdown.cli import terminal as ui
from strapdown.cli.options import FILTER, FORMAT, STATES, Format, Layout
from strapdown.files import write_json


@dataclass(frozen=True, eq=False)
class _Filter:
    """Initial filter."""

    free: list[str] | None = Option(
        None,
        help="Parameters to tune, separated by commas or repeated: gyro.arw, gyro.rrw, SENSOR.sigma, initial.attitude, "
        "initial.bias, gate.probability; or only filter.scale, as for a recording without --truth. Default: gyro and every sensor.",
    )
    filter_file: Path | None = FILTER
    states: bool | None = STATES
    prior: str | None = Option(None, help="Weak prior of the gyro noise: TOML of `strapdown allan`, or a preset.")

    @property
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.tune`."""
        from strapdown.workflows.filters import gyro_of

        names = [name.strip() for name in ",".join(self.free or ()).split(",") if name.strip()]
        setup = self.filter_file and sd.estimation.setup.read_setup(self.filter_file)
        priors = self.prior and gyro_of(self.prior)
        return {"setup": setup, "free": names if self.free else None, "states": self.states, "priors": priors}


@dataclass(frozen=True)
class _Objective:
    """Objective, by default the likelihood of all innovations, and the search."""

    truth: bool = Option(False, "--truth", help="Tune by the likelihood of the errors relative to the truth.")
    gate: bool = Option(False, "--gate", help="Also model outliers, and set the filter's gate.")
    spacing: float = Option(0.0, help="Interval of the samples used, s, with the weight of all.")
    holdout: float | None = Option(None, help="Fraction of each record, its end, held out to compare the filters.")
    starts: int = Option(4, help="Number of searches: one from the filter, the others from random values.")
    seed: int = Option(0, help="Seed of the random values.")
    threads: int | None = Option(None, help="Number of threads. Default: one per core.")


@ui.command("tables")
def tune(
    *,
    records: list[Path] = Argument(help="Records or recordings (BROAD HDF5, CSV), all of one unit."),
    start: _Filter,
    goal: _Objective,
    layout: Layout,
    out: Path = Option(Path("filter.toml"), "--out", "-o", help="TOML for --filter; beside it JSON and figure."),
    form: Format = FORMAT,
) -> None:
    """Tune the filter by maximum likelihood, with a confidence interval for each parameter."""
    from strapdown.report import tunings

    for k, path in enumerate(records):
        if path.exists() and any(path.samefile(other) for other in records[:k] if other.exists()):
            raise InputError(f"{path} is given twice; give each record once")
    beside, drawing = out.with_suffix(".json"), out.with_name(f"{out.stem}-likelihood.{form}")
    ui.check_files(out, suffixes=(".toml",), own=lambda _: tunings.read(beside))
    ui.check_files(beside, drawing, own=tunings.read)
    sources: dict[str, Any] = {}
    for path in records:
        simulated = sd.recordings.is_record(path)
        source: Any = sd.read(path) if simulated else sd.recordings.read(path, **layout.options)
        if start.states and not simulated:
            raise InputError(f"{path} is a recording, which specifies no errors; --states is for simulated records")
        ui.say("" if simulated else source.left_out_words)
        sources[path.name if path.name not in sources else str(path)] = source
    with ui.progress_bar("searches") as advance:
        result = sd.tune(sources, **start.options, **vars(goal), progress=advance)
    ui.show(*result.tables)
    ui.say(*result.words)
    sd.write(result.setup, out)
    with ui.progress_bar("slices of the likelihood"):
        slices = sd.tuning.slices(result)
    write_json(beside, {"records": list(sources), **result.summary(), "slices": slices.summary()})
    answer, reason, details = result.verdict
    ui.say(f"{answer}: {reason}.", *(f"  - {detail}" for detail in details if result.comparison is not None))
    ui.written(out, beside, *sd.plots.save_as({drawing: sd.plots.likelihood_slices(slices, result)}, form))
