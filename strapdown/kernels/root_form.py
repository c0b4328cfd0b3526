"""The filter with optional error states, its covariance as a triangular factor: a body of :mod:`strapdown.kernels.walk`.

State: attitude; ``x`` = (b, c): gyro bias and error states; the factor ``F`` (:mod:`strapdown.kernels.triangle`). Error states are defined
by arrays (:mod:`strapdown.kernels.error_state_step`). No digits are lost, however precise a measurement is, so this is also the fallback of
:mod:`strapdown.kernels.covariance_form` without error states.

The first functions are the filter without a gate. Those under *for the gate* let :mod:`strapdown.kernels.gate` wrap it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    combine,
    combine_matrices,
    congruent,
    cross,
    dot,
    matrix_times_vector,
    multiply,
    plus_square,
    scale_matrix,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.chains import chain_root, chain_start, chain_step, step_chains
from strapdown.kernels.error_state_step import (
    OFFSET,
    carry,
    fill_noise,
    fixed_turn,
    follow,
    move,
    step_noise,
    turn_columns,
    turn_rows,
    turn_values,
    turning_matrix,
)
from strapdown.kernels.gate_rules import (
    FIRST_BIAS,
    count_widening,
    may_widen,
    reset_candidate,
    restart_attitude,
    restart_width,
    start_undone,
)
from strapdown.kernels.iterated_update import arc_over_chord, seen_from
from strapdown.kernels.lane_values import WIDTH, spread, store
from strapdown.kernels.lane_values import load as read
from strapdown.kernels.measurement import (
    ATTITUDE,
    DIRECTION,
    HEADING,
    KIND,
    frame_of,
    noise_of,
    quaternion_at,
    sigma_of,
    value_of,
    vector_at,
)
from strapdown.kernels.rotation import moved, quaternion_multiply
from strapdown.kernels.sensor_rows import arm_noise, decorrelate, fill_rows
from strapdown.kernels.state import store_row
from strapdown.kernels.triangle import (
    TAKEN,
    covariances,
    seen_by,
    seen_columns,
    take_rows,
    triangularise,
    variances,
    whole_bias,
)
from strapdown.kernels.walk import step_within, turn_squared

REPLACEABLE = ("take",)
CALLED = ("store_segment", "age_chains", "aged_chain")
"""Called, not inlined; only functions of few arrays, because each array of a NamedTuple is a separate argument."""

SHORT = 0.5
"""Maximum λ dt of a state in a chain, for which its series is accurate to rounding."""


class Model(NamedTuple):
    """Noise of the gyro, and the m error states in the form of :mod:`strapdown.kernels.error_state_step`."""

    angle_variance: float
    """σ_v², rad²/s."""
    rate_variance: float
    """σ_u², rad²/s³."""
    decay: np.ndarray
    density: np.ndarray
    changing: int
    """Number of leading error states that are not constant."""
    limit: float
    """Maximum step of states that decay, s."""
    gyro: np.ndarray
    gyro_use: np.ndarray
    sensors: np.ndarray
    sensor_use: np.ndarray
    force_f: tuple[float, float, float]
    chains: np.ndarray


class Scratch(NamedTuple):
    """Work space of a step and an update, for n states and m error states; in few arrays, because each costs compile time."""

    rows: np.ndarray
    """(3, 3, width of F): H of a measurement, H in the prior's tangent space, and F Hᵀ."""
    lines: np.ndarray
    """(``LINES``, width of F), in the order of the constants below."""
    steps: np.ndarray
    """(2, 2, n, 4): Φ and Q of the steps that the factor is behind by, and of the next, as written by
    :func:`strapdown.kernels.error_state_step.move` and :func:`strapdown.kernels.error_state_step.step_noise`."""
    links: np.ndarray
    """(chained states, ``LINKS``)"""
    six: np.ndarray
    """(6, 6)"""


PRIOR = 0
"""Prior mean (n,) relative to the state of the linearisation."""
STEP = 1
"""A correction (n,)."""
NOW_X = 2
"""Bias and error states at the linearisation (n − 3,)."""
FACTOR = 3
"""Decay factor of each error state (m,) over those steps, and over the next."""
WORK = 5
ROWS = 6
"""From here, the scratch rows of :func:`strapdown.kernels.triangle.take_rows`."""
LINES = 6 + TAKEN


