"""Gyro error model: what a rate gyro makes of the true rotation.

Rate form: ``w_meas = (I + M) w_b + b + n``, with ``n`` white of PSD σ_v² (angle random walk) and b a sum of drifts; increment form: the
integral of that over each sample interval. An increment over its interval is the averaged-rate sample, so both outputs are the same
numbers (:attr:`GyroOutput.rates`). All noise is exact in discrete time, for any interval.

Power spectral densities are two-sided, as in IEEE Std 952: ARW σ_v², flicker B²/(2π f), rate random walk σ_u²/(2π f)².

Flicker in the filter
---------------------
A filter with a random-walk bias has no flicker. :func:`process_noise` covers it by the least white and random-walk noise whose spectrum
is nowhere below that of the gyro: ``σ_v'² = σ_v² + B²/(2ω*)`` and ``σ_u'² = σ_u² + ω* B²/2``; by the inequality of the means
``B²/(2ω*) + ω* B²/(2ω²) ≥ B²/ω`` for every ω, with equality at ω*. A spectrum that is nowhere below gives an attitude covariance that is
nowhere too small. :func:`best_bandwidth` puts ω* where that costs least: at the natural frequency of the filter.

That bound is safe and rather modest. :func:`matched_process_noise` scales it so that the filter's attitude variance is the actual one.
Exact is to put the sixteen states of :class:`strapdown.flicker.Shaping` into the filter, driven by one white noise an axis.

``sims/flicker_in_filter.py`` compares them on the presets, each at its natural rate with vector measurements once a second. Mean NEES of
the attitude over its three degrees of freedom (40 runs of 600 s; the scatter of each is 0.012 to 0.049, 0.073 for the blind mpu-9250; the
columns share their random numbers):

===========  ===============  =========  ==============  =======  =========
preset       without flicker  blind      spectral bound  matched  augmented
===========  ===============  =========  ==============  =======  =========
mpu-9250     0.973            1.611      0.919           1.003    0.994
bmi088       1.043            1.117      1.017           1.047    1.044
adis16470    0.999            1.380      0.929           1.001    1.001
adis16467-1  1.013            1.361      0.966           1.040    1.037
stim300      1.003            1.025      0.985           1.007    1.005
hg4930       1.057            1.210      0.983           1.045    1.044
dsp-1760     1.020            1.074      0.982           1.020    1.018
hg9900       1.003            1.009      1.001           1.007    1.009
===========  ===============  =========  ==============  =======  =========

So: match it, or bound it where too small a covariance is not to be risked. The rms error is within 1.2 % of the augmented filter's.
The bias is another matter: a random-walk bias tracks the slow part of the flicker, and its covariance does not cover the fast part, which
the simulator's bias holds too. Judge such a filter by its attitude.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from strapdown import flicker, tables, units
from strapdown.checks import Array, InputError, array, finite, increasing, non_negative, positive
from strapdown.equality import ByValue
from strapdown.kernels import gyro_errors, noise
from strapdown.kernels.machine import compiled

Axes = float | Array
"""One number for all axes, or an array (3,) of one an axis."""


def _zeros() -> Array:
    return np.zeros(3)


def _zero_matrix() -> Array:
    return np.zeros((3, 3))


_BY_AXIS = {
    "angle_random_walk": "rad/√s",
    "bias_instability": "rad/s",
    "rate_random_walk": "rad/s/√s",
    "markov_noise": "rad/s/√s",
    "quantization": "rad",
    "rate_resolution": "rad/s",
    "turn_on_bias_sigma": "rad/s",
}
"""Fields of zero or more, one number or one an axis, and their units."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroSpec(ByValue):
    """Parameters of a three-axis gyro, SI and radians. Every default is a perfect gyro.

    The noise coefficients take one number for all axes or one an axis.
    """

    angle_random_walk: Axes = 0.0
    """σ_v (N), rad/√s; 1 °/√h = π/10800 rad/√s."""
    rate_random_walk: Axes = 0.0
    """σ_u (K), rad/s/√s: a random walk of the bias from 0 at the first edge."""
    bias_instability: Axes = 0.0
    """B, rad/s: flicker of two-sided PSD B²/(2π f), stationary from the first sample; the floor of the Allan deviation is 0.664 B."""
    quantization: Axes = 0.0
    """Q, rad: the increments are whole multiples of Q√12 and the remainder is carried to the next, which gives 3Q²/τ²."""
    rate_ramp: Axes = 0.0
    """R, rad/s²: the bias grows so much a second, from 0 at the first edge."""
    markov_noise: Axes = 0.0
    """√q, rad/s/√s, driving a Gauss–Markov bias ``ḃ = −b/τ + √q w``; its stationary standard deviation is √(qτ/2)."""
    markov_correlation_time: float = np.inf
    """τ, s; a finite one starts stationary, an infinite one is a random walk from 0."""
    turn_on_bias: Array = field(default_factory=_zeros)
    """Fixed bias, (3,), rad/s, body axes."""
    turn_on_bias_sigma: Axes = 0.0
    """Standard deviation of a bias drawn anew for every run, rad/s."""
    scale_factor: Array = field(default_factory=_zeros)
    """Scale-factor errors, (3,) or one for all axes, dimensionless: the diagonal of M."""
    asymmetry: Array = field(default_factory=_zeros)
    """Scale-factor asymmetry a, (3,), dimensionless: adds a |w|, so the scale factor is 1 + s ± a by the sign of the rate."""
    misalignment: Array = field(default_factory=_zero_matrix)
    """Off-diagonal part of M, (3, 3), rad; entry (i, j) is how much of the rate about j shows on axis i."""
    g_sensitivity: Array = field(default_factory=_zero_matrix)
    """(3, 3), rad/s per m/s²: the bias that a specific force adds."""
    temperature_coefficient: Array = field(default_factory=_zeros)
    """(3,), rad/s/K: the bias that a temperature above that of calibration adds."""
    bandwidth: float = np.inf
    """Natural frequency of a second-order low-pass, Hz; needs uniform edges. Infinite: none."""
    damping: float = 0.7071067811865476
    """Damping ratio of the low-pass."""
    range: float = np.inf
    """Largest rate that an axis tells, rad/s: beyond, it saturates."""
    rate_resolution: Axes = 0.0
    """Step of a rate output, rad/s: each averaged rate is rounded by itself, no remainder is carried."""
    sampling_jitter: float = 0.0
    """Standard deviation of the sampling instants about the nominal ones, s."""
    timestamp_error: float = 0.0
    """Standard deviation of the stamps about the nominal instants, s."""
    timestamp_offset: float = 0.0
    """What the stamps are late by, s."""
    drop_probability: float = 0.0
    """Probability that a sample is lost, each by itself."""

    def __post_init__(self) -> None:
        """Check every field."""
        for name, unit in _BY_AXIS.items():
            object.__setattr__(self, name, _by_axis(name, getattr(self, name), unit))
        if np.ndim(self.rate_ramp) == 0:
            object.__setattr__(self, "rate_ramp", finite("rate_ramp", cast(float, self.rate_ramp), unit="rad/s²"))
        else:
            object.__setattr__(self, "rate_ramp", array("rate_ramp", self.rate_ramp, (3,)))
        for name in ("turn_on_bias", "scale_factor", "asymmetry", "temperature_coefficient"):
            value = getattr(self, name)
            if not isinstance(value, (bool, str)) and np.ndim(value) == 0:
                value = np.full(3, finite(name, value))
            object.__setattr__(self, name, array(name, value, (3,)))
        for name in ("misalignment", "g_sensitivity"):
            object.__setattr__(self, name, array(name, getattr(self, name), (3, 3)))
        if np.any(np.diag(self.misalignment) != 0.0):
            raise InputError("misalignment has entries on its diagonal; give those as scale_factor")
        for name, unit in (("markov_correlation_time", "s"), ("bandwidth", "Hz"), ("range", "rad/s")):
            value = float(getattr(self, name))
            object.__setattr__(self, name, value if value == np.inf else positive(name, value, unit=unit))
        object.__setattr__(self, "damping", positive("damping", self.damping))
        for name in ("sampling_jitter", "timestamp_error"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name), unit="s"))
        object.__setattr__(self, "timestamp_offset", finite("timestamp_offset", self.timestamp_offset, unit="s"))
        object.__setattr__(self, "drop_probability", non_negative("drop_probability", self.drop_probability))
        if self.drop_probability >= 1.0:
            raise InputError(f"drop_probability is {self.drop_probability:g}; it must be below 1")

    @property
    def error_matrix(self) -> Array:
        """M of ``(I + M) w_b``: scale factors on the diagonal, misalignments off it."""
        return self.misalignment + np.diag(self.scale_factor)

    @property
    def quantization_step(self) -> Axes:
        """Step of the increments, Q√12, rad."""
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
    """What the gyro gave, and the bias it gave it with."""

    increments: Array
    """Measured rotation increments (n, 3), rad, body axes."""
    bias: Array
    """True bias at the edges (n + 1, 3), rad/s: turn-on bias and all drifts. Flicker has no value at an instant; here it is the mean of
    those of the two intervals at the edge. (Before any low-pass; the effect of acceleration is not part of it.)"""
    edges: Array
    """Edges of the intervals (n + 1,), s."""

    @property
    def rates(self) -> Array:
        """Averaged rates (n, 3), rad/s: the rate output."""
        return np.asarray(self.increments / np.diff(self.edges)[:, None])


