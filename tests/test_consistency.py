"""Each statistic, its bounds and its verdict against a closed form, scipy, or a slow plain reference."""

import math

import mpmath
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
import scipy.signal
import scipy.stats

from strapdown import consistency, quaternion
from strapdown.checks import InputError
from strapdown.consistency import Verdict, bounds, timeaverage, whiteness


def test_errors_are_zero_for_the_truth_and_signed_true_minus_estimate():
    generator = np.random.default_rng(0)
    q = quaternion.normalize(generator.normal(size=(20, 4)))
    delta = 1e-3 * generator.normal(size=(20, 3))
    bias = generator.normal(size=(20, 3))
    true = quaternion.multiply(q, quaternion.exp(delta))
    e = consistency.errors(q, bias - 0.25, true, bias)
    assert np.allclose(e[:, :3], delta, atol=1e-15)
    assert np.allclose(e[:, 3:], 0.25)


@pytest.mark.parametrize("states", [None, (5, 0, 2), *consistency.SUBSETS.values()])
def test_nees_is_the_quadratic_form(states):
    """Of a subset that in the marginal covariance."""
    generator = np.random.default_rng(1)
    P, e = random_covariances(generator, (5, 4)), generator.normal(size=(5, 4, 6))
    kept = list(range(6)) if states is None else list(states)
    block = P[..., kept, :][..., kept]
    expected = np.einsum("...i,...ij,...j->...", e[..., kept], np.linalg.inv(block), e[..., kept])
    assert np.allclose(consistency.nees(e, P, *(() if states is None else (states,))), expected, rtol=1e-10)
    assert consistency.nees(e[0, 0], P[0, 0]).shape == ()


@pytest.mark.parametrize(
    ("runs", "expected"), [(50, (0.8464, 1.1662)), (1000, (0.9645, 1.0361))], ids=["50 runs", "1000 runs"]
)
def test_bounds_are_the_published_ones(runs, expected):
    assert consistency.mean_bounds(6, runs, 0.95) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("probability", [0.95, 0.99])
def test_bounds_hold_what_they_promise(probability):
    """10 000 means of 40 runs of χ²₃ fall inside as often as promised, to a binomial ±4σ."""
    means = np.random.default_rng(2).chisquare(3, size=(10_000, 40)).mean(axis=1) / 3.0
    low, high = consistency.mean_bounds(3, 40, probability)
    inside = np.mean((means >= low) & (means <= high))
    assert abs(inside - probability) < 4.0 * np.sqrt(probability * (1.0 - probability) / 10_000)
    assert scipy.stats.chi2.cdf(low * 120, 120) == pytest.approx(0.5 * (1.0 - probability))


def test_simultaneous_bounds_hold_for_independent_and_for_equal_epochs():
    generator = np.random.default_rng(3)
    trials, wrong = 1000, [0, 0]
    for _ in range(trials):
        independent = generator.chisquare(6, size=(20, 100)).mean(axis=1) / 6.0
        equal = np.full(20, generator.chisquare(600) / 600.0)
        for k, mean in enumerate((independent, equal)):
            wrong[k] += not Verdict(mean=mean, degrees=6, runs=100, confidence_level=0.99).consistent
    assert 0.002 * trials < wrong[0] < 0.021 * trials  # Bonferroni is nearly exact for independent epochs
    assert wrong[1] < 0.005 * trials  # and conservative for equal ones


def random_covariances(generator, shape, n=6):
    root = generator.normal(size=(*shape, n, n)) + 2.0 * np.eye(n)
    return root @ np.swapaxes(root, -1, -2)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        *((lambda p=p: consistency.mean_bounds(6, 10, p), "confidence_level") for p in (0.0, 1.0, 1.5)),
        *((lambda s=s: consistency.nees(np.zeros(6), np.eye(6), s), "states") for s in ((), (0, 0), (6,), (-1,))),
        (lambda: consistency.anderson_darling(np.ones(20)), "do not vary"),
        (lambda: consistency.errors(*(np.ones((n, k)) for n, k in ((3, 4), (3, 3), (2, 4), (2, 3)))), "same times"),
        (
            lambda: consistency.nees(np.zeros((2, 2)), [np.eye(2), np.diag([1.0, -1.0])]),
            r"covariance\[1\] is not positive",
        ),
    ],
)
def test_it_is_refused_by_the_name_of_the_argument(call, named):
    with pytest.raises(InputError, match=named):
        call()


