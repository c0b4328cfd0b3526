"""The SIMD vector behind :mod:`strapdown.kernels.lane_values`: a numba type for eight (or any power of two) scalars (lanes) in one value.

``Lanes(float64, 8)`` is LLVM's ``<8 x double>``. Arithmetic, comparisons and square roots act lane by lane, and each lane is rounded like a
scalar; a float or integer combined with lanes is copied to all of them. LLVM splits the vector to the width of the machine, down to single
scalars, so a machine without vectors needs no other code, and the bits of a lane are the same on every machine with fused multiply-add.
"""

from __future__ import annotations

import math
import operator
import platform
import sys
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

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
    found = {a for a in arguments if isinstance(a, Lanes)}
    others = [a for a in arguments if not isinstance(a, Lanes)]
    return found.pop() if len(found) == 1 and all(map(_is_number, others)) else None


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


# ------------------------------------------------------------------------------------------------ memory and choice


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: ir.VectorType) -> Any:
    data = builder.extract_value(array, DATA)
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _read(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: ir.VectorType) -> Any:
    instruction = builder.load(_pointer(context, builder, array_type, array, index, vector))
    instruction.align = _BYTES[array_type.dtype]  # an array starts at any multiple of its element's size
    return instruction


def _write(context: Any, builder: Any, array_type: Any, array: Any, index: Any, value: Any) -> None:
    builder.store(value, _pointer(context, builder, array_type, array, index, value.type)).align = _BYTES[
        array_type.dtype
    ]


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


def _tuple_of(dtype: types.Type, count: int) -> Any:
    return types.UniTuple(Lanes(dtype, WIDTH), count)


@intrinsic  # type: ignore[untyped-decorator]
def load(typingctx: Any, array: Any, start: Any) -> Any:
    """Lower :func:`lane_values.load`."""
    lanes = Lanes(array.dtype, WIDTH)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data, first = arguments
        return _read(context, builder, array, data, first, _vector(lanes))

    return lanes(array, types.intp), lower


@intrinsic  # type: ignore[untyped-decorator]
def fetch(typingctx: Any, array: Any, start: Any) -> Any:
    """Lower :func:`lane_values.fetch`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data = builder.gep(builder.extract_value(arguments[0], DATA), [arguments[1]])
        place = builder.bitcast(data, ir.IntType(8).as_pointer())
        function = ir.FunctionType(ir.VoidType(), [place.type, *[_INDEX] * 3])
        name = cgutils.get_or_insert_function(builder.module, function, "llvm.prefetch.p0i8")
        builder.call(name, [place, *(ir.Constant(_INDEX, k) for k in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, types.intp), lower


@intrinsic  # type: ignore[untyped-decorator]
def load_triples(typingctx: Any, array: Any, start: Any, stride: Any) -> Any:
    """Lower :func:`lane_values.load_triples`: rows of four, the last from one element before it, so that none ends outside the array."""
    result = _tuple_of(array.dtype, 3)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data, first, step = arguments
        four = ir.VectorType(_ELEMENTS[array.dtype], 4)
        rows = [
            _read(context, builder, array, data, _row(builder, first, step, i, 0 if i < WIDTH - 1 else -1), four)
            for i in range(WIDTH)
        ]
        rows[-1] = _picked(builder, rows[-1], rows[-1], [1, 2, 3, 3])
        return context.make_tuple(builder, result, _columns(builder, rows, 3))

    return result(array, types.intp, types.intp), lower


@intrinsic  # type: ignore[untyped-decorator]
def load_quadruples(typingctx: Any, array: Any, start: Any, stride: Any) -> Any:
    """Lower :func:`lane_values.load_quadruples`."""
    result = _tuple_of(array.dtype, 4)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data, first, step = arguments
        four = ir.VectorType(_ELEMENTS[array.dtype], 4)
        rows = [_read(context, builder, array, data, _row(builder, first, step, i), four) for i in range(WIDTH)]
        return context.make_tuple(builder, result, _columns(builder, rows, 4))

    return result(array, types.intp, types.intp), lower


@intrinsic  # type: ignore[untyped-decorator]
def store(typingctx: Any, array: Any, start: Any, value: Any) -> Any:
    """Lower :func:`lane_values.store`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        _write(context, builder, array, *arguments)
        return context.get_dummy_value()

    return types.void(array, types.intp, Lanes(array.dtype, WIDTH)), lower


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


