"""Sensors: simulating scenarios, and identifying a gyro's noise."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strapdown.cli.terminal import app, console, need_own, progress_bar, scenario_named, show, table, writable, written

if TYPE_CHECKING:
    from strapdown import allan as identification


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

    chosen = scenario_named(scenario)
    toml = catalogue.scenario_to_toml(chosen)
    if show:
        console.print(toml)
        return
    used = chosen.seed if seed is None else seed
    target = out or Path(f"{chosen.name or Path(scenario).stem}.h5")
    writable("out", target, suffixes=(".h5", ".hdf5", ".csv"), sources=(scenario,))
    beside = [target.with_name(f"{target.stem}-vectors-{number}.csv") for number in range(len(chosen.sensors))]
    writable("out", *(beside if target.suffix.lower() == ".csv" else ()))
    need_own(target, "simulate", recordfiles.is_record)
    with progress_bar("simulating, writing", 2) as advance:
        record = catalogue.simulate(chosen, used, run)
        advance(1)
        if target.suffix.lower() == ".csv":
            paths = recordfiles.export_csv(target, record, gyro_spec=chosen.gyro, scenario=toml, seed=used, run=run)
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
        sigma = series.sigma if series.sigma_axes is None else series.sigma_axes
        if series.covariance is None and (sigma == 0.0).any():
            console.print(
                f"warning: {series.sensor}: its sigma is zero, which no filter can use; give it noise in the scenario, or tell the filter "
                "another in [filter.sigma]"
            )
    written(*paths)


@app.command()
def allan(
    recording: Annotated[
        Path, typer.Argument(help="Gyro at rest: HDF5 (simulated record or BROAD), CSV with time, gx, gy, gz, or NPY.")
    ],
    rate: Annotated[float | None, typer.Option(help="Samples a second, Hz; for NPY.")] = None,
    gyro_unit: Annotated[str | None, typer.Option(help="Unit of a CSV or NPY file's gyro: rad/s or deg/s.")] = None,
    time_unit: Annotated[str | None, typer.Option(help="Unit of a CSV file's time: s, ms, us or ns.")] = None,
    highest_frequency: Annotated[
        float | None,
        typer.Option(help="Hz; the fit leaves out what lies above: a low-pass filter's shape, vibration."),
    ] = None,
    robust: Annotated[
        bool, typer.Option(help="Draw the deviation by medians, which stands outliers; the fit stays as it is.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for gyro.toml, allan.json and the figure.")] = Path("allan-results"),
) -> None:
    """Identify a gyro's noise from a recording at rest: Allan deviation, fitted coefficients, specification as TOML."""
    import math

    import numpy as np

    from strapdown import allan as identification
    from strapdown import plots, recordings
    from strapdown.checks import InputError
    from strapdown.files import usable_folder, write_json, written_beside

    given = {"gyro": gyro_unit, "time": time_unit}
    usable_folder("out", out)
    writable("out", *(out / name for name in ("gyro.toml", "allan.json", "allan.png")), sources=(recording,))
    if recording.is_dir():
        raise InputError(f"{recording} is a folder; name a file")
    source = recordings.read_gyro(recording, rate=rate, units={name: unit for name, unit in given.items() if unit})
    if source.values.shape[1] not in (1, 3):
        raise InputError(
            f"{recording.name} has {source.values.shape[1]} columns; a gyro has three axes, or pass one column, (n,) or (n, 1)"
        )
    largest = float(np.abs(source.values).max(initial=0.0))
    if largest > _LARGEST_RATE:
        raise InputError(f"{recording.name} holds {largest:g} rad/s, which no gyro measures; check its unit")
    if not 1.0 / _LARGEST_RATE <= source.sample_interval <= _LARGEST_RATE:
        raise InputError(
            f"{recording.name}: {1.0 / source.sample_interval:g} Hz is no rate of a gyro; check it and its unit"
        )
    try:
        with progress_bar("fit, deviation, figure", 3) as advance:
            fit = identification.fit_noise(
                source.values, source.sample_interval, kind=source.kind, highest_frequency=highest_frequency
            )
            advance(1)
            deviation = identification.allan_deviation(
                source.values, source.sample_interval, kind=source.kind, estimator="robust" if robust else "overlapping"
            )
            advance(1)
            figure = plots.allan_overview(deviation, fit, identification.curves_by_axis(fit, deviation))
            advance(1)
    except InputError as error:
        raise InputError(f"{recording.name}: {error}") from None
    hours = len(source.values) * source.sample_interval / 3600.0
    length = f"{len(source.values)} samples at {1.0 / source.sample_interval:.6g} Hz, {hours:.3g} h"
    console.print(f"{recording.name}: {length}.", highlight=False)
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
    warnings = [
        f"axis {'xyz'[axis]} holds more than such noises: {what} (probability {max(probability, 1e-99):.0e})"
        for axis, (probability, what) in enumerate(zip(fit.misfit_probability, fit.misfit, strict=True))
        if probability < identification.MISFIT_PROBABILITY
    ]
    with written_beside(out / "gyro.toml") as temporary:
        temporary.write_text(_specification(fit, f"{recording.name}, {length}", warnings), encoding="utf-8")
    number = lambda value: None if isinstance(value, float) and not math.isfinite(value) else value  # noqa: E731
    write_json(
        out / "allan.json",
        {
            "source": recording.name,
            "sample_interval_s": source.sample_interval,
            "level": fit.level,
            "coefficients": [{key: number(value) for key, value in row.items()} for row in rows],
            "misfit_probability": [float(p) for p in fit.misfit_probability],
            "misfit": list(fit.misfit),
            "estimator": deviation.estimator,
            "tau_s": [float(tau) for tau in deviation.taus],
            "deviation_rad_per_s": [[number(float(x)) for x in axis] for axis in deviation.deviation],
        },
    )
    written(out / "gyro.toml", out / "allan.json", plots.save(figure, out / "allan.png"))
    for warning in warnings:
        console.print(f"warning: {warning}", highlight=False)
    if warnings:
        console.print("Cut the recording to where the gyro rests, or leave a filter's band out by --highest-frequency.")
        console.print(f"warning: {_DISBELIEF}.", highlight=False)


