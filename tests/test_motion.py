"""Exact motions: one conformance suite over all of them, then what each claims for itself."""

import itertools
import math
from dataclasses import FrozenInstanceError, dataclass, fields
from decimal import Decimal, localcontext
from functools import cache

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad_vec

from strapdown import quaternion
from strapdown.checks import InputError
from strapdown.motion import (
    Composed,
    Coning,
    ConstantRate,
    Harmonic,
    HarmonicRates,
    Motion,
    SampledAttitude,
    Slew,
    SpinCone,
    SpinRock,
    TorqueFree,
    rest,
    torque_free,
    waypoints,
)
from strapdown.motion.exact_phase import DIGITS

START = tuple(quaternion.exp([0.3, -1.1, 0.7]).tolist())
RECORD = (0.0, 2.0)


def wandering_attitudes(n: int, seed: int = 5) -> np.ndarray:
    steps = 0.25 * np.random.default_rng(seed).standard_normal((n, 3))
    q = [np.array(START)]
    for step in steps[1:]:
        q.append(quaternion.multiply(q[-1], quaternion.exp(step)))
    return np.array(q)


def elliptic_vibration(frequency: float, size: float) -> tuple[Harmonic, ...]:
    return (
        Harmonic(amplitude=(size, 0.1 * size, 0.0), frequency=frequency, phase=0.4),
        Harmonic(amplitude=(0.0, 1.5 * size, 0.2 * size), frequency=frequency, phase=1.9),
        Harmonic(amplitude=(0.1 * size, 0.0, 0.3 * size), frequency=1.7 * frequency, phase=-0.8),
    )


TORQUE_FREE = {
    f"torque-free {inertia} {rate}": TorqueFree(inertia=inertia, initial_rate=rate, initial_attitude=START)
    for inertia, rate in [
        # every order of the axes, about the largest and about the smallest moment, all signs of the middle and circled rates
        ((1.0, 2.0, 2.5), (1.0, 0.5, -2.0)),
        ((1.0, 2.5, 2.0), (1.0, 2.0, 0.5)),
        ((2.0, 1.0, 2.5), (-0.5, 0.4, 2.0)),
        ((2.0, 2.5, 1.0), (0.5, -2.0, -1.0)),
        ((2.5, 1.0, 2.0), (-2.0, 1.0, -0.5)),
        ((2.5, 2.0, 1.0), (2.0, -0.5, 1.0)),
        ((1.0, 2.0, 2.5), (-2.0, 0.5, 0.2)),
        ((1.0, 2.5, 2.0), (2.0, 0.2, -0.5)),
        ((2.0, 1.0, 2.5), (0.5, 2.0, 0.2)),
        ((2.0, 2.5, 1.0), (-0.5, 0.2, 2.0)),
        ((2.5, 1.0, 2.0), (0.2, -2.0, 0.5)),
        ((2.5, 2.0, 1.0), (0.2, -0.5, -2.0)),
        # symmetric: oblate, prolate, spun about an equatorial axis; spherical; about each principal axis; a lamina
        ((2.0, 2.0, 3.0), (0.2, -2.0, 0.5)),
        ((3.0, 2.0, 2.0), (0.7, -2.0, 0.5)),
        ((3.0, 2.0, 3.0), (0.7, 1.2, 0.5)),
        ((2.0, 3.0, 3.0), (0.0, -2.0, 0.5)),
        ((2.0, 2.0, 2.0), (1.0, -2.0, 0.5)),
        ((1.0, 2.0, 2.5), (0.0, 0.0, -2.0)),
        ((1.0, 2.0, 2.5), (0.0, 2.0, 0.0)),
        ((1.0, 2.0, 2.5), (1.5, 0.0, 0.0)),
        ((1.0, 2.0, 3.0), (0.4, 1.0, 1.1)),
        # on the separatrix exactly: 3 · 1 · w_x² = 6 · 2 · w_z²; then very close to it on either side
        ((3.0, 4.0, 6.0), (2.0, 0.5, 1.0)),
        ((3.0, 4.0, 6.0), (2.0, -0.5, -1.0)),
        ((3.0, 4.0, 6.0), (2.0 + 1e-14, 0.5, 1.0)),
        ((3.0, 4.0, 6.0), (2.0, 0.5, 1.0 + 1e-9)),
        # nearly pure spin: a small nutation
        ((1.0, 2.0, 2.5), (1e-9, 0.0, 2.0)),
        ((1.0, 2.0, 2.5), (2.0, 1e-6, -1e-6)),
        ((1.0, 2.0, 2.5), (1e-9, 2.0, 1e-9)),
    ]
}

