"""Tuning a filter from data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, one_of
from strapdown.cli import terminal as ui
from strapdown.cli.options import FILTER, FORMAT, Format, Layout
from strapdown.files import write_json

FIGURES = ("likelihood", "heldout")
"""Figures written beside the filter, by the ends of their names."""


@dataclass(frozen=True, eq=False)
class _Filter:
    """Initial filter."""

    free: list[str] | None = Option(
        None,
        help="Parameters to tune, separated by commas or repeated: gyro.arw, gyro.rrw, SENSOR.sigma[.x, .y, .z], initial.attitude, "
        "initial.bias, gate.probability; or only filter.scale. Default: the two of the gyro and the sigma of every sensor; for a recording "
        "without --truth only filter.scale is allowed.",
    )
    filter_file: Path | None = FILTER
    states: bool = Option(
        False,
        "--states",
        help="Add a state for each error that the record specifies; --free may then name its parameters, such as gyro.scale_sigma.",
    )
    prior: str | None = Option(None, help="Weak prior of the gyro noise: TOML of `strapdown allan`, or a preset.")

    @property
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.tune`."""
        names = [name.strip() for name in ",".join(self.free or ()).split(",") if name.strip()]
        if self.free and not names:
            raise InputError(f"--free is {','.join(self.free)!r} and names no parameter; name some, or leave it out")
        spec = None
        if self.prior is not None and Path(self.prior).suffix == ".toml":
            spec = sd.gyro.read_spec(self.prior)
        elif self.prior is not None:
            presets = sd.gyro.datasheets.PRESETS
            spec = presets[one_of("--prior", self.prior, presets)].spec
        setup = self.filter_file and sd.estimation.setup.read_setup(self.filter_file)
        return {"setup": setup, "free": names or None, "states": self.states, "priors": spec}


@dataclass(frozen=True)
class _Objective:
    """Objective, by default the likelihood of all innovations."""

    truth: bool = Option(False, "--truth", help="Tune by the likelihood of the errors relative to the truth.")
    gate: bool = Option(False, "--gate", help="Also model outliers, and set the filter's gate.")
    spacing: float = Option(0.0, help="Interval of the samples used, s, with the weight of all.")
    holdout: float | None = Option(
        None, help="Fraction of each record, its end, held out to compare the filter before and after."
    )


@dataclass(frozen=True)
class _Search:
    """Search."""

    starts: int = Option(4, help="Number of searches: one from the filter, the others from random values.")
    seed: int = Option(0, help="Seed of the random values.")
    threads: int | None = Option(None, help="Number of threads. Default: one per core.")


@ui.command("tables")
def tune(
    *,
    records: list[Path] = Argument(help="Records or recordings (BROAD HDF5, CSV), all of one unit."),
    start: _Filter,
    goal: _Objective,
    search: _Search,
    layout: Layout,
    out: Path = Option(Path("filter.toml"), "--out", "-o", help="TOML for --filter; beside it JSON and figures."),
    form: Format = FORMAT,
) -> None:
    """Tune the filter by maximum likelihood, with a confidence interval for each parameter."""
    from strapdown.plots import tuning as drawing
    from strapdown.report import tunings

    for k, path in enumerate(records):
        if path.exists() and any(path.samefile(other) for other in records[:k] if other.exists()):
            raise InputError(f"{path} is given twice; give each record once")
    beside, places = out.with_suffix(".json"), {name: out.with_name(f"{out.stem}-{name}.{form}") for name in FIGURES}
    ui.check_files(out, suffixes=(".toml",), own=lambda _: tunings.read(beside))
    ui.check_files(beside, *places.values(), own=tunings.read)
    sources: dict[str, Any] = {}
    for path in records:
        simulated = sd.recordings.is_record(path)
        source: Any = sd.read(path, **({} if simulated else layout.options))
        if start.states and not simulated:
            raise InputError(f"{path} is a recording, which specifies no errors; --states is for simulated records")
        ui.say("" if simulated else source.left_out_words)
        sources[path.name if path.name not in sources else str(path)] = source
    with ui.progress_bar("searches") as advance:
        result = sd.tune(sources, **start.options, **vars(goal), **vars(search), progress=advance)
    ui.show(*result.tables)
    ui.say(*result.words)
    sd.write(result.setup, out)
    for place in places.values():  # of an earlier tuning, which may have had more of them, or in another format
        for other in (".png", ".pdf", ".svg"):
            place.with_suffix(other).unlink(missing_ok=True)
    with ui.progress_bar("slices of the likelihood"):
        slices = sd.tuning.slices(result)
    write_json(beside, {"records": list(sources), **result.summary(), "slices": slices.summary()})
    answer, reason, details = sd.tuning.fitting.verdict(result)
    ui.say(f"{answer}: {reason}.", *(f"  - {detail}" for detail in details if result.comparison is not None))
    figures = {places["likelihood"]: drawing.likelihood_slices(slices, result)}
    if result.comparison is not None:
        title = "Held-out part of the first record"
        figures[places["heldout"]] = drawing.before_and_after(result.comparison, title=title)
    ui.written(out, beside, *sd.plots.save_as(figures, form))
