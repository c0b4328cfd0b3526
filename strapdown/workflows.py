"""High-level functions for the most common tasks, available as ``sd.NAME`` after ``import strapdown as sd``; also used by the command line.

Each function chooses gyro noise, filter and initial state from the data and then calls a module that has more options:
:mod:`strapdown.estimation` and :mod:`strapdown.estimation.setup`, :mod:`strapdown.ahrs`, :mod:`strapdown.consistency`,
:mod:`strapdown.montecarlo`, :mod:`strapdown.tuning`, :mod:`strapdown.covariance`, :mod:`strapdown.allan`.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import (
    ahrs,
    allan,
    coning,
    consistency,
    gyro,
    quaternion,
    recordings,
    records,
    scenarios,
    units,
)
from strapdown.ahrs.remarks import fixed_frame, remarks
from strapdown.checks import Array, Hint, InputError, array, count, instance
from strapdown.consistency import Accuracy, Judgement
from strapdown.consistency.accuracy import accuracy as accuracy_of_rows
from strapdown.consistency.accuracy import accuracy_of
from strapdown.consistency.alignment import Series
from strapdown.covariance import analyse as covariance_analysis
from strapdown.estimation import setup as setups
from strapdown.estimation.filters.own import Own
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import FilterSetup, for_record
from strapdown.estimation.states import ProcessNoise, State
from strapdown.files import reading, write_text
from strapdown.gyro import GyroSpec
from strapdown.recordings import Recording, recordfiles
from strapdown.recordings.attitudes import Attitudes, read_attitudes
from strapdown.records import Estimate, ImuRecord, Origin, Truth
from strapdown.scenarios import Scenario, simulate

if TYPE_CHECKING:
    from strapdown.allan import AllanDeviation, NoiseFit
    from strapdown.calibration import UnitCalibration
    from strapdown.gyro.temperature import BiasOverTemperature
    from strapdown.montecarlo import Dispersions, Plan, Statistics
    from strapdown.montecarlo.campaign import Campaign
    from strapdown.recordings import GyroSamples
    from strapdown.tuning import Prior, Tuning
    from strapdown.tuning.diagnosis import Diagnosis
    from strapdown.tuning.procedure import Tuned

__all__ = [
    "AttitudeHistory",
    "Run",
    "accuracy",
    "allan_deviation",
    "check",
    "covariance_analysis",
    "diagnose",
    "estimate",
    "fit_noise",
    "integrate",
    "monte_carlo",
    "plan",
    "read",
    "read_attitudes",
    "simulate",
    "smooth",
    "tune",
    "write",
]

SOURCE = "give an ImuRecord or a Recording, as simulate and read return them"
SAME_STAMP = 1e-9
"""Maximum difference between two time stamps of the same epoch, s."""
HDF5 = (".h5", ".hdf5")
"""Suffixes of files that hold results completely."""


# ------------------------------------------------------------------------------------------------------------------ read, write


COLUMNS = ("columns", "data_vars", "__arrow_c_stream__")
"""Attributes of an object that holds columns."""


def read(
    path: Any,
    *,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    topic: str = "",
    axes: str | Mapping[str, str] | None = None,
    invert: str | Iterable[str] = (),
) -> ImuRecord | Recording | Estimate | Campaign:
    """Read a file of any known format, identified by its content, or a table in memory.

    Parameters
    ----------
    path : path, DataFrame, Dataset or mapping
        A simulated record, an estimate or a Monte Carlo of this package, or a recording in a format of
        :data:`strapdown.recordings.FORMATS` (CSV, ROS bag, ULog, EuRoC folder, …); or the columns of a recording, as for
        :func:`strapdown.recordings.from_table` (pandas, polars, pyarrow, xarray, structured arrays, arrays by name).
    units : mapping of str to str, optional
        For tables: units of ``time``, ``gyro``, ``accelerometer`` and ``magnetometer`` if the header does not declare them.
    columns : mapping of str to str, optional
        For tables: names of columns by role, ``{"time": "timestamp [us]", "gx": "gyro_x[dps]"}``.
    topic : str, default ""
        For bags and flight logs: topic of the inertial unit, if there are several.
    axes : str or mapping of str to str, optional
        For recordings: the recorded axes that become the body's x, y, z (:func:`strapdown.recordings.read`).
    invert : str or iterable of str, default empty
        For recordings: sensors with inverted sign.

    Returns
    -------
    ImuRecord, Estimate, Campaign or Recording
        A record has its ``origin``; the ``remarks`` of a recording list the choices of the reader.

    Raises
    ------
    InputError
        If the file is missing, damaged, of unknown format, or does not declare a required unit; or if an option does not apply to it.

    Examples
    --------
    >>> import strapdown as sd
    >>> walk = sd.read("walk.csv", units={"gyro": "deg/s", "accelerometer": "g"})  # doctest: +SKIP
    """
    given = {"units": units, "columns": columns, "topic": topic, "axes": axes, "invert": invert}
    options: dict[str, Any] = {name: value for name, value in given.items() if value}
    if isinstance(path, (Mapping, np.ndarray)) or any(map(partial(hasattr, path), COLUMNS)):
        if topic:
            raise InputError(f"{Hint('topic')} is for a bag or a flight log; leave it out")
        table = recordings.from_table(path, units=units, columns=columns)
        return recordings.with_axes(table, axes, invert) if axes or invert else table
    instance("path", path, (str, os.PathLike), "give a path, a data frame, a Dataset, or arrays by name")
    file = Path(path)
    kinds = {"strapdown estimate": "estimate", "strapdown montecarlo": "Monte Carlo"}
    kind = ""
    if file.is_file():
        kind = "record" if recordfiles.is_record(file) else kinds.get(reading.kind(file), "")
    if not kind:
        return recordings.read(file, **options)
    if options:
        raise InputError(
            f"{file} is a {kind} of this package and declares its own layout; leave {', '.join(options)} out"
        )
    if kind == "record":
        return recordfiles.read_record(file)
    if kind == "estimate":
        return setups.read_estimate(file)
    from strapdown.montecarlo import campaign

    return campaign.read(file)


def write(
    content: ImuRecord | Recording | Estimate | Scenario | FilterSetup, path: str | os.PathLike[str], **options: Any
) -> Path:
    """Write a record, recording, estimate, scenario or filter setup to a file, atomically.

    Parameters
    ----------
    content : ImuRecord, Recording, Estimate, Scenario or FilterSetup
        The file of a record contains its origin; a scenario that includes your own Python functions or classes is omitted.
    path : path
        The suffix selects the format: ``.h5`` holds a record or an estimate completely, with its filter, origin and truth, ``.toml`` a
        scenario or a filter setup; :data:`strapdown.recordings.FORMATS` lists the others for recordings and estimates.
    **options
        Options of the format (:func:`strapdown.recordings.write`): ``sequence`` and ``frame`` for an estimate as a table.

    Returns
    -------
    Path
        The file.

    Examples
    --------
    >>> import strapdown as sd
    >>> sd.write(estimate, "walk-angles.csv", sequence="ZYX")  # doctest: +SKIP
    """
    kinds = (ImuRecord, Recording, Estimate, Scenario, FilterSetup)
    instance("content", content, kinds, "give one of these")
    if isinstance(content, (Scenario, FilterSetup)):
        if Path(path).suffix.lower() != ".toml" or options:
            raise InputError(
                f"{path}: a {type(content).__name__} is written as TOML without options; name a file *.toml"
            )
        text = setups.to_toml(content) if isinstance(content, FilterSetup) else scenarios.scenario_to_toml(content)
        write_text(path, text)
    elif isinstance(content, (ImuRecord, Estimate)) and Path(path).suffix.lower() in HDF5:
        save: Callable[..., None] = setups.write_estimate if isinstance(content, Estimate) else recordfiles.write_record
        save(path, content, **options)
    else:
        recordings.write(content, path, **options)
    return Path(path)


# ------------------------------------------------------------------------------------------------------------------- estimate


class Run(NamedTuple):
    """An estimate with what it was made from."""

    estimate: Estimate
    record: ImuRecord
    """Input of the filter, from its start on (:func:`strapdown.estimation.setup.modelled_record`)."""
    setup: FilterSetup
    """The filter without gate and weights."""
    initial: State
    calibration: UnitCalibration | None = None
    """Calibration of the unit that a recording yields."""


def estimate(
    source: ImuRecord | Recording,
    *,
    noise: GyroSpec | NoiseFit | ProcessNoise | None = None,
    setup: FilterSetup | None = None,
    initial: State | ArrayLike | str | None = None,
    states: bool | Sequence[str] | None = None,
    every: int = 1,
    gate: Gate | float | None = None,
    robust: Robust | str | None = None,
    motion: str | None = None,
    latency: float | None = None,
    calibration: UnitCalibration | None = None,
    temperature: BiasOverTemperature | None = None,
    full_covariance: bool | None = None,
    smooth: bool = False,
) -> Estimate:
    """Estimate attitude and gyro bias with a multiplicative extended Kalman filter, as the command ``strapdown estimate`` does.

    For a simulated record, the filter matches the scenario and is initialised from the first measurements. For a recording, the
    accelerometer gives the vertical and the magnetometer the heading (:mod:`strapdown.ahrs`), from the first sample on.

    Parameters
    ----------
    source : ImuRecord or Recording
        Result of :func:`simulate` or :func:`read`, or a record made from your own data.
    noise : GyroSpec, NoiseFit or ProcessNoise, optional
        Noise of the gyro: a specification, an Allan fit (:func:`fit_noise`), or the two coefficients of the filter. Default: that of the
        record's origin; for a recording that of :data:`strapdown.ahrs.MOTIONS`.
    setup : FilterSetup, optional
        For a record: the complete filter, for example from :func:`tune`, in place of ``noise`` and ``states``.
    initial : State, array_like (4,) or "truth", optional
        For a record: initial state (:func:`initial_state`) at the first edge; an attitude q_fb, with the filter's σ; or the truth with
        errors drawn from the filter's σ. Default: from the first measurements.
    states : bool or sequence of str, optional
        For a record: whether to add an error state for each error that the scenario specifies (scale factor, misalignment, hard iron, …),
        or the names of those to add. Default: True if the scenario specifies such errors.
    every : int, default 1
        For a record: store every n-th filter step.
    gate : Gate or float, optional
        Reject measurements beyond this quantile of χ² (such as 0.999), and recover from a lost attitude.
    robust : Robust or {"huber", "student"}, optional
        Weight measurements by the size of their innovations.
    motion : {"hand", "vehicle", "vessel", "any"}, optional
        For a recording: model of the motion. ``"hand"``, the default: bounded velocity, as of a hand, a person or a small aircraft;
        ``"vehicle"``: acceleration that lasts for seconds; ``"vessel"``: bounded position, as on waves; ``"any"``: white noise.
    latency : float, optional
        For a recording: delay of the gyro's samples, s. Default: half a sample interval.
    calibration : UnitCalibration, optional
        For a recording: calibration of the unit, from :func:`strapdown.calibrate`; the bias is then that of the corrected rates.
    temperature : BiasOverTemperature, optional
        For a recording: the gyro's bias over temperature (°C), which is subtracted first. Default: that of ``noise``.
    full_covariance : bool, optional
        Whether to store covariance matrices rather than their diagonals. Default: True, but for a recording without a reference attitude.
    smooth : bool, default False
        Whether to estimate each epoch from all measurements: see :func:`smooth`.

    Returns
    -------
    Estimate
        At the edges of the filter's steps (record) or at the stamps of the recording: ``time`` (m,) s, ``attitude`` (m, 4) q_fb,
        ``bias`` (m, 3) rad/s, ``variance`` (m, 6) rad² and (rad/s)². The fixed frame of a recording is East-North-Up with magnetic North.
        It has its filter (``setup``), its ``truth`` or reference if the source has one, and ``remarks``.

    Raises
    ------
    InputError
        If the gyro's noise is unknown, the initial attitude is not observable from the measurements, a recording has no accelerometer, or
        an option does not apply to the source.

    Warns
    -----
    UserWarning
        If units, axes or signs of a recording seem wrong.

    Examples
    --------
    >>> import strapdown as sd
    >>> estimate = sd.estimate(sd.simulate("two-stars"))  # doctest: +SKIP
    >>> estimate.attitude[-1], estimate.sigma[-1]  # doctest: +SKIP
    """
    options = locals()
    if isinstance(source, Recording):
        _doubt(source)
    return run(**options).estimate


def run(
    source: ImuRecord | Recording,
    *,
    gate: Gate | float | None = None,
    robust: Robust | str | None = None,
    walks: bool = False,
    **options: Any,
) -> Run:
    """Return the estimate of :func:`estimate` with what it was made from; ``walks``: model the bias slope's error as a random walk."""
    gate = Gate(probability=gate) if isinstance(gate, (int, float)) else gate
    robust = Robust(kind=robust) if isinstance(robust, str) else robust  # type: ignore[arg-type]
    instance("source", source, (ImuRecord, Recording), SOURCE)
    recorded = isinstance(source, Recording)
    others = ("motion", "latency", "calibration", "temperature")
    for name in ("setup", "initial", "states", "every") if recorded else others:
        value = options.pop(name, None) if recorded or name in others else None
        if value not in (None, False) and not (name == "every" and value == 1):
            raise InputError(f"{Hint(name)} goes with a record{'' if recorded else 'ing'}; leave it out")
    if isinstance(source, Recording):
        return _run_recording(source, gate, robust, walks=walks, **options)
    changes = {name: value for name, value in (("gate", gate), ("robust", robust)) if value is not None}
    return _run_record(source, changes, **options)


