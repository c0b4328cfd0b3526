"""Studies without a recording: coning, and the covariance analysis of a filter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from typer import Argument, Option

from strapdown.checks import InputError, non_negative, one_of
from strapdown.cli.progress import progress_bar
from strapdown.cli.terminal import (
    FILTER,
    FORMAT,
    SCENARIO,
    STATES,
    TABLES,
    Format,
    check_files,
    command,
    console,
    counted,
    show,
    written,
)
from strapdown.files import write_json
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR, STANDARD_GRAVITY


@command
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
    tables: Path | None = TABLES,
) -> None:
    """Study coning: the drift of each integration algorithm, and its effect on a filter."""
    from strapdown import plots
    from strapdown.coning import read_algorithms
    from strapdown.montecarlo import coning_study

    own = tuple(one for path in algorithm or () for one in read_algorithms(path))
    motion = {"angle": angle * DEGREE, "frequency": frequency, "rate": rate, "duration": duration}
    parameters = coning_study.ConingParameters(**motion, runs=runs, seed=seed, own=own)  # type: ignore[arg-type]
    names = ("drift", "errors", "consistency", *(["algorithms"] if own else []))
    check_files(out / "coning.json", *(out / f"{name}.{form}" for name in names), tables=tables)
    if own:
        show(coning_study.own_table(own))
    with progress_bar("runs", runs) as advance:
        study = coning_study.run(parameters, progress=advance)
    summary = study.summary()
    write_json(out / "coning.json", summary)
    length = summary["scenario"]["duration_s"]
    whole = "" if length == duration else f" (not {duration:g}: an integer number of epochs and steps)"
    console.print(
        f"Coning of {angle:g}° at {frequency:g} Hz, gyro sampled at {rate:g} Hz ({rate / frequency:.3g} samples per cycle); "
        f"{counted(runs, 'run')} of {length:g} s{whole}, seed {seed}.\n"
    )
    listed = coning_study.tables(summary)
    show(*listed)
    written(out / "coning.json", *plots.draw_coning_study(study, out, form), tables=(tables, listed))


def _considered(texts: Sequence[str], sensors: Any) -> dict[str, Any]:
    """Return errors, given as NAME=VALUE, as arguments of :func:`strapdown.covariance_analysis` in SI units."""
    from strapdown.covariance import Consider
    from strapdown.vectors import Accelerometer, Magnetometer

    sizes = {"scale_factor": 1e-6, "misalignment": 1e-3, "g_sensitivity": DEGREE_PER_HOUR / STANDARD_GRAVITY}
    sizes |= {"initial.attitude": DEGREE, "initial.bias": DEGREE_PER_HOUR}
    fields = {"bias": "sensor_bias", "mounting": "mounting", "delay": "time_offset"}
    for sensor in sensors:
        bias = {Magnetometer: 1e-9, Accelerometer: 1.0}.get(type(sensor), ARCSECOND)
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
    return {"consider": Consider(**errors), **initial}


@command
def covariance(
    scenario: str = Argument(help=SCENARIO),
    consider: list[str] | None = Option(
        None,
        metavar="ERROR=σ",
        help="An error that the filter does not model, with its 1σ: scale_factor (ppm), misalignment (mrad), g_sensitivity (°/h/g); "
        "SENSOR.bias (nT, m/s², arcsec), SENSOR.mounting (arcsec), SENSOR.delay (ms); or the true 1σ initial.attitude (°), initial.bias "
        "(°/h). Repeatable.",
    ),
    filter_file: Path | None = FILTER,
    states: bool | None = STATES,
    epochs: int = Option(100, help="Number of epochs over the duration of the scenario."),
    out: Path = Option(Path("covariance-results"), help="Folder for covariance.json and the figure."),
    form: Format = FORMAT,
    tables: Path | None = TABLES,
) -> None:
    """Predict the errors of a filter and their budget by source, by a covariance analysis without random noise."""
    import strapdown as sd
    from strapdown.estimation import setup
    from strapdown.plots.style import save_as
    from strapdown.workflows import filter_for_scenario, state_words

    body = sd.scenarios.load_scenario(scenario)
    files = (out / "covariance.json", out / f"budget.{form}")
    check_files(*files, tables=tables, sources=(scenario, filter_file))
    errors = _considered(consider or (), body.sensors)
    given = None if filter_file is None else setup.read_setup(filter_file)
    chosen = filter_for_scenario(body, setup=given, states=states)
    with progress_bar("covariance analysis"):
        result = sd.covariance_analysis(body, chosen, epochs=epochs, **errors)
    name = body.name or Path(scenario).stem
    what = "the filter given" if given else "the filter that matches it"
    console.print(f"{name}, {what}, integration {chosen.integration.name}.\n")
    budget = result.listing()
    show(budget)
    if not given:
        if states is None and chosen.states is not None:
            console.print(state_words(chosen.states.names))
        missing = setup.unmodelled_errors(body.gyro, body.sensors, chosen.states, gravity_f=body.gravity_f)
        if missing:
            console.print(f"The filter has no state for {', '.join(missing)}.")
    write_json(files[0], {"scenario": name, **result.summary()})
    figures = save_as({out / "budget": sd.plots.error_budget(result, title=f"{name}: predicted errors")}, form)
    written(files[0], *figures, tables=(tables, [budget]))
