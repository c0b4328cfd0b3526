"""The filter on a recording, or on a simulated record."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strapdown.cli.filters import filter_for
from strapdown.cli.reading import RECORDING_HELP, AccelerometerUnit, Columns, GyroUnit, TimeUnit, Topic, told
from strapdown.cli.terminal import app, console, doubt, need_own, show, table, writable, written

if TYPE_CHECKING:
    from strapdown.estimation.states import State
    from strapdown.recordfiles import RecordFile
    from strapdown.recordings import Recording
    from strapdown.records import Estimate, ImuRecord
    from strapdown.setup import FilterSetup

FILES = (
    "estimate.h5",
    "errors.json",
    "states.json",
    "observability.json",
    "calibration.toml",
    "estimate.png",
    "errors.png",
    "states.png",
)
"""What the command may write to its folder."""
ABOUT_IT = ("estimate.html", "estimate.report.json")
"""What other commands write there about an estimate."""
RECORDING_ONLY = ("motion", "latency", "calibration")
"""Options that go with a recording."""
RECORD_ONLY = ("filter", "states", "state", "attitude", "from_truth", "every")
"""Options that go with a record of `strapdown simulate`."""

UNEVEN = 2.0
"""Largest σ of an attitude over the least, above which both are told."""


@app.command()
def estimate(
    recording: Annotated[
        Path,
        typer.Argument(help=f"{RECORDING_HELP}; or record of `strapdown simulate` (HDF5)."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for estimate.h5, errors.json and the figures.")] = Path(
        "estimate-results"
    ),
    gyro_unit: GyroUnit = None,
    accelerometer_unit: AccelerometerUnit = None,
    time_unit: TimeUnit = None,
    columns: Columns = None,
    topic: Topic = None,
    gyro: Annotated[
        Path | None,
        typer.Option(
            help="TOML with a table named gyro, as `strapdown allan` writes it: the filter believes its noise."
        ),
    ] = None,
    full_covariance: Annotated[
        bool | None,
        typer.Option(
            "--full-covariance/--variances",
            help="Write whole 6 x 6 covariances, or only their diagonals; a record's estimate has whole ones unless told.",
        ),
    ] = None,
    filter_file: Annotated[
        Path | None,
        typer.Option(
            "--filter",
            help="Record: TOML with a table named filter, as `strapdown tune` writes it; without it the filter that matches the record.",
        ),
    ] = None,
    gate: Annotated[
        float | None,
        typer.Option(help="Refuse measurements beyond this quantile (0.999) of chi-squared, and recover."),
    ] = None,
    robust: Annotated[
        str | None, typer.Option(help="Record: weigh measurements by how far they lie off: huber or student.")
    ] = None,
    states: Annotated[
        bool,
        typer.Option(
            "--states",
            help="Record: with a state for each error that gyro and sensors are specified with: scale, misalignment, drift, hard iron, …",
        ),
    ] = False,
    state: Annotated[
        list[str] | None,
        typer.Option(help="Record: only this one of those states, such as gyro.scale or SENSOR.bias; may be repeated."),
    ] = None,
    attitude: Annotated[
        str | None,
        typer.Option(help="Record: initial attitude body to fixed, w,x,y,z; without it from the first measurements."),
    ] = None,
    from_truth: Annotated[
        bool, typer.Option("--from-truth", help="Record: start at the truth, off by errors drawn from the filter's σ.")
    ] = False,
    every: Annotated[int, typer.Option(help="Record: keep each so-manieth step of the filter.")] = 1,
    observability: Annotated[
        bool,
        typer.Option(
            "--observability", help="Report what the measurements show of each state, optional ones included."
        ),
    ] = False,
    smooth: Annotated[
        bool,
        typer.Option("--smooth", help="From all samples, those after each time too, by the fixed-interval smoother."),
    ] = False,
    motion: Annotated[
        str | None,
        typer.Option(
            help="Recording: what moves the unit: hand (if not given), of bounded velocity, with states for the gyro's scale; or any, "
            "whose acceleration is white noise, without."
        ),
    ] = None,
    to: Annotated[
        list[Path] | None,
        typer.Option(
            help="Write the estimate to this file too, in the format of its ending: .csv, .tsv, .parquet, .tum, .h5, .rrd (Rerun), and of "
            "a recording .bag, .mcap or .db3 with orientation and covariance filled in; may be repeated."
        ),
    ] = None,
    euler: Annotated[
        str | None, typer.Option(help="With --to a table: Euler angles of this sequence, ZYX if not given.")
    ] = None,
    frame: Annotated[str | None, typer.Option(help="With --to: fixed frame ENU (if not given) or NED.")] = None,
    latency: Annotated[
        float | None,
        typer.Option(
            help="Recording: delay of the gyro's samples, ms, that of its low-pass; 0: point samples. If not given, half a sample interval."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Recording: calibration.toml of an earlier one of the same unit; that of this one is written too."
        ),
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="Draw the estimate, its states and errors as PNG.")
    ] = False,
) -> None:
    """Estimate attitude and gyro bias from a recording (accelerometer as vertical, magnetometer as heading) or a simulated record."""
    from strapdown import unit_calibration
    from strapdown.checks import InputError
    from strapdown.files import usable_folder
    from strapdown.recordings import is_record
    from strapdown.records import read_attributes

    usable_folder("out", out)
    writable("out", *(out / name for name in FILES), sources=(recording, gyro, filter_file, calibration))
    need_own(out / FILES[0], "estimate", lambda path: bool(read_attributes(path)["kind"] == "strapdown estimate"))
    layout = told(
        recording, columns=columns, topic=topic, gyro=gyro_unit, accelerometer=accelerometer_unit, time=time_unit
    )
    exports = _exports(to or (), recording, euler, frame)
    if is_record(recording):
        for name, text in zip(RECORDING_ONLY, (motion, latency, calibration), strict=True):
            if text is not None:
                raise InputError(f"--{name} goes with a recording; {recording} is a record of `strapdown simulate`")
        _estimate_record(
            recording,
            out,
            gyro,
            filter_file,
            gate,
            robust,
            tuple(state or ()) if states or state else None,
            attitude,
            from_truth,
            every,
            full_covariance is not False,
            observability,
            smooth,
            exports,
            figures,
        )
        return
    options = dict(
        zip(
            RECORD_ONLY,
            (
                filter_file,
                states or None,
                state or None,
                attitude,
                from_truth or None,
                None if every == 1 else every,
            ),
            strict=True,
        )
    )
    for name, value in options.items():
        if value is not None:
            raise InputError(
                f"--{name.replace('_', '-')} goes with a record of `strapdown simulate`; {recording} is none"
            )
    carried = None if calibration is None else unit_calibration.read(calibration)
    options_used = {
        "calibration": carried,
        "gate": gate,
        "robust": robust,
        "full_covariance": bool(full_covariance),
        "smooth": smooth,
    }
    _estimate_recording(recording, out, layout, gyro, motion, latency, observability, figures, exports, options_used)


def _exports(
    to: Sequence[Path], recording: Path, euler: str | None, frame: str | None
) -> list[tuple[Path, dict[str, Any]]]:
    """Return the further files of an estimate with the options of their writers; what cannot be written is refused."""
    from strapdown import outputs, recordings
    from strapdown.checks import InputError, one_of

    if frame is not None:
        one_of("--frame", frame, outputs.FRAMES)
    if euler is not None:
        outputs.euler([[1.0, 0.0, 0.0, 0.0]], euler)
    given = {name: value for name, value in (("sequence", euler), ("frame", frame)) if value is not None}
    if given and not to:
        raise InputError("--euler and --frame go with --to FILE; give the file")
    found = []
    for target in to:
        writable("to", target, suffixes=recordings.writers("write_estimate"), sources=(recording,))
        options: dict[str, Any] = dict(given)
        chosen = recordings.estimate_format(target, given, recording=not recordings.is_record(recording))
        if "source" in chosen.estimate_options and recordings.format_of(recording) is chosen:
            options["source"] = recording
        found.append((target, options))
    return found


def _export(
    exports: Sequence[tuple[Path, dict[str, Any]]], estimate: Estimate, recording: Recording | None
) -> list[Path]:
    """Write an estimate to its further files and return them."""
    from strapdown import recordings

    for target, options in exports:
        recordings.write(estimate, target, recording=recording, **options)
    return [target for target, _ in exports]


def _estimate_record(
    path: Path,
    out: Path,
    gyro: Path | None,
    filter_file: Path | None,
    gate: float | None,
    robust: str | None,
    states: tuple[str, ...] | None,
    attitude: str | None,
    from_truth: bool,
    every: int,
    full_covariance: bool,
    observability: bool,
    smooth: bool,
    exports: Sequence[tuple[Path, dict[str, Any]]],
    figures: bool,
) -> None:
    """Run the filter over a record, report and write its estimate."""
    import numpy as np

    from strapdown import records, setup
    from strapdown.checks import InputError, count
    from strapdown.estimation.gating import Gate, Robust
    from strapdown.files import write_json
    from strapdown.recordfiles import read_record_file
    from strapdown.records import Truth, write_estimate

    count("every", every)
    if smooth and every > 1:
        raise InputError("--every keeps some steps of the filter, and the smoother gives all; leave one of them out")
    if gyro is not None and filter_file is not None:
        raise InputError("--gyro and --filter both tell the filter's belief of the gyro; give one of them")
    held = read_record_file(path)
    chosen, remarks = filter_for(path, held, gyro, filter_file, states)
    if gate is not None:
        chosen = dataclasses.replace(chosen, gate=Gate(probability=gate))
    if robust is not None:
        chosen = dataclasses.replace(chosen, robust=Robust(kind=robust))  # type: ignore[arg-type]
    believed = setup.believed(held.record, chosen)
    if every > len(believed.increments):
        raise InputError(
            f"every is {every}, more than the {len(believed.increments)} filter steps of the record; only the start would be kept"
        )
    initial, words, first = _initial(believed, held, chosen, attitude, from_truth)
    used = held.record
    if first > 0:
        used = records.cut(used, first * chosen.integration.samples, len(used.increments))
        believed = records.cut(believed, first, len(believed.increments))
        if every > len(believed.increments):
            raise InputError(
                f"every is {every}, and {len(believed.increments)} filter steps are left from the start on"
            )
    if smooth:
        result = setup.smooth(used, chosen, initial, full_covariance=full_covariance)
    else:
        result = setup.run(used, chosen, initial, every=every, full_covariance=full_covariance)
    truth = None
    if believed.truth is not None:
        truth = Truth(attitude=believed.truth.attitude[::every], bias=believed.truth.bias[::every])
    length = held.record.time[-1] - held.record.time[0]
    console.print(
        f"{path.name}: {len(held.record.increments)} gyro samples over {length:.6g} s, "
        f"{', '.join(f'{len(s.time)} of {s.sensor}' for s in held.record.vectors) or 'no measurements'}. {words}"
    )
    for remark in remarks:
        console.print(remark)
    _tell(result)
    paths = [out / "estimate.h5"]
    attributes: dict[str, Any] = {"source": str(path), "filter": setup.to_toml(chosen), "start": words}
    attributes["smoothed"] = smooth
    if held.scenario:
        attributes["scenario"] = held.scenario
    attributes |= {name: value for name, value in (("seed", held.seed), ("run", held.run)) if value is not None}
    _clear(out)
    write_estimate(paths[0], result, attributes, truth=truth)
    if result.error_states:
        paths.append(out / "states.json")
        write_json(paths[-1], {"source": str(path), **_tell_states(result, used)})
    if observability:
        shown = setup.observability(used, chosen, initial)
        console.print(str(shown))
        paths.append(out / "observability.json")
        write_json(paths[-1], {"source": str(path), **shown.summary()})
    if truth is not None:
        paths.append(out / "errors.json")
        found = _errors(result, truth)
        write_json(paths[-1], {"source": str(path), **found})
        line = (
            f"Second half: attitude error RMS {found['attitude_rms_deg']:.4g}° (σ {found['attitude_sigma_deg']:.4g}°), bias error RMS "
            f"{found['bias_rms_deg_per_h']:.4g} °/h (σ {found['bias_sigma_deg_per_h']:.4g} °/h)"
        )
        if "nees_per_state" in found:
            line += f"; mean NEES per state {found['nees_per_state']:.3g} (right: about 1)"
        console.print(line + ".")
    paths += _export(exports, result, None)
    seen = {s: i for s, i in result.innovations.items() if np.sum(i.used)}
    if seen:
        each = ", ".join(f"{np.mean(i.nis[i.used]) / i.innovation.shape[1]:.3g} {s}" for s, i in seen.items())
        console.print(f"Mean NIS per degree of freedom (right: 1): {each}. `strapdown check {paths[0]}` judges them.")
    if figures:
        paths += _drawn(out, result, path.name, truth=truth)
    written(*paths)


def _drawn(
    out: Path, result: Estimate, title: str, truth: Any = None, used: Any = None, errors: Any = None
) -> list[Path]:
    """Draw the estimate, its optional states, and its errors beside a truth or a recording's reference; return the files."""
    from strapdown import plots

    figures = {"estimate.png": plots.estimate_overview(result, title=title)}
    if result.error_states:
        figures["states.png"] = plots.states_over_time(result, title=title)
    if truth is not None:
        figures["errors.png"] = plots.error_overview(result, truth, title=title)
    if errors is not None:
        figures["errors.png"] = plots.recording_errors(used.time, errors, used.movement)
    return [plots.save(figure, out / name) for name, figure in figures.items()]