def _run_record(
    record: ImuRecord,
    changes: Mapping[str, Any],
    *,
    noise: GyroSpec | NoiseFit | ProcessNoise | None = None,
    setup: FilterSetup | None = None,
    initial: State | ArrayLike | str | None = None,
    states: bool | Sequence[str] | None = None,
    every: int = 1,
    full_covariance: bool | None = None,
    smooth: bool = False,
) -> Run:
    """Run the filter over a record; ``changes``: the gate and the weights."""
    if smooth and count("every", every) > 1:
        raise InputError(f"{Hint('every')} stores some filter steps, but the smoother needs all; leave one of them out")
    chosen, notes = _record_setup(record, noise, setup, initial, states)
    chosen = dataclasses.replace(chosen, **changes)
    modelled = setups.modelled_record(record, chosen)
    if every > len(modelled.increments):
        raise InputError(
            f"every is {every}, more than the {len(modelled.increments)} filter steps of the record; only the first epoch would be kept"
        )
    if initial is None:
        begin = for_record.start(modelled, chosen)
    elif isinstance(initial, str) and initial == "truth":
        begin = for_record.drawn_start(record, chosen)
    elif isinstance(initial, State):
        begin = for_record.Start(initial, "Started from the state given.")
    else:
        q = array("initial", initial, (4,))  # type: ignore[arg-type]
        if not q.any():
            raise InputError("initial is the zero quaternion; give w, x, y, z of an attitude")
        begin = for_record.Start(
            setups.initial_state(chosen, quaternion.normalize(q)), "Started from the attitude given."
        )
    if begin.edge > 0:
        modelled = records.cut(modelled, begin.edge, len(modelled.increments))
        if every > len(modelled.increments):
            raise InputError(
                f"every is {every}, more than the {len(modelled.increments)} filter steps after the start of the filter"
            )
    full = full_covariance is not False
    if smooth:
        result = setups.smooth_modelled(modelled, chosen, begin.state, full_covariance=full)
    else:
        result = setups.run_modelled(modelled, chosen, begin.state, every=every, full_covariance=full)
    truth = None if modelled.truth is None else modelled.truth.taken(np.searchsorted(modelled.time, result.time))
    result = dataclasses.replace(
        result, setup=chosen, origin=record.origin, truth=truth, smoothed=smooth, remarks=(begin.words, *notes)
    )
    return Run(result, modelled, chosen, begin.state)


