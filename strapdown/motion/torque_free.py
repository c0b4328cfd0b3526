"""The rigid body free of torque: Euler's rates and Poinsot's attitude, in elliptic functions."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks, quaternion
from strapdown.checks import Array
from strapdown.motion.closed_forms import ConstantRate
from strapdown.motion.exact_phase import DIGITS, Pair, cosine_sine, halved, product_error, to_decimal, to_pair
from strapdown.motion.protocol import IDENTITY, edge_stamps, stacked, store_attitude, store_vector, times
from strapdown.motion.quadrature import interval_integrals

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494")
"""π to :data:`DIGITS` digits."""
_SMALLEST_SINE = 1e-140
_SEPARATRIX = Decimal("1e-300")
"""Value of 1 − m used on the separatrix instead of 0: the motions differ only after 340 time constants of leaving the middle axis."""


@dataclass(frozen=True, kw_only=True)
class TorqueFree:
    """Rigid body free of torque, by Jacobi elliptic functions (Landau and Lifshitz, *Mechanics*, §37).

    All moments and initial rates are allowed: both energy branches, the separatrix between them, symmetric and spherical bodies, spin
    about a principal axis. Constants are computed to 60 digits, so accuracy does not decrease with time: attitude, rates and increments
    have relative errors of a few 1e-16. Very close to the separatrix, 1 − m is computed directly and not from a rounded m.

    Parameters
    ----------
    inertia : array_like (3,)
        Principal moments about the body axes x, y, z, kg m² (only their ratios matter); none may exceed the sum of the other two.
    initial_rate : array_like (3,)
        w_b at time 0, rad/s.
    initial_attitude : array_like (4,), default identity
        Unit quaternion q_fb at time 0.
    """

    inertia: Sequence[float]
    initial_rate: Sequence[float]
    initial_attitude: Sequence[float] = IDENTITY

    def __post_init__(self) -> None:
        moments = store_vector(self, "inertia")
        for i, moment in enumerate(moments):
            checks.positive(f"inertia[{i}]", moment, unit="kg m²")
        for i, moment in enumerate(moments):
            if moment > (moments[i - 1] + moments[i - 2]) * (1.0 + 1e-12):
                raise checks.InputError(
                    f"inertia[{i}] is {moment:g}, more than the sum of the other two; no rigid body has such principal moments"
                )
        store_vector(self, "initial_rate")
        store_attitude(self)

    @functools.cached_property
    def _steady(self) -> ConstantRate | None:
        """Motion of a body that spins about a principal axis; None if it does not."""
        moments, w = [Fraction(i) for i in self.inertia], [Fraction(r) for r in self.initial_rate]
        if any((moments[i] - moments[i - 1]) * w[i] * w[i - 1] for i in range(3)):
            return None
        return ConstantRate(rate=self.initial_rate, initial_attitude=self.initial_attitude)

    @functools.cached_property
    def _solution(self) -> _Solution:
        return _solved(self.inertia, self.initial_rate)

    @functools.cached_property
    def _fixed_side(self) -> Array:
        return quaternion.multiply(np.array(self.initial_attitude), quaternion.conjugate(self._relative(np.zeros(()))))

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb (..., 4)."""
        t = times(time)
        if self._steady is not None:
            return self._steady.attitude(t)
        return quaternion.multiply(self._fixed_side, self._relative(t))

    def _relative(self, time: Array) -> Array:
        """Return the attitude up to a constant rotation on the fixed side."""
        s = self._solution
        j, t = _reduced(s, time)
        sn, cn, dn = _jacobi(s, s.rate * t + s.start)
        chi = s.momentum / s.moments[2] * t + _third_angle(s, s.rate * t + s.start, sn, cn, dn) / s.rate
        turn_cosine, turn_sine = cosine_sine(halved(s.turn), j)
        cosine, sine = np.cos(0.5 * chi), np.sin(0.5 * chi)
        half_turn = stacked(turn_cosine * cosine - turn_sine * sine, 0.0, 0.0, turn_sine * cosine + turn_cosine * sine)
        n1, n2, n3 = np.moveaxis(_rate(s, j, sn, cn, dn) * np.array(s.moments) / s.momentum, -1, 0)
        scale = 1.0 / np.sqrt((1.0 + n3) ** 2 + n1 * n1 + n2 * n2)
        shortest = stacked(scale * (1.0 + n3), scale * n2, -scale * n1, 0.0)
        return quaternion.multiply(quaternion.multiply(half_turn, shortest), quaternion.from_matrix(s.axes))

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b, rad/s."""
        t = times(time)
        if self._steady is not None:
            return self._steady.body_rate(t)
        s = self._solution
        j, t = _reduced(s, t)
        return np.asarray(_rate(s, j, *_jacobi(s, s.rate * t + s.start)) @ s.axes)

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt from Euler's equations, ``I ẇ = (I w) × w``, rad/s²."""
        w, moments = self.body_rate(time), np.array(self.inertia)
        return np.asarray(np.cross(moments * w, w) / moments)

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval, rad, by converged quadrature."""
        return interval_integrals(self.body_rate, edge_stamps(edges), np.empty(0))


class _Solution(NamedTuple):
    """The solution in principal axes 1, 2, 3: ``w = (A_1 cn u, A_2 sn u, A_3 dn u)``, ``u = p t + u_0``; A_1 and A_3 are positive.

    Axis 3 is the one about which the angular momentum circulates (largest or smallest moment), axis 2 the middle one. With n = h/|h| in
    these axes the attitude is ``Z(χ) ⊗ a(n)``, with a(n) the shortest rotation of n to axis 3 and
    ``χ̇ = L/I_3 + (2T/L − L/I_3)/(1 + n_3)``. There is no singularity, because n_3 > 0. The integral of χ̇ is an elliptic integral of the
    third kind and an arc tangent.
    """

    axes: Array
    """Rotation matrix from body axes to axes 1, 2, 3: a signed permutation."""
    moments: tuple[float, ...]
    amplitudes: tuple[float, ...]
    momentum: float
    rate: float
    """p, rad/s"""
    start: float
    """u_0"""
    means: tuple[Pair, ...]
    """The sequence of arithmetic and geometric means from 1 and k', whose limit is π/(2K)."""
    half_period: Pair
    """2K/p, s"""
    turn: Pair
    """The advance of χ in a half-period, rad"""
    characteristic: float
    pitch: float
    """(I_3 − I_1) L/(I_1 I_3), rad/s"""