class Body(NamedTuple):
    """State, model and limits. Row 0 of the states is the filter, row 1 the restart candidate of a gate; at return, the end states."""

    model: Model
    attitude: np.ndarray
    """(2, 4)"""
    x: np.ndarray
    """(2, n − 3)"""
    F: np.ndarray
    """(2, rows, width): the triangle, and below it scratch for noise rows, or n + 1 rows of outliers, each
    :func:`strapdown.kernels.triangle.padded`."""
    length: np.ndarray
    """Divisor of the effects of error states on each measurement, in order of time (events,)."""
    turning: np.ndarray
    """Measured rate, angular acceleration and variances of the latter at each measurement (events, 9); (0, 9) without lever arms."""
    scratch: Scratch
    together: bool
    """Whether the factor takes all steps between two measurements at once."""
    sharpness: float
    """Infinite: no limit to the precision of a measurement."""
    least_share: float
    """0: no digits are lost."""
    check: int
    outliers: tuple[float, float] = (0.0, 1.0)
    """Share of the measurements that are outliers, and their variance over that of the others, where they are modelled."""


class Restart(NamedTuple):
    """Initial values of a restart candidate."""

    bias_sigma: np.ndarray
    """Increase of the σ of the bias (3,), rad/s."""
    values: np.ndarray
    """Error states (m,) at ``time``."""
    root: np.ndarray
    """Their covariance ``rootᵀ root`` (m, m)."""
    time: float
    fresh: np.ndarray
    """Scratch (3 m + 6, 3 + m), padded."""


class Outputs(NamedTuple):
    """Output arrays: a row for each stored edge; innovations by measurement."""

    attitude: np.ndarray
    x: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    """Covariance of the first m states (rows, m, m), or (0, m, m)."""
    whole_variance: np.ndarray
    """Variances of attitude and whole gyro bias (rows, 6), or (0, 6)."""
    whole_covariance: np.ndarray
    """(rows, 6, 6), or (0, 6, 6)."""
    innovation: np.ndarray
    segments: np.ndarray
    """Each prediction, for a smoother: dt, increment (3), attitude (4), x and the rows of the triangle."""


def store_segment(out, k, dt, part, q, x, F, loose):
    """Write row k of the segments: dt, increment (3), attitude (4), x, and the rows of the factor, the first of them loose.

    A row has ``WIDTH`` − 1 unused numbers at its end.
    """
    out[k, 0] = dt
    out[k, 1], out[k, 2], out[k, 3] = part
    out[k, 4], out[k, 5], out[k, 6], out[k, 7] = q
    place = 8
    for i in range(len(x)):
        out[k, place + i] = x[i]
    place += len(x) + k * out.shape[1]
    for j in range(len(x) + 3):
        end = row_end(j, loose)
        for c in range(0, end, WIDTH):  # the next row overwrites the excess
            store(out, place + c, read(F, F.shape[1] * j + c))
        place += end


def row_end(j, loose):
    """Return the number of stored columns of row j of a factor; rows of attitude and bias are zero beyond them."""
    return 6 if j < 6 else max(j + 1, loose)


def keep_row(form, q, row, out):
    """Write the state of the filter to a row of the outputs, with covariances and the whole bias if these are requested."""
    write_row(form, 0, q, row, out)


def write_row(form, i, q, row, out):
    """Write the filter's state with the i-th factor to a row of the outputs."""
    x, F = form.x[0], form.F[i]
    size = len(x) + 3
    store_row(out.attitude, row, q)
    for j in range(len(x)):
        out.x[row, j] = x[j]
    variances(F, size, out.variance, row, form.scratch.lines[WORK])
    if row < len(out.covariance):
        covariances(F, size, out.covariance, row, form.scratch.lines[WORK])
    if row < len(out.whole_variance):
        model = form.model
        whole_bias(
            F, size, model.gyro, model.gyro_use, OFFSET, out.whole_variance, out.whole_covariance, row, form.scratch.six
        )


def advance(model, scratch, q, x, F, dt, part):
    """Propagate a state over an increment ``part``, ``x`` and ``F`` in place; return q."""
    q = step(model, scratch, q, x, dt, part, False)
    absorb(model, scratch, x, F, dt)
    return q


