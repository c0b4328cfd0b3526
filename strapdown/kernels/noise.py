"""Random numbers on tuples of 64-bit words: counter-hashed seeds, a fast generator, and normals without libm.

A stream is identified by a key of two words and a number: :func:`stream_state` hashes them with Threefry (Salmon et al. 2011) into the
state of a xoshiro256++ generator (Blackman & Vigna 2021). :func:`normal_pair` returns two normals from two of its words (Box & Muller),
:func:`single_normals` two from one word, in single precision. A stream therefore depends only on its key and number.

Words are unsigned 64-bit integers that wrap: NumPy scalars in plain Python (silence ``over`` with ``numpy.errstate``), numba's ``uint64``,
or lanes of them (:mod:`strapdown.kernels.lane_values`), one stream per lane. All constants are such words, because an operation of a signed
literal and an unsigned word gives a float.
"""

from __future__ import annotations

import math

import numpy as np

from strapdown.kernels.algebra import square_root
from strapdown.kernels.lane_values import any_lane, bits_of, leading_zeros, number_of_bits, select, signed_number

_ZERO, _ONE, _TWO, _THREE, _FOUR, _FIVE = (np.uint64(k) for k in range(6))
_PARITY = np.uint64(0x1BD11BDAA9FC1A22)
_S10, _S11, _S12, _S16, _S17, _S19, _S21, _S22, _S23, _S24 = (
    np.uint64(k) for k in (10, 11, 12, 16, 17, 19, 21, 22, 23, 24)
)
_S31, _S32, _S33, _S40, _S41, _S42, _S43, _S45, _S48, _S52 = (
    np.uint64(k) for k in (31, 32, 33, 40, 41, 42, 43, 45, 48, 52)
)
_UNIT = np.uint64(0x3FF0000000000000)
"""Bits of 1.0: with a mantissa in its low bits, a number in [1, 2)."""
_SIGN = np.uint64(0x8000000000000000)
_SWAP = np.uint64(0x4000000000000000)
_W1, _W16, _W31, _LOW, _SCARCE = (np.uint32(k) for k in (1, 16, 31, 0xFFFF, 1 << 16))
_WORD, _TWO_WORDS, _HALF = 2.0**-32, 2.0**-31, 2.0**-33
_INTEGER = np.uint64(0x4330000000000000)
"""Bits of 2^52: with an integer n < 2^52 in its low bits, the number 2^52 + n."""
_TO_ROOT_HALF = np.uint64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD)
"""Offset that shifts the range of the mantissa from [1, 2) to [√½, √2)."""
_EXPONENT_BIAS = 4503599627370496.0 + 1023.0
_MINUS_TWO_LOG_TWO = -2.0 * math.log(2.0)
_TWO_LOG_TWO = 2.0 * math.log(2.0)

_L0, _L1, _L2, _L3, _L4, _L5, _L6, _L7, _L8, _L9 = (1.0 / (2 * k + 1) for k in range(10))
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = (
    (-1.0) ** k * (0.5 * math.pi) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(8)
)
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = (
    (-1.0) ** k * (0.5 * math.pi) ** (2 * k) / math.factorial(2 * k) for k in range(9)
)

_R0, _R1, _R2, _R3, _R4, _R5, _R6, _R7, _R8 = (
    -2.00000004546,
    0.999985705117,
    -0.667401228733,
    0.48561017158,
    -0.539225386603,
    -0.407077372188,
    -2.51533829738,
    -3.39162233952,
    -2.88221501974,
)
"""−2 ln(1 + d)/d for −1/2 ≤ d ≤ 0, relative error 2.3e-8: minimax polynomial."""
_P0, _P1, _P2, _P3, _P4 = (1.57079631845, -0.6459637106, 0.0796896789479, -0.00467376661258, 0.000151485130816)
"""sin(πx/2)/x in x² for |x| ≤ 1, relative error 5.4e-9."""
_Q0, _Q1, _Q2, _Q3, _Q4 = (0.999999999129, -0.233700506445, 0.01996860716, -0.000893537025977, 2.3601451754e-05)
"""cos(πx/2)/(1 − x²) in x² for |x| ≤ 1, relative error 1.2e-9."""