def _run_recording(
    source: Recording,
    gate: Gate | None,
    robust: Robust | None,
    *,
    noise: GyroSpec | NoiseFit | ProcessNoise | None = None,
    temperature: BiasOverTemperature | None = None,
    motion: str | None = None,
    walks: bool = False,
    full_covariance: bool | None = None,
    smooth: bool = False,
    **options: Any,
) -> Run:
    """Run the filter over a recording; its estimate has the setup, the reference, and remarks on the start, the motion and the samples."""
    motion = motion or "hand"
    ahrs.need_accelerometer(source)
    parameters, notes = ahrs.of_motion(motion, magnetometer=source.magnetic_field is not None, smooth=smooth), []
    if isinstance(noise, ProcessNoise):
        parameters = dataclasses.replace(
            parameters, angle_random_walk=noise.angle_random_walk, rate_random_walk=noise.rate_random_walk
        )
    elif noise is not None:
        spec = _specification(noise)
        parameters, temperature = with_gyro_noise(parameters, spec), temperature or spec.temperature
        arw = parameters.angle_random_walk / units.DEGREE_PER_ROOT_HOUR
        rrw = parameters.rate_random_walk / units.DEGREE_PER_HOUR_PER_ROOT_HOUR
        notes = [f"Gyro noise, flicker included: {arw:.3g} °/√h, bias random walk {rrw:.3g} °/h/√h."]
    if temperature is not None:
        source, parameters = ahrs.without_temperature(source, parameters, temperature, walks=walks or smooth)
    reference = source.true_attitude
    if reference is not None and source.movement is not None:
        judged = np.isfinite(reference).all(axis=1) & source.movement
        if not judged.any():
            raise InputError(
                f"{source.source}: no sample to judge has a reference attitude; check its movement mask and its reference"
            )
    full = reference is not None if full_covariance is None else full_covariance
    result = ahrs.estimate(source, parameters, gate=gate, robust=robust, full_covariance=full, smooth=smooth, **options)
    used = result.recording
    estimate = dataclasses.replace(
        result.estimate,
        setup=dataclasses.replace(result.parameters.setup, gate=gate, robust=robust),
        origin=Origin(source=used.source),
        truth=None if used.true_attitude is None else Truth.of_reference(used.true_attitude, used.movement),
        fixed_frame=fixed_frame(used),
        motion=motion,
        smoothed=smooth,
        remarks=(*remarks(result, motion), *notes),
        details={
            **{f"parameter.{name}": value for name, value in vars(result.parameters).items()},
            "latency": result.delays.last_gyro,
            "magnetometer_latency": result.delays.last_field,
        },
    )
    return Run(estimate, result.record, result.parameters.setup, result.initial, result.calibration)


