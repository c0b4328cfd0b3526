"""The filter on a recording, or on a simulated record."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer import Argument, Option

import strapdown as sd
from strapdown.checks import InputError, array, non_negative, one_of
from strapdown.cli import terminal as ui
from strapdown.cli.reading import RECORDING_HELP, Layout
from strapdown.files import reading, writable, write_json

if TYPE_CHECKING:
    from strapdown.records import Estimate
    from strapdown.workflows import Run

FILES = ("estimate.h5", "errors.json", "states.json", "observability.json", "field.json", "calibration.toml")
"""Files that the command may write to its folder, in addition to figures."""
FIGURES = ("estimate", "errors", "states")
"""Figures that it may write there, without the suffix of their format."""
ABOUT_IT = ("estimate.html", "estimate.report.json")
"""Files that other commands write there about an estimate."""


@dataclass(frozen=True)
class _Shared:
    """Filter."""

    gyro: Path | None = ui.GYRO
    gate: float | None = Option(None, help="Reject measurements beyond this quantile of chi-squared, and recover.")
    robust: str | None = Option(None, help="Weight measurements by their innovations: huber or student.")
    full_covariance: bool | None = Option(
        None, "--full-covariance/--variances", help="Full covariances. Default: if there is a truth or a reference."
    )
    observability: bool = Option(False, "--observability", help="Report the observability of each state.")
    smooth: bool = Option(False, "--smooth", help="Also use the samples after each time (fixed-interval smoother).")

    @property
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.estimate`."""
        noise = self.gyro and sd.gyro.read_spec(self.gyro)
        plain = {name: getattr(self, name) for name in ("gate", "robust", "smooth", "full_covariance")}
        return plain | {"noise": noise}


