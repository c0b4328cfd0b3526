"""A filter setup with its sensors as a program; what cannot be exported is refused with the reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from strapdown import coning
from strapdown.ahrs import LiveAhrs
from strapdown.ahrs.live import arrays_of
from strapdown.checks import Array, InputError
from strapdown.codegen.c import identifier
from strapdown.codegen.program import Program, Sensor, Table
from strapdown.codegen.recording import Recording
from strapdown.estimation import forward, initial_state
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import temperature_slopes
from strapdown.estimation.features import refuse
from strapdown.estimation.live import template
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.setup.running import with_sigma
from strapdown.kernels.measurement import KIND_CODES
from strapdown.kernels.structure import MAX_PRECISION_SINGLE, Model
from strapdown.records import ImuRecord
from strapdown.units import ARCSECOND, DEGREE
from strapdown.vectors import VectorMeasurements, VectorSensor, triad

EXPORTED = "the exported filter"


def program_of(setup: FilterSetup, sensors: Sequence[VectorSensor | VectorMeasurements], *, single: bool) -> Program:
    """Return the program of a setup for these sensors."""
    one_sample = setup.integration == coning.ALGORITHMS["one-sample"]
    refuse(
        EXPORTED, estimator=setup.estimator_name != "mekf", robust=setup.robust is not None, integration=not one_sample
    )
    series = _series(setup, sensors)
    kinds: Mapping[str, Any] = {vectors.sensor: vectors.kind for vectors in series}
    error_states = () if setup.states is None else setup.states.blocks(kinds)
    refuse(EXPORTED, temperature=temperature_slopes(error_states) is not None)
    isotropic = not any(vectors.anisotropic for vectors in series)
    model = modelling.assemble(error_states, kinds, isotropic=isotropic)
    refuse(EXPORTED, record=model.of_record)
    noise = setup.process_noise
    variances = noise.angle_random_walk**2, noise.rate_random_walk**2
    numbers = forward.kernel_model(model, variances)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma)
    covariance = modelling.with_error_states(start, error_states).covariance
    program = Program(
        structure=model.structure,
        model=_plain(numbers),
        sensors=tuple(
            _sensor(vectors, int(shape), isotropic=isotropic)
            for vectors, shape in zip(series, model.shape, strict=True)
        ),
        thresholds=None if setup.gate is None else tuple(float(x) for x in setup.gate.thresholds),
        single=single,
        covariance=tuple(map(tuple, covariance.tolist())),
        state_names=tuple(
            f"{block.name} {component} ({unit})"
            for block in error_states
            for component, unit in zip(block.components, block.units, strict=True)
        ),
        offsets=tuple(tuple(float(x) for x in row) for row in model.offsets),
    )
    if single:
        _need_single(setup, program)
    return program


def program_of_live(live: LiveAhrs, *, single: bool) -> Program:
    """Return the program of the filter of an IMU."""
    imu, field, rest, sensors = arrays_of(live)
    program = program_of(live.parameters.setup, sensors, single=single)
    return replace(
        program,
        sensors=tuple(replace(sensor, noise=()) for sensor in program.sensors),
        recording=Recording(parameters=live.parameters, imu=imu, field=field, rest=rest),
    )


def _series(setup: FilterSetup, sensors: Sequence[VectorSensor | VectorMeasurements]) -> tuple[VectorMeasurements, ...]:
    """Return one measurement of each sensor, with the σ of the setup."""
    if not sensors:
        raise InputError("there is no sensor; give the sensors, a record, or a scenario with sensors")
    for sensor in sensors:
        if isinstance(sensor, VectorMeasurements) and len(sensor.time):
            varying = any(np.any(values != values[0]) for values in (sensor.references_f, sensor.covariances))
            refuse(f"{sensor.sensor} varies, but {EXPORTED}", varying=varying)
    series = [template(sensor, 0.0) for sensor in sensors]
    record = ImuRecord(time=np.arange(2.0), increments=np.zeros((1, 3)), vectors=tuple(series))
    identifiers = [identifier(vectors.sensor) for vectors in record.vectors]
    if len(set(identifiers)) < len(identifiers):
        raise InputError(f"two sensors have the same name in code: {', '.join(identifiers)}; rename one")
    return with_sigma(record, setup).vectors


def _sensor(series: VectorMeasurements, shape: int, *, isotropic: bool) -> Sensor:
    """Return a sensor with its numbers in the form of the kernels."""
    reference, sigma = series.references_f[0], float(series.sigma[0])
    if sigma == 0.0:
        raise InputError(f"{series.sensor}: sigma is 0; give the noise of the sensor")
    length = float(np.linalg.norm(reference)) if series.kind == "vector" else 1.0
    covariance = series.covariances[0] / length**2
    attitude = series.kind == "attitude"
    scaled = sigma / length
    noise = (scaled * scaled,) if isotropic else tuple(covariance[np.triu_indices(3)].tolist())
    what = {
        "direction": "a direction; its length is ignored",
        "vector": "a whole vector, in the unit of its reference",
        "heading": "a vector of which only the heading is used",
        "attitude": "an attitude q_fb, scalar first",
    }[series.kind]
    place = "" if attitude else f" Reference in fixed axes: ({', '.join(f'{x:.6g}' for x in reference)})."
    axes = np.sqrt(np.diag(covariance))
    if not attitude or np.allclose(axes, sigma):
        axes = np.array([sigma])
    angle = f" = {_each(axes / DEGREE, 4)} deg" if sigma > 0.1 * DEGREE else f" = {_each(axes / ARCSECOND, 4)} arcsec"
    unit = "" if series.kind == "vector" else f" rad{angle}"
    of = {"heading": " of the heading", "attitude": " about body x, y, z" if len(axes) > 1 else ""}.get(series.kind, "")
    return Sensor(
        name=identifier(series.sensor),
        kind=KIND_CODES[series.kind],
        shape=shape,
        frame=(0.0,) * 9 if attitude else tuple(triad(reference).ravel().tolist()),
        length=length,
        noise=noise,
        variances=tuple(np.diag(covariance).tolist()),
        words=f"Update with {series.sensor}: {what}, body axes.{place} sigma{of} {_each(axes, 6)}{unit}.",
    )


def _each(values: Array, digits: int) -> str:
    """Return one number, or several in brackets."""
    numbers = ", ".join(f"{value:.{digits}g}" for value in values)
    return numbers if len(values) == 1 else f"({numbers})"


def _plain(model: Model) -> Model:
    """Return the numbers of a model as floats of Python, which a program keeps while it is traced."""
    numbers: dict[str, Any] = {
        "numbers": tuple(model.numbers.tolist()),
        "decay": tuple(model.decay.tolist()),
        "last": tuple(model.last.tolist()),
        "chains": Table(model.chains.tolist()),
    }
    return model._replace(**numbers)


def _need_single(setup: FilterSetup, program: Program) -> None:
    """Refuse sensors that are too precise for single precision."""
    for sensor in program.sensors:
        variance = min(sensor.variances)
        ratio = (setup.attitude_sigma**2 + variance) / variance
        if ratio > MAX_PRECISION_SINGLE:
            raise InputError(
                f"{sensor.name}: its sigma is {np.sqrt(ratio):.0f} times smaller than the initial attitude_sigma, and a covariance in "
                "single precision keeps no digits; use double precision, or a smaller attitude_sigma"
            )