def smooth(
    source: ImuRecord | Recording,
    *,
    noise: GyroSpec | NoiseFit | ProcessNoise | None = None,
    setup: FilterSetup | None = None,
    initial: State | ArrayLike | str | None = None,
    states: bool | Sequence[str] | None = None,
    gate: Gate | float | None = None,
    robust: Robust | str | None = None,
    motion: str | None = None,
    latency: float | None = None,
    calibration: UnitCalibration | None = None,
    temperature: BiasOverTemperature | None = None,
    full_covariance: bool | None = None,
) -> Estimate:
    """Estimate attitude and gyro bias at each epoch from all measurements, before and after it (fixed-interval smoother).

    Parameters
    ----------
    source : ImuRecord or Recording
        Result of :func:`simulate` or :func:`read`, or a record made from your own data.
    noise, setup, initial, states, gate, robust, motion, latency, calibration, temperature, full_covariance : optional
        As for :func:`estimate`; ``latency`` in s, bias over ``temperature`` in °C.

    Returns
    -------
    Estimate
        Smoothed estimate at the same epochs and with the same fields as that of :func:`estimate`.

    Raises
    ------
    InputError
        As for :func:`estimate`, or if the record is too long for the memory.

    References
    ----------
    H. E. Rauch, F. Tung, C. T. Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965.

    Examples
    --------
    >>> record = simulate("two-stars", seed=1)
    >>> smooth(record).attitude.shape  # doctest: +SKIP
    (30001, 4)
    """
    return estimate(**locals(), smooth=True)


def _doubt(source: Recording) -> None:
    """Warn the caller of the calling function if axes, signs or units of a recording seem wrong."""
    for words in ahrs.check_conventions.examine(source).warnings:
        warnings.warn(f"{source.source}: {words}", stacklevel=3)


def _refuse(what: str, **options: Any) -> None:
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{name} goes with {what}; leave it out")


def _specification(noise: GyroSpec | NoiseFit) -> GyroSpec:
    if isinstance(noise, allan.NoiseFit):
        return GyroSpec(**allan.to_gyro_parameters(noise))  # type: ignore[arg-type]
    if not isinstance(noise, GyroSpec):
        raise InputError(f"noise is {type(noise).__name__}; give a GyroSpec, a NoiseFit or a ProcessNoise")
    return noise


def with_gyro_noise(parameters: ahrs.AhrsParameters, spec: GyroSpec) -> ahrs.AhrsParameters:
    """Return the parameters of a recorded unit with the noise of its gyro; flicker is approximated for the accuracy of the tilt."""
    density = (parameters.specific_force_noise / units.STANDARD_GRAVITY) ** 2  # rad² s
    noise: dict[str, Any] = gyro.matched_process_noise(spec, density)
    return dataclasses.replace(parameters, **noise)


def _record_setup(
    record: ImuRecord,
    noise: GyroSpec | NoiseFit | ProcessNoise | None,
    setup: FilterSetup | None,
    initial: State | ArrayLike | str | None,
    states: bool | Sequence[str] | None,
) -> tuple[FilterSetup, list[str]]:
    """Return the filter for a record, and remarks on its error states and on errors that it does not model."""
    if setup is not None:
        remedy = "give a FilterSetup, as setup.FilterSetup.for_scenario or tune returns it"
        instance("setup", setup, FilterSetup, remedy)
        _need_alone(noise, states)
        need_angles(setup, record)
        return setup, no_state_words(for_record.unmodelled_errors(record.origin, setup), setup)
    if not isinstance(noise, ProcessNoise):
        return matched_filter(record, None if noise is None else _specification(noise), states=states)
    if not isinstance(initial, State):
        raise InputError(
            "noise is a ProcessNoise, which has no σ of the initial gyro bias; give initial= too, or a GyroSpec as noise"
        )
    _refuse("a specified gyro; declare the states of your own filter in setup=", states=states or None)
    sigma = np.sqrt(np.diag(initial.covariance))
    return FilterSetup(
        process_noise=noise, attitude_sigma=float(np.max(sigma[:3])), bias_sigma=float(np.max(sigma[3:6]))
    ), []


def _need_alone(noise: Any, states: Any) -> None:
    """Raise an error for options that go with a matched filter, if a complete one is given."""
    for name, value in (("states", states), ("noise", noise)):
        if value is not None:
            raise InputError(
                f"{Hint('setup')} is the complete filter, with its noise and states; leave {Hint(name)} out"
            )


def need_angles(setup: FilterSetup, record: ImuRecord) -> None:
    """Raise an error for σ of the record's sensors that cannot be in rad, unless the record's own are as large."""
    fine = {one.sensor: one.kind for one in record.vectors if len(one.time) and np.max(one.sigma) <= np.pi}
    setups.need_angles(setup, fine, "filter")


def matched_filter(
    record: ImuRecord, spec: GyroSpec | None = None, *, states: bool | Sequence[str] | None = None
) -> tuple[FilterSetup, list[str]]:
    """Return the filter that matches a record's specifications, and remarks on its error states and on errors without one."""
    chosen = setups.FilterSetup.for_record(record, spec, states=states)
    missing = for_record.unmodelled_errors(record.origin, chosen)
    if states is False or (states is None and chosen.states is None):
        return chosen, no_state_words(missing, chosen)
    notes = []
    if record.origin is None or record.origin.scenario is None:
        notes.append(
            "The record does not contain its scenario, so the errors of its sensors are unknown: no state for them."
        )
    if chosen.states is None:
        notes.append("No errors are specified that need optional states; the filter has none.")
    elif states is None:
        notes.append(state_words(chosen.states.names))
    else:
        notes.append(f"Optional states: {', '.join(chosen.states.names)}.")
    return chosen, [*notes, *([f"Still without a state: {', '.join(missing)}."] if missing else [])]


