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
    compiled = numba.njit(
        error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(function)
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
i8_at = _pointer_to(types.int64)
f4_at = _pointer_to(types.float32)
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
i8_scratch = _scratch_of(types.int64)
f4_scratch = _scratch_of(types.float32)
u2_scratch = _scratch_of(types.uint16)


def _moved(typing_context: Any, pointer: Any, by: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.gep(args[0], [args[1]])

    return pointer(pointer, types.int64), generate


def _seen_as(element: Any) -> Callable[[Pointer], Pointer]:
    """What turns a pointer into one to elements of this type."""
    wanted = types.CPointer(element)

    def seen(typing_context: Any, pointer: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bitcast(args[0], context.get_value_type(wanted))

        return wanted(pointer), generate

    return cast(Callable[[Pointer], Pointer], intrinsic(seen))


def _bits(typing_context: Any, word: Any, shift: Any, mask: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, by, kept = (
            _in_32_bits(builder, number, kind.bitwidth)
            for number, kind in zip(args, signature.args, strict=True)
        )
        return builder.and_(builder.lshr(value, by), kept)

    return types.int32(word, shift, mask), generate


def _in_32_bits(builder: Any, number: Any, width: int) -> Any:
    if width == _NARROW.width:
        return number
    return (builder.trunc if width > _NARROW.width else builder.zext)(number, _NARROW)


def _taken_apart(typing_context: Any, pixels: Any, planes: Any, step: Any, pad: Any) -> Any:
    if not isinstance(step, types.IntegerLiteral) or not isinstance(pad, types.IntegerLiteral):
        return None
    apart, width = step.literal_value, pad.literal_value

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        part = context.get_value_type(pixels.dtype)
        source = builder.bitcast(args[0], ir.VectorType(part, apart * TOGETHER).as_pointer())
        whole = builder.load(source, align=1)
        for number in range(apart):
            chosen = [number + apart * pixel for pixel in range(TOGETHER)]
            order = ir.Constant(ir.VectorType(_NARROW, TOGETHER), chosen)
            plane = builder.shuffle_vector(whole, whole, order)
            place = builder.gep(args[1], [_NARROW(number * width)])
            builder.store(plane, builder.bitcast(place, plane.type.as_pointer()), align=1)
        return context.get_dummy_value()

    return types.void(pixels, planes, step, pad), generate


def _fetch(typing_context: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.inttoptr(args[0], ir.IntType(8).as_pointer())
        # To be read, and then used again, as data.
        numbers = [ir.Constant(_NARROW, number) for number in (0, 3, 1)]
        kind = ir.FunctionType(ir.VoidType(), [place.type, *(one.type for one in numbers)])
        name = "llvm.prefetch.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        builder.call(function, [place, *numbers])
        return context.get_dummy_value()

    return types.void(types.int64), generate


def _call_kernel(typing_context: Any, address: Any, frame: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        # numba's calling convention: places of the result and of an exception, then the arguments.
        result = cgutils.alloca_once(builder, ir.IntType(64))
        raised = cgutils.alloca_once(builder, ir.IntType(8).as_pointer())
        values = [result, raised, args[1]]
        kind = ir.FunctionType(_NARROW, [value.type for value in values])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), values)
        return builder.load(result)

    return types.int64(types.int64, frame), generate


_NARROW = ir.IntType(32)
# The pointer so many elements further on.
moved = cast(Callable[[Pointer, int], Pointer], intrinsic(_moved))
# `(word >> shift) & mask` in 32 bits: wider numbers would halve what a vector holds.
bits = cast(Callable[[int, int, int], int], intrinsic(_bits))
# Pixels that `take_apart` moves at once, and what it does: of each the first, second ... of `step`
# bytes or words goes to a plane of its own; a plane has `pad` elements. As a shuffle of a few
# registers it costs a tenth of what loads of single parts do.
TOGETHER = 16
take_apart = cast(
    Callable[[Pointer, Pointer, int, int], None], intrinsic(prefer_literal=True)(_taken_apart)
)
# What another kernel, at an address, makes of its frame.
call_kernel = cast(Callable[[int, Pointer], int], intrinsic(_call_kernel))
# Ask for the bytes around an address, which will be read soon; any address will do.
fetch = cast(Callable[[int], None], intrinsic(_fetch))
# The same place, as elements of another type, or of sixteen bytes.
as_u1, as_u4 = _seen_as(types.uint8), _seen_as(types.uint32)
as_c16 = _seen_as(types.complex128)
