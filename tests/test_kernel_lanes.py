"""Lanes: the machine vectors do what NumPy does lane by lane, a kernel over them does what it does on floats, on any width of machine."""

import functools
import math
import operator
import os
import platform
import subprocess
import sys
from types import FunctionType

import numpy as np
import plain_kernels
import pytest
from numba.core.errors import TypingError

from strapdown.kernels import lane_values
from strapdown.kernels.algebra import square_root
from strapdown.kernels.lane_angles import arctangent, inverse_root, rotation_vector
from strapdown.kernels.lane_values import (
    WIDTH,
    all_lanes,
    any_lane,
    bits_of,
    broadcast,
    halves,
    lanes_of,
    leading_zeros,
    load,
    load_like,
    load_quadruples,
    load_triples,
    narrowed,
    number_of_bits,
    number_where,
    select,
    signed_number,
    store,
    store_quadruples,
    sum_lanes,
    with_lane,
)

RANDOM = np.random.default_rng(5)


@pytest.fixture(autouse=True)
def random_numbers(monkeypatch):
    """The same random numbers in a test, whatever tests ran before it."""
    monkeypatch.setattr(sys.modules[__name__], "RANDOM", np.random.default_rng(5))


A = RANDOM.standard_normal(WIDTH)
B = RANDOM.standard_normal(WIDTH)


@functools.cache
def kernel(function: FunctionType) -> object:
    """Compile a function of this file as if it lived among the kernels."""
    twin = FunctionType(function.__code__, function.__globals__, function.__name__, None, function.__closure__)
    twin.__module__ = "strapdown.kernels.probe"
    return plain_kernels.called(twin)


# ---------------------------------------------------------------------------------------------------- the type