def filter_for_scenario(
    scenario: Scenario,
    *,
    setup: FilterSetup | None = None,
    gyro: GyroSpec | None = None,
    states: bool | Sequence[str] | None = None,
) -> FilterSetup:
    """Return the filter for a scenario: ``setup``, or one that matches it, assuming another ``gyro`` if given."""
    if setup is None:
        assumed = scenario if gyro is None else dataclasses.replace(scenario, gyro=gyro)
        return setups.FilterSetup.for_scenario(assumed, states=states)
    setups.need_setup(setup)
    _need_alone(gyro, states)
    kinds = {sensor.name: str(getattr(sensor, "kind", "attitude")) for sensor in scenario.sensors}
    setups.need_angles(setup, kinds, "filter")
    return setup


def state_words(names: Sequence[str]) -> str:
    """Return the reason why a filter has error states by default."""
    return (
        f"The filter has states for the specified errors, {', '.join(names)}: without them its σ would be too small "
        f"({Hint('states', False)} omits them)."
    )


def no_state_words(missing: Sequence[str], chosen: FilterSetup) -> list[str]:
    """Return a message about errors for which a filter has no state, with a remedy; empty if there are none."""
    remedy = "" if chosen.states is not None else f"; {Hint('states', True)} adds states for most of them"
    said = f"The record specifies errors for which this filter has no state: {', '.join(missing)}{remedy}."
    return [said] if missing else []


class AttitudeHistory(NamedTuple):
    """Attitude integrated from the gyro only."""

    time: Array
    """Edges of the algorithm's steps (k + 1,), s."""
    attitude: Array
    """q_fb (k + 1, 4)."""


def integrate(
    source: ImuRecord | Recording,
    algorithm: str | coning.Algorithm = "four-sample",
    *,
    initial_attitude: ArrayLike | None = None,
) -> AttitudeHistory:
    """Integrate gyro samples to attitude, without other sensors.

    Parameters
    ----------
    source : ImuRecord or Recording
        Only its gyro samples are used; gyro errors are not corrected.
    algorithm : str or Algorithm, default "four-sample"
        Coning algorithm (``strapdown.coning.ALGORITHMS``).
    initial_attitude : array_like (4,), optional
        q_fb at the first edge. Default: the true attitude if the source has it, otherwise the identity.

    Returns
    -------
    AttitudeHistory
        ``time`` (k + 1,), s, and ``attitude`` (k + 1, 4), q_fb, at the edges of the algorithm's steps; remaining samples are dropped.

    Examples
    --------
    >>> import strapdown as sd
    >>> found = sd.integrate(sd.simulate("coning"))  # doctest: +SKIP
    """
    chosen = coning.named(algorithm)
    instance("source", source, (ImuRecord, Recording), SOURCE)
    if isinstance(source, ImuRecord):
        time, increments = source.time, source.increments
        known, place = None if source.truth is None else source.truth.attitude, "the record"
    else:
        place = source.source
        time, increments, known = source.time, recordings.increments(source), source.true_attitude
    if len(increments) < chosen.samples:
        raise InputError(
            f"{place} holds {len(increments)} gyro samples, fewer than the {chosen.samples} of one step of {chosen.name}; choose another "
            "algorithm or a longer recording"
        )
    start: ArrayLike = quaternion.IDENTITY
    if initial_attitude is not None:
        start = initial_attitude
    elif known is not None and np.isfinite(known[0]).all():
        start = known[0]
    attitude = coning.integrate(increments, chosen, start, edges=time)
    return AttitudeHistory(time[: len(attitude) * chosen.samples : chosen.samples], attitude)


# ---------------------------------------------------------------------------------------------------------------------- check


def check(
    result: Estimate | Statistics | Campaign,
    truth: Truth | ImuRecord | Recording | None = None,
    *,
    confidence_level: float = 0.99,
    detectable_error: float = consistency.DETECTABLE,
) -> Judgement:
    """Test whether a filter is consistent, that is, whether its errors and innovations agree with its covariance.

    The verdict is that of the command ``strapdown check`` and of the report. A result has all that it depends on, in memory and in a file.

    Parameters
    ----------
    result : Estimate, Statistics or Campaign
        Result of :func:`estimate`, :func:`monte_carlo` or :func:`read`.
    truth : Truth, ImuRecord or Recording, optional
        Truth at the epochs of the estimate, or the record or recording with its truth, which is matched by time. Default: the estimate's
        own; if it has none, only the innovations are tested.
    confidence_level : float, default 0.99
        Minimum probability with which a consistent filter passes all tests together.
    detectable_error : float, default 1.5
        "consistent" needs tests that would have detected an error of σ by this factor, of attitude, bias and innovations.

    Returns
    -------
    Judgement
        ``headline`` has the verdict, "consistent", "not consistent" or "cannot tell", and the parts that were tested; ``findings`` has the
        statistics.

    Examples
    --------
    >>> import strapdown as sd
    >>> print(sd.check(sd.estimate(sd.simulate("two-stars"))))  # doctest: +SKIP
    """
    if isinstance(result, Estimate):
        options = {"confidence_level": confidence_level, "detectable_error": detectable_error}
        return consistency.judge(result, _truth_at(result, truth), **options)
    statistics: Any = getattr(result, "statistics", result)
    if statistics is None:
        raise InputError("the Monte Carlo has no finished run yet; resume it")
    if not hasattr(statistics, "log_nees_sum"):
        raise InputError(f"result is {type(result).__name__}; give an Estimate, or what monte_carlo returned")
    if truth is not None:
        raise InputError("truth goes with an estimate; a Monte Carlo contains its own truth; leave it out")
    judgement: Judgement = statistics.judge(confidence_level=confidence_level, detectable_error=detectable_error)
    return judgement