@intrinsic  # type: ignore[untyped-decorator]
def store_quadruples(typingctx: Any, array: Any, start: Any, stride: Any, q: Any) -> Any:
    """Lower :func:`lane_values.store_quadruples`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data, first, step, packed = arguments
        for i, row in enumerate(_rows_of(builder, cgutils.unpack_tuple(builder, packed))):
            _write(context, builder, array, data, _row(builder, first, step, i), row)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, _tuple_of(array.dtype, 4)), lower


def _converted(builder: Any, value: Any, source: Any, target: Any) -> Any:
    """Return floats (lanes or scalar) in another precision."""
    if source == target:
        return value
    kind = _vector(target) if isinstance(target, Lanes) else _ELEMENTS[target]
    narrower = getattr(target, "dtype", target) == types.float32
    return (builder.fptrunc if narrower else builder.fpext)(value, kind)


def _like(dtype: types.Type, pattern: Any) -> Any:
    """Return ``dtype`` in as many lanes as ``pattern`` has, a scalar beside a scalar."""
    return Lanes(dtype, pattern.count) if isinstance(pattern, Lanes) else dtype


def _align_stack(builder: Any) -> None:
    """Align the stack to cache lines: spilled vectors that cross two lines cost more than the arithmetic.

    A stack frame has the strictest alignment of its variables, so an aligned one is made; an empty inline assembly keeps it.
    """
    place = cgutils.alloca_once(builder, ir.ArrayType(ir.IntType(8), 64))
    place.align = 64
    builder.asm(ir.FunctionType(ir.VoidType(), [place.type]), "", "r", [place], side_effect=True)


@intrinsic  # type: ignore[untyped-decorator]
def lanes_of(typingctx: Any, pattern: Any) -> Any:
    """Lower :func:`lane_values.lanes_of`."""
    lanes = Lanes(pattern.dtype, pattern.count)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        _align_stack(builder)
        return ir.Constant(_vector(lanes), [0.0] * lanes.count)

    return lanes(pattern), lower


_TO_ZERO = 0x8040
"""Bits of the x86 control word: results and operands below the smallest normal number are zero."""


def _control(builder: Any, instruction: str, place: Any) -> None:
    pointer = ir.IntType(8).as_pointer()
    function = ir.FunctionType(ir.VoidType(), [pointer])
    name = f"llvm.x86.sse.{instruction}"
    builder.call(cgutils.get_or_insert_function(builder.module, function, name), [builder.bitcast(place, pointer)])


@intrinsic  # type: ignore[untyped-decorator]
def flush_tiny(typingctx: Any, like: Any) -> Any:
    """Lower :func:`lane_values.flush_tiny`; on x86 only."""
    wanted = like.dtype == types.float32 and platform.machine() in ("x86_64", "AMD64")

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        if not wanted:
            return context.get_constant(types.int32, 0)
        place = cgutils.alloca_once(builder, ir.IntType(32))
        _control(builder, "stmxcsr", place)
        mode = builder.load(place)
        builder.store(builder.or_(mode, ir.Constant(mode.type, _TO_ZERO)), place)
        _control(builder, "ldmxcsr", place)
        return mode

    return types.int32(like), lower


@intrinsic  # type: ignore[untyped-decorator]
def restore_mode(typingctx: Any, mode: Any) -> Any:
    """Lower :func:`lane_values.restore_mode`; a mode of 0 was never read."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        if platform.machine() in ("x86_64", "AMD64"):
            before = arguments[0]
            with builder.if_then(builder.icmp_unsigned("!=", before, ir.Constant(before.type, 0))):
                place = cgutils.alloca_once(builder, ir.IntType(32))
                builder.store(before, place)
                _control(builder, "ldmxcsr", place)
        return context.get_dummy_value()

    return types.void(types.int32), lower


@intrinsic  # type: ignore[untyped-decorator]
def load_like(typingctx: Any, array: Any, start: Any, like: Any) -> Any:
    """Lower :func:`lane_values.load_like`."""
    lanes = Lanes(array.dtype, like.count)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return _read(context, builder, array, arguments[0], arguments[1], _vector(lanes))

    return lanes(array, types.intp, like), lower


@intrinsic  # type: ignore[untyped-decorator]
def element(typingctx: Any, array: Any, place: Any) -> Any:
    """Lower :func:`lane_values.element`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data = builder.extract_value(arguments[0], DATA)
        return builder.load(builder.gep(data, [arguments[1]]))

    return array.dtype(array, types.intp), lower


@intrinsic  # type: ignore[untyped-decorator]
def store_like(typingctx: Any, array: Any, start: Any, value: Any) -> Any:
    """Lower :func:`lane_values.store_like`."""
    target = Lanes(array.dtype, value.count)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data, first, lanes = arguments
        _write(context, builder, array, data, first, _converted(builder, lanes, value, target))
        return context.get_dummy_value()

    return types.void(array, types.intp, value), lower


@intrinsic  # type: ignore[untyped-decorator]
def narrowed(typingctx: Any, x: Any, like: Any) -> Any:
    """Lower :func:`lane_values.narrowed`."""
    result = _like(like.dtype if isinstance(like, Lanes) else like, x)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return _converted(builder, arguments[0], x, result)

    return result(x, like), lower


@intrinsic  # type: ignore[untyped-decorator]
def total(typingctx: Any, x: Any) -> Any:
    """Lower :func:`lane_values.total`: the upper half is added to the lower until one is left."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value = arguments[0]
        n = x.count
        while n > 1:
            n //= 2
            value = builder.fadd(*(_picked(builder, value, value, list(range(k, k + n))) for k in (0, n)))
        return builder.extract_element(value, ir.Constant(_INDEX, 0))

    return x.dtype(x), lower


