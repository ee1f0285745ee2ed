"""Compiled loops for what numpy does in many passes: the engine `native`.

C functions (`native.h`) over plain arrays, built when the package is installed
(`.ci/build_library.py`) and called through ctypes.
"""

from __future__ import annotations

import os
from pathlib import Path

from mlbatch.errors import UsageError

ENGINES = ("auto", "numpy", "native")
# Names of earlier versions.
ALIASES = {"numba": "native"}
BUILD_ADVICE = "reinstall mlbatch, which compiles it"


def library_path() -> Path | None:
    """Return the path of the compiled library; None if it was not built."""
    # Tests run other builds of the same sources.
    chosen = os.environ.get("MLBATCH_NATIVE", "")
    if chosen:
        return Path(chosen)
    path = Path(__file__).with_name("_native.so")
    return path if path.is_file() else None


def choose_engine(name: str) -> str:
    """`numpy` or `native`; name: one of ENGINES, `auto` for native where it is installed.

    Raises UsageError if native is name and cannot be loaded.
    """
    name = ALIASES.get(name, name)
    if name == "numpy":
        return name
    from mlbatch.native.library import trouble

    why = trouble()
    if not why:
        return "native"
    if name == "auto":
        return "numpy"
    raise UsageError(
        f"--engine native: expected its compiled library, found {why}; {BUILD_ADVICE}, or leave "
        "the option out"
    )
