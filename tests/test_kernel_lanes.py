"""Lanes: the machine vectors do what NumPy does lane by lane, a kernel over them does what it does on floats, on any width of machine."""

import hashlib
import math
import operator
import os
import platform
import subprocess
import sys
from types import FunctionType

import numpy as np
import pytest
from numba.core.errors import TypingError

from strapdown.kernels import integration, lane_values, machine, rotation, series
from strapdown.kernels.algebra import square_root
from strapdown.kernels.filter_step import predict
from strapdown.kernels.lane_values import (
    WIDTH,
    anywhere,
    chosen,
    everywhere,
    load,
    load_quadruples,
    load_triples,
    spread,
    store,
    store_quadruples,
)
from strapdown.kernels.rotation import rotation_matrix

RANDOM = np.random.default_rng(5)
A = RANDOM.standard_normal(WIDTH)
B = RANDOM.standard_normal(WIDTH)


def kernel(function: FunctionType) -> object:
    """Compile a function of this file as if it lived among the kernels."""
    twin = FunctionType(function.__code__, function.__globals__, function.__name__, None, function.__closure__)
    twin.__module__ = "strapdown.kernels.probe"
    return machine.helper(twin)


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


@pytest.mark.parametrize("name", ["add", "sub", "mul", "and_", "or_", "xor", "lshift", "rshift"])
@pytest.mark.parametrize("dtype", [np.uint64, np.int64, np.uint32])
def test_integers(name, dtype):
    operation = getattr(operator, name)
    if (name, dtype) == ("rshift", np.int64):
        pytest.skip("shifts to the right are logical: lanes of integers are bits, for random numbers")

    def apply(a, b, out):
        store(out, 0, operation(load(a, 0), load(b, 0)))

    a = RANDOM.integers(0, 2**31, WIDTH).astype(dtype)
    b = RANDOM.integers(1, 30, WIDTH).astype(dtype)
    out = np.empty(WIDTH, dtype)
    kernel(apply)(a, b, out)
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(out, operation(a, b))


def test_numbers_are_spread():
    def apply(a, s, out):
        x = 0.0
        for _ in range(2):
            x = x + load(a, 0)  # a number at first, then lanes
        store(out, 0, 2 - 0.5 * x * s)
        store(out, 8, -spread(s))

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
        store(out, 0, chosen(condition, x, 7.0))
        return everywhere(condition), anywhere(condition)

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
        return chosen(a > b, a, 3.0), everywhere(a > b), anywhere(a < b)

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


def test_every_lane_function_has_its_machine_form():
    from strapdown.kernels.lanes import INTRINSICS

    functions = {name for name, value in vars(lane_values).items() if isinstance(value, FunctionType)}
    assert set(INTRINSICS) == functions


# ---------------------------------------------------------------------------------------------------- kernels over lanes


STATE = 4 + 3 + 6 + 9 + 6


def states():
    """Eight attitudes, biases and covariances as 28 rows of lanes."""
    rows = np.empty((WIDTH, STATE))
    upper = np.triu_indices(3)
    for i in range(WIDTH):
        q = np.r_[1.0, 0.3 * RANDOM.standard_normal(3)]
        factor = RANDOM.standard_normal((6, 6)) * 10.0 ** RANDOM.uniform(-3, -1, 6)[:, None]
        P = factor @ factor.T
        rows[i] = np.r_[
            q / np.linalg.norm(q),
            1e-3 * RANDOM.standard_normal(3),
            P[:3, :3][upper],
            P[:3, 3:].ravel(),
            P[3:, 3:][upper],
        ]
    return rows.T.copy()


def predicted(state, phi, dt, angle_variance, rate_variance, out):
    """Propagate the runs in eight lanes; q 0-3, b 4-6, A 7-12, B 13-21, C 22-27, each row of lanes after the other."""
    q, A, B, C = predict(
        (load(state, 0), load(state, 8), load(state, 16), load(state, 24)),
        (load(state, 32), load(state, 40), load(state, 48)),
        (load(state, 56), load(state, 64), load(state, 72), load(state, 80), load(state, 88), load(state, 96)),
        (
            load(state, 104),
            load(state, 112),
            load(state, 120),
            load(state, 128),
            load(state, 136),
            load(state, 144),
            load(state, 152),
            load(state, 160),
            load(state, 168),
        ),
        (load(state, 176), load(state, 184), load(state, 192), load(state, 200), load(state, 208), load(state, 216)),
        (load(phi, 0), load(phi, 8), load(phi, 16)),
        dt,
        angle_variance,
        rate_variance,
    )
    for i in range(4):
        store(out, 8 * i, q[i])
    for i in range(6):
        store(out, 56 + 8 * i, A[i])
        store(out, 176 + 8 * i, C[i])
    for i in range(9):
        store(out, 104 + 8 * i, B[i])


