"""What kernels are written with: plain pointers, scratch on the stack, inlined pieces.

Imported only where a kernel is compiled. Pointers are used instead of arrays, since an index of an
array may be negative, which costs a test a pixel and keeps loops from being vectorised; scratch on
the stack is memory that the compiler knows nothing else points to. No fast-math: floats are added
and multiplied in the order of the source, and rounded after each step, as numpy does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., object])
# A pointer, as checks of types see it: what lies there is read and written by number.
Pointer = list[Any]


def piece(function: Function) -> Function:
    """A part of kernels, always inlined; it may not allocate or raise."""
    compiled = numba.njit(error_model="numpy", forceinline=True)(function)
    return cast(Function, compiled)


def _pointer_to(element: Any) -> Callable[[int], Pointer]:
    """What turns an address into a pointer to elements of this type."""

    def pointer(typing_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

        return types.CPointer(element)(types.int64), generate

    return cast(Callable[[int], Pointer], intrinsic(pointer))


u1_at = _pointer_to(types.uint8)
u2_at = _pointer_to(types.uint16)
u4_at = _pointer_to(types.uint32)
i4_at = _pointer_to(types.int32)
i8_at = _pointer_to(types.int64)
f4_at = _pointer_to(types.float32)
f8_at = _pointer_to(types.float64)
# Sixteen bytes that move as one.
c16_at = _pointer_to(types.complex128)


def _scratch_of(element: Any) -> Callable[[int], Pointer]:
    """What gives scratch of so many elements, a literal number; it lives as long as the kernel."""

    def scratch(typing_context: Any, count: Any) -> Any:
        if not isinstance(count, types.IntegerLiteral):
            return None

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            held = ir.ArrayType(context.get_value_type(element), count.literal_value)
            place = cgutils.alloca_once(builder, held)
            place.align = 64
            return builder.bitcast(place, context.get_value_type(signature.return_type))

        return types.CPointer(element)(count), generate

    return cast(Callable[[int], Pointer], intrinsic(prefer_literal=True)(scratch))


u1_scratch = _scratch_of(types.uint8)
i4_scratch = _scratch_of(types.int32)
i8_scratch = _scratch_of(types.int64)
f4_scratch = _scratch_of(types.float32)
