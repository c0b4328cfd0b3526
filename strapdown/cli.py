"""The command line. Only this module prints; units are degrees, hours and arcseconds here and radians and seconds below."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from strapdown.checks import InputError

app = typer.Typer(
    help="Strapdown gyro attitude estimation: simulate, estimate, judge.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()
errors = Console(stderr=True)


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Any]:
    """Yield a function that advances a bar by so many units; on standard error, and only on a terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.advance(task, done)


def _table(title: str, *columns: str) -> Table:
    """Print the title and return an empty table: titles longer than their table would wrap inside it."""
    console.print(f"[bold]{title}[/]", highlight=False)
    table = Table(box=box.SIMPLE_HEAD, header_style="", pad_edge=False, padding=(0, 1, 0, 0))
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right", no_wrap=True)
    return table


@app.callback(invoke_without_command=True)
def _about(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.", is_eager=True)] = False,
) -> None:
    if version:
        import strapdown

        console.print(f"strapdown {strapdown.__version__}")
        raise typer.Exit


@app.command()
def coning(
    angle: Annotated[float, typer.Option(help="Half-angle of the cone, degrees.")] = 0.7,
    frequency: Annotated[float, typer.Option(help="Coning frequency, Hz.")] = 10.0,
    rate: Annotated[float, typer.Option(help="Gyro samples a second, Hz.")] = 100.0,
    duration: Annotated[float, typer.Option(help="Length of each run, s.")] = 240.0,
    runs: Annotated[int, typer.Option(help="Monte Carlo runs.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed; the same one gives the same runs.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for coning.json and the figures.")] = Path("coning-results"),
) -> None:
    """Study coning: the drift of each integration algorithm, and what a filter makes of it."""
    from strapdown import coning_study
    from strapdown.files import write_json
    from strapdown.units import DEGREE

    parameters = coning_study.ConingParameters(
        angle=angle * DEGREE, frequency=frequency, rate=rate, duration=duration, runs=runs, seed=seed
    )
    with progress_bar("Monte Carlo runs", runs) as advance:
        study = coning_study.run(parameters, progress=advance)
    summary = study.summary()
    write_json(out / "coning.json", summary)
    scenario = summary["scenario"]
    console.print(
        f"Coning of {angle:g}° at {frequency:g} Hz, gyro sampled at {rate:g} Hz ({rate / frequency:.3g} samples a cycle); "
        f"{runs} runs of {scenario['duration_s']:g} s, seed {seed}.\n"
    )
    drift = _table(
        "Drift of the integration, °/h about the cone's axis", "algorithm", "samples", "measured", "predicted"
    )
    for row in summary["integration"]:
        drift.add_row(
            row["algorithm"],
            str(row["samples"]),
            f"{row['drift_deg_per_hour']:.4g}",
            f"{row['predicted_deg_per_hour']:.4g}",
        )
    console.print(drift)
    verdicts = _table(
        "The same noisy filter on each: RMS error / what the filter says of itself",
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
            "[green]pass[/]" if row["consistent"] else "[red]FAIL[/]",
        )
    console.print(verdicts)
    low, high = summary["filter"][0]["anees_bias_bounds"]
    nis_low, nis_high = summary["filter"][0]["nis_bounds"]
    console.print(
        f"ANEES and NIS are per degree of freedom: 1 is a filter as good as it says. 99 % bounds: ANEES of attitude and of bias "
        f"{low:.3f} to {high:.3f} at one epoch, NIS {nis_low:.4f} to {nis_high:.4f}.\n"
    )
    from strapdown import plots

    paths = plots.draw_coning_study(study, out)
    console.print("Written: " + ", ".join(str(path) for path in [out / "coning.json", *paths]), soft_wrap=True)


@app.command()
def estimate(
    recording: Annotated[
        Path, typer.Argument(help="BROAD HDF5 file, or CSV with time, gx, gy, gz, ax, ay, az[, mx, my, mz].")
    ],
    out: Annotated[Path, typer.Option(help="Folder for estimate.h5, errors.json and the figures.")] = Path(
        "estimate-results"
    ),
    gyro_unit: Annotated[str | None, typer.Option(help="Unit of a CSV file's gyro: rad/s or deg/s.")] = None,
    accelerometer_unit: Annotated[
        str | None, typer.Option(help="Unit of a CSV file's accelerometer: m/s2 or g.")
    ] = None,
    time_unit: Annotated[str | None, typer.Option(help="Unit of a CSV file's time: s, ms, us or ns.")] = None,
    full_covariance: Annotated[
        bool, typer.Option(help="Write whole 6 x 6 covariances, not only their diagonals.")
    ] = False,
) -> None:
    """Estimate attitude and gyro bias from a recording: accelerometer as the vertical, magnetometer as the heading."""
    from strapdown import ahrs, plots, recordings
    from strapdown.consistency import reference_errors
    from strapdown.files import write_json
    from strapdown.records import write_estimate
    from strapdown.units import DEGREE

    given = {"gyro": gyro_unit, "accelerometer": accelerometer_unit, "time": time_unit}
    source = recordings.read(recording, units={name: unit for name, unit in given.items() if unit})
    parameters = ahrs.AhrsParameters()
    result = ahrs.estimate(source, parameters, full_covariance=full_covariance)
    used = result.recording
    write_estimate(
        out / "estimate.h5",
        result.estimate,
        {
            "source": used.source,
            "fixed_frame": "East-North-Up, magnetic North",
            **{f"parameter.{name}": value for name, value in vars(parameters).items()},
        },
    )
    console.print(
        f"{used.source}: {len(used.time)} samples over {used.time[-1] - used.time[0]:.1f} s, started in the quiet second "
        f"from {used.time[0]:.2f} s."
    )
    for sensor, number in result.estimate.skipped.items():
        if number:
            console.print(f"{number} samples of the {sensor} are missing and were skipped.")
    figure = plots.estimate_overview(result.estimate, title=used.source)
    written = [out / "estimate.h5", plots.save(figure, out / "estimate.png")]
    if used.true_attitude is not None:
        errors_found = reference_errors(result.estimate.attitude, used.true_attitude)
        rms = {name: value / DEGREE for name, value in errors_found.rms(used.movement).items()}
        write_json(
            out / "errors.json", {"source": used.source, **{f"{name}_rmse_deg": value for name, value in rms.items()}}
        )
        table = _table("RMS error over the movement phase, degrees", *rms)
        table.add_row(*(f"{value:.2f}" for value in rms.values()))
        console.print(table)
        figure = plots.recording_errors(used.time, errors_found, used.movement)
        written += [out / "errors.json", plots.save(figure, out / "errors.png")]
    console.print("Written: " + ", ".join(str(path) for path in written), soft_wrap=True)


def main() -> None:
    """Run the command line; bad input ends with one clear line and status 2, Ctrl-C with status 130."""
    try:
        app(standalone_mode=True)
    except InputError as error:
        errors.print(f"[red]error:[/] {error}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        errors.print("interrupted")
        sys.exit(130)
