"""Random numbers of the kernels: known answers, one source on two machines, and the normals' distribution."""

import math
import re

import numpy as np
import plain_kernels
import pytest
from scipy import stats

from strapdown.kernels import noise
from strapdown.kernels.lane_values import halves, lanes_of, load_like
from strapdown.kernels.machine import compiled
from strapdown.kernels.montecarlo_run import refill, store_several
from strapdown.kernels.noise import stream_state

WORD = np.uint64
ALL = WORD(0xFFFFFFFFFFFFFFFF)


@pytest.fixture(autouse=True)
def _words_wrap():
    with np.errstate(over="ignore"):
        yield


def normals(number, count, first=11):
    """Return standard normals of one stream."""
    state, words = np.empty((2, 4), WORD), np.empty((2, 1 << 14), WORD)
    compiled(noise.seed_stream)(WORD(first), WORD(22), WORD(number), state)
    out, block = np.empty(count), np.empty(1 << 15)
    fill = compiled(noise.fill_normals)
    for begin in range(0, count, len(block)):
        fill(state, words, block)
        part = out[begin : begin + len(block)]
        part[:] = block[: len(part)]
    return out


@pytest.mark.parametrize(
    ("key", "counter", "wanted"),
    [
        ((0, 0), (0, 0), (0xC2B6E3A8C2C69865, 0x6F81ED42F350084D)),
        ((2**64 - 1,) * 2, (2**64 - 1,) * 2, (0xE02CB7C4D95D277A, 0xD06633D0893B8B68)),
        (
            (0xA4093822299F31D0, 0x082EFA98EC4E6C89),
            (0x243F6A8885A308D3, 0x13198A2E03707344),
            (0x263C7D30BB0F0AF1, 0x56BE8361D3311526),
        ),
    ],
)
def test_threefry_gives_the_known_answers_of_random123(key, counter, wanted):
    got = noise.threefry(*map(WORD, key), *map(WORD, counter))
    assert tuple(int(word) for word in got) == wanted


def plain_xoshiro(state, count):
    """Return words of xoshiro256++ by Python's own integers, after the reference of Blackman and Vigna."""
    mask = (1 << 64) - 1

    def rotl(x, k):
        return ((x << k) | (x >> (64 - k))) & mask

    s, words = list(state), []
    for _ in range(count):
        words.append((rotl((s[0] + s[3]) & mask, 23) + s[0]) & mask)
        t = (s[1] << 17) & mask
        s[2] ^= s[0]
        s[3] ^= s[1]
        s[1] ^= s[2]
        s[0] ^= s[3]
        s[2] ^= t
        s[3] = rotl(s[3], 45)
    return words


def test_xoshiro_gives_the_known_answers():
    # First words from the state (1, 2, 3, 4), as published with the generators of the rand crate and of Boost.
    known = [41943041, 58720359, 3588806011781223, 3591011842654386, 9228616714210784205, 9973669472204895162]
    assert plain_xoshiro((1, 2, 3, 4), 6) == known
    state, got = tuple(map(WORD, (1, 2, 3, 4))), []
    for _ in range(500):
        word, *state = noise.next_word(*state)
        got.append(int(word))
    assert got == plain_xoshiro((1, 2, 3, 4), 500)


def test_plain_python_and_compiled_agree():
    plain_state, words, plain = np.empty((2, 4), WORD), np.empty((2, 100), WORD), np.empty(200)
    noise.seed_stream(WORD(5), WORD(6), WORD(7), plain_state)
    fast_state = np.empty((2, 4), WORD)
    compiled(noise.seed_stream)(WORD(5), WORD(6), WORD(7), fast_state)
    assert np.array_equal(plain_state, fast_state)
    noise.fill_normals(plain_state, words, plain)
    fast = np.empty(200)
    compiled(noise.fill_normals)(fast_state, words, fast)
    np.testing.assert_allclose(fast, plain, rtol=0.0, atol=2e-15)
    assert np.array_equal(plain_state, fast_state)


def test_logarithm_and_normals_are_those_of_libm():
    rng = np.random.default_rng(3)
    uniforms = np.concatenate(
        [10.0 ** rng.uniform(-15.0, 0.0, 500), 1.0 - 10.0 ** rng.uniform(-15.0, -1.0, 500), [1.0, 2.0**-52]]
    )
    for u in uniforms:
        assert noise.minus_two_log(u) == pytest.approx(-2.0 * math.log(u), rel=1e-15, abs=1e-30)
    for word0, word1 in rng.integers(0, 2**64, (500, 2), dtype=WORD):
        u = 1.0 - (int(word0) >> 12) * 2.0**-52
        angle = 0.5 * math.pi * (((int(word1) << 2) % 2**64 >> 12) * 2.0**-52 - 0.5)
        sine, cosine = math.sin(angle), math.cos(angle) * (-1.0 if int(word1) >> 63 else 1.0)
        radius = math.sqrt(-2.0 * math.log(u))
        wanted = (cosine, sine) if int(word1) >> 62 & 1 else (sine, cosine)
        assert noise.normal_pair(word0, word1) == pytest.approx(
            [radius * part for part in wanted], rel=4e-15, abs=1e-16
        )


