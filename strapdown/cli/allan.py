"""Identification of the noise of a sensor at rest."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from typer import Argument, Option

from strapdown.checks import InputError, count, one_of, positive
from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Samples
from strapdown.cli.terminal import FORMAT, TABLES, Format, check_files, command, console, say, show, written
from strapdown.files import plain, write_json, write_text

if TYPE_CHECKING:
    from strapdown.allan import NoiseFit


@dataclass(frozen=True)
class _Identification:
    """Identification."""

    rate: float | None = Option(None, help="Sample rate of an NPY file, Hz.")
    highest_frequency: float | None = Option(None, help="Maximum frequency of the fit, Hz.")
    robust: bool = Option(False, "--robust", help="Compute the deviation from medians; does not affect the fit.")
    temperature: int | None = Option(
        None,
        metavar="ORDER",
        help="Subtract a polynomial of the recorded temperature, of this order, and identify the rest.",
    )


@dataclass(frozen=True, eq=False)
class _Output:
    """Output."""

    out: Path = Option(Path("allan-results"), help="Folder for gyro.toml, allan.json and the figure.")
    form: Format = FORMAT
    tables: Path | None = TABLES
    kalibr: bool = Option(False, "--kalibr", help="Also write imu.yaml; needs gyro and accelerometer.")
    factor: float = Option(1.0, help="Factor on the noise in imu.yaml, usually 5 to 10.")
    px4: bool = Option(False, "--px4", help="Also write px4.params of EKF2; needs gyro and accelerometer.")
    matlab: bool = Option(False, "--matlab", help="Also write imu_sensor.m for imuSensor.")


@command
def allan(
    *,
    recording: Path = Argument(help=f"Sensor at rest: simulated record (HDF5), NPY. {RECORDING_HELP}."),
    samples: Samples,
    options: _Identification,
    output: _Output,
    sensor: list[str] | None = Option(None, help="gyro (default), accelerometer or magnetometer; may be repeated."),
) -> None:
    """Identify the noise of a sensor from a recording at rest: Allan deviation, fitted coefficients, specification as TOML."""
    from strapdown.allan import parameters
    from strapdown.allan.noise_fit import SENSORS

    out, name = output.out, recording.name
    chosen = [one_of("--sensor", one, SENSORS) for one in dict.fromkeys(sensor or ["gyro"])]
    if (output.kalibr or output.px4) and not {"gyro", "accelerometer"} <= set(chosen):
        raise InputError("--kalibr and --px4 need both: --sensor gyro --sensor accelerometer")
    positive("--factor", output.factor)
    if options.temperature is not None:
        count("--temperature", options.temperature)
    fits: dict[str, NoiseFit] = {}
    exports: dict[str, Any] = {
        "imu.yaml": output.kalibr
        and (lambda: parameters.to_kalibr(fits, factor=output.factor, topic=samples.topic or "/imu0", source=name)),
        "px4.params": output.px4 and (lambda: parameters.to_px4(fits, source=name)),
        "imu_sensor.m": output.matlab and (lambda: parameters.to_matlab(fits, source=name)),
    }
    exports = {file: text for file, text in exports.items() if text}
    files = [out / file for file in (*(file for one in chosen for file in _names(one, output.form)), *exports)]
    check_files(*files, tables=output.tables, sources=(recording,))
    # For simulated records and arrays the reader raises errors for options that do not apply.
    plain_units = recording.suffix.lower() == ".npy" or (samples.columns is None and samples.topic is None)
    layout = {"units": samples.units} if plain_units else samples.options(recording)
    fits |= {one: _identify(recording, one, layout, options, output) for one in chosen}
    for file, text in exports.items():
        write_text(out / file, text())
    written(*(out / file for file in exports))
    if output.kalibr:
        console.print(f"imu.yaml has the maximum over the axes times {output.factor:g} (--factor).")


def _names(sensor: str, form: str) -> tuple[str, str, str, str]:
    """Return the files of a sensor: its specification, the numbers, the figure, its bias over temperature."""
    stem = "allan" if sensor == "gyro" else sensor
    return (f"{sensor}.toml", f"{stem}.json", f"{stem}.{form}", f"{sensor}-temperature.toml")


def _identify(
    recording: Path, sensor: str, layout: dict[str, Any], options: _Identification, output: _Output
) -> NoiseFit:
    """Identify the noise of one sensor; print and write the results."""
    from strapdown import allan as identification
    from strapdown import plots, recordings
    from strapdown.allan import parameters
    from strapdown.plots.style import save_as

    specification, numbers, drawing, warm = (output.out / name for name in _names(sensor, output.form))
    source = recordings.read_samples(recording, sensor, rate=options.rate, gaps=True, **layout)
    interval, values, temperature = source.sample_interval, source.values, ""
    gaps = bool(np.isnan(values).any())
    if gaps and options.robust:
        raise InputError(f"{recording.name} has gaps, which --robust does not support; leave it out")
    try:
        if options.temperature is not None:
            values, listing, temperature = identification.temperature.regressed(source, sensor, options.temperature)
            show(listing)
        with progress_bar("fit, deviation, figure"):
            how: dict[str, Any] = {"kind": source.kind}
            fit = identification.fit_noise(
                values, interval, sensor=sensor, highest_frequency=options.highest_frequency, **how
            )
            estimator = "robust" if options.robust else "overlapping"
            deviation = identification.allan_deviation(values, interval, estimator=estimator, **how)
            figure = plots.allan_overview(deviation, fit)
    except InputError as error:
        raise InputError(f"{recording.name}: {error}") from None
    length = f"{len(values)} samples at {1.0 / interval:.6g} Hz, {len(values) * interval / 3600.0:.3g} h"
    console.print(f"{recording.name}: {length}.", highlight=False)
    say(*source.remarks)
    if gaps:
        shortest = identification.noise_fit.SHORTEST
        console.print(
            f"Because of gaps the fit uses {fit.samples} samples in segments of {shortest} or more; the deviation uses all samples."
        )
    table = fit.listing()
    show(table, title=f"Noise coefficients with {100.0 * fit.level:g} % intervals", notes=False)
    console.print("For a term not detected in this record, the last column is an upper bound.")
    write_text(specification, parameters.to_specification(fit, f"{recording.name}, {length}"))
    content = {
        "source": recording.name,
        "sample_interval_s": fit.sample_interval,
        "level": fit.level,
        "coefficients": identification.table(fit),
        "misfit_probability": fit.misfit_probability,
        "misfit": fit.misfit,
        "estimator": deviation.estimator,
        "tau_s": deviation.taus,
        f"deviation_{identification.temperature.UNITS[sensor][1]}": deviation.deviation,
    }
    write_json(numbers, plain(content))
    if temperature:
        write_text(warm, temperature)
    files = [specification, numbers, *([warm] if temperature else []), *save_as({drawing: figure}, output.form)]
    written(*files, tables=(output.tables, [table]))
    say(*(f"warning: {warning}" for warning in fit.warnings))
    if fit.warnings:
        say(
            f"Cut the recording to an interval where the {sensor} is at rest, or exclude the band of a filter by --highest-frequency.",
            f"warning: {parameters.DISTRUST}, nor {specification.name}.",
        )
    return fit
