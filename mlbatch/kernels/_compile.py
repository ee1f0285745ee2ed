"""A kernel's Python source to object code, by numba; imported only where none is kept."""

from __future__ import annotations

import importlib

import llvmlite.binding as llvm
import numba
from numba import types

from mlbatch.kernels.native import Constant, machine

_SIGNATURE = (types.CPointer(types.int64),)


def compiled(source: str, constants: tuple[Constant, ...]) -> tuple[str, bytes]:
    """Symbol and object code of the function that `build(*constants)` of a module makes."""
    function = importlib.import_module(source).build(*constants)
    made = numba.njit(types.int64(*_SIGNATURE), error_model="numpy")(function)
    result = made.overloads[_SIGNATURE]
    # What is left of numba's own entry points would ask for its runtime.
    module = llvm.parse_assembly(result.library.get_llvm_str())
    symbol = result.fndesc.mangled_name
    return symbol, bytes(machine().emit_object(module))