# -------------------------------------------------------------------------------------------------------------------- bounds


def test_p_value_and_bounds_agree():
    for degrees, samples in ((6, 50), (3, 1), (2, 1234.5)):
        for probability in (0.95, 0.99):
            for end in consistency.mean_bounds(degrees, samples, probability):
                assert consistency.mean_p_value(end, degrees, samples) == pytest.approx(1.0 - probability, rel=1e-6)
    assert consistency.mean_p_value(math.inf, 6, 10) == 0.0
    assert consistency.mean_p_value(math.nan, 6, 10) == 0.0
    several = {"degrees": 6, "runs": 50, "confidence_level": 0.99}
    low, high = Verdict(mean=np.ones(4), **several).simultaneous_bounds
    for mean, p in (([1.0, low, 1.0, 1.0], 0.01), ([1.0, 1.0, 1.0, high], 0.01), ([1.0, 1.01, 1.0, 1.0], 1.0)):
        assert Verdict(mean=np.array(mean), **several).p_value == pytest.approx(p, rel=1e-6)


@pytest.mark.parametrize("degrees", [1, 2, 3, 6])
def test_log_moments_are_those_of_log_chi_square(degrees):
    mean, variance = consistency.log_moments(degrees)
    with mpmath.workdps(30):
        assert mean == pytest.approx(float(mpmath.digamma(degrees / mpmath.mpf(2)) + mpmath.log(2)), rel=1e-14)
        assert variance == pytest.approx(float(mpmath.psi(1, degrees / mpmath.mpf(2))), rel=1e-14)
    density = scipy.stats.chi2(degrees)
    grid = np.linspace(-60.0, 6.0, 200_001)
    weight = density.pdf(np.exp(grid)) * np.exp(grid) * (grid[1] - grid[0])
    assert np.sum(weight * grid) == pytest.approx(mean, abs=1e-6)
    assert np.sum(weight * (grid - mean) ** 2) == pytest.approx(variance, rel=1e-6)


@pytest.mark.parametrize("degrees", [1, 2, 3, 6])
def test_the_distribution_of_one_log_is_the_log_of_chi_square(degrees):
    for x in (-12.0, -4.0, -1.0, 0.5, 1.5, 2.5, 3.5):
        expected = scipy.stats.chi2.cdf(math.exp(x), degrees)
        assert bounds.log_mean_distribution(x, degrees, 1) == pytest.approx(expected, abs=1e-10)


def test_the_mean_of_two_logs_by_convolution():
    """P(½ (ln a + ln b) ≤ x) = E P(a ≤ e^{2x}/b)."""
    for degrees in (2, 6):
        law = scipy.stats.chi2(degrees)
        for x in (-0.5, 1.0, 2.0):
            expected = scipy.integrate.quad(
                lambda b, x=x, law=law: law.cdf(math.exp(2.0 * x) / b) * law.pdf(b), 0.0, 80.0
            )
            assert bounds.log_mean_distribution(x, degrees, 2) == pytest.approx(expected[0], abs=1e-7)


@pytest.mark.parametrize(("degrees", "samples"), [(1, 1), (6, 1), (6, 50), (3, 1000)])
def test_log_mean_bounds_hold_their_tails(degrees, samples):
    for probability in (0.9999, 0.95, 0.99):
        low, high = consistency.log_mean_bounds(degrees, samples, probability)
        assert bounds.log_mean_distribution(low, degrees, samples) == pytest.approx(0.5 * (1 - probability), rel=1e-6)
        assert 1.0 - bounds.log_mean_distribution(high, degrees, samples) == pytest.approx(
            0.5 * (1 - probability), rel=1e-6
        )
        for end in (low, high):
            assert consistency.log_mean_p_value(end, degrees, samples) == pytest.approx(1.0 - probability, rel=1e-5)
    if samples == 1000:  # nearly normal
        mean, variance = consistency.log_moments(degrees)
        assert low == pytest.approx(mean - 2.5758 * math.sqrt(variance / samples), rel=2e-3)


# ----------------------------------------------------------------------------------------------------------------- whiteness


