"""The SIMD vector behind :mod:`strapdown.kernels.lane_values`: a numba type for eight (or any power of two) scalars (lanes) in one value.

``Lanes(float64, 8)`` is LLVM's ``<8 x double>``. Arithmetic, comparisons and square roots act lane by lane, and each lane is rounded like a
scalar; a float or integer combined with lanes is copied to all of them. LLVM splits the vector to the width of the machine, down to single
scalars, so a machine without vectors needs no other code, and the bits of a lane are the same on every machine with fused multiply-add.
"""

from __future__ import annotations

import inspect
import math
import operator
import sys
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

from strapdown.kernels import lane_values
from strapdown.kernels.compiler import DATA
from strapdown.kernels.lane_values import WIDTH

_ELEMENTS = {
    types.float64: ir.DoubleType(),
    types.float32: ir.FloatType(),
    types.int64: ir.IntType(64),
    types.uint64: ir.IntType(64),
    types.uint32: ir.IntType(32),
    types.boolean: ir.IntType(1),
}
_BYTES = {types.float64: 8, types.float32: 4, types.int64: 8, types.uint64: 8, types.uint32: 4}
_INDEX = ir.IntType(32)


class Lanes(types.Type):  # type: ignore[misc]
    """``count`` scalars of one type in one value."""

    def __init__(self, dtype: types.Type, count: int) -> None:
        self.dtype = dtype
        self.count = count
        super().__init__(f"Lanes({dtype}, {count})")

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Any:
        """A number is converted by copying it to all lanes."""
        return Conversion.safe if _is_number(other) else None

    def unify(self, typingctx: Any, other: types.Type) -> Any:
        """A variable that is a number in one place and lanes in another is lanes."""
        return self if _is_number(other) else None


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, _vector(lanes))


def _is_number(numba_type: types.Type) -> bool:
    return isinstance(numba_type, types.Float | types.Integer)


def _vector(lanes: Lanes) -> ir.VectorType:
    return ir.VectorType(_ELEMENTS[lanes.dtype], lanes.count)


