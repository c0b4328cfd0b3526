"""Estimation of a record or a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import ahrs, quaternion, records, units
from strapdown.ahrs.remarks import fixed_frame, remarks, warn
from strapdown.checks import Hint, InputError, are_finite, array, count, instance
from strapdown.estimation import setup as setups
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import FilterSetup, for_record
from strapdown.estimation.states import ProcessNoise, State
from strapdown.gyro import GyroSpec
from strapdown.recordings import Recording
from strapdown.records import Estimate, ImuRecord, Origin, Truth
from strapdown.workflows.filters import filter_for_record, specification_of, with_gyro_noise

if TYPE_CHECKING:
    from strapdown.allan import NoiseFit
    from strapdown.calibration import UnitCalibration
    from strapdown.gyro.temperature import BiasOverTemperature

SOURCE = "give an ImuRecord or a Recording, as simulate and read return them"


class Run(NamedTuple):
    """An estimate with what it was made from."""

    estimate: Estimate
    record: ImuRecord
    """Input of the filter, from its start on (:func:`strapdown.estimation.setup.modelled_record`)."""
    setup: FilterSetup
    """The filter without gate and weights."""
    initial: State
    recorded: ahrs.AhrsEstimate | None = None
    """Result for a recording."""


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
) -> Estimate:
    """Estimate attitude and gyro bias with a multiplicative extended Kalman filter, as the command ``strapdown estimate`` does.

    For a simulated record, the filter matches the scenario and is initialised from the first measurements. For a recording, the
    accelerometer gives the vertical and the magnetometer the heading (:mod:`strapdown.ahrs`), from the first sample on.

    Parameters
    ----------
    source : ImuRecord or Recording
        Result of :func:`simulate` or :func:`read`, or a record made from your own data.
    noise : GyroSpec, NoiseFit or ProcessNoise, optional
        Noise of the gyro: a specification, an Allan fit (:func:`strapdown.fit_noise`), or the two coefficients of the filter. Default:
        that of the record's origin; for a recording that of :data:`strapdown.ahrs.MOTIONS`.
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
        For a recording: model of the motion. ``"hand"``, the default: bounded velocity, as of a hand, a person or a small aircraft
        in a room; ``"vehicle"``: acceleration that lasts for seconds, also of a drone outdoors; ``"vessel"``: bounded position, as on
        waves; ``"any"``: white noise.
    latency : float, optional
        For a recording: delay of the gyro's samples, s. Default: half a sample interval.
    calibration : UnitCalibration, optional
        For a recording: calibration of the unit, from :func:`strapdown.calibrate`; the bias is then that of the corrected rates.
    temperature : BiasOverTemperature, optional
        For a recording: the gyro's bias over temperature (°C), which is subtracted first. Default: that of ``noise``.
    full_covariance : bool, optional
        Whether to store covariance matrices rather than their diagonals. Default: True, but for a recording without a reference attitude.

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
    strapdown.ahrs.ConventionWarning
        If units, axes or signs of a recording seem wrong.
    strapdown.ahrs.MotionWarning
        If the model of the motion does not suit a recording.

    Examples
    --------
    >>> import strapdown as sd
    >>> estimate = sd.estimate(sd.simulate("two-stars"))  # doctest: +SKIP
    >>> estimate.attitude[-1], estimate.sigma[-1]  # doctest: +SKIP
    """
    options = locals()
    doubtful = isinstance(source, Recording) and ahrs.check_conventions.warn(source)
    result = run(**options)
    if result.recorded is not None and not doubtful:  # wrong axes are the cause then
        warn(result.recorded, result.estimate.motion)
    return result.estimate


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

    Errors and warnings are those of :func:`estimate`; a record may also be too long for the memory.

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

    References
    ----------
    H. E. Rauch, F. Tung, C. T. Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965.

    Examples
    --------
    >>> import strapdown as sd
    >>> sd.smooth(sd.simulate("two-stars", seed=1)).attitude.shape  # doctest: +SKIP
    (30001, 4)
    """
    options = locals()
    doubtful = isinstance(source, Recording) and ahrs.check_conventions.warn(source)
    result = run(**options, smooth=True)
    if result.recorded is not None and not doubtful:  # wrong axes are the cause then
        warn(result.recorded, result.estimate.motion)
    return result.estimate


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
    of_records, of_recordings = (
        ["setup", "initial", "states", "every"],
        ["motion", "latency", "calibration", "temperature"],
    )
    for name in of_records if recorded else of_recordings:
        value = options.pop(name, None)
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
    filter_setup, notes = filter_for_record(record, noise, setup, initial, states, changes)
    modelled = setups.modelled_record(record, filter_setup)
    if initial is None:
        begin = for_record.start(modelled, filter_setup)
    elif isinstance(initial, str) and initial == "truth":
        begin = for_record.drawn_start(record, filter_setup)
    elif isinstance(initial, State):
        begin = for_record.Start(initial, "Started from the state given.")
    else:
        q = array("initial", initial, (4,))  # type: ignore[arg-type]
        if not q.any():
            raise InputError("initial is the zero quaternion; give w, x, y, z of an attitude")
        state = setups.initial_state(filter_setup, quaternion.normalize(q))
        begin = for_record.Start(state, "Started from the attitude given.")
    steps = len(modelled.increments) - begin.edge
    if every > steps:
        raise InputError(
            f"every is {every}, more than the {steps} filter steps from the start; only the first epoch would be kept"
        )
    if begin.edge > 0:
        modelled = records.cut(modelled, begin.edge, len(modelled.increments))
    full = full_covariance is not False
    if smooth:
        result = setups.smooth_modelled(modelled, filter_setup, begin.state, full_covariance=full)
    else:
        result = setups.run_modelled(modelled, filter_setup, begin.state, every=every, full_covariance=full)
    truth = None if modelled.truth is None else modelled.truth.taken(np.searchsorted(modelled.time, result.time))
    result = dataclasses.replace(
        result, setup=filter_setup, origin=record.origin, truth=truth, smoothed=smooth, remarks=(begin.words, *notes)
    )
    return Run(result, modelled, filter_setup, begin.state)


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
        spec = specification_of(noise)
        parameters, temperature = with_gyro_noise(parameters, spec), temperature or spec.temperature
        arw = parameters.angle_random_walk / units.DEGREE_PER_ROOT_HOUR
        rrw = parameters.rate_random_walk / units.DEGREE_PER_HOUR_PER_ROOT_HOUR
        notes = [f"Gyro noise, flicker included: {arw:.3g} °/√h, bias random walk {rrw:.3g} °/h/√h."]
    if temperature is not None:
        source, parameters = ahrs.without_temperature(source, parameters, temperature, walks=walks or smooth)
    reference, movement = source.true_attitude, source.movement
    if reference is not None and movement is not None and not movement[are_finite(reference)].any():
        raise InputError(
            f"{source.source}: no sample to judge has a reference attitude; check its movement mask and its reference"
        )
    full = reference is not None if full_covariance is None else full_covariance
    result = ahrs.estimate(source, parameters, gate=gate, robust=robust, full_covariance=full, smooth=smooth, **options)
    used, parameters = result.recording, result.parameters
    if reference is not None and used.magnetic_field is None:
        notes.append("The reference is turned about the vertical to the estimate's heading at its first sample.")
    estimate = dataclasses.replace(
        result.estimate,
        setup=dataclasses.replace(parameters.setup, gate=gate, robust=robust),
        origin=Origin(source=used.source, epoch_ns=used.epoch_ns),
        truth=None if used.true_attitude is None else reference_of(used, slice(None), result.estimate),
        fixed_frame=fixed_frame(used),
        motion=motion,
        remarks=(*remarks(result, motion), *notes),
        details={
            **{f"parameter.{field.name}": getattr(parameters, field.name) for field in dataclasses.fields(parameters)},
            "latency": result.delays.gyro,
            "magnetometer_latency": result.delays.last_field,
        },
    )
    return Run(estimate, result.record, parameters.setup, result.initial, result)


def reference_of(recording: Recording, rows: Any, result: Estimate) -> Truth:
    """Return the reference at some rows of a recording, those of its estimate.

    Without a magnetometer the heading of the estimate is arbitrary, and the reference is turned to it at its first known attitude.
    """
    assert recording.true_attitude is not None
    truth = Truth(attitude=recording.true_attitude, movement=recording.movement).taken(rows)
    (known,) = np.nonzero(truth.known)
    if recording.magnetic_field is None and len(known):
        attitude = truth.attitude.copy()
        w, _, _, z = quaternion.multiply(result.attitude[known[0]], quaternion.conjugate(attitude[known[0]]))
        attitude[known] = quaternion.multiply(quaternion.normalize([w, 0.0, 0.0, z]), attitude[known])
        truth = dataclasses.replace(truth, attitude=attitude)
    return truth
