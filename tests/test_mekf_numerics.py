"""Numerical safety: positive definite over long runs and over ten decades of measurement noise; single precision characterised."""

import functools
import re
from contextlib import nullcontext
from dataclasses import replace

import in_steps
import mpmath
import numpy as np
import pytest
from measured import EVERY_KIND, STAR, SWAY, in_body, record_of, resting, series_of, turn_to, unit
from scipy.spatial.transform import Rotation
from square_root import SquareRootFilter

from strapdown import estimation, kinematics, motion, quaternion, records
from strapdown.checks import InputError
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import GateMemory, ProcessNoise, initial_state
from strapdown.kernels import gate_rules
from strapdown.kernels.gate_rules import CANDIDATE
from strapdown.records import ImuRecord
from strapdown.units import ARCSECOND
from strapdown.vectors import VectorMeasurements

NOISE = ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)


def least_eigenvalue(P):
    """Least eigenvalue of matrices (..., 6, 6) scaled to a unit diagonal."""
    d = np.sqrt(np.einsum("...ii->...i", P))
    return np.linalg.eigvalsh(P / (d[..., :, None] * d[..., None, :]))[..., 0].min()


def sharp_record(sigma, steps=400):
    """A turning body that sees three directions in turn, exactly, with a modelled noise of ``sigma`` rad."""
    body = motion.ConstantRate(rate=(0.3, -0.5, 0.4))
    time = 0.02 * np.arange(steps + 1)
    series = []
    for k, r in enumerate(([1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.6, -0.8, 0.0])):
        at = time[1 + k :: 3]
        directions = quaternion.rotate(quaternion.conjugate(body.attitude(at)), np.array(r))
        series.append(series_of(f"s{k}", "direction", at, directions, r, sigma))
    return ImuRecord(time=time, increments=body.increments(time), vectors=tuple(series)), body.attitude(time)


OPTIONS = Gate(probability=1.0 - 1e-12)
DECADES = [(exponent, gate) for exponent in range(-9, 4, 2) for gate in (None, OPTIONS)]
"""Of σ over the prior's."""
NAMES = [f"1e{exponent}-{'plain' if gate is None else 'options'}" for exponent, gate in DECADES]
REFUSED = r"^a measurement is more than 7e\+06 times as precise as the state"


ROUNDING = 1e-15
"""Of the least eigenvalue of a matrix with a unit diagonal."""


def bound_of(sigma):
    """Return the bound of a variance's relative error after measurements of σ, rad, from a start that is known to a radian."""
    return 1e-6 if sigma >= ARCSECOND else 1e-3


def taken_or_refused(sigma, record, process, start, **options):
    """Run the filter; return None if it refuses measurements of σ, sharper than a tenth of an arcsecond, for want of digits."""
    try:
        estimate, end = estimation.run_part(record, process, start, full_covariance=True, **options)
    except InputError as error:
        assert sigma < 0.09 * ARCSECOND, error  # noqa: PT017
        assert re.match(REFUSED, str(error)), error  # noqa: PT017
        return None
    assert np.array_equal(np.diag(end.covariance)[:6], estimate.variance[-1])
    return estimate


@pytest.mark.parametrize(("exponent", "gate"), DECADES, ids=NAMES)
def test_positive_definite_over_twelve_decades_of_noise_over_the_prior(exponent, gate):
    """σ from 1e-9 to 1e3 of the prior's, both loops, at every step; or a refusal."""
    record, truth = sharp_record(10.0**exponent)
    start = initial_state(
        quaternion.multiply(truth[0], quaternion.exp([1e-9, 0, 0])), attitude_sigma=1.0, bias_sigma=0.1
    )
    result = taken_or_refused(10.0**exponent, record, NOISE, start, gate=gate)
    if result is not None:
        assert least_eigenvalue(result.covariance) > 0.0
        assert np.all(np.isfinite(result.attitude))
        assert np.max(quaternion.angle_between(result.attitude, truth)) < 1e-6


