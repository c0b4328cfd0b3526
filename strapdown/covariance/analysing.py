"""The pass along the true trajectory that gives the predicted errors."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Sequence

import numpy as np

from strapdown import scenarios
from strapdown.checks import Array, half_turn, non_negative
from strapdown.covariance.consider import Consider, check_considered, checked_size
from strapdown.covariance.deterministic_errors import (
    MIN_ERROR,
    DeterministicError,
    considered_errors,
    fixed_errors,
    sizes_of,
)
from strapdown.covariance.random_errors import RandomSources, diagonal, random_sources
from strapdown.covariance.result import LARGEST_LINEAR, Analysis
from strapdown.covariance.trajectory import Trajectory, noise_of, trajectory_of, unit_of
from strapdown.estimation import forward
from strapdown.estimation.schedule import Schedule
from strapdown.estimation.setup import FilterSetup, need_setup, specified_errors, unmodelled_errors
from strapdown.kernels import analysis
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.measurement import Measurements
from strapdown.kernels.walk import walk
from strapdown.records import Origin
from strapdown.scenarios import Scenario
from strapdown.units import DEGREE

SHIFT = 1e-4
"""Shift of a measurement for the derivative of its residuals by the noise, relative to the reference. They are linear to 1e-8, those of
vectors without error."""


def analyse(
    scenario: Scenario | str | os.PathLike[str],
    setup: FilterSetup | None = None,
    *,
    consider: Consider | None = None,
    initial_attitude_sigma: float | None = None,
    initial_bias_sigma: float | None = None,
    epochs: int = 100,
) -> Analysis:
    """Predict the errors of a filter on a scenario, in one pass without noise samples.

    Parameters
    ----------
    scenario : Scenario, str or path
        See :func:`strapdown.scenarios.simulate`.
    setup : FilterSetup, optional
        Filter to analyse, with its error states. Default: matched to the scenario
        (:meth:`strapdown.estimation.setup.FilterSetup.for_scenario`).
    consider : Consider, optional
        Errors in addition to those of the scenario.
    initial_attitude_sigma, initial_bias_sigma : float, optional
        Actual standard deviations of the initial errors, each axis, rad and rad/s. Default: those of the setup.
    epochs : int, default 100
        Number of intervals between the epochs of the result; they end at filter steps, as in :func:`strapdown.montecarlo.run`.

    Returns
    -------
    Analysis
        Covariance reported by the filter, and that of the actual error by source, at every epoch.

    Raises
    ------
    InputError
        If a considered sensor is not in the scenario, a considered time offset exceeds the scenario's duration, or a sensor has a
        user-defined class or no noise.

    References
    ----------
    A. Gelb (ed.), Applied Optimal Estimation, 1974, chapter 7 (suboptimal filters and sensitivity analysis).

    Examples
    --------
    >>> import strapdown as sd
    >>> analysis = sd.covariance_analysis("two-stars")  # doctest: +SKIP
    >>> print(analysis)  # doctest: +SKIP
    """
    scenario = scenarios.as_scenario(scenario)
    setup = FilterSetup.for_scenario(scenario) if setup is None else setup
    consider = Consider() if consider is None else consider
    need_setup(setup)
    check_considered(scenario, consider)
    attitude_sigma = setup.attitude_sigma if initial_attitude_sigma is None else initial_attitude_sigma
    bias_sigma = setup.bias_sigma if initial_bias_sigma is None else initial_bias_sigma
    half_turn("initial_attitude_sigma", non_negative("initial_attitude_sigma", attitude_sigma, unit="rad"))
    checked_size("initial_bias_sigma", bias_sigma, unit="rad/s")
    path = trajectory_of(scenario, setup, epochs)
    fixed = fixed_errors(scenario, setup, path)
    considered = considered_errors(scenario, consider, path)
    columns = [*fixed, *considered]
    random = random_sources(scenario, attitude_sigma, bias_sigma)
    out = _propagated(scenario, path, random, columns, len(fixed))
    origin = Origin(gyro=scenario.gyro, scenario=scenario)
    sizes = sizes_of(path, columns, out.residual)
    real = [k for k, column in enumerate(fixed) if column.sensor < 0 or sizes[k] > MIN_ERROR]
    analysis = Analysis(
        time=scenario.edges[path.kept],
        filter_covariance=out.P[:, 0] + _fast_bias(setup, len(out.P)),
        sources=tuple(random.names),
        contributions=out.P[:, 1:],
        fixed=tuple(fixed[k].name for k in real),
        fixed_errors=out.columns[:, real],
        considered=tuple(column.name for column in considered),
        considered_errors=out.columns[:, len(fixed) :],
        expected_nis={
            sensor.name: float(total / degrees)
            for sensor, (total, degrees) in zip(scenario.sensors, out.nis, strict=True)
            if degrees > 0.0
        },
        drawn=tuple(fixed[k].name for k in real if fixed[k].drawn)
        if setup.states is not None and setup.states.has_constants
        else (),
        unmodelled=unmodelled_errors(origin, setup),
        left_out=_left_out(origin, setup),
        beyond_linear=(),
    )
    return dataclasses.replace(analysis, beyond_linear=_beyond_linear(analysis, columns, sizes))


def _fast_bias(setup: FilterSetup, epochs: int) -> Array:
    """Return the covariance (epochs, 6, 6) of the part of the bias that changes too fast for a state of the filter."""
    fast = np.zeros((epochs, 6, 6))
    if setup.states is not None:
        fast[:] = diagonal(0.0, setup.states.gyro_fast_bias_sigma)
        fast[0] *= -1.0  # the initial bias contains this part, so its error does not
    return fast


def _propagated(
    scenario: Scenario, path: Trajectory, random: RandomSources, columns: list[DeterministicError], fixed: int
) -> analysis.Outputs:
    """Propagate the covariance of each random source and each deterministic error through the filter's gains."""
    problem, events, kept = path.problem, path.events, len(path.kept)
    n, sources = problem.model.structure.n, len(random.names)
    body = forward.filter_body(problem, forward.unit_sigmas(problem.record, problem.model, {}))
    W = body.P.shape[1] // n
    contributions = np.zeros((sources, n, W))
    contributions[:, :6, :6] = random.initial
    # Their arrays must outlive the kernel, which reads them by their addresses.
    shifted = [path.shifted(axis, shift) for axis, shift in itertools.product(range(3), (SHIFT, -SHIFT))]
    out = analysis.Outputs(
        stations=np.searchsorted(path.stamps, scenario.edges[path.kept]),
        P=np.empty((kept, 1 + sources, 6, 6)),
        columns=np.empty((kept, len(columns), 6)),
        residual=np.zeros((len(events.time), 3)),
        nis=np.zeros((len(scenario.sensors), 2)),
    )
    compiled(walk, forward.instance_of(problem.model, analysis))(
        *problem.gyro,
        _measurements(events),
        1,
        analysis.Body(
            filter=body,
            quiet=body.model._replace(angle_variance=0.0, rate_variance=0.0, chains=body.model.chains * [1.0, 0.0]),
            coefficients=np.zeros_like(body.coefficients),
            sources=analysis.Sources(np.array(random.angle), np.array(random.rate), contributions.reshape(sources, -1)),
            rates=random.coloured_rates(n),
            noises=random.sensor_noises(n, path.stamps[0]),
            columns=_for_kernel(path, columns, fixed, n),
            truth=path.attitude,
            begins_sample=np.concatenate([[False], np.diff(path.interval) > 0, [False]]),
            shifted=tuple(map(_measurements, shifted)),
            shift=SHIFT,
            noise=path.of_events(noise_of).reshape(-1, 6),
            unit=path.of_events(unit_of),
            x=np.zeros(n + 1),
            top=np.zeros(3 * W),
            weights=np.zeros((2, 3, 3)),
            product=np.zeros(n),
            error=np.zeros(n),
        ),
        out,
    )
    return out


