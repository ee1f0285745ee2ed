"""A kernel's Python source to object code, by numba; imported only where none is kept."""

from __future__ import annotations

import importlib

import llvmlite.binding as llvm
import numba
from numba import types

from mlbatch.kernels.native import MEMORY_FUNCTIONS, Constant, machine

_SIGNATURE = (types.CPointer(types.int64),)


def compiled(source: str, constants: tuple[Constant, ...]) -> tuple[str, bytes]:
    """Symbol and object code of the function that `build(*constants)` of a module makes."""
    function = importlib.import_module(source).build(*constants)
    # Without numba's own entry points, which would ask for its runtime.
    made = numba.njit(
        types.int64(*_SIGNATURE),
        error_model="numpy",
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
    )(function)
    result = made.overloads[_SIGNATURE]
    module = llvm.parse_assembly(result.library.get_llvm_str())
    symbol = result.fndesc.mangled_name
    for function in module.functions:
        # Nobody would tell where it is: the call of it would end the process.
        known = function.name.startswith("llvm.") or function.name in MEMORY_FUNCTIONS
        if function.is_declaration and not known:
            raise RuntimeError(f"kernel {source}{constants} calls {function.name}")
    return symbol, bytes(machine().emit_object(module))