def _picked(builder: Any, a: Any, b: Any, places: list[int]) -> Any:
    """Return the elements at ``places`` of a followed by b."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INDEX, len(places)), places))


def _spread(builder: Any, scalar: Any, vector: ir.VectorType) -> Any:
    empty = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(empty, scalar, ir.Constant(_INDEX, 0))
    return _picked(builder, first, empty, [0] * vector.count)


@lower_cast(types.Float, Lanes)  # type: ignore[untyped-decorator]
@lower_cast(types.Integer, Lanes)  # type: ignore[untyped-decorator]
def _number_to_lanes(context: Any, builder: Any, source: Any, target: Any, value: Any) -> Any:
    if source != target.dtype:
        value = context.cast(builder, value, source, target.dtype)
    return _spread(builder, value, _vector(target))


# ------------------------------------------------------------------------------------------------ operators


def _lanes_among(arguments: tuple[types.Type, ...]) -> Lanes | None:
    """Return the type of the lanes among the arguments; None if it is not unique, or if another argument is not a number."""
    kinds = {a for a in arguments if isinstance(a, Lanes)}
    others = [a for a in arguments if not isinstance(a, Lanes)]
    return kinds.pop() if len(kinds) == 1 and all(map(_is_number, others)) else None


def _define(operation: Callable[..., Any], count: int, emit: Callable[..., Any], *, compares: bool = False) -> None:
    """Define ``operation`` on lanes in numba; ``emit(builder, dtype, *vectors)`` writes its instruction."""

    @infer_global(operation)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, arguments: tuple[types.Type, ...], keywords: Any) -> Any:
            lanes = _lanes_among(arguments) if len(arguments) == count else None
            if lanes is None:
                return None
            return signature(Lanes(types.boolean, lanes.count) if compares else lanes, *[lanes] * count)

    @lower_builtin(operation, *[Lanes] * count)  # type: ignore[untyped-decorator]
    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return emit(builder, sig.args[0].dtype, *arguments)


def _arithmetic(float_instruction: str | None, integer_instruction: str | None) -> Callable[..., Any]:
    def emit(builder: Any, dtype: types.Type, *vectors: Any) -> Any:
        name = float_instruction if isinstance(dtype, types.Float) else integer_instruction
        if name is None:
            raise TypeError(f"no such operation on lanes of {dtype}")
        return getattr(builder, name)(*vectors)

    return emit


def _comparison(sign: str) -> Callable[..., Any]:
    def emit(builder: Any, dtype: types.Type, a: Any, b: Any) -> Any:
        if isinstance(dtype, types.Float):
            # As in Python, NaN is unequal to everything, and every other comparison with it is false.
            return (builder.fcmp_unordered if sign == "!=" else builder.fcmp_ordered)(sign, a, b)
        return (builder.icmp_signed if getattr(dtype, "signed", False) else builder.icmp_unsigned)(sign, a, b)

    return emit


def _square_root(builder: Any, dtype: types.Type, x: Any) -> Any:
    name = f"llvm.sqrt.v{x.type.count}f{8 * _BYTES[dtype]}"
    return builder.call(cgutils.get_or_insert_function(builder.module, ir.FunctionType(x.type, [x.type]), name), [x])


for _operator, _instructions in {
    operator.add: ("fadd", "add"),
    operator.sub: ("fsub", "sub"),
    operator.mul: ("fmul", "mul"),
    operator.truediv: ("fdiv", None),
    operator.and_: (None, "and_"),
    operator.or_: (None, "or_"),
    operator.xor: (None, "xor"),
    operator.lshift: (None, "shl"),
    operator.rshift: (None, "lshr"),
}.items():
    _define(_operator, 2, _arithmetic(*_instructions))
_define(operator.neg, 1, _arithmetic("fneg", "neg"))
_define(math.sqrt, 1, _square_root)
for _operator, _sign in {
    operator.lt: "<",
    operator.le: "<=",
    operator.gt: ">",
    operator.ge: ">=",
    operator.eq: "==",
    operator.ne: "!=",
}.items():
    _define(_operator, 2, _comparison(_sign), compares=True)


@infer_global(len)
class _LengthTemplate(AbstractTemplate):  # type: ignore[misc]
    def generic(self, arguments: tuple[types.Type, ...], keywords: Any) -> Any:
        return signature(types.intp, *arguments) if isinstance(arguments[0], Lanes) else None


@lower_builtin(len, Lanes)  # type: ignore[untyped-decorator]
def _length(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    return context.get_constant(types.intp, sig.args[0].count)


# ------------------------------------------------------------------------------------------------ memory


INTRINSICS: dict[str, Any] = {}
"""Intrinsic of each function of :mod:`strapdown.kernels.lane_values`, by name."""


def _instead_of(function: Callable[..., Any], typed: Callable[..., Any]) -> Callable[..., Any]:
    """Register the decorated function as the intrinsic for a function of :mod:`strapdown.kernels.lane_values`.

    ``typed`` returns numba's signature for the types of the arguments. The decorated function is called with numba's target, LLVM's
    builder, that signature and the values; it emits the instructions and returns the result, if any.
    """

    def define(write: Callable[..., Any]) -> Callable[..., Any]:
        def definition(typing: Any, *operands: Any) -> Any:
            def lower(target: Any, builder: Any, sig: Any, values: Any) -> Any:
                result = write(target, builder, sig, *values)
                return target.get_dummy_value() if result is None else result

            return typed(*operands), lower

        first = inspect.Parameter("typing", inspect.Parameter.POSITIONAL_ONLY)
        parameters = [first, *inspect.signature(function).parameters.values()]
        definition.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        INTRINSICS[function.__name__] = intrinsic(definition)
        return write

    return define


def _read(builder: Any, kind: Any, array: Any, index: Any, vector: ir.VectorType) -> Any:
    """Return the vector at ``array[index]``; ``kind`` is the array's type."""
    pointer = builder.gep(builder.extract_value(array, DATA), [index])
    instruction = builder.load(builder.bitcast(pointer, vector.as_pointer()))
    instruction.align = _BYTES[kind.dtype]  # an array starts at any multiple of its element's size
    return instruction


