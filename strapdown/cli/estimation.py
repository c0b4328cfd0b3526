"""The filter on a recording, or on a simulated record."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, non_negative
from strapdown.cli import terminal as ui
from strapdown.cli.options import FILTER, FORMAT, GYRO, RECORDING_HELP, STATES, Format, Layout, numbers, options_given
from strapdown.files import write_json

FIGURES = tuple(f"{name}.{form}" for name in ("estimate", "errors", "states") for form in ("png", "pdf", "svg"))
NUMBERS = tuple(f"{name}.json" for name in ("errors", "states", "observability", "field"))
FILES = ("estimate.h5", "calibration.toml", *NUMBERS, *FIGURES, "estimate.html", "estimate.report.json")
"""Files that this command, and `report`, may write to its folder."""


@dataclass(frozen=True)
class _Shared:
    """Filter."""

    gyro: Path | None = GYRO
    gate: float | None = Option(None, help="Reject measurements beyond this quantile of chi-squared, and recover.")
    robust: str | None = Option(None, help="Weight measurements by their innovations: huber or student.")
    full_covariance: bool | None = Option(
        None, "--full-covariance/--variances", help="Full covariances. Default: if there is a truth or a reference."
    )
    observability: bool = Option(False, "--observability", help="Report the observability of each state.")
    smooth: bool = Option(False, "--smooth", help="Also use the samples after each time (fixed-interval smoother).")


@dataclass(frozen=True, eq=False)
class _Specified:
    """With a specification, as in recordings of `strapdown simulate`."""

    filter_file: Path | None = FILTER
    states: bool | None = STATES
    state: list[str] | None = Option(None, help="Only this state, such as gyro.scale or SENSOR.bias; repeatable.")
    attitude: str | None = Option(None, help="Initial attitude, w,x,y,z. Default: from the first measurements.")
    from_truth: bool = Option(False, "--from-truth", help="Start from the truth with errors drawn from the filter's σ.")
    every: int = Option(1, help="Store every n-th filter step.")


@dataclass(frozen=True)
class _Recorded:
    """Without a specification."""

    motion: str | None = Option(
        None,
        help="Motion model: hand (default), with bounded velocity; vehicle, with lasting acceleration; vessel, with bounded position; "
        "or any, with white-noise acceleration.",
    )
    latency: float | None = Option(None, help="Delay of the gyro's samples, ms. Default: half a sample interval.")
    calibration: Path | None = Option(None, help="calibration.toml of the unit; a new one is written.")
    temperature: Path | None = Option(None, help="TOML of `strapdown allan --temperature`: bias to subtract.")
    place: str | None = Option(
        None, help="LATITUDE,LONGITUDE[,HEIGHT], ° and m: use true North, and report samples unlike the field there."
    )
    date: str | None = Option(None, help="Day of the recording, such as 2026-11-28, for --place.")

    @property
    def field(self) -> sd.ahrs.MagneticField | None:
        """The Earth's field at the place."""
        if self.place is None and self.date is None:
            return None
        if self.place is None or self.date is None:
            raise InputError("--place and --date go together: the field drifts; give both")
        place = numbers("--place", self.place, "LATITUDE,LONGITUDE or LATITUDE,LONGITUDE,HEIGHT", 2, 3)
        return sd.ahrs.MagneticField.at(*place, date=self.date)


@dataclass(frozen=True, eq=False)
class _Output:
    """Output."""

    out: Path = Option(Path("estimate-results"), help="Folder for estimate.h5, errors.json and the figures.")
    to: list[Path] | None = Option(
        None, help="Also write this file: .csv, .tsv, .parquet, .tum; of a recording .bag, .mcap, .db3; repeatable."
    )
    euler: str | None = Option(None, help="With --to a table: sequence of the Euler angles. Default: ZYX.")
    frame: str | None = Option(None, help="With --to: fixed frame, enu (default) or ned; body axes are not changed.")
    figures: bool = Option(False, "--figures", help="Draw the estimate, its states and errors; --format does too.")
    form: Format | None = Option(None, "--format", help=FORMAT.help)

    def exports(self, recording: Path, *, changed: bool, simulated: bool) -> dict[Path, dict[str, Any]]:
        """Return the additional files with the options of their writers; raise an error for those that cannot be written."""
        wanted = {"sequence": self.euler, "frame": self.frame and self.frame.upper()}
        wanted = {name: value for name, value in wanted.items() if value is not None}
        if wanted and not self.to:
            raise InputError("--euler and --frame go with --to FILE; give the file")
        exports: dict[Path, dict[str, Any]] = {}
        for target in self.to or ():
            ui.check_files(target, name="to")
            form = sd.recordings.estimate_format(target, wanted, recording=not simulated)
            # If the axes were changed, the samples in a copy of the file would not be in those of the orientation.
            copied = "source" in form.estimate_options and sd.recordings.format_of(recording) is form and not changed
            exports[target] = wanted | ({"source": recording} if copied else {})
        return exports