_STATE_UNITS = {
    "gyro scale": {"1": ("ppm", 1e-6), "rad": ("mrad", 1e-3)},
    "gyro drift": {"rad/s": ("°/h", 0.0)},
    "gyro force": {"rad s/m": ("°/h/g", 0.0)},
}


def _states(result: Any) -> dict[str, Any]:
    """Return the optional states at the end."""
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


def _tell_states(result: Any, record: ImuRecord) -> dict[str, Any]:
    """Show the optional states at the end, and return them for JSON."""
    from strapdown.units import DEGREE_PER_HOUR, STANDARD_GRAVITY

    of_directions = tuple(f"{one.sensor} " for one in record.vectors if one.kind in ("direction", "heading"))
    rows = table("Optional states at the end", "state", "", "unit", "value", "σ", "σ at the start", left=3)
    for name, block in result.error_states.items():
        for k, (component, unit) in enumerate(zip(block.components, block.units, strict=True)):
            kind = " ".join(name.split()[:2])
            word, size = _STATE_UNITS.get(kind, {}).get(unit, (unit, 1.0))
            if unit == "1" and name.startswith(of_directions):
                word, size = "% of the vector", 0.01
            if size == 0.0:
                size = DEGREE_PER_HOUR / (STANDARD_GRAVITY if kind == "gyro force" else 1.0)
            values = (block.values[-1, k], block.sigma[-1, k], block.sigma[0, k])
            rows.add_row(name, component, word, *(f"{value / size:.4g}" for value in values))
    show(rows)
    return _states(result)


