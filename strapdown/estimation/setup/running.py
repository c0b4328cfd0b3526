"""The filter of a setup over a record."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from strapdown import estimation, quaternion
from strapdown.checks import Array, InputError, one_of
from strapdown.estimation import Observability, forward
from strapdown.estimation import model as modelling
from strapdown.estimation.angular_acceleration import turning
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.filters.own import Own
from strapdown.estimation.schedule import schedule
from strapdown.estimation.setup.filter_setup import FilterSetup, need_mekf
from strapdown.estimation.setup.states import States
from strapdown.estimation.states import State
from strapdown.randomness import generator
from strapdown.records import Estimate, ImuRecord, compress
from strapdown.vectors import VectorMeasurements

_BIAS = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
"""1 for the bias, 0 for the attitude."""
WHOLE_BIAS: dict[str, Any] = {"whole_bias": True}
"""Options of the filter by which the reported bias includes the drifts."""

MAX_MEMORY = 8e9
"""Maximum memory for the smoother's forward pass, bytes."""


def modelled_record(record: ImuRecord, setup: FilterSetup) -> ImuRecord:
    """Return the record as processed by the filter of this setup: at the rate of its integration algorithm, with the setup's σ."""
    return with_sigma(at_steps(record, setup), setup)


def at_steps(record: ImuRecord, setup: FilterSetup) -> ImuRecord:
    """Return the record at the rate of the setup's integration algorithm."""
    algorithm = setup.integration
    return record if algorithm.samples == 1 and algorithm.name == "one-sample" else compress(record, algorithm)


def with_sigma(record: ImuRecord, setup: FilterSetup) -> ImuRecord:
    """Return the record with the setup's σ."""
    names = [series.sensor for series in record.vectors]
    for name in setup.sigma:
        one_of("sigma: sensor", name, names)
    if setup.measurement_sigma_factor == 1.0 and not setup.sigma:
        return record
    return replace(record, vectors=tuple(_modelled_series(series, setup) for series in record.vectors))


def _modelled_series(series: VectorMeasurements, setup: FilterSetup) -> VectorMeasurements:
    factor = setup.measurement_sigma_factor
    if series.sensor in setup.sigma:
        sigma = setup.sigma[series.sensor]
        if isinstance(sigma, tuple):
            return _by_axis(series, sigma, factor)
        own = float(np.sqrt(np.mean(series.sigma**2))) if len(series.time) else 0.0
        if own == 0.0:
            if series.attitude is not None:
                return replace(series, sigma_axes=np.full(3, factor * sigma))
            return replace(series, sigma=np.full(len(series.time), factor * sigma))
        factor *= sigma / own
    return series if factor == 1.0 else series.noise_scaled(factor)


def _by_axis(series: VectorMeasurements, sigma: tuple[float, float, float], factor: float) -> VectorMeasurements:
    """Return the series with a separate σ about each body axis, whose ratios between samples are those of the series."""
    if series.kind == "heading":
        raise InputError(
            f"sigma: {series.sensor} is {sigma}, three numbers, but a heading has one degree of freedom; give one number"
        )
    m = len(series.time)
    own = float(np.sqrt(np.mean(series.sigma**2))) if m else 0.0
    level = series.sigma / own if own > 0.0 else np.ones(m)
    # sigma is recomputed as the root mean square over the axes.
    return replace(
        series, sigma=np.zeros(m), sigma_axes=factor * level[:, None] * np.asarray(sigma)[None], covariance=None
    )


def run(record: ImuRecord, setup: FilterSetup, initial: State, **options: Any) -> Estimate:
    """Run the filter of a setup over a record.

    Parameters
    ----------
    record : ImuRecord
        Record at the gyro's rate; the setup's integration algorithm and σ are applied.
    setup : FilterSetup
        Setup whose noise, σ, error states, gate and integration algorithm are used.
    initial : State
        State at the first edge.
    **options
        Options of :func:`strapdown.estimation.run`; ``gate`` and ``robust`` replace the setup's. Other estimators than the
        mekf accept only ``every`` and ``full_covariance``.

    Returns
    -------
    Estimate
        Attitude, bias and any ``error_states`` of the setup; if drifts are among them, ``bias`` is the whole bias.
    """
    return run_modelled(modelled_record(record, setup), setup, initial, **options)


