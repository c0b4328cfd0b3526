"""Planning: predicted accuracy of a filter, without simulation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from strapdown.checks import InputError, finite, non_negative
from strapdown.cli.filters import default_words, filter_of_scenario
from strapdown.cli.progress import progress_bar
from strapdown.cli.terminal import (
    FORMAT,
    TABLES,
    FigureFormat,
    command,
    console,
    scenario_named,
    show,
    tables_folder,
    tables_written,
    written,
)
from strapdown.files import usable_folder, writable, write_json
from strapdown.units import ARCSECOND, DEGREE, DEGREE_PER_HOUR, STANDARD_GRAVITY

if TYPE_CHECKING:
    from strapdown.covariance import Consider


def _named(option: str, values: list[str] | None) -> dict[str, float]:
    """Return the numbers from options NAME=VALUE."""
    found = {}
    for text in values or []:
        name, equals, number = text.rpartition("=")
        if not equals or not name:
            raise InputError(f"{option} is {text!r}; give NAME=VALUE, such as 'magnetometer=50'")
        try:
            value = finite(f"{option}: {name}", float(number))
        except ValueError:
            raise InputError(f"{option}: {name}: {number!r} is no number; give NAME=VALUE") from None
        if name in found:
            raise InputError(f"{option}: {name} is given twice; give it once")
        found[name] = value
    return found


def _in_own_units(biases: dict[str, float], sensors: Any) -> dict[str, float]:
    """Return sensor biases, given in nT, m/s² or arcsec, in the unit of each sensor's σ."""
    from strapdown.vectors import Accelerometer, Magnetometer

    sizes = {sensor.name: {Magnetometer: 1e-9, Accelerometer: 1.0}.get(type(sensor), ARCSECOND) for sensor in sensors}
    return {name: value * sizes.get(name, 1.0) for name, value in biases.items()}


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors that the filter does not model."""

    scale_factor: float = typer.Option(0.0, help="Consider gyro scale factor errors with this 1σ, ppm.")
    misalignment: float = typer.Option(0.0, help="Consider gyro misalignments with this 1σ, mrad.")
    g_sensitivity: float = typer.Option(0.0, help="Consider gyro g-sensitivities with this 1σ, °/h/g.")
    sensor_bias: list[str] | None = typer.Option(
        None, help="Consider a sensor bias with this 1σ per axis, NAME=VALUE: nT, m/s², or arcsec. Repeatable."
    )
    mounting: list[str] | None = typer.Option(
        None, help="Consider a mounting error of a sensor with this 1σ per axis, NAME=ARCSEC. Repeatable."
    )
    time_offset: list[str] | None = typer.Option(
        None, help="Consider a delay of a sensor with this 1σ, NAME=MS. Repeatable."
    )
    attitude_sigma: float | None = typer.Option(
        None, help="True 1σ of the initial attitude, per axis, degrees. Default: that of the filter."
    )
    bias_sigma: float | None = typer.Option(
        None, help="True 1σ of the initial bias, per axis, °/h. Default: that of the filter."
    )

    def check(self) -> None:
        """Raise an error for negative σ, in the unit of the option."""
        units = {"scale_factor": "ppm", "misalignment": "mrad", "g_sensitivity": "°/h/g"}
        for name, unit in (units | {"attitude_sigma": "degrees", "bias_sigma": "°/h"}).items():
            non_negative("--" + name.replace("_", "-"), getattr(self, name) or 0.0, unit=unit)

    def considered(self, sensors: Any) -> Consider:
        """Return the errors in SI units, for the sensors of a scenario."""
        from strapdown.covariance import Consider

        return Consider(
            scale_factor=1e-6 * self.scale_factor,
            misalignment=1e-3 * self.misalignment,
            g_sensitivity=self.g_sensitivity * DEGREE_PER_HOUR / STANDARD_GRAVITY,
            sensor_bias=_in_own_units(_named("sensor_bias", self.sensor_bias), sensors),
            mounting={name: value * ARCSECOND for name, value in _named("mounting", self.mounting).items()},
            time_offset={name: 1e-3 * value for name, value in _named("time_offset", self.time_offset).items()},
        )


@command
def covariance(
    scenario: Annotated[str, typer.Argument(help="Name of a built-in scenario, or a TOML file.")],
    errors: _Errors,
    filter_file: Path | None = typer.Option(
        None,
        "--filter",
        help="TOML with a table named filter, as written by `strapdown tune`. Default: the filter that matches the scenario.",
    ),
    states: bool | None = typer.Option(
        None,
        "--states/--no-states",
        help="With or without a state for each error that the scenario specifies. Default: with, if there are such errors and no filter is "
        "given.",
    ),
    epochs: int = typer.Option(100, help="Number of epochs over the duration of the scenario."),
    out: Path = typer.Option(Path("covariance-results"), help="Folder for covariance.json and the figure."),
    form: FigureFormat = FORMAT,
    tables: Path | None = TABLES,
) -> None:
    """Predict the errors of a filter and their budget by source, by a covariance analysis without random noise."""
    from strapdown import covariance as analysis
    from strapdown import plots
    from strapdown.estimation import setup
    from strapdown.plots.style import save_as

    errors.check()
    chosen = scenario_named(scenario)
    usable_folder("out", out)
    tables_folder(tables)
    writable("out", out / "covariance.json", out / f"budget.{form}", sources=(scenario, filter_file))
    considered = errors.considered(chosen.sensors)
    if states is not None and filter_file:
        raise InputError("--filter defines the complete filter with its states; leave --states and --no-states out")
    modelled = (
        filter_of_scenario(filter_file, chosen)
        if filter_file
        else setup.FilterSetup.for_scenario(chosen, states=states)
    )
    with progress_bar("covariance analysis"):
        found = analysis.analyse(
            chosen,
            modelled,
            consider=considered,
            initial_attitude_sigma=None if errors.attitude_sigma is None else errors.attitude_sigma * DEGREE,
            initial_bias_sigma=None if errors.bias_sigma is None else errors.bias_sigma * DEGREE_PER_HOUR,
            epochs=epochs,
        )
    name = chosen.name or Path(scenario).stem
    what = "the filter given" if filter_file else "the filter that matches it"
    console.print(f"{name}, {what}, integration {modelled.integration.name}.\n")
    budget = found.listing()
    show(budget)
    if states is None and not filter_file and modelled.states is not None:
        console.print(default_words(modelled.states.names))
    missing = setup.unmodelled_errors(chosen.gyro, chosen.sensors, modelled.states, gravity_f=chosen.gravity_f)
    if missing and not filter_file:
        console.print(f"The filter has no state for {', '.join(missing)}.")
    write_json(out / "covariance.json", _summary(name, found))
    title = f"{name}: predicted errors"
    figures = save_as({out / "budget": plots.error_budget(found, title=title)}, form)
    written(out / "covariance.json", *figures, *tables_written(tables, budget))


def _summary(name: str, found: Any) -> dict[str, Any]:
    """Return the content of the JSON file, with the units in the keys."""
    units = np.array([ARCSECOND] * 3 + [DEGREE_PER_HOUR] * 3)

    def parts(values: Any) -> dict[str, Any]:
        shown = values / units
        return {"attitude_arcsec": shown[..., :3].tolist(), "bias_deg_per_hour": shown[..., 3:].tolist()}

    return {
        "scenario": name,
        "time_s": found.time.tolist(),
        "rms": parts(found.rms),
        "filter_sigma": parts(found.filter_sigma),
        "mean_error": parts(found.mean_error),
        "expected_nees_per_state": dict(
            zip(("state", "attitude", "bias"), found.expected_nees.T.tolist(), strict=True)
        ),
        "expected_nis": dict(found.expected_nis),
        "random": {
            source: parts(np.sqrt(np.maximum(np.diagonal(found.contributions[:, k], axis1=1, axis2=2), 0.0)))
            for k, source in enumerate(found.sources)
        },
        "fixed": {source: parts(found.fixed_errors[:, k]) for k, source in enumerate(found.fixed)},
        "considered": {source: parts(found.considered_errors[:, k]) for k, source in enumerate(found.considered)},
        "left_out": list(found.left_out),
        "beyond_linear": list(found.beyond_linear),
    }
