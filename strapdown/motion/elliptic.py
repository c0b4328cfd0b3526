"""Jacobi's elliptic functions and the complete integrals K and Π, accurate for every modulus, also next to 1."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from decimal import Decimal, localcontext

import numpy as np

from strapdown.checks import Array
from strapdown.motion.exact_phase import DIGITS, Pair


@functools.cache
def decimal_pi() -> Decimal:
    """Return π to :data:`DIGITS` digits (Gauss and Legendre)."""
    with localcontext(prec=DIGITS):
        a, b, t, power = Decimal(1), 1 / Decimal(2).sqrt(), Decimal(1) / 4, 1
        for _ in range(7):
            mean = (a + b) / 2
            b, t, power, a = (a * b).sqrt(), t - power * (a - mean) ** 2, 2 * power, mean
        return (a + b) ** 2 / (4 * t)


def complete_integrals(complement: Decimal, characteristic: Decimal) -> tuple[Decimal, Decimal]:
    """Return K(m) and Π(n|m) for complement = 1 − m > 0 and n < 1, by the arithmetic-geometric mean (DLMF 19.8.1, 19.8.6)."""
    a, g, p = Decimal(1), complement.sqrt(), (1 - characteristic).sqrt()
    term, total = Decimal(1), Decimal(0)
    for _ in range(64):
        total += term
        squared, product = p * p, a * g
        term = term * (squared - product) / (squared + product) / 2
        p = (squared + product) / (2 * p)
        a, g = (a + g) / 2, product.sqrt()
        if abs(term) + abs(a - g) < Decimal(10) ** (5 - DIGITS):
            break
    first = decimal_pi() / (2 * a)
    return first, first * (1 + characteristic / (1 - characteristic) / 2 * total)


@dataclass(frozen=True, kw_only=True)
class JacobiFunctions:
    """sn, cn and dn for one parameter m, by the arithmetic-geometric mean (Bulirsch 1965, *sncndn*).

    cn and dn keep their relative accuracy where they are small, near odd multiples of K for m near 1.
    """

    parameter: float
    complement: float
    quarter_period: float
    scale: float
    """π/(2K)"""
    means: tuple[Pair, ...]
    """The sequence of arithmetic and geometric means from 1 and k'."""

    @staticmethod
    def of(complement: Decimal, quarter_period: Decimal) -> JacobiFunctions:
        """Return the functions for 1 − m and K."""
        means: list[Pair] = []
        a, g = Decimal(1), complement.sqrt()
        while complement and (not means or abs(means[-1][0] - means[-1][1]) > 1e-9 * means[-1][0]):
            means.append((float(a), float(g)))
            a, g = (a + g) / 2, (a * g).sqrt()
        return JacobiFunctions(
            parameter=float(1 - complement),
            complement=float(complement),
            quarter_period=float(quarter_period),
            scale=float(a),
            means=tuple(means),
        )

    def __call__(self, u: Array) -> tuple[Array, Array, Array, Array]:
        """Return sn, cn and dn of u, and πu/(2K), within a quarter-turn of the amplitude."""
        if self.complement == 0.0:
            cosine = 1.0 / np.cosh(np.clip(u, -700.0, 700.0))
            return np.tanh(u), cosine, cosine, np.zeros_like(u)
        turned = self.scale * u
        sine = np.sin(turned)
        small = np.abs(sine) < _SMALLEST_SINE
        a = np.cos(turned) / np.where(small, _SMALLEST_SINE, sine)
        c, dn = self.scale * a, np.ones_like(turned)
        for arithmetic, geometric in reversed(self.means):
            a = a * c
            c = c * dn
            dn = (geometric + a) / (arithmetic + a)
            a = c / arithmetic
        sn = np.copysign(1.0 / np.hypot(c, 1.0), sine)
        return np.where(small & (np.abs(turned) < 1.0), u, sn), np.asarray(c * sn), np.asarray(dn), np.asarray(turned)


_SMALLEST_SINE = 1e-140