def rotated(x, left, right):
    """Return x rotated left by ``left`` bits; ``right`` = 64 − ``left``."""
    return (x << left) | (x >> right)


def mixed(x0, x1, left, right):
    """Return one round of Threefry."""
    x0 = x0 + x1
    return x0, rotated(x1, left, right) ^ x0


def threefry(k0, k1, c0, c1):
    """Return the two words of Threefry-2x64 with 20 rounds for a key and a counter (Salmon et al. 2011, section 3.3)."""
    k2 = k0 ^ k1 ^ _PARITY
    x0 = c0 + k0
    x1 = c1 + k1
    x0, x1 = mixed(x0, x1, _S16, _S48)
    x0, x1 = mixed(x0, x1, _S42, _S22)
    x0, x1 = mixed(x0, x1, _S12, _S52)
    x0, x1 = mixed(x0, x1, _S31, _S33)
    x0, x1 = x0 + k1, x1 + k2 + _ONE
    x0, x1 = mixed(x0, x1, _S16, _S48)
    x0, x1 = mixed(x0, x1, _S32, _S32)
    x0, x1 = mixed(x0, x1, _S24, _S40)
    x0, x1 = mixed(x0, x1, _S21, _S43)
    x0, x1 = x0 + k2, x1 + k0 + _TWO
    x0, x1 = mixed(x0, x1, _S16, _S48)
    x0, x1 = mixed(x0, x1, _S42, _S22)
    x0, x1 = mixed(x0, x1, _S12, _S52)
    x0, x1 = mixed(x0, x1, _S31, _S33)
    x0, x1 = x0 + k0, x1 + k1 + _THREE
    x0, x1 = mixed(x0, x1, _S16, _S48)
    x0, x1 = mixed(x0, x1, _S32, _S32)
    x0, x1 = mixed(x0, x1, _S24, _S40)
    x0, x1 = mixed(x0, x1, _S21, _S43)
    x0, x1 = x0 + k1, x1 + k2 + _FOUR
    x0, x1 = mixed(x0, x1, _S16, _S48)
    x0, x1 = mixed(x0, x1, _S42, _S22)
    x0, x1 = mixed(x0, x1, _S12, _S52)
    x0, x1 = mixed(x0, x1, _S31, _S33)
    return x0 + k2, x1 + k0 + _FIVE


def stream_state(k0, k1, number):
    """Return the xoshiro256++ state (4 words) of stream ``number`` under the key (k0, k1)."""
    s0, s1 = threefry(k0, k1, number, _ZERO)
    s2, s3 = threefry(k0, k1, number, _ONE)
    return s0, s1, s2, s3


def next_word(s0, s1, s2, s3):
    """Return the next word of xoshiro256++ and the state after it."""
    word = rotated(s0 + s3, _S23, _S41) + s0
    t = s1 << _S17
    s2 = s2 ^ s0
    s3 = s3 ^ s1
    s1 = s1 ^ s2
    s0 = s0 ^ s3
    s2 = s2 ^ t
    s3 = rotated(s3, _S45, _S19)
    return word, s0, s1, s2, s3


def uniform(word):
    """Return a number in (0, 1], a multiple of 2^−52."""
    return 2.0 - number_of_bits((word >> _S12) | _UNIT)


def minus_two_log(u):
    """Return −2 ln u for u in (0, 1], or any normal number, from the exponent and the series of 2 artanh((m − 1)/(m + 1)), |.| ≤ 0.172."""
    bits = bits_of(u)
    exponent = (bits + _TO_ROOT_HALF) >> _S52
    d = number_of_bits(bits - (exponent << _S52) + _UNIT) - 1.0
    f = d / (d + 2.0)
    w = f * f
    ww = w * w
    tail = (_L9 * w + _L8) * ww + (_L7 * w + _L6)
    p = ((tail * ww + (_L5 * w + _L4)) * ww + (_L3 * w + _L2)) * ww + (_L1 * w + _L0)
    return (number_of_bits(exponent | _INTEGER) - _EXPONENT_BIAS) * _MINUS_TWO_LOG_TWO - 4.0 * f * p


