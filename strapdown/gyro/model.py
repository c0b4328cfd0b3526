"""Gyro error model: from the true rotation to the output of a rate gyro.

Rate: ``w_meas = (I + M) w_b + b + n``, with ``n`` white noise of PSD σ_v² (angle random walk) and b a sum of drifts. Increment: the
integral of the rate over each sample interval. An increment divided by its interval is the averaged-rate sample (:attr:`GyroOutput.rates`).
All noise is exact in discrete time, for any interval.

Power spectral densities are two-sided, as in IEEE Std 952: ARW σ_v², flicker B²/(2π f), rate random walk σ_u²/(2π f)².

Flicker in the filter
---------------------
A filter with a random-walk bias does not model flicker. :func:`matched_process_noise` gives the white and random-walk noise with which its
attitude variance is the actual one; :func:`process_noise` a bound, a spectrum that is nowhere below that of the gyro: ``σ_v'² = σ_v² +
B²/(2ω*)`` and ``σ_u'² = σ_u² + ω* B²/2``; by the inequality of the means ``B²/(2ω*) + ω* B²/(2ω²) ≥ B²/ω`` for every ω, with equality at
ω*. The exact model adds the sixteen states of :class:`strapdown.gyro.flicker.Shaping` to the filter, driven by one white noise per axis.

``sims/flicker_in_filter.py`` compares them on the presets: mean NEES per degree of freedom of the attitude 1.00 to 1.05 matched, 1.00 to
1.61 if flicker is ignored; the RMS error is within 1.2 % of that of the augmented filter. For the bias this does not hold: a random-walk
bias tracks the low-frequency part of the flicker, and its covariance does not include the high-frequency part, which the simulated bias
contains. Judge such a filter by its attitude.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from strapdown import units
from strapdown.checks import Array, InputError, array, finite, increasing, known_keys, non_negative, positive
from strapdown.files import tables
from strapdown.gyro import flicker
from strapdown.gyro import temperature as thermal
from strapdown.gyro.temperature import BiasOverTemperature
from strapdown.kernels import gyro_errors, noise
from strapdown.kernels.machine import compiled, read_only
from strapdown.results import ByValue

Axes = float | Array
"""One number for all axes, or an array (3,) of one per axis."""


_BY_AXIS = {
    "angle_random_walk": "rad/√s",
    "bias_instability": "rad/s",
    "rate_random_walk": "rad/s/√s",
    "markov_noise": "rad/s/√s",
    "quantization": "rad",
    "rate_resolution": "rad/s",
    "turn_on_bias_sigma": "rad/s",
}
"""Non-negative fields, one number or one per axis, and their units."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroSpec(ByValue):
    """Parameters of a three-axis gyro, SI and radians. The defaults are those of a gyro without errors.

    Noise coefficients are one number for all axes, or one per axis.

    Parameters
    ----------
    angle_random_walk : float or ndarray (3,), default 0.0
        Angle random walk σ_v (N), rad/√s; 1 °/√h = π/10800 rad/√s.
    rate_random_walk : float or ndarray (3,), default 0.0
        Rate random walk σ_u (K) of the bias, rad/s/√s, from 0 at the first edge.
    bias_instability : float or ndarray (3,), default 0.0
        Bias instability B, rad/s: flicker of two-sided PSD B²/(2π f), stationary from the first sample; the floor of
        the Allan deviation is 0.664 B.
    quantization : float or ndarray (3,), default 0.0
        Quantisation Q, rad: the increments are integer multiples of Q√12 and the remainder is carried to the next; Allan variance 3Q²/τ².
    rate_ramp : float or ndarray (3,), default 0.0
        Rate ramp R, rad/s²: slope of the bias, which starts at 0 at the first edge.
    markov_noise : float or ndarray (3,), default 0.0
        Noise √q, rad/s/√s: it drives a Gauss–Markov bias ``ḃ = −b/τ + √q w``; its stationary standard deviation is √(qτ/2).
    markov_correlation_time : float, default inf
        Correlation time τ of that bias, s; stationary from the start if finite, a random walk from 0 if infinite.
    turn_on_bias : ndarray (3,), default zeros
        Constant bias, rad/s, body axes.
    turn_on_bias_sigma : float or ndarray (3,), default 0.0
        Standard deviation of a constant bias drawn in every run, rad/s.
    scale_factor : ndarray (3,), default zeros
        Scale-factor errors, dimensionless: the diagonal of M.
    asymmetry : ndarray (3,), default zeros
        Scale-factor asymmetry a, dimensionless: adds ``a |w|``, so that the scale factor is 1 + s ± a by the sign of the rate.
    misalignment : ndarray (3, 3), default zeros
        Off-diagonal part of M, rad; entry (i, j) is the fraction of the rate about axis j that axis i senses.
    g_sensitivity : ndarray (3, 3), default zeros
        Bias per specific force, rad/s per m/s², body axes.
    temperature : BiasOverTemperature, optional
        Bias over temperature in °C (:class:`strapdown.gyro.temperature.BiasOverTemperature`). Default: none.
    bandwidth : float, default inf
        Natural frequency of a second-order low-pass filter, Hz; needs uniform edges. Infinite: no filter.
    damping : float, default √½
        Damping ratio of the low-pass filter.
    range : float, default inf
        Maximum rate of an axis, rad/s; beyond it the output saturates.
    rate_resolution : float or ndarray (3,), default 0.0
        Resolution of a rate output, rad/s: each averaged rate is rounded separately, without carrying the remainder.
    sampling_jitter : float, default 0.0
        Standard deviation of the sampling instants about the nominal ones, s.
    timestamp_error : float, default 0.0
        Standard deviation of the time stamps about the nominal instants, s.
    timestamp_offset : float, default 0.0
        Delay of the time stamps after the nominal instants, s.
    drop_probability : float, default 0.0
        Probability that a sample is lost, independently of the others; 0 to below 1.

    Examples
    --------
    >>> from strapdown.units import DEGREE_PER_HOUR, DEGREE_PER_ROOT_HOUR
    >>> spec = GyroSpec(angle_random_walk=0.15 * DEGREE_PER_ROOT_HOUR, turn_on_bias_sigma=20.0 * DEGREE_PER_HOUR)
    >>> print(f"{spec.angle_random_walk:.3g} rad/√s, {spec.turn_on_bias_sigma:.3g} rad/s")
    4.36e-05 rad/√s, 9.7e-05 rad/s
    """

    angle_random_walk: Axes = 0.0
    rate_random_walk: Axes = 0.0
    bias_instability: Axes = 0.0
    quantization: Axes = 0.0
    rate_ramp: Axes = 0.0
    markov_noise: Axes = 0.0
    markov_correlation_time: float = np.inf
    turn_on_bias: Array = field(default_factory=lambda: np.zeros(3))
    turn_on_bias_sigma: Axes = 0.0
    scale_factor: Array = field(default_factory=lambda: np.zeros(3))
    asymmetry: Array = field(default_factory=lambda: np.zeros(3))
    misalignment: Array = field(default_factory=lambda: np.zeros((3, 3)))
    g_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))
    temperature: BiasOverTemperature | None = None
    bandwidth: float = np.inf
    damping: float = 0.7071067811865476
    range: float = np.inf
    rate_resolution: Axes = 0.0
    sampling_jitter: float = 0.0
    timestamp_error: float = 0.0
    timestamp_offset: float = 0.0
    drop_probability: float = 0.0

    def __post_init__(self) -> None:
        """Check every field."""
        fields: dict[str, Any] = {name: _by_axis(name, getattr(self, name), unit) for name, unit in _BY_AXIS.items()}
        ramp: Any = self.rate_ramp
        fields["rate_ramp"] = (
            array("rate_ramp", ramp, (3,)) if np.ndim(ramp) else finite("rate_ramp", ramp, unit="rad/s²")
        )
        for name in ("turn_on_bias", "scale_factor", "asymmetry"):
            value = getattr(self, name)
            if not isinstance(value, (bool, str)) and np.ndim(value) == 0:
                value = np.full(3, finite(name, value))
            fields[name] = array(name, value, (3,))
        for name in ("misalignment", "g_sensitivity"):
            fields[name] = array(name, getattr(self, name), (3, 3))
        if np.any(np.diag(fields["misalignment"]) != 0.0):
            raise InputError("misalignment has entries on its diagonal; give those as scale_factor")
        for name, unit in (("markov_correlation_time", "s"), ("bandwidth", "Hz"), ("range", "rad/s")):
            value = float(getattr(self, name))
            fields[name] = value if value == np.inf else positive(name, value, unit=unit)
        fields["damping"] = positive("damping", self.damping)
        for name in ("sampling_jitter", "timestamp_error"):
            fields[name] = non_negative(name, getattr(self, name), unit="s")
        fields["timestamp_offset"] = finite("timestamp_offset", self.timestamp_offset, unit="s")
        fields["drop_probability"] = non_negative("drop_probability", self.drop_probability)
        if self.drop_probability >= 1.0:
            raise InputError(f"drop_probability is {self.drop_probability:g}; it must be below 1")
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @property
    def error_matrix(self) -> Array:
        """M of ``(I + M) w_b``: scale factors on the diagonal, misalignments off it."""
        return self.misalignment + np.diag(self.scale_factor)

    @property
    def quantization_step(self) -> Axes:
        """Quantisation step of the increments, Q√12, rad."""
        return self.quantization * float(np.sqrt(12.0))


