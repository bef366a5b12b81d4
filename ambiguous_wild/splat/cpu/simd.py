"""Vectors as Numba values: sixteen float32 lanes, or eight float64 lanes, without relying on the vectoriser.

`f32x16` lowers to LLVM's ``<16 x float>``: one AVX-512 register, two AVX ones, four NEON ones; `f64x8` to
``<8 x double>``. Operators round like their scalar forms; of doubles a product may be fused into a sum.
Nothing else is reordered, so results repeat bit for bit. Arrays hold float32: `load8` widens and `store`
rounds. The values exist only inside of kernels.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model
from numba.np.arrayobj import make_array

from ambiguous_wild.splat.cpu.compile import intrinsic

LANES = 8  # of doubles
_F32, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_ELEMENTS = {"f32": _F32, "f64": ir.DoubleType(), "mask": ir.IntType(1)}
# 2^f on [-0.5, 0.5], least largest relative error with 2^0 exact: 9e-8 before rounding.
_EXP2 = (1.0, 0.693146977594, 0.240222420792, 0.055507337491, 0.00967151301, 0.00132647263)
_ROUND = 12582912.0  # 1.5 * 2^23: adding it rounds to an integer kept in the low bits
_LN2 = math.log(2.0)
_LN2_HIGH = float.fromhex("0x1.62e42feep-1")  # its products with whole numbers below 2^20 are exact
_LN2_LOW = 1.9082149292705877e-10
_ROUND64 = 6755399441055744.0  # 1.5 * 2^52, as `_ROUND`


class Lanes(types.Type):
    """Numba type of a vector of floats, doubles or truth values."""

    def __init__(self, kind: str, count: int) -> None:
        super().__init__(name=f"{kind}x{count}")
        self.kind, self.count = kind, count

    @property
    def vector(self) -> ir.VectorType:
        """The type in LLVM."""
        return ir.VectorType(_ELEMENTS[self.kind], self.count)


f32x16, mask16 = Lanes("f32", 16), Lanes("mask", 16)
f64x8, mask8 = Lanes("f64", LANES), Lanes("mask", LANES)
_FLOATS = {mask16: f32x16, mask8: f64x8}


@register_model(Lanes)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, fe_type.vector)


def _filled(vector: ir.VectorType, value: float) -> ir.Constant:
    return ir.Constant(vector, [value] * vector.count)


def _broadcast(builder: Any, scalar: Any, vector: ir.VectorType) -> Any:
    if scalar.type != vector.element:
        resize = builder.fptrunc if vector.element == _F32 else builder.fpext
        scalar = resize(scalar, vector.element)
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, undefined, _filled(ir.VectorType(_I32, vector.count), 0))


def _as(lanes: Lanes, builder: Any, kinds: Sequence[Any], values: Sequence[Any]) -> list[Any]:
    """Return the values as these lanes; scalars are broadcast."""
    return [
        value if isinstance(kind, Lanes) else _broadcast(builder, value, lanes.vector)
        for kind, value in zip(kinds, values)
    ]


def _call(builder: Any, name: str, result: Any, arguments: Sequence[Any]) -> Any:
    """Call a function of LLVM."""
    function = builder.module.globals.get(name)
    if function is None:
        kind = ir.FunctionType(result, [argument.type for argument in arguments])
        function = ir.Function(builder.module, kind, name)
    return builder.call(function, arguments)


def _lanewise(builder: Any, name: str, *arguments: Any) -> Any:
    """Call a function of LLVM that works lane by lane, or on a scalar."""
    kind = arguments[0].type
    count = f"v{kind.count}" if isinstance(kind, ir.VectorType) else ""
    width = "f32" if getattr(kind, "element", kind) == _F32 else "f64"
    return _call(builder, f"llvm.{name}.{count}{width}", kind, arguments)


def _operator(op: Any, emit: Any, *, compares: bool = False) -> None:
    """Register an operator of lanes with lanes, and with scalars on either side, at Numba."""
    signatures: list[tuple[Lanes, Any, Any, Any]] = []
    for mask, lanes in _FLOATS.items():
        result = mask if compares else lanes
        signatures.append((lanes, result, lanes, lanes))
        for scalar in (types.float32, types.float64) if lanes is f32x16 else (types.float64,):
            signatures += [(lanes, result, lanes, scalar), (lanes, result, scalar, lanes)]

    @infer_global(op)
    class _Template(ConcreteTemplate):
        cases = [signature(*case) for _, *case in signatures]  # noqa: RUF012

    def lowered(lanes: Lanes) -> Any:
        flags = ("contract",) if lanes is f64x8 else ()
        return lambda context, builder, sig, args: emit(builder, *_as(lanes, builder, sig.args, args), flags)

    for lanes, _, left, right in signatures:
        lower_builtin(op, left, right)(lowered(lanes))


_operator(operator.add, lambda b, x, y, flags: b.fadd(x, y, flags=flags))
_operator(operator.sub, lambda b, x, y, flags: b.fsub(x, y, flags=flags))
_operator(operator.mul, lambda b, x, y, flags: b.fmul(x, y, flags=flags))
_operator(operator.truediv, lambda b, x, y, _: b.fdiv(x, y))
for _op, _sign in ((operator.ge, ">="), (operator.gt, ">"), (operator.le, "<="), (operator.lt, "<")):
    _operator(_op, lambda b, x, y, _, sign=_sign: b.fcmp_ordered(sign, x, y), compares=True)


@infer_global(operator.and_)
class _AndTemplate(ConcreteTemplate):
    cases = [signature(mask, mask, mask) for mask in _FLOATS]  # noqa: RUF012


for _mask in _FLOATS:
    lower_builtin(operator.and_, _mask, _mask)(lambda context, builder, sig, args: builder.and_(*args))


@intrinsic
def select(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Select lane by lane `yes` where the mask is set, else `no`; scalars are broadcast."""
    lanes = _FLOATS[mask]

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(args[0], *_as(lanes, builder, sig.args[1:], args[1:]))

    return lanes(mask, yes, no), codegen


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """True if one lane of the mask is set."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = ir.IntType(mask.count)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), ir.Constant(bits, 0))

    return types.boolean(mask), codegen


@intrinsic
def bits_of(typingctx: Any, mask: Any) -> Any:
    """Return the mask as an integer, lane i as bit i."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(mask.count)), _I64)

    return types.int64(mask), codegen


