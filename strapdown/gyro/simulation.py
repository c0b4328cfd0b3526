"""Simulation of a gyro: from the true rotation to the output of a rate gyro.

Rate: ``w_meas = (I + M) w_b + b + n``, with ``n`` white noise of PSD σ_v² (angle random walk) and b a sum of drifts. Increment: the
integral of the rate over each sample interval. An increment divided by its interval is the averaged-rate sample (:attr:`GyroOutput.rates`).
All noise is exact in discrete time, for any interval.

Power spectral densities are two-sided, as in IEEE Std 952: ARW σ_v², flicker B²/(2π f), rate random walk σ_u²/(2π f)².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, array, increasing
from strapdown.gyro import flicker
from strapdown.gyro.model import Axes, GyroSpec
from strapdown.kernels import gyro_errors, noise
from strapdown.kernels.machine import compiled, read_only


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroOutput:
    """Output of the gyro and its true bias.

    Parameters
    ----------
    increments : ndarray (n, 3)
        Measured rotation increments, rad, body axes.
    bias : ndarray (n + 1, 3)
        True bias at the edges, rad/s, body axes: turn-on bias and all drifts, before any low-pass filter and without the effect of
        acceleration. Flicker has no value at an instant; its mean over the two intervals at the edge is used.
    edges : ndarray (n + 1,)
        Edges of the intervals, s.
    """

    increments: Array
    bias: Array
    edges: Array

    @property
    def rates(self) -> Array:
        """Averaged rates (n, 3), rad/s: the rate output."""
        return np.asarray(self.increments / np.diff(self.edges)[:, None])


BEFORE_RANGE = ("turn_on_bias", "scale_factor", "asymmetry", "misalignment", "bandwidth", "damping")
"""Errors that are the same in every run and act before the range limits the rate."""
_INITIAL, _LOW_PASS = 4, 5  # stream numbers above those of gyro_errors
_STREAMS = 8  # stream numbers reserved for an axis
_UNEVEN = 0.1  # maximum relative deviation of an interval from the mean interval with flicker or low-pass filter


def simulate(
    spec: GyroSpec,
    true_increments: ArrayLike,
    edges: ArrayLike,
    generator: np.random.Generator,
    *,
    specific_force: ArrayLike | None = None,
    temperature: ArrayLike | None = None,
) -> GyroOutput:
    """Return the increments that the gyro measures, and its bias.

    Parameters
    ----------
    spec : GyroSpec
        Specification of the gyro.
    true_increments : array_like (n, 3)
        Exact integrals of the body rate over each interval, rad, body axes.
    edges : array_like (n + 1,)
        Edges of the sample intervals, s. With flicker or a low-pass filter, which use the mean interval, uniform within 10 %.
    generator : numpy.random.Generator
        Seeds the random streams: two words are drawn from it, and each noise term of each axis has a separate stream seeded by them.
    specific_force : array_like (n, 3), optional
        Mean specific force over each interval, m/s², body axes; required if the specification has a g-sensitivity.
    temperature : array_like (n + 1,), optional
        Temperature at the edges, °C; required if the specification has a bias over temperature.

    Returns
    -------
    GyroOutput
        Measured increments and true bias.

    Notes
    -----
    Over an interval dt the bias walks by σ_u √dt n₁; its integral, given both ends, is ½ (b_k + b_{k+1}) dt plus a Gaussian of
    variance σ_u² dt³/12 (the Brownian bridge), and the integral of the white noise has variance σ_v² dt. An increment is therefore
    ``(I + M) Δθ + ½ (b_k + b_{k+1}) dt + √(σ_v² dt + σ_u² dt³/12) n₂``, exact for any dt. A Gauss–Markov bias has an exact step and
    bridge, too (:func:`strapdown.kernels.gyro_errors.markov_step`). Low-pass filter, saturation and rounding are applied last.
    """
    stamps = increasing("edges", edges, minimum=2)
    exact = np.ascontiguousarray(array("true_increments", true_increments, (len(stamps) - 1, 3)))
    n = len(exact)
    key = generator.integers(0, 2**64, size=2, dtype=np.uint64)
    low_passed = bool(np.isfinite(spec.bandwidth))
    if np.any(np.asarray(spec.bias_instability) > 0.0) or low_passed:
        _need_uniform(stamps)
    streams, initial = np.empty((3, _STREAMS, 2, 4), np.uint64), np.empty((3, 64))
    for axis, term in np.ndindex(3, _STREAMS):
        compiled(noise.seed_stream)(key[0], key[1], np.uint64(_STREAMS * axis + term), streams[axis, term])
    for axis in range(3):
        compiled(noise.fill_normals)(streams[axis, _INITIAL], np.empty((2, 32), np.uint64), initial[axis])
    increments, bias = np.empty((n, 3)), np.empty((n + 1, 3))
    draws = gyro_errors.Draws(
        streams, np.empty((2, gyro_errors.BLOCK // 2), np.uint64), np.zeros((4, gyro_errors.BLOCK))
    )
    errors = _errors(spec, initial, n, low_passed)
    compiled(gyro_errors.drift_and_noise)(read_only(stamps), read_only(exact), *errors, draws, increments, bias)
    _add_environment(spec, stamps, specific_force, temperature, increments, bias)
    if low_passed:
        own = draws._replace(streams=np.ascontiguousarray(streams[:, _LOW_PASS:]))
        increments = _low_pass(spec, increments, (stamps[-1] - stamps[0]) / n, initial, own)
    rounded = [np.any(np.asarray(value) > 0.0) for value in (spec.quantization, spec.rate_resolution)]
    if np.isfinite(spec.range) or any(rounded):
        step = _axes(spec.quantization_step)
        carried = step * (generator.random(3) - 0.5)
        compiled(gyro_errors.digitize)(
            stamps, np.full(3, spec.range), step, _axes(spec.rate_resolution), carried, increments
        )
    return GyroOutput(increments=increments, bias=bias, edges=stamps)


def _errors(
    spec: GyroSpec, initial: Array, samples: int, low_passed: bool
) -> tuple[gyro_errors.Errors, gyro_errors.Drift]:
    """Return the errors of a gyro and the initial state of its drift from normals (3, 64); with a low-pass, that adds the white noise."""
    shaping = flicker.shaping(samples)
    tau = spec.markov_correlation_time
    q, instability = _axes(spec.markov_noise), _axes(spec.bias_instability)
    states = shaping.start(initial[:, : flicker.STATES])
    errors = gyro_errors.Errors(
        matrix=np.eye(3) + spec.error_matrix,
        asymmetry=read_only(spec.asymmetry),
        constant=spec.turn_on_bias + _axes(spec.turn_on_bias_sigma) * initial[:, -1],
        ramp=_axes(spec.rate_ramp),
        white=_axes(0.0 if low_passed else spec.angle_random_walk),
        walk=_axes(spec.rate_random_walk),
        markov=q,
        correlation_time=np.full(3, tau),
        flicker=instability,
        poles=np.ascontiguousarray(shaping.poles),
        gains=np.ascontiguousarray(shaping.gains),
    )
    return errors, gyro_errors.Drift(
        flicker_states=states,
        flicker_before=instability * (states @ shaping.gains),
        walk=np.zeros(3),
        markov=q * np.sqrt(0.5 * tau) * initial[:, -2] if np.isfinite(tau) else np.zeros(3),
    )


def _add_environment(
    spec: GyroSpec,
    edges: Array,
    specific_force: ArrayLike | None,
    temperature: ArrayLike | None,
    increments: Array,
    bias: Array,
) -> None:
    """Add the effects of specific force and temperature to increments and bias, in place."""
    dt = np.diff(edges)[:, None]
    if np.any(spec.g_sensitivity != 0.0):
        if specific_force is None:
            raise InputError("the specification has a g_sensitivity; pass specific_force (n, 3) in m/s²")
        force = array("specific_force", specific_force, (len(increments), 3))
        increments += force @ spec.g_sensitivity.T * dt
    if spec.temperature is not None:
        if temperature is None:
            raise InputError(
                "the gyro has a bias over temperature, but no temperature is given; add the table [temperature] to the scenario "
                "(temperature (n + 1,), °C, in Python)"
            )
        drift = spec.temperature.bias(array("temperature", temperature, (len(edges),)))
        bias += drift
        increments += 0.5 * (drift[1:] + drift[:-1]) * dt


def _axes(value: Axes) -> Array:
    return read_only(np.broadcast_to(np.asarray(value, dtype=np.float64), 3))


def _need_uniform(edges: Array) -> None:
    dt = np.diff(edges)
    mean = (edges[-1] - edges[0]) / len(dt)
    k = int(np.argmax(dt)) if dt.max() - mean > mean - dt.min() else int(np.argmin(dt))
    if abs(dt[k] - mean) > _UNEVEN * mean:
        raise InputError(
            f"edges[{k}] to edges[{k + 1}] is {dt[k]:.9g} s, the mean interval {mean:.9g} s; bias_instability and bandwidth need "
            "uniform edges: simulate at nominal edges and drop samples afterwards"
        )


def _low_pass(spec: GyroSpec, increments: Array, dt: float, initial: Array, draws: gyro_errors.Draws) -> Array:
    """Return the increments filtered by ``H(s) = ω²/(s² + 2ζωs + ω²)``, with the white noise, exact over each interval."""
    natural, damping, white = 2.0 * np.pi * spec.bandwidth, spec.damping, _axes(spec.angle_random_walk)
    step = low_pass_step(natural, damping, dt)
    # Stationary: ȳ is the first mean rate; the white noise gives var y = σ_v² ω/(4ζ), var ẏ = σ_v² ω³/(4ζ), uncorrelated.
    sigma = white * np.sqrt(natural / (4.0 * damping))
    state = np.stack([increments[0] / dt + sigma * initial[:, -3], sigma * natural * initial[:, -4]], axis=1)
    out = np.empty_like(increments)
    compiled(gyro_errors.low_pass)(dt, *step, white, np.ascontiguousarray(state), *draws, increments, out)
    return out


def low_pass_step(natural: float, damping: float, dt: float) -> tuple[Array, Array]:
    """Return the exact step of ``ÿ + 2ζω ẏ + ω² y = ω² u`` over dt, and the Cholesky factor (3, 3) for unit white noise in u.

    The step (3, 4) maps (y, ẏ, mean of u, slope of u) to (y, ẏ, ∫y) at the end, for linear u (matrix exponential; the noise by Van Loan
    1978).
    """
    from scipy.linalg import expm

    # Scaled time and velocity (t ω, ẏ/ω) keep the matrix exponential well conditioned.
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 0] = A[3, 4] = 1.0
    A[1, :4] = -1.0, -2.0 * damping, 0.0, 1.0
    x = natural * dt
    whole = expm(A * x)
    lines = whole[:3, [0, 1, 3, 4]].copy()
    # u(0) = mean − ½ slope; in scaled time slope' = slope/ω.
    lines[:, 3] -= 0.5 * x * lines[:, 2]
    unscale = np.array([1.0, natural, 1.0 / natural])
    transition = unscale[:, None] * lines * np.array([1.0, 1.0 / natural, 1.0, 1.0 / natural])
    # Van Loan's matrix contains e^(−Fx), so it is used for small x, which is then doubled: Q(2x) = Q(x) + Φ Q(x) Φᵀ.
    F, noise_in = A[:3, :3], np.zeros((3, 3))
    noise_in[1, 1] = 1.0
    doublings = max(0, int(np.ceil(np.log2(x))))
    block = expm(np.block([[-F, noise_in], [np.zeros((3, 3)), F.T]]) * (x / 2**doublings))
    step = block[3:, 3:].T
    covariance = step @ block[:3, 3:]
    for _ in range(doublings):
        covariance = covariance + step @ covariance @ step.T
        step = step @ step
    # The variance of ∫y decreases as x⁵: factor the correlation, not the covariance.
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    factor = np.linalg.cholesky(0.5 * (correlation + correlation.T)) * scale[:, None]
    return transition, np.sqrt(natural) * unscale[:, None] * factor


def sampling(spec: GyroSpec, edges: ArrayLike, generator: np.random.Generator) -> tuple[Array, Array]:
    """Return the true sampling instants (n + 1,) and the reported time stamps (n + 1,), s, for nominal edges."""
    nominal = increasing("edges", edges, minimum=2)
    most = 0.4 * float(np.diff(nominal).min())
    draws = generator.standard_normal((2, len(nominal)))
    for name in ("sampling_jitter", "timestamp_error"):
        if (sigma := getattr(spec, name)) >= most:
            raise InputError(f"{name} is {sigma:g} s; it must be below 0.4 sample intervals, {most:g} s")
    jitter, error = np.clip(np.multiply([[spec.sampling_jitter], [spec.timestamp_error]], draws), -most, most)
    return nominal + jitter, nominal + spec.timestamp_offset + error


def bridge_dropped(increments: ArrayLike, edges: ArrayLike, lost: np.ndarray) -> tuple[Array, np.ndarray]:
    """Return increments without the lost samples, and the indices of the remaining edges.

    A gap is merged with the interval of the sample after it, with the rate of that sample; lost samples at the end are cut off.
    """
    stamps = increasing("edges", edges, minimum=2)
    turns = array("increments", increments, (len(stamps) - 1, 3))
    if np.all(lost):
        raise InputError("all samples are lost; lower drop_probability")
    kept = np.flatnonzero(~np.asarray(lost, bool))
    left = np.concatenate([[0], kept + 1])
    own = np.diff(stamps)[kept]
    return turns[kept] * (np.diff(stamps[left]) / own)[:, None], left
