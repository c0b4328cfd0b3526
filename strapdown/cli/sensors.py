"""Sensors: simulating scenarios, and identifying a gyro's noise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from strapdown.cli.terminal import app, console, progress_bar, show, table, written


@app.command()
def scenarios() -> None:
    """List the built-in scenarios."""
    from strapdown.scenarios import builtin_rows

    rows = builtin_rows()
    listing = table("Built-in scenarios: `strapdown simulate NAME`", "name", "s", "Hz", "gyro")
    for row in rows:
        listing.add_row(str(row["name"]), f"{row['duration_s']:g}", f"{row['rate_hz']:g}", str(row["gyro"]))
    show(listing)
    for row in rows:
        console.print(f"{row['name']}: {row['description']}")


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help="Name of a built-in scenario, or a TOML file.")],
    out: Annotated[Path | None, typer.Option(help="HDF5 file, or CSV by its suffix; NAME.h5 if not given.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed; the scenario's own if not given.")] = None,
    run: Annotated[int, typer.Option(help="Number of the run of this seed.")] = 0,
    show: Annotated[
        bool, typer.Option(help="Print the scenario as TOML, to start a file of one's own, and stop.")
    ] = False,
) -> None:
    """Simulate a scenario: a record with its truth."""
    from strapdown import recordfiles
    from strapdown import scenarios as catalogue
    from strapdown.files import output_file

    chosen = catalogue.load_scenario(scenario)
    toml = catalogue.scenario_to_toml(chosen)
    if show:
        console.print(toml, soft_wrap=True)
        return
    used = chosen.seed if seed is None else seed
    target = out or Path(f"{chosen.name or Path(scenario).stem}.h5")
    output_file("out", target, (".h5", ".hdf5", ".csv"), scenario)
    with progress_bar("simulating, writing", 2) as advance:
        record = catalogue.simulate(chosen, used, run)
        advance(1)
        if target.suffix.lower() == ".csv":
            paths = recordfiles.export_csv(target, record)
        else:
            recordfiles.write_record(target, record, gyro_spec=chosen.gyro, scenario=toml, seed=used, run=run)
            paths = (target,)
        advance(1)
    console.print(
        f"{chosen.name or target.stem}: {len(record.increments)} gyro samples over {record.time[-1] - record.time[0]:g} s, seed {used}, "
        f"run {run}.",
        highlight=False,
    )
    for series in record.vectors:
        console.print(f"  {series.sensor}: {len(series.time)} measurements ({series.kind})")
    written(*paths)


@app.command()
def allan(
    recording: Annotated[
        Path, typer.Argument(help="Gyro at rest: HDF5 (simulated record or BROAD), CSV with time, gx, gy, gz, or NPY.")
    ],
    rate: Annotated[float | None, typer.Option(help="Samples a second, Hz; for NPY.")] = None,
    gyro_unit: Annotated[str | None, typer.Option(help="Unit of a CSV or NPY file's gyro: rad/s or deg/s.")] = None,
    time_unit: Annotated[str | None, typer.Option(help="Unit of a CSV file's time: s, ms, us or ns.")] = None,
    robust: Annotated[
        bool, typer.Option(help="Draw the deviation by medians, which stands outliers; the fit stays as it is.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for gyro.toml, allan.json and the figure.")] = Path("allan-results"),
) -> None:
    """Identify a gyro's noise from a recording at rest: Allan deviation, fitted coefficients, specification as TOML."""
    import math

    import tomli_w

    from strapdown import allan as identification
    from strapdown import gyro, plots, recordings
    from strapdown.files import usable_folder, write_json, written_beside

    given = {"gyro": gyro_unit, "time": time_unit}
    usable_folder("out", out)
    source = recordings.read_gyro(recording, rate=rate, units={name: unit for name, unit in given.items() if unit})
    with progress_bar("deviation, fit, figure", 3) as advance:
        deviation = identification.allan_deviation(
            source.values, source.sample_interval, kind=source.kind, estimator="robust" if robust else "overlapping"
        )
        advance(1)
        fit = identification.fit_noise(source.values, source.sample_interval, kind=source.kind)
        advance(1)
        figure = plots.allan_overview(deviation, fit, identification.curves_by_axis(fit, deviation))
        advance(1)
    hours = len(source.values) * source.sample_interval / 3600.0
    console.print(
        f"{recording.name}: {len(source.values)} samples at {1.0 / source.sample_interval:g} Hz, {hours:.3g} h."
    )
    rows = identification.table(fit)
    listing = table("Noise coefficients with 95 % intervals", "axis", "term", "unit", "estimate", "from", "to", left=3)
    for row in rows:
        estimate = f"{row['estimate']:.4g}" if row["supported"] else "not seen"
        lower = f"{row['lower']:.4g}" if row["supported"] else ""
        listing.add_row(
            "xyz"[int(str(row["axis"]))],
            f"{row['term']} ({row['symbol']})",
            str(row["unit"]),
            estimate,
            lower,
            f"{row['upper']:.4g}",
        )
    show(listing)
    console.print("Of a term not seen in this record, the last column bounds what it could hide.")
    for axis, probability in enumerate(fit.misfit_probability):
        if probability < 1e-3:
            console.print(
                f"axis {'xyz'[axis]}: the record holds something that no such noise explains (probability {probability:.1g}): "
                "motion, a vibration line, a filter, outliers. Do not believe its intervals."
            )
    parameters: dict[str, Any] = dict(identification.to_gyro_parameters(fit))
    spec = gyro.GyroSpec(**parameters)
    with written_beside(out / "gyro.toml") as temporary:
        temporary.write_text(tomli_w.dumps({"gyro": gyro.to_table(spec)}), encoding="utf-8")
    number = lambda value: None if isinstance(value, float) and not math.isfinite(value) else value  # noqa: E731
    write_json(
        out / "allan.json",
        {
            "source": recording.name,
            "sample_interval_s": source.sample_interval,
            "coefficients": [{key: number(value) for key, value in row.items()} for row in rows],
            "misfit_probability": [float(p) for p in fit.misfit_probability],
            "tau_s": [float(tau) for tau in deviation.taus],
            "deviation_rad_per_s": [[number(float(x)) for x in axis] for axis in deviation.deviation],
        },
    )
    written(out / "gyro.toml", out / "allan.json", plots.save(figure, out / "allan.png"))
