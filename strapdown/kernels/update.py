"""Updates of the filter with a measurement: gains, correction of state and covariance, and the reset to the new tangent space.

Three forms by the ratio of a row's innovation variance to its noise: all rows at once in the short form ``P − Σ g gᵀ`` (:func:`gains`,
:func:`apply_gains`); one row after the other in Joseph's form (:func:`take_row`); the most precise with a root of P
(:func:`take_row_by_root`). :func:`take` decides, for sensors of any shape.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import matrix_times_vector, square_root
from strapdown.kernels.filter_step import turned_by
from strapdown.kernels.lane_values import any_lane, lanes_of, load_like, select, store, with_lane
from strapdown.kernels.layout import (
    AXES,
    CHUNKS,
    EIGHT,
    FACTORS,
    GAINS,
    LANES,
    LINE,
    MAX_SHORT,
    PARAMETERS,
    PRODUCT,
    RESIDUAL,
    ROUNDING,
    ROWS,
    SIZE_OF_P,
    STATES,
    STEP,
    STRUCTURE,
    VARIANCE,
    N,
    W,
    by_shape,
    chunk_at,
    copy_values,
    element_at,
    entry,
    put_at,
    put_chunk,
    put_element,
    stored_row,
    tuple_at,
    value_at,
)
from strapdown.kernels.measurement import HEADING
from strapdown.kernels.rows import measurement_of, rows_of, store_rows  # noqa: F401 - in the source by shape
from strapdown.kernels.structural_zeros import any_number, is_zero, plus, products
from strapdown.kernels.structure import MAX_PRECISION, Gains
from strapdown.kernels.tangent_space import fixed_turn, rotate_vectors

ROTATED = (0, 1, 2, *tuple(k for v in STRUCTURE.vectors for k in v))
"""States that a correction of the attitude rotates."""
PLAIN = tuple(k for k in STATES if k not in ROTATED)
BLOCKS = tuple(PLAIN[i : i + 4] for i in range(0, len(PLAIN), 4)) if LANES > 1 else (CHUNKS,)
"""Chunks of a row that are computed together, for all rows: four columns, whose gains stay in registers."""

JOSEPH_FORM = 1e8
"""Maximum ratio for Joseph's form, whose rounding is up to 2e-8 of the measurement's variance at this ratio."""

CALLED = ("take_precisely", "take_row", "inner_product")
"""An update is inlined: the sixty numbers of its arguments cost a tenth of its time, and no kernel has two copies."""


def gains(s, x, P, work, measured, numbers, factor, like):
    """Return the gains of a measurement whose noise variances are multiplied by a factor, as a :class:`Gains`.

    Of each row p = P h, given the rows before it, in chunks, over the root of its innovation's variance: P decreases by the sum of the
    outer products of these gains, which is symmetric to the last bit.
    """
    H, y, r, angle, valid = rows_of(s, x, measured, numbers, like)
    r = tuple(factor * t for t in r) if factor is not None else r
    used = tuple(i for i in STATES if any(not is_zero(h[i]) for h in H))
    rows = tuple(tuple(h[i] for i in used) for h in H if any_number(h))  # the length of a vector has no information
    p = [tuple(products(row, tuple(chunk_at(P, i, c, like) for i in used)) for c in CHUNKS) for row in rows]
    p = [stored_row(t, work, LINE * (FACTORS + i)) for i, t in enumerate(p)]
    entries = [tuple(entry(t, work, LINE * (FACTORS + i), k) for k in used) for i, t in enumerate(p)]
    errors, step, gain, inverted, variances, shares = list(y), (0,) * len(CHUNKS), [], [], [], {}
    precise = None
    # H P Hᵀ + R = L D Lᵀ from the products of all rows, none of which waits for the rows before it.
    for i, row in enumerate(rows):
        variance, column = products(row, entries[i]), []
        for j in AXES[:i]:
            m = products(row, entries[j])
            for k in AXES[:j]:
                m = m - shares[j, k] * column[k]
            column.append(m)
            share = shares[i, j] = m * inverted[j]
            variance = variance - share * m
            errors[i] = errors[i] - share * errors[j]
            p[i] = tuple(u - share * v for u, v in zip(p[i], p[j], strict=True))
        variances.append(variance + r[i])
        inverted.append(1.0 / variances[i])
        weight = inverted[i] * errors[i]
        step = tuple(plus(t, weight * u) for t, u in zip(step, p[i], strict=True))
        root = square_root(inverted[i])
        gain.append(stored_row(tuple(root * t for t in p[i]), work, LINE * (GAINS + i)))
        far = variances[i] > MAX_SHORT * r[i]
        precise = far if precise is None else precise | far
    for variance in r[len(rows) :]:  # that of the length is part of the innovation
        variances.append(variance)
        inverted.append(1.0 / variance)
        shares[2, 0] = shares[2, 1] = like
    nis = products(tuple(e * e for e in errors), tuple(inverted))
    errors, variances = tuple(errors), tuple(variances)
    skipped = STRUCTURE.sensors[s].kind == HEADING  # possibly: a vertical vector has no heading
    reported = (select(valid, errors[0], like + math.nan),) if skipped else errors
    rest = precise, tuple(shares.values()), tuple(r), tuple(y), angle, valid, nis
    return Gains(tuple(gain), step, errors, variances, reported, *rest)


# ------------------------------------------------------------------------------------------------------------------------------- correction


def apply_gains(x, P, work, gain, step, like):
    """Correct the state by a step; subtract Σ g gᵀ from the covariance, and transform it to the new tangent space, in one pass.

    The attitude's error is transformed by J_r of its correction, carried vectors as in :mod:`strapdown.kernels.tangent_space`.
    """
    rotate_covariance(P, work, gain, *correct_state(x, work, step, like), like)


def correct_state(x, work, step, like):
    """Correct the state by a step; return the transformations of the errors of attitude and carried vectors."""
    step, before = stored_row(step, work, LINE * STEP), tuple_at(x, 0, 4, like)
    both = turned_by(before, tuple(entry(step, work, LINE * STEP, a) for a in AXES))
    q, G = both[:4], both[4:]
    add_step(x, step, work, like)
    A = fixed_turn(before, q) if STRUCTURE.vectors else ()
    for v in STRUCTURE.vectors:
        for k, t in zip(v, matrix_times_vector(A, tuple(value_at(x, 1 + k, like) for k in v)), strict=True):
            put_at(x, 1 + k, t)
    for i, t in enumerate(q):
        put_at(x, i, t)
    return G, A


def add_step(x, step, work, like):
    """Add a step (chunks) to the states; it overwrites the vector part of the quaternion, which is written next."""
    for c, t in zip(CHUNKS, step, strict=True):
        if LANES > 1:
            put_at(x, 1 + c, value_at(x, 1 + c, like) + t)
        elif c + 8 <= N:
            store(x, 1 + c, load_like(x, 1 + c, t) + t)
        else:
            for j in STATES[max(c, 3) :]:
                x[1 + j] = x[1 + j] + entry(step, work, LINE * STEP, j)


def rotate_covariance(P, work, gain, G, A, like):
    """Subtract Σ g gᵀ from P, and transform the attitude by G and the carried vectors by A."""
    groups = ((AXES, G), *((v, A) for v in STRUCTURE.vectors))
    half = {}  # rows that rotate, transformed from the left
    whole = {}  # their elements of columns that rotate, from both sides
    for m, (v, T) in enumerate(groups):
        for first in CHUNKS if LANES == 1 else STATES:
            if first in PLAIN or LANES == 1 or any(first in w for w, _ in groups[m:]):
                t = tuple(less_gains(P, work, gain, i, first, like) for i in v)
                for a in AXES:
                    half[v[a], first] = products(T[3 * a : 3 * a + 3], t)
                    if first in PLAIN or LANES == 1:
                        put_chunk(P, v[a], first, half[v[a], first])
    for block in BLOCKS:
        for i in PLAIN:
            columns = tuple(c for c in block if c >= i or LANES == 1)
            row = tuple(less_gains(P, work, gain, i, c, like) for c in columns)  # read as a whole before it is written
            # Of one run, with the columns that rotate: a store of a number takes as long as that of a chunk.
            rotated = tuple((j, element_at(P, j, i, like)) for j in ROTATED) if LANES == 1 else ()
            for c, t in zip(columns, row, strict=True):
                put_chunk(P, i, c, with_entries(t, c, rotated))
    for m, (v, _) in enumerate(groups):
        for w, T in groups[m:]:
            old = tuple(tuple(element_at(P, i, j, like) if LANES == 1 else half[i, j] for j in w) for i in v)
            for a in AXES:
                for d in AXES:
                    if w[d] >= v[a] or w != v:
                        whole[v[a], w[d]] = whole[w[d], v[a]] = products(old[a], T[3 * d : 3 * d + 3])
    for i in ROTATED:
        if LANES == 1:
            entries = tuple((j, whole[i, j]) for j in ROTATED)
            for c in sorted({j - j % 8 for j in ROTATED}):
                put_chunk(P, i, c, with_entries(half[i, c], c, entries))
        else:
            for j in ROTATED:
                if j >= i:
                    put_element(P, i, j, whole[i, j])


def less_gains(P, work, gain, i, c, like):
    """Return the chunk of row i of ``P − Σ g gᵀ`` from column c on."""
    t = chunk_at(P, i, c, like)
    rows = gains_at(gain, i)
    for r, u in enumerate(gains_at(gain, c)):
        t = t - (work[LINE * (GAINS + r) + i] if LANES == 1 else rows[r]) * u
    return t


def gains_at(gain, c):
    """Return the chunk of each gain from column c on."""
    return tuple(g[CHUNKS.index(c)] for g in gain if c in CHUNKS)


def with_entries(chunk, c, entries):
    """Return the chunk of one run from column c on with other entries, given by column and number."""
    for j, number in entries:
        if c <= j < c + 8:
            chunk = with_lane(chunk, j - c, number)
    return chunk


def apply_step(x, P, work, like):
    """Correct the state by the step in the work space, and transform the covariance."""
    apply_gains(x, P, work, (), stored_step(work, like), like)


def stored_step(work, like):
    """Return the step in the work space (chunks)."""
    return tuple(
        load_like(work, LINE * STEP + c, lanes_of(EIGHT)) if LANES == 1 else value_at(work, LINE * STEP + c, like)
        for c in CHUNKS
    )


def clear_step(work, like):
    """Set the correction in the work space to zero."""
    for i in range(N):
        put_at(work, LINE * STEP + i, like)


# ------------------------------------------------------------------------------------------------ one row after the other, in Joseph's form


def take_row(P, work, line, residual, variance, like):
    """Update covariance and step with a line of the work space; return its innovation and the innovation's variance.

    By Joseph's form, as :func:`strapdown.kernels.filter_step.update_row`.
    """
    first, p, step = LINE * line, LINE * PRODUCT, LINE * STEP
    s = variance
    error = residual
    product(P, work, first, p, like)
    for i in range(N):
        h = value_at(work, first + i, like)
        s = s + h * value_at(work, p + i, like)
        error = error - h * value_at(work, step + i, like)
    inverted = 1.0 / s
    minus_outer_rows(P, work, p, p, inverted, like)
    for i in range(N):
        t = inverted * value_at(work, p + i, like)
        put_at(work, p + i, t)
        put_at(work, step + i, value_at(work, step + i, like) + error * t)
    precise = s > MAX_SHORT * variance
    if any_lane(precise):
        d = LINE * ROUNDING
        product(P, work, first, d, like)
        for i in range(N):
            rounding = value_at(work, d + i, like) - variance * value_at(work, p + i, like)
            put_at(work, d + i, select(precise, rounding, like))
        minus_outer_rows(P, work, d, p, like + 1.0, like)
    return error, s


def product_by_chunks(P, work, row, line, like):
    """Write P h of a row of the work space to another line, eight columns at once."""
    for c in CHUNKS:
        s = work[row] * chunk_at(P, 0, c, like)
        for i in STATES[1:]:
            s = s + work[row + i] * chunk_at(P, i, c, like)
        store(work, line + c, s)


def product_by_elements(P, work, row, line, like):
    """The same, one element after the other."""
    for j in range(N):
        t = like
        for i in range(N):
            t = t + value_at(work, row + i, like) * element_at(P, i, j, like)
        put_at(work, line + j, t)


product = product_by_chunks if LANES == 1 else product_by_elements


def minus_outer_by_chunks(P, work, left, right, factor, like):
    """Subtract a factor times the outer product of two lines of the work space, known to be symmetric, from P, eight columns at once.

    Below the diagonal it is the transpose, whose bits are those above.
    """
    columns = tuple(load_like(work, right + c, lanes_of(EIGHT)) for c in CHUNKS)
    rows = tuple(factor * load_like(work, left + c, lanes_of(EIGHT)) for c in CHUNKS)
    for i in STATES:
        f, g = factor * work[left + i], work[right + i]
        for c, column, row in zip(CHUNKS, columns, rows, strict=True):
            put_chunk(P, i, c, chunk_at(P, i, c, like) - (g * row if c + 8 <= i else f * column))
    for i in STATES:
        for j in STATES[i + 1 : 8 * (i // 8) + 8]:  # the chunks that the diagonal crosses
            P[W * j + i] = P[W * i + j]


def minus_outer_by_elements(P, work, left, right, factor, like):
    """The same, one element after the other."""
    for i in range(N):
        t = factor * value_at(work, left + i, like)
        for j in range(i, N):
            put_element(P, i, j, element_at(P, i, j, like) - t * value_at(work, right + j, like))


minus_outer_rows = minus_outer_by_chunks if LANES == 1 else minus_outer_by_elements


# ------------------------------------------------------------------------------------------------ very precise measurements, by a root of P


def take_precisely(x, P, work, root, rows, like):
    """Update with the rows in the work space, one after the other; return whether one was too precise for double precision.

    In lanes and in exported code, by Joseph's form only.
    """
    clear_step(work, like)
    lost = like < 0.0  # false, of the type of the lanes
    by_root = LANES == 1 and exceeds_joseph_form(work, rows)
    if LANES == 1 and by_root:
        factor_covariance(P, root)
    for i in range(rows):
        line = LINE * (ROWS + i)
        variance = value_at(work, line + VARIANCE, like)
        if LANES == 1 and by_root:
            s = take_row_by_root(root, work, line)
        else:
            _, s = take_row(P, work, ROWS + i, value_at(work, line + RESIDUAL, like), variance, like)
        lost = lost | (s > MAX_PRECISION * variance)
    G, A = correct_state(x, work, stored_step(work, like), like)
    if LANES == 1 and by_root:
        turn_root(P, root, G, A)
    else:
        rotate_covariance(P, work, (), G, A, like)
    return any_lane(lost)


def exceeds_joseph_form(work, rows):
    """Return whether a row is too precise for Joseph's form; :func:`gains` has written P h."""
    far = False
    for r in range(rows):
        row = LINE * (ROWS + r)
        far = far or inner_product(work, row, 1, work, LINE * (FACTORS + r), 1, N) > JOSEPH_FORM * work[row + VARIANCE]
    return far