@dataclass(frozen=True, eq=False)
class _Specified:
    """With a specification, as in recordings of `strapdown simulate`."""

    filter_file: Path | None = ui.FILTER
    states: bool | None = ui.STATES
    state: list[str] | None = Option(None, help="Only this state, such as gyro.scale or SENSOR.bias; repeatable.")
    attitude: str | None = Option(None, help="Initial attitude, w,x,y,z. Default: from the first measurements.")
    from_truth: bool = Option(False, "--from-truth", help="Start from the truth with errors drawn from the filter's σ.")
    every: int = Option(1, help="Store every n-th filter step.")

    @property
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.estimate`."""
        from strapdown.estimation.setup import read_setup

        setup = self.filter_file and read_setup(self.filter_file)
        states: Any = self.state or self.states
        return {"setup": setup, "states": states, "initial": self.initial, "every": self.every}

    @property
    def initial(self) -> Any:
        """Initial state, as :func:`strapdown.estimate` takes it."""
        if self.attitude is not None and self.from_truth:
            raise InputError("--attitude and --from-truth both define the initial attitude; give one of them")
        if self.attitude is None:
            return "truth" if self.from_truth else None
        try:
            return array("--attitude", [float(part) for part in self.attitude.split(",")], (4,))
        except ValueError:  # of which InputError is one
            raise InputError(f"--attitude is {self.attitude!r}; give four numbers w,x,y,z") from None


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
        None,
        help="LATITUDE,LONGITUDE[,HEIGHT], degrees and m: use true North, and report samples unlike the field there.",
    )
    date: str | None = Option(None, help="Day of the recording, such as 2026-11-28, for --place.")

    @property
    def field(self) -> sd.ahrs.MagneticField | None:
        """The Earth's field at the place."""
        if self.place is None and self.date is None:
            return None
        if self.place is None or self.date is None:
            raise InputError("--place and --date go together: the field drifts; give both")
        try:
            latitude, longitude, *height = (float(part) for part in self.place.split(","))
        except ValueError:
            latitude, longitude, *height = (0.0,) * 4
        if len(height) > 1:
            raise InputError(f"--place is {self.place!r}; give LATITUDE,LONGITUDE or LATITUDE,LONGITUDE,HEIGHT")
        return sd.ahrs.MagneticField.at(latitude, longitude, *height, date=self.date)

    @property
    def options(self) -> dict[str, Any]:
        """Options of :func:`strapdown.estimate`."""
        one_of("--motion", self.motion or "hand", sd.ahrs.MOTIONS)
        late = self.latency
        return {
            "motion": self.motion,
            "latency": None if late is None else 1e-3 * non_negative("--latency", late, unit="ms"),
            "calibration": self.calibration and sd.calibration.read(self.calibration),
            "temperature": self.temperature and sd.gyro.temperature.read(self.temperature),
        }


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
    form: ui.Format | None = Option(None, "--format", help=ui.FORMAT.help)


@ui.command
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
    names = (*FILES, *(f"{name}.{form or 'png'}" for name in FIGURES))
    inputs = (recording, shared.gyro, specified.filter_file, recorded.calibration, recorded.temperature)
    kind = lambda path: reading.kind(path) == "strapdown estimate"  # noqa: E731
    ui.check_files(*(out / name for name in names), sources=inputs, own=kind, command="estimate")
    exports = _exports(output, recording, changed=bool(layout.axes or layout.invert))
    simulated = sd.recordings.is_record(recording)
    for name in ui.options_given(recorded if simulated else specified):
        raise InputError(f"{name} goes with a record{'ing' if simulated else ' of `strapdown simulate`'}; leave it out")
    options = shared.options | (specified.options if simulated else recorded.options)
    field = recorded.field
    with ui.progress_bar("reading"):
        source: Any = sd.read(recording, **layout.options(recording))
    if not simulated:
        if field is not None and source.magnetic_field is None:
            raise InputError(f"--place is for the field, and {recording} has no magnetometer; leave it out")
        ui.warn_about_conventions(source, recording)
    with ui.progress_bar("smoothing" if shared.smooth else "filtering"):
        run = run_filter(source, walks=shared.observability, **options)
    if field is not None:
        run = run._replace(estimate=field.to_true_north(run.estimate))
    if simulated:
        vectors = ", ".join(f"{len(series.time)} of {series.sensor}" for series in source.vectors) or "no measurements"
        length = source.time[-1] - source.time[0]
        ui.say(f"{recording.name}: {len(source.increments)} gyro samples over {length:.6g} s, {vectors}.")
    ui.say(*run.estimate.remarks)
    ui.show(run.estimate.listing())
    figures = (f"{name}.{suffix}" for name in FIGURES for suffix in ("png", "pdf", "svg"))
    for name in (*FILES[1:], *figures, *ABOUT_IT):  # of an earlier estimate; this one may not write all of them
        (out / name).unlink(missing_ok=True)
    contents = _shown(run, observability=shared.observability)
    if field is not None:
        compared = field.compared(source, run.estimate)
        ui.say(str(compared))
        contents["field.json"] = compared.summary()
    paths = [sd.write(run.estimate, out / FILES[0])]
    for file, content in contents.items():
        write_json(out / file, {"source": recording.name, **content})
        paths.append(out / file)
    if run.calibration is not None:
        paths.append(out / "calibration.toml")
        sd.calibration.write(run.calibration, paths[-1])
    for target, how in exports.items():
        paths.append(sd.write(run.estimate, target, recording=None if simulated else source, **how))
    if form is not None:
        paths += _drawn(out, form, run.estimate, recording.name)
    ui.written(*paths)
    if run.estimate.innovations:
        ui.say(f"Test the filter with `strapdown check {paths[0]}`.")


def _shown(run: Run, *, observability: bool) -> dict[str, Any]:
    """Print observability and errors of an estimate; return these and its error states as contents of JSON files."""
    from strapdown.estimation import setup

    contents: dict[str, Any] = {}
    if run.estimate.error_states:
        contents["states.json"] = {name: states.summary() for name, states in run.estimate.error_states.items()}
    if observability:
        with ui.progress_bar("observability"):
            analysis = setup.observability(run.record, run.setup, run.initial)
        ui.say(str(analysis))
        contents["observability.json"] = analysis.summary()
    if run.estimate.truth is not None:
        accuracy = sd.accuracy(run.estimate)
        ui.show(accuracy.listing())
        contents["errors.json"] = accuracy.summary()
    return contents


def _exports(output: _Output, recording: Path, *, changed: bool) -> dict[Path, dict[str, Any]]:
    """Return the additional files of an estimate with the options of their writers; raise an error for those that cannot be written."""
    from strapdown.records import outputs

    frame = None if output.frame is None else one_of("--frame", output.frame.upper(), outputs.FRAMES)
    if output.euler is not None:
        outputs.euler([[1.0, 0.0, 0.0, 0.0]], output.euler)
    wanted = {name: value for name, value in (("sequence", output.euler), ("frame", frame)) if value is not None}
    if wanted and not output.to:
        raise InputError("--euler and --frame go with --to FILE; give the file")
    exports = {}
    for target in output.to or ():
        writable("to", target, sources=(recording,))
        file_format = sd.recordings.estimate_format(target, wanted, recording=not sd.recordings.is_record(recording))
        exports[target] = dict[str, Any](wanted)
        # If the axes were changed, the samples in a copy of the file would not be in those of the orientation.
        if (
            "source" in file_format.estimate_options
            and sd.recordings.format_of(recording) is file_format
            and not changed
        ):
            exports[target]["source"] = recording
    return exports


def _drawn(out: Path, form: ui.Format, result: Estimate, title: str) -> list[Path]:
    """Draw the estimate, its optional states, and its errors relative to a truth or a reference; return the files."""
    truth = result.truth
    figures = {out / "estimate": sd.plots.estimate_overview(result, title=title, fixed_frame=result.fixed_frame)}
    if result.error_states:
        figures[out / "states"] = sd.plots.states_over_time(result, title=title)
    if truth is not None and truth.has_bias:
        figures[out / "errors"] = sd.plots.error_overview(result, truth, title=title)
    elif truth is not None:
        figures[out / "errors"] = sd.plots.recording_errors(result, truth.attitude, truth.movement)
    return sd.plots.save_as(figures, form)
