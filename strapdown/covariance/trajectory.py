"""The true trajectory of a scenario, divided at every gyro edge and measurement, and the filter along it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from strapdown import quaternion, scenarios, vectors
from strapdown.checks import Array, InputError, count
from strapdown.estimation.forward import Problem
from strapdown.estimation.model import assemble
from strapdown.estimation.schedule import Schedule
from strapdown.estimation.setup import (
    FilterSetup,
    initial_state,
    measured_motion,
    modelled_record,
    need_mekf,
    prepared,
    with_sigma,
)
from strapdown.randomness import generator
from strapdown.records import ImuRecord
from strapdown.scenarios import Scenario
from strapdown.vectors import VectorMeasurements
from strapdown.vectors.sensor import Sampled


class Trajectory(NamedTuple):
    """The true trajectory, divided at every gyro edge and measurement, and the filter along it."""

    scenario: Scenario
    problem: Problem
    """The filter over the true rotations between the divisions, with measurements without noise."""
    attitude: Array
    """At the divisions (n + 1, 4)."""
    interval: np.ndarray
    """Gyro interval of each segment between them (n,)."""
    kept: np.ndarray
    """Gyro edges at the epochs."""
    own: tuple[VectorMeasurements, ...]
    """The measurements, without noise, with the σ of their sensors."""

    @property
    def stamps(self) -> Array:
        """Times of the divisions (n + 1,), s."""
        return self.problem.record.time

    @property
    def dt(self) -> Array:
        """Durations of the segments (n,), s."""
        return self.problem.record.intervals

    @property
    def phi(self) -> Array:
        """True rotation vectors over the segments (n, 3), rad."""
        return self.problem.record.increments

    @property
    def events(self) -> Schedule:
        """The measurements in order of time."""
        return self.problem.events

    def shifted(self, axis: int, shift: float) -> Schedule:
        """Return the measurements shifted along an axis of their noise: that of a heading pair is in fixed axes, in its reference."""
        events, along = self.events, shift * np.eye(3)[axis]
        values, triads = list(events.series_vector_b), events.triads.copy()
        for i, (kind, sensor) in enumerate(zip(events.kinds, self.scenario.sensors, strict=True)):
            first, moves = events.frames[i]
            rows = slice(first, first + (len(events.series_time[i]) if moves else 1))
            if kind == "attitude":
                triads[rows, :4] = quaternion.multiply(triads[rows, :4], quaternion.exp(along))
            elif isinstance(sensor, vectors.HeadingPair):
                triads[rows, 6:8] += along[:2]
            else:
                values[i] = values[i] + along
        return dataclasses.replace(events, series_vector_b=tuple(values), triads=triads)

    def of_events(self, of: Callable[[VectorMeasurements, Any], Array]) -> Array:
        """Return a number or vector of the measurements of each sensor (m, …) in order of time (events, …)."""
        events = self.events
        columns = [of(series, sensor) for series, sensor in zip(self.own, self.scenario.sensors, strict=True)]
        out = np.empty((len(events.time), *columns[0].shape[1:]) if columns else 0)
        for i, (series, column) in enumerate(zip(self.own, columns, strict=True)):
            mine = events.sensor == i
            out[mine] = column[np.searchsorted(series.time, events.time[mine])]
        return out


def _observed(scenario: Scenario) -> list[VectorMeasurements]:
    """Return the measurements of each sensor without noise, with the σ of the sensor."""
    start, end = scenario.edges[0], scenario.edges[-1]
    observed = []
    for sensor in scenario.sensors:
        if not isinstance(sensor, Sampled):
            raise InputError(
                f"{sensor.name} is a {type(sensor).__name__}, whose noise the analysis does not support; remove it"
            )
        # The same seed for both, so that the same samples are lost.
        own, exact = (
            source.observe(scenario.motion, start, end, generator(scenario.seed, 0, sensor.name))
            for source in (sensor, vectors.without_noise(sensor))
        )
        observed.append(
            dataclasses.replace(own, vector_b=exact.vector_b, attitude=exact.attitude, reference_f=exact.reference_f)
        )
    return observed


def _length(series: VectorMeasurements) -> Array:
    """Return the length (m,) by which the measurements of a series are divided: that of the reference of whole vectors."""
    return np.linalg.norm(series.references_f, axis=1) if series.kind == "vector" else np.ones(len(series.time))


def unit_of(series: VectorMeasurements, sensor: Any) -> Array:
    """Return a unit of the sensor along the axes of the noise of each measurement (m,)."""
    sigma = 0.0 if series.attitude is not None else sensor.sigma
    unit = np.ones(len(series.time))
    return np.divide(series.sigma / _length(series), sigma, out=unit, where=sigma > 0.0)


def noise_of(series: VectorMeasurements, sensor: Any) -> Array:
    """Return the covariance of the white noise of each measurement (m, 6) along its axes, with that of outliers."""
    faults = sensor.faults
    more = 1.0 - faults.outlier_probability + faults.outlier_probability * faults.outlier_scale**2
    whole = series.covariances * (more / _length(series) ** 2)[:, None, None]
    return np.asarray(whole[:, *np.triu_indices(3)])


def trajectory_of(scenario: Scenario, setup: FilterSetup, epochs: int) -> Trajectory:
    """Return the trajectory of a scenario with the filter of a setup along it."""
    need_mekf(setup, "the covariance analysis")
    samples = setup.integration.samples
    steps = (len(scenario.edges) - 1) // samples
    if steps < count("epochs", epochs):
        raise InputError(f"{steps} filter steps are fewer than {epochs} epochs; use fewer epochs, or a longer scenario")
    edges = scenario.edges[: steps * samples + 1]  # like the filter, without an incomplete last step
    own = _observed(scenario)
    times = np.concatenate([np.empty(0), *(series.time for series in own)])
    stamps = np.union1d(edges, times[(times >= edges[0]) & (times <= edges[-1])])
    attitude = scenario.motion.attitude(stamps)
    phi = quaternion.rotation_between(attitude[:-1], attitude[1:])
    record = with_sigma(ImuRecord(time=stamps, increments=phi, vectors=tuple(own)), setup)
    for series in record.vectors:
        if not np.all(series.sigma > 0.0):
            raise InputError(
                f"{series.sensor}: sigma is 0; a filter needs a noise greater than zero: give the sensor one, or [filter.sigma]"
            )
    if setup.states is not None:  # states for a bias over temperature are left out
        setup = dataclasses.replace(setup, states=dataclasses.replace(setup.states, gyro_temperature_sigma=0.0))
    problem = prepared(record, setup, initial_state(setup, attitude[0]))
    kinds = dict(zip(problem.events.sensors, problem.events.kinds, strict=True))
    # With a covariance for each measurement.
    problem = dataclasses.replace(problem, model=assemble(problem.error_states, kinds, isotropic=False))
    if problem.model.levers.any():
        # The angular acceleration is that of a run: how much it is smoothed depends on the gyro's noise.
        # Errors of the time stamps are left out.
        gyro = dataclasses.replace(
            scenario.gyro, timestamp_offset=0.0, timestamp_error=0.0, sampling_jitter=0.0, drop_probability=0.0
        )
        on_time = scenarios.simulate(dataclasses.replace(scenario, gyro=gyro))
        motion = measured_motion(modelled_record(on_time, setup), setup)
        problem = dataclasses.replace(problem, motion=motion)
    every = steps // epochs * samples
    return Trajectory(
        scenario=scenario,
        problem=problem,
        own=tuple(own),
        attitude=attitude,
        interval=np.clip(np.searchsorted(edges, stamps[:-1], side="right") - 1, 0, len(edges) - 2),
        kept=np.arange(0, steps * samples + 1, every),
    )