SILENT = tuple(series.taken(slice(0)) for series in record_of(duration=1.0, anisotropic=True).vectors)
"""Sensors without measurements, with which tests of one kind of sensor share their kernels."""


@pytest.mark.parametrize(
    ("kind", "gate", "states"),
    [
        *((kind, None, ()) for kind in ("direction", "vector", "attitude")),
        ("direction", OPTIONS, ()),
        ("vector", None, EVERY_KIND),
        pytest.param("attitude", OPTIONS, EVERY_KIND, marks=pytest.mark.slow),
    ],
)
def test_what_needs_more_digits_than_a_covariance_has_is_refused(kind, gate, states):
    """A nanoradian at a start known to a radian; a hundredth of that start, and 0.1 arcseconds at one known to 3 rad, are taken."""
    axis = np.array([0.0, 0.6, 0.8])
    for sigma, first, refused in ((1e-9, 1.0, True), (1e-2, 1.0, False), (0.1 * ARCSECOND, 3.0, False)):
        series = {"sensor": "star", "kind": kind, "time": [0.0], "sigma": sigma}
        series |= (
            {"attitude": [quaternion.IDENTITY]} if kind == "attitude" else {"vector_b": [axis], "reference_f": axis}
        )
        record = resting(*(SILENT if states else ()), VectorMeasurements(**series))
        start = initial_state(quaternion.IDENTITY, attitude_sigma=first, bias_sigma=0.1)
        if refused:
            with pytest.raises(InputError, match=REFUSED):
                estimation.run(record, NOISE, start, states, gate=gate)
        else:
            estimation.run(record, NOISE, start, states, gate=gate)


@pytest.mark.parametrize("sigma", [1e-9, 1e-2])
def test_a_filter_that_has_recovered_refuses_it_too(sigma):
    """Its updates are iterated."""
    series = VectorMeasurements(
        sensor="star",
        kind="direction",
        time=[0.0],
        sigma=sigma,
        vector_b=[[0.0, 0.6, 0.8]],
        reference_f=[0.0, 0.6, 0.8],
    )
    counts = np.zeros(gate_rules.MEMORY)
    counts[gate_rules.PASSES] = gate_rules.WIDE_PASSES
    memory = GateMemory(restart_bias_variance=np.ones(3), counts=counts, counters={})
    start = replace(initial_state(quaternion.IDENTITY, attitude_sigma=1.0, bias_sigma=0.1), gate=memory)
    with pytest.raises(InputError, match=REFUSED) if sigma < 1e-3 else nullcontext():
        estimation.run(resting(series), NOISE, start, gate=OPTIONS)


def reference_variances(record, noise, prior):
    """Variances (m, 6) of a body that does not turn and whose errors are zero, by the covariance's recursion in 60 digits."""
    mp = mpmath.mp
    with mpmath.workdps(60):
        P = mp.diag([mp.mpf(float(x)) ** 2 for x in prior])
        v, u = mp.mpf(noise.angle_random_walk) ** 2, mp.mpf(noise.rate_random_walk) ** 2
        rows = []
        for k, now in enumerate(record.time):
            if k:
                dt = mp.mpf(float(now)) - mp.mpf(float(record.time[k - 1]))
                step = mp.eye(6)
                Q = mp.zeros(6, 6)
                for i in range(3):
                    step[i, 3 + i] = -dt
                    Q[i, i] = v * dt + u * dt**3 / 3
                    Q[i, 3 + i] = Q[3 + i, i] = -u * dt**2 / 2
                    Q[3 + i, 3 + i] = u * dt
                P = step * P * step.T + Q
            for series in record.vectors:
                for at in np.flatnonzero(series.time == now):
                    r = mp.matrix([mp.mpf(float(x)) for x in series.references_f[at]])
                    H = mp.zeros(3, 6)
                    for i, j, m in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                        H[i, j], H[j, i] = -r[m], r[m]
                    across = mp.qr(mp.matrix([[r[0], 1, 0], [r[1], 0, 1], [r[2], 1, 1]]))[0][:, 1:]
                    H = across.T * H  # two directions across r: along it nothing is measured
                    S = H * P * H.T + mp.mpf(float(series.sigma[at])) ** 2 * mp.eye(2)
                    P = P - P * H.T * mp.inverse(S) * H * P
                    P = (P + P.T) / 2
            rows.append([float(P[i, i]) for i in range(6)])
        return np.array(rows)


