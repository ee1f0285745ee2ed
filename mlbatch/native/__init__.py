"""Compiled loops over packets, columns and points.

C functions (`native.h`) over plain arrays, built when the package is installed
(`.ci/build_library.py`) and called through ctypes.
"""

from __future__ import annotations

import os
from pathlib import Path

from mlbatch.errors import UsageError

BUILD_ADVICE = "reinstall mlbatch, which compiles it"


def library_path() -> Path | None:
    """Return the path of the compiled library; None if it was not built."""
    # Tests run other builds of the same sources.
    chosen = os.environ.get("MLBATCH_NATIVE", "")
    if chosen:
        return Path(chosen)
    path = Path(__file__).with_name("_native.so")
    return path if path.is_file() else None


def require_library() -> None:
    """Raise UsageError if the compiled library cannot be loaded."""
    from mlbatch.native.library import trouble

    why = trouble()
    if why:
        raise UsageError(f"expected the compiled library of mlbatch, found {why}; {BUILD_ADVICE}")
