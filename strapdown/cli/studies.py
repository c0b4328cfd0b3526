"""Integration of the gyro and studies: coning, and the covariance analysis of a filter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, non_negative, one_of
from strapdown.cli import terminal as ui
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.files import reading, write_json
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR, STANDARD_GRAVITY


@ui.command
def coning(
    angle: float = Option(0.7, help="Half-angle of the cone, degrees."),
    frequency: float = Option(10.0, help="Coning frequency, Hz."),
    rate: float = Option(100.0, help="Sample rate of the gyro, Hz."),
    duration: float = Option(240.0, help="Duration of each run, s."),
    runs: int = Option(100, help="Number of Monte Carlo runs."),
    seed: int = Option(1, help="Seed; the same one gives the same runs."),
    out: Path = Option(Path("coning-results"), help="Folder for coning.json and the figures."),
    algorithm: list[Path] | None = Option(None, help="TOML of your own algorithms; repeatable."),
    form: ui.Format = ui.FORMAT,
    tables: Path | None = ui.TABLES,
) -> None:
    """Study coning: the drift of each integration algorithm, and its effect on a filter."""
    from strapdown.montecarlo import coning_study

    own = tuple(custom for path in algorithm or () for custom in sd.coning.read_algorithms(path))
    motion = {"angle": angle * DEGREE, "frequency": frequency, "rate": rate, "duration": duration}
    parameters = coning_study.ConingParameters(**motion, runs=runs, seed=seed, own=own)  # type: ignore[arg-type]
    names = ("drift", "errors", "consistency")
    ui.check_files(out / "coning.json", *(out / f"{name}.{form}" for name in names), tables=tables)
    if own:
        ui.show(coning_study.own_table(own))
    with ui.progress_bar("runs", runs) as advance:
        study = coning_study.run(parameters, progress=advance)
    summary = study.summary()
    write_json(out / "coning.json", summary)
    length = summary["scenario"]["duration_s"]
    whole = "" if length == duration else f" (not {duration:g}: an integer number of epochs and steps)"
    ui.say(
        f"Coning of {angle:g}° at {frequency:g} Hz, gyro sampled at {rate:g} Hz ({rate / frequency:.3g} samples per cycle); "
        f"{ui.counted(runs, 'run')} of {length:g} s{whole}, seed {seed}.\n"
    )
    listed = coning_study.tables(summary)
    ui.show(*listed)
    ui.written(out / "coning.json", *sd.plots.draw_coning_study(study, out, form), tables=(tables, listed))


def _considered(texts: Sequence[str], sensors: Any) -> dict[str, Any]:
    """Return errors, given as NAME=VALUE, as arguments of :func:`strapdown.covariance_analysis` in SI units."""
    sizes = {"scale_factor": 1e-6, "misalignment": 1e-3, "g_sensitivity": DEGREE_PER_HOUR / STANDARD_GRAVITY}
    sizes |= {"initial.attitude": DEGREE, "initial.bias": DEGREE_PER_HOUR}
    fields = {"bias": "sensor_bias", "mounting": "mounting", "delay": "time_offset"}
    for sensor in sensors:
        bias = {sd.vectors.Magnetometer: 1e-9, sd.vectors.Accelerometer: 1.0}.get(type(sensor), ARCSECOND)
        sizes |= zip((f"{sensor.name}.{what}" for what in fields), (bias, ARCSECOND, 1e-3), strict=True)
    values: dict[str, float] = {}
    for text in texts:
        name, _, number = text.rpartition("=")
        if not name:
            raise InputError(f"--consider is {text!r}; give NAME=VALUE, such as scale_factor=300")
        if one_of("--consider", name, sizes) in values:
            raise InputError(f"--consider: {name} is given twice; give it once")
        try:
            values[name] = float(number)
        except ValueError:
            raise InputError(f"--consider {name}: {number!r} is no number; give NAME=VALUE") from None
        values[name] = non_negative(f"--consider {name}", values[name]) * sizes[name]
    initial = {f"initial_{what}_sigma": values.pop(f"initial.{what}", None) for what in ("attitude", "bias")}
    errors: dict[str, Any] = {field: {} for field in fields.values()}
    for name, value in values.items():
        sensor, _, what = name.rpartition(".")
        (errors[fields[what]] if sensor else errors)[sensor or name] = value
    return {"consider": sd.covariance.Consider(**errors), **initial}


@ui.command
def covariance(
    scenario: str = Argument(help=ui.SCENARIO),
    consider: list[str] | None = Option(
        None,
        metavar="ERROR=σ",
        help="An error that the filter does not model, with its 1σ: scale_factor (ppm), misalignment (mrad), g_sensitivity (°/h/g); "
        "SENSOR.bias (nT, m/s², arcsec), SENSOR.mounting (arcsec), SENSOR.delay (ms); or the true 1σ initial.attitude (°), initial.bias "
        "(°/h). Repeatable.",
    ),
    filter_file: Path | None = ui.FILTER,
    states: bool | None = ui.STATES,
    epochs: int = Option(100, help="Number of epochs over the duration of the scenario."),
    out: Path = Option(Path("covariance-results"), help="Folder for covariance.json and the figure."),
    form: ui.Format = ui.FORMAT,
    tables: Path | None = ui.TABLES,
) -> None:
    """Predict the errors of a filter and their budget by source, by a covariance analysis without random noise."""
    from strapdown.estimation import setup
    from strapdown.workflows.filters import filter_for_scenario, state_words

    body = sd.scenarios.load_scenario(scenario)
    files = (out / "covariance.json", out / f"budget.{form}")
    ui.check_files(*files, tables=tables, sources=(scenario, filter_file))
    errors = _considered(consider or (), body.sensors)
    from_file = None if filter_file is None else setup.read_setup(filter_file)
    filter_setup = filter_for_scenario(body, setup=from_file, states=states)
    with ui.progress_bar("covariance analysis"):
        result = sd.covariance_analysis(body, filter_setup, epochs=epochs, **errors)
    name = body.name or Path(scenario).stem
    what = "the filter given" if from_file else "the filter that matches it"
    ui.say(f"{name}, {what}, integration {filter_setup.integration.name}.\n")
    budget = result.listing()
    ui.show(budget)
    if not from_file:
        if states is None and filter_setup.states is not None:
            ui.say(state_words(filter_setup.states.names))
        missing = setup.unmodelled_errors(body.gyro, body.sensors, filter_setup.states, gravity_f=body.gravity_f)
        if missing:
            ui.say(f"The filter has no state for {', '.join(missing)}.")
    write_json(files[0], {"scenario": name, **result.summary()})
    figures = sd.plots.save_as({out / "budget": sd.plots.error_budget(result, title=f"{name}: predicted errors")}, form)
    ui.written(files[0], *figures, tables=(tables, [budget]))


@ui.command
def algorithms(
    time: bool = Option(True, help="Measure the time per sample on this machine (a few seconds)."),
    tables: Path | None = ui.TABLES,
) -> None:
    """List the integration algorithms: samples, orders, drift constant, required input, time per sample."""
    ui.check_files(tables=tables)
    seconds = {}
    with ui.progress_bar("timing", len(sd.coning.ALGORITHMS)) as advance:
        for name in sd.coning.ALGORITHMS if time else ():
            seconds[name] = sd.coning.time_per_sample(name)
            advance(1)
    listing = sd.coning.algorithm_table(seconds or None)
    ui.show(listing)
    ui.written(tables=(tables, [listing]))


@ui.command
def integrate(
    *,
    recording: Path = Argument(help=f"Simulated record (HDF5). {RECORDING_HELP}."),
    layout: Layout,
    algorithm: str = Option("four-sample", help="Name of the algorithm; see `strapdown algorithms`."),
    out: Path = Option(Path("attitude.h5"), help="HDF5 file for the attitude."),
) -> None:
    """Integrate a gyro recording to attitude. Initial attitude: the true one if the file contains it, otherwise the identity."""
    own = lambda path: sd.records.read_attributes(path)["kind"] == "strapdown attitude"  # noqa: E731
    ui.check_files(out, suffixes=(".h5", ".hdf5"), sources=(recording,), own=own, command="integrate")
    rule, options, simulated = (
        sd.coning.named(algorithm),
        layout.options(recording),
        sd.recordings.is_record(recording),
    )
    with ui.progress_bar("reading, integrating, writing", 3) as advance:
        source: Any = sd.read(recording) if simulated else sd.recordings.read(recording, **options, gyro_alone=True)
        samples = len(source.time) - 1
        truth = source.truth and source.truth.attitude if simulated else source.true_attitude
        advance(1)
        with reading.from_file(recording):
            time, attitude = sd.integrate(source, rule)
        advance(1)
        sd.records.write_attitude(out, time, attitude, {"source": recording.name, "algorithm": rule.name})
        advance(1)
    ui.say(f"{recording.name}: {samples} samples over {time[-1] - time[0]:.6g} s with {rule.name}.")
    if left := samples % rule.samples:
        ui.say(f"Samples not used at the end, an incomplete step of {rule.samples}: {left}.")
    if truth is not None:
        reference = truth[:: rule.samples][: len(attitude)]
        known = np.isfinite(reference).all(axis=1)
        if known.any():
            error = np.degrees(sd.quaternion.angle_between(sd.quaternion.normalize(reference[known]), attitude[known]))
            ui.say(f"Error relative to the file's attitude: final {error[-1]:.4g}°, maximum {error.max():.4g}°.")
    if not simulated:
        from strapdown.ahrs.remarks import gap_words

        gaps = gap_words(sd.recordings.gaps(source.time))
        ui.say(gaps and f"{gaps}: the rotation during a gap is interpolated.", *source.remarks, source.left_out_words)
    ui.written(out)


@ui.command
def coning_budget(
    *,
    psd: Path = Option(help="CSV of vibration lines: frequency_hz, angle_deg[, angle_across_deg, phase_deg]."),
    rate: list[float] = Option(help="Sample rate of the gyro, Hz; may be given several times."),
    algorithm: list[str] | None = Option(None, help="Algorithm; may be given several times."),
    json: Path | None = Option(None, help="Write the table as JSON too, to this file; - for standard output."),
    tables: Path | None = ui.TABLES,
) -> None:
    """Predict the drift caused by an angular vibration spectrum, for each algorithm and sample rate."""
    ui.json_target(json, psd)
    ui.check_files(tables=tables)
    lines = sd.coning.read_vibration(psd)
    listing = sd.coning.vibration_table(lines, rate, algorithm)
    ui.show(listing)
    ui.put_json(json, {"lines": len(lines), "budget": listing.records})
    ui.written(tables=(tables, [listing]))
