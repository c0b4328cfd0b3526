"""The torque-free rigid body in its principal axes: Euler's rates, Poinsot's attitude, in elliptic functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array
from strapdown.motion.elliptic import JacobiFunctions, complete_integrals, decimal_pi
from strapdown.motion.exact_phase import DIGITS, Pair, cosine_sine, halved, product_error, to_decimal, to_pair
from strapdown.motion.parameters import stacked


@dataclass(frozen=True, kw_only=True, eq=False)
class EulerPoinsot:
    """The solution in principal axes 1, 2, 3: ``w = (A_1 cn u, A_2 sn u, A_3 dn u)``, ``u = p t + u_0``.

    A_1 and A_3 are positive; on the separatrix cn and dn never change sign.

    Axis 3 is the one that the angular momentum circles (largest or smallest moment), 2 the middle one. With n = h/|h| in these axes
    the attitude is ``Z(χ) ⊗ a(n)``, a(n) the shortest rotation of n to axis 3 and ``χ̇ = L/I_3 + (2T/L − L/I_3)/(1 + n_3)``. As n_3 > 0
    nothing here is singular. The integral of χ̇ is an elliptic integral of the third kind and an arc tangent.
    """

    axes: Array
    """Rotation matrix from body axes to axes 1, 2, 3: a signed permutation."""
    moments: tuple[float, float, float]
    amplitudes: tuple[float, float, float]
    momentum: float
    rate: float
    """p, rad/s"""
    start: float
    """u_0"""
    functions: JacobiFunctions
    half_period: Pair | None
    """2K/p, s; none on the separatrix"""
    turn: Pair
    """The advance of χ in a half-period, rad"""
    characteristic: float
    pitch: float
    """(I_3 − I_1) L/(I_1 I_3), rad/s"""

    @staticmethod
    def of(inertia: Sequence[float], rate: Sequence[float]) -> EulerPoinsot:
        """Return the solution from principal moments and w_b at time 0, in exact fractions until the last roots."""
        moments, w = [Fraction(i) for i in inertia], [Fraction(r) for r in rate]
        small, middle, large = sorted(range(3), key=lambda axis: moments[axis])
        # L² − 2T I_2 decides which axis is circled; on the separatrix either will do.
        excess = sum((moments[i] * (moments[i] - moments[middle]) * w[i] ** 2 for i in range(3)), Fraction(0))
        first, third = (small, large) if excess > 0 or moments[small] == moments[middle] else (large, small)
        if excess == 0 and moments[third] == moments[middle]:
            first, third = third, first
        axes = np.zeros((3, 3))
        axes[0, first] = -1.0 if w[first] < 0 else 1.0
        axes[2, third] = -1.0 if w[third] < 0 else 1.0
        axes[1, middle] = 1.0
        axes[1] *= np.linalg.det(axes)
        i1, i2, i3 = moments[first], moments[middle], moments[third]
        w1, w2, w3 = abs(w[first]), int(axes[1, middle]) * w[middle], abs(w[third])
        wide = i1 * (i3 - i1) * w1**2 + i2 * (i3 - i2) * w2**2  # 2T I_3 − L²
        narrow = i2 * (i2 - i1) * w2**2 + i3 * (i3 - i1) * w3**2  # L² − 2T I_1
        middling = i1 * (i1 - i2) * w1**2 + i3 * (i3 - i2) * w3**2  # L² − 2T I_2
        complement = middling * (i3 - i1) / ((i3 - i2) * narrow)  # 1 − m
        with localcontext(prec=DIGITS):
            momentum = to_decimal((i1 * w1) ** 2 + (i2 * w2) ** 2 + (i3 * w3) ** 2).sqrt()
            a1 = to_decimal(wide / (i1 * (i3 - i1))).sqrt()
            a2 = to_decimal(wide / (i2 * (i3 - i2))).sqrt() * (1 if i3 > i2 else -1)
            a3 = to_decimal(narrow / (i3 * (i3 - i1))).sqrt()
            p = to_decimal((i3 - i2) * narrow / (i1 * i2 * i3)).sqrt()
            characteristic = i3 * (i1 - i2) / (i1 * (i3 - i2))
            pitch = to_decimal((i3 - i1) / (i1 * i3)) * momentum
            half_period, turn, quarter = None, (0.0, 0.0), Decimal("inf")
            if complement:
                quarter, third_kind = complete_integrals(to_decimal(complement), to_decimal(characteristic))
                half_period = to_pair(2 * quarter / p)
                tilt = to_decimal(i3) * a3 / momentum / (1 - to_decimal(characteristic)).sqrt()
                turn = to_pair(
                    momentum / to_decimal(i3) * 2 * quarter / p + pitch / p * (2 * third_kind - tilt * decimal_pi())
                )
            functions = JacobiFunctions.of(to_decimal(complement), quarter)
            sine, cosine = float(to_decimal(w2) / a2), float(to_decimal(w1) / a1)
        solution = EulerPoinsot(
            axes=axes,
            moments=(float(i1), float(i2), float(i3)),
            amplitudes=(float(a1), float(a2), float(a3)),
            momentum=float(momentum),
            rate=float(p),
            start=0.0,
            functions=functions,
            half_period=half_period,
            turn=turn,
            characteristic=float(characteristic),
            pitch=float(pitch),
        )
        return replace(solution, start=solution._first_integral(sine, cosine))

    def _first_integral(self, sine: float, cosine: float) -> float:
        """Return u with sn u = sine, cn u = cosine, in [−2K, 2K]."""
        from scipy.special import elliprf

        if self.half_period is None:
            return math.asinh(sine / cosine)
        u = sine * float(elliprf(cosine**2, self.functions.complement + self.functions.parameter * cosine**2, 1.0))
        return u if cosine >= 0.0 else math.copysign(2.0 * self.functions.quarter_period, sine) - u

    def _reduced(self, time: Array) -> tuple[Array, Array]:
        """Return the half-periods to leave out, j, and the time less j half-periods, free of rounding error."""
        if self.half_period is None:
            return np.zeros_like(time), time
        high, low = self.half_period
        j = np.rint((time + self.start / self.rate) / high)
        whole = high * j
        return j, (time - whole) - (product_error(high, j, whole) + low * j)

    def _rate(self, sn: Array, cn: Array, dn: Array) -> Array:
        a1, a2, a3 = self.amplitudes
        return stacked(a1 * cn, a2 * sn, a3 * dn)

    def body_rate(self, time: Array) -> Array:
        """Return w_b, rad/s, in body axes."""
        j, t = self._reduced(time)
        sn, cn, dn, _ = self.functions(self.rate * t + self.start)
        sign = 1.0 - 2.0 * np.mod(j, 2.0)
        return np.asarray(self._rate(sign * sn, sign * cn, dn) @ self.axes)

    def _third_angle(self, u: Array, sn: Array, cn: Array, dn: Array) -> Array:
        """Return ``κ ∫ α du/(1 + n_3)`` from 0 to u, |u| ≤ K, with κ α = 2T/L − L/I_3.

        Its integral of the third kind is ``Π = F + n/3 sn³ R_J(cn², dn², 1, 1 − n sn²)`` (DLMF 19.25.14), and F is u itself.
        """
        from scipy.special import elliprj

        i1, _, i3 = self.moments
        a1, _, a3 = self.amplitudes
        tilt = i3 * a3 / self.momentum
        if self.half_period is None:
            alpha = (i1 * a1 / self.momentum) ** 2
            ratio = i1 * a1 / self.momentum / (1.0 + tilt)
            return np.asarray(
                self.pitch * (alpha * u - 2.0 * tilt * math.sqrt(alpha) * np.arctan(ratio * np.tanh(0.5 * u)))
            )
        n = self.characteristic
        x, y, squared = cn * cn, dn * dn, sn * sn
        third_kind = u + n / 3.0 * sn * squared * elliprj(x, y, 1.0, 1.0 - n * squared)
        root = math.sqrt(1.0 - n)
        return np.asarray(self.pitch * (third_kind - tilt / root * np.arctan2(root * sn, cn)))

    def attitude(self, time: Array) -> Array:
        """Return the attitude up to a constant rotation on the fixed side."""
        j, t = self._reduced(time)
        u = self.rate * t + self.start
        sn, cn, dn, _ = self.functions(u)
        chi = self.momentum / self.moments[2] * t + self._third_angle(u, sn, cn, dn) / self.rate
        turn_cosine, turn_sine = cosine_sine(halved(self.turn), j)
        cosine, sine = np.cos(0.5 * chi), np.sin(0.5 * chi)
        half_turn = stacked(turn_cosine * cosine - turn_sine * sine, 0.0, 0.0, turn_sine * cosine + turn_cosine * sine)
        sign = 1.0 - 2.0 * np.mod(j, 2.0)
        n1, n2, n3 = np.moveaxis(self._rate(sign * sn, sign * cn, dn) * np.array(self.moments) / self.momentum, -1, 0)
        scale = 1.0 / np.sqrt((1.0 + n3) ** 2 + n1 * n1 + n2 * n2)
        shortest = stacked(scale * (1.0 + n3), scale * n2, -scale * n1, 0.0)
        return quaternion.multiply(quaternion.multiply(half_turn, shortest), quaternion.from_matrix(self.axes))

    def increments(self, edges: Array) -> Array:
        """Return ∫ w_b dt: with u at the middle of an interval and v half its length in u.

        ``∫ dn = 2 arctan(sn v dn u/cn v)``, ``∫ cn = 2/k arctan(k sn v cn u/dn v)``, ``∫ sn = 2/k artanh(k sn v sn u)`` (from the
        addition theorems, DLMF 22.8 and 22.14): products, no differences.
        """
        j, t = self._reduced(edges[:-1])
        step = np.diff(edges)
        half = 0.5 * self.rate * step
        sn, cn, dn, _ = self.functions(self.rate * t + self.start + half)
        half_sn, half_cn, half_dn, half_turn = self.functions(half)
        sign = 1.0 - 2.0 * np.mod(j, 2.0)
        k = math.sqrt(self.functions.parameter)
        along = np.arctan2(half_sn * dn, half_cn)
        along += 2.0 * math.pi * np.rint((half_turn - along) / (2.0 * math.pi))
        if k > 0.0:
            across_cn = np.arctan2(k * half_sn * cn, half_dn) / k
            # artanh x as arsinh x/√(1 − x²), the root from terms of one sign: near the separatrix x nears 1.
            across_sn = np.arcsinh(k * half_sn * sn / np.hypot(dn, k * sn * half_cn)) / k
        else:
            across_cn, across_sn = half_sn * cn, half_sn * sn
        return np.asarray(self._rate(sign * across_sn, sign * across_cn, along) * (2.0 / self.rate) @ self.axes)