def by_covariance(series):
    """The same measurements with their noise given as a covariance."""
    return VectorMeasurements(
        sensor=series.sensor,
        kind=series.kind,
        time=series.time,
        vector_b=series.vector_b,
        reference_f=series.references_f,
        covariance=series.sigma[:, None, None] ** 2 * np.eye(3),
    )


@functools.cache
def sparse_record(sensors, sigma, noise):
    """Random directions, one or three at a time, the process noise, and the variances in 60 digits."""
    generator = np.random.default_rng(7)
    time = np.concatenate([0.1 * np.arange(31), [1000.0, 1000.1]])  # an outage after which attitude and bias are one
    series = []
    for k in range(sensors):
        r = generator.standard_normal(3)
        r /= np.linalg.norm(r)
        at = time[[0, 10, 20, 32]] if k == 0 else time[[0, 10]]
        series.append(series_of(f"s{k}", "direction", at, np.tile(r, (len(at), 1)), r, sigma))
    record = resting(*series, time=time)
    process = ProcessNoise(angle_random_walk=noise[0], rate_random_walk=noise[1])
    return record, process, reference_variances(record, process, [1.0] * 3 + [0.1] * 3)


@pytest.mark.parametrize("noise", [(1e-12, 0.0), (1e-12, 1e-14), (1e-4, 1e-5)], ids=["no drift", "little", "usual"])
@pytest.mark.parametrize("sigma", [1e-7, 1e-6, 1e-3])
@pytest.mark.parametrize("sensors", [1, 3])
@pytest.mark.parametrize("options", ["none", "gate", "huber", "covariance"])
def test_variances_are_those_in_sixty_digits(options, sensors, sigma, noise):
    """Against 60 digits: after one of the directions σ about it is still the prior's, 1e7 times more."""
    record, process, expected = sparse_record(sensors, sigma, noise)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=0.1)
    keywords = {"gate": {"gate": OPTIONS}, "huber": {"robust": Robust(kind="huber")}}.get(options, {})
    if options == "covariance":
        record = replace(record, vectors=tuple(by_covariance(s) for s in record.vectors))
    estimate = taken_or_refused(sigma, record, process, start, **keywords)
    if estimate is not None:
        assert np.max(np.abs(estimate.variance / expected - 1.0)) < bound_of(sigma)
        assert least_eigenvalue(estimate.covariance) > -ROUNDING


@pytest.mark.parametrize("outage", [1e4, 1e7])
def test_an_outage_that_makes_attitude_and_bias_one_leaves_the_covariance_definite(outage):
    """After 1e4 s the attitude's error is the bias's, to 1e-12 of its variance; a measurement then determines both; 1e7 s are refused."""
    time = np.concatenate([[0.0, 1.0], outage + np.arange(3.0)])
    series = tuple(
        series_of(name, "direction", time[[0, 3]], np.tile(r, (2, 1)), r, 1e-3)
        for name, r in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 0.6, 0.8]))
    )
    process = ProcessNoise(angle_random_walk=1e-12, rate_random_walk=0.0)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=0.1)
    for end in (3, 5):  # before and after the measurements end the outage
        mine = tuple(s.taken(np.flatnonzero(s.time <= time[end - 1])) for s in series)
        record = ImuRecord(time=time[:end], increments=np.zeros((end - 1, 3)), vectors=mine)
        if end == 5 and outage > 1e4:  # the variance of the bias becomes 1e-18 of what it was
            with pytest.raises(InputError, match=REFUSED):
                estimation.run(record, process, start)
            continue
        expected = reference_variances(record, process, [1.0] * 3 + [0.1] * 3)
        for gate in (None, OPTIONS):
            estimate, _ = estimation.run_part(record, process, start, full_covariance=True, gate=gate)
            assert least_eigenvalue(estimate.covariance) > -ROUNDING
            assert np.max(np.abs(estimate.variance / expected - 1.0)) < 1e-3