def diagnose(
    result: Estimate, record: ImuRecord, *, setup: FilterSetup | None = None, judgement: Judgement | None = None
) -> tuple[Diagnosis | None, str]:
    """Search for the causes of an inconsistency, as ``strapdown check`` with a record does.

    Parameters
    ----------
    result : Estimate
        Result of :func:`estimate`.
    record : ImuRecord
        The record from which it was made.
    setup : FilterSetup, optional
        The filter that made it. Default: that of the estimate.
    judgement : Judgement, optional
        The verdict of :func:`check`, with which the causes are combined.

    Returns
    -------
    diagnosis : Diagnosis or None
        Causes, the most likely first, and the verdict from statistics and causes together; None if the filter has more states.
    reason : str
        Feature of the filter that the search does not support, so that only the statistics count; empty if there is none.

    Examples
    --------
    >>> import strapdown as sd
    >>> record = sd.read("flight.h5")  # doctest: +SKIP
    >>> causes, reason = sd.diagnose(sd.estimate(record), record)  # doctest: +SKIP
    """
    from strapdown.tuning import diagnosis
    from strapdown.tuning.residual_checks import accepted

    chosen = result.setup if setup is None else setup
    if chosen is None:
        raise InputError(f"the estimate does not contain its filter; give it, {Hint('setup')}")
    unknown = sorted(set(result.innovations) - {series.sensor for series in record.vectors})
    if unknown or not np.isin(result.time, record.time).all():
        what = f"has no sensor {unknown[0]!r}" if unknown else "has other time stamps"
        raise InputError(f"the record {what}; the estimate was made from another record")
    if chosen.states is not None and chosen.states.names:
        names = ", ".join(chosen.states.names)
        return None, f"the search supports filters of attitude and bias only, and this one has the states {names}"
    P = np.diag(result.variance[0]) if result.covariance is None else result.covariance[0]
    initial = State(attitude=result.attitude[0], bias=result.bias[0], covariance=P)
    judged = judgement or check(result)
    # The verdict is on the filter with its gate, so measurements that it rejected are left out.
    found = diagnosis.diagnose(
        accepted(record, result), chosen, initial, probability=judged.confidence_level, judgement=judged
    )
    if chosen.robust is not None:
        return found, "The filter weights measurements by their innovations, and the search for causes does not"
    if any(event.kind == "recovery" for event in result.events):
        return found, "The filter recovered from a lost attitude, and the search for causes does not"
    return found, ""


def _truth_at(result: Estimate, truth: Truth | ImuRecord | Recording | None) -> Truth | None:
    """Return the truth at the epochs of an estimate."""
    if truth is None or isinstance(truth, Truth):
        if truth is not None and len(truth.attitude) != len(result.time):
            raise InputError(
                f"truth has {len(truth.attitude)} epochs and the estimate {len(result.time)}; give the record, which is matched by time"
            )
        return truth
    instance(
        "truth",
        truth,
        (ImuRecord, Recording),
        "give the record, the recording, or a Truth at the epochs of the estimate",
    )
    whole = truth.truth if isinstance(truth, ImuRecord) else None
    if isinstance(truth, Recording) and truth.true_attitude is not None:
        whole = Truth.of_reference(truth.true_attitude, truth.movement)
    if whole is None:
        raise InputError("truth is a record without a truth; leave it out to test the innovations only")
    rows = np.minimum(np.searchsorted(truth.time, result.time - SAME_STAMP), len(truth.time) - 1)
    if np.max(np.abs(truth.time[rows] - result.time)) > SAME_STAMP:
        raise InputError("the time stamps of record and estimate differ; give the record of the estimate")
    return whole.taken(rows)


def accuracy(result: Estimate, truth: Truth | ImuRecord | Recording | Attitudes | None = None) -> Accuracy:
    """Return the attitude errors of an estimate: total, heading and inclination, as given, and aligned with a truth of another source.

    Parameters
    ----------
    result : Estimate
        Estimate of any filter.
    truth : Truth, ImuRecord, Recording or Attitudes, optional
        Truth at the epochs of the estimate; the record or recording with its truth; or attitudes of any source
        (:func:`read_attitudes`), in another clock and other frames. Default: the estimate's own.

    Returns
    -------
    Accuracy
        Errors over all samples and over the movement; with covariances also their coverage and the ratio of RMS error and σ.

    Examples
    --------
    >>> import strapdown as sd
    >>> print(sd.accuracy(sd.estimate(recording)))  # doctest: +SKIP
    """
    instance("result", result, Estimate, "give the result of estimate or read")
    if not isinstance(truth, Attitudes):
        known = _truth_at(result, truth) or result.truth
        return accuracy_of_rows(result, known, align=known is not None and not known.has_bias)
    P = result.attitude_covariance
    own = Series(result.time, result.attitude, P if np.isfinite(P).all() else None)
    return accuracy_of(own, Series(truth.seconds(0), truth.attitude, movement=truth.movement))


def plan(
    scenario: Scenario,
    *,
    setup: FilterSetup | Own | None = None,
    gyro: GyroSpec | None = None,
    seed: int | None = None,
    states: bool | None = None,
    dispersions: Dispersions | None = None,
) -> Plan:
    """Return the plan of a Monte Carlo: a scenario with the filter that matches it, or with another ``setup``.

    ``gyro``: gyro specification assumed by the matched filter, such as that of a data sheet; default: that of the scenario.
    ``states``: whether the matched filter has an error state for each error that the scenario specifies; default: if there are such errors.
    If constant errors have states, each run draws its own gyro and sensors, since the filter is consistent on average over such units only.
    """
    from strapdown import montecarlo

    if isinstance(setup, Own):
        _need_alone(gyro, states)
        setup = dataclasses.replace(FilterSetup.for_scenario(scenario, states=False), estimator=setup)
    chosen = filter_for_scenario(scenario, setup=setup, gyro=gyro, states=states)
    names = chosen.states.names if setup is None and chosen.states is not None else ()
    return montecarlo.Plan(
        scenario=scenario,
        setup=chosen,
        seed=scenario.seed if seed is None else seed,
        epochs=montecarlo.whole_epochs(scenario, chosen),
        individuals=any(not name.endswith((".drift", ".correlated")) for name in names),
        dispersions=dispersions or montecarlo.Dispersions(),
    )


