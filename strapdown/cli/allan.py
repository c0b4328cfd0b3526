"""Identification of the noise of a sensor at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, count, one_of, positive
from strapdown.cli import terminal as ui
from strapdown.cli.options import FORMAT, RECORDING_HELP, Format, Samples
from strapdown.files import plain, reading, write_json, write_text


@dataclass(frozen=True, eq=False)
class _Identification:
    """Identification."""

    sensor: list[str] | None = Option(None, help="gyro (default), accelerometer or magnetometer; may be repeated.")
    rate: float | None = Option(None, help="Sample rate of an NPY file, Hz.")
    highest_frequency: float | None = Option(None, help="Maximum frequency of the fit, Hz.")
    temperature: int | None = Option(None, metavar="ORDER", help="Order of the temperature's polynomial to subtract.")


@dataclass(frozen=True, eq=False)
class _Output:
    """Output."""

    out: Path = Option(Path("allan-results"), help="Folder for gyro.toml, allan.json and the figure.")
    form: Format = FORMAT
    kalibr: bool = Option(False, "--kalibr", help="Also write imu.yaml; needs gyro and accelerometer.")
    factor: float = Option(1.0, help="Factor on the noise in imu.yaml, usually 5 to 10.")
    px4: bool = Option(False, "--px4", help="Also write px4.params of EKF2; needs gyro and accelerometer.")
    matlab: bool = Option(False, "--matlab", help="Also write imu_sensor.m for imuSensor.")

    def files(self, sensor: str) -> list[Path]:
        """Return the files of a sensor: its specification, the numbers, the figure, its bias over temperature."""
        stem = "allan" if sensor == "gyro" else sensor
        names = (f"{sensor}.toml", f"{stem}.json", f"{stem}.{self.form}", f"{sensor}-temperature.toml")
        return [self.out / name for name in names]


@ui.command("tables")
def allan(
    *,
    recording: Path = Argument(help=f"Sensor at rest: simulated record (HDF5), NPY. {RECORDING_HELP}."),
    samples: Samples,
    options: _Identification,
    output: _Output,
) -> None:
    """Identify the noise of a sensor from a recording at rest: Allan deviation, fitted coefficients, specification as TOML."""
    sensors = [one_of("--sensor", sensor, sd.allan.UNITS) for sensor in dict.fromkeys(options.sensor or ["gyro"])]
    if (output.kalibr or output.px4) and not {"gyro", "accelerometer"} <= set(sensors):
        raise InputError("--kalibr and --px4 need both: --sensor gyro --sensor accelerometer")
    positive("--factor", output.factor)
    if options.temperature is not None:
        count("--temperature", options.temperature)
    kalibr = partial(sd.allan.parameters.to_kalibr, factor=output.factor, topic=samples.topic or "/imu0")
    exports: dict[Path, Any] = {}
    for name, wanted, to in (
        ("imu.yaml", output.kalibr, kalibr),
        ("px4.params", output.px4, sd.allan.parameters.to_px4),
        ("imu_sensor.m", output.matlab, sd.allan.parameters.to_matlab),
    ):
        if wanted:
            exports[output.out / name] = to
    ui.check_files(*(file for sensor in sensors for file in output.files(sensor)), *exports)
    fits = {sensor: _identified(recording, sensor, samples, options, output) for sensor in sensors}
    for file, text in exports.items():
        write_text(file, text(fits, source=recording.name))
    ui.written(*exports)
    if output.kalibr:
        ui.say(f"imu.yaml has the maximum over the axes times {output.factor:g} (--factor).")


def _identified(
    recording: Path, sensor: str, samples: Samples, options: _Identification, output: _Output
) -> sd.allan.NoiseFit:
    """Identify the noise of one sensor; print and write the results."""
    source = sd.recordings.read_samples(recording, sensor, rate=options.rate, **samples.options)
    specification, numbers, drawing, warm = output.files(sensor)
    paths, number = [specification, numbers], len(source.values)
    with reading.from_file(recording):
        if options.temperature is not None:
            left, table, temperature = sd.allan.temperature.regressed(source, sensor, options.temperature)
            source = replace(source, values=left)
            ui.show(table)
        with ui.progress_bar("fit, deviation, figure"):
            fit = sd.fit_noise(source, sensor=sensor, highest_frequency=options.highest_frequency)
            deviation = sd.allan_deviation(source, sensor=sensor)
            figure = sd.plots.allan_overview(deviation, fit)
    dt = source.sample_interval
    length = f"{recording.name}, {number} samples at {1.0 / dt:.6g} Hz, {number * dt / 3600.0:.3g} h"
    ui.say(f"{length}.", *source.remarks)
    if fit.samples < number:
        ui.say(
            f"Because of gaps the fit uses {fit.samples} samples in segments of {sd.allan.noise_fit.SHORTEST} or more; the deviation uses "
            "averages that have most of their samples."
        )
    ui.show(fit.listing(), notes=False)
    ui.say("For a term not detected in this record, the last column is an upper bound.")
    write_text(specification, sd.allan.parameters.to_specification(fit, length))
    curve = {"tau_s": deviation.taus, f"deviation_{sd.allan.temperature.UNITS[sensor][1]}": deviation.deviation}
    write_json(numbers, plain({"source": recording.name, **fit.summary(), **curve}))
    if options.temperature is not None:
        write_text(warm, temperature)
        paths.append(warm)
    ui.written(*paths, *sd.plots.save_as({drawing: figure}, output.form))
    ui.say(*(f"warning: {warning}" for warning in fit.warnings))
    return fit
