"""Drift under coning: 50-digit truth, the closed forms, and the double-precision code, against one another."""

import math

import mpmath as mp
import numpy as np
import pytest

from sims.coning_algorithms import OWN, PUBLISHED, coning_increments, exact_error
from strapdown import coning, quaternion
from strapdown.checks import InputError
from strapdown.coning import ALGORITHMS, VibrationLine, vibration_drift

SOME = [pytest.param(name, marks=[] if k % 4 == 0 else pytest.mark.slow) for k, name in enumerate(ALGORITHMS)]
"""One algorithm in four, where its coefficients are not what is tested."""


def double_precision_drift(name, angle, ratio):
    """Return the drift over ω of the package's code, by the fixed-rotation trick on one step far from the record's ends."""
    table = ALGORITHMS[name]
    n = table.samples
    before = n * max(2, -(-table.previous // n))
    first, last = -before, n + table.previous + table.following + 2
    with mp.workdps(40):
        beta, lam = mp.mpf(angle), mp.mpf(ratio)
        exact = coning_increments(beta, lam, first, last)
    attitude = coning.integrate(np.array(exact, dtype=float), table)
    step = quaternion.multiply(quaternion.conjugate(attitude[before // n]), attitude[before // n + 1])
    turn = 0.5 * n * ratio
    fixed = quaternion.multiply(step, np.array([math.cos(turn), 0.0, 0.0, math.sin(turn)]))
    half = (
        math.atan2(np.linalg.norm(fixed[1:]), fixed[0])
        if math.sin(turn) > 0
        else math.atan2(-np.linalg.norm(fixed[1:]), fixed[0])
    )
    return 2.0 * (math.remainder(half - turn, math.pi)) / (n * ratio)


@pytest.mark.parametrize("name", SOME)
def test_double_precision_agrees_with_thirty_digits(name):
    angle, ratio = 0.3, 0.6
    true = float(exact_error(name, angle, ratio, digits=30).drift)
    step = ALGORITHMS[name].samples * ratio
    rounding = 6e-16 / step / min(abs(math.sin(0.5 * step)), 1.0)
    assert double_precision_drift(name, angle, ratio) == pytest.approx(true, rel=0.01, abs=rounding)


@pytest.mark.parametrize("name", SOME)
def test_the_predicted_drift_is_the_leading_term_of_the_series(name):
    ratio, frequency, beta = 0.02, 5.0, 1e-6
    predicted = coning.predicted_coning_drift(name, beta, frequency, ratio / (2.0 * math.pi * frequency))
    series = beta**2 * 2.0 * math.pi * frequency * coning.small_angle_drift(name, ratio)
    assert predicted == pytest.approx(series, rel=0.01, abs=0.0)


@pytest.mark.parametrize("name", list(ALGORITHMS))
def test_drift_order_and_constant_of_every_table(name):
    """With digits enough β can be so small that no second-order floor shows; a wrong order is a factor of 2,500."""
    table, ratio = ALGORITHMS[name], 0.02
    drift = float(exact_error(name, 1e-32, ratio, digits=150).drift / mp.mpf(1e-32) ** 2)
    assert drift == pytest.approx(-float(table.drift_constant) * ratio**table.drift_order, rel=0.02)


@pytest.mark.parametrize("name", SOME)
def test_small_angle_drift_is_the_whole_series(name):
    for ratio in (0.1, 1.0):
        true = float(exact_error(name, 1e-15, ratio, digits=70).drift / mp.mpf(1e-15) ** 2)
        assert coning.small_angle_drift(name, ratio) == pytest.approx(true, rel=1e-6, abs=1e-17)


def drift_of_a_turn(beta, samples):
    """Return the drift over ω of one turn of a cone of ``samples`` exact increments, each a rotation at constant rate, to fifty digits.

    After a turn of equation (18) the attitude is what it was, so the rotation composed of the steps is the drift.
    """
    with mp.workdps(50):
        beta, lam = mp.mpf(beta), 2 * mp.pi / samples
        attitude = mp.eye(3)
        for k in range(samples):
            x = mp.quad(lambda t: -mp.sin(beta) * mp.sin(t), [k * lam, (k + 1) * lam])
            y = mp.quad(lambda t: mp.sin(beta) * mp.cos(t), [k * lam, (k + 1) * lam])
            z = (mp.cos(beta) - 1) * lam
            attitude *= mp.expm(mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        sine = mp.matrix([attitude[i, j] - attitude[j, i] for i, j in ((2, 1), (0, 2), (1, 0))]) / 2
        angle = mp.atan2(mp.norm(sine), (attitude[0, 0] + attitude[1, 1] + attitude[2, 2] - 1) / 2)
        return float(mp.sign(sine[2]) * angle / (2 * mp.pi))


@pytest.mark.parametrize(("degrees", "too_small"), [(1e-3, 0.0), (0.7, 1.884e-6), (17.0, 1.075e-3), (45.0, 6.10e-3)])
def test_one_sample_drift_against_steps_composed_to_fifty_digits(degrees, too_small):
    """The formula holds to β²; what it lacks grows with β²: 0.1 % at 17°, 0.6 % at 45°."""
    beta, frequency, samples = math.radians(degrees), 3.0, 10
    true = 2.0 * math.pi * frequency * drift_of_a_turn(beta, samples)
    predicted = coning.predicted_coning_drift("one-sample", beta, frequency, 1.0 / (frequency * samples))
    assert 1.0 - predicted / true == pytest.approx(too_small, rel=2e-3, abs=1e-10)
    exact = 2.0 * math.pi * frequency * float(exact_error("one-sample", beta, 2.0 * math.pi / samples).drift)
    assert exact == pytest.approx(true, rel=1e-12)


@pytest.mark.parametrize(("angle_degrees", "ratio"), [(3.0, 0.6), (45.0, 0.02)])
def test_own_best_beats_every_published_algorithm(angle_degrees, ratio):
    """Lower drift and lower periodic error than any algorithm published, or at rounding. The sim covers the whole grid."""
    angle = math.radians(angle_degrees)
    own = exact_error("matched-1-8-8", angle, ratio, digits=30)
    others = [exact_error(name, angle, ratio, digits=30) for name in PUBLISHED]
    rounding = 2.0**-52
    assert abs(own.drift) < max(min(abs(e.drift) for e in others), rounding / ratio)
    assert own.periodic < max(min(e.periodic for e in others), rounding)


def test_second_order_forms_have_a_floor_and_own_best_has_not():
    angle, ratio = math.radians(20.0), 0.2
    assert abs(exact_error("eight-sample", angle, ratio).drift) > 10 * abs(
        exact_error("three-sample", angle, ratio).drift
    )
    assert all(abs(exact_error(name, angle, ratio).drift) < 1e-9 for name in OWN)


def simulated_drift(line, rate, name, seconds):
    """Return the z drift that the code makes of a two-axis vibration with exact increments; the truth by fine two-sample steps."""
    omega = 2 * math.pi * line.frequency
    across = line.angle if line.angle_across is None else line.angle_across

    def angles(t):
        return np.stack([line.angle * np.sin(omega * t), across * np.sin(omega * t - line.phase), 0 * t], axis=-1)

    def drifted(h, algorithm):
        n = round(seconds / h)
        t = np.arange(n + 1) * h
        rotation = quaternion.log(coning.integrate(np.diff(angles(t), axis=0), algorithm)[-1])
        return rotation[2] / (n * h)

    return drifted(1 / rate, name) - drifted(1 / rate / 40, "matched-1-4-4")


@pytest.mark.parametrize("phase", [math.pi / 2, 0.5, -1.0])
@pytest.mark.parametrize("name", ["one-sample", "two-sample", "time-taylor-3"])
def test_budget_agrees_with_simulation(phase, name):
    line = VibrationLine(frequency=5.0, angle=2e-3, angle_across=1e-3, phase=phase)
    assert vibration_drift((line,), name, 60.0) == pytest.approx(simulated_drift(line, 60.0, name, 20.0), rel=0.01)


def test_budget_adds_lines():
    lines = (VibrationLine(frequency=5.0, angle=1e-3), VibrationLine(frequency=11.0, angle=3e-4, phase=-0.4))
    alone = [vibration_drift((line,), "two-sample", 100.0) for line in lines]
    assert vibration_drift(lines, "two-sample", 100.0) == pytest.approx(sum(alone), rel=1e-14)
    slow, fast = (vibration_drift(lines, "one-sample", rate) for rate in (100.0, 200.0))
    assert slow == pytest.approx(4 * fast, rel=0.05)


LINE = {"frequency": 5.0, "angle": 1e-3}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: vibration_drift((VibrationLine(**LINE),), "two-sample", 20.0), "sample rate 20 Hz"),
        (lambda: vibration_drift((VibrationLine(**LINE),), "two-sample", 0.0), "sample rate is 0"),
        (lambda: vibration_drift((VibrationLine(**LINE),), "five-samples", 100.0), "did you mean"),
        (lambda: VibrationLine(**LINE | {"frequency": 0.0}), "frequency is 0 Hz"),
        (lambda: VibrationLine(**LINE | {"angle": -1.0}), "angle is -1 rad"),
        (lambda: VibrationLine(**LINE, phase=math.nan), "phase is nan"),
        (lambda: VibrationLine(**LINE, angle_across=-1e-3), "angle_across is -0.001 rad"),
        (lambda: coning.small_angle_drift("two-sample", 1.5), "sample faster"),
    ],
)
def test_what_has_no_drift_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_comments_and_empty_lines_of_a_vibration_file_are_no_lines(tmp_path):
    path = tmp_path / "v.csv"
    path.write_text("# measured on the bench\n\nfrequency_hz,angle_deg\n  \n10,0.1\n # 20,0.1\n\n")
    assert coning.read_vibration(path) == (VibrationLine(frequency=10.0, angle=math.radians(0.1), phase=0.5 * math.pi),)