def test_autocorrelation_by_the_sum():
    z = np.random.default_rng(6).standard_normal((250, 2))
    correlation = consistency.autocorrelation(z)
    for lag in range(1, 6):
        for k in range(2):
            expected = sum(z[i + lag, k] * z[i, k] for i in range(250 - lag)) / sum(z[:, k] ** 2)
            assert correlation.values[lag - 1, k] == pytest.approx(expected)
    assert correlation.lags.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    within = scipy.stats.norm.isf(0.5 * 0.01 / 10)  # five lags of two components
    assert correlation.bounds[0] == pytest.approx(within * math.sqrt(249 / (250 * 252)), rel=1e-9)


def test_the_usual_lags_are_a_fiftieth_of_the_samples_from_1_to_20():
    assert [whiteness.usual_lags(n) for n in (3, 99, 100, 999, 1000, 10_000)] == [1, 1, 2, 19, 20, 20]


def test_ljung_box_of_one_component_is_the_textbook_one():
    z = np.random.default_rng(7).standard_normal(300)
    r = [np.sum(z[lag:] * z[:-lag]) / np.sum(z * z) for lag in range(1, 7)]
    expected = 300 * 302 * sum(x * x / (300 - lag) for lag, x in enumerate(r, start=1))
    statistic, degrees, p = consistency.ljung_box(z)
    assert statistic == pytest.approx(expected)
    assert degrees == 6
    assert p == pytest.approx(scipy.stats.chi2.sf(expected, 6))


def test_ljung_box_of_several_components_is_hoskings():
    z = np.random.default_rng(8).standard_normal((200, 3)) @ np.array(
        [[1.0, 0.4, 0.0], [0.0, 2.0, 0.1], [0.0, 0.0, 0.3]]
    )
    C = [z[lag:].T @ z[: 200 - lag] / 200 for lag in range(5)]
    inverse = np.linalg.inv(C[0])
    expected = sum(np.trace(C[lag].T @ inverse @ C[lag] @ inverse) / (200 - lag) for lag in range(1, 5))
    statistic, degrees, _ = consistency.ljung_box(z)
    assert statistic == pytest.approx(200 * (200 + 2 / 3) * expected)
    assert degrees == 36
    with pytest.raises(InputError, match="3 samples are too few for 1 lags of 3 components"):
        consistency.ljung_box(np.random.default_rng(1).standard_normal((3, 3)))


def test_anderson_darling_by_the_sum():
    x = np.sort(np.random.default_rng(10).standard_normal(250) + 3.0)
    u = scipy.stats.norm.cdf((x - x.mean()) / x.std(ddof=1))
    total = sum((2 * i + 1) * (math.log(u[i]) + math.log1p(-u[249 - i])) for i in range(250))
    statistic, _ = consistency.anderson_darling(x)
    assert statistic == pytest.approx((-250 - total / 250) * (1.0 + 0.75 / 250 + 2.25 / 250**2), rel=1e-9)


def test_p_values_of_normal_samples_are_uniform():
    """Each of the four formulas for the p-value has its share of these samples."""
    samples = np.random.default_rng(13).standard_normal((3000, 100, 1))
    p = np.array([consistency.anderson_darling(x)[1] for x in samples])
    for level in (0.05, 0.3, 0.6, 0.8, 0.95):
        assert np.mean(p < level) == pytest.approx(level, abs=4.0 * math.sqrt(level * (1.0 - level) / len(p)) + 0.005)


def test_mean_innovation_is_hotellings():
    z = np.random.default_rng(14).standard_normal((40, 1)) + 0.4
    mean, p = consistency.mean_innovation_p_value(z)
    assert mean[0] == pytest.approx(z.mean())
    assert p == pytest.approx(scipy.stats.ttest_1samp(z[:, 0], 0.0).pvalue)  # T² of one component is t²
    few = np.array([[0.1], [0.3], [-0.1]])
    p_value = scipy.stats.ttest_1samp(few[:, 0], 0.0).pvalue
    assert consistency.mean_innovation_p_value(few)[1] == pytest.approx(p_value)
    with pytest.raises(InputError, match="2 samples are too few to judge a mean of 1 components"):
        consistency.mean_innovation_p_value(few[:2])
    shifted = np.random.default_rng(15).standard_normal((400, 3)) + np.array([0.0, 0.3, 0.0])
    assert consistency.mean_innovation_p_value(shifted)[1] < 1e-4