def _by_axis(name: str, value: Any, unit: str) -> Axes:
    if np.ndim(value) == 0:
        return non_negative(name, value, unit=unit)
    values = array(name, value, (3,))
    for k, number in enumerate(values):
        non_negative(f"{name}[{k}]", number, unit=unit)
    return values


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
    A[0, 1] = 1.0
    A[1, :2] = -1.0, -2.0 * damping
    A[1, 3] = 1.0
    A[2, 0] = 1.0
    A[3, 4] = 1.0
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
    true = nominal + np.clip(spec.sampling_jitter * draws[0], -most, most)
    stamps = nominal + spec.timestamp_offset + np.clip(spec.timestamp_error * draws[1], -most, most)
    return (true if spec.sampling_jitter > 0.0 else nominal), stamps


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


def process_noise(spec: GyroSpec, *, bandwidth: float | None = None) -> dict[str, float]:
    """Return the process noise of a filter with a random-walk bias: ``ProcessNoise(**process_noise(spec))``.

    Parameters
    ----------
    spec : GyroSpec
        Specification of the gyro.
    bandwidth : float, optional
        ω*, rad/s, at which the spectral bound equals the flicker, required if the gyro has flicker: the natural frequency of the filter.

    Returns
    -------
    dict
        ``angle_random_walk``, rad/√s, and ``rate_random_walk``, rad/s/√s, the maximum over the axes.

    Notes
    -----
    Without flicker these are the coefficients of the gyro; a Gauss–Markov bias is represented by its driving noise, which is valid for
    times much shorter than τ.

    Examples
    --------
    >>> process_noise(GyroSpec(angle_random_walk=1e-5, rate_random_walk=1e-8))
    {'angle_random_walk': 1e-05, 'rate_random_walk': 1e-08}
    """
    white, walk, instability = _filter_terms(spec)
    if instability > 0.0:
        if bandwidth is None:
            raise InputError(
                "the specification has flicker (bias_instability); pass the bandwidth of its spectral bound, in rad/s"
            )
        corner = positive("bandwidth", bandwidth, unit="rad/s")
        white += instability**2 / (2.0 * corner)
        walk += 0.5 * corner * instability**2
    return {"angle_random_walk": float(np.sqrt(white)), "rate_random_walk": float(np.sqrt(walk))}


