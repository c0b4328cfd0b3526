"""Integration algorithms: list, attitude from a gyro file, and the drift budget of a vibration spectrum."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from typer import Argument, Option

from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import TABLES, check_files, command, console, json_target, put_json, say, show, written
from strapdown.files import reading


@command
def algorithms(
    time: bool = Option(True, help="Measure the time per sample on this machine (a few seconds)."),
    tables: Path | None = TABLES,
) -> None:
    """List the integration algorithms: samples, orders, drift constant, required input, time per sample."""
    from strapdown import coning

    check_files(tables=tables)
    seconds = {}
    with progress_bar("timing", len(coning.ALGORITHMS)) as advance:
        for name in coning.ALGORITHMS if time else ():
            seconds[name] = coning.time_per_sample(name)
            advance(1)
    listing = coning.algorithm_table(seconds or None)
    show(listing)
    written(tables=(tables, [listing]))


@command
def integrate(
    *,
    recording: Path = Argument(help=f"Simulated record (HDF5). {RECORDING_HELP}."),
    layout: Layout,
    algorithm: str = Option("four-sample", help="Name of the algorithm; see `strapdown algorithms`."),
    out: Path = Option(Path("attitude.h5"), help="HDF5 file for the attitude."),
) -> None:
    """Integrate a gyro recording to attitude. Initial attitude: the true one if the file contains it, otherwise the identity."""
    import strapdown as sd
    from strapdown import coning, quaternion, recordings, records

    own = lambda path: records.read_attributes(path)["kind"] == "strapdown attitude"  # noqa: E731
    check_files(out, suffixes=(".h5", ".hdf5"), sources=(recording,), own=own, command="integrate")
    chosen, options, simulated = coning.named(algorithm), layout.options(recording), recordings.is_record(recording)
    with progress_bar("reading, integrating, writing", 3) as advance:
        source: Any = sd.read(recording) if simulated else recordings.read(recording, **options, gyro_alone=True)
        samples = len(source.time) - 1
        truth = source.truth and source.truth.attitude if simulated else source.true_attitude
        advance(1)
        with reading.from_file(recording):
            time, attitude = sd.integrate(source, chosen)
        advance(1)
        records.write_attitude(out, time, attitude, {"source": recording.name, "algorithm": chosen.name})
        advance(1)
    console.print(f"{recording.name}: {samples} samples over {time[-1] - time[0]:.6g} s with {chosen.name}.")
    if left := samples % chosen.samples:
        console.print(f"Samples not used at the end, an incomplete step of {chosen.samples}: {left}.")
    if truth is not None:
        reference = truth[:: chosen.samples][: len(attitude)]
        known = np.isfinite(reference).all(axis=1)
        if known.any():
            error = np.degrees(quaternion.angle_between(quaternion.normalize(reference[known]), attitude[known]))
            console.print(f"Error relative to the file's attitude: final {error[-1]:.4g}°, maximum {error.max():.4g}°.")
    if not simulated:
        from strapdown.ahrs.remarks import gap_words

        gaps = gap_words(recordings.gaps(source.time))
        say(gaps and f"{gaps}: the rotation during a gap is interpolated.", *source.remarks, source.left_out_words)
    written(out)


@command
def coning_budget(
    *,
    psd: Path = Option(help="CSV of vibration lines: frequency_hz, angle_deg[, angle_across_deg, phase_deg]."),
    rate: list[float] = Option(help="Sample rate of the gyro, Hz; may be given several times."),
    algorithm: list[str] | None = Option(None, help="Algorithm; may be given several times."),
    json: Path | None = Option(None, help="Write the table as JSON too, to this file; - for standard output."),
    tables: Path | None = TABLES,
) -> None:
    """Predict the drift caused by an angular vibration spectrum, for each algorithm and sample rate."""
    from strapdown import coning

    json_target(json, psd)
    check_files(tables=tables)
    lines = coning.read_vibration(psd)
    listing = coning.vibration_table(lines, rate, algorithm)
    show(listing)
    put_json(json, {"lines": len(lines), "budget": listing.records})
    written(tables=(tables, [listing]))
