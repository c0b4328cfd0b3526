"""The gyro error model against closed forms, exact recipes and spectra; data sheets; tables; the filter's noise."""

import dataclasses
import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg, signal, stats

from sims import flicker_in_filter
from strapdown import gyro, units
from strapdown.checks import InputError
from strapdown.gyro import GyroSpec, datasheets, flicker
from strapdown.gyro.temperature import BiasOverTemperature
from strapdown.kernels import gyro_errors
from strapdown.randomness import generator

RNG = np.random.default_rng(5)


def simulate(spec, increments=None, edges=None, *, samples=1000, dt=0.01, seed=1, run=0, **more):
    edges = np.arange(samples + 1) * dt if edges is None else edges
    increments = np.zeros((len(edges) - 1, 3)) if increments is None else increments
    return gyro.simulate(spec, increments, edges, generator(seed, run, "gyro"), **more)


def edges_of(intervals):
    return np.concatenate([[0.0], np.cumsum(intervals)])


def warming(slope):
    """A bias that grows evenly with temperature."""
    coefficients = np.stack([np.zeros(3), np.broadcast_to(slope, 3)])
    return BiasOverTemperature(reference=0.0, span=(-1e3, 1e3), coefficients=coefficients, sigma=np.zeros((2, 3)))


# ------------------------------------------------------------------------------------------------------------- deterministic


def test_a_perfect_gyro_measures_the_truth():
    increments = RNG.normal(size=(700, 3))
    output = simulate(GyroSpec(), increments, edges_of(RNG.uniform(0.001, 1.0, 700)))
    assert np.array_equal(output.increments, increments)
    assert np.array_equal(output.bias, np.zeros((701, 3)))


def test_rate_form_with_every_deterministic_term():
    rate, force = np.array([0.3, -0.2, 0.1]), np.array([1.0, 2.0, 9.0])
    slope = np.array([1e-5, 2e-5, -1e-5])
    spec = GyroSpec(
        turn_on_bias=[1e-3, 2e-3, 3e-3],
        rate_ramp=[1e-4, 0.0, -2e-4],
        scale_factor=[1e-3, 2e-3, -1e-3],
        asymmetry=[1e-4, -2e-4, 3e-4],
        misalignment=[[0.0, 1e-3, 2e-3], [3e-3, 0.0, 4e-3], [5e-3, 6e-3, 0.0]],
        g_sensitivity=RNG.normal(size=(3, 3)) * 1e-5,
        temperature=warming(slope),
    )
    dt = RNG.uniform(0.01, 0.5, 600)
    edges = edges_of(dt)
    temperature = 0.3 * edges
    output = simulate(spec, rate * dt[:, None], edges, specific_force=np.tile(force, (600, 1)), temperature=temperature)
    matrix = np.eye(3) + np.array([[1e-3, 1e-3, 2e-3], [3e-3, 2e-3, 4e-3], [5e-3, 6e-3, -1e-3]])
    middle = 0.5 * (edges[1:] + edges[:-1])[:, None]
    drift = spec.turn_on_bias + spec.rate_ramp * middle + slope * 0.3 * middle
    wanted = matrix @ rate + spec.asymmetry * np.abs(rate) + spec.g_sensitivity @ force + drift
    np.testing.assert_allclose(output.rates, wanted, rtol=1e-11)
    bias = spec.turn_on_bias + (spec.rate_ramp + 0.3 * slope) * edges[:, None]
    np.testing.assert_allclose(output.bias, bias, rtol=1e-12, atol=1e-18)


def test_saturation_clips_the_rate_and_resolution_rounds_it():
    rates, edges = RNG.normal(size=(500, 3)), np.arange(501) * 0.02
    clipped = simulate(GyroSpec(range=0.9), rates * 0.02, edges)
    np.testing.assert_allclose(clipped.rates, np.clip(rates, -0.9, 0.9), rtol=1e-12)
    rounded = simulate(GyroSpec(rate_resolution=0.01), rates * 0.02, edges)
    np.testing.assert_allclose(rounded.rates / 0.01, np.round(rates / 0.01), atol=1e-8)


def test_quantised_increments_are_whole_steps_and_lose_nothing():
    spec = GyroSpec(quantization=1e-5)
    increments = RNG.normal(size=(5000, 3)) * 1e-4
    output = simulate(spec, increments, samples=5000)
    steps = output.increments / spec.quantization_step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    left = np.cumsum(output.increments - increments, axis=0) / spec.quantization_step
    assert np.ptp(left, axis=0).max() <= 1.0 + 1e-6  # the remainder is carried, so the error never grows
    assert np.ptp(left, axis=0).min() > 0.99