def _write(builder: Any, kind: Any, array: Any, index: Any, value: Any) -> None:
    pointer = builder.gep(builder.extract_value(array, DATA), [index])
    builder.store(value, builder.bitcast(pointer, value.type.as_pointer())).align = _BYTES[kind.dtype]


@_instead_of(lane_values.load, lambda array, start: Lanes(array.dtype, WIDTH)(array, types.intp))
@_instead_of(lane_values.load_like, lambda array, start, like: Lanes(array.dtype, like.count)(array, types.intp, like))
def _load(target: Any, builder: Any, sig: Any, array: Any, start: Any, like: Any = None) -> Any:
    return _read(builder, sig.args[0], array, start, _vector(sig.return_type))


@_instead_of(lane_values.store, lambda array, start, value: types.void(array, types.intp, value))
def _store(target: Any, builder: Any, sig: Any, array: Any, start: Any, value: Any) -> None:
    kind, _, lanes = sig.args
    _write(builder, kind, array, start, _converted(builder, value, lanes, Lanes(kind.dtype, lanes.count)))


@_instead_of(lane_values.prefetch, lambda array, start: types.void(array, types.intp))
def _prefetch(target: Any, builder: Any, sig: Any, array: Any, start: Any) -> None:
    place = builder.gep(builder.extract_value(array, DATA), [start])
    place = builder.bitcast(place, ir.IntType(8).as_pointer())
    function = ir.FunctionType(ir.VoidType(), [place.type, *[_INDEX] * 3])
    name = cgutils.get_or_insert_function(builder.module, function, "llvm.prefetch.p0i8")
    builder.call(name, [place, *(ir.Constant(_INDEX, k) for k in (0, 3, 1))])


def _row(builder: Any, start: Any, stride: Any, i: int, shift: int = 0) -> Any:
    along = builder.mul(stride, ir.Constant(stride.type, i))
    return builder.add(builder.add(start, along), ir.Constant(start.type, shift))


def _columns(builder: Any, rows: list[Any], count: int) -> list[Any]:
    """Return the first ``count`` columns of eight rows of four.

    Row i is joined with row i + 4, which the load instruction does, and neighbours are interleaved by half vectors. This needs fewer
    shuffles, which the processor executes on a single port, than selecting each column from all rows.
    """
    wide = [_picked(builder, rows[i], rows[i + 4], list(range(8))) for i in range(4)]
    columns = []
    for c in range(count):
        odd = c % 2
        low, high = (
            _picked(builder, a, b, [k + odd + side for k in range(0, WIDTH, 2) for side in (0, WIDTH)])
            for a, b in (wide[:2], wide[2:])
        )
        columns.append(_picked(builder, low, high, [c - odd + k for k in (0, 1, 8, 9, 4, 5, 12, 13)]))
    return columns


def _rows_of(builder: Any, columns: list[Any]) -> list[Any]:
    """Return four columns of eight as eight rows of four."""
    w, x, y, z = columns
    pairs = [
        [_picked(builder, a, b, [i for k in range(odd, WIDTH, 2) for i in (k, k + WIDTH)]) for a, b in ((w, x), (y, z))]
        for odd in (0, 1)
    ]
    rows = []
    for i in range(WIDTH):
        wx, yz = pairs[i % 2]
        place = i - i % 2
        rows.append(_picked(builder, wx, yz, [place, place + 1, place + WIDTH, place + WIDTH + 1]))
    return rows


def _several(array: Any, count: int) -> Any:
    return types.UniTuple(Lanes(array.dtype, WIDTH), count)


