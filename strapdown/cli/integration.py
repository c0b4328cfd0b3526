"""Integration algorithms: list, attitude from a gyro file, and the drift budget of a vibration spectrum."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from strapdown.checks import InputError
from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import (
    TABLES,
    command,
    console,
    json_target,
    need_own,
    put_json,
    say,
    show,
    tables_folder,
    tables_written,
    written,
)
from strapdown.files import reading, writable
from strapdown.units import DEGREE

if TYPE_CHECKING:
    from strapdown.recordings import Recording
    from strapdown.records import ImuRecord


@command
def algorithms(
    time: bool = typer.Option(True, help="Measure the time per sample on this machine (a few seconds)."),
    tables: Path | None = TABLES,
) -> None:
    """List the integration algorithms: samples, orders, drift constant, required input, time per sample."""
    from strapdown import coning

    tables_folder(tables)
    seconds = {}
    with progress_bar("timing", len(coning.ALGORITHMS)) as advance:
        for name in coning.ALGORITHMS if time else ():
            seconds[name] = coning.time_per_sample(name)
            advance(1)
    listing = coning.algorithm_table(seconds or None)
    show(listing)
    if tables is not None:
        written(*tables_written(tables, listing))


@command
def integrate(
    recording: Annotated[Path, typer.Argument(help=f"Simulated record (HDF5). {RECORDING_HELP}.")],
    layout: Layout,
    algorithm: str = typer.Option("four-sample", help="Name of the algorithm; see `strapdown algorithms`."),
    out: Path = typer.Option(Path("attitude.h5"), help="HDF5 file for the attitude."),
) -> None:
    """Integrate a gyro recording to attitude. Initial attitude: the true one if the file contains it, otherwise the identity."""
    from strapdown import coning, quaternion, recordings, records, workflows
    from strapdown.recordings import recordfiles

    writable("out", out, suffixes=(".h5", ".hdf5"), sources=(recording,))
    need_own(out, "integrate", lambda path: bool(records.read_attributes(path)["kind"] == "strapdown attitude"))
    chosen = coning.named(algorithm)
    reading_options = layout.options(recording)
    gaps: list[tuple[float, float]] = []
    words = ""
    with progress_bar("reading, integrating, writing", 3) as advance:
        source: ImuRecord | Recording
        if recordings.is_record(recording):
            source = recordfiles.read_record(recording)
            samples = len(source.increments)
            truth = None if source.truth is None else source.truth.attitude
        else:
            source = recordings.read(recording, **reading_options, gyro_alone=True)
            samples, truth = len(source.time) - 1, source.true_attitude
            gaps, words = recordings.gaps(source.time), " ".join([*source.remarks, source.left_out_words]).strip()
        advance(1)
        with reading.from_file(recording):
            time, attitude = workflows.integrate(source, chosen)
        advance(1)
        records.write_attitude(out, time, attitude, {"source": recording.name, "algorithm": chosen.name})
        advance(1)
    console.print(f"{recording.name}: {samples} samples over {time[-1] - time[0]:.6g} s with {chosen.name}.")
    left = samples % chosen.samples
    if left:
        console.print(f"Samples not used at the end, an incomplete step of {chosen.samples}: {left}.")
    if truth is not None:
        reference = truth[:: chosen.samples][: len(attitude)]
        known = np.isfinite(reference).all(axis=1)
    if truth is not None and known.any():
        error = np.degrees(quaternion.angle_between(quaternion.normalize(reference[known]), attitude[known]))
        console.print(f"Error relative to the file's attitude: final {error[-1]:.4g}°, maximum {error.max():.4g}°.")
    if gaps:
        from strapdown.ahrs.remarks import gap_words

        console.print(f"{gap_words(gaps)}: the rotation during a gap is interpolated.")
    say(words)
    written(out)


_RIGHT_ANGLE = 0.5 * math.pi


@command
def coning_budget(
    psd: Annotated[
        Path, typer.Option(help="CSV of vibration lines: frequency_hz, angle_deg[, angle_across_deg, phase_deg].")
    ],
    rate: Annotated[list[float], typer.Option(help="Sample rate of the gyro, Hz; may be given several times.")],
    algorithm: list[str] | None = typer.Option(None, help="Algorithm; may be given several times."),
    json: Path | None = typer.Option(None, help="Write the table as JSON too, to this file; - for standard output."),
    tables: Path | None = TABLES,
) -> None:
    """Predict the drift caused by an angular vibration spectrum, for each algorithm and sample rate."""
    from strapdown import coning

    json_target(json, psd)
    tables_folder(tables)
    lines = coning.read_vibration(psd)
    largest = max(max(line.angle, line.angle_across or 0.0) for line in lines)
    if largest >= _RIGHT_ANGLE:
        raise InputError(
            f"{psd} has an amplitude of {largest / DEGREE:.4g}°, but that of a vibration is below 90°; check the unit"
        )
    listing = coning.vibration_table(lines, rate, algorithm)
    show(listing)
    paths = tables_written(tables, listing)
    if json is not None:
        put_json(json, {"lines": len(lines), "budget": listing.records})
    if paths:
        written(*paths)
