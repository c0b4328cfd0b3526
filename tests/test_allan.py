"""Allan deviation against allantools and plain sums; noise identification against records of known noise.

The records come from this file's own simulator, not from the package's gyro.
"""

import itertools
import math
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import allantools
import numpy as np
import pytest
from allantools.ci import edf_greenhall
from numpy.testing import assert_allclose
from scipy.fft import dct, idct
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import chi2, norm

from sims import allan as sim
from strapdown import allan, units
from strapdown.allan import misfit
from strapdown.checks import InputError
from strapdown.kernels.allan import accumulate, second_difference_squares
from strapdown.kernels.machine import compiled

# Records of known noise


def flicker(generator, samples):
    """Unit flicker, two-sided PSD 1/(2π ν) up to Nyquist: spectral lines of a 16 times longer period (Timmer & König 1995)."""
    length = 16 * samples
    frequency = np.arange(1, length // 2 + 1) / length
    lines = np.zeros(length // 2 + 1, dtype=complex)
    size = np.sqrt(length / (2.0 * np.pi * frequency))
    lines[1:] = (
        size * (generator.standard_normal(length // 2) + 1j * generator.standard_normal(length // 2)) / math.sqrt(2.0)
    )
    lines[-1] = lines[-1].real * math.sqrt(2.0)
    return np.fft.irfft(lines, length)[:samples]


def simulate(seed, samples, dt, *, Q=0.0, N=0.0, B=0.0, K=0.0, R=0.0):
    """Averaged-rate samples; the quantised angle carries its remainder, so the rates are differences of a rounded angle."""
    generator = np.random.default_rng(seed)
    rate = R * dt * np.arange(samples)
    rate += N / math.sqrt(dt) * generator.standard_normal(samples)
    bias = np.concatenate([[0.0], np.cumsum(K * math.sqrt(dt) * generator.standard_normal(samples))])
    rate += 0.5 * (bias[1:] + bias[:-1]) + K * math.sqrt(dt / 12.0) * generator.standard_normal(samples)
    if B:
        rate += B * flicker(generator, samples)
    if Q:
        step = Q * math.sqrt(12.0)
        angle = np.concatenate([[0.0], np.cumsum(rate * dt)]) + generator.uniform(0.0, step)
        rate = np.diff(np.round(angle / step) * step) / dt
    return rate


def corners(samples, first, second, quantization=0.577):
    """Coefficients (dt = 1) whose flicker lies between ``first`` and ``second`` cycles a record; a step is 2 N of quantisation."""
    N = math.sqrt(samples / (2.0 * math.pi * first))
    return {"Q": quantization * N, "N": N, "B": 1.0, "K": math.sqrt(2.0 * math.pi * second / samples)}


NOISES = {2: {"Q": 1.0}, 0: {"N": 1.0}, -1: {"B": 1.0}, -2: {"K": 1.0}}


def pure(alpha, seed, samples):
    if alpha == 2:  # white phase, without the rounding that needs other noise to be white
        return np.diff(np.random.default_rng(seed).standard_normal(samples + 1))
    return simulate(seed, samples, 1.0, **NOISES[alpha])


# Allan deviation


@pytest.mark.parametrize(
    ("samples", "noise"),
    [*itertools.product([7, 100, 20_001], [{"N": 1.0}, {"K": 0.1}, {"N": 1.0, "B": 1.0, "R": 1e-3}])],
)
def test_deviation_equals_allantools(samples, noise):
    dt = 0.01
    record = np.stack([simulate(seed, samples, dt, **noise) + 5.0 for seed in range(3)], axis=1)
    m = np.unique(np.geomspace(1, samples // 2, 20).astype(int))
    result = allan.allan_deviation(record, dt, taus=m * dt)
    assert_allclose(result.taus, m * dt, rtol=1e-14)
    for axis in range(3):
        phase = np.concatenate([[0.0], np.cumsum(record[:, axis] - record[:, axis].mean())]) * dt
        expected = allantools.oadev(phase, 1.0 / dt, "phase", taus=m * dt)
        # allantools drops taus with a single difference; compare those it kept.
        kept = np.isin(m, np.round(expected[0] / dt).astype(int))
        assert kept.sum() >= len(m) - 1
        assert_allclose(result.deviation[axis, kept], expected[1], rtol=1e-12)


def test_increments_and_rates_give_the_same():
    dt = 0.02
    rate = simulate(3, 3000, dt, N=1e-3, K=1e-4)
    a, b = allan.allan_deviation(rate, dt), allan.allan_deviation(rate * dt, dt, kind="increments")
    assert_allclose(b.deviation, a.deviation, rtol=1e-10)


def test_kernels_compiled_and_plain_agree_with_exact_sums():
    generator = np.random.default_rng(5)
    rate = generator.standard_normal(3000) * 10.0 ** generator.uniform(-8, 8, 3000)
    plain, fast = np.empty(3001), np.empty(3001)
    accumulate(rate, 0.25, plain)
    compiled(accumulate)(rate, 0.25, fast)
    assert np.array_equal(plain, fast)
    exact = [math.fsum(rate[:k] - 0.25) for k in range(0, 3001, 50)]
    assert_allclose(plain[::50], exact, rtol=2.3e-16)
    multiples = np.array([1, 3, 500, 1500])
    expected = []
    for m in multiples:
        differences = (
            plain[2 * m :] - plain[m : len(plain) - m] - (plain[m : len(plain) - m] - plain[: len(plain) - 2 * m])
        )
        expected.append(math.fsum(differences**2))
    for function, width in ((second_difference_squares, 8), (compiled(second_difference_squares), 64)):
        squares = np.empty(4)
        function(plain, multiples, np.empty(width), np.empty(4), squares)
        assert_allclose(squares, expected, rtol=1e-14)


def test_sums_keep_their_digits_over_a_long_record():
    rate = np.full(500_001, 0.1)  # not a binary fraction: a plain running sum drifts
    phase, squares = np.empty(len(rate) + 1), np.empty(1)
    compiled(accumulate)(rate, 0.0, phase)
    assert phase[-1] == math.fsum(rate)
    phase = np.random.default_rng(6).uniform(0.9, 1.1, 500_003) * np.resize([1.0, -1.0], 500_003)
    compiled(second_difference_squares)(phase, np.array([1]), np.empty(1), np.empty(1), squares)
    assert_allclose(squares[0], math.fsum(((phase[2:] - phase[1:-1]) - (phase[1:-1] - phase[:-2])) ** 2), rtol=5e-16)


ANALYSES = """
import threading
from pathlib import Path

import numpy as np

from strapdown import allan
from strapdown.consistency.timeaverage import effective_samples

values = np.random.default_rng(1).standard_normal(40_000)
gappy = np.where(np.arange(len(values)) == 20_000, np.nan, values)


def time_of_other_threads():
    tasks = [task for task in Path("/proc/self/task").iterdir() if int(task.name) != threading.get_native_id()]
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks)


analyses = (
    lambda: allan.allan_deviation(values, 0.01),
    lambda: allan.allan_deviation(gappy, 0.01),
    lambda: allan.fit_noise(gappy, 0.01, terms=allan.TERMS[1:2]),
    lambda: allan.temperature.fit_temperature(values[:20_000], np.linspace(20.0, 30.0, 20_000), 0.01, order=2),
    lambda: effective_samples(np.resize(values, (10_000, 20))),
)
for call in analyses:
    call()  # compiles and imports
# By BLAS, whose threads go on for a while; often, because on a busy machine one may be over before they begin.
for call in (*analyses, lambda: [np.linalg.qr(np.resize(values, (10_000, 20))) for _ in range(50)]):
    before = time_of_other_threads()
    call()
    print(time_of_other_threads() - before)
"""
"""Prints the CPU time, ns, that other threads of the process take for a factorisation by BLAS and for analyses of long records."""


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="CPU time of threads is read from Linux's /proc")
def test_long_sums_wake_no_threads_of_blas():
    """On a busy machine they made the modified deviation 20 times slower."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    said = subprocess.run([sys.executable, "-c", ANALYSES], env=environment, capture_output=True, text=True, check=True)
    *times, of_blas = map(int, said.stdout.split())
    assert of_blas > 1e6
    assert max(times) < 1e6, times


def test_default_taus_and_rounding():
    result = allan.allan_deviation(np.random.default_rng(1).standard_normal(1000), 0.5)
    assert result.taus[0] == 0.5
    assert result.taus[-1] == 333 * 0.5
    assert np.all(np.diff(result.taus) > 0.0)
    rounded = allan.allan_deviation(np.random.default_rng(1).standard_normal(1000), 0.5, taus=[10.1, 1.0, 9.9])
    assert_allclose(rounded.taus, [1.0, 10.0])


# Confidence


def by_definition(alpha, samples, m):
    """2 E²/Var of the mean squared difference, from the covariance matrix of the phase, summed in full."""
    k = np.arange(samples + 1)
    lag = np.abs(k[:, None] - k[None, :]).astype(float)
    log = np.log(np.where(lag > 0, lag, 1.0))
    phase = {2: (lag == 0) * 1.0, 0: -lag, -1: lag**2 * log, -2: lag**3}[alpha]
    rows = np.arange(samples + 1 - 2 * m)
    difference = np.zeros((len(rows), samples + 1))
    for j, weight in enumerate([1.0, -2.0, 1.0]):
        difference[rows, rows + j * m] = weight
    covariance = difference @ phase @ difference.T
    return np.trace(covariance) ** 2 / np.sum(covariance**2)


@pytest.mark.parametrize("alpha", [2, 1, 0, -1, -2])
@pytest.mark.parametrize(("samples", "m"), [(100_000, 100), (100_000, 1003), (100_000, 20_000), (3000, 700)])
def test_degrees_of_freedom_against_greenhall(alpha, samples, m):
    expected = edf_greenhall(alpha, 2, m, samples + 1, overlapping=True, modified=False)
    # Greenhall's own shortcuts for long averages are good to one or two percent.
    assert_allclose(allan.equivalent_degrees_of_freedom(alpha, samples, m), expected, rtol=0.02)


@pytest.mark.parametrize("alpha", [1, 0, -1, -2])
def test_degrees_of_freedom_do_not_jump_where_the_sum_goes_over_from_lags_to_cells(alpha):
    """Beyond m = 1000 cells of several lags are summed; the third differences of a smooth function of m are small."""
    degrees = [allan.equivalent_degrees_of_freedom(alpha, 20_000, m) for m in range(998, 1004)]
    assert np.abs(np.diff(degrees, n=3)).max() < 1e-5 * degrees[0]


@pytest.mark.parametrize("m", [1, 4, 30, 60, 90])
@pytest.mark.parametrize("alpha", NOISES)
def test_degrees_of_freedom_by_definition(alpha, m):
    degrees = allan.equivalent_degrees_of_freedom(alpha, 200, m)
    assert_allclose(degrees, by_definition(alpha, 200, m), rtol=2e-3)


BANDS = {
    2: lambda taus: np.sqrt(3.0) / taus,
    0: lambda taus: taus**-0.5,
    -1: lambda taus: np.sqrt(allan.flicker_variance(taus)),
    -2: lambda taus: np.sqrt(taus / 3.0),
}
"""Closed forms of the deviations of unit noises."""


@pytest.mark.parametrize("alpha", BANDS)
def test_band_covers(alpha):
    taus = np.array([1.0, 8.0, 60.0])
    truth, inside = BANDS[alpha](taus), np.zeros(3)
    for seed in range(200):
        record = pure(alpha, [seed, 2], 600)
        result = allan.allan_deviation(record, 1.0, taus=taus)
        inside += (result.lower[0] <= truth) & (truth <= result.upper[0])
    assert_allclose(chi2.cdf(result.edf * (result.deviation / result.lower) ** 2, result.edf), 0.975)
    assert_allclose(chi2.cdf(result.edf * (result.deviation / result.upper) ** 2, result.edf), 0.025)
    # At 60 samples, ten blocks, the noise type is the one found at 8; a wrong one widens or narrows the band a little.
    assert np.all(inside >= 0.90 * 200)
    assert np.all(inside <= 199)


@pytest.mark.parametrize("alpha", NOISES)
def test_noise_type_is_identified(alpha):
    result = allan.allan_deviation(pure(alpha, [9, 3], 30_000), 1.0, taus=[2.0, 5.0, 20.0, 60.0, 9000.0])
    assert set(result.noise_type[0]) == {allan.NOISE_TYPES[alpha]}


def test_noise_of_few_averages_is_taken_for_no_whiter_than_that_of_many():
    """White noise by 31 to 127 averages passes for quantisation as often as not, with far too many degrees of freedom."""
    for seed in range(10):
        types = allan.allan_deviation(pure(0, [seed, 6], 6000), 1.0, taus=np.arange(6.0, 200.0, 10.0)).noise_type[0]
        assert not {"quantization", "flicker angle"} & set(types[5:])


# Models


def averaged_random_walk(samples):
    """Covariance of averages over unit intervals of a Wiener process: ∫∫ min(s, t)."""
    k = np.arange(samples)
    matrix = np.minimum(k[:, None], k[None, :]) + 0.5
    matrix[k, k] = k + 1.0 / 3.0
    return matrix


def quantization_covariance(samples):
    difference = np.diff(np.eye(samples + 1), axis=0)
    return difference @ difference.T


def flicker_covariance(samples):
    """∫ (cos 2πνk − 1)/ν dν/π over the band, by quadrature."""
    gamma = [
        quad(lambda v, k=k: (math.cos(2 * math.pi * v * k) - 1.0) / v, 0.0, 0.5, limit=200)[0] / math.pi
        for k in range(samples)
    ]
    k = np.arange(samples)
    return np.array(gamma)[np.abs(k[:, None] - k[None, :])]


COVARIANCES = {
    "quantization": quantization_covariance,
    "angle_random_walk": np.eye,
    "bias_instability": flicker_covariance,
    "rate_random_walk": averaged_random_walk,
}


@pytest.mark.parametrize("samples", [17, 40])
@pytest.mark.parametrize("term", COVARIANCES)
def test_spectrum_of_the_cosine_transform_is_exact(term, samples):
    rows = dct(np.eye(samples), axis=0, norm="ortho")
    transformed = (rows @ COVARIANCES[term](samples) @ rows.T)[1:, 1:]
    expected = allan.spectrum.expected_power(term, samples, 1.0, np.arange(1, samples))
    assert_allclose(np.diag(transformed), expected, rtol=1e-9)
    if term in ("angle_random_walk", "rate_random_walk"):  # independent coefficients: nothing off the diagonal
        assert_allclose(transformed, np.diag(expected), atol=1e-10 * expected.max())
    ramp = rows[1:] @ np.arange(samples)
    assert_allclose(allan.spectrum.ramp_coefficients(samples, np.arange(1, samples)), ramp, atol=1e-11)


def test_flicker_spectrum_of_long_records_continues_that_of_short_ones():
    j = np.array([1, 2, 3, 10, 100, 5000])
    short = allan.spectrum.expected_power("bias_instability", 1 << 16, 1.0, j) / (1 << 16)
    long = allan.spectrum.expected_power("bias_instability", 1 << 22, 1.0, j) / (1 << 22)
    assert_allclose(long, short, rtol=1e-4)
    j = np.array([8190, 8191, 8192, 8193])
    power = allan.spectrum.expected_power("bias_instability", 1 << 22, 1.0, j) * j
    assert_allclose(power / power[0], 1.0, rtol=1e-4)
    # Its Allan variance: of few samples below, of many the limit.
    assert_allclose(allan.flicker_variance([4097]), allan.flicker_variance([4096]), rtol=1e-6)
    assert_allclose(allan.flicker_variance([10**7]), 2.0 * math.log(2.0) / math.pi, rtol=1e-9)


@pytest.mark.parametrize("m", [1, 2, 5, 12, 50])
def test_model_is_exact_for_averaged_samples(m):
    """Also at one sample: K²τ/3 holds for averages of a random walk (for point samples it would be K²dt (2m² + 1)/(6m))."""
    samples = 2 * m
    combination = np.zeros(samples)
    combination[:m], combination[m : 2 * m] = -1.0 / m, 1.0 / m
    for term, matrix in COVARIANCES.items():
        expected = math.sqrt(0.5 * combination @ matrix(samples) @ combination)
        assert_allclose(
            allan.model_deviation({term: 2.0}, [0.3 * m], 0.3)[term] * _unit(term, 0.3), 2.0 * expected, rtol=1e-8
        )
    ramp = 0.5 * (combination @ np.arange(samples)) ** 2
    assert_allclose(
        allan.model_deviation({"rate_ramp": 3.0}, [m * 1.0], 1.0)["total"], 3.0 * math.sqrt(ramp), rtol=1e-12
    )


def _unit(term, dt):
    """Take a deviation at sample interval dt to what unit intervals give."""
    powers = {"quantization": 1.0, "angle_random_walk": 0.5, "bias_instability": 0.0, "rate_random_walk": -0.5}
    return dt ** powers[term]


# Fit


def error_of(fit):
    """Standard errors by the 95 % intervals of what is supported (axes, terms)."""
    return np.where(fit.supported, 0.5 * (fit.upper - fit.lower) / 1.96, np.nan)


# Studies


def coverage(seeds, samples, first, second, ramp=0.0):
    """Return, by seed and term (Q, N, B, K, R): truth inside the interval, supported, estimate and standard error over truth."""
    truth = {**corners(samples, first, second), "R": 0.0}
    truth["R"] = ramp * truth["K"] / math.sqrt(samples)
    wanted = np.array(list(truth.values()))
    inside, supported, ratio, error = [], [], [], []
    for seed in range(seeds):
        fit = allan.fit_noise(simulate([seed, 7], samples, 1.0, **truth), 1.0)
        inside.append((fit.lower[0] <= wanted) & (wanted <= fit.upper[0]))
        supported.append(fit.supported[0])
        present = np.where(wanted > 0.0, wanted, np.nan)
        ratio.append(fit.estimate[0] / present)
        error.append(error_of(fit)[0] / present)
    return np.array(inside), np.array(supported), np.array(ratio), np.array(error)


@pytest.mark.parametrize(
    ("seeds", "samples", "first", "least", "most"),
    [(24, 8192, 150.0, 0.79, 1.0), pytest.param(200, 1 << 14, 200.0, 0.91, 0.98, marks=pytest.mark.slow)],
)
def test_intervals_cover_with_a_ramp_and_errors_are_as_stated(seeds, samples, first, least, most):
    """95 % of 24 is 22.8; 18 or fewer has a chance of 0.6 %. A standard deviation from 24 is within 37 % but for a chance of 1 %."""
    inside, supported, ratio, error = coverage(seeds, samples, first, 20.0, ramp=20.0)
    assert np.all((inside.mean(axis=0) >= least) & (inside.mean(axis=0) <= most))
    assert 0.898 <= inside.mean() <= 0.995
    assert np.all(supported.mean(axis=0) > 0.9)
    relative = np.sqrt(np.nanmean((ratio - 1.0) ** 2, axis=0) / np.nanmean(error**2, axis=0))
    assert np.all(np.abs(relative[[0, 1, 2, 4]] - 1.0) < 0.37), relative


@pytest.mark.parametrize("records", [50, pytest.param(200, marks=pytest.mark.slow)])
def test_intervals_cover_where_a_term_is_at_the_edge_of_being_seen(records):
    """Flicker between corners so near that the record shows it or not by chance: the bounds must hold as the intervals do.

    Coefficients are drawn as the model has them, N and B alone.
    """
    samples, B = 1024, 1.0
    N = math.sqrt(samples / (2.0 * math.pi * 4.0))
    terms = ("angle_random_walk", "bias_instability")
    j = np.arange(1, samples)
    sigma = np.sqrt(
        sum(c**2 * allan.spectrum.expected_power(t, samples, 1.0, j) for t, c in zip(terms, (N, B), strict=True))
    )
    generator = np.random.default_rng(12)
    inside, above, supported = [], [], []
    for _ in range(records):
        drawn = np.concatenate([[0.0], sigma * generator.standard_normal(samples - 1)])
        fit = allan.fit_noise(idct(drawn, norm="ortho"), 1.0, terms=terms)
        truth = np.array([N, B])
        inside.append((fit.lower[0] <= truth) & (truth <= fit.upper[0]))
        above.append(fit.upper[0, 1] < B)
        supported.append(fit.supported[0, 1])
    wide = math.sqrt(200 / records)  # 0.04 is 2.7 σ of two hundred
    assert 0.3 < np.mean(supported) < 0.9
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.955) < 0.04 * wide)
    assert 0.025 - 0.02 * wide < np.mean(above) < 0.025 + 0.025 * wide  # one-sided bounds give 0.065 here


@pytest.mark.slow
@pytest.mark.parametrize("name", sim.CASES)
def test_recovery_over_200_records(name):
    """The intervals of 402 axes hold the truth in 91–98 %, seen or not; the errors are those expected of what is seen throughout."""
    result = sim.case(name, 134)
    share = result.covered[:, :4].mean(axis=0)
    assert np.all((share >= 0.91) & (share <= 0.98)), share
    assert 0.91 <= result.covered[:, :4].mean() <= 0.98
    assert np.mean(result.misfit_probability < 0.01) < 0.03
    for i, term in enumerate(allan.TERMS[:4]):
        if result.supported[:, i].all():
            ratio = result.relative_rms(term) * result.truth[term] / result.expected[term]
            assert 0.85 < ratio < 1.15, term
        if result.expected[term] < 0.12 * result.truth[term]:
            assert result.supported[:, i].mean() > 0.85, term
        if term == "bias_instability" and result.expected[term] < 0.09 * result.truth[term]:
            assert result.relative_rms(term) < 0.1


def test_terms_that_are_not_there_are_bounded_not_invented():
    """Of six records; a slow study takes two hundred."""
    supported, below = np.zeros(5), np.zeros(5)
    for seed in range(6):
        fit = allan.fit_noise(simulate([seed, 8], 4096, 0.01, N=1e-3), 0.01)
        supported += fit.supported[0]
        below += np.isnan(fit.estimate[0]) & (fit.lower[0] == 0.0) & (fit.upper[0] > 0.0)
    assert supported[1] == 6
    assert supported[[0, 2, 3, 4]].sum() == 0  # each with a chance of 1e-3
    assert_allclose(supported + below, 6.0)


def test_bound_is_where_the_likelihood_falls():
    """With white noise alone in two terms: −log likelihood, written out over the bins, at the bound and at its least."""
    rate = simulate([3, 10], 2048, 1.0, N=1.0)
    fit = allan.fit_noise(rate, 1.0, terms=("quantization", "angle_random_walk"))
    power = dct(rate, norm="ortho")[1:] ** 2
    basis = allan.spectrum.expected_power("quantization", 2048, 1.0, np.arange(1, 2048))

    def loss(q, n):
        return 0.5 * np.sum(np.log(q * basis + n) + power / (q * basis + n))

    def profile(q):
        return minimize_scalar(lambda n: loss(q, n), bounds=(0.5, 1.5), method="bounded", options={"xatol": 1e-9}).fun

    least = min(profile(q) for q in np.linspace(0.0, 0.1, 101))
    assert not fit.supported[0, 0]
    # The fit pools the coefficients in bins of 5 %, which moves the likelihood a little.
    # And it is the two-sided quantile, 1.96² = 3.84: the one-sided 1.645² = 2.71 would let the threshold of support spoil the coverage.
    assert_allclose(2.0 * (profile(fit.upper[0, 0] ** 2) - least), 1.96**2, rtol=0.15)


def test_intervals_average_over_the_terms_that_may_be_there():
    """White noise on two axes, with and without quantisation: Φ of the signed roots, written out, in Akaike's manner weighted."""
    samples, terms = 1024, ("quantization", "angle_random_walk")
    rates = np.stack([simulate([seed, 15], samples, 1.0, Q=0.25, N=1.0) for seed in (2, 5)], axis=1)
    fit = allan.fit_noise(rates, 1.0, terms=terms)
    begin = allan.spectrum.bin_starts(samples - 1) - 1
    number = np.diff(np.append(begin, samples - 1))
    power = np.add.reduceat(dct(rates, axis=0, norm="ortho")[1:] ** 2, begin)
    basis = (
        np.add.reduceat(allan.spectrum.expected_power("quantization", samples, 1.0, np.arange(1, samples)), begin)
        / number
    )

    def loss(q, n, axis):
        return 0.5 * np.sum(number * np.log(q * basis + n) + power[:, axis] / (q * basis + n))

    def least(n, axis, highest=0.3):  # over q ≥ 0
        minimum = minimize_scalar(
            lambda q: loss(q, n, axis), bounds=(0.0, highest), method="bounded", options={"xatol": 1e-10}
        )
        return min(minimum.fun, loss(0.0, n, axis))

    def best(function):
        minimum = minimize_scalar(function, bounds=(0.5, 1.5), method="bounded", options={"xatol": 1e-10})
        return minimum.x, minimum.fun

    alone = [best(lambda n, axis=axis: loss(0.0, n, axis)) for axis in range(2)]
    both = [best(lambda n, axis=axis: least(n, axis)) for axis in range(2)]
    gain = sum(single[1] - two[1] for single, two in zip(alone, both, strict=True))
    weight = 1.0 / (1.0 + math.exp(gain - 2.0 * allan.noise_fit.TERM_COST))  # of white noise alone
    assert 0.1 < weight < 0.9
    for axis in range(2):
        for end, probability in ((fit.lower[axis, 1], 0.025), (fit.upper[axis, 1], 0.975)):
            n, area = end**2, 0.0
            for share, (top, bottom), here in (
                (weight, alone[axis], loss(0.0, n, axis)),
                (1.0 - weight, both[axis], least(n, axis)),
            ):
                area += share * norm.cdf(math.copysign(math.sqrt(2.0 * max(0.0, here - bottom)), n - top))
            assert_allclose(area, probability, atol=2e-5)
        estimate = weight * math.sqrt(alone[axis][0]) + (1.0 - weight) * math.sqrt(both[axis][0])
        assert_allclose(fit.estimate[axis, 1], estimate, rtol=1e-6)


def test_fit_is_the_restricted_maximum():
    """At the optimum no small step in any coefficient raises the likelihood restricted for the ramp."""
    rate = simulate([4, 11], 2048, 1.0, **corners(2048, 60.0, 20.0))
    terms = allan.TERMS[:4]
    whole = allan.spectrum.segment(slice(0, 2048), 1.0, terms, None)
    _, bins = allan.spectrum.binned([allan.spectrum.cosine_transform(rate, 1.0)], [whole], 1.0)
    best = allan.noise_fit._maximise(bins, allan.noise_fit._first_guess(bins), np.ones(4, dtype=bool))
    for i in range(4):
        for factor in (0.999, 1.001):
            moved = best.theta.copy()
            moved[i] *= factor
            assert allan.noise_fit._loss(bins, moved, None, True).loss >= best.loss - 1e-8


def test_misfit_is_reported():
    rate = simulate(1, 8192, 0.01, N=1e-3)
    assert allan.fit_noise(rate, 0.01).misfit_probability[0] > 0.01
    line = rate + 3e-3 * np.sin(2 * math.pi * 20.0 * 0.01 * np.arange(8192))
    fit = allan.fit_noise(line, 0.01)
    assert fit.misfit_probability[0] < 1e-6
    below = allan.fit_noise(line, 0.01, highest_frequency=15.0)
    assert below.misfit_probability[0] > 0.01
    assert_allclose(below.estimate[0, 1], 1e-3, rtol=0.05)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda rate: rate + 20.0 * ((np.arange(8192) > 3000) & (np.arange(8192) < 5000)),
            "noise is not stationary|is an outlier",
        ),
        (lambda rate: rate + 9.0 * (np.arange(8192) == 1234), "a sample at 1234 s is an outlier of 8.7 σ"),
        (lambda rate: rate * np.where(np.arange(8192) // 128 == 7, 1.7, 1.0), "largest from 896 to 1024 s"),
        (lambda rate: np.convolve(rate, [0.6, 0.4], "same"), "another shape"),
    ],
)
def test_misfit_says_what(spoil, words):
    """Steps of the bias have the spectrum of a random walk: they show in the whitened record only."""
    fit = allan.fit_noise(spoil(simulate(2, 8192, 1.0, N=1.0)), 1.0)
    assert fit.misfit_probability[0] < 1e-3
    assert re.search(words, fit.misfit[0]), fit.misfit[0]


def test_scores_of_chi_squares_are_normal():
    ratio = np.random.default_rng(14).chisquare(6.0, (4000, 60)) / 6.0
    probability = np.array([misfit.chi_squared_probability(np.full(60, 6.0), row, 60) for row in ratio])
    assert 0.005 < np.mean(probability < 0.01) < 0.02
    assert 0.47 < np.mean(probability < 0.5) < 0.53


def test_each_term_of_the_fit_costs_its_spectrum_a_degree():
    ratio = np.linspace(0.6, 1.5, 10)
    bins = types.SimpleNamespace(number=np.full(10, 50.0), square=50.0 * ratio, product=np.zeros(10), ramp=np.zeros(10))
    bins.basis = np.eye(4)[0][:, None] * np.ones(10)
    score = (np.cbrt(ratio) - 1.0 + 2.0 / 450.0) / np.sqrt(2.0 / 450.0)
    assert misfit._of_spectrum(bins, np.array([1.0, 0.0, 2.0, 3.0]), 0.0)[0] == pytest.approx(
        chi2.sf(score @ score, 7), rel=1e-9
    )


@pytest.mark.parametrize("highest_frequency", [None, 0.3])
def test_misfit_probability_is_one(highest_frequency):
    """Below 0.2 and 0.5 in as many records or somewhat fewer: three tests share it, none of them exact."""
    probability = [
        allan.fit_noise(
            simulate([seed, 13], 4096, 1.0, N=1.0, K=0.01),
            1.0,
            terms=("angle_random_walk", "rate_random_walk"),
            highest_frequency=highest_frequency,
        ).misfit_probability[0]
        for seed in range(24)
    ]
    for level in (0.2, 0.5):
        assert abs(np.mean(np.array(probability) < level) - level) < 3.0 * math.sqrt(level * (1.0 - level) / 24)


def test_units_scale_through_and_a_ramp_moves_the_ramp_alone():
    rate = simulate(6, 4096, 1.0, **corners(4096, 100.0, 20.0))
    fit = allan.fit_noise(rate, 1.0)
    for factor in (1e-12, 1e6):
        other = allan.fit_noise(rate * factor + 3.0 * factor, 1.0)
        assert np.array_equal(fit.supported, other.supported)
        assert_allclose(other.estimate, factor * fit.estimate, rtol=1e-4)
        assert_allclose(other.upper, factor * fit.upper, rtol=1e-4)
    by_increments = allan.fit_noise(4.0 * rate, 4.0, kind="increments")
    assert_allclose(by_increments.upper, fit.upper * 4.0 ** np.array([1.0, 0.5, 0.0, -0.5, -1.0]), rtol=1e-4)
    ramp = allan.fit_noise(rate - 100.0 * np.arange(4096), 1.0)
    assert_allclose(ramp.estimate[0, :4], fit.estimate[0, :4], rtol=1e-5)
    assert_allclose(ramp.estimate[0, 4], -100.0, rtol=1e-3)
    assert ramp.lower[0, 4] < -100.0 + fit.upper[0, 4]
    assert ramp.upper[0, 4] > -100.0 - fit.upper[0, 4]


def test_chosen_terms_only():
    rate = simulate(7, 4096, 1.0, N=1.0, K=0.01)
    fit = allan.fit_noise(rate, 1.0, terms=["rate_random_walk", "angle_random_walk"])
    assert fit.terms == ("angle_random_walk", "rate_random_walk")
    assert np.all(np.abs(fit.estimate[0] / [1.0, 0.01] - 1.0) < [0.05, 0.4])
    # Of n samples of white noise alone σ is known to σ/√(2n).
    only = allan.fit_noise(simulate(7, 4096, 1.0, N=1.0), 1.0, terms=["angle_random_walk"])
    assert only.supported.all()
    assert_allclose(only.upper[0, 0] / only.estimate[0, 0], 1.0 + 1.96 / math.sqrt(2.0 * 4095), rtol=2e-3)


# Rim


def test_table_and_parameters():
    terms = ("angle_random_walk", "rate_random_walk")
    rate = simulate(8, 1 << 14, 1.0, N=units.DEGREE_PER_ROOT_HOUR)
    fit = allan.fit_noise(rate, 1.0, terms=terms)
    row = next(r for r in fit.listing().records if r["term"] == "angle_random_walk")
    assert row["symbol"] == "N"
    assert row["unit"] == "°/√h"
    assert row["supported"]
    assert_allclose(row["estimate"], 1.0, rtol=0.03)
    parameters = allan.to_gyro_parameters(fit)
    assert tuple(parameters) == ("angle_random_walk",)
    assert allan.upper_bounds(fit) == {"rate_random_walk": fit.upper[0, 1]}
    assert_allclose(parameters["angle_random_walk"], units.DEGREE_PER_ROOT_HOUR, rtol=0.03)
    three = allan.to_gyro_parameters(allan.fit_noise(np.stack([rate] * 3, axis=1), 1.0, terms=terms))
    # Three axes weigh the terms together, so that each is judged more sharply than alone.
    assert three["angle_random_walk"] == (three["angle_random_walk"][0],) * 3
    assert_allclose(three["angle_random_walk"], parameters["angle_random_walk"], rtol=3e-3)
    walking = simulate(9, 1 << 14, 1.0, N=units.DEGREE_PER_ROOT_HOUR, K=0.1 * units.DEGREE_PER_ROOT_HOUR)
    mixed = allan.fit_noise(np.stack([rate, rate, walking], axis=1), 1.0, terms=terms)
    assert allan.to_gyro_parameters(mixed)["rate_random_walk"] == (0.0, 0.0, mixed.estimate[2, 1])
    assert allan.upper_bounds(mixed) == {"rate_random_walk": tuple(mixed.upper[:, 1])}
    total = allan.model_deviation(parameters, [1.0, 100.0], 1.0)["total"]
    assert_allclose(total, allan.allan_deviation(rate, 1.0, taus=[1.0, 100.0]).deviation[0], rtol=0.1)


RECORD = np.random.default_rng(0).standard_normal(200)
WHITE_ALONE = allan.fit_noise(RECORD, 1.0, terms=["angle_random_walk"])
GAPPY = np.append(np.arange(9.0) % 3, np.nan)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: allan.allan_deviation(RECORD, 0.0), "sample_interval"),
        (lambda: allan.allan_deviation(RECORD, 0.1, kind="rates"), "did you mean 'rate'"),
        (lambda: allan.allan_deviation(RECORD, 0.1, taus=[0.01]), "taus holds 0.01 s"),
        (lambda: allan.allan_deviation(RECORD, 0.1, taus=[1.0, 11.0]), "taus holds 11 s"),
        (lambda: allan.allan_deviation(RECORD, 0.1, taus=[]), "empty"),
        (lambda: allan.allan_deviation(RECORD, 0.1, confidence_level=95.0), "confidence_level is 95"),
        (lambda: allan.allan_deviation(RECORD.reshape(4, 50), 0.1), "50 axes"),
        (lambda: allan.allan_deviation([1.0, 2.0], 0.1), "2 samples"),
        (lambda: allan.fit_noise(RECORD[:50], 0.1), "50 samples"),
        (lambda: allan.fit_noise(RECORD, 0.1, terms=["angle_walk"]), "did you mean 'angle_random_walk'"),
        (lambda: allan.fit_noise(RECORD, 0.1, terms=["rate_ramp"]), "no random noise"),
        (lambda: allan.fit_noise(RECORD, 0.1, highest_frequency=0.5), "only 20 coefficients are below it; raise it"),
        (lambda: allan.fit_noise(RECORD, 0.1, sensor="giro"), "did you mean 'gyro'"),
        (lambda: allan.fit_noise(np.full(100, 0.1), 0.1), "no noise"),
        (lambda: allan.fit_noise(0.1 * np.arange(100), 0.1), "no noise"),
        (lambda: allan.equivalent_degrees_of_freedom(-3, 100, 10), "alpha is -3"),
        (lambda: allan.equivalent_degrees_of_freedom(0, 100, 60), "m is 60"),
        (lambda: allan.flicker_variance([0.0]), "at least one sample"),
        (lambda: allan.model_deviation({"flicker": 1.0}, [1.0], 1.0), "flicker"),
        (lambda: allan.fit_noise(np.full(100, np.nan), 1.0), "at least 64 without a gap are needed"),
        (
            lambda: allan.fit_noise(np.where(np.arange(500) % 50, 1.0, np.nan), 1.0),
            "at least 64 without a gap are needed",
        ),
        (lambda: allan.fit_noise(np.where(np.arange(500) == 250, np.nan, 1.0), 1.0), "axis 0, has no noise"),
        (lambda: allan.allan_deviation(GAPPY, 1.0, confidence_level=0.5), "confidence_level is "),
        (lambda: allan.allan_deviation(GAPPY, 1.0, confidence_level=1.0), "confidence_level is "),
        (lambda: allan.allan_deviation(GAPPY, 1.0, confidence_level=np.nan), "confidence_level is "),
        (lambda: allan.allan_deviation(GAPPY, 1.0, taus=[6.0]), "must be between"),
        (lambda: allan.temperature.fit_temperature(RECORD, np.full(200, 20.0), 1.0), "spans 0 K, less than 0.5 K"),
        (lambda: allan.temperature.fit_temperature(np.full(100, 0.1), np.arange(100.0), 1.0), "axis 0, has no noise"),
        (
            lambda: allan.temperature.fit_temperature(RECORD[:5], np.arange(5.0), 1.0),
            "values has 5 samples; at least 64",
        ),
        (lambda: allan.parameters.to_matlab({"gyro": WHITE_ALONE}), "the fit has no bias_instability"),
        (lambda: allan.temperature.fit_temperature(RECORD, np.linspace(0, 9, 100), 1.0), "temperature has shape"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(InputError, match=words):
        call()


def test_the_units_of_the_coefficients_are_what_their_names_say():
    hour, g = 3600.0, 9.80665e-6  # s, and a microgravity in m/s²
    degree = np.pi / 180.0
    for terms in allan.noise_fit.UNITS.values():
        names, factors, *_ = zip(*(terms[term] for term in allan.TERMS), strict=True)
        wanted = {
            "arcsec": (degree / hour, degree / hour**0.5, degree / hour, degree / hour**1.5, degree / hour**2),
            "mm/s": (1e-3, g, g, g / hour**0.5, g / hour),
            "nT s": (1e-9, 1e-9, 1e-9, 1e-9 / hour**0.5, 1e-9 / hour),
        }[names[0]]
        assert_allclose(factors, wanted, rtol=1e-12)