@_instead_of(lane_values.load_triples, lambda array, *places: _several(array, 3)(array, types.intp, types.intp))
@_instead_of(lane_values.load_quadruples, lambda array, *places: _several(array, 4)(array, types.intp, types.intp))
def _load_rows(target: Any, builder: Any, sig: Any, array: Any, start: Any, stride: Any) -> Any:
    """Load rows of four; of triples the last from one element before it, so that none ends outside the array."""
    kind, count = sig.args[0], len(sig.return_type)
    four = ir.VectorType(_ELEMENTS[kind.dtype], 4)
    shifts = [*[0] * (WIDTH - 1), count - 4]
    rows = [_read(builder, kind, array, _row(builder, start, stride, i, shifts[i]), four) for i in range(WIDTH)]
    if count == 3:
        rows[-1] = _picked(builder, rows[-1], rows[-1], [1, 2, 3, 3])
    return target.make_tuple(builder, sig.return_type, _columns(builder, rows, count))


@_instead_of(
    lane_values.store_quadruples,
    lambda array, start, stride, q: types.void(array, types.intp, types.intp, _several(array, 4)),
)
def _store_rows(target: Any, builder: Any, sig: Any, array: Any, start: Any, stride: Any, q: Any) -> None:
    for i, row in enumerate(_rows_of(builder, cgutils.unpack_tuple(builder, q))):
        _write(builder, sig.args[0], array, _row(builder, start, stride, i), row)


# ------------------------------------------------------------------------------------------------ making, precision, sums


def _like(dtype: types.Type, pattern: Any) -> Any:
    """Return ``dtype`` in as many lanes as ``pattern`` has, a scalar beside a scalar."""
    return Lanes(dtype, pattern.count) if isinstance(pattern, Lanes) else dtype


def _converted(builder: Any, value: Any, source: Any, target: Any) -> Any:
    """Return floats (lanes or scalar) in another precision."""
    if source == target:
        return value
    kind = _vector(target) if isinstance(target, Lanes) else _ELEMENTS[target]
    narrower = getattr(target, "dtype", target) == types.float32
    return (builder.fptrunc if narrower else builder.fpext)(value, kind)


@_instead_of(lane_values.lanes_of, lambda pattern: Lanes(pattern.dtype, pattern.count)(pattern))
def _lanes_of(target: Any, builder: Any, sig: Any, pattern: Any) -> Any:
    _align_stack(builder)
    return ir.Constant(_vector(sig.return_type), [0.0] * sig.return_type.count)


def _align_stack(builder: Any) -> None:
    """Align the stack to cache lines: spilled vectors that cross two lines cost more than the arithmetic.

    A stack frame has the strictest alignment of its variables, so an aligned one is made, once in a function; an empty inline assembly
    keeps it.
    """
    if hasattr(builder.function, "stack_is_aligned"):
        return
    builder.function.stack_is_aligned = True
    place = cgutils.alloca_once(builder, ir.ArrayType(ir.IntType(8), 64))
    place.align = 64
    builder.asm(ir.FunctionType(ir.VoidType(), [place.type]), "", "r", [place], side_effect=True)


@_instead_of(lane_values.broadcast, lambda x: Lanes(x, WIDTH)(x))
def _spread_over_lanes(target: Any, builder: Any, sig: Any, x: Any) -> Any:
    return _spread(builder, x, _vector(sig.return_type))


@_instead_of(lane_values.with_lane, lambda x, place, value: x(x, types.intp, x.dtype))
def _with_lane(target: Any, builder: Any, sig: Any, x: Any, place: Any, value: Any) -> Any:
    return builder.insert_element(x, value, place)


@_instead_of(lane_values.narrowed, lambda x, like: _like(getattr(like, "dtype", like), x)(x, like))
def _narrowed(target: Any, builder: Any, sig: Any, x: Any, like: Any) -> Any:
    return _converted(builder, x, sig.args[0], sig.return_type)


@_instead_of(lane_values.sum_lanes, lambda x: x.dtype(x))
def _total(target: Any, builder: Any, sig: Any, value: Any) -> Any:
    """Add the upper half to the lower until one is left."""
    n = sig.args[0].count
    while n > 1:
        n //= 2
        value = builder.fadd(*(_picked(builder, value, value, list(range(k, k + n))) for k in (0, n)))
    return builder.extract_element(value, ir.Constant(_INDEX, 0))


# ------------------------------------------------------------------------------------------------ bits