def step(model, scratch, q, x, dt, part, more):
    """Propagate attitude and ``x`` only; with ``more``, combine the step with those that the factor is behind by; return q."""
    now = 1 if more else 0
    top, noise, factor = scratch.steps[now, 0], scratch.steps[now, 1], scratch.lines[FACTOR + now]
    q, _, rate, D = move(q, x, dt, part, model, top, factor)
    step_noise(noise, dt, rate, D, model)
    if more:
        size, first = len(x) + 3, scratch.lines[FACTOR]
        follow(scratch.steps[0, 0], first, scratch.steps[0, 1], top, factor, noise, size, model.changing)
    return q


def absorb(model, scratch, x, F, dt):
    """Propagate the factor over the steps that it is behind by; with states in chains, a single step of dt that includes these."""
    size, noisy = len(x) + 3, 6 + model.changing
    carry(F, size, loose(model), scratch.steps[0, 0], scratch.lines[FACTOR], model.changing)
    rows = fill_noise(F, size, scratch.steps[0, 1], noisy)
    if len(model.chains) > 0:
        rows = step_chains(F, size, rows, x, dt, model.decay, model.chains, scratch.links)
    triangularise(F, noisy, loose(model), size, rows, 0, 0, scratch.lines[WORK])


def loose(model):
    """Return the number of leading rows of a factor that are loose after a correction."""
    return 3 if len(model.chains) == 0 else 6 + model.changing


def settle(model, F, before, after, x):
    """Rotate the states that follow a correction of the attitude."""
    if len(model.chains) > 0:
        A = fixed_turn(before, after)
        turn_values(model.chains, A, x, 3)
        turn_columns(model.chains, A, F, len(x) + 3)


# --------------------------------------------------------------------------------------------------------------- the filter without a gate


def begin(body):
    """Return the attitude, the number of segments, and the number of steps that the factor is behind by."""
    # From an array, and not the literal 0: numba would compile the body for that type too.
    none = 0 * len(body.length)
    return load(body, 0), none, none


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return min(step_within(turn_squared(part, dt, bias_at(body, 0)), dt), body.model.limit)


def predict(state, part, dt, body, out):
    """Store the prediction for a smoother, and propagate."""
    q, segments, behind = state
    model, scratch, x, F = body.model, body.scratch, body.x[0], body.F[0]
    if segments < len(out.segments):
        store_prediction(body, 0, q, segments, part, dt, out)
        segments += 1
    q = step(model, scratch, q, x, dt, part, behind > 0)
    behind += 1
    if not body.together:
        absorb(model, scratch, x, F, dt)
        behind = 0 * behind
    return q, segments, behind


def update(state, e, now, measured, body, out):
    """Update with a measurement."""
    q, segments, behind = state
    model, x, F, step = body.model, body.x[0], body.F[0], body.scratch.lines[STEP]
    size = len(x) + 3
    if behind > 0:
        absorb(model, body.scratch, x, F, 0.0)
    place = measured.place[e]
    sensor = measured.sensor[e]
    kind = measured.series[sensor, KIND]
    z = value_of(measured, place, sensor)
    arm = arm_variance(body, e)
    rows, y, axes, shown = seen_rows(body, e, q, x, kind, z, frame_of(measured, place, sensor), sensor)
    if arm[0] > 0.0 or len(measured.noise) > 0:
        C = noise_of(measured, place, sensor, kind, z)
        y, spread = independent(body, e, x, sensor, rows, y, axes, C, arm)
    elif kind == ATTITUDE:
        spread = z
    else:
        variance = sigma_of(measured, place, sensor) * sigma_of(measured, place, sensor)
        u, v = 1.0, 1.0
        if kind == DIRECTION:
            u, v = dot(axes[0], axes[0]), dot(axes[1], axes[1])
        spread = (variance * u, variance * v, variance)
    errors, s = take(body, place, rows, y, spread, out)
    for r in range(rows):
        out.innovation[place, 2 * r] = errors[r]
        out.innovation[place, 2 * r + 1] = s[r]
    if kind == HEADING and not shown:
        out.innovation[place, 0] = math.nan  # a vertical vector has no heading: skipped
    before = q
    q, G = moved(q, (step[0], step[1], step[2]))
    for i in range(len(x)):
        x[i] += step[3 + i]
    turn_rows(F, size, G)
    settle(model, F, before, q, x)
    return q, segments, 0 * behind


def take(form, place, rows, y, variance, out):
    """Update the factor with the rows in the scratch; return innovations and variances, and leave the correction in ``step``."""
    scratch, size = form.scratch, len(form.x[0]) + 3
    step, work = scratch.lines[STEP], scratch.lines[ROWS:]
    return take_rows(form.F[0], size, loose(form.model), scratch.rows[0], rows, y, variance, step, work)