def test_the_filters_prediction_over_lanes():
    state = states()
    phi = 0.1 * RANDOM.standard_normal((3, WIDTH))
    noise = (0.01, 1e-6, 1e-8)
    fast = state.copy()
    kernel(predicted)(state.reshape(-1), phi.reshape(-1), *noise, fast.reshape(-1))
    scalar = machine.helper(predict)
    for step in (predict, scalar):
        for i in range(WIDTH):
            run = tuple(map(tuple, np.split(state[:, i], [4, 7, 13, 22])))
            q, A, B, C = step(*run, tuple(phi[:, i]), *noise)
            slow = np.r_[q, state[4:7, i], A, B, C]
            np.testing.assert_allclose(fast[:, i], slow, rtol=1e-12, atol=1e-15 * np.abs(slow[7:]).max())


@pytest.mark.parametrize(
    "function", [series.cosine, series.sinc, series.second, series.third, series.fourth, series.fifth]
)
def test_series_over_lanes(function):
    over_lanes = machine.helper(function)

    def apply(a, out):
        store(out, 0, over_lanes(load(a, 0)))

    x, out = RANDOM.uniform(0.0, 0.11, WIDTH), np.empty(WIDTH)
    kernel(apply)(x, out)
    np.testing.assert_allclose(out, function(x), rtol=4e-16)


def test_a_matrix_of_lanes():
    def apply(a, out):
        R = rotation_matrix(load_quadruples(a, 0, 4))
        for i in range(9):
            store(out, 8 * i, R[i])

    q = RANDOM.standard_normal((WIDTH, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    out = np.empty((9, WIDTH))
    kernel(apply)(q.reshape(-1), out.reshape(-1))
    np.testing.assert_allclose(out, rotation.rotation_matrix(tuple(q.T)), atol=4e-16)


# ---------------------------------------------------------------------------------------------------- any width of machine


BITS = """
import hashlib, numpy as np
from strapdown import coning
random = np.random.default_rng(8)
increments = np.concatenate([1e-2 * random.standard_normal((3001, 3)), 0.5 * random.standard_normal((500, 3))])
steps = coning.integrate(increments, "magnus-4"), coning.integrate(increments)
print(hashlib.sha256(b"".join(a.tobytes() for a in steps)).hexdigest())
"""


def digest_on(cpu: str, features: str) -> str:
    # No cache on disk: other tests' kernels stay.
    environment = {**os.environ, "NUMBA_CPU_NAME": cpu, "NUMBA_CPU_FEATURES": features, "NUMBA_CACHE_DIR": os.devnull}
    done = subprocess.run([sys.executable, "-c", BITS], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of one architecture")
def test_bits_do_not_depend_on_the_width_of_the_machine():
    from numba.core.codegen import get_host_cpu_features

    if "+fma" not in get_host_cpu_features().split(","):
        pytest.skip("a machine without fused multiply-add rounds every product")
    import llvmlite.binding

    host = digest_on(llvmlite.binding.get_host_cpu_name(), get_host_cpu_features())
    assert len(host) == len(hashlib.sha256().hexdigest())
    assert digest_on("haswell", "+avx2,+fma,-avx512f") == host  # four lanes an instruction, not eight


def test_the_block_equals_one_chain():
    n = integration.BLOCK + 100
    vectors = 0.02 * RANDOM.standard_normal((n, 3))
    attitude = np.empty((n + 1, 4))
    initial = np.array([0.6, 0.0, 0.8, 0.0])
    machine.compiled(integration.accumulate_vectors)(
        vectors.reshape(-1), initial, np.empty(integration.WORK), attitude.reshape(-1)
    )
    q = tuple(initial)
    for k in range(n):
        q = rotation.turned(q, tuple(vectors[k]))
        # Each of the products before it has rounded once, in one order or the other.
        np.testing.assert_allclose(attitude[k + 1], q, rtol=0.0, atol=4e-16 * math.sqrt(k + 1))
