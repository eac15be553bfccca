"""Eight float32 lanes as one numba value, so that kernels say themselves what is vectorized instead of hoping
for LLVM.

Only what the rasterizer and SSIM need. Everything maps to single LLVM instructions without fast-math flags:
the same expression gives the same bits in every kernel, on which the agreement of forward and backward pass
rests.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba.core import types
from numba.core.cgutils import get_or_insert_function
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 8
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_INT32 = ir.IntType(32)


class _Lanes(types.Type):
    def __init__(self):
        super().__init__(name="float32x8")


lanes = _Lanes()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _FLOATS)


def _register(symbol, instruction: str, num_operands: int = 2) -> None:
    signature_ = signature(lanes, *[lanes] * num_operands)
    infer_global(symbol)(type(f"_{instruction}", (ConcreteTemplate,), {"cases": [signature_]}))
    lower_builtin(symbol, *[lanes] * num_operands)(
        lambda context, builder, sig, args: getattr(builder, instruction)(*args)
    )


for _symbol, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _register(_symbol, _instruction)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [float(value)] * LANES)


def _splat(builder, scalar):
    single = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), scalar, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(single, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INTS, [0] * LANES))


def _fma(builder, a, b, c):
    function = get_or_insert_function(
        builder.module, ir.FunctionType(_FLOATS, [_FLOATS] * 3), f"llvm.fmuladd.v{LANES}f32"
    )
    return builder.call(function, [a, b, c])


def _address(context, builder, array_type, array, index_type, index):
    data = context.make_array(array_type)(context, builder, array).data
    index = context.cast(builder, index, index_type, types.int64)
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


def _shuffle(builder, a, b, order: list[int]):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT32, len(order)), order))


@intrinsic
def load(typingctx, array, index):
    """Eight neighbors of a flat contiguous float32 array from `index`; no bounds check, any alignment."""

    def codegen(context, builder, sig, args):
        return builder.load(_address(context, builder, sig.args[0], args[0], sig.args[1], args[1]), align=4)

    return lanes(array, index), codegen


@intrinsic
def store(typingctx, array, index, value):
    """Write eight neighbors of a flat contiguous float32 array from `index`; no check, any alignment."""

    def codegen(context, builder, sig, args):
        builder.store(
            args[2], _address(context, builder, sig.args[0], args[0], sig.args[1], args[1]), align=4
        )
        return context.get_dummy_value()

    return types.none(array, index, value), codegen


@intrinsic
def splat(typingctx, scalar):
    """All lanes equal to one number, rounded to float32."""

    def codegen(context, builder, sig, args):
        return _splat(builder, context.cast(builder, args[0], sig.args[0], types.float32))

    return lanes(scalar), codegen


@intrinsic
def ramp(typingctx):
    """0, 1, ... 7."""

    def codegen(context, builder, sig, args):
        return ir.Constant(_FLOATS, [float(lane) for lane in range(LANES)])

    return lanes(), codegen


@intrinsic
def fma(typingctx, a, b, c):
    """a * b + c, with one rounding where the processor has it."""

    def codegen(context, builder, sig, args):
        return _fma(builder, *args)

    return lanes(a, b, c), codegen


@intrinsic
def minimum(typingctx, a, b):
    """Lane-wise minimum; b where a is NaN."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return lanes(a, b), codegen


@intrinsic
def maximum(typingctx, a, b):
    """Lane-wise maximum; b where a is NaN."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return lanes(a, b), codegen


@intrinsic
def truncate(typingctx, a):
    """Lane-wise whole number towards zero, for |a| < 2^31."""

    def codegen(context, builder, sig, args):
        return builder.sitofp(builder.fptosi(args[0], _INTS), _FLOATS)

    return lanes(a), codegen


@intrinsic
def absolute(typingctx, a):
    """Lane-wise |a|."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(args[0], _INTS)
        return builder.bitcast(builder.and_(bits, ir.Constant(_INTS, [0x7FFFFFFF] * LANES)), _FLOATS)

    return lanes(a), codegen


