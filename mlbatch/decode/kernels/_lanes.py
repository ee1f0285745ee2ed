"""Eight slots of a column to the rows where they belong, at once, on CPUs that can (AVX-512).

Source: the LLVM language reference, and its intrinsics for x86 (IntrinsicsX86.td): lanes of a
register are packed by a mask, and the register is stored whole; what is not wanted lies behind, and
is overwritten by what comes next.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mlbatch.decode.kernels._primitives import Pointer

LANES = 8
_BYTES, _WORDS, _REALS = (
    ir.VectorType(one, LANES) for one in (ir.IntType(8), ir.IntType(64), ir.DoubleType())
)
_BITS, _MASK, _NUMBER = ir.IntType(LANES), ir.VectorType(ir.IntType(1), LANES), ir.IntType(64)
_PAIRS, _HALF = 0x5555, LANES // 2

# `(keep, points, words, offset, out points, out words)` gives how many of the eight are wanted;
# points are of sixteen bytes; words are written with the offset added.
Packing = Callable[[Pointer, Pointer, Pointer, int, Pointer, Pointer], int]


def _packed(
    typing_context: Any, keep: Any, points: Any, words: Any, offset: Any, out: Any, told: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        keep, points, words, offset, out, told = args
        chosen = _load(builder, keep, _BYTES)
        mask = builder.icmp_unsigned("!=", chosen, ir.Constant(_BYTES, None))
        wide = builder.zext(builder.bitcast(mask, _BITS), _NUMBER)
        first = _ones(builder, builder.and_(wide, ir.Constant(_NUMBER, (1 << _HALF) - 1)))
        # A point is two lanes, so that each bit counts twice.
        pairs = builder.mul(_spread(builder, wide), ir.Constant(_NUMBER, 3))
        for begin, row in ((0, ir.Constant(_NUMBER, 0)), (_HALF, first)):
            bits = builder.lshr(pairs, ir.Constant(_NUMBER, 2 * begin))
            own = builder.bitcast(builder.trunc(bits, _BITS), _MASK)
            place = builder.gep(points, [ir.Constant(_NUMBER, begin)])
            real = _load(builder, place, _REALS)
            _store(builder, _compressed(builder, real, own), builder.gep(out, [row]))
        numbers = builder.add(_load(builder, words, _WORDS), _splat(builder, offset))
        _store(builder, _compressed(builder, numbers, mask), told)
        return _ones(builder, wide)

    signature = types.int64(keep, points, words, types.int64, out, told)
    return signature, generate


packed = cast(Packing, intrinsic(_packed))


def _load(builder: Any, place: Any, kind: Any) -> Any:
    return builder.load(builder.bitcast(place, kind.as_pointer()), align=1)


def _store(builder: Any, value: Any, place: Any) -> None:
    builder.store(value, builder.bitcast(place, value.type.as_pointer()), align=1)


def _splat(builder: Any, number: Any) -> Any:
    first = builder.insert_element(ir.Constant(_WORDS, ir.Undefined), number, _index(0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
    return builder.shuffle_vector(first, first, order)


def _index(number: int) -> Any:
    return ir.Constant(ir.IntType(32), number)


def _ones(builder: Any, number: Any) -> Any:
    return _call(builder, "llvm.ctpop.i64", _NUMBER, [number])


def _spread(builder: Any, number: Any) -> Any:
    """Every bit at twice its place."""
    pairs = ir.Constant(_NUMBER, _PAIRS)
    return _call(builder, "llvm.x86.bmi.pdep.64", _NUMBER, [number, pairs])


def _compressed(builder: Any, values: Any, mask: Any) -> Any:
    name = "v8f64" if values.type is _REALS else "v8i64"
    rest = ir.Constant(values.type, None)
    return _call(
        builder, f"llvm.x86.avx512.mask.compress.{name}", values.type, [values, rest, mask]
    )


def _call(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)