@intrinsic  # type: ignore[untyped-decorator]
def number_where(typingctx: Any, condition: Any) -> Any:
    """Lower :func:`lane_values.number_where`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(condition.count))
        return builder.zext(builder.ctpop(bits), ir.IntType(64))

    return types.int64(condition), lower


def _reinterpreted(wide: types.Type, narrow: types.Type) -> Callable[..., Any]:
    """Return the lowering that reads the same bits as ``wide``, those of 32 bits as ``narrow``."""

    def reinterpret(typingctx: Any, x: Any) -> Any:
        result = _like(narrow if _BYTES[getattr(x, "dtype", x)] == _BYTES[narrow] else wide, x)

        def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], context.get_value_type(result))

        return result(x), lower

    return reinterpret


bits_of = intrinsic(_reinterpreted(types.uint64, types.uint32))
number_of_bits = intrinsic(_reinterpreted(types.float64, types.float32))


@intrinsic  # type: ignore[untyped-decorator]
def halves(typingctx: Any, a: Any, b: Any) -> Any:
    """Lower :func:`lane_values.halves`."""
    half = Lanes(types.uint32, 2 * a.count)
    result = types.UniTuple(half, 2)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        first, second = (builder.bitcast(word, _vector(half)) for word in arguments)
        lower_first = (0, 1) if sys.byteorder == "little" else (1, 0)
        places = [list(range(begin, 2 * half.count, 2)) for begin in lower_first]
        return context.make_tuple(builder, result, [_picked(builder, first, second, k) for k in places])

    return result(a, b), lower


@intrinsic  # type: ignore[untyped-decorator]
def leading_zeros(typingctx: Any, word: Any) -> Any:
    """Lower :func:`lane_values.leading_zeros`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        (value,), bit = arguments, ir.IntType(1)
        function = ir.FunctionType(value.type, [value.type, bit])
        name = f"llvm.ctlz.v{word.count}i{8 * _BYTES[word.dtype]}"
        return builder.call(
            cgutils.get_or_insert_function(builder.module, function, name), [value, ir.Constant(bit, 0)]
        )

    return word(word), lower


@intrinsic  # type: ignore[untyped-decorator]
def signed_number(typingctx: Any, word: Any) -> Any:
    """Lower :func:`lane_values.signed_number`."""
    result = Lanes(types.float32, word.count)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.sitofp(arguments[0], _vector(result))

    return result(word), lower


@intrinsic  # type: ignore[untyped-decorator]
def spread(typingctx: Any, x: Any) -> Any:
    """Lower :func:`lane_values.spread`."""
    lanes = Lanes(x, WIDTH)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return _spread(builder, arguments[0], _vector(lanes))

    return lanes(x), lower


def _counted(nature: str) -> Callable[..., Any]:
    """Return the lowering of a condition over lanes to one bit; a plain condition stays as it is."""

    def decide(typingctx: Any, condition: Any) -> Any:
        def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
            mask = arguments[0]
            if not isinstance(condition, Lanes):
                return mask
            bits = builder.bitcast(mask, ir.IntType(condition.count))
            if nature == "every":
                return builder.icmp_unsigned("==", bits, ir.Constant(bits.type, (1 << condition.count) - 1))
            return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

        return types.boolean(condition), lower

    return decide


everywhere = intrinsic(_counted("every"))
anywhere = intrinsic(_counted("any"))


@intrinsic  # type: ignore[untyped-decorator]
def chosen(typingctx: Any, condition: Any, a: Any, b: Any) -> Any:
    """Lower :func:`lane_values.chosen`."""
    result = _lanes_among(tuple(t for t in (a, b) if isinstance(t, Lanes))) or typingctx.unify_types(a, b)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        condition, *values = arguments
        if isinstance(result, Lanes) and isinstance(result.dtype, types.Float):
            # Else LLVM takes an operation that both values end in after the choice, and a product that was to fuse with it is rounded by
            # itself: a run's bits would depend on its neighbours.
            values = [_fenced(builder, value) for value in values]
        return builder.select(condition, *values)

    return result(condition, result, result), lower


def _fenced(builder: Any, value: Any) -> Any:
    """Return a value across which no operation is moved."""
    kind = value.type
    name = f"llvm.arithmetic.fence.v{kind.count}{'f64' if isinstance(kind.element, ir.DoubleType) else 'f32'}"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind]), name)
    return builder.call(function, [value])


INTRINSICS = {
    f.__name__: f
    for f in (
        load,
        fetch,
        load_triples,
        load_quadruples,
        store,
        store_quadruples,
        lanes_of,
        flush_tiny,
        restore_mode,
        load_like,
        element,
        store_like,
        narrowed,
        total,
        number_where,
        spread,
        chosen,
        halves,
        leading_zeros,
        signed_number,
    )
} | {"everywhere": everywhere, "anywhere": anywhere, "bits_of": bits_of, "number_of_bits": number_of_bits}
"""What stands for each function of :mod:`strapdown.kernels.lane_values` in compiled code."""