def test_lost_samples_are_bridged_at_the_rate_after_the_gap():
    edges = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 6.0])
    increments = np.arange(15.0).reshape(5, 3)
    lost = np.array([False, True, False, False, True])
    bridged, left = gyro.bridge_dropped(increments, edges, lost)
    assert left.tolist() == [0, 1, 3, 4]
    np.testing.assert_array_equal(bridged, [increments[0], increments[2] * 1.5, increments[3]])


def test_jitter_and_stamps():
    edges = np.arange(20_001) * 0.01
    spec = GyroSpec(sampling_jitter=1e-4, timestamp_error=2e-4, timestamp_offset=3e-3)
    true, stamps = gyro.sampling(spec, edges, generator(1, 0, "t"))
    assert np.std(true - edges) == pytest.approx(1e-4, rel=0.03)
    assert np.std(stamps - edges) == pytest.approx(2e-4, rel=0.03)
    assert np.mean(stamps - edges) == pytest.approx(3e-3, abs=1e-5)
    wild, _ = gyro.sampling(GyroSpec(sampling_jitter=3.9e-3), edges, generator(1, 0, "t"))
    assert np.all(np.diff(wild) > 0.0)
    same, also = gyro.sampling(GyroSpec(), edges, generator(1, 0, "t"))
    assert np.array_equal(same, edges)
    assert np.array_equal(also, edges)


# ---------------------------------------------------------------------------------------------------------------- exact noise


def within(value, expected, samples, *, sigmas=4.5):
    """Whether the mean square of Gaussians is within its own scatter of the expected one."""
    return abs(value / expected - 1.0) < sigmas * math.sqrt(2.0 / samples)


@pytest.mark.parametrize("steps", [(1e-3,), (0.1,), (10.0,), (0.01, 1.0, 0.1)], ids=["fast", "even", "slow", "uneven"])
def test_random_walks_have_the_exact_discrete_moments(steps):
    """Also where each interval takes its own variance; one number an axis."""
    white, walk = np.array([0.02, 0.01, 0.03]), np.array([0.01, 0.05, 0.02])
    n = 100_000 if len(steps) == 1 else 180_000
    dt = np.tile(steps, n)
    output = simulate(GyroSpec(angle_random_walk=white, rate_random_walk=walk), edges=edges_of(dt))
    change = np.diff(output.bias, axis=0)
    rest = output.increments - 0.5 * (output.bias[1:] + output.bias[:-1]) * dt[:, None]
    assert np.array_equal(output.bias[0], np.zeros(3))
    for axis in range(3):
        for k, h in enumerate(steps):
            own = slice(k, None, len(steps))
            assert within(np.mean(change[own, axis] ** 2), walk[axis] ** 2 * h, n)
            expected = white[axis] ** 2 * h + walk[axis] ** 2 * h**3 / 12.0
            assert within(np.mean(rest[own, axis] ** 2), expected, n)
        if len(steps) == 1:
            pairs = [(change[:, axis], rest[:, axis]), (change[:, axis], change[:, (axis + 1) % 3])]
            pairs += [(x[:, axis], np.roll(x[:, axis], lag)) for x in (change, rest) for lag in (1, 2, 3)]
            for first, second in pairs:
                assert abs(np.corrcoef(first, second)[0, 1]) * math.sqrt(n) < 4.5


@pytest.mark.parametrize("u", [1e-9, 1e-4, 0.0199, 0.0201, 0.3, 3.0, 40.0])
def test_markov_step_against_closed_forms_in_fifty_digits(u):
    dt, tau = 0.7, 0.35 / u
    decay, step, mean, remainder = gyro_errors.markov_step(dt, tau)
    with mp.workdps(50):
        h, t = mp.mpf(dt), mp.mpf(tau)
        # Covariance of (x, ∫x) from 0 by integrating the impulse responses e^(−s/τ) and τ(1 − e^(−s/τ)), then the conditional moments.
        vxx = t / 2 * (1 - mp.exp(-2 * h / t))
        vxy = t**2 * (1 - mp.exp(-h / t)) ** 2 / 2
        vyy = t**2 * (h - 2 * t * (1 - mp.exp(-h / t)) + t / 2 * (1 - mp.exp(-2 * h / t)))
        assert decay == pytest.approx(float(mp.exp(-h / t)), rel=1e-14)
        assert step == pytest.approx(float(vxx), rel=1e-13)
        assert mean == pytest.approx(float(vxy / vxx), rel=1e-13)
        assert remainder == pytest.approx(float(vyy - vxy**2 / vxx), rel=1e-11)


def test_markov_bias_is_stationary_from_the_first_sample():
    spec = GyroSpec(markov_noise=0.3, markov_correlation_time=2.0)
    runs = np.concatenate([simulate(spec, samples=40, dt=0.5, run=k).bias for k in range(500)], axis=1)
    variance = np.mean(runs**2, axis=1)
    wanted = 0.3**2 * 2.0 / 2.0
    assert np.all(np.abs(variance / wanted - 1.0) < 5.0 * math.sqrt(2.0 / 1500))
    correlation = np.mean(runs[0] * runs[4]) / wanted
    assert correlation == pytest.approx(math.exp(-1.0), abs=5.0 / math.sqrt(1500))