@pytest.mark.parametrize("gate", [Gate(), Gate(probability=0.99, recovery=4)], ids=["usual", "eager"])
def test_a_gate_recovers_with_sharp_measurements_and_in_parts(gate):
    """A lost start and directions 1e-7 as wide as a restart: in one, in parts to the bit, and with whole covariances stored.

    Cut while sensors are refused, while a candidate runs, and after the recovery.
    """
    record, truth = sharp_record(1e-7, steps=60)
    off = quaternion.multiply(truth[0], quaternion.exp([0.4, -0.2, 0.1]))
    start = initial_state(off, attitude_sigma=1e-3, bias_sigma=0.01)
    estimate = estimation.run(record, NOISE, start, gate=gate, full_covariance=True)
    assert [event.kind for event in estimate.events] == ["recovery"]
    assert quaternion.angle_between(estimate.attitude[-1], truth[-1]) < 1e-9
    assert least_eigenvalue(estimate.covariance) > 0.0
    other = estimation.run(record, NOISE, start, gate=gate)
    assert np.array_equal(estimate.attitude, other.attitude)
    assert estimate.events == other.events
    challenged = []
    for cut in (3, 5, 8, 12, 40):
        first, state = estimation.run_part(records.cut(record, 0, cut), NOISE, start, gate=gate)
        challenged.append(state.gate.counts[CANDIDATE])
        rest, end = estimation.run_part(records.cut(record, cut, 60), NOISE, state, gate=gate, full_covariance=True)
        assert np.array_equal(rest.attitude, estimate.attitude[cut:])
        assert np.array_equal(rest.variance, estimate.variance[cut:])
        assert [event.kind for event in (*first.events, *rest.events)] == ["recovery"]
        assert np.array_equal(end.covariance, rest.covariance[-1])
    assert any(challenged)


@pytest.mark.parametrize("states", [(), EVERY_KIND], ids=["six", "more"])
@pytest.mark.parametrize("angle", [0.3, 0.6, 0.95, 1.5])
def test_a_large_correction_is_exact(states, angle):
    """P = σ²I and one measured attitude of variance r: the correction is φ σ²/(σ² + r), and P becomes σ² r/(σ² + r) J Jᵀ."""
    sigma, r, axis = 0.5, 2e-4, np.array([0.6, 0.48, 0.64])
    measured = VectorMeasurements(
        sensor="tracker",
        kind="attitude",
        time=[0.0],
        attitude=[Rotation.from_rotvec(angle * axis).as_quat(scalar_first=True)],
        sigma=np.sqrt(r),
    )
    others = tuple(series for series in SILENT if states and series.kind != "attitude")
    record = ImuRecord(time=[0.0, 0.01], increments=np.zeros((1, 3)), vectors=(*others, measured))
    start = initial_state(quaternion.IDENTITY, attitude_sigma=sigma, bias_sigma=1e-6)
    estimate = estimation.run(record, NOISE, start, states, full_covariance=True)
    share = sigma**2 / (sigma**2 + r)
    theta = mpmath.mpf(share * angle)
    K = kinematics.skew(axis)
    J = np.eye(3) - float((1 - mpmath.cos(theta)) / theta) * K + float(1 - mpmath.sin(theta) / theta) * K @ K
    want = Rotation.from_rotvec(share * angle * axis).as_quat(scalar_first=True)
    np.testing.assert_allclose(estimate.attitude[0], want, rtol=0, atol=1e-15)
    np.testing.assert_allclose(estimate.covariance[0, :3, :3], r * share * J @ J.T, rtol=0, atol=3e-15 * r)