_LARGEST_RATE = 1e12
"""rad/s and Hz: far beyond any gyro, and far from where the fit's squares overflow."""
_DISBELIEF = "do not believe these intervals, nor gyro.toml"


def _specification(fit: identification.NoiseFit, source: str, warnings: list[str]) -> str:
    """Return the text of gyro.toml: the terms seen, and in comments the bounds of those not seen, and the warnings."""
    import numpy as np
    import tomli_w

    from strapdown import allan as identification
    from strapdown import gyro

    rounded: dict[str, Any] = {}  # six digits of the unit that is written: an estimate has no more
    for term, value in identification.to_gyro_parameters(fit).items():
        factor = gyro.FORM[term][0][1]
        rounded[term] = np.array([float(f"{x / factor:.6g}") * factor for x in np.atleast_1d(value)]).reshape(
            np.shape(value)
        )
    spec = gyro.GyroSpec(**rounded)
    lines = [f"Gyro noise by `strapdown allan` from {source}."]
    lines += [f"WARNING: {warning}." for warning in warnings]
    if warnings:
        lines.append(f"WARNING: {_DISBELIEF}.")
    text = _commented(lines) + "\n" + tomli_w.dumps({"gyro": gyro.to_table(spec)})
    partly, wholly = [], []
    for term, bound in identification.upper_bounds(fit).items():
        suffix, factor = gyro.FORM[term][0]
        values = [bound] if isinstance(bound, float) else list(bound)
        seen = fit.supported[:, fit.terms.index(term)]
        if seen.any():
            told = ", ".join(f"{'xyz'[k]} below {values[k] / factor:.4g}" for k in range(len(values)) if not seen[k])
            partly.append(f"{term}_{suffix}: 0 where not seen, {told}.")
        else:
            shown = ", ".join(f"{value / factor:.4g}" for value in values)
            wholly.append(f"{term}_{suffix} = {shown if len(values) == 1 else f'[{shown}]'}")
    if partly or wholly:
        text += "\n" + _commented(
            [
                f"Not seen in the record, so left out; the upper ends of their {100 * fit.level:g} % intervals:",
                *partly,
                *wholly,
            ]
        )
    return text


def _commented(lines: list[str]) -> str:
    """Return lines as comments of TOML, which may hold no control characters; a file's name may."""
    return "".join(f"# {''.join(c if c.isprintable() else '?' for c in line)}\n" for line in lines)