def _axes(moments: Sequence[Fraction], w: Sequence[Fraction]) -> Array:
    """Return the axes 1 to 3 of the solution as rows (3, 3): axis 2 is that of the middle moment, and w is not negative about 1 and 3."""
    small, middle, large = sorted(range(3), key=lambda axis: moments[axis])
    # The sign of L² − 2T I_2 decides which axis is axis 3; on the separatrix either will do.
    excess = sum((moments[i] * (moments[i] - moments[middle]) * w[i] ** 2 for i in range(3)), Fraction(0))
    first, third = (small, large) if excess > 0 or moments[small] == moments[middle] else (large, small)
    if excess == 0 and moments[third] == moments[middle]:
        first, third = third, first
    axes = np.zeros((3, 3))
    axes[0, first] = -1.0 if w[first] < 0 else 1.0
    axes[2, third] = -1.0 if w[third] < 0 else 1.0
    axes[1, middle] = 1.0
    axes[1] *= np.linalg.det(axes)
    return axes


def _solved(inertia: Sequence[float], rate: Sequence[float]) -> _Solution:
    """Return the solution from principal moments and w_b at time 0, in exact fractions up to the final roots."""
    from scipy.special import elliprf

    moments, w = [Fraction(i) for i in inertia], [Fraction(r) for r in rate]
    axes = _axes(moments, w)
    first, middle, third = (int(np.argmax(np.abs(axis))) for axis in axes)
    i1, i2, i3 = moments[first], moments[middle], moments[third]
    w1, w2, w3 = abs(w[first]), int(axes[1, middle]) * w[middle], abs(w[third])
    wide = i1 * (i3 - i1) * w1**2 + i2 * (i3 - i2) * w2**2  # 2T I_3 − L²
    narrow = i2 * (i2 - i1) * w2**2 + i3 * (i3 - i1) * w3**2  # L² − 2T I_1
    middling = i1 * (i1 - i2) * w1**2 + i3 * (i3 - i2) * w3**2  # L² − 2T I_2
    with localcontext(prec=DIGITS):
        momentum = to_decimal((i1 * w1) ** 2 + (i2 * w2) ** 2 + (i3 * w3) ** 2).sqrt()
        a1 = to_decimal(wide / (i1 * (i3 - i1))).sqrt()
        a2 = to_decimal(wide / (i2 * (i3 - i2))).sqrt() * (1 if i3 > i2 else -1)
        a3 = to_decimal(narrow / (i3 * (i3 - i1))).sqrt()
        p = to_decimal((i3 - i2) * narrow / (i1 * i2 * i3)).sqrt()
        n = to_decimal(i3 * (i1 - i2) / (i1 * (i3 - i2)))
        pitch = to_decimal((i3 - i1) / (i1 * i3)) * momentum
        complement = to_decimal(middling * (i3 - i1) / ((i3 - i2) * narrow)) or _SEPARATRIX  # 1 − m
        quarter, third_kind, means = complete_integrals(complement, n)
        tilt = to_decimal(i3) * a3 / momentum / (1 - n).sqrt()
        turn = momentum / to_decimal(i3) * 2 * quarter / p + pitch / p * (2 * third_kind - tilt * PI)
        sine, cosine = float(to_decimal(w2) / a2), float(to_decimal(w1) / a1)
        # u_0 in [−2K, 2K] from its sn and cn.
        start = sine * float(elliprf(cosine**2, float(complement + (1 - complement) * Decimal(cosine) ** 2), 1.0))
        if cosine < 0.0:
            start = math.copysign(2.0 * float(quarter), sine) - start
        return _Solution(
            axes=axes,
            moments=(float(i1), float(i2), float(i3)),
            amplitudes=(float(a1), float(a2), float(a3)),
            momentum=float(momentum),
            rate=float(p),
            start=start,
            means=means,
            half_period=to_pair(2 * quarter / p),
            turn=to_pair(turn),
            characteristic=float(n),
            pitch=float(pitch),
        )