# ----------------------------------------------------------------------------------------------- against the square root of the covariance


def tracked(sigma, sharp=None, duration=2.0, states=()):
    """A record of a turning body with two stars, field and force, and perhaps one direction that is much sharper than all else."""
    record = record_of(duration=duration, rate=25.0, anisotropic=bool(states))
    series = [s for s in record.vectors if s.sensor in ("mag", "force")]
    series += SILENT[2:] if states else ()
    random = np.random.default_rng(3)
    for name, at, r, noise in (
        ("first", np.arange(0.2, duration, 0.4), STAR, sigma),
        ("second", np.arange(0.2, duration, 0.4), np.array([-0.28, 0.96, 0.0]), sigma),
        ("third", np.array([0.5 * duration]), np.array([0.3, -0.2, 0.9]), sharp),
    ):
        if noise:
            vector = in_body(SWAY.attitude(at), unit(r)) + noise * random.standard_normal((len(at), 3))
            # With states as a whole vector, for the structure of other tests: its length says nothing.
            series.append(series_of(name, "vector" if states else "direction", at, unit(vector), unit(r), noise))
    return replace(record, vectors=tuple(series))


SHARP = {
    "1 mrad": (1e-3, None, 1.0, 1e-6),
    "1 arcsecond": (ARCSECOND, None, 1.0, 1e-6),
    "one of 1 arcsecond": (1e-3, ARCSECOND, 1.0, 1e-6),
    "1 µrad": (1e-6, None, 1.0, 1e-3),
    "0.1 µrad": (1e-7, None, 1.0, 1e-3),
    "one of 1 nrad": (1e-3, 1e-9, 1.0, 1e-3),
    "from anywhere": (ARCSECOND, None, 1.8, 1e-3),
    "from 3 rad": (ARCSECOND, None, 3.0, 1e-3),
    "0.1 arcsecond from anywhere": (0.1 * ARCSECOND, None, 1.8, 1e-3),
    "0.1 arcsecond from 3 rad": (0.1 * ARCSECOND, None, 3.0, 1e-3),
}
WITH_STATES = ("1 arcsecond", "one of 1 nrad", "from 3 rad")
"""With error states in the default run; the reference takes a second."""


@pytest.mark.parametrize(
    ("sigma", "sharp", "start_sigma", "bound", "states"),
    [
        pytest.param(
            *case, states, id=f"{name}-{many}", marks=[] if not states or name in WITH_STATES else pytest.mark.slow
        )
        for many, states in (("six", ()), ("states", EVERY_KIND))
        for name, case in SHARP.items()
    ],
)
def test_variances_are_those_of_the_square_root(sigma, sharp, start_sigma, bound, states):
    """Every variance at every edge; within 60° and from an arcsecond on the estimate too, to as much of its σ."""
    record = tracked(sigma, sharp, states=states)
    draw = start_sigma * np.array([0.4, -0.3, 0.5])
    first = initial_state(
        quaternion.multiply(SWAY.attitude(np.array(0.0)), quaternion.exp(draw)),
        attitude_sigma=start_sigma,
        bias_sigma=0.01,
    )
    f = SquareRootFilter(
        NOISE, estimation.with_error_states(first, states), states, sensors=[s.sensor for s in record.vectors]
    )
    attitude, bias, _, P = in_steps.fed(f, record)
    expected = np.einsum("kii->ki", P)
    estimate = taken_or_refused(min(sigma, sharp or sigma), record, NOISE, first, error_states=states)
    if estimate is None:
        return
    whole = estimate.covariance if not states else estimate.whole_covariance
    variance = np.einsum("kii->ki", whole)
    assert np.all(variance > 0.0)
    assert np.max(np.abs(variance / expected - 1.0)) < bound
    error = np.concatenate([turn_to(attitude, estimate.attitude), bias - estimate.bias], axis=1)
    if bound == 1e-6:
        assert np.max(np.abs(error) / np.sqrt(expected[:, :6])) < bound


