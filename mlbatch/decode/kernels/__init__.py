"""Compiled loops for what numpy does in many passes: the engine `numba`.

Kernels are short functions over plain memory (`_*_source.py`). numba compiles them once; their
object code is kept and loaded by llvmlite alone (`native.py`), since importing numba costs every
run more than short recordings take.
"""

from __future__ import annotations

import importlib.util
import os

from mlbatch.errors import UsageError

ENGINES = ("auto", "numpy", "numba")
# From here on `auto` takes the kernels: loading them costs 0.05 s of CPU, as much as they save on
# a tenth of this; the run that compiles them first (once) is to lose no more than some seconds.
AUTO_BYTES = 64 << 20
# The least that numba can compile.
_PROBE = "mlbatch.decode.kernels._probe_source"


def is_installed() -> bool:
    """Whether numba can be imported and used; nothing is loaded for the answer."""
    # Told to compile nothing, numba has no code to give. On Windows, functions with more than a
    # page of scratch call one of the compiler's runtime, which nothing here can name.
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0") or os.name == "nt":
        return False
    return all(importlib.util.find_spec(name) for name in ("numba", "llvmlite"))


def choose_engine(wanted: str, size_bytes: int) -> str:
    """`numpy` or `numba`, for recordings of this size together.

    wanted: one of ENGINES. Raises UsageError where numba is wanted and is not there.
    """
    if wanted == "numpy" or (wanted == "auto" and size_bytes < AUTO_BYTES):
        return "numpy"
    trouble = _trouble(wanted)
    if not trouble:
        return "numba"
    if wanted == "auto":
        return "numpy"
    raise UsageError(
        f"--engine numba: wanted numba, {trouble}; `pip install mlbatch[fast]`, or leave the "
        "option out"
    )


def _trouble(wanted: str) -> str:
    """Why kernels cannot be used here; nothing where they can."""
    if not is_installed():
        return "which is not installed here"
    from mlbatch.decode.kernels import native

    if wanted == "auto" and native.cache_folder() is None:
        # Each run would compile, which takes longer than most recordings.
        return "no folder to keep kernels in"
    try:
        # One that is kept was compiled here, and tells as much without being loaded.
        if not native.is_kept(_PROBE):
            native.load(_PROBE)
    except ImportError as err:  # It may be too old for this numpy.
        return f"got {' '.join(str(err).split())}"
    return ""
