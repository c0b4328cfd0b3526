"""Tuning a filter from data."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
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
    doubt,
    need_own,
    say,
    show,
    tables_folder,
    tables_written,
    writable,
    written,
)
from strapdown.files import plain, write_json, written_beside

if TYPE_CHECKING:
    from collections.abc import Sequence

    from strapdown.estimation.setup import FilterSetup
    from strapdown.gyro import GyroSpec
    from strapdown.records import ImuRecord
    from strapdown.tuning import Case, Comparison, TunedGate, Tuning, Unmodelled


FIGURES = ("likelihood", "heldout")
"""Figures written beside the filter, by the ends of their names."""
MAX_EXAMINED = 4
"""Maximum number of records examined for errors that the tuned filter does not model."""
WORSE = 1.05
"""An increase of the attitude error on the held-out data by more than this factor is reported."""


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
        if self.states and chosen is not None:
            raise InputError("--filter contains the filter's states in [filter.states]; leave --states out")
        return chosen

    def wanted(self, cases: Sequence[Case], gyros: dict[str, GyroSpec]) -> list[str]:
        """Return the parameters to tune on these records; raise an error for those of a gyro that differs between the records."""
        from strapdown import tuning

        if self.names == []:
            raise InputError(
                f"--free is {','.join(self.free or ())!r} and names no parameter; name some, or leave it out"
            )
        wanted = [name for name in self.names or [] if name not in tuning.GATED]
        wanted = wanted or list(tuning.default_names([case.record for case in cases]))
        if self.filter_file is None or any(name.startswith(("gyro.", "filter.")) for name in wanted):
            tuning.one_gyro(gyros)
        return wanted

    def priors(self, record: ImuRecord, names: Sequence[str]) -> dict[str, Any]:
        """Return the priors of the given parameters."""
        from strapdown import tuning
        from strapdown.gyro import datasheets, read_spec

        if self.prior is None:
            return {}
        spec = read_spec(self.prior) if Path(self.prior).suffix == ".toml" else datasheets.preset(self.prior).spec
        found = tuning.priors_from_gyro(spec, record)
        return {name: prior for name, prior in found.items() if name in names}


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
    def name(self) -> str:
        """Name of the objective in the result."""
        name = "rmse" if self.rmse else "likelihood"
        return name + (" of the errors" if self.truth else "")

    def split(self, cases: Sequence[Case]) -> tuple[tuple[Case, ...], tuple[Case, ...]]:
        """Return the data for tuning and the held-out data."""
        from strapdown import tuning

        if self.holdout is None:
            return tuple(cases), ()
        return tuning.split(cases, self.holdout, one_of("holdout-by", self.holdout_by, ("time", "record")))  # type: ignore[arg-type]


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


class _Found(NamedTuple):
    """Result of a tuning."""

    result: Tuning
    objective: Any
    gate: TunedGate | None
    comparison: Comparison | None
    examined: Sequence[Unmodelled]
    """Tests of each record for errors that the tuned filter does not model."""
    worst: Unmodelled | None
    attitude_rms: tuple[float, float] | None
    """RMS attitude error before and after, rad, if it was the objective."""


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
    from strapdown import recordings, tuning

    workers = count("threads", search.threads if search.threads is not None else os.cpu_count() or 1)
    chosen = start.setup()
    count("seed", search.seed, minimum=0)
    _check_files(records, start.filter_file, output)
    cases, before, gyros = _cases(records, chosen, start, layout)
    if not (goal.truth or goal.rmse or all(recordings.is_record(path) for path in records)):
        names, spacing = tuning.by_innovations(start.names, goal.spacing, gate=goal.gate, prior=start.prior)
        start, goal = replace(start, free=list(names)), replace(goal, spacing=spacing)
    if (before.gate or before.robust) and not (goal.truth or goal.gate):
        console.print(
            "The filter's gate and weights are not applied: a narrower gate would always increase the likelihood. --gate models outliers, "
            "and --truth tunes the filter with its gate and weights."
        )
    found = _tuned(cases, before, gyros, start, goal, search, workers)
    show(found.result.listing())
    if found.attitude_rms is not None:
        old, new = np.degrees(found.attitude_rms)
        console.print(f"RMS attitude error: {old:.4g}° before, {new:.4g}° after.")
    if found.gate is not None:
        _print_gate(found.gate)
    say(*(() if found.worst is None else found.worst.words))
    if found.comparison is not None:
        _print_comparison(found.comparison, truth=goal.truth or goal.rmse)
    _write(found, records, goal.name, output)


def _tuned(
    cases: Sequence[Case],
    before: FilterSetup,
    gyros: dict[str, GyroSpec],
    start: _Filter,
    goal: _Objective,
    search: _Search,
    workers: int,
) -> _Found:
    """Tune, compare on the held-out data, and test for errors that the tuned filter does not model."""
    from strapdown import tuning

    train, held = goal.split(cases)
    wanted = start.wanted(cases, gyros)
    gated = goal.gate or any(name in tuning.GATED for name in start.names or [])
    priors = start.priors(train[0].record, wanted)
    with progress_bar("searches") as advance:
        result, objective, gate = tuning.tune(
            train,
            before,
            wanted,
            truth=goal.truth,
            rmse=goal.rmse,
            gate=gated,
            spacing=goal.spacing,
            priors=priors,
            starts=search.starts,
            factor=search.factor,
            seed=search.seed,
            threads=workers,
            progress=advance,
        )
    comparison = None
    if held:
        with progress_bar("judging on the held-out data"):
            comparison = tuning.compare(held, before, result.setup, threads=workers)
    if comparison is not None and gated:  # the likelihood after tuning includes the gate
        likely = tuning.log_likelihood(held, objective, result)  # type: ignore[arg-type]
        comparison = replace(comparison, after=replace(comparison.after, log_likelihood=likely))
    examined, worst = _examined(train, before, result)
    if worst is not None:
        result = tuning.doubted(result, worst)
    rms = None
    if goal.rmse:
        before_and_after = objective.rms(np.stack([objective.start, result.point - np.log(result.scale)]))  # type: ignore[attr-defined]
        rms = tuple(before_and_after.tolist())
    return _Found(result, objective, gate, comparison, examined, worst, rms)


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


def _examined(train: Sequence[Case], before: FilterSetup, result: Tuning) -> tuple[list[Unmodelled], Unmodelled | None]:
    """Return tests of each record for errors that the tuned filter does not model, and the worst of them."""
    from strapdown import tuning

    # Optional states model such errors already; and the search supports one σ per sample only.
    looked = before.states is None and not _differs_by_axis(train, result.setup)
    suspects = train[:MAX_EXAMINED] if looked else ()
    examined = []
    with progress_bar("unmodelled errors", len(suspects)) as advance:
        for case in suspects:
            examined.append(tuning.unmodelled(case, result.setup))
            advance(1)
    worst = max(examined, key=lambda one: (one.moves_with_the_rate, one.suspected, len(one.failed)), default=None)
    return examined, worst


def _differs_by_axis(cases: Sequence[Case], chosen: FilterSetup) -> bool:
    """Return whether the filter has a noise of a direction or whole vector that differs by axis."""
    series = [one for case in cases for one in case.record.vectors]
    return any(
        one.anisotropic or (one.kind != "attitude" and isinstance(chosen.sigma.get(one.sensor), tuple))
        for one in series
    )


def _cases(
    paths: Sequence[Path], chosen: FilterSetup | None, start: _Filter, layout: Layout
) -> tuple[list[Case], FilterSetup, dict[str, GyroSpec]]:
    """Return the records, the initial filter, and the gyro specifications of the records that contain one."""
    from strapdown import recordings, tuning
    from strapdown.cli.filters import filter_for, need_angles
    from strapdown.recordings import recordfiles

    cases: list[Case] = []
    gyros: dict[str, GyroSpec] = {}
    for path in paths:
        if recordfiles.is_record(path):
            record = recordfiles.read_record(path)
            gyro = None if record.origin is None else record.origin.gyro
            if chosen is None:
                if gyro is None:
                    raise InputError(
                        f"{path} does not contain its gyro's specification; give an initial filter, --filter filter.toml"
                    )
                chosen, remarks = filter_for(path, record, None, None, () if start.states else False)
                say(*remarks)
            elif start.filter_file is not None:
                need_angles(start.filter_file, chosen, record)
            if gyro is not None:
                gyros[str(path)] = gyro
            cases.append(tuning.record_case(record, chosen, name=path.name))
        else:
            if start.states:
                raise InputError(f"{path} is a recording, which specifies no errors; --states is for simulated records")
            recording = recordings.read(path, **layout.options(path))
            chosen = chosen or tuning.recording_setup()
            say(recording.left_out_words)
            cases.append(tuning.recording_case(recording))
            doubt(recording, path)
    assert chosen is not None
    return cases, chosen, gyros


def _print_gate(found: TunedGate) -> None:
    if found.gate is None:
        why = "no outliers" if not found.share.identified else "noise of two sizes rather than outliers"
        console.print(f"The records show {why}; the filter's gate is unchanged.")
        return
    thresholds = ", ".join(f"{value:.1f} of {name}" for name, value in found.thresholds.items())
    console.print(
        f"A measurement with a NIS above {thresholds} is more likely an outlier than noise. The gate accepts "
        f"{100.0 * found.probability:.4g} % of valid measurements (95 %: {100.0 * found.lower:.4g} to {100.0 * found.upper:.4g})."
    )


def _print_comparison(comparison: Comparison, *, truth: bool) -> None:
    from strapdown.report import tunings

    show(comparison.listing())
    console.print(f"{tunings.BOUNDS}.")
    for judgement in comparison.after.judgements[:1]:
        say(*("After:" + line[3:] for line in judgement.words.splitlines()[1:]))
    if not comparison.better and not truth:
        console.print("On the held-out data the likelihood has decreased: keep the previous filter.")
    elif comparison.after.attitude_rms > WORSE * comparison.before.attitude_rms:
        console.print("On the held-out data the attitude error has increased: keep the previous filter.")


def _write(found: _Found, paths: Sequence[Path], of: str, output: _Output) -> None:
    from strapdown import tuning
    from strapdown.estimation.setup import to_toml
    from strapdown.plots import tuning as drawing
    from strapdown.plots.style import save_as
    from strapdown.report import tunings

    out, result = output.out, found.result
    with written_beside(out) as temporary:
        temporary.write_text(to_toml(result.setup), encoding="utf-8")
    places = {name: out.with_name(f"{out.stem}-{name}.{output.form}") for name in FIGURES}
    for place in places.values():  # of an earlier tuning, which may have had more of them, or in another format
        for other in FigureFormat:
            place.with_suffix(f".{other}").unlink(missing_ok=True)
    report = out.with_suffix(".json")
    content = _report(found, paths, of)
    write_json(report, content)
    tables = [one.listing() for one in (found.result, found.comparison) if one is not None]
    answer, reason, _ = tunings.verdict(content)
    console.print(f"{answer}: {reason}.")
    with progress_bar("figure of the likelihood"):
        figures = {places["likelihood"]: drawing.likelihood_slices(tuning.slices(found.objective, result), result)}
    if found.comparison is not None:
        figures[places["heldout"]] = drawing.before_and_after(
            found.comparison, title="Held-out part of the first record"
        )
    written(out, report, *save_as(figures, output.form), *tables_written(output.tables, *tables))


def _report(found: _Found, paths: Sequence[Path], of: str) -> dict[str, Any]:
    result, gate, comparison = found.result, found.gate, found.comparison
    content: dict[str, Any] = {
        "records": [path.name for path in paths],
        "parameters": [
            {**vars(one), "note": one.words, "unit": one.unit.name, "si_per_unit": one.unit.factor}
            for one in result.parameters
        ],
        "units": "SI: rad, s, and the units of whole vectors; divide by si_per_unit for the unit of a parameter",
        "objective": {
            "name": of,
            "before": result.before,
            "after": result.after,
            "attitude_rms_rad": found.attitude_rms,
        },
        "searches": {"number": len(result.starts), "at_the_best_point": result.agreeing},
        "innovations_fit": not result.misfit,
        "unmodelled": [one.summary() for one in found.examined],
    }
    if gate is not None:
        content["gate"] = {name: getattr(gate, name) for name in ("probability", "lower", "upper", "thresholds")}
    if comparison is not None:
        content["held_out"] = {
            name: {
                "log_likelihood_per_innovation": one.log_likelihood,
                "nis_per_degree": one.nis,
                "nis_bounds": one.nis_bounds,
                "anees_per_state": one.anees,
                "attitude_rms_rad": one.attitude_rms,
                "nees_per_state": {course.of: np.nanmean(course.mean) for course in one.nees},
                "judgements": [judgement.summary() for judgement in one.judgements],
            }
            for name, one in (("before", comparison.before), ("after", comparison.after))
        }
    return plain(content)  # type: ignore[no-any-return]