def matched_process_noise(spec: GyroSpec, measurement_density: float) -> dict[str, float]:
    """Return the process noise for which the filter's steady-state attitude variance is correct in the presence of flicker.

    Parameters
    ----------
    spec : GyroSpec
        Specification of the gyro.
    measurement_density : float
        r, rad² s: variance of a measurement about an axis times the interval between measurements.

    Returns
    -------
    dict
        ``angle_random_walk``, rad/√s, and ``rate_random_walk``, rad/s/√s.

    Notes
    -----
    The transfer function from rate to attitude error is ``s/(s² + 2ζω s + ω²)``, so flicker gives the attitude variance
    ``B²/(2πω²) arccos ζ/(ζ √(1 − ζ²))``, and the bound at ω* = ω gives ``B²/(4ζω²)``. Their ratio is ``κ(ζ) = (2/π) arccos ζ/√(1 −
    ζ²)`` (arcosh and ζ² − 1 above ζ = 1): 1, 0.71 and 0.64 at ζ = 0, 0.71 and 1. The bound with κ B² in place of B² is solved for the ω and
    ζ of the resulting filter.
    """
    white, walk, instability = _filter_terms(spec)
    density = positive("measurement_density", measurement_density, unit="rad² s")
    if instability == 0.0:
        return process_noise(spec)
    share = 1.0
    for _ in range(200):
        power = share * instability**2
        natural = _natural_frequency(walk, power, density)
        matched_white, matched_walk = white + power / (2.0 * natural), walk + 0.5 * natural * power
        damping = 0.5 * float(np.sqrt((matched_white + 2.0 * np.sqrt(matched_walk * density)) / density)) / natural
        before, share = share, flicker_share(damping)
        if abs(share - before) <= 1e-14 * share:
            break
    return {"angle_random_walk": float(np.sqrt(matched_white)), "rate_random_walk": float(np.sqrt(matched_walk))}


