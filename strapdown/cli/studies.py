"""Integration of the gyro and studies: coning, and the covariance analysis of a filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from typer import Argument, Option

import strapdown as sd
from strapdown.cli import terminal as ui
from strapdown.cli.options import FILTER, FORMAT, RECORDING_HELP, SCENARIO, STATES, Format, Layout, by_name, numbers
from strapdown.files import HDF5, reading, write_json
from strapdown.units import DEGREE


@ui.command("tables")
def coning(
    angle: float = Option(0.7, help="Half-angle of the cone, degrees."),
    frequency: float = Option(10.0, help="Coning frequency, Hz."),
    rate: float = Option(100.0, help="Sample rate of the gyro, Hz."),
    duration: float = Option(240.0, help="Duration of each run, s."),
    runs: int = Option(100, help="Number of Monte Carlo runs."),
    seed: int = Option(1, help="Seed; the same one gives the same runs."),
    out: Path = Option(Path("coning-results"), help="Folder for coning.json and the figures."),
    algorithm: list[Path] | None = Option(None, help="TOML of your own algorithms; repeatable."),
    form: Format = FORMAT,
) -> None:
    """Study coning: the drift of each integration algorithm, and its effect on a filter."""
    from strapdown.montecarlo import coning_study

    own = tuple(custom for path in algorithm or () for custom in sd.coning.read_algorithms(path))
    motion = {"angle": angle * DEGREE, "frequency": frequency, "rate": rate, "duration": duration}
    parameters = coning_study.ConingParameters(**motion, runs=runs, seed=seed, own=own)  # type: ignore[arg-type]
    ui.check_files(out / "coning.json", *(out / f"{name}.{form}" for name in ("drift", "errors", "consistency")))
    with ui.progress_bar("runs", runs) as advance:
        study = coning_study.run(parameters, progress=advance)
    summary = study.summary()
    write_json(out / "coning.json", summary)
    ui.say(f"{coning_study.words(summary)}.\n")
    ui.show(*coning_study.tables(summary))
    ui.written(out / "coning.json", *sd.plots.draw_coning_study(study, out, form))


@ui.command("tables")
def covariance(
    scenario: str = Argument(help=SCENARIO),
    consider: list[str] | None = Option(
        None,
        metavar="ERROR=σ",
        help="An error without a state, with its 1σ: scale_factor (ppm), misalignment (mrad), g_sensitivity (°/h/g); SENSOR.bias (nT, "
        "m/s², arcsec), .mounting (arcsec), .delay (ms); or the true 1σ initial.attitude (°), initial.bias (°/h). Repeatable.",
    ),
    filter_file: Path | None = FILTER,
    states: bool | None = STATES,
    epochs: int = Option(100, help="Number of epochs over the duration of the scenario."),
    out: Path = Option(Path("covariance-results"), help="Folder for covariance.json and the figure."),
    form: Format = FORMAT,
) -> None:
    """Predict the errors of a filter and their budget by source, by a covariance analysis without random noise."""
    from strapdown.workflows.filters import filter_for_scenario, state_words

    body, name = sd.scenarios.load_scenario(scenario), Path(scenario).stem
    ui.check_files(out / "covariance.json", out / f"budget.{form}")
    named = by_name("--consider", consider or [], "NAME=VALUE, such as scale_factor=300")
    sizes = {name: numbers(f"--consider {name}", text, "a number", 1)[0] for name, text in named.items()}
    errors = sd.covariance.consider.considered(sizes, body.sensors)
    from_file = None if filter_file is None else sd.estimation.setup.read_setup(filter_file)
    filter_setup = filter_for_scenario(body, setup=from_file, states=states)
    with ui.progress_bar("covariance analysis"):
        result = sd.covariance_analysis(body, filter_setup, epochs=epochs, **errors)
    what = "the filter given" if from_file else "the filter that matches it"
    ui.say(f"{body.name or name}, {what}, integration {filter_setup.integration.name}.\n")
    ui.show(result.listing())
    if not from_file and states is None and filter_setup.states is not None:
        ui.say(state_words(filter_setup.states.names))
    write_json(out / "covariance.json", {"scenario": body.name or name, **result.summary()})
    figure = sd.plots.error_budget(result, title=f"{body.name or name}: predicted errors")
    ui.written(out / "covariance.json", *sd.plots.save_as({out / "budget": figure}, form))


@ui.command("tables")
def algorithms(
    time: bool = Option(True, help="Measure the time per sample on this machine (a few seconds)."),
) -> None:
    """List the integration algorithms: samples, orders, drift constant, required input, time per sample."""
    with ui.progress_bar("timing"):
        seconds = {name: sd.coning.time_per_sample(name) for name in sd.coning.ALGORITHMS} if time else None
    ui.show(sd.coning.algorithm_table(seconds))


@ui.command()
def integrate(
    *,
    recording: Path = Argument(help=f"Simulated record (HDF5). {RECORDING_HELP}."),
    layout: Layout,
    algorithm: str = Option("four-sample", help="Name of the algorithm; see `strapdown algorithms`."),
    out: Path = Option(Path("attitude.h5"), help="HDF5 file for the attitude."),
) -> None:
    """Integrate a gyro recording to attitude. Initial attitude: the true one if the file contains it, otherwise the identity."""
    ui.check_files(out, suffixes=HDF5, own="strapdown estimate")
    rule = sd.coning.named(algorithm)
    with ui.progress_bar("reading, integrating, writing"):
        source: Any = sd.read(recording, **layout.options)
        with reading.from_file(recording):
            estimate = sd.integrate(source, rule)
        sd.write(estimate, out)
    ui.say(f"{recording.name}: {estimate.remarks[0]}", *estimate.remarks[1:])
    ui.written(out)


@ui.command("tables", "json")
def coning_budget(
    *,
    psd: Path = Option(help="CSV of lines: frequency_hz, angle_deg[, angle_across_deg, phase_deg; default: a cone]."),
    rate: list[float] = Option(help="Sample rate of the gyro, Hz; may be given several times."),
    algorithm: list[str] | None = Option(None, help="Algorithm; may be given several times."),
) -> dict[str, Any]:
    """Predict the drift caused by an angular vibration spectrum, for each algorithm and sample rate."""
    lines = sd.coning.read_vibration(psd)
    ui.show(listing := sd.coning.vibration_table(lines, rate, algorithm))
    return {"lines": len(lines), "budget": listing.records}