def _initial(
    record: ImuRecord, held: RecordFile, chosen: FilterSetup, attitude: str | None, from_truth: bool
) -> tuple[State, str, int]:
    """Return the initial state, how it came about, and the filter's edge that it stands at."""
    import numpy as np

    from strapdown import estimation, quaternion, setup
    from strapdown.checks import InputError
    from strapdown.randomness import generator
    from strapdown.wahba import InconsistentError

    if attitude is not None and from_truth:
        raise InputError("--attitude and --from-truth both tell the start; give one of them")
    if attitude is not None:
        try:
            q = np.array([float(part) for part in attitude.split(",")])
        except ValueError:
            raise InputError(f"--attitude is {attitude!r}; give four numbers w,x,y,z") from None
        if q.shape != (4,) or np.linalg.norm(q) == 0.0:
            raise InputError(f"--attitude is {attitude!r}; give four numbers w,x,y,z, not all zero")
        return setup.initial_state(chosen, q / np.linalg.norm(q)), "Started from the attitude given.", 0
    if from_truth:
        if record.truth is None:
            raise InputError("--from-truth needs a record with the truth; this one has none")
        draw = generator(held.seed or 0, held.run or 0, "initial error").standard_normal(6)
        q = quaternion.multiply(record.truth.attitude[0], quaternion.exp(-chosen.attitude_sigma * draw[:3]))
        bias = record.truth.bias[0] - chosen.bias_sigma * draw[3:]
        words = "Started from the truth, off by errors drawn from the filter's σ."
        return setup.initial_state(chosen, q, bias), words, 0
    try:
        state = estimation.first_state(record, chosen.process_noise, bias_sigma=chosen.bias_sigma)
    except InconsistentError as error:
        problem = str(error).removesuffix("; give the initial attitude")
        # A sensor's own errors may be among the states, and then the filter can tell who is right.
        if chosen.states is None:
            raise InputError(
                f"{problem}; if a sensor has a bias, give the filter its state (--states); or give --attitude, or --from-truth"
            ) from None
        return _banked(record, chosen, problem, f"{problem[:1].upper()}{problem[1:]}. So a bank took them one by one")
    except InputError as error:
        problem = str(error).removesuffix("; give the initial attitude")
        return _banked(record, chosen, problem, "One direction at a time does not give the attitude at once")
    return state, f"Started from the first measurements, σ {_sigma_words(state)}.", 0