def seen_rows(form, e, q, x, kind, z, frame, sensor):
    """Write H of a measurement at a state to the scratch; return the same as :func:`strapdown.kernels.sensor_rows.fill_rows`."""
    model, H = form.model, form.scratch.rows[0]
    W = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    t = form.turning
    if len(t) > 0:
        turn = (t[e, 0] - x[0], t[e, 1] - x[1], t[e, 2] - x[2])
        W = turning_matrix(turn, (t[e, 3], t[e, 4], t[e, 5]))
    for j in range(0, 3 * H.shape[1], WIDTH):
        store(H, j, spread(0.0))
    value = (z[0], z[1], z[2], 0.0)
    if kind == ATTITUDE:
        value = frame[:4]
    return fill_rows(q, x, H, kind, value, frame, form.length[e], sensor, model.sensors, model.sensor_use, W, 0.0)


def arm_variance(form, e):
    """Return the variances of the angular acceleration at a measurement with a lever arm, otherwise zeros."""
    if len(form.turning) > 0:
        return (form.turning[e, 6], form.turning[e, 7], form.turning[e, 8])
    return (0.0, 0.0, 0.0)


def independent(form, e, x, sensor, rows, y, axes, C, arm):
    """Decorrelate the rows in the scratch; return y and the variances."""
    model = form.model
    if arm[0] > 0.0:
        C = arm_noise(x, sensor, model.sensors, model.sensor_use, form.length[e], arm, C, 0.0)
    return decorrelate(form.scratch.rows[0], model.sensor_use[sensor], rows, y, axes, C, 0.0)


def keep(state, row, e, body, out):
    """Write a row. The factor is not brought up to date, so its bits do not depend on which rows are stored."""
    q, _, behind = state
    if behind > 0:
        for j in range(len(body.x[0]) + 3):
            for c in range(body.F.shape[2]):
                body.F[1, j, c] = body.F[0, j, c]
        absorb(body.model, body.scratch, body.x[0], body.F[1], 0.0)
    write_row(body, 1 if behind > 0 else 0, q, row, out)
    return state


def finish(state, row, e, body):
    """Store the end state and return the number of segments."""
    q, segments, behind = state
    if behind > 0:
        absorb(body.model, body.scratch, body.x[0], body.F[0], 0.0)
    save(body, 0, q)
    return segments


# --------------------------------------------------------------------------------------------------------------------------- for the gate


def load(form, i):
    """Return the attitude of state i; the other parts remain in their arrays."""
    return quaternion_at(form.attitude, i)


def save(form, i, q):
    """Store the attitude of state i."""
    store_row(form.attitude, i, q)


def become(form):
    """Replace the filter by the restart candidate."""
    size = form.x.shape[1] + 3
    save(form, 0, load(form, 1))
    for j in range(size - 3):
        form.x[0, j] = form.x[1, j]
    for j in range(size):
        for c in range(size):
            form.F[0, j, c] = form.F[1, j, c]


def attitude_of(q):
    """Return q_fb of a state."""
    return q


def bias_at(form, i):
    """Return the gyro bias of state i."""
    return (form.x[i, 0], form.x[i, 1], form.x[i, 2])


def step_limit(form):
    """Return the longest step, s, allowed by states other than the attitude."""
    return form.model.limit


def digits_left(form, i):
    """Return 1: a factor loses no digits."""
    return 1.0


def propagate(form, i, q, part, dt):
    """Return the attitude after an increment over dt."""
    return advance(form.model, form.scratch, q, form.x[i], form.F[i], dt, part)


def store_prediction(form, i, q, k, part, dt, out):
    """Store a prediction for a smoother."""
    store_segment(out.segments, k, dt, part, q, form.x[i], form.F[i], loose(form.model))


def attitude_covariance(form, i, q):
    """Return the covariance of the attitude (6-tuple)."""
    F = form.F[i]
    S = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for j in range(form.x.shape[1] + 3):
        S = plus_square(S, vector_at(F, j))
    return S


def start_update(form, i):
    """Start the linearisation at the state."""
    scratch, x = form.scratch, form.x[i]
    for j in range(len(x)):
        scratch.lines[NOW_X][j] = x[j]
    for j in range(len(x) + 3):
        scratch.lines[PRIOR][j] = 0.0  # prior mean relative to the state of the linearisation


