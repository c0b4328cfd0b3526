"""Tuning a filter from data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strapdown.checks import InputError, count, one_of
from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import Layout
from strapdown.cli.terminal import (
    FORMAT,
    TABLES,
    FigureFormat,
    command,
    console,
    need_own,
    say,
    show,
    tables_folder,
    tables_written,
    warn_about_conventions,
    written,
)
from strapdown.files import atomic_write, writable, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from strapdown.estimation.setup import FilterSetup
    from strapdown.gyro import GyroSpec
    from strapdown.recordings import Recording
    from strapdown.records import ImuRecord
    from strapdown.tuning import Tuning


FIGURES = ("likelihood", "heldout")
"""Figures written beside the filter, by the ends of their names."""


@dataclass(frozen=True, eq=False)
class _Filter:
    """Initial filter."""

    free: list[str] | None = typer.Option(
        None,
        help="Parameters to tune, separated by commas, or the option repeated: gyro.arw, gyro.rrw, SENSOR.sigma, initial.attitude, "
        "initial.bias, gate.probability (as --gate); SENSOR.sigma.x, .y, .z (about one body axis); or only filter.scale. Default: the "
        "two of the gyro and the sigma of every sensor; for a recording without --truth or --rmse only filter.scale is allowed.",
    )
    filter_file: Path | None = typer.Option(
        None, "--filter", help="TOML with a table named filter. Default: one that matches the records."
    )
    states: bool = typer.Option(
        False,
        "--states",
        help="Add an optional state for each error that the record specifies; --free may then also name their parameters, such as "
        "gyro.scale_sigma, SENSOR.correlated_sigma, SENSOR.correlation_time.",
    )
    prior: str | None = typer.Option(
        None, help="Weak prior of the gyro noise: TOML of `strapdown allan`, or the name of a preset."
    )

    @property
    def names(self) -> list[str] | None:
        """Names of the parameters, if given."""
        return None if not self.free else [name.strip() for name in ",".join(self.free).split(",") if name.strip()]

    def setup(self) -> FilterSetup | None:
        """Return the filter of the file, if there is one."""
        from strapdown.estimation.setup import read_setup

        chosen = None if self.filter_file is None else read_setup(self.filter_file)
        if self.states and chosen is not None and chosen.states is not None:
            raise InputError("--filter contains the filter's states in [filter.states]; leave --states out")
        return chosen

    @property
    def spec(self) -> GyroSpec | None:
        """The gyro of the prior, if given."""
        from strapdown.gyro import datasheets, read_spec

        if self.prior is None:
            return None
        return read_spec(self.prior) if Path(self.prior).suffix == ".toml" else datasheets.preset(self.prior).spec


@dataclass(frozen=True)
class _Objective:
    """Objective, by default the likelihood of all innovations."""

    truth: bool = typer.Option(False, "--truth", help="Tune by the likelihood of the errors relative to the truth.")
    rmse: bool = typer.Option(
        False, "--rmse", help="Tune by the RMS attitude error against the truth; then scale all σ by innovations."
    )
    gate: bool = typer.Option(
        False,
        "--gate",
        help="Also model the fraction and scale of outliers, and set the filter's gate where an outlier is more likely than noise.",
    )
    spacing: float = typer.Option(
        0.0, help="Use samples of a sensor this far apart, s, with the weight of all: for correlated disturbances."
    )
    holdout: float | None = typer.Option(
        None, help="Fraction of the data held out, for comparing the filter before and after tuning."
    )
    holdout_by: str = typer.Option("time", help="Hold out the end of each record (time), or complete records (record).")

    @property
    def options(self) -> dict[str, Any]:
        """Objective and held-out data, as :func:`strapdown.tune` takes them."""
        by = one_of("holdout-by", self.holdout_by, ("time", "record"))
        names = ("truth", "rmse", "gate", "spacing", "holdout")
        return {name: getattr(self, name) for name in names} | {"holdout_by": by}


@dataclass(frozen=True)
class _Search:
    """Search."""

    starts: int = typer.Option(4, help="Number of searches: one from the filter, the others from random values.")
    factor: float = typer.Option(30.0, help="Maximum factor between random and initial values, up or down.")
    seed: int = typer.Option(0, help="Seed of the random values.")
    threads: int | None = typer.Option(None, help="Number of threads. Default: one per core.")


@dataclass(frozen=True)
class _Output:
    """Output."""

    out: Path = typer.Option(
        Path("filter.toml"), "--out", "-o", help="TOML for --filter of other commands, beside it JSON and figures."
    )
    form: FigureFormat = FORMAT
    tables: Path | None = TABLES


@command
def tune(
    records: Annotated[
        list[Path],
        typer.Argument(help="Records (HDF5 of `strapdown simulate`) or recordings (BROAD HDF5, CSV), all of one unit."),
    ],
    start: _Filter,
    goal: _Objective,
    search: _Search,
    layout: Layout,
    output: _Output,
) -> None:
    """Tune the filter by maximum likelihood, with a confidence interval for each parameter."""
    from strapdown import workflows
    from strapdown.report import tunings

    count("seed", search.seed, minimum=0)
    if start.names == []:
        raise InputError(f"--free is {','.join(start.free or ())!r} and names no parameter; name some, or leave it out")
    chosen = start.setup()
    _check_files(records, start.filter_file, output)
    sources, chosen = _sources(records, chosen, start, layout)
    if chosen is not None and (chosen.gate or chosen.robust) and not (goal.truth or goal.gate):
        console.print(
            "The filter's gate and weights are not applied: a narrower gate would always increase the likelihood. --gate models outliers, "
            "and --truth tunes the filter with its gate and weights."
        )
    with progress_bar("searches") as advance:
        result, objective, _ = workflows.tuned(
            sources,
            names=[path.name for path in records],
            setup=chosen,
            free=start.names,
            states=start.states,
            priors=start.spec,
            **goal.options,
            **vars(search),
            progress=advance,
        )
    show(result.listing())
    say(*result.words)
    if result.comparison is not None:
        show(result.comparison.listing())
        console.print(f"{tunings.BOUNDS}.")
        for judgement in result.comparison.after.judgements[:1]:
            say(*("After:" + line[3:] for line in judgement.words.splitlines()[1:]))
        say(result.comparison.advice(truth=goal.truth or goal.rmse))
    _write(result, objective, records, output)


def _check_files(records: Sequence[Path], filter_file: Path | None, output: _Output) -> None:
    """Raise an error for a record given twice, and for files that cannot be written or were not written by this command."""
    from strapdown.report import tunings

    for k, path in enumerate(records):
        if path.exists() and any(path.samefile(other) for other in records[:k] if other.exists()):
            raise InputError(f"{path} is given twice; give each record once")
    sources, out = (*records, filter_file), output.out
    report = out.with_suffix(".json")
    writable("out", out, suffixes=(".toml",), sources=sources)
    writable("out", report, *(out.with_name(f"{out.stem}-{name}.{output.form}") for name in FIGURES), sources=sources)
    tables_folder(output.tables)
    for target in (out, report):
        need_own(target, "tune", lambda _: bool(tunings.read(report)))


def _sources(
    paths: Sequence[Path], chosen: FilterSetup | None, start: _Filter, layout: Layout
) -> tuple[list[ImuRecord | Recording], FilterSetup | None]:
    """Return the records, and the filter of the file; say what it does not model."""
    from strapdown import ahrs, recordings
    from strapdown.cli.filters import filter_for, need_angles
    from strapdown.estimation.setup import FilterSetup
    from strapdown.recordings import recordfiles

    sources: list[ImuRecord | Recording] = []
    for path in paths:
        if not recordfiles.is_record(path):
            if start.states:
                raise InputError(f"{path} is a recording, which specifies no errors; --states is for simulated records")
            recording = recordings.read(path, **layout.options(path))
            say(recording.left_out_words)
            ahrs.need_accelerometer(recording)
            warn_about_conventions(recording, path)
            sources.append(recording)
            continue
        record = recordfiles.read_record(path)
        if chosen is not None and start.filter_file is not None:
            need_angles(start.filter_file, chosen, record)
            if start.states and chosen.states is None:
                chosen = replace(chosen, states=FilterSetup.for_record(record, states=True).states)
        elif not any(isinstance(one, type(record)) for one in sources):
            if record.origin is None or record.origin.gyro is None:
                raise InputError(
                    f"{path} does not contain its gyro's specification; give an initial filter, --filter filter.toml"
                )
            say(*filter_for(path, record, None, None, () if start.states else False)[1])
        sources.append(record)
    return sources, chosen


def _write(result: Tuning, objective: Any, paths: Sequence[Path], output: _Output) -> None:
    from strapdown import tuning
    from strapdown.estimation.setup import to_toml
    from strapdown.plots import tuning as drawing
    from strapdown.plots.style import save_as
    from strapdown.report import tunings

    out = output.out
    with atomic_write(out) as temporary:
        temporary.write_text(to_toml(result.setup), encoding="utf-8")
    places = {name: out.with_name(f"{out.stem}-{name}.{output.form}") for name in FIGURES}
    for place in places.values():  # of an earlier tuning, which may have had more of them, or in another format
        for other in FigureFormat:
            place.with_suffix(f".{other}").unlink(missing_ok=True)
    report = out.with_suffix(".json")
    content = {"records": [path.name for path in paths], **result.summary()}
    write_json(report, content)
    answer, reason, _ = tunings.verdict(content)
    console.print(f"{answer}: {reason}.")
    with progress_bar("figure of the likelihood"):
        figures = {places["likelihood"]: drawing.likelihood_slices(tuning.slices(objective, result), result)}
    if result.comparison is not None:
        title = "Held-out part of the first record"
        figures[places["heldout"]] = drawing.before_and_after(result.comparison, title=title)
    tables = [one.listing() for one in (result, result.comparison) if one is not None]
    written(out, report, *save_as(figures, output.form), *tables_written(output.tables, *tables))
