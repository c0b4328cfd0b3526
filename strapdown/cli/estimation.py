"""The filter on a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from strapdown.cli.terminal import app, console, show, table, written


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
    gyro: Annotated[
        Path | None,
        typer.Option(
            help="TOML with a table named gyro, as `strapdown allan` writes it: the filter believes its noise."
        ),
    ] = None,
    full_covariance: Annotated[
        bool, typer.Option(help="Write whole 6 x 6 covariances, not only their diagonals.")
    ] = False,
) -> None:
    """Estimate attitude and gyro bias from a recording: accelerometer as the vertical, magnetometer as the heading."""
    from strapdown import ahrs, plots, recordings
    from strapdown.consistency import reference_errors
    from strapdown.files import usable_folder, write_json
    from strapdown.gyro import process_noise, read_spec
    from strapdown.records import write_estimate
    from strapdown.units import DEGREE

    given = {"gyro": gyro_unit, "accelerometer": accelerometer_unit, "time": time_unit}
    source = recordings.read(recording, units={name: unit for name, unit in given.items() if unit})
    parameters = ahrs.AhrsParameters()
    if gyro is not None:
        parameters = replace(parameters, **process_noise(read_spec(gyro)))
    usable_folder("out", out)
    result = ahrs.estimate(source, parameters, full_covariance=full_covariance)
    used = result.recording
    errors_found = None
    if used.true_attitude is not None:
        errors_found = reference_errors(result.estimate.attitude, used.true_attitude)
        rms = {name: value / DEGREE for name, value in errors_found.rms(used.movement).items()}
    figures = {"estimate.png": plots.estimate_overview(result.estimate, title=used.source)}
    if errors_found is not None:
        figures["errors.png"] = plots.recording_errors(used.time, errors_found, used.movement)
    frame = (
        "East-North-Up, magnetic North"
        if used.magnetic_field is not None
        else "z up, heading arbitrary (no magnetometer)"
    )
    paths = [out / "estimate.h5"]
    write_estimate(
        paths[0],
        result.estimate,
        {
            "source": used.source,
            "fixed_frame": frame,
            **{f"parameter.{name}": value for name, value in vars(parameters).items()},
        },
    )
    console.print(
        f"{used.source}: {len(used.time)} samples over {used.time[-1] - used.time[0]:.1f} s, started in the quiet second "
        f"from {used.time[0]:.2f} s."
    )
    console.print(f"Fixed frame: {frame}.")
    for begin, length in recordings.gaps(used.time):
        console.print(f"Gap of {length:.3g} s after {begin:.3f} s: the turn across it is a guess, whatever σ says.")
    for sensor, number in result.estimate.skipped.items():
        if number:
            console.print(f"{number} samples of the {sensor} are missing and were skipped.")
    if errors_found is not None:
        paths.append(out / "errors.json")
        write_json(paths[-1], {"source": used.source, **{f"{name}_rmse_deg": value for name, value in rms.items()}})
        rows = table("RMS error over the movement phase, degrees", *rms, left=0)
        rows.add_row(*(f"{value:.2f}" for value in rms.values()))
        show(rows)
    written(*paths, *(plots.save(figure, out / name) for name, figure in figures.items()))
