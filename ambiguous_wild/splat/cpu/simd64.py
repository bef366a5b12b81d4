"""Eight float64 lanes as one Numba value: projection and its gradient take eight Gaussians at a time.

`F64x8` lowers to LLVM's ``<8 x double>``, as `F32x16` of `simd.py` does to floats. A product may be fused
into a sum; nothing else is reordered, so results repeat bit for bit. Arrays hold float32: `load` widens,
`store` rounds. Functions of `simd.py` with the same name take the other type.
"""

from __future__ import annotations

import math
import operator
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model
from numba.np.arrayobj import make_array

from ambiguous_wild.splat.cpu.compile import intrinsic

LANES = 8
_F64 = ir.DoubleType()
_I64 = ir.IntType(64)
_VECTOR = ir.VectorType(_F64, LANES)
_NARROW = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(_I64, LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_FUSED = ("contract",)


class F64x8(types.Type):
    """Numba type of eight float64 lanes."""

    def __init__(self) -> None:
        super().__init__(name="F64x8")


class Mask8(types.Type):
    """Numba type of eight truth values."""

    def __init__(self) -> None:
        super().__init__(name="Mask8")


f64x8 = F64x8()
mask8 = Mask8()


@register_model(F64x8)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


@register_model(Mask8)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _BITS)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [float(value)] * LANES)


def _int_constant(value: int) -> ir.Constant:
    return ir.Constant(_INTS, [value] * LANES)


def _as_vector(builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, F64x8):
        return value
    if value.type != _F64:
        value = builder.fpext(value, _F64)
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, zeros)


def _operator(op: Any, emit: Any, result: Any) -> None:
    pairs: list[tuple[Any, Any]] = [(f64x8, f64x8), (f64x8, types.float64), (types.float64, f64x8)]

    @infer_global(op)
    class _Template(ConcreteTemplate):
        cases = [signature(result, a, b) for a, b in pairs]  # noqa: RUF012

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        left, right = (_as_vector(builder, kind, value) for kind, value in zip(sig.args, args))
        return emit(builder, left, right)

    for a, b in pairs:
        lower_builtin(op, a, b)(lower)


_operator(operator.add, lambda b, x, y: b.fadd(x, y, flags=_FUSED), f64x8)
_operator(operator.sub, lambda b, x, y: b.fsub(x, y, flags=_FUSED), f64x8)
_operator(operator.mul, lambda b, x, y: b.fmul(x, y, flags=_FUSED), f64x8)
_operator(operator.truediv, lambda b, x, y: b.fdiv(x, y), f64x8)
_operator(operator.ge, lambda b, x, y: b.fcmp_ordered(">=", x, y), mask8)
_operator(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), mask8)
_operator(operator.le, lambda b, x, y: b.fcmp_ordered("<=", x, y), mask8)
_operator(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), mask8)


@infer_global(operator.and_)
class _AndTemplate(ConcreteTemplate):
    cases = [signature(mask8, mask8, mask8)]  # noqa: RUF012


