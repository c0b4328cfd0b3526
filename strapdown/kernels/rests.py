"""Rests of a unit, sample by sample: its mean rate over a second in which it hardly moves is a measurement of the gyro's bias.

All that lasts from one sample to the next is in arrays, so samples may be processed at once or one at a time, with the same bits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import combine, cross, dot
from strapdown.kernels.measurement import vector_at
from strapdown.kernels.state import store_row


class Constants(NamedTuple):
    """Constants of the method, and of a unit."""

    with_field: int
    """Whether there is a magnetometer, whose field shows a slow turn."""
    parts: int
    """Number of parts of a span, whose mean rates are compared."""
    part: int
    """Number of samples of a part."""
    span: float
    """Usual duration of a span, s."""
    own_variance: float
    """Variance of the mean rate of a unit that does not move, (rad/s)²."""
    max_variance: float
    """Variance of the mean rate from which on the unit moves, (rad/s)²."""
    odds: float
    """Squared difference of a mean rate from the bias by the rests before, relative to its variance, above which it is a turn."""
    turning: float
    """Squared mean rate, (rad/s)², above which vertical and field are examined for a rotation with it."""
    noise: float
    """Squared change of specific force and field from half to half, relative to them, by noise at rest."""
    vibration_odds: float
    """Squared change of mean rate and specific force, relative to its variance by vibration, above which it is motion."""
    vibration_bias: float
    """Maximum variance of a bias that is measured while the unit vibrates, (rad/s)²."""
    vibration_spans: int
    """Number of successive spans that must agree then."""
    walk: float
    """Variance that the bias gains in a second between rests."""
    unmodelled: float
    """The part of it that the filter does not model."""
    slow_walk: float
    """The part of it that is not mistaken for a slow turn."""
    field_turn: float
    """Squared turn of the field, rad², above which a unit that seems at rest turns slowly."""
    field_time: float
    """Time over which such a turn is looked for, s."""


class Memory(NamedTuple):
    """What lasts from one sample to the next."""

    tenths: np.ndarray
    """Sums of the rate over the parts of the span (parts, 3)."""
    force_tenths: np.ndarray
    """Sums of the specific force over them, and number of its samples (parts, 4)."""
    halves: np.ndarray
    """Sums of specific force and field over its halves (4, 3)."""
    halves_number: np.ndarray
    """Number of samples in the halves (4,)."""
    steady: np.ndarray
    """Mean rate, rad/s, and specific force of the first of the spans since which they have changed no more than by vibration (2, 3)."""
    steady_spans: np.ndarray
    """Number of those spans (1,)."""
    resting: np.ndarray
    """Number of samples in the span; 1 if it shows more of the bias, 2 if the next step begins with it (2,)."""
    rest_rate: np.ndarray
    """Mean rate of the last span (1, 3), rad/s."""
    rest_variance: np.ndarray
    """Its variance; infinite if it was no rest (1,)."""
    rest_gained: np.ndarray
    """Variance that the bias has gained since the rest before and the filter does not model; infinite if this one shows no more (1,)."""
    rest_bias: np.ndarray
    """Bias by all rests (1, 3), rad/s."""
    bias_variance: np.ndarray
    """Variance of the bias that the filter knows (1,)."""
    plausible_variance: np.ndarray
    """That of the bias by all rests, at first that of any unit: a mean rate that departs by more is a turn (1,)."""
    rest_clock: np.ndarray
    """Time of the first sample of the span, and of the last rest, s (2,)."""
    field_before: np.ndarray
    """Direction of the field in an earlier span at rest, zero if the unit has moved since, or if there is no field (1, 3)."""
    field_clock: np.ndarray
    """Time of the last sample of the span of ``field_before``, s (1,)."""
    turned_slowly: np.ndarray
    """1 if the field had turned slowly at that time (1,)."""


class Means(NamedTuple):
    """Results for each span that ended."""

    rate: np.ndarray
    """Mean rate (k, 3), rad/s."""
    variance: np.ndarray
    """Its variance (k,); infinite if it was no rest."""
    gained: np.ndarray
    """Variance that the bias has gained since the rest before and the filter does not model (k,); infinite if it shows no more."""
    bias: np.ndarray
    """Bias by all rests so far (k, 3), rad/s."""


def find_rests(constants, time, rate, force, field, memory, means):
    """Look for rests in samples (n,), (n, 3); ``field`` (0, 3) if there is none. Missing ones are not finite or zero."""
    length = constants.parts * constants.part
    for i in range(len(time)):
        k = memory.resting[0]
        if k == 0:
            memory.rest_clock[0] = time[i]
        part, half = k // constants.part, k // ((length + 1) // 2)
        add(memory.tenths, part, vector_at(rate, i))
        if is_sample(vector_at(force, i)):
            memory.force_tenths[part, 3] += 1.0
            add(memory.force_tenths, part, vector_at(force, i))
        add_known(memory, half, vector_at(force, i))
        if len(field) > 0:
            add_known(memory, 2 + half, vector_at(field, i))
        memory.resting[0] = k + 1
        if k + 1 == length:
            find_rest(constants, time[i], memory)
            clear_span(memory)
            store_row(means.rate, i // length, vector_at(memory.rest_rate, 0))
            means.variance[i // length] = memory.rest_variance[0]
            means.gained[i // length] = memory.rest_gained[0]
            store_row(means.bias, i // length, vector_at(memory.rest_bias, 0))


def add(sums, row, vector):
    """Add a vector to a row of sums."""
    for i in range(3):
        sums[row, i] += vector[i]


def is_sample(vector):
    """Return whether a specific force or a field is not missing."""
    return 0.0 < dot(vector, vector) < math.inf


def add_known(memory, row, vector):
    """Add a sample of specific force or field to the sums over a half of the span, unless it is missing."""
    if is_sample(vector):
        memory.halves_number[row] += 1
        add(memory.halves, row, vector)


def clear_span(memory):
    """Begin another span."""
    memory.resting[0] = 0
    for i in range(4):
        memory.halves_number[i] = 0
    for sums in (memory.tenths, memory.force_tenths, memory.halves):
        for i in range(len(sums)):
            for j in range(sums.shape[1]):
                sums[i, j] = 0.0


def find_rest(constants, time, memory):
    """Decide at the end of a span whether it was a rest.

    The variance of its mean rate is that of a unit at rest and the spread of the rate between the parts, which is motion of the hand. A
    span with a gap is no rest, nor one with which the vertical or the field rotates, nor one that is faster than a bias that the rests
    before leave possible: a steady turn is no bias. Nor is a rate with which the field turns slowly. At rest the specific force hardly
    changes, while on waves it may turn against the rate; where it vibrates, several seconds must agree.
    """
    parts = constants.parts
    rate, spread, covered = mean_of_parts(constants, memory)
    variance = constants.own_variance + spread / parts
    since = time - memory.rest_clock[1]
    known = memory.bias_variance[0] + constants.walk * since
    plausible = memory.plausible_variance[0] + constants.slow_walk * since
    bias = vector_at(memory.rest_bias, 0)
    change = combine(1.0, rate, -1.0, bias)
    changed = dot(change, change) > constants.odds * (variance + plausible)
    # Unless the new rate is less than half of that bias, which then was a turn itself.
    turns = changed and 4.0 * dot(rate, rate) > dot(bias, bias)
    with_force, square_force, change_force = turned_with(constants, rate, memory, 0)
    with_field, square_field, _ = turned_with(constants, rate, memory, 2)
    slow = dot(rate, rate) <= constants.turning
    possible = (
        variance < constants.max_variance
        and time - memory.rest_clock[0] < 1.5 * constants.span
        and 2.0 * covered > parts
        and not turns
        and (slow or with_field <= 0.5 * square_field + constants.noise)
    )
    fixed = (slow or with_force <= 0.5 * square_force) and change_force <= 0.1 * square_force + constants.noise
    own = constants.own_variance + constants.vibration_odds * spread / parts**2
    count_steady(constants, possible, rate, own, memory)
    bias_variance = constants.vibration_odds * min(known, constants.vibration_bias)
    shaken = memory.steady_spans[0] >= constants.vibration_spans and dot(change, change) <= own + bias_variance
    quiet = possible and (fixed or shaken)
    still = quiet
    if constants.with_field > 0:
        if variance >= constants.max_variance:
            store_row(memory.field_before, 0, (0.0, 0.0, 0.0))
        if quiet:  # a statement: an operand of "and" would be evaluated always by the exported filter
            still = not turns_slowly(constants, rate, change, time, memory)
    store_row(memory.rest_rate, 0, rate)
    memory.rest_variance[0] = variance if still else math.inf
    memory.rest_gained[0] = math.inf
    if still and variance < known:
        memory.resting[1] = 1
        memory.rest_gained[0] = constants.unmodelled * since
        memory.rest_clock[1] = time
        memory.bias_variance[0] = 1.0 / (1.0 / known + 1.0 / variance)
        memory.plausible_variance[0] = 1.0 / (1.0 / plausible + 1.0 / variance)
        store_row(memory.rest_bias, 0, combine(1.0, bias, plausible / (plausible + variance), change))


def mean_of_parts(constants, memory):
    """Return the mean rate, the sum of its squared changes over the parts, and the number of parts with a specific force."""
    parts, part = constants.parts, constants.part
    rate = (0.0, 0.0, 0.0)
    for i in range(parts):
        rate = combine(1.0, rate, 1.0 / part, vector_at(memory.tenths, i))
    rate = (rate[0] / parts, rate[1] / parts, rate[2] / parts)
    spread, covered = 0.0, 0.0
    for i in range(parts):
        covered += min(memory.force_tenths[i, 3], 1.0)
        off = combine(1.0 / part, vector_at(memory.tenths, i), -1.0, rate)
        spread += dot(off, off)
    return rate, spread, covered


def count_steady(constants, possible, rate, allowed, memory):
    """Count the successive spans, possibly at rest, since whose first mean rate and specific force have changed no more than by vibration.

    Vibration is white from part to part, so that the differences of successive parts show its variance; waves and turns hardly differ in a
    tenth of a second. ``allowed``: squared error of a mean rate.
    """
    spread, pairs = 0.0, 0
    for i in range(1, constants.parts):
        before, after = memory.force_tenths[i - 1, 3], memory.force_tenths[i, 3]
        if before > 0.0 and after > 0.0:
            step = combine(
                1.0 / after, vector_at(memory.force_tenths, i), -1.0 / before, vector_at(memory.force_tenths, i - 1)
            )
            spread, pairs = spread + 0.5 * dot(step, step), pairs + 1
    share = 1.0 / max(memory.halves_number[0] + memory.halves_number[1], 1)
    force = combine(share, vector_at(memory.halves, 0), share, vector_at(memory.halves, 1))
    turn = combine(1.0, rate, -1.0, vector_at(memory.steady, 0))
    change = combine(1.0, force, -1.0, vector_at(memory.steady, 1))
    vibration = constants.vibration_odds * spread / (max(pairs, 1) * constants.parts)
    agrees = (
        dot(turn, turn) <= 2.0 * allowed
        and dot(change, change) <= constants.noise * dot(force, force) + 2.0 * vibration
    )
    if possible and agrees and memory.steady_spans[0] > 0:
        memory.steady_spans[0] += 1
    else:
        memory.steady_spans[0] = 1 if possible else 0
        store_row(memory.steady, 0, rate)
        store_row(memory.steady, 1, force)


def turns_slowly(constants, rate, change, time, memory):
    """Return whether the field shows that a unit that seems at rest turns, so slowly that no second shows it: its rate is no bias.

    The field is compared with that of a span up to two times ``field_time`` before; its turn must be that of the rate, or of the change of
    the rate since the rests before. Once it has turned, its next span must not.
    """
    before, since = vector_at(memory.field_before, 0), time - memory.field_clock[0]
    field = combine(1.0, vector_at(memory.halves, 2), 1.0, vector_at(memory.halves, 3))
    size = math.sqrt(dot(field, field))
    if size > 0.0:
        field = combine(1.0 / size, field, 0.0, field)
    compared = dot(before, before) > 0.0 and size > 0.0
    turned = turned_by(constants, rate, since, before, field) or turned_by(constants, change, since, before, field)
    due = since >= constants.field_time
    turns = compared and (turned or (memory.turned_slowly[0] == 1 and not due))
    if due or not compared:
        store_row(memory.field_before, 0, field)
        memory.field_clock[0] = time
        memory.turned_slowly[0] = 1 if turns else 0
    return turns


def turned_by(constants, rate, since, before, field):
    """Return whether a direction has turned by more than ``field_turn`` and by as much as with a mean rate, to within a half."""
    change = combine(1.0, field, -1.0, before)
    expected = cross(rate, combine(-0.5 * since, field, -0.5 * since, before))
    square = dot(change, change)
    return square > constants.field_turn and dot(change, expected) > 0.5 * max(square, dot(expected, expected))


def turned_with(constants, rate, memory, first):
    """Return c·w, w·w and c·c of the relative change c of a vector from the first to the second half, and that, w, by the mean rate."""
    sums, number = memory.halves, memory.halves_number
    in_first, in_second = number[first], number[first + 1]
    total = combine(1.0, vector_at(sums, first), 1.0, vector_at(sums, first + 1))
    size = math.sqrt(dot(total, total)) / max(in_first + in_second, 1)
    product, square, squared_change = 0.0, 0.0, 0.0
    if in_first > 0 and in_second > 0 and size > 0.0:
        before, after = 1.0 / (size * in_first), 1.0 / (size * in_second)
        change = combine(after, vector_at(sums, first + 1), -before, vector_at(sums, first))
        middle = combine(before, vector_at(sums, first), after, vector_at(sums, first + 1))
        expected = cross(rate, combine(-0.25 * constants.span, middle, 0.0, middle))
        product, square, squared_change = dot(change, expected), dot(expected, expected), dot(change, change)
    return product, square, squared_change