def test_sub_steps_do_not_depend_on_the_reading_of_the_clock():
    """Seconds since 1970 have seven digits behind the point; a sub-step of the second record is shorter than their last."""
    for turn, passes in ((100.0, (estimation.run, estimation.smooth)), (1e5, (estimation.run,))):
        record = ImuRecord(time=1.7e9 + 0.01 * np.arange(4.0), increments=np.full((3, 3), turn))
        initial = initial_state(quaternion.IDENTITY, attitude_sigma=1e-2, bias_sigma=1e-9)
        expected = quaternion.exp(turn * np.outer(np.arange(4.0), np.ones(3)))
        for through in passes:
            off = quaternion.angle_between(through(record, NOISE, initial).attitude, expected)
            assert off.max() < 1e-10 * turn


@pytest.mark.parametrize(("parts", "steps"), [(1, 100_000), pytest.param(500, 2_000_000, marks=pytest.mark.slow)])
def test_positive_definite_and_steady_over_a_long_run(parts, steps):
    """1e5 steps, or 1e9 (five minutes): the covariance repeats itself period by period to rounding, and the quaternion keeps its norm."""
    body = motion.ConstantRate(rate=(0.0, 0.0, 2.0 * np.pi / 10.0))
    time = 0.1 * np.arange(steps + 1)
    series = tuple(
        series_of(
            name,
            "direction",
            time[1:],
            quaternion.rotate(quaternion.conjugate(body.attitude(time[1:])), np.array(r)),
            r,
            1e-4,
        )
        for name, r in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 0.6, 0.8]))
    )
    record = ImuRecord(time=time, increments=body.increments(time), vectors=series)
    state = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1e-2, bias_sigma=1e-3)
    covariances = []
    for _ in range(parts):
        whole, state = estimation.run_part(record, NOISE, state, every=steps // 10, full_covariance=True)
        covariances.append(whole.covariance[1:])
        assert abs(np.linalg.norm(state.attitude) - 1.0) < 1e-14
    P = np.concatenate(covariances)  # whole turns apart
    assert least_eigenvalue(P) > 1e-3
    d = np.sqrt(np.diag(P[0]))
    assert np.abs((P - P[0]) / np.outer(d, d)).max() < 1e-9
    # The last corrections are rounding.
    assert np.max(quaternion.angle_between(whole.attitude, body.attitude(time[:: steps // 10]))) < 1e-9


@pytest.mark.parametrize(("exponent", "gate"), DECADES, ids=NAMES)
def test_the_covariance_is_that_of_the_information_form(exponent, gate):
    """(I/σ₀² + Σ (I − r rᵀ)/σ²)⁻¹ of three directions at one time."""
    sigma = 10.0**exponent
    references = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.6, -0.8, 0.0]])
    series = tuple(series_of(f"s{k}", "direction", [0.0], [r], r, sigma) for k, r in enumerate(references))
    record = resting(*series)
    start = initial_state((1.0, 0.0, 0.0, 0.0), attitude_sigma=1.0, bias_sigma=0.1)
    estimate = taken_or_refused(sigma, record, NOISE, start, gate=gate)
    if estimate is None:
        return
    P = estimate.covariance[0, :3, :3]
    information = np.eye(3) + sum(np.eye(3) - np.outer(r, r) for r in references) / sigma**2
    expected = np.linalg.inv(information)
    d = np.sqrt(np.diag(expected))
    assert np.abs((P - expected) / np.outer(d, d)).max() < 1e-9