def linearised(form, i, e, now_q, q, M, z, frame, noise, kind, sensor, prior):
    """Return the number of rows, y (3,), its prediction by the prior (3,), variances (3,), θ/sin θ and cos θ of a direction's angle.

    The rows are written to ``H``, and in the prior's tangent space to ``prior_H``.
    """
    model, scratch = form.model, form.scratch
    H, prior_H = scratch.rows[0], scratch.rows[1]
    size = form.x.shape[1] + 3
    now_x = scratch.lines[NOW_X, : size - 3]
    rows, y, axes, _ = seen_rows(form, e, now_q, now_x, kind, z, frame, sensor)
    far, along = seen_from_afar(kind, z, rows, y, axes)
    y, spread = independent(form, e, now_x, sensor, rows, y, axes, noise, arm_variance(form, e))
    p = (0.0, 0.0, 0.0)
    for j in range(H.shape[1]):
        column = (H[0, j], H[1, j], H[2, j])
        prior_H[0, j], prior_H[1, j], prior_H[2, j] = column
        if j < size:
            p = combine(1.0, p, scratch.lines[PRIOR][j], column)
    for r in range(3):
        prior_H[r, 0], prior_H[r, 1], prior_H[r, 2] = transpose_times_vector(M, vector_at(H, r))
    if len(model.chains) > 0:
        turn_columns(model.chains, transpose(fixed_turn(q, now_q)), prior_H, 3)
    two, three = rows > 1, rows > 2
    variance = (spread[0], spread[1] if two else 1.0, spread[2] if three else 1.0)
    return rows, (y[0], y[1] if two else 0.0, y[2] if three else 0.0), p, variance, far, along


def seen_from_afar(kind, z, rows, y, axes):
    """Return θ/sin θ for the angle θ between a measured and a predicted vector, and cos θ times their length; for other kinds 1, 1.

    The rows of a direction are transverse to its prediction with the error states. Those of a vector are transverse to the reference; the
    third row is along it.
    """
    if kind in (ATTITUDE, HEADING):
        return 1.0, 1.0
    if rows == 3:
        along = y[2] + 1.0
    else:
        d = cross(axes[0], axes[1])
        along = dot(d, z) / math.sqrt(dot(d, d))
    return arc_over_chord(math.sqrt(y[0] * y[0] + y[1] * y[1]), along), along


def innovation_covariance(form, i, q, rows):
    """Return H P Hᵀ (6-tuple), zero for absent rows; write ``F Hᵀ`` to ``seen``."""
    F, H, seen = form.F[i], form.scratch.rows[1], form.scratch.rows[2]
    size = form.x.shape[1] + 3
    S = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    first, end = seen_columns(H, size)
    for j in range(size):
        seen[0, j], seen[1, j], seen[2, j] = f = seen_by(F, j, H, first, end)
        S = plus_square(S, f)
    return S


def step_of(form, i, state, rows, u, M, prior, q, now_q):
    """Return the attitude part (3,) of the step from the linearisation given by P Hᵀ u, and write the whole step to ``step``.

    Also return its squared size: of the attitude part, and of the effect of the error states on the rows.
    """
    scratch, F = form.scratch, form.F[i]
    step, seen, H = scratch.lines[STEP], scratch.rows[2], scratch.rows[0]
    size = form.x.shape[1] + 3
    for j in range(size):
        step[j] = 0.0
    for j in range(size):
        w = u[0] * seen[0, j] + u[1] * seen[1, j] + u[2] * seen[2, j]
        for c in range(size):
            step[c] += F[j, c] * w
    step[0], step[1], step[2] = matrix_times_vector(M, (step[0], step[1], step[2]))
    if len(form.model.chains) > 0:
        turn_values(form.model.chains, fixed_turn(q, now_q), step, 6)
    for j in range(size):
        step[j] += scratch.lines[PRIOR][j]
    squared = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    for r in range(rows):
        total = 0.0
        for j in range(6, size):
            total += H[r, j] * step[j]
        squared += total * total
    return (step[0], step[1], step[2]), squared