def flicker_share(damping: float) -> float:
    """Return κ(ζ) of :func:`matched_process_noise`: the ratio of the attitude variance due to flicker to that of its spectral bound."""
    away = 1.0 - damping**2
    if abs(away) < 1e-6:
        return float(2.0 / np.pi * (1.0 + (1.0 - damping) / 3.0))
    angle = np.arccos(damping) if away > 0.0 else np.arccosh(damping)
    return float(2.0 / np.pi * angle / np.sqrt(abs(away)))


def _natural_frequency(walk: float, power: float, density: float) -> float:
    """Return the root ω of r ω⁴ = σ_u² + ω B²/2."""
    from scipy.optimize import brentq

    # In units of the larger of the two limits ω⁴ = σ_u²/r and ω³ = B²/(2r), the root lies in [1, 2).
    scale = max((walk / density) ** 0.25, (power / (2.0 * density)) ** (1.0 / 3.0))
    a, b = walk / (density * scale**4), power / (2.0 * density * scale**3)
    return float(scale * brentq(lambda x: x**4 - b * x - a, 0.5, 2.0, xtol=1e-14))


def _filter_terms(spec: GyroSpec) -> tuple[float, float, float]:
    """Return σ_v², the PSD of all random walks, and B, each the maximum over the axes."""
    white = float(np.max(spec.angle_random_walk)) ** 2
    walk = float(np.max(np.square(spec.rate_random_walk) + np.square(spec.markov_noise)))
    return white, walk, float(np.max(spec.bias_instability))


FORM: tables.Form = {
    "angle_random_walk": (("deg_per_sqrt_hour", units.DEGREE_PER_ROOT_HOUR), ("rad_per_sqrt_s", 1.0)),
    "rate_random_walk": (
        ("deg_per_hour_per_sqrt_hour", units.DEGREE_PER_HOUR_PER_ROOT_HOUR),
        ("rad_per_s_per_sqrt_s", 1.0),
    ),
    "bias_instability": tables.DEGREES_PER_HOUR,
    "quantization": (("arcsec", units.ARCSECOND), ("rad", 1.0)),
    "rate_ramp": (("deg_per_hour_per_hour", units.DEGREE_PER_HOUR / 3600.0), ("rad_per_s2", 1.0)),
    "markov_noise": (
        ("deg_per_hour_per_sqrt_hour", units.DEGREE_PER_HOUR_PER_ROOT_HOUR),
        ("rad_per_s_per_sqrt_s", 1.0),
    ),
    "markov_correlation_time": tables.SECONDS,
    "turn_on_bias": tables.DEGREES_PER_HOUR,
    "turn_on_bias_sigma": tables.DEGREES_PER_HOUR,
    "scale_factor": tables.PPM,
    "asymmetry": tables.PPM,
    "misalignment": tables.MILLIRADIANS,
    "g_sensitivity": (("deg_per_hour_per_g", units.DEGREE_PER_HOUR / units.STANDARD_GRAVITY), ("rad_s_per_m", 1.0)),
    "bandwidth": tables.HERTZ,
    "damping": tables.RATIO,
    "range": tables.DEGREES_PER_SECOND,
    "rate_resolution": tables.DEGREES_PER_SECOND,
    "sampling_jitter": tables.SECONDS,
    "timestamp_error": tables.SECONDS,
    "timestamp_offset": tables.SECONDS,
    "drop_probability": tables.RATIO,
}
"""Keys of the specification in files, except the table ``temperature``."""


def to_table(spec: GyroSpec) -> dict[str, Any]:
    """Return the fields that differ from the defaults as a table for TOML or JSON, with the units in the keys; read back exactly."""
    warm = {} if spec.temperature is None else {"temperature": thermal.to_table(spec.temperature)}
    return tables.encode(spec, FORM) | warm


def from_table(table: Mapping[str, Any], place: str = "gyro", base: GyroSpec | None = None) -> GyroSpec:
    """Return the specification of a table with the units in the keys; with ``base``, the table has the changes to it."""
    known_keys(place, table, [*tables.keys(FORM), "temperature", *(["preset"] if base else [])])
    own = {key: value for key, value in table.items() if key != "temperature"}
    values = tables.decode(own, FORM, place)
    if "temperature" in table:
        values["temperature"] = thermal.from_table(table["temperature"], f"{place}: temperature")
    return tables.construct(functools.partial(replace, base or GyroSpec()), values, own, FORM, place)  # type: ignore[no-any-return]


def read_spec(path: str | os.PathLike[str]) -> GyroSpec:
    """Read the table ``[gyro]`` of a TOML file, as written by ``strapdown allan``.

    Parameters
    ----------
    path : path-like
        File.

    Returns
    -------
    GyroSpec
        The specification.
    """
    return tables.read(path, "gyro", "`strapdown allan` writes one", from_table)