def test_markov_increments_have_the_exact_variance_given_the_ends():
    spec = GyroSpec(markov_noise=0.3, markov_correlation_time=2.0)
    output = simulate(spec, samples=60_000, dt=3.0)
    _, step, mean, remainder = gyro_errors.markov_step(3.0, 2.0)
    ends = output.bias[1:] + output.bias[:-1]
    assert within(np.mean((output.increments - mean * ends) ** 2), 0.09 * remainder, 180_000)
    assert within(np.mean((output.bias[1:] - math.exp(-1.5) * output.bias[:-1]) ** 2), 0.09 * step, 180_000)


def test_infinite_correlation_time_is_a_random_walk():
    output = simulate(GyroSpec(markov_noise=0.3), samples=60_000, dt=0.1)
    steps = np.diff(output.bias, axis=0)
    assert np.array_equal(output.bias[0], np.zeros(3))
    assert within(np.mean(steps**2), 0.09 * 0.1, 180_000)
    assert abs(np.mean(steps[1:] * steps[:-1]) / np.mean(steps**2)) * math.sqrt(180_000) < 4.5
    rest = output.increments - 0.05 * (output.bias[1:] + output.bias[:-1])
    assert within(np.mean(rest**2), 0.09 * 0.1**3 / 12.0, 180_000)


def test_turn_on_bias_is_drawn_anew_for_each_run():
    spec = GyroSpec(turn_on_bias=[1.0, 2.0, 3.0], turn_on_bias_sigma=[0.1, 0.2, 0.3])
    starts = np.array([simulate(spec, samples=1, run=k).bias[0] for k in range(500)])
    np.testing.assert_allclose(starts.mean(axis=0), [1.0, 2.0, 3.0], atol=0.3 * 4.5 / math.sqrt(500))
    np.testing.assert_allclose(starts.std(axis=0), [0.1, 0.2, 0.3], rtol=4.5 / math.sqrt(1000))


def test_each_term_has_a_stream_of_its_own():
    terms = {"angle_random_walk": 1.0, "rate_random_walk": 2.0, "bias_instability": 3.0, "turn_on_bias_sigma": 4.0}
    alone = {name: simulate(GyroSpec(**{name: value})).increments for name, value in terms.items()}
    # (The remainder of the walk within an interval shares the draw of the white noise, as the sum of the two is one Gaussian.)
    together = simulate(
        GyroSpec(**{name: value for name, value in terms.items() if name != "rate_random_walk"})
    ).increments
    parts = sum(part for name, part in alone.items() if name != "rate_random_walk")
    np.testing.assert_allclose(together, parts, rtol=1e-9, atol=1e-12)
    walk = simulate(GyroSpec(**terms)).bias - simulate(GyroSpec(**{**terms, "rate_random_walk": 0.0})).bias
    np.testing.assert_allclose(walk, simulate(GyroSpec(rate_random_walk=2.0)).bias, atol=1e-10)


@pytest.mark.parametrize("term", ["angle_random_walk", "rate_random_walk", "bias_instability", "markov_noise"])
def test_an_axis_without_a_term_has_none_of_its_neighbours(term):
    noise = simulate(GyroSpec(**{term: [1.0, 2.0, 0.0]})).increments
    assert np.any(noise != 0.0, axis=0).tolist() == [True, True, False]


def test_a_run_is_the_same_however_often_and_differs_from_others():
    spec = GyroSpec(angle_random_walk=1.0, rate_random_walk=1.0, bias_instability=1.0)
    first, again = simulate(spec, run=3), simulate(spec, run=3)
    assert np.array_equal(first.increments, again.increments)
    others = [simulate(spec, run=4), simulate(spec, seed=2, run=3)]
    assert all(not np.any(first.increments == other.increments) for other in others)
    # Without flicker, whose filter goes by the length, a longer record begins with the shorter one.
    walks = dataclasses.replace(spec, bias_instability=0.0)
    assert np.array_equal(simulate(walks, samples=700).increments, simulate(walks, samples=5000).increments[:700])


# -------------------------------------------------------------------------------------------------------------------- spectra


def expected_periodogram(covariance, window, frequency):
    """Return the exact mean of |Σ w x e^{−jωk}|²/Σw² of a stationary series with this autocovariance."""
    n = len(window)
    lags = signal.fftconvolve(window, window[::-1])[n - 1 :] / np.sum(window**2)
    terms = np.where(np.arange(n) == 0, 1.0, 2.0) * lags * covariance[:n]
    return np.cos(2.0 * np.pi * np.outer(frequency, np.arange(n))) @ terms