def relinearise(form, i, q, old_q, now_q, prior, fresh):
    """Change the point of linearisation; ``fresh``: reset all states except the attitude to the prior."""
    scratch, x, chains = form.scratch, form.x[i], form.model.chains
    now_x, all_prior = scratch.lines[NOW_X], scratch.lines[PRIOR]
    all_prior[0], all_prior[1], all_prior[2] = prior
    for j in range(len(x)):
        now_x[j] = x[j] if fresh else now_x[j] + scratch.lines[STEP][3 + j]
        all_prior[3 + j] = x[j]
    if len(chains) > 0:
        turn_values(chains, fixed_turn(old_q, now_q), now_x, 3)
        turn_values(chains, fixed_turn(q, now_q), all_prior, 6)
    for j in range(len(x)):
        all_prior[3 + j] -= now_x[j]


def correct(form, i, q, rows, e, variance):
    """Update with independent rows of innovations e (3,) in the prior's tangent space; return q and the correction of the attitude."""
    scratch, x, F = form.scratch, form.x[i], form.F[i]
    step = scratch.lines[STEP]
    size = form.x.shape[1] + 3
    take_rows(F, size, loose(form.model), scratch.rows[1], rows, e, variance, step, scratch.lines[ROWS:])
    for j in range(len(x)):
        x[j] += step[3 + j]
    return q, (step[0], step[1], step[2])


def turn_tangent(form, i, q, M):
    """Transform the factor to another tangent space by M, after which it is not triangular."""
    turn_rows(form.F[i], form.x.shape[1] + 3, M)
    return q


def set_attitude(form, i, state, q, before):
    """Rotate the states that follow the correction of the attitude."""
    settle(form.model, form.F[i], before, q, form.x[i])
    return q


def start_candidate(form, memory, now, attitude_sigma, restart):
    """Write row 1: attitude and bias of the filter with initial covariances, and the error states with their prior, propagated to now.

    The error states of the filter may be in error too, by an unknown amount; their prior remains valid. The covariances of attitude and
    bias increase with the number of candidates before it.
    """
    model, scratch, x, F = form.model, form.scratch, form.x, form.F
    decay, density, chains, fresh = model.decay, model.density, model.chains, restart.fresh
    size = x.shape[1] + 3
    age = now - restart.time
    width = restart_width(memory)
    m = len(restart.values)
    triangularise(F[0], loose(model), loose(model), size, size, 0, 0, scratch.lines[WORK])
    for r in range(3 * m + 6):
        for c in range(fresh.shape[1]):
            fresh[r, c] = 0.0
    for r in range(3):
        fresh[r, r] = width * restart.bias_sigma[r]
    for k in range(m):
        kept = math.exp(-decay[k] * age)
        if len(chains) > 0 and (chains[k, 0] != 0.0 or (k > 0 and chains[k - 1, 0] != 0.0)):
            kept = 1.0  # propagated by age_chains
        x[1, 3 + k] = kept * restart.values[k]
        for r in range(k, m):
            fresh[3 + r, 3 + k] = kept * restart.root[r, k]
        driven = age
        if decay[k] > 0.0:
            driven = -0.5 * math.expm1(-2.0 * decay[k] * age) / decay[k]
        fresh[3 + m + k, 3 + k] = math.sqrt(driven * density[k])
    if len(chains) > 0:
        age_chains(x, fresh, decay, chains, age)
    for r in range(3 + m):
        for c in range(3):
            fresh[3 + 2 * m + r, c] = F[0, 3 + r, 3 + c]
    triangularise(fresh, 3 + m, 0, 3 + m, 3 * m + 6, 0, 0, scratch.lines[WORK])
    for r in range(size):
        for c in range(F.shape[2]):
            F[1, r, c] = 0.0
    for r in range(3):
        F[1, r, r] = restart_attitude(attitude_sigma, memory)
        x[1, r] = x[0, r]
    for r in range(3 + m):
        for c in range(r + 1):
            F[1, 3 + r, 3 + c] = fresh[r, c]
    save(form, 1, load(form, 0))
    reset_candidate(memory, now, bias_at(form, 1), bias_variances(F[1], size))


def bias_variances(F, size):
    """Return the variances of the bias (3,) from a factor."""
    variances = (0.0, 0.0, 0.0)
    for j in range(size):
        b = (F[j, 3], F[j, 4], F[j, 5])
        variances = add(variances, (b[0] * b[0], b[1] * b[1], b[2] * b[2]))
    return variances


