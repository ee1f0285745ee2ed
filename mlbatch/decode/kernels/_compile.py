"""A kernel's Python source to object code, by numba; imported only where none is kept.

numba translates, without optimising anything; the passes of llvm then run over the whole. They are
told not to unroll: loops over as few as 16 beams would be unrolled before they are vectorised, and
stay a thousand operations on single numbers.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator

import llvmlite.binding as llvm
import numba
from numba import types
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

from mlbatch.decode.kernels.native import MEMORY_FUNCTIONS, Constant, machine

if not hasattr(llvm, "create_pass_builder"):
    raise ImportError(f"numba {numba.__version__}, wanted 0.62 or later")

_SIGNATURE = (types.CPointer(types.int64),)
_OPTIMISED = 3


def compiled(source: str, constants: tuple[Constant, ...]) -> tuple[str, bytes]:
    """Symbol and object code of the function that `build(*constants)` of a module makes."""
    function = importlib.import_module(source).build(*constants)
    # Without numba's own entry points, which would ask for its runtime.
    with _as_it_stands():
        made = numba.njit(
            types.int64(*_SIGNATURE),
            error_model="numpy",
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
        )(function)
    result = made.overloads[_SIGNATURE]
    module = llvm.parse_assembly(result.library.get_llvm_str())
    symbol = result.fndesc.mangled_name
    _optimise(module)
    for function in module.functions:
        # Nobody would tell where it is: the call of it would end the process.
        known = function.name.startswith("llvm.") or function.name in MEMORY_FUNCTIONS
        if function.is_declaration and not known:
            raise RuntimeError(f"kernel {source}{constants} calls {function.name}")
    return symbol, bytes(machine().emit_object(module))


@contextlib.contextmanager
def _as_it_stands() -> Iterator[None]:
    """What numba compiles meanwhile is not optimised."""
    # Made once a process, with the level that all other code is to have.
    cpu_target.target_context.codegen()
    with global_compiler_lock:
        level = numba.config.OPT
        numba.config.OPT = type(level)(0)
        try:
            yield
        finally:
            numba.config.OPT = level


def _optimise(module: llvm.ModuleRef) -> None:
    options = llvm.create_pipeline_tuning_options(speed_level=_OPTIMISED)
    options.loop_vectorization = True
    options.loop_unrolling = False
    builder = llvm.create_pass_builder(machine(), options)
    builder.getModulePassManager().run(module, builder)