def _for_kernel(path: Trajectory, columns: Sequence[DeterministicError], fixed: int, n: int) -> analysis.Columns:
    """Return the deterministic errors for the kernel, for n states."""
    rates = {k: column.rate for k, column in enumerate(columns) if column.rate is not None}
    place, rate = np.full(len(columns), -1), np.zeros((len(path.dt), len(rates), 3))
    for r, (k, values) in enumerate(rates.items()):
        place[k], rate[:, r] = r, values
    turn, offset = np.zeros((2, len(path.events.time), len(columns), 3))
    for k, column in enumerate(columns):
        turn[:, k] = 0.0 if column.turn is None else column.turn
        offset[:, k] = 0.0 if column.offset is None else column.offset
    return analysis.Columns(
        rate=rate,
        place=place,
        ramp=np.array([column.ramp for column in columns]).reshape(-1, 3),
        turn=turn,
        offset=offset,
        sensor=np.array([column.sensor for column in columns], np.int64),
        fixed=fixed,
        value=np.zeros((len(columns), n)),
    )


def _measurements(events: Schedule) -> Measurements:
    """Return measurements as the kernels' argument, with a covariance for each."""
    noise = np.empty((len(events.time), 6))
    noise[events.row] = events.body_noise
    return events.measurements._replace(noise=read_only(noise))


def _left_out(origin: Origin, setup: FilterSetup) -> tuple[str, ...]:
    """Return the errors of a scenario, and the parts of a filter, that the analysis does not include."""
    terms = [error.words for error in specified_errors(origin) if not error.analysed]
    if setup.states is not None and np.any(setup.states.gyro_temperature_sigma):
        terms.append("states for the gyro bias over temperature")
    terms += [name for name in ("gate", "robust") if getattr(setup, name, None) is not None]
    return tuple(terms)


def _beyond_linear(analysis: Analysis, columns: list[DeterministicError], sizes: Sequence[float]) -> tuple[str, ...]:
    """Return the errors that are too large for the analysis, in words; ``sizes``: the largest error of a sensor by column, rad."""
    largest: dict[str, float] = {}
    for column, size in zip(columns, sizes, strict=True):
        name = column.name.partition(",")[0]  # the largest over the axes of a considered error
        largest[name] = max(largest.get(name, 0.0), size)
    terms = [f"{name}, up to {size / DEGREE:.3g}°" for name, size in largest.items() if size > LARGEST_LINEAR]
    attitude = analysis.rms[:, :3].max(axis=1)
    if (error := attitude.max()) > LARGEST_LINEAR:
        time = analysis.time[np.argmax(attitude)]
        terms.append(f"the attitude error itself, {error / DEGREE:.3g}° at {time:.6g} s")
    return tuple(terms)
