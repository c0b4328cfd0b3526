"""The filter on a recording, or on a simulated record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from strapdown.checks import InputError, count, non_negative, one_of
from strapdown.cli.filters import ChosenStates, filter_for
from strapdown.cli.progress import progress_bar
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.cli.terminal import (
    FORMAT,
    FigureFormat,
    command,
    console,
    need_own,
    options_given,
    say,
    show,
    warn_about_conventions,
    written,
)
from strapdown.files import usable_folder, writable, write_json
from strapdown.results import Table
from strapdown.units import DEGREE, DEGREE_PER_HOUR, DEGREE_PER_HOUR_PER_ROOT_HOUR, DEGREE_PER_ROOT_HOUR

if TYPE_CHECKING:
    from strapdown.estimation.setup import FilterSetup
    from strapdown.estimation.setup.for_record import Start
    from strapdown.estimation.states import State
    from strapdown.recordings import Recording
    from strapdown.records import Estimate, ImuRecord

    Exports = Sequence[tuple[Path, dict[str, Any]]]
    """Additional files of an estimate, with the options of their writers."""

FILES = ("estimate.h5", "errors.json", "states.json", "observability.json", "calibration.toml")
"""Files that the command may write to its folder, in addition to figures."""
FIGURES = ("estimate", "errors", "states")
"""Figures that it may write there, without the suffix of their format."""
ABOUT_IT = ("estimate.html", "estimate.report.json")
"""Files that other commands write there about an estimate."""


@dataclass(frozen=True)
class _Shared:
    """Filter."""

    gyro: Path | None = typer.Option(
        None, help="TOML with a table named gyro, as written by `strapdown allan`: the gyro noise of the filter."
    )
    gate: float | None = typer.Option(
        None, help="Reject measurements beyond this quantile of chi-squared, such as 0.999, and recover."
    )
    robust: str | None = typer.Option(
        None, help="Weight measurements by the size of their innovations: huber or student."
    )
    full_covariance: bool | None = typer.Option(
        None,
        "--full-covariance/--variances",
        help="Write full 6 x 6 covariances, or only their diagonals. Default: full if there is a specification or a reference attitude.",
    )
    observability: bool = typer.Option(
        False, "--observability", help="Report the observability of each state, including optional ones."
    )
    smooth: bool = typer.Option(
        False, "--smooth", help="Also use the samples after each time, by the fixed-interval smoother."
    )

    @property
    def robustness(self) -> dict[str, Any]:
        """The gate and the weights, if given."""
        from strapdown.estimation.gating import Gate, Robust

        gate = None if self.gate is None else Gate(probability=self.gate)
        robust = None if self.robust is None else Robust(kind=self.robust)  # type: ignore[arg-type]
        return {name: value for name, value in (("gate", gate), ("robust", robust)) if value is not None}


@dataclass(frozen=True, eq=False)
class _Specified:
    """With a specification, as in recordings of `strapdown simulate`."""

    filter_file: Path | None = typer.Option(
        None,
        "--filter",
        help="TOML with a table named filter, as written by `strapdown tune`. Default: one that matches the specification.",
    )
    states: bool | None = typer.Option(
        None,
        "--states/--no-states",
        help="With or without a state for each specified error (scale, misalignment, drift, hard iron, …). Default: with, if there "
        "are such errors.",
    )
    state: list[str] | None = typer.Option(
        None, help="Only this one of those states, such as gyro.scale or SENSOR.bias; may be repeated."
    )
    attitude: str | None = typer.Option(
        None, help="Initial attitude body to fixed, w,x,y,z. Default: from the first measurements."
    )
    from_truth: bool = typer.Option(
        False, "--from-truth", help="Initial state: the truth with errors drawn from the filter's σ."
    )
    every: int = typer.Option(1, help="Store every n-th filter step.")

    @property
    def chosen_states(self) -> ChosenStates:
        """Optional states requested."""
        return tuple(self.state or ()) if self.states or self.state else False if self.states is False else None


@dataclass(frozen=True)
class _Recorded:
    """Without a specification."""

    motion: str | None = typer.Option(
        None,
        help="Motion model: hand, with bounded velocity; vehicle, with acceleration that lasts for seconds; auto (default), that of "
        "higher likelihood; or any, with white-noise acceleration and without states for the gyro's scale factors.",
    )
    latency: float | None = typer.Option(
        None,
        help="Delay of the gyro's samples by its low-pass filter, ms; 0: point samples. Default: half a sample interval.",
    )
    calibration: Path | None = typer.Option(
        None,
        help="calibration.toml of the unit, from `strapdown calibrate` or an earlier estimate; a new one is written.",
    )
    temperature: Path | None = typer.Option(
        None,
        help="gyro-temperature.toml of `strapdown allan --temperature`: the gyro's bias over temperature, which is subtracted first; the "
        "error of its slope is estimated (with --smooth and --observability it is modelled as a random walk).",
    )


@dataclass(frozen=True, eq=False)
class _Output:
    """Output."""

    out: Path = typer.Option(Path("estimate-results"), help="Folder for estimate.h5, errors.json and the figures.")
    to: list[Path] | None = typer.Option(
        None,
        help="Also write the estimate to this file, in the format of its suffix: .csv, .tsv, .parquet, .tum, .h5, .rrd (Rerun), and for "
        "a recording .bag, .mcap or .db3 with orientation and covariance filled in; may be repeated.",
    )
    euler: str | None = typer.Option(None, help="With --to a table: sequence of the Euler angles. Default: ZYX.")
    frame: str | None = typer.Option(
        None, help="With --to: fixed frame of the output, enu (default) or ned; the body axes are not changed."
    )
    figures: bool = typer.Option(
        False, "--figures", help="Draw the estimate, its states and errors; --format does too."
    )
    form: FigureFormat | None = typer.Option(None, "--format", help=FORMAT.help)

    @property
    def drawn_as(self) -> FigureFormat | None:
        """Format of the figures; None: no figures."""
        return None if self.form is None and not self.figures else self.form or FigureFormat.png


@command
def estimate(
    recording: Annotated[
        Path,
        typer.Argument(
            help=f"{RECORDING_HELP}; or the HDF5 file of `strapdown simulate`, which contains its specification and its truth."
        ),
    ],
    shared: _Shared,
    specified: _Specified,
    recorded: _Recorded,
    layout: Layout,
    output: _Output,
) -> None:
    """Estimate attitude and gyro bias from a recording.

    The accelerometer gives the vertical and the magnetometer the heading. If the recording contains its specification, like those of
    `strapdown simulate`, the filter matches it.
    """
    from strapdown.files import reading
    from strapdown.recordings import is_record

    out = output.out
    usable_folder("out", out)
    names = (*FILES, *(f"{name}.{output.drawn_as or FigureFormat.png}" for name in FIGURES))
    sources = (recording, shared.gyro, specified.filter_file, recorded.calibration, recorded.temperature)
    writable("out", *(out / name for name in names), sources=sources)
    need_own(out / FILES[0], "estimate", lambda path: reading.kind(path) == "strapdown estimate")
    reading_options = layout.options(recording)
    simulated = is_record(recording)
    if simulated and (options := options_given(recorded)):
        raise InputError(
            f"{options[0]} goes with a recording without a specification; {recording} contains one, of `strapdown simulate`"
        )
    if not simulated and (options := options_given(specified)):
        raise InputError(
            f"{options[0]} goes with a recording that contains its specification, as those of `strapdown simulate`; {recording} does not"
        )
    exports = _exports(output, recording, changed=bool(layout.axes or layout.invert))
    if simulated:
        _estimate_specified(recording, shared, specified, output, exports)
    else:
        _estimate_recording(recording, reading_options, shared, recorded, output, exports)


def _exports(output: _Output, recording: Path, *, changed: bool) -> Exports:
    """Return the additional files of an estimate; raise an error for those that cannot be written."""
    from strapdown import recordings, workflows
    from strapdown.records import outputs

    frame = None if output.frame is None else one_of("--frame", output.frame.upper(), outputs.FRAMES)
    if output.euler is not None:
        outputs.euler([[1.0, 0.0, 0.0, 0.0]], output.euler)
    wanted = {name: value for name, value in (("sequence", output.euler), ("frame", frame)) if value is not None}
    if wanted and not output.to:
        raise InputError("--euler and --frame go with --to FILE; give the file")
    found = []
    for target in output.to or ():
        suffixes = tuple(dict.fromkeys((*workflows.HDF5, *recordings.writers("write_estimate"))))
        writable("to", target, suffixes=suffixes, sources=(recording,))
        options: dict[str, Any] = dict(wanted)
        if target.suffix.lower() in workflows.HDF5 and not wanted:
            found.append((target, options))
            continue
        chosen = recordings.estimate_format(target, wanted, recording=not recordings.is_record(recording))
        # If the axes were changed, the samples in a copy of the file would not be in those of the orientation.
        if "source" in chosen.estimate_options and recordings.format_of(recording) is chosen and not changed:
            options["source"] = recording
        found.append((target, options))
    return found


def _export(exports: Exports, estimate: Estimate, recording: Recording | None) -> list[Path]:
    """Write an estimate to its additional files and return them."""
    from strapdown import workflows

    for target, options in exports:
        samples = {} if target.suffix.lower() in workflows.HDF5 else {"recording": recording}
        workflows.write(estimate, target, **options, **samples)
    return [target for target, _ in exports]


def _estimate_specified(path: Path, shared: _Shared, options: _Specified, output: _Output, exports: Exports) -> None:
    """Run the filter over a recording with a specification; print and write its estimate."""
    from strapdown import workflows
    from strapdown.recordings.recordfiles import read_record

    every = count("every", options.every)
    if shared.smooth and every > 1:
        raise InputError("--every stores some filter steps, but the smoother needs all; leave one of them out")
    if shared.gyro is not None and options.filter_file is not None:
        raise InputError("--gyro and --filter both define the gyro noise of the filter; give one of them")
    record = read_record(path)
    chosen, remarks = filter_for(path, record, shared.gyro, options.filter_file, options.chosen_states)
    chosen = replace(chosen, **shared.robustness)
    start = _start(record, chosen, options.attitude, options.from_truth)
    with progress_bar("smoothing" if shared.smooth else "filtering"):
        run = workflows.estimate_record(
            record,
            chosen,
            start,
            every=every,
            full_covariance=shared.full_covariance is not False,
            smooth=shared.smooth,
        )
    length, result = record.time[-1] - record.time[0], run.estimate
    console.print(
        f"{path.name}: {len(record.increments)} gyro samples over {length:.6g} s, "
        f"{', '.join(f'{len(s.time)} of {s.sensor}' for s in record.vectors) or 'no measurements'}. {' '.join(result.remarks)}"
    )
    say(*remarks)
    _print_result(result)
    paths = _write(output.out, result, record)
    if shared.observability:
        paths.append(_observability(output.out, str(path), run.record, chosen, run.initial))
    if result.truth is not None:
        paths.append(output.out / "errors.json")
        found = _errors(result, result.truth)
        write_json(paths[-1], {"source": str(path), **found})
        console.print(_errors_words(found))
    paths += _export(exports, result, None)
    _say_nis(result, paths[0])
    if output.drawn_as is not None:
        paths += _drawn(output.out, output.drawn_as, result, path.name)
    written(*paths)


def _write(out: Path, result: Estimate, record: ImuRecord) -> list[Path]:
    """Write the estimate and its error states, which are printed too; return the files."""
    from strapdown import workflows

    _clear(out)
    paths = [workflows.write(result, out / "estimate.h5")]
    if result.error_states:
        paths.append(out / "states.json")
        states = _states(result) if result.motion else _print_states(result, record)
        write_json(paths[-1], {"source": "" if result.origin is None else result.origin.source, **states})
    return paths


def _say_nis(result: Estimate, path: Path) -> None:
    seen = {s: i for s, i in result.innovations.items() if np.sum(i.used)}
    if seen:
        each = ", ".join(f"{np.mean(i.nis[i.used]) / i.innovation.shape[1]:.3g} {s}" for s, i in seen.items())
        console.print(f"Mean NIS per degree of freedom (expected: 1): {each}. Test them with `strapdown check {path}`.")


def _observability(out: Path, source: str, record: ImuRecord, chosen: FilterSetup, initial: State) -> Path:
    """Print and write the observability of each state; return the file."""
    from strapdown.estimation import setup

    with progress_bar("observability"):
        shown = setup.observability(record, chosen, initial)
    console.print(str(shown))
    write_json(out / "observability.json", {"source": source, **shown.summary()})
    return out / "observability.json"


def _errors_words(found: dict[str, float]) -> str:
    line = (
        f"Second half: attitude error RMS {found['attitude_rms_deg']:.4g}° (σ {found['attitude_sigma_deg']:.4g}°), bias error RMS "
        f"{found['bias_rms_deg_per_h']:.4g} °/h (σ {found['bias_sigma_deg_per_h']:.4g} °/h), each of three axes together"
    )
    if "nees_per_state" in found:
        line += f"; mean NEES per state {found['nees_per_state']:.3g} (expected: about 1)"
    return line + "."


def _drawn(
    out: Path,
    form: FigureFormat,
    result: Estimate,
    title: str,
) -> list[Path]:
    """Draw the estimate, its optional states, and its errors relative to a truth or a reference; return the files."""
    from strapdown import plots
    from strapdown.plots.style import save_as

    truth = result.truth
    figures = {out / "estimate": plots.estimate_overview(result, title=title, fixed_frame=result.fixed_frame)}
    if result.error_states:
        figures[out / "states"] = plots.states_over_time(result, title=title)
    if truth is not None and truth.has_bias:
        figures[out / "errors"] = plots.error_overview(result, truth, title=title)
    elif truth is not None:
        figures[out / "errors"] = plots.recording_errors(result, truth.attitude, truth.movement)
    return save_as(figures, form)


def _states(result: Any) -> dict[str, Any]:
    """Return the final values and σ of the optional states."""
    return {
        name: {
            "components": list(block.components),
            "units": list(block.units),
            "values": block.values[-1].tolist(),
            "sigma": block.sigma[-1].tolist(),
            "first_sigma": block.sigma[0].tolist(),
        }
        for name, block in result.error_states.items()
    }


def _print_states(result: Any, record: ImuRecord) -> dict[str, Any]:
    """Print the final values and σ of the optional states, and return them for JSON."""
    from strapdown.plots.style import error_state_unit

    of_directions = tuple(f"{one.sensor} " for one in record.vectors if one.kind in ("direction", "heading"))
    rows = []
    for name, block in result.error_states.items():
        for k, (component, unit) in enumerate(zip(block.components, block.units, strict=True)):
            word, size = error_state_unit(name, unit)
            if unit == "1" and name.startswith(of_directions):
                word, size = "% of the vector", 0.01
            values = (block.values[-1, k], block.sigma[-1, k], block.sigma[0, k])
            rows.append((name, component, word, *(value / size for value in values)))
    show(Table("Optional states at the end", ("state", "", "unit", "value", "σ", "initial σ"), rows, left=3))
    return _states(result)


def _start(record: ImuRecord, chosen: FilterSetup, attitude: str | None, from_truth: bool) -> Start | None:
    """Return the start given by the options; None: from the first measurements."""
    from strapdown.estimation import setup
    from strapdown.estimation.setup.for_record import Start, drawn_start

    if attitude is not None and from_truth:
        raise InputError("--attitude and --from-truth both define the initial attitude; give one of them")
    if from_truth:
        return drawn_start(record, chosen)
    if attitude is None:
        return None
    try:
        q = np.array([float(part) for part in attitude.split(",")])
    except ValueError:
        raise InputError(f"--attitude is {attitude!r}; give four numbers w,x,y,z") from None
    if q.shape != (4,) or np.linalg.norm(q) == 0.0:
        raise InputError(f"--attitude is {attitude!r}; give four numbers w,x,y,z, not all zero")
    return Start(setup.initial_state(chosen, q / np.linalg.norm(q)), "Started from the attitude given.")


def _clear(out: Path) -> None:
    """Remove the files of an earlier estimate from the folder, some of which the next one may not write."""
    figures = (f"{name}.{form}" for name in FIGURES for form in FigureFormat)
    for name in (*FILES[1:], *figures, *ABOUT_IT):
        (out / name).unlink(missing_ok=True)


def _print_result(result: Estimate) -> None:
    """Print the numbers of unused samples and the events."""
    for sensor, number in result.skipped.items():
        if number:
            console.print(f"{number} samples of the {sensor} are missing or outside the record and were skipped.")
    for sensor, number in result.refused.items():
        if number:
            share = number / len(result.innovations[sensor].time)
            console.print(f"{number} samples of the {sensor} ({share:.2%}) were rejected by the gate.")
    say(*map(str, result.events))


def _errors(result: Estimate, truth: Any) -> dict[str, float]:
    """Return errors and consistency over the second half, degrees and degrees per hour."""
    from strapdown import consistency

    half = slice(len(result.time) // 2, None)
    error = consistency.errors(result.attitude[half], result.bias[half], truth.attitude[half], truth.bias[half])
    total = np.sqrt(np.mean(np.sum(error.reshape(-1, 2, 3) ** 2, axis=2), axis=0))
    sigma = np.sqrt(np.mean(np.sum(result.variance[half].reshape(-1, 2, 3), axis=2), axis=0))
    found = {
        "attitude_rms_deg": float(total[0]) / DEGREE,
        "attitude_sigma_deg": float(sigma[0]) / DEGREE,
        "bias_rms_deg_per_h": float(total[1]) / DEGREE_PER_HOUR,
        "bias_sigma_deg_per_h": float(sigma[1]) / DEGREE_PER_HOUR,
    }
    if result.covariance is not None:
        found["nees_per_state"] = float(np.mean(consistency.nees(error, result.covariance[half]))) / 6.0
    return found


def _estimate_recording(
    recording: Path, layout: dict[str, Any], shared: _Shared, options: _Recorded, output: _Output, exports: Exports
) -> None:
    """Run the filter over a recording: accelerometer as the vertical, magnetometer as the heading."""
    from strapdown import ahrs, calibration, recordings, workflows
    from strapdown.gyro import read_spec
    from strapdown.gyro import temperature as thermal

    motion = one_of("--motion", options.motion or "hand", ahrs.MOTIONS)
    late = None if options.latency is None else 1e-3 * non_negative("--latency", options.latency, unit="ms")
    carried = None if options.calibration is None else calibration.read(options.calibration)
    warm = None if options.temperature is None else thermal.read(options.temperature)
    spec = None if shared.gyro is None else read_spec(shared.gyro)
    with progress_bar("reading"):
        source = recordings.read(recording, **layout)
    known = None if source.true_attitude is None else np.isfinite(source.true_attitude).all(axis=1)
    if known is not None and source.movement is not None and not (known & source.movement).any():
        raise InputError(
            f"{recording}: no sample to judge has a reference attitude; check its movement mask and its reference"
        )
    warn_about_conventions(source, recording)
    with progress_bar("smoothing" if shared.smooth else "filtering"):
        run = workflows.estimate_recording(
            source,
            noise=spec,
            temperature=warm,
            motion=motion,
            walks=shared.observability,
            latency=late,
            calibration=carried,
            full_covariance=shared.full_covariance,
            smooth=shared.smooth,
            **shared.robustness,
        )
    result, parameters, out = run.estimate, run.parameters, output.out
    paths = _write(out, result, run.record)
    if run.calibration is not None:
        paths.append(out / "calibration.toml")
        calibration.write(run.calibration, paths[-1])
    say(*result.remarks)
    _print_result(replace(result, skipped={}))
    if shared.gyro is not None:
        arw, rrw = parameters.angle_random_walk, parameters.rate_random_walk
        console.print(
            f"Gyro noise from {shared.gyro}, flicker included: {arw / DEGREE_PER_ROOT_HOUR:.3g} °/√h, bias random walk "
            f"{rrw / DEGREE_PER_HOUR_PER_ROOT_HOUR:.3g} °/h/√h."
        )
    if shared.observability:
        paths.append(_observability(out, source.source, run.record, parameters.setup, run.initial))
    if result.truth is not None:
        table = workflows.accuracy(result)
        show(table.listing())
        paths.append(out / "errors.json")
        write_json(paths[-1], {"source": source.source, **table.summary()})
    paths += _export(exports, result, source)
    if output.drawn_as is not None:
        paths += _drawn(out, output.drawn_as, result, source.source)
    written(*paths)
