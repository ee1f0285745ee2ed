"""Time-consistent merged scans from raw packets of many lidars."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlbatch.api import scans as scans
    from mlbatch.errors import MlbatchError as MlbatchError
    from mlbatch.types import Scan as Scan

__version__ = "0.1.0"
__all__ = ["MlbatchError", "Scan", "scans"]

_PLACES = {"scans": "mlbatch.api", "MlbatchError": "mlbatch.errors", "Scan": "mlbatch.types"}


def __getattr__(name: str) -> object:
    """Load what is asked for: `mlbatch --help` must not wait for numpy."""
    import importlib

    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)