_INITIAL, _LOW_PASS = 4, 5  # stream numbers above those of gyro_errors
_STREAMS = 8  # stream numbers reserved for an axis
_UNEVEN = 0.1  # of the mean interval: what flicker and low-pass bear


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

    Over an interval dt the bias walks by σ_u √dt n₁; its integral, given both ends, is ½ (b_k + b_{k+1}) dt plus a Gaussian of variance
    σ_u² dt³/12 (the Brownian bridge), and the integral of the white noise has variance σ_v² dt. So an increment is
    ``(I + M) Δθ + ½ (b_k + b_{k+1}) dt + √(σ_v² dt + σ_u² dt³/12) n₂``: exact, whatever dt. A Gauss–Markov bias goes by its own exact step
    and bridge (:func:`strapdown.kernels.gyro_errors.markov_step`). Then come the low-pass, saturation and rounding.

    Parameters
    ----------
    spec : GyroSpec
    true_increments : array (n, 3)
        Exact integrals of the body rate over each interval, rad.
    edges : array (n + 1,)
        Edges of the sample intervals, s; uniform to a tenth (jitter, no gaps) if there is flicker or a low-pass, which go by the mean.
    generator : numpy.random.Generator
        Names the gyro's streams: two words are drawn from it, and each noise term of each axis has a stream of its own under them.
    specific_force : array (n, 3), optional
        Mean specific force over each interval, m/s², body axes; needed if the specification has a g-sensitivity.
    temperature : array (n + 1,), optional
        Temperature at the edges above that of calibration, K; needed if the specification has a temperature coefficient.
    """
    stamps = increasing("edges", edges, least=2)
    exact = np.ascontiguousarray(array("true_increments", true_increments, (len(stamps) - 1, 3)))
    n = len(exact)
    key = generator.integers(0, 2**64, size=2, dtype=np.uint64)
    has_flicker = bool(np.any(np.asarray(spec.bias_instability) > 0.0))
    low_passed = np.isfinite(spec.bandwidth)
    if has_flicker or low_passed:
        _need_uniform(stamps)
    streams = _streams(key)
    initial = np.empty((3, 64))
    for axis in range(3):
        compiled(noise.fill_normals)(streams[axis, _INITIAL], np.empty((2, 32), np.uint64), initial[axis])
    shaping = flicker.shaping(n)
    tau = spec.markov_correlation_time
    q = _axes(spec.markov_noise)
    instability = _axes(spec.bias_instability)
    white = _axes(spec.angle_random_walk)
    states = shaping.start(initial[:, : flicker.STATES])
    increments, bias = np.empty((n, 3)), np.empty((n + 1, 3))
    words, normals = np.empty((2, gyro_errors.BLOCK // 2), np.uint64), np.zeros((4, gyro_errors.BLOCK))
    compiled(gyro_errors.drift_and_noise)(
        stamps,
        exact,
        np.eye(3) + spec.error_matrix,
        spec.asymmetry,
        spec.turn_on_bias + _axes(spec.turn_on_bias_sigma) * initial[:, -1],
        _axes(spec.rate_ramp),
        np.zeros(3) if low_passed else white,
        _axes(spec.rate_random_walk),
        q,
        np.full(3, tau),
        instability,
        np.ascontiguousarray(shaping.poles),
        np.ascontiguousarray(shaping.gains),
        states,
        instability * (states @ shaping.gains),
        np.zeros(3),
        q * np.sqrt(0.5 * tau) * initial[:, -2] if np.isfinite(tau) else np.zeros(3),
        streams,
        words,
        normals,
        increments,
        bias,
    )
    if np.any(spec.g_sensitivity != 0.0):
        if specific_force is None:
            raise InputError("the specification has a g_sensitivity; pass specific_force (n, 3) in m/s²")
        increments += array("specific_force", specific_force, (n, 3)) @ spec.g_sensitivity.T * np.diff(stamps)[:, None]
    if np.any(spec.temperature_coefficient != 0.0):
        if temperature is None:
            raise InputError(
                "the specification has a temperature_coefficient; pass temperature (n + 1,) in K above calibration"
            )
        drift = array("temperature", temperature, (n + 1,))[:, None] * spec.temperature_coefficient
        bias += drift
        increments += 0.5 * (drift[1:] + drift[:-1]) * np.diff(stamps)[:, None]
    if low_passed:
        increments = _low_pass(
            spec, increments, (stamps[-1] - stamps[0]) / n, white, initial, streams[:, _LOW_PASS:], words, normals
        )
    if (
        np.isfinite(spec.range)
        or np.any(np.asarray(spec.quantization) > 0.0)
        or np.any(np.asarray(spec.rate_resolution) > 0.0)
    ):
        step = _axes(spec.quantization_step)
        carried = step * (generator.random(3) - 0.5)
        compiled(gyro_errors.digitize)(
            stamps, np.full(3, spec.range), step, _axes(spec.rate_resolution), carried, increments
        )
    return GyroOutput(increments=increments, bias=bias, edges=stamps)


def _axes(value: Axes) -> Array:
    return np.ascontiguousarray(np.broadcast_to(value, 3), dtype=np.float64)


def _streams(key: np.ndarray) -> np.ndarray:
    streams = np.empty((3, _STREAMS, 2, 4), np.uint64)
    seed = compiled(noise.seed_stream)
    for axis in range(3):
        for term in range(_STREAMS):
            seed(key[0], key[1], np.uint64(_STREAMS * axis + term), streams[axis, term])
    return streams


def _need_uniform(edges: Array) -> None:
    dt = np.diff(edges)
    mean = (edges[-1] - edges[0]) / len(dt)
    k = int(np.argmax(dt)) if dt.max() - mean > mean - dt.min() else int(np.argmin(dt))
    if abs(dt[k] - mean) > _UNEVEN * mean:
        raise InputError(
            f"edges[{k}] to edges[{k + 1}] is {dt[k]:.9g} s, the mean interval {mean:.9g} s; bias_instability and bandwidth need "
            "uniform edges: simulate at nominal ones, drop samples afterwards"
        )


def _low_pass(
    spec: GyroSpec,
    increments: Array,
    dt: float,
    white: Array,
    initial: Array,
    streams: np.ndarray,
    words: np.ndarray,
    normals: Array,
) -> Array:
    """Return the increments behind ``H(s) = ω²/(s² + 2ζωs + ω²)``, white noise and all, exact over each interval."""
    natural, damping = 2.0 * np.pi * spec.bandwidth, spec.damping
    transition, factor = low_pass_step(natural, damping, dt)
    # Stationary: ȳ is the first mean rate; the white noise alone gives var y = σ_v² ω/(4ζ), var ẏ = σ_v² ω³/(4ζ), uncorrelated.
    sigma = white * np.sqrt(natural / (4.0 * damping))
    state = np.stack([increments[0] / dt + sigma * initial[:, -3], sigma * natural * initial[:, -4]], axis=1)
    out = np.empty_like(increments)
    compiled(gyro_errors.low_pass)(
        dt,
        transition,
        factor,
        white,
        np.ascontiguousarray(state),
        np.ascontiguousarray(streams),
        words,
        normals,
        increments,
        out,
    )
    return out


def low_pass_step(natural: float, damping: float, dt: float) -> tuple[Array, Array]:
    """Return the exact step of ``ÿ + 2ζω ẏ + ω² y = ω² u`` over dt, and the Cholesky factor (3, 3) for unit white noise in u.

    The step (3, 4) takes (y, ẏ, mean of u, slope of u) to (y, ẏ, ∫y) at the end, for u a straight line (matrix exponential; the noise by
    Van Loan 1978).
    """
    from scipy.linalg import expm

    # Scaled time and velocity (t ω, ẏ/ω) keep the exponential well balanced.
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
    # Van Loan's matrix holds e^(−Fx), so it is used where that is small, then doubled: Q(2x) = Q(x) + Φ Q(x) Φᵀ.
    F, noise_in = A[:3, :3], np.zeros((3, 3))
    noise_in[1, 1] = 1.0
    doublings = max(0, int(np.ceil(np.log2(x))))
    block = expm(np.block([[-F, noise_in], [np.zeros((3, 3)), F.T]]) * (x / 2**doublings))
    step = block[3:, 3:].T
    covariance = step @ block[:3, 3:]
    for _ in range(doublings):
        covariance = covariance + step @ covariance @ step.T
        step = step @ step
    # ∫y has a variance that falls as x⁵: factor the correlation, not the covariance.
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    factor = np.linalg.cholesky(0.5 * (correlation + correlation.T)) * scale[:, None]
    return transition, np.sqrt(natural) * unscale[:, None] * factor


def sampling(spec: GyroSpec, edges: ArrayLike, generator: np.random.Generator) -> tuple[Array, Array]:
    """Return the instants at which the gyro really samples (n + 1,), and the stamps it tells (n + 1,), of nominal edges, s.

    Jitter and stamp error are independent and normal, cut off at two fifths of the shortest interval so that the order stays.
    """
    nominal = increasing("edges", edges, least=2)
    most = 0.4 * float(np.diff(nominal).min())
    draws = generator.standard_normal((2, len(nominal)))
    true = nominal + np.clip(spec.sampling_jitter * draws[0], -most, most)
    stamps = nominal + spec.timestamp_offset + np.clip(spec.timestamp_error * draws[1], -most, most)
    return (true if spec.sampling_jitter > 0.0 else nominal), stamps


def dropped(spec: GyroSpec, samples: int, generator: np.random.Generator) -> np.ndarray:
    """Return which samples are lost, a mask (samples,)."""
    return generator.random(samples) < spec.drop_probability


def bridge_dropped(increments: ArrayLike, edges: ArrayLike, lost: np.ndarray) -> tuple[Array, np.ndarray]:
    """Return increments without the lost samples, and the indices of the edges left: what a reader of the record makes of a gap.

    A gap joins the sample after it, whose rate is taken to hold throughout; lost samples at the end are cut off.
    """
    stamps = increasing("edges", edges, least=2)
    turns = array("increments", increments, (len(stamps) - 1, 3))
    if np.all(lost):
        raise InputError("all samples are lost; lower drop_probability")
    kept = np.flatnonzero(~np.asarray(lost, bool))
    left = np.concatenate([[0], kept + 1])
    own = np.diff(stamps)[kept]
    return turns[kept] * (np.diff(stamps[left]) / own)[:, None], left


def process_noise(spec: GyroSpec, *, bandwidth: float | None = None) -> dict[str, float]:
    """Return ``angle_random_walk`` and ``rate_random_walk`` for a filter with a random-walk bias: ``ProcessNoise(**process_noise(spec))``.

    Without flicker these are the gyro's own, and a Gauss–Markov bias is held by its driving noise, which is right over times short against
    τ. Flicker is covered by the spectral bound of :mod:`strapdown.gyro`, touching at ω* = ``bandwidth``. Axes that differ give the largest.

    Parameters
    ----------
    spec : GyroSpec
    bandwidth : float
        ω*, rad/s: :func:`best_bandwidth` of the vector measurements; needed if there is flicker.
    """
    white, walk, instability = _filter_terms(spec)
    if instability > 0.0:
        if bandwidth is None:
            raise InputError(
                "the specification has flicker (bias_instability); pass the bandwidth at which to bound it, in rad/s"
            )
        corner = positive("bandwidth", bandwidth, unit="rad/s")
        white += instability**2 / (2.0 * corner)
        walk += 0.5 * corner * instability**2
    return {"angle_random_walk": float(np.sqrt(white)), "rate_random_walk": float(np.sqrt(walk))}


def best_bandwidth(spec: GyroSpec, measurement_density: float) -> float:
    """Return the ω*, rad/s, at which the spectral bound of flicker gives the least attitude variance.

    A filter with white and random-walk noise and measurements of density r has the steady attitude variance ``√r √(σ_v'² + 2 σ_u' √r)``
    about an axis (Farrenkopf 1978, in the limit of frequent measurements). With the bound put in, it is least where
    ``r ω*⁴ = σ_u² + ω* B²/2``, which is where ω* is the natural frequency of the filter itself.

    Parameters
    ----------
    spec : GyroSpec
    measurement_density : float
        r, rad² s: variance about an axis of a measurement times the interval between measurements.
    """
    _, walk, instability = _filter_terms(spec)
    density = positive("measurement_density", measurement_density, unit="rad² s")
    if walk == 0.0 and instability == 0.0:
        raise InputError(
            "the specification has neither flicker nor a drifting bias; its filter has no bandwidth to bound at"
        )
    return _natural_frequency(walk, instability**2, density)


def matched_process_noise(spec: GyroSpec, measurement_density: float) -> dict[str, float]:
    """Return white and random-walk noise with which the filter's attitude variance is right, flicker and all, in the steady state.

    The filter's error answers to the rate with ``s/(s² + 2ζω s + ω²)``, so flicker gives the attitude variance
    ``B²/(2πω²) arccos ζ/(ζ √(1 − ζ²))``, and the bound at ω* = ω gives ``B²/(4ζω²)``. Their ratio is
    ``κ(ζ) = (2/π) arccos ζ/√(1 − ζ²)`` (arcosh and ζ² − 1 above ζ = 1): 1, 0.71 and 0.64 at ζ = 0, 0.71 and 1. The bound with κ B² for
    B² is solved for the ω and ζ that it gives the filter.

    Parameters
    ----------
    spec : GyroSpec
    measurement_density : float
        r, rad² s, as for :func:`best_bandwidth`.
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
    """Return κ(ζ) of :func:`matched_process_noise`: the attitude variance that flicker gives over that of its spectral bound."""
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
    """Return σ_v², the PSD of all random walks, and B, of the worst axis each."""
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
    "temperature_coefficient": (("deg_per_hour_per_kelvin", units.DEGREE_PER_HOUR), ("rad_per_s_per_kelvin", 1.0)),
    "bandwidth": tables.HERTZ,
    "damping": tables.RATIO,
    "range": tables.DEGREES_PER_SECOND,
    "rate_resolution": tables.DEGREES_PER_SECOND,
    "sampling_jitter": tables.SECONDS,
    "timestamp_error": tables.SECONDS,
    "timestamp_offset": tables.SECONDS,
    "drop_probability": tables.RATIO,
}
"""Keys of the specification in files."""


def to_table(spec: GyroSpec) -> dict[str, Any]:
    """Return what differs from a perfect gyro as a table for TOML or JSON, units in the key names; exact both ways."""
    return tables.encode(spec, FORM)


def from_table(table: Mapping[str, Any], place: str = "gyro") -> GyroSpec:
    """Return the specification told by a table with units in the key names; unknown keys are refused with the nearest known one."""
    return tables.build(GyroSpec, table, FORM, place)  # type: ignore[no-any-return]


def read_spec(path: str | os.PathLike[str]) -> GyroSpec:
    """Read the specification in the table ``[gyro]`` of a TOML file, such as ``strapdown allan`` writes.

    Raises
    ------
    InputError
        If the file is missing, no TOML, has no such table, or a key that no gyro has.
    """
    return tables.read(path, "gyro", "`strapdown allan` writes one", from_table)