@intrinsic
def where_at_least(typingctx, a, b, value):
    """`value` in the lanes where a >= b, else 0 (also where a or b is NaN)."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">=", args[0], args[1]), args[2], _constant(0.0))

    return lanes(a, b, value), codegen


@intrinsic
def any_at_least(typingctx, a, b):
    """True if a >= b in any lane."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(builder.fcmp_ordered(">=", args[0], args[1]), ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(a, b), codegen


@intrinsic
def bits_at_least(typingctx, a, b):
    """int64 whose lowest bits tell in which lanes a >= b; lane 0 is the lowest."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(builder.fcmp_ordered(">=", args[0], args[1]), ir.IntType(LANES))
        return builder.zext(bits, ir.IntType(64))

    return types.int64(a, b), codegen


# 2^f on [-0.5, 0.5], highest power first: Chebyshev interpolation, relative error 1e-7.
_EXP2 = (1.33908634e-3, 9.67603192e-3, 5.55035711e-2, 2.40221075e-1, 6.93147188e-1, 1.00000008)
_ROUND = 12582912.0  # 1.5 * 2^23: adding it leaves the nearest integer in the low bits of the mantissa


@intrinsic
def exp2(typingctx, x):
    """2^x for -126 < x < 127, relative error about 2e-7; outside that range the result is meaningless."""

    def codegen(context, builder, sig, args):
        shifted = builder.fadd(args[0], _constant(_ROUND))
        fraction = builder.fsub(args[0], builder.fsub(shifted, _constant(_ROUND)))
        power = _constant(_EXP2[0])
        for coefficient in _EXP2[1:]:
            power = _fma(builder, power, fraction, _constant(coefficient))
        exponent = builder.shl(builder.bitcast(shifted, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), _FLOATS)

    return lanes(x), codegen


@intrinsic
def sums(typingctx, a, b, c, d, e, f, g, h):
    """The eight sums over lanes of eight vectors, as one vector; always added in the same order."""

    def codegen(context, builder, sig, args):
        stages = [
            ([0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15]),
            ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]),
            ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]),
        ]
        vectors = list(args)
        for low, high in stages:
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [
                builder.fadd(_shuffle(builder, p, q, low), _shuffle(builder, p, q, high)) for p, q in pairs
            ]
        return vectors[0]

    return lanes(a, b, c, d, e, f, g, h), codegen


def _reduce(builder, vector, combine):
    for width in (4, 2, 1):
        low, high = list(range(width)), list(range(width, 2 * width))
        vector = combine(_shuffle(builder, vector, vector, low), _shuffle(builder, vector, vector, high))
    return builder.extract_element(vector, ir.Constant(_INT32, 0))


@intrinsic
def store_whole(typingctx, array, index, value):
    """Write the lanes, truncated towards zero, to a flat contiguous int32 array from `index`."""

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.int64)])
        builder.store(builder.fptosi(args[2], _INTS), builder.bitcast(place, _INTS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.none(array, index, value), codegen


@intrinsic
def root(typingctx, a):
    """Lane-wise square root."""

    def codegen(context, builder, sig, args):
        function = get_or_insert_function(
            builder.module, ir.FunctionType(_FLOATS, [_FLOATS]), f"llvm.sqrt.v{LANES}f32"
        )
        return builder.call(function, args)

    return lanes(a), codegen


@intrinsic
def total(typingctx, a):
    """Sum over lanes, float32."""

    def codegen(context, builder, sig, args):
        return _reduce(builder, args[0], builder.fadd)

    return types.float32(a), codegen


@intrinsic
def largest(typingctx, a):
    """Maximum over lanes, float32."""

    def codegen(context, builder, sig, args):
        return _reduce(builder, args[0], lambda p, q: builder.select(builder.fcmp_ordered(">", p, q), p, q))

    return types.float32(a), codegen