def test_cross_correlation_pairs_by_time():
    generator = np.random.default_rng(16)
    a, b = generator.standard_normal((300, 2)), generator.standard_normal((300, 1))
    time = np.arange(300.0)
    correlation, pairs, p = consistency.cross_correlation_p_value(time, a, time, b)
    assert pairs == 300
    assert p > 0.01
    assert correlation[0, 0] == pytest.approx(
        np.sum(a[:, 0] * b[:, 0]) / math.sqrt(np.sum(a[:, 0] ** 2) * np.sum(b**2))
    )
    # The squared canonical correlation with one component is R² of its regression; p + q + 1 = 4.
    left = float(np.linalg.lstsq(a, b, rcond=None)[1][0]) / float(np.sum(b**2))
    assert p == pytest.approx(scipy.stats.chi2.sf(-(300.0 - 2.0) * math.log(left), 2), rel=1e-9)
    shared = b + 0.5 * a[:, :1]
    assert consistency.cross_correlation_p_value(time, a, time + 0.25, shared)[2] < 1e-6  # later, but before the next
    assert consistency.cross_correlation_p_value(time, a, time - 0.25, shared)[2] > 0.01  # the next one's neighbour
    _, pairs, _ = consistency.cross_correlation_p_value(time, a, time[::3] + 0.5, b[::3])
    assert pairs == 100
    _, pairs, p = consistency.cross_correlation_p_value(time[:5], a[:5], time, b)
    assert pairs == 5
    assert math.isnan(p)


# --------------------------------------------------------------------------------------------------------------- time average


def test_effective_samples_of_an_autoregression_are_known():
    """Of z with correlation ρ^τ, |z|² has ρ^{2τ}: N (1 − ρ²)/(1 + ρ²) of them count."""
    generator = np.random.default_rng(17)
    for rho in (0.0, 0.6, 0.9):
        drive = math.sqrt(1.0 - rho**2) * generator.standard_normal((20_000, 3))
        z = scipy.signal.lfilter([1.0], [1.0, -rho], drive, axis=0)
        expected = 20_000 * (1.0 - rho**2) / (1.0 + rho**2)
        assert timeaverage.effective_samples(z) == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize(("m", "memory"), [(30, 0.95), (700, 0.999), (3000, 0.5), (3000, 0.9999)])
@pytest.mark.parametrize("first", [None, 1])
def test_effective_samples_are_the_sum_over_lags(m, memory, first):
    """The documented formula, term by term, of the same matrix."""
    drive = np.random.default_rng(m).standard_normal((m, 3))
    z = scipy.signal.lfilter([1.0], [1.0, -memory], drive, axis=0) * math.sqrt(1.0 - memory**2)
    z[1:, 0] += 0.3 * z[:-1, 1]
    A, k = (1.0 + 2.0 / m) * np.linalg.lstsq(z[:-1], z[1:], rcond=None)[0].T, first or 3
    power, total = np.eye(3), 0.0
    for lag in range(1, m):
        power = A @ power
        total += (1.0 - lag / m) * min(np.sum(power[:k, :k] ** 2) / k, 1.0)
    assert timeaverage.effective_samples(z, first) == pytest.approx(max(1.0, m / (1.0 + 2.0 * total)), rel=2e-4)


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_effective_samples_of_squares_are_those_of_the_initial_monotone_sequence(memory):
    """Geyer's sum by its definition: autocovariances of |z|² one by one, in pairs, until one is not positive, none larger than before."""
    m = 200
    z = scipy.signal.lfilter([1.0], [1.0, -memory], np.random.default_rng(4).standard_normal((m, 2)), axis=0)
    x = np.sum(z * z, axis=1)
    x -= x.mean()
    c = [np.sum(x[: m - k] * x[k:]) / np.sum(x * x) for k in range(m)]
    total, least, number = -1.0, math.inf, 0
    while (pair := c[2 * number] + c[2 * number + 1]) > 0.0:
        least, number = min(least, pair), number + 1
        total += 2.0 * least
    expected = m / max(total, 1.0) * (1.0 - 4.0 * number / m)
    assert timeaverage.squares_effective(z) == pytest.approx(expected, rel=1e-9)