def _banked(record: ImuRecord, chosen: FilterSetup, problem: str, why: str) -> tuple[State, str, int]:
    """Return the state that a bank of hypotheses finds, where the first measurements do not give the attitude."""
    import numpy as np

    from strapdown import estimation
    from strapdown.checks import InputError
    from strapdown.estimation import multiple_model

    try:
        found = multiple_model.run(record, chosen.process_noise, bias_sigma=chosen.bias_sigma)
    except InputError as error:
        raise InputError(
            f"{problem}, nor does a bank of hypotheses ({error}); give --attitude, or --from-truth"
        ) from None
    if not found.converged:
        raise InputError(
            f"{problem}, nor does a bank of hypotheses: {found.reason}; or give --attitude, or --from-truth"
        )
    edge = int(np.searchsorted(record.time, found.became_one))
    if edge >= len(record.increments):
        raise InputError(
            f"{problem}, and a bank of hypotheses found it only at the end; record longer, or give --attitude"
        )
    row = int(np.searchsorted(found.estimate.time, found.became_one))
    assert found.estimate.covariance is not None
    state = estimation.State(
        attitude=found.estimate.attitude[row],
        bias=found.estimate.bias[row],
        covariance=found.estimate.covariance[row],
    )
    words = (
        f"{why}: {len(found.angles)} hypotheses about it became one at "
        f"{found.became_one:.6g} s, σ {_sigma_words(state)}; the estimate begins there."
    )
    return state, words, edge