def run_modelled(
    record: ImuRecord,
    setup: FilterSetup,
    initial: State,
    *,
    motion: tuple[Array, Array] | None = None,
    **options: Any,
) -> Estimate:
    """Run the filter of a setup over a :func:`modelled_record`, with its :func:`measured_motion` if known."""
    if isinstance(setup.estimator, Own):
        return _run_own(setup.estimator, record, initial, **options)
    judging = {"gate": setup.gate, "robust": setup.robust, **options}
    if setup.states is None:
        return estimation.run(record, setup.process_noise, initial, **judging)
    problem = replace(prepared(record, setup, initial), motion=motion)
    return _reported(
        forward.filtered(problem, forward.Options(**judging, **WHOLE_BIAS)).estimate, setup.states, initial
    )


def measured_motion(record: ImuRecord, setup: FilterSetup) -> tuple[Array, Array] | None:
    """Return what runs of setups that differ in noise have in common on a modelled record: the motion of a lever arm at the measurements.

    None if the setup has no lever arm.
    """
    states = setup.states or States()
    if not any(np.any(sensor.lever_arm_sigma) for sensor in states.sensors.values()):
        return None
    return turning(record, schedule(record.vectors, record.time[0], record.time[-1]).time)


def _run_own(own: Own, record: ImuRecord, initial: State, *, every: int = 1, full_covariance: bool = False) -> Estimate:
    return own(record, initial, times=None if every == 1 else record.time[::every])


def smooth(record: ImuRecord, setup: FilterSetup, initial: State, **options: Any) -> Estimate:
    """Run the fixed-interval smoother of a setup over a record.

    Parameters
    ----------
    record, setup, initial : ImuRecord, FilterSetup, State
        As for :func:`run`.
    **options
        Options of :func:`strapdown.estimation.smooth`.

    Returns
    -------
    Estimate
        Smoothed estimate at the edges of the filter's steps.

    Raises
    ------
    InputError
        If the smoother would need more memory than :data:`MAX_MEMORY`.
    """
    return smooth_modelled(modelled_record(record, setup), setup, initial, **options)