def _unary(emit: Any) -> Any:
    """Make a function of one vector, lane by lane; `emit` gets LLVM's builder and the value."""

    def typer(typingctx: Any, value: Any) -> Any:
        return value(value), lambda context, builder, sig, args: emit(builder, args[0])

    typer.__name__, typer.__doc__ = emit.__name__, emit.__doc__
    return intrinsic(typer)


square_root, magnitude, ceiling, floor = (
    _unary(lambda builder, x, name=name: _lanewise(builder, name, x))
    for name in ("sqrt", "fabs", "ceil", "floor")
)


def _bound(predicate: str) -> Any:
    def typer(typingctx: Any, value: Any, limit: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            a, b = _as(value, builder, sig.args, args)
            return builder.select(builder.fcmp_ordered(predicate, a, b), b, a)

        return value(value, limit), codegen

    return intrinsic(typer)


# The value, or the limit where it is beyond; NaN stays NaN.
at_most = _bound(">")
at_least = _bound("<")


def _pointer(context: Any, builder: Any, sig: Any, args: Any, element: Any) -> Any:
    """Return a pointer into the array of the first argument, at the index of the second."""
    data = make_array(sig.args[0])(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]]), element.as_pointer())


def _integers(vector: ir.VectorType) -> ir.VectorType:
    """Return the type of integers of the same width, for bit operations."""
    return ir.VectorType(_I32 if vector.element == _F32 else _I64, vector.count)


