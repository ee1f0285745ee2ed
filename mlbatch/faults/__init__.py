"""Fault injection: packets dropped, damaged, reordered, repeated or delayed, and clocks changed.

specs.py parses what users write; replay.py applies it to the packets of a session.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlbatch.faults.replay import FaultCount as FaultCount
    from mlbatch.faults.replay import FaultLedger as FaultLedger
    from mlbatch.faults.replay import FaultReplay as FaultReplay
    from mlbatch.faults.specs import KINDS as KINDS
    from mlbatch.faults.specs import Fault as Fault
    from mlbatch.faults.specs import parse_fault as parse_fault

_MODULES = {
    "FaultCount": "mlbatch.faults.replay",
    "FaultLedger": "mlbatch.faults.replay",
    "FaultReplay": "mlbatch.faults.replay",
    "KINDS": "mlbatch.faults.specs",
    "Fault": "mlbatch.faults.specs",
    "parse_fault": "mlbatch.faults.specs",
}


def __getattr__(name: str) -> object:
    """Import on first use: parsing `--fault` does not need the replay."""
    import importlib

    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