def _sigma_words(state: State) -> str:
    """Return how well an attitude is known: one σ, or where it differs by direction, as of tilt and heading, from which to which."""
    import numpy as np

    from strapdown.units import DEGREE

    least, _, most = np.sqrt(np.maximum(np.linalg.eigvalsh(state.covariance[:3, :3]), 0.0)) / DEGREE
    if most < UNEVEN * least:
        return f"{np.sqrt(np.trace(state.covariance[:3, :3]) / 3.0) / DEGREE:.3g}° an axis"
    return f"{least:.3g} to {most:.3g}° by direction"


def _clear(out: Path) -> None:
    """Remove what an earlier estimate left in the folder, which the next one may not write anew."""
    for name in (*FILES[1:], *ABOUT_IT):
        (out / name).unlink(missing_ok=True)


def _tell(result: Estimate) -> None:
    """Say what was not used, and what happened."""
    for sensor, number in result.skipped.items():
        if number:
            console.print(f"{number} samples of the {sensor} are missing or outside the record and were skipped.")
    for sensor, number in result.refused.items():
        if number:
            share = number / len(result.innovations[sensor].time)
            console.print(f"{number} samples of the {sensor} ({share:.2%}) were refused by the gate.")
    for event in result.events:
        console.print(str(event))


def _errors(result: Estimate, truth: Any) -> dict[str, float]:
    """Return errors and consistency over the second half, degrees and degrees an hour."""
    import numpy as np

    from strapdown import consistency
    from strapdown.units import DEGREE, DEGREE_PER_HOUR

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
    recording: Path,
    out: Path,
    layout: dict[str, Any],
    gyro: Path | None,
    motion: str | None,
    latency: float | None,
    observability: bool,
    figures: bool,
    exports: Sequence[tuple[Path, dict[str, Any]]],
    options: dict[str, Any],
) -> None:
    """Run the filter over a recording: accelerometer as the vertical, magnetometer as the heading."""
    from strapdown import ahrs, recordings, setup, unit_calibration
    from strapdown.checks import non_negative, one_of
    from strapdown.consistency import reference_errors
    from strapdown.estimation.gating import Gate, Robust
    from strapdown.files import write_json
    from strapdown.gyro import process_noise, read_spec
    from strapdown.records import write_estimate
    from strapdown.units import DEGREE

    moved_by = one_of("--motion", motion or "hand", ahrs.MOTIONS)
    late = None if latency is None else 1e-3 * non_negative("--latency", latency, unit="ms")
    if options["gate"] is not None:
        options["gate"] = Gate(probability=options["gate"])
    if options["robust"] is not None:
        options["robust"] = Robust(kind=options["robust"])
    source = recordings.read(recording, **layout)
    parameters = ahrs.MOTIONS[moved_by]
    if gyro is not None:
        parameters = replace(parameters, **process_noise(read_spec(gyro)))
    result = ahrs.estimate(source, parameters, latency=late, **options)
    used, found = result.recording, result.estimate
    errors = None if used.true_attitude is None else reference_errors(found.attitude, used.true_attitude)
    rms = None if errors is None else {name: value / DEGREE for name, value in errors.rms(used.movement).items()}
    frame = (
        "East-North-Up, magnetic North"
        if used.magnetic_field is not None
        else "z up, heading arbitrary (no magnetometer)"
    )
    paths = [out / "estimate.h5"]
    _clear(out)
    write_estimate(
        paths[0],
        found,
        {
            "source": used.source,
            "fixed_frame": frame,
            "motion": moved_by,
            "smoothed": options["smooth"],
            "filter": setup.to_toml(replace(parameters.setup, gate=options["gate"], robust=options["robust"])),
            **{f"parameter.{name}": value for name, value in vars(parameters).items()},
            "latency": result.delays.last_gyro,
            "magnetometer_latency": result.delays.last_field,
        },
    )
    if found.error_states:
        paths.append(out / "states.json")
        write_json(paths[-1], {"source": used.source, **_states(found)})
    console.print(
        f"{used.source}: {len(used.time)} samples over {used.time[-1] - used.time[0]:.1f} s, started in the quiet second "
        f"from {used.time[0]:.2f} s."
    )
    for remark in used.remarks:
        console.print(remark)
    console.print(f"Fixed frame: {frame}.")
    doubt(source, recording)
    console.print(_model(moved_by, parameters, result))
    for sentence in (*result.delays.words, *(f"{one}." for one in result.faults.words)):
        console.print(sentence)
    if result.hard_iron.any():
        iron = ", ".join(f"{value:.3g}" for value in result.hard_iron)
        console.print(
            f"Hard iron of {iron} (unit of the magnetometer, body axes, at the end) is taken off its samples."
        )
    if result.calibration is not None:
        paths.append(out / "calibration.toml")
        paths[-1].write_text(unit_calibration.to_toml(result.calibration), encoding="utf-8")
    for begin, length in recordings.gaps(used.time):
        console.print(f"Gap of {length:.3g} s after {begin:.3f} s.")
    if used.left_out_words:
        console.print(used.left_out_words)
    for sensor, number in found.skipped.items():
        if number:
            console.print(f"{number} samples of the {sensor} are missing and were skipped.")
    _tell(replace(found, skipped={}))
    if observability:
        shown = setup.observability(result.record, parameters.setup, result.initial)
        console.print(str(shown))
        paths.append(out / "observability.json")
        write_json(paths[-1], {"source": used.source, **shown.summary()})
    if rms is not None:
        paths.append(out / "errors.json")
        write_json(paths[-1], {"source": used.source, **{f"{name}_rmse_deg": value for name, value in rms.items()}})
        rows = table("RMS error over the movement phase, degrees", *rms, left=0)
        rows.add_row(*(f"{value:.2f}" for value in rms.values()))
        show(rows)
    paths += _export(exports, found, source)
    if figures:
        paths += _drawn(out, found, used.source, used=used, errors=errors)
    written(*paths)


def _model(moved_by: str, parameters: Any, result: Any) -> str:
    """Return in words the model of a recording's motion, and the bias that the filter started from."""
    import numpy as np

    from strapdown.units import DEGREE

    if moved_by == "any":
        return "Motion: any, its acceleration modelled as white noise."
    bias, sigma = result.initial.bias / DEGREE, np.sqrt(result.initial.covariance[3, 3]) / DEGREE
    words = (
        f"Motion: of a hand, {parameters.velocity_sigma:g} m/s with a correlation time of {parameters.velocity_time:g} s. "
        f"Gyro bias at the start: {', '.join(f'{value:.3g}' for value in bias)} °/s, σ {sigma:.2g} °/s"
    )
    if sigma > 0.5 * parameters.bias_sigma / DEGREE:
        return f"{words}: no second is quiet enough to show it, so the heading may drift at first."
    return f"{words}, from that second."
