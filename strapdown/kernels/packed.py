"""Products of 3×3 matrices in SIMD registers, for one run at a time.

In the source a matrix is a tuple of nine numbers. Compiled for doubles, a few functions of :mod:`strapdown.kernels.algebra` use its rows as
vectors: a row of the result is a sum of rows, each times a scalar, so nine instructions replace 27. LLVM removes moves between scalars and
vectors in a chain of products. The order of operations is that of the source, so the bits are those of each lane of
:mod:`strapdown.kernels.lanes`.

Products with vectors, symmetric products and symmetric rank-one terms are not here: moving the numbers costs about as much as it saves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir

_ROW = ir.VectorType(ir.DoubleType(), 4)
"""Three numbers and one unused."""
_INDEX = ir.IntType(32)
_NOWHERE = ir.Constant(_ROW, ir.Undefined)
_FUSED = ("contract",)


def _row(builder: Any, numbers: Any) -> Any:
    vector = _NOWHERE
    for place, number in enumerate(numbers):
        vector = builder.insert_element(vector, number, ir.Constant(_INDEX, place))
    return vector


def _rows(builder: Any, matrix: Any) -> list[Any]:
    return [_row(builder, matrix[3 * i : 3 * i + 3]) for i in range(3)]


def _numbers(builder: Any, rows: Any) -> list[Any]:
    return [builder.extract_element(row, ir.Constant(_INDEX, place)) for row in rows for place in range(3)]


def _times(builder: Any, number: Any, row: Any) -> Any:
    spread = builder.shuffle_vector(_row(builder, [number]), _NOWHERE, ir.Constant(ir.VectorType(_INDEX, 4), [0] * 4))
    return builder.fmul(spread, row, flags=_FUSED)


def _multiply(builder: Any, left: Any, right: Any) -> list[Any]:
    """Emit :func:`strapdown.kernels.algebra.multiply`."""
    rows = _rows(builder, right)
    result = []
    for i in range(3):
        first, second, third = (_times(builder, left[3 * i + k], rows[k]) for k in range(3))
        result.append(builder.fadd(builder.fadd(first, second, flags=_FUSED), third, flags=_FUSED))
    return _numbers(builder, result)


def _multiply_add(builder: Any, left: Any, right: Any, addend: Any) -> list[Any]:
    """Emit :func:`strapdown.kernels.algebra.multiply_add`."""
    rows, result = _rows(builder, right), _rows(builder, addend)
    for i in range(3):
        for k in (2, 1, 0):
            result[i] = builder.fadd(_times(builder, left[3 * i + k], rows[k]), result[i], flags=_FUSED)
    return _numbers(builder, result)


def _minus_outer(builder: Any, matrix: Any, left: Any, right: Any) -> list[Any]:
    """Emit :func:`strapdown.kernels.algebra.minus_outer`."""
    row = _row(builder, right)
    rows = _rows(builder, matrix)
    return _numbers(builder, [builder.fsub(rows[i], _times(builder, left[i], row), flags=_FUSED) for i in range(3)])


EMIT: dict[str, Callable[..., list[Any]]] = {
    "multiply": _multiply,
    "multiply_add": _multiply_add,
    "minus_outer": _minus_outer,
}
"""Emitter of each function of :mod:`strapdown.kernels.algebra` by name, for lists of doubles."""