def _reduced(s: _Solution, time: Array) -> tuple[Array, Array]:
    """Return the nearest number of half-periods, j, and the time less j half-periods without rounding error."""
    high, low = s.half_period
    j = np.rint((time + s.start / s.rate) / high)
    whole = high * j
    return j, (time - whole) - (product_error(high, j, whole) + low * j)


def _rate(s: _Solution, j: Array, sn: Array, cn: Array, dn: Array) -> Array:
    """Return the rate in axes 1, 2, 3, j half-periods after the argument of these functions."""
    a1, a2, a3 = s.amplitudes
    sign = 1.0 - 2.0 * np.mod(j, 2.0)
    return stacked(sign * a1 * cn, sign * a2 * sn, a3 * dn)


def _third_angle(s: _Solution, u: Array, sn: Array, cn: Array, dn: Array) -> Array:
    """Return ``κ ∫ α du/(1 + n_3)`` from 0 to u, |u| ≤ K, with κ α = 2T/L − L/I_3.

    The integral of the third kind is ``Π = F + n/3 sn³ R_J(cn², dn², 1, 1 − n sn²)`` (DLMF 19.25.14) with F = u.
    """
    from scipy.special import elliprj

    n = s.characteristic
    root, squared = math.sqrt(1.0 - n), sn * sn
    third_kind = u + n / 3.0 * sn * squared * elliprj(cn * cn, dn * dn, 1.0, 1.0 - n * squared)
    tilt = s.moments[2] * s.amplitudes[2] / s.momentum
    return np.asarray(s.pitch * (third_kind - tilt / root * np.arctan2(root * sn, cn)))


def _jacobi(s: _Solution, u: Array) -> tuple[Array, Array, Array]:
    """Return sn, cn and dn of u by the arithmetic-geometric mean (Bulirsch 1965, *sncndn*).

    cn and dn keep their relative accuracy when they are small, near odd multiples of K for m near 1.
    """
    scale = s.means[-1][0]
    turned = scale * u
    sine = np.sin(turned)
    small = np.abs(sine) < _SMALLEST_SINE
    a = np.cos(turned) / np.where(small, _SMALLEST_SINE, sine)
    c, dn = scale * a, np.ones_like(turned)
    for arithmetic, geometric in reversed(s.means[:-1]):
        a = a * c
        c = c * dn
        dn = (geometric + a) / (arithmetic + a)
        a = c / arithmetic
    sn = np.copysign(1.0 / np.hypot(c, 1.0), sine)
    return np.where(small & (np.abs(turned) < 1.0), u, sn), np.asarray(c * sn), np.asarray(dn)


def complete_integrals(complement: Decimal, characteristic: Decimal) -> tuple[Decimal, Decimal, tuple[Pair, ...]]:
    """Return K(m) and Π(n|m) for complement = 1 − m > 0 and n < 1, and the means (DLMF 19.8.1, 19.8.6)."""
    a, g, p = Decimal(1), complement.sqrt(), (1 - characteristic).sqrt()
    term, total = Decimal(1), Decimal(0)
    means: list[Pair] = []
    while abs(term) + abs(a - g) > Decimal(10) ** (5 - DIGITS):
        if not means or means[-1][0] - means[-1][1] > 1e-9 * means[-1][0]:
            means.append((float(a), float(g)))
        total += term
        squared, product = p * p, a * g
        term = term * (squared - product) / (squared + product) / 2
        p = (squared + product) / (2 * p)
        a, g = (a + g) / 2, product.sqrt()
    first = PI / (2 * a)
    return first, first * (1 + characteristic / (1 - characteristic) / 2 * total), (*means, (float(a), float(g)))
