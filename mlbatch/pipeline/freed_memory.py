"""Memory that the process has freed and the C library keeps."""

from __future__ import annotations

import ctypes
import sys


def return_freed_memory() -> None:
    """Return freed pages to the kernel where the C library can (glibc, since 2.8).

    The search for sensors frees arrays of some MB between small objects that stay. The next arrays
    are larger or are only partly used: they would take memory in addition to these pages.
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