def check_spectrum(series, covariance):
    """Compare the mean periodogram of series (n, runs) with its exact expectation: every bin within its own confidence, two-sided."""
    n, runs = series.shape
    window = signal.windows.hann(n, sym=False)
    frequency = np.fft.rfftfreq(n)[1 : n // 2]
    power = np.abs(np.fft.rfft(series * window[:, None], axis=0)[1 : n // 2]) ** 2 / np.sum(window**2)
    ratio = power.mean(axis=1) / expected_periodogram(covariance, window, frequency)
    bins = len(frequency)
    low, high = stats.chi2.ppf([0.0005 / bins, 1.0 - 0.0005 / bins], 2 * runs) / (2 * runs)
    assert ratio.min() > low
    assert ratio.max() < high
    # All bins together are sharper; neighbouring bins of the Hann window are correlated (a third as many are independent).
    assert abs(ratio.mean() - 1.0) < 4.5 * math.sqrt(3.0 / (bins * runs))
    tenth = bins // 10
    for part in (ratio[:tenth], ratio[-tenth:]):
        assert abs(part.mean() - 1.0) < 4.5 * math.sqrt(3.0 / (tenth * runs))


def records(spec, samples, runs, what):
    return np.concatenate([what(simulate(spec, samples=samples, dt=1.0, run=k)) for k in range(runs)], axis=1)


def test_spectrum_of_quantisation():
    moving = GyroSpec(angle_random_walk=0.05, quantization=1e-4)
    series = records(moving, 1024, 40, lambda o: o.increments)
    check_spectrum(series, np.r_[0.05**2 + 2e-8, -1e-8, np.zeros(1022)])
    rest = GyroSpec(turn_on_bias_sigma=1.0, quantization=1e-4)  # a bias sweeps the remainder evenly; take it away
    series = records(rest, 1024, 40, lambda o: o.increments - o.bias[:-1])
    assert np.mean(np.cumsum(series, axis=0).var(axis=0)) == pytest.approx(1e-8, rel=0.1)


def flicker_difference_covariance(lags):
    """Return the autocovariance of differenced samples with the PSD 1/(2π f) up to Nyquist: ∫ 4 sin²(πf)/(2πf) cos(2πfh) 2 df."""
    fine = 1 << 16
    frequency = (np.arange(fine) + 0.5) / (2 * fine)
    density = 4.0 * np.sin(np.pi * frequency) ** 2 / (2.0 * np.pi * frequency)
    return np.array([np.mean(density * np.cos(2.0 * np.pi * frequency * h)) for h in range(lags)])


def test_spectrum_of_flicker_from_the_record_length_to_nyquist():
    series = records(GyroSpec(bias_instability=0.7), 1025, 60, lambda o: np.diff(o.rates, axis=0))
    check_spectrum(series, 0.49 * flicker_difference_covariance(1024))


def test_flicker_is_stationary_from_the_first_sample():
    wanted = flicker.shaping(50).variance
    series = records(GyroSpec(bias_instability=1.0), 50, 400, lambda o: o.rates)
    variance = np.mean(series**2, axis=1) / wanted
    assert np.all(np.abs(variance - 1.0) < 5.0 * math.sqrt(2.0 / 1200))


def test_flicker_shows_in_the_bias_as_the_mean_of_neighbours():
    output = simulate(GyroSpec(bias_instability=1.0), samples=2000)
    np.testing.assert_allclose(output.bias[1:-1], 0.5 * (output.rates[1:] + output.rates[:-1]), atol=1e-12)
    assert np.all(np.abs(output.bias[[0, -1]]) < 12.0)


@pytest.mark.parametrize("samples", [20, 1000, 10**6, 10**8, 10**9])
def test_shaping_filter_holds_the_spectrum(samples):
    shaping = flicker.shaping(samples)
    frequency = np.geomspace(0.125 / max(samples, 16), 0.5, 5000)
    ratio = shaping.spectrum(frequency) * 2.0 * np.pi * frequency
    assert np.max(np.abs(ratio - 1.0)) < (0.005 if samples <= 10**7 else 0.02)
    assert np.max(np.abs(ratio - 1.0)) > 1e-4


def test_shaping_states_are_stationary():
    shaping = flicker.shaping(10**4)
    P, p = shaping.covariance, shaping.poles
    np.testing.assert_allclose(P, p[:, None] * P * p + 1.0, rtol=1e-7)
    frequency = (np.arange(1 << 18) + 0.5) / (1 << 19)
    assert shaping.variance == pytest.approx(np.mean(shaping.spectrum(frequency)), rel=2e-3)
    starts = shaping.start(np.random.default_rng(1).standard_normal((20_000, 16)))
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(np.cov(starts.T) / np.outer(scale, scale), P / np.outer(scale, scale), atol=0.05)


def test_flicker_needs_even_edges():
    with pytest.raises(InputError, match=r"edges\[5\].*uniform"):
        simulate(GyroSpec(bias_instability=1.0), edges=edges_of(np.r_[np.ones(5), 3.0, np.ones(50)]))


# ------------------------------------------------------------------------------------------------------------------- low-pass


def test_low_pass_answers_a_ramp_as_the_differential_equation_says():
    dt, natural, damping = 0.01, 2.0 * np.pi * 8.0, 0.6
    edges = np.arange(401) * dt
    # Rate 1 + 2t: straight in each interval, so the discretisation is exact but for the ends of the slope's estimate.
    area = edges + edges**2
    output = simulate(GyroSpec(bandwidth=8.0, damping=damping), np.tile(np.diff(area)[:, None], 3), edges)
    A = np.array([[0.0, 1.0, 0.0], [-(natural**2), -2.0 * damping * natural, 0.0], [1.0, 0.0, 0.0]])
    fine = np.linspace(0.0, 4.0, 8_001)
    rate = 1.0 + 2.0 * fine
    _, out, _ = signal.lsim(
        (A, [[0.0], [natural**2], [0.0]], [[0.0, 0.0, 1.0]], [[0.0]]), rate, fine, X0=[1.0 + dt, 0.0, 0.0]
    )
    wanted = np.diff(out[::20])
    np.testing.assert_allclose(output.increments[:, 0], wanted, rtol=1e-7, atol=1e-10)
    late = 2.0 * damping / natural  # a ramp comes out later by 2ζ/ω
    np.testing.assert_allclose(output.rates[-1], 1.0 + 2.0 * (4.0 - 0.5 * dt - late), rtol=1e-9)


@pytest.mark.parametrize("frequency", [1.0, 5.0, 12.0])
def test_low_pass_frequency_response(frequency):
    dt, natural, damping = 0.002, 10.0, 0.5
    edges = np.arange(5001) * dt
    s = 2j * np.pi * frequency
    response = 1.0 / ((s / (2 * np.pi * natural)) ** 2 + 2.0 * damping * s / (2 * np.pi * natural) + 1.0)
    area = np.exp(s * edges) / s
    spec = GyroSpec(bandwidth=natural, damping=damping)
    got = simulate(spec, np.tile(np.diff(area).real[:, None], 3), edges).increments[2500:, 0]
    wanted = np.diff(response * area).real[2500:]
    assert np.max(np.abs(got - wanted)) < 2e-3 * np.max(np.abs(wanted))


@pytest.mark.parametrize("x", [0.01, 0.3, 3.0, 30.0])
def test_low_pass_noise_by_an_independent_integral(x):
    damping, dt = 0.7, 0.5
    natural = x / dt
    _, factor = gyro.simulation.low_pass_step(natural, damping, dt)
    A = np.array([[0.0, 1.0, 0.0], [-(natural**2), -2.0 * damping * natural, 0.0], [1.0, 0.0, 0.0]])
    nodes, weights = np.polynomial.legendre.leggauss(120)
    responses = [linalg.expm(A * (0.5 * dt * (1.0 + node))) @ [0.0, natural**2, 0.0] for node in nodes]
    wanted = sum(0.5 * dt * w * np.outer(r, r) for w, r in zip(weights, responses, strict=True))
    scale = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(factor @ factor.T / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=2e-9)


def test_low_pass_white_noise_is_stationary_and_keeps_the_random_walk_of_the_angle():
    spec = GyroSpec(angle_random_walk=0.2, bandwidth=5.0)
    runs = np.stack([simulate(spec, samples=400, dt=0.01, run=k).increments for k in range(150)])
    by_sample = np.mean(runs**2, axis=(0, 2))
    assert np.all(np.abs(by_sample / by_sample.mean() - 1.0) < 6.0 * math.sqrt(2.0 / 450))
    # Over 4 s the angle spreads by σ_v² (t − 3/(2ω) …): ∫|H|² sin²: by quadrature.
    f = np.linspace(1e-4, 60.0, 600_000)
    gain = 1.0 / ((1.0 - (f / 5.0) ** 2) ** 2 + (2.0 * spec.damping * f / 5.0) ** 2)
    wanted = 2.0 * np.trapezoid(0.04 * gain * (np.sin(np.pi * f * 4.0) / (np.pi * f)) ** 2, f)
    assert within(np.mean(runs.sum(axis=1) ** 2), wanted, 450)


# ---------------------------------------------------------------------------------------------------- specification and tables


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(1e-12, 1e3), min_size=8, max_size=8), st.booleans())
def test_a_table_holds_the_specification_to_the_last_bit(values, by_axis):
    a, b, c, d, e, f, g, h = values
    p, q, r, s, t, u, _, _ = (1e-3 * value for value in values)  # ratios are at most 1
    spec = GyroSpec(
        angle_random_walk=np.array([a, b, c]) if by_axis else a,
        rate_random_walk=b,
        bias_instability=c,
        quantization=d,
        rate_ramp=-e,
        markov_noise=f,
        markov_correlation_time=g,
        turn_on_bias=[a, -b, c],
        scale_factor=[s, t, -u],
        misalignment=[[0.0, p, q], [r, 0.0, s], [t, u, 0.0]],
        g_sensitivity=np.full((3, 3), h),
        range=h,
        drop_probability=a / (1.0 + a) * 0.9,
    )
    assert gyro.from_table(gyro.to_table(spec)) == spec
    assert gyro.from_table(gyro.to_table(spec)) != dataclasses.replace(spec, damping=0.123)


def test_tables_are_readable():
    spec = gyro.from_table({"angle_random_walk_deg_per_sqrt_hour": 0.15, "scale_factor_ppm": [500.0, 0.0, 0.0]})
    assert spec.angle_random_walk == 0.15 * math.pi / 10800.0
    assert gyro.to_table(spec)["angle_random_walk_deg_per_sqrt_hour"] == 0.15


# ----------------------------------------------------------------------------------------------------------------- data sheets


@pytest.mark.parametrize(
    ("name", "unit", "factor"),
    [
        ("arw", "deg/sqrt(h)", math.pi / 10800.0),
        ("arw", "°/√h", math.pi / 10800.0),
        ("arw", "deg/s/sqrt(Hz)", math.pi / 180.0),
        ("arw", "°/s/√Hz", math.pi / 180.0),
        ("arw", "deg/h/sqrt(Hz)", math.pi / 648000.0),
        ("arw", "mdeg/s/√Hz", math.pi / 180000.0),
        ("arw", "°/s/rtHz", math.pi / 180.0),
        ("arw", "deg/rt(h)", math.pi / 10800.0),
        ("arw", "deg/√(h)", math.pi / 10800.0),
        ("arw", "dps/√Hz", math.pi / 180.0),
        ("arw", "mdps/sqrt(Hz)", math.pi / 180000.0),
        ("bias_instability", "°/h", math.pi / 648000.0),
        ("bias_instability", "deg/hr", math.pi / 648000.0),
        ("rrw", "deg/h/sqrt(h)", math.pi / 648000.0 / 60.0),
        ("rrw", "deg/h^1.5", math.pi / 648000.0 / 60.0),
        ("rate_ramp", "deg/h/h", math.pi / 648000.0 / 3600.0),
        ("quantization", "arcsec", math.pi / 648000.0),
        ("range", "deg/s", math.pi / 180.0),
    ],
)
def test_units_convert(name, unit, factor):
    field = datasheets._QUANTITIES[name][0]
    for number in (1.0, 0.15, 3e-4):
        value = getattr(datasheets.from_datasheet(**{name: f"{number} {unit}"}), field)
        assert value == pytest.approx(number * factor, rel=4e-16)


SHEET = datasheets.from_datasheet


def sampled(**errors):
    return gyro.sampling(GyroSpec(**errors), np.arange(11) * 0.01, generator(1, 0, "t"))


# fmt: off
REFUSED = [
    *((GyroSpec, {field: value}, field) for field, value in (
        ("angle_random_walk", -1.0), ("bias_instability", [1.0, -1.0, 0.0]), ("misalignment", np.eye(3)), ("bandwidth", 0.0),
        ("drop_probability", 1.0), ("scale_factor", [1.0]), ("markov_correlation_time", -3.0), ("timestamp_offset", np.nan),
    )),
    (GyroSpec, {"scale_factor": -300.0}, r"scale_factor is up to 300.*is it in ppm"),
    (GyroSpec, {"misalignment": 5.0 * (1.0 - np.eye(3))}, r"misalignment is up to 5 .*is it in mrad"),
    (gyro.from_table, {"table": {"bandwith_hz": 3.0}}, "did you mean 'bandwidth_hz'"),
    (gyro.from_table, {"table": {"range_deg_per_s": 3.0, "range_rad_per_s": 3.0}}, "second time"),
    (gyro.from_table, {"table": {"range_deg_per_s": "3 deg/s"}}, "unit is in the key"),
    (simulate, {"spec": GyroSpec(g_sensitivity=np.eye(3))}, "specific_force"),
    (simulate, {"spec": GyroSpec(temperature=warming(1.0))}, "temperature"),
    (gyro.process_noise, {"spec": GyroSpec(bias_instability=1.0)}, "bandwidth"),
    (sampled, {"sampling_jitter": 0.011}, r"sampling_jitter is 0.011 s; it must be below 0.4 sample intervals, 0.004 s"),
    (sampled, {"timestamp_error": 0.011}, "timestamp_error is 0.011 s"),
    (SHEET, {"arw": "0.15 deg/h"}, r"arw is '0.15 deg/h' \(in radian / second\).*deg/sqrt\(h\)"),
    (SHEET, {"bias_instability": "0.5 deg/sqrt(h)"}, "bias_instability.*deg/h"),
    (SHEET, {"rrw": "0.5 deg/sqrt(h)"}, "rrw.*deg/h/sqrt"),
    (SHEET, {"arw": "0.15"}, "no unit"),
    (SHEET, {"arw": "0.15 1/sqrt(h)"}, "radian / second"),
    (SHEET, {"arw": "0.15 bananas"}, "bananas"),
    (SHEET, {"arw": "deg//h"}, "not a quantity"),
    (SHEET, {"arw": "0,34 deg/sqrt(h)"}, "decimal point"),
    (SHEET, {"range": "1,000 deg/s"}, "decimal point"),
    (SHEET, {"bandwidth": "50 /m"}, "bandwidth.*Hz"),
    (SHEET, {"arw": "0.3 – 0.5 deg/sqrt(h)"}, "more than a number"),
    (SHEET, {"arw": "9**9**9 deg/sqrt(h)"}, "not a quantity"),
    (SHEET, {"arw": "nan deg/sqrt(h)"}, "begin with a number"),
    (SHEET, {"arw": 0.15}, r"as text with its unit, such as deg/sqrt\(h\) or deg/s/sqrt\(Hz\)$"),
    (SHEET, {"bandwidth": "50 rad/s"}, "bandwidth.*Hz"),
    (SHEET, {"awr": "1 deg/h"}, "did you mean 'arw'"),
    (SHEET, {"quantization": "1 arcsec", "angle_resolution": "1 arcsec"}, "the same quantity"),
]
# fmt: on


@pytest.mark.parametrize(("call", "arguments", "message"), REFUSED, ids=[row[2] for row in REFUSED])
def test_what_makes_no_sense_is_refused_by_name(call, arguments, message):
    with pytest.raises(InputError, match=message):
        call(**arguments)


def test_sheet_figures_reach_their_fields():
    spec = datasheets.from_datasheet(
        angle_resolution="1 arcsec",
        scale_factor="500 ppm",
        misalignment="1 mrad",
        g_sensitivity="1 deg/h/g",
        turn_on_bias="3 deg/h",
    )
    assert spec.quantization_step == pytest.approx(units.ARCSECOND, rel=1e-15)
    np.testing.assert_allclose(spec.scale_factor, 5e-4, rtol=1e-15)
    np.testing.assert_allclose(spec.misalignment, 1e-3 * (1.0 - np.eye(3)), rtol=1e-15)
    np.testing.assert_allclose(
        spec.g_sensitivity, units.DEGREE_PER_HOUR / units.STANDARD_GRAVITY * np.eye(3), rtol=1e-15
    )
    assert spec.turn_on_bias_sigma == pytest.approx(3.0 * units.DEGREE_PER_HOUR, rel=1e-15)


STATED = {
    "mpu-9250": {"arw": "0.01 deg/s/sqrt(Hz)", "range": "250 deg/s"},
    "bmi088": {"arw": "0.014 deg/s/sqrt(Hz)", "range": "2000 deg/s"},
    "adis16470": {"arw": "0.008 deg/s/sqrt(Hz)", "bias_instability": "8 deg/h", "range": "2000 deg/s"},
    "adis16467-1": {
        "arw": "0.15 deg/sqrt(h)",
        "bias_instability": "2 deg/h",
        "range": "125 deg/s",
        "misalignment": "0.05 deg",
    },
    "stim300": {
        "arw": "0.15 deg/sqrt(h)",
        "bias_instability": "0.5 deg/h",
        "range": "400 deg/s",
        "scale_factor": "500 ppm",
        "misalignment": "1 mrad",
        "g_sensitivity": "1 deg/h/g",
    },
    "hg4930": {
        "arw": "0.04 deg/sqrt(h)",
        "bias_instability": "0.25 deg/h",
        "turn_on_bias": "7 deg/h",
        "range": "200 deg/s",
    },
    "dsp-1760": {"arw": "0.012 deg/sqrt(h)", "bias_instability": "0.05 deg/h", "range": "490 deg/s"},
    "hg9900": {"arw": "0.002 deg/sqrt(h)", "turn_on_bias": "0.0035 deg/h", "scale_factor": "5 ppm"},
}
"""Figures of the data sheets in their own units."""


@pytest.mark.parametrize("name", datasheets.PRESETS)
def test_the_stated_figures_of_a_preset_are_those_of_its_sheet(name):
    sheet, stated = datasheets.from_datasheet(**STATED[name]), gyro.from_table(datasheets.PRESETS[name].stated)
    for field, value in vars(sheet).items():
        if isinstance(value, (float, np.ndarray)):
            np.testing.assert_allclose(getattr(stated, field), value, rtol=1e-14, err_msg=field)


def test_presets_go_from_consumer_to_navigation_grade():
    walks = [preset.spec.angle_random_walk for preset in datasheets.PRESETS.values()]
    assert len(walks) >= 6
    assert max(walks) / min(walks) > 100.0
    for name, preset in datasheets.PRESETS.items():
        assert preset.name == name
        assert preset.document
        assert "angle_random_walk_deg_per_sqrt_hour" in preset.stated
        assert not set(preset.stated) & set(preset.assumed)
        spec = preset.spec
        assert spec.bias_instability > 0.0
        assert spec.rate_random_walk > 0.0
        simulate(spec, samples=20, dt=1.0 / preset.rate, specific_force=np.zeros((20, 3)))


# ------------------------------------------------------------------------------------------------------------ noise of the filter


def test_process_noise_without_flicker_is_the_gyro_s_own():
    spec = GyroSpec(angle_random_walk=[1.0, 2.0, 3.0], rate_random_walk=3.0, markov_noise=4.0)
    assert gyro.process_noise(spec) == {"angle_random_walk": 3.0, "rate_random_walk": 5.0}


@pytest.mark.parametrize("corner", [1e-3, 1.0, 30.0])
def test_the_bound_is_nowhere_below_the_gyro_and_touches_once(corner):
    spec = GyroSpec(angle_random_walk=0.3, rate_random_walk=0.1, bias_instability=0.7)
    noise = gyro.process_noise(spec, bandwidth=corner)
    w = corner * np.geomspace(1e-4, 1e4, 8001)
    own = spec.angle_random_walk**2 + spec.bias_instability**2 / w + spec.rate_random_walk**2 / w**2
    bound = noise["angle_random_walk"] ** 2 + noise["rate_random_walk"] ** 2 / w**2
    slack = (bound - own) / (spec.bias_instability**2 / w)
    assert np.all(slack > -1e-9 * bound * w)
    assert abs(slack[4000]) < 1e-9 * bound[4000] * w[4000]
    assert np.all(np.delete(slack, slice(3900, 4101)) > 1e-3)


@pytest.mark.parametrize("damping", [0.01, 0.5, 0.999999, 1.0000001, 1.3, 40.0])
def test_flicker_share_by_quadrature(damping):
    with mp.workdps(30):
        z = mp.mpf(damping)
        integral = mp.quad(lambda v: 1 / ((1 - v) ** 2 + 4 * z * z * v), [0, 0.5, 0.9, 1, 1.1, 2, 10, 1e3, 1e6, mp.inf])
        assert gyro.filter_noise.flicker_share(damping) == pytest.approx(
            float(integral / (2 * mp.pi) * 4 * z), rel=1e-8
        )


@pytest.mark.parametrize("white", [1e-3, 0.3, 10.0])
def test_matched_noise_makes_the_filter_s_variance_the_actual_one(white):
    spec = GyroSpec(angle_random_walk=white, rate_random_walk=0.05, bias_instability=0.4)
    density = 0.7
    noise = gyro.matched_process_noise(spec, density)
    own = noise["angle_random_walk"] ** 2, noise["rate_random_walk"] ** 2
    P = linalg.solve_continuous_are([[0.0, 0.0], [1.0, 0.0]], [[1.0], [0.0]], np.diag(own), [[density]])
    gain = P[:, 0] / density
    w = np.geomspace(1e-7, 1e7, 400_001)
    s = 1j * w
    bottom = np.abs(s * s + gain[0] * s - gain[1]) ** 2 if gain[1] < 0.0 else np.abs(s * s + gain[0] * s + gain[1]) ** 2
    rates = white**2 + 0.4**2 / w + 0.05**2 / w**2
    error = (w**2 * rates + density * np.abs(gain[0] * s + abs(gain[1])) ** 2) / bottom
    assert np.trapezoid(error, w) / np.pi == pytest.approx(P[0, 0], rel=1e-4)


def test_filters_on_presets_with_flicker(tmp_path):
    """Control, matched and augmented are consistent, and its own noise alone is not."""
    result = flicker_in_filter.main(presets=("mpu-9250",), runs=24, duration=300.0, rate=20.0, out=tmp_path)
    (blind,) = result.outcomes
    mean, scatter, rms = blind.anees, blind.scatter, blind.rms
    for name in ("control", "matched", "augmented"):
        assert abs(mean[name] - 1.0) < 4.0 * scatter[name], name
    assert mean["own"] > max(mean["matched"], 1.0 + 3.0 * scatter["own"])
    assert rms["augmented"] <= 1.005 * rms["matched"] <= 1.03 * rms["own"]
    assert (tmp_path / "flicker.png").exists()