def _reread(wide: types.Type, narrow: types.Type) -> Callable[..., Any]:
    """Return the signature of reading the same bits as ``wide``, those of 32 bits as ``narrow``."""
    return lambda x: _like(narrow if _BYTES[getattr(x, "dtype", x)] == _BYTES[narrow] else wide, x)(x)


@_instead_of(lane_values.bits_of, _reread(types.uint64, types.uint32))
@_instead_of(lane_values.number_of_bits, _reread(types.float64, types.float32))
def _same_bits(target: Any, builder: Any, sig: Any, x: Any) -> Any:
    return builder.bitcast(x, target.get_value_type(sig.return_type))


@_instead_of(lane_values.halves, lambda a, b: types.UniTuple(Lanes(types.uint32, 2 * a.count), 2)(a, b))
def _halves(target: Any, builder: Any, sig: Any, a: Any, b: Any) -> Any:
    half = sig.return_type.dtype
    first, second = (builder.bitcast(word, _vector(half)) for word in (a, b))
    lower_first = (0, 1) if sys.byteorder == "little" else (1, 0)
    places = [list(range(begin, 2 * half.count, 2)) for begin in lower_first]
    return target.make_tuple(builder, sig.return_type, [_picked(builder, first, second, k) for k in places])


@_instead_of(lane_values.leading_zeros, lambda word: word(word))
def _leading_zeros(target: Any, builder: Any, sig: Any, word: Any) -> Any:
    bit = ir.IntType(1)
    function = ir.FunctionType(word.type, [word.type, bit])
    name = f"llvm.ctlz.v{word.type.count}i{word.type.element.width}"
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), [word, ir.Constant(bit, 0)])


@_instead_of(lane_values.signed_number, lambda word: Lanes(types.float32, word.count)(word))
def _signed_number(target: Any, builder: Any, sig: Any, word: Any) -> Any:
    return builder.sitofp(word, _vector(sig.return_type))


# ------------------------------------------------------------------------------------------------ conditions


def _bits(builder: Any, mask: Any) -> Any:
    """Return a condition over lanes as a whole number, a bit a lane."""
    return builder.bitcast(mask, ir.IntType(mask.type.count))


@_instead_of(lane_values.all_lanes, types.boolean)
def _all_lanes(target: Any, builder: Any, sig: Any, condition: Any) -> Any:
    if not isinstance(sig.args[0], Lanes):
        return condition
    bits = _bits(builder, condition)
    return builder.icmp_unsigned("==", bits, ir.Constant(bits.type, (1 << bits.type.width) - 1))


@_instead_of(lane_values.any_lane, types.boolean)
def _any_lane(target: Any, builder: Any, sig: Any, condition: Any) -> Any:
    if not isinstance(sig.args[0], Lanes):
        return condition
    bits = _bits(builder, condition)
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@_instead_of(lane_values.number_where, types.int64)
def _number_where(target: Any, builder: Any, sig: Any, condition: Any) -> Any:
    return builder.zext(builder.ctpop(_bits(builder, condition)), ir.IntType(64))


def _select_type(condition: Any, a: Any, b: Any) -> Any:
    lanes = _lanes_among(tuple(t for t in (a, b) if isinstance(t, Lanes)))
    result = lanes or cpu_target.typing_context.unify_types(a, b)
    return result(condition, result, result)


@_instead_of(lane_values.select, _select_type)
def _select(target: Any, builder: Any, sig: Any, condition: Any, *values: Any) -> Any:
    result = sig.return_type
    if isinstance(result, Lanes) and isinstance(result.dtype, types.Float):
        # Without this LLVM may move a final operation common to both values behind the selection, where it no longer fuses with a product:
        # the bits of a run would depend on its neighbours.
        values = tuple(_fenced(builder, value) for value in values)
    return builder.select(condition, *values)


def _fenced(builder: Any, value: Any) -> Any:
    """Return a value across which no operation is moved."""
    kind = value.type
    name = f"llvm.arithmetic.fence.v{kind.count}{'f64' if isinstance(kind.element, ir.DoubleType) else 'f32'}"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind]), name)
    return builder.call(function, [value])