def smooth_modelled(record: ImuRecord, setup: FilterSetup, initial: State, **options: Any) -> Estimate:
    """Run the smoother of a setup over a :func:`modelled_record`."""
    need_mekf(setup, "the smoother")
    judging = {"gate": setup.gate, "robust": setup.robust, **options}
    states = setup.states or States()
    start, blocks = _with_states(record, setup, initial)
    n = 6 + sum(block.size for block in blocks)
    segments = len(record.increments) + sum(len(series.time) for series in record.vectors)
    need = 8 * (n * (n + 1) // 2 + n + 5) * segments
    if states.gyro_drift_sigma:
        need += 8 * n * n * len(record.time)
    if need > MAX_MEMORY:
        raise InputError(
            f"smoothing {len(record.increments)} samples with {n} states needs {need / 1e9:.3g} GB, more than {MAX_MEMORY / 1e9:g}; "
            "cut the record, or do not smooth"
        )
    if not states.gyro_drift_sigma:
        return estimation.smooth(record, setup.process_noise, initial, blocks, **judging)
    full = bool(judging.pop("full_covariance", False))
    smoothed = estimation.smooth(record, setup.process_noise, start, blocks, full_covariance=True, **judging)
    assert smoothed.whole_covariance is not None
    offsets = _offsets(blocks)
    sums = np.eye(6, 6 + offsets.shape[1])
    sums[3:, 6:] = offsets
    covariance = sums @ smoothed.whole_covariance @ sums.T + np.diag(_BIAS * states.gyro_fast_bias_sigma**2)
    return replace(
        smoothed,
        bias=smoothed.bias
        + np.concatenate([block.values for block in smoothed.error_states.values()], axis=1) @ offsets.T,
        variance=np.einsum("kii->ki", covariance).copy(),
        covariance=covariance if full else None,
        whole_covariance=smoothed.whole_covariance if full else None,
    )


def observability(record: ImuRecord, setup: FilterSetup, initial: State) -> Observability:
    """Return the :func:`strapdown.estimation.observability` of each state of this setup's filter on a :func:`modelled_record`."""
    need_mekf(setup, "observability")
    return estimation.observability(record, setup.process_noise, *_with_states(record, setup, initial))


def initial_state(
    setup: FilterSetup, attitude: Array, bias: Array | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> State:
    """Return the initial state of the filter, with the setup's σ.

    Parameters
    ----------
    setup : FilterSetup
        Setup whose initial σ of attitude and bias are used.
    attitude : array_like (4,)
        Initial attitude q_fb.
    bias : array_like (3,), default zero
        Gyro bias, rad/s, body axes.

    Returns
    -------
    State
        Attitude and bias with independent errors of these σ.
    """
    return estimation.initial_state(
        attitude, bias=bias, attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma
    )


def drawn_state(
    setup: FilterSetup,
    record: ImuRecord,
    seed: int,
    run: int = 0,
    *,
    sigmas: tuple[float, float] | None = None,
    fixed_errors: tuple[Array, Array] = (np.zeros(3), np.zeros(3)),
) -> State:
    """Return the true initial state of a record with errors drawn from the setup's σ (or ``sigmas``) and fixed errors added."""
    if record.truth is None:
        raise InputError("record has no truth to start from; simulate one, or give an initial state")
    attitude_sigma, bias_sigma = sigmas or (setup.attitude_sigma, setup.bias_sigma)
    draw = generator(seed, run, "initial error").standard_normal(6)
    turn = quaternion.exp(-attitude_sigma * draw[:3] - fixed_errors[0])
    bias = record.truth.bias[0] - bias_sigma * draw[3:] - fixed_errors[1]
    return initial_state(setup, quaternion.multiply(record.truth.attitude[0], turn), bias)


def state_of_whole_bias(initial: State, error_states: tuple[ErrorStates, ...], fast_bias_sigma: float = 0.0) -> State:
    """Return the initial state of the filter if ``initial`` has the *whole* bias, including the contribution of the error states.

    The error of the whole bias β is that of ``initial``, whatever its parts. The covariance of the bias ``b = β − Σ c e`` follows: a drift
    that is large relative to the σ of the whole bias is strongly correlated with b. The part with a bandwidth above that of the states, of
    σ ``fast_bias_sigma``, is also contained in the initial bias but lasts no longer than a sample: its variance is added to that of b.
    """
    if len(initial.values):
        return initial
    fast = np.diag(_BIAS * fast_bias_sigma**2)
    plain = modelling.with_error_states(replace(initial, covariance=initial.covariance + fast), error_states)
    turn = np.eye(len(plain.covariance))
    turn[3:6, 6:] = -_offsets(error_states)
    sigma = np.sqrt(np.diag(plain.covariance))
    root = (turn @ (sigma[:, None] * np.linalg.cholesky(plain.covariance / np.outer(sigma, sigma)))).T
    return replace(plain, covariance=root.T @ root)


def _offsets(error_states: tuple[ErrorStates, ...]) -> Array:
    """Return the contribution of a unit of each error state to the gyro's bias (3, m)."""
    return np.concatenate([np.empty((3, 0)), *(np.asarray(block.gyro_offset).T for block in error_states)], axis=1)


def _with_states(record: ImuRecord, setup: FilterSetup, initial: State) -> tuple[State, tuple[ErrorStates, ...]]:
    """Return the initial state with the setup's error states, and their declarations; ``initial`` has the whole bias."""
    if setup.states is None:
        return initial, ()
    blocks = setup.states.blocks({series.sensor: series.kind for series in record.vectors})
    return state_of_whole_bias(initial, blocks, setup.states.gyro_fast_bias_sigma), blocks


def prepared(record: ImuRecord, setup: FilterSetup, initial: State) -> forward.Problem:
    """Return a :func:`modelled_record` prepared for the filter with the setup's error states."""
    return forward.prepared(record, setup.process_noise, *_with_states(record, setup, initial))


def _reported(estimate: Estimate, states: States, initial: State) -> Estimate:
    """Return an estimate of the whole bias whose variance includes the part with a bandwidth above that of the states."""
    fast = np.outer(np.ones(len(estimate.time)), _BIAS * states.gyro_fast_bias_sigma**2)
    if not len(initial.values):
        fast[0] *= -1.0  # the initial bias contains this part, so its error does not
    P = estimate.covariance
    return replace(
        estimate, variance=estimate.variance + fast, covariance=None if P is None else P + fast[:, :, None] * np.eye(6)
    )
