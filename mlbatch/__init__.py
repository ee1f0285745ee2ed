"""Time-consistent merged scans from raw packets of many lidars."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlbatch.api import calibrate as calibrate
    from mlbatch.api import compare as compare
    from mlbatch.api import convert as convert
    from mlbatch.api import dataset as dataset
    from mlbatch.api import extract as extract
    from mlbatch.api import inspect as inspect
    from mlbatch.api import open as open
    from mlbatch.api import read as read
    from mlbatch.api import report as report
    from mlbatch.api import scans as scans
    from mlbatch.digests import digest as digest
    from mlbatch.errors import MlbatchError as MlbatchError
    from mlbatch.outputs.scan import Scan as Scan
    from mlbatch.poses.calibration import Calibration as Calibration
    from mlbatch.python.dataset import Dataset as Dataset
    from mlbatch.python.recording import Recording as Recording
    from mlbatch.python.run import Run as Run
    from mlbatch.verification import verify as verify

__version__ = "0.1.0"
__all__ = [
    "Calibration",
    "Dataset",
    "MlbatchError",
    "Recording",
    "Run",
    "Scan",
    "calibrate",
    "compare",
    "convert",
    "dataset",
    "digest",
    "extract",
    "inspect",
    "open",
    "read",
    "report",
    "scans",
    "verify",
]

_PLACES = {
    "Calibration": "mlbatch.poses.calibration",
    "MlbatchError": "mlbatch.errors",
    "Dataset": "mlbatch.python.dataset",
    "Recording": "mlbatch.python.recording",
    "Run": "mlbatch.python.run",
    "Scan": "mlbatch.outputs.scan",
    "digest": "mlbatch.digests",
    "verify": "mlbatch.verification",
}
_OF_API = ("calibrate", "compare", "convert", "dataset", "extract", "inspect", "open", "read")
_PLACES |= dict.fromkeys((*_OF_API, "report", "scans"), "mlbatch.api")


def __getattr__(name: str) -> object:
    """Load what is asked for: `mlbatch --help` must not wait for numpy."""
    import importlib

    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)