def factor_covariance(P, root):
    """Write a root of P (Cholesky), unless P is still its square; of a state that those before it determine, a line of zeros."""
    changed = False
    for i in range(N):
        for j in range(N):
            changed = changed or P[W * i + j] != inner_product(root, i, N, root, j, N, N)
    for k in range(N if changed else 0):
        pivot = P[W * k + k] - inner_product(root, k, N, root, k, N, k)
        share = 1.0 / math.sqrt(pivot) if MAX_PRECISION * pivot > P[W * k + k] else 0.0
        for i in range(N):
            root[N * k + i] = share * (P[W * k + i] - inner_product(root, k, N, root, i, N, k)) if i >= k else 0.0


def take_row_by_root(root, work, row):
    """Update root and step with a row in the work space; return the innovation's variance (Potter: Bierman 1977, section V.3)."""
    f, step, variance = LINE * PRODUCT, LINE * STEP, work[row + VARIANCE]
    error = work[row + RESIDUAL] - inner_product(work, row, 1, work, step, 1, N)
    for k in range(N):
        work[f + k] = inner_product(root, N * k, 1, work, row, 1, N)
    s = variance + inner_product(work, f, 1, work, f, 1, N)
    for i in range(N):
        p = inner_product(root, i, N, work, f, 1, N) / s
        work[step + i] += error * p
        for k in range(N):
            root[N * k + i] -= p / (1.0 + math.sqrt(variance / s)) * work[f + k]
    return s