def monte_carlo(
    scenario: Scenario | str | os.PathLike[str],
    *,
    runs: int = 1000,
    seed: int | None = None,
    setup: FilterSetup | None = None,
    states: bool | None = None,
    dispersions: Dispersions | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Statistics:
    """Simulate many runs of a scenario with a filter and return the statistics over the runs.

    :func:`strapdown.montecarlo.campaign.run` does the same with a file from which it can be resumed, also on clusters.

    Parameters
    ----------
    scenario : Scenario, str or path
        As for :func:`simulate`.
    runs : int, default 1000
        Number of independent runs.
    seed : int, optional
        Seed of the random numbers. Default: that of the scenario.
    setup : FilterSetup, optional
        The filter. Default: matched to the scenario.
    states : bool, optional
        Whether the matched filter has an error state for each error that the scenario specifies. Default: True if there are such errors.
    dispersions : Dispersions, optional
        Initial errors and gyro parameters that differ from run to run.
    threads : int, optional
        Number of threads. Default: one per core.
    progress : callable, optional
        Called with the number of runs completed since its last call.

    Returns
    -------
    Statistics
        Argument of :func:`check`; bit-identical for any number of threads.

    Examples
    --------
    >>> import strapdown as sd
    >>> print(sd.check(sd.monte_carlo("two-stars", runs=1000)))  # doctest: +SKIP
    """
    from strapdown import montecarlo

    chosen = plan(scenarios.as_scenario(scenario), setup=setup, seed=seed, states=states, dispersions=dispersions)
    return montecarlo.run_plan(chosen, runs=runs, threads=threads, progress=progress)


# ----------------------------------------------------------------------------------------------------------------------- tune


def tune(
    sources: ImuRecord | Recording | Sequence[ImuRecord | Recording],
    *,
    setup: FilterSetup | None = None,
    free: Sequence[str] | None = None,
    states: bool | None = None,
    priors: Mapping[str, Prior] | GyroSpec | None = None,
    truth: bool = False,
    rmse: bool = False,
    gate: bool = False,
    spacing: float = 0.0,
    holdout: float | None = None,
    holdout_by: str = "time",
    starts: int = 4,
    seed: int = 0,
    threads: int | None = None,
) -> Tuning:
    """Tune noise parameters of a filter by maximum likelihood of its innovations, with confidence intervals.

    Parameters
    ----------
    sources : ImuRecord, Recording, or sequence of them
        Records of one unit.
    setup : FilterSetup, optional
        Initial filter. Default: matched to the first record, or that of recordings.
    free : sequence of str, optional
        Parameters to tune: ``"gyro.arw"``, ``"gyro.rrw"``, ``"SENSOR.sigma"``, …. Default: the two of the gyro and the σ of every sensor;
        for recordings without ``truth`` or ``rmse`` only ``"filter.scale"``.
    states : bool, optional
        Whether the matched filter has an error state for each error that the record specifies. Default: if there are such errors.
    priors : mapping of str to Prior, or GyroSpec, optional
        Prior distributions of parameters, by name; or a gyro, for weak priors of its noise.
    truth : bool, default False
        Whether to tune by the likelihood of the errors relative to the truth, in place of that of the innovations.
    rmse : bool, default False
        Whether to tune by the RMS attitude error against the truth, and then to scale all σ by the innovations.
    gate : bool, default False
        Whether to model the fraction and scale of outliers too, for the filter's gate.
    spacing : float, default 0.0
        Interval between the samples of a sensor that are used, with the weight of all, s: for correlated disturbances.
    holdout : float, optional
        Fraction of the data held out, for comparing the filter before and after tuning (``Tuning.comparison``).
    holdout_by : {"time", "record"}, default "time"
        Whether the end of each record is held out, or complete records.
    starts : int, default 4
        Number of searches: one from the initial filter, the others from random initial values.
    seed : int, default 0
        Seed of the random initial values.
    threads : int, optional
        Number of threads. Default: one per core.

    Returns
    -------
    Tuning
        ``setup`` is the tuned filter, for :func:`estimate` and :func:`monte_carlo`; ``words`` say what it does not model.

    Examples
    --------
    >>> import strapdown as sd
    >>> tuned = sd.tune(record, free=["gyro.arw", "star 1.sigma"])  # doctest: +SKIP
    >>> estimate = sd.estimate(record, setup=tuned.setup)  # doctest: +SKIP
    """
    options = locals()
    given = [sources] if isinstance(sources, (ImuRecord, Recording, str, os.PathLike)) else list(sources)
    result = tuned(**{**options, "sources": given})
    for one in given:
        if isinstance(one, Recording):
            _doubt(one)
    return result.tuning


def tuned(
    sources: Sequence[ImuRecord | Recording],
    *,
    names: Sequence[str] = (),
    setup: FilterSetup | None = None,
    free: Sequence[str] | None = None,
    states: bool | None = None,
    priors: Mapping[str, Prior] | GyroSpec | None = None,
    holdout: float | None = None,
    holdout_by: str = "time",
    threads: int | None = None,
    **options: Any,
) -> Tuned:
    """Return the tuning of :func:`tune` with its objective; ``names``: those of the sources, in messages."""
    from strapdown import tuning

    if not sources:
        raise InputError("sources is empty; give at least one record or recording")
    labels = list(names) or [f"record {k}" if len(sources) > 1 else "" for k in range(len(sources))]
    own, cases = setup is not None, []
    for one, label in zip(sources, labels, strict=True):
        instance("sources", one, (ImuRecord, Recording), SOURCE)
        if isinstance(one, ImuRecord):
            if setup is None:
                if one.origin is None or one.origin.gyro is None:
                    raise InputError(
                        f"{label or 'the record'} does not contain its gyro's specification; give a filter, {Hint('setup')}"
                    )
                setup = setups.FilterSetup.for_record(one, states=states)
            elif own and states:
                if setup.states is not None:
                    raise InputError(f"{Hint('setup')} contains the filter's states; leave {Hint('states')} out")
                added = setups.FilterSetup.for_record(one, states=True).states
                setup, states = dataclasses.replace(setup, states=added), None
            need_angles(setup, one)
            cases.append(tuning.record_case(one, setup, name=label))
        else:
            setup = setup or tuning.recording_setup()
            cases.append(tuning.recording_case(one))
    assert setup is not None
    if not (options.get("truth") or options.get("rmse") or all(isinstance(one, ImuRecord) for one in sources)):
        free, options["spacing"] = tuning.by_innovations(
            free, options.get("spacing", 0.0), gate=options.get("gate"), priors=priors
        )
    train, held = (tuple(cases), ()) if holdout is None else tuning.split(cases, holdout, holdout_by)  # type: ignore[arg-type]
    wanted = [name for name in free or () if name not in tuning.GATED]
    wanted = wanted or list(tuning.default_names([case.record for case in cases]))
    if not own or any(name.startswith(("gyro.", "filter.")) for name in wanted):
        specified = (
            (label, one.origin) for label, one in zip(labels, sources, strict=True) if isinstance(one, ImuRecord)
        )
        tuning.one_gyro(
            {label: origin.gyro for label, origin in specified if origin is not None and origin.gyro is not None}
        )
    if isinstance(priors, GyroSpec):
        by_gyro = tuning.priors_from_gyro(priors, train[0].record)
        priors = {name: prior for name, prior in by_gyro.items() if name in wanted}
    gate = options.pop("gate", False) or any(name in tuning.GATED for name in free or ())
    workers = count("threads", threads if threads is not None else os.cpu_count() or 1)
    return tuning.tune(train, setup, wanted, held=held, priors=priors, gate=gate, threads=workers, **options)


# ---------------------------------------------------------------------------------------------------------------------- Allan


def _samples(
    source: Recording | ImuRecord | GyroSamples | ArrayLike, sample_interval: float | None, sensor: str, kind: str
) -> tuple[ArrayLike, float, str]:
    """Return samples (missing ones as NaN), sample interval and kind."""
    if isinstance(source, (Recording, ImuRecord)):
        source = recordings.samples_of(source, sensor, gaps=True)
    if isinstance(source, recordings.GyroSamples):
        if sample_interval is not None:
            raise InputError("sample_interval goes with an array; a recording has its own: leave it out")
        return source.values, source.sample_interval, source.kind
    if sample_interval is None:
        raise InputError("sample_interval is missing; for an array, give the time between its samples in s")
    return source, sample_interval, kind


def allan_deviation(
    source: Recording | ImuRecord | GyroSamples | ArrayLike,
    sample_interval: float | None = None,
    *,
    sensor: str = "gyro",
    kind: str = "rate",
    taus: ArrayLike | None = None,
    level: float = 0.95,
) -> AllanDeviation:
    """Return the Allan deviation of a sensor at rest, with its confidence band.

    Parameters
    ----------
    source : Recording, ImuRecord, GyroSamples or array_like (n,) or (n, axes)
        Missing samples are NaN (:func:`strapdown.allan.allan_deviation`).
    sample_interval : float, optional
        For an array: time between its samples, s.
    sensor : {"gyro", "accelerometer", "magnetometer"}
        For a recording: the sensor.
    kind : {"rate", "increments"}
        For an array: averages over each sample interval, or integrals.
    taus : array_like, optional
        Averaging times, s. Default: 12 per decade, up to a third of the record.
    level : float, default 0.95
        Confidence of the band.

    Returns
    -------
    AllanDeviation
        Deviation at each averaging time and axis, in the unit of the samples (increments: that unit per s), and its confidence band.

    Examples
    --------
    >>> import numpy as np
    >>> import strapdown as sd
    >>> white = np.random.default_rng(1).standard_normal(100_000)
    >>> found = sd.allan_deviation(white, 0.01, taus=[1.0])
    >>> round(float(found.deviation[0, 0]), 2)  # σ √(dt/τ)
    0.1
    """
    values, interval, what = _samples(source, sample_interval, sensor, kind)
    return allan.allan_deviation(values, interval, kind=what, taus=taus, level=level)


def fit_noise(
    source: Recording | ImuRecord | GyroSamples | ArrayLike,
    sample_interval: float | None = None,
    *,
    sensor: str = "gyro",
    kind: str = "rate",
    terms: Sequence[str] = allan.TERMS,
    highest_frequency: float | None = None,
    level: float = 0.95,
) -> NoiseFit:
    """Return the noise coefficients of a sensor at rest (angle random walk, bias instability, …), with confidence intervals.

    Parameters
    ----------
    source : Recording, ImuRecord, GyroSamples or array_like (n,) or (n, axes)
        Samples at rest; a recording may have gaps.
    sample_interval : float, optional
        For an array: time between its samples, s.
    sensor, kind : str
        As for :func:`allan_deviation`.
    terms : sequence of str
        Terms to fit, by default all (``strapdown.allan.TERMS``).
    highest_frequency : float, optional
        Maximum frequency of the spectrum that is used, Hz, to exclude a low-pass filter or a vibration.
    level : float, default 0.95
        Confidence of the intervals.

    Returns
    -------
    NoiseFit
        Coefficients and intervals; can be passed to :func:`estimate` as ``noise``.

    Examples
    --------
    >>> import strapdown as sd
    >>> noise = sd.fit_noise(sd.read("rest.csv", units={"gyro": "deg/s"}))  # doctest: +SKIP
    >>> estimate = sd.estimate(record, noise=noise)  # doctest: +SKIP
    """
    values, interval, what = _samples(source, sample_interval, sensor, kind)
    options: dict[str, Any] = {"terms": terms, "highest_frequency": highest_frequency, "level": level}
    return allan.fit_noise(values, interval, kind=what, sensor=sensor, **options)
