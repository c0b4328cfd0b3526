"""Layout of the arrays of the filter of N error states: state, covariance and work space.

State: ``x`` = (q, b, c): attitude, gyro bias and error states; ``P`` the covariance of the errors (δθ, δb, δc), the attitude's on the body
side, ``q_true = q ⊗ exp(δθ)``. Both are in arrays between the functions in ``CALLED``, so that none needs more than a few dozen numbers at
once. P has two layouts, which differ in the functions of this module only. A row is read and written by *chunks*:

- one run: a chunk is eight columns of a row; P is stored in full, its rows padded to :data:`W`;
- several runs, one per lane: a chunk is one element of P of all runs; the upper triangle is stored by rows.

Size and structure of the model are known while compiling: this module and all that use it are templates, of which
:func:`strapdown.kernels.machine.instance` makes a copy for each :class:`strapdown.kernels.structure.Structure` and number of lanes.
"""

from __future__ import annotations

from strapdown.kernels.lane_values import lanes_of, load_like, store
from strapdown.kernels.measurement import degrees_of_freedom
from strapdown.kernels.structure import SHORT_FORM, SHORT_FORM_SINGLE, SIX_STATES, Structure

STRUCTURE: Structure = globals().get("STRUCTURE", SIX_STATES)
"""Structure of the model, given by :func:`strapdown.kernels.machine.instance`."""
LANES: int = globals().get("LANES", 1)
"""Number of runs in a value, likewise."""
SINGLE: bool = globals().get("SINGLE", False)
"""Whether numbers are of single precision, as exported code can be."""
PARAMETERS: bool = globals().get("PARAMETERS", False)
"""Whether the runs differ in noise and error states, instead of gyro and measurements: numbers of the model are lanes."""

N = STRUCTURE.n
STATES = tuple(range(N))
AXES = (0, 1, 2)
OTHERS = STATES[3:]
"""All states but the attitude."""
DIAGONAL = (0, 4, 8)
"""Places of the diagonal of a 3×3 matrix."""
W = N + 7 - (N + 7) % 8
"""Length of a row of P of one run."""
SIZE_OF_P = N * W if LANES == 1 else N * (N + 1) // 2 * LANES
CHUNKS = tuple(range(0, W, 8)) if LANES == 1 else STATES
"""First column of each chunk of a row."""
EIGHT = (0.0,) * 8
MAX_SHORT = SHORT_FORM_SINGLE if SINGLE else SHORT_FORM

# Lines of the work space, each of LINE values.
LINE = W + 8
FACTORS, GAINS, ROWS = 0, 3, 6
"""Products P h of the rows of a measurement; the same given the rows before, over the roots of their innovation variances; the rows h."""
PRODUCT, STEP, ROUNDING, PRIOR, NOW_X, PRIOR_ROWS = 9, 10, 11, 12, 13, 14
"""P h of one row; a correction; the rounding error of P h; prior mean relative to a point of linearisation, the state there, and the rows
there in the tangent space of the prior."""
LINES = 17
RESIDUAL, VARIANCE = N, N + 1
"""Places in a line of the rows, after h."""


def number(entry, numbers):
    """Return the number of an entry of the structure."""
    return entry if isinstance(entry, int) else parameter(numbers, entry[0])


def numbers_of(entries, numbers):
    """Return the numbers of entries."""
    return tuple(number(entry, numbers) for entry in entries)


def parameter(array, i):
    """Return number i of the model."""
    return load_like(array, i * LANES, lanes_of((0.0,) * LANES)) if PARAMETERS else array[i]


def value_at(array, i, like):
    """Return value i of an array, a number or that of each lane."""
    return array[i] if LANES == 1 else load_like(array, i * LANES, like)


def put_at(array, i, value):
    """Write value i of an array."""
    if LANES == 1:
        array[i] = value
    else:
        store(array, i * LANES, value)


def tuple_at(array, first, count, like):
    """Return neighbouring values of an array."""
    return tuple(value_at(array, first + i, like) for i in range(count))


def copy_values(a, b, count, like):
    """Copy values of an array to another."""
    for i in range(count):
        put_at(b, i, value_at(a, i, like))


def bias_at(body, i):
    """Return the gyro bias of state i."""
    x = body.x
    return (x[i, 4], x[i, 5], x[i, 6])


def attitude_covariance(body, i):
    """Return the covariance of the attitude of state i (6-tuple)."""
    P = body.P
    return (P[i, 0], P[i, 1], P[i, 2], P[i, W + 1], P[i, W + 2], P[i, 2 * W + 2])


# ------------------------------------------------------------------------------------------------------------------------------- covariance


def index_of(i, j):
    """Return the index of P[i, j] in its array."""
    if LANES == 1:
        return W * i + j
    a, b = min(i, j), max(i, j)
    return a * N - a * (a - 1) // 2 + b - a


def element_at(P, i, j, like):
    """Return P[i, j]."""
    return value_at(P, index_of(i, j), like)


def put_element(P, i, j, value):
    """Write P[i, j] and P[j, i]."""
    put_at(P, index_of(i, j), value)
    if LANES == 1 and i != j:
        put_at(P, index_of(j, i), value)


def chunk_at(P, i, c, like):
    """Return the chunk of row i from column c on."""
    return load_like(P, W * i + c, lanes_of(EIGHT)) if LANES == 1 else element_at(P, i, c, like)


def put_chunk(P, i, c, chunk):
    """Write the chunk of row i from column c on."""
    if LANES == 1:
        store(P, W * i + c, chunk)
    else:
        put_at(P, index_of(i, c), chunk)


def stored_row(row, work, line):
    """Return a row (chunks) for :func:`entry`; if its chunks have several entries, it is written to a line of the work space."""
    for c, chunk in zip(CHUNKS, row, strict=True) if LANES == 1 else ():
        store(work, line + c, chunk)
    return row


def entry(row, work, line, j):
    """Return entry j of a row; read where it is needed, so that no register holds it until then."""
    return work[line + j] if LANES == 1 else row[j]


# ------------------------------------------------------------------------------------------------------------------------- sensors by shape


def by_shape(definitions, name, arguments, otherwise):
    """Return the source of functions for each shape of sensor, a constant ``{s}``, and of one that calls ``name_{s}`` of a given shape.

    ``{rows}``: number of rows of a measurement.
    """
    kinds = [sensor.kind for sensor in STRUCTURE.sensors]
    source = [definitions.format(s=s, rows=degrees_of_freedom(kind)) for s, kind in enumerate(kinds)]
    source.append(f"def {name}(shape, {arguments}):")
    source += [f"    if shape == {s}:\n        return {name}_{s}({arguments})" for s in range(len(kinds))]
    return "\n\n".join([*source, f"    return {otherwise}"])
