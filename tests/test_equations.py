"""Formulas of docstrings that no other test holds, each against an independent computation.

Equations (1)–(18) of *Quaternion differentiation* are held in ``test_reference_equations.py``.
"""

import math

import mpmath as mp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from strapdown import allan, coning, kinematics
from strapdown.motion import orbit
from strapdown.vectors import wahba


@pytest.mark.parametrize(("angle", "axis"), [(1e-3, (1.0, 2.0, -2.0)), (1.0, (2.0, -1.0, 2.0)), (6.0, (0.0, 3.0, 4.0))])
def test_the_bortz_equation_as_bortz_wrote_it(angle, axis):
    """Bortz 1971, equation (12): φ̇ = w + ½ φ × w + (1/φ²) (1 − φ sin φ/(2 (1 − cos φ))) φ × (φ × w), in 40 digits."""
    phi = angle * np.array(axis) / np.linalg.norm(axis)
    w = np.array([0.3, -0.7, 0.2])
    with mp.workdps(40):
        size = mp.sqrt(sum(mp.mpf(x) ** 2 for x in phi))
        factor = float((1 - size * mp.sin(size) / (2 * (1 - mp.cos(size)))) / size**2)
    expected = w + 0.5 * np.cross(phi, w) + factor * np.cross(phi, np.cross(phi, w))
    assert_allclose(np.linalg.inv(kinematics.right_jacobian(phi)) @ w, expected, rtol=1e-14)


def test_the_floor_of_bias_instability():
    """0.664 B: √(2 ln 2/π), the limit of the Allan deviation of flicker."""
    floor = float(mp.sqrt(2 * mp.log(2) / mp.pi))
    assert floor == pytest.approx(0.664, abs=5e-4)
    assert allan.model_deviation({"bias_instability": 2.0}, [100.0], 0.01)["total"][0] == pytest.approx(
        2.0 * floor, rel=1e-6
    )


@pytest.mark.parametrize(("name", "gain"), [("matched-4-11", 24.0), ("matched-2-8", 2.1), ("matched-1-8-8", 0.12)])
def test_noise_beside_a_steady_rotation_counts_as_often_as_the_module_says(name, gain):
    """Change each increment of the window: the change of the step across both, over rotation and change, root sum of squares."""
    table = coning.ALGORITHMS[name]
    n, step = table.samples, 12  # a step in the middle of the record
    rotation, change = 1e-3, 1e-6
    steady = np.tile([0.0, 0.0, rotation], (25 * n, 1))
    across = []
    for k in range(len(steady)):
        changed = steady.copy()
        changed[k, 0] += change
        across.append(coning.rotation_vectors(changed, table)[step, 1] / (rotation * change))
    assert math.sqrt(np.sum(np.square(across)) / n) == pytest.approx(gain, rel=0.02)


def test_the_dipole_is_that_of_igrf_13():
    """√(g₁₀² + g₁₁² + h₁₁²) of epoch 2020, nT (Alken et al. 2021)."""
    assert math.hypot(29404.8, 1450.9, 4652.5) * 1e-9 == pytest.approx(orbit.DIPOLE_STRENGTH, rel=1e-3)


def test_limits_of_wahba_are_the_probabilities_they_name():
    assert 1e-9 < math.erfc(wahba.INCONSISTENT / math.sqrt(2.0)) < 3e-9
    assert math.pi / math.sqrt(3.0) == pytest.approx(1.8, abs=0.02)  # standard deviation of a uniform angle