def test_extreme_words_give_finite_normals():
    words = [WORD(0), ALL, WORD(1), WORD(1 << 63)]
    pairs = [noise.normal_pair(a, b) for a in words for b in words]
    assert np.all(np.isfinite(pairs))
    assert np.max(np.abs(pairs)) < 8.5


def test_successive_normals_and_the_two_of_a_pair_are_independent(sample):
    n = 1 << 15  # a block: first half sines or cosines, second half their partners
    blocks = sample[: len(sample) // n * n].reshape(-1, n)
    first, second = blocks[:, : n // 2].ravel(), blocks[:, n // 2 :].ravel()
    pairs = [(first, second), (first**2, second**2), (np.abs(first), second)]
    pairs += [(sample[:-lag], sample[lag:]) for lag in (1, 2, 3, 7, n // 2)]
    pairs += [(sample[:-lag] ** 2, sample[lag:] ** 2) for lag in (1, 2, n // 2)]
    for a, b in pairs:
        assert abs(np.corrcoef(a, b)[0, 1]) * math.sqrt(len(a)) < 4.0


def fill_with_normals(pattern, k0, k1, numbers, streams, out):
    """Fill out with the normals of the streams of these runs; a kernel."""
    like = lanes_of(pattern)
    store_several(streams, 0, like, stream_state(k0, k1, load_like(numbers, 0, like)))
    refill(streams, 0, out, len(out) // len(like), like)


FILL = plain_kernels.called(fill_with_normals)


def lane_normals(runs, count, width=8, key=(5, 6)):
    """Return normals (runs, count) of the lanes' streams of these runs."""
    pattern = (0.0,) * width
    out = np.empty((len(runs), count))
    for first in range(0, len(runs), width):
        numbers = np.zeros(width, WORD)
        part = runs[first : first + width]
        numbers[: len(part)] = part
        rows = np.empty((count, width))
        FILL(pattern, WORD(key[0]), WORD(key[1]), numbers, np.empty(4 * width, WORD), rows.reshape(-1))
        out[first : first + width] = rows.T[: len(part)]
    return out


@pytest.fixture(scope="module")
def sample():
    return normals(0, 1_000_000)


@pytest.fixture(scope="module")
def lane_sample():
    return lane_normals(np.arange(64), 1 << 14)


@pytest.fixture(params=["sample", "lane_sample"])
def drawn(request):
    """Return normals of one stream, and of the streams of the lanes."""
    return request.getfixturevalue(request.param).ravel()


def test_moments(drawn):
    # Standard deviation of the mean of x^k is √((E x^2k − (E x^k)²)/n).
    even = {2 * k: float(math.factorial(2 * k) // (2**k * math.factorial(k))) for k in range(9)}
    power = np.ones(len(drawn))
    for k in range(1, 9):
        power *= drawn
        expected = even.get(k, 0.0)
        score = (np.mean(power) - expected) / math.sqrt((even[2 * k] - expected**2) / len(drawn))
        assert abs(score) < 4.0, (k, score)


def test_distribution_by_kolmogorov_and_smirnov(drawn):
    for part in np.split(drawn[:500_000], 5):
        assert stats.kstest(part, "norm").pvalue > 1e-4
    assert stats.kstest(drawn, "norm").pvalue > 1e-3


@pytest.mark.parametrize("edge", [3.0, 4.0, 4.5, 5.0])
def test_tails(drawn, edge):
    low, high = stats.binom.ppf([5e-5, 1.0 - 5e-5], len(drawn), stats.norm.sf(edge))
    for count in (np.sum(drawn > edge), np.sum(drawn < -edge)):
        assert low <= count <= high


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [False, True])
def test_tails_to_six_sigma(lanes):
    counts, total = np.zeros(3), 0
    for k in range(100):
        part = np.abs(lane_normals(np.arange(16 * k, 16 * k + 16), 1 << 20) if lanes else normals(k, 1 << 24))
        counts += [np.sum(part > edge) for edge in (5.0, 5.5, 6.0)]
        total += part.size
    for count, edge in zip(counts, (5.0, 5.5, 6.0), strict=True):
        low, high = stats.binom.ppf([5e-4, 1.0 - 5e-4], total, 2.0 * stats.norm.sf(edge))
        assert low <= count <= high


def test_lane_normals_have_the_same_bits_in_any_lane():
    runs = np.arange(1000, 1020)
    eight = lane_normals(runs, 2000)
    np.testing.assert_array_equal(lane_normals(runs[::-1], 2000)[::-1], eight)
    np.testing.assert_array_equal(lane_normals(runs, 2000, width=1), eight)
    state = tuple(int(word) for word in noise.stream_state(WORD(5), WORD(6), WORD(1003)))
    words = np.array(plain_xoshiro(state, 1000), WORD).reshape(-1, 2)
    wanted = np.stack(libm_normals(words), axis=1)  # of each two words both first normals, then both second ones
    np.testing.assert_allclose(eight[3].reshape(-1, 2, 2), wanted, rtol=3e-7, atol=3e-7)


def libm_normals(words):
    """Return two normals of each word of 64 by libm in double precision: the lower half gives the radius, the upper the angle."""
    low, high = (words & WORD(0xFFFFFFFF)).astype(np.int64), (words >> WORD(32)).astype(np.int64)
    # Evenly spread over (0, 1]: the middle of what 32 leading binary digits leave open; of numbers below 2^-16 there are 48 digits.
    u = (low + 0.5 * 2.0 ** -(32 - np.frexp(low.astype(float))[1])) * 2.0**-32
    u = np.where(low < 1 << 16, ((low << 16) | (high & 0xFFFF) | 1) * 2.0**-48, u)
    signed = np.where(high >= 1 << 31, high - (1 << 32), high)
    angle = 0.5 * math.pi * (signed + 0.5) * 2.0**-31
    radius = np.sqrt(-2.0 * np.log(u))
    return radius * np.sin(angle), radius * np.cos(angle) * np.where(high & 1, -1.0, 1.0)


def test_lane_normals_are_those_of_libm():
    words = np.random.default_rng(4).integers(0, 2**64, 6000, dtype=WORD)
    words[:6] = [0, ALL, WORD(1) << WORD(63), WORD(1) << WORD(31), 0xFFFFFFFF, ALL - WORD(0xFFFFFFFF)]
    words[6:1000] &= ~WORD(0xFFFF0000)  # the long radii
    words[1000:2000] |= WORD(0xFFFFFF00)  # the short ones
    single = [noise.single_normals(*(half[0] for half in halves(word, WORD(0)))) for word in words]
    for got, wanted in zip(np.transpose(single), libm_normals(words), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=3e-7, atol=3e-7)
    longest = noise.single_normals(np.uint32(0), np.uint32(0))
    assert np.hypot(*longest) == pytest.approx(math.sqrt(2.0 * 48.0 * math.log(2.0)), rel=1e-6)


def test_the_series_of_the_normals_are_as_good_as_they_say():
    d, w = -0.5 * np.linspace(1e-9, 1.0, 20_001), np.linspace(0.0, 1.0, 20_001)[:-1]
    angle = 0.5 * np.pi * np.sqrt(w)
    for letter, x, exact, error in (
        ("R", d, -2.0 * np.log1p(d) / d, 2.4e-8),
        ("P", w, 0.5 * np.pi * np.sinc(0.5 * np.sqrt(w)), 5.4e-9),
        ("Q", w, np.cos(angle) / (1.0 - w), 1.2e-9),
    ):
        coefficients = [value for name, value in sorted(vars(noise).items()) if re.fullmatch(f"_{letter}[0-9]", name)]
        series = np.polynomial.polynomial.polyval(x, coefficients)
        assert 0.9 * error < np.abs(series / exact - 1.0).max() < error


def test_lanes_and_runs_are_independent(lane_sample):
    n = lane_sample.shape[1]
    correlation = np.corrcoef(lane_sample) - np.eye(64)
    assert np.abs(correlation).max() * math.sqrt(n) < 5.0
    squares = np.corrcoef(lane_sample**2) - np.eye(64)
    assert np.abs(squares).max() * math.sqrt(n) < 5.0
    x = lane_sample.ravel()
    for lag in (1, 2, 3, 4, 7):
        assert abs(np.corrcoef(x[:-lag], x[lag:])[0, 1]) * math.sqrt(len(x)) < 4.0
        assert abs(np.corrcoef(x[:-lag] ** 2, x[lag:] ** 2)[0, 1]) * math.sqrt(len(x)) < 4.0
    other = lane_normals(np.arange(8), n, key=(5, 7))
    assert np.abs(np.corrcoef(other, lane_sample[:8])[:8, 8:]).max() * math.sqrt(n) < 4.5


def test_octants_are_even(sample):
    n = 1 << 15
    blocks = sample[: len(sample) // n * n].reshape(-1, n)
    angle = np.arctan2(blocks[:, : n // 2], blocks[:, n // 2 :]).ravel()
    counts = np.histogram(angle, bins=64, range=(-math.pi, math.pi))[0]
    assert 1e-3 < stats.chisquare(counts).pvalue < 0.999


def test_streams_of_different_names_are_uncorrelated():
    streams = np.array([normals(number, 100_000) for number in range(8)] + [normals(0, 100_000, first=12)])
    correlation = np.corrcoef(streams) - np.eye(9)
    assert np.max(np.abs(correlation)) * math.sqrt(100_000) < 4.5