def _load(lanes: Lanes) -> Any:
    def typer(typingctx: Any, array: Any, index: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            narrow = ir.VectorType(_F32, lanes.count)
            values = builder.load(_pointer(context, builder, sig, args, narrow), align=4)
            return values if lanes is f32x16 else builder.fpext(values, lanes.vector)

        return lanes(array, types.intp), codegen

    return intrinsic(typer)


# Load sixteen floats, or eight widened to doubles, of a contiguous float32 array from a flat element index,
# without a check of bounds.
load = _load(f32x16)
load8 = _load(f64x8)


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write all lanes, as float32, to a contiguous array from a flat element index."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        narrow = ir.VectorType(_F32, value.count)
        rounded = args[2] if value is f32x16 else builder.fptrunc(args[2], narrow)
        builder.store(rounded, _pointer(context, builder, sig, args, narrow), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line at a flat element index of a contiguous array; any index is allowed."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig, args, ir.IntType(8))
        hints = [ir.Constant(_I32, hint) for hint in (0, 3, 1)]  # to read, into every level, data
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), [pointer, *hints])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
def trailing_zeros(typingctx: Any, bits: Any) -> Any:
    """Return the number of the lowest set bit of an int64 that is not 0."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen


def _polynomial(builder: Any, x: Any, coefficients: Sequence[float]) -> Any:
    """c0 + c1 x + ... by Horner's rule."""
    result = _filled(x.type, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = _lanewise(builder, "fmuladd", result, x, _filled(x.type, coefficient))
    return result


@intrinsic
def splat(typingctx: Any, value: Any) -> Any:
    """Set all lanes to a scalar."""
    return f32x16(value), lambda context, builder, sig, args: _broadcast(builder, args[0], f32x16.vector)


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, fused where the machine can; scalars are broadcast."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _lanewise(builder, "fmuladd", *_as(f32x16, builder, sig.args, args))

    return f32x16(a, b, c), codegen


@_unary
def negated_magnitude(builder: Any, x: Any) -> Any:
    """-|value|, lane by lane."""
    return builder.fneg(_lanewise(builder, "fabs", x))


@_unary
def exp2(builder: Any, x: Any) -> Any:
    """2^value for -126 < value < 127, relative error 2e-7; outside, any number (mask it)."""
    ints, big = _integers(x.type), _filled(x.type, _ROUND)
    shifted = builder.fadd(x, big)
    result = _polynomial(builder, builder.fsub(x, builder.fsub(shifted, big)), _EXP2)
    exponent = builder.shl(builder.bitcast(shifted, ints), _filled(ints, 23))
    return builder.bitcast(builder.add(builder.bitcast(result, ints), exponent), x.type)


@intrinsic
def sum_lanes(typingctx: Any, values: Any) -> Any:
    """Sum the lanes of each of up to sixteen vectors: lane i of the result is the sum of values[i].

    A butterfly in a fixed order: 45 instructions for sixteen sums, and no lane is special.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        count = f32x16.count
        indices = ir.VectorType(_I32, count)
        rows = [builder.extract_value(args[0], i) for i in range(len(sig.args[0]))]
        rows += [_filled(f32x16.vector, 0.0)] * (count - len(rows))
        step = 1
        while len(rows) > 1:
            # After this stage lane l of the merged vector belongs to row (l // step) % 2 of the pair.
            low = [(i & ~step) + (count if i & step else 0) for i in range(count)]
            lanes = [ir.Constant(indices, at) for at in (low, [i + step for i in low])]
            rows = [
                builder.fadd(*(builder.shuffle_vector(a, b, at) for at in lanes))
                for a, b in zip(rows[0::2], rows[1::2])
            ]
            step *= 2
        return rows[0]

    return f32x16(values), codegen


def _first_lanes(builder: Any, count: Any) -> Any:
    """Return the mask of the first `count` lanes."""
    indices = ir.VectorType(_I32, f32x16.count)
    limit = _broadcast(builder, builder.trunc(count, _I32), indices)
    return builder.icmp_signed("<", ir.Constant(indices, list(range(f32x16.count))), limit)


@intrinsic
def load_some(typingctx: Any, array: Any, index: Any, count: Any) -> Any:
    """Like `load` for the first `count` lanes, the others 0 and their memory untouched."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = f32x16.vector
        pointer = _pointer(context, builder, sig, args, vector)
        arguments = [pointer, ir.Constant(_I32, 4), _first_lanes(builder, args[2]), _filled(vector, 0.0)]
        return _call(builder, "llvm.masked.load.v16f32.p0", vector, arguments)

    return f32x16(array, types.intp, types.intp), codegen


@intrinsic
def store_some(typingctx: Any, array: Any, index: Any, value: Any, count: Any) -> Any:
    """Like `store` for the first `count` lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig, args, f32x16.vector)
        arguments = [args[2], pointer, ir.Constant(_I32, 4), _first_lanes(builder, args[3])]
        _call(builder, "llvm.masked.store.v16f32.p0", ir.VoidType(), arguments)
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x16, types.intp), codegen


@_unary
def exp(builder: Any, x: Any) -> Any:
    """e^value to 2 units of the last place; values beyond +-708 count as +-708, NaN stays NaN."""
    vector, ints = x.type, _integers(x.type)
    for predicate, limit in ((">", 708.0), ("<", -708.0)):
        beyond = builder.fcmp_ordered(predicate, x, _filled(vector, limit))
        x = builder.select(beyond, _filled(vector, limit), x)
    big = _filled(vector, _ROUND64)
    shifted = _lanewise(builder, "fmuladd", x, _filled(vector, 1.0 / _LN2), big)
    whole = builder.fsub(shifted, big)
    rest = _lanewise(builder, "fmuladd", whole, _filled(vector, -_LN2_HIGH), x)
    rest = _lanewise(builder, "fmuladd", whole, _filled(vector, -_LN2_LOW), rest)
    # |rest| <= 0.347: the first term left out is 2e-16
    power = _polynomial(builder, rest, [1.0 / math.factorial(k) for k in range(13)])
    exponent = builder.shl(builder.bitcast(shifted, ints), _filled(ints, 52))
    scaled = builder.bitcast(builder.add(builder.bitcast(power, ints), exponent), vector)
    return builder.select(builder.fcmp_unordered("uno", x, x), x, scaled)


@_unary
def log(builder: Any, x: Any) -> Any:
    """Natural logarithm of normal positive numbers, to 2 units of the last place; any number for others."""
    ints, one = _integers(x.type), _filled(x.type, 1.0)
    bits = builder.bitcast(x, ints)
    half_root = _filled(ints, 0x3FE6A09E667F3BCD)  # sqrt(1/2): what remains lies in [sqrt(1/2), sqrt(2))
    exponent = builder.ashr(builder.sub(bits, half_root), _filled(ints, 52))
    rest = builder.bitcast(builder.sub(bits, builder.shl(exponent, _filled(ints, 52))), x.type)
    f = builder.fdiv(builder.fsub(rest, one), builder.fadd(rest, one))
    # log((1 + f) / (1 - f)) = 2 f (1 + f^2 / 3 + f^4 / 5 + ...), |f| <= 0.172
    series = _polynomial(builder, builder.fmul(f, f), [2.0 / (2 * k + 1) for k in range(11)])
    whole = builder.sitofp(exponent, x.type)
    return _lanewise(builder, "fmuladd", whole, _filled(x.type, _LN2), builder.fmul(f, series))