def aged_chain(decay, chains, first, k, age):
    """Return Φ (9-tuple) and Q (6-tuple) of the states ``first`` to k of a chain, two or three, over any time.

    By :func:`strapdown.kernels.chains.chain_step` over a short step, and repeated doubling.
    """
    fastest = 0.0
    for j in range(first, k + 1):
        fastest = max(fastest, decay[j])
    h = age
    doublings = 0
    while fastest * h > SHORT:
        h *= 0.5
        doublings += 1
    (_, _, own0), _ = chain_step(decay, chains, first, first, h)
    # The driving noise of the first state, which drives no other, is not part of the chain.
    (_, near1, own1), q = chain_step(decay, chains, first + 1, first, h)
    Q = scale_matrix(chains[first + 1, 1], (q[3], q[4], 0.0, q[5], 0.0, 0.0))
    far2, near2, own2 = 0.0, 0.0, 1.0
    if k - first > 1:
        (far2, near2, own2), q = chain_step(decay, chains, k, first, h)
        Q = combine_matrices(1.0, Q, chains[k, 1], q)
    phi = (own0, near1, far2, 0.0, own1, near2, 0.0, 0.0, own2)
    for _ in range(doublings):
        Q = add_matrices(Q, congruent(phi, Q))
        phi = multiply(phi, phi)
    return phi, Q


def age_chains(x, fresh, decay, chains, age):
    """Propagate mean and root of the prior of error states in chains over ``age``, and write the rows of their noise."""
    m = len(decay)
    for k in range(1, m):
        if chains[k - 1, 0] != 0.0 and chains[k, 0] == 0.0 and age > 0.0:
            first = chain_start(chains, k)
            last = k - first == 2
            phi, Q = aged_chain(decay, chains, first, k, age)
            a, b, c = x[1, 3 + first], x[1, 4 + first], x[1, 5 + first] if last else 0.0
            x[1, 3 + first] = phi[0] * a + phi[1] * b + phi[2] * c
            x[1, 4 + first] = phi[4] * b + phi[5] * c
            if last:
                x[1, 5 + first] = phi[8] * c
            for r in range(3, 3 + m):
                a, b, c = fresh[r, 3 + first], fresh[r, 4 + first], fresh[r, 5 + first] if last else 0.0
                fresh[r, 3 + first] = phi[0] * a + phi[1] * b + phi[2] * c
                fresh[r, 4 + first] = phi[4] * b + phi[5] * c
                if last:
                    fresh[r, 5 + first] = phi[8] * c
            # A root of Q by rows from the last state upwards; the driving noise of the first is in its row already.
            n20, n21, n22, n10, n11, n00 = chain_root(Q)
            row = 3 + m + first
            if last:
                fresh[row + 2, 3 + first], fresh[row + 2, 4 + first], fresh[row + 2, 5 + first] = n20, n21, n22
            fresh[row + 1, 3 + first], fresh[row + 1, 4 + first] = n10, n11
            fresh[row, 3 + first] = math.sqrt(fresh[row, 3 + first] ** 2 + n00 * n00)


def widen(form, memory):
    """Increase the initial bias variance of the candidate retroactively, if that start still determines its bias.

    The start is removed by a measurement of negative variance, of magnitude above that of the bias, which only adds |1/s| P e (P e)ᵀ to P:
    one more row of the factor.
    """
    scratch, x, F = form.scratch, form.x[1], form.F[1]
    size = len(x) + 3
    if not may_widen(bias_variances(F, size), memory):
        return
    column = scratch.lines[PRIOR]
    turn = (0.0, 0.0, 0.0)
    for i in range(3):
        for c in range(size):
            column[c] = 0.0
            for j in range(size):
                column[c] += F[j, c] * F[j, 3 + i]
        inverse = start_undone(i, column[3 + i], memory)
        share = inverse * (memory[FIRST_BIAS + i] - x[i])
        turn = combine(1.0, turn, share, (column[0], column[1], column[2]))
        for c in range(3, size):
            x[c - 3] += share * column[c]
        root = math.sqrt(-inverse)
        for c in range(size):
            F[size, c] = root * column[c]
        triangularise(F, size, loose(form.model), size, size + 1, 0, 0, scratch.lines[WORK])
    before = load(form, 1)
    q, G = seen_from(turn, attitude_covariance(form, 1, before))
    after = quaternion_multiply(before, q)
    turn_rows(F, size, G)
    settle(form.model, F, before, after, x)
    save(form, 1, after)
    count_widening(memory)