MOTIONS: dict[str, Motion] = {
    "coning": Coning(angle=0.3, frequency=1.3),
    "coning, small and backwards": Coning(angle=1e-6, frequency=-4.0),
    "coning, upside down": Coning(angle=math.pi, frequency=1.0),
    "spin-cone": SpinCone(precession_rate=3.0, spin_rate=-2.0, angle=0.7),
    "spin-cone, no spin": SpinCone(precession_rate=3.0, spin_rate=0.0, angle=2.0),
    "constant rate": ConstantRate(rate=(1.0, 2.0, -0.5), initial_attitude=START),
    "rest": rest(START),
    "spin-rock": SpinRock(rock_angle=0.4, rock_frequency=0.7, spin_rate=2.0, rock_phase=0.3),
    "spin-rock, in step": SpinRock(rock_angle=1.2, rock_frequency=0.5, spin_rate=math.pi),
    "slew": Slew(rotation_vector=(1.0, 2.0, -1.0), duration=1.5, start=0.2, initial_attitude=START),
    "harmonic": HarmonicRates(harmonics=elliptic_vibration(2.0, 1.0), mean=(0.1, -0.4, 0.2), initial_attitude=START),
    "harmonic, fast": HarmonicRates(harmonics=elliptic_vibration(20.0, 3.0), initial_attitude=START),
    "harmonic, mean only": HarmonicRates(harmonics=(), mean=(1.0, 0.2, -3.0)),
    "sampled": SampledAttitude(time=np.linspace(*RECORD, 9), attitudes=wandering_attitudes(9)),
    "sampled, uneven": SampledAttitude(time=np.linspace(*RECORD, 9) ** 2 / 2, attitudes=wandering_attitudes(9)),
    "waypoints": waypoints([0.0, 0.9, 2.0], quaternion.exp([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0]])),
    "coning under a slew": Composed(
        base=Slew(rotation_vector=(1.0, 2.0, -1.0), duration=1.5, start=0.2), vibration=Coning(angle=0.05, frequency=5.0)
    ),
    "harmonics on a torque-free body": Composed(
        base=TorqueFree(inertia=(1.0, 2.0, 2.5), initial_rate=(1.0, 0.5, -2.0)),
        vibration=HarmonicRates(harmonics=elliptic_vibration(6.0, 0.4)),
    ),
    "composed twice": Composed(
        base=waypoints([0.0, 1.0, 2.0], wandering_attitudes(3)),
        vibration=Composed(base=Coning(angle=0.1, frequency=3.0), vibration=SpinRock(rock_angle=0.1, rock_frequency=7.0, spin_rate=1.0)),
    ),
    **TORQUE_FREE,
}  # fmt: skip

DEFAULT = [name for name in MOTIONS if name not in TORQUE_FREE] + [
    list(TORQUE_FREE)[k] for k in (0, 3, 7, 10, 12, 13, 14, 16, 17, 20, 21, 23, 25)
]
"""Of the bodies both regimes, the symmetric ones, spins about an axis, and the separatrix; the other orders of the axes are slow."""
every_motion = pytest.mark.parametrize(
    "truth",
    [
        pytest.param(truth, id=name, marks=() if name in DEFAULT else pytest.mark.slow)
        for name, truth in MOTIONS.items()
    ],
)


def breaks(truth: Motion) -> list[float]:
    """Times where a derivative of the rate jumps, from the parameters."""
    if isinstance(truth, Composed):
        return sorted(breaks(truth.base) + breaks(truth.vibration))
    if isinstance(truth, Slew):
        return [truth.start, truth.start + truth.duration]
    return truth.time.tolist() if isinstance(truth, SampledAttitude) else []


def smooth_times(truth: Motion, n: int = 40) -> np.ndarray:
    t = np.linspace(0.02, 1.98, n) + 1e-3 * math.sqrt(2.0)
    return np.array([x for x in t if all(abs(x - b) > 0.011 for b in breaks(truth))])


DIFFERENCES = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}


def derivative(function, t: np.ndarray, h: float) -> np.ndarray:
    """Central differences of order 8."""
    return sum(c * (function(t + k * h) - function(t - k * h)) for k, c in DIFFERENCES.items()) / h


def rate_scale(truth: Motion) -> float:
    return float(np.abs(truth.body_rate(np.linspace(*RECORD, 201))).max())