def normal_pair(word0, word1):
    """Return two independent standard normals from two words (Box & Muller 1958), of at most 8.49 σ.

    The angle is a multiple of 2^−52 within ±45°; a random sign of the cosine and a random swap cover all eight octants.
    """
    radius = square_root(minus_two_log(uniform(word0)))
    x = number_of_bits(((word1 << _TWO) >> _S12) | _UNIT) - 1.5
    w = x * x
    ww = w * w
    sine = x * ((((_S7 * w + _S6) * ww + (_S5 * w + _S4)) * ww + (_S3 * w + _S2)) * ww + (_S1 * w + _S0))
    cosine = ((((_C8 * w + _C7) * ww + (_C6 * w + _C5)) * ww + (_C4 * w + _C3)) * ww + (_C2 * w + _C1)) * w + _C0
    a = radius * sine
    b = radius * cosine
    b = select((word1 & _SIGN) != _ZERO, -b, b)
    swap = (word1 & _SWAP) != _ZERO
    return select(swap, b, a), select(swap, a, b)


def single_normals(radius_word, angle_word):
    """Return two independent standard normals in single precision, from two words of 32 bits (Box & Muller 1958), of at most 8.1 σ.

    The radius is √(−2 ln u), u uniform on (0, 1] with resolution 2^−32, and 2^−48 below 2^−16, by half of the bits of the angle. With k the
    number of leading zeros of u, u = 2^−k (1 + d), −1/2 ≤ d < 0. The angle lies within ±90°, and the cosine has a random sign. The error is
    below 3e-7; the bits do not depend on the precision of the run.
    """
    zeros = leading_zeros(radius_word)
    d = signed_number(radius_word << zeros) * _WORD + _HALF
    binades = signed_number(zeros)
    scarce = radius_word < _SCARCE
    if any_lane(scarce):
        longer = (radius_word << _W16) | (angle_word & _LOW) | _W1
        zeros = leading_zeros(longer)
        d = select(scarce, signed_number(longer << zeros) * _WORD, d)
        binades = select(scarce, signed_number(zeros + _W16), binades)
    p = (((((((_R8 * d + _R7) * d + _R6) * d + _R5) * d + _R4) * d + _R3) * d + _R2) * d + _R1) * d + _R0
    radius = square_root(d * p + binades * _TWO_LOG_TWO)
    x = signed_number(angle_word) * _TWO_WORDS + _WORD
    w = x * x
    sine = x * ((((_P4 * w + _P3) * w + _P2) * w + _P1) * w + _P0)
    cosine = (1.0 - w) * ((((_Q4 * w + _Q3) * w + _Q2) * w + _Q1) * w + _Q0)
    cosine = number_of_bits(bits_of(radius * cosine) ^ (angle_word << _W31))
    return radius * sine, cosine


def seed_stream(k0, k1, number, state):
    """Fill state (2, 4) with the generators of radius and angle words of stream ``number`` under the key (k0, k1)."""
    state[0, 0], state[0, 1], state[0, 2], state[0, 3] = stream_state(k0, k1, number + number)
    state[1, 0], state[1, 1], state[1, 2], state[1, 3] = stream_state(k0, k1, number + number + _ONE)


def fill_normals(state, words, out):
    """Fill out (2m,) with standard normals from a stream's state (2, 4), which is updated; words (2, m) is scratch.

    All words are drawn first, so the iterations of the second loop are independent and run at vector width.
    """
    a0, a1, a2, a3 = state[0, 0], state[0, 1], state[0, 2], state[0, 3]
    b0, b1, b2, b3 = state[1, 0], state[1, 1], state[1, 2], state[1, 3]
    m = words.shape[1]
    radius = words[0]
    angle = words[1]
    for i in range(m):
        radius[i], a0, a1, a2, a3 = next_word(a0, a1, a2, a3)
        angle[i], b0, b1, b2, b3 = next_word(b0, b1, b2, b3)
    state[0, 0], state[0, 1], state[0, 2], state[0, 3] = a0, a1, a2, a3
    state[1, 0], state[1, 1], state[1, 2], state[1, 3] = b0, b1, b2, b3
    first = out[:m]
    second = out[m : 2 * m]
    for i in range(m):
        first[i], second[i] = normal_pair(radius[i], angle[i])