@lower_builtin(operator.and_, mask8, mask8)
def _lower_and(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.and_(*args)


@intrinsic
def select(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Lane by lane `yes` where the mask is set, else `no`; scalars are broadcast."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [_as_vector(builder, kind, value) for kind, value in zip(sig.args[1:], args[1:])]
        return builder.select(args[0], *values)

    return f64x8(mask, yes, no), codegen


@intrinsic
def bits_of(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane i as bit i."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _I64)

    return types.int64(mask), codegen


def _bound(predicate: str) -> Any:
    def typer(typingctx: Any, value: Any, limit: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            a, b = (_as_vector(builder, kind, value) for kind, value in zip(sig.args, args))
            return builder.select(builder.fcmp_ordered(predicate, a, b), b, a)

        return f64x8(value, limit), codegen

    return typer


# The value, or the limit where it is beyond; NaN stays NaN.
at_most = intrinsic(_bound(">"))
at_least = intrinsic(_bound("<"))


def _function(builder: Any, name: str, count: int) -> Any:
    name = f"llvm.{name}.v{LANES}f64"
    function = builder.module.globals.get(name)
    if function is None:
        function = ir.Function(builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * count), name)
    return function


def _unary(name: str) -> Any:
    def typer(typingctx: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return builder.call(_function(builder, name, 1), args)

        return f64x8(value), codegen

    return typer


square_root = intrinsic(_unary("sqrt"))
magnitude = intrinsic(_unary("fabs"))
ceiling = intrinsic(_unary("ceil"))
floor = intrinsic(_unary("floor"))


def _polynomial(builder: Any, x: Any, coefficients: list[float]) -> Any:
    """c0 + c1 x + ... by Horner's rule."""
    result = _constant(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = builder.call(_function(builder, "fmuladd", 3), [result, x, _constant(coefficient)])
    return result


_LN2 = math.log(2.0)
_LN2_HIGH = float.fromhex("0x1.62e42feep-1")  # its products with whole numbers below 2^20 are exact
_LN2_LOW = 1.9082149292705877e-10
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to an integer kept in the low bits


@intrinsic
def exp(typingctx: Any, value: Any) -> Any:
    """e^value to 2 units of the last place; beyond 708 either way that of 708, NaN stays NaN."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = args[0]
        for predicate, limit in ((">", 708.0), ("<", -708.0)):
            beyond = builder.fcmp_ordered(predicate, x, _constant(limit))
            x = builder.select(beyond, _constant(limit), x)
        fma = _function(builder, "fmuladd", 3)
        shifted = builder.call(fma, [x, _constant(1.0 / _LN2), _constant(_ROUND)])
        whole = builder.fsub(shifted, _constant(_ROUND))
        rest = builder.call(fma, [whole, _constant(-_LN2_HIGH), x])
        rest = builder.call(fma, [whole, _constant(-_LN2_LOW), rest])
        # |rest| <= 0.347: the first term left out is 2e-16
        power = _polynomial(builder, rest, [1.0 / math.factorial(k) for k in range(13)])
        exponent = builder.shl(builder.bitcast(shifted, _INTS), _int_constant(52))
        scaled = builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), _VECTOR)
        return builder.select(builder.fcmp_unordered("uno", x, x), x, scaled)

    return f64x8(value), codegen


@intrinsic
def log(typingctx: Any, value: Any) -> Any:
    """Natural logarithm of normal positive numbers, to 2 units of the last place; of others, any number."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _INTS)
        half_root = _int_constant(0x3FE6A09E667F3BCD)  # sqrt(1/2): what remains lies in [sqrt(1/2), sqrt(2))
        exponent = builder.ashr(builder.sub(bits, half_root), _int_constant(52))
        rest = builder.bitcast(builder.sub(bits, builder.shl(exponent, _int_constant(52))), _VECTOR)
        f = builder.fdiv(builder.fsub(rest, _constant(1.0)), builder.fadd(rest, _constant(1.0)))
        # log((1 + f) / (1 - f)) = 2 f (1 + f^2 / 3 + f^4 / 5 + ...), |f| <= 0.172
        series = _polynomial(builder, builder.fmul(f, f), [2.0 / (2 * k + 1) for k in range(11)])
        whole = builder.sitofp(exponent, _VECTOR)
        return builder.call(
            _function(builder, "fmuladd", 3), [whole, _constant(_LN2), builder.fmul(f, series)]
        )

    return f64x8(value), codegen


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _NARROW.as_pointer())


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """Eight values of a contiguous float32 array from a flat element index; bounds are the caller's."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        narrow = builder.load(_pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        return builder.fpext(narrow, _VECTOR)

    return f64x8(array, types.intp), codegen


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write eight values, rounded to float32, to a contiguous array from a flat element index."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        narrow = builder.fptrunc(args[2], _NARROW)
        builder.store(narrow, _pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, f64x8), codegen
