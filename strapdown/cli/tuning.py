"""Tuning a filter from data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, count, one_of
from strapdown.cli import terminal as ui
from strapdown.cli.reading import Layout
from strapdown.files import write_json, write_text

if TYPE_CHECKING:
    from strapdown.estimation.setup import FilterSetup
    from strapdown.gyro import GyroSpec


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
    filter_file: Path | None = ui.FILTER
    states: bool = Option(
        False,
        "--states",
        help="Add a state for each error that the record specifies; --free may then name its parameters, such as gyro.scale_sigma.",
    )
    prior: str | None = Option(None, help="Weak prior of the gyro noise: TOML of `strapdown allan`, or a preset.")

    @property
    def names(self) -> list[str] | None:
        """Names of the parameters, if given."""
        if not self.free:
            return None
        names = [name.strip() for name in ",".join(self.free).split(",") if name.strip()]
        if not names:
            raise InputError(f"--free is {','.join(self.free)!r} and names no parameter; name some, or leave it out")
        return names

    @property
    def spec(self) -> GyroSpec | None:
        """The gyro of the prior, if given."""
        if self.prior is None:
            return None
        if Path(self.prior).suffix == ".toml":
            return sd.gyro.read_spec(self.prior)
        presets = sd.gyro.datasheets.PRESETS
        return presets[one_of("--prior", self.prior, presets)].spec


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


@ui.command
def tune(
    *,
    records: list[Path] = Argument(help="Records or recordings (BROAD HDF5, CSV), all of one unit."),
    start: _Filter,
    goal: _Objective,
    search: _Search,
    layout: Layout,
    out: Path = Option(Path("filter.toml"), "--out", "-o", help="TOML for --filter; beside it JSON and figures."),
    form: ui.Format = ui.FORMAT,
    tables: Path | None = ui.TABLES,
) -> None:
    """Tune the filter by maximum likelihood, with a confidence interval for each parameter."""
    from strapdown.estimation.setup import read_setup, to_toml
    from strapdown.plots import tuning as drawing
    from strapdown.report import tunings
    from strapdown.workflows.tuning import tuned

    count("seed", search.seed, minimum=0)
    for k, path in enumerate(records):
        if path.exists() and any(path.samefile(other) for other in records[:k] if other.exists()):
            raise InputError(f"{path} is given twice; give each record once")
    free, beside = start.names, out.with_suffix(".json")
    places = {name: out.with_name(f"{out.stem}-{name}.{form}") for name in FIGURES}
    inputs, own = (*records, start.filter_file), lambda _: bool(tunings.read(beside))
    ui.check_files(out, suffixes=(".toml",), sources=inputs, own=own, command="tune")
    ui.check_files(beside, *places.values(), tables=tables, sources=inputs, own=own, command="tune")
    filter_setup = None if start.filter_file is None else read_setup(start.filter_file)
    sources = _sources(records, filter_setup, start, layout)
    if filter_setup is not None and (filter_setup.gate or filter_setup.robust) and not (goal.truth or goal.gate):
        ui.say(
            "The filter's gate and weights are not applied: a narrower gate would always increase the likelihood. --gate models outliers, "
            "and --truth tunes the filter with its gate and weights."
        )
    with ui.progress_bar("searches") as advance:
        result, objective, _ = tuned(
            sources,
            names=[path.name for path in records],
            setup=filter_setup,
            free=free,
            states=start.states,
            priors=start.spec,
            **vars(goal),
            **vars(search),
            progress=advance,
        )
    listed = result.tables
    ui.show(listed[0])
    ui.say(*result.words)
    ui.show(*listed[1:])
    write_text(out, to_toml(result.setup))
    for place in places.values():  # of an earlier tuning, which may have had more of them, or in another format
        for other in ("png", "pdf", "svg"):
            place.with_suffix(f".{other}").unlink(missing_ok=True)
    with ui.progress_bar("slices of the likelihood"):
        slices = sd.tuning.slices(objective, result)
    content = {"records": [path.name for path in records], **result.summary(), "slices": slices.summary()}
    write_json(beside, content)
    answer, reason, details = sd.tuning.fitting.verdict(result)
    ui.say(f"{answer}: {reason}.", *(f"  - {detail}" for detail in details if result.comparison is not None))
    figures = {places["likelihood"]: drawing.likelihood_slices(slices, result)}
    if result.comparison is not None:
        title = "Held-out part of the first record"
        figures[places["heldout"]] = drawing.before_and_after(result.comparison, title=title)
    ui.written(out, beside, *sd.plots.save_as(figures, form), tables=(tables, listed))


def _sources(paths: list[Path], filter_setup: FilterSetup | None, start: _Filter, layout: Layout) -> list[Any]:
    """Return the records; say what the filter of the first does not model."""
    from strapdown.recordings import recordfiles
    from strapdown.workflows.filters import matched_filter

    sources: list[Any] = []
    for path in paths:
        if recordfiles.is_record(path):
            source: Any = recordfiles.read_record(path)
            if filter_setup is None and not any(isinstance(other, type(source)) for other in sources):
                ui.say(*matched_filter(source, states=start.states)[1])
        else:
            if start.states:
                raise InputError(f"{path} is a recording, which specifies no errors; --states is for simulated records")
            source = sd.recordings.read(path, **layout.options(path))
            ui.say(source.left_out_words)
            sd.ahrs.need_accelerometer(source)
            ui.warn_about_conventions(source, path)
        sources.append(source)
    return sources