def test_effective_samples_of_part_of_a_markov_process():
    """The first component is no Markov process: its correlation is known from the whole matrix."""
    A = np.array([[0.3, 0.5], [0.0, 0.98]])
    P = scipy.linalg.solve_discrete_lyapunov(A, np.eye(2))
    generator = np.random.default_rng(18)
    z = np.zeros((40_000, 2))
    for k in range(1, len(z)):
        z[k] = A @ z[k - 1] + generator.standard_normal(2)
    power, total = np.eye(2), 0.0
    for _ in range(1000):
        power = A @ power
        total += ((power @ P)[0, 0] / P[0, 0]) ** 2
    white = consistency.whitened(z, np.broadcast_to(P, (len(z), 2, 2)))
    assert timeaverage.effective_samples(white, 1) == pytest.approx(40_000 / (1.0 + 2.0 * total), rel=0.1)


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.2, 1.41])
@pytest.mark.parametrize("epochs", [400, 1000])
def test_a_wrong_sigma_leaves_the_effective_samples_of_white_errors(epochs, factor):
    """A constant excess of the NEES is no correlation: nearly every epoch counts, and the average shows the factor."""
    random = np.random.default_rng(int(1000 * factor) + epochs)
    error = factor * random.standard_normal((epochs, 3))
    average = consistency.timeaverage.time_average(error, np.tile(np.eye(3), (epochs, 1, 1)))
    assert average.reliable
    assert 0.6 * epochs < average.effective <= epochs
    assert average.mean == pytest.approx(factor**2, rel=0.15)
    assert (consistency.mean_p_value(average.mean, 3, average.effective) < 1e-3) == (factor != 1.0)


def test_time_average_of_a_short_run_says_that_it_is_not_reliable():
    walk = np.cumsum(np.random.default_rng(19).standard_normal((60, 2)), axis=0)
    average = consistency.time_average(walk, np.broadcast_to(30.0 * np.eye(2), (60, 2, 2)))
    assert not average.reliable
    assert 0.001 < consistency.mean_p_value(average.mean, 2, max(average.effective, 1.0)) < 1.0
    with pytest.raises(InputError, match="too few"):
        consistency.time_average(walk[:4], np.broadcast_to(np.eye(2), (4, 2, 2)))


# ------------------------------------------------------------------------------------------------------------------ accuracy


@pytest.mark.parametrize(("samples", "inside"), [(10, 3), (10, 9), (10, 10), (50, 40), (50, 30), (7, 0)])
def test_the_p_value_of_a_coverage_counts_what_is_as_far_off_or_farther(samples, inside):
    """Twice the smaller of P(N ≤ k) and P(N ≥ k), both with k itself, by sums of binomial terms."""
    p_values = bounds.coverage_p_values(np.full(3, inside / samples), samples)
    for k, p in enumerate(math.erf(s / math.sqrt(2.0)) for s in (1, 2, 3)):
        terms = [math.comb(samples, j) * p**j * (1.0 - p) ** (samples - j) for j in range(samples + 1)]
        wanted = min(1.0, 2.0 * min(math.fsum(terms[: inside + 1]), math.fsum(terms[inside:])))
        assert p_values[k] == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(
    ("critical", "level"), [(0.631, 0.1), (0.752, 0.05), (0.873, 0.025), (1.035, 0.01), (0.341, 0.5), (10.0, 3.7e-24)]
)
def test_the_p_value_of_anderson_and_darling_is_that_of_the_table(critical, level):
    """D'Agostino & Stephens (1986), table 4.7: the levels of A²*, on samples bent until they have just that statistic.

    The last, far in the tail, is the value that the R package nortest gives from A²* = 10 on.
    """
    normal = scipy.stats.norm.ppf((np.arange(300) + 0.5) / 300)[:, None]

    def anderson_darling(bent):
        return whiteness.anderson_darling(np.sinh(bent * normal))

    bent = scipy.optimize.brentq(lambda x: anderson_darling(x)[0] - critical, 0.05, 3.0)
    assert anderson_darling(bent)[1] == pytest.approx(level, rel=0.04, abs=0.0)
