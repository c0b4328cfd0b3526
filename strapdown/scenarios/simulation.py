"""Simulation of a scenario: a record with its truth."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from strapdown import gyro, vectors
from strapdown.checks import Array
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Origin, Truth
from strapdown.scenarios.scenario import Scenario
from strapdown.scenarios.toml import as_scenario


def simulate(scenario: Scenario | str | os.PathLike[str], seed: int | None = None, run: int = 0) -> ImuRecord:
    """Simulate one run of a scenario: gyro increments, vector measurements and the truth.

    Each sensor has its own random stream (seed, run, name), so adding one does not change the others. With sampling jitter, the truth is
    given at the actual sampling instants and the stamps are those that the gyro reports. Lost samples are bridged
    (:func:`strapdown.gyro.bridge_dropped`).

    Parameters
    ----------
    scenario : Scenario, str or path
        A scenario, the name of a built-in one (:data:`SCENARIOS`), or the path of its TOML file.
    seed : int, optional
        Seed of the random numbers. Default: that of the scenario.
    run : int, default 0
        Number of the run; runs with the same seed are independent. Those of a Monte Carlo: :func:`strapdown.montecarlo.replay`.

    Returns
    -------
    ImuRecord
        Record with ``truth``, and with the scenario as ``origin``, to which :func:`strapdown.estimate` matches its filter.

    Examples
    --------
    >>> import strapdown as sd
    >>> record = sd.simulate("two-stars", seed=1)
    >>> record.truth.attitude.shape, [one.sensor for one in record.vectors]
    ((30001, 4), ['star 1', 'star 2'])
    """
    scenario = as_scenario(scenario)
    seed = scenario.seed if seed is None else seed
    spec, nominal = scenario.gyro, scenario.edges
    edges, stamps = gyro.sampling(spec, nominal, generator(seed, run, "gyro sampling"))
    force = None
    if np.any(spec.g_sensitivity != 0.0):
        middle = 0.5 * (edges[1:] + edges[:-1])
        force = vectors.specific_force(scenario.motion, middle, gravity_f=scenario.gravity_f)
    temperature = None if scenario.temperature is None else scenario.temperature._at(edges)
    output = gyro.simulate(
        spec,
        scenario.motion.increments(edges),
        edges,
        generator(seed, run, "gyro"),
        specific_force=force,
        temperature=temperature,
    )
    increments, bias = output.increments, output.bias
    if spec.drop_probability > 0.0:
        lost = generator(seed, run, "gyro losses").random(len(increments)) < spec.drop_probability
        increments, left = gyro.bridge_dropped(increments, stamps, lost)
        edges, stamps, bias = edges[left], stamps[left], bias[left]
        temperature = None if temperature is None else temperature[left]
    series = tuple(
        sensor.observe(scenario.motion, nominal[0], nominal[-1], generator(seed, run, sensor.name))
        for sensor in scenario.sensors
    )
    truth = Truth(attitude=scenario.motion.attitude(edges), bias=bias)
    origin = Origin(gyro=spec, scenario=scenario, seed=seed, run=run)
    return ImuRecord(
        time=stamps, increments=increments, vectors=series, truth=truth, origin=origin, temperature=temperature
    )


def drawn(scenario: Scenario, seed: int, run: int = 0) -> Scenario:
    """Return the scenario with randomly drawn units of its gyro and sensors: each fixed error is multiplied by a standard normal number.

    The fixed errors (scale factor, misalignment, sensitivity to acceleration, hard iron, a sensor's bias, lever arm) are interpreted as
    standard deviations, entry by entry, as in a datasheet. The coefficients of a bias over temperature get additive errors with their σ. A
    filter with a state for each error (``FilterSetup.for_scenario(scenario, states=True)``) is consistent on average over such units, and
    only approximately for a unit whose errors are all equal to one σ.

    Parameters
    ----------
    scenario : Scenario
        Scenario whose fixed errors are standard deviations.
    seed : int
        Seed of the random numbers.
    run : int, default 0
        Number of the unit; units with the same seed are independent.

    Returns
    -------
    Scenario
        Scenario with the drawn errors, without ``gyro_preset``.
    """
    draw = generator(seed, run, "individual")

    def each(errors: Array) -> Array:
        return np.asarray(np.asarray(errors) * draw.standard_normal(np.shape(errors)))

    errors: dict[str, Any] = {name: each(getattr(scenario.gyro, name)) for name in _FIXED_OF_THE_GYRO}
    warm = scenario.gyro.temperature
    if warm is not None:
        errors["temperature"] = dataclasses.replace(warm, coefficients=warm.coefficients + each(warm.sigma))
    spec = dataclasses.replace(scenario.gyro, **errors)
    sensors = []
    for sensor in scenario.sensors:
        own: dict[str, Any] = {name: each(getattr(sensor, name)) for name in _FIXED_OF_SENSORS if hasattr(sensor, name)}
        sensors.append(dataclasses.replace(sensor, **own))  # type: ignore[type-var]
    return dataclasses.replace(scenario, gyro=spec, gyro_preset="", sensors=tuple(sensors))


_FIXED_OF_THE_GYRO = ("scale_factor", "misalignment", "g_sensitivity")
_FIXED_OF_SENSORS = ("hard_iron", "bias", "lever_arm_b")