@pytest.mark.parametrize("name", ["add", "sub", "mul", "truediv"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_arithmetic_is_that_of_each_lane(name, dtype):
    operation = getattr(operator, name)

    def apply(a, b, out):
        store(out, 0, operation(load(a, 0), load(b, 0)))

    a, b, out = A.astype(dtype), B.astype(dtype), np.empty(WIDTH, dtype)
    kernel(apply)(a, b, out)
    np.testing.assert_array_equal(out, operation(a, b))


@pytest.mark.parametrize("dtype", [np.uint64, np.int64, np.uint32])
def test_integers(dtype):
    def results(x, y):
        return x + y, x - y, x * y, x & y, x | y, x ^ y, x << y

    def apply(a, b, out):
        x, y = load(a, 0), load(b, 0)
        for k, value in enumerate((x + y, x - y, x * y, x & y, x | y, x ^ y, x << y)):
            store(out, k * WIDTH, value)

    def shifted(a, b, out):
        store(out, 0, load(a, 0) >> load(b, 0))

    a = RANDOM.integers(0, 2**31, WIDTH).astype(dtype)
    b = RANDOM.integers(1, 30, WIDTH).astype(dtype)
    out = np.empty(7 * WIDTH, dtype)
    kernel(apply)(a, b, out)
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(out.reshape(7, WIDTH), results(a, b))
    if dtype != np.int64:  # shifts to the right are logical: lanes of integers are bits, for random numbers
        kernel(shifted)(a, b, out)
        np.testing.assert_array_equal(out[:WIDTH], a >> b)


def test_numbers_are_spread():
    def apply(a, s, out):
        x = 0.0
        for _ in range(2):
            x = x + load(a, 0)  # a number at first, then lanes
        store(out, 0, 2 - 0.5 * x * s)
        store(out, 8, -broadcast(s))

    out = np.empty(2 * WIDTH)
    kernel(apply)(A, 0.3, out)
    np.testing.assert_array_equal(out[:WIDTH], 2 - 0.5 * (A + A) * 0.3)
    np.testing.assert_array_equal(out[WIDTH:], -0.3)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_square_root(dtype):
    def apply(a, out):
        store(out, 0, square_root(load(a, 0)))

    a, out = np.abs(A).astype(dtype), np.empty(WIDTH, dtype)
    kernel(apply)(a, out)
    np.testing.assert_array_equal(out, np.sqrt(a))


@pytest.mark.parametrize("name", ["lt", "le", "gt", "ge", "eq", "ne"])
def test_comparisons_and_choice(name):
    operation = getattr(operator, name)

    def apply(a, b, out):
        x = load(a, 0)
        y = load(b, 0)
        condition = operation(x, y)
        store(out, 0, select(condition, x, 7.0))
        return all_lanes(condition), any_lane(condition)

    fast = kernel(apply)
    mixed = np.array([1.0, 2.0, 3.0, math.nan, 1.0, math.inf, -0.0, 5.0])
    other = np.array([1.0, 3.0, 2.0, math.nan, math.nan, math.inf, 0.0, -5.0])
    for a, b in ((mixed, other), (np.zeros(8), np.ones(8)), (np.ones(8), np.zeros(8)), (np.ones(8), np.ones(8))):
        out = np.empty(WIDTH)
        condition = operation(a, b)
        assert fast(a, b, out) == (condition.all(), condition.any())
        np.testing.assert_array_equal(out, np.where(condition, a, 7.0))


def test_choices_take_floats_and_plain_conditions():
    def choose(a, b):
        return select(a > b, a, 3.0), all_lanes(a > b), any_lane(a < b)

    assert kernel(choose)(2.0, 1.0) == (2.0, True, False)
    assert kernel(choose)(1.0, 2.0) == (3.0, False, True)
    assert choose(2.0, 1.0) == (2.0, True, False)
    assert choose(1.0, 2.0) == (3.0, False, True)


def test_a_branch_on_lanes_is_refused():
    def branch(a, out):
        x = load(a, 0)
        if x > 0.0:
            store(out, 0, x)

    with pytest.raises(TypingError):
        kernel(branch)(A, np.empty(WIDTH))


# ---------------------------------------------------------------------------------------------------- memory


def copy_triples(a, start, stride, out):
    x, y, z = load_triples(a, start, stride)
    store(out, 0, x)
    store(out, 8, y)
    store(out, 16, z)


def copy_quadruples(a, start, stride, out):
    store_quadruples(out, start, stride, load_quadruples(a, start, stride))


@pytest.mark.parametrize("stride", [3, 4, 5, 30])
@pytest.mark.parametrize("start", [0, 1, 6])
def test_triples(start, stride):
    # The array ends with the last row: no more than it may be read.
    a = RANDOM.standard_normal(start + 7 * stride + 3)
    out = np.empty(3 * WIDTH)
    kernel(copy_triples)(a, start, stride, out)
    expected = np.array([a[start + i * stride + np.arange(3)] for i in range(WIDTH)]).T
    np.testing.assert_array_equal(out.reshape(3, WIDTH), expected)
    np.testing.assert_array_equal(lane_values.load_triples(a, start, stride), expected)


@pytest.mark.parametrize("stride", [4, 5, 48])
@pytest.mark.parametrize("start", [0, 1, 6])
def test_quadruples(start, stride):
    a = RANDOM.standard_normal(start + 7 * stride + 4)
    fast, plain, expected = np.zeros((3, len(a)))
    kernel(copy_quadruples)(a, start, stride, fast)
    copy_quadruples(a, start, stride, plain)
    for i in range(WIDTH):
        row = slice(start + i * stride, start + i * stride + 4)
        expected[row] = a[row]
    np.testing.assert_array_equal(fast, expected)
    np.testing.assert_array_equal(plain, expected)


def replace_two_lanes(a, out):
    x = load(a, 0)
    store(out, 0, with_lane(with_lane(x, 2, a[8]), 7, a[9]))
    store(out, 8, x)


def test_number_in_one_lane():
    a = RANDOM.standard_normal(10)
    expected = np.concatenate([a[[0, 1, 8, 3, 4, 5, 6, 9]], a[:8]])
    for function in (kernel(replace_two_lanes), replace_two_lanes):
        out = np.empty(16)
        function(a, out)
        np.testing.assert_array_equal(out, expected)


def test_every_lane_function_has_its_machine_form():
    from strapdown.kernels.lanes import INTRINSICS

    functions = {name for name, value in vars(lane_values).items() if isinstance(value, FunctionType)}
    assert set(INTRINSICS) == functions


@pytest.mark.parametrize("width", [1, 2, 8])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_any_number_of_lanes(width, dtype):
    def apply(pattern, a, doubles, words, out, counts):
        like = lanes_of(pattern)
        n = len(like)
        x = load_like(a, 1, like)
        y = load_like(doubles, 1, like)
        store(out, 0, x)
        store(out, n, narrowed(y, like))
        store(out, 2 * n, like - 3.0)
        store(words, 0, bits_of(y))
        store(out, 3 * n, number_of_bits(load_like(words, 0, like)))
        counts[0] = n
        counts[1] = number_where(x > 0.0)
        return sum_lanes(x)

    a, doubles = RANDOM.standard_normal(width + 1).astype(dtype), RANDOM.standard_normal(width + 1)
    results = []
    for function in (kernel(apply), apply):
        out, words, counts = np.empty(4 * width), np.empty(width, np.uint64), np.empty(2, np.int64)
        summed = function((dtype(0.0),) * width, a, doubles, words, out, counts)
        results.append(np.concatenate([out, words.view(np.float64), counts, [summed]]))
        assert counts[0] == width
        assert counts[1] == np.sum(a[1:] > 0.0)
        np.testing.assert_array_equal(out[:width], a[1:])
        np.testing.assert_array_equal(out[width : 2 * width], doubles[1:].astype(dtype))
        np.testing.assert_array_equal(out[2 * width : 3 * width], -3.0)
        np.testing.assert_array_equal(out[3 * width :], doubles[1:])
        assert summed == pytest.approx(a[1:].sum(), abs=1e-5)
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("width", [1, 4, 16])
def test_words_of_thirty_two_bits(width):
    def apply(pattern, words, singles, out):
        like = lanes_of(pattern)
        n = len(like)
        low, high = halves(load_like(words, 0, like), load_like(words, n, like))
        store(out, 0, low)
        store(out, 2 * n, high)
        store(out, 4 * n, leading_zeros(low))
        store(out, 6 * n, bits_of(signed_number(high)))
        x = load_like(singles, 0, like)
        store(out, 8 * n, bits_of(x))
        store(singles, n, number_of_bits(bits_of(x)))

    words = RANDOM.integers(0, 2**64, 2 * width, dtype=np.uint64) >> RANDOM.integers(0, 64, 2 * width, dtype=np.uint64)
    words[0] = 0
    value = RANDOM.standard_normal(width).astype(np.float32)
    low, high = (words & np.uint64(2**32 - 1)).astype(np.uint32), (words >> np.uint64(32)).astype(np.uint32)
    zeros = [32 - int(word).bit_length() for word in low]
    signed = [np.float32(int(word) - (1 << 32 if word >> np.uint32(31) else 0)) for word in high]
    wanted = np.concatenate([low, high, zeros, np.array(signed).view(np.uint32), value.view(np.uint32)])
    for function in (kernel(apply), apply):
        singles, out = np.concatenate([value, 0.0 * value]), np.empty(9 * width, np.uint32)
        function((np.float32(0.0),) * width, words, singles, out)
        np.testing.assert_array_equal(out, wanted)
        np.testing.assert_array_equal(singles[width:], value)


def angles(y, x, out):
    store(out, 0, arctangent(load(y, 0), load(x, 0)))


def vectors_of(q, out):
    v = rotation_vector((load(q, 0), load(q, 8), load(q, 16), load(q, 24)))
    store(out, 0, v[0])
    store(out, 8, v[1])
    store(out, 16, v[2])


def inverse_roots(x, out):
    store(out, 0, inverse_root(load(x, 0)))


def test_angles_over_lanes():
    fast = kernel(angles)
    out = np.empty(WIDTH)
    size = 10.0 ** RANDOM.uniform(-12.0, 12.0, (200, 2, WIDTH))
    points = size * RANDOM.choice([-1.0, 1.0], size.shape)
    points[0] = [[0.0, 0.0, 1.0, -1.0, 1.0, -1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0, 1.0, 1.0, -1.0, -1.0]]
    for y, x in points:
        fast(y, x, out)
        np.testing.assert_allclose(out, np.arctan2(y, x), rtol=4e-16, atol=0.0)
        angles(y, x, out)
        np.testing.assert_allclose(out, np.arctan2(y, x), rtol=4e-16, atol=0.0)


def test_rotation_vectors_over_lanes():
    fast, out = kernel(vectors_of), np.empty((3, WIDTH))
    for exponent in range(-20, 1):
        phi = RANDOM.standard_normal((3, WIDTH))
        phi *= np.minimum(10.0**exponent, 3.1 / np.linalg.norm(phi, axis=0))
        angle = np.linalg.norm(phi, axis=0)
        q = np.concatenate([[np.cos(0.5 * angle)], np.sinc(0.5 * angle / np.pi) * 0.5 * phi])
        q[:, ::2] *= -1.0
        fast(q.reshape(-1), out.reshape(-1))
        np.testing.assert_allclose(out, phi, rtol=2e-15, atol=0.0)


def test_inverse_roots_over_lanes():
    fast, out = kernel(inverse_roots), np.empty(WIDTH)
    for _ in range(100):
        x = 10.0 ** RANDOM.uniform(-29.0, 29.0, WIDTH)
        fast(x, out)
        np.testing.assert_allclose(out, 1.0 / np.sqrt(x), rtol=5e-16)


# ---------------------------------------------------------------------------------------------------- any width of machine


BITS = """
import hashlib, numpy as np
from strapdown import coning
random = np.random.default_rng(8)
increments = np.concatenate([1e-2 * random.standard_normal((3001, 3)), 0.5 * random.standard_normal((500, 3))])
digest = hashlib.sha256(coning.integrate(increments).tobytes()).hexdigest()
"""


def digest_on(cpu: str, features: str) -> str:
    # No cache on disk: other tests' kernels stay.
    environment = {**os.environ, "NUMBA_CPU_NAME": cpu, "NUMBA_CPU_FEATURES": features, "NUMBA_CACHE_DIR": os.devnull}
    command = [sys.executable, "-c", f"{BITS}\nprint(digest)"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of one architecture")
def test_bits_do_not_depend_on_the_width_of_the_machine():
    from numba.core.codegen import get_host_cpu_features

    if "+fma" not in get_host_cpu_features().split(","):
        pytest.skip("a machine without fused multiply-add rounds every product")
    here: dict = {}
    exec(BITS, here)
    assert digest_on("haswell", "+avx2,+fma,-avx512f") == here["digest"]  # four lanes an instruction, not eight