def right_product_matrices(w_b: np.ndarray) -> np.ndarray:
    """Return the matrices A (..., 4, 4) of equation (17), q̇ = A q."""
    x, y, z = np.moveaxis(0.5 * w_b, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -x, -y, -z], [x, o, z, -y], [y, -z, o, x], [z, y, -x, o]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def collocated_attitude(rate, edges: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the solution of (17) at the edges by collocation at 8 Gauss points an interval: order 16, all rates in one call.

    The exact solution keeps the unit norm; rounding errors of the norm, which may be systematic, are removed at each edge.
    """
    nodes, weights = np.polynomial.legendre.leggauss(8)
    nodes, weights = 0.5 * (1.0 + nodes), 0.5 * weights
    vandermonde = np.vander(nodes, increasing=True)
    inner = (vandermonde * nodes[:, None] / np.arange(1.0, 9.0)) @ np.linalg.inv(
        vandermonde
    )  # ∫ of the interpolant to each node
    step = np.diff(edges)
    a = step[:, None, None, None] * right_product_matrices(rate(edges[:-1, None] + nodes * step[:, None]))
    system = np.eye(32) - np.einsum("ij,pimn->pimjn", inner, a).reshape(-1, 32, 32)
    slopes = np.linalg.solve(system, a.reshape(-1, 32, 4)).reshape(-1, 8, 4, 4)
    path = [q]
    for change in np.einsum("i,pimn->pmn", weights, slopes):
        q = path[-1] + change @ path[-1]
        path.append(q / np.linalg.norm(q))
    return np.array(path)


# ---------------------------------------------------------------------------------------------------- conformance


@every_motion
def test_it_is_a_motion_and_frozen(truth):
    assert isinstance(truth, Motion)
    name = fields(truth)[0].name
    with pytest.raises(FrozenInstanceError):
        setattr(truth, name, getattr(truth, name))


@every_motion
def test_attitude_is_unit(truth):
    q = truth.attitude(np.linspace(*RECORD, 501))
    assert np.abs(np.linalg.norm(q, axis=-1) - 1.0).max() < 1.5e-15


@every_motion
def test_acceleration_is_the_derivative_of_the_rate(truth):
    t = smooth_times(truth)
    difference = derivative(truth.body_rate, t, 5e-4)
    scale = np.abs(difference).max() + rate_scale(truth)
    assert np.abs(truth.body_angular_acceleration(t) - difference).max() <= 1e-9 * scale


@every_motion
def test_increments_are_integrals_of_the_body_rate(truth):
    edges = np.array([0.0, 1e-6, 1e-3, 0.07, 0.8, 1.5, 2.0])
    increments = truth.increments(edges)
    assert increments.shape == (len(edges) - 1, 3)
    for a, b, increment in zip(edges[:-1], edges[1:], increments, strict=True):
        size = rate_scale(truth) * (b - a)
        cuts = [x for x in breaks(truth) if a < x < b]
        options = {"epsabs": 1e-15 * size + 1e-300, "epsrel": 1e-14, "points": cuts, "limit": 200}
        assert np.abs(increment - quad_vec(truth.body_rate, a, b, **options)[0]).max() <= 1e-14 * size


@every_motion
def test_short_increments_keep_their_digits(truth):
    """A nanosecond: the increment is rate × time to 1e-13 of itself; a difference of attitudes would keep seven digits."""
    t = smooth_times(truth, 12)
    step = 2.0**-30
    increments = np.array([truth.increments([x, x + step])[0] for x in t])
    middle = 0.5 * (truth.body_rate(t) + truth.body_rate(t + step))
    assert np.abs(increments - middle * step).max() <= 1e-13 * np.abs(middle).max() * step


@every_motion
def test_attitude_is_the_integral_of_the_rate(truth):
    """Against an independent integration of (17), stopped and started where the rate is not smooth."""
    stops = sorted({RECORD[0], RECORD[1], *[b for b in breaks(truth) if RECORD[0] < b < RECORD[1]]})
    q = truth.attitude(RECORD[0])
    for a, b in itertools.pairwise(stops):
        edges = np.linspace(a, b, math.ceil(200.0 * (b - a)) + 1)
        path = collocated_attitude(truth.body_rate, edges, q)
        q = path[-1]
        assert np.abs(path - truth.attitude(edges)).max() < 5e-14


@every_motion
def test_batch_shapes(truth):
    methods = (("attitude", 4), ("body_rate", 3), ("body_angular_acceleration", 3))
    for shape, (method, width) in itertools.product([(), (2, 3), (0,)], methods):
        t = np.random.default_rng(3).uniform(*RECORD, shape)
        values = getattr(truth, method)(t)
        assert values.shape == (*shape, width)
        assert values.dtype == np.float64
        for index in np.ndindex(shape):
            assert np.abs(values[index] - getattr(truth, method)(float(t[index]))).max() <= 1e-13 * (
                1.0 + np.abs(values[index]).max()
            )


@every_motion
def test_bad_times_are_refused(truth):
    with pytest.raises(InputError, match=r"time\[1\] is nan"):
        truth.attitude([0.0, math.nan])
    with pytest.raises(InputError, match="time is inf"):
        truth.body_rate(math.inf)
    with pytest.raises(InputError, match=r"edges\[2\] goes back"):
        truth.increments([0.0, 1.0, 0.5])
    with pytest.raises(InputError, match="edges has 1 stamps; at least 2"):
        truth.increments([0.0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Coning(angle=-0.1, frequency=1.0), "angle is -0.1 rad; it must not be negative"),
        (lambda: Coning(angle=10.0, frequency=1.0), "is it in degrees"),
        (lambda: Coning(angle=0.1, frequency=math.nan), "frequency is nan"),
        (lambda: SpinCone(precession_rate=math.inf, spin_rate=1.0, angle=0.1), "precession_rate is inf"),
        (lambda: SpinCone(precession_rate=1.0, spin_rate=1.0, angle=4.0), "between 0 and π"),
        (lambda: ConstantRate(rate=(1.0, 2.0)), r"rate has shape \(2,\), wanted \(3,\)"),
        (lambda: ConstantRate(rate=(1.0, 2.0, 3.0), initial_attitude=(1.0, 1.0, 0.0, 0.0)), "initial_attitude has norm 1.41"),
        (lambda: SpinRock(rock_angle="wide", rock_frequency=1.0, spin_rate=1.0), "rock_angle is 'wide'"),
        (lambda: Slew(rotation_vector=(1.0, 0.0, 0.0), duration=0.0), "duration is 0 s; it must be greater than zero"),
        (lambda: TorqueFree(inertia=(1.0, 2.0, 4.0), initial_rate=(1.0, 0.0, 0.0)), r"inertia\[2\] is 4, more than the sum"),
        (lambda: TorqueFree(inertia=(1.0, -2.0, 2.0), initial_rate=(1.0, 0.0, 0.0)), r"inertia\[1\] is -2 kg m²; it must be greater"),
        (lambda: Harmonic(amplitude=(1.0, 0.0), frequency=1.0), "amplitude has shape"),
        (lambda: HarmonicRates(harmonics=(3.0,)), r"harmonics\[0\] is 3.0; give motion.Harmonic"),
        (lambda: HarmonicRates(harmonics=elliptic_vibration(100.0, 1.0)).attitude([0.0, 1e9]), r"time\[1\] is 1e\+09 s from time 0"),
        (lambda: SampledAttitude(time=[0, 1, 2], attitudes=wandering_attitudes(3)), "time has 3 stamps; at least 6"),
        (lambda: SampledAttitude(time=np.arange(7.0), attitudes=wandering_attitudes(6)), "6 rows for 7 stamps"),
        (lambda: SampledAttitude(time=np.arange(6.0), attitudes=wandering_attitudes(6), ends="rst"), "did you mean 'rest'"),
        (lambda: waypoints([0.0, 1.0], [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]), r"attitudes\[1\] is 180° from the one before"),
        (lambda: MOTIONS["sampled"].body_rate([1.0, 2.5]), "time 2.5 s is outside the samples, 0 s to 2 s"),
        (lambda: MOTIONS["sampled"].increments([-1.0, 0.5]), "time -1 s is outside"),
        (lambda: Composed(base=1.0, vibration=rest()), "base is 1.0; give a motion"),
    ],
)  # fmt: skip
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


# ---------------------------------------------------------------------------------------------------- late times


def mp_rate(truth):
    """Return the body rate as a function of mpmath numbers, from the formulas of the conventions."""
    m = mpmath
    if isinstance(truth, Coning):
        b, w = m.mpf(truth.angle), m.mpf(truth.rate)
        return lambda t: (-w * m.sin(b) * m.sin(w * t), w * m.sin(b) * m.cos(w * t), w * (m.cos(b) - 1))
    if isinstance(truth, SpinCone):
        b, p, s = m.mpf(truth.angle), m.mpf(truth.precession_rate), m.mpf(truth.spin_rate)
        return lambda t: (p * m.sin(b) * m.sin(s * t), p * m.sin(b) * m.cos(s * t), p * m.cos(b) + s)
    if isinstance(truth, SpinRock):
        a, w, s, f = m.mpf(truth.rock_angle), m.mpf(truth.rock_rate), m.mpf(truth.spin_rate), m.mpf(truth.rock_phase)
        rock = lambda t: a * w * m.cos(w * t + f)  # noqa: E731
        return lambda t: (rock(t) * m.cos(s * t), -rock(t) * m.sin(s * t), s)
    if isinstance(truth, HarmonicRates):
        terms = [([m.mpf(x) for x in h.amplitude], m.mpf(h.rate), m.mpf(h.phase)) for h in truth.harmonics]
        mean = [m.mpf(x) for x in truth.mean]

        def rate(t):
            cosines = [m.cos(w * t + f) for _, w, f in terms]
            return tuple(mean[i] + sum(a[i] * c for (a, _, _), c in zip(terms, cosines, strict=True)) for i in range(3))

        return rate
    if isinstance(truth, Composed):
        base, vibration = mp_rate(truth.base), mp_rate(truth.vibration)
        b, w = m.mpf(truth.vibration.angle), m.mpf(truth.vibration.rate)

        def carried(t):
            c, u = m.cos(b / 2), [-m.sin(b / 2) * m.cos(w * t), -m.sin(b / 2) * m.sin(w * t), m.mpf(0)]  # q_v⁻¹
            cross = lambda x, y: [x[i - 2] * y[i - 1] - x[i - 1] * y[i - 2] for i in range(3)]  # noqa: E731
            v = base(t)
            once = cross(u, v)
            twice = cross(u, once)
            return [v[i] + 2 * c * once[i] + 2 * twice[i] for i in range(3)]

        return lambda t: tuple(x + y for x, y in zip(carried(t), vibration(t), strict=True))
    raise TypeError(truth)


LATE = {
    "coning": Coning(angle=0.01, frequency=50.0),
    "spin-cone": SpinCone(precession_rate=300.0, spin_rate=-299.0, angle=0.02),
    "spin-rock": SpinRock(rock_angle=0.02, rock_frequency=50.0, spin_rate=7.3, rock_phase=0.3),
    "harmonic": HarmonicRates(harmonics=elliptic_vibration(50.0, 0.3), mean=(0.01, 0.0, 0.02)),
    "composed": Composed(
        base=SpinCone(precession_rate=3.0, spin_rate=2.0, angle=0.5), vibration=Coning(angle=0.01, frequency=50.0)
    ),
}


@pytest.mark.parametrize("truth", LATE.values(), ids=LATE.keys())
def test_increments_at_1_khz_are_exact_after_an_hour(truth):
    """To 1e-15 of the largest, against 40 digits; phases formed as rounded products would leave 1e-9."""
    edges = 3600.0 + 1e-3 * np.arange(7)
    increments = truth.increments(edges)
    with mpmath.workdps(40):
        rate = cache(mp_rate(truth))  # the three components share their nodes
        spans = [[mpmath.mpf(a), mpmath.mpf(b)] for a, b in itertools.pairwise(edges)]
        exact = np.array([[float(mpmath.quad(lambda t, i=i: rate(t)[i], span)) for i in range(3)] for span in spans])
    assert np.abs(increments - exact).max() <= 1e-15 * np.abs(exact).max()


def test_constant_rate_is_exact_after_an_hour():
    rate, t = (123.4, -5.6, 78.9), 3600.1
    with mpmath.workdps(40):
        norm = mpmath.norm(mpmath.matrix(rate))
        half = norm * mpmath.mpf(t) / 2
        exact = [float(x) for x in (mpmath.cos(half), *(x / norm * mpmath.sin(half) for x in rate))]
    assert np.abs(ConstantRate(rate=rate).attitude(t) - exact).max() < 5e-16


def test_slew_increments_are_exact_where_the_rate_is_tiny():
    truth = Slew(rotation_vector=(0.0, 2.0, 0.0), duration=2.0, start=4096.0)
    for edges in ([4096.0, 4096.0 + 2.0**-10], [4098.0 - 2.0**-10, 4098.0]):
        x = mpmath.mpf(2) ** -11
        exact = 2 * (35 * x**4 - 84 * x**5 + 70 * x**6 - 20 * x**7)
        assert abs(truth.increments(edges)[0, 1] / float(exact) - 1.0) < 1e-15


# ---------------------------------------------------------------------------------------------------- each for itself


def test_spin_cone_is_its_product_of_three_rotations():
    truth = SpinCone(precession_rate=1.3, spin_rate=0.4, angle=0.8)
    t = np.linspace(-3.0, 3.0, 31)[:, None]
    z = np.array([0.0, 0.0, 1.0])
    q = quaternion.multiply(
        quaternion.multiply(quaternion.exp(1.3 * t * z), quaternion.exp([0.8, 0.0, 0.0])), quaternion.exp(0.4 * t * z)
    )
    assert np.abs(truth.attitude(t[:, 0]) - q).max() < 1e-15


def test_slew_turns_by_its_rotation_vector():
    truth = Slew(rotation_vector=(0.5, -1.0, 2.0), duration=3.0, start=1.0, initial_attitude=START)
    end = quaternion.multiply(START, quaternion.exp([0.5, -1.0, 2.0]))
    assert np.abs(truth.attitude([-1.0, 1.0]) - START).max() < 1e-15
    assert np.abs(truth.attitude([4.0, 9.0]) - end).max() < 1e-15
    assert np.abs(truth.body_rate([0.5, 1.0, 4.0, 5.0])).max() == 0.0
    assert np.abs(truth.increments([-3.0, 0.9, 6.0]) - [[0.0] * 3, [0.5, -1.0, 2.0]]).max() < 1e-15
    peak = np.linalg.norm(truth.body_rate(2.5))
    assert peak == pytest.approx(35.0 / 16.0 * math.sqrt(5.25) / 3.0, rel=1e-14)


@pytest.mark.parametrize("truth", TORQUE_FREE.values(), ids=TORQUE_FREE.keys())
def test_torque_free_conserves_energy_and_momentum(truth):
    """From the start on and over two weeks: T, |h|, and h in fixed axes."""
    assert np.abs(truth.body_rate(0.0) - truth.initial_rate).max() < 1e-15 * 4.0
    assert np.abs(truth.attitude(0.0) - START).max() < 1e-15
    t = np.concatenate([np.linspace(-30.0, 30.0, 301), np.random.default_rng(0).uniform(-1e6, 1e6, 100)])
    w, moments = truth.body_rate(t), np.array(truth.inertia)
    energy = 0.5 * (moments * w * w).sum(axis=-1)
    h_b = moments * w
    h_f = quaternion.rotate(truth.attitude(t), h_b)
    momentum = quaternion.rotate(START, moments * np.array(truth.initial_rate))
    size = np.linalg.norm(momentum)
    first = 0.5 * math.fsum(i * w * w for i, w in zip(truth.inertia, truth.initial_rate, strict=True))
    assert np.abs(energy / first - 1.0).max() < 4e-15
    assert np.abs(np.linalg.norm(h_b, axis=-1) / size - 1.0).max() < 4e-15
    assert np.abs(h_f - momentum).max() < 6e-15 * size


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if k % 2 else ())
        for k, name in enumerate([*list(TORQUE_FREE)[:14], list(TORQUE_FREE)[20]])
    ],
)
def test_torque_free_after_a_hundred_thousand_periods(name):
    """After N periods of the rate (Landau and Lifshitz (37.12)) the body has turned about h by N times the advance of one.

    The advance is the integral of the rate of the Euler angle about h, ``L (I_1 w_1² + I_2 w_2²)/((I_1 w_1)² + (I_2 w_2)²)``: another
    formula than the one the motion uses. 40 digits.
    """
    truth = TORQUE_FREE[name]
    periods = 100_000
    with mpmath.workdps(40):
        m = mpmath
        axes = sorted(range(3), key=lambda i: truth.inertia[i])
        moments, w = ([m.mpf(float(x[i])) for i in axes] for x in (truth.inertia, truth.initial_rate))
        twice_energy = sum(i * r**2 for i, r in zip(moments, w, strict=True))
        momentum = m.sqrt(sum((i * r) ** 2 for i, r in zip(moments, w, strict=True)))
        i1, i2, i3 = moments if momentum**2 > twice_energy * moments[1] else moments[::-1]
        outer, inner = twice_energy * i3 - momentum**2, momentum**2 - twice_energy * i1
        p, k2 = m.sqrt((i3 - i2) * inner / (i1 * i2 * i3)), (i2 - i1) * outer / ((i3 - i2) * inner)
        period = 4 * m.ellipk(k2) / p

        def spin(t):
            first = outer / (i1 * (i3 - i1)) * m.ellipfun("cn", p * t, m=k2).real ** 2
            second = outer / (i2 * (i3 - i2)) * m.ellipfun("sn", p * t, m=k2).real ** 2
            return momentum * (i1 * first + i2 * second) / (i1**2 * first + i2**2 * second)

        # Periodic and analytic: equal weights converge geometrically.
        advance = period * sum(spin(period * j / 240) for j in range(120)) / 120
        t = float(periods * period)
        late = float(m.mpf(t) - periods * period)
        turned = float(m.fmod(periods * advance, 4 * m.pi))
    h = quaternion.rotate(START, np.array(truth.inertia) * np.array(truth.initial_rate))
    expected = quaternion.multiply(
        quaternion.multiply(quaternion.exp(turned * h / np.linalg.norm(h)), START),
        quaternion.exp(late * np.array(truth.initial_rate)),
    )
    assert quaternion.angle_between(truth.attitude(t), expected) < 5e-15
    moved = np.array(truth.initial_rate) + late * truth.body_angular_acceleration(0.0)
    assert np.abs(truth.body_rate(t) - moved).max() < 1e-14


@pytest.mark.parametrize("truth", TORQUE_FREE.values(), ids=TORQUE_FREE.keys())
def test_torque_free_increments_over_many_periods(truth):
    fine = truth.increments(np.linspace(0.0, 100.0, 2001)).reshape(2, 1000, 3).sum(axis=1, dtype=np.longdouble)
    assert np.abs(truth.increments([0.0, 50.0, 100.0]) - fine).max() < 1e-15 * 50.0 * rate_scale(truth)


@pytest.mark.parametrize("complement", [1.0, 0.7, 0.1, 1e-3, 1e-8, 1e-20, 1e-40, 1e-300])
def test_jacobi_functions_against_mpmath(complement):
    """Of the separatrix too, whose 1 − m is 1e-300; K and Π to 45 digits."""
    with mpmath.workdps(60 - math.floor(math.log10(complement))), localcontext(prec=DIGITS):
        exact, characteristic = mpmath.mpf(complement), mpmath.mpf("-0.3")
        first, third, means = torque_free.complete_integrals(Decimal(complement), Decimal("-0.3"))
        quarter = mpmath.ellipk(1 - exact)
        assert abs(mpmath.mpf(str(first)) / quarter - 1) < mpmath.mpf(10) ** -45
        assert abs(mpmath.mpf(str(third)) / mpmath.ellippi(characteristic, 1 - exact) - 1) < mpmath.mpf(10) ** -45
        assert abs(mpmath.mpf(str(torque_free.PI)) / mpmath.pi - 1) < mpmath.mpf(10) ** -45
        u = np.linspace(-1.5, 1.5, 11) * float(quarter) + 1e-3
        solution = next(iter(TORQUE_FREE.values()))._solution._replace(means=means)
        got = np.array(torque_free._jacobi(solution, u))
        want = np.array(
            [[float(mpmath.ellipfun(kind, mpmath.mpf(x), m=1 - exact).real) for x in u] for kind in ("sn", "cn", "dn")]
        )
    assert np.abs(got - want).max() < 2e-15


# ---------------------------------------------------------------------------------------------------- harmonic rates


def coning_as_harmonics(coning: Coning) -> HarmonicRates:
    across = coning.rate * math.sin(coning.angle)
    return HarmonicRates(
        harmonics=(
            Harmonic(amplitude=(-across, 0.0, 0.0), frequency=coning.frequency, phase=-0.5 * math.pi),
            Harmonic(amplitude=(0.0, across, 0.0), frequency=coning.frequency),
        ),
        mean=(0.0, 0.0, -2.0 * coning.rate * math.sin(0.5 * coning.angle) ** 2),
        initial_attitude=coning.attitude(0.0),
    )


def stated_error(motion: HarmonicRates, time: float) -> float:
    """The bound of the neglected terms, and rounding: of the rotations between nodes, at random, and equal at every node, as for coning."""
    nodes = 1.0 + abs(time) / motion._spacing
    turn = min(1.0, motion._spacing * motion._largest_rate)
    rounding = 2.0**-52 * (4.0 + 2.0 * turn * math.sqrt(nodes) + 0.25 * abs(time) * motion._largest_rate)
    return 4.0 * nodes * motion._truncation(0.5 * motion._spacing) + rounding


@pytest.mark.parametrize(("angle", "frequency"), [(1e-3, 100.0), (0.01, 30.0), (0.5, 1.0), (2.0, 0.2)])
def test_harmonic_attitude_is_the_closed_form_of_coning(angle, frequency):
    coning = Coning(angle=angle, frequency=frequency)
    truth = coning_as_harmonics(coning)
    t = np.concatenate([np.random.default_rng(1).uniform(-100.0, 100.0, 200), [0.0, 600.0]])
    error = quaternion.angle_between(truth.attitude(t), coning.attitude(t))
    # Besides the stated error: amplitudes and mean are rounded in the passing from one form to the other.
    stated = np.array([stated_error(truth, x) for x in t]) + 1.2e-16 * truth._largest_rate * np.abs(t)
    assert (error <= stated).all()
    assert stated_error(truth, 1400.0 / truth._largest_rate) < 1e-13


def test_harmonic_attitude_of_a_small_vibration_gathers_no_rounding():
    """Ten minutes at 100 Hz, 200,000 nodes: plain sums leave 1.6e-15."""
    coning = Coning(angle=1e-5, frequency=100.0)
    same = coning_as_harmonics(coning)
    truth = HarmonicRates(
        harmonics=same.harmonics, mean=same.mean, initial_attitude=quaternion.multiply(START, same.initial_attitude)
    )
    t = np.linspace(599.0, 600.0, 101)
    expected = quaternion.multiply(START, coning.attitude(t))
    assert quaternion.angle_between(truth.attitude(t), expected).max() < 2.5e-16


# ---------------------------------------------------------------------------------------------------- sampled motions


def test_sampled_motion_passes_through_its_samples():
    q, time = wandering_attitudes(40), np.cumsum(np.random.default_rng(4).uniform(0.5, 1.5, 40))
    signs = np.where(np.random.default_rng(6).random(40) < 0.5, -1.0, 1.0)[:, None]
    truth = SampledAttitude(time=time, attitudes=signs * q)
    assert quaternion.angle_between(truth.attitude(time), q).max() < 1e-14


def test_sampled_motion_converges_on_the_motion_sampled():
    true = SpinRock(rock_angle=0.6, rock_frequency=0.3, spin_rate=1.0, rock_phase=0.2)
    t = np.linspace(2.0, 8.0, 301)
    errors = []
    for n in (101, 201):
        time = np.linspace(0.0, 10.0, n)
        truth = SampledAttitude(time=time, attitudes=true.attitude(time))
        errors.append(quaternion.angle_between(truth.attitude(t), true.attitude(t)).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(6.0, abs=0.3)


def test_sampled_rate_is_smooth_at_the_samples():
    """The attitude is C⁴: the rate is C³, and the next derivative jumps."""
    truth = SampledAttitude(time=np.arange(12.0), attitudes=wandering_attitudes(12))

    def jump(k, h):
        """Of the k-th derivative at a sample, by one-sided differences."""
        weights = [(-1) ** (k - i) * math.comb(k, i) for i in range(k + 1)]
        before, after = (
            sum(w * truth.body_rate(5.0 + side * i * h) for i, w in enumerate(weights)) * (side / h) ** k
            for side in (-1.0, 1.0)
        )
        return np.abs(after - before).max()

    assert jump(4, 0.02) > 0.2
    assert jump(3, 0.02) / jump(3, 0.01) == pytest.approx(2.0, rel=0.3)  # vanishes with the step


def test_sampled_motion_turns_with_its_axes():
    q, turn, mount = wandering_attitudes(9), quaternion.exp([0.4, 1.0, -2.0]), quaternion.exp([1.0, 0.2, 0.7])
    time = np.linspace(0.0, 2.0, 9)
    t = np.linspace(0.0, 2.0, 57)
    plain = SampledAttitude(time=time, attitudes=q)
    turned = SampledAttitude(time=time, attitudes=quaternion.multiply(quaternion.multiply(turn, q), mount))
    want = quaternion.multiply(quaternion.multiply(turn, plain.attitude(t)), mount)
    assert quaternion.angle_between(turned.attitude(t), want).max() < 1e-14


def test_waypoints_start_and_end_at_rest():
    truth = waypoints([1.0, 2.0, 4.0, 5.0], wandering_attitudes(4))
    assert np.abs(truth.body_rate([1.0, 5.0])).max() < 1e-14
    assert np.abs(truth.body_angular_acceleration([1.0, 5.0])).max() < 1e-13
    assert np.abs(truth.body_rate(3.0)).max() > 0.01


# ---------------------------------------------------------------------------------------------------- composition


def test_composition_truly_cones():
    """On a resting base the composed motion is the vibration; its mean rate about z is the coning rate."""
    coning = Coning(angle=0.02, frequency=10.0)
    truth = Composed(base=rest(START), vibration=coning)
    edges = np.linspace(0.0, 1.0, 1001)
    assert np.abs(truth.increments(edges) - coning.increments(edges)).max() < 1e-17
    assert truth.increments([0.0, 1.0])[0, 2] == pytest.approx(-coning.rate * (1.0 - math.cos(0.02)), rel=1e-11)
    assert quaternion.angle_between(truth.attitude(0.3), quaternion.multiply(START, coning.attitude(0.3))) < 1e-15


@dataclass(frozen=True, kw_only=True)
class Kicked:
    """A motion from outside the package: spin about z, at rest until ``kick``, then at a rate that grows with the time since."""

    kick: float

    def _since(self, time):
        return np.maximum(np.asarray(time, dtype=float) - self.kick, 0.0)

    def _about_z(self, value):
        return value[..., None] * np.array([0.0, 0.0, 1.0])

    def attitude(self, time):
        return quaternion.exp(self._about_z(0.5 * self._since(time) ** 2))

    def body_rate(self, time):
        return self._about_z(self._since(time))

    def body_angular_acceleration(self, time):
        return self._about_z(np.where(self._since(time) > 0.0, 1.0, 0.0))

    def increments(self, edges):
        return self._about_z(np.diff(0.5 * self._since(edges) ** 2))


@dataclass(frozen=True, kw_only=True)
class DeclaredKick(Kicked):
    """The same, and says where its rate is not smooth."""

    @property
    def breaks(self):
        return [self.kick]


def test_a_motion_from_outside_may_declare_its_breaks():
    """Under coning, which carries its rate about z round a cone: ∫ (t − kick) (−sinβ sin ωt, sinβ cos ωt, cosβ) dt, in closed form."""
    kick, edges = (
        0.995,
        np.linspace(0.0, 1.5, 4),
    )  # between the last node and the end of an interval: unseen unless named
    assert isinstance(DeclaredKick(kick=kick), Motion)
    coning = Coning(angle=0.05, frequency=0.7)
    for base, low, high in [(DeclaredKick(kick=kick), 0.0, 2e-15), (Kicked(kick=kick), 1e-6, 1e-4)]:
        truth = Composed(base=base, vibration=coning)
        carried = truth.increments(edges) - coning.increments(edges)
        w, start = coning.rate, np.maximum(edges, kick)
        t = start - kick
        primitive = np.stack(
            [
                math.sin(0.05) * (t * np.cos(w * start) / w - np.sin(w * start) / w**2),
                math.sin(0.05) * (t * np.sin(w * start) / w + np.cos(w * start) / w**2),
                math.cos(0.05) * 0.5 * t**2,
            ],
            axis=-1,
        )
        error = np.abs(carried - np.diff(primitive, axis=0)).max()
        assert low <= error <= high
        assert (
            Composed(base=rest(), vibration=truth).breaks.tolist() == np.asarray(getattr(base, "breaks", ())).tolist()
        )


def test_breaks_of_a_composition_are_those_of_its_parts():
    slew = Slew(rotation_vector=(1.0, 0.0, 0.0), duration=0.75, start=0.5)
    sampled = waypoints([0.0, 1.0, 2.0], wandering_attitudes(3))
    truth = Composed(base=sampled, vibration=Composed(base=slew, vibration=rest()))
    assert truth.breaks.tolist() == [0.0, 0.5, 1.0, 1.25, 2.0]


@pytest.mark.parametrize(
    ("breaks", "message"),
    [([0.5, math.nan], r"vibration.breaks\[1\] is nan"), (0.5, r"vibration.breaks has shape \(\), wanted \(k,\)")],
)
def test_bad_breaks_are_refused(breaks, message):
    kicked = Kicked(kick=0.5)
    object.__setattr__(kicked, "breaks", breaks)
    with pytest.raises(InputError, match=message):
        Composed(base=rest(), vibration=kicked)
