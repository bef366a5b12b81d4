"""Sixteen float32 lanes as one Numba value: rows of a tile are blended without relying on the vectoriser.

`F32x16` lowers to LLVM's ``<16 x float>``: one AVX-512 register, two AVX ones, four NEON ones. Operators
round like their scalar forms; nothing is reordered, so results repeat bit for bit. Inside kernels only:
the values never leave compiled code.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model
from numba.np.arrayobj import make_array

from ambiguous_wild.splat.cpu.compile import intrinsic

LANES = 16
_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_VECTOR = ir.VectorType(_F32, LANES)
_INTS = ir.VectorType(_I32, LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)


class F32x16(types.Type):
    """Numba type of sixteen float32 lanes."""

    def __init__(self) -> None:
        super().__init__(name="F32x16")


class Mask16(types.Type):
    """Numba type of sixteen truth values."""

    def __init__(self) -> None:
        super().__init__(name="Mask16")


f32x16 = F32x16()
mask16 = Mask16()


@register_model(F32x16)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


@register_model(Mask16)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _BITS)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [float(value)] * LANES)


def _int_constant(value: int) -> ir.Constant:
    return ir.Constant(_INTS, [value] * LANES)


def _broadcast(builder: Any, scalar: Any) -> Any:
    if scalar.type != _F32:
        scalar = builder.fptrunc(scalar, _F32)
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTS, [0] * LANES))


def _as_vector(builder: Any, kind: Any, value: Any) -> Any:
    return value if isinstance(kind, F32x16) else _broadcast(builder, value)


def _fmuladd(builder: Any, a: Any, b: Any, c: Any) -> Any:
    name = f"llvm.fmuladd.v{LANES}f32"
    function = builder.module.globals.get(name)
    if function is None:
        function = ir.Function(builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), name)
    return builder.call(function, [a, b, c])


def _operator(op: Any, emit: Any, result: Any) -> None:
    pairs: list[tuple[Any, Any]] = [(f32x16, f32x16)]
    for scalar in (types.float32, types.float64):
        pairs += [(f32x16, scalar), (scalar, f32x16)]

    @infer_global(op)
    class _Template(ConcreteTemplate):
        cases = [signature(result, a, b) for a, b in pairs]  # noqa: RUF012

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        left, right = (_as_vector(builder, kind, value) for kind, value in zip(sig.args, args))
        return emit(builder, left, right)

    for a, b in pairs:
        lower_builtin(op, a, b)(lower)


_operator(operator.add, lambda b, x, y: b.fadd(x, y), f32x16)
_operator(operator.sub, lambda b, x, y: b.fsub(x, y), f32x16)
_operator(operator.mul, lambda b, x, y: b.fmul(x, y), f32x16)
_operator(operator.truediv, lambda b, x, y: b.fdiv(x, y), f32x16)
_operator(operator.ge, lambda b, x, y: b.fcmp_ordered(">=", x, y), mask16)
_operator(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), mask16)
_operator(operator.le, lambda b, x, y: b.fcmp_ordered("<=", x, y), mask16)


@infer_global(operator.and_)
class _AndTemplate(ConcreteTemplate):
    cases = [signature(mask16, mask16, mask16)]  # noqa: RUF012


@lower_builtin(operator.and_, mask16, mask16)
def _lower_and(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.and_(*args)


@intrinsic
def splat(typingctx: Any, value: Any) -> Any:
    """All lanes equal to a scalar."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _broadcast(builder, args[0])

    return f32x16(value), codegen


@intrinsic
def trailing_zeros(typingctx: Any, bits: Any) -> Any:
    """Number of the lowest set bit of an int64 that is not 0."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, fused where the machine can; scalars are broadcast."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _fmuladd(builder, *(_as_vector(builder, kind, value) for kind, value in zip(sig.args, args)))

    return f32x16(a, b, c), codegen


@intrinsic
def select(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Lane by lane `yes` where the mask is set, else `no`; scalars are broadcast."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        yes_value = _as_vector(builder, sig.args[1], args[1])
        return builder.select(args[0], yes_value, _as_vector(builder, sig.args[2], args[2]))

    return f32x16(mask, yes, no), codegen


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """True if one lane of the mask is set."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), codegen


