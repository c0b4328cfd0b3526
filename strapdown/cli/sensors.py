"""Sensors: simulation of scenarios, and identification of sensor noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from strapdown.checks import InputError, count, one_of, positive
from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Samples
from strapdown.cli.terminal import (
    FORMAT,
    TABLES,
    FigureFormat,
    command,
    console,
    need_own,
    say,
    scenario_named,
    show,
    tables_folder,
    tables_written,
    written,
)
from strapdown.files import atomic_write, plain, usable_folder, writable, write_json
from strapdown.results import Column, Table

if TYPE_CHECKING:
    from strapdown import allan as identification
    from strapdown.recordings import GyroSamples


@command
def scenarios() -> None:
    """List the built-in scenarios."""
    from strapdown.scenarios import builtin_rows

    rows = builtin_rows()
    cells = [[row[key] for key in ("name", "duration_s", "rate_hz", "gyro")] for row in rows]
    columns = ("name", Column("s", digits=6), Column("Hz", digits=6), "gyro")
    show(Table("Built-in scenarios: `strapdown simulate NAME`", columns, cells))
    for row in rows:
        console.print(f"{row['name']}: {row['description']}")


@command
def simulate(
    scenario: Annotated[str, typer.Argument(help="Name of a built-in scenario, or a TOML file.")],
    out: Path | None = typer.Option(
        None, help="HDF5 file, or CSV by its suffix. Default: .h5 with the name, or the TOML file, of the scenario."
    ),
    seed: int | None = typer.Option(None, help="Seed. Default: that of the scenario."),
    run: int = typer.Option(0, help="Number of the run of this seed."),
    show: bool = typer.Option(False, help="Print the scenario as TOML, as a template for your own, and stop."),
) -> None:
    """Simulate a scenario: a record with its truth."""
    from strapdown import scenarios as catalogue
    from strapdown.recordings import recordfiles

    chosen = scenario_named(scenario)
    toml = catalogue.scenario_to_toml(chosen)
    if show:
        console.print(toml)
        return
    used = chosen.seed if seed is None else seed
    target = out or Path(f"{Path(scenario).stem}.h5")
    writable("out", target, suffixes=(".h5", ".hdf5"), sources=(scenario,))
    need_own(target, "simulate", recordfiles.is_record)
    with progress_bar("simulating, writing", 2) as advance:
        record = catalogue.simulate(chosen, used, run)
        advance(1)
        recordfiles.write_record(target, record)
        advance(1)
    console.print(
        f"{chosen.name or target.stem}: {len(record.increments)} gyro samples over {record.time[-1] - record.time[0]:g} s, seed {used}, "
        f"run {run}.",
        highlight=False,
    )
    for series in record.vectors:
        console.print(f"  {series.sensor}: {len(series.time)} measurements ({series.kind})")
        sigma = series.sigma if series.sigma_axes is None else series.sigma_axes
        if series.covariance is None and (sigma == 0.0).any():
            console.print(
                f"warning: {series.sensor}: its sigma is zero, which a filter cannot use; add noise in the scenario, or give the filter "
                "another sigma in [filter.sigma]"
            )
    written(target)


@dataclass(frozen=True)
class _Identification:
    """Identification."""

    rate: float | None = typer.Option(None, help="Sample rate of an NPY file, Hz.")
    highest_frequency: float | None = typer.Option(
        None, help="Maximum frequency of the fit, Hz, to exclude a low-pass filter or vibration."
    )
    robust: bool = typer.Option(
        False, help="Compute the deviation from medians, which is robust to outliers; does not affect the fit."
    )
    temperature: int | None = typer.Option(
        None,
        metavar="ORDER",
        help="Regress the bias on the recorded temperature, with a polynomial of this order, and identify the noise of the residuals.",
    )


@dataclass(frozen=True, eq=False)
class _Exports:
    """Files for other programs."""

    kalibr: bool = typer.Option(False, "--kalibr", help="Also write imu.yaml; needs gyro and accelerometer.")
    factor: float = typer.Option(1.0, help="Factor on the noise in imu.yaml, usually 5 to 10.")
    px4: bool = typer.Option(False, "--px4", help="Also write px4.params of EKF2; needs gyro and accelerometer.")
    matlab: bool = typer.Option(False, "--matlab", help="Also write imu_sensor.m for imuSensor.")

    @property
    def files(self) -> list[str]:
        """Names of the requested files."""
        wanted = {"imu.yaml": self.kalibr, "px4.params": self.px4, "imu_sensor.m": self.matlab}
        return [name for name, asked in wanted.items() if asked]

    def check(self, sensors: list[str]) -> None:
        """Raise an error for files that need another sensor, and for an invalid factor."""
        if (self.kalibr or self.px4) and not {"gyro", "accelerometer"} <= set(sensors):
            raise InputError("--kalibr and --px4 need both: --sensor gyro --sensor accelerometer")
        positive("--factor", self.factor)

    def write(self, fits: dict[str, identification.NoiseFit], out: Path, source: str, topic: str | None) -> None:
        """Write the requested files."""
        from strapdown.allan import parameters

        made = {
            "imu.yaml": lambda: parameters.to_kalibr(fits, factor=self.factor, topic=topic or "/imu0", source=source),
            "px4.params": lambda: parameters.to_px4(fits, source=source),
            "imu_sensor.m": lambda: parameters.to_matlab(fits, source=source),
        }
        for name in self.files:
            with atomic_write(out / name) as temporary:
                temporary.write_text(made[name](), encoding="utf-8")
        if self.files:
            written(*(out / name for name in self.files))
        if self.kalibr:
            console.print(f"imu.yaml has the maximum over the axes times {self.factor:g} (--factor).")


@dataclass(frozen=True)
class _Output:
    """Output."""

    out: Path = typer.Option(Path("allan-results"), help="Folder for gyro.toml, allan.json and the figure.")
    form: FigureFormat = FORMAT
    tables: Path | None = TABLES


@command
def allan(
    recording: Annotated[
        Path,
        typer.Argument(help=f"Sensor at rest: simulated record (HDF5), NPY. {RECORDING_HELP}."),
    ],
    samples: Samples,
    options: _Identification,
    exports: _Exports,
    output: _Output,
    sensor: list[str] | None = typer.Option(
        None, help="gyro (default), accelerometer or magnetometer; may be repeated."
    ),
) -> None:
    """Identify the noise of a sensor from a recording at rest: Allan deviation, fitted coefficients, specification as TOML."""
    from strapdown.allan.noise_fit import SENSORS

    chosen = list(dict.fromkeys(sensor or ["gyro"]))
    for one in chosen:
        one_of("--sensor", one, SENSORS)
    exports.check(chosen)
    if options.temperature is not None:
        count("--temperature", options.temperature)
    usable_folder("out", output.out)
    tables_folder(output.tables)
    names = [*(name for one in chosen for name in _names(one, output.form)), *exports.files]
    writable("out", *(output.out / name for name in names), sources=(recording,))
    # For simulated records and arrays the reader raises errors for options that do not apply.
    plain_units = recording.suffix.lower() == ".npy" or (samples.columns is None and samples.topic is None)
    layout = {"units": samples.units} if plain_units else samples.options(recording)
    fits = {one: _identify(recording, one, layout, options, output) for one in chosen}
    exports.write(fits, output.out, recording.name, samples.topic)


def _names(sensor: str, form: str = FigureFormat.png) -> tuple[str, ...]:
    """Return the files of a sensor: its specification, the numbers, the figure."""
    stem = "allan" if sensor == "gyro" else sensor
    return (f"{sensor}.toml", f"{stem}.json", f"{stem}.{form}", f"{sensor}-temperature.toml")


def _identify(
    recording: Path, sensor: str, layout: dict[str, Any], options: _Identification, output: _Output
) -> identification.NoiseFit:
    """Identify the noise of one sensor; print and write the results."""
    from strapdown import allan as identification
    from strapdown import plots, recordings
    from strapdown.allan import parameters
    from strapdown.plots.style import save_as

    out, (specification, _, figure_name, _) = output.out, _names(sensor, output.form)
    source = recordings.read_samples(recording, sensor, rate=options.rate, gaps=True, **layout)
    _plausible(recording, sensor, source)
    gaps = bool(np.isnan(source.values).any())
    if gaps and options.robust:
        raise InputError(f"{recording.name} has gaps, which --robust does not support; leave it out")
    values = source.values
    paths: list[Path] = []
    try:
        if options.temperature is not None:
            values = _regressed(recording, sensor, source, options.temperature, out, paths)
        with progress_bar("fit, deviation, figure", 3) as advance:
            fit = identification.fit_noise(
                values,
                source.sample_interval,
                kind=source.kind,
                sensor=sensor,
                highest_frequency=options.highest_frequency,
            )
            estimator = "robust" if options.robust else "overlapping"
            deviation = identification.allan_deviation(
                values, source.sample_interval, kind=source.kind, estimator=estimator
            )
            advance(2)
            figure = plots.allan_overview(deviation, fit)
            advance(1)
    except InputError as error:
        raise InputError(f"{recording.name}: {error}") from None
    hours = len(values) * source.sample_interval / 3600.0
    length = f"{len(values)} samples at {1.0 / source.sample_interval:.6g} Hz, {hours:.3g} h"
    console.print(f"{recording.name}: {length}.", highlight=False)
    say(*source.remarks)
    if gaps:
        shortest = identification.noise_fit.SHORTEST
        console.print(
            f"Because of gaps the fit uses {fit.samples} samples in segments of {shortest} or more; the deviation uses all samples."
        )
    found = fit.listing()
    show(found, f"Noise coefficients with {100.0 * fit.level:g} % intervals", notes=False)
    console.print("For a term not detected in this record, the last column is an upper bound.")
    paths = [
        *_saved(recording, fit, deviation, length, output),
        *paths,
        *save_as({out / figure_name: figure}, output.form),
    ]
    written(*paths, *tables_written(output.tables, found))
    for warning in fit.warnings:
        console.print(f"warning: {warning}", highlight=False)
    if fit.warnings:
        console.print(
            f"Cut the recording to an interval where the {sensor} is at rest, or exclude the band of a filter by --highest-frequency."
        )
        console.print(f"warning: {parameters.DISTRUST}, nor {specification}.", highlight=False)
    return fit


def _saved(
    recording: Path,
    fit: identification.NoiseFit,
    deviation: identification.AllanDeviation,
    length: str,
    output: _Output,
) -> list[Path]:
    """Write the specification and the numbers of a sensor, and return the files."""
    from strapdown import allan as identification
    from strapdown.allan import parameters

    specification, numbers = (output.out / name for name in _names(fit.sensor)[:2])
    with atomic_write(specification) as temporary:
        temporary.write_text(parameters.to_specification(fit, f"{recording.name}, {length}"), encoding="utf-8")
    content = {
        "source": recording.name,
        "sample_interval_s": fit.sample_interval,
        "level": fit.level,
        "coefficients": identification.table(fit),
        "misfit_probability": fit.misfit_probability,
        "misfit": fit.misfit,
        "estimator": deviation.estimator,
        "tau_s": deviation.taus,
        f"deviation_{_UNITS[fit.sensor][1]}": deviation.deviation,
    }
    write_json(numbers, plain(content))
    return [specification, numbers]


def _plausible(recording: Path, sensor: str, source: GyroSamples) -> None:
    """Raise an error for impossible samples, whose squares would overflow."""
    if source.values.shape[1] not in (1, 3):
        raise InputError(
            f"{recording.name} has {source.values.shape[1]} columns; a {sensor} has three axes, or pass one column, (n,) or (n, 1)"
        )
    largest = float(np.nanmax(np.abs(source.values), initial=0.0))
    if largest > _LARGEST_RATE:
        raise InputError(
            f"{recording.name} holds {largest:g} {_UNITS[sensor][0]}, which no {sensor} measures; check its unit"
        )
    if not 1.0 / _LARGEST_RATE <= source.sample_interval <= _LARGEST_RATE:
        raise InputError(
            f"{recording.name}: {1.0 / source.sample_interval:g} Hz is no sample rate of a {sensor}; check it and its unit"
        )


def _regressed(recording: Path, sensor: str, source: GyroSamples, order: int, out: Path, paths: list[Path]) -> Any:
    """Return the samples less their regression on temperature, which is printed and written."""
    import tomli_w

    from strapdown.allan import temperature as allan_temperature
    from strapdown.allan.parameters import commented
    from strapdown.gyro.temperature import to_table

    if source.temperature is None:
        raise InputError("no temperature is recorded; leave --temperature out")
    if np.isnan(source.values).any():
        raise InputError("there are gaps, which --temperature does not support; cut the recording between them")
    scale = source.sample_interval if source.kind == "increments" else 1.0
    fit = allan_temperature.fit_temperature(
        source.values / scale, source.temperature, source.sample_interval, order=order
    )
    unit, stem = _UNITS[sensor]
    show(fit.listing(unit))
    paths.append(out / _names(sensor)[3])
    with atomic_write(paths[-1]) as temporary:
        text = commented(
            [f"Bias over temperature by `strapdown allan` from {recording.name}, a polynomial in T - reference."]
        )
        content = {sensor: {"temperature": to_table(fit.polynomial, stem)}}
        temporary.write_text(text + "\n" + tomli_w.dumps(content), encoding="utf-8")
    return fit.left * scale


_UNITS = {"gyro": ("rad/s", "rad_per_s"), "accelerometer": ("m/s²", "m_per_s2"), "magnetometer": ("T", "t")}
"""Unit of the samples of each sensor, in messages and in keys."""
_LARGEST_RATE = 1e12
"""Maximum rate, rad/s, and sample rate, Hz: far beyond any gyro, and far below overflow of squares in the fit."""
