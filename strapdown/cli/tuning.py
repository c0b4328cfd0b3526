"""Tuning a filter from data."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strapdown.cli.terminal import (
    FigureFormat,
    Format,
    Tables,
    app,
    console,
    doubt,
    need_own,
    progress_bar,
    show,
    table,
    tables_folder,
    tables_written,
    writable,
    written,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from strapdown.gyro import GyroSpec
    from strapdown.records import ImuRecord
    from strapdown.setup import FilterSetup
    from strapdown.tuning import Case, Comparison, Performance, Plan, TunedGate, Tuning, Unmodelled
    from strapdown.tuning.parameters import Unit


GATED = ("gate.probability", "outliers.share", "outliers.scale")
"""Names of parameters that ask for a model of outliers."""
FIGURES = ("likelihood", "heldout")
"""Figures that are drawn beside the filter, by the ends of their names."""
PRIOR_FACTOR = 3.0
"""One standard deviation of a prior, where none is given."""
MOST_EXAMINED = 4
"""Records that are looked at for what the tuned filter leaves unexplained."""
WORSE = 1.05
"""An attitude error on the data held out that has grown by more than this is told."""


@app.command()
def tune(
    records: Annotated[
        list[Path],
        typer.Argument(
            help="Records (HDF5 of `strapdown simulate`) or recordings (BROAD HDF5, CSV), all of one unit; with --plan one record, or the "
            "name or TOML file of a scenario."
        ),
    ],
    free: Annotated[
        str | None,
        typer.Option(
            help="Parameters to tune, with commas: gyro.arw, gyro.rrw, SENSOR.sigma, initial.attitude, initial.bias, "
            "gate.probability (as --gate); SENSOR.sigma.x, .y, .z (about one body axis); or filter.scale alone. If not given the "
            "gyro's two and every sensor's."
        ),
    ] = None,
    filter_file: Annotated[
        Path | None,
        typer.Option("--filter", help="TOML with a table named filter to start from; else what the records tell."),
    ] = None,
    integration: Annotated[
        str | None, typer.Option(help="Integration algorithm (`strapdown algorithms`); the filter's if not given.")
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth", help="Tune by the errors against the truth, and how well the filter knows them.")
    ] = False,
    rmse: Annotated[
        bool,
        typer.Option(
            "--rmse", help="Tune by the RMS attitude error against the truth; then all σ alike by innovations."
        ),
    ] = False,
    credibility: Annotated[
        bool,
        typer.Option(
            "--credibility",
            help="Tune until the filter may be believed: the whole distribution of NIS, and whiteness; with --truth that of NEES.",
        ),
    ] = False,
    gate: Annotated[
        bool,
        typer.Option(
            "--gate",
            help="Model outliers too, their share and scale, and set the filter's gate where an outlier is the likelier explanation.",
        ),
    ] = False,
    states: Annotated[
        bool,
        typer.Option(
            "--states",
            help="Give the filter the optional states that the record's specified errors call for; --free may name their sizes too, such "
            "as gyro.scale_sigma, SENSOR.correlated_sigma, SENSOR.correlation_time.",
        ),
    ] = False,
    holdout: Annotated[
        float | None, typer.Option(help="Share of the data held out, to judge the filter before and after on.")
    ] = None,
    holdout_by: Annotated[
        str, typer.Option(help="Hold out the end of each record (time), or whole ones (record).")
    ] = "time",
    prior: Annotated[
        str | None,
        typer.Option(help="Weak prior of the gyro's noise: TOML of `strapdown allan`, or the name of a preset."),
    ] = None,
    prior_factor: Annotated[
        float, typer.Option(help="One standard deviation of the prior is a factor of this.")
    ] = PRIOR_FACTOR,
    spacing: Annotated[
        float,
        typer.Option(
            help="Take a sensor's samples so many seconds apart, the weight of all on them: disturbances last."
        ),
    ] = 0.0,
    starts: Annotated[int, typer.Option(help="Searches: one from the filter, the others from random starts.")] = 4,
    factor: Annotated[float, typer.Option(help="Random starts are off by up to this factor, either way.")] = 30.0,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    threads: Annotated[int | None, typer.Option(help="Threads; one a core if not given.")] = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="Tell how well records will tell each parameter, before there are any.")
    ] = False,
    length: Annotated[
        str | None,
        typer.Option(help="For --plan: lengths of a record, s, with commas; that of the scenario if not given."),
    ] = None,
    gyro_unit: Annotated[str | None, typer.Option(help="Unit of a CSV file's gyro: rad/s or deg/s.")] = None,
    accelerometer_unit: Annotated[
        str | None, typer.Option(help="Unit of a CSV file's accelerometer: m/s2 or g.")
    ] = None,
    time_unit: Annotated[str | None, typer.Option(help="Unit of a CSV file's time: s, ms, us or ns.")] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="TOML for --filter of other commands; JSON and figures go beside it.")
    ] = Path("filter.toml"),
    form: Format = FigureFormat.png,
    tables: Tables = None,
) -> None:
    """Tune the filter by maximum likelihood, and tell how sure each parameter is."""
    import os

    from strapdown import coning, tuning
    from strapdown.checks import InputError, count, non_negative, one_of
    from strapdown.report import tunings
    from strapdown.setup import read_setup

    workers = count("threads", threads if threads is not None else os.cpu_count() or 1)
    chosen = read_setup(filter_file) if filter_file is not None else None
    algorithm = None
    if integration is not None:
        algorithm = coning.ALGORITHMS[one_of("integration", integration, coning.ALGORITHMS)]
    names = None if free is None else [name.strip() for name in free.split(",") if name.strip()]
    if states and chosen is not None:
        raise InputError("--filter tells the filter's states itself, in [filter.states]; leave --states out")
    if plan and (states or (chosen is not None and chosen.states is not None)):
        raise InputError("--plan knows no optional states; leave --states away, and [filter.states] out of the filter")
    if plan:
        _plan(records, chosen, algorithm, names, length, workers)
        return
    if length is not None:
        raise InputError("--length is for --plan; the records' own length is taken")
    count("seed", seed, least=0)
    non_negative("spacing", spacing, unit="s")
    same = [
        path
        for k, path in enumerate(records)
        if path.exists() and any(path.samefile(other) for other in records[:k] if other.exists())
    ]
    if same:
        raise InputError(f"{same[0]} is given twice; a record counts once")
    sources = (*records, filter_file)
    writable("out", out, suffixes=(".toml",), sources=sources)
    writable(
        "out",
        out.with_suffix(".json"),
        *(out.with_name(f"{out.stem}-{name}.{form}") for name in FIGURES),
        sources=sources,
    )
    tables_folder(tables)
    report = out.with_suffix(".json")
    for target in (out, report):
        need_own(target, "tune", lambda _: bool(tunings.read(report)))
    units = {"gyro": gyro_unit, "accelerometer": accelerometer_unit, "time": time_unit}
    cases, believed, gyros = _cases(
        records, chosen, filter_file, {name: unit for name, unit in units.items() if unit}, states=states
    )
    if algorithm is not None:
        believed = replace(believed, integration=algorithm)
    train, held = (tuple(cases), ()) if holdout is None else tuning.split(cases, holdout, _by(holdout_by))
    gate = gate or any(name in GATED for name in names or [])
    wanted = [name for name in names or [] if name not in GATED]
    wanted = wanted or list(tuning.default_names([case.record for case in cases]))
    if chosen is None or any(name.startswith(("gyro.", "filter.")) for name in wanted):
        tuning.one_gyro(gyros)
    objective: Any
    if prior is None and prior_factor != PRIOR_FACTOR:
        raise InputError("--prior-factor goes with --prior, the noise that it is about")
    if names == []:
        raise InputError(f"--free is {free!r} and names no parameter; name some, or leave it out")
    if rmse and truth:
        raise InputError(
            "--rmse and --truth both tell what of the errors against the truth is tuned by; give one of them"
        )
    if rmse and credibility:
        raise InputError(
            "--rmse and --credibility ask for different filters: small errors, or believable ones; give one of them"
        )
    if spacing > 0.0 and (truth or rmse or credibility):
        raise InputError(
            "--spacing thins the innovations of the likelihood; against a truth, or for credibility, there are none to thin: leave it away"
        )
    if gate and (truth or rmse or credibility or spacing > 0.0):
        raise InputError(
            "--gate needs the likelihood of all innovations: leave --truth, --rmse, --credibility and --spacing away"
        )
    if believed.states is not None and (gate or truth or rmse or credibility or spacing > 0.0):
        raise InputError(
            "a filter with optional states is tuned by the likelihood of all innovations: leave --gate, --truth, --rmse, --credibility and "
            "--spacing away"
        )
    by_axis = any(tuning.axis_of(name) for name in wanted)
    if by_axis and (gate or truth or rmse or credibility or spacing > 0.0):
        raise InputError(
            "a sigma of one axis is tuned by the likelihood of all innovations: leave --gate, --truth, --rmse, --credibility and --spacing "
            "away"
        )
    if believed.states is not None or by_axis:
        from strapdown.tuning import extended

        objective = extended.likelihood(train, believed, wanted, threads=workers)
    elif gate:
        objective = tuning.contaminated_likelihood(train, believed, wanted)
    elif credibility:
        objective = tuning.credibility_objective(train, believed, wanted, truth=truth, threads=workers)
    elif truth or rmse:
        objective = tuning.error_objective(
            train, believed, wanted, measure="rmse" if rmse else "likelihood", threads=workers
        )
    else:
        objective = tuning.likelihood(train, believed, wanted, spacing=spacing)
    priors = {} if prior is None else _priors(prior, prior_factor, train[0].record, wanted)
    with progress_bar("searches, intervals", starts + len(wanted)) as advance:
        result = tuning.fit(
            objective,
            priors=priors,
            starts=starts,
            factor=factor,
            seed=seed,
            threads=1 if truth or rmse or credibility or believed.states is not None or by_axis else workers,
            progress=advance,
        )
    if rmse:
        # The size of the error leaves a common scale open; the innovations tell it.
        scaled = tuning.fit(tuning.likelihood(train, result.setup, ["filter.scale"]), starts=2, threads=workers)
        result = tuning.rescaled(result, scaled["filter.scale"].value)
    found = tuning.tuned_gate(objective, result) if gate else None
    if found is not None and found.gate is not None:
        result = replace(result, setup=replace(result.setup, gate=found.gate))
    comparison = tuning.compare(held, believed, result.setup, threads=workers) if held else None
    if comparison is not None and gate:
        likely = tuning.log_likelihood(held, objective, result)
        comparison = replace(comparison, after=replace(comparison.after, log_likelihood=likely))
    # What is looked for is what optional states are there for, and by filters that take one σ a sample.
    suspects = train[:MOST_EXAMINED] if believed.states is None and not _differs_by_axis(train, result.setup) else ()
    examined = []
    with progress_bar("what is left unexplained", len(suspects)) as advance:
        for case in suspects:
            examined.append(tuning.unmodelled(case, result.setup))
            advance(1)
    worst = max(examined, key=lambda one: (one.moves_with_the_rate, one.suspected, len(one.failed)), default=None)
    if worst is not None:
        result = tuning.doubted(result, worst)
    _tell(result, [case.record for case in cases], credible=credibility)
    if found is not None:
        _tell_gate(found)
    for sentence in () if worst is None else worst.words:
        console.print(sentence)
    if comparison is not None:
        _tell_comparison(comparison, truth=bool(truth or rmse or credibility))
    objective_name = "credibility" if credibility else "rmse" if rmse else "likelihood"
    of = objective_name + (" of the errors" if truth else "")
    _write(
        out,
        result,
        objective,
        comparison,
        cases,
        records,
        of=of,
        examined=examined,
        gate=found,
        form=form,
        tables=tables,
    )


def _differs_by_axis(cases: Sequence[Case], chosen: FilterSetup) -> bool:
    """Return whether the filter believes a noise of a direction or whole vector that differs by axis."""
    series = [one for case in cases for one in case.record.vectors]
    return any(
        one.anisotropic or (one.kind != "attitude" and isinstance(chosen.sigma.get(one.sensor), tuple))
        for one in series
    )


def _by(text: str) -> Any:
    from strapdown.checks import one_of

    return one_of("holdout-by", text, ("time", "record"))


def _cases(
    paths: Sequence[Path],
    chosen: FilterSetup | None,
    filter_file: Path | None,
    units: dict[str, str],
    *,
    states: bool,
) -> tuple[list[Case], FilterSetup, dict[str, GyroSpec]]:
    """Return the records to tune on, the filter to start from, and the gyros of the records that tell theirs."""
    from strapdown import recordfiles, recordings, tuning
    from strapdown.checks import InputError
    from strapdown.cli.filters import filter_for, need_angles

    cases: list[Case] = []
    gyros: dict[str, GyroSpec] = {}
    for path in paths:
        if recordfiles.is_record(path):
            file = recordfiles.read_record_file(path)
            if chosen is None:
                if file.gyro is None:
                    raise InputError(
                        f"{path} does not tell its gyro; give a filter to start from, --filter filter.toml"
                    )
                chosen, remarks = filter_for(path, file, None, None, () if states else None)
                for remark in remarks:
                    console.print(remark)
            elif filter_file is not None:
                need_angles(filter_file, chosen, file)
            if file.gyro is not None:
                gyros[str(path)] = file.gyro
            cases.append(tuning.record_case(file.record, chosen, name=path.name))
        else:
            if states:
                raise InputError(f"{path} is a recording, which specifies no errors; --states is for simulated records")
            recording = recordings.read(path, units=units)
            chosen = chosen or tuning.recording_setup()
            if recording.left_out_words:
                console.print(recording.left_out_words)
            cases.append(tuning.recording_case(recording))
            doubt(recording, path)
    assert chosen is not None
    return cases, chosen, gyros


def _priors(source: str, factor: float, record: ImuRecord, names: Sequence[str]) -> dict[str, Any]:
    from strapdown import datasheets, tuning
    from strapdown.gyro import read_spec

    spec: GyroSpec = read_spec(source) if Path(source).suffix == ".toml" else datasheets.preset(source).spec
    return {
        name: prior for name, prior in tuning.priors_from_gyro(spec, record, factor=factor).items() if name in names
    }


def _unit_of(name: str, records: Sequence[ImuRecord]) -> Unit:
    """Return the unit that a parameter is printed in, of the filter or of its optional states."""
    from strapdown import tuning
    from strapdown.tuning import extended

    plain = name in tuning.known_names(records) or tuning.axis_of(name) is not None
    return tuning.unit_of(name, records) if plain else extended.unit_of(name)


def _figure(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "∞"


def _tell(result: Tuning, records: Sequence[ImuRecord], *, credible: bool) -> None:
    rows = table("Tuned, with 95 % intervals", "parameter", "unit", "before", "after", "from", "to", "", left=2)
    for one in result.parameters:
        unit = _unit_of(one.name, records)
        told = [value / unit.factor for value in (one.start, one.value, one.lower, one.upper)]
        bounded = f"not identified: < {_figure(told[3])} at 95 %" if math.isfinite(one.upper) else "not identified"
        note = one.note if one.identified or "prior" in one.note else bounded
        rows.add_row(one.name, unit.name, *(_figure(value) for value in told), note)
    show(rows)
    gain = result.before - result.after
    console.print(
        f"{result.agreeing} of {len(result.starts)} searches ended at the best point; "
        + (f"half Neyman's statistic fell by {gain:.4g}." if credible else f"gain {gain:.4g} nats.")
    )
    if not all(one.identified for one in result.parameters):
        console.print(
            "What is not identified has only a bound: these records are too short to say more. The filter takes the mean below it; --prior "
            "holds it to what is known."
        )
    if result.misfit and result.parameters[0].name == "filter.scale":
        console.print(
            "The innovations are not those of any such filter: disturbances last over many samples, or change. A common scale leaves the "
            "estimates as they are; it makes σ right on the whole, not at each time."
        )
    elif result.misfit:
        console.print(
            "The innovations are not those of any such filter: disturbances last over many samples, or change. The most likely filter may "
            "follow them and estimate worse. Tune filter.scale alone, or against a truth (--truth, --rmse), or try --spacing."
        )


def _tell_gate(found: TunedGate) -> None:
    if found.gate is None:
        why = "no outliers" if not found.share.identified else "noise of two sizes rather than outliers"
        console.print(f"The records show {why}; the filter's gate is left as it was.")
        return
    thresholds = ", ".join(f"{value:.1f} of {name}" for name, value in found.thresholds.items())
    console.print(
        f"An outlier is the likelier explanation of a NIS above {thresholds}. The gate lets {100.0 * found.probability:.4g} % of right "
        f"measurements pass (95 %: {100.0 * found.lower:.4g} to {100.0 * found.upper:.4g})."
    )


def _anees(one: Performance) -> str:
    """Return the ANEES as a table tells it: of attitude and bias, or where only the attitude is known of that."""
    import numpy as np

    if math.isfinite(one.anees):
        return _figure(one.anees)
    return f"{_figure(float(np.nanmean(one.nees[0].mean)))} (attitude)" if one.nees else "-"


def _tell_comparison(comparison: Comparison, *, truth: bool) -> None:
    from strapdown.report import tunings
    from strapdown.units import DEGREE

    listing = table(
        "On the data held out", "filter", "log likelihood", "NIS", "99 % bounds", "ANEES", "attitude RMS, °", "verdict"
    )
    for name, one in (("before", comparison.before), ("after", comparison.after)):
        verdicts = [judgement.verdict for judgement in one.judgements]
        told = (
            verdicts[0] if len(set(verdicts)) == 1 else f"{verdicts.count('consistent')} of {len(verdicts)} consistent"
        )
        listing.add_row(
            name,
            f"{one.log_likelihood:.4f}",
            f"{one.nis:.3f}",
            f"{one.nis_bounds[0]:.3f} to {one.nis_bounds[1]:.3f}",
            _anees(one),
            _figure(one.attitude_rms / DEGREE) if math.isfinite(one.attitude_rms) else "-",
            told,
        )
    show(listing)
    console.print(f"{tunings.BOUNDS}.")
    for judgement in comparison.after.judgements[:1]:
        console.print("After: " + judgement.words)
    if not comparison.better and not truth:
        console.print("On the data held out the tuned filter is less likely than the one before: keep that one.")
    elif comparison.after.attitude_rms > WORSE * comparison.before.attitude_rms:
        console.print("On the data held out the attitude error has grown: keep the filter before.")


def _write(
    out: Path,
    result: Tuning,
    objective: Any,
    comparison: Comparison | None,
    cases: Sequence[Case],
    paths: Sequence[Path],
    *,
    of: str,
    examined: Sequence[Unmodelled],
    gate: TunedGate | None,
    form: FigureFormat,
    tables: Path | None,
) -> None:
    from strapdown import tuning
    from strapdown.files import write_json, written_beside
    from strapdown.plots import tuning as drawing
    from strapdown.plots.style import save_as
    from strapdown.setup import to_toml

    with written_beside(out) as temporary:
        temporary.write_text(to_toml(result.setup), encoding="utf-8")
    places = {name: out.with_name(f"{out.stem}-{name}.{form}") for name in FIGURES}
    for place in places.values():  # of an earlier tuning, which may have had more of them, or in another format
        for other in FigureFormat:
            place.with_suffix(f".{other}").unlink(missing_ok=True)
    report = out.with_suffix(".json")
    records = [case.record for case in cases]
    units = [_unit_of(name, records) for name in objective.names]
    own = [_unit_of(one.name, records) for one in result.parameters]
    content = _report(result, own, comparison, paths, of, examined, gate)
    write_json(report, content)
    figures = {places["likelihood"]: drawing.likelihood_slices(tuning.slices(objective, result), result, units)}
    if comparison is not None:
        figures[places["heldout"]] = drawing.before_and_after(
            comparison, title="The first record, on what was held out"
        )
    written(out, report, *save_as(figures, form), *tables_written(tables, "tuning", content))


def _report(
    result: Tuning,
    units: Sequence[Unit],
    comparison: Comparison | None,
    paths: Sequence[Path],
    of: str,
    examined: Sequence[Unmodelled],
    gate: TunedGate | None,
) -> dict[str, Any]:
    import numpy as np

    number = lambda value: None if isinstance(value, float) and not math.isfinite(value) else value  # noqa: E731
    content: dict[str, Any] = {
        "records": [path.name for path in paths],
        "parameters": [
            {**{key: number(value) for key, value in vars(one).items()}, "unit": unit.name, "si_per_unit": unit.factor}
            for one, unit in zip(result.parameters, units, strict=True)
        ],
        "units": "SI: rad, s, and the units of whole vectors; pages and tables tell each in its unit, of so much SI",
        "objective": {"name": of, "before": result.before, "after": result.after},
        "searches": {"number": len(result.starts), "at_the_best_point": result.agreeing},
        "innovations_fit": not result.misfit,
        "unmodelled": [one.summary() for one in examined],
    }
    if gate is not None:
        content["gate"] = {
            "probability": number(gate.probability),
            "lower": number(gate.lower),
            "upper": number(gate.upper),
            "thresholds": gate.thresholds,
        }
    if comparison is not None:
        content["held_out"] = {
            name: {
                "log_likelihood_per_innovation": one.log_likelihood,
                "nis_per_degree": one.nis,
                "nis_bounds": list(one.nis_bounds),
                "anees_per_state": number(one.anees),
                "attitude_rms_rad": number(one.attitude_rms),
                "nees_per_state": {course.of: number(float(np.nanmean(course.mean))) for course in one.nees},
                "judgements": [judgement.summary() for judgement in one.judgements],
            }
            for name, one in (("before", comparison.before), ("after", comparison.after))
        }
    return content


def _plan(
    records: Sequence[Path],
    chosen: FilterSetup | None,
    algorithm: Any,
    names: list[str] | None,
    length: str | None,
    threads: int,
) -> None:
    from strapdown import recordfiles, scenarios, setup, tuning
    from strapdown.checks import InputError

    if len(records) != 1:
        raise InputError(f"--plan takes one record or scenario; {len(records)} are given")
    source: Any
    path = records[0]
    if recordfiles.is_record(path):
        file = recordfiles.read_record_file(path)
        source, example = file.record, file.record
        if chosen is None and file.gyro is None:
            raise InputError(f"{path} does not tell its gyro; give the filter to plan with, --filter filter.toml")
        believed = chosen or setup.matched_to_record(file.gyro, file.record)  # type: ignore[arg-type]
        whole = float(file.record.time[-1] - file.record.time[0])
    else:
        source = scenarios.load_scenario(path)
        believed = chosen or setup.matched(source)
        example = scenarios.simulate(source)
        whole = source.duration
    if algorithm is not None:
        believed = replace(believed, integration=algorithm)
    lengths = [whole] if length is None else _numbers(length)
    wanted = names or list(tuning.default_names([example]))
    with progress_bar("simulated records", 4) as advance:
        found = tuning.plan(source, believed, wanted, lengths=lengths, threads=threads, progress=advance)
    _tell_plan(found, [example])


def _numbers(text: str) -> list[float]:
    from strapdown.checks import InputError

    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--length is {text!r}; it must be seconds with commas, as in 600,1800") from None


def _tell_plan(found: Plan, records: Sequence[ImuRecord]) -> None:
    columns = [f"{length:g} s" for length in found.lengths]
    listing = table(
        "Least standard error, as a factor (Cramér–Rao)", "parameter", "unit", "value", *columns, "10 % needs", left=2
    )
    for j, name in enumerate(found.names):
        unit = _unit_of(name, records)
        listing.add_row(
            name,
            unit.name,
            _figure(found.values[j] / unit.factor),
            *(f"× {math.exp(error):.3f}" if error < 2.0 else "nothing" for error in found.errors[:, j]),
            f"{found.needed()[j]:.3g} s",
        )
    show(listing)
    console.print(
        "Above about × 1.5 a record gives a bound rather than a value. The last column lets information grow as at the end."
    )