@intrinsic
def magnitude(typingctx: Any, value: Any) -> Any:
    """|value|, lane by lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _INTS)
        return builder.bitcast(builder.and_(bits, _int_constant(0x7FFFFFFF)), _VECTOR)

    return f32x16(value), codegen


@intrinsic
def negated_magnitude(typingctx: Any, value: Any) -> Any:
    """-|value|, lane by lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _INTS)
        return builder.bitcast(builder.or_(bits, _int_constant(-0x80000000)), _VECTOR)

    return f32x16(value), codegen


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """Sixteen values of a contiguous float32 array from a flat element index; bounds are the caller's."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], args[0], args[1]), align=4)

    return f32x16(array, types.intp), codegen


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write sixteen values to a contiguous float32 array from a flat element index."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x16), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line at a flat element index of a contiguous array; any index will do."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        function = _masked_function(
            builder, "llvm.prefetch.p0", ir.VoidType(), [pointer.type, _I32, _I32, _I32]
        )
        hints = [ir.Constant(_I32, hint) for hint in (0, 3, 1)]  # to read, into every level, data
        builder.call(function, [pointer, *hints])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


# 2^f on [-0.5, 0.5], least largest relative error with 2^0 exact: 9e-8 before rounding.
_EXP2 = (1.0, 0.693146977594, 0.240222420792, 0.055507337491, 0.00967151301, 0.00132647263)
_ROUND = 12582912.0  # 1.5 * 2^23: adding it rounds to an integer kept in the low bits


@intrinsic
def exp2(typingctx: Any, value: Any) -> Any:
    """2^value for -126 < value < 127, relative error 2e-7; outside, any number (mask it)."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        shifted = builder.fadd(args[0], _constant(_ROUND))
        fraction = builder.fsub(args[0], builder.fsub(shifted, _constant(_ROUND)))
        result = _constant(_EXP2[-1])
        for coefficient in reversed(_EXP2[:-1]):
            result = _fmuladd(builder, result, fraction, _constant(coefficient))
        exponent = builder.shl(builder.bitcast(shifted, _INTS), _int_constant(23))
        return builder.bitcast(builder.add(builder.bitcast(result, _INTS), exponent), _VECTOR)

    return f32x16(value), codegen


@intrinsic
def sum_lanes(typingctx: Any, values: Any) -> Any:
    """Tuple of up to sixteen vectors -> one vector: lane i holds the sum over the lanes of values[i].

    A butterfly in a fixed order: 45 instructions for sixteen sums, and no lane is special.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = [builder.extract_value(args[0], i) for i in range(len(sig.args[0]))]
        rows += [ir.Constant(_VECTOR, [0.0] * LANES)] * (LANES - len(rows))
        step = 1
        while len(rows) > 1:
            # After this stage lane l of the merged vector belongs to row (l // step) % 2 of the pair.
            low = [(i & ~step) if not i & step else LANES + (i & ~step) for i in range(LANES)]
            high = [(i | step) if not i & step else LANES + (i | step) for i in range(LANES)]
            merged = []
            for a, b in zip(rows[0::2], rows[1::2]):
                first = builder.shuffle_vector(a, b, ir.Constant(_INTS, low))
                second = builder.shuffle_vector(a, b, ir.Constant(_INTS, high))
                merged.append(builder.fadd(first, second))
            rows, step = merged, step * 2
        return rows[0]

    return f32x16(values), codegen


def _masked(builder: Any, count: Any) -> Any:
    lanes = ir.Constant(_INTS, list(range(LANES)))
    narrow = builder.trunc(count, _I32)
    first = builder.insert_element(ir.Constant(_INTS, ir.Undefined), narrow, ir.Constant(_I32, 0))
    limit = builder.shuffle_vector(first, ir.Constant(_INTS, ir.Undefined), ir.Constant(_INTS, [0] * LANES))
    return builder.icmp_signed("<", lanes, limit)


def _masked_function(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    function = builder.module.globals.get(name)
    if function is None:
        function = ir.Function(builder.module, ir.FunctionType(result, arguments), name)
    return function


@intrinsic
def load_some(typingctx: Any, array: Any, index: Any, count: Any) -> Any:
    """Like `load` for the first `count` lanes, the others 0 and their memory untouched."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1])
        function = _masked_function(
            builder, f"llvm.masked.load.v{LANES}f32.p0", _VECTOR, [pointer.type, _I32, _BITS, _VECTOR]
        )
        return builder.call(
            function, [pointer, ir.Constant(_I32, 4), _masked(builder, args[2]), _constant(0.0)]
        )

    return f32x16(array, types.intp, types.intp), codegen


@intrinsic
def store_some(typingctx: Any, array: Any, index: Any, value: Any, count: Any) -> Any:
    """Like `store` for the first `count` lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1])
        function = _masked_function(
            builder, f"llvm.masked.store.v{LANES}f32.p0", ir.VoidType(), [_VECTOR, pointer.type, _I32, _BITS]
        )
        builder.call(function, [args[2], pointer, ir.Constant(_I32, 4), _masked(builder, args[3])])
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x16, types.intp), codegen


@intrinsic
def square_root(typingctx: Any, value: Any) -> Any:
    """Correctly rounded square root, lane by lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.call(
            _masked_function(builder, f"llvm.sqrt.v{LANES}f32", _VECTOR, [_VECTOR]), [args[0]]
        )

    return f32x16(value), codegen