def turn_root(P, root, G, A):
    """Transform a root to the new tangent space, and write P, its square."""
    for k in range(0, N * N, N):
        root[k], root[k + 1], root[k + 2] = matrix_times_vector(G, (root[k], root[k + 1], root[k + 2]))
        rotate_vectors(root, k, A)
    for i in range(N):
        for j in range(N):
            P[W * i + j] = inner_product(root, i, N, root, j, N, N)


def inner_product(a, i, stride, b, j, step, count):
    """Return the inner product of every ``stride``-th number of a from the i-th on, and every ``step``-th of b from the j-th on."""
    s = 0.0
    for k in range(count):
        s += a[i + stride * k] * b[j + step * k]
    return s


# ----------------------------------------------------------------------------------------------------------------------- by shape of sensor


def take_precise_rows(body, g, rows, like):
    """Update with the rows in the work space; several runs by both forms, Joseph's for those that are precise."""
    x, P = body.x, body.P
    if LANES == 1:
        return take_precisely(x[0], P[0], body.work, body.root, rows, like)
    # A run that needs Joseph's form must not change the bits of those beside it.
    copy_values(x[0], x[1], N + 1, like)
    copy_values(P[0], P[1], SIZE_OF_P // LANES, like)
    apply_gains(x[0], P[0], body.work, g.gain, g.step, like)
    lost = take_precisely(x[1], P[1], body.work, body.root, rows, like)
    blend_values(x[1], x[0], g.precise, N + 1, like)
    blend_values(P[1], P[0], g.precise, SIZE_OF_P // LANES, like)
    return lost


def blend_values(a, b, condition, count, like):
    """Replace values of b by those of a in the runs in which the condition holds."""
    for i in range(count):
        put_at(b, i, select(condition, value_at(a, i, like), value_at(b, i, like)))


def store_innovations(innovation, measured, e, g):
    """Write the innovations of a measurement, and their variances; of several runs to the first row, where another kernel takes them."""
    for i, pair in enumerate(zip(g.reported, g.variances, strict=True)):
        for j, value in enumerate(pair):
            if LANES == 1:
                innovation[measured.place[e], 2 * i + j] = value
            else:
                put_at(innovation, 2 * i + j, value)
    if LANES > 1 and not PARAMETERS:
        put_at(innovation, 6, g.nis)


def take(shape, body, measured, e, innovation, like):
    """Update with the e-th measurement, by a sensor of a shape; return whether it was too precise. Defined below."""


OF_A_SHAPE = """
def gains_{s}(body, measured, e, factor, like):
    m = measurement_of({s}, body, measured, e)
    return gains({s}, body.x[0], body.P[0], body.work, m, body.model.numbers, factor, like)


def rows_{s}(body, measured, e, like):
    m = measurement_of({s}, body, measured, e)
    return store_rows({s}, body.x[0], body.work, m, body.model.numbers, False, like)
"""
"""Gains and rows at the state of the filter."""
_SOURCE = f"""{OF_A_SHAPE}

def take_{{s}}(body, measured, e, innovation, like):
    g = gains_{{s}}(body, measured, e, None, like)
    store_innovations(innovation, measured, e, g)
    if any_lane(g.precise):
        rows_{{s}}(body, measured, e, like)
        return take_precise_rows(body, g, {{rows}}, like)
    apply_gains(body.x[0], body.P[0], body.work, g.gain, g.step, like)
    return False
"""
exec(compile(by_shape(_SOURCE, "take", "body, measured, e, innovation, like", "False"), __file__, "exec"), globals())