def _options(shared: _Shared, specified: _Specified, recorded: _Recorded) -> dict[str, Any]:
    """Return the options of :func:`strapdown.estimate`."""
    initial: Any = "truth" if specified.from_truth else None
    if specified.attitude is not None:
        if specified.from_truth:
            raise InputError("--attitude and --from-truth both define the initial attitude; give one of them")
        initial = numbers("--attitude", specified.attitude, "four numbers w,x,y,z", 4)
    late = recorded.latency
    return {
        "noise": shared.gyro and sd.gyro.read_spec(shared.gyro),
        **{name: getattr(shared, name) for name in ("gate", "robust", "smooth", "full_covariance")},
        "setup": specified.filter_file and sd.estimation.setup.read_setup(specified.filter_file),
        "states": specified.state or specified.states,
        "initial": initial,
        "every": specified.every,
        "motion": recorded.motion,
        "latency": None if late is None else 1e-3 * non_negative("--latency", late, unit="ms"),
        "calibration": recorded.calibration and sd.calibration.read(recorded.calibration),
        "temperature": recorded.temperature and sd.gyro.temperature.read(recorded.temperature),
    }


@ui.command()
def estimate(
    *,
    recording: Path = Argument(help=f"{RECORDING_HELP}; or a record of `strapdown simulate`."),
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
    from strapdown.workflows.estimating import run as run_filter

    out, form = output.out, output.form or ("png" if output.figures else None)
    ui.check_files(*(out / name for name in FILES), own="strapdown estimate")
    simulated = sd.recordings.is_record(recording)
    exports = output.exports(recording, changed=bool(layout.axes or layout.invert), simulated=simulated)
    for name in options_given(recorded if simulated else specified):
        raise InputError(f"{name} goes with a record{'ing' if simulated else ' of `strapdown simulate`'}; leave it out")
    options, field = _options(shared, specified, recorded), recorded.field
    with ui.progress_bar("reading"):
        source: Any = (sd.read if simulated else sd.recordings.read)(recording, **layout.options)
    if field is not None and source.magnetic_field is None:
        raise InputError(f"--place is for the field, and {recording} has no magnetometer; leave it out")
    if not simulated:
        sd.ahrs.check_conventions.warn(source)
    with ui.progress_bar("smoothing" if shared.smooth else "filtering"):
        run = run_filter(source, walks=shared.observability, **options)
    result = run.estimate if field is None else field.to_true_north(run.estimate)
    ui.say(*result.remarks)
    ui.show(result.listing())
    parts: dict[str, Any] = {}
    if shared.observability:
        with ui.progress_bar("observability"):
            parts["observability.json"] = sd.estimation.setup.observability(run.record, run.setup, run.initial)
    if result.truth is not None:
        parts["errors.json"] = sd.accuracy(result)
    ui.show(*(part.listing() for part in parts.values()))
    if field is not None:
        parts["field.json"] = field.compared(source, result)
        ui.say(str(parts["field.json"]))
    contents = {file: part.summary() for file, part in parts.items()}
    if result.error_states:
        contents["states.json"] = {name: states.summary() for name, states in result.error_states.items()}
    for name in FILES[1:]:  # of an earlier estimate; this one may not write all of them
        (out / name).unlink(missing_ok=True)
    paths = [sd.write(result, out / FILES[0])]
    for file, content in contents.items():
        write_json(out / file, {"source": recording.name, **content})
        paths.append(out / file)
    new = None if run.recorded is None else run.recorded.calibration
    if new is not None:
        paths.append(out / "calibration.toml")
        sd.calibration.write(new, paths[-1])
    paths += [sd.write(result, to, recording=None if simulated else source, **how) for to, how in exports.items()]
    if form is not None:
        paths += sd.plots.draw_estimate(result, out, form, title=recording.name)
    ui.written(*paths)
    if result.innovations:
        ui.say(f"Test the filter with `strapdown check {out / FILES[0]}`.")
