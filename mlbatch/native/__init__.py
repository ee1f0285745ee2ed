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
    """`numpy` or `native`: what reads headers and merges columns; name: one of ENGINES.

    Points are always decoded by the compiled library: UsageError if it cannot be loaded.
    """
    from mlbatch.native.library import trouble

    why = trouble()
    if why:
        raise UsageError(f"expected the compiled library of mlbatch, found {why}; {BUILD_ADVICE}")
    return "numpy" if ALIASES.get(name, name) == "numpy" else "native"
